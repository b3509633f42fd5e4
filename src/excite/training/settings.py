"""Hyper-parameters of both trainers; the type of each field has its allowed values."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Annotated, NamedTuple, TypeAlias, get_args, get_type_hints


class Rule(NamedTuple):
    """Allowed values of a hyper-parameter, in words and as a test."""

    words: str
    holds: Callable[..., bool]


Count: TypeAlias = Annotated[int, Rule("must be at least 1", lambda n: n >= 1)]
Positive: TypeAlias = Annotated[
    float, Rule("must be positive and finite", lambda x: 0 < x < math.inf)
]
NotNegative: TypeAlias = Annotated[float, Rule("must not be negative", lambda x: 0 <= x < math.inf)]
Fraction: TypeAlias = Annotated[float, Rule("must lie in [0, 1)", lambda x: 0 <= x < 1)]
Share: TypeAlias = Annotated[float, Rule("must be above 0 and at most 1", lambda x: 0 < x <= 1)]
Flag: TypeAlias = Annotated[
    bool, Rule("must be true or false", lambda value: isinstance(value, bool))
]
Widths: TypeAlias = Annotated[
    tuple[int, ...],
    Rule("needs widths of at least 1", lambda widths: min(widths, default=0) >= 1),
]


class _Checked:
    """Hyper-parameters that are checked by the rules of their types."""

    def __post_init__(self) -> None:
        """Raises ValueError for a value that is not allowed; a default of None is allowed."""
        types = get_type_hints(type(self), include_extras=True)
        for field in fields(self):  # pyright: ignore[reportArgumentType]
            value, kind = getattr(self, field.name), types[field.name]
            if value is None:
                continue
            first = get_args(kind)[0]
            rule = (getattr(kind, "__metadata__", None) or first.__metadata__)[0]
            if not rule.holds(value):
                got = list(value) if isinstance(value, tuple) else format(value, "g")
                raise ValueError(f"{field.name} {rule.words}: got {got}")


@dataclass(frozen=True)
class GradientSettings(_Checked):
    """Hyper-parameters of training by gradient.

    Attributes:
        num_updates: steps of Adam.
        num_plants: plants of each step.
        learning_rate: of Adam, decaying to zero by a cosine.
        max_grad_norm: a longer gradient is scaled down to this norm.
        hidden: widths of the hidden layers, tanh; the first is also that of the encoder of a
            memory that is a sum.
        last_gain: scale of the last layer's initial weights; with large ones training diverges.
        starts: first policies that are compared, of which the best is trained: with more than one
            they begin as random linear feedbacks of the newest measurement and the last input.
        through_measurements: whether the gradient also goes through what the policy has measured:
            through what an input does to later ones. Over many sharp outcomes this part is large
            and says little; without it, training is steady.
        margin: the penalty begins at this fraction of a critical level.
        penalty_weight: of the penalty, at the beginning and at least.
        near: fraction of a critical level that counts as too near to it.
        penalty_growth, penalty_decay: added to the weight's logarithm after a batch of which
            more than `violation_rate` came too near; subtracted after any other batch.
        violation_rate: allowed on held-out plants.
        watch_every: updates between two validations of the policy.
        watch_episodes: episodes of a validation.
        num_adversaries: of each step, plants of the declared uncertainty on which this policy
            comes near to a level, in the penalty alone; none without a declared uncertainty.
        adversary_steps: of the ascent that finds each of them.
        adversary_margin: as `margin`, for them.
        adversary_noise: within which their noise is searched too, in standard deviations.
        adversaries_from: fraction of the updates after which they join.
        allowed_nearness: largest output over its critical level that a search of a validation
            may find in the declared uncertainty.
    """

    num_updates: Count = 1000
    num_plants: Count = 64
    learning_rate: Positive = 3e-3
    max_grad_norm: Positive = 1.0
    hidden: Widths = (64, 64)
    last_gain: Positive = 0.02
    starts: Count = 1
    through_measurements: Flag = True
    margin: Fraction = 0.95
    penalty_weight: Positive = 30.0
    near: Fraction = 0.97
    penalty_growth: NotNegative = 0.02
    penalty_decay: NotNegative = 0.02
    violation_rate: Fraction = 0.0
    watch_every: Count = 50
    watch_episodes: Count = 500
    num_adversaries: Count = 48
    adversary_steps: Count = 3
    adversary_margin: Fraction = 0.93
    adversary_noise: NotNegative = 3.0
    adversaries_from: Fraction = 0.4
    allowed_nearness: Fraction = 0.975

    def has_adversaries(self, update: int) -> bool:
        """Whether they have joined at this update."""
        return update >= self.adversaries_from * self.num_updates


ONE_START = "several starts are for policies without a memory: leave one of the two out"


AGAINST_UNCERTAINTY = (
    "num_adversaries", "adversary_steps", "adversary_margin", "adversary_noise",
    "adversaries_from", "allowed_nearness",
)  # fmt: skip
"""Hyper-parameters that matter only where an uncertainty is declared."""


@dataclass(frozen=True)
class PPOSettings(_Checked):
    """Hyper-parameters of PPO, with the names and defaults of Stable-Baselines3 where it has them.

    Attributes:
        total_steps: environment steps of the whole training, rounded up to whole rollouts.
        num_envs: plants stepped as one batch.
        n_steps: steps of each plant in a rollout.
        batch_size, n_epochs, gamma, gae_lambda: as in Stable-Baselines3.
        clip_range, ent_coef, vf_coef, max_grad_norm: as there.
        learning_rate, learning_rate_end: Adam's step, first and last, linear between;
            without an end it is constant.
        noise_sd, noise_sd_end: standard deviation of the exploration noise, in units of
            the input limit, in the first rollout and in one after the last, geometric
            between; without an end it is learned.
        average_last: fraction of the training, at its end, over which the weights of the policy
            are averaged (B. Polyak, A. Juditsky, Acceleration of stochastic approximation by
            averaging, 1992); 0 is the last policy, as in Stable-Baselines3.
        hidden: widths of the hidden layers of policy and value function, tanh.
        watch_every: rollouts between two validations of the deterministic policy.
        watch_episodes: episodes of a validation.
    """

    total_steps: Count = 1_000_000
    num_envs: Count = 1
    n_steps: Count = 2048
    batch_size: Count = 64
    n_epochs: Count = 10
    gamma: Share = 0.99
    gae_lambda: Share = 0.95
    clip_range: Positive = 0.2
    ent_coef: NotNegative = 0.0
    vf_coef: NotNegative = 0.5
    max_grad_norm: Positive = 0.5
    learning_rate: Positive = 3e-4
    learning_rate_end: Positive | None = None
    noise_sd: Positive = 1.0
    noise_sd_end: Positive | None = None
    average_last: Fraction = 0.0
    hidden: Widths = (64, 64)
    watch_every: Count = 10
    watch_episodes: Count = 100

    def __post_init__(self) -> None:
        """Raises ValueError for a value that is not allowed."""
        super().__post_init__()
        rollout = self.num_envs * self.n_steps
        if self.batch_size < 2 or rollout % self.batch_size:
            raise ValueError(
                f"batch_size {self.batch_size} does not divide the {rollout} steps of a rollout "
                "(num_envs times n_steps), or is below 2"
            )

    @property
    def whole_steps(self) -> int:
        """Environment steps of all rollouts."""
        rollout = self.num_envs * self.n_steps
        return -(-self.total_steps // rollout) * rollout

    def noise_at(self, progress: float) -> float | None:
        """Exploration noise at a fraction of the training; None where it is learned."""
        if self.noise_sd_end is None:
            return None
        return self.noise_sd ** (1 - progress) * self.noise_sd_end**progress

    def learning_rate_at(self, remaining: float) -> float:
        """Learning rate at a remaining fraction of the training."""
        end = self.learning_rate if self.learning_rate_end is None else self.learning_rate_end
        return end + (self.learning_rate - end) * max(remaining, 0.0)  # full rollouts
