"""What a room re-exports as `from .arx import ARX as ARX` is public, and documented."""

import ast
from typing import Any

import griffe


class Reexports(griffe.Extension):
    """Marks these names for the reference; nothing is imported, only read."""

    def on_alias_instance(self, *, node: Any, alias: griffe.Alias, **_: Any) -> None:
        """Called for every name that a module imports."""
        if isinstance(node, ast.ImportFrom):
            alias.public = any(name.name == name.asname == alias.name for name in node.names)
