"""What plays on a rig, sample by sample: a signal or a policy, with NumPy alone."""

from __future__ import annotations

import abc
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ..policy import Policy, empty_window, respond, with_input


class AbstractPlayer(abc.ABC):
    """What proposes the inputs of an experiment.

    Attributes:
        num_steps: for how many sampling instants.
    """

    num_steps: int

    @abc.abstractmethod
    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """The input proposed at sampling instant k."""

    def applied(self, input: np.ndarray) -> None:
        """Called with the input that was applied in its place."""
        del input

    def origin(self) -> dict[str, Any]:
        """Where its inputs come from, JSON-ready; before the experiment."""
        return {}

    def facts(self) -> dict[str, Any]:
        """What a record should say of it, JSON-ready; after the end of an experiment."""
        return {}


class SignalPlayer(AbstractPlayer):
    """A signal known beforehand."""

    def __init__(self, inputs: np.ndarray) -> None:
        """`inputs` by time and input, in the plant's units."""
        self._inputs, self.num_steps = np.asarray(inputs, float), len(inputs)

    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """Row k."""
        del measured
        return self._inputs[k]


class PolicyPlayer(AbstractPlayer):
    """A learned policy, as in training but for the inputs in its window: those applied."""

    def __init__(self, policy: Policy) -> None:
        """A policy before its experiment."""
        self._policy, self._layout = policy, policy.layout
        self._window = empty_window(np, policy.layout)
        self.num_steps = policy.layout.num_steps

    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """The network's input for the window that ends with this measurement."""
        weights, window = self._policy.weights, self._window
        with np.errstate(over="ignore", invalid="ignore"):
            # Not zero, as in training: the supervisor ends an experiment where the input is NaN.
            self._window, input = respond(
                np, self._layout, weights, window, k, measured, if_not_finite=math.nan
            )
        return input

    def applied(self, input: np.ndarray) -> None:
        """The window remembers what was applied."""
        self._window = with_input(np, self._layout, self._window, input)

    def origin(self) -> dict[str, Any]:
        """The policy's hash."""
        return {"policy_hash": self._policy.hash}


def step_seconds(make: Callable[[], AbstractPlayer], num_outputs: int) -> float:
    """99th percentile of the time that one step of a player takes, of 200 dry ones [s]."""
    player, took = make(), []
    for k in range(min(200, player.num_steps)):
        start = time.perf_counter()
        player.applied(player(k, np.zeros(num_outputs)))
        took.append(time.perf_counter() - start)
    return float(np.percentile(took, 99))
