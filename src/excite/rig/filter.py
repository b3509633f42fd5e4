"""A predictive safety filter: the smallest change of an input that keeps every plant safe.

An input may pass if, after it, one known feedback brings every plant of a set, the corners
of the prior and its middle, to rest without reaching the limit (K. Wabersich, M. Zeilinger,
A predictive safety filter for learning-based control, Automatica 2021, with a fixed backup
law). Otherwise it is moved towards what that feedback would do, as little as is enough.
Every plant of the set follows the experiment with an observer of its own; the feedback,
which cannot know which of them is the true one, takes the mean of what they ask for.

Feedback and observers are linear-quadratic, from a linearisation over the typical size of
each state: a derivative at rest would see nothing but a dead zone.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float, Int

from ..plant import AbstractPlant, Params
from ..safety import critical_levels, safe_input
from ..simulation import step
from .player import AbstractPlayer

MAX_CORNERS = 16
"""Of the prior's box; beyond, as many are drawn at random."""


class Memory(eqx.Module):
    """What a filter remembers of an experiment.

    Attributes:
        states: of the plants of its set, as their observers see them.
        input: that it let through last.
        num_unsafe: samples at which no input was safe for all plants.
    """

    states: Float[Array, "plant state"]
    input: Float[Array, " input"]
    num_unsafe: Int[Array, ""]


class SafetyFilter(eqx.Module):
    """A filter for one plant and its prior.

    Attributes:
        plant: as identification knows it.
        params: of the set of plants, leading axis the plant.
        feedback: of the backup law u = rest - K (x - x_rest).
        observer: gain of the observers.
        rest: input at rest.
        slew: largest change of an input from sample to sample, infinite for any.
        level: outputs beyond this fraction of their critical levels are not allowed.
        horizon: samples in which the backup law must have turned every plant around.
        num_candidates: inputs tried between the proposed one and the backup law's.
    """

    plant: AbstractPlant
    params: Params
    feedback: Float[Array, "input state"]
    observer: Float[Array, "state output"]
    rest: Float[Array, " input"]
    slew: Float[Array, " input"]
    level: float = eqx.field(static=True, default=0.92)
    horizon: int = eqx.field(static=True, default=24)
    num_candidates: int = eqx.field(static=True, default=3)

    @classmethod
    def of(
        cls, plant: AbstractPlant, spread: float, slew: float = math.inf, **choices: Any
    ) -> SafetyFilter:
        """A filter for parameters within ± `spread` times their scale.

        Args:
            slew: largest change of every input in one second, in its unit.

        Raises:
            ValueError: for a plant that the backup law cannot hold.
        """
        feedback, observer = _linear_quadratic(plant)
        rest = jnp.asarray(safe_input(plant.definition))
        change = jnp.full(len(rest), slew * float(plant.dt))
        return cls(plant, _corners(plant, spread), feedback, observer, rest, change, **choices)

    def start(self) -> Memory:
        """Before the experiment: all at rest."""
        states = jnp.tile(self.plant.initial_state, (len(self.params[0]), 1))
        return Memory(states, self.rest, jnp.asarray(0))

    def __call__(
        self, memory: Memory, measured: Float[Array, " output"], proposed: Float[Array, " input"]
    ) -> tuple[Memory, Float[Array, " input"], Bool[Array, ""]]:
        """Memory before the next sample, the input to apply, and whether it is another.

        An input that is not finite passes as it is: it is the supervisor's, who then ends the
        experiment and says why. So does one that no observer can tell any more.
        """
        states = jax.vmap(self._corrected, (0, 0, None))(memory.states, self.params, measured)
        wanted = self._within(proposed, memory.input)
        backup = self._within(self._backup(states), memory.input)
        share = jnp.linspace(0.0, 1.0, self.num_candidates)[:, None]
        candidates = wanted[None] + share * (backup - wanted)[None]
        is_safe = jax.vmap(self._reach, (0, None))(candidates, states) < self.level
        # The first that is safe; where none is, what the backup law does.
        best = jnp.where(jnp.any(is_safe), jnp.argmax(is_safe), self.num_candidates - 1)
        input = candidates[best]
        states = jax.vmap(self._next, (0, 0, None))(states, self.params, input)
        memory = Memory(states, input, memory.num_unsafe + ~jnp.any(is_safe))
        is_finite = jnp.all(jnp.isfinite(proposed))
        return memory, jnp.where(is_finite, input, proposed), is_finite & (best > 0)

    def _within(self, input: Array, before: Array) -> Array:
        """The nearest input that limits and slew allow."""
        return jnp.clip(
            jnp.clip(input, before - self.slew, before + self.slew), *self.plant.input_limits
        )

    def _corrected(self, state: Array, params: Params, measured: Array) -> Array:
        error = measured - self.plant.output(state, params)
        return state + self.observer @ jnp.where(jnp.isfinite(error), error, 0.0)

    def _backup(self, states: Array) -> Array:
        """What the feedback asks for, in the mean over the plants."""
        away = jnp.mean(states, axis=0) - self.plant.initial_state
        return self.rest - self.feedback @ away

    def _next(self, state: Array, params: Params, input: Array) -> Array:
        return step(self.plant, state, input, params)

    def _reach(self, input: Array, states: Array) -> Array:
        """Largest output over its critical level, over all plants and the horizon."""
        critical = critical_levels(self.plant.definition)

        def advance(carry: tuple, _: None) -> tuple[tuple, Array]:
            states, applied = carry
            states = jax.vmap(self._next, (0, 0, None))(states, self.params, applied)
            outputs = jax.vmap(self.plant.output)(states, self.params)
            size = jnp.max(jnp.abs(outputs) / critical[None])
            return (states, self._within(self._backup(states), applied)), size

        sizes = jax.lax.scan(advance, (states, input), None, length=self.horizon)[1]
        return jnp.max(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))


def _corners(plant: AbstractPlant, spread: float) -> Params:
    """The prior's middle and corners, leading axis the plant."""
    middle = np.array([float(value) for value in plant.nominal])
    reach = spread * np.array([p.scale for p in plant.definition.parameters])
    if 2 ** len(reach) > MAX_CORNERS:
        signs = np.random.default_rng(0).choice((-1, 1), (MAX_CORNERS, len(reach)))
    else:
        signs = np.array(list(itertools.product((-1, 1), repeat=len(reach))))
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
        self._memory = filter.start()
        outputs = jnp.zeros(len(filter.plant.definition.outputs))
        _filtered(filter, self._memory, outputs, filter.rest)

    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """The input that the filter lets through."""
        proposed = jnp.asarray(self._player(k, measured), float)
        self._memory, input, is_changed = _filtered(
            self._filter, self._memory, jnp.asarray(measured), proposed
        )
        self.num_interventions += int(is_changed)
        return np.array(input)

    def applied(self, input: np.ndarray) -> None:
        """Tells the player."""
        self._player.applied(input)

    def origin(self) -> dict[str, Any]:
        """The player's."""
        return self._player.origin()

    def facts(self) -> dict[str, Any]:
        """The player's, how often the filter intervened, and how often nothing was safe."""
        own = {"filter_interventions": self.num_interventions}
        own["filter_without_safe_input"] = int(self._memory.num_unsafe)
        return {**self._player.facts(), **own}
