"""What a study answers: which excitation tells most and stays safe, and by how much."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from .numbers import number
from .rows import Row, StudyFacts
from .study_table import violations_cell
from .tables import Table

KNOWS_THE_PLANT = "clairvoyant"  # a reference, and no excitation that could be played
_USUAL = "chirp"  # of the classical excitations, what others are compared with
_MOST_ROWS = 14  # of a table that fits a screen


@dataclass(frozen=True)
class Answer:
    """The answer of a study.

    Attributes:
        rows: one for each excitation, with the estimator of the smallest errors; those without a
            violation first, and of them the most informative.
        best: the first of them; None where every excitation had violations.
        usual: what it is compared with; None where there is nothing else.
        sentences: two, and a third on what a search found.
    """

    rows: tuple[Row, ...]
    best: Row | None
    usual: Row | None
    sentences: tuple[str, ...]

    def table(self) -> Table:
        """At most one screen: information, errors and violations of each excitation."""
        names = self.rows[0].parameters
        header = ["excitation", "log det", *(f"{name} error %" for name in names), "violations"]
        return header, [
            [row.method, f"{row.log_det_information:.2f}",
             *(number(row.relative_error_percent[name].mean, 3) for name in names),
             violations_cell(row)]
            for row in self.rows[:_MOST_ROWS]
        ]  # fmt: skip

    @property
    def caption(self) -> str:
        """Of the table and the figure, to be copied."""
        row, left = self.rows[0], len(self.rows) - _MOST_ROWS
        more = f" {left} more are in the table of all results." * (left > 0)
        return (
            "Information (log det of the Fisher information), mean relative error of "
            f"{row.estimator}, and experiments that reached a critical level, with the 95 % "
            f"interval of their share.{more}"
        )


def answered(rows: Sequence[Row], study: StudyFacts, claims: Mapping[str, str]) -> Answer:
    """The answer of a study's table.

    Args:
        rows: of all methods and estimators.
        study: its settings.
        claims: by agent, what a search for violations found.
    """
    estimator = min({row.estimator: None for row in rows}, key=lambda name: _excess(rows, name))
    own = [r for r in rows if r.estimator == estimator and r.method != KNOWS_THE_PLANT]
    ranked = sorted(own, key=lambda row: (row.violations > 0, -row.log_det_information))
    if not ranked:
        ranked = [row for row in rows if row.estimator == estimator]
    safe = [row for row in ranked if row.violations == 0]
    best = safe[0] if safe else None
    classical = [row for row in ranked if row.method in study.methods and row is not best]
    usual = next((r for r in classical if r.method == _USUAL), classical[0] if classical else None)
    told = _told(ranked, safe, best, usual)
    claim = claims.get(best.method) if best else None
    searched = (claim or "").partition(";")[0].removeprefix("no certificate: ")
    last = (f"{searched[0].upper()}{searched[1:]}.",) if searched else ()
    return Answer(tuple(ranked), best, usual, (*told, *last))


def _excess(rows: Sequence[Row], estimator: str) -> float:
    """How far an estimator's errors lie above the Cramér-Rao bound, in the middle of all rows."""
    ratios = [
        error.rms / row.cramer_rao_percent[name]
        for row in rows
        if row.estimator == estimator
        for name, error in row.relative_error_percent.items()
        if math.isfinite(error.rms) and row.cramer_rao_percent[name] > 0
    ]
    return statistics.median(ratios) if ratios else math.inf


def _told(
    ranked: Sequence[Row], safe: Sequence[Row], best: Row | None, usual: Row | None
) -> tuple[str, ...]:
    """The answer in sentences."""
    if best is None:
        least = min(ranked, key=lambda row: row.violation_rate.estimate)
        return (
            f"No excitation was without a violation: {least.method} had the fewest, "
            f"{least.violations} of {least.evaluations}.",
        )
    many = f"Of {len(safe)} excitations" if len(safe) > 1 else "The only excitation"
    told = f"{many} that reached no critical level in these experiments"
    told += f", {best.method} tells most" if len(safe) > 1 else f" is {best.method}"
    told += f" about the plant: log det {best.log_det_information:.1f} of the Fisher information"
    if usual is not None:
        names = best.parameters
        ratios = [usual.cramer_rao_percent[n] / best.cramer_rao_percent[n] for n in names]
        gain = math.exp(statistics.fmean(map(math.log, ratios)))
        word = f"{gain:.2g} times smaller" if gain >= 1 else f"{1 / gain:.2g} times larger"
        told += (
            f". The standard errors that it allows are {word} than those of {usual.method} "
            "(Cramér-Rao bound, geometric mean over the parameters)"
        )
    most = 100 * best.violation_rate.ci95[1]
    return (
        f"{told}.",
        f"It reached a critical level in 0 of {best.evaluations} experiments (sampled; 95 %: at "
        f"most {most:.2g} %).",
    )
