"""Names that a shell completes and help texts list, found without importing what computes.

The shell calls this at every press of the Tab key, so it must be fast. Names of plants,
excitations and estimators are read from the source of their catalogue, those of policies and
studies from the folders of the shipped files.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path

import click
from click.shell_completion import CompletionItem

_PACKAGE = Path(__file__).parent.parent


def plants() -> list[str]:
    """Names of the shipped plants."""
    return _keys("plant/catalogue.py", "PLANTS")


def signals() -> list[str]:
    """Names of the classical signals."""
    return _keys("excitation/catalogue.py", "EXCITATIONS")


def excitations() -> list[str]:
    """Names of the signals, alone and as the reference of a position loop."""
    return [*signals(), *(f"loop-{name}" for name in signals())]


def estimators() -> list[str]:
    """Names of the estimators."""
    return _keys("estimation/catalogue.py", "ESTIMATORS")


def policies() -> list[str]:
    """Names of the shipped policies."""
    return sorted(path.stem for path in (_PACKAGE / "policy" / "shipped").glob("*.safetensors"))


def studies() -> list[str]:
    """Names of the shipped studies."""
    return sorted(path.stem for path in (_PACKAGE / "study" / "shipped").glob("*.toml"))


def _keys(file: str, dictionary: str) -> list[str]:
    """Keys of a dictionary literal in a module of the package."""
    tree = ast.parse((_PACKAGE / file).read_text(encoding="utf-8"))
    return [
        key.value
        for node in tree.body
        if isinstance(node, ast.AnnAssign)
        and isinstance(node.target, ast.Name)
        and node.target.id == dictionary
        and isinstance(node.value, ast.Dict)
        for key in node.value.keys
        if isinstance(key, ast.Constant) and isinstance(key.value, str)
    ]


class Names(click.ParamType):
    """A text that a shell completes to one of these names, or to a file."""

    name = "text"

    def __init__(self, *sources: Callable[[], list[str]], designs: tuple[str, ...] = ()) -> None:
        """`sources` list the names; `designs` are further words."""
        self._sources, self._designs = sources, designs

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The text, unchanged; the command looks up what it names."""
        del param, ctx
        return value

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Names that begin with what follows the last comma of a list; files if none does."""
        del ctx, param
        before, comma, word = incomplete.rpartition(",")
        names = [*self._designs, *(name for source in self._sources for name in source())]
        found = [name for name in names if name.startswith(word)]
        if not found:
            return [CompletionItem(incomplete, type="file")]
        return [CompletionItem(f"{before}{comma}{name}") for name in found]


_TYPES = {
    "plant": Names(plants),
    "excitation": Names(excitations, policies),
    "kind": Names(excitations, designs=("robust", "clairvoyant")),
    "policy": Names(policies),
    "estimator": Names(estimators),
    "estimators": Names(estimators),
    "study": Names(studies),
}
"""By the name of the argument or option."""


def complete_names(command: click.Command) -> None:
    """Lets a shell complete the names that the options and arguments of a command take."""
    for param in command.params:
        if param.name in _TYPES and param.type is click.STRING:
            param.type = _TYPES[param.name]
