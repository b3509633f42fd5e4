"""The commands that the documentation shows, as tests run or read them."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import click

from excite.cli import cli

ROOT = Path(__file__).parent.parent
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted(ROOT.glob("*/README.md")),
    *sorted(ROOT.glob("docs/**/*.md")),
]
_BLOCK = re.compile(
    r"(?:<!-- (?:not run: (?P<why>[^\n]*?)|shortened: (?P<shorter>[^\n]*?)) -->\n+)?"
    r"```sh\n(?P<lines>.*?)```",
    re.S,
)
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)#\s]*)(?:#([^)\s]*))?\)")


@dataclass(frozen=True)
class Block:
    """Commands shown together.

    Attributes:
        why: they are not run by the tests, if they are not.
        shorter: what tests add to them, so that they do not take minutes: the first words of
            commands, each with further options, separated by semicolons.
    """

    lines: str
    why: str | None
    shorter: str | None

    @property
    def commands(self) -> list[str]:
        """One a line, comments and continuations taken away."""
        lines = self.lines.replace("\\\n", " ").splitlines()
        return [" ".join(line.split()) for line in lines if line.strip() and line[0] != "#"]

    @property
    def played(self) -> list[str]:
        """The commands as tests run them."""
        added = [part.strip() for part in (self.shorter or "").split(";") if part.strip()]
        pairs = [(part.split(" --")[0], part[part.index(" --") :]) for part in added]
        for start, _ in pairs:
            assert any(command.startswith(start) for command in self.commands), start
        commands = [command.partition(" #")[0].strip() for command in self.commands]
        played = list[str]()
        for command in commands:
            more = "".join(more for start, more in pairs if command.startswith(start))
            options, otherwise, code = command.partition(" || ")
            played.append(options + more + otherwise + code)
        return played


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> list[Block]:
    """What the page shows as shell, in its order."""
    return [Block(m["lines"], m["why"], m["shorter"]) for m in _BLOCK.finditer(page.read_text())]


def mentions(page: Path) -> list[str]:
    """Commands within sentences and tables."""
    return re.findall(
        r"`(excite [a-z][^`\n]*)`", re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    )


def links(page: Path) -> list[tuple[str, str]]:
    """File and anchor of every link that stays in the project."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    return [(path, anchor) for path, anchor in _LINK.findall(text) if "://" not in path]


def anchors(page: Path) -> set[str]:
    """Anchors of the headings, as GitHub and the site make them of plain words."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.M)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings
    }


def parsed(command: str) -> dict[str, list[str]]:
    """Options of a shown `excite ...` and their values.

    Raises:
        click.UsageError: for a command, an option or a choice that does not exist.
    """
    words = shlex.split(command, comments=True)[1:]
    words = [word for word in words if word != "--debug"]
    part: click.Command = cli
    while isinstance(part, click.Group) and words and words[0][0] not in "-.":
        found = part.commands.get(words[0])
        if found is None:
            raise click.UsageError(f"{command}: no command {words[0]!r}")
        part, words = found, words[1:]
    context = click.Context(part, info_name=part.name)
    options = {opt: p for p in part.params for opt in (*p.opts, *p.secondary_opts)}
    values: dict[str, list[str]] = {}
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if not word.startswith("-"):
            values.setdefault("", []).append(word)
            continue
        option = options.get(word)
        if option is None and word not in ("--help", "-h", "--version"):
            raise click.UsageError(f"{command}: no option {word}")
        if option is None or getattr(option, "is_flag", False):
            continue
        if not rest:
            continue  # the option itself is spoken of, not its value
        value = rest.pop(0)
        if isinstance(option.type, click.Choice) and not value.isupper():
            option.type.convert(value, option, context)
        values.setdefault(word, []).append(value)
    return values
