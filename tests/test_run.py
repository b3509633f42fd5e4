"""`excite run`: exit codes, what is written and what is not, refusals, and life without JAX."""

import json
import math
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import PATIENCE, REPEATS

import excite
from excite.cli import main
from excite.estimation.identify import identify
from excite.excitation import Chirp
from excite.files import csv_text
from excite.plant import Aero2, Aero2Detailed
from excite.policy import read_policy, shipped_policies
from excite.record import read_record
from excite.rig import Recorder, Stop, session
from excite.rig.live_estimate import LiveEstimate

AERO = Aero2Detailed.definition
TESTS = Path(__file__).parent
POLICIES = shipped_policies()

OWN_RIG = """
import numpy as np
from excite.rig import AbstractRig, Reading, RigError


class Still(AbstractRig):
    num_readings, is_real_time = 2, False

    def open(self):
        self.n = -1

    def read(self):
        self.n += 1
        return Reading(self.n * self.description.dt / 2, np.array([0.001 * self.n]))

    def write(self, input):
        pass

    def close(self):
        pass

    def facts(self):
        return {"own": self.n}


class Absent(Still):
    def open(self):
        raise RigError("nobody at home")


class Clinging(Still):
    def close(self):
        raise RigError("the card does not answer")


class Foreign(Still):
    def __init__(self):
        from excite.plant import DCMotor
        self.description = DCMotor().description


class Loud(Still):
    def open(self):
        raise ZeroDivisionError("it was touched")


class Ended(Still):
    def read(self):
        if self.n == 20:
            raise SystemExit(3)
        return super().read()


class EndedTwice(Ended):
    def close(self):
        raise RigError("the card does not answer")


class Stopped(Still):
    def close(self):
        raise GeneratorExit


class Half(AbstractRig):
    def open(self):
        pass


class Other:
    pass
"""


class NoEstimate(LiveEstimate):
    """In place of the live estimate, which compiles for long."""

    @property
    def latest(self):
        return {}

    def __init__(self, *_):
        pass

    def __call__(self, sample):
        pass

    def close(self):
        pass


@pytest.fixture
def call(tmp_path, capsys, monkeypatch):
    """`excite run` in this process, in an empty folder: exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(session, "LiveEstimate", NoEstimate)
    (tmp_path / "own.py").write_text(OWN_RIG)
    inputs = 3 * np.sin(0.25 * np.arange(30))
    (tmp_path / "u.csv").write_text(csv_text({"time": 0.1 * np.arange(30), "voltage": inputs}))

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["excite", "run", *map(str, words)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ending:
            main()
        return (int(ending.value.code or 0), *capsys.readouterr())

    return run


FAST = ("--fast", "--out", "r.csv")


@pytest.mark.slow
def test_an_experiment_that_completes_is_one_json_object_and_a_record(call):
    code, out, err = call("--input", "u.csv", *FAST, "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert set(told) == {
        "file", "live_estimate", "reason", "trip", "num_samples", "max_abs_output",
        "late_ms_percentiles", "missed_deadlines", "rig", "player",
    }  # fmt: skip
    assert told["reason"] == "complete"
    assert (told["trip"], told["num_samples"], told["missed_deadlines"]) == ("none", 29, 0)
    assert set(told["rig"]["true_params"]) == {"J_p", "K_pu", "D_p"}
    record = read_record("r.csv", AERO)
    assert len(record.time) == 30
    assert record.metadata["provenance"]["played"] == "u.csv"
    assert record.metadata["ended"] == {
        key: value for key, value in told.items() if key not in ("file", "live_estimate")
    }


@pytest.mark.science
@pytest.mark.parametrize("seed", [3])
def test_what_ran_on_the_rig_identifies_its_hidden_parameters(seed, call):
    """The path of an engineer, with the rig's own policy and plant, then with the paper's."""
    code, out, _ = call("--rig", "simulated", "--seed", seed, *FAST, "--json")
    told = json.loads(out)
    assert (code, told["trip"]) == (0, "none")
    assert told["rig"]["true_max_abs_output"][0] < AERO.outputs[0].critical_level
    record = read_record("r.csv", AERO)
    found = identify([record], Aero2Detailed())
    for name, true in told["rig"]["true_params"].items():
        assert abs(found.params[name] / true - 1) < 0.002
        assert abs(found.params[name] - true) < 2.6 * found.std_error[name]  # 99 %
    wrong = identify([read_record("r.csv", Aero2.definition)], Aero2())
    assert wrong.structure["pitch"] < 0.01
    assert wrong.verdict[0].endswith("was made with plant 'aero2_detailed', not with 'aero2'")
    assert "structure" in wrong.verdict[1]


def test_a_trip_is_a_failed_run_that_is_recorded_and_explained(call):
    words = ("--policy", "aero2-ppo-all", "--steps", 60, "--fault", "dropout=0.99999")
    code, out, err = call(*words, *FAST)
    assert code == 1
    assert "did not change" in out
    assert "next: excite identify r.csv --plant aero2_detailed" in out
    assert "Traceback" not in err
    assert read_record("r.csv", AERO).metadata["ended"]["trip"] == "stale"


def test_a_dry_run_writes_and_sends_nothing(call, tmp_path):
    before = sorted(tmp_path.iterdir())
    code, out, _ = call("--input", "u.csv", "--dry-run", "--json", "--out", "r.csv")
    assert code == 0
    told = json.loads(out)
    assert told["num_steps"] == 29
    assert told["inputs"]["voltage"]["largest"] == pytest.approx(3.0, abs=0.05)
    assert call("--rig", "own.py:Absent", "--input", "u.csv", "--dry-run")[0] == 0
    assert sorted(tmp_path.iterdir()) == before


def test_a_record_is_replaced_only_where_that_is_wanted(call, tmp_path):
    words = ("--rig", "own.py:Still", "--input", "u.csv", "--out", "r.csv", "--steps")
    assert call(*words, 5)[0] == 0
    code, _, err = call(*words, 6)
    assert code == 2
    assert "--overwrite" in err
    assert len(read_record("r.csv", AERO).time) == 6
    assert call(*words, 6, "--overwrite")[0] == 0
    assert len(read_record("r.csv", AERO).time) == 7


SIGNAL = ("--input", "u.csv")
REFUSALS = {
    "no record": (SIGNAL, "--out FILE.csv is missing"),
    "record of another kind": ((*SIGNAL, "--out", "r.mat"), "line by line"),
    "record in no folder": ((*SIGNAL, "--out", "no/r.csv"), "does not exist"),
    "rig": ((*SIGNAL, *FAST, "--rig", "lego"), "unknown rig 'lego'"),
    "policy": ((*FAST, "--policy", "best"), "unknown policy 'best'"),
    "plant": ((*SIGNAL, *FAST, "--plant", "aero3"), "aero3"),
    "policy of another plant": ((*FAST, "--policy", "emps"), "emps"),
    "two players": ((*SIGNAL, *FAST, "--policy", "aero2-ppo-all"), "exclude each other"),
    "policy and excitation": (
        (*FAST, "--policy", "aero2-ppo-all", "--excitation", "chirp"), "exclude each other",
    ),
    "excitation": ((*FAST, "--excitation", "chrip"), "did you mean 'chirp'"),
    "options of nothing": ((*FAST, "--set", "amplitude=1"), "--set needs an --excitation"),
    "option of an excitation": (
        (*FAST, "--excitation", "loop-multisine", "--set", "gain=-1"), "must not be negative",
    ),
    "excitation on another rig": (
        ("--out", "r.csv", "--excitation", "chirp", "--rig", "own.py:Foreign"),
        "the rig is of 'dc_motor'",
    ),
    "fault": ((*SIGNAL, *FAST, "--fault", "wind=0.1"), "unknown fault of a simulated rig 'wind'"),
    "fault of no number": ((*SIGNAL, *FAST, "--fault", "latency=nan"), "is not allowed"),
    "negative fault": ((*SIGNAL, *FAST, "--fault", "dropout=-0.1"), "is not allowed"),
    "latency": ((*SIGNAL, *FAST, "--fault", "latency=0.2"), "must be less than the sampling time"),
    "slew": ((*SIGNAL, *FAST, "--slew", "-1"), "the slew limit must be positive"),
    "steps": ((*SIGNAL, *FAST, "--steps", 30), "was made for 29 steps"),
    "steps of a policy": (
        (*FAST, "--policy", "aero2-ppo-all", "--steps", 501), "was made for 500 steps",
    ),
    "no file of steps": ((*FAST, "--input", "v.csv"), "no such file"),
    "unit": ((*SIGNAL, *FAST, "--rig", "no.fmu"), "no.fmu"),
    "own rig without file": ((*SIGNAL, *FAST, "--rig", "no.py:Still"), "no such file"),
    "a fault of a real rig": (
        (*SIGNAL, "--rig", "quanser", "--fault", "dropout=0.1", "--dry-run"),
        "--fault is an option of a simulated rig, not of 'quanser'",
    ),
    "a real rig in a hurry": (
        (*SIGNAL, "--rig", "own.py:Still", "--fast", "--dry-run"),
        "--fast is an option of a simulated rig",
    ),
    "own rig without class": ((*SIGNAL, *FAST, "--rig", "own.py:Quick"), "no rig class 'Quick'"),
    "own rig that is none": ((*SIGNAL, *FAST, "--rig", "own.py:Other"), "Other in own.py is no"),
    "own rig half made": ((*SIGNAL, *FAST, "--rig", "own.py:Half"), "not a complete rig"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSALS)
def test_a_bad_option_is_one_sentence_and_exit_code_2(call, tmp_path, name):
    words, sentence = REFUSALS[name]
    code, out, err = call(*words)
    assert (code, out) == (2, ""), err
    lines = [line for line in err.splitlines() if not line.startswith("warning:")]
    assert len(lines) == 1
    assert lines[0].startswith("excite: ")
    assert sentence in lines[0]
    assert not (tmp_path / "r.csv").exists()
    assert not (tmp_path / "r.json").exists()


@pytest.mark.parametrize(("numbers", "sentence"), [
    ({"spread": math.nan}, "such as factor:3: got nan"),
    ({"spread": math.inf}, "such as factor:3: got inf"),
    ({"spread": -0.1}, "such as factor:3: got -0.1"),
    ({"seed": -1}, "seed must be a whole number from 0 to 9223372036854775807: got -1"),
    ({"seed": 10**30}, "seed must be a whole number"),
    ({"steps": 0}, "steps must be a whole number from 2 to 10000000: got 0"),
    ({"steps": 10**30}, "steps must be a whole number"),
    ({"slew": math.nan}, "the slew limit must be positive: got nan"),
    ({"slew": 0.0}, "the slew limit must be positive: got 0"),
    ({"fault": {"latency": math.inf}}, "--fault latency=inf is not allowed"),
])  # fmt: skip
def test_a_number_that_is_none_is_refused_by_the_function_too(call, tmp_path, numbers, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        session.run("simulated", signal="u.csv", fast=True, out="r.csv", **numbers)
    assert not list(tmp_path.glob("r.*"))


def test_a_policy_without_a_checksum_is_played_with_a_warning(call, tmp_path):
    content = POLICIES["aero2_detailed"].read_bytes()
    (entry,) = re.findall(rb',"sha256":"[0-9a-f]{64}"', content)
    old = content.replace(entry, b" " * len(entry))
    assert len(old) == len(content) > len(entry)
    (tmp_path / "old.safetensors").write_bytes(old)
    done = bare(tmp_path, "--rig", "quanser", "--policy", "old.safetensors", "--dry-run", "--json")
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines() == [
        JAX_IS_MISSING.strip(),
        "warning: old.safetensors: has no checksum, so that damage is not seen; saved again it "
        "has one",
    ]
    (tmp_path / "flipped.safetensors").write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    code, out, err = call("--policy", "flipped.safetensors", *FAST)
    assert (code, out) == (2, "")
    assert err == (
        "excite: flipped.safetensors: damaged: its content does not match its checksum\n"
    )


def test_a_class_of_ones_own_is_a_rig(call):
    code, out, err = call("--rig", "own.py:Still", *SIGNAL, "--out", "r.csv", "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["rig"] == {"own": 58}
    assert len(read_record("r.csv", AERO).time) == 30


def test_a_rig_that_does_not_open_is_a_failed_run(call, tmp_path):
    code, out, err = call("--rig", "own.py:Absent", *SIGNAL, "--out", "r.csv")
    assert (code, out) == (1, "")
    assert err == "excite: the rig failed: nobody at home\n"
    assert not (tmp_path / "r.csv").exists()


def test_a_rig_that_is_not_released_hides_no_outcome(call):
    code, out, _ = call("--rig", "own.py:Clinging", *SIGNAL, "--out", "r.csv", "--json")
    assert code == 1
    told = json.loads(out)
    expected = "complete; the rig was not released: the card does not answer"
    assert told["reason"] == expected
    assert told["num_samples"] == 29
    assert read_record("r.csv", AERO).metadata["ended"]["reason"] == expected


@pytest.mark.parametrize(("name", "reason", "code"), [
    ("Ended", "SystemExit: 3", 3),
    ("EndedTwice", "SystemExit: 3; the rig was not released: the card does not answer", 3),
])  # fmt: skip
def test_who_ends_the_program_ends_it_after_the_record(call, name, reason, code):
    assert call("--rig", f"own.py:{name}", *SIGNAL, "--out", "r.csv")[0] == code
    record = read_record("r.csv", AERO)
    assert record.metadata["ended"]["reason"] == reason
    assert record.metadata["ended"]["num_samples"] == len(record.time) == 11


def test_an_end_of_the_program_while_the_rig_is_released_goes_on(call):
    with pytest.raises(GeneratorExit):
        session.run("own.py:Stopped", signal="u.csv", out="r.csv")
    reason = read_record("r.csv", AERO).metadata["ended"]["reason"]
    assert reason == "complete; the rig was not released: GeneratorExit"


@pytest.mark.parametrize("error", [SystemExit(0), GeneratorExit()])
def test_an_excitation_that_ends_the_program_is_recorded(call, error):
    def end(sample):
        if sample.k == 4:
            raise error

    with pytest.raises(type(error)):
        session.run("own.py:Still", signal="u.csv", out="r.csv", on_sample=end)
    ended = read_record("r.csv", AERO).metadata["ended"]
    assert ended["reason"].startswith(type(error).__name__)
    assert ended["num_samples"] == 5


def test_a_program_can_ask_for_the_end(call):
    stop = Stop()

    def ask(sample):
        if sample.k == 4:
            stop.ask("the door was opened")

    result = session.run("own.py:Still", signal="u.csv", out="r.csv", on_sample=ask, stop=stop)
    assert result.outcome.reason == "the door was opened"
    assert result.outcome.num_samples == 5


def test_after_an_experiment_a_signal_does_not_change_the_exit_code(call):
    assert call("--rig", "own.py:Still", *SIGNAL, "--out", "r.csv")[0] == 0
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        assert signal.getsignal(number) == signal.SIG_IGN


def test_a_function_gives_signals_back(call):
    before = signal.getsignal(signal.SIGTERM)
    session.run("own.py:Still", signal="u.csv", out="s.csv")
    assert signal.getsignal(signal.SIGTERM) == before


def test_the_second_process_on_a_record_is_refused(call, tmp_path):
    first = Recorder(Path("r.csv"), AERO, {})
    with first:
        first.begin()
        before = (tmp_path / "r.csv").read_bytes(), (tmp_path / "r.json").read_bytes()
        code, out, err = call("--rig", "own.py:Loud", *SIGNAL, "--out", "r.csv", "--overwrite")
        assert (code, out) == (2, "")
        assert err == "excite: r.csv: another process records into this file\n"
        assert before == ((tmp_path / "r.csv").read_bytes(), (tmp_path / "r.json").read_bytes())


def test_a_filter_says_how_often_it_intervened(call):
    code, out, _ = call(*SIGNAL, *FAST, "--filter", "--json")
    assert code == 0
    quiet = {"filter_interventions": 0, "filter_without_safe_input": 0}
    assert json.loads(out)["player"] == quiet


@pytest.mark.science
def test_a_position_loop_is_played_recorded_and_identified(call):
    words = ("--excitation", "loop-multisine", "--set", "amplitude=0.4,gain=16", "--seed", 5)
    code, out, err = call(*words, *FAST, "--steps", 160, "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert (told["reason"], told["num_samples"]) == ("complete", 160)
    record = read_record("r.csv", AERO)
    provenance = record.metadata["provenance"]
    assert provenance["played"] == "loop-multisine"
    assert provenance["options"] == {"amplitude": 0.4, "gain": 16}
    found = identify([record], Aero2Detailed())
    for name, true in told["rig"]["true_params"].items():
        assert abs(found.params[name] / true - 1) < 0.01


def test_an_excitation_may_be_a_policy_or_a_file(call):
    told = {}
    for words in (("--excitation", "aero2-ppo-all"), ("--policy", "aero2-ppo-all")):
        code, out, err = call(*words, *FAST, "--steps", 8, "--json", "--overwrite")
        assert code == 0
        assert err.startswith("warning: aero2-ppo-all: the policy was trained on 'aero2'")
        told[words[0]] = json.loads(out)
    assert told["--excitation"] == told["--policy"]
    code, out, _ = call("--excitation", "u.csv", "--dry-run", "--json")
    assert (code, json.loads(out)["num_steps"]) == (0, 29)


def test_run_is_a_function_of_the_library(call, tmp_path):
    seen = []
    result = session.run(
        excitation=Chirp(amplitude=5.0), out="r.csv", fast=True, steps=20, on_sample=seen.append
    )
    assert result.outcome.is_complete
    assert [s.k for s in seen] == list(range(20))
    np.testing.assert_array_equal(result.record.inputs[:-1, 0], [s.input[0] for s in seen])
    shown = repr(result)
    assert shown.startswith("aero2_detailed, ")
    assert "ended" in shown
    assert max(map(len, shown.splitlines())) <= 80
    assert all(f"<td>{cell}</td>" in result._repr_html_() for row in result.rows() for cell in row)
    dry = session.run(dry_run=True, steps=20, policy=read_policy("aero2_detailed"))
    assert dry.inputs.shape == (20, 1)
    assert "nothing is sent" in repr(dry)
    assert f"<td>{dry.rows()[0][1]}</td>" in dry._repr_html_()
    with pytest.raises(ValueError, match="must be recorded"):
        session.run(fast=True)


# ------------------------------------------------------------------------- without JAX

NOTHING_ELSE = """
import sys

ALLOWED = {"excite", "numpy", "safetensors", "click", "rich", "pygments", "markdown_it",
           "mdurl", "quanser", *sys.stdlib_module_names}


class Absent:
    def find_spec(self, name, path=None, target=None):
        first = name.partition(".")[0]
        if first not in ALLOWED and not first.startswith("_"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Absent())
"""


def bare(folder, *words):
    """`excite run` on a computer that has NumPy and little else."""
    (folder / "hook").mkdir(exist_ok=True)
    (folder / "hook" / "sitecustomize.py").write_text(NOTHING_ELSE)
    source = Path(excite.__file__).parent.parent
    places = (folder / "hook", TESTS / "standin", source)
    return subprocess.run(
        [sys.executable, "-m", "excite", "run", *map(str, words)], cwd=folder, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, places))},
        capture_output=True, text=True, timeout=PATIENCE,
    )  # fmt: skip


JAX_IS_MISSING = "JAX is not installed: the live estimate and the filter are off\n"


@pytest.mark.parametrize("words", [("--policy", "aero2-ppo-all"), SIGNAL])
def test_a_laboratory_computer_runs_without_jax(call, tmp_path, words):
    words = ("--rig", "quanser", *words, "--out", "r.csv", "--steps", 20, "--json", "--overwrite")
    done = bare(tmp_path, *words)
    for _ in range(REPEATS):
        if '"trip": "deadlines"' not in done.stdout:
            break
        done = bare(tmp_path, *words)
    assert done.stderr.startswith(JAX_IS_MISSING)
    assert done.returncode == 0, done.stdout
    told = json.loads(done.stdout)
    assert told["reason"] == "complete"
    assert told["live_estimate"] == {}
    assert len(read_record(tmp_path / "r.csv", AERO).time) == 21


@pytest.mark.parametrize(("words", "sentence"), [
    ((*SIGNAL, "--rig", "simulated"), "need JAX, which is not installed"),
    ((*SIGNAL, "--rig", "quanser", "--filter"), "--filter needs JAX, which is not installed"),
    (("--excitation", "chirp", "--rig", "quanser"), "--excitation needs JAX, which is not"),
])  # fmt: skip
def test_what_needs_jax_says_so(call, tmp_path, words, sentence):
    done = bare(tmp_path, *words, "--out", "r.csv")
    assert done.returncode == 2
    assert sentence in done.stderr
    assert len(done.stderr.splitlines()) == 2
    assert not (tmp_path / "r.csv").exists()
