import contextlib
import csv
import json
import math
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
import pytest
from commands import PATIENCE
from documented import documented, documented_words
from experiments import NUM_STEPS

from excite.cli import cli, completion, main
from excite.cli.options import Lines, progress_bar
from excite.cli.study import running, study
from excite.estimation.catalogue import ESTIMATORS
from excite.excitation.catalogue import EXCITATIONS
from excite.files import read_columns
from excite.plant import Aero2
from excite.plant.catalogue import PLANTS
from excite.policy import Layout, Policy, read_policy, shipped_policies
from excite.progress import SHOWN
from excite.record import read_record
from excite.report.numbers import number
from excite.study.catalogue import studies

TESTS = Path(__file__).parent
COMMANDS = tuple(cli.commands)

STUDY = """
name = "tiny"
title = "A tiny study"
plant = "aero2"
episodes = 1000
num_steps = 60

[methods.random]
excitation = "random"

[methods.prbs]
excitation = "prbs"
clock = 5

[estimators.arx-rls]
kind = "arx-rls"

[reference.prbs]
relative_error_percent = { J_p = [2.57, 2.73], K_pu = [3.42, 1.64], D_p = [1065, 936] }
max_abs_output = [20.4, 9.1]
violations = "2/100"
"""

OWN_PLANT = """
import jax.numpy as jnp

from excite.estimation import NLS
from excite.excitation.contract import AbstractShape, AbstractSignal
from excite.description import Input, Output, Parameter, PlantDescription, State
from excite.plant import AbstractPlant


class Tank(AbstractPlant):
    definition = PlantDescription(
        name="tank",
        states=(State("level", "m"),),
        inputs=(Input("flow", "m³/s", 0.0, 1.0),),
        outputs=(Output("level_m", "m", 1.0, noise_sd=0.001),),
        parameters=(Parameter("area", "m²", 2.0), Parameter("leak", "m²/s", 0.3)),
        dt=0.5,
        band=(0.01, 0.5),
    )

    def derivative(self, state, input, params):
        return (input - params.leak * state) / params.area

    def output(self, state, params):
        return state


class Broken(Tank):
    def derivative(self, state, input, params):
        return a_name_that_is_nowhere


class Swapped(Tank):
    def derivative(self, state, params, input):
        return (input - params.leak * state) / params.area


class Steady(AbstractShape):
    def shape(self, plant, num_steps, key):
        return jnp.ones((num_steps, 1))


class Level(AbstractSignal):
    level: float

    def sequence(self, plant, num_steps, key):
        return jnp.full((num_steps, 1), self.level)


class Doubtful(NLS):
    pass
"""


class Answer(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The one JSON object of stdout; anything beside it is an error."""
        return json.loads(self.out)


Run = Callable[..., Answer]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """The command line in this process: exit code, stdout, stderr."""
    monkeypatch.delenv("FORCE_COLOR", raising=False)

    def call(*words: object) -> Answer:
        monkeypatch.setattr(sys, "argv", ["excite", *map(str, words)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ending:
            main()
        out, err = capsys.readouterr()
        return Answer(int(ending.value.code or 0), out, err)

    return call


def excite(*words: object, folder: Path, **settings: str) -> Answer:
    """The command line as a program of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "excite", *map(str, words)],
        cwd=folder, env={**os.environ, **settings}, capture_output=True, text=True,
        check=False, timeout=PATIENCE,
    )  # fmt: skip
    return Answer(done.returncode, done.stdout, done.stderr)


def spoiled(good: str, **cells: str) -> str:
    """A CSV file whose fifth sample is another: pitch="nan"."""
    lines = good.splitlines()
    header, row = lines[0].split(","), lines[5].split(",")
    lines[5] = ",".join(cells.get(name, value) for name, value in zip(header, row, strict=True))
    return "\n".join(lines) + "\n"


def scaled(good: str, **factors: float) -> str:
    rows = list(csv.DictReader(good.splitlines()))
    shown = [",".join(repr(float(r[n]) * factors.get(n, 1.0)) for n in r) for r in rows]
    return "\n".join([",".join(rows[0]), *shown]) + "\n"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with good and bad files; no test writes to it."""
    folder = tmp_path_factory.mktemp("files")
    with pytest.MonkeyPatch.context() as patch:
        words = ["simulate", "aero2", "--steps", str(NUM_STEPS)]
        for name in ("good.csv", "good.mat"):
            out = ["--out", str(folder / name)]
            patch.setattr(sys, "argv", ["excite", *words, *out])
            with pytest.raises(SystemExit) as ending:
                main()
            assert not ending.value.code
    good = (folder / "good.csv").read_text()
    texts = {
        "column.csv": good.replace("pitch", "theta", 1),
        "missing.csv": spoiled(good, voltage=""),
        "nan.csv": spoiled(good, voltage="nan"),
        "text.csv": spoiled(good, voltage="on"),
        "uneven.csv": spoiled(good, time="0.43"),
        "gap.csv": "\n".join(good.splitlines()[:50] + good.splitlines()[53:]) + "\n",
        "unit.csv": scaled(good, voltage=1000.0),
        "loud.csv": scaled(good, voltage=4.0),
        "notes.json": '{"mine": 1}',
        "short.csv": "\n".join(good.splitlines()[:6]) + "\n",
        "silent.csv": scaled(good, pitch=0.0),
        "rest.csv": scaled(good, voltage=0.0, pitch=0.0),
        "truncated.csv": good[: good.rindex(",")],
        "empty.csv": "",
        "header.csv": good.splitlines()[0] + "\n",
        "long.csv": "a" * 200_000 + "\n",
        "backwards.csv": scaled(good, time=-1.0),
        "deep.csv": good,
        "deep.json": "[" * 100_000,
        "digits.csv": spoiled(good, pitch="7" * 5000),
        "sidecar.csv": good,
        "sidecar.json": '{"kind": "excite record", "plant',
        "hand.csv": good,
        "hand.json": '{"kind": "excite record", "starts_at_initial_state": true, "plant": "aero2"}',
        "foreign.csv": good,
        "slow.csv": "\n".join([good.splitlines()[0], *good.splitlines()[1::2]]) + "\n",
        "study.toml": STUDY,
        "key.toml": STUDY.replace("episodes", "episode"),
        "option.toml": STUDY.replace("clock", "clok"),
        "method.toml": STUDY.replace('excitation = "random"', 'excitation = "radnom"'),
        "plant.toml": STUDY.replace("aero2", "aero3"),
        "invalid.toml": "methods = [",
        "own.py": OWN_PLANT,
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    mat = (folder / "good.mat").read_bytes()
    (folder / "truncated.mat").write_bytes(mat[: len(mat) // 2])
    (folder / "pickle.mat").write_bytes(pickle.dumps({"time": 0}))
    (folder / "hdf5.mat").write_bytes(
        b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400)
    )
    (folder / "binary.csv").write_bytes(bytes(range(256)) * 10)
    (folder / "mine.csv").mkdir()
    (folder / "mine").mkdir()
    (folder / "mine" / "thesis.tex").write_text("years of work")
    return folder


@pytest.fixture
def here(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder: a copy of those files."""
    folder = tmp_path / "here"
    shutil.copytree(files, folder)
    monkeypatch.chdir(folder)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


# Help


def test_help_opens_without_what_computes():
    program = (
        "import sys\n"
        "from excite.cli import cli, main\n"
        "for words in [[], *([name] for name in cli.commands)]:\n"
        "    sys.argv = ['excite', *words, '--help']\n"
        "    try:\n"
        "        main()\n"
        "    except SystemExit as ending:\n"
        "        assert not ending.code\n"
        "slow = {'jax', 'numpy', 'scipy', 'matplotlib', 'pydantic', 'rich'} & set(sys.modules)\n"
        "assert not slow, slow\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Usage: ") == 1 + len(COMMANDS)


def completed(words: str) -> list[str]:
    """What a shell offers after these words, without importing what computes."""
    program = (
        "import sys\n"
        "from excite.cli import main\n"
        "try:\n"
        "    main()\n"
        "finally:\n"
        "    slow = {'jax', 'numpy', 'pydantic', 'rich'} & set(sys.modules)\n"
        "    assert not slow, slow\n"
    )
    count = len(words.split(" ")) - 1
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False,
        env={**os.environ, "__C_COMPLETE": "bash_complete", "COMP_WORDS": words,
             "COMP_CWORD": str(count)},
    )  # fmt: skip
    assert done.stderr == ""
    return [line.removeprefix("plain,") for line in done.stdout.splitlines()]


@pytest.mark.parametrize(("words", "names"), [
    ("excite simulate aero2_", ["aero2_lag", "aero2_detailed"]),
    ("excite simulate aero2 --excitation loop-m", ["loop-multisine"]),
    ("excite evaluate aero2-d", ["aero2-damping"]),
    ("excite benchmark x.toml --estimators nls,dec", ["nls,decrement"]),
    ("excite study run tab", ["table1"]),
    ("excite identify x.csv --plant my_", ["file,my_"]),
])  # fmt: skip
def test_a_shell_completes_names(words, names):
    assert completed(words) == names


def test_names_that_a_shell_completes_are_those_of_the_catalogues():
    assert completion.plants() == list(PLANTS)
    assert completion.excitations() == [*EXCITATIONS, *(f"loop-{name}" for name in EXCITATIONS)]
    assert completion.estimators() == list(ESTIMATORS)
    assert set(completion.policies()) == set(shipped_policies())
    assert set(completion.studies()) == set(studies())


def test_commands_are_those_that_are_promised():
    assert set(COMMANDS) >= {
        "plants",
        "simulate",
        "identify",
        "information",
        "benchmark",
        "study",
        "doctor",
    }
    for command in cli.commands.values():
        group = command.commands if isinstance(command, click.Group) else {"": command}
        for single in group.values():
            assert "--json" in {opt for p in single.params for opt in p.opts}
        assert command.help
        assert "Example:" in (command.epilog or "")


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """The file of a small policy for aero2."""
    description, rng = Aero2().description, np.random.default_rng(0)
    layout = Layout.of(description, 3, 40)
    weights = ((rng.normal(size=(1, layout.size)), np.zeros(1)),)
    path = tmp_path / "policy.safetensors"
    path.write_bytes(Policy(description, layout, weights).to_bytes())
    return path


def test_a_policy_is_an_excitation_like_any_other(run, policy, tmp_path):
    record = tmp_path / "record.csv"
    words = ("simulate", "aero2", "--excitation", policy, "--steps", 40, "--out", record)
    assert run(*words).code == 0
    origin = json.loads(record.with_suffix(".json").read_text())["provenance"]
    assert origin["policy_hash"] == read_policy(policy).hash
    assert "warning" not in origin
    answer = run(*words, "--noise", "pitch=0.001", "--overwrite")
    assert answer.err.startswith("warning: the policy was trained on another 'aero2'")
    for command in ("simulate", "information"):
        told = run(command, *words[1:4], "--noise", "pitch=0.001", "--json")
        shown = json.loads(told.out)
        assert len(shown["warnings"]) == (2 if command == "information" else 1)  # its level
        assert told.err == "".join(f"warning: {sentence}\n" for sentence in shown["warnings"])
        assert shown["num_steps"] == 40  # the policy's
    assert "warning" in json.loads(record.with_suffix(".json").read_text())["provenance"]
    assert run("information", "aero2", "--excitation", policy, "--steps", 40).code == 0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("emps",), "trained for the input 'voltage'"),
        (("aero2", "--steps", 41), "policy.safetensors was made for 40 steps: got 41"),
        (("aero2", "--steps", 40, "--set", "amplitude=3"), "a policy has no options"),
    ],
)
def test_a_policy_that_may_not_excite_is_one_sentence(run, policy, words, sentence):
    answer = run("simulate", *words, "--excitation", policy)
    assert answer.code == 2
    assert sentence in answer.err
    assert answer.err.count("\n") == 1


def test_without_a_command_help_is_shown(run):
    answer = run()
    assert answer.code == 0
    assert "Usage:" in answer.out
    assert answer.err == ""


def test_the_version_is_shown(run):
    assert run("--version") == (0, "excite, version 0.1.0\n", "")


# One JSON object


JSON_COMMANDS = (
    "plants",
    "plants dc_motor",
    f"simulate aero2 --steps {NUM_STEPS}",
    f"information aero2 --steps {NUM_STEPS}",
    "information aero2 good.csv",
    "identify good.csv --plant aero2",
    "benchmark study.toml --episodes 8",
    "doctor",
)


@pytest.mark.parametrize("words", JSON_COMMANDS)
def test_json_is_one_object_with_documented_keys_and_nothing_else(words, run, here):
    before = contents(here)
    answer = run(*words.split(), "--json")
    assert answer.code == 0
    assert answer.err == ""
    assert isinstance(answer.json, dict)
    command = words.split()[0].replace("benchmark", "evaluate")  # the same keys
    assert set(answer.json) <= documented_words(command)
    assert contents(here) == before


def test_a_progress_bar_goes_to_stderr_of_a_terminal_alone(run, here, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # counts as a terminal
    answer = run("benchmark", "study.toml", "--episodes", 8, "--json")
    assert "tiny" in answer.err
    assert len(answer.json["rows"]) == 2


def test_where_stderr_is_no_terminal_lines_tell_how_far_it_is(monkeypatch, capsys):
    def told(step: str) -> str:
        """The first line about this step."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            for line in capsys.readouterr().err.splitlines():
                if step in line:
                    return line
            time.sleep(0.02)
        raise TimeoutError(step)

    monkeypatch.setenv("EXCITE_PROGRESS", "0.05")
    with Lines("designing") as lines:
        lines.update("trial 1 of 4", 0, 4)
        assert re.fullmatch(r"designing: trial 1 of 4, \d+ s so far", told("trial 1"))
        lines.update("trial 2 of 4", 1, 4)
        assert re.fullmatch(r"designing: trial 2 of 4, 25 %, \d+ s so far", told("trial 2"))
        lines.update("trial 3 of 4", 2, 4)
        assert re.fullmatch(r"designing: trial 3 of 4, 50 %, \d+ s left", told("trial 3"))


def test_the_time_left_counts_neither_start_up_nor_earlier_work(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("excite.progress.time.monotonic", lambda: now[0])
    lines = Lines("resumed")
    for now[0], done, words in (
        (0.0, 0.80, "80 %, 0 s so far"),
        (20.0, 0.75, "75 %, 20 s so far"),  # from its checkpoint
        (50.0, 0.80, "80 %, 50 s so far"),  # compiled
        (60.0, 0.85, "85 %, 30 s left"),
        (70.0, 0.90, "90 %, 20 s left"),
        (80.0, float("nan"), "80 s so far"),
        (95.0, float("nan"), "2 min so far"),
        (99.0, 0.90, "90 %, 2 min so far"),
    ):
        lines.update("", done, 1.0)
        assert lines.line() == f"resumed, {words}"


def test_a_function_of_the_library_shows_a_line_every_ten_seconds(monkeypatch, capsys):
    now = [100.0]
    monkeypatch.setattr("excite.progress.time.monotonic", lambda: now[0])
    monkeypatch.setenv("EXCITE_PROGRESS", "10")
    for _ in range(2):  # two computations, one after the other
        began = now[0]
        for seconds, done in ((0, 0), (4, 1), (11, 2), (19, 3), (22, 4)):
            now[0] = began + seconds
            SHOWN("update", done, 8)
        assert capsys.readouterr().err.splitlines() == [
            "update, 25 %, 42 s left",
            "update, 50 %, 24 s left",
        ]
        now[0] += 1000
    monkeypatch.setenv("EXCITE_PROGRESS", "0")
    SHOWN("update", 5, 8)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("text", ["ten", "-1", "inf", "nan"])
def test_seconds_between_lines_that_are_no_number_are_refused(monkeypatch, text):
    monkeypatch.setenv("EXCITE_PROGRESS", text)
    with pytest.raises(ValueError, match=f"EXCITE_PROGRESS must be .* got '{text}'"):
        Lines("designing")
    monkeypatch.setenv("EXCITE_PROGRESS", "")  # as if it were not there
    assert Lines("designing").line().startswith("designing")


# Plants, doctor


def test_plants_lists_what_is_shipped(run):
    answer = run("plants")
    assert all(f"{name} " in answer.out for name in PLANTS)
    listed = run("plants", "--json").json["plants"]
    assert [p["name"] for p in listed] == list(PLANTS)
    assert [p["hash"] for p in listed] == [kind.definition.hash for kind in PLANTS.values()]


def test_plants_tells_all_of_one(run, here, monkeypatch):
    chosen = {name: EXCITATIONS[name] for name in ("chirp", "square")}  # to save time
    monkeypatch.setattr("excite.excitation.catalogue.EXCITATIONS", chosen)
    answer = run("plants", "aero2", "--plot", here / "p.png")
    for word in ("J_p", "0.0232", "kg m²", "-24 to 24", "40 deg", "30 deg", "Langschwert"):
        assert word in answer.out
    assert (here / "p.png").stat().st_size > 10_000


def test_doctor_names_packages_devices_and_extras(run):
    found = run("doctor", "--json").json
    assert found["devices"]
    assert found["packages"]["jax"]
    assert None not in found["packages"].values()
    assert "dev" in found["extras"]
    for name, extra in found["extras"].items():
        assert extra["installed"] == (extra["missing"] == [])
        assert extra["install"] == f"pip install 'excite[{name}]'"
    shown = run("doctor").out
    assert all(word in shown for word in ("jax", "extras", "dev", found["python"]))


# Simulate, information, identify


def test_a_simulated_record_is_what_was_asked_for(run, here):
    words = "simulate aero2 --excitation prbs --set amplitude=5,clock=4 --steps 200 --seed 3"
    answer = run(*words.split(), "--params", "J_p=0.02", "--out", "r.csv", "--json")
    record = read_record(here / "r.csv", Aero2.definition)
    assert set(record.inputs[:, 0].tolist()) == {-5.0, 5.0}
    assert len(record.time) == 201
    assert record.starts_at_initial_state
    assert record.metadata["params"] == {"J_p": 0.02, "K_pu": 0.0125, "D_p": 0.00104}
    assert record.metadata["provenance"]["seed"] == 3
    assert answer.json["file"] == "r.csv"
    assert answer.json["params"] == record.metadata["params"]
    assert answer.json["crest_factor"] == {"voltage": pytest.approx(1)}
    largest = np.max(np.abs(record.outputs))
    assert answer.json["max_abs_output"]["pitch"] == pytest.approx(largest, abs=1e-3)


def test_a_seed_gives_the_same_file_and_another_another(run, here):
    for name, seed in (("a.csv", 1), ("b.csv", 1), ("c.csv", 2)):
        run("simulate", "aero2", "--steps", NUM_STEPS, "--seed", seed, "--out", name)
    a, b, c = ((here / f"{name}.csv").read_text() for name in "abc")
    assert a == b
    assert a != c


def test_a_record_is_replaced_only_when_told_to(run, here):
    words = ["simulate", "aero2", "--steps", NUM_STEPS, "--seed", 8, "--out", "good.csv"]
    before = (here / "good.csv").read_text()
    assert run(*words).code == 2
    assert (here / "good.csv").read_text() == before
    assert run(*words, "--overwrite").code == 0
    assert (here / "good.csv").read_text() != before


def test_a_simulation_that_diverges_is_a_failed_run(run, here):
    before = contents(here)
    answer = run(
        "simulate", "aero2", "--steps", NUM_STEPS, "--params", "J_p=1e-9", "--out", "r.csv"
    )
    assert answer.code == 1
    assert "diverged" in answer.err
    assert answer.err.count("\n") == 1
    assert contents(here) == before


def test_a_recorded_input_is_replayed(run, here):
    run("simulate", "aero2", "good.csv", "--out", "again.csv")
    good = read_record(here / "good.csv", Aero2.definition)
    again = read_record(here / "again.csv", Aero2.definition)
    np.testing.assert_array_equal(again.inputs, good.inputs)
    np.testing.assert_array_equal(again.outputs, good.outputs)  # and the same seed


def test_a_violation_is_said(run, here):
    calm = run("simulate", "aero2", "--steps", NUM_STEPS)
    assert "safe" in calm.out
    loud = ["simulate", "aero2", "--steps", NUM_STEPS, "--set", "amplitude=24"]
    assert "VIOLATION" in run(*loud).out
    assert run(*loud, "--json").json["is_violation"] is True
    assert "critical level 40.0 deg" in run(*loud).out.replace("40 deg", "40.0 deg")


def test_noise_and_resolution_are_those_of_the_options(run, here):
    words = ["simulate", "aero2", "--steps", NUM_STEPS]
    run(*words, "--noise", "pitch=0", "--resolution", "pitch=0.01", "--out", "r.csv")
    pitch = read_record(here / "r.csv", Aero2.definition).outputs / 0.01
    np.testing.assert_allclose(pitch, np.round(pitch), atol=1e-9)
    sidecar = json.loads((here / "r.json").read_text())
    assert sidecar["plant"]["outputs"][0]["resolution"] == 0.01


def test_each_input_gets_its_own_amplitude(run, here):
    plant = f"{TESTS / 'catalogue.py'}:TwoMasses"
    words = ["simulate", plant, "--excitation", "prbs", "--set", "amplitude=[1,2],clock=2"]
    answer = run(*words, "--steps", 50, "--out", "r.csv")
    assert answer.err == ""
    columns = np.loadtxt(here / "r.csv", delimiter=",", skiprows=1).T
    assert set(columns[1]) == {-1.0, 1.0}
    assert set(columns[2]) == {1.0, 5.0}  # around the middle of 0 to 6 N


def test_what_information_promises_identification_keeps(run, here):
    """The bound at the true parameters against the standard errors of a fit."""
    bound = run("information", "aero2", "good.csv", "--json").json
    found = run("identify", "good.csv", "--plant", "aero2", "--json").json
    assert bound["initial_state"] == found["initial_state"] == "known"
    assert bound["num_steps"] == NUM_STEPS
    assert found["status"] == "successful"
    for name, p in found["params"].items():
        assert p["std_error"] == pytest.approx(bound["params"][name]["cramer_rao_bound"], rel=0.2)
        assert abs(p["estimate"] - bound["params"][name]["value"]) < 4 * p["std_error"]


def test_the_table_shows_the_numbers_of_the_json(run, here):
    words = ("identify", "good.csv", "--plant", "aero2")
    found, shown = run(*words, "--json").json, run(*words).out
    for name, p in found["params"].items():
        line = next(line for line in shown.splitlines() if line.strip().startswith(f"{name} "))
        assert p["unit"] in line
        assert number(p["std_error"]) in line
        estimate = float(line.split(p["unit"])[1].split()[0])
        assert abs(estimate - p["estimate"]) < p["std_error"] / 10
    assert f"fit {number(found['fit_percent']['pitch'], 4)} %" in shown
    assert found["verdict"][0] in shown
    assert "largest correlation" in shown


def test_foreign_names_and_units_are_mapped(run, here):
    rows = list(csv.DictReader((here / "good.csv").read_text().splitlines()))
    lines = ["t,u,deg"] + [
        f"{r['time']},{r['voltage']},{math.degrees(float(r['pitch']))!r}" for r in rows
    ]
    (here / "other.csv").write_text("\n".join(lines) + "\n")
    own = run("identify", "good.csv", "--plant", "aero2", "--initial-state", "free", "--json")
    words = ["--column", "time=t,voltage=u", "--column", "pitch=deg"]
    scale = ["--scale", f"pitch={math.pi / 180!r}"]
    other = run("identify", "other.csv", "--plant", "aero2", *words, *scale, "--json")
    assert other.json["initial_state"] == "free"
    for name, p in own.json["params"].items():
        assert other.json["params"][name]["estimate"] == pytest.approx(p["estimate"], rel=1e-9)


@pytest.mark.science
def test_a_log_of_another_program_gives_the_same_parameters(run, here):
    rows = list(csv.DictReader((here / "good.csv").read_text().splitlines()))
    lines = ["# a log; of 3 columns", "t;u;w", "[ms];[mV];[deg]"] + [
        f"{1000 * float(r['time'])!r};{1000 * float(r['voltage'])!r};"
        f"{math.degrees(float(r['pitch']))!r}".replace(".", ",")
        for r in rows
    ]
    (here / "log.txt").write_text("\n".join(lines), encoding="utf-8")
    options = ["--plant", "aero2", "--initial-state", "free", "--json"]
    own = run("identify", "good.csv", "--rows", ":150", *options)
    words = "identify log.txt --column voltage=u,pitch=w --unit voltage=mV,pitch=deg --rows 1:151"
    for clock in ("--column time=t --unit time=ms", "--dt 0.1"):
        other = run(*words.split(), *clock.split(), *options)
        assert other.code == 0, other.err
        for name, p in own.json["params"].items():
            assert other.json["params"][name]["estimate"] == pytest.approx(p["estimate"], rel=1e-6)


def test_a_run_folder_and_a_figure_are_left(run, here):
    words = "identify foreign.csv --plant aero2 --validate good.csv --out runs/one --plot fit.svg"
    answer = run(*words.split(), "--json")
    assert answer.code == 0
    assert {f.name for f in (here / "runs" / "one").iterdir()} >= {
        "record.csv", "record.json", "simulated.csv", "residual.csv", "estimate.json",
        "information.json", "run.json",
    }  # fmt: skip
    assert json.loads((here / "runs" / "one" / "estimate.json").read_text()) == answer.json
    assert [v["file"] for v in answer.json["validation"]] == ["good.csv"]
    assert answer.json["validation"][0]["fit_percent"]["pitch"] > 99
    assert "pitch [deg]" in (here / "fit.svg").read_text()
    again = run(*words.split())
    assert again.code == 2
    assert "--overwrite" in again.err
    assert run(*words.split(), "--overwrite").code == 0
    assert [f.name for f in (here / "runs").iterdir()] == ["one"]


def test_the_run_folder_names_the_estimator_as_the_command_line_does(run, here):
    words = "identify good.csv --plant aero2 --estimator arx-rls-wide --out one --json"
    answer = run(*words.split())
    assert answer.json["estimator"] == "arx-rls-wide"
    assert json.loads((here / "one" / "estimate.json").read_text()) == answer.json


@pytest.fixture
def decay(run: Run, here: Path) -> str:
    """A record in which the plant swings freely: the second half of one with a late pulse."""
    time = 0.1 * np.arange(2 * NUM_STEPS + 1)
    pulse = 7.0 * ((time > 16) & (time < 0.1 * NUM_STEPS))
    np.savetxt(
        "pulse.csv", np.column_stack([time, pulse]), delimiter=",", header="time,voltage",
        comments="",
    )  # fmt: skip
    run("simulate", "aero2", "pulse.csv", "--out", "whole.csv")
    lines = (here / "whole.csv").read_text().splitlines()
    (here / "decay.csv").write_text("\n".join([lines[0], *lines[NUM_STEPS + 1 :]]) + "\n")
    return "decay.csv"


def test_what_a_free_decay_cannot_tell_is_held_and_named(run, decay):
    words = ("identify", decay, "--plant", "aero2")
    answer = run(*words)
    assert answer.code == 0
    assert "partly identifiable" in answer.out
    assert "(held)" in answer.out
    assert "K_pu is not identifiable from the data; K_pu was held at 0.0125" in answer.out
    found = run(*words, "--json").json
    assert found["params"]["K_pu"]["std_error"] is None
    assert found["fit_percent"]["pitch"] > 99


def test_a_failed_estimate_is_shown_and_ends_with_1(run, decay, here):
    words = ("identify", decay, "--plant", "aero2", "--estimator", "arx-rls")
    answer = run(*words, "--plot", "fit.png")
    assert answer.code == 1
    assert "ill conditioned" in answer.out
    assert "the data do not determine all parameters" in answer.out
    assert (here / "fit.png").is_file()
    assert run(*words, "--json").json["status"] == "ill conditioned"


# Benchmark


@pytest.mark.slow
def test_a_benchmark_leaves_table_and_study(run, here):
    words = "benchmark study.toml --episodes 8 --out runs/tiny --plot b.png --json"
    answer = run(*words.split())
    folder = here / "runs" / "tiny"
    assert {f.name for f in folder.iterdir()} >= {
        "table.md", "table.csv", "table.json", "study.json", "run.json",
    }  # fmt: skip
    rows = answer.json["rows"]
    assert json.loads((folder / "table.json").read_text()) == answer.json
    assert [(r["method"], r["estimator"]) for r in rows] == [
        ("random", "arx-rls"), ("prbs", "arx-rls"),
    ]  # fmt: skip
    elsewhere = {"bound_by_length", "on_rig", "expected_gain"}
    assert all(set(r) | elsewhere == documented("evaluate") for r in rows)
    assert "| prbs | as published |" in (folder / "table.md").read_text()
    table = list(csv.DictReader((folder / "table.csv").read_text().splitlines()))
    assert [float(line["evaluations"]) for line in table] == [8, 8]
    assert json.loads((folder / "study.json").read_text())["num_steps"] == 60
    assert (here / "b.png").stat().st_size > 10_000


def test_a_benchmark_shows_its_table_and_what_was_inferred(run, here):
    study = STUDY.replace("num_steps", 'inferred = ["the sensor noise"]\nnum_steps')
    (here / "study.toml").write_text(study)
    answer = run("benchmark", "study.toml", "--episodes", 8)
    assert answer.err == ""
    for words in ("A tiny study", "D_p error %", "bound %", "as published", "0/8",
                  "Inferred, not stated by the source: the sensor noise."):  # fmt: skip
        assert words in answer.out


def test_options_override_the_study(run, here):
    words = ["benchmark", "study.toml", "--json", "--episodes", 8, "--seed", 9]
    rows = run(*words, "--estimators", "arx-rls-wide,arx-rls").json["rows"]
    assert [r["evaluations"] for r in rows] == [8] * 4
    assert [r["estimator"] for r in rows] == ["arx-rls-wide", "arx-rls"] * 2
    assert rows[0]["max_abs_output"] == rows[1]["max_abs_output"]
    other = run(*words[:-1], 7, "--estimators", "arx-rls").json["rows"]
    assert other[0]["max_abs_output"] != rows[0]["max_abs_output"]


# A user's own plant


@pytest.mark.science
def test_a_users_plant_goes_through_everything(run, here):
    plant = "own.py:Tank"
    assert run("plants", plant, "--json").json["plants"][0]["name"] == "tank"
    words = ["--excitation", "random", "--steps", 100]
    bound = run("information", plant, *words, "--json").json
    assert run("simulate", plant, *words, "--out", "tank.csv").code == 0
    assert (here / "tank.csv").read_text().startswith("time,flow,level_m\n")
    found = run("identify", "tank.csv", "--plant", plant, "--plot", "t.png", "--json").json
    assert found["status"] == "successful"
    for name, truth in (("area", 2.0), ("leak", 0.3)):
        p = found["params"][name]
        assert p["std_error"] == pytest.approx(bound["params"][name]["cramer_rao_bound"], rel=0.4)
        assert abs(p["estimate"] - truth) < 4 * p["std_error"]


def test_a_defect_is_a_failed_run_in_one_line(run, here, monkeypatch):
    def broken(*_: object) -> None:
        raise RuntimeError("this must\nnot happen")

    monkeypatch.setattr("excite.simulation.run_episode", broken)
    before = contents(here)
    answer = run("simulate", "aero2", "--out", "r.csv")
    assert answer.code == 1
    assert answer.out == ""
    assert answer.err.startswith("excite: failed: RuntimeError: this must not happen")
    assert answer.err.count("\n") == 1
    assert contents(here) == before


# Bad input: one sentence, exit code 2, nothing written


IDENTIFY = "identify {} --plant aero2 --out run --plot fit.png"
BAD: dict[str, tuple[str, tuple[str, ...]]] = {
    "unknown column": (
        IDENTIFY.format("column.csv"), ("column.csv", "'pitch'", "theta", "column pitch=NAME"),
    ),
    "missing sample": (IDENTIFY.format("missing.csv"), ("missing.csv", "sample 5", "'voltage'")),
    "NaN": (IDENTIFY.format("nan.csv"), ("nan.csv", "sample 5", "'voltage'", "finite")),
    "text": (IDENTIFY.format("text.csv"), ("text.csv", "sample 5", "'on'", "number")),
    "uneven sampling for ARX": (
        IDENTIFY.format("uneven.csv") + " --estimator arx-rls", ("uneven.csv", "nls does not"),
    ),
    "samples left out for ARX": (
        IDENTIFY.format("gap.csv") + " --estimator arx-rls", ("gap.csv", "gaps in time"),
    ),
    "wrong unit": (
        IDENTIFY.format("unit.csv"), ("unit.csv", "-24 to 24", "--scale voltage=", "the first is"),
    ),
    "too short": (IDENTIFY.format("short.csv"), ("short.csv", "5 measured values for 5 unknowns")),
    "nothing to see": (IDENTIFY.format("rest.csv"), ("no parameter is identifiable",)),
    "no response": (IDENTIFY.format("silent.csv"), ("no parameter is identifiable",)),
    "truncated CSV": (IDENTIFY.format("truncated.csv"), ("truncated.csv", "truncated?")),
    "empty file": (IDENTIFY.format("empty.csv"), ("empty.csv", "empty")),
    "header only": (IDENTIFY.format("header.csv"), ("header.csv", "0 samples")),
    "binary": (IDENTIFY.format("binary.csv"), ("binary.csv", "cannot be read")),
    "endless line": (IDENTIFY.format("long.csv"), ("long.csv", "cannot be read")),
    "time backwards": (
        IDENTIFY.format("backwards.csv"), ("backwards.csv", "'time'", "--rows", "--dt"),
    ),
    "deep sidecar": (IDENTIFY.format("deep.csv"), ("deep.json", "nested too deeply")),
    "digits in a cell": (IDENTIFY.format("digits.csv"), ("digits.csv", "sample 5", "is inf")),
    "digits in rows": (
        IDENTIFY.format("good.csv") + f" --rows {'7' * 5000}:", ("rows '777", "are not allowed"),
    ),
    "surrogate in a unit": (
        IDENTIFY.format("good.csv") + " --unit pitch=\udcff", ("unit '\\udcff' of 'pitch'",),
    ),
    "delay beyond the record": (
        "identify good.csv --plant aero2+delay_voltage --start delay_voltage=50",
        ("delay of input 'voltage' is 50 s", "the longest record has", "(--start, --hold)"),
    ),
    "known delay beyond the record": (
        "identify good.csv --plant aero2+delay_voltage --hold delay_voltage=-50",
        ("delay of input 'voltage' is -50 s", "(--start, --hold)"),
    ),
    "nested option": (
        "simulate aero2 --set amplitude=" + "[" * 100_000, ("--set", "is not a number, true"),
    ),
    "time step NaN": (IDENTIFY.format("good.csv") + " --dt nan", ("'--dt'", "finite number")),
    "folder as record": (IDENTIFY.format("mine.csv"), ("mine.csv", "is a folder")),
    "truncated MAT": (IDENTIFY.format("truncated.mat"), ("truncated.mat", "not a readable MAT")),
    "pickle as MAT": (IDENTIFY.format("pickle.mat"), ("pickle.mat", "not a readable MAT")),
    "HDF5 MAT": (IDENTIFY.format("hdf5.mat"), ("hdf5.mat", "-v7")),
    "wrong ending": (IDENTIFY.format("study.toml"), ("study.toml", ".csv, .txt", "or .db3")),
    "spreadsheet": (IDENTIFY.format("log.xlsx"), ("log.xlsx", "save the sheet as CSV or Parquet")),
    "no such file": (IDENTIFY.format("nowhere.csv"), ("nowhere.csv", "no such file")),
    "broken sidecar": (IDENTIFY.format("sidecar.csv"), ("sidecar.json", "JSON")),
    "sidecar by hand": (IDENTIFY.format("hand.csv"), ("hand.json", "plant")),
    "second file bad": (IDENTIFY.format("good.csv nan.csv"), ("nan.csv", "sample 5")),
    "validation bad": (IDENTIFY.format("good.csv --validate nan.csv"), ("nan.csv", "sample 5")),
    "two sampling times for ARX": (
        IDENTIFY.format("good.csv slow.csv") + " --estimator arx-rls",
        ("slow.csv", "0.2 s", "0.1 s"),
    ),
    "unknown plant": ("identify good.csv --plant aero", ("unknown plant 'aero'", "'aero2'?")),
    "unknown plant to simulate": ("simulate dcmotor", ("'dcmotor'", "'dc_motor'?")),
    "unknown plant to show": ("plants cartpole", ("'cartpole'", "'cart_pole'?")),
    "unknown plant to judge": ("information emsp", ("'emsp'", "'emps'?")),
    "no such plant file": ("simulate nowhere.py:Tank", ("nowhere.py", "no such file")),
    "plant that fails": ("simulate own.py:Broken", ("Broken", "a_name_that_is_nowhere")),
    "plant for the page that is nowhere": ("serve --plant no.json", ("no.json", "No such file")),
    "plant that the page has": ("serve --plant aero2", ("'aero2'", "already")),
    "plant without a name for the page": (
        "serve --plant aero2+delay_voltage", ("--plant", "letters", "'aero2+delay_voltage'"),
    ),
    "no such plant class": ("simulate own.py:Tanc", ("own.py", "'Tanc'")),
    "class that is no plant": (
        "simulate own.py:Steady", ("Steady in own.py is no plant", "derived from AbstractPlant"),
    ),
    "plant file of another language": ("simulate study.toml:Tank", ("study.toml", "ends in .py")),
    "plant with its arguments in another order": (
        "simulate own.py:Swapped", ("derivative of Swapped", "(self, state, input, params)"),
    ),
    "excitation that is none": (
        "simulate own.py:Tank --excitation own.py:Tank", ("Tank in own.py is no excitation",),
    ),
    "excitation that needs arguments": (
        "simulate own.py:Tank --excitation own.py:Level", ("own.py:Level cannot be made",),
    ),
    "estimator that is none": (
        IDENTIFY.format("good.csv") + " --estimator own.py:Steady", ("is no estimator",),
    ),
    "excitation file without a class": (
        "simulate own.py:Tank --excitation own.py:", ("own.py:Steady or own.py:Level",),
    ),
    "unknown excitation": (
        "simulate aero2 --excitation chrip --out r.csv", ("'chrip'", "'chirp'?", "multisine"),
    ),
    "unknown estimator": (
        "identify good.csv --plant aero2 --estimator arx", ("'arx'", "'arx-rls'?", "nls"),
    ),
    "unknown option of an excitation": (
        "simulate aero2 --set clok=3 --excitation prbs", ("'clok'", "'clock'?"),
    ),
    "amplitude beyond the limits": ("simulate aero2 --set amplitude=30", ("30 V", "0 to 24 V")),
    "option that is no number": ("simulate aero2 --set amplitude=high", ("'high'", "amplitude")),
    "option without value": ("simulate aero2 --set amplitude", ("'amplitude'", "NAME=VALUE")),
    "start of an unknown parameter": (
        "identify good.csv --plant aero2 --start J_q=1", ("'J_q'", "J_p, K_pu, D_p"),
    ),
    "start that is not allowed": (
        "identify good.csv --plant aero2 --start J_p=-1", ("J_p = -1 kg m²", "above 0"),
    ),
    "start that is no number": ("identify good.csv --plant aero2 --start J_p=x", ("'x'", "J_p")),
    "column that the plant has not": (
        "identify good.csv --plant aero2 --column theta=pitch", ("'theta'", "time, voltage, pitch"),
    ),
    "unit of another quantity": (
        "identify good.csv --plant aero2 --unit pitch=mm", ("'mm' of 'pitch'", "'rad'", "deg"),
    ),
    "rows that are no slice": (
        "identify good.csv --plant aero2 --rows 5", ("rows '5'", "START:STOP:STEP"),
    ),
    "set input that the file has": (
        "identify good.csv --plant aero2 --set-input voltage=1", ("a column 'voltage'",),
    ),
    "sampling time of zero": (
        "identify good.csv --plant aero2 --dt 0", ("sampling time 0 s", "positive"),
    ),
    "unknown output": ("simulate aero2 --noise pich=0.1", ("'pich'", "'pitch'?")),
    "negative noise": ("simulate aero2 --noise pitch=-1", ("'pitch'", "-1")),
    "noise that bounds nothing": ("information aero2 --noise pitch=0", ("noise",)),
    "ARX without mapping": (
        "identify good.csv --plant emps --estimator arx-rls --column force=voltage,position=pitch",
        ("'emps'", "'nls'"),
    ),
    "input file and options": ("simulate aero2 good.csv --set amplitude=1", ("--set",)),
    "input file and excitation": (
        "information aero2 good.csv --excitation prbs", ("--excitation",),
    ),
    "input beyond the limits": ("simulate aero2 loud.csv", ("loud.csv", "-24 to 24 V")),
    "start for what does not search": (
        "identify good.csv --plant aero2 --estimator arx-rls --start J_p=0.02", ("takes no start",),
    ),
    "held in what estimates all": (
        "identify good.csv --plant aero2 --estimator arx-rls --hold J_p=0.02", ("takes no hold",),
    ),
    "a filter without a rig": ("evaluate aero2 --filter", ("--filter", "needs rig (--rig)")),
    "record that exists": ("simulate aero2 --out good.csv", ("good.csv", "--overwrite")),
    "record beside a foreign file": (
        "simulate aero2 --out notes.csv --overwrite", ("notes.json", "lost"),
    ),
    "more steps than inputs": (
        "simulate aero2 good.csv --steps 5000", ("good.csv", "201 steps", "5000"),
    ),
    "zero steps": ("simulate aero2 --steps 0", ("--steps", "0")),
    "negative seed": ("simulate aero2 --seed -1", ("--seed", "-1")),
    "seed beyond what a key can hold": (f"simulate aero2 --seed {10**20}", ("seed",)),
    "record ending": ("simulate aero2 --out r.txt", ("r.txt", ".csv or .mat")),
    "record folder": ("simulate aero2 --out nowhere/r.csv", ("nowhere", "does not exist")),
    "figure ending": ("simulate aero2 --plot r.gif", ("r.gif", ".png, .svg, .pdf")),
    "figure folder": ("simulate aero2 --plot nowhere/r.png", ("nowhere", "does not exist")),
    "figure of all plants": ("plants --plot p.png", ("--plot", "PLANT")),
    "foreign folder": ("identify good.csv --plant aero2 --out mine", ("mine", "no run folder")),
    "foreign folder to overwrite": (
        "benchmark study.toml --out mine --overwrite", ("mine", "no run folder"),
    ),
    "folder below a file": ("benchmark study.toml --episodes 8 --out good.csv/run", ("good.csv",)),
    "study key": (
        "benchmark key.toml --out run", ("key.toml", "unknown key 'episode'", "'episodes'?"),
    ),
    "study option": ("benchmark option.toml", ("option.toml", "'clok'", "'clock'?")),
    "study method": ("benchmark method.toml", ("method.toml", "'radnom'", "'random'?")),
    "study plant": ("benchmark plant.toml", ("plant.toml", "'aero3'", "'aero2'?")),
    "invalid TOML": ("benchmark invalid.toml", ("invalid.toml", "not valid TOML")),
    "no such study": ("benchmark nowhere.toml", ("nowhere.toml", "No such file")),
    "study estimator": ("benchmark study.toml --estimators nsl", ("'nsl'", "'nls'?")),
    "zero episodes": ("benchmark study.toml --episodes 0", ("--episodes", "0")),
    "unknown command": ("identfy good.csv", ("identfy", "identify")),
    "unknown option": ("simulate aero2 --exitation chirp", ("--exitation", "--excitation")),
    "no file": ("identify --plant aero2", ("FILE",)),
    "other hold of an input": (
        "identify good.csv --plant aero2 --hold-input cubic",
        ("'voltage'", "constant or linear", "'cubic'"),
    ),
    "hold of an input that is none": (
        "identify good.csv --plant aero2 --hold-input volt=linear", ("'volt'", "it has voltage"),
    ),
    "objective of weight zero": (
        "train aero2 --out run --objective D=0", ("weight must be greater than 0, got 0.0",),
    ),
    "other initial state": (
        "identify good.csv --plant aero2 --initial-state maybe", ("maybe", "free", "known"),
    ),
}  # fmt: skip


@pytest.mark.slow
def test_plant_excitation_and_estimator_of_ones_own_work_from_a_file_to_the_next_experiment(
    run, here
):
    plant = ("--plant", "own.py:Tank")
    words = ("--excitation", "own.py:Steady", "--set", "amplitude=0.4", "--steps", "80")
    assert run("simulate", "own.py:Tank", *words, "--out", "steady.csv").code == 0
    assert read_columns(here / "steady.csv")["flow"][0] == pytest.approx(0.9)
    found = run("identify", "steady.csv", *plant, "--estimator", "own.py:Doubtful", "--out", "run")
    assert found.code == 0
    refused = run("next", "run", "--target", "area=1%")
    assert refused.code == 2
    assert "'tank', which does not come with the package: give the plant (--plant)" in refused.err
    more = ("--target", "area=0.01%", "--steps", "20", "--coast", "5")
    assert run("next", "run", *plant, *more).code == 0
    played = ("run", "--rig", "simulated", *plant, *words[:2], "--steps", "20", "--fast")
    told = run(*played, "--out", "played.csv").out
    assert "next: excite identify played.csv --plant own.py:Tank" in told


def test_a_plant_file_leaves_no_compiled_code(run, here, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    monkeypatch.setattr(sys, "pycache_prefix", None)  # beside the file
    before = contents(here)
    assert run("information", "own.py:Tank", "--excitation", "chirp").code == 0
    assert contents(here) == before
    assert not sys.dont_write_bytecode


@pytest.mark.parametrize(("words", "fragments"), BAD.values(), ids=list(BAD))
def test_a_mistake_is_one_sentence_and_leaves_nothing(words, fragments, run, here):
    before = contents(here)
    answer = run(*words.split())
    assert answer.code == 2, answer
    assert answer.out == ""
    assert answer.err.startswith("excite: ")
    assert answer.err.count("\n") == 1
    assert answer.err.endswith("\n")
    assert "Traceback" not in answer.err
    assert len(answer.err) < 1500
    assert [f for f in fragments if f not in answer.err] == []
    assert contents(here) == before


DIGITS = "7" * 5000
NOT_FINITE = "nan", "inf", "-inf", "1e400", DIGITS


def numeric_options() -> dict[str, click.ParamType[Any, Any]]:
    """The type of every option that takes a number, by command and option."""
    commands = {**cli.commands, **{f"study {n}": c for n, c in study.commands.items()}}
    kinds = click.types.FloatParamType, click.types.IntParamType
    return {
        f"{name} {option.opts[0]}": option.type
        for name, command in commands.items()
        for option in command.params
        if isinstance(option.type, kinds)
    }


@pytest.mark.parametrize("option", numeric_options())
@pytest.mark.parametrize("text", [*NOT_FINITE, "1" + "0" * 30])
def test_a_number_that_is_not_finite_or_too_large_is_refused_everywhere(option, text):
    kind = numeric_options()[option]
    if text.endswith("0") and text.isdigit() and not isinstance(kind, click.IntRange):
        pytest.skip("a large number is a number")
    with pytest.raises(click.BadParameter):
        kind.convert(text, None, None)


@pytest.mark.parametrize("text", NOT_FINITE)
@pytest.mark.parametrize("words", [
    "run --fast --out r.csv --spread {}", "run --fast --filter --dry-run --spread {}",
    "run --fast --out r.csv --seed {}", "run --fast --out r.csv --slew {}",
    "run --fast --out r.csv --steps {}",
    "train aero2 --out runs --spread {}", "train aero2 --out runs --clock {}",
    "design aero2 --out s.csv --spread {}", "evaluate aero2 --spread {}",
    "identify good.csv --plant aero2 --dt {}",
])  # fmt: skip
def test_a_number_that_is_not_finite_is_one_sentence(words, text, run, here):
    before = contents(here)
    answer = run(*words.format(text).split())
    assert (answer.code, answer.out) == (2, ""), answer
    assert answer.err.startswith("excite: Invalid value for '--")
    assert answer.err.count("\n") == 1
    assert contents(here) == before


@pytest.mark.parametrize("words", [
    ("identify", f"{DIGITS}.csv", "--plant", "aero2"), ("identify", "good.csv", "--plant", DIGITS),
    ("identify", "good.csv", "--plant", "aero2", "--uncertain", f"m={DIGITS}"),
    ("identify", "good.csv", "--plant", "aero2", "--estimator", DIGITS),
    ("identify", "good.csv", "--plant", "aero2", "--out", DIGITS),
    ("identify", "good.csv", "--plant", "aero2", "--hold-input", DIGITS),
    ("simulate", "aero2", "--seed", DIGITS), ("simulate", "aero2", "--set", f"amplitude={DIGITS}"),
])  # fmt: skip
def test_very_long_words_are_shortened_in_a_message(words, run, here):
    answer = run(*words)
    assert answer.code == 2
    assert len(answer.err) < 1500
    assert answer.err.count("\n") == 1


def test_a_run_folder_may_be_of_files_whose_names_are_not_utf8(run, here):
    """Linux allows any bytes in names; Python has them as halves of surrogate pairs."""
    name, out = "a\udcff\udced.csv", "b\udcff"
    (here / "good.csv").rename(here / name)
    answer = run("identify", name, "--plant", "aero2", "--out", out)
    assert answer.code == 0, answer
    told = json.loads((here / out / "estimate.json").read_text(encoding="utf-8"))
    assert told["files"] == [name]


@pytest.mark.parametrize("place", [0, 2])
def test_debug_shows_where_an_error_arose(place, run, here):
    words = ["simulate", "nowhere"]
    words.insert(place, "--debug")
    answer = run(*words)
    assert answer.code == 2
    assert "Traceback (most recent call last)" in answer.err
    assert "plant_named" in answer.err
    assert answer.err.splitlines()[-1].startswith("excite: unknown plant 'nowhere'")


def test_a_name_with_a_letter_missing_is_recognised(run):
    for name in EXCITATIONS:
        answer = run("simulate", "aero2", "--excitation", name[:-1])
        assert f"did you mean '{name}'?" in answer.err


# As a program of its own


@pytest.mark.slow
def test_as_a_program_stdout_is_json_and_stderr_silent(here):
    answer = excite("identify", "good.csv", "--plant", "aero2", "--json", folder=here)
    assert answer.err == ""
    assert answer.code == 0
    assert answer.json["status"] == "successful"


def test_as_a_program_a_mistake_is_one_line_and_code_2(here):
    before = contents(here)
    answer = excite(*IDENTIFY.format("nan.csv").split(), folder=here)
    assert answer.code == 2
    assert answer.out == ""
    assert answer.err.startswith("excite: nan.csv: sample 5 of 'voltage' is nan")
    assert answer.err.count("\n") == 1
    assert contents(here) == before


def test_a_cache_that_cannot_be_written_is_no_remark(here):
    (here / "cache").write_text("")
    answer = excite("plants", "--json", folder=here, EXCITE_CACHE=str(here / "cache"))
    assert (answer.code, answer.err) == (0, "")


def test_an_interrupt_that_a_library_has_swallowed_is_not_lost():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with progress_bar("working") as report:
            report("on", 0, 2)
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                report("on", 1, 2)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.science
def test_an_interrupted_benchmark_ends_with_130_and_leaves_nothing(here, tmp_path):
    before, cache = contents(here), tmp_path / "cache"
    program = subprocess.Popen(
        [sys.executable, "-m", "excite", "benchmark", "study.toml", "--episodes", "100000",
         "--out", "run"],
        cwd=here, env={**os.environ, "EXCITE_CACHE": str(cache)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        # The first compiled program on disk tells that the run has begun.
        deadline = time.monotonic() + PATIENCE
        while not (cache.is_dir() and any(cache.iterdir())) and time.monotonic() < deadline:
            assert program.poll() is None
            time.sleep(0.05)
        program.send_signal(signal.SIGINT)
        out, err = program.communicate(timeout=PATIENCE)
    finally:
        program.kill()
    assert program.returncode == 130
    assert out == ""
    assert err.strip() == "excite: interrupted; no file was left incomplete"
    assert contents(here) == before
    assert not (here / "run").exists()


@pytest.mark.parametrize("keeps", [None, "missing", "there"])
def test_an_interrupted_study_says_what_is_kept(keeps, tmp_path, capsys):
    (tmp_path / "there").mkdir()
    folder = None if keeps is None else tmp_path / keeps
    is_kept = keeps == "there"
    with (
        click.Context(cli),
        pytest.raises(SystemExit if is_kept else KeyboardInterrupt),
        running("tiny", folder),
    ):
        raise KeyboardInterrupt
    assert ("kept in" in capsys.readouterr().err) == is_kept


WITHOUT_JAX = "import sys; sys.modules['jax'] = None; from excite.cli import main; main()"


@pytest.mark.parametrize(("arguments", "code", "said"), [
    (["policies"], 0, "aero2-goals"),
    (["doctor"], 0, "JAX is not installed"),
    (["plants"], 2, "this command needs JAX"),
    (["run", "--input", "small.csv", "--rig", "quanser", "--dry-run"], 0, "small.csv: 3 samples"),
])  # fmt: skip
def test_what_a_rigs_computer_needs_works_without_jax(arguments, code, said, tmp_path):
    (tmp_path / "small.csv").write_text("time,voltage\n0,5\n0.1,5\n0.2,0\n0.3,0\n")
    run = subprocess.run(
        [sys.executable, "-c", WITHOUT_JAX, *arguments],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == code, run.stderr
    assert said in run.stdout + run.stderr
