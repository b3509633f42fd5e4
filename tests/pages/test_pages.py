"""Every command that a page shows runs or exists; links lead somewhere; the site builds."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import click
import pytest
from commands import PATIENCE
from documentation import PAGES, ROOT, Block, anchors, blocks, links, mentions, name, parsed
from experiments import recording

README = ROOT / "README.md"
HERE = Path(sys.executable).parent
TARGETS = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.M))
MADE = re.compile(r"--(?:out|onnx|plot|posterior)[ =](\S+)")

# One process a page: most of a short command's time is what it imports.
PLAYER = """
import shlex, subprocess, sys
from excite.cli import cli
for line in sys.stdin.read().splitlines():
    print("$", line, flush=True)
    if line.startswith("excite ") and not set(line) & set("|>;&"):
        code = cli.main(shlex.split(line, comments=True)[1:], standalone_mode=False)
        assert not code, line
    else:
        subprocess.run(["sh", "-ec", line], check=True)
"""


def is_run(commands: list[str]) -> bool:
    return not all(command.startswith("make ") for command in commands)


def play(page: Path) -> list[str]:
    """The commands of a page that its reader, too, runs in one go."""
    shown = [block for block in blocks(page) if is_run(block.commands)]
    shown = [block for block in shown if block.why is None or not_shipped(block)]
    return [command for block in shown for command in block.played]


def not_shipped(block: Block) -> Path | None:
    """The recording that a block needs and that is not shipped, where this computer has it."""
    name = (block.why or "").partition("the record is not shipped: ")[2]
    return recording(name) if name else None


@pytest.mark.parametrize("page", [page for page in PAGES if play(page)], ids=name)
def test_the_commands_of_a_page_run(page: Path, tmp_path: Path):
    for folder in ("examples", "studies", "results", "docs"):  # copies: some are made anew
        shutil.copytree(ROOT / folder, tmp_path / folder)
    for file in filter(None, map(not_shipped, blocks(page))):
        shutil.copy(file, tmp_path)
    run = subprocess.run(
        [sys.executable, "-c", PLAYER], input="\n".join(play(page)), cwd=tmp_path,
        env={**os.environ, "PATH": f"{HERE}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-2000:]
    for file in MADE.findall("\n".join(play(page))):
        assert (tmp_path / file).exists(), file
    printed = " ".join(run.stdout.split())
    for shown in re.findall(r"```sh\n[^`]*```\n\n```text\n(.*?)```", page.read_text(), re.S):
        # What stands below commands is what they print; of a file the last digits may differ.
        for line in shown.splitlines() if " " in shown else []:
            assert " ".join(line.split()) in printed, line
    if page == README:
        assert "successful" in run.stdout
        [(python, shown)] = re.findall(
            r"```python\n(.*?)```\n\n```text\n(.*?)```", page.read_text(), re.S
        )
        run = subprocess.run(
            [sys.executable, "-c", python], cwd=tmp_path,
            capture_output=True, text=True, timeout=PATIENCE, check=False,
        )  # fmt: skip
        assert run.returncode == 0, run.stderr
        assert run.stdout == shown


@pytest.mark.parametrize("script", sorted(ROOT.glob("docs/figures/*.py")), ids=name)
def test_the_figures_of_the_pages_are_made_by_their_scripts(script: Path, tmp_path: Path):
    """From the committed results; pixels depend on the fonts of a computer."""
    for folder in ("results", "examples", "studies"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    copy = tmp_path / script.relative_to(ROOT)
    copy.parent.mkdir(parents=True)
    (tmp_path / "docs" / "reference").symlink_to(ROOT / "docs" / "reference")
    shutil.copy(script, copy)
    subprocess.run([sys.executable, str(copy)], cwd=tmp_path, check=True, timeout=PATIENCE)
    made = [path for path in copy.parent.rglob("*.*") if path != copy]
    assert made
    for figure in made:
        assert (script.parent / figure.relative_to(copy.parent)).is_file()


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_command_of_a_page_exists(page: Path):
    """Options, choices and files, also of what takes too long to be run."""
    shown = [(command, block.why) for block in blocks(page) for command in block.commands]
    made: set[str] = set()
    for command, why in [*shown, *((mention, None) for mention in mentions(page))]:
        if command.startswith("make "):
            assert set(command.split("#")[0].split()[1:]) <= TARGETS, command
        if not command.startswith("excite "):
            continue
        values = parsed(command)
        made |= {
            file
            for option in ("--out", "--onnx", "--plot", "--posterior")
            for file in values.get(option, [])
        }
        for word in (word for words in values.values() for word in words):
            file = re.split(r"[:=]", word)[0]
            if re.match(r"(studies|examples|results)/", file):
                known = (ROOT / file).exists() or file in made
                assert known, f"{name(page)}: {command}: {word} does not exist"
            elif why is not None and re.fullmatch(r"[^/]+\.(csv|mat)", file):
                known = file in made or file in why
                assert known, f"{name(page)}: {command}: nothing on the page makes {file}"


def test_a_wrong_option_command_or_choice_is_found():
    for wrong in (
        "excite dream",
        "excite simulate aero2 --loud",
        "excite identify r.csv --initial-state x",
    ):
        with pytest.raises(click.UsageError):
            parsed(wrong)
    assert parsed("excite design aero2 --out a.csv  # comment") == {
        "": ["aero2"],
        "--out": ["a.csv"],
    }


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_to_files_and_headings(page: Path):
    for path, anchor in links(page):
        target = page.parent / path if path else page
        assert target.exists(), f"{name(page)}: {path}"
        if anchor:
            assert anchor in anchors(target), f"{name(page)}: {path}#{anchor}"


def test_every_page_stands_in_the_sites_navigation():
    listed = (ROOT / "mkdocs.yml").read_text()
    for page in sorted(ROOT.glob("docs/**/*.md")):
        assert page.relative_to(ROOT / "docs").as_posix() in listed


def test_the_site_builds_strictly_and_asks_nothing_of_the_network(tmp_path: Path):
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("MkDocs is not installed: python -m pip install -e '.[docs]'")
    run = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path)],
        cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    for page in tmp_path.rglob("*.html"):
        loaded = re.findall(
            r"<(?:script|link|img|iframe)\b[^>]*(?:src|href)=\"([^\"]*)", page.read_text()
        )
        assert not [url for url in loaded if "//" in url], page
    reference = (tmp_path / "reference" / "python" / "estimation.html").read_text()
    assert 'id="excite.estimation.NLS"' in reference  # re-exported names are there
    assert 'href="results/baselines/table.html"' not in reference
    assert (tmp_path / "results" / "table1" / "table.html").is_file()
    metrics = (tmp_path / "reference" / "metrics.html").read_text()
    assert metrics.count("<math") > 10  # equations need no script
    assert "arithmatex" not in metrics
    commands = (tmp_path / "reference" / "commands.html").read_text()
    assert 'id="excite-identify"' in commands  # made from the commands


def test_every_room_has_its_place_in_the_reference():
    pages = "".join(page.read_text() for page in sorted(ROOT.glob("docs/reference/python/*.md")))
    rooms = {path.stem for path in (ROOT / "src" / "excite").iterdir() if path.stem[0] != "_"}
    rooms -= {"py"}  # py.typed
    shown = {room.split(".")[0] for room in re.findall(r"^::: excite\.([\w.]+)", pages, re.M)}
    # Seen by its commands, or by its page in the browser.
    assert rooms - shown <= {"cli", "web"}


def test_the_tutorial_shows_the_example_plant_as_it_is():
    page = (ROOT / "docs" / "tutorials" / "own-plant.md").read_text()
    [shown] = re.findall(r"```python\n(.*?)```", page, re.S)
    assert shown in (ROOT / "examples" / "flexible_drive.py").read_text()
