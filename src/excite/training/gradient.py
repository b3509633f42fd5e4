"""Training by the gradient of the whole experiment: policy, plant, sensor, objective.

The decision process is one differentiable function of the policy's weights, so that the
gradient of what an experiment is worth follows from one backward pass through it. Every
update takes a fresh batch of plants. Safety is a quadratic penalty on the true outputs
from a margin below the critical level, whose weight grows after a batch with a violation
and slowly decays otherwise.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray

from ..env import Env
from ..policy import Weights, forward, observe
from ..safety import watched_levels
from .base import Checkpoint, OnBoundary, Trained, look


@dataclass(frozen=True)
class GradientSettings:
    """Hyper-parameters of training by gradient.

    Attributes:
        num_updates: steps of Adam.
        num_plants: plants of each step.
        learning_rate: of Adam, decaying to zero by a cosine.
        max_grad_norm: a longer gradient is scaled down to this norm.
        hidden: widths of the hidden layers, tanh.
        last_gain: scale of the last layer's first weights; a loud first policy runs away.
        margin: the penalty begins at this fraction of a critical level.
        penalty_weight: of the penalty, at the beginning.
        penalty_growth, penalty_decay: what is added to its logarithm after a batch with a
            violation, and taken away after one without.
        watch_every: updates between two looks at the policy.
        watch_episodes: episodes of such a look.
    """

    num_updates: int = 1000
    num_plants: int = 32
    learning_rate: float = 2e-3
    max_grad_norm: float = 1.0
    hidden: tuple[int, ...] = (64, 64)
    last_gain: float = 0.02
    margin: float = 0.9
    penalty_weight: float = 1.0
    penalty_growth: float = 0.05
    penalty_decay: float = 0.005
    watch_every: int = 50
    watch_episodes: int = 100

    def __post_init__(self) -> None:
        """Raises ValueError for a value that is not allowed."""
        for name in ("num_updates", "num_plants", "watch_every", "watch_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1: got {getattr(self, name)}")
        for name in ("learning_rate", "max_grad_norm", "last_gain", "penalty_weight"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive: got {getattr(self, name):g}")
        for name in ("penalty_growth", "penalty_decay"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must not be negative: got {getattr(self, name):g}")
        if not 0 <= self.margin < 1:
            raise ValueError(f"margin must lie in [0, 1): got {self.margin:g}")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden needs widths of at least 1: got {list(self.hidden)}")


class Batch(eqx.Module):
    """Experiments of one policy on a batch of plants.

    Attributes:
        worth: of each, by the objective.
        excess: of each, the mean square of how far outputs lie beyond the margin; one is
            the critical level.
        is_violation: of each.
    """

    worth: Float[Array, "*plant"]
    excess: Float[Array, "*plant"]
    is_violation: Bool[Array, "*plant"]


@eqx.filter_jit
def experiments(
    env: Env, weights: Weights, keys: Key[Array, " plant"], margin: Float[Array, ""] | float
) -> Batch:
    """One experiment for every key, differentiable in the weights.

    Only the states at every step are kept for the backward pass; the rest of a step is
    computed again.
    """
    watched, _, critical = watched_levels(env.plant.definition)

    @jax.checkpoint
    def advance(carry: tuple, _: None) -> tuple[tuple, tuple]:
        state, observation = carry
        state, output, gain = env.advance(state, forward(jnp, weights, observation))
        size = jnp.abs(output[np.array(watched, int)]) / critical
        over = jnp.maximum(size - margin, 0.0) / (1 - margin)
        observation = observe(jnp, env.layout, state.window, state.k)
        return (state, observation), (gain, jnp.sum(over**2), jnp.any(size >= 1))

    def experiment(key: PRNGKeyArray) -> Batch:
        (state, _), (gains, excess, is_over) = jax.lax.scan(
            advance, env.reset(key), None, length=env.layout.num_steps
        )
        final = env.objective.final(env.plant, state.memory, state.params)
        is_violation = jnp.any(is_over) | ~state.is_finite
        return Batch(jnp.sum(gains) + final, jnp.mean(excess), is_violation)

    return jax.vmap(experiment)(keys)


class _Progress(eqx.Module):
    """What changes from update to update."""

    weights: Weights
    adam: Any
    penalty_weight: Float[Array, ""]


def train(
    env: Env,
    settings: GradientSettings,
    seed: int,
    *,
    resume: Checkpoint | None = None,
    on_boundary: OnBoundary = lambda *_: None,
) -> Trained:
    """Trains a policy; the same seed gives the same weights, interrupted or not.

    Args:
        resume: where to continue.
        on_boundary: called after every update.

    Raises:
        ValueError: where gradients are no longer finite.
    """
    first, key = jax.random.split(jax.random.key(seed))
    weights = _first_weights(env, settings, first)
    penalty_weight = jnp.asarray(settings.penalty_weight, float)
    now = _Progress(weights, _optimiser(settings).init(weights), penalty_weight)
    start, curve = 0, []
    if resume is not None:
        now, start, curve = _restored(now, resume)
    for i in range(start, settings.num_updates + 1):
        row, steps = None, float(i * settings.num_plants * env.layout.num_steps)
        is_due = i % settings.watch_every == 0 or i == settings.num_updates
        if is_due and (not curve or curve[-1]["steps"] < steps):  # not twice after a resume
            _require_finite(now, settings, i)
            row = {"steps": steps, **look(env, now.weights, settings.watch_episodes), **_state(now)}
            curve.append(row)
        on_boundary(functools.partial(_checkpoint, now, i, steps, curve), row)
        if i < settings.num_updates:
            now = _update(env, settings, now, jax.random.fold_in(key, i))
    return Trained(jax.tree.map(np.asarray, now.weights), curve)


def _optimiser(settings: GradientSettings) -> optax.GradientTransformation:
    """Adam on clipped gradients; one that is not finite is left out and counted."""
    rate = optax.cosine_decay_schedule(settings.learning_rate, settings.num_updates)
    adam = optax.chain(optax.clip_by_global_norm(settings.max_grad_norm), optax.adam(rate))
    return optax.apply_if_finite(adam, max_consecutive_errors=settings.num_updates)


def _first_weights(env: Env, settings: GradientSettings, key: PRNGKeyArray) -> Weights:
    """Glorot's (X. Glorot, Y. Bengio, 2010), those of the last layer made small."""
    widths = [env.layout.size, *settings.hidden, len(env.layout.input_half)]
    gains = [1.0] * len(settings.hidden) + [settings.last_gain]
    keys = jax.random.split(key, len(gains))
    glorot = jax.nn.initializers.glorot_uniform()
    return tuple(
        (gain * glorot(own, (after, before), jnp.float32), jnp.zeros(after, jnp.float32))
        for own, gain, before, after in zip(keys, gains, widths[:-1], widths[1:], strict=True)
    )


@eqx.filter_jit
def _update(env: Env, settings: GradientSettings, now: _Progress, key: PRNGKeyArray) -> _Progress:
    keys = jax.random.split(key, settings.num_plants)

    def loss(weights: Weights) -> tuple[Array, Array]:
        batch = experiments(env, weights, keys, settings.margin)
        cost = now.penalty_weight * jnp.mean(batch.excess) - jnp.mean(batch.worth)
        return cost, jnp.any(batch.is_violation)

    (cost, is_unsafe), gradient = jax.value_and_grad(loss, has_aux=True)(now.weights)
    gradient = jax.tree.map(lambda leaf: jnp.where(jnp.isfinite(cost), leaf, jnp.nan), gradient)
    step, adam = _optimiser(settings).update(gradient, now.adam, now.weights)
    change = jnp.where(is_unsafe, settings.penalty_growth, -settings.penalty_decay)
    weights: Any = optax.apply_updates(now.weights, step)
    return _Progress(weights, adam, now.penalty_weight * jnp.exp(change))


def _require_finite(now: _Progress, settings: GradientSettings, num_updates: int) -> None:
    in_a_row = int(now.adam.notfinite_count)
    if in_a_row >= min(settings.watch_every, settings.num_updates) and num_updates:
        raise ValueError(
            f"the gradient was not finite in the last {in_a_row} updates: the plant or its "
            "sensitivities grow without bound under this policy; give the plant a critical "
            "level, a shorter experiment, or a smaller spread"
        )


def _state(now: _Progress) -> dict[str, float]:
    return {
        "penalty_weight": float(now.penalty_weight),
        "not_finite": float(now.adam.total_notfinite),
    }


def _checkpoint(
    now: _Progress, num_updates: int, num_steps: float, curve: list[dict[str, float]]
) -> Checkpoint:
    tensors = {f"leaf.{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(now))}
    state = {"num_updates": num_updates, "num_steps": num_steps, "curve": list(curve)}
    return Checkpoint(tensors, state)


def _restored(first: _Progress, saved: Checkpoint) -> tuple[_Progress, int, list[dict[str, float]]]:
    """Progress, the update that comes next, and the curve before it."""
    old, structure = jax.tree.flatten(first)
    leaves = [  # a file has no scalars
        jnp.asarray(saved.tensors[f"leaf.{i}"], x.dtype).reshape(x.shape) for i, x in enumerate(old)
    ]
    now = jax.tree.unflatten(structure, leaves)
    return now, saved.state["num_updates"], list(saved.state["curve"])
