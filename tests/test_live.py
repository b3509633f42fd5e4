"""What the bench page asks for is what the command line does, and says so."""

import json
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import excite

import excite as ex
from excite.cli import main
from excite.report.html import report_html
from excite.report.numbers import number
from excite.web import jobs as live

ASKED: Any = {
    "plant": "aero2",
    "excitation": "prbs",
    "amplitude": 5.125,
    "noise": {"pitch": 1 / 700},
    "params": {"J_p": 0.025, "D_p": 1 / 140},
    "steps": 150,
    "seed": 7,
    "others": [],
}
MAPPED: Any = {
    "plant": "aero2",
    "estimator": "arx-rls-wide",
    "initial_state": "free",
    "columns": {"pitch": "theta (deg)", "voltage": "u"},
    "scales": {"pitch": 3.141592653589793 / 180},
    "units": {}, "intervals": "linear", "likelihood": "normal", "hold_input": "constant",
    "fitted": ["my_log.csv"], "held_out": [], "effects": [], "others": [],
    "validate_columns": {}, "set_inputs": {}, "dt": None, "rows": None,
    "start": {}, "hold": {}, "priors": {}, "uncertain": {},
}  # fmt: skip
OPTIONS = {
    "a scale": {},
    "a unit and two effects": {
        "estimator": "nls", "scales": {}, "units": {"pitch": "deg"}, "hold_input": "linear",
        "effects": ["delay_voltage", "bias_pitch"],
    },
    "profiles": {"estimator": "nls", "intervals": "profile"},
    "a known value and a prior": {
        "estimator": "nls", "hold": {"J_p": 0.025}, "priors": {"D_p": "normal:0.0071:0.001"},
    },
    "a start, other noise and an uncertain constant": {
        "estimator": "nls", "start": {"J_p": 0.02}, "likelihood": "student",
        "uncertain": {"m": "5%"},
    },
    "no time, some rows and held-out columns": {
        "estimator": "nls", "columns": {"pitch": "theta (deg)", "voltage": "u"}, "dt": 0.1,
        "rows": "10:140", "held_out": ["my_log.csv"], "validate_columns": {"pitch": "theta (deg)"},
    },
}  # fmt: skip
CHANGES = {
    "a signal": {},
    "of its usual size": {"amplitude": None, "noise": {}, "params": {}},
    "a loop": {"excitation": "loop-multisine"},
    "a policy": {"excitation": "aero2", "amplitude": None},
}


def again(run: Path, folder: Path) -> Path:
    """The run that the commands in a run folder make in another folder."""
    for line in read(run / "run.json")["command"].splitlines():
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            patch.setattr(sys, "argv", shlex.split(line))
            with pytest.raises(SystemExit) as ending:
                main()
        assert not ending.value.code, line
    return folder / "run"


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def assert_same(first: Path, second: Path) -> None:
    assert (first / "record.csv").read_text() == (second / "record.csv").read_text()
    assert read(first / "estimate.json") == read(second / "estimate.json")
    assert read(first / "run.json")["plant"] == read(second / "run.json")["plant"]


@pytest.mark.science
@pytest.mark.parametrize("change", CHANGES.values(), ids=list(CHANGES))
def test_the_command_of_an_experiment_makes_it_again(change: dict[str, Any], tmp_path: Path):
    run = tmp_path / "page" / "run"
    run.parent.mkdir()
    list(live.followed(ASKED | change, str(run)))
    for line in read(run / "run.json")["command"].splitlines():
        assert line in report_html([run])
    assert_same(run, again(run, tmp_path))


@pytest.mark.science
@pytest.mark.parametrize("change", OPTIONS.values(), ids=list(OPTIONS))
def test_the_command_of_a_file_identifies_it_again(change: dict[str, Any], tmp_path: Path):
    source, page = tmp_path / "upload", tmp_path / "page"
    source.mkdir()
    page.mkdir()
    list(live.followed(ASKED, str(page / "simulated")))
    header, *rows = (page / "simulated" / "record.csv").read_text().splitlines()
    assert header == "time,voltage,pitch"
    values = [row.split(",") for row in rows]
    degrees = [f"{time},{u},{float(pitch) * 180 / 3.14159}" for time, u, pitch in values]
    (source / "my_log.csv").write_text("\n".join(["time,u,theta (deg)", *degrees, ""]))
    list(live.identified(MAPPED | change, str(source), str(page / "run")))
    shutil.copy(source / "my_log.csv", tmp_path)
    assert_same(page / "run", again(page / "run", tmp_path))


@pytest.mark.science
def test_plants_and_files_are_compared_by_the_same_commands(tmp_path: Path):
    """A constant input, two files of which one is held out, and two plants."""
    source, page = tmp_path / "upload", tmp_path / "page"
    for folder in (source, page):
        folder.mkdir()
    for seed, name in enumerate(("a.csv", "b.csv")):
        record = ex.simulate("aero2", np.full((150, 1), 5.0), seed=seed)
        rows = zip(record.time.tolist(), record.outputs[:, 0].tolist(), strict=True)
        lines = ["time,pitch", *(f"{time},{pitch}" for time, pitch in rows), ""]
        for place in (source, tmp_path):
            (place / name).write_text("\n".join(lines))
    asked = MAPPED | {
        "estimator": "nls", "columns": {}, "scales": {}, "set_inputs": {"voltage": 5.0},
        "fitted": ["a.csv"], "held_out": ["b.csv"], "others": ["aero2_lag", "aero2"],
    }  # fmt: skip
    told: Any = live.identified(asked, str(source), str(page / "run"))
    [event] = told
    found = event["identification"]
    assert [own["file"] for own in found["validation"]] == ["b.csv"]
    assert [shown["file"] for shown in event["records"]] == ["a.csv", "b.csv"]
    assert_same(page / "run", again(page / "run", tmp_path))
    _, *words = shlex.split(event["command"].splitlines()[1])
    plants = json.loads(excite(*words, "--json", cwd=tmp_path).stdout)["plants"]
    assert {p["plant"] for p in plants} == {"aero2", "aero2_lag"}
    cells = [[p["plant"], str(p["num_unknowns"]), number(p["log_likelihood"], 6)] for p in plants]
    assert [row[:3] for row in event["comparison"]["rows"]] == cells
