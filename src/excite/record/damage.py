"""Sentences for files that are damaged, or that unpack to very much."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

MAX_UNPACKED = 256 * 2**20  # bytes of all columns of a file, which may be compressed


@contextlib.contextmanager
def damage_reported(path: Path, kind: str, advice: str = "") -> Iterator[None]:
    """One sentence for what a library raises, of any type, where a file is damaged."""
    try:
        yield
    except NotImplementedError:
        raise
    except Exception as error:
        raise ValueError(f"{path}: not a readable {kind} file ({error}){advice}") from None


def require_size(path: Path, size: int) -> None:
    """Raises ValueError for columns of so many bytes that they may not fit in memory."""
    if size > MAX_UNPACKED:
        sizes = f"{size / 2**20:.0f} MiB unpacked, more than {MAX_UNPACKED >> 20}"
        raise ValueError(f"{path}: its columns take {sizes}; save it with fewer of them")
