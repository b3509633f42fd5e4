"""From records to tables and figures that people read; degrees and percent live here.

Everything comes in as plain data (records, descriptions, JSON-ready dictionaries): no
line of this room computes an experiment.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.figure
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float

from .description import Input, Output, PlantDescription, display_unit
from .files import csv_text, write_bytes
from .records import Record

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


def table_header(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Column titles of a benchmark table."""
    largest = rows[0]["max_abs_output"]
    header = ["method", "estimator"]
    for name in rows[0]["relative_error_percent"]:
        header += [f"{name} error %", "bound %"]
    return [*header, f"max {largest['output']} {largest['unit']}", "violations (95 %)", "failed"]


def table_cells(row: Mapping[str, Any]) -> list[str]:
    """The cells of one row, errors and magnitudes as mean ± standard deviation."""
    cells = [row["method"], row["estimator"]]
    for name, error in row["relative_error_percent"].items():
        cells += [_mean_sd(error["mean"], error["sd"]), number(row["cramer_rao_percent"][name], 2)]
    low, high = row["violation_rate"]["ci95"]
    count = f"{row['violations']}/{row['evaluations']} ({100 * low:.1f}–{100 * high:.1f} %)"
    largest = row["max_abs_output"]
    failed = f"{row['failed']}/{row['evaluations']}"
    return [*cells, _mean_sd(largest["mean"], largest["sd"]), count, failed]


def reference_cells(row: Mapping[str, Any], reference: Mapping[str, Any]) -> list[str]:
    """A published row in the columns of the method's own `row`."""
    cells = [row["method"], "as published"]
    for name in row["relative_error_percent"]:
        published = reference["relative_error_percent"].get(name)
        cells += ["–" if published is None else _mean_sd(*published), "–"]
    return [*cells, _mean_sd(*reference["max_abs_output"]), reference["violations"], "–"]


def _mean_sd(mean: float, sd: float) -> str:
    return f"{number(mean)} ± {number(sd)}"


def all_cells(
    rows: Sequence[Mapping[str, Any]], reference: Mapping[str, Mapping[str, Any]]
) -> list[list[str]]:
    """All rows of a table, after each method's the published one, if there is one."""
    cells = []
    for i, row in enumerate(rows):
        cells.append(table_cells(row))
        is_last = i + 1 == len(rows) or rows[i + 1]["method"] != row["method"]
        if is_last and row["method"] in reference:
            cells.append(reference_cells(row, reference[row["method"]]))
    return cells


def footnotes(study: Mapping[str, Any]) -> list[str]:
    """What a reader of the table must know."""
    notes = [
        "Errors are relative errors in percent, mean ± standard deviation over the estimates "
        "that did not fail. The bound is the mean Cramér-Rao bound of the same data, a standard "
        "deviation: the mean error of an efficient estimator is 0.80 of it.",
    ]
    if study.get("reference"):
        notes.append(f"Published rows: {study['source']}.")
    if study.get("inferred"):
        notes.append("Inferred, not stated by the source: " + "; ".join(study["inferred"]) + ".")
    return notes


def benchmark_markdown(rows: Sequence[Mapping[str, Any]], study: Mapping[str, Any]) -> str:
    """The table as Markdown, with its footnotes."""
    header = table_header(rows)
    lines = [f"# {study.get('title') or study['name']}", ""]
    lines += ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    lines += ["| " + " | ".join(c) + " |" for c in all_cells(rows, study.get("reference", {}))]
    lines += [line for note in footnotes(study) for line in ("", note)]
    return "\n".join(lines) + "\n"


def benchmark_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table as CSV, numbers unrounded."""
    text = {"method": [r["method"] for r in rows], "estimator": [r["estimator"] for r in rows]}
    columns: dict[str, list[float]] = {
        key: [row[key] for row in rows] for key in ("evaluations", "failed", "violations")
    }
    largest = rows[0]["max_abs_output"]
    for part in ("mean", "sd"):
        title = f"max_abs_{largest['output']}_{largest['unit']}_{part}"
        columns[title] = [row["max_abs_output"][part] for row in rows]
    for name in rows[0]["relative_error_percent"]:
        for part in ("mean", "sd", "median", "rms"):
            columns[f"{name}_error_percent_{part}"] = [
                row["relative_error_percent"][name][part] for row in rows
            ]
        columns[f"{name}_cramer_rao_percent"] = [row["cramer_rao_percent"][name] for row in rows]
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    numbers = csv.reader(csv_text(columns).splitlines())
    labels = [["method", "estimator"], *zip(text["method"], text["estimator"], strict=True)]
    writer.writerows([*pair, *values] for pair, values in zip(labels, numbers, strict=True))
    return buffer.getvalue()


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


def _figure(rows: int, columns: int = 1, height: float = 2.2, width: float = 8.0) -> tuple:
    plt.switch_backend("agg")
    figure, axes = plt.subplots(
        rows, columns, figsize=(width, height * rows + 0.6), squeeze=False, layout="constrained"
    )
    for axis in axes.ravel():
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    return figure, axes


def _add_legend(figure: matplotlib.figure.Figure, *axes: Any) -> None:
    """One legend below all axes, where it hides nothing."""
    entries = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    if entries:
        figure.legend(entries.values(), entries, loc="outside lower center", ncols=4, fontsize=8)


def _label(part: Input | Output) -> str:
    return f"{part.name} [{display_unit(part.unit)[0]}]"


def _thin(*arrays: np.ndarray) -> list[np.ndarray]:
    every = max(1, len(arrays[0]) // _MAX_POINTS)
    return [a[::every] for a in arrays]


def _draw_levels(axis: Any, part: Output, drawn: Float[np.ndarray, "..."]) -> None:
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


def identification_figure(
    description: PlantDescription,
    result: Mapping[str, Any],
    record: Record,
    simulated: Float[np.ndarray, "sample output"],
) -> matplotlib.figure.Figure:
    """Measured against simulated outputs, residuals, and the parameters' intervals."""
    outputs = description.outputs
    figure, axes = _figure(2 * len(outputs) + 1)
    for i, part in enumerate(outputs):
        top, below = axes[2 * i, 0], axes[2 * i + 1, 0]
        factor = display_unit(part.unit)[1]
        time, measured, model = _thin(record.time, record.outputs[:, i], simulated[:, i])
        top.plot(time, factor * measured, color=GREY, lw=1.6, label="measured")
        top.plot(time, factor * model, color=BLUE, lw=1, label="simulated")
        fit = result["fit_percent"][part.name]
        top.set(ylabel=_label(part), title=f"{part.name}: fit {number(fit, 4)} %")
        below.plot(time, factor * (measured - model), color=ORANGE, lw=0.8)
        below.set(ylabel=f"residual [{display_unit(part.unit)[0]}]")
    axes[-2, 0].set(xlabel="time [s]")
    _draw_intervals(axes[-1, 0], result["params"])
    _add_legend(figure, axes[0, 0])
    figure.suptitle(f"{description.name}: {result['estimator']}, {result['status']}")
    return figure


def _draw_intervals(axis: Any, params: Mapping[str, Mapping[str, Any]]) -> None:
    """95 % intervals in percent of the estimate."""
    for i, (name, p) in enumerate(params.items()):
        value, error = p["estimate"], p["std_error"]
        if error is None or not math.isfinite(error):
            axis.text(0, i, f"{name} held", color=GREY, va="center", ha="center")
            continue
        half = 100 * 1.96 * error / (abs(value) or math.nan)
        axis.errorbar(0, i, xerr=half, color=BLUE, fmt="o", capsize=4, ms=4)
        text = f"{number(value, digits_for(value, error))} {p['unit']}"
        axis.annotate(text, (0, i), (0, 7), textcoords="offset points", ha="center", fontsize=8)
    axis.set_yticks(range(len(params)), params)
    axis.set(ylim=(len(params) - 0.4, -0.9), xlabel="95 % interval [% of the estimate]")


def episode_figure(description: PlantDescription, record: Record) -> matplotlib.figure.Figure:
    """Inputs and outputs of one experiment, with the safety levels."""
    figure, axes = _figure(len(description.inputs) + len(description.outputs))
    _draw_episode(axes[:, 0], description, record)
    axes[-1, 0].set(xlabel="time [s]")
    _add_legend(figure, *axes[:, 0])
    figure.suptitle(description.name)
    return figure


def _draw_episode(axes: Any, description: PlantDescription, record: Record) -> None:
    """One axis an input, then one axis an output."""
    for i, part in enumerate(description.inputs):
        time, values = _thin(record.time, record.inputs[:, i])
        axes[i].step(time, values, where="post", color=GREEN, lw=1)
        axes[i].set(ylabel=_label(part))
    for i, part in enumerate(description.outputs, len(description.inputs)):
        time, values = _thin(record.time, record.outputs[:, i - len(description.inputs)])
        axes[i].plot(time, display_unit(part.unit)[1] * values, color=BLUE, lw=1)
        _draw_levels(axes[i], part, values)
        axes[i].set(ylabel=_label(part))


def episodes_figure(
    description: PlantDescription, records: Mapping[str, Record]
) -> matplotlib.figure.Figure:
    """Several experiments of one plant side by side, by title."""
    rows = len(description.inputs) + len(description.outputs)
    figure, axes = _figure(rows, len(records), width=3.2 * len(records))
    for column, (title, record) in enumerate(records.items()):
        _draw_episode(axes[:, column], description, record)
        axes[0, column].set(title=title)
        axes[-1, column].set(xlabel="time [s]")
    _add_legend(figure, *axes[:, 0])
    figure.suptitle(f"{description.name}: nominal response")
    return figure


def information_figure(
    description: PlantDescription, record: Record, percent: Mapping[str, float | None]
) -> matplotlib.figure.Figure:
    """The input, and the least standard deviation of each parameter in percent."""
    inputs = description.inputs
    figure, axes = _figure(len(inputs) + 1)
    for i, part in enumerate(inputs):
        time, values = _thin(record.time, record.inputs[:, i])
        axes[i, 0].step(time, values, where="post", color=GREEN, lw=1)
        axes[i, 0].set(ylabel=_label(part))
    axes[len(inputs) - 1, 0].set(xlabel="time [s]")
    axis, finite = axes[-1, 0], {n: v for n, v in percent.items() if v is not None}
    axis.plot(list(finite.values()), list(finite), "o", color=BLUE, ms=8)
    for i, value in enumerate(finite.values()):
        axis.annotate(
            f"{number(value)} %", (value, i), (8, 0), textcoords="offset points", va="center"
        )
    axis.set(
        xlabel="least standard deviation (Cramér-Rao) [%]", xscale="log" if finite else "linear"
    )
    axis.invert_yaxis()
    axis.margins(x=0.15)
    return figure


def benchmark_figure(rows: Sequence[Mapping[str, Any]], title: str) -> matplotlib.figure.Figure:
    """Mean relative error of each method and estimator beside its Cramér-Rao bound."""
    names = list(rows[0]["relative_error_percent"])
    methods = list(dict.fromkeys(row["method"] for row in rows))
    estimators = list(dict.fromkeys(row["estimator"] for row in rows))
    figure, axes = _figure(1, len(names), height=3.2, width=3.2 * len(names))
    for axis, name in zip(axes[0], names, strict=True):
        for e, estimator in enumerate(estimators):
            chosen = [r for r in rows if r["estimator"] == estimator]
            place = [
                methods.index(r["method"]) + 0.12 * (e - (len(estimators) - 1) / 2) for r in chosen
            ]
            means = [r["relative_error_percent"][name]["mean"] for r in chosen]
            colour = (BLUE, ORANGE, GREEN, RED)[e % 4]
            axis.plot(place, means, "o", color=colour, ms=6, label=estimator)
        for m, method in enumerate(methods):
            # What an efficient estimator's mean error would be: sqrt(2 / pi) of the bound.
            bound = next(r for r in rows if r["method"] == method)["cramer_rao_percent"][name]
            label = "attainable (0.80 of the bound)" if m == 0 else None
            axis.hlines(0.798 * bound, m - 0.35, m + 0.35, color=GREY, lw=2, label=label)
        axis.set_xticks(range(len(methods)), methods)
        axis.set(yscale="log", title=name)
    axes[0, 0].set(ylabel="mean relative error [%]")
    _add_legend(figure, axes[0, 0])
    figure.suptitle(title)
    return figure
