"""Figures of information against violations and against the number of samples."""

from __future__ import annotations

import math
from collections.abc import Sequence

import matplotlib.figure

from ..record.figure import add_legend, add_title, colour_of, new_figure
from .answer import KNOWS_THE_PLANT
from .rows import Row
from .study_table import has_gain, information_of

QUANTITY = {
    False: "log det of the Fisher information",
    True: "expected information gain [nats]",
}
"""What methods are compared by, by whether they have an expected gain."""
_MARKERS = "osD^vP*X<>hpd"  # as many as share no factor with the colours


def frontier(rows: Sequence[Row]) -> list[str]:
    """Methods that no other beats: none tells as much with fewer violations, or more with as few.

    One that knows the plant is a reference, and neither on the frontier nor before it.
    """
    own = [row for row in rows if row.estimator == rows[0].estimator]
    own = [row for row in own if row.method != KNOWS_THE_PLANT]
    in_nats = has_gain(own)
    points = {
        row.method: (told, -row.violation_rate.estimate)
        for row in own
        if math.isfinite(told := information_of(row, in_nats))
    }
    return [
        method
        for method, (told, safe) in points.items()
        if not any(t >= told and s >= safe and (t, s) != (told, safe) for t, s in points.values())
    ]


def frontier_figure(rows: Sequence[Row], title: str) -> matplotlib.figure.Figure:
    """Information of every method against its violation rate, with the rate's interval."""
    first = [row for row in rows if row.estimator == rows[0].estimator]
    figure, axes = new_figure(1, 1, height=4.6, width=7.6)
    axis, below, in_nats = axes[0, 0], -math.inf, has_gain(first)
    drawn = [
        (told, i, row)
        for i, row in enumerate(first)
        if math.isfinite(told := information_of(row, in_nats))
    ]
    values = [told for told, _, _ in drawn]
    gap = (max(values, default=0.0) - min(values, default=0.0)) / 26  # of two lines of text
    for value, i, row in sorted(drawn, key=lambda own: own[:2]):
        rate, (low, high) = row.violation_rate.estimate, row.violation_rate.ci95
        bars = [[100 * max(0.0, rate - low)], [100 * max(0.0, high - rate)]]
        style = {"color": colour_of(i)}
        axis.errorbar(100 * rate, value, xerr=bars, marker="o", ms=5, capsize=2, **style)
        below = max(below + gap, value)
        axis.annotate(
            row.method, (100 * high, value), (100 * max(high, 0.001) * 1.15, below),
            va="center", fontsize=7.5, **style,
        )  # fmt: skip
    axis.set_xscale("symlog", linthresh=0.1)
    axis.set(xlim=(-0.01, 110), xlabel="violations [% of experiments, 95 % interval]")
    axis.set(ylabel=QUANTITY[in_nats])
    add_title(figure, title)
    return figure


def lengths_figure(rows: Sequence[Row], title: str) -> matplotlib.figure.Figure:
    """Cramér-Rao bound of each parameter against the length of the experiment."""
    first = [row for row in rows if row.estimator == rows[0].estimator]
    chosen = [(row.method, row.bound_by_length) for row in first if row.bound_by_length]
    names = rows[0].parameters
    figure, axes = new_figure(1, len(names), height=4.0, width=3.6 * len(names))
    for axis, name in zip(axes[0], names, strict=True):
        for i, (method, bound) in enumerate(chosen):
            percent = bound.cramer_rao_percent[name]
            marker = _MARKERS[i % len(_MARKERS)]
            axis.plot(
                bound.num_steps, percent, color=colour_of(i), marker=marker, ms=4, lw=1,
                label=method,
            )  # fmt: skip
        axis.set(yscale="log", title=name, xlabel="samples")
    axes[0, 0].set(ylabel="Cramér-Rao bound [%]")
    add_legend(figure, axes[0, 0])
    add_title(figure, title)
    return figure
