"""`excite doctor`: what is installed, what runs where, and what to type for the rest."""

from __future__ import annotations

import re
from importlib import metadata

import click

from .options import cache_folder, json_option, prepare_jax, show_json, show_table


@click.command()
@json_option
def doctor(as_json: bool) -> None:
    """Print versions, devices and extras, and what to type for what is missing."""
    import platform

    core, extras = _requirements()
    packages = {name: _version(name) for name in core}
    missing = {extra: [n for n in names if _version(n) is None] for extra, names in extras.items()}
    install = {extra: f"pip install 'excite[{extra}]'" for extra in extras}
    version, python, devices = metadata.version("excite"), platform.python_version(), _devices()
    folder = cache_folder()
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    if as_json:
        found = {
            extra: {"installed": not names, "missing": names, "install": install[extra]}
            for extra, names in missing.items()
        }
        show_json(
            {"excite": version, "python": python, "devices": devices, "packages": packages,
             "extras": found, "cache": str(folder), "cache_bytes": size}
        )  # fmt: skip
        return
    click.echo(f"excite {version}, Python {python}")
    click.echo(f"devices: {', '.join(devices) or 'none, JAX is not installed'}")
    click.echo(f"compiled programs: {folder}, {size / 1e6:.0f} MB\n")
    show_table("core", ["package", "version"], [[n, v or "MISSING"] for n, v in packages.items()])
    show_table(
        "extras",
        ["extra", "installed", "missing", "to install"],
        [
            [extra, "no" if names else "yes", ", ".join(names) or "–",
             install[extra] if names else ""]
            for extra, names in missing.items()
        ],
    )  # fmt: skip


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
