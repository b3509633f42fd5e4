"""Objectives of a training by name, and their settings in a study.

Needs no JAX, so that the command line and the page load it fast.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from ..description import unknown, wrong_type

OBJECTIVES: Mapping[str, Mapping[str, str]] = {
    "D": {"reward": "information", "criterion": "D"},
    "A": {"reward": "information", "criterion": "A"},
    "E": {"reward": "information", "criterion": "E"},
    "sPCE": {"reward": "contrast"},
    "ACE": {"reward": "adaptive_contrast"},
    "InfoNCE": {"reward": "critic"},
    "goals": {"reward": "goals"},
    "relative": {"reward": "relative"},
    "log": {"reward": "log"},
    "nls": {"reward": "relative", "estimator": "nls"},
}
"""Settings of a reward: criteria of the Fisher information, contrasts, errors of an estimator."""

CONTRASTS = {"contrast": "sPCE", "adaptive_contrast": "ACE", "critic": "InfoNCE"}
"""Rewards that compare the true plant with others, and their objectives."""


def rewards_of(
    objectives: str | Sequence[str] | Mapping[str, float], goals: Mapping[str, float]
) -> dict[str, dict[str, object]]:
    """Settings of the reward of each objective, by name.

    Args:
        objectives: a name; names, each with an optional weight (`log=2`); or weights by name.
        goals: by parameter, for the objectives of errors.

    Raises:
        ValueError: for an unknown name, one that repeats, or a weight that is not a number.
    """
    given = [objectives] if isinstance(objectives, str) else objectives
    if not isinstance(given, Sequence | Mapping):
        raise wrong_type("objective", objectives, "a name, several names, or a dict of weights")
    weights = list(given.items() if isinstance(given, Mapping) else map(_weighted, given))
    names = [name for name, _ in weights]
    for name in names:
        if name not in OBJECTIVES:
            raise unknown("objective", name, OBJECTIVES)
    if len(set(names)) < len(names) or not names:
        raise ValueError(f"objectives must differ from each other, got {', '.join(names)}")
    with_goals = [name for name in names if is_error(name)] or names
    return {
        name: {
            **OBJECTIVES[name],
            **({"goals": dict(goals)} if goals and name in with_goals else {}),
            **({} if weight is None else {"weight": weight}),
        }
        for name, weight in weights
    }


def is_information(name: str) -> bool:
    """Whether an objective is a criterion of the Fisher information."""
    return OBJECTIVES[name]["reward"] == "information"


def is_error(name: str) -> bool:
    """Whether an objective is the errors of an estimator."""
    return OBJECTIVES[name]["reward"] not in ("information", *CONTRASTS)


def _weighted(word: str) -> tuple[str, float | None]:
    name, has_weight, weight = word.partition("=")
    try:
        return name, float(weight) if has_weight else None
    except ValueError:
        raise ValueError(f"the weight of {name!r} must be a number, got {weight!r}") from None


def decision_of(rewards: Iterable[Mapping[str, object]]) -> dict[str, object]:
    """The reward in a decision process: a single one, or several that are added."""
    rewards = [dict(reward) for reward in rewards]
    return rewards[0] if len(rewards) == 1 else {"terms": rewards}
