"""Progress, checkpoints and result of a training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ..files import tensors_from_bytes, tensors_to_bytes
from ..policy import Weights

FORMAT = "excite checkpoint 1"


@dataclass(frozen=True)
class Checkpoint:
    """State of a training at a rollout boundary.

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
        """The checkpoint in the content of a file; ValueError for another file."""
        return cls(*tensors_from_bytes(content, FORMAT, where))


@dataclass(frozen=True)
class Trained:
    """A trained policy.

    Attributes:
        weights: of its network.
        curve: one row per validation.
        validation: of these weights.
    """

    weights: Weights
    curve: list[dict[str, float]]
    validation: dict[str, float]


OnBoundary: TypeAlias = Callable[[Callable[[], Checkpoint], dict[str, float] | None], None]
"""Called where a training can be interrupted, with a function that makes a checkpoint, and
the newest row of the learning curve, if there is one."""
