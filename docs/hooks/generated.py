"""Tables made from the code when the site is built, in place of `<!-- generated: NAME -->`."""

import re
from collections.abc import Iterator
from typing import Any

import click

from excite.cli import cli
from excite.estimation import catalogue
from excite.excitation.catalogue import EXCITATIONS
from excite.plant.catalogue import PLANTS, plant_named

_MARK = re.compile(r"<!-- generated: (\w+) -->")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page with its tables."""
    return _MARK.sub(lambda found: TABLES[found[1]](), markdown)


def leaves(group: click.Group = cli, before: str = "excite") -> Iterator[tuple[str, click.Command]]:
    """Every command and its full name; hidden ones are left out."""
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from leaves(command, f"{before} {name}")
        elif not command.hidden:
            yield f"{before} {name}", command


def commands() -> str:
    """One section a command: what its help page says, and its options."""
    return "\n\n".join(_command(name, command) for name, command in leaves())


def _command(name: str, command: click.Command) -> str:
    context = click.Context(command, info_name=name)
    lines = [f"## {name}", "", f"`{command.get_usage(context).removeprefix('Usage: ')}`", ""]
    lines += [_prose(command.help or ""), "", "| option | meaning |", "| --- | --- |"]
    for option in command.get_params(context):
        record = option.get_help_record(context)
        if record is not None and record[1] and not getattr(option, "hidden", False):
            lines.append(f"| `{_cell(record[0])}` | {_cell(record[1])} |")
    return "\n".join(lines)


def _prose(text: str) -> str:
    """A help text as Markdown; a command that click leaves unwrapped is an example."""
    paragraphs = []
    for part in re.split(r"\n\s*\n", text.split("\f")[0].strip()):
        kept = part.removeprefix("\b\n")
        is_example = kept != part and "excite " in kept
        paragraphs.append(f"```text\n{kept}\n```" if is_example else kept)
    return "\n\n".join(paragraphs)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _sentence(thing: Any) -> str:
    """The first sentence of a docstring."""
    return " ".join((thing.__doc__ or "").split("\n\n")[0].split())


def plants() -> str:
    """One row a plant."""
    rows = [
        "| plant | what it is | inputs | outputs | parameters |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, plant in PLANTS.items():
        d = plant_named(name).description
        named = (", ".join(f"{p.name} [{p.unit}]" for p in part) for part in (d.inputs, d.outputs))
        parameters = ", ".join(p.name for p in d.parameters)
        rows.append(f"| `{name}` | {_sentence(plant)} | {' | '.join(named)} | {parameters} |")
    return "\n".join(rows)


def excitations() -> str:
    """One row a classical signal."""
    rows = ["| excitation | what it is |", "| --- | --- |"]
    return "\n".join(rows + [f"| `{name}` | {_sentence(e)} |" for name, e in EXCITATIONS.items()])


def estimators() -> str:
    """One row an estimator."""
    rows = ["| estimator | what it is |", "| --- | --- |"]
    rows += [f"| `{name}` | {line} |" for name, line in catalogue.estimators().items()]
    return "\n".join(rows)


TABLES = {
    "commands": commands,
    "plants": plants,
    "excitations": excitations,
    "estimators": estimators,
}
