"""Runs as one report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..description import path_from, wrong_type
from ..files import require_new_file, write_bytes
from ..progress import SHOWN, Progress
from .html import report_html


def report(
    runs: str | Path | Sequence[str | Path],
    out: str | Path | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = SHOWN,
) -> str:
    """A report of run folders and records as one self-contained HTML page.

        >>> import excite as ex
        >>> ex.simulate("aero2", steps=60).save("report_of_this.csv")
        >>> page = ex.report("report_of_this.csv")
        >>> page[:15]
        '<!DOCTYPE html>'

    Args:
        runs: one or several folders of `excite identify`, `excite campaign` and `excite study
            run`, and records with their sidecar.
        out: file to write, .html.
        overwrite: whether the file may exist.
        progress: called with what is drawn, how many are done, and the total.

    Returns:
        The page's text.

    Raises:
        ValueError: for a path that cannot be read as one of them, an `out` that is no .html
            file, or one that exists, unless `overwrite`.
    """
    if out is not None:
        if Path(out).suffix.lower() != ".html":
            raise ValueError(f"{out}: reports end in .html")
        require_new_file(Path(out), overwrite)
    given = [runs] if isinstance(runs, str | Path) else runs
    allowed = "a run folder, a record's file, or several"
    if not isinstance(given, Sequence):
        raise wrong_type("runs", runs, allowed)
    page = report_html([path_from("runs", path, allowed) for path in given], progress)
    if out is not None:
        write_bytes(Path(out), page.encode())
    return page
