"""Training by the gradient of the whole experiment: policy, plant, sensor, objective.

The decision process is one differentiable function of the policy's weights, so that the
gradient of what an experiment is worth follows from one backward pass through it. Every
update takes a fresh batch of plants. Safety is a quadratic penalty on the true outputs
from a margin below the critical level. Its weight grows after a batch in which a plant came
too near to that level, and slowly decays otherwise. The policy with the best validation and
an allowed violation rate on held-out plants is kept.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key, PRNGKeyArray, PyTree

from ..environment import Env, EnvState
from ..environment.falsification import Cases, Effort, OnPlant, climbed, nearness, search
from ..excitation import Coast, PolicyExcitation
from ..plant import AbstractPlant
from ..plant.uncertainty import Uncertainty
from ..policy import Layout, Weights, act
from ..safety import watched_levels
from .checkpoint import Checkpoint, OnBoundary, Trained
from .settings import ONE_START, GradientSettings
from .validation import VALIDATION_SEED, look, validation_keys

_LOOK = dataclasses.replace(Effort.of(1500), searched_noises=8)
"""Of the search in a validation."""


class Network(eqx.Module):
    """A policy being trained."""

    weights: Weights
    layout: Layout = eqx.field(static=True)
    through_measurements: bool = eqx.field(static=True, default=True)

    def __call__(self, state: EnvState) -> tuple[EnvState, Float[Array, " input"]]:
        """The policy's action in this state, and the state with what it remembers."""
        window = state.window
        if not self.through_measurements:
            window = window._replace(outputs=jax.lax.stop_gradient(window.outputs))
        window, action = act(jnp, self.layout, self.weights, window, state.k)
        return dataclasses.replace(state, window=window), action

    def excitation(self, layout: Layout) -> PolicyExcitation:
        """The same policy, to be played on any plant."""
        return PolicyExcitation(self.weights, layout)


class Scores(eqx.Module):
    """Experiments of one policy or signal on a batch of plants.

    Attributes:
        worth: of each, by the objective.
        outcome: of each, for the objective over a batch.
        excess: of each, the mean square of the distance of outputs beyond the margin; one is
            the critical level.
        nearness: of each, the largest output over its critical level; infinite for an
            experiment that cannot be computed.
    """

    worth: Float[Array, "*plant"]
    outcome: PyTree
    excess: Float[Array, "*plant"]
    nearness: Float[Array, "*plant"]


@eqx.filter_jit
def experiments(
    env: Env,
    act: Callable[[EnvState], tuple[EnvState, Float[Array, " input"]]],
    keys: Key[Array, " plant"],
    margin: Float[Array, ""] | float,
) -> Scores:
    """One experiment for every key, differentiable with respect to the arrays of `act`.

    Only the states at every step are kept for the backward pass; the rest of a step is
    computed again.
    """
    watched, _, critical = watched_levels(env.plant.definition)

    def beyond(output: Array) -> tuple[Array, Array]:
        size = jnp.abs(output[np.array(watched, int)]) / critical
        over = jnp.maximum(size - margin, 0.0) / (1 - margin)
        return jnp.sum(over**2), jnp.max(size, initial=0.0)

    @jax.checkpoint
    def advance(state: EnvState, _: None) -> tuple[EnvState, tuple]:
        state, output, gain = env.advance(*act(state))
        return state, (gain, *beyond(output))

    def experiment(key: PRNGKeyArray) -> Scores:
        start, _ = env.reset(key)
        state, (gains, excess, sizes) = jax.lax.scan(
            advance, start, None, length=env.layout.num_steps
        )
        final = env.objective.final(env.plant, state.memory, state.params)
        worth = jnp.sum(gains) + final
        outcome = env.objective.outcome(env.plant, state.memory, state.params, worth)
        after = jax.vmap(beyond)(env.coasting(state))
        nearness = jnp.maximum(jnp.max(sizes), jnp.max(after[1], initial=0.0))
        nearness = jnp.where(state.is_finite & jnp.isfinite(nearness), nearness, jnp.inf)
        return Scores(worth, outcome, jnp.mean(excess) + jnp.sum(after[0]) / len(excess), nearness)

    return jax.vmap(experiment)(keys)


class Optimisation(eqx.Module):
    """State that changes from update to update.

    Attributes:
        player: the policy or signal being trained.
        adam: state of the optimiser.
        penalty_weight: of the safety penalty.
        adversaries: of the last update; None where no uncertainty is declared.
        trained: what of the objective is trained too.
    """

    player: PyTree
    adam: PyTree
    penalty_weight: Float[Array, "*training"]
    adversaries: Cases | None = None
    trained: PyTree = None

    @classmethod
    def start(
        cls, player: PyTree, settings: GradientSettings, env: Env, trained: PyTree = None
    ) -> Optimisation:
        """Before the first update."""
        adam = optimiser(settings).init(eqx.filter((player, trained), eqx.is_array))
        weight, count = jnp.asarray(settings.penalty_weight, float), settings.num_adversaries
        if (box := env.uncertainty) is None:
            return cls(player, adam, weight, None, trained)
        length = env.layout.num_steps + env.coast + 1
        noise = jnp.zeros((count, length, len(env.plant.definition.outputs)))
        middle = Cases(jnp.zeros((count, len(box.names))), jnp.zeros(count, int), noise)
        return cls(player, adam, weight, middle, trained)

    def env(self, env: Env) -> Env:
        """The decision process whose objective has what was trained of it."""
        return dataclasses.replace(env, objective=env.objective.with_trained(self.trained))


def update(
    env: Env,
    settings: GradientSettings,
    now: Optimisation,
    keys: Key[Array, " plant"],
    is_adversarial: bool = False,
    margin: Float[Array, ""] | None = None,
) -> tuple[Optimisation, Scores]:
    """One step of Adam on the plants of these keys, and the experiments before it.

    Args:
        env: the decision process.
        settings: hyper-parameters.
        now: before the step.
        keys: of the plants.
        is_adversarial: whether the worst plants of the declared uncertainty are penalised too.
        margin: in place of that of the settings.
    """
    start = settings.margin if margin is None else margin
    box, adversaries = env.uncertainty, now.adversaries
    if is_adversarial and box is not None and adversaries is not None:
        play = _on_plants(env, box, now.player)
        key = jax.random.fold_in(keys[0], 1)
        adversaries = _adversaries(play, settings, adversaries, key)

    def loss(trained: tuple[PyTree, PyTree]) -> tuple[Array, tuple[Scores, Array]]:
        player, of_objective = trained
        own = dataclasses.replace(env, objective=env.objective.with_trained(of_objective))
        batch = experiments(own, player, keys, start)
        excess, nearest = jnp.mean(batch.excess), batch.nearness
        if is_adversarial and box is not None and adversaries is not None:
            play = _on_plants(env, box, player)
            more, size = _excess(play, adversaries, settings.adversary_margin)
            excess, nearest = excess + jnp.mean(more), jnp.concatenate([nearest, size])
        worth = own.objective.of_batch(batch.outcome)
        return now.penalty_weight * excess - worth, (batch, nearest)

    trained = now.player, now.trained
    (cost, (batch, nearest)), gradient = eqx.filter_value_and_grad(loss, has_aux=True)(trained)
    gradient = jax.tree.map(lambda leaf: jnp.where(jnp.isfinite(cost), leaf, jnp.nan), gradient)
    step, adam = optimiser(settings).update(gradient, now.adam)
    is_near = jnp.mean(nearest >= settings.near) > settings.violation_rate
    change = jnp.where(is_near, settings.penalty_growth, -settings.penalty_decay)
    player, of_objective = eqx.apply_updates(trained, step)
    weight = jnp.maximum(now.penalty_weight * jnp.exp(change), settings.penalty_weight)
    return Optimisation(player, adam, weight, adversaries, of_objective), batch


def _on_plants(env: Env, box: Uncertainty, player: PyTree) -> OnPlant:
    """Experiments of what is being trained, coast included."""
    own = player.excitation(env.layout)
    return OnPlant(box, *Coast.after(own, env.layout.num_steps, env.coast))


def _adversaries(
    play: OnPlant, settings: GradientSettings, last: Cases, key: PRNGKeyArray
) -> Cases:
    """Plants and noise with which the policy comes near to a level, the nearest first.

    Half of the ascents begin with the worst cases of the last update, the others with new
    plants: every second at a corner of the box.
    """
    count = settings.num_adversaries
    is_kept, is_corner = jnp.arange(count) < count // 2, jnp.arange(count) % 2 == 0
    points = jax.vmap(play.uncertainty.draw)(jax.random.split(key, count))
    points = jnp.where(is_corner[:, None], jnp.sign(points), points)
    seeds, bound = jax.random.randint(key, (count,), 0, 2**31 - 1), settings.adversary_noise
    fresh = Cases(points, seeds)
    fresh = Cases(points, seeds, jnp.clip(jax.vmap(play.noise)(fresh), -bound, bound))
    starts = jax.tree.map(lambda old, new: jnp.where(_by_case(is_kept, new), old, new), last, fresh)
    climb = partial(climbed, play, num_steps=settings.adversary_steps, bound=bound, decay=0.7)
    worst, sizes, _ = jax.vmap(climb)(starts)
    # The gradient of a simulation that diverged is not finite: the worst other takes its place.
    order = jnp.argsort(-jnp.where(jnp.isfinite(sizes), sizes, -jnp.inf))
    order = jnp.where(jnp.isfinite(sizes[order]), order, order[0])
    return jax.lax.stop_gradient(jax.tree.map(lambda leaf: leaf[order], worst))


def _by_case(is_case: Array, values: Array) -> Array:
    """The condition, with as many axes as the values have."""
    return is_case.reshape(-1, *(1 for _ in values.shape[1:]))


def _excess(
    play: OnPlant, cases: Cases, margin: float
) -> tuple[Float[Array, " case"], Float[Array, " case"]]:
    """Of each case, the mean square of the distance beyond the margin, and the nearness."""
    plant = play.uncertainty.plant

    def judged(case: Cases) -> tuple[Array, Array]:
        outputs = play.outputs(case)
        return mean_excess(plant, outputs, margin), nearness(plant, outputs)

    return jax.vmap(judged)(cases)


def mean_excess(
    plant: AbstractPlant, outputs: Float[Array, "time output"], margin: float
) -> Float[Array, ""]:
    """The mean square of the outputs' distance beyond the margin; one is the critical level."""
    watched, _, critical = watched_levels(plant.definition)
    over = jnp.abs(outputs[:, np.array(watched, int)]) / critical[None] - margin
    over = jnp.maximum(over, 0.0) / (1 - margin)
    return jnp.mean(jnp.sum(over**2, axis=1))


update_all = eqx.filter_jit(
    eqx.filter_vmap(update, in_axes=(None, None, eqx.if_array(0), eqx.if_array(0), None, None))
)
"""`update` for several parallel trainings; their axis is the first of progress and keys."""


def train(
    env: Env,
    settings: GradientSettings,
    seed: int,
    *,
    first: Weights | None = None,
    resume: Checkpoint | None = None,
    on_boundary: OnBoundary = lambda *_: None,
) -> Trained:
    """Trains a policy; the same seed gives the same weights, interrupted or not.

    Args:
        first: weights with which it begins, such as those of a policy for a similar objective;
            default random ones.
        resume: where to continue.
        on_boundary: called after every update.

    Raises:
        ValueError: where gradients are no longer finite.
    """
    own = {"first": first, "resume": resume, "on_boundary": on_boundary}
    return train_all(env, settings, [seed], **own)[0]


def train_all(
    env: Env,
    settings: GradientSettings,
    seeds: Sequence[int],
    *,
    first: Weights | None = None,
    resume: Checkpoint | None = None,
    on_boundary: OnBoundary = lambda *_: None,
) -> list[Trained]:
    """Trains one policy per seed, all in one batch; see `train`.

    `on_boundary` gets the mean of their validations.
    """
    course, keys = started(env, settings, seeds, first)
    if resume is not None:
        course = _restored(course, resume)
    for i in range(course.num_updates, settings.num_updates + 1):
        row = None
        is_due = i % settings.watch_every == 0 or i == settings.num_updates
        steps = float(i * settings.num_plants * env.layout.num_steps)
        if is_due and course.last_look() < steps:  # not twice after a resume
            _require_finite(course.now, settings, i)
            row = _looked(env, settings, course, steps)
            _require_computable(row)
        on_boundary(partial(course.checkpoint, steps), row)
        if i < settings.num_updates:
            is_adversarial = settings.has_adversaries(i) and env.uncertainty is not None
            course.now, _ = update_all(env, settings, course.now, keys(i), is_adversarial, None)
            course.num_updates += 1
    best = course.best.weights
    weights = [jax.tree.map(lambda x, s=s: np.asarray(x[s]), best) for s in range(len(seeds))]
    looks = [max(c, key=lambda row: rank(settings, row)) for c in course.curves]
    return [Trained(*parts) for parts in zip(weights, course.curves, looks, strict=True)]


@dataclass
class _Course:
    """A running training; the leading axis of arrays is the seed.

    Attributes:
        now: progress.
        best: the best policy in a validation.
        rank: of that validation: minus the violation rate beyond the allowed one, then worth.
        curves: validations, by seed.
        num_updates: done.
    """

    now: Optimisation
    best: PyTree
    rank: Float[np.ndarray, "seed 2"]
    curves: list[list[dict[str, float]]]
    num_updates: int = 0

    def last_look(self) -> float:
        """Steps of the last validation; before the first, below zero."""
        return self.curves[0][-1]["steps"] if self.curves[0] else -1.0

    def checkpoint(self, steps: float) -> Checkpoint:
        """The whole state, to be restored."""
        leaves = jax.tree.leaves((self.now, self.best, self.rank))
        tensors = {f"leaf.{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
        state = {"num_updates": self.num_updates, "num_steps": steps}
        return Checkpoint(tensors, {**state, "curves": [list(c) for c in self.curves]})


def _restored(course: _Course, saved: Checkpoint) -> _Course:
    old, structure = jax.tree.flatten((course.now, course.best, course.rank))
    leaves = [  # the file format has no scalars
        jnp.asarray(saved.tensors[f"leaf.{i}"], x.dtype).reshape(x.shape) for i, x in enumerate(old)
    ]
    now, best, rank = jax.tree.unflatten(structure, leaves)
    return _Course(
        now, best, np.array(rank), list(saved.state["curves"]), saved.state["num_updates"]
    )


def started(
    env: Env, settings: GradientSettings, seeds: Sequence[int], first: Weights | None = None
) -> tuple[_Course, Callable[[int], Key[Array, "seed plant"]]]:
    """Trainings at their beginning, and the keys of the plants of an update."""
    pairs = jax.vmap(jax.random.split)(jnp.stack([jax.random.key(seed) for seed in seeds]))

    def start(key: PRNGKeyArray) -> Optimisation:
        weights = _first_policy(env, settings, key) if first is None else first
        network = Network(weights, env.layout, settings.through_measurements)
        trained = env.objective.first_trained(env.plant, jax.random.fold_in(key, 3))
        return Optimisation.start(network, settings, env, trained)

    def keys(i: int) -> Key[Array, "seed plant"]:
        own = jax.vmap(jax.random.fold_in, (0, None))(pairs[:, 1], i)
        return jax.vmap(jax.random.split, (0, None))(own, settings.num_plants)

    now = eqx.filter_vmap(start)(pairs[:, 0])
    rank = np.full((len(seeds), 2), -np.inf)
    return _Course(now, now.player, rank, [[] for _ in seeds]), keys


def _looked(
    env: Env, settings: GradientSettings, course: _Course, steps: float
) -> dict[str, float]:
    """Validates every policy and keeps the best; returns the mean of the validations."""
    for s, curve in enumerate(course.curves):
        own = jax.tree.map(lambda x, s=s: x[s], course.now)
        judging = own.env(env)
        seen = look(judging, own.player.weights, settings.watch_episodes)
        judged = _judged(judging, own.player, validation_keys(settings.watch_episodes))
        judged |= _falsified(env, own.player)
        curve.append({"steps": steps, **seen, **judged, **_state(own)})
        own_rank = rank(settings, curve[-1])
        if own_rank > tuple(course.rank[s]):
            course.rank[s] = own_rank
            course.best = jax.tree.map(
                lambda best, x, s=s: best.at[s].set(x), course.best, own.player
            )
    last = [curve[-1] for curve in course.curves]
    return {name: float(np.mean([row[name] for row in last])) for name in last[0]}


def _judged(env: Env, player: Network, keys: Key[Array, " plant"]) -> dict[str, float]:
    """The objective alone, without the stepwise penalty of the decision process."""
    batch = experiments(env, player, keys, 0.9)
    return {
        "worth": float(env.objective.of_batch(batch.outcome)),
        "nearness": float(jnp.max(batch.nearness)),
        "violation_rate": float(jnp.mean(batch.nearness >= 1)),
        "not_computable": float(jnp.mean(jnp.isinf(batch.nearness))),
    }


def _falsified(env: Env, player: Network) -> dict[str, float]:
    """The largest nearness that a short search in the declared uncertainty finds."""
    if env.uncertainty is None:
        return {}
    play = _on_plants(env, env.uncertainty, player)
    found = search(play, _LOOK, VALIDATION_SEED)
    return {"worst_nearness": max(stage.nearness for stage in found.stages)}


def rank(settings: GradientSettings, row: Mapping[str, float]) -> tuple[float, float]:
    """Rank of a validation: violations and nearness beyond the allowed ones, then the worth.

    The first validation, of an untrained policy, is the last choice.
    """
    too_many = max(0.0, row["violation_rate"] - settings.violation_rate)
    too_near = max(0.0, row.get("worst_nearness", 0.0) - settings.allowed_nearness)
    worth = -math.inf if math.isnan(row["worth"]) else row["worth"]
    return (-too_many - too_near if row["steps"] else -math.inf, worth)


def optimiser(settings: GradientSettings) -> optax.GradientTransformation:
    """Adam on clipped gradients; a gradient that is not finite is left out and counted."""
    rate = optax.cosine_decay_schedule(settings.learning_rate, settings.num_updates)
    adam = optax.chain(optax.clip_by_global_norm(settings.max_grad_norm), optax.adam(rate))
    return optax.apply_if_finite(adam, max_consecutive_errors=settings.num_updates)


def _first_weights(env: Env, settings: GradientSettings, key: PRNGKeyArray) -> Weights:
    """Glorot's weights (X. Glorot, Y. Bengio, 2010), those of the last layer made small."""
    layout, memory = env.layout, env.layout.memory
    widths = [memory + layout.size_beside_memory, *settings.hidden, len(layout.input_half)]
    gains = [1.0] * len(settings.hidden) + [settings.last_gain]
    keys = jax.random.split(key, len(gains))
    layers = tuple(
        _layer(own, before, after, gain)
        for own, gain, before, after in zip(keys, gains, widths[:-1], widths[1:], strict=True)
    )
    if not memory:
        return layers
    own_keys = jax.random.split(jax.random.fold_in(key, 1))
    if layout.memory_kind == "gru":
        back = jax.nn.initializers.orthogonal(column_axis=0)(
            own_keys[1], (3 * memory, memory), jnp.float32
        )
        keeps = jnp.repeat(jnp.array([0.0, 1.0, 0.0], jnp.float32), memory)
        return _layer(own_keys[0], layout.size, 3 * memory), (back, keeps), *layers
    own_keys = [*own_keys, jax.random.fold_in(key, 2)]
    shapes = [[settings.hidden[0] if n == -1 else n for n in shape] for shape in layout.unit]
    unit = [_layer(own, n, m) for own, (m, n) in zip(own_keys, shapes, strict=False)]
    return *unit, *layers


def _layer(
    key: PRNGKeyArray, before: int, after: int, gain: float = 1.0
) -> tuple[Float[Array, "after before"], Float[Array, " after"]]:
    glorot = jax.nn.initializers.glorot_uniform()
    return gain * glorot(key, (after, before), jnp.float32), jnp.zeros(after, jnp.float32)


def _first_policy(env: Env, settings: GradientSettings, key: PRNGKeyArray) -> Weights:
    """The best of several first policies, on the same plants; of one, that.

    A gradient does not leave a policy that plays the limit of its input all the time, and far from
    a good one it does not find it: feedbacks that excite are found by chance.
    """
    if settings.starts == 1:
        return _first_weights(env, settings, key)
    if env.layout.memory:
        raise ValueError(ONE_START)
    keys = jax.random.split(key, settings.starts)
    tried = jax.vmap(lambda own: _linear_start(env, settings, own))(keys)
    plants = jax.random.split(jax.random.fold_in(key, 1), _PLANTS_OF_A_START)

    def worth(weights: Weights) -> Float[Array, ""]:
        found = env.objective.of_batch(
            experiments(env, Network(weights, env.layout), plants, settings.margin).outcome
        )
        return jnp.where(jnp.isfinite(found), found, -jnp.inf)

    best = jnp.argmax(jax.lax.map(worth, tried, batch_size=8))
    return jax.tree.map(lambda x: x[best], tried)


_PLANTS_OF_A_START = 32
_GAINS = 0.3, 30.0  # of linear feedbacks, in scales of outputs and inputs
_SMALL = 0.05  # at which the hyperbolic tangent is linear


def _linear_start(env: Env, settings: GradientSettings, key: PRNGKeyArray) -> Weights:
    """First weights to which a random linear feedback is added, by one neuron for each input.

    Its hyperbolic tangent bounds it, so that it has a gradient wherever the input is.
    """
    weights_key, gain_key, direction_key = jax.random.split(key, 3)
    weights = list(_first_weights(env, settings, weights_key))
    newest, count = np.array(env.layout.newest), len(env.layout.input_half)
    own = np.arange(count)
    low, high = np.log(_GAINS)
    gain = jnp.exp(jax.random.uniform(gain_key, (count, 1), jnp.float32, low, high))
    direction = jax.random.normal(direction_key, (count, len(newest)), jnp.float32)
    rows = _SMALL * gain * direction / math.sqrt(len(newest))
    last = len(weights) - 2
    for i, (matrix, bias) in enumerate(weights[:-1]):
        carried = jnp.zeros((count, matrix.shape[1]), jnp.float32)
        carried = carried.at[:, newest].set(rows) if i == 0 else carried.at[own, own].set(1.0)
        weights[i] = matrix.at[own].set(carried / _SMALL if i == last else carried), bias
    matrix, bias = weights[-1]
    weights[-1] = matrix.at[:, own].set(jnp.eye(count, dtype=jnp.float32)), bias
    return tuple(weights)


def _require_finite(now: Optimisation, settings: GradientSettings, num_updates: int) -> None:
    in_a_row = int(np.max(now.adam.notfinite_count))
    if in_a_row >= min(settings.watch_every, settings.num_updates) and num_updates:
        raise ValueError(
            f"the gradient was not finite in the last {in_a_row} updates: the plant or its "
            "sensitivities grow without bound under this policy; a critical level where "
            "the plant has none, a shorter experiment or a smaller spread may help"
        )


def _require_computable(row: Mapping[str, float]) -> None:
    if row["not_computable"] == 1:
        raise ValueError(
            "every simulation of this plant diverges (NaN or infinity) under this policy; a "
            "critical level, a shorter experiment or a smaller spread may help"
        )


def _state(now: Optimisation) -> dict[str, float]:
    return {
        "penalty_weight": float(now.penalty_weight),
        "not_finite": float(now.adam.total_notfinite),
    }
