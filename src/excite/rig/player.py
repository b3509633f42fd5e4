"""What plays on a rig, sample by sample: a signal or a policy, with NumPy alone."""

from __future__ import annotations

import abc
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ..policy import (
    Policy,
    empty_window,
    network,
    observe,
    scaled_action,
    with_input,
    with_measurement,
)


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
        self._window = with_measurement(np, self._layout, self._window, measured)
        observation = observe(np, self._layout, self._window, k)
        with np.errstate(over="ignore", invalid="ignore"):
            action = network(np, self._policy.weights, observation).astype(float)
        # Not zero, as in training: for what is no number the supervisor ends the experiment.
        action = np.where(np.isfinite(action), np.clip(action, -1.0, 1.0), np.nan)
        return scaled_action(np, self._layout, action)

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
