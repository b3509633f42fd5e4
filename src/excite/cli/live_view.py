"""The live view of an experiment on a rig: one line on a terminal."""

from __future__ import annotations

import sys
import threading

from ..description import Output, display_unit
from ..rig import Sample

_SHOWN_EVERY = 0.2  # seconds; drawing takes a fraction of a millisecond


class LiveView:
    """One line: time, outputs between their levels, inputs, and the live estimate."""

    def __init__(self) -> None:
        """Draws in a separate thread: a terminal that blocks must not delay the loop."""
        self._latest: Sample | None = None
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._draw, daemon=True)
        if sys.stderr.isatty():
            self._thread.start()

    def __call__(self, sample: Sample) -> None:
        """Keeps the sample; it is drawn now or later."""
        self._latest = sample

    def _draw(self) -> None:
        shown = None
        while not self._end.wait(_SHOWN_EVERY):
            if (sample := self._latest) is not None and sample is not shown:
                sys.stderr.write("\r\x1b[2K" + line(sample))
                sys.stderr.flush()
                shown = sample

    def end(self) -> None:
        """Ends the line."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join(1.0)
            sys.stderr.write("\n")


def line(sample: Sample) -> str:
    """The line for a sample."""
    d = sample.description
    parts = [f"{sample.time:5.1f} / {sample.num_steps * d.dt:g} s"]
    parts += [_gauge(o, y) for o, y in zip(d.outputs, sample.measured, strict=True)]
    parts += [f"{i.name} {u:+6.2f} {i.unit}" for i, u in zip(d.inputs, sample.input, strict=True)]
    parts += [f"{name} {v:.3g} ± {h:.1g}" for name, (v, h) in sample.live_estimate.items()]
    return "  ".join(parts)


def _gauge(output: Output, value: float) -> str:
    """An output as a mark between its critical levels, with the warning levels marked."""
    unit, factor = display_unit(output.unit)
    text = f"{output.name} {factor * value:+7.2f} {unit}"
    if output.critical_level is None:
        return text
    width = 10
    marks = [" "] * (2 * width + 1)
    marks[width] = "."
    if output.warning_level is not None:
        near = round(width * output.warning_level / output.critical_level)
        marks[width - near] = marks[width + near] = ":"
    place = width + round(width * max(-1.0, min(1.0, value / output.critical_level)))
    marks[place] = "#"
    return f"{text} |{''.join(marks)}|"
