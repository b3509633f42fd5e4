"""Figures of what information costs: violations, and samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.figure

from .base import add_legend, add_title, colour_of, new_figure

_MARKERS = "osD^vP*X<>hpd"  # as many as share no factor with the colours


def frontier_figure(rows: Sequence[Mapping[str, Any]], title: str) -> matplotlib.figure.Figure:
    """Information of every method against its violation rate, with the rate's interval."""
    first = [row for row in rows if row["estimator"] == rows[0]["estimator"]]
    figure, axes = new_figure(1, 1, height=4.6, width=7.6)
    axis = axes[0, 0]
    for i, row in enumerate(r for r in first if "log_det_information" in r):
        rate, (low, high) = row["violation_rate"]["estimate"], row["violation_rate"]["ci95"]
        bars = [[100 * max(0.0, rate - low)], [100 * max(0.0, high - rate)]]
        style = {"color": colour_of(i), "marker": _MARKERS[i % len(_MARKERS)]}
        axis.errorbar(
            100 * rate, row["log_det_information"], xerr=bars, ls="", capsize=2, ms=6,
            label=row["method"], **style,
        )  # fmt: skip
    axis.set_xscale("symlog", linthresh=0.1)
    axis.set(xlim=(-0.01, 110), xlabel="violations [% of experiments, 95 % interval]")
    axis.set(ylabel="log det of the Fisher information")
    add_legend(figure, axis)
    add_title(figure, title)
    return figure


def lengths_figure(rows: Sequence[Mapping[str, Any]], title: str) -> matplotlib.figure.Figure:
    """Least standard deviation of each parameter against the length of the experiment."""
    first = [row for row in rows if row["estimator"] == rows[0]["estimator"]]
    chosen = [row for row in first if "bound_by_length" in row]
    names = list(rows[0]["relative_error_percent"])
    figure, axes = new_figure(1, len(names), height=4.0, width=3.6 * len(names))
    for axis, name in zip(axes[0], names, strict=True):
        for i, row in enumerate(chosen):
            bound = row["bound_by_length"]
            percent = bound["cramer_rao_percent"][name]
            marker = _MARKERS[i % len(_MARKERS)]
            axis.plot(
                bound["num_steps"], percent, color=colour_of(i), marker=marker, ms=4, lw=1,
                label=row["method"],
            )  # fmt: skip
        axis.set(yscale="log", title=name, xlabel="samples")
    axes[0, 0].set(ylabel="Cramér-Rao bound [%]")
    add_legend(figure, axes[0, 0])
    add_title(figure, title)
    return figure
