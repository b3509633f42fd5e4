"""What tables and figures share: numbers as text, axes, levels, files.

Degrees and percent live in this room and in the command line only.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import matplotlib.figure
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float

from ..description import Input, Output, PlantDescription, display_unit
from ..files import write_bytes
from ..records import Record

# Distinguishable with any colour vision (M. Okabe and K. Ito, 2008).
BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#767676"
PLOT_ENDINGS = (".png", ".svg", ".pdf")
_MAX_POINTS = 4000  # more cannot be told apart on paper and make files slow to open


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many significant digits; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value != 0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.{digits - 1}e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:.{decimals}f}"


def digits_for(value: float, error: float | None) -> int:
    """Significant digits of a value that show two digits of its error."""
    if error is None or not math.isfinite(error) or not 0 < error < abs(value):
        return 5
    return min(12, 2 + math.ceil(math.log10(abs(value) / error)))


def mean_sd(mean: float | None, sd: float | None) -> str:
    """Mean ± standard deviation."""
    return f"{number(mean)} ± {number(sd)}"


def require_plot_path(path: Path) -> None:
    """Raises ValueError, before anything is computed, where a figure cannot be written."""
    if path.suffix.lower() not in PLOT_ENDINGS:
        raise ValueError(f"{path}: figures end in {', '.join(PLOT_ENDINGS)}")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} does not exist")


def save(figure: matplotlib.figure.Figure, path: Path) -> None:
    """Writes a figure, whole or not at all."""
    write_bytes(path, image(figure, path.suffix[1:].lower()))


def image(figure: matplotlib.figure.Figure, kind: str) -> bytes:
    """A figure as the content of a file of this kind: png, svg or pdf."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=150)
    plt.close(figure)
    return buffer.getvalue()


def new_figure(rows: int, columns: int = 1, height: float = 2.2, width: float = 8.0) -> tuple:
    """A figure and its grid of axes; height of one row and width of all, in inches."""
    plt.switch_backend("agg")
    figure, axes = plt.subplots(
        rows, columns, figsize=(width, height * rows + 0.6), squeeze=False, layout="constrained"
    )
    for axis in axes.ravel():
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    return figure, axes


def add_legend(figure: matplotlib.figure.Figure, *axes: Any) -> None:
    """One legend below all axes, where it hides nothing."""
    entries = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    if entries:
        figure.legend(entries.values(), entries, loc="outside lower center", ncols=4, fontsize=8)


def axis_label(part: Input | Output) -> str:
    """Name and unit as people read it."""
    return f"{part.name} [{display_unit(part.unit)[0]}]"


def thin(*arrays: np.ndarray) -> list[np.ndarray]:
    """Every n-th sample of long arrays."""
    every = max(1, len(arrays[0]) // _MAX_POINTS)
    return [a[::every] for a in arrays]


def draw_levels(axis: Any, part: Output, drawn: Float[np.ndarray, "..."]) -> None:
    """Both safety levels, where the output comes near enough for them to fit the picture."""
    factor = display_unit(part.unit)[1]
    for level, colour, word in (
        (part.warning_level, ORANGE, "warning"),
        (part.critical_level, RED, "critical"),
    ):
        if level is None or np.max(np.abs(drawn)) < 0.25 * level:
            continue
        for sign in (1, -1):
            label = f"{word} level" if sign == 1 else None
            axis.axhline(sign * level * factor, color=colour, ls="--", lw=1, label=label)


def draw_episode(axes: Any, description: PlantDescription, record: Record) -> None:
    """One axis an input, then one axis an output."""
    for i, part in enumerate(description.inputs):
        time, values = thin(record.time, record.inputs[:, i])
        axes[i].step(time, values, where="post", color=GREEN, lw=1)
        axes[i].set(ylabel=axis_label(part))
    for i, part in enumerate(description.outputs, len(description.inputs)):
        time, values = thin(record.time, record.outputs[:, i - len(description.inputs)])
        axes[i].plot(time, display_unit(part.unit)[1] * values, color=BLUE, lw=1)
        draw_levels(axes[i], part, values)
        axes[i].set(ylabel=axis_label(part))
