"""What the real-time loop costs: a step of policy and guard, a check, readings that come late.

Absolute times, not ratios: a loop at 500 Hz has 2 ms for everything, and nothing to be compared
with. NumPy alone; the rig of the loop does nothing but wait.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from excite.policy import Policy, guard_of, read_policy, shipped_policies
from excite.rig import AbstractRig, Outcome, Pacer, PolicyPlayer, Reading, Recorder, run_loop
from excite.rig.guard import Guard, GuardedPlayer
from excite.rig.player import SignalPlayer
from excite.safety import Supervision, Watch, check_reading

POLICY, NUM_READINGS, STEPS = "aero2", 50, 100
"""Readings in one dt of 0.1 s (500 Hz), and samples (10 s)."""

GUARDED = "aero2", "dc_motor", "cart_pole", "aero2_detailed"


class IdleRig(AbstractRig):
    """A slow swing, so that the supervisor sees a plant that moves."""

    num_readings = NUM_READINGS

    def __init__(self, policy: Policy) -> None:
        self.description = policy.plant

    def open(self) -> None:
        """Starts the clock."""
        self._pacer = Pacer(self.description.dt / self.num_readings)

    def read(self) -> Reading:
        """The swing, when it is due."""
        now = self._pacer.wait()
        return Reading(now, np.array([0.2 * math.sin(now)]))

    def write(self, input: np.ndarray) -> None:
        """Nothing to be driven."""

    def close(self) -> None:
        """Nothing to release."""


def microseconds(call: Callable[[int], object], count: int) -> str:
    """Median and 99th percentile of one call."""
    took = []
    for i in range(count):
        start = time.perf_counter()
        call(i)
        took.append(time.perf_counter() - start)
    median, high = 1e6 * np.percentile(took, (50, 99))
    return f"median {median:.1f}, 99 % below {high:.1f} microseconds"


def policy_step(policy: Policy) -> str:
    player, pitch = PolicyPlayer(policy), np.array([0.1])

    def step(i: int) -> None:
        player.applied(player(i % player.num_steps, pitch))

    return microseconds(step, 5000)


def guard_step(policy: Policy, size: float) -> str:
    """A step of the guard alone: a plant at rest, or outputs at a part of their scales."""
    guard = Guard.from_dict(guard_of(policy, policy.plant))
    at_rest = SignalPlayer(np.tile(guard.rules.rest, (200, 1)))
    player = GuardedPlayer(at_rest, guard)
    outputs = size * np.array([o.scale for o in policy.plant.outputs])

    def step(i: int) -> None:
        player.applied(player(i, outputs))

    return microseconds(step, 100)


def supervisor_check(policy: Policy) -> str:
    rules, pitch = Supervision.of(policy.plant), np.array([0.1])
    watch = Watch.start(np, rules, pitch)
    interval = policy.plant.dt / NUM_READINGS
    return microseconds(lambda _: check_reading(np, rules, watch, pitch, interval), 20_000)


def loop(policy: Policy) -> Outcome:
    """Ten seconds, recorded to a temporary file."""
    player, rules = PolicyPlayer(policy), Supervision.of(policy.plant)
    player.num_steps = STEPS
    with tempfile.TemporaryDirectory() as folder:
        recorder = Recorder(Path(folder) / "record.csv", policy.plant, {})
        with IdleRig(policy) as rig, recorder as record:
            return run_loop(rig, player, rules, record)


def main() -> None:
    policy = read_policy(shipped_policies()[POLICY])
    print(f"a step of the policy {POLICY}: {policy_step(policy)}")
    for name in GUARDED:
        own = read_policy(shipped_policies()[name])
        print(f"a step of the guard of {name}, watching: {guard_step(own, 0.0)}")
        print(f"a step of the guard of {name}, braking: {guard_step(own, 0.5)}")
    print(f"a check of a reading: {supervisor_check(policy)}")
    outcome = loop(policy)
    late = outcome.to_dict()["late_ms_percentiles"] or {}
    shown = ", ".join(f"{p} %: {value:.3f}" for p, value in late.items())
    print(f"readings late at 500 Hz, ms: {shown} ({outcome.reason}, {len(outcome.late)} readings)")


if __name__ == "__main__":
    main()
