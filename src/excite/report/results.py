"""Text and HTML of an identification and an information result.

The command line prints the same text as `repr` in Python; a notebook gets the table as HTML.
The data are those of the results' `to_dict`.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

from .estimates import (
    held_out_fit,
    largest_correlation,
    parameter_cells,
    parameter_header,
    residual_in_words,
)
from .numbers import digits_for, number
from .rows import EstimateSummary, HeldOut
from .tables import Table, html_table, text_table

_WIDTH = 80
Data = Mapping[str, Any]
"""A result as returned by its `to_dict`."""


def wrapped(text: str) -> str:
    """Text with its sentences broken into lines."""
    return "\n".join(
        textwrap.fill(line, _WIDTH) if len(line) > _WIDTH else line for line in text.split("\n")
    )


# ------------------------------------------------------------------------- identification


def _estimates(result: EstimateSummary) -> tuple[str, Table]:
    title = (
        f"{result.plant}, {result.estimator}, initial state {result.initial_state}: {result.status}"
    )
    rows = [parameter_cells(name, p)[:-1] for name, p in result.params.items()]
    return title, (parameter_header()[:-1], rows)


def judgement(result: EstimateSummary) -> list[str]:
    """Fits, tests of the residual, verdict and correlation, one a line."""
    if not result.is_usable:
        return list(result.verdict)
    lines = [
        f"{name}: {_fits(result, name)}, {residual_in_words(result, name)}"
        for name in result.fit_percent
    ]
    lines += [
        f"{v.file}: held-out {name} {_fits(v, name)}" + (f", {v.initial_state}" if i == 0 else "")
        for v in result.validation
        for i, name in enumerate(v.fit_percent)
    ]
    if result.process_noise is not None and result.measurement_noise is not None:
        lines.append(
            f"process noise [state unit / sqrt(s)]: {_named(result.process_noise)}; "
            f"measurement noise: {_named(result.measurement_noise)}"
        )
    lines += result.verdict
    if sum(not p.held for p in result.params.values()) > 1:
        lines.append(f"largest correlation: {largest_correlation(result)}")
    return lines


def _fits(result: EstimateSummary | HeldOut, output: str) -> str:
    """Fit of the simulation, and of the one-step prediction where there is one."""
    simulated = f"{number(result.fit_percent[output], 4)} %"
    if result.prediction_fit_percent is None:
        return f"fit {simulated}"
    predicted = f"{number(result.prediction_fit_percent[output], 4)} %"
    words = f"fit of the one-step prediction {predicted}, of the simulation {simulated}"
    if isinstance(result, HeldOut) and result.inside_band_percent is not None:
        inside = number(result.inside_band_percent[output], 3)
        words += f", {inside} % of the samples inside the 95 % band of the prediction"
    return words


def _named(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {number(value)}" for name, value in values.items())


def identification_text(result: EstimateSummary) -> str:
    """Parameters with their intervals, tests and verdict, as plain text."""
    title, (header, rows) = _estimates(result)
    return "\n".join([text_table(title, header, rows), "", *judgement(result)])


def posterior_text(posterior: Data) -> str:
    """Means and 95 % credible intervals of posterior samples, as plain text.

    Args:
        posterior: of `excite.estimation.posterior.summary`.
    """
    noise = {f"noise of {name}": p for name, p in (posterior["noise_sd"] or {}).items()}
    rows = []
    for name, p in {**posterior["params"], **noise}.items():
        digits = digits_for(p["mean"], p["sd"])
        ends = " to ".join(number(end, digits) for end in p["ci95"])
        of_chains = [number(p["rhat"], 4), f"{p['ess']:.0f}"]
        rows.append([name, p["unit"], number(p["mean"], digits), ends, *of_chains])
    header = ["posterior", "unit", "mean", "95 % credible interval", "rhat", "ess"]
    drawn = (
        f"{posterior['chains']} chains of {posterior['samples']} samples, "
        f"{posterior['divergences'] or 'no'} divergences"
    )
    return "\n".join([text_table("", header, rows), "", drawn, *posterior["verdict"]])


def identification_html(result: EstimateSummary) -> str:
    """The same for a notebook."""
    title, (header, rows) = _estimates(result)
    return html_table(title, header, rows) + _paragraphs(judgement(result))


def _paragraphs(lines: list[str]) -> str:
    return html_table("", [""], [[line] for line in lines])


# ----------------------------------------------------------------------------- comparison


def compared_plants(result: Data) -> tuple[str, Table]:
    """Title and table of several plants of the same records."""
    best = min(p["bic"] for p in result["plants"])
    found = [EstimateSummary.of(p["identification"]) for p in result["plants"]]
    outputs, held_out = list(found[0].fit_percent), bool(found[0].validation)
    header = ["plant", "unknowns", "log likelihood", "BIC - least", "p", *_columns(outputs, "fit")]
    header += _columns(outputs, "held-out fit") if held_out else []
    rows = []
    for p, own in zip(result["plants"], found, strict=True):
        row = [p["plant"], str(p["num_unknowns"]), number(p["log_likelihood"], 6)]
        row += [number(p["bic"] - best, 4), "–" if p["p_value"] is None else number(p["p_value"])]
        row += [number(own.fit_percent[name], 4) for name in outputs]
        if held_out:
            row += [number(held_out_fit(own, name), 4) for name in outputs]
        rows.append(row)
    states = " or ".join(sorted({own.initial_state for own in found}))
    return f"plants, likeliest first; initial state {states}", (header, rows)


def _columns(outputs: list[str], what: str) -> list[str]:
    """Titles of a column for each output."""
    return [f"{what} of {name} [%]" if len(outputs) > 1 else f"{what} [%]" for name in outputs]


def _residuals(result: Data) -> list[str]:
    """A line on each plant's residual."""
    found = [(p["plant"], EstimateSummary.of(p["identification"])) for p in result["plants"]]
    return [
        "; ".join([
            f"{plant}: {own.status}",
            *(f"{name}: {residual_in_words(own, name)}" for name in own.fit_percent),
        ])
        for plant, own in found
    ]  # fmt: skip


def comparison_text(result: Data) -> str:
    """Several plants, the likeliest first, as plain text."""
    title, (header, rows) = compared_plants(result)
    return "\n".join([text_table(title, header, rows), "", *_residuals(result)])


def comparison_html(result: Data) -> str:
    """The same for a notebook."""
    title, (header, rows) = compared_plants(result)
    return html_table(title, header, rows) + _paragraphs(_residuals(result))


# ---------------------------------------------------------------------------- information


def _bounds(result: Data) -> tuple[str, Table]:
    title = (
        f"{result['plant']}, {result['excitation']}, {result['num_steps']} steps, "
        f"initial state {result['initial_state']}: best possible standard deviation"
    )
    rows = [
        [
            name,
            p["unit"],
            number(p["value"], 5),
            number(p["cramer_rao_bound"]),
            number(p["cramer_rao_percent"]),
        ]
        for name, p in result["params"].items()
    ]
    return title, (["symbol", "unit", "value", "standard deviation", "percent"], rows)


def _criteria(result: Data) -> list[str]:
    return [
        f"relative information: log det {number(result['log_det_information'], 4)}, "
        f"trace of the inverse {number(result['a_optimality'])}, "
        f"smallest eigenvalue {number(result['e_optimality'])}",
        f"{result['identifiability']}{_tested(result['structure'])}",
        *result["verdict"],
    ]


def _tested(structure: Data | None) -> str:
    """What the structural test was made with."""
    if structure is None:
        return " (structural test not made: the response to random inputs is not finite)"
    rank = f"{structure['rank']} of {structure['num_unknowns']}"
    return f" (structural test: rank {rank}; {structure['tried']})"


def information_text(result: Data) -> str:
    """Best possible standard deviations and the criteria, as plain text."""
    title, (header, rows) = _bounds(result)
    return "\n".join([text_table(title, header, rows), "", *_criteria(result)])


def information_html(result: Data) -> str:
    """The same for a notebook."""
    title, (header, rows) = _bounds(result)
    return html_table(title, header, rows) + _paragraphs(_criteria(result))
