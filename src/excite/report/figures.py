"""Figures of experiments, estimates and comparisons."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib.axes
import matplotlib.figure
import numpy as np
from jaxtyping import Float, Int

from ..description import HALF_95, PlantDescription, display_unit, with_unit
from ..record import Record
from ..record.figure import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    add_legend,
    add_title,
    axis_label,
    colour_of,
    new_figure,
    thin,
)
from .numbers import digits_for, number
from .rows import EstimatedParameter, EstimateSummary, Row

_LEAST_KNOWN = 1e4  # an interval over its target that is drawn
_HIGHEST = 5.0  # growth of a profile that is drawn, over the limit


def identification_figure(
    description: PlantDescription,
    result: EstimateSummary,
    record: Record,
    simulated: Float[np.ndarray, "sample output"],
) -> matplotlib.figure.Figure:
    """Measured against simulated outputs, residuals, and the parameters' intervals.

    With `pem` the outputs of the plant are those of its one-step prediction.
    """
    word = "predicted one step ahead" if result.is_predicted else "simulated"
    outputs = description.outputs
    figure, axes = new_figure(2 * len(outputs) + 1)
    for i, part in enumerate(outputs):
        top, below = axes[2 * i, 0], axes[2 * i + 1, 0]
        factor = display_unit(part.unit)[1]
        residual = record.outputs[:, i] - simulated[:, i]
        time, measured, model, residual = thin(
            record.time, record.outputs[:, i], simulated[:, i], residual
        )
        top.plot(time, factor * measured, color=GREY, lw=1.6, label="measured")
        top.plot(time, factor * model, color=BLUE, lw=1, ls="--", label=word)
        fit = number(result.model_fit_percent[part.name], 4)
        top.set(ylabel=axis_label(part), title=f"{part.name}: fit {fit} %")
        below.plot(time, factor * residual, color=ORANGE, lw=0.8)
        below.set(ylabel=with_unit("residual", display_unit(part.unit)[0]))
    axes[-2, 0].set(xlabel="time [s]")
    _draw_intervals(axes[-1, 0], result.params)
    add_legend(figure, axes[0, 0])
    add_title(figure, f"{description.name}: {result.estimator}, {result.status}")
    return figure


def _draw_intervals(axis: matplotlib.axes.Axes, params: Mapping[str, EstimatedParameter]) -> None:
    """95 % intervals in percent of the estimate."""
    for i, (name, p) in enumerate(params.items()):
        value, error = p.estimate, p.std_error
        if not math.isfinite(error):
            axis.text(0, i, f"{name} held", color=GREY, va="center", ha="center")
            continue
        ends = [end if math.isfinite(end) else value for end in p.ci95]  # an open side has no line
        low, high = (100 * abs(end - value) / (abs(value) or math.nan) for end in ends)
        axis.errorbar(0, i, xerr=[[low], [high]], color=BLUE, fmt="o", capsize=4, ms=4)
        text = f"{number(value, digits_for(value, error))} {p.unit}"
        axis.annotate(text, (0, i), (0, 7), textcoords="offset points", ha="center", fontsize=8)
    axis.set_yticks(range(len(params)), params)
    axis.set(ylim=(len(params) - 0.4, -0.9), xlabel="95 % interval [% of the estimate]")


def knowledge_figure(
    title: str,
    samples: Int[np.ndarray, " sample"],
    halves: Mapping[str, Float[np.ndarray, " sample"]],
    rounds: Sequence[Mapping[str, Any]],
    allowed: Mapping[str, float],
) -> matplotlib.figure.Figure:
    """Half of the 95 % intervals over those asked for, after every sample of a campaign.

    Lines are the Cramér-Rao bound for the declared noise; dots are the intervals of the estimates.

    Args:
        title: of the figure.
        samples: counted from the first of the campaign.
        halves: of the intervals by the bound, by quantity.
        rounds: as JSON-ready data.
        allowed: half of the interval that each target allows.
    """
    figure, axes = new_figure(1)
    axis = axes[0, 0]
    ends = np.cumsum([r["num_samples"] for r in rounds])
    for i, (name, most) in enumerate(allowed.items()):
        judged = [r["known"].get(name, {}).get("ci95_half", np.nan) for r in rounds]
        with np.errstate(divide="ignore", invalid="ignore"):  # nothing is a share of nothing
            bound, found = np.divide(halves[name], most), np.divide(judged, most)
        shown = np.where(np.isfinite(bound), bound, np.nan)
        axis.plot(samples, shown, color=colour_of(i), lw=1.4, label=name)
        axis.plot(ends, found, "o", color=colour_of(i), ms=5)
    axis.axhline(1, color="black", lw=0.8, ls="--", label="asked for")
    for end in ends[:-1]:
        axis.axvline(end, color=GREY, lw=0.8, ls=":")
    axis.set(yscale="log", xlabel="samples", ylabel="95 % interval over the target")
    axis.set_ylim(top=min(axis.get_ylim()[1], _LEAST_KNOWN))
    add_legend(figure, axis)
    add_title(figure, title)
    return figure


def selection_figure(
    title: str,
    spent: Float[np.ndarray, " experiment"],
    names: Sequence[str],
    shares: Mapping[str, Float[np.ndarray, " experiment"]],
) -> matplotlib.figure.Figure:
    """Half of the 95 % intervals over those asked for, after each of some experiments.

    Args:
        title: of the figure.
        spent: cost before the first, and after each experiment.
        names: of the experiments, in their order.
        shares: by target, before the first and after each; reached at one.
    """
    figure, axes = new_figure(1)
    axis = axes[0, 0]
    for i, (name, share) in enumerate(shares.items()):
        shown = np.where(np.isfinite(share), share, np.nan)
        axis.plot(spent, shown, color=colour_of(i), marker="o", ms=4, lw=1.4, label=name)
    axis.axhline(1, color="black", lw=0.8, ls="--", label="asked for")
    axis.set(yscale="log", xlabel="cost", ylabel="95 % interval over the target")
    for before, end, name in zip(spent[:-1], spent[1:], names, strict=True):
        axis.axvline(end, color=GREY, lw=0.8, ls=":")
        middle = ((before + end) / 2, 1.02)
        axis.annotate(name, middle, xycoords=axis.get_xaxis_transform(), ha="center", fontsize=8)
    add_legend(figure, axis)
    add_title(figure, title)
    return figure


def candidates_figure(
    description: PlantDescription,
    time: Float[np.ndarray, " sample"],
    names: Sequence[str],
    inputs: Sequence[Float[np.ndarray, "sample input"]],
    shares: Sequence[Mapping[str, Float[np.ndarray, " sample"]]],
) -> matplotlib.figure.Figure:
    """Inputs of experiments that could be made next, and what would be known after each sample.

    Args:
        description: of the plant.
        time: of the samples [s].
        names: of the candidates, a column each.
        inputs: of each candidate.
        shares: of each candidate, the 95 % interval over that asked for, by parameter.
    """
    figure, axes = new_figure(1 + len(description.inputs), len(names), sharey="row")
    for column, (name, own, known) in enumerate(zip(names, inputs, shares, strict=True)):
        for row, part in enumerate(description.inputs):
            axis = axes[row, column]
            axis.step(time[: len(own)], own[:, row], where="post", color=colour_of(0), lw=1.0)
            axis.set(ylabel="" if column else with_unit(part.name, part.unit))
        axes[0, column].set(title=name)
        axis = axes[-1, column]
        for i, (parameter, share) in enumerate(known.items()):
            shown = np.where(np.isfinite(share), share, np.nan)
            axis.plot(time[: len(share)], shown, color=colour_of(i), lw=1.4, label=parameter)
        axis.axhline(1, color="black", lw=0.8, ls="--", label="asked for")
        axis.set(yscale="log", xlabel="time [s]")
    axes[-1, 0].set(ylabel="95 % interval over the target")
    add_legend(figure, axes[-1, 0])
    return figure


def rivals_figure(
    description: PlantDescription,
    time: Float[np.ndarray, " sample"],
    inputs: Float[np.ndarray, "time input"],
    responses: Mapping[str, Float[np.ndarray, "sample output"]],
) -> matplotlib.figure.Figure:
    """An experiment that tells rival plants apart, and the outputs of each of them.

    Args:
        description: of a plant with the rivals' inputs and outputs.
        time: of the samples [s].
        inputs: of the experiment, without that after the last sample.
        responses: noise-free outputs of each rival, by name.
    """
    names = (*description.inputs, *description.outputs)
    figure, axes = new_figure(len(names))
    for row, part in enumerate(names):
        axes[row, 0].set(ylabel=with_unit(part.name, part.unit))
    for i in range(len(description.inputs)):
        own = np.append(inputs[:, i], inputs[-1, i])
        axes[i, 0].step(time, own, where="post", color="black", lw=1.0)
    for column, (name, outputs) in enumerate(responses.items()):
        for i in range(len(description.outputs)):
            axis = axes[len(description.inputs) + i, 0]
            axis.plot(time, outputs[:, i], color=colour_of(column), lw=1.4, label=name)
    axes[-1, 0].set(xlabel="time [s]")
    add_legend(figure, axes[-1, 0])
    return figure


def autocorrelation_figure(
    description: PlantDescription, residuals: Sequence[Float[np.ndarray, "sample output"]]
) -> matplotlib.figure.Figure:
    """Autocorrelation of the residuals of all records, and its 95 % band for white noise."""
    outputs = description.outputs
    figure, axes = new_figure(1, len(outputs), width=4.0 * len(outputs), sharey="row")
    for i, (axis, part) in enumerate(zip(axes[0], outputs, strict=True)):
        _draw_autocorrelation(axis, [r[:, i] for r in residuals])
        axis.set(title=part.name)
    axes[0, 0].set(ylabel="autocorrelation")
    return figure


def _draw_autocorrelation(
    axis: matplotlib.axes.Axes, residuals: Sequence[Float[np.ndarray, " sample"]]
) -> None:
    lags = np.arange(1, min(25, min(len(r) for r in residuals) // 5) + 1)  # Ljung-Box's
    centred = [r - r.mean() for r in residuals]
    power = sum(float(c @ c) for c in centred) or math.nan
    values = [sum(float(c[lag:] @ c[:-lag]) for c in centred) / power for lag in lags]
    axis.vlines(lags, 0, values, color=ORANGE, lw=2)
    axis.axhline(0, color="black", lw=0.6)
    for sign in (1, -1):
        band = sign * HALF_95 / math.sqrt(sum(map(len, residuals)))
        axis.axhline(band, color=GREY, ls="--", lw=1)
    axis.set(xlabel="lag [samples]")


def diagnosis_figure(
    description: PlantDescription,
    result: EstimateSummary,
    residuals: Sequence[Float[np.ndarray, "sample output"]],
) -> matplotlib.figure.Figure:
    """How far an estimate can be trusted.

    The costs at which the starts of the search ended, the correlation of the estimates,
    the autocorrelation of the residuals and, where there are any, the profile likelihoods.
    """
    panels: list[Callable[[matplotlib.axes.Axes], object]] = []
    if result.starts:
        panels.append(lambda axis: _draw_starts(axis, result.starts))
    if sum(p.has_interval for p in result.params.values()) > 1:
        panels.append(lambda axis: _draw_correlations(axis, result))
    for i, part in enumerate(description.outputs):

        def draw(axis: matplotlib.axes.Axes, i: int = i, name: str = part.name) -> None:
            _draw_autocorrelation(axis, [r[np.isfinite(r[:, i]), i] for r in residuals])
            axis.set(title=f"residual of {name}", ylabel="autocorrelation")

        panels.append(draw)
    for name in result.profiles:
        panels.append(lambda axis, name=name: _draw_profile(axis, result, name))
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    figure, axes = new_figure(rows, columns, height=2.8, width=3.4 * columns)
    for axis, panel in itertools.zip_longest(axes.ravel(), panels):
        if panel is None:
            axis.set_visible(False)
        else:
            panel(axis)
    add_title(figure, f"{description.name}: {result.estimator}, {result.status}")
    return figure


def _draw_starts(axis: matplotlib.axes.Axes, costs: Sequence[float]) -> None:
    """Costs over the least one, in their order."""
    finite = np.sort([cost for cost in costs if math.isfinite(cost)])
    ratio, numbers = finite / finite[0], range(1, len(finite) + 1)
    axis.plot(numbers, ratio, "o-", color=BLUE, ms=4)
    axis.set(title="starts of the search", xlabel="start, the best first", xticks=numbers)
    is_wide = ratio[-1] > 10
    axis.set(ylabel="cost / least", yscale="log" if is_wide else "linear")
    axis.set(ylim=(0.8, None if is_wide else max(2.0, 1.1 * ratio[-1])))


def _draw_correlations(axis: matplotlib.axes.Axes, result: EstimateSummary) -> None:
    """Correlation of the estimates, a field for each pair."""
    free = [i for i, p in enumerate(result.params.values()) if p.has_interval]
    names = [list(result.params)[i] for i in free]
    values = np.array(result.correlation, float)[np.ix_(free, free)]
    axis.imshow(values, vmin=-1, vmax=1, cmap="RdBu_r")
    for i, j in itertools.product(range(len(free)), repeat=2):
        is_dark = abs(values[i, j]) > 0.6
        axis.text(
            j,
            i,
            f"{values[i, j]:.2f}",
            ha="center",
            va="center",
            fontsize=8,
            color="white" if is_dark else "black",
        )
    axis.set_xticks(range(len(names)), names)
    axis.set_yticks(range(len(names)), names)
    axis.grid(visible=False)
    axis.set(title="correlation of the estimates")


def _draw_profile(axis: matplotlib.axes.Axes, result: EstimateSummary, name: str) -> None:
    """Growth of the sum of squares with one parameter held, and the limit of its interval."""
    value, growth = np.array(result.profiles[name]).T
    shown = np.isfinite(growth) & (growth < _HIGHEST)
    value, growth = value[shown], np.maximum(growth[shown], 0.0)
    between = np.linspace(value[0], value[-1], 200)
    side = np.sign(value - result.params[name].estimate)
    root = np.interp(between, value, side * np.sqrt(growth))  # nearly a straight line
    axis.plot(between, root**2, color=BLUE, lw=1)
    axis.plot(value, growth, "o", color=BLUE, ms=3)
    axis.axhline(1, color=GREY, ls="--", lw=1)
    for end in result.params[name].ci95:
        if math.isfinite(end):
            axis.axvline(end, color=GREY, lw=0.8)
    axis.set(title=f"profile of {name}", xlabel=with_unit(name, result.params[name].unit))
    axis.set(ylabel="growth of squares / limit", ylim=(-0.1, None))
    axis.locator_params(axis="x", nbins=4)


def correlation_figure(result: EstimateSummary) -> matplotlib.figure.Figure | None:
    """95 % ellipse of every pair of estimated parameters; None where there is no pair."""
    params = list(result.params.items())
    free = [i for i, (_, p) in enumerate(params) if p.has_interval]
    pairs = list(itertools.combinations(free, 2))
    if not pairs:
        return None
    columns = min(len(pairs), 3)
    rows = -(-len(pairs) // columns)
    figure, axes = new_figure(rows, columns, height=2.8, width=3.2 * columns)
    angle = np.linspace(0, 2 * np.pi, 200)
    for axis in axes.ravel()[len(pairs) :]:
        axis.set_visible(False)
    for axis, (i, j) in zip(axes.ravel(), pairs, strict=False):
        correlation = result.correlation[i][j]
        # Radius at which two normal variables lie within 95 times in 100.
        radii = [245 * p.std_error / abs(p.estimate) for _, p in (params[i], params[j])]
        rest = math.sqrt(max(0.0, 1 - correlation**2))
        tilted = correlation * np.cos(angle) + rest * np.sin(angle)
        axis.fill(radii[0] * np.cos(angle), radii[1] * tilted, color=BLUE, alpha=0.2, lw=0)
        axis.plot(radii[0] * np.cos(angle), radii[1] * tilted, color=BLUE, lw=1.2)
        axis.plot(0, 0, "+", color=BLUE, ms=8)
        (first, _), (second, _) = params[i], params[j]
        axis.set(xlabel=f"{first} [%]", ylabel=f"{second} [%]")
        axis.set(title=f"correlation {correlation:+.3f}")
        axis.locator_params(nbins=5)
    return figure


def information_figure(
    description: PlantDescription, record: Record, percent: Mapping[str, float | None]
) -> matplotlib.figure.Figure:
    """The input, and the smallest possible standard deviation of each parameter in percent."""
    inputs = description.inputs
    figure, axes = new_figure(len(inputs) + 1)
    for i, part in enumerate(inputs):
        time, values = thin(record.time, record.inputs[:, i])
        axes[i, 0].step(time, values, where="post", color=GREEN, lw=1)
        axes[i, 0].set(ylabel=axis_label(part))
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


def benchmark_figure(rows: Sequence[Row], title: str) -> matplotlib.figure.Figure:
    """Mean relative error of each method and estimator beside its Cramér-Rao bound."""
    names = rows[0].parameters
    methods = list(dict.fromkeys(row.method for row in rows))
    estimators = list(dict.fromkeys(row.estimator for row in rows))
    each = max(3.2, 0.3 * len(methods))  # inches
    figure, axes = new_figure(1, len(names), height=each, width=each * len(names))
    for axis, name in zip(axes[0], names, strict=True):
        for e, estimator in enumerate(estimators):
            chosen = [r for r in rows if r.estimator == estimator]
            place = [
                methods.index(r.method) + 0.12 * (e - (len(estimators) - 1) / 2) for r in chosen
            ]
            means = [r.relative_error_percent[name].mean for r in chosen]
            axis.plot(place, means, "o", color=colour_of(e), ms=6, label=estimator)
        for m, method in enumerate(methods):
            # Mean error of an efficient estimator: sqrt(2 / pi) of the bound.
            bound = next(r for r in rows if r.method == method).cramer_rao_percent[name]
            label = "attainable (0.80 of the bound)" if m == 0 else None
            axis.hlines(0.798 * bound, m - 0.35, m + 0.35, color=GREY, lw=2, label=label)
        ticks = [method + _absent(rows, method, name) for method in methods]
        is_tight = len("".join(ticks)) > 24  # otherwise they overlap
        slant = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"} if is_tight else {}
        axis.set_xticks(range(len(methods)), ticks, **slant)
        axis.set(yscale="log", title=name, xlim=(-0.5, len(methods) - 0.5))
    axes[0, 0].set(ylabel="mean relative error [%]")
    add_legend(figure, axes[0, 0])
    add_title(figure, title)
    return figure


def _absent(rows: Sequence[Row], method: str, name: str) -> str:
    """The reason why a method, or one of its estimators, has no error to draw."""
    absent = [
        row
        for row in rows
        if row.method == method and math.isnan(row.relative_error_percent[name].mean)
    ]
    if any(row.viable_seeds == 0 for row in absent):
        return " (collapsed)"
    return f" ({', '.join(row.estimator for row in absent)} failed)" if absent else ""
