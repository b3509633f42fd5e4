"""A predictive safety filter: the smallest change of an input that keeps every plant safe.

An input passes if a known feedback law can afterwards bring every plant of a set (the
corners of the prior and its centre) to rest without reaching a critical level
(K. Wabersich, M. Zeilinger, A predictive safety filter for learning-based control,
Automatica 2021, with a fixed backup law). Otherwise it is moved towards the input of that
feedback law, as little as necessary. Each plant of the set has an observer that follows
the experiment. The feedback uses the mean of the observed states, as the true plant is not
known.

Feedback and observers are linear-quadratic, from secants over the typical size of each
state: a derivative at rest would be zero in a dead zone.
"""

from __future__ import annotations

import abc
import itertools
import math
from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..description import SpreadLike
from ..plant import AbstractPlant, Params, params_within
from ..safety import Supervision, critical_levels, safe_input
from ..simulation import step
from .player import AbstractPlayer

MAX_CORNERS = 16
"""Largest number of corners of the prior; with more, this number is drawn at random."""


class Memory(eqx.Module):
    """State of a filter during an experiment.

    Attributes:
        states: estimated state of each plant of the set.
        input: last input that was let through.
        num_unsafe: number of samples at which no input was safe for all plants.
    """

    states: Float[Array, "plant state"]
    input: Float[Array, " input"]
    num_unsafe: Int[Array, ""]


class AbstractFilter(eqx.Module):
    """What comes between an excitation and the supervisor, in simulated experiments."""

    @abc.abstractmethod
    def start(self) -> PyTree:
        """Memory before the experiment."""

    @abc.abstractmethod
    def __call__(
        self, memory: PyTree, measured: Float[Array, " output"], proposed: Float[Array, " input"]
    ) -> tuple[PyTree, Float[Array, " input"], Bool[Array, ""]]:
        """Memory before the next sample, the input to apply, and whether it was changed."""

    def applied(self, memory: PyTree, input: Float[Array, " input"]) -> PyTree:
        """Memory at the next sample; the input is the one that the supervisor let through."""
        del input
        return memory

    def supervision(self, rules: Supervision) -> Supervision:
        """A supervisor's rules beside this filter."""
        return rules

    @property
    def num_more(self) -> int:
        """Samples that it plays after the last one of the excitation."""
        return 0

    def is_over(self, memory: PyTree) -> Bool[Array, ""]:
        """Whether the experiment ends."""
        del memory
        return jnp.asarray(False)


class SafetyFilter(AbstractFilter):
    """A filter for one plant and its prior.

    Attributes:
        plant: as identification knows it.
        params: of the set of plants, leading axis the plant.
        feedback: of the backup law u = rest - K (x - x_rest).
        observer: gain of the observers.
        rest: input at rest.
        slew: largest change of an input from sample to sample; infinite for no limit.
        level: outputs beyond this fraction of their critical levels are not allowed.
        horizon: number of predicted samples under the backup law.
        num_candidates: number of inputs tried between the proposed one and the backup law's.
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
    def of(cls, plant: AbstractPlant, spread: SpreadLike, slew: float = math.inf) -> SafetyFilter:
        """A filter for parameters within a spread around their nominal values.

        Args:
            plant: as identification knows it.
            spread: of the prior.
            slew: largest change of every input in one second, in its unit.

        Raises:
            ValueError: for a plant that linear feedback cannot bring to rest.
        """
        feedback, observer = _linear_quadratic(plant)
        rest = jnp.asarray(safe_input(plant.definition))
        change = jnp.full(len(rest), slew * float(plant.dt))
        return cls(plant, _corners(plant, spread), feedback, observer, rest, change)

    def start(self) -> Memory:
        """Memory before the experiment: all plants at rest."""
        states = jnp.tile(self.plant.initial_state, (len(self.params[0]), 1))
        return Memory(states, self.rest, jnp.asarray(0))

    def __call__(
        self, memory: Memory, measured: Float[Array, " output"], proposed: Float[Array, " input"]
    ) -> tuple[Memory, Float[Array, " input"], Bool[Array, ""]]:
        """Memory before the next sample, the input to apply, and whether it was changed.

        An input that is NaN or infinite passes unchanged: the supervisor then ends the
        experiment and records why.
        """
        states = jax.vmap(self._corrected, (0, 0, None))(memory.states, self.params, measured)
        wanted = self._within(proposed, memory.input)
        backup = self._within(self._backup(states), memory.input)
        share = jnp.linspace(0.0, 1.0, self.num_candidates)[:, None]
        candidates = wanted[None] + share * (backup - wanted)[None]
        tried = jax.lax.stop_gradient((candidates, states))  # a choice has no derivative
        is_safe = jax.vmap(self._reach, (0, None))(*tried) < self.level
        # The first safe input; where there is none, that of the backup law.
        best = jnp.where(jnp.any(is_safe), jnp.argmax(is_safe), self.num_candidates - 1)
        input = candidates[best]
        states = jax.vmap(self._next, (0, 0, None))(states, self.params, input)
        memory = Memory(states, input, memory.num_unsafe + ~jnp.any(is_safe))
        is_finite = jnp.all(jnp.isfinite(proposed))
        return memory, jnp.where(is_finite, input, proposed), is_finite & (best > 0)

    def _within(self, input: Array, before: Array) -> Array:
        """The nearest input within limits and slew."""
        return jnp.clip(
            jnp.clip(input, before - self.slew, before + self.slew), *self.plant.input_limits
        )

    def _corrected(self, state: Array, params: Params, measured: Array) -> Array:
        error = measured - self.plant.output(state, params)
        return state + self.observer @ jnp.where(jnp.isfinite(error), error, 0.0)

    def _backup(self, states: Array) -> Array:
        """Input of the feedback law, for the mean of the plants' states."""
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
            outputs = jax.vmap(self.plant.true_output)(states, self.params)
            size = jnp.max(jnp.abs(outputs) / critical[None])
            return (states, self._within(self._backup(states), applied)), size

        sizes = jax.lax.scan(advance, (states, input), None, length=self.horizon)[1]
        return jnp.max(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))


def _corners(plant: AbstractPlant, spread: SpreadLike) -> Params:
    """Centre and corners of the prior; the leading axis is the plant."""
    count = len(plant.nominal)
    if 2**count > MAX_CORNERS:
        signs = np.random.default_rng(0).choice((-1.0, 1.0), (MAX_CORNERS, count))
    else:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=count)))
    points = np.vstack([np.zeros(count), signs])
    return jax.vmap(lambda point: params_within(plant, spread, point))(points)


def linear_model(plant: AbstractPlant) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrices A, B, C of one sample of the nominal plant, by secants over usual sizes."""
    d, rest, params = plant.definition, plant.initial_state, plant.nominal
    zero = jnp.asarray(safe_input(d))
    states, inputs = (
        np.array([s.scale for s in d.states]),
        np.array([i.amplitude for i in d.inputs]),
    )

    def secant(response: Callable[[np.ndarray], Array], sizes: np.ndarray) -> np.ndarray:
        moves = [np.eye(len(sizes))[i] * size for i, size in enumerate(sizes)]
        columns = [
            (response(m) - response(-m)) / (2 * s) for m, s in zip(moves, sizes, strict=True)
        ]
        return np.stack([np.asarray(column) for column in columns], axis=1)

    A = secant(lambda move: step(plant, rest + move, zero, params), states)
    B = secant(lambda move: step(plant, rest, zero + move, params), inputs)
    C = secant(lambda move: plant.output(rest + move, params), states)
    return A, B, C


def _linear_quadratic(plant: AbstractPlant) -> tuple[Array, Array]:
    """Gains of the backup law and of the observers, for the nominal plant."""
    d = plant.definition
    A, B, C = linear_model(plant)
    states, inputs = (
        np.array([s.scale for s in d.states]),
        np.array([i.amplitude for i in d.inputs]),
    )
    try:
        P = scipy.linalg.solve_discrete_are(A, B, np.diag(states**-2.0), np.diag(inputs**-2.0))
        # Process noise per sample: half a usual input, through the input matrix, and a
        # hundredth of each state's size. Measurement noise: the sensor's.
        noise = np.maximum(
            np.asarray(plant.sensor.sd), 1e-4 * np.array([o.scale for o in d.outputs])
        )
        Q, R = (
            B @ np.diag((0.5 * inputs) ** 2) @ B.T + np.diag((0.01 * states) ** 2),
            np.diag(noise**2),
        )
        S = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(f"no linear feedback brings plant {d.name!r} to rest ({error})") from None
    feedback = np.linalg.solve(np.diag(inputs**-2.0) + B.T @ P @ B, B.T @ P @ A)
    observer = S @ C.T @ np.linalg.inv(C @ S @ C.T + R)
    return jnp.asarray(feedback), jnp.asarray(observer)


_filtered = eqx.filter_jit(SafetyFilter.__call__)


class FilteredPlayer(AbstractPlayer):
    """A player behind a safety filter."""

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
        """Passes the applied input to the player."""
        self._player.applied(input)

    def origin(self) -> Mapping[str, object]:
        """As for the player without filter."""
        return self._player.origin()

    def facts(self) -> Mapping[str, object]:
        """Also the number of interventions, and of samples at which no input was safe."""
        return {
            **self._player.facts(),
            "filter_interventions": self.num_interventions,
            "filter_without_safe_input": int(self._memory.num_unsafe),
        }
