"""Runs as one self-contained HTML page."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib

from .. import __version__
from ..description import path_from, wrong_type
from ..files import require_new_file, write_bytes
from ..progress import SHOWN, Progress
from ..record.figure import MAX_POINTS, at_most
from .sections.campaign import read_campaign
from .sections.elements import Marker, Run, Section, paragraph, text
from .sections.experiment import Experiment, comparison, read_experiment
from .sections.record import read_recorded
from .sections.study import StudyRun, common_methods, read_study_run
from .svg import PAGE_STYLE

MAX_BYTES = 3_000_000
"""Size above which a page is drawn again with fewer points, so that it can be mailed."""
_NUM_POINTS = (MAX_POINTS, 1000, 250)
_TOO_LARGE = f"This page is larger than {MAX_BYTES / 1e6:g} MB: several pages are easier to send."
_STYLE = Path(__file__).with_name("page.css")
_KINDS: dict[str, Callable[[Marker], Run]] = {
    "excite identification": read_experiment,
    "excite campaign": read_campaign,
    "excite study": read_study_run,
}
_DRAWING = threading.Lock()  # Matplotlib's settings are global


def report_html(
    runs: Sequence[Path], progress: Callable[[str, int, int], None] = lambda *_: None
) -> str:
    """A report of run folders and records as one HTML document.

    Lines of long records are thinned to their extremes, more so where the page gets large.

    Args:
        runs: folders of `excite identify`, `excite campaign` and `excite study run`, and records
             (.csv, .mat) with their sidecar.
        progress: called with what is drawn, how many are done, and the total.

    Raises:
        ValueError: for a path that cannot be read as one of them.
    """
    every = [_read(path) for path in runs]  # reports damaged files before drawing starts
    page = ""
    for points in _NUM_POINTS:
        with _DRAWING, matplotlib.rc_context(PAGE_STYLE), at_most(points):
            page = _drawn(every, runs, progress)
        if len(page.encode()) <= MAX_BYTES:
            return page
    return page.replace("<main>\n", f"<main>\n{paragraph(_TOO_LARGE)}", 1)


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


def _drawn(
    every: Sequence[Run],
    runs: Sequence[Path],
    progress: Callable[[str, int, int], None],
) -> str:
    """The page, with the present limit on the points of a line."""
    sections = []
    for i, run in enumerate(every):
        progress(runs[i].name, i, len(runs))
        sections.append(run.section(f"run{i + 1}"))
    progress("done", len(runs), len(runs))
    return _document(sections, _beside(every))


def _beside(runs: Sequence[Run]) -> str:
    """Comparisons of several experiments and of several studies, numbered as in the contents."""
    experiments: dict[str, Experiment] = {}
    studies: dict[str, StudyRun] = {}
    for i, run in enumerate(runs, 1):
        if isinstance(run, Experiment):
            experiments[f"{i}. {run.marker.folder.absolute().name}"] = run
        elif isinstance(run, StudyRun):
            studies[f"{i}. {run.marker.folder.absolute().name}"] = run
    parts = []
    if len(experiments) > 1:
        parts.append(("Experiments side by side", comparison(experiments)))
    if len(studies) > 1:
        parts.append(("Studies side by side", common_methods(studies)))
    return "".join(f"<section>\n<h2>{h}</h2>\n{b}</section>\n" for h, b in parts if b)


def _read(path: Path) -> Run:
    """A run folder or a record of any kind."""
    if path.is_file():
        return read_recorded(path)
    if not path.exists():
        raise ValueError(f"{path}: no such folder or record")
    marker = Marker.read(path, _KINDS)
    return _KINDS[marker.kind](marker)


def _document(sections: Sequence[Section], beside: str) -> str:
    """The page; for several runs with a list of contents and a comparison."""
    numbered = {f"{i}. {s.title}": s for i, s in enumerate(sections, 1)}
    title, contents = f"{len(sections)} runs", _contents(list(numbered.items()))
    if len(sections) == 1:
        numbered, contents = {"": sections[0]}, _source(sections[0])
        title = sections[0].title
    body = "".join(
        f'<section id="run{i}">\n{_head(t, s)}{s.body}</section>\n'
        for i, (t, s) in enumerate(numbered.items(), 1)
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="excite {__version__}">
<title>{text(title)}</title>
<style>
{_STYLE.read_text(encoding="utf-8")}</style>
</head>
<body>
<header><h1>{text(title)}</h1></header>
<main>
{contents}{beside}{body}</main>
<footer>Made by excite {__version__}.</footer>
</body>
</html>
"""


def _head(title: str, section: Section) -> str:
    return f"<h2>{text(title)}</h2>\n{_source(section)}" if title else ""


def _source(section: Section) -> str:
    return f'<p class="source">{text(section.name)}</p>\n'


def _contents(sections: Sequence[tuple[str, Section]]) -> str:
    links = "".join(
        f'<li><a href="#run{i}">{text(title)}</a> <small>{text(s.name)}</small></li>\n'
        for i, (title, s) in enumerate(sections, 1)
    )
    return f'<nav aria-label="Contents"><ol>\n{links}</ol></nav>\n'
