"""Run folders and records as the content of one report."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import matplotlib

from ..record.figure import MAX_POINTS, at_most
from .content import Document, Element
from .sections.campaign import read_campaign
from .sections.elements import Marker, Run
from .sections.experiment import Experiment, comparison, read_experiment
from .sections.record import read_recorded
from .sections.study import StudyRun, common_methods, read_study_run
from .svg import PAGE_STYLE

_KINDS: dict[str, Callable[[Marker], Run]] = {
    "excite identification": read_experiment,
    "excite campaign": read_campaign,
    "excite study": read_study_run,
}
_DRAWING = threading.Lock()  # Matplotlib's settings are global


@contextlib.contextmanager
def drawing(points: int = MAX_POINTS) -> Iterator[None]:
    """Matplotlib's settings for a report, for one at a time, and the points of a line at most."""
    with _DRAWING, matplotlib.rc_context(PAGE_STYLE), at_most(points):
        yield


def read_runs(paths: Sequence[Path]) -> list[Run]:
    """Run folders and records of any kind; ValueError for a path that is none of them."""
    return [_read(path) for path in paths]


def described(
    every: Sequence[Run],
    paths: Sequence[Path],
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Document:
    """What a report says of some runs, its figures drawn.

    Args:
        every: of the runs.
        paths: that they were read from.
        progress: called with what is drawn, how many are done, and the total.
    """
    sections = []
    for i, run in enumerate(every):
        progress(paths[i].name, i, len(paths))
        sections.append(run.section(f"run{i + 1}"))
    progress("done", len(paths), len(paths))
    return Document(sections, _beside(every))


def _beside(runs: Sequence[Run]) -> list[tuple[str, Sequence[Element]]]:
    """Comparisons of several experiments and of several studies, numbered as in the contents."""
    experiments: dict[str, Experiment] = {}
    studies: dict[str, StudyRun] = {}
    for i, run in enumerate(runs, 1):
        if isinstance(run, Experiment):
            experiments[f"{i}. {run.marker.folder.absolute().name}"] = run
        elif isinstance(run, StudyRun):
            studies[f"{i}. {run.marker.folder.absolute().name}"] = run
    parts: list[tuple[str, Sequence[Element]]] = []
    if len(experiments) > 1:
        parts.append(("Experiments side by side", comparison(experiments)))
    if len(studies) > 1:
        parts.append(("Studies side by side", common_methods(studies)))
    return [(title, body) for title, body in parts if body]


def _read(path: Path) -> Run:
    """A run folder or a record of any kind."""
    if path.is_file():
        return read_recorded(path)
    if not path.exists():
        raise ValueError(f"{path}: no such folder or record")
    marker = Marker.read(path, _KINDS)
    return _KINDS[marker.kind](marker)
