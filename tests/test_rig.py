"""Rigs and the real-time loop: the order of an experiment, and every way in which it ends."""

import contextlib
import dataclasses
import errno
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import LONG
from commands import PATIENCE

import excite
from excite.environment import run_episodes
from excite.estimation import NLS, Experiments
from excite.estimation.identify import identify
from excite.excitation import Chirp, Multisine, PolicyExcitation, PositionLoop, Square
from excite.files import csv_text
from excite.plant import Aero2, Aero2Detailed
from excite.plant.catalogue import plant_from, with_sensor
from excite.policy import read_policy, shipped_policies
from excite.record import read_record, write_record
from excite.rig import (
    AbstractPlayer,
    AbstractRig,
    Outcome,
    Pacer,
    PolicyPlayer,
    Reading,
    Recorder,
    RigError,
    SignalPlayer,
    contract,
    interruptible,
    loop,
    run_loop,
)
from excite.rig.excitation import ExcitationPlayer
from excite.rig.filter import FilteredPlayer, SafetyFilter
from excite.rig.live_estimate import LiveEstimate
from excite.rig.simulated import (
    Hardware,
    SimulatedRig,
    at_interval,
    drawn_hardware,
    evaluate_on_rig,
    readings_per_sample,
    run_batch,
)
from excite.safety import Supervision, Trip
from excite.simulation import response, run_episode

PLANT = Aero2Detailed()
AERO = PLANT.description
RULES = Supervision.of(AERO)
CRITICAL = float(RULES.critical[0])
LEVEL_AT = 11  # of the reading of sample 5 in scripts, with two readings a sample


class ScriptedRig(AbstractRig):
    """Moves a little at every reading, but for what a script says.

    `script` has by reading an output, or what is called in its place; `failing` has by method
    the error that it raises; `from_write` is the first write that fails.
    """

    num_readings, is_real_time = 2, False

    def __init__(self, script=None, failing=None, from_write=0, clock=1.0):
        self.description = AERO
        self.script, self.failing, self.from_write = script or {}, failing or {}, from_write
        self.clock, self.log, self.num_read, self.num_written = clock, [], 0, 0

    def open(self):
        self.said("open")
        self.pacer = Pacer(self.description.dt / self.num_readings)

    def read(self):
        self.said("read")
        n, self.num_read = self.num_read, self.num_read + 1
        if self.is_real_time:
            self.pacer.wait()
        output = self.script.get(n, 0.001 * n)
        output = output() if callable(output) else output
        interval = self.description.dt / self.num_readings
        return Reading(self.clock * n * interval, np.array([output], float))

    def write(self, input):
        self.num_written += 1
        if self.num_written > self.from_write:
            self.said(f"write {float(input[0]):g}")
        else:
            self.log.append(f"write {float(input[0]):g}")

    def close(self):
        self.said("close")

    def said(self, word):
        self.log.append(word)
        if word.split()[0] in self.failing:
            error = self.failing[word.split()[0]]
            raise error if isinstance(error, BaseException) else error.pop(0)


class ScriptedPlayer(AbstractPlayer):
    """Five volts, but for what is called at sampling instant `at`."""

    def __init__(self, then=lambda: 5.0, at=4, num_steps=8):
        self.num_steps, self.then, self.at = num_steps, then, at

    def __call__(self, k, measured):
        return np.array([float(self.then() if k == self.at else 5.0)])


def raising(error):
    def fail():
        raise error

    return fail


def kill(number):
    """Asks this process to end, and goes on."""

    def ask():
        os.kill(os.getpid(), number)
        return 5.0

    return ask


def experiment(path, rig, player=None, recorder=None, **choices) -> tuple[Any, RigError | None]:
    """As a user runs it: the outcome, or None, and the error that left the rig."""
    outcome = None
    try:
        with interruptible() as stop, rig, recorder or Recorder(path, rig.description, {}) as r:
            rules = Supervision.of(rig.description)
            outcome = run_loop(rig, player or ScriptedPlayer(), rules, r, stop=stop, **choices)
    except RigError as error:
        return outcome, error
    return outcome, None


def ended(path):
    return json.loads(path.with_suffix(".json").read_text())["ended"]


# ----------------------------------------------------------------------------- the loop


def test_the_order_of_an_experiment(tmp_path):
    rig = ScriptedRig()

    class Player(ScriptedPlayer):
        def __call__(self, k, measured):
            rig.log.append(f"ask {k} {measured[0]:g}")
            return super().__call__(k, measured)

        def applied(self, input):
            rig.log.append(f"told {input[0]:g}")

    def show(sample):
        recorded = len((tmp_path / "a.csv").read_text().splitlines()) - 1
        rig.log.append(f"shown {sample.k}, {recorded} on disk")

    outcome, _ = experiment(tmp_path / "a.csv", rig, Player(num_steps=2), on_sample=show)
    assert outcome.is_complete
    assert rig.log == [
        "open", "read",
        "ask 0 0", "write 5", "told 5", "shown 0, 1 on disk", "read", "read",
        "ask 1 0.002", "write 5", "told 5", "shown 1, 2 on disk", "read", "read",
        "write 0", "write 0", "write 0", "close",
    ]  # fmt: skip
    record = read_record(tmp_path / "a.csv", AERO)
    np.testing.assert_array_equal(record.outputs[:, 0], [0.0, 0.002, 0.004])
    np.testing.assert_array_equal(record.inputs[:, 0], [5.0, 5.0, 0.0])
    assert ended(tmp_path / "a.csv") == {**outcome.to_dict(), "reason": "complete"}


@pytest.mark.parametrize("latency", [0, 1, 3])
def test_the_record_holds_the_reading_at_which_an_input_begins_to_act(tmp_path, latency):
    rig = ScriptedRig()
    rig.num_readings, rig.num_latency = 4, latency
    outcome, _ = experiment(tmp_path / "a.csv", rig, SignalPlayer(np.array([[1.0], [2.0], [3.0]])))
    assert outcome.is_complete
    record = read_record(tmp_path / "a.csv", AERO)
    np.testing.assert_array_equal(record.inputs[:, 0], [1.0, 2.0, 3.0, 0.0])
    expected = 0.001 * (4 * np.arange(4) + latency)
    np.testing.assert_allclose(record.outputs[:, 0], expected, rtol=1e-12)
    np.testing.assert_allclose(record.time, AERO.dt * np.arange(4))
    clock = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)["clock"]
    np.testing.assert_allclose(clock, AERO.dt * (np.arange(4) + latency / 4))


def test_a_latency_of_a_whole_sample_is_refused(tmp_path):
    rig = ScriptedRig()
    rig.num_latency = 2
    outcome, _ = experiment(tmp_path / "a.csv", rig)
    assert "must be less than the 2 of one sampling time" in outcome.reason
    assert outcome.num_samples == 0


def test_a_recorder_refuses_what_it_would_destroy(tmp_path):
    (tmp_path / "a.csv").write_text("mine")
    with pytest.raises(ValueError, match="exists"):
        Recorder(tmp_path / "a.csv", AERO, {})
    with pytest.raises(ValueError, match="line by line"):
        Recorder(tmp_path / "a.mat", AERO, {})
    assert (tmp_path / "a.csv").read_text() == "mine"


# ------------------------------------------------------------------------ how it ends

STUCK = {n: 0.012 * min(n, 5) for n in range(30)}
RISING = {8: 0.25, 9: 0.45, 10: 0.60, LEVEL_AT: 0.70}
SHAKEN = {LEVEL_AT: raising(RigError("the cable is out"))}
UNLICENSED = {LEVEL_AT: raising(SystemExit("no licence"))}
ENDINGS = {
    "player fails": ({}, raising(ZeroDivisionError("oh")), "ZeroDivisionError: oh", None, 4),
    "player ends the program": ({}, raising(SystemExit(3)), "SystemExit: 3", None, 4),
    "player is closed": ({}, raising(GeneratorExit()), "GeneratorExit", None, 4),
    "the rig ends the program": ({"script": UNLICENSED}, None, "no licence", None, 6),
    "player is interrupted": ({}, raising(KeyboardInterrupt()), "interrupted", None, 4),
    "player without a number": ({}, lambda: math.nan, "asked for an input", "input_not_finite", 5),
    "SIGINT": ({}, kill(signal.SIGINT), "interrupted by SIGINT", None, 5),
    "SIGTERM": ({}, kill(signal.SIGTERM), "interrupted by SIGTERM", None, 5),
    "a reading is no number": ({"script": {LEVEL_AT: math.nan}}, None, "finite", "not_finite", 6),
    "a reading is infinite": ({"script": {LEVEL_AT: -math.inf}}, None, "finite", "not_finite", 6),
    "a reading jumps": ({"script": {LEVEL_AT: 0.6}}, None, "measurement jumped", "jump", 6),
    "a reading sticks": ({"script": STUCK}, None, "did not change", "stale", 8),
    "the level": ({"script": RISING}, None, "reached", "level", 6),
    "the rig fails to read": ({"script": SHAKEN}, None, "the cable is out", None, 6),
    "its clock stands": ({"clock": 0.0}, None, "did not change", "stale", 1),
    "its clock is none": ({"clock": math.nan}, None, "did not change", "stale", 1),
    "its clock runs": ({"clock": 1.5}, None, "too fast or too slow", "duration", 6),
    "SIGHUP": ({}, kill(signal.SIGHUP), "interrupted by SIGHUP", None, 5),
}


@pytest.mark.parametrize("name", ENDINGS)
def test_an_ending_is_safe_released_recorded_and_explained(tmp_path, name):
    choices, then, reason, trip, num_rows = ENDINGS[name]
    rig, path = ScriptedRig(**choices), tmp_path / "a.csv"
    outcome, error = experiment(path, rig, ScriptedPlayer(then) if then else None)
    assert error is None
    assert reason in outcome.reason
    assert outcome.trip.name.lower() == (trip or "none")
    assert rig.log[-3:] == ["write 0", "write 0", "close"]
    assert ended(path)["reason"] == outcome.reason
    assert not outcome.is_complete
    rows = path.read_text().splitlines()[1:]
    assert len(rows) == num_rows
    if num_rows > 1:
        record = read_record(path, AERO)
        assert np.abs(record.outputs).max() <= outcome.max_abs_output[0]
    if trip is not None:
        assert " at " in outcome.reason  # which reading it was


def test_after_a_trip_the_player_is_not_asked_again(tmp_path):
    asked = []

    class Player(ScriptedPlayer):
        def __call__(self, k, measured):
            asked.append(k)
            return super().__call__(k, measured)

    rig = ScriptedRig(RISING)
    outcome, _ = experiment(tmp_path / "a.csv", rig, Player())
    assert asked == [0, 1, 2, 3, 4, 5]
    assert outcome.num_samples == 6
    assert set(rig.log[rig.log.index("write 5") :]) == {"write 5", "read", "write 0", "close"}


@pytest.mark.parametrize("failing", ["open", "read", "write"])
def test_a_rig_that_fails_is_closed(tmp_path, failing):
    rig = ScriptedRig(failing={failing: RigError("the cable is out")})
    outcome, error = experiment(tmp_path / "a.csv", rig)
    assert rig.log[-1] == "close"
    if failing == "open":
        assert outcome is None
        assert rig.log == ["open", "close"]
        assert not list(tmp_path.iterdir())
    else:
        assert outcome.reason.startswith("the cable is out")
        assert ended(tmp_path / "a.csv")["reason"] == outcome.reason
    assert (error is None) == (failing == "read")


def test_a_rig_that_fails_to_open_and_to_close_tells_the_first(tmp_path):
    rig = ScriptedRig(failing={"open": RigError("no card"), "close": RigError("nothing")})
    assert str(experiment(tmp_path / "a.csv", rig)[1]) == "no card"


def test_a_safe_input_that_cannot_be_written_is_told_and_the_rig_closed(tmp_path):
    rig = ScriptedRig(failing={"write": RigError("the cable is out")}, from_write=8)
    outcome, error = experiment(tmp_path / "a.csv", rig)
    assert str(error) == "the cable is out"
    assert rig.log[-1] == "close"
    # The loop's last sample writes the safe input as well.
    assert outcome.reason == (
        "the cable is out; the safe input could not be applied: the cable is out"
    )
    assert ended(tmp_path / "a.csv")["reason"] == outcome.reason
    assert len(read_record(tmp_path / "a.csv", AERO).time) == 8


def test_an_interrupt_while_the_safe_input_is_written_loses_nothing(tmp_path):
    rig = ScriptedRig(failing={"write": [KeyboardInterrupt()]}, from_write=4)
    rig.said = interrupted_once(rig)
    player = ScriptedPlayer(raising(ValueError("oh")))
    outcome, _ = experiment(tmp_path / "a.csv", rig, player)
    expected = "ValueError: oh; the safe input could not be applied: interrupted"
    assert outcome.reason == ended(tmp_path / "a.csv")["reason"] == expected
    assert rig.log[-2:] == ["write 0", "close"]


def interrupted_once(rig):
    """The rig's `said`, which raises only while there is something left to raise."""
    told = rig.said

    def said(word):
        if not any(rig.failing.values()):
            rig.failing = {}
        told(word)

    return said


def test_a_second_interrupt_ends_a_rig_that_hangs(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "_PATIENCE", 0.05)

    def hang():
        kill(signal.SIGINT)()
        time.sleep(0.1)
        kill(signal.SIGINT)()
        raise AssertionError("a second Ctrl-C must not wait for the next reading")

    rig = ScriptedRig({9: hang})
    outcome, _ = experiment(tmp_path / "a.csv", rig)
    assert outcome.reason == "interrupted"
    assert rig.log[-3:] == ["write 0", "write 0", "close"]
    assert len(read_record(tmp_path / "a.csv", AERO).time) == 5


def test_signals_are_given_back():
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    before = [signal.getsignal(n) for n in numbers]
    with interruptible() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.reason == "interrupted by SIGTERM"
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.reason == "interrupted by SIGTERM"
    assert [signal.getsignal(n) for n in numbers] == before


@pytest.fixture
def _usual_interrupt():
    """A process that was started in the background ignores SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("_usual_interrupt")
def test_before_an_experiment_signals_act_as_usual():
    with interruptible(has_begun=False) as stop:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        assert not stop.reason
        stop.has_begun = True
        os.kill(os.getpid(), signal.SIGINT)
    assert stop.reason == "interrupted by SIGINT"


AT_THE_END = ["write", "facts", "close"]


@pytest.mark.parametrize("at", AT_THE_END)
def test_a_second_signal_while_it_ends_changes_nothing(tmp_path, monkeypatch, at):
    """Also one that comes after a while: a slow end is no rig that hangs."""
    monkeypatch.setattr(loop, "_PATIENCE", 0.0)

    class Rig(ScriptedRig):
        def write(self, input):
            super().write(input)
            self.interrupt("write" if float(input[0]) == 0 else "")

        def facts(self):
            self.interrupt("facts")
            return {"own": 1}

        def close(self):
            self.interrupt("close")
            super().close()

        def interrupt(self, word):
            if word == at and stop.is_ending:
                for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
                    os.kill(os.getpid(), number)

    rig, path = Rig(), tmp_path / "a.csv"
    with interruptible() as stop, rig, Recorder(path, AERO, {}) as recorder:
        player = ScriptedPlayer(kill(signal.SIGINT))
        outcome = run_loop(rig, player, RULES, recorder, stop=stop)
    assert outcome.reason == "interrupted by SIGINT"
    assert outcome.rig == {"own": 1}
    assert ended(path) == outcome.to_dict()
    assert len(read_record(path, AERO).time) == 5
    assert rig.log[-3:] == ["write 0", "write 0", "close"]


class FullDisk:
    """A file of a disk that is full after a number of lines; `part` of the next still fits."""

    def __init__(self, file, num_lines, part):
        self.file, self.left, self.part = file, num_lines, part

    def write(self, line):
        self.left -= 1
        if self.left >= 0:
            return self.file.write(line)
        if self.part:
            return self.file.write(line[: self.part])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def __getattr__(self, name):
        return getattr(self.file, name)


class FullRecorder(Recorder):
    part = 0

    def begin(self):
        super().begin()
        self._file = FullDisk(self._file, 5, self.part)


@pytest.mark.parametrize("part", [0, 7])
def test_a_full_disk_ends_it_with_a_record_that_can_be_read(tmp_path, part):
    path, rig = tmp_path / "a.csv", ScriptedRig()
    recorder = FullRecorder(path, AERO, {})
    recorder.part = part
    outcome, _ = experiment(path, rig, recorder=recorder)
    assert ("the disk is full" if part else "No space left") in outcome.reason
    assert ended(path)["reason"] == outcome.reason
    assert rig.log[-3:] == ["write 0", "write 0", "close"]
    assert len(read_record(path, AERO).time) == 5


def test_a_sidecar_that_cannot_be_written_at_the_end_is_told(tmp_path, monkeypatch):
    def full(self, ended):
        raise ValueError("a.json: cannot be written")

    monkeypatch.setattr(Recorder, "end", full)
    rig = ScriptedRig()
    outcome, _ = experiment(tmp_path / "a.csv", rig)
    assert outcome.reason == (
        "complete; the end was not recorded: ValueError: a.json: cannot be written"
    )
    assert rig.log[-1] == "close"


@pytest.mark.parametrize("facts", [raising(ZeroDivisionError("oh")), lambda: {"x": {1, 2}}])
def test_a_part_that_cannot_tell_of_itself_loses_nothing(tmp_path, facts):
    rig, player = ScriptedRig(), ScriptedPlayer()
    rig.facts = player.facts = facts
    outcome, error = experiment(tmp_path / "a.csv", rig, player)
    assert error is None
    assert outcome.is_complete
    told = ended(tmp_path / "a.csv")
    assert told["reason"] == "complete"
    assert "Error: " in told["rig"]["error"]
    assert "Error: " in told["player"]["error"]


# ---------------------------------------------------------------------------- real time


class Clock:
    """In place of the module `time`: time passes only in `sleep`, so that nothing else is late."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        return self.now

    def sleep(self, seconds):
        self.now += max(seconds, 1e-4)


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    for module in (contract, loop):
        monkeypatch.setattr(module, "time", clock)
    return clock


def real_time_rig(clock, dt, num_readings, sleeps):
    """Reading number -> how long it takes."""
    rig = ScriptedRig({n: lambda s=s, n=n: clock.sleep(s) or 0.001 * n for n, s in sleeps.items()})
    rig.description = dataclasses.replace(AERO, dt=dt, band=(0.05, 1.0))
    rig.num_readings, rig.is_real_time = num_readings, True
    return rig


def test_a_sample_that_is_late_by_another_ends_it(tmp_path, clock):
    rig = real_time_rig(clock, 0.1, 2, {7: 0.2})
    outcome, _ = experiment(tmp_path / "a.csv", rig)
    assert outcome.trip == Trip.DEADLINES
    assert outcome.num_samples == 4
    assert rig.log[-3:] == ["write 0", "write 0", "close"]
    assert ended(tmp_path / "a.csv")["missed_deadlines"] >= 1
    assert len(read_record(tmp_path / "a.csv", AERO).time) == 4


def test_readings_that_are_late_in_a_row_end_it(tmp_path, clock):
    rig = real_time_rig(clock, 0.2, 4, dict.fromkeys(range(3, 30), 0.06) | {3: 0.12})
    outcome, _ = experiment(tmp_path / "a.csv", rig)
    assert outcome.trip == Trip.DEADLINES
    assert max(outcome.late) < 0.2  # none of them by a whole sample
    assert outcome.num_missed >= 5


def test_one_late_reading_is_counted_and_forgiven(tmp_path, clock):
    rig = real_time_rig(clock, 0.4, 4, {3: 0.15})
    outcome, _ = experiment(tmp_path / "a.csv", rig, ScriptedPlayer(num_steps=2))
    assert outcome.is_complete, outcome.reason
    assert outcome.num_missed == 1
    assert outcome.to_dict()["late_ms_percentiles"]["100"] == pytest.approx(150, abs=1)


def test_a_reading_before_it_is_due_is_not_late():
    told = Outcome(late=[-0.002, -0.001, 0.003]).to_dict()["late_ms_percentiles"]
    assert told == pytest.approx({"50": 0.0, "90": 2.4, "99": 2.94, "100": 3.0})


def test_where_time_is_not_the_walls_nothing_is_late():
    assert Outcome().to_dict()["late_ms_percentiles"] is None


# ------------------------------------------------------------------------ simulated rig

NUM_READINGS, NUM_SAMPLES = 10, 120
IDEAL = Aero2()


@pytest.fixture(scope="module")
def many():
    keys = jax.random.split(jax.random.key(5), 20)
    return drawn_hardware(PLANT, NUM_READINGS, 0.3, keys)


def hardware_of(num_readings=NUM_READINGS, seed=0, spread=0.1, **numbers):
    return Hardware.draw(PLANT, num_readings, spread, jax.random.key(seed), **numbers)


def simulated(path, hardware, player, num_steps, on_sample=lambda _: None):
    rig = SimulatedRig(PLANT, hardware, NUM_READINGS, is_real_time=False)
    player.num_steps = num_steps
    outcome, error = experiment(path, rig, player, on_sample=on_sample)
    assert error is None
    return outcome, rig


def chirp(num_steps, amplitude=None):
    excitation = Chirp(amplitude=amplitude)
    return excitation, np.asarray(excitation.sequence(PLANT, num_steps, jax.random.key(0)))


@pytest.mark.science
def test_the_loop_and_the_batch_are_one_experiment(many, tmp_path):
    policy = read_policy(shipped_policies()["aero2-ppo-all"])
    gentle, sequence = chirp(80, 3.0)
    trips = set()
    for name, excitation, make, num_steps in (
        ("policy", PolicyExcitation.of(policy), lambda: PolicyPlayer(policy), 120),
        ("chirp", gentle, lambda: SignalPlayer(sequence), 80),
    ):
        runs = run_batch(many, excitation, RULES, num_steps, NUM_READINGS)
        for i in range(20):
            path = tmp_path / f"{name}{i}.csv"
            hardware = jax.tree.map(lambda leaf, i=i: leaf[i], many)
            outcome, _ = simulated(path, hardware, make(), num_steps)
            trip = Trip(int(runs.trip[i]))
            assert outcome.trip == trip
            inputs = np.asarray(runs.inputs[i])
            # At a sampling instant the safe input takes the place of the player's.
            is_sampled = trip in (Trip.PREDICTED_LEVEL, Trip.STALE)
            if trip != Trip.NONE:
                assert outcome.num_samples == np.count_nonzero(inputs) + is_sampled
            else:
                assert outcome.num_samples == num_steps
            record = np.genfromtxt(path, delimiter=",", names=True)
            n = min(outcome.num_samples, len(record))
            assert n >= outcome.num_samples - 1
            np.testing.assert_allclose(record["voltage"][:n], inputs[:n, 0], atol=1e-4)
            seen = np.asarray(runs.measured[i, :, 0])
            n = n if trip != Trip.NONE else n + 1
            # Of a sample in which it tripped, a record has the reading that did it.
            np.testing.assert_allclose(record["pitch"][: n - 1], seen[: n - 1], atol=1e-9)
            if trip == Trip.NONE:
                assert record["pitch"][n - 1] == pytest.approx(seen[n - 1], abs=1e-9)
            trips.add((name, trip))
    assert {name for name, trip in trips if trip != Trip.NONE} == {"policy"}, trips
    assert ("chirp", Trip.NONE) in trips


@pytest.mark.science
def test_experiments_on_rigs_are_scored_like_those_on_plants():
    keys = jax.random.split(jax.random.key(3), 4)
    bare = {"latency": 0.0, "jitter": 0.0}
    fine = readings_per_sample(PLANT)
    assert fine == 50
    excitation = Chirp(amplitude=6.0)
    scored, runs = evaluate_on_rig(
        PLANT, excitation, drawn_hardware(PLANT, fine, 0.3, keys, **bare), RULES, 60
    )
    on_plants = run_episodes(PLANT, excitation, 60, 0.3, keys)
    for own, other in zip(scored.params, on_plants.params, strict=True):
        np.testing.assert_array_equal(own, other)
    # Without latency it is the same experiment but for steps of integration and the encoder's.
    inputs = scored.trajectory.inputs, on_plants.trajectory.inputs
    np.testing.assert_allclose(*inputs, atol=1e-12)
    resolution = AERO.outputs[0].resolution
    far = scored.trajectory.measured - on_plants.trajectory.outputs
    assert float(jnp.abs(far).max()) < 0.6 * resolution
    np.testing.assert_allclose(scored.information, on_plants.information, rtol=1e-9)
    assert not np.asarray(runs.trip).any()
    assert not np.asarray(scored.is_violation).any()


@pytest.mark.science
def test_a_level_counts_between_samples_too():
    keys = jax.random.split(jax.random.key(0), 8)
    many = drawn_hardware(PLANT, readings_per_sample(PLANT), 0.3, keys)
    scored, runs = evaluate_on_rig(PLANT, Chirp(amplitude=14.0), many, RULES, 200)
    between = np.asarray(scored.max_abs_output)[:, 0]
    at_samples = np.abs(np.asarray(scored.trajectory.measured)).max(axis=1)[:, 0]
    assert (between >= at_samples - AERO.outputs[0].resolution).all()
    np.testing.assert_array_equal(scored.is_violation, between >= CRITICAL)
    assert (np.asarray(runs.trip) != Trip.NONE).any()


def test_a_position_loop_on_a_rig_is_that_of_an_episode(tmp_path):
    """Without latency and noise, and read at sampling instants only, trajectories are equal."""
    plant = with_sensor(IDEAL, {"pitch": 0.0}, {"pitch": 0.0})
    loop = PositionLoop(Multisine(), amplitude=0.3, gain=9.0, damping=2.0)
    hardware = Hardware.draw(plant, 1, 0.2, jax.random.key(4), latency=0.0, jitter=0.0)
    key = jax.random.key(1)
    episode = run_episode(plant, hardware.params, loop, 100, key)
    player = ExcitationPlayer(loop, plant, 100, key)
    rig = SimulatedRig(plant, hardware, 1, is_real_time=False)
    outcome, _ = experiment(tmp_path / "a.csv", rig, player)
    assert outcome.is_complete, outcome.reason
    record = read_record(tmp_path / "a.csv", plant.description)
    np.testing.assert_allclose(record.inputs[:-1], episode.inputs, atol=1e-10)
    np.testing.assert_allclose(record.outputs, episode.measured, atol=1e-12)


def test_a_played_excitation_hears_what_was_applied():
    policy = read_policy(shipped_policies()["aero2"])
    by_jax = ExcitationPlayer(PolicyExcitation.of(policy), IDEAL, 40, jax.random.key(0))
    by_numpy = PolicyPlayer(policy, 40)
    for k in range(40):
        measured = np.array([0.3 * math.sin(0.4 * k)])
        proposed = by_jax(k, measured)
        np.testing.assert_allclose(proposed, by_numpy(k, measured), atol=1e-4)
        for player in (by_jax, by_numpy):
            player.applied(0.5 * proposed)


def test_without_latency_the_physics_is_that_of_the_plant(tmp_path):
    hardware, (_, sequence) = hardware_of(latency=0.0, jitter=0.0), chirp(60, 6.0)
    outcome, rig = simulated(tmp_path / "a.csv", hardware, SignalPlayer(sequence), 60)
    assert outcome.is_complete
    fine = at_interval(PLANT, NUM_READINGS)
    held = jnp.asarray(np.repeat(sequence, NUM_READINGS, axis=0))
    true = np.asarray(response(fine, hardware.params, held))
    measured = read_record(tmp_path / "a.csv", AERO).outputs
    half = 0.5 * AERO.outputs[0].resolution
    assert np.abs(measured - true[::NUM_READINGS]).max() <= half * (1 + 1e-9)
    largest = rig.facts()["true_max_abs_output"]
    np.testing.assert_allclose(largest, np.abs(true).max(axis=0), rtol=1e-9)


@pytest.mark.science
def test_a_record_with_latency_identifies_without_bias(tmp_path):
    seen, (_, sequence) = [], chirp(NUM_SAMPLES, 5.0)
    hardware = Hardware.draw(IDEAL, NUM_READINGS, 0.1, jax.random.key(1), latency=0.01, jitter=0.0)
    rig = SimulatedRig(IDEAL, hardware, NUM_READINGS, is_real_time=False)
    outcome, _ = experiment(tmp_path / "a.csv", rig, SignalPlayer(sequence), on_sample=seen.append)
    assert outcome.is_complete
    true = rig.facts()["true_params"]
    record = read_record(tmp_path / "a.csv", IDEAL.description)
    result = identify([record], IDEAL, initial_state="known")
    for name, value in true.items():
        off = abs(result.params[name] - value)
        assert off < 4 * result.std_error[name], (name, result.params, true)
    _check_tracker(seen, record, result)


def _check_tracker(seen, record, result):
    """Its last estimate is that of the estimator on all samples it has seen."""
    tracker = LiveEstimate(IDEAL, len(seen), starts_at_rest=True)
    assert tracker.latest == {}
    for sample in seen:
        tracker(sample)
    tracker.close()
    experiments = Experiments(
        inputs=jnp.asarray(record.inputs[:-1])[None],
        measured=jnp.asarray(record.outputs)[None],
        valid=jnp.asarray(np.arange(len(seen) + 1) < len(seen))[None, :, None],
        initial_state=IDEAL.initial_state[None],
        initial_state_known=True,
    )
    estimate = NLS()(IDEAL, experiments)
    for value, (name, (ours, half)) in zip(estimate.params, tracker.latest.items(), strict=True):
        assert ours == pytest.approx(float(value), rel=1e-6)
        # The record has one measurement more.
        assert half == pytest.approx(1.96 * result.std_error[name], rel=0.1)
        assert abs(ours - result.params[name]) < 0.5 * half


def test_lost_readings_repeat_the_one_before(tmp_path):
    readings = {}
    for dropout in (0.0, 0.5):
        rig = SimulatedRig(PLANT, hardware_of(dropout=dropout), NUM_READINGS, is_real_time=False)
        rig.open()
        rig.write(np.array([10.0]))
        readings[dropout] = np.array([rig.read().outputs[0] for _ in range(100)])
    lost = readings[0.5] != readings[0.0]
    assert 0.2 < lost[30:].mean() < 0.8
    repeated = readings[0.5][1:] == readings[0.5][:-1]
    assert repeated[lost[1:]].all()


def test_a_rig_that_loses_all_readings_is_stopped(tmp_path):
    hardware, (_, sequence) = hardware_of(dropout=1.0), chirp(60, 6.0)
    outcome, _ = simulated(tmp_path / "a.csv", hardware, SignalPlayer(sequence), 60)
    assert outcome.trip == Trip.STALE


@pytest.mark.parametrize("numbers", [{"latency": 0.1}, {"latency": 0.097}, {"jitter": 0.095}])
def test_an_input_that_would_act_after_the_next_is_refused(numbers):
    with pytest.raises(ValueError, match="must be less than the sampling time"):
        SimulatedRig(PLANT, hardware_of(**numbers), NUM_READINGS, is_real_time=False)


def test_latency_is_a_part_of_the_plants_own_sampling_time():
    fast = PLANT.changed(dt=0.004)
    rig = SimulatedRig(fast, Hardware.draw(fast, 2, 0.0, jax.random.key(0)), 2, is_real_time=False)
    assert rig.num_latency == 0


@pytest.mark.parametrize(("name", "dt"), [("dc_motor", 0.001), ("aero2", 0.03), ("aero2", 0.1)])
def test_the_usual_latency_is_one_that_a_record_can_show(name, dt):
    """A part of a reading would be a delay that the plant of that name does not have."""
    plant = plant_from(name).changed(dt=dt)
    count = readings_per_sample(plant)
    hardware = Hardware.draw(plant, count, 0.0, jax.random.key(0))
    in_readings = float(hardware.latency) / float(plant.dt) * count
    assert in_readings == pytest.approx(round(in_readings), abs=1e-9)
    assert in_readings == pytest.approx(count / 10, abs=0.5)


# ------------------------------------------------------------------------ safety filter


@pytest.fixture(scope="module")
def safety():
    return SafetyFilter.of(PLANT, 0.3)


@pytest.mark.science
def test_the_filter_prevents_every_violation_and_only_these(many, safety):
    shape = 200, NUM_READINGS
    strong, gentle = Chirp(amplitude=12.0), Chirp(amplitude=4.0)
    bare = run_batch(many, strong, RULES, *shape)
    assert int(bare.is_violation.sum()) > 0
    filtered = run_batch(many, strong, RULES, *shape, safety)
    assert int(filtered.is_violation.sum()) == 0
    assert int((filtered.num_interventions > 0).sum()) > 10
    harmless = run_batch(many, gentle, RULES, *shape, safety)
    assert int(harmless.num_interventions.sum()) == 0
    _, sequence = chirp(200, 4.0)
    np.testing.assert_allclose(harmless.inputs[3], sequence, atol=1e-9)


@pytest.mark.science
def test_a_filtered_player_passes_on_what_is_harmless(safety):
    heard = []

    class Player(SignalPlayer):
        def applied(self, input):
            heard.append(input)

        def facts(self):
            return {"own": 1}

    player = FilteredPlayer(Player(np.full((40, 1), 2.0)), safety)
    assert player.num_steps == 40
    for k in range(3):
        np.testing.assert_array_equal(player(k, np.zeros(1)), [2.0])
    assert player.facts() == {
        "own": 1, "filter_interventions": 0, "filter_without_safe_input": 0,
    }  # fmt: skip
    input = player(3, np.array([0.0]))
    player.applied(input)
    assert heard == [input]


def test_what_is_no_number_is_left_to_the_supervisor(safety, tmp_path):
    player = FilteredPlayer(SignalPlayer(np.array([[1.0], [math.nan], [1.0]])), safety)
    np.testing.assert_array_equal(player(0, np.array([math.nan])), [1.0])
    assert np.isnan(player(1, np.zeros(1))).all()
    signal = FilteredPlayer(SignalPlayer(np.array([[1.0]] * 3 + [[math.inf]] * 3)), safety)
    outcome, _ = simulated(tmp_path / "a.csv", hardware_of(), signal, 6)
    assert outcome.trip == Trip.INPUT_NOT_FINITE
    assert outcome.player["filter_interventions"] == 0


def test_a_filter_that_has_lost_the_plant_lets_nothing_pass(safety):
    states = np.array(safety.start().states)
    states[3, 1] = 1e170  # finite, and beyond any prediction
    lost = dataclasses.replace(safety.start(), states=jnp.asarray(states))
    memory, input, is_changed = safety(lost, jnp.array([0.6]), jnp.array([24.0]))
    assert is_changed
    assert int(memory.num_unsafe) == 1
    assert not float(input[0]) > 0


@pytest.mark.science
@pytest.mark.parametrize("slew", [math.inf, 30.0])
def test_no_plant_of_the_set_is_driven_over_the_level(slew):
    """Full voltage either way, at and beside resonance, on every plant that the filter knows."""
    safety = SafetyFilter.of(PLANT, 0.3, slew)
    rules = dataclasses.replace(RULES, critical=np.full(1, np.inf), slew=np.full(1, slew * 0.1))
    drawn = drawn_hardware(PLANT, NUM_READINGS, 0.0, jax.random.split(jax.random.key(0), 9))
    corners = eqx.tree_at(lambda hardware: hardware.params, drawn, safety.params)
    for frequency in (0.08, 0.12, 0.15, 0.2):
        bang = Square(amplitude=24.0, frequency=frequency)
        shape = 200, NUM_READINGS
        runs = run_batch(corners, bang, rules, *shape, safety)
        assert float(runs.max_abs_output.max()) < CRITICAL
        assert (np.asarray(runs.num_interventions) > 10).all()
        assert (np.asarray(runs.trip) == int(Trip.NONE)).all()


# ------------------------------------------------------------------- what else may happen


def test_a_policy_whose_network_overflows_ends_the_experiment(tmp_path):
    policy = read_policy(shipped_policies()["aero2"])
    *inner, (matrix, bias) = policy.weights
    last = np.full_like(matrix, 3e38), np.full_like(bias, 3e38)
    broken = dataclasses.replace(policy, weights=(*inner, last))
    outcome, _ = experiment(tmp_path / "a.csv", ScriptedRig(), PolicyPlayer(broken))
    assert outcome.trip == Trip.INPUT_NOT_FINITE


def test_an_input_that_comes_a_sample_late_is_not_applied(tmp_path):
    class Slow(ScriptedPlayer):
        def __call__(self, k, measured):
            if k == 4:
                time.sleep(0.25)
                return np.array([24.0])
            return np.array([1.0])

    rig = ScriptedRig()
    rig.is_real_time = True
    outcome, _ = experiment(tmp_path / "a.csv", rig, Slow())
    assert outcome.trip == Trip.DEADLINES
    assert "write 24" not in rig.log


def test_readings_that_come_before_their_time_are_refused(tmp_path):
    class Hasty(ScriptedRig):
        is_real_time = True

        def open(self):
            super().open()
            self.pacer.wait = lambda: 0.0

    outcome, _ = experiment(tmp_path / "a.csv", Hasty(), ScriptedPlayer(num_steps=40))
    assert "before they are due" in outcome.reason


@pytest.mark.parametrize("clock", [0.9, 1.1])
def test_a_clock_that_leaves_the_plan_ends_the_experiment(tmp_path, clock):
    rig = ScriptedRig(clock=clock)
    outcome, _ = experiment(tmp_path / "a.csv", rig, ScriptedPlayer(num_steps=80))
    assert outcome.trip == Trip.DURATION


def test_a_reading_of_another_shape_is_an_error_of_the_rig(tmp_path):
    class Wide(ScriptedRig):
        def read(self):
            time, outputs = super().read()
            return Reading(time, np.append(outputs, 0.0) if self.num_read > 5 else outputs)

    outcome, _ = experiment(tmp_path / "a.csv", Wide())
    assert "has 1 outputs" in outcome.reason
    assert len(read_record(tmp_path / "a.csv", AERO).inputs) >= 2


def test_a_full_disk_does_not_lose_the_reason(tmp_path, monkeypatch):
    def full(path, content):
        raise ValueError(f"{path}: cannot be written (No space left on device)")

    path, sizes = tmp_path / "a.csv", []

    def fill():
        sizes.append(path.with_suffix(".json").stat().st_size)
        monkeypatch.setattr("excite.rig.recorder.write_bytes", full)
        return 5.0

    experiment(path, ScriptedRig(), ScriptedPlayer(fill))
    assert ended(path)["reason"] == "complete"
    assert path.with_suffix(".json").stat().st_size <= sizes[0]


def limited(folder: Path, size: int, *words: str) -> subprocess.CompletedProcess[str]:
    """A program of a rig, in which no file can grow beyond a size."""
    program = (
        "import resource, sys\n"
        "import numpy as np\n"
        "from excite.rig import Recorder, SignalPlayer, run_loop\n"
        "from excite.safety import Supervision\n"
        "from still import Still, AERO\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))\n"
        "from pathlib import Path\n"
        "recorder = Recorder(Path('a.csv'), AERO, {}, overwrite='again' in sys.argv)\n"
        "player = SignalPlayer(np.full((2000, 1), 5.0))\n"
        "with recorder, Still() as rig:\n"
        "    outcome = run_loop(rig, player, Supervision.of(AERO), recorder)\n"
        "print(outcome.reason)\n"
    )
    (folder / "still.py").write_text(STILL)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([SOURCE, str(folder)])}
    return subprocess.run(
        [sys.executable, "-c", program, str(size), *words], cwd=folder, env=environment,
        capture_output=True, text=True, check=False, timeout=PATIENCE,
    )  # fmt: skip


SOURCE = str(Path(excite.__file__).parent.parent)

STILL = """
import numpy as np
from excite.policy import read_policy
from excite.rig import AbstractRig, Reading

AERO = read_policy("aero2_detailed").plant


class Still(AbstractRig):
    description, is_real_time, num_readings = AERO, False, 2

    def open(self):
        self.n = -1

    def read(self):
        self.n += 1
        return Reading(self.n * AERO.dt / 2, np.array([0.0001 * (self.n % 7)]))

    def write(self, input):
        print("write", input[0], flush=True)

    def close(self):
        print("close", flush=True)
"""


def test_a_disk_that_is_full_at_once_leaves_nothing(tmp_path):
    for size in (0, 100):  # of which the second is enough for a header, not for a sidecar
        done = limited(tmp_path, size)
        assert "a.json: cannot be written (File too large)" in done.stderr
        assert done.stdout.splitlines() == ["write 0.0", "close"]
        assert [p.name for p in tmp_path.glob("*a.*")] == []


def test_a_disk_that_is_full_at_the_header_leaves_nothing(tmp_path, monkeypatch):
    class Full(Recorder):
        def _write_sidecar(self, more, reserve=0):
            super()._write_sidecar(more, reserve)
            self._file = FullDisk(self._file, 0, 0)

    rig = ScriptedRig()
    with pytest.raises(OSError, match=r"a\.csv: cannot be written \(No space left on device\)"):
        experiment(tmp_path / "a.csv", rig, recorder=Full(tmp_path / "a.csv", AERO, {}))
    assert rig.log == ["open", "write 0", "close"]
    assert not list(tmp_path.iterdir())


def test_a_disk_that_is_full_later_leaves_whole_lines_and_the_reason(tmp_path):
    done = limited(tmp_path, 21_500)  # the sidecar fits
    *_, last, closed, reason = done.stdout.splitlines()
    assert (last, closed) == ("write 0.0", "close"), done.stderr
    assert reason == ended(tmp_path / "a.csv")["reason"]
    assert "a.csv: the disk is full" in reason or "File too large" in reason
    record = read_record(tmp_path / "a.csv", AERO)
    assert 100 < len(record.time) < 2000
    before = (tmp_path / "a.csv").read_bytes(), (tmp_path / "a.json").read_bytes()
    assert "cannot be written" in limited(tmp_path, 0, "again").stderr
    assert before == ((tmp_path / "a.csv").read_bytes(), (tmp_path / "a.json").read_bytes())


# -------------------------------------------------------------------- one process alone


def test_two_recorders_of_one_file_are_one_too_many(tmp_path):
    path = tmp_path / "a.csv"
    seen = []

    def second():
        for overwrite in (False, True):
            try:
                with Recorder(path, AERO, {}, overwrite):
                    pytest.fail("two recorders")
            except ValueError as error:
                seen.append(str(error))
        try:
            write_record(path, excite.simulate("aero2", "chirp", steps=10), AERO)
        except ValueError as error:
            seen.append(str(error))
        return 5.0

    outcome, _ = experiment(path, ScriptedRig(), ScriptedPlayer(second))
    assert outcome.is_complete, outcome.reason
    assert "exists; choose another name" in seen[0]
    assert seen[1].endswith("a.csv: another process records into this file")
    assert seen[2].endswith("a.csv: another process records into this file")
    assert len(read_record(path, AERO).time) == 9
    with Recorder(path, AERO, {}, overwrite=True):  # and then it is free again
        pass
    assert len(read_record(path, AERO).time) == 9


def test_a_record_made_meanwhile_is_not_replaced(tmp_path):
    path = tmp_path / "a.csv"
    late = Recorder(path, AERO, {})  # when there is none yet
    experiment(path, ScriptedRig())
    content = path.read_bytes()
    rig = ScriptedRig()
    with pytest.raises(ValueError, match="exists; choose another name"), late, rig:
        pass
    assert path.read_bytes() == content
    assert rig.log == []  # the second does not touch the rig


def test_a_file_that_was_there_is_kept_where_no_experiment_begins(tmp_path):
    path = tmp_path / "a.csv"
    path.touch()
    rig = ScriptedRig(failing={"open": RigError("no card")})
    experiment(path, rig, recorder=Recorder(path, AERO, {}, overwrite=True))
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]
    experiment(tmp_path / "b.csv", rig)
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]


@pytest.mark.science
def test_the_lock_of_a_process_that_was_killed_is_gone(tmp_path):
    with experiment_under_way(tmp_path, 3) as process:
        with (
            pytest.raises(ValueError, match="another process records into this file"),
            Recorder(tmp_path / "r.csv", IDEAL.description, {}, overwrite=True),
        ):
            pass
        process.kill()
        process.wait()
        with Recorder(tmp_path / "r.csv", IDEAL.description, {}, overwrite=True):
            pass


def test_a_record_is_never_a_folder(tmp_path):
    path = tmp_path / "a.csv"
    path.mkdir()
    with pytest.raises(ValueError, match="is a folder"):
        Recorder(path, AERO, {}, overwrite=True)
    assert not path.with_suffix(".json").exists()


# ------------------------------------------------------------------------------ kill -9


@contextlib.contextmanager
def experiment_under_way(folder: Path, num_needed: int) -> Iterator[subprocess.Popen[str]]:
    """`excite run` in real time, some samples in r.csv after its start."""
    time_, inputs = 0.1 * np.arange(300), 4 * np.sin(2 * math.pi * 0.35 * 0.1 * np.arange(300))
    (folder / "u.csv").write_text(csv_text({"time": time_, "voltage": inputs}))
    words = ["run", "--plant", "aero2", "--input", "u.csv", "--out", "r.csv", "--spread", "0.1"]
    program = [sys.executable, "-m", "excite", *words, "--overwrite"]
    environment = {**os.environ, "PYTHONPATH": str(Path(excite.__file__).parent.parent)}
    until, path = time.monotonic() + PATIENCE, folder / "r.csv"
    while time.monotonic() < until:  # a busy computer loses deadlines, which ends an experiment
        path.unlink(missing_ok=True)
        with subprocess.Popen(
            program, cwd=folder, text=True, env=environment,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        ) as process:  # fmt: skip
            try:
                while process.poll() is None and time.monotonic() < until:
                    if path.exists() and path.read_text().count("\n") > num_needed:
                        yield process
                        return
                    time.sleep(0.02)
                out = process.communicate()[0]
                assert "deadlines were missed" in out, out
            finally:
                process.kill()
    pytest.fail("no experiment came so far")


@pytest.mark.science
def test_a_killed_process_leaves_a_record_that_identifies(tmp_path):
    plant, num_needed, path = IDEAL, 45, tmp_path / "r.csv"
    with experiment_under_way(tmp_path, num_needed):
        pass  # which kills it
    assert json.loads(path.with_suffix(".json").read_text())["ended"] is None
    record = read_record(path, plant.description)
    assert len(record.time) >= num_needed
    assert record.starts_at_initial_state
    result = identify([record], plant)
    assert result.status == "successful"
    for name, nominal in plant.nominal._asdict().items():
        assert abs(result.params[name] / float(nominal) - 1) < 0.5


CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second", "wait"),
    [
        (signal.SIGINT, signal.SIGINT, 0.0),
        LONG(signal.SIGTERM, signal.SIGINT, 0.005),
        LONG(signal.SIGINT, signal.SIGTERM, 0.01),
    ],
)
def test_two_signals_are_an_end_as_one_is(first, second, wait, tmp_path):
    with experiment_under_way(tmp_path, 5) as process:
        for number in (first, second, second, second):
            process.send_signal(number)
            time.sleep(wait)
        out, _ = process.communicate(timeout=PATIENCE)
    ended = json.loads((tmp_path / "r.json").read_text())["ended"]
    codes = {f"interrupted by {n.name}": CODES[n] for n in (first, second)}
    assert process.returncode == codes[ended["reason"]]
    assert "Traceback" not in out
    assert "record: r.csv" in out
    assert len(read_record(tmp_path / "r.csv", IDEAL.description).time) >= ended["num_samples"] > 3


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, LONG(signal.SIGTERM), LONG(signal.SIGHUP)])
def test_a_signal_ends_it_with_its_own_code_and_a_whole_record(number, tmp_path):
    with experiment_under_way(tmp_path, 5) as process:
        process.send_signal(number)
        out, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == CODES[number]
    assert "Traceback" not in out
    assert signal.Signals(number).name in out
    ended = json.loads((tmp_path / "r.json").read_text())["ended"]
    assert signal.Signals(number).name in ended["reason"]
    assert len(read_record(tmp_path / "r.csv", IDEAL.description).time) >= ended["num_samples"] > 3
