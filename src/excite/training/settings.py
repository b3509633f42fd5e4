"""Hyper-parameters of PPO, and checks that all trainers' settings share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


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
