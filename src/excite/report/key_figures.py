"""What a run found, in one line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from .answer import answered
from .estimates import parameter_cells
from .numbers import number
from .rows import EstimateSummary, Row
from .study_table import StudyTable, gain_cell, has_gain, violations_cell

_MOST = 3  # parameters in a line


def of_experiment(sidecar: Mapping[str, Any]) -> str:
    """What was played, on what, and how it ended."""
    made, ended = sidecar.get("provenance") or {}, sidecar.get("ended") or {}
    rig = f"rig {made['rig']}" if made.get("rig") else "simulated" * bool(made.get("simulated"))
    end = f"{ended['reason']}, {ended['num_samples']} samples" if ended else ""
    return ", ".join(
        word for word in (made.get("excitation") or made.get("played"), rig, end) if word
    )


def of_identification(result: EstimateSummary) -> str:
    """Its first estimates and its worst fit; its status where there is no estimate."""
    if not result.is_usable:
        return result.status
    free = {name: p for name, p in result.params.items() if not p.held}
    words = [f"{name} {parameter_cells(name, p)[2]}" for name, p in free.items()]
    if len(words) > _MOST:
        words[_MOST:] = [f"{len(words) - _MOST} more"]
    fits = [fit for fit in result.model_fit_percent.values() if math.isfinite(fit)]
    return ", ".join(words + [f"fit {number(min(fits), 4)} %"] * bool(fits))


def of_study(table: StudyTable) -> str:
    """The most informative of its excitations without a violation."""
    answer = answered(table.rows, table.study, {})
    if answer.best is None:
        return "no excitation without a violation"
    return _line(answer.best, has_gain(table.rows))


def of_training(table: StudyTable) -> str:
    """What its agents reach."""
    rows = answered(table.rows, table.study, {}).rows
    in_nats = has_gain(table.rows)
    return "; ".join(_line(row, in_nats) for row in rows if row.method in table.study.agents)


def _line(row: Row, in_nats: bool) -> str:
    told = (
        f"{gain_cell(row.expected_gain)} nats"
        if in_nats
        else f"log det {row.log_det_information:.2f}"
    )
    return f"{row.method}: {told}, violations {violations_cell(row)}"
