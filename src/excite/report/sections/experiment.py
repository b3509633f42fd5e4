"""Identified experiments: measurements, estimates, tests."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...description import RARE, PlantDescription, display_unit, names_of
from ...files import read_columns
from ...record import Record
from ...record.figure import episode_figure
from ..estimates import (
    beside,
    largest_correlation,
    parameter_cells,
    parameter_header,
    residual_cells,
)
from ..figures import (
    autocorrelation_figure,
    correlation_figure,
    identification_figure,
)
from ..numbers import number
from ..rows import EstimateSummary
from .elements import (
    Marker,
    Run,
    Section,
    bullets,
    command,
    facts,
    figure,
    folded,
    heading,
    origin_in_words,
    paragraph,
    plant_facts,
    record_in,
    signals_table,
    table,
    understood,
)

_MAX_RECORDS = 6  # drawn of one run
_TESTS = (
    "White: without correlation in time (Ljung-Box). Follows the input: correlated with past "
    "inputs, a sign that the structure of the plant is wrong for the data. Both are judged at "
    f"p = {RARE:g}."
)
_ADVICE = "'excite identify --out' writes it again"


@dataclass(frozen=True)
class Experiment(Run):
    """The run folder of an identification.

    Attributes:
        marker: the content of `run.json`, and the folder.
        plant: as it was fitted.
        result: the content of `estimate.json`.
        records, simulated: measurements, and the outputs of the estimated plant, with `pem`
            those of its one-step prediction.
    """

    marker: Marker
    plant: PlantDescription
    result: EstimateSummary
    records: Sequence[Record]
    simulated: Sequence[np.ndarray]

    def section(self, name: str) -> Section:
        """The section of an identification."""
        d, result = self.plant, self.result
        with understood(self.marker.folder / "estimate.json", _ADVICE):
            cells = [parameter_cells(n, p) for n, p in result.params.items()]
            parts = [
                heading("Parameters"),
                table(parameter_header(), cells),
                _truth(self),
                heading("What can be identified"),
                bullets(result.verdict),
                heading("Measured"),
                signals_table(d, self.records),
                _figures(self, name),
                heading("Residual"),
                table(*_residuals(self), labels=1),
                paragraph(_TESTS),
                figure(
                    autocorrelation_figure(d, _residual_values(self)),
                    f"{name}-white",
                    "Autocorrelation of the residual. For white noise, 95 % of it lies between "
                    "the dashed lines.",
                ),
                _correlation(result, name),
                heading("Settings and provenance"),
                _provenance(self),
                command(self.marker.command, _likely_command(result)),
            ]
        title = f"{d.name}: {result.estimator}, {result.status}"
        return Section(title, self.marker.folder, "".join(parts))


def read_experiment(marker: Marker) -> Experiment:
    """The experiment in a run folder.

    Raises:
        ValueError: for a file that is damaged or missing.
    """
    folder, plant = marker.folder, marker.plant
    result = EstimateSummary.read(folder / "estimate.json", _ADVICE)
    count = len(result.files)
    records, simulated = [], []
    for i in range(1, count + 1):
        ending = "" if count == 1 else f"_{i}"
        records.append(record_in(folder / f"record{ending}.csv", plant))
        word = "predicted" if result.is_predicted else "simulated"
        names, path = names_of(plant.outputs), folder / f"{word}{ending}.csv"
        columns = read_columns(path, names, _ADVICE)
        with understood(path, _ADVICE):
            values = np.stack([columns[name] for name in names], axis=1)
            simulated.append(values.reshape(records[-1].outputs.shape))
    return Experiment(marker, plant, result, records, simulated)


def _truth(experiment: Experiment) -> str:
    """Estimates beside the parameters of a simulated plant; nothing for a real one."""
    true = experiment.records[0].metadata.get("params")
    params = experiment.result.params
    others = [record.metadata.get("params") for record in experiment.records]
    if not isinstance(true, Mapping) or set(true) != set(params) or any(o != true for o in others):
        return ""
    rows = []
    for name, p in params.items():
        error = 100 * (p.estimate / true[name] - 1) if p.estimate and true[name] else None
        low, high = p.ci95
        inside = "–" if math.isnan(low) else "yes" if low <= true[name] <= high else "no"
        rows.append([name, p.unit, number(true[name], 5), f"{number(error)} %", inside])
    header = ["symbol", "unit", "true", "error", "inside the interval"]
    return paragraph("The record is simulated; these are the true parameters:") + table(
        header, rows
    )


def _figures(experiment: Experiment, name: str) -> str:
    """Signals and fit of the first records."""
    d, parts = experiment.plant, []
    word = "predicted" if experiment.result.is_predicted else "simulated"
    pairs = list(zip(experiment.records, experiment.simulated, strict=True))
    for i, (record, simulated) in enumerate(pairs[:_MAX_RECORDS], 1):
        file = experiment.result.files[i - 1]
        parts += [
            figure(episode_figure(d, record), f"{name}-in{i}", f"{file}: inputs and outputs."),
            figure(
                identification_figure(d, experiment.result, record, simulated),
                f"{name}-fit{i}",
                f"{file}: measured and {word} output, residual, and parameters.",
            ),
        ]
    if len(pairs) > _MAX_RECORDS:
        parts.append(paragraph(f"{len(pairs) - _MAX_RECORDS} more records are not drawn."))
    return "".join(parts)


def _residual_values(experiment: Experiment) -> list[np.ndarray]:
    pairs = zip(experiment.records, experiment.simulated, strict=True)
    return [record.outputs - simulated for record, simulated in pairs]


def _residuals(experiment: Experiment) -> tuple[list[str], list[list[str]]]:
    """Fit and tests by output, and the fit of held-out records."""
    result, rows = experiment.result, []
    residuals = np.concatenate(_residual_values(experiment))
    for i, part in enumerate(experiment.plant.outputs):
        unit, factor = display_unit(part.unit)
        size = f"{number(factor * float(np.sqrt(np.mean(residuals[:, i] ** 2))))} {unit}"
        fit = f"{number(result.model_fit_percent[part.name], 4)} %"
        rows.append([part.name, fit, size, *residual_cells(result, part.name)])
    simulated = "simulated, " if result.is_predicted else ""
    others = [(result.fit_percent, "simulated")] if simulated else []
    for held_out in result.validation:
        if held_out.prediction_fit_percent is not None:
            others.append((held_out.prediction_fit_percent, f"held out: {held_out.file}"))
        others.append((held_out.fit_percent, f"{simulated}held out: {held_out.file}"))
    for percents, about in others:
        for output, percent in percents.items():
            rows.append([f"{output}, {about}", f"{number(percent, 4)} %", *"–––––"])
    return ["output", "fit", "RMS residual", "white", "p", "follows the input", "p"], rows


def _correlation(result: EstimateSummary, name: str) -> str:
    drawn = correlation_figure(result)
    if drawn is None:
        return ""
    caption = (
        "95 % confidence region of each pair of parameters, in percent of the estimates. "
        f"Largest correlation: {largest_correlation(result)}."
    )
    return heading("Correlation of the estimates") + figure(drawn, f"{name}-pairs", caption)


def _provenance(experiment: Experiment) -> str:
    result = experiment.result
    own = facts(
        [
            ("estimator", result.estimator),
            ("initial state", result.initial_state),
            ("excite", experiment.marker.version),
        ]
    )
    rows = [
        [file, *_lengths(record), origin_in_words(record)]
        for file, record in zip(result.files, experiment.records, strict=True)
    ]
    header = ["record", "samples", "sampling time", "duration", "origin"]
    return own + table(header, rows, labels=1) + folded("The plant", plant_facts(experiment.plant))


def _lengths(record: Record) -> list[str]:
    duration = record.time[-1] - record.time[0]
    return [str(len(record.time)), f"{record.dt:.4g} s", f"{duration:.4g} s"]


def _likely_command(result: EstimateSummary) -> str:
    """The command that made the run; empty where it was made from Python."""
    files = shlex.join(result.files)
    return (
        f"excite identify {files} --plant {result.plant} --estimator {result.estimator} --out RUN"
    )


def comparison(numbered: Mapping[str, Experiment]) -> str:
    """Estimates with intervals, and fits, of several experiments side by side, by title."""
    cells = beside({title: experiment.result for title, experiment in numbered.items()})
    return table(*cells, name="Experiments side by side")
