"""The Aero 2 over HIL, against a strict stand-in of the interface with a body behind it."""

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from catalogue import TwoMasses
from commands import PATIENCE, REPEATS
from standin.quanser import hardware as standin

from excite.plant import Aero2Detailed
from excite.record import read_record
from excite.rig import AbstractPlayer, Recorder, RigError, SignalPlayer, quanser, run_loop
from excite.rig.quanser import QuanserAero2
from excite.safety import Supervision, Trip

AERO = Aero2Detailed.definition
RULES = Supervision.of(AERO)
VIRTUAL = "0@tcpip://localhost:18950"
STANDIN = Path(__file__).parent / "standin"

OPENING = [
    "open",
    "watchdog_clear",
    "write_analog",
    "set_encoder_counts",
    *["read_encoder"] * 10,
    "task_create_encoder_reader",
    "task_set_buffer_overflow_mode",
    "write_digital",
]
STARTING = ["watchdog_set_analog_expiration_state", "watchdog_start", "task_start"]
READING = ["task_read_encoder", "watchdog_reload"]
CLOSING = ["write_analog", "write_digital", "watchdog_stop", "task_stop", "task_delete", "close"]


@pytest.fixture
def card(monkeypatch):
    """A device at rest; at the end, nothing was asked of it that its interface does not allow."""
    device = standin.Device()
    monkeypatch.setattr(standin, "device", device)
    monkeypatch.setattr(quanser, "hardware", standin)
    monkeypatch.setattr(quanser, "sleep", lambda seconds: standin.device.wait(seconds))
    monkeypatch.setattr(quanser, "BufferOverflowMode", standin.BufferOverflowMode)
    yield device
    assert device.misuses == []


def rig_of(address="0", description=AERO):
    rig = QuanserAero2(description, address)
    rig.is_real_time = False  # the stand-in's readings come at once
    return rig


class Failing(AbstractPlayer):
    """Drives, and from step 2 on does something else."""

    num_steps = 5

    def __init__(self, then):
        self._then = then

    def __call__(self, k, measured):
        return np.array([5.0]) if k < 2 else self._then()


def experiment(path, player, address="0") -> tuple[Any, RigError | None]:
    """As a user runs it: the outcome, or the error that left the rig."""
    outcome = None
    try:
        with rig_of(address) as rig, Recorder(path, AERO, {}) as recorder:
            outcome = run_loop(rig, player, RULES, recorder)
    except RigError as error:
        return outcome, error
    return outcome, None


def names(card):
    return [name for name, _ in card.calls]


def said(card, name):
    return [arguments for called, arguments in card.calls if called == name]


def is_released(card):
    """Whether the motors are off and nothing is held."""
    return not card.voltages.any() and not card.enabled.any() and not card.resources


def num_recorded(path):
    return len(read_record(path, AERO).inputs)


# -------------------------------------------------------------------- one experiment


def test_the_calls_of_an_experiment_come_in_order(card, tmp_path):
    outcome, error = experiment(tmp_path / "a.csv", SignalPlayer(np.full((3, 1), 6.0)))
    assert error is None
    assert outcome.is_complete, outcome.reason
    step = ["write_analog", *(READING * 50)]
    ending = ["write_analog"] * 3  # at the last instant, at the end, and the rig's own
    assert names(card) == [*OPENING, *STARTING, *READING, *(step * 3), *ending, *CLOSING]
    assert said(card, "open") == [{"card": "quanser_aero2_usb", "identifier": "0"}]
    assert said(card, "write_digital") == [{"bits": [1, 1]}, {"bits": [0, 0]}]
    assert said(card, "set_encoder_counts") == [{"counts": [0, 0, 0, 0]}]
    assert said(card, STARTING[0]) == [{"volts": [0.0, 0.0]}]
    assert said(card, "task_start") == [{"clock": 0, "frequency": 500.0, "samples": 2**32 - 1}]
    assert is_released(card)
    assert num_recorded(tmp_path / "a.csv") == 4  # the last one is the measurement at the end


def test_the_second_motor_has_the_opposite_voltage(card, tmp_path):
    inputs = np.array([[6.0], [-24.0], [24.0]])
    experiment(tmp_path / "a.csv", SignalPlayer(inputs))
    volts = [arguments["volts"] for arguments in said(card, "write_analog")]
    assert volts[1:4] == [[6.0, -6.0], [-24.0, 24.0], [24.0, -24.0]]
    assert not np.any([volts[0], *volts[4:]])


def test_a_reading_is_the_pitch_in_radians_by_the_clock_of_the_card(card):
    card.pitch, card.offsets, card.is_held = 0.2, np.array([5, 6, 700, 8]), True
    with rig_of() as rig:
        card.is_held = False
        card.wait(0.4)  # until somebody reads: neither a burst afterwards nor a watchdog
        before = card.pitch
        first = rig.read()
        rig.write(np.array([24.0]))
        readings = [rig.read() for _ in range(500)]
        # Zero is where it was opened.
        assert first.outputs == pytest.approx([before - 0.2], abs=0.003)
        assert readings[-1].outputs == pytest.approx([card.pitch - 0.2], abs=0.003)
    assert (first.time, readings[0].time, readings[-1].time) == (0.0, 1 / 500, 1.0)
    steps = np.array([r.outputs[0] for r in readings]) / (2 * math.pi / 2880)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert abs(steps[-1]) > 20
    assert readings[0].outputs is not readings[1].outputs


def test_a_push_turns_the_body_to_where_the_plant_says(card, tmp_path):
    path = tmp_path / "a.csv"
    experiment(path, SignalPlayer(np.full((10, 1), 12.0)))
    pitch = read_record(path, AERO).outputs[:, 0]
    assert pitch[-1] == pytest.approx(0.5 * 2 * 0.0125 * 12.0, rel=0.15)  # a t² / 2 after 1 s


def test_without_the_amplifiers_the_body_would_not_move(card):
    with rig_of() as rig:
        rig.read()
        card.enabled[:] = 0
        rig.write(np.array([24.0]))
        assert not any(rig.read().outputs for _ in range(300))


@pytest.mark.parametrize(("address", "mode"), [("0", 1), (VIRTUAL, 3)])
def test_what_happens_on_overflow_depends_on_the_address(card, tmp_path, address, mode):
    _, error = experiment(tmp_path / "a.csv", SignalPlayer(np.zeros((1, 1))), address)
    assert error is None
    assert said(card, "task_set_buffer_overflow_mode") == [{"mode": mode}]
    assert said(card, "open")[0]["identifier"] == address


def test_a_stall_overwrites_samples_of_hardware_and_halts_the_virtual_device(card):
    for address, num_lost in (("0", 1), (VIRTUAL, 0)):
        with rig_of(address) as rig:
            rig.read()
            card.timeout, card.num_lost = math.inf, 0
            card.wait(3.0)
            times = [rig.read().time for _ in range(501)]
            assert (card.num_lost > 0) == num_lost
            assert times == pytest.approx(np.arange(1, 502) / 500)


def test_a_record_can_say_how_the_rig_was_read(card, tmp_path):
    experiment(tmp_path / "a.csv", SignalPlayer(np.zeros((1, 1))), VIRTUAL)
    facts = json.loads((tmp_path / "a.json").read_text())["ended"]["rig"]
    assert facts["card"] == "quanser_aero2_usb"
    assert facts["address"] == VIRTUAL
    assert facts["reading_rate"] == 500


def test_a_rig_can_be_opened_again(card, tmp_path):
    rig = rig_of()
    for _ in range(2):
        with rig:
            assert rig.read().time == 0
            assert rig.read().time == 1 / 500
        assert is_released(card)


# ----------------------------------------------------------------------- it goes wrong


@pytest.mark.parametrize("error", [ValueError("no idea"), KeyboardInterrupt()])
def test_an_error_of_the_player_ends_in_zero_and_released_hardware(card, tmp_path, error):
    def fail():
        raise error

    outcome, _ = experiment(tmp_path / "a.csv", Failing(fail))
    assert outcome.error is error
    assert is_released(card)
    assert names(card)[-6:] == CLOSING
    assert num_recorded(tmp_path / "a.csv") == 2


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_number_that_is_none_ends_in_zero_and_released_hardware(card, tmp_path, number):
    outcome, _ = experiment(tmp_path / "a.csv", Failing(lambda: np.array([number])))
    assert outcome.trip == Trip.INPUT_NOT_FINITE
    assert is_released(card)
    assert num_recorded(tmp_path / "a.csv") == 3


@pytest.mark.slow
def test_a_failure_at_any_single_call_still_releases_everything(card, tmp_path, monkeypatch):
    player = SignalPlayer(np.full((2, 1), 6.0))
    experiment(tmp_path / "clean.csv", player)
    assert is_released(card)
    seen = Counter()
    for index, name in enumerate(names(card)):
        device = standin.Device()
        device.failing = lambda i, _, index=index: i == index
        monkeypatch.setattr(standin, "device", device)
        path = tmp_path / f"{index}.csv"
        outcome, error = experiment(path, player)
        where = f"{name}, call {index}"
        assert names(device)[index] == name
        assert device.misuses == [], where
        _check_the_end(device, name, where)
        if name == "watchdog_clear":  # there may be nothing to clear
            assert outcome is not None
            assert outcome.is_complete
            continue
        sentence = str(error) if error else outcome.reason if outcome else ""
        assert f"{name} of the Aero 2 failed: error -1 at call {index}" in sentence, where
        assert "\n" not in sentence
        assert path.exists() == (index >= len(OPENING)), where
        if path.exists():
            lines = path.read_text().splitlines()
            assert lines[0] == "time,voltage,pitch,clock"
            assert len(lines) < 3 or num_recorded(path) == len(lines) - 1  # two make a record
            assert json.loads(path.with_suffix(".json").read_text())["ended"] is not None
        seen[name] += 1
    assert set(seen) == {*OPENING, *STARTING, *READING, *CLOSING} - {"watchdog_clear"}


def _check_the_end(device, failed, where):
    """What was taken is given back, in order; what is left is what the failed call did not do."""
    taken_by = dict.fromkeys(CLOSING, "open")
    taken_by |= {"watchdog_stop": "watchdog_start", "task_stop": "task_start"}
    taken_by |= {"task_delete": "task_create_encoder_reader"}
    taken = set(names(device)) - {failed}
    expected = [name for name in CLOSING if taken_by[name] in taken]
    assert names(device)[len(names(device)) - len(expected) :] == expected, where
    left = {"close": {"open"}, "watchdog_stop": {"watchdog"}}
    assert device.resources == left.get(failed, set()), where
    assert not (device.voltages * device.enabled).any(), where
    # One failure leaves at most one of the two guards open.
    assert not device.enabled.any() or failed == "write_digital", where
    assert not device.voltages.any() or failed == "write_analog", where


@pytest.mark.parametrize("name", sorted({*OPENING, *STARTING, *READING, *CLOSING}))
def test_a_call_that_always_fails_stops_nothing_else(card, tmp_path, name):
    card.failing = lambda _, called: called == name
    outcome, error = experiment(tmp_path / "a.csv", SignalPlayer(np.full((2, 1), 6.0)))
    if name == "watchdog_clear":
        assert error is None
        assert outcome.is_complete
    else:
        told = [str(error), outcome.reason if outcome else ""]
        assert any(f"{name} of the Aero 2 failed" in sentence for sentence in told)
    assert not (card.voltages * card.enabled).any()
    if name != "open":
        assert names(card)[-1] == "close"


def test_two_failures_while_closing_are_told_by_the_first(card):
    rig = rig_of()
    rig.open()
    rig.read()
    card.failing = lambda _, name: name in ("write_digital", "task_stop")
    with pytest.raises(RigError, match="write_digital"):
        rig.close()
    assert names(card)[-6:] == CLOSING
    assert card.resources == set()
    rig.close()  # nothing is left to be done
    assert names(card)[-6:] == CLOSING


def test_the_watchdog_stays_where_it_is_the_last_guard(card):
    rig = rig_of()
    rig.open()
    rig.read()
    rig.write(np.array([24.0]))
    card.failing = lambda _, name: name in ("write_analog", "write_digital")
    with pytest.raises(RigError, match="write_analog"):
        rig.close()
    assert "watchdog_stop" not in names(card)
    card.wait(0.6)
    assert not card.voltages.any()


def test_a_body_that_still_swings_is_not_zeroed(card, tmp_path):
    card.pitch = 0.3
    outcome, error = experiment(tmp_path / "a.csv", SignalPlayer(np.zeros((1, 1))))
    assert outcome is None
    assert "not at rest" in str(error)
    assert is_released(card)
    assert not (tmp_path / "a.csv").exists()


def test_an_interrupt_while_closing_stops_nothing_else(card, monkeypatch):
    def interrupted(self, *_):
        raise KeyboardInterrupt

    rig = rig_of()
    rig.open()
    rig.read()
    monkeypatch.setattr(standin.HIL, "write_analog", interrupted)
    with pytest.raises(KeyboardInterrupt):
        rig.close()
    assert is_released(card)


def test_a_task_that_has_ended_is_an_error(card):
    with rig_of() as rig:
        rig.read()
        rig._card._num_left = 0
        with pytest.raises(RigError, match="its task has ended"):
            rig.read()


# ---------------------------------------------------------------------- the watchdog


def test_the_watchdog_stops_motors_that_nobody_reads(card):
    rig = rig_of()
    rig.open()
    rig.read()
    rig.write(np.array([24.0]))
    started = card.now
    card.abandon()  # killed
    card.wait(0.45)
    assert card.fired_at is None
    assert card.voltages.tolist() == [24.0, -24.0]
    card.wait(0.1)
    assert card.fired_at == pytest.approx(started + quanser.WATCHDOG_TIMEOUT, abs=0.005)
    assert not card.voltages.any()
    assert abs(card.pitch) < 0.09
    card.pitch, card.is_held = 0.0, True
    with rig_of() as again:  # the card of a process that was killed is no lost card
        again.read()
        again.write(np.array([3.0]))
        assert card.voltages.tolist() == [3.0, -3.0]
    assert is_released(card)


def test_a_watchdog_that_has_fired_ends_the_experiment_with_a_sentence(card, tmp_path):
    class Hanging(AbstractPlayer):
        num_steps = 4

        def __call__(self, k, measured):
            if k == 2:
                card.wait(0.7)
            return np.array([5.0])

    outcome, error = experiment(tmp_path / "a.csv", Hanging())
    # The card accepts nothing any more, not even zero.
    assert "write_analog of the Aero 2 failed" in outcome.reason
    assert isinstance(error, RigError)
    assert not card.voltages.any()
    assert card.resources == {"watchdog"}  # which the next opening clears
    assert num_recorded(tmp_path / "a.csv") == 2


def test_a_reading_after_the_watchdog_fired_is_no_reading(card):
    rig = rig_of()
    rig.open()
    rig.read()
    card.wait(0.7)
    with pytest.raises(RigError, match=r"stopped the motors: no reading for 0\.5 s"):
        rig.read()
    with pytest.raises(RigError):
        rig.close()
    assert card.resources == {"watchdog"}
    with rig_of() as again:
        again.read()
    assert is_released(card)


def test_a_watchdog_that_cannot_be_cleared_is_found_at_the_next_call(card):
    card.fired_at, card.is_watchdog_clearable = 0.0, False
    with pytest.raises(RigError, match="write_analog of the Aero 2 failed: error -watchdog"):
        rig_of().__enter__()
    assert card.resources == set()


KILLED = """
import json, sys
from pathlib import Path
import numpy as np
from excite.description import PlantDescription
from excite.rig import Recorder, SignalPlayer, run_loop
from excite.rig.quanser import QuanserAero2
from excite.safety import Supervision

aero = PlantDescription.from_dict(json.loads(Path(sys.argv[1]).read_text()))
with QuanserAero2(aero) as rig, Recorder(Path(sys.argv[2]), aero, {}, True) as recorder:
    signal = SignalPlayer(np.full((int(sys.argv[3]), 1), 2.0))
    outcome = run_loop(rig, signal, Supervision.of(aero), recorder)
print(outcome.reason, sorted({"jax", "equinox"} & set(sys.modules)))
"""


@pytest.fixture
def process(tmp_path):
    """An experiment in a process of its own, in real time, with the stand-in as the SDK."""
    (tmp_path / "aero.json").write_text(json.dumps(AERO.to_dict()))
    started = []

    def start(num_steps):
        paths = [str(STANDIN), str(Path(quanser.__file__).parents[2])]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(paths),
            "STANDIN_LOG": str(tmp_path / "log"),
        }
        arguments = [str(tmp_path / "aero.json"), str(tmp_path / "a.csv"), str(num_steps)]
        command = [sys.executable, "-c", KILLED, *arguments]
        started.append(
            subprocess.Popen(
                command,
                env=environment,
                text=True,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
            )
        )
        return started[-1]

    yield start
    for each in started:
        each.kill()
        each.wait()
        each.stdout.close()


def test_a_killed_process_leaves_a_watchdog_that_runs_and_a_record(process, tmp_path):
    running, path = process(300), tmp_path / "a.csv"
    until = time.monotonic() + PATIENCE
    while not (path.exists() and path.read_text().count("\n") > 5):
        assert running.poll() is None, running.communicate()[0]
        assert time.monotonic() < until
        time.sleep(0.02)
    running.send_signal(signal.SIGKILL)
    running.wait()
    log = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    told = [name for _, name, _ in log]
    assert not {"watchdog_stop", "close", "task_stop"} & set(told)
    volts = [arguments["volts"] for _, name, arguments in log if name == "write_analog"]
    assert volts[-1] == [2.0, -2.0]
    # All that the card needs to stop the motors by itself it has been told before it was driven.
    assert told.index("watchdog_start") < len(told) - told[::-1].index("write_analog") - 1
    assert said_in(log, "watchdog_set_analog_expiration_state") == [{"volts": [0.0, 0.0]}]
    assert said_in(log, "watchdog_start") == [{"timeout": 0.5}]
    assert num_recorded(path) >= 5
    assert json.loads(path.with_suffix(".json").read_text())["ended"] is None


def test_an_experiment_in_real_time_needs_numpy_alone(process):
    text = "deadlines"
    for _ in range(REPEATS):
        text, _ = process(4).communicate(timeout=PATIENCE)
        if not text.startswith("deadlines"):
            break
    assert text.split("\n")[0] == "complete []", text


def said_in(log, name):
    return [arguments for _, called, arguments in log if called == name]


# -------------------------------------------------------------------------- refusals


def test_the_sensor_is_the_encoder_whatever_sensor_the_plant_was_given_with():
    (pitch,) = AERO.outputs
    ideal = dataclasses.replace(AERO, outputs=(dataclasses.replace(pitch, resolution=0.0),))
    assert rig_of(description=ideal).description.outputs[0].resolution == 2 * math.pi / 2880
    coarse = dataclasses.replace(AERO, outputs=(dataclasses.replace(pitch, resolution=0.01),))
    assert rig_of(description=coarse).description == coarse


def test_without_quansers_package_one_sentence_says_where_it_comes_from(monkeypatch):
    monkeypatch.setattr(quanser, "hardware", None)
    rig = QuanserAero2(AERO)
    with pytest.raises(RigError, match="comes with Quanser's SDK, not from a package index") as e:
        rig.__enter__()
    assert "\n" not in str(e.value)
    rig.close()


@pytest.mark.parametrize("voltage", [24.001, -25.0, math.nan, math.inf, -math.inf])
def test_a_voltage_beyond_the_limits_is_refused(card, voltage):
    with rig_of() as rig:
        rig.read()
        rig.write(np.array([7.0]))
        with pytest.raises(RigError, match="must be from -24 to 24 V"):
            rig.write(np.array([voltage]))
        assert card.voltages.tolist() == [7.0, -7.0]


def test_the_limits_are_those_of_the_plant(card):
    narrow = dataclasses.replace(AERO.inputs[0], lower=-10.0, upper=10.0)
    with rig_of(description=dataclasses.replace(AERO, inputs=(narrow,))) as rig:
        rig.read()
        with pytest.raises(RigError, match="must be from -10 to 10 V"):
            rig.write(np.array([12.0]))


def test_motors_do_not_turn_before_the_watchdog_runs(card):
    with rig_of() as rig:
        with pytest.raises(RigError, match="must be read before it is driven"):
            rig.write(np.array([1.0]))
        rig.write(np.array([0.0]))
        assert "watchdog_start" not in names(card)


@pytest.mark.parametrize(("dt", "num_readings"), [(0.1, 50), (0.02, 10), (0.002, 1)])
def test_the_number_of_readings_is_that_of_500_hz(dt, num_readings):
    assert QuanserAero2(dataclasses.replace(AERO, dt=dt)).num_readings == num_readings


@pytest.mark.parametrize("dt", [0.001, 0.003, 0.1001])
def test_a_sampling_time_between_readings_is_refused(dt):
    with pytest.raises(ValueError, match=r"multiple of 0\.002 s"):
        QuanserAero2(dataclasses.replace(AERO, dt=dt))


def test_a_plant_that_is_no_aero_2_is_refused():
    with pytest.raises(ValueError, match="one input of at most 24 V and one output"):
        QuanserAero2(TwoMasses.definition)
    strong = dataclasses.replace(AERO.inputs[0], upper=30.0)
    with pytest.raises(ValueError, match="at most 24 V"):
        QuanserAero2(dataclasses.replace(AERO, inputs=(strong,)))


# ----------------------------------------------------------------- the stand-in itself


@pytest.mark.parametrize(
    "wrong",
    [
        lambda hil, c: hil.write_analog(c.astype(np.int32), 2, np.zeros(2)),
        lambda hil, c: hil.write_analog(c, 1, np.zeros(2)),
        lambda hil, c: hil.write_analog(c + 1, 2, np.zeros(2)),
        lambda hil, c: hil.write_analog(c, 2, np.zeros(2, np.float32)),
        lambda hil, c: hil.write_analog(c, 2, np.array([25.0, 0.0])),
        lambda hil, c: hil.write_digital(c, 2, np.zeros(2)),
        lambda hil, c: hil.set_encoder_counts(c, 2, np.zeros(2)),
        lambda hil, c: hil.watchdog_reload(),
        lambda hil, c: hil.task_start(None, 0, 500.0, 9),
        lambda hil, c: hil.open("quanser_aero2_usb", "0"),
        lambda hil, c: standin.HIL("quanser_aero_usb", "0"),
        lambda hil, c: standin.HIL().write_analog(c, 2, np.zeros(2)),
    ],
)
def test_the_stand_in_is_strict(card, wrong):
    hil = standin.HIL("quanser_aero2_usb", "0")
    with pytest.raises(standin.MisuseError):
        wrong(hil, np.array([0, 1], np.uint32))
    assert card.misuses
    card.misuses.clear()
