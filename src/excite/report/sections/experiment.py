"""Identified experiments: measurements, estimates, tests."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...description import RARE, PlantDescription, names_of
from ...files import read_columns
from ...record import Record
from ...record.figure import episode_figure
from ..answer import told_of_identification, told_of_levels
from ..content import Answer, Bullets, Element, Figure, Folded, Heading, Paragraph, Section, Table
from ..estimates import (
    beside,
    largest_correlation,
    parameter_cells,
    parameter_header,
    residual_cells,
    residual_size,
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
    again,
    facts,
    origin_in_words,
    plant_facts,
    record_in,
    signals_table,
    understood,
)

_MAX_RECORDS = 6  # drawn of one run
_TESTS = (
    "White: without correlation in time (Ljung-Box). Follows the input: correlated with past "
    "inputs, a sign that the structure of the plant is wrong for the data. Both are judged at "
    f"p = {RARE:g}."
)
_CODE = """\
import pandas as pd

from excite.record.figure import episode_figure
from excite.report.figures import (
    autocorrelation_figure,
    correlation_figure,
    identification_figure,
)
from excite.report.rows import EstimateSummary

result = EstimateSummary.read(run / "estimate.json")
endings = ENDINGS
records = [ex.read_record(run / f"record{ending}.csv") for ending in endings]
plant = records[0].description
outputs = [output.name for output in plant.outputs]
simulated = [pd.read_csv(run / f"WORD{ending}.csv")[outputs].to_numpy() for ending in endings]
pd.DataFrame({name: parameter.data() for name, parameter in result.params.items()}).T"""
_WHITENESS = """\
residuals = [record.outputs - own for record, own in zip(records, simulated, strict=True)]
autocorrelation_figure(plant, residuals)"""
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
                Answer((*told_of_levels(d, self.records), *told_of_identification(result))),
                Heading("Parameters"),
                Table(parameter_header(), cells, name="Estimates and their 95 % intervals"),
                *_truth(self),
                Heading("What can be identified"),
                Bullets(result.verdict),
                Heading("Measured"),
                signals_table(d, self.records),
                *_figures(self, name),
                Heading("Residual"),
                _residuals(self),
                Figure(
                    autocorrelation_figure(d, _residual_values(self)),
                    f"{name}-white",
                    "Autocorrelation of the residual. For white noise, 95 % of it lies between "
                    "the dashed lines.",
                    _WHITENESS,
                ),
                *_correlation(result, name),
                Heading("Settings and provenance"),
                *_provenance(self),
                *again(self.marker.command, _likely_command(result)),
            ]
        title = f"{d.name}: {result.estimator}, {result.status}"
        return Section(title, self.marker.folder, parts, _code(self))


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


def _code(experiment: Experiment) -> str:
    """Python that reads the run folder."""
    result = experiment.result
    count = len(result.files)
    endings = [""] if count == 1 else [f"_{i}" for i in range(1, count + 1)]
    word = "predicted" if result.is_predicted else "simulated"
    return _CODE.replace("ENDINGS", json.dumps(endings)).replace("WORD", word)


def _truth(experiment: Experiment) -> list[Element]:
    """Estimates beside the parameters of a simulated plant; nothing for a real one."""
    true = experiment.records[0].metadata.get("params")
    params = experiment.result.params
    others = [record.metadata.get("params") for record in experiment.records]
    if not isinstance(true, Mapping) or set(true) != set(params) or any(o != true for o in others):
        return []
    rows = []
    for name, p in params.items():
        error = 100 * (p.estimate / true[name] - 1) if p.estimate and true[name] else None
        low, high = p.ci95
        inside = "–" if math.isnan(low) else "yes" if low <= true[name] <= high else "no"
        rows.append([name, p.unit, number(true[name], 5), f"{number(error)} %", inside])
    header = ["symbol", "unit", "true", "error", "inside the interval"]
    remark = Paragraph("The record is simulated; these are the true parameters:")
    return [remark, Table(header, rows, name="True parameters")]


def _figures(experiment: Experiment, name: str) -> list[Element]:
    """Signals and fit of the first records."""
    d, parts = experiment.plant, list[Element]()
    word = "predicted" if experiment.result.is_predicted else "simulated"
    pairs = list(zip(experiment.records, experiment.simulated, strict=True))
    for i, (record, simulated) in enumerate(pairs[:_MAX_RECORDS], 1):
        file = experiment.result.files[i - 1]
        parts += [
            Figure(
                episode_figure(d, record),
                f"{name}-in{i}",
                f"{file}: inputs and outputs.",
                f"episode_figure(plant, records[{i - 1}])",
            ),
            Figure(
                identification_figure(d, experiment.result, record, simulated),
                f"{name}-fit{i}",
                f"{file}: measured and {word} output, residual, and parameters.",
                f"identification_figure(plant, result, records[{i - 1}], simulated[{i - 1}])",
            ),
        ]
    if len(pairs) > _MAX_RECORDS:
        parts.append(Paragraph(f"{len(pairs) - _MAX_RECORDS} more records are not drawn."))
    return parts


def _residual_values(experiment: Experiment) -> list[np.ndarray]:
    pairs = zip(experiment.records, experiment.simulated, strict=True)
    return [record.outputs - simulated for record, simulated in pairs]


def _residuals(experiment: Experiment) -> Table:
    """Fit and tests by output, and the fit of held-out records."""
    result, rows = experiment.result, []
    for name, percent in result.model_fit_percent.items():
        size, tests = residual_size(result, name), residual_cells(result, name)
        rows.append([name, f"{number(percent, 4)} %", size, *tests])
    simulated = "simulated, " if result.is_predicted else ""
    others = [(result.fit_percent, "simulated")] if simulated else []
    for held_out in result.validation:
        if held_out.prediction_fit_percent is not None:
            others.append((held_out.prediction_fit_percent, f"held out: {held_out.file}"))
        others.append((held_out.fit_percent, f"{simulated}held out: {held_out.file}"))
    for percents, about in others:
        for output, percent in percents.items():
            rows.append([f"{output}, {about}", f"{number(percent, 4)} %", *"–––––"])
    header = ["output", "fit", "RMS residual", "white", "p", "follows the input", "p"]
    return Table(header, rows, 1, "Fit and residual", _TESTS)


def _correlation(result: EstimateSummary, name: str) -> list[Element]:
    drawn = correlation_figure(result)
    if drawn is None:
        return []
    caption = (
        "95 % confidence region of each pair of parameters, in percent of the estimates. "
        f"Largest correlation: {largest_correlation(result)}."
    )
    shown = Figure(drawn, f"{name}-pairs", caption, "correlation_figure(result)")
    return [Heading("Correlation of the estimates"), shown]


def _provenance(experiment: Experiment) -> list[Element]:
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
    plant = Folded("The plant", [plant_facts(experiment.plant)])
    return [own, Table(header, rows, 1, "Records"), plant]


def _lengths(record: Record) -> list[str]:
    duration = record.time[-1] - record.time[0]
    return [str(len(record.time)), f"{record.dt:.4g} s", f"{duration:.4g} s"]


def _likely_command(result: EstimateSummary) -> str:
    """The command that made the run; empty where it was made from Python."""
    files = shlex.join(result.files)
    return (
        f"excite identify {files} --plant {result.plant} --estimator {result.estimator} --out RUN"
    )


def comparison(numbered: Mapping[str, Experiment]) -> list[Element]:
    """Estimates with intervals, and fits, of several experiments side by side, by title."""
    header, rows = beside({title: experiment.result for title, experiment in numbered.items()})
    return [Table(header, rows, name="Experiments side by side")]
