"""Figures of trained agents: learning curves and episodes."""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Mapping, Sequence

import matplotlib.axes
import matplotlib.figure
import numpy as np

from ..description import PlantDescription
from ..record import Record
from ..record.figure import (
    BLUE,
    RED,
    add_legend,
    add_title,
    colour_of,
    draw_episodes,
    new_figure,
    thin,
)

Curve = Mapping[str, np.ndarray]
"""Columns of one learning curve by name; `steps` is one of them."""


def curves_figure(
    description: PlantDescription,
    curves: Mapping[str, Sequence[Curve]],
    title: str,
    bounds: Collection[str] = (),
) -> matplotlib.figure.Figure:
    """Learning curves of the deterministic policies: median and band over the seeds.

    Args:
        curves: by agent, one per seed.
        bounds: agents rewarded with information, whose curves hold the smallest standard
            deviations (Cramér-Rao) instead of errors.
    """
    names = [p.name for p in description.parameters]
    figure, axes = new_figure(
        len(names) + 1, len(curves), height=1.9, width=3.2 * len(curves), sharey="row"
    )
    for column, (agent, seeds) in enumerate(curves.items()):
        count = f"{len(seeds)} seed" + "s" * (len(seeds) > 1)
        axes[0, column].set(title=_column_title(f"{agent}, {count}"))
        word = "bound" if agent in bounds else "error"
        for axis, name in zip(axes[:, column], names, strict=False):
            _draw_band(axis, seeds, f"relative_error_{name}", BLUE)
            axis.set(yscale="log")
            if column == 0 or (agent in bounds) != (next(iter(curves)) in bounds):
                axis.set_ylabel(f"{name} {word} [%]", labelpad=8)
        _draw_band(axes[-1, column], seeds, "violation_rate", RED)
        axes[-1, column].set(xlabel="million steps", ylim=(-2, 102))
    axes[-1, 0].set(ylabel="violations [%]")
    add_legend(figure, axes[0, 0])
    add_title(figure, f"{title}: policy without exploration noise")
    return figure


def _column_title(text: str) -> str:
    return textwrap.fill(text, 28)


def _draw_band(
    axis: matplotlib.axes.Axes, seeds: Sequence[Curve], column: str, colour: str
) -> None:
    """Median, quartiles and extremes over the seeds, in percent."""
    steps = seeds[0]["steps"] / 1e6
    values = 100 * np.stack([seed[column] for seed in seeds])
    low, first, middle, third, high = np.quantile(values, (0, 0.25, 0.5, 0.75, 1), axis=0)
    axis.fill_between(steps, low, high, color=colour, alpha=0.15, lw=0, label="all seeds")
    axis.fill_between(steps, first, third, color=colour, alpha=0.3, lw=0, label="middle half")
    axis.plot(steps, middle, color=colour, lw=1.2, label="median")


def agents_figure(
    description: PlantDescription,
    episodes: Mapping[str, tuple[Record, np.ndarray]],
    title: str,
) -> matplotlib.figure.Figure:
    """One episode of each agent: inputs, outputs with their levels, running estimates.

    Args:
        episodes: by agent, the record, its metadata with the `seed` and the `estimator`; and
            the estimates over the true parameters, one row per sample (NaN where there is
            none).
    """
    records = [record for record, _ in episodes.values()]
    running = [estimates for _, estimates in episodes.values()]
    has_estimates = any(np.any(np.isfinite(e)) for e in running)
    rows = len(description.inputs) + len(description.outputs) + has_estimates
    figure, axes = new_figure(
        rows, len(episodes), height=1.9, width=3.4 * len(episodes), sharey="row"
    )
    draw_episodes(axes, description, records)
    for column, (agent, record) in enumerate(zip(episodes, records, strict=True)):
        seed = record.metadata.get("seed")
        text = agent if seed is None else f"{agent}, seed {seed}"
        axes[0, column].set(title=_column_title(text))
        axes[-1, column].set(xlabel="time [s]")
    if has_estimates:
        _draw_running(axes[-1], description, records, running)
    add_legend(figure, *axes[:, 0])
    add_title(figure, title)
    return figure


def _draw_running(
    axes: np.ndarray,
    description: PlantDescription,
    records: Sequence[Record],
    running: Sequence[np.ndarray],
) -> None:
    """Estimates over true parameters, one axis per experiment."""
    for axis, record, estimates in zip(axes, records, running, strict=True):
        for i, part in enumerate(description.parameters):
            time, values = thin(record.time, estimates[:, i])
            axis.plot(time, values, color=colour_of(i), lw=1, label=part.name)
        axis.axhline(1, color="black", lw=0.6)
    estimator = records[0].metadata.get("estimator", "estimate")
    axes[0].set(yscale="log", ylim=(0.1, 30), ylabel=f"{estimator} / true")
