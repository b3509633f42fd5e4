"""From recorded experiments to parameters with confidence: the everyday job.

`identify` fits all records at once, holds what the data cannot see, and says in words how
much the result is worth. Command line and page call it and show what it returns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .description import PlantDescription, names_of
from .estimation import (
    NLS,
    AbstractEstimator,
    Estimate,
    Experiments,
    Status,
    search_slope,
    stack_experiments,
)
from .estimation.diagnosis import (
    EXPLAINS_NOTHING,
    correlation,
    fit_percent,
    identifiability,
    ljung_box,
    robust_covariance,
    worst_seen,
)
from .information import (
    a_optimality,
    cramer_rao_bound,
    d_optimality,
    e_optimality,
    experiment_information,
    relative_size,
)
from .plant import AbstractPlant, Params
from .records import Record, csv_text, new_run_folder, write_json, write_record

InitialState = Literal["auto", "free", "known"]
_WHITE = 0.01  # a residual is called coloured when whiteness is less probable


@dataclass(frozen=True)
class Fitted:
    """One record beside its simulation.

    Attributes:
        record: what was measured.
        simulated: noise-free outputs of the estimated plant.
        fit_percent: by output, 100 (1 - |y - y_s| / |y - mean y|).
    """

    record: Record
    simulated: Float[np.ndarray, "sample output"]
    fit_percent: Mapping[str, float]


@dataclass(frozen=True)
class Identification:
    """The result of `identify`.

    Attributes:
        plant: the plant as it was fitted, sampled as the records are.
        estimator: its name on the command line.
        status: "successful", or what is wrong in a few words.
        params, std_error: by parameter, in its unit; the error of a held one is nan.
        held: parameters that the data could not see, held where the search started.
        covariance, information: of the estimates; see `excite.estimation.Estimate`.
        whiteness: by output, p-value of the residual being white (Ljung-Box).
        verdict: sentences on what the data can see and how far to trust the intervals.
        fitted, validation: records beside their simulation.
        initial_state_known: whether initial states were taken as known.
    """

    plant: PlantDescription
    estimator: str
    status: str
    params: Mapping[str, float]
    std_error: Mapping[str, float]
    held: tuple[str, ...]
    covariance: Float[np.ndarray, "param param"]
    information: Float[np.ndarray, "param param"]
    whiteness: Mapping[str, float]
    verdict: tuple[str, ...]
    fitted: tuple[Fitted, ...]
    validation: tuple[Fitted, ...]
    initial_state_known: bool

    @property
    def is_usable(self) -> bool:
        """Whether there is an estimate at all."""
        return self.status in ("successful", "partly identifiable")

    def ci95(self, name: str) -> tuple[float, float]:
        """95 % interval of a parameter; symmetric, estimate ± 1.96 standard errors."""
        half = 1.959964 * self.std_error[name]
        return self.params[name] - half, self.params[name] + half

    def fit(self) -> dict[str, float]:
        """Fit in percent by output; over several records, of all of them together."""
        outputs = names_of(self.plant.outputs)
        measured = np.concatenate(
            [f.record.outputs - f.record.outputs.mean(axis=0) for f in self.fitted]
        )
        simulated = np.concatenate(
            [f.simulated - f.record.outputs.mean(axis=0) for f in self.fitted]
        )
        return {n: fit_percent(measured[:, i], simulated[:, i]) for i, n in enumerate(outputs)}

    def to_dict(self) -> dict[str, Any]:
        """The result as JSON-ready data; its keys are documented in the README."""
        return {
            "plant": self.plant.name,
            "plant_hash": self.plant.hash,
            "estimator": self.estimator,
            "status": self.status,
            "params": {
                p.name: {
                    "estimate": self.params[p.name],
                    "std_error": self.std_error[p.name],
                    "ci95": self.ci95(p.name),
                    "unit": p.unit,
                    "relative_to_nominal": self.params[p.name] / p.nominal if p.nominal else None,
                    "held": p.name in self.held,
                }
                for p in self.plant.parameters
            },
            "fit_percent": self.fit(),
            "validation": [
                {"file": f.record.source, "fit_percent": dict(f.fit_percent)}
                for f in self.validation
            ],
            "files": [f.record.source for f in self.fitted],
            "initial_state": "known" if self.initial_state_known else "free",
            "correlation": correlation(self.covariance),
            "whiteness_p_value": dict(self.whiteness),
            "verdict": list(self.verdict),
        }


def identify(
    plant: AbstractPlant,
    records: Sequence[Record],
    estimator: AbstractEstimator | None = None,
    *,
    start: Mapping[str, float] | None = None,
    initial_state: InitialState = "auto",
    validation: Sequence[Record] = (),
) -> Identification:
    """Parameters of one plant from one or several records.

    Args:
        plant: its constants and sensor are taken as known; its dt gives way to the records'.
        records: all with one sampling time.
        estimator: default `NLS()`.
        start: where the search begins, by name; default the nominal parameters.
        initial_state: "known" (the plant's), "free" (estimated along), or "auto": known
            where every sidecar says so.
        validation: records for which only the initial state is fitted.

    Raises:
        ValueError: for records too short, of different sampling times, or in which no
            parameter can be seen, and for a start that is not allowed.
    """
    estimator = NLS() if estimator is None else estimator
    known = initial_state == "known" or (
        initial_state == "auto" and all(_starts_at(record, plant) for record in records)
    )
    _check_lengths(plant, [*records, *validation], known)
    plant = plant.changed(dt=_common_dt([*records, *validation]))
    experiments = _experiments(plant, records, known)
    fit = _fit(plant, experiments, estimator, start_params(plant, start or {}))
    residual = _residuals(plant, records, experiments, fit)
    fitted = tuple(_fitted(plant.definition, *pair) for pair in zip(records, residual, strict=True))
    if fit.is_successful and isinstance(estimator, NLS):
        _require_explanation(fitted)
    whiteness = {
        name: min(ljung_box(r[:, i]) for r in residual)
        for i, name in enumerate(names_of(plant.definition.outputs))
    }
    covariance, verdict = _confidence(plant, experiments, estimator, fit, whiteness)
    names, d = names_of(plant.definition.parameters), plant.description
    sd = np.where(fit.free, np.sqrt(np.maximum(np.diag(covariance), 0.0)), np.nan)
    return Identification(
        plant=d,
        estimator=estimator.name,
        status=fit.status,
        params={n: float(v) for n, v in zip(names, fit.estimate.params, strict=True)},
        std_error={n: float(v) for n, v in zip(names, sd, strict=True)},
        held=tuple(n for n, is_free in zip(names, fit.free, strict=True) if not is_free),
        covariance=covariance,
        information=np.asarray(fit.estimate.information),
        whiteness=whiteness,
        verdict=verdict,
        fitted=fitted,
        validation=tuple(_validated(plant, record, fit.estimate.params) for record in validation),
        initial_state_known=known,
    )


def start_params(plant: AbstractPlant, start: Mapping[str, float]) -> Params:
    """Nominal parameters, but for those given.

    Raises:
        ValueError: for an unknown name or a value outside the parameter's bounds.
    """
    names = names_of(plant.definition.parameters)
    for name, value in start.items():
        if name not in names:
            raise ValueError(
                f"plant {plant.definition.name!r} has no parameter {name!r}; "
                f"it has {', '.join(names)}"
            )
        p = plant.definition.parameters[names.index(name)]
        lower = 0.0 if p.positive and p.lower is None else p.lower
        if not (
            np.isfinite(value)
            and (lower is None or value > lower)
            and (p.upper is None or value < p.upper)
        ):
            raise ValueError(
                f"{name} = {value:g} {p.unit} is not allowed; it must be finite, above "
                f"{'minus infinity' if lower is None else format(lower, 'g')} and below "
                f"{'infinity' if p.upper is None else format(p.upper, 'g')}"
            )
    given = {name: jnp.asarray(float(value)) for name, value in start.items()}
    return plant.nominal._replace(**given)


def _starts_at(record: Record, plant: AbstractPlant) -> bool:
    """Whether the sidecar says that the record starts at this plant's initial state."""
    states = record.metadata.get("plant", {}).get("states", [])
    initial = [s.get("initial") for s in states]
    return record.starts_at_initial_state and initial == plant.initial_state.tolist()


def _check_lengths(plant: AbstractPlant, records: Sequence[Record], known: bool) -> None:
    d = plant.definition
    unknowns = len(d.parameters) + (0 if known else len(d.states))
    needed = max(10, -(-3 * unknowns // len(d.outputs)))
    for record in records:
        if len(record.time) < needed:
            raise ValueError(
                f"{record.source}: {len(record.time)} samples are too short a record; "
                f"{needed} or more are needed for {unknowns} unknowns"
            )


def _common_dt(records: Sequence[Record]) -> float:
    first = records[0]
    for record in records[1:]:
        if abs(record.dt - first.dt) > 1e-3 * first.dt:
            raise ValueError(
                f"{record.source} is sampled every {record.dt:g} s and {first.source} every "
                f"{first.dt:g} s; records fitted together need one sampling time"
            )
    return first.dt


def _experiments(plant: AbstractPlant, records: Sequence[Record], known: bool) -> Experiments:
    inputs = [jnp.asarray(r.inputs[:-1]) for r in records]
    return stack_experiments(plant, inputs, [jnp.asarray(r.outputs) for r in records], known)


@dataclass(frozen=True)
class _Fit:
    """An estimate, which parameters were free, and a sentence for each held one."""

    estimate: Estimate
    free: np.ndarray
    reasons: tuple[str, ...]

    @property
    def is_successful(self) -> bool:
        return int(self.estimate.status) == Status.SUCCESSFUL

    @property
    def status(self) -> str:
        if self.is_successful and not self.free.all():
            return "partly identifiable"
        return Status(int(self.estimate.status)).sentence


def _fit(
    plant: AbstractPlant, experiments: Experiments, estimator: AbstractEstimator, start: Params
) -> _Fit:
    """Fits, and as long as the data cannot see a parameter, holds it and fits again."""
    names = names_of(plant.definition.parameters)
    free, reasons = np.ones(len(names), bool), ()
    while True:
        estimate = estimator(plant, experiments, start, jnp.asarray(free))
        if not isinstance(estimator, NLS):  # ARX estimates all parameters or none
            return _Fit(estimate, free, reasons)
        unseen = worst_seen(names, np.asarray(estimate.information), free)
        if unseen is None:
            return _Fit(estimate, free, reasons)
        chosen, why = unseen
        free = free & (np.arange(len(names)) != chosen)
        if not free.any():
            raise ValueError(
                f"no parameter can be seen in the data ({why}); the input must move the "
                "plant, and the outputs must exceed the noise"
            )
        reasons = (*reasons, f"{why}; {names[chosen]} was held at {float(start[chosen]):g}")


def _residuals(
    plant: AbstractPlant, records: Sequence[Record], experiments: Experiments, fit: _Fit
) -> list[Float[np.ndarray, "sample output"]]:
    """Measured minus simulated outputs of each record, at its own length."""
    estimate = fit.estimate
    if fit.is_successful and not experiments.initial_state_known:
        # An estimator that knows nothing of initial states (ARX) is judged fairly, too.
        estimate = _with_initial_state(plant, experiments, estimate.params)
    residual = np.asarray(estimate.residual)
    return [residual[i, : len(record.time)] for i, record in enumerate(records)]


def _with_initial_state(plant: AbstractPlant, experiments: Experiments, params: Params) -> Estimate:
    """The best initial states for given parameters."""
    return NLS()(plant, experiments, params, jnp.zeros(len(params), bool))


def _confidence(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: AbstractEstimator,
    fit: _Fit,
    whiteness: Mapping[str, float],
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Covariance of the estimates, and the verdict in words."""
    covariance = np.asarray(fit.estimate.covariance)
    if not fit.is_successful:
        return covariance, fit.reasons
    names = names_of(plant.definition.parameters)
    information = np.asarray(fit.estimate.information)
    verdict = (*fit.reasons, identifiability(names, information, fit.free))
    coloured = [name for name, p in whiteness.items() if p < _WHITE]
    if not coloured:
        return covariance, verdict
    what = f"the residual of {' and '.join(coloured)} is not white"
    if not isinstance(estimator, NLS):
        return covariance, (*verdict, f"{what}: the intervals assume it is, and are too narrow")
    S, residual = estimator.sensitivity(plant, experiments, fit.estimate, jnp.asarray(fit.free))
    count = len(names)
    robust = robust_covariance(np.asarray(S), np.asarray(residual))[:count, :count]
    slope = np.asarray(search_slope(plant.definition, fit.estimate.params))
    reason = "the intervals are widened for its correlation; noise or plant differ from the model"
    return slope[:, None] * robust * slope, (*verdict, f"{what}: {reason}")


def _fitted(description: PlantDescription, record: Record, residual: np.ndarray) -> Fitted:
    simulated = record.outputs - residual
    fits = {
        name: fit_percent(record.outputs[:, i], simulated[:, i])
        for i, name in enumerate(names_of(description.outputs))
    }
    return Fitted(record, simulated, fits)


def _require_explanation(fitted: Sequence[Fitted]) -> None:
    """Raises where the best simulation has nothing to do with the measured outputs."""
    best = max(np.nan_to_num(percent) for f in fitted for percent in f.fit_percent.values())
    if best < EXPLAINS_NOTHING:
        raise ValueError(
            f"no parameter can be seen in the data: the best simulation fits them by {best:.2g} %; "
            "are the columns, their signs and units right, and does the plant move beyond noise?"
        )


def _validated(plant: AbstractPlant, record: Record, params: Params) -> Fitted:
    """A record beside its simulation; only its initial state is fitted."""
    estimate = _with_initial_state(plant, _experiments(plant, [record], False), params)
    return _fitted(plant.definition, record, np.asarray(estimate.residual[0]))


def best_possible(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[np.ndarray, "time input"],
    *,
    initial_state_known: bool,
) -> dict[str, Any]:
    """Least standard deviation of each parameter for an input, as JSON-ready data.

    Raises:
        ValueError: for a sensor without noise, which sets no bound.
    """
    if not np.all(np.asarray(plant.sensor.sd) > 0):
        raise ValueError("a sensor without noise sets no bound; give every output a noise")
    state = None if initial_state_known else plant.initial_state
    information = experiment_information(plant, params, jnp.asarray(inputs), state)
    size = np.asarray(relative_size(plant, params))
    sd = np.asarray(cramer_rao_bound(information)) * size
    names, free = names_of(plant.definition.parameters), np.ones(len(size), bool)
    unseen = worst_seen(names, np.asarray(information), free)
    seen = () if unseen else (identifiability(names, np.asarray(information), free),)
    return {
        "plant": plant.definition.name,
        "initial_state": "known" if initial_state_known else "free",
        "params": {
            p.name: {
                "value": float(value),
                "std_error": float(s) if np.isfinite(s) else None,
                "percent": float(100 * s / abs(value)) if np.isfinite(s) and value else None,
                "unit": p.unit,
            }
            for p, value, s in zip(plant.definition.parameters, params, sd, strict=True)
        },
        "log_det_information": float(d_optimality(information)),
        "a_optimality": float(a_optimality(information)),
        "e_optimality": float(e_optimality(information)),
        "information": np.asarray(information),
        "verdict": [unseen[1]] if unseen else list(seen),
    }


def write_run(result: Identification, path: Path, overwrite: bool = False) -> None:
    """Leaves a run folder: records, simulated outputs, residuals, estimate, information.

    Raises:
        ValueError: where `path` holds something else, or a run and not `overwrite`.
    """
    d = result.plant
    outputs = names_of(d.outputs)
    with new_run_folder(path, overwrite) as folder:
        for i, f in enumerate(result.fitted, 1):
            ending = "" if len(result.fitted) == 1 else f"_{i}"
            write_record(folder / f"record{ending}.csv", f.record, d)
            for name, values in (
                ("simulated", f.simulated),
                ("residual", f.record.outputs - f.simulated),
            ):
                columns = {"time": f.record.time, **dict(zip(outputs, values.T, strict=True))}
                (folder / f"{name}{ending}.csv").write_text(csv_text(columns))
        write_json(folder / "estimate.json", result.to_dict())
        write_json(
            folder / "information.json",
            {
                "coordinates": "logarithm of positive parameters, free ones over their scale",
                "parameters": names_of(d.parameters),
                "information": result.information,
                "covariance": result.covariance,
            },
        )
        write_json(folder / "run.json", {"kind": "excite identification", "plant": d.to_dict()})
