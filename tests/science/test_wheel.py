"""What is built for a package index works where there is no checkout."""

import json
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path
from typing import NamedTuple

import pytest
from commands import PATIENCE

ROOT = Path(__file__).parent.parent.parent


class Installed(NamedTuple):
    """Source distribution, wheel, and the interpreter of an environment that holds the wheel."""

    sdist: Path
    wheel: Path
    python: Path

    def run(self, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
        """Its interpreter, which sees nothing of the checkout."""
        hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
        env = {name: value for name, value in os.environ.items() if name not in hidden}
        return subprocess.run(
            [str(self.python), *words], cwd=folder, env=env,
            capture_output=True, text=True, check=False, timeout=PATIENCE,
        )  # fmt: skip

    def excite(self, folder: Path, words: str) -> str:
        """What the installed command prints."""
        done = self.run(folder, str(self.python.with_name("excite")), *words.split())
        assert done.returncode == 0, done.stderr
        return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel in an environment of its own; dependencies are those of this environment."""
    place = tmp_path_factory.mktemp("wheel")
    for words in (
        ["build", "--no-isolation", "--outdir", str(place / "dist"), str(ROOT)],
        ["venv", "--without-pip", str(place / "venv")],
    ):
        subprocess.run([sys.executable, "-m", *words], check=True, capture_output=True, cwd=place)
    [sdist], [wheel] = place.glob("dist/*.tar.gz"), place.glob("dist/*.whl")
    python = place / "venv" / "bin" / "python"
    subprocess.run(
        [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps",
         "--no-index", str(wheel)],
        check=True, cwd=place,
    )  # fmt: skip
    [packages] = place.glob("venv/lib/python*/site-packages")
    # A folder on such a line is searched, but its own lines (an editable excite) are not read.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return Installed(sdist, wheel, python)


def test_the_wheel_holds_what_it_needs_and_the_source_distribution_the_tests(installed: Installed):
    with zipfile.ZipFile(installed.wheel) as wheel:
        names = set(wheel.namelist())
        [metadata] = [name for name in names if name.endswith(".dist-info/METADATA")]
        about = message_from_bytes(wheel.read(metadata))
    assert {"excite/py.typed", "excite/study/shipped/table1.toml"} <= names
    assert {f"excite/examples/{path.name}" for path in (ROOT / "examples").iterdir()} <= names
    assert not [name for name in names if not name.startswith(("excite/", "excite-"))]
    assert about["Requires-Python"] == ">=3.11"
    assert len(about.get_all("Project-URL", [])) >= 4
    text = str(about.get_payload())
    assert "# excite" in text
    assert re.findall(r"\]\((?!https?:|#)[^)]*\)", text) == []  # relative: dead on an index
    with tarfile.open(installed.sdist) as sdist:
        held = {name.partition("/")[2] for name in sdist.getnames()}
    assert {"README.md", "tests/test_cli.py", "examples/flexible_drive.py"} <= held
    assert not [name for name in held if name.startswith(("perf", "results", "studies"))]


def test_the_lower_bounds_are_the_oldest_versions_that_are_tested():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    bounds = dict(needed.split(">=") for needed in project["dependencies"])
    lines = (ROOT / "constraints-oldest.txt").read_text().splitlines()
    oldest = dict(line.split("==") for line in lines if "==" in line)
    assert bounds
    for name, bound in bounds.items():
        assert f"{oldest[name]}.".startswith(f"{bound}."), name


def test_commands_work_without_a_checkout(installed: Installed, tmp_path: Path):
    listed = json.loads(installed.excite(tmp_path, "study list --json"))["studies"]
    assert {path.stem for path in (ROOT / "studies").glob("*.toml")} == {s["name"] for s in listed}
    for study in listed:
        assert Path(study["file"]).is_relative_to(installed.python.parent.parent)
    assert "chirp" in installed.excite(tmp_path, "study run baselines --episodes 20")
    installed.excite(tmp_path, "simulate aero2 --out record.csv --plot record.png")
    assert "J_p" in installed.excite(tmp_path, "identify record.csv --plant aero2")
    installed.excite(tmp_path, "information aero2 --excitation aero2-damping")
    assert "excite" in installed.excite(tmp_path, "doctor")


def test_the_front_door_works_without_a_checkout(installed: Installed, tmp_path: Path):
    program = (
        "import excite as ex\n"
        "record = ex.simulate('aero2', 'chirp', seed=0)\n"
        "print(ex.__file__, ex.identify(record), sep='\\n')\n"
    )
    done = installed.run(tmp_path, "-c", program)
    assert done.returncode == 0, done.stderr
    where, _, table = done.stdout.partition("\n")
    assert Path(where).is_relative_to(installed.python.parent.parent)
    assert "J_p" in table


def test_a_missing_extra_is_one_sentence_that_says_what_to_install(
    installed: Installed, tmp_path: Path
):
    program = (
        "import sys\n"
        "sys.modules['optuna'] = None\n"
        "sys.argv = ['excite', 'design', 'aero2', '--kind', 'chirp', '--out', 'signal.csv']\n"
        "from excite.cli import main\n"
        "main()\n"
    )
    done = installed.run(tmp_path, "-c", program)
    assert done.returncode == 2
    assert "pip install 'excite[tune]'" in done.stderr
    assert done.stderr.count("\n") == 1
