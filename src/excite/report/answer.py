"""What a run answers, in a few sentences.

A study: which excitation tells most and stays safe, and by how much. A record: whether it reached
a safety level, and when. An identification: the parameters, and whether to believe them. A
campaign: whether its targets are reached, and how near it came to a level.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..description import RARE, Output, PlantDescription, display_unit, listed
from ..record import Record
from .numbers import digits_for, number
from .rows import EstimatedParameter, EstimateSummary, Row, StudyFacts
from .study_table import (
    NUM_LABELS,
    StudyTable,
    gain_cell,
    has_gain,
    information_of,
    violations_cell,
)
from .tables import Table

KNOWS_THE_PLANT = "clairvoyant"  # a reference, and no excitation that could be played
_USUAL = "chirp"  # of the methods that are not trained, what others are compared with
_OFTEN = 0.05  # of the experiments: an estimator that fails more often is not chosen
_NEARLY = 1.05  # a ratio of standard errors below it is no difference
_MOST_ROWS = 14  # of a table that fits a screen
_MOST_PARAMETERS = 6  # of a sentence
_EVEN = 0.95  # an interval whose sides differ by more is no ± of the estimate


@dataclass(frozen=True)
class Answer:
    """The answer of a study.

    Attributes:
        rows: one for each excitation, with the estimator whose errors are nearest to the
            Cramér-Rao bound; those without a violation first, and of them the most informative.
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
        with_gain = has_gain(self.rows)
        gain = ["gain nats"] * with_gain
        header = ["excitation", *gain, "log det", *(f"{n} error %" for n in names), "violations"]
        return header, [
            [row.method, *[gain_cell(row.expected_gain)] * with_gain,
             f"{row.log_det_information:.2f}",
             *(number(row.relative_error_percent[name].mean, 3) for name in names),
             violations_cell(row)]
            for row in self._shown
        ]  # fmt: skip

    @property
    def _shown(self) -> list[Row]:
        """Rows that fit one screen: those with violations are not left out for want of room."""
        bad = [row for row in self.rows if row.violations][: _MOST_ROWS // 2]
        return [row for row in self.rows if not row.violations][: _MOST_ROWS - len(bad)] + bad

    @property
    def caption(self) -> str:
        """Of the table and the figure, to be copied."""
        row, left = self.rows[0], len(self.rows) - len(self._shown)
        more = f" {left} more are in the table of all results." * (left > 0)
        gain = (
            "Expected information gain (nats), information"
            if has_gain(self.rows)
            else "Information"
        )
        return (
            f"{gain} (log det of the Fisher information), mean relative error of "
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
    own = [row for row in rows if row.estimator == estimator]
    in_nats = has_gain(own)
    ranked = [row for row in own if row.method != KNOWS_THE_PLANT]
    ranked.sort(key=lambda row: _rank(row, in_nats))
    if not ranked:
        return Answer(tuple(own), None, None, ())
    safe = [row for row in ranked if row.violations == 0]
    best = safe[0] if safe else None
    classical = [row for row in ranked if row.method in study.methods and row is not best]
    usual = next((r for r in classical if r.method == _USUAL), classical[0] if classical else None)
    told = _told(ranked, safe, best, usual, in_nats)
    if best is not None:
        found = claims.get(best.method, _UNSEARCHED)
        is_searched = not found.startswith(_UNSEARCHED)
        last = f"search for violations: {found}" if is_searched else _NOBODY
        told = (*told, f"{last[0].upper()}{last[1:]}.")
    return Answer(tuple(ranked), best, usual, told)


_UNSEARCHED = "no certificate"
_NOBODY = "it was not searched for violations (excite falsify)"


def _rank(row: Row, in_nats: bool) -> tuple[bool, float]:
    """Excitations without a violation first, then by information; what is not finite is last."""
    worth = information_of(row, in_nats)
    return row.violations > 0, -worth if math.isfinite(worth) else math.inf


def best_columns(table: StudyTable) -> dict[str, set[int]]:
    """The columns of `cells` in which a method is the best of those that are safe, by method.

    Columns are those of errors, bounds and information, of a table of one estimator. Safe is a
    method without a violation whose estimates fail in at most 5 % of the experiments; one that
    knows the plant is left out.
    """
    rows, header = table.rows, table.cells()[0]
    smaller = dict[int, list[float]]()  # is better
    for i, name in enumerate(rows[0].parameters):
        column = NUM_LABELS + 2 * i
        smaller[column] = [row.relative_error_percent[name].mean for row in rows]
        smaller[column + 1] = [row.cramer_rao_percent[name] for row in rows]
    smaller[header.index("log det")] = [-row.log_det_information for row in rows]
    if "gain nats" in header:
        smaller[header.index("gain nats")] = [-information_of(row, True) for row in rows]
    if "D-efficiency" in header:
        known = (math.nan if row.d_efficiency is None else row.d_efficiency for row in rows)
        smaller[header.index("D-efficiency")] = [-value for value in known]
    found: dict[str, set[int]] = {row.method: set() for row in rows}
    for column, values in smaller.items():
        safe = [(v, r.method) for v, r in zip(values, rows, strict=True) if _is_safe(r)]
        least = min((value for value, _ in safe if math.isfinite(value)), default=math.nan)
        for value, method in safe:
            if value == least:
                found[method].add(column)
    return found


def _is_safe(row: Row) -> bool:
    often = row.failed > _OFTEN * row.evaluations
    return row.violations == 0 and not often and row.method != KNOWS_THE_PLANT


def _excess(rows: Sequence[Row], estimator: str) -> tuple[bool, float]:
    """Whether an estimator fails often, and how far its errors lie above the Cramér-Rao bound.

    The second is the median over rows and parameters of the error's root mean square over the
    bound.
    """
    own = [row for row in rows if row.estimator == estimator]
    ratios = [
        error.rms / row.cramer_rao_percent[name]
        for row in own
        for name, error in row.relative_error_percent.items()
        if math.isfinite(error.rms) and row.cramer_rao_percent[name] > 0
    ]
    fails = any(row.failed > _OFTEN * row.evaluations for row in own)
    return fails, statistics.median(ratios) if ratios else math.inf


def _told(
    ranked: Sequence[Row], safe: Sequence[Row], best: Row | None, usual: Row | None, in_nats: bool
) -> tuple[str, ...]:
    """The answer in sentences."""
    if best is None:
        least = min(ranked, key=lambda row: row.violation_rate.estimate)
        few = f"{least.violations} of {least.evaluations}"
        few = few if least.by_seed is None else violations_cell(least)
        return (f"No excitation was without a violation: {least.method} had the fewest, {few}.",)
    many = f"Of {len(safe)} excitations" if len(safe) > 1 else "The only excitation"
    told = f"{many} that reached no critical level in these experiments"
    told += f", {best.method} tells most about the plant" * (len(safe) > 1)
    told += f" is {best.method}" * (len(safe) == 1)
    if in_nats:
        told += f": an expected information gain of {gain_cell(best.expected_gain)} nats"
        more = (
            math.nan if usual is None else information_of(best, True) - information_of(usual, True)
        )
        if usual is not None and math.isfinite(more):
            word = "more" if more >= 0 else "less"
            told += f", {abs(more):.2g} nats {word} than {usual.method}"
    else:
        told += f": log det {best.log_det_information:.1f} of the Fisher information"
    if usual is not None and (gain := _gain(best, usual)) is not None:
        size = max(gain, 1 / gain)
        word = f"{size:.0f}" if size >= 10 else f"{size:.2g}"
        word += f" times {'smaller' if gain > 1 else 'larger'} than"
        told += (
            f". The standard errors that it allows are {word if size >= _NEARLY else 'about'} "
            f"those of {usual.method} (Cramér-Rao bound, geometric mean over the parameters)"
        )
    most = 100 * best.violation_rate.ci95[1]
    return (
        f"{told}.",
        f"It reached a critical level in 0 of {best.evaluations} experiments (sampled; 95 %: at "
        f"most {most:.2g} %).",
    )


def _gain(best: Row, usual: Row) -> float | None:
    """How much smaller the standard errors can be; None where a bound is missing."""
    ratios = [usual.cramer_rao_percent[n] / best.cramer_rao_percent[n] for n in best.parameters
              if best.cramer_rao_percent[n] > 0]  # fmt: skip
    if len(ratios) < len(best.parameters) or not all(0 < r < math.inf for r in ratios):
        return None
    return math.exp(statistics.fmean(map(math.log, ratios)))


def told_of_record(d: PlantDescription, record: Record) -> tuple[str, ...]:
    """Whether an experiment reached a safety level and when, and how it ended on a rig."""
    lasted = record.time[-1] - record.time[0]
    reached = [
        _reached(part, record.time - record.time[0], np.abs(record.outputs[:, i]))
        for i, part in enumerate(d.outputs)
        if not (part.warning_level is None and part.critical_level is None)
    ]
    levels = "; ".join(reached) or "no output has a safety level"
    told = f"In {lasted:.4g} s, {levels}, as measured." if reached else f"{levels.capitalize()}."
    if "ended" not in record.metadata:
        return (told,)
    ended = record.metadata["ended"]
    if ended is None:
        return told, "The experiment is still running, or its process was killed."
    return told, f"The experiment ended after {lasted:.4g} s: {str(ended['reason']).rstrip('.')}."


def told_of_levels(d: PlantDescription, records: Sequence[Record]) -> tuple[str, ...]:
    """Of each record in which an output reached a safety level, which and when."""
    told = []
    for record in records:
        most = np.nanmax(np.abs(record.outputs), axis=0, initial=0.0)
        levels = [(part.warning_level, part.critical_level) for part in d.outputs]
        if any(w <= m for m, own in zip(most, levels, strict=True) for w in own if w is not None):
            where = f"{record.source}: " * (len(records) > 1)
            told.append(where + told_of_record(d, record)[0])
    return tuple(told)


def _reached(part: Output, time: np.ndarray, size: np.ndarray) -> str:
    """The highest safety level that an output reached, and when first."""
    unit, factor = display_unit(part.unit)
    largest = float(np.max(size, initial=0.0, where=np.isfinite(size)))
    most, below = f"{number(factor * largest)} {unit}", ""
    for word, level in (("critical", part.critical_level), ("warning", part.warning_level)):
        if level is None:
            continue
        named = f"its {word} level ({factor * level:.4g} {unit})"
        if largest >= level:
            first = f"{part.name} reached {named} after {time[np.argmax(size >= level)]:.4g} s"
            safe = f" and stayed below {below}" * bool(below)
            return f"{first}{safe}: its largest value is {most}"
        below = named
    return f"{part.name} stayed below {below}: its largest value is {most}"


def told_of_campaign(c: Mapping[str, Any]) -> tuple[str, ...]:
    """How a campaign ended, what is known of its targets, and how near it came to a level.

    Args:
        c: content of `campaign.json`.
    """
    count, ended = len(c["rounds"]), c["reason"] or c["interrupted"] or "not ended"
    told = f"After {c['num_samples']} samples in {count} round{'s' * (count != 1)}, {ended}"
    found = [
        f"{name} {_known(c['estimate'].get(name))} (asked: {target})"
        for name, target in c["targets"].items()
    ]
    shown = found[:_MOST_PARAMETERS] + [f"{len(found) - _MOST_PARAMETERS} more"] * (
        len(found) > _MOST_PARAMETERS
    )
    told = f"{told}: {listed(shown)}, with 95 % intervals." if shown else f"{told}."
    nearest = max(
        ((r["nearness"], i) for i, r in enumerate(c["rounds"], 1) if r["nearness"] is not None),
        default=None,
    )
    if nearest is None:
        return told, "Nothing was measured that says whether it was safe."
    share, i = nearest
    reached = "reached its critical level" if share >= 1 else "reached no critical level"
    which = f"Round {i}" if share >= 1 else "The measured outputs"
    return told, f"{which} {reached}: the nearest came to {100 * share:.0f} % of it."


def _known(known: Mapping[str, Any] | None) -> str:
    """A value with half of its interval, relative where it is not zero."""
    if known is None:
        return "not known"
    value, half = known["estimate"], known["ci95_half"]
    if half is None:
        return f"= {number(value)}, its interval open"
    size = f"{number(100 * half / abs(value), 2)} %" if value else f"{half:.2g}"
    return f"= {number(value, digits_for(value, half))} ± {size}"


def told_of_identification(result: EstimateSummary) -> tuple[str, ...]:
    """The parameters with their intervals, and what the residual says of them."""
    if not result.is_usable:
        why = f": {result.verdict[-1]}" if result.verdict else ""
        return (f"There is no estimate ({result.status}){why}.",)
    count = len(result.files)
    found = [f"{name} = {_in_words(p)}" for name, p in result.params.items() if not p.held]
    held = [name for name, p in result.params.items() if p.held]
    more = [f"{len(found) - _MOST_PARAMETERS} more"] * (len(found) > _MOST_PARAMETERS)
    told = f"From {result.files[0] if count == 1 else f'{count} records'}, {result.estimator}"
    told += f" estimates {listed([*found[:_MOST_PARAMETERS], *more])} (95 % intervals)"
    told += f"; {listed(held)} {'is' if len(held) == 1 else 'are'} held, not estimated" * bool(held)
    fitting = "One step ahead, the plant" if result.is_predicted else "The plant"
    return f"{told}.", f"{fitting} fits {_fits(result)}; {_believed(result)}."


def _in_words(p: EstimatedParameter) -> str:
    """An estimate with half of its interval."""
    digits = digits_for(p.estimate, p.std_error)
    shown = f"{number(p.estimate, digits)} {p.unit}".strip()
    smaller, half = sorted(abs(end - p.estimate) for end in p.ci95)
    if not math.isfinite(half):
        return f"{shown} (its interval is open)"
    if smaller < _EVEN * half:
        low, high = (number(end, digits) for end in p.ci95)
        return f"{shown} ({low} to {high})"
    relative = f"{100 * half / abs(p.estimate):.2g} %" if p.estimate else f"{half:.2g} {p.unit}"
    return f"{shown} ± {relative.strip()}"


def _fits(result: EstimateSummary) -> str:
    """The fit of every output, and the least of the held-out records."""
    fits = [f"{name} by {number(value, 4)} %" for name, value in result.model_fit_percent.items()]
    found = [v.prediction_fit_percent or v.fit_percent for v in result.validation]
    outside = [fit for fits_of_one in found for fit in fits_of_one.values()]
    least = f" (held out: {number(min(outside), 4)} %)" if outside else ""
    return f"{listed(fits)}{least}"


def _believed(result: EstimateSummary) -> str:
    """What the tests of the residual say of the intervals."""
    follow = [name for name, p in result.structure_p_value.items() if p < RARE]
    coloured = [name for name, p in result.whiteness_p_value.items() if p < RARE]
    tested = [*result.structure_p_value.values(), *result.whiteness_p_value.values()]
    if follow:
        factor = result.misfit_factor
        wider = f"; the intervals are {factor:.2g} times as wide for this" * (factor > 1)
        return (
            f"the residual of {listed(follow)} follows the input, so that the structure of the "
            "plant is wrong for these data or they differ from its description: the estimates "
            f"are to be doubted{wider}"
        )
    if coloured:
        return (
            f"the residual of {listed(coloured)} is not white noise: something is left "
            "that the plant does not explain, or that disturbs it"
        )
    if not any(map(math.isfinite, tested)):
        return "the residual is too small or too short to be tested"
    more = ", but read what can be identified" * (len(result.verdict) > 1)
    return f"the tests of its residual give no reason to doubt the intervals{more}"
