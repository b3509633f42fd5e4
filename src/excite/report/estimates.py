"""The cells of tables of estimates and their residuals."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ..description import RARE, display_unit
from .numbers import digits_for, number
from .rows import EstimatedParameter, EstimateSummary
from .tables import Table

_SMALLEST = 1e-300  # p-value that is written as a number


def parameter_header() -> list[str]:
    """Column titles of a table of estimates."""
    return ["symbol", "unit", "estimate", "standard error", "95 % interval", "relative to nominal"]


def parameter_cells(name: str, param: EstimatedParameter) -> list[str]:
    """One estimate, to two digits of its error."""
    relative = param.relative_to_nominal
    relative = "–" if relative is None else f"{relative:.4f}"
    if param.held:
        return [name, param.unit, f"{number(param.estimate, 5)} (held)", "–", "–", relative]
    digits, (low, high) = digits_for(param.estimate, param.std_error), param.ci95
    return [
        name,
        param.unit,
        number(param.estimate, digits),
        number(param.std_error),
        _interval(low, high, digits),
        relative,
    ]


def _interval(low: float, high: float, digits: int) -> str:
    """Both ends; an open one, which a file does not hold, is infinite."""
    if not (math.isfinite(low) or math.isfinite(high)):
        return "–"
    ends = zip((low, high), ("-∞", "∞"), strict=True)
    shown = (number(end, digits) if math.isfinite(end) else word for end, word in ends)
    return " to ".join(shown)


def residual_cells(result: EstimateSummary, output: str) -> list[str]:
    """Whether a residual is white and whether it follows the input, each with its p-value."""
    white, follows = result.whiteness_p_value[output], result.structure_p_value[output]
    cells = []
    for p, words in ((white, ("yes", "no")), (follows, ("no", "yes"))):
        # One too small for the computer is not zero.
        shown = number(p) if p > _SMALLEST else f"< {_SMALLEST:g}"
        cells += [words[p < RARE], shown] if math.isfinite(p) else ["–", "–"]
    return cells


def residual_size(result: EstimateSummary, output: str) -> str:
    """Root mean square of a residual with its unit."""
    if output not in result.residual:
        return "–"
    size = result.residual[output]
    unit, factor = display_unit(size.unit)
    return f"{number(factor * size.rms)} {unit}".rstrip()


def _equal(p: str) -> str:
    return p if p.startswith("<") else f"= {p}"


def residual_in_words(result: EstimateSummary, output: str) -> str:
    """The size of the residual and the same tests as part of a sentence."""
    white, p_white, follows, p_follows = residual_cells(result, output)
    parts = [f"{residual_size(result, output)} RMS"] if output in result.residual else []
    if white != "–":
        parts.append(f"{'white' if white == 'yes' else 'not white'} (p {_equal(p_white)})")
    if follows != "–":
        word = "follows" if follows == "yes" else "does not follow"
        parts.append(f"{word} the input (p {_equal(p_follows)})")
    if white == follows == "–":
        parts.append("too small or too short to be tested")
    return f"residual {', '.join(parts)}"


def largest_correlation(result: EstimateSummary) -> str:
    """The largest correlation between two estimates, and between which."""
    names, table = list(result.params), np.nan_to_num(np.array(result.correlation, float))
    pairs = np.stack(np.triu_indices(len(names), 1), axis=1)
    i, j = max(pairs, key=lambda pair: abs(table[*pair]))
    return f"{table[i, j]:+.3f} between {names[i]} and {names[j]}"


def beside(results: Mapping[str, EstimateSummary]) -> Table:
    """Column titles and rows: estimates with intervals, and fits, side by side, by title."""
    header, every = ["", "unit", *results], list(results.values())
    names = {n: p.unit for result in every for n, p in result.params.items()}
    outputs = list(dict.fromkeys(n for result in every for n in result.fit_percent))
    rows = [["status", "", *(result.status for result in every)]]
    rows.append(["estimator", "", *(result.estimator for result in every)])
    for name, unit in names.items():
        rows.append([name, unit, *(_with_interval(name, result.params) for result in every)])
    for output in outputs:
        fits = [number(result.fit_percent.get(output), 4) for result in every]
        rows.append([f"fit of {output}", "%", *fits])
    for output in outputs:
        held_out = [held_out_fit(result, output) for result in every]
        if any(fit is not None for fit in held_out):
            rows.append([f"held-out fit of {output}", "%", *(number(fit, 4) for fit in held_out)])
    return header, rows


def held_out_fit(result: EstimateSummary, output: str) -> float | None:
    """Fit of the simulation, mean over the held-out records [%]; None without any."""
    fits = [own.fit_percent[output] for own in result.validation if output in own.fit_percent]
    return sum(fits) / len(fits) if fits else None


def _with_interval(name: str, params: Mapping[str, EstimatedParameter]) -> str:
    if name not in params:
        return "–"
    _, _, estimate, _, interval, _ = parameter_cells(name, params[name])
    return estimate if interval == "–" else f"{estimate} ({interval})"
