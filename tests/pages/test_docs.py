"""Commands, options, files and examples that the documentation shows exist and run."""

import importlib.util
import json
import math
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from pathlib import Path

import click
import pytest
from commands import PATIENCE
from experiments import ROOT

from excite.estimation.catalogue import ESTIMATORS
from excite.excitation.catalogue import EXCITATIONS
from excite.plant.catalogue import PLANTS, plant_named
from excite.record import read_record
from excite.study.spec import read_study


def shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs a command with this environment's `excite` first on the path."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        ["sh", "-ec", command], cwd=folder, env={**os.environ, "PATH": path},
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip


def test_the_generated_reference_has_every_command_option_and_name():
    path = ROOT / "docs" / "hooks" / "generated.py"
    spec = importlib.util.spec_from_file_location("generated", path)
    assert spec is not None
    assert spec.loader is not None
    generated = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generated)
    sections = re.split(r"^## ", generated.commands(), flags=re.M)[1:]
    commands = dict(generated.leaves())
    assert [section.partition("\n")[0] for section in sections] == list(commands)
    for section, command in zip(sections, commands.values(), strict=True):
        for option in command.params:
            if isinstance(option, click.Option) and not option.hidden:
                assert f"`{option.opts[0]}" in section or f", {option.opts[0]}" in section
    for names, table in (
        (PLANTS, generated.plants()),
        (EXCITATIONS, generated.excitations()),
        (ESTIMATORS, generated.estimators()),
    ):
        assert all(f"`{name}`" in table for name in names)


def test_every_study_loads_and_stands_in_the_index_with_its_result():
    index = (ROOT / "docs" / "reference" / "studies.md").read_text()
    for path in sorted((ROOT / "studies").glob("*.toml")):
        assert read_study(path).name == path.stem
        assert f"`{path.name}`" in index
        assert (ROOT / "results" / path.stem / "table.json").is_file()


def test_a_policy_runs_on_a_rig_as_documented(tmp_path: Path):
    """With NumPy alone, on a rig that does not move."""
    page = (ROOT / "docs" / "how-to" / "run-on-a-rig.md").read_text()
    (loop,) = (b for b in re.findall(r"```python\n(.*?)```", page, re.S) if "measure()" in b)
    trained = ROOT / "results" / "table1" / "seeds" / "RL_all" / "0" / "policy.safetensors"
    shutil.copy(trained, tmp_path)
    (tmp_path / "rig.py").write_text(
        "import sys\n\nimport numpy as np\n\napplied = []\napply = applied.append\n\n\n"
        f"def measure():\n    return np.zeros(1)\n\n\n{loop}\n"
        "assert np.shape(applied) == (500, 1)\n"
        "assert 1 < np.max(np.abs(applied)) <= 24\n"
        "assert 'jax' not in sys.modules\n"
    )
    run = subprocess.run(
        [sys.executable, "rig.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr


def controller(server: socket.socket, answers: list[float]) -> None:
    """Answers every line, as the rig on the page expects; its pitch is a slow swing."""
    line, _ = server.accept()
    with line:
        while asked := line.recv(64):
            if asked == b"pitch?\n":
                answers.append(round(0.2 * math.sin(len(answers) / 100), 6))
            line.sendall(b"%.6f\n" % (answers[-1] if answers else 0.0))


def test_a_rig_of_ones_own_is_short_and_runs_as_documented(tmp_path: Path):
    page = (ROOT / "docs" / "how-to" / "run-on-a-rig.md").read_text()
    (rig,) = (b for b in re.findall(r"```python\n(.*?)```", page, re.S) if "\nclass " in b)
    assert len(rig[rig.index("class ") :].splitlines()) <= 40
    words = "run --rig seesaw.py:Seesaw --plant aero2 --steps 10 --out r.csv --json"
    answers: list[float] = []
    with socket.create_server(("localhost", 0)) as server:
        (tmp_path / "seesaw.py").write_text(rig.replace("5000", str(server.getsockname()[1])))
        threading.Thread(target=controller, args=(server, answers), daemon=True).start()
        run = shell(f"excite {words}", tmp_path)
    told = json.loads(run.stdout)
    if told["trip"] == "deadlines":  # on a busy computer they are lost
        assert run.returncode == 1
        assert told["missed_deadlines"] > 0
    else:
        assert (run.returncode, told["reason"], told["num_samples"]) == (0, "complete", 10)
    if told["num_samples"] > 1:  # what has fewer is no record
        record = read_record(tmp_path / "r.csv", plant_named("aero2").description)
        assert set(record.outputs[:, 0]) <= {0.0, *answers}


def test_a_rigs_computer_needs_little_and_in_the_tested_versions():
    needed = (ROOT / "requirements-rig.txt").read_text().splitlines()[1:]
    assert {line.split("==")[0] for line in needed} == {"numpy", "safetensors", "click", "rich"}
    assert set(needed) <= set((ROOT / "constraints.txt").read_text().splitlines())


def test_the_page_on_architecture_names_every_package():
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text()
    packages = {p.stem for p in (ROOT / "src" / "excite").iterdir() if p.stem[0] != "_"}
    packages -= {"py"}  # py.typed
    assert not [package for package in packages if f"`{package}" not in page]


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("0*")), ids=lambda p: p.name)
def test_examples_run(path: Path, tmp_path: Path):
    program = sys.executable if path.suffix == ".py" else "sh"
    run = shell(f"{program} {path}", tmp_path)
    assert run.returncode == 0, run.stderr


def test_the_example_plant_is_short_and_goes_through_in_under_ten_lines_of_shell():
    plant = (ROOT / "examples" / "flexible_drive.py").read_text()
    assert len(plant[plant.index("class ") :].splitlines()) <= 40
    script = (ROOT / "examples" / "01_own_plant.sh").read_text()
    for command in ("simulate", "information", "identify"):
        assert f"excite {command} " in script
    assert len(script.splitlines()) < 10
