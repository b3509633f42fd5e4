"""Progress of a training: `progress.json` beside the checkpoint of every running seed.

`phase.json` says what else is done before and after: compiling, searching for violations,
evaluating.

The worker that trains writes it. The command line and the bench page read it without JAX.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from ..files import write_json

_NAME, _PHASE = "progress.json", "phase.json"
FILES = (_NAME, _PHASE)
"""Their names."""


def write_progress(seed_folder: Path, look: Mapping[str, float]) -> None:
    """Stores the newest row of a learning curve: `steps` so far, `return`, errors, violations."""
    write_json(seed_folder / _NAME, look)


def read_progress(seed_folder: Path) -> dict[str, float | None] | None:
    """That row; None where there is none yet, or it cannot be read.

    A number that was not finite is None.
    """
    try:
        look = json.loads((seed_folder / _NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(look, dict) or not all(_is_number(value) for value in look.values()):
        return None
    return None if look.get("steps") is None else look


def _is_number(value: object) -> bool:
    return value is None or isinstance(value, int | float)


def write_phase(seed_folder: Path, text: str) -> None:
    """Stores what is done before or after the updates of a training; empty: these are made."""
    write_json(seed_folder / _PHASE, {"text": text})


def read_phase(seed_folder: Path) -> str:
    """What is done before or after the updates; empty while these are made, or nothing is done."""
    try:
        return str(json.loads((seed_folder / _PHASE).read_text(encoding="utf-8"))["text"])
    except (OSError, ValueError, RecursionError, LookupError, TypeError):
        return ""


def remove_progress(seed_folder: Path) -> None:
    """Removes the files after the training."""
    for name in FILES:
        (seed_folder / name).unlink(missing_ok=True)
