"""`excite doctor`: what is installed, what runs where, and what to type for the rest."""

from __future__ import annotations

import re
from importlib import metadata
from typing import Any

import click

from .options import cache_folder, json_option, prepare_jax, show_json, show_table


@click.command()
@json_option
def doctor(as_json: bool) -> None:
    """Print versions, devices and extras, and what to type for what is missing."""
    import platform

    core, extras = _requirements()
    result = {
        "excite": metadata.version("excite"),
        "python": platform.python_version(),
        "devices": _devices(),
        "packages": {name: _version(name) for name in core},
        "extras": {
            extra: {
                "installed": not (missing := [n for n in names if _version(n) is None]),
                "missing": missing,
                "install": f"pip install 'excite[{extra}]'",
            }
            for extra, names in extras.items()
        },
        "cache": str(cache_folder()),
    }
    if as_json:
        show_json(result)
        return
    _show(result)


def _devices() -> list[str]:
    """Where JAX computes; nowhere without it."""
    try:
        prepare_jax()
    except ImportError:
        return []
    import jax

    return [str(device) for device in jax.devices()]


def _requirements() -> tuple[list[str], dict[str, list[str]]]:
    """Names of the packages that the core needs, and that each extra needs."""
    core: list[str] = []
    extras = {name: [] for name in metadata.metadata("excite").get_all("Provides-Extra") or []}
    for line in metadata.requires("excite") or []:
        name = re.split(r"[\s<>=!~;\[(]", line, maxsplit=1)[0]
        marker = re.search(r"extra\s*==\s*['\"]([^'\"]+)", line)
        (core if marker is None else extras[marker.group(1)]).append(name)
    return core, extras


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _show(result: dict[str, Any]) -> None:
    click.echo(f"excite {result['excite']}, Python {result['python']}")
    click.echo(f"devices: {', '.join(result['devices']) or 'none, JAX is not installed'}")
    click.echo(f"compiled programs: {result['cache']}")
    show_table(
        "core", ["package", "version"], [[n, v or "MISSING"] for n, v in result["packages"].items()]
    )
    show_table(
        "extras",
        ["extra", "there", "missing", "to install"],
        [
            [
                name,
                "yes" if e["installed"] else "no",
                ", ".join(e["missing"]) or "–",
                "" if e["installed"] else e["install"],
            ]
            for name, e in result["extras"].items()
        ],
    )
