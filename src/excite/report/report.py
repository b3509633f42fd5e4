"""Runs as one report, in one of several formats."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

from ..description import path_from, unknown, wrong_type
from ..files import require_new_file, write_bytes, write_with_files
from ..progress import SHOWN, Progress
from ..record.figure import image
from .content import Figure
from .document import described, drawing, read_runs
from .html import report_html
from .latex import latex_page
from .markdown import markdown_page
from .notebook import notebook_page
from .svg import make_plain

FORMATS = ("html", "md", "tex", "ipynb")
"""Formats of a report, and the endings of their files."""
_WITH_FIGURES = {"md": (markdown_page, "svg"), "tex": (latex_page, "pdf")}
_FONTS: dict[Any, Any] = {"svg.fonttype": "path", "pdf.fonttype": 42}  # alike everywhere
_OWN = re.compile(r"run\d+-\w+\.(svg|pdf)")
_LATEX_NAME = re.compile(r"[\w.+=, -]+")


def report(
    runs: str | Path | Sequence[str | Path],
    out: str | Path | None = None,
    *,
    format: str | None = None,
    overwrite: bool = False,
    progress: Progress = SHOWN,
) -> str:
    """A report of run folders and records.

    It is one self-contained HTML page; or Markdown or LaTeX with its figures as files in the
    folder `NAME_files` beside it; or a Jupyter notebook that shows the answer, reads the runs
    and draws their figures.

        >>> import excite as ex
        >>> ex.simulate("aero2", steps=60).save("report_of_this.csv")
        >>> page = ex.report("report_of_this.csv")
        >>> page[:15]
        '<!DOCTYPE html>'

    Args:
        runs: one or several folders of `excite identify`, `excite campaign` and `excite study
            run`, and records with their sidecar.
        out: file to write.
        format: "html", "md", "tex" or "ipynb"; default that of the ending of `out`, or "html".
        overwrite: whether the file and the folder of its figures may exist.
        progress: called with what is drawn, how many are done, and the total.

    Returns:
        The text of the file.

    Raises:
        ValueError: for a path that cannot be read as one of them, a format that is none of
            these or contradicts the ending of `out`, one with figures as files without `out`,
            and a file or folder that exists, unless `overwrite`.
    """
    path = None if out is None else path_from("out", out)
    kind = format_of(path, format)
    if path is not None:
        _require_free(path, kind, overwrite)
    given = [runs] if isinstance(runs, str | Path) else runs
    allowed = "a run folder, a record's file, or several"
    if not isinstance(given, Sequence):
        raise wrong_type("runs", runs, allowed)
    paths = [path_from("runs", run, allowed) for run in given]
    if kind == "html":
        page, files = report_html(paths, progress), {}
    else:
        page, files = _page(kind, paths, path, progress)
    if path is not None and (folder := figures_of(path, kind)):
        write_with_files(path, page.encode(), folder, files)
    elif path is not None:
        write_bytes(path, page.encode())
    return page


def figures_of(out: Path, kind: str) -> Path | None:
    """The folder of a report's figures; None where they are in the report itself."""
    return out.with_name(f"{out.stem}_files") if kind in _WITH_FIGURES else None


def _page(
    kind: str, paths: Sequence[Path], out: Path | None, progress: Progress
) -> tuple[str, dict[str, bytes]]:
    """A report that is no HTML page, and the content of its figures by file name."""
    every, place = read_runs(paths), Path() if out is None else out.parent
    with drawing():
        document = described(every, paths, progress)
        folder = None if out is None else figures_of(out, kind)
        if folder is None:
            places = [Path(os.path.relpath(path, place)).as_posix() for path in paths]
            return notebook_page(document, places), {}
        page, ending = _WITH_FIGURES[kind]
        kept = folder.iterdir() if folder.exists() else []  # of the same report in another format
        files = {file.name: file.read_bytes() for file in kept if file.suffix != f".{ending}"}
        files |= {f"{figure.name}.{ending}": _drawn(figure, ending) for figure in document.figures}
        return page(document, folder.name), files


def _drawn(figure: Figure, ending: str) -> bytes:
    """A figure as a file."""
    make_plain(figure.drawn)
    with matplotlib.rc_context(_FONTS):
        return image(figure.drawn, ending)


def format_of(out: Path | None, format: str | None) -> str:
    """The format that was asked for; ValueError where that is none, or two."""
    if format is not None and format not in FORMATS:
        raise unknown("format", str(format), FORMATS)
    if out is None:
        if format in _WITH_FIGURES:
            raise ValueError(f"a report in the format {format} needs out: its figures are files")
        return format or "html"
    ending = out.suffix.lower()
    if ending[1:] not in FORMATS and format is not None:
        return format
    if ending[1:] not in FORMATS:
        raise ValueError(f"{out}: reports end in {', '.join(f'.{name}' for name in FORMATS)}")
    if format not in (None, ending[1:]):
        raise ValueError(f"{out} ends in {ending}, but the format is {format}")
    return ending[1:]


def _require_free(out: Path, kind: str, overwrite: bool) -> None:
    """Raises ValueError, before anything is drawn, where a report may not be written."""
    require_new_file(out, overwrite)
    folder = figures_of(out, kind)
    if folder is None:
        return
    if kind == "tex" and not _LATEX_NAME.fullmatch(out.name):
        raise ValueError(
            f"{out}: LaTeX finds no figures of a file with such a name; take letters, digits, "
            "blanks and . + = , _ - alone"
        )
    if not (folder.exists() or folder.is_symlink()):
        return
    is_own = folder.is_dir() and not folder.is_symlink()
    others = [f.name for f in folder.iterdir() if not _OWN.fullmatch(f.name)] if is_own else []
    if not is_own or others:
        what = f"has other files ({others[0]})" if others else "is no folder of a report's figures"
        raise ValueError(f"{folder} {what}; choose another name")
    if any(folder.glob(f"*.{_WITH_FIGURES[kind][1]}")) and not overwrite:
        raise ValueError(f"{folder} has figures; choose another name or add --overwrite")
