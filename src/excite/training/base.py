"""What trainers share: settings, checkpoints, and a look at the policy being trained."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray

from ..description import names_of
from ..env import Env
from ..policy import Weights, forward, tensors_from_bytes, tensors_to_bytes

FORMAT = "excite checkpoint 1"
WATCH_SEED = 0x7A11DA7E
"""Validation episodes, the same for all seeds, apart from training and every evaluation."""


def check_counts(settings: Any, *names: str) -> None:
    """Raises ValueError for a setting below one."""
    for name in names:
        if getattr(settings, name) < 1:
            raise ValueError(f"{name} must be at least 1: got {getattr(settings, name)}")


def check_positive(settings: Any, *names: str) -> None:
    """Raises ValueError for a setting that is not positive and finite; None is allowed."""
    for name in names:
        value = getattr(settings, name)
        if value is not None and not 0 < value < math.inf:
            raise ValueError(f"{name} must be positive and finite: got {value:g}")


def check_not_negative(settings: Any, *names: str) -> None:
    """Raises ValueError for a setting that is negative or not finite."""
    for name in names:
        if not 0 <= getattr(settings, name) < math.inf:
            raise ValueError(f"{name} must not be negative: got {getattr(settings, name):g}")


def check_fractions(settings: Any, *names: str) -> None:
    """Raises ValueError for a setting that is not in [0, 1)."""
    for name in names:
        if not 0 <= getattr(settings, name) < 1:
            raise ValueError(f"{name} must lie in [0, 1): got {getattr(settings, name):g}")


def check_widths(settings: Any) -> None:
    """Raises ValueError where the hidden layers have no widths of at least one."""
    if not settings.hidden or min(settings.hidden) < 1:
        raise ValueError(f"hidden needs widths of at least 1: got {list(settings.hidden)}")


@dataclass(frozen=True)
class PPOSettings:
    """Hyper-parameters, named as in Stable-Baselines3 and with its defaults where it has one.

    Attributes:
        total_steps: environment steps of the whole training, rounded up to whole rollouts.
        num_envs: plants stepped as one batch.
        n_steps: steps of each plant in a rollout.
        batch_size, n_epochs, gamma, gae_lambda: as in Stable-Baselines3.
        clip_range, ent_coef, vf_coef, max_grad_norm: as there.
        learning_rate, learning_rate_end: Adam's step, first and last, linear between;
            without an end it is constant.
        noise_sd, noise_sd_end: standard deviation of the exploration noise, in units of
            the input limit, in the first rollout and in one that would follow the last,
            geometric between; without an end it is learnt.
        average_last: fraction of the training, at its end, over which the weights of the policy
            are averaged (B. Polyak, A. Juditsky, Acceleration of stochastic approximation by
            averaging, 1992); 0 is the last policy, as in Stable-Baselines3.
        hidden: widths of the hidden layers of policy and value function, tanh.
        watch_every: rollouts between two looks at the deterministic policy.
        watch_episodes: episodes of such a look.
    """

    total_steps: int = 1_000_000
    num_envs: int = 1
    n_steps: int = 2048
    batch_size: int = 64
    n_epochs: int = 10
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    learning_rate: float = 3e-4
    learning_rate_end: float | None = None
    noise_sd: float = 1.0
    noise_sd_end: float | None = None
    average_last: float = 0.0
    hidden: tuple[int, ...] = (64, 64)
    watch_every: int = 10
    watch_episodes: int = 100

    def __post_init__(self) -> None:
        """Raises ValueError for a value that is not allowed."""
        check_counts(self, "total_steps", "num_envs", "n_steps", "batch_size", "n_epochs")
        check_counts(self, "watch_every", "watch_episodes")
        check_positive(self, "learning_rate", "learning_rate_end", "noise_sd", "noise_sd_end")
        check_positive(self, "clip_range", "max_grad_norm")
        check_not_negative(self, "ent_coef", "vf_coef")
        for name in ("gamma", "gae_lambda"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(
                    f"{name} must be above 0 and at most 1: got {getattr(self, name):g}"
                )
        check_fractions(self, "average_last")
        check_widths(self)
        rollout = self.num_envs * self.n_steps
        if self.batch_size < 2 or rollout % self.batch_size:
            raise ValueError(
                f"batch_size {self.batch_size} does not divide the {rollout} steps of a rollout "
                "(num_envs times n_steps), or is below 2"
            )

    def noise_at(self, progress: float) -> float | None:
        """Exploration noise at a fraction of the training; None where it is learnt."""
        if self.noise_sd_end is None:
            return None
        return self.noise_sd ** (1 - progress) * self.noise_sd_end**progress

    def learning_rate_at(self, remaining: float) -> float:
        """Learning rate at a remaining fraction of the training."""
        end = self.learning_rate if self.learning_rate_end is None else self.learning_rate_end
        return end + (self.learning_rate - end) * max(remaining, 0.0)  # the last rollout is whole


@dataclass(frozen=True)
class Checkpoint:
    """Training at a rollout boundary.

    Attributes:
        tensors: weights, moments, running episodes, random states.
        state: counters and the learning curve so far.
    """

    tensors: Mapping[str, np.ndarray]
    state: Mapping[str, Any]

    def to_bytes(self) -> bytes:
        """Content of a checkpoint file."""
        return tensors_to_bytes(self.tensors, FORMAT, self.state)

    @classmethod
    def from_bytes(cls, content: bytes, where: str) -> Checkpoint:
        """The checkpoint in the content of a file; ValueError where it is none."""
        return cls(*tensors_from_bytes(content, FORMAT, where))


@dataclass(frozen=True)
class Trained:
    """A trained policy.

    Attributes:
        weights: of its network.
        curve: one row a look.
        validation: the look at these weights.
    """

    weights: Weights
    curve: list[dict[str, float]]
    validation: dict[str, float]


OnBoundary: TypeAlias = Callable[[Callable[[], Checkpoint], dict[str, float] | None], None]
"""Called where a training can be interrupted, with a function that makes a checkpoint, and
the newest row of the learning curve, if there is one."""


class Watched(eqx.Module):
    """Episodes of a policy without exploration noise; the leading axis is the episode.

    Attributes:
        total_reward: undiscounted return.
        relative_errors: of the parameters, as the objective knows them.
        is_violation: whether a critical level was reached.
        rms_action: root mean square action of each episode, 1 is the input limit.
    """

    total_reward: Float[Array, "*episode"]
    relative_errors: Float[Array, "*episode param"]
    is_violation: Bool[Array, "*episode"]
    rms_action: Float[Array, "*episode"]


@eqx.filter_jit
def watch(env: Env, weights: Weights, keys: Key[Array, " episode"]) -> Watched:
    """One episode of the deterministic policy for every key."""

    def episode(key: PRNGKeyArray) -> Watched:
        state, observation = env.reset(key)

        def advance(carry: tuple, _: None) -> tuple[tuple, tuple]:
            state, observation = carry
            action = forward(jnp, weights, observation)
            state, t = env.step(state, action)
            kept = t.reward, t.relative_errors, t.is_violation, jnp.mean(action**2)
            return (state, t.observation), kept

        start = state, observation
        _, kept = jax.lax.scan(advance, start, None, length=env.layout.num_steps)
        rewards, errors, violations, squares = kept
        rms = jnp.sqrt(jnp.mean(squares))
        return Watched(jnp.sum(rewards), errors[-1], violations[-1], rms)

    return jax.vmap(episode)(keys)


def watch_keys(num_episodes: int) -> Key[Array, " episode"]:
    """Keys of the validation episodes."""
    return jax.random.split(jax.random.key(WATCH_SEED), num_episodes)


def look(env: Env, weights: Weights, num_episodes: int) -> dict[str, float]:
    """What a learning curve shows of the deterministic policy, in the validation episodes."""
    seen = watch(env, weights, watch_keys(num_episodes))
    names = names_of(env.plant.definition.parameters)
    errors = np.asarray(seen.relative_errors).mean(axis=0)
    return {
        "return": float(np.mean(seen.total_reward)),
        "violation_rate": float(np.mean(np.asarray(seen.is_violation), dtype=float)),
        "rms_action": float(np.sqrt(np.mean(np.asarray(seen.rms_action) ** 2))),
        **{f"relative_error_{n}": float(e) for n, e in zip(names, errors, strict=True)},
    }
