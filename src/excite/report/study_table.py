"""The table of a study: its rows as text, HTML, Markdown, CSV, LaTeX or figure."""

from __future__ import annotations

import csv
import io
import math
import re
import statistics
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Self

from pydantic import Field, ValidationError

from ..description import Spread, unknown
from ..files import csv_text, damaged, read_json
from ..record.table import data_frame
from .numbers import mean_sd, number
from .rows import (
    Difference,
    ExpectedGain,
    Gap,
    PublishedRow,
    RigCounts,
    Row,
    Saved,
    StudyFacts,
)
from .tables import Table, html_table, markdown_table, text_table

if TYPE_CHECKING:
    import matplotlib.figure
    import pandas

NUM_LABELS = 2
"""Columns of words before those of numbers: method and estimator."""
DIFFERENCES = (
    "Mean error of the first method minus that of the second, in points of percent, with "
    "the 95 % interval over the seeds; plants and noise are common to both."
)


class StudyTable(Saved):
    """Results of a study: one row per method and estimator, and differences between methods.

    Attributes:
        rows: in the order of the study.
        differences: of every agent to every other method.
        best_seeds: by agent, the seed that was best in the validation episodes.
        bound_curves: agents whose learning curves hold Cramér-Rao bounds in place of errors.
        study: its settings, which are in a separate file.
    """

    rows: tuple[Row, ...] = Field(min_length=1)
    differences: tuple[Difference, ...] = ()
    best_seeds: dict[str, int] = Field(default_factory=dict)
    bound_curves: tuple[str, ...] = ()
    study: StudyFacts = Field(exclude=True)

    @classmethod
    def in_folder(cls, folder: Path, study: StudyFacts, advice: str) -> Self:
        """The table that was written to `table.json` of a run folder.

        Args:
            advice: what helps where the file is damaged; it ends the message.
        """
        path = folder / "table.json"
        try:
            return cls.model_validate({**read_json(path, advice=advice), "study": study})
        except ValidationError:
            raise damaged(path, advice) from None

    def __repr__(self) -> str:
        return self.text()

    def __str__(self) -> str:
        return self.text()

    def text(self, width: int = 80) -> str:
        """The table with its footnotes, no line wider than `width` where possible."""
        header, cells = self.cells()
        table = text_table(self.study.heading, header, cells, width, NUM_LABELS)
        notes = "\n".join(textwrap.fill(note, width) for note in footnotes(self.study, self.rows))
        return f"{table}\n\n{notes}"

    def _repr_html_(self) -> str:
        return html_table(self.study.heading, *self.cells())

    def to_pandas(self) -> pandas.DataFrame:
        """The columns of `csv`, numbers unrounded; needs pandas."""
        labels = {key: [getattr(r, key) for r in self.rows] for key in ("method", "estimator")}
        return data_frame({**labels, **self.columns()})

    def plot(self) -> matplotlib.figure.Figure:
        """Mean relative error of each method and estimator beside its Cramér-Rao bound."""
        from .figures import benchmark_figure

        return benchmark_figure(self.rows, self.study.heading)

    def only(self, estimator: str) -> Self:
        """The same table with the rows of one estimator; ValueError where there is none."""
        rows = tuple(row for row in self.rows if row.estimator == estimator)
        if not rows:
            raise unknown("estimator", estimator, {row.estimator for row in self.rows})
        pairs = tuple(pair for pair in self.differences if pair.estimator == estimator)
        changed = {"rows": rows} | ({"differences": pairs} if self.differences else {})
        return self.model_copy(update=changed)

    def sorted_by(self, column: str) -> Self:
        """The same rows by the numbers of one column of `csv`, the smallest first.

        A parameter's name means its mean error. Rows without that number are last.

        Raises:
            ValueError: for an unknown column.
        """
        columns = self.columns()
        name = f"{column}_error_percent_mean" if column in self.rows[0].parameters else column
        if name not in columns:
            raise unknown("column", column, [*self.rows[0].parameters, *columns])
        worth = [math.inf if math.isnan(value) else value for value in columns[name]]
        order = sorted(range(len(worth)), key=worth.__getitem__)
        return self.model_copy(update={"rows": tuple(self.rows[i] for i in order)})

    def cells(self) -> Table:
        """Column titles and rows as text, after each method its published row."""
        cells = []
        for i, row in enumerate(self.rows):
            cells.append(_cells(self.rows, row))
            is_last = i + 1 == len(self.rows) or self.rows[i + 1].method != row.method
            published = self.study.reference.get(row.method)
            if is_last and published is not None:
                cells.append(_published_cells(self.rows, row, published))
        return _header(self.rows), cells

    def markdown(self) -> str:
        """The table as Markdown, with its footnotes and differences."""
        lines = [f"# {self.study.heading}", "", *markdown_table(*self.cells())]
        lines += [line for note in footnotes(self.study, self.rows) for line in ("", note)]
        if self.differences:
            title = f"## Differences, {self.differences[0].estimator}"
            lines += ["", title, "", DIFFERENCES, ""]
            lines += markdown_table(*difference_cells(self.differences))
        return "\n".join(lines) + "\n"

    def latex(self) -> str:
        """The table as LaTeX (booktabs), its footnotes as comments."""
        header, cells = self.cells()
        lines = [f"% {note}" for note in footnotes(self.study, self.rows)]
        lines += [r"\begin{tabular}{ll" + "r" * (len(header) - NUM_LABELS) + "}", r"\toprule"]
        lines += [_latex_row(header), r"\midrule", *map(_latex_row, cells)]
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"

    def columns(self) -> dict[str, list[float]]:
        """All numbers by column, unrounded; NaN where a row has none."""
        rows = self.rows
        columns: dict[str, list[float]] = {
            "evaluations": [row.evaluations for row in rows],
            "failed": [row.failed for row in rows],
            "violations": [row.violations for row in rows],
        }
        if _is_trained(rows):
            columns["viable_seeds"] = [_known(row.viable_seeds) for row in rows]
            columns["seeds"] = [_known(row.seeds) for row in rows]
            if any(row.by_seed is not None for row in rows):
                columns |= _columns_by_seed(rows)
            columns["train_seconds"] = [_known(row.train_seconds) for row in rows]
        for key in sorted(RigCounts.model_fields):
            if getattr(rows[0].on_rig, key, None) is not None:
                columns[key] = [_known(getattr(row.on_rig, key, None)) for row in rows]
        columns["log_det_information"] = [row.log_det_information for row in rows]
        columns["log_det_information_sd"] = [row.log_det_information_sd for row in rows]
        if has_gain(rows):
            columns |= _columns_of_gain(rows)
        if any(row.d_efficiency is not None for row in rows):
            columns["d_efficiency"] = [_known(row.d_efficiency) for row in rows]
        largest = rows[0].max_abs_output
        title = f"max_abs_{largest.output}_{largest.unit}"
        columns[f"{title}_mean"] = [row.max_abs_output.mean for row in rows]
        columns[f"{title}_sd"] = [row.max_abs_output.sd for row in rows]
        for name in rows[0].parameters:
            errors = [row.relative_error_percent[name] for row in rows]
            for part in ("mean", "sd", "median", "rms"):
                columns[f"{name}_error_percent_{part}"] = [getattr(e, part) for e in errors]
            if _is_trained(rows):
                every = [e.all_seeds for e in errors]
                for part in ("mean", "sd"):
                    title = f"{name}_error_percent_all_seeds_{part}"
                    columns[title] = [_known(getattr(e, part, None)) for e in every]
            columns[f"{name}_cramer_rao_percent"] = [row.cramer_rao_percent[name] for row in rows]
        return columns

    def csv(self) -> str:
        """The table as CSV, numbers unrounded."""
        labels = [["method", "estimator"], *([row.method, row.estimator] for row in self.rows)]
        numbers = csv.reader(csv_text(self.columns()).splitlines())
        return _csv([*pair, *values] for pair, values in zip(labels, numbers, strict=True))


def _columns_by_seed(rows: Sequence[Row]) -> dict[str, list[float]]:
    """Smallest, median and largest number of violations of a seed, and its evaluations."""
    counts = [row.by_seed for row in rows]
    ranges = [(math.nan,) * 3 if c is None else _min_median_max(c.violations) for c in counts]
    names = [f"violations_by_seed_{part}" for part in ("min", "median", "max")]
    evaluations = [math.nan if c is None else c.evaluations for c in counts]
    columns = {n: list(values) for n, values in zip(names, zip(*ranges, strict=True), strict=True)}
    return {**columns, "evaluations_by_seed": evaluations}


def _columns_of_gain(rows: Sequence[Row]) -> dict[str, list[float]]:
    """Bounds on the expected gain and their standard errors [nats]."""
    columns: dict[str, list[float]] = {}
    for bound in ("lower", "upper"):
        found = [getattr(row.expected_gain, bound, None) for row in rows]
        columns[f"gain_{bound}_nats"] = [math.nan if b is None else b.mean for b in found]
        columns[f"gain_{bound}_nats_error"] = [
            math.nan if b is None else b.std_error for b in found
        ]
    return columns


def _min_median_max(values: Sequence[int]) -> tuple[float, float, float]:
    return min(values), statistics.median(values), max(values)


def _known(value: float | None) -> float:
    return math.nan if value is None else value


def _csv(lines: Iterable[Sequence[object]]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(lines)
    return buffer.getvalue()


def has_gain(rows: Sequence[Row]) -> bool:
    """Whether any of the rows has an expected gain."""
    return any(row.expected_gain is not None for row in rows)


def information_of(row: Row, in_nats: bool) -> float:
    """What a method tells: the expected gain [nats] or log det of the Fisher information.

    Args:
        in_nats: whether it is compared with others that have an expected gain.
    """
    if not in_nats:
        return row.log_det_information
    return math.nan if row.expected_gain is None else row.expected_gain.lower.mean


def _is_trained(rows: Sequence[Row]) -> bool:
    """Whether any of the rows is that of an agent."""
    return any(row.seeds is not None for row in rows)


def _header(rows: Sequence[Row]) -> list[str]:
    """Column titles: those that any of the rows needs."""
    largest = rows[0].max_abs_output
    header = ["method", "estimator"]
    for name in rows[0].parameters:
        header += [f"{name} error %", "bound %"]
    header += [f"max {largest.output} {largest.unit}".rstrip(), "violations (95 %)", "failed"]
    header += [*_rig_cells(rows[0].on_rig, rows[0].evaluations), "log det"]
    header += ["gain nats"] * has_gain(rows)
    header += ["D-efficiency"] * any(row.d_efficiency is not None for row in rows)
    return header + ["viable seeds", "training"] * _is_trained(rows)


def _cells(rows: Sequence[Row], row: Row) -> list[str]:
    """The cells of one of the rows, errors and magnitudes as mean ± standard deviation."""
    cells = [row.method, row.estimator]
    for name, error in row.relative_error_percent.items():
        text = mean_sd(error.mean, error.sd)
        if row.viable_seeds != row.seeds and error.all_seeds is not None:
            text += f" (all seeds: {mean_sd(error.all_seeds.mean, error.all_seeds.sd)})"
        cells += [text, number(row.cramer_rao_percent[name], 2)]
    cells += [
        mean_sd(row.max_abs_output.mean, row.max_abs_output.sd),
        violations_cell(row),
        f"{row.failed}/{row.evaluations}",
        *_rig_cells(row.on_rig, row.evaluations).values(),
        number(row.log_det_information, 4),
    ]
    if has_gain(rows):
        cells.append(gain_cell(row.expected_gain))
    if any(other.d_efficiency is not None for other in rows):
        cells.append(number(row.d_efficiency, 2))
    return cells + _training_cells(row) * _is_trained(rows)


def gain_cell(gain: ExpectedGain | None) -> str:
    """The expected gain with its standard error; both bounds where they differ by more than it."""
    if gain is None:
        return "–"
    bounds = [f"{bound.mean:.2f} ± {bound.std_error:.2f}" for bound in (gain.lower, gain.upper)]
    return " to ".join(bounds) if _has_two_bounds(gain) else bounds[0]


def _has_two_bounds(gain: ExpectedGain) -> bool:
    return gain.upper.mean - gain.lower.mean >= gain.lower.std_error


def violations_cell(row: Row) -> str:
    """Count and interval of the rate; for several seeds, that of the seeds."""
    counts = row.by_seed
    if counts is None:
        low, high = row.violation_rate.ci95
        return f"{row.violations}/{row.evaluations} ({100 * low:.1f}–{100 * high:.1f} %)"
    seeds = len(counts.violations)
    if not any(counts.violations):
        return f"0/{counts.evaluations} in {seeds} of {seeds} seeds"
    parts = (f"{value:g}" for value in _min_median_max(counts.violations))
    return f"{'–'.join(parts)} of {counts.evaluations} ({seeds} seeds)"


def _rig_cells(seen: RigCounts | None, count: int) -> dict[str, str]:
    """Counts of a simulated rig by column title; empty without a rig."""
    if seen is None:
        return {}
    cells = {"trips": f"{seen.trips}/{count}"}
    if seen.interventions is not None:
        cells["violations, filter"] = f"{seen.filtered_violations}/{count}"
        cells["trips, filter"] = f"{seen.filtered_trips}/{count}"
        cells["interventions"] = f"{number(seen.interventions / count)} an experiment"
    return cells


def _training_cells(row: Row) -> list[str]:
    """Viable seeds and training time; dashes for a method that is not trained."""
    if row.seeds is None:
        return ["–", "–"]
    minutes = _known(row.train_seconds) / 60 / row.seeds
    return [f"{row.viable_seeds}/{row.seeds}", f"{number(minutes, 2)} min a seed"]


def _published_cells(rows: Sequence[Row], row: Row, published: PublishedRow) -> list[str]:
    """A published row in the columns of the method's `row`."""
    cells = [row.method, "as published"]
    for name in row.parameters:
        error = published.relative_error_percent.get(name)
        cells += ["–" if error is None else mean_sd(*error), "–"]
    cells += [mean_sd(*published.max_abs_output), published.violations]
    cells += ["–"] * (len(_header(rows)) - len(cells))
    if _is_trained(rows):
        cells[-2] = published.viable_seeds or "–"
    return cells


def footnotes(study: StudyFacts, rows: Sequence[Row]) -> list[str]:
    """The footnotes of the table."""
    notes = [study.note] * bool(study.note) + [
        "Errors are relative errors in percent, mean ± standard deviation over the estimates "
        "that did not fail. The bound is the mean Cramér-Rao bound of the same data, a standard "
        "deviation: the mean error of an efficient estimator is 0.80 of it.",
    ]
    if study.agents:
        notes.append(
            f"Agents: cross-seed mean ± standard deviation of the mean errors of {study.seeds} "
            f"training seeds, {study.episodes} evaluation episodes each, "
            "over viable seeds (a seed has collapsed where the RMS input is below 1 % of its "
            "limit); failures over all evaluations of all seeds. The policy is evaluated without "
            "exploration noise."
        )
    notes.append(violations_note(study))
    if study.clairvoyant:
        count = min(study.clairvoyant.plants, study.episodes)
        notes.append(
            "log det is that of the relative Fisher information. The D-efficiency compares it, on "
            f"the first {count} plants, with the best signals that our search found for each plant "
            f"as if its parameters were known ({study.clairvoyant.starts} starts, "
            f"{study.clairvoyant.updates:,} updates); it is no upper limit."
        )
    gains = {row.method: row.expected_gain for row in rows if row.expected_gain is not None}
    for gain in list(gains.values())[:1]:  # alike in all rows
        kind = "near the posterior"
        if gain.from_prior:
            kind = "of the prior: figures of other numbers cannot be compared"
        has_two = any(_has_two_bounds(gain) for gain in gains.values())
        notes.append(
            "gain is the expected information gain: mean and standard error over "
            f"{gain.plants:,} plants, its evidence from {gain.samples:,} samples {kind}."
            f"{' Two figures are a lower and an upper bound.' * has_two}"
        )
    notes += [f"{method}: {told}." for method, gain in gains.items() for told in gain.warnings]
    if study.uncertainty:
        signals = "; the clairvoyant signals are for plants of the spread alone"
        notes.append(
            "The estimators and the bound take only the parameters as unknown"
            f"{signals * bool(study.clairvoyant)}."
        )
    if study.rig:
        notes.append(
            "Experiments were made on the plant's simulated rig, with its latency and jitter, "
            "watched by the supervisor; one that it ended (a trip) has no estimate. Columns with "
            "a filter are of the same experiments behind the predictive safety filter."
        )
    if study.ours:
        notes.append("Ours, other than the source: " + "; ".join(study.ours) + ".")
    if study.reference:
        notes.append(f"Published rows: {study.source}.")
    if study.inferred:
        notes.append("Inferred, not stated by the source: " + "; ".join(study.inferred) + ".")
    return notes


def violations_note(study: StudyFacts) -> str:
    """What the violations of a table were counted on, in words."""
    spread = Spread.of(study.spread)
    within = f"a factor of {spread.reach:g}" if spread.is_factor else f"± {100 * spread.reach:g} %"
    declared = f"parameters within {within}"
    if study.prior:
        given = ", ".join(f"{name} {distribution}" for name, distribution in study.prior.items())
        declared = f"{given}, any others within {within}"
    if study.uncertainty:
        ranges = ", ".join(f"{name} {_range(value)}" for name, value in study.uncertainty.items())
        declared += f", in addition {ranges}"
    else:
        where = "on its simulated rig" if study.rig else "in the plant's description"
        declared += f", all else as {where}"
    coast = f", also in the {study.coast} samples after their end" * bool(study.coast)
    note = (
        f"Violations: experiments that reached a critical level{coast}, on plants drawn at random "
        f"({declared}). They are sampled: 'excite falsify' searches for the worst plant."
    )
    if study.agents and study.seeds > 1 and study.safety_episodes is None:
        note += (
            f" Those of an agent are given by seed (smallest, median, largest); its {study.seeds} "
            f"seeds share the {study.episodes} plants."
        )
    elif study.agents and study.safety_episodes is not None:
        note += (
            " Those of an agent are given by seed (smallest, median, largest), each seed on "
            f"{study.safety_episodes:,} plants of its own."
        )
    return note


def _range(value: object) -> str:
    """A declared range as a person would write it."""
    if isinstance(value, list | tuple):
        return " to ".join(f"{part:g}" for part in value)
    text = str(value)
    return f"± {text.removesuffix('%')} %" if text.endswith("%") else text


def _latex_row(cells: Sequence[str]) -> str:
    """One line of a tabular; parameters like K_pu are set as mathematics."""
    text = " & ".join(cells)
    for plain, latex in (("%", r"\%"), ("±", r"$\pm$"), ("–", "--")):
        text = text.replace(plain, latex)
    return re.sub(r"([A-Za-z])_([A-Za-z]+)", r"$\1_{\2}$", text) + r" \\"


def differences_csv(differences: Iterable[Difference]) -> str:
    """Differences between methods in percent, with 95 % intervals, as CSV."""
    header = ["method", "minus", "estimator", "parameter", "mean", "low", "high", "seeds"]
    lines = [
        [pair.method, pair.minus, pair.estimator, name, gap.mean, *gap.ci95, gap.seeds]
        for pair in differences
        for name, gap in pair.relative_error_percent.items()
    ]
    return _csv([header, *lines])


def difference_cells(differences: Sequence[Difference]) -> Table:
    """Column titles and rows of the differences in the errors of the study's first estimator."""
    first = differences[0]
    names = list(first.relative_error_percent)
    chosen = [pair for pair in differences if pair.estimator == first.estimator]
    cells = [
        [p.method, p.minus, *(_gap(p.relative_error_percent[n]) for n in names)] for p in chosen
    ]
    return ["method", "minus", *names], cells


def _gap(gap: Gap) -> str:
    low, high = gap.ci95
    return f"{number(gap.mean)} ({number(low)} to {number(high)})"


def common_table(tables: Mapping[str, StudyTable]) -> Table | None:
    """Methods of several studies beside each other; None where there are none.

    Args:
        tables: by the title of the study.
    """
    found: dict[tuple[str, str], dict[str, Row]] = {}
    for title, table in tables.items():
        for row in table.rows:
            found.setdefault((row.method, row.estimator), {})[title] = row
    common = [by_title for by_title in found.values() if len(by_title) > 1]
    rows = [row for by_title in common for row in by_title.values()]
    if not rows:
        return None
    hidden = {"on_rig": None}  # and what some of the studies lack
    if not all(_is_trained(table.rows) for table in tables.values()):
        hidden |= {"seeds": None, "viable_seeds": None}
    if any(row.d_efficiency is None for row in rows):
        hidden |= {"d_efficiency": None}
    shown = [row.model_copy(update=hidden) for row in rows]
    titles = [title for by_title in common for title in by_title]
    cells = [_cells(shown, row) for row in shown]
    labelled = [[m, e, title, *rest] for title, (m, e, *rest) in zip(titles, cells, strict=True)]
    method, estimator, *rest = _header(shown)
    return [method, estimator, "study", *rest], labelled
