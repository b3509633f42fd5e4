"""Figures of trained agents: how they learnt, and what they do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.figure
import numpy as np

from ..description import PlantDescription
from ..records import Record
from .base import BLUE, GREEN, ORANGE, RED, add_legend, draw_episode, new_figure

Curve = Mapping[str, np.ndarray]
"""Columns of one learning curve by name; `steps` is one of them."""


def curves_figure(
    description: PlantDescription, curves: Mapping[str, Sequence[Curve]], title: str
) -> matplotlib.figure.Figure:
    """Learning curves of the deterministic policies: median and band over the seeds.

    Args:
        curves: by agent, one a seed.
    """
    names = [p.name for p in description.parameters]
    figure, axes = new_figure(len(names) + 1, len(curves), height=1.9, width=3.2 * len(curves))
    for column, (agent, seeds) in enumerate(curves.items()):
        axes[0, column].set(title=f"{agent}, {len(seeds)} seeds")
        for axis, name in zip(axes[:, column], names, strict=False):
            _draw_band(axis, seeds, f"relative_error_{name}", BLUE)
            axis.set(yscale="log")
        _draw_band(axes[-1, column], seeds, "violation_rate", RED)
        axes[-1, column].set(xlabel="million steps", ylim=(-2, 102))
    for axis, name in zip(axes[:, 0], names, strict=False):
        axis.set(ylabel=f"{name} error [%]")
    axes[-1, 0].set(ylabel="violations [%]")
    add_legend(figure, axes[0, 0], axes[-1, 0])
    figure.suptitle(f"{title}: policy without exploration noise")
    return figure


def _draw_band(axis: Any, seeds: Sequence[Curve], column: str, colour: str) -> None:
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
        episodes: by agent, the record, and the estimates over the true parameters, one row a
            sample (not numbers where there are none).
    """
    names = [p.name for p in description.parameters]
    rows = len(description.inputs) + len(description.outputs)
    figure, axes = new_figure(rows + 1, len(episodes), height=1.9, width=3.4 * len(episodes))
    for column, (agent, (record, estimates)) in enumerate(episodes.items()):
        draw_episode(axes[:rows, column], description, record)
        axes[0, column].set(title=agent)
        below = axes[rows, column]
        for name, values, colour in zip(
            names, estimates.T, (BLUE, ORANGE, GREEN, RED), strict=False
        ):
            below.plot(record.time, values, color=colour, lw=1, label=name)
        below.axhline(1, color="black", lw=0.6)
        below.set(xlabel="time [s]", yscale="log", ylim=(0.1, 30), ylabel="estimate / true")
    add_legend(figure, *axes[:, 0])
    figure.suptitle(title)
    return figure
