"""Guards made for a plant, its declared uncertainty and what is played: model, brake, thresholds.

A guard is made once, where JAX is installed; see `rig.guard`.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float, Int

from ..description import SpreadLike
from ..environment.falsification import Cases
from ..excitation import AbstractExcitation
from ..plant import AbstractPlant, Params
from ..plant.uncertainty import Range, Uncertainty
from ..safety import Supervision, safe_input, watched_levels
from ..simulation import step
from . import guard
from .falsification import OnRig
from .filter import AbstractFilter
from .guard import Belief, Guard, GuardRules, Model
from .tracing import program_of

_WATCHED = 30.0  # weight of the outputs with a level in the brake
# Weights of the states and of the inputs in the brakes that are tried. The last one lets a pole
# swing while its cart is stopped.
_BRAKES = ((1.0, 10.0), (1.0, 1.0), (1.0, 0.1), (0.1, 10.0))
_SAFE = 0.99  # largest output over its level that a brake may leave
_LATENCY = 0.2  # of a rig, at most, in samples
_MARGIN, _MARGIN_OUTSIDE = 1.3, 0.15  # of the thresholds above the largest score
_CHUNK = 100  # experiments of one call
_WALK = 1e-3  # unexplained change in one sample, of a state in its scales and of a quantity


class GuardModel(eqx.Module):
    """The declared plants, as the guard's filter needs them.

    Attributes:
        uncertainty: the box.
        depth: samples for which an input can act.
    """

    uncertainty: Uncertainty
    depth: int = eqx.field(static=True)

    @classmethod
    def of(cls, uncertainty: Uncertainty) -> GuardModel:
        """The model for a box."""
        delays = [
            high
            for name, high in zip(uncertainty.names, uncertainty.upper.tolist(), strict=True)
            if name.startswith("delay_")
        ]
        longest = max(delays, default=0.0) / float(uncertainty.plant.dt)
        return cls(uncertainty, 2 + math.ceil(longest))

    @classmethod
    def for_rig(
        cls, plant: AbstractPlant, spread: SpreadLike, ranges: Mapping[str, Range]
    ) -> GuardModel:
        """The model for a declared uncertainty, and for a rig.

        A rig acts a part of a sampling time late: the guard must not take that for a fault.
        """
        short, declared = _LATENCY * float(plant.dt), Uncertainty.of(plant, spread, ranges).ranges()
        late = {
            name: (0.0, max(short, declared.get(name, (0.0, 0.0))[1]))
            for name in (f"delay_{i.name}" for i in plant.definition.inputs)
        }
        return cls.of(Uncertainty.of(plant, spread, {**ranges, **late}))

    @property
    def estimated(self) -> tuple[int, ...]:
        """Indices of the quantities that act throughout an experiment."""
        names = self.uncertainty.names
        return tuple(
            i for i, n in enumerate(names) if not n.startswith("initial_") and n != "noise"
        )

    def functions(self) -> Model:
        """Over points."""
        return Model(jax.vmap(self._advance), jax.vmap(self._output))

    def _split(self, point: Array) -> tuple[Array, AbstractPlant, Params]:
        """State, plant and parameters at a point."""
        count = len(self.uncertainty.plant.definition.states)
        place = {index: count + i for i, index in enumerate(self.estimated)}
        zero = jnp.asarray(0.0)
        size = len(self.uncertainty.names)
        quantities = jnp.stack([point[place[i]] if i in place else zero for i in range(size)])
        return point[:count], *self.uncertainty.at(quantities)

    def _output(self, point: Float[Array, " quantity"]) -> Float[Array, " output"]:
        state, plant, params = self._split(point)
        return plant.output(state, params)

    def _advance(
        self, point: Float[Array, " quantity"], past: Float[Array, "depth input"]
    ) -> Float[Array, " state"]:
        state, plant, params = self._split(point)
        delay = plant.delay(params)
        if delay is None:
            return step(plant, state, past[-1], params)
        delay = jnp.clip(delay / plant.dt, 0.0, self.depth - 1.001)
        # As `simulation.run_episode` has it: mean and first moment of the delayed input.
        whole = jnp.floor(delay)
        part, age = delay - whole, (self.depth - 1 - jnp.arange(self.depth))[:, None]
        new, old = (jnp.sum(jnp.where(age == whole[None] + i, past, 0.0), axis=0) for i in (0, 1))
        mean, half = new + part * (old - new), 3 * part * (1 - part) * (new - old)
        return step(plant, state, mean - half, params, next_input=mean + half)


def rules_of(model: GuardModel, weights: tuple[float, float] = (1.0, 1.0)) -> GuardRules:
    """The rules for a model, with thresholds that nothing exceeds.

    Args:
        weights: of the states and of the inputs in the brake.

    Raises:
        ValueError: for a plant that linear feedback cannot bring to rest.
    """
    box, plant = model.uncertainty, model.uncertainty.plant
    d, names = plant.definition, list(box.names)
    num_states, count = len(d.states), len(model.estimated)
    scale = np.array([s.scale for s in d.states])
    start = np.zeros(num_states)
    for i, state in enumerate(d.states):
        if (name := f"initial_{state.name}") in names:
            at = names.index(name)
            start[i] = float(box.upper[at] - box.lower[at]) / 2
    spread = np.concatenate([np.maximum(start, 1e-9 * scale), np.ones(count)])
    walk = np.concatenate([_WALK * scale, np.full(count, _WALK)])
    watched, _, critical = watched_levels(d)
    (feedback, past_feedback), rest = _brake(model, *weights), np.asarray(safe_input(d), float)
    limits = plant.input_limits
    return GuardRules(
        mean=np.concatenate([np.asarray(plant.initial_state), np.zeros(count)]),
        root=np.diag(spread / math.sqrt(3)),  # as a uniform distribution has it
        walk=walk,
        noise=_noise(plant),
        feedback=feedback,
        past_feedback=past_feedback,
        rest=rest,
        lower=np.asarray(limits[0]),
        upper=np.asarray(limits[1]),
        watched=np.array(watched, int),
        critical=np.asarray(critical, float),
        state_scale=scale,
        depth=model.depth,
        thresholds=np.full(3, np.inf),
    )


def _noise(plant: AbstractPlant) -> np.ndarray:
    """Standard deviation of a measurement: noise, rounding, and a trifle where there is neither."""
    sensor, scale = plant.sensor, np.array([o.scale for o in plant.definition.outputs])
    rounding = np.asarray(sensor.resolution) / math.sqrt(12)
    return np.maximum(np.hypot(np.asarray(sensor.noise_sd), rounding), 1e-5 * scale)


def _brake(model: GuardModel, of_states: float, of_inputs: float) -> tuple[np.ndarray, np.ndarray]:
    """Linear-quadratic feedback that keeps the outputs with a critical level small.

    It is made for the largest delays and lags of the box: a plant that acts sooner is easier to
    brake. What was written and has not acted yet belongs to the state.

    Returns:
        Feedback of the plant's state [input, state] and of the last inputs [input, past input].
    """
    A, B, C = _linear(model)
    plant, d = model.uncertainty.plant, model.uncertainty.plant.definition
    watched, _, critical = watched_levels(d)
    states, inputs = (
        np.array([s.scale for s in d.states]),
        np.array([i.amplitude for i in d.inputs]),
    )
    num_states, num_inputs, num_past = len(states), len(inputs), model.depth - 1
    # The state, then the last inputs, the newest at the end; a small part of each state leaks
    # away, so that an effect that nothing controls, such as a drift, does not matter.
    whole = np.block([
        [A * (1 - 1e-6), B[:, : num_past * num_inputs]],
        [np.zeros((num_past * num_inputs, num_states)),
         np.eye(num_past * num_inputs, k=num_inputs)],
    ])  # fmt: skip
    entry = np.zeros((len(whole), num_inputs))
    entry[:num_states] = B[:, num_past * num_inputs :]
    if num_past:
        entry[-num_inputs:] = np.eye(num_inputs)
    levels = np.zeros((len(watched), len(whole)))
    levels[:, :num_states] = C[np.array(watched, int)] / critical[:, None]
    weights = np.concatenate([of_states * states**-2.0, np.tile(1e-6 * inputs**-2.0, num_past)])
    Q = np.diag(weights) + _WATCHED * levels.T @ levels
    R = of_inputs * np.diag(inputs**-2.0)
    try:
        P = scipy.linalg.solve_discrete_are(whole, entry, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(
            f"no linear feedback brings plant {plant.definition.name!r} to rest ({error})"
        ) from None
    feedback = np.linalg.solve(R + entry.T @ P @ entry, entry.T @ P @ whole)
    return feedback[:, :num_states], feedback[:, num_states:]


def _linear(model: GuardModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrices of one sample of the slowest plant, by secants; B has all inputs of the past."""
    plant, d = model.uncertainty.plant, model.uncertainty.plant.definition
    functions = model.functions()
    names = [model.uncertainty.names[i] for i in model.estimated]
    slowest = np.array([float(name.startswith(("delay_", "lag_"))) for name in names])
    states = np.array([s.scale for s in d.states])
    inputs = np.tile([i.amplitude for i in d.inputs], model.depth)
    sizes = np.concatenate([states, inputs])
    # Rows: each state and each input of the past, moved up, then down.
    moves = np.concatenate([np.diag(sizes), -np.diag(sizes)])
    moved, past = moves[:, : len(states)], moves[:, len(states) :]
    points = np.concatenate(
        [np.asarray(plant.initial_state) + moved, np.tile(slowest, (len(moves), 1))], axis=1
    )
    past = np.tile(np.asarray(safe_input(d), float), model.depth) + past

    def secants(responses: Array) -> np.ndarray:
        up, down = np.split(np.asarray(responses), 2)
        return ((up - down) / (2 * sizes[:, None])).T

    advanced = jax.jit(functions.advance)(points, past.reshape(len(moves), model.depth, -1))
    whole, C = secants(advanced), secants(jax.jit(functions.output)(points))
    return whole[:, : len(states)], whole[:, len(states) :], C[:, : len(states)]


def guard_for(
    plant: AbstractPlant,
    excitation: AbstractExcitation,
    spread: SpreadLike,
    ranges: Mapping[str, Range],
    *,
    num_steps: int,
    num_runs: int,
    seed: int = 0,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> GuardFilter:
    """The guard of an excitation, with thresholds that declared plants do not reach.

    The excitation is played on simulated rigs with plants drawn from the declared uncertainty. A
    threshold is the largest score of all these experiments, and some more. The brake is the first
    of several that keeps these plants safe after a trip at any time, or the one that comes nearest
    to it.

    Args:
        plant: for which the excitation was made.
        excitation: plays.
        spread: of the declared uncertainty, see `Uncertainty.of`.
        ranges: of the declared uncertainty.
        num_steps: of an experiment.
        num_runs: experiments.
        seed: of these.
        progress: called with a text, how many experiments are done, and their number.

    Raises:
        ValueError: for a plant that linear feedback cannot bring to rest.
    """
    box = Uncertainty.of(plant, spread, ranges)
    model = GuardModel.for_rig(plant, spread, ranges)
    keys = jax.random.split(jax.random.key(seed), num_runs)
    cases = Cases(jax.vmap(box.draw)(keys), jnp.arange(num_runs) + seed * num_runs % 2**62)
    stops = jax.random.randint(jax.random.key(seed), (num_runs,), 1, num_steps + 1)

    def played(function: Callable[..., Array], rules: GuardRules, *series: Array) -> np.ndarray:
        """A function of all experiments, chunk by chunk."""
        watched, latency = GuardFilter(model, rules, num_steps), float(plant.dt) / 10
        play, rows = OnRig.of(box, excitation, num_steps, watched, latency=latency), []
        for first in range(0, num_runs, _CHUNK):
            progress("calibrating the guard", first, num_runs)
            chunk = jax.tree.map(lambda x, at=first: x[at : at + _CHUNK], (cases, *series))
            rows.append(np.asarray(function(play, *chunk)))
        return np.concatenate(rows)

    chosen = rules_of(model)
    best = np.inf
    for weights in _BRAKES:  # what declared plants do after a trip at any time decides
        rules = rules_of(model, weights)
        largest = played(_stopped, rules, stops).max()
        if largest < best:
            chosen, best = rules, largest
        if largest < _SAFE:
            break
    if not best < 1:
        warnings.warn(
            "the guard's brake does not keep all declared plants below their critical levels: of "
            f"{num_runs} that it stopped at a random sample, one reached {best:.2f} of its level",
            stacklevel=2,
        )
    top = np.nanmax(played(_scores, chosen), axis=0)
    progress("calibrating the guard", num_runs, num_runs)
    thresholds = np.append(_MARGIN * top[:2], top[2] + _MARGIN_OUTSIDE)
    return GuardFilter(model, dataclasses.replace(chosen, thresholds=thresholds), num_steps)


@eqx.filter_jit
def _stopped(play: OnRig, cases: Cases, stops: Int[Array, " case"]) -> Float[Array, " case"]:
    """The nearness of each case, where the guard trips at the given sample."""

    def one(case: Cases, stop: Array) -> Array:
        asked = dataclasses.replace(play.safety_filter, trips_at=stop)
        return dataclasses.replace(play, safety_filter=asked)(case)

    return jax.vmap(one)(cases, stops)


@eqx.filter_jit
def _scores(play: OnRig, cases: Cases) -> Float[Array, "case 3"]:
    """The largest scores of the guard in each case."""
    return jax.vmap(lambda case: play.run(case).memory.largest)(cases)


def _of_leaves(depth: int, leaves: Iterable[Any]) -> GuardRules:
    """Rules with leaves that may be traced."""
    rules = object.__new__(GuardRules)
    vars(rules).update(zip(_ARRAYS, leaves, strict=True), depth=depth)
    return rules


_ARRAYS = tuple(f.name for f in dataclasses.fields(GuardRules) if f.name != "depth")
jax.tree_util.register_pytree_node(
    GuardRules, lambda rules: ([getattr(rules, n) for n in _ARRAYS], rules.depth), _of_leaves
)


class GuardFilter(AbstractFilter):
    """A guard between excitation and supervisor, for batches of simulated experiments.

    Attributes:
        model: the declared plants.
        rules: of the guard.
        num_steps: samples of the experiment, after which it brakes.
        trips_at: sample at which it trips in any case.
    """

    model: GuardModel
    rules: GuardRules
    num_steps: int = eqx.field(static=True)
    trips_at: Int[Array, ""] | float = math.inf

    def start(self) -> Belief:
        """Before the first measurement."""
        return guard.start(jnp, self.rules)

    def __call__(
        self, belief: Belief, measured: Float[Array, " output"], proposed: Float[Array, " input"]
    ) -> tuple[Belief, Float[Array, " input"], Bool[Array, ""]]:
        """The belief after a measurement, the input to apply, and whether it is the brake's."""
        model = self.model.functions()
        is_asked = belief.k >= jnp.minimum(self.num_steps, self.trips_at)
        belief = guard.observed(jnp, self.rules, model, belief, measured, is_asked)
        input = guard.decided(jnp, self.rules, model, belief, proposed)
        input = jnp.where(belief.is_over, jnp.asarray(self.rules.rest), input)
        return belief, input, belief.num_braked > 0

    def applied(self, memory: Belief, input: Float[Array, " input"]) -> Belief:
        """The belief at the next sample."""
        return guard.moved(jnp, self.rules, self.model.functions(), memory, input)

    @property
    def num_more(self) -> int:
        """The longest brake."""
        return guard.LONGEST_BRAKE

    def is_over(self, memory: Belief) -> Bool[Array, ""]:
        """Whether the brake has ended, and not as after a whole experiment of a declared plant."""
        return memory.is_over & memory.is_unexplained(self.num_steps)

    def supervision(self, rules: Supervision) -> Supervision:
        """A supervisor's rules beside this guard, which notices a frozen sensor and brakes."""
        return guard.beside(rules)

    def guard(self) -> Guard:
        """The same guard for NumPy.

        Raises:
            ValueError: for a plant with equations that a program cannot have.
        """
        rules, model, count = self.rules, self.model.functions(), guard.num_points(self.rules)
        points = np.zeros((count, len(rules.mean)))
        past = np.zeros((count, rules.depth, len(rules.rest)))
        advance = program_of(model.advance, points, past)
        return Guard(rules, advance, program_of(model.output, points))
