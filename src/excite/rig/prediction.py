"""A predictive safety filter: the smallest change of an input that keeps every plant safe.

An input may pass if, after it, a known feedback can bring every plant of a set, the
corners of the prior and its middle, to rest without reaching the limit (K. Wabersich,
M. Zeilinger, A predictive safety filter for learning-based control, Automatica 2021, with
a fixed backup law). Otherwise it is moved towards what that feedback would do, as little
as is enough. Every plant of the set follows the experiment with an observer of its own.

Feedback and observers are linear-quadratic, from a linearisation over the typical size of
each state: a derivative at rest would see nothing but a dead zone.
"""

from __future__ import annotations

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float

from ..plant import AbstractPlant, Params
from ..safety import critical_levels, safe_input
from ..simulation import step
from .base import AbstractPlayer

MAX_CORNERS = 16
"""Of the prior's box; beyond, as many are drawn at random."""


class SafetyFilter(eqx.Module):
    """A filter for one plant and its prior.

    Attributes:
        plant: as identification knows it.
        params: of the set of plants, leading axis the plant.
        feedback: of the backup law u = rest - K (x - x_rest).
        observer: gain of the observers.
        rest: input at rest.
        level: outputs beyond this fraction of their critical levels are not allowed.
        horizon: samples in which the backup law must have turned every plant around.
        num_candidates: inputs tried between the proposed one and the backup law's.
    """

    plant: AbstractPlant
    params: Params
    feedback: Float[Array, "input state"]
    observer: Float[Array, "state output"]
    rest: Float[Array, " input"]
    level: float = eqx.field(static=True, default=0.95)
    horizon: int = eqx.field(static=True, default=16)
    num_candidates: int = eqx.field(static=True, default=3)

    @classmethod
    def of(cls, plant: AbstractPlant, spread: float, **choices: Any) -> SafetyFilter:
        """A filter for parameters within ± `spread` times their scale.

        Raises:
            ValueError: for a plant that the backup law cannot hold.
        """
        feedback, observer = _linear_quadratic(plant)
        rest = jnp.asarray(safe_input(plant.definition))
        return cls(plant, _corners(plant, spread), feedback, observer, rest, **choices)

    def start(self) -> Float[Array, "plant state"]:
        """States before the experiment: all at rest."""
        return jnp.tile(self.plant.initial_state, (len(self.params[0]), 1))

    def __call__(
        self,
        states: Float[Array, "plant state"],
        measured: Float[Array, " output"],
        proposed: Float[Array, " input"],
    ) -> tuple[Float[Array, "plant state"], Float[Array, " input"], Bool[Array, ""]]:
        """States before the next sample, the input to apply, and whether it is another."""
        states = jax.vmap(self._corrected, (0, 0, None))(states, self.params, measured)
        lower, upper = self.plant.input_limits
        wanted = jnp.clip(jnp.where(jnp.isfinite(proposed), proposed, self.rest), lower, upper)
        backup = jnp.clip(jnp.mean(jax.vmap(self._backup)(states), axis=0), lower, upper)
        share = jnp.linspace(0.0, 1.0, self.num_candidates)[:, None]
        candidates = wanted[None] + share * (backup - wanted)[None]
        reach = jax.vmap(self._reach, (0, None))(candidates, states)
        is_safe = reach < self.level
        # The first that is safe; where none is, the one that stays furthest away.
        best = jnp.where(jnp.any(is_safe), jnp.argmax(is_safe), jnp.argmin(reach))
        input = candidates[best]
        states = jax.vmap(self._next, (0, 0, None))(states, self.params, input)
        return states, input, best > 0

    def _corrected(self, state: Array, params: Params, measured: Array) -> Array:
        error = measured - self.plant.output(state, params)
        return state + self.observer @ jnp.where(jnp.isfinite(error), error, 0.0)

    def _backup(self, state: Array) -> Array:
        return self.rest - self.feedback @ (state - self.plant.initial_state)

    def _next(self, state: Array, params: Params, input: Array) -> Array:
        return step(self.plant, state, input, params)

    def _reach(self, input: Array, states: Array) -> Array:
        """Largest output over its critical level, over all plants and the horizon."""
        critical = critical_levels(self.plant.definition)
        lower, upper = self.plant.input_limits

        def one(state: Array, params: Params) -> Array:
            def advance(carry: tuple, k: Array) -> tuple[tuple, Array]:
                state, applied = carry
                state = self._next(state, params, applied)
                size = jnp.max(jnp.abs(self.plant.output(state, params)) / critical)
                return (state, jnp.clip(self._backup(state), lower, upper)), size

            sizes = jax.lax.scan(advance, (state, input), jnp.arange(self.horizon))[1]
            return jnp.max(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))

        return jnp.max(jax.vmap(one)(states, self.params))


def _corners(plant: AbstractPlant, spread: float) -> Params:
    """The prior's middle and corners, leading axis the plant."""
    middle = np.array([float(value) for value in plant.nominal])
    reach = spread * np.array([p.scale for p in plant.definition.parameters])
    signs = np.array(list(itertools.islice(itertools.product((-1, 1), repeat=len(reach)), 4096)))
    if len(signs) > MAX_CORNERS:
        signs = np.random.default_rng(0).permutation(signs)[:MAX_CORNERS]
    every = np.vstack([middle, middle + signs * reach])
    return plant.Params(*(jnp.asarray(column) for column in every.T))


def _linear_quadratic(plant: AbstractPlant) -> tuple[Array, Array]:
    """Gains of the backup law and of the observers, for the nominal plant."""
    d, rest, params = plant.definition, plant.initial_state, plant.nominal
    zero = jnp.asarray(safe_input(d))
    states, inputs = (
        np.array([s.scale for s in d.states]),
        np.array([i.amplitude for i in d.inputs]),
    )

    def secant(response: Any, sizes: np.ndarray) -> np.ndarray:
        moves = [np.eye(len(sizes))[i] * size for i, size in enumerate(sizes)]
        columns = [
            (response(m) - response(-m)) / (2 * s) for m, s in zip(moves, sizes, strict=True)
        ]
        return np.stack([np.asarray(column) for column in columns], axis=1)

    A = secant(lambda move: step(plant, rest + move, zero, params), states)
    B = secant(lambda move: step(plant, rest, zero + move, params), inputs)
    C = secant(lambda move: plant.output(rest + move, params), states)
    try:
        P = scipy.linalg.solve_discrete_are(A, B, np.diag(states**-2.0), np.diag(inputs**-2.0))
        # Disturbed by half a usual input, which moves the states as inputs do, and a hundredth
        # of each state's size a sample, against the sensor's noise.
        noise = np.maximum(
            np.asarray(plant.sensor.sd), 1e-4 * np.array([o.scale for o in d.outputs])
        )
        Q, R = (
            B @ np.diag((0.5 * inputs) ** 2) @ B.T + np.diag((0.01 * states) ** 2),
            np.diag(noise**2),
        )
        S = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(
            f"plant {d.name!r} has no linear feedback that could bring it to rest ({error})"
        ) from None
    feedback = np.linalg.solve(np.diag(inputs**-2.0) + B.T @ P @ B, B.T @ P @ A)
    observer = S @ C.T @ np.linalg.inv(C @ S @ C.T + R)
    return jnp.asarray(feedback), jnp.asarray(observer)


_filtered = eqx.filter_jit(SafetyFilter.__call__)


class FilteredPlayer(AbstractPlayer):
    """A player whose inputs pass through a safety filter."""

    def __init__(self, player: AbstractPlayer, filter: SafetyFilter) -> None:
        """Compiles the filter."""
        self._player, self._filter = player, filter
        self.num_steps, self.num_interventions = player.num_steps, 0
        self._states = filter.start()
        outputs = jnp.zeros(len(filter.plant.definition.outputs))
        _filtered(filter, self._states, outputs, filter.rest)

    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """The input that the filter lets through."""
        proposed = jnp.asarray(self._player(k, measured), float)
        self._states, input, is_changed = _filtered(
            self._filter, self._states, jnp.asarray(measured), proposed
        )
        self.num_interventions += int(is_changed)
        return np.array(input)

    def applied(self, input: np.ndarray) -> None:
        """Tells the player."""
        self._player.applied(input)

    def facts(self) -> dict[str, Any]:
        """The player's, and how often the filter intervened."""
        return {**self._player.facts(), "filter_interventions": self.num_interventions}
