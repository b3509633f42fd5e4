"""What the bench page asks for is what the command line does, and says so."""

import json
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from excite.cli import main
from excite.report.html import report_html
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
    "units": {}, "intervals": "linear", "hold_input": "constant", "effects": [],
    "hold": {}, "priors": {},
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
    list(live.identified(MAPPED | change, str(source), "my_log.csv", str(page / "run")))
    shutil.copy(source / "my_log.csv", tmp_path)
    assert_same(page / "run", again(page / "run", tmp_path))
