"""Functional mock-up units as rigs: against the plant they were made from, and what fails."""

import ctypes
import dataclasses
import json
import math
import platform
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fmpy
import jax.numpy as jnp
import numpy as np
import pytest
from pythonfmu import FmuBuilder

from excite.description import Input, Output, Parameter, PlantDescription, State
from excite.plant import Aero2
from excite.record import read_record
from excite.rig import Recorder, RigError, SignalPlayer, run_loop
from excite.rig import fmu as fmu_module
from excite.rig.fmu import FMURig, simulate_fmu
from excite.safety import Supervision, Trip
from excite.simulation import response

PLANT = Aero2()
DESCRIPTION = PLANT.description
INPUTS = np.random.default_rng(0).uniform(-7, 7, (300, 1))
STIFFNESS = {"stiffness": math.prod(c.value for c in DESCRIPTION.constants)}

# The plant takes two Runge-Kutta steps in one dt, the unit 20. A step of h errs by
# (omega h)^5 / 120 of the swing, omega = 0.94 rad/s its frequency: 2e-9 of 0.5 rad, at most
# 600 times over. The wrong parameter, order or time of an input errs by more than 1e-3.
TOLERANCE = 6e-7

runs_pythonfmu = pytest.mark.skipif(
    sys.platform == "darwin" or platform.machine() not in ("x86_64", "AMD64"),
    reason="pythonfmu has libraries for 64-bit Intel under Linux and Windows only",
)


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The body of Aero2 as FMI 2; pythonfmu leaves the folder of its script on the path."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", sys.path[:])
        script = Path(__file__).parent / "pitch_unit.py"
        return FmuBuilder.build_FMU(script, tmp_path_factory.mktemp("unit") / "pitch.fmu")


@pytest.fixture(autouse=True)
def extracted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where units are extracted: nothing may stay there, nor the working directory move."""
    folder, here = tmp_path / "extracted", Path.cwd()
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setattr(sys, "path", sys.path[:])
    yield folder
    assert not list(folder.iterdir())
    assert Path.cwd() == here


class Seen(FMURig):
    """Remembers what was written."""

    written: list[list[float]]

    def write(self, input: np.ndarray) -> None:
        self.written = [*getattr(self, "written", []), input.tolist()]
        super().write(input)


def recorder(tmp_path: Path) -> Recorder:
    return Recorder(tmp_path / "record.csv", DESCRIPTION, {}, overwrite=True)


def played(rig: FMURig, inputs: np.ndarray, tmp_path: Path) -> Any:
    rules = Supervision.of(rig.description)
    with rig, recorder(tmp_path) as record:
        return run_loop(rig, SignalPlayer(inputs), rules, record)


# ------------------------------------------------------------ a unit is a rig like others


@runs_pythonfmu
@pytest.mark.parametrize("num_readings", [1, 5])
def test_an_experiment_on_the_unit_is_that_on_the_plant(
    unit: Path, tmp_path: Path, num_readings: int, capfd: pytest.CaptureFixture[str]
):
    rig = FMURig(unit, DESCRIPTION, start=STIFFNESS, num_readings=num_readings)
    outcome = played(rig, INPUTS, tmp_path)
    assert outcome.is_complete, outcome.reason
    record = read_record(tmp_path / "record.csv", DESCRIPTION)
    expected = np.asarray(response(PLANT, PLANT.nominal, jnp.asarray(INPUTS)))
    assert 0.1 < np.abs(expected).max() < 0.5
    np.testing.assert_allclose(record.outputs, expected, rtol=0, atol=TOLERANCE)
    np.testing.assert_array_equal(record.inputs[:-1], INPUTS)
    sidecar = json.loads((tmp_path / "record.json").read_text())
    facts = sidecar["ended"]["rig"]
    assert facts["fmu"] == "pitch.fmu"
    assert facts["fmi_version"] == "2.0"
    assert facts["start"] == STIFFNESS
    assert len(facts["fmu_hash"]) == 64
    assert capfd.readouterr().out == ""


@runs_pythonfmu
def test_names_start_values_and_variables_inside(unit: Path):
    output = dataclasses.replace(DESCRIPTION.outputs[0], name="speed")
    other = dataclasses.replace(DESCRIPTION, outputs=(output,))
    start = {**STIFFNESS, "K_pu": 0.02, "D_p": 0.01}
    pitch = simulate_fmu(unit, DESCRIPTION, INPUTS, start=start)
    params = PLANT.nominal._replace(K_pu=0.02, D_p=0.01)
    expected = np.asarray(response(PLANT, params, jnp.asarray(INPUTS)))
    np.testing.assert_allclose(pitch, expected, rtol=0, atol=TOLERANCE)
    speed = simulate_fmu(unit, other, INPUTS, names={"speed": "rate"}, start=start)
    assert speed.shape == (301, 1)
    trapezoids = np.cumsum((speed[1:] + speed[:-1]) / 2 * DESCRIPTION.dt)
    assert np.abs(trapezoids - pitch[1:, 0]).max() < 5e-3


@runs_pythonfmu
def test_a_rig_may_be_opened_again_and_two_side_by_side(unit: Path):
    one, two = FMURig(unit, DESCRIPTION), FMURig(unit, DESCRIPTION)
    for _ in range(2):
        with one, two:
            assert one.read().outputs == two.read().outputs == 0
            one.write(np.array([5.0]))
            assert one.read().outputs > 1e-4
            assert two.read().outputs == 0


@runs_pythonfmu
def test_a_real_time_unit_is_paced(unit: Path):
    quick = dataclasses.replace(DESCRIPTION, dt=0.04)
    with FMURig(unit, quick, num_readings=2, is_real_time=True) as rig:
        start, times = time.perf_counter(), []
        for _ in range(11):
            times.append(rig.read().time)
            assert time.perf_counter() - start >= times[-1]
    np.testing.assert_allclose(times, 0.02 * np.arange(11), atol=1e-12)


# ---------------------------------------------------------------- what ends an experiment


@runs_pythonfmu
@pytest.mark.parametrize(("raises", "status"), [(0.0, "discard"), (1.0, "fatal")])
def test_a_unit_that_fails_ends_the_experiment_with_the_reason(
    unit: Path, tmp_path: Path, raises: float, status: str, capfd: pytest.CaptureFixture[str]
):
    start = {**STIFFNESS, "fails_at": 2.05, "raises": raises}
    rig = Seen(unit, DESCRIPTION, start=start)
    outcome = played(rig, INPUTS, tmp_path)
    assert outcome.reason.startswith("pitch.fmu failed at 2.1 s (fmi2DoStep failed")
    assert status in outcome.reason
    assert "\n" not in outcome.reason
    assert isinstance(outcome.error, RigError)
    assert outcome.num_samples == 21
    assert rig.written[-1] == [0.0]
    assert rig._unit is None
    record = read_record(tmp_path / "record.csv", DESCRIPTION)
    assert len(record.outputs) == 21
    assert json.loads((tmp_path / "record.json").read_text())["ended"]["reason"] == outcome.reason
    assert capfd.readouterr().out == ""


@runs_pythonfmu
def test_a_trip_ends_with_the_safe_input_in_the_unit(unit: Path, tmp_path: Path):
    rig = Seen(unit, DESCRIPTION)
    rules = Supervision.of(DESCRIPTION)
    with rig, recorder(tmp_path) as record:
        outcome = run_loop(rig, SignalPlayer(np.full((100, 1), 24.0)), rules, record)
        [reference] = [v.valueReference for v in rig._inputs]
        assert rig._unit.getReal([reference]) == [0.0]
    assert outcome.trip in (Trip.LEVEL, Trip.PREDICTED_LEVEL)
    assert {24.0, 0.0} == {value for row in rig.written for value in row}


# --------------------------------------------------------------------- refused in a sentence


def altered(unit: Path, path: Path, change: Callable[[str, bytes], bytes | None]) -> Path:
    """A copy of a unit with other files."""
    with zipfile.ZipFile(unit) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            content = change(name, old.read(name))
            if content is not None:
                new.writestr(name, content)
    return path


def described(old: str, new: str) -> Callable[[str, bytes], bytes]:
    def change(name: str, content: bytes) -> bytes:
        if name != "modelDescription.xml":
            return content
        assert old.encode() in content
        return content.replace(old.encode(), new.encode())

    return change


def refusal(path: Path, **options: Any) -> str:
    with pytest.raises(ValueError, match=r"\w") as error:
        FMURig(path, DESCRIPTION, **options)
    assert type(error.value) is ValueError
    assert "\n" not in str(error.value)
    return str(error.value)


def test_files_that_are_no_unit(unit: Path, tmp_path: Path):
    path = tmp_path / "bad.fmu"
    assert "cannot be read (No such file or directory)" in refusal(path)
    path.write_text("hello")
    assert "truncated, or no FMU (File is not a zip file)" in refusal(path)
    path.write_bytes(unit.read_bytes()[:-1000])
    assert "truncated, or no FMU" in refusal(path)
    altered(unit, path, lambda n, c: None if n == "modelDescription.xml" else c)
    assert "modelDescription.xml" in refusal(path)
    altered(unit, path, lambda n, c: c[:100] if n == "modelDescription.xml" else c)
    assert "truncated, or no FMU" in refusal(path)
    altered(unit, path, described('causality="input"', 'causality="inwards"'))
    assert "Failed to validate" in refusal(path)


def test_units_of_another_kind(unit: Path, tmp_path: Path):
    def exchanged(name: str, content: bytes) -> bytes:
        content = described("<CoSimulation", "<ModelExchange")(name, content)
        for word in (b"canHandleVariableCommunicationStepSize", b"canInterpolateInputs"):
            content = content.replace(word + b'="true"', b"").replace(word + b'="false"', b"")
        return content

    path = altered(unit, tmp_path / "other.fmu", exchanged)
    assert "export it for co-simulation" in refusal(path)
    altered(unit, path, lambda n, c: None if n.startswith("binaries/linux64") else c)
    if fmpy.platform == "linux64":
        assert "has no library for linux64 (there is win64)" in refusal(path)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"names": {"voltage": "volage"}}, "has no real input 'volage' (there is voltage)"),
        ({"names": {"voltage": "pitch"}}, "has no real input 'pitch' (there is voltage)"),
        ({"names": {"pitch": "angle"}}, "has no real output 'angle' (there is pitch)"),
        ({"names": {"pich": "pitch"}}, "aero2 has no input or output 'pich' (there is pitch)"),
        ({"start": {"K_p": 1.0}}, "has no start value 'K_p' (there is K_pu"),
        ({"start": {"voltage": 1.0}}, "has no start value 'voltage'"),
    ],
)
def test_variables_that_are_not_there(unit: Path, options: dict, sentence: str):
    assert sentence in refusal(unit, **options)


def test_without_fmpy_the_sentence_says_what_to_type(unit: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(fmu_module, "fmpy", None)
    assert refusal(unit) == "an FMU needs FMPy: pip install 'excite[fmu]'"


def test_a_library_that_cannot_be_loaded_leaves_nothing_behind(unit: Path, tmp_path: Path):
    broken = altered(
        unit, tmp_path / "broken.fmu", lambda n, c: b"no program" if n[:9] == "binaries/" else c
    )
    rig = FMURig(broken, DESCRIPTION)
    with pytest.raises(RigError, match=r"broken.fmu could not be started \(Failed to load"), rig:
        pass


# --------------------------------------------------------------------------------- FMI 3

LAG = PlantDescription(
    name="lag",
    states=(State("y", "V"),),
    inputs=(Input("u", "V", -5.0, 5.0),),
    outputs=(Output("y", "V", 1.0),),
    parameters=(Parameter("tau", "s", 0.3),),
    dt=0.1,
    band=(0.1, 5.0),
)
LAG_XML = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="Lag" instantiationToken="lag">
  <CoSimulation modelIdentifier="lag"/>
  <ModelVariables>
    <Float64 name="time" valueReference="9" causality="independent" variability="continuous"/>
    <Float64 name="u" valueReference="0" causality="input" start="0"/>
    <Float64 name="y" valueReference="1" causality="output" initial="exact" start="0"/>
    <Float64 name="tau" valueReference="2" causality="parameter" variability="fixed" start="1"/>
  </ModelVariables>
  <ModelStructure><Output valueReference="1"/></ModelStructure>
</fmiModelDescription>
"""


class LagLibrary:
    """The C functions of a unit with tau y' = u - y, in Python, so that no compiler is needed."""

    def __init__(self, ends_at: float) -> None:
        self.values, self.ends_at, self.called = [0.0, 0.0, 1.0], ends_at, []
        self._handle = ctypes.CDLL(None)._handle  # one that may be closed

    def __getattr__(self, name: str) -> Callable[..., int]:
        answers: dict[str, Callable[..., int]] = {
            "fmi3InstantiateCoSimulation": self.instantiate,
            "fmi3SetFloat64": self.set,
            "fmi3GetFloat64": self.get,
            "fmi3DoStep": self.step,
        }

        def function(*words: Any) -> int:
            self.called.append(name)
            return answers.get(name, lambda *_: 0)(*words)

        if not name.startswith("fmi3"):
            raise AttributeError(name)
        return function

    def instantiate(self, *words: Any) -> int:
        self.say = words[10]
        return 1

    def set(self, _: Any, references: Any, count: int, values: Any, *__: Any) -> int:
        for i in range(count):
            self.values[references[i]] = values[i]
        return 0

    def get(self, _: Any, references: Any, count: int, values: Any, *__: Any) -> int:
        for i in range(count):
            values[i] = self.values[references[i]]
        return 0

    def step(self, _: Any, now: float, step: float, *rest: Any) -> int:
        u, y, tau = self.values
        self.values[1] = u + (y - u) * math.exp(-step / tau)
        if now + step > self.ends_at:
            self.say(None, 1, b"logEvents", b"the lag\nis over.")
            rest[2]._obj.value = True  # asks to terminate
        return 0


@pytest.fixture
def lag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[float], tuple]:
    """A unit of FMI 3, and its library, which asks to end at a time."""
    path = tmp_path / "lag.fmu"
    library = f"binaries/{fmpy.platform_tuple}/lag{fmpy.sharedLibraryExtension}"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("modelDescription.xml", LAG_XML)
        file.writestr(library, b"")

    def made(ends_at: float = math.inf) -> tuple[Path, LagLibrary]:
        library = LagLibrary(ends_at)
        monkeypatch.setattr(ctypes.cdll, "LoadLibrary", lambda path: library)
        return path, library

    return made


def test_fmi_3_units_too(lag: Callable[..., tuple]):
    path, library = lag()
    inputs = np.random.default_rng(1).normal(size=(50, 1))
    outputs = simulate_fmu(path, LAG, inputs, start={"tau": 0.3})
    expected, decay = [0.0], math.exp(-0.1 / 0.3)
    for u in inputs[:, 0]:
        expected.append(u + (expected[-1] - u) * decay)
    np.testing.assert_allclose(outputs[:, 0], expected, rtol=0, atol=1e-14)
    assert library.called[-3:] == ["fmi3SetFloat64", "fmi3Terminate", "fmi3FreeInstance"]
    assert library.values[0] == 0.0


def test_an_fmi_3_unit_may_ask_to_end(lag: Callable[..., tuple]):
    path, library = lag(0.55)
    with pytest.raises(RigError, match=r"lag.fmu failed at 0.6 s \(.+; the lag is over\)$"):
        simulate_fmu(path, LAG, np.ones((50, 1)))
    assert library.called[-1] == "fmi3FreeInstance"
    assert "fmi3Terminate" not in library.called
