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


class Sequel:
    """Signals that go on from what is played, given while the experiment runs.

    After what is played first, between them and after them the safe input is played.

    Attributes:
        num_steps: samples of the experiment at most.
    """

    def __init__(self, num_steps: int) -> None:
        """No signal."""
        self.num_steps = num_steps
        self._end = self._begin = math.inf
        self._inputs = np.zeros((0, 0))

    def end(self, k: int) -> None:
        """Ends what is played: the safe input follows from sample k on."""
        self._end = min(self._end, k)

    def begin(self, k: int, inputs: np.ndarray) -> None:
        """Plays a signal [time, input] from sample k on."""
        self._begin, self._end, self._inputs = k, k + len(inputs), inputs

    def input(self, k: int) -> np.ndarray | None:
        """What the signal is at sample k; None for the safe input."""
        return self._inputs[k - int(self._begin)] if self._begin <= k < self._end else None

    def first_has_ended(self, k: int) -> bool:
        """Whether what was played first has ended before sample k."""
        return k >= min(self._begin, self._end)


class SequelPlayer(AbstractPlayer):
    """A player, and what goes on from it."""

    def __init__(self, first: AbstractPlayer, sequel: Sequel, safe_input: np.ndarray) -> None:
        """A player before its first sample."""
        self._first, self._sequel, self._safe_input = first, sequel, safe_input
        self.num_steps = sequel.num_steps
        self._is_first = True

    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """The input of the player, of a signal after it, or the safe one."""
        has_ended = k >= self._first.num_steps or self._sequel.first_has_ended(k)
        self._is_first = not has_ended
        if self._is_first:
            return self._first(k, measured)
        input = self._sequel.input(k)
        return self._safe_input if input is None else input

    def applied(self, input: np.ndarray) -> None:
        """Passes the applied input to the player."""
        if self._is_first:
            self._first.applied(input)

    def origin(self) -> Mapping[str, object]:
        """That of the player."""
        return self._first.origin()

    def facts(self) -> Mapping[str, object]:
        """Those of the player."""
        return self._first.facts()


def step_seconds(make: Callable[[], AbstractPlayer], num_outputs: int) -> float:
    """99th percentile of the time of one step of a player [s], from 200 steps without a rig."""
    player, took = make(), []
    for k in range(min(200, player.num_steps)):
        start = time.perf_counter()
        player.applied(player(k, np.zeros(num_outputs)))
        took.append(time.perf_counter() - start)
    return float(np.percentile(took, 99))
