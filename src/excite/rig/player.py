"""Players propose the inputs of an experiment on a rig, sample by sample; NumPy alone.

A signal or a policy is played with NumPy. Any other excitation (`excite.excitation`) is
played by `rig.excitation`, which needs JAX.
"""

from __future__ import annotations

import abc
import math
import time
from collections.abc import Callable, Mapping

import numpy as np

from ..policy import Policy, empty_window, respond, with_input


class AbstractPlayer(abc.ABC):
    """A player proposes the inputs of one experiment.

    Attributes:
        num_steps: number of sampling instants.
    """

    num_steps: int

    @property
    def is_over(self) -> bool:
        """Whether it ends the experiment before its time."""
        return False

    @property
    def is_at_rest(self) -> bool:
        """Whether the experiment may end where it has been played."""
        return True

    @abc.abstractmethod
    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """Proposed input at sampling instant k, in the plant's units."""

    def applied(self, input: np.ndarray) -> None:
        """Called with the input that was applied, after limits and supervision."""
        del input

    def origin(self) -> Mapping[str, object]:
        """Origin of the inputs, JSON-ready; called before the experiment."""
        return {}

    def facts(self) -> Mapping[str, object]:
        """Facts about the player for the record, JSON-ready; called after the experiment."""
        return {}


class SignalPlayer(AbstractPlayer):
    """A signal known beforehand."""

    def __init__(self, inputs: np.ndarray) -> None:
        """`inputs` has shape [time, input], in the plant's units."""
        self._inputs, self.num_steps = np.asarray(inputs, float), len(inputs)

    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """Row k."""
        del measured
        return self._inputs[k]


class PolicyPlayer(AbstractPlayer):
    """A learned policy; the inputs in its window are those that were applied."""

    def __init__(self, policy: Policy, num_steps: int | None = None) -> None:
        """A policy before its first sample; by default for all steps that it was made for."""
        self._policy, self._layout = policy, policy.layout
        self._window = empty_window(np, policy.layout)
        self.num_steps = num_steps or policy.layout.num_steps

    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """The network's input for the window that ends with this measurement."""
        weights, window = self._policy.weights, self._window
        with np.errstate(over="ignore", invalid="ignore"):
            # NaN, not zero as in training: the supervisor then ends the experiment.
            self._window, input = respond(
                np, self._layout, weights, window, k, measured, if_not_finite=math.nan
            )
        return input

    def applied(self, input: np.ndarray) -> None:
        """Puts the applied input into the window."""
        self._window = with_input(np, self._layout, self._window, input)

    def origin(self) -> Mapping[str, object]:
        """The policy's hash."""
        return {"policy_hash": self._policy.hash}


def step_seconds(make: Callable[[], AbstractPlayer], num_outputs: int) -> float:
    """99th percentile of the time of one step of a player [s], from 200 steps without a rig."""
    player, took = make(), []
    for k in range(min(200, player.num_steps)):
        start = time.perf_counter()
        player.applied(player(k, np.zeros(num_outputs)))
        took.append(time.perf_counter() - start)
    return float(np.percentile(took, 99))
