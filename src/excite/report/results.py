"""Text and HTML of a record, an identification and an information result.

The command line prints the same text as `repr` in Python; a notebook gets the table as HTML.
The data are those of the results' `to_dict`.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..description import PlantDescription, display_unit
from ..record import Record
from ..record.rows import EstimateSummary
from .estimates import (
    largest_correlation,
    parameter_cells,
    parameter_header,
    residual_in_words,
)
from .numbers import number
from .tables import Table, html_table, text_table

if TYPE_CHECKING:
    import pandas

_WIDTH = 80
Data = Mapping[str, Any]
"""A result as returned by its `to_dict`."""


def data_frame(columns: Mapping[str, object], index: object = None) -> pandas.DataFrame:
    """Columns as a pandas DataFrame; ValueError where pandas is not installed."""
    try:
        import pandas
    except ImportError:
        raise ValueError("to_pandas needs pandas: pip install pandas") from None
    return pandas.DataFrame(columns, index)  # pyright: ignore[reportArgumentType]


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


def _judgement(result: EstimateSummary) -> list[str]:
    """Fits, tests of the residual, verdict and correlation, one a line."""
    lines = [
        f"{name}: fit {number(percent, 4)} %, {residual_in_words(result, name)}"
        for name, percent in result.fit_percent.items()
    ]
    lines += [
        f"{v.file}: held-out {name} fit {number(percent, 4)} %"
        for v in result.validation
        for name, percent in v.fit_percent.items()
    ]
    lines += result.verdict
    if len(result.params) > 1:
        lines.append(f"largest correlation: {largest_correlation(result)}")
    return lines


def identification_text(result: EstimateSummary) -> str:
    """Parameters with their intervals, tests and verdict, as plain text."""
    title, (header, rows) = _estimates(result)
    return "\n".join([text_table(title, header, rows), "", *_judgement(result)])


def identification_html(result: EstimateSummary) -> str:
    """The same for a notebook."""
    title, (header, rows) = _estimates(result)
    return html_table(title, header, rows) + _paragraphs(_judgement(result))


def _paragraphs(lines: list[str]) -> str:
    return html_table("", [""], [[line] for line in lines])


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
        *result["verdict"],
    ]


def information_text(result: Data) -> str:
    """Best possible standard deviations and the criteria, as plain text."""
    title, (header, rows) = _bounds(result)
    return "\n".join([text_table(title, header, rows), "", *_criteria(result)])


def information_html(result: Data) -> str:
    """The same for a notebook."""
    title, (header, rows) = _bounds(result)
    return html_table(title, header, rows) + _paragraphs(_criteria(result))


# --------------------------------------------------------------------------------- record


def record_text(record: Record) -> str:
    """A record in a few lines."""
    about = record.metadata.get("provenance") or {}
    made_with: Data = record.metadata.get("plant") or {}
    lines = [
        f"record of {made_with.get('name', 'an unknown plant')}"
        + "".join(f", {about[word]}" for word in ("excitation",) if word in about)
        + f": {len(record.time)} samples, every {record.dt:.4g} s"
    ]
    for kind, values in (("inputs", record.inputs), ("outputs", record.outputs)):
        parts = made_with.get(kind) or [
            {"name": f"{kind[:-1]} {i + 1}", "unit": ""} for i in range(values.shape[1])
        ]
        for part, column in zip(parts, values.T, strict=True):
            unit, factor = display_unit(part["unit"])
            low, high = number(factor * column.min()), number(factor * column.max())
            lines.append(f"  {part['name']}: {low} to {high} {unit}".rstrip())
    if "warning" in about:
        lines.append(f"warning: {about['warning']}")
    return "\n".join(lines)


# ---------------------------------------------------------------------------------- plant


def plant_text(d: PlantDescription) -> str:
    """A plant in a few lines: inputs, outputs, parameters."""

    def level(value: float | None, unit: str) -> str:
        shown, factor = display_unit(unit)
        return "" if value is None else f", critical level {factor * value:g} {shown}"

    lines = [f"plant {d.name}, sampled every {d.dt:g} s"]
    lines += [f"  input {i.name}: {i.lower:g} to {i.upper:g} {i.unit}" for i in d.inputs]
    lines += [f"  output {o.name} [{o.unit}]{level(o.critical_level, o.unit)}" for o in d.outputs]
    named = [f"{p.name} = {p.nominal:g} {p.unit}".rstrip() for p in d.parameters[:12]]
    rest = f", and {len(d.parameters) - 12} more" if len(d.parameters) > 12 else ""
    return "\n".join([*lines, f"  parameters {', '.join(named)}{rest}"])
