"""`identify`: parameters and confidence intervals from recorded experiments."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias, get_args

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from ..description import HALF_95, RARE, Named, PlantDescription, names_of, unknown, wrong_type
from ..files import json_ready
from ..identifiability import STRUCTURALLY_NOT, identifiability, worst_seen
from ..plant import AbstractPlant, Params, floats, params_from
from ..plant.catalogue import PLANTS, PlantLike, plant_from
from ..plant.extension import plain_kind
from ..record import (
    Record,
    described_in,
    is_even,
    read_record,
    require_columns,
    require_even,
    unbroken,
)
from .catalogue import estimator_from
from .contract import (
    AbstractEstimator,
    AbstractSearch,
    Basis,
    Estimate,
    Experiments,
    Prediction,
    Status,
    bound_reached,
    from_search,
    quality,
    residual_of,
    simulate_experiments,
    stack_experiments,
    to_search,
)
from .diagnosis import (
    chance_of_fit,
    effect_of_constants,
    fit_percent,
    half_95,
    input_dependence,
    ljung_box,
    robust_covariance,
    widened,
    with_independent,
)
from .held import structure_of, told_of_held
from .nls import NLS, Likelihood
from .pem import PEM
from .prior_knowledge import PriorLike, with_prior
from .profile import profile_intervals
from .remedies import HOLDS, Suspect, outliers, suspects
from .result import Fitted, Identification, Noise, Predicted

InitialState = Literal["auto", "free", "known"]
Intervals = Literal["linear", "profile"]
_NOTHING_SEEN = (
    "no parameter is identifiable from the data; are columns, signs and units right, and does the "
    "input move the plant beyond the noise? or did the search begin too far from the truth "
    "(--start)?"
)
_STARTS, _SIZE_OF_MANY_STARTS = 8, 50_000  # measured values up to which so many are tried
_SIZE_OF_SUSPECTS = 10_000  # measured values up to which suspects are tried
_TELLING = 50  # measured values from which the residual tells whether the search missed something
_FREE = 100.0  # scales of a parameter of free sign that are small for its standard error
_SAME = 0.01  # difference of sums of squares at one minimum, over the noise
_FAR_ABOVE = 10.0  # times the declared noise; a larger residual is remarked
_SHARE = 0.1  # of a held-out record, from which its initial state is estimated
_BY_CHANCE = 1e-3  # a fit with a larger p-value explains nothing


Progress = Callable[[str, float, float], None]
RecordLike: TypeAlias = Record | str | Path
"""A record, or the path of an experiment file."""


def identify(
    records: RecordLike | Sequence[RecordLike],
    plant: PlantLike | None = None,
    estimator: str | AbstractEstimator | type[AbstractEstimator] = "nls",
    *,
    start: Mapping[str, float] | Params | None = None,
    hold: Mapping[str, float] | None = None,
    prior: PriorLike | Sequence[PriorLike] | None = None,
    uncertain: Mapping[str, float | str] | None = None,
    likelihood: Likelihood = "normal",
    initial_state: InitialState = "auto",
    intervals: Intervals = "linear",
    hold_input: str | Mapping[str, str] = "constant",
    validate: RecordLike | Sequence[RecordLike] = (),
    validate_state: str | float = "auto",
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None,
    set_inputs: Mapping[str, float] | None = None,
    dt: float | None = None,
    rows: slice | str | None = None,
    progress: Progress = lambda *_: None,
) -> Identification:
    """Parameters of one plant from one or several records.

        >>> import excite as ex
        >>> result = ex.identify(ex.simulate("aero2", "chirp", seed=0))
        >>> result.status
        'successful'
        >>> round(result.params.K_pu, 4)
        0.0125

    Args:
        records: a record or the path of an experiment file, or several.
        plant: a name, `path/to/file.py:ClassName`, a plant or its class; its constants and
            sensor are taken as known, its dt is replaced by that of the records. Default the
            plant that the first record's sidecar names.
        estimator: a name (`ex.estimators()` lists them), an estimator or its class.
        start: where the search begins, by name; default the nominal parameters.
        hold: values of parameters that are known and not estimated, by name.
        prior: what is known of parameters beforehand: {"J_p": "normal:0.022:5%"}, "lognormal:",
            "uniform:0.01:0.05", the run folder or result of an earlier `identify` of other
            records, a file with mean and covariance, or several of these.
        uncertain: standard deviation of known constants, by name: {"m": 0.02} in the constant's
            unit, {"m": "5%"} of its value. It widens the intervals.
        likelihood: of the noise, "normal" or "student", with which outliers hardly count.
        initial_state: "known" (the plant's), "free" (estimated too), or "auto": known
            where every sidecar says so.
        intervals: "linear": from standard errors; "profile": from the profile likelihood, which
            follows a curved likelihood and may stay open to one side, and takes longer.
        hold_input: "constant": an input keeps its value until the next sample; "linear": it runs
            straight to the next value; or one of them by the input's name.
        validate: held-out records, of which at most the initial state is estimated.
        validate_state: where that comes from. "known": it is the plant's; "first": from the first
            measurements, where the outputs at one time determine it; 0.1 (or "10%"): estimated
            from this share of the record, which does not count in the fit; 1.0: from all of it,
            which counts. "auto": known where the sidecar says so, otherwise from the first
            measurements, otherwise from all of it, and the fit with a share of 10 % is told, too.
        progress: called with a text, how much is done, and the total.
        columns: names in the files where they are not the plant's: {"pitch": "qm"}.
        scales: factors from the files' units to the plant's: {"pitch": 0.01745}.
        units: the files' units where they are not the plant's: {"time": "ms", "pitch": "deg"}.
        set_inputs: values of constant inputs that the files do not have: {"voltage": 5.0}.
        dt: sampling time of files without time [s].
        rows: rows of the files to use, counted from 0: slice(100, 1000, 5) or "100:1000:5".

    Raises:
        ValueError: for records too short, or in which no parameter can be identified, for a
            file that cannot be used, and for a name or a value that is not allowed.
        TypeError: for an argument of another type.
    """
    given = _listed(records, "records")
    if not given:
        raise ValueError("no record is given")
    plant = plant_from(_plant_of(given[0]) if plant is None else plant)
    estimator, begin = _chosen(estimator, plant, start, hold)
    if likelihood not in get_args(Likelihood):
        raise ValueError(f"likelihood {likelihood!r} is not one of: normal, student")
    plant, prior = with_prior(plant, prior, begin)
    if prior is not None or likelihood != "normal":
        what = "a likelihood other than normal" if prior is None else "a prior"
        if not isinstance(estimator, NLS):
            raise ValueError(f"{what} needs the estimator nls: got {estimator.name}")
        estimator = dataclasses.replace(estimator, prior=prior, likelihood=likelihood)
    if intervals not in get_args(Intervals):
        raise ValueError(f"intervals {intervals!r} are not one of: linear, profile")
    if intervals == "profile" and not isinstance(estimator, NLS):
        raise ValueError(f"profile intervals need the estimator nls: got {estimator.name}")
    uncertain_sd = _uncertain(plant, estimator, uncertain)
    if initial_state not in get_args(InitialState):
        raise ValueError(f"initial state {initial_state!r} is not one of: known, free, auto")
    progress("reading", 0.0, 1.0)
    read = partial(
        read_record,
        description=plant.description,
        columns=columns,
        scales=scales,
        units=units,
        set_inputs=set_inputs,
        dt=dt,
        rows=rows,
    )
    records, validation = (
        [_require_kind(r, plant.description) if isinstance(r, Record) else read(r) for r in group]
        for group in (given, _listed(validate, "validate"))
    )
    known = initial_state == "known" or (
        initial_state == "auto" and all(_starts_at(record, plant) for record in records)
    )
    _require_enough(plant, records, int(np.sum(~_known(plant, estimator))), known)
    shares = [_state_from(record, plant, validate_state) for record in validation]
    for record in validation:
        _require_enough(plant, [record], 0, False)
    _require_short_delays(plant, begin, records)
    linear = _linear_inputs(plant, hold_input)
    if not isinstance(estimator, AbstractSearch):
        _require_complete(estimator, [*records, *validation], linear)
    plant = _sampled_as([*records, *validation], plant)
    known = known and all(len(parts_of(record)) == 1 for record in records)
    experiments = _experiments(plant, records, known, linear)
    progress("first search", 0.05, 1.0)
    fit = _fit(plant, experiments, estimator, begin, progress)
    residual = _residuals(plant, records, experiments, estimator, fit)
    fitted = _fitted_all(plant, records, experiments, fit.estimate, residual)
    if isinstance(estimator, NLS) and not fit.has_ended_in(Status.NOT_FINITE):
        _require_explanation(records, residual, int(fit.free.sum()))
    whiteness = {
        name: _whiteness([_finite(r[:, i]) for r in residual], plant.definition.outputs[i].scale)
        for i, name in enumerate(names_of(plant.definition.outputs))
    }
    structure = {
        name: _dependence(residual, records, i, plant.definition.outputs[i].scale)
        for i, name in enumerate(whiteness)
    }
    covariance, degrees, verdict = _confidence(
        plant, experiments, estimator, fit, whiteness, uncertain_sd
    )
    wrong = _wrong_structure(structure, estimator) if fit.is_successful else ()
    others = tuple(s for record in [*records, *validation] for s in _other_plant(record, plant))
    found = _suspects(plant, records, experiments, estimator, begin, fit, linear, progress)
    large = _above_declared(plant, fit) if fit.is_successful else ()
    verdict = (*others, *wrong, *large, *_remedies(found), *_agreement(fit), *verdict)
    names, d = names_of(plant.definition.parameters), plant.description
    values = np.array([float(value) for value in fit.estimate.params])
    sd = np.where(fit.free, np.sqrt(np.maximum(np.diag(covariance), 0.0)), np.nan)
    half = np.where(fit.free, half_95(covariance, degrees), np.nan)
    ends = np.stack([values - half, values + half], axis=1)
    if intervals == "profile" and isinstance(estimator, NLS) and fit.is_successful:
        estimate = jax.device_put(fit.estimate)
        ends = profile_intervals(
            plant,
            experiments,
            estimator,
            estimate,
            fit.free,
            half,
            lambda text, done, total: progress(text, 0.8 + 0.2 * done / total, 1.0),
        )
        verdict = (*verdict, *_open_sides(plant.definition, ends))
    return Identification(
        plant=d,
        estimator=estimator.name,
        status=fit.status,
        params=Named(zip(names, values.tolist(), strict=True)),
        std_error=Named(zip(names, sd.tolist(), strict=True)),
        intervals=Named(zip(names, map(tuple, ends.tolist()), strict=True)),
        held=tuple(n for n, is_free in zip(names, fit.free, strict=True) if not is_free),
        covariance=covariance,
        information=np.asarray(fit.estimate.information),
        whiteness=whiteness,
        structure=structure,
        verdict=verdict,
        suspects=found,
        fitted=fitted,
        validation=tuple(
            _validated(plant, record, linear, estimator, fit.estimate, share)
            for record, share in zip(validation, shares, strict=True)
        ),
        initial_state_known=known,
        noise=_noise(plant.definition, fit.estimate),
        basis=Basis(plant, experiments, estimator, fit.estimate, fit.free, uncertain_sd),
    )


def _listed(records: RecordLike | Sequence[RecordLike], what: str) -> list[RecordLike]:
    """One or several records as a list."""
    listed = [records] if isinstance(records, RecordLike) else records
    allowed = "a record or the path of an experiment file, or several"
    if not isinstance(listed, Sequence):
        raise wrong_type(what, records, allowed)
    for record in listed:
        if not isinstance(record, RecordLike):
            raise wrong_type(what, record, allowed)
    return list(listed)


def _plant_of(record: RecordLike) -> str:
    """The plant that a record's sidecar names."""
    is_read = isinstance(record, Record)
    where = (record.source if is_read else str(record)) or "the record"
    name = (record.description if is_read else described_in(Path(record))).name
    if name.partition("+")[0] not in PLANTS:
        raise ValueError(
            f"{where} is of plant {name!r}, which does not come with the package: give the plant "
            "as path/to/file.py:ClassName, as an object or as a class"
        )
    return name


def _require_kind(record: Record, description: PlantDescription) -> Record:
    """The record; ValueError where it does not have the plant's inputs and outputs."""
    found = record.inputs.shape[1], record.outputs.shape[1]
    if found != (len(description.inputs), len(description.outputs)):
        raise ValueError(
            f"{record.source or 'the record'} has {found[0]} inputs and {found[1]} outputs; plant "
            f"{description.name!r} has {len(description.inputs)} and {len(description.outputs)}"
        )
    require_columns(record, description)
    return record


def _chosen(
    estimator: str | AbstractEstimator | type[AbstractEstimator],
    plant: AbstractPlant,
    start: Mapping[str, float] | Params | None,
    hold: Mapping[str, float] | None,
) -> tuple[AbstractEstimator, Params]:
    """The estimator, and the start of its search."""
    method = estimator_from(estimator)
    for word, values in (("start", start), ("hold", hold)):
        if values and not isinstance(method, AbstractSearch):
            raise ValueError(
                f"{method.name} estimates all parameters at once and takes no {word} (--{word})"
            )
    begin = params_from(plant, start)
    if not hold:
        return method, begin
    held = params_from(plant, hold)
    names = tuple(hold if isinstance(hold, Mapping) else begin._fields)
    begin = begin._replace(**{name: getattr(held, name) for name in names})
    return dataclasses.replace(method, known=names), begin


def _uncertain(
    plant: AbstractPlant, estimator: AbstractEstimator, given: Mapping[str, float | str] | None
) -> Float[np.ndarray, " constant"]:
    """Standard deviation of each known constant, zero where none is given."""
    if not isinstance(given, Mapping | None):
        raise wrong_type("uncertain", given, "a dict by constant")
    if given and not isinstance(estimator, NLS):
        raise ValueError(f"uncertain constants need the estimator nls: got {estimator.name}")
    values = {name: float(value) for name, value in plant.constants._asdict().items()}
    sd = dict.fromkeys(values, 0.0)
    for name, spread in (given or {}).items():
        if name not in values:
            raise unknown(f"{plant.definition.name} constant", name, values or ["none"])
        try:
            if isinstance(spread, str) and spread.endswith("%"):
                number = float(spread[:-1]) / 100 * abs(values[name])
            else:
                number = float(spread)
        except (TypeError, ValueError):
            raise ValueError(f"uncertain {name!r} must be a number or 5%: got {spread!r}") from None
        if not (np.isfinite(number) and number > 0):
            raise ValueError(f"standard deviation of {name!r} must be above 0: got {spread}")
        sd[name] = number
    return np.array(list(sd.values()), float)


def _open_sides(
    description: PlantDescription, ends: Float[np.ndarray, "param end"]
) -> tuple[str, ...]:
    """A sentence for each interval that the data do not close."""
    told = []
    for part, (low, high) in zip(description.parameters, ends, strict=True):
        is_open = np.isinf(low) or (part.positive and low == 0), np.isinf(high)
        if any(is_open):
            side = "to either side" if all(is_open) else "above" if is_open[1] else "below"
            told.append(
                f"{part.name} is practically not identifiable: its 95 % interval is open {side}"
            )
    return tuple(told)


def _starts_at(record: Record, plant: AbstractPlant) -> bool:
    """Whether the sidecar says that the record starts at this plant's initial state."""
    states = record.metadata.get("plant", {}).get("states", [])
    initial = [s.get("initial") for s in states]
    return record.starts_at_initial_state and initial == np.asarray(plant.initial_state).tolist()


def _other_plant(record: Record, plant: AbstractPlant) -> tuple[str, ...]:
    """A warning where the record was made with another plant or other constants."""
    made_with, own = record.metadata.get("plant", {}), json_ready(plant.description.to_dict())
    if all(made_with.get(key, own[key]) == own[key] for key in ("name", "constants")):
        return ()
    where, name = record.source or "the record", made_with.get("name", own["name"])
    if name != own["name"]:
        return (f"{where} was made with plant {name!r}, not with {own['name']!r}",)
    return (f"{where} was made with other known constants of {name!r}",)


def _linear_inputs(
    plant: AbstractPlant, hold_input: str | Mapping[str, str]
) -> Bool[np.ndarray, " input"]:
    """Which inputs are linear between samples; ValueError for another word or name."""
    names = names_of(plant.definition.inputs)
    by_name = hold_input if isinstance(hold_input, Mapping) else dict.fromkeys(names, hold_input)
    for name, word in by_name.items():
        if name not in names:
            raise ValueError(
                f"plant {plant.definition.name!r} has no input {name!r} to hold; it has "
                f"{', '.join(names)}"
            )
        if word not in HOLDS:
            raise ValueError(f"hold_input of {name!r} must be constant or linear: got {word!r}")
    return np.array([by_name.get(name) == "linear" for name in names], bool)


def _require_complete(
    estimator: AbstractEstimator, records: Sequence[Record], linear: np.ndarray
) -> None:
    """Raises ValueError where an estimator in discrete time cannot use the records."""
    for record in records:
        require_even(record, f"{estimator.name} needs one sampling time (nls does not)")
        if not np.isfinite(record.outputs).all():
            raise ValueError(
                f"{record.source or 'the record'} has samples without a measurement; "
                f"{estimator.name} needs them all (nls does not)"
            )
    if linear.any():
        raise ValueError(
            f"{estimator.name} takes inputs as constant between samples; nls also as linear"
        )
    first = records[0]
    for record in records[1:]:
        if abs(record.dt - first.dt) > 1e-3 * first.dt:
            raise ValueError(
                f"{record.source} is sampled every {record.dt:g} s and {first.source} every "
                f"{first.dt:g} s; {estimator.name} needs one sampling time (nls does not)"
            )


def _require_enough(
    plant: AbstractPlant, records: Sequence[Record], num_params: int, knows_state: bool
) -> None:
    """Raises ValueError where there are not more measured values than unknowns."""
    where = " and ".join(record.source or "the record" for record in records)
    if any(len(record.time) < 2 for record in records):
        raise ValueError(f"{where}: a record needs at least two samples")
    values = sum(int(np.isfinite(record.outputs).sum()) for record in records)
    parts = sum(len(parts_of(record)) for record in records)
    states = 0 if knows_state and parts == len(records) else parts * len(plant.definition.states)
    if values <= num_params + states:
        raise ValueError(
            f"{where}: {values} measured values for {num_params + states} unknowns ({num_params} "
            f"parameters, {states} initial states); more values than unknowns are needed"
        )


def _require_short_delays(plant: AbstractPlant, begin: Params, records: Sequence[Record]) -> None:
    """Raises ValueError where the search begins with a delay that moves all inputs out."""
    delay, span = plant.delay(begin), max(float(np.ptp(record.time)) for record in records)
    names = names_of(plant.definition.inputs)
    for name, value in zip(names, () if delay is None else delay, strict=False):
        if abs(value) >= span:
            raise ValueError(
                f"the delay of input {name!r} is {float(value):g} s, and the longest record has "
                f"{span:g} s; begin with a shorter one (--start, --hold)"
            )


def parts_of(record: Record) -> list[slice]:
    """Parts without a gap in time; without inputs nothing is unknown in a gap."""
    return unbroken(record.time) if record.inputs.shape[1] else [slice(0, len(record.time))]


def _sampled_as(records: Sequence[Record], plant: AbstractPlant) -> AbstractPlant:
    """The plant with the sampling time of the records.

    It is rounded, because it enters the plant's hash. Where the steps differ, the longest
    is integrated no more coarsely than in the definition.
    """
    first, own = records[0].dt, float(plant.dt)
    usual = own if abs(first - own) < 1e-6 * own else float(f"{first:.6g}")
    sampled = plant.changed(dt=usual)
    if _are_even(records, usual):
        return sampled
    steps = [np.diff(r.time[part]).max() for r in records for part in parts_of(r)]
    longest = plant.changed(dt=max(steps))
    return eqx.tree_at(lambda p: p.dt, longest, sampled.dt)


def _are_even(records: Sequence[Record], dt: float) -> bool:
    """Whether all parts of the records are sampled with this time."""
    parts = [record.time[part] for record in records for part in parts_of(record)]
    own = [(time[-1] - time[0]) / (time.size - 1) for time in parts]
    return all(map(is_even, parts)) and bool(np.allclose(own, dt, rtol=1e-3, atol=0))


def _experiments(
    plant: AbstractPlant,
    records: Sequence[Record],
    known: bool,
    linear: np.ndarray,
) -> Experiments:
    """The parts of all records without gaps, as experiments.

    They have next inputs even where all are held: one program is compiled for both.
    """
    parts = [(record, part) for record in records for part in parts_of(record)]
    inputs = [record.inputs[part] for record, part in parts]
    outputs = [record.outputs[part] for record, part in parts]
    evenly = _are_even(records, float(plant.dt))
    seen = [np.isfinite(rows) for rows in outputs]
    return stack_experiments(
        plant,
        [rows[:-1] for rows in inputs],
        outputs,
        known,
        dt=None if evenly else [np.diff(record.time[part]) for record, part in parts],
        next_inputs=[np.where(linear, rows[1:], rows[:-1]) for rows in inputs],
        seen=None if all(rows.all() for rows in seen) else seen,
    )


def _by_record(
    records: Sequence[Record], values: Float[np.ndarray, "experiment sample output"]
) -> list[Float[np.ndarray, "_sample output"]]:
    """Values of the parts of records, joined; NaN where no output was measured."""
    experiments, joined = iter(values), []
    for record in records:
        own = np.full(record.outputs.shape, np.nan)
        for part in parts_of(record):
            rows = part.stop - part.start
            own[part] = next(experiments)[:rows]
        joined.append(np.where(np.isfinite(record.outputs), own, np.nan))
    return joined


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def _known(plant: AbstractPlant, estimator: AbstractEstimator) -> np.ndarray:
    """Which parameters the estimator holds because they are known; ValueError where all are."""
    names = names_of(plant.definition.parameters)
    held = estimator.held(plant) if isinstance(estimator, AbstractSearch) else (False,) * len(names)
    if all(held):
        raise ValueError("all parameters are held; none is left to estimate")
    return np.array(held)


@dataclass(frozen=True)
class _Fit:
    """An estimate, its free and known parameters, and a sentence for each held one.

    `others` are the ends of searches that began elsewhere.
    """

    estimate: Estimate
    free: np.ndarray
    known: np.ndarray
    reasons: tuple[str, ...]
    others: Sequence[Estimate] = ()

    def has_ended_in(self, status: Status) -> bool:
        return int(self.estimate.status) == status

    @property
    def is_successful(self) -> bool:
        return self.has_ended_in(Status.SUCCESSFUL)

    @property
    def status(self) -> str:
        if self.is_successful and not (self.free | self.known).all():
            return "partly identifiable"
        return Status(int(self.estimate.status)).name.lower().replace("_", " ")


def _fit(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: AbstractEstimator,
    start: Params,
    progress: Progress,
) -> _Fit:
    """Fits; parameters that were held are tested once more, from the estimate.

    Far from the true values a search can end at an estimate where the outputs hardly depend
    on a parameter, although the data determine it.
    """
    fit = _fit_seen(plant, experiments, estimator, start, progress)
    if not (fit.reasons and fit.is_successful):
        return fit
    again = _fit_seen(plant, experiments, estimator, fit.estimate.params, progress)
    return again if again.is_successful and again.free.sum() > fit.free.sum() else fit


def _fit_seen(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: AbstractEstimator,
    start: Params,
    progress: Progress,
) -> _Fit:
    """Fits; holds a parameter that ends at a bound or is not identifiable, and fits again."""
    names = names_of(plant.definition.parameters)
    known = _known(plant, estimator)
    free, reasons = ~known, ()
    found = _estimate(plant, experiments, estimator, start, free, progress)
    while True:
        fit = _Fit(found[0], free, known, reasons, found[1:])
        # ARX estimates all parameters or none.
        if not isinstance(estimator, AbstractSearch) or fit.has_ended_in(Status.NOT_FINITE):
            return fit
        held = _to_hold(plant, fit, start)
        if held is None:
            return fit
        chosen, value, why = held
        start, last = (
            params._replace(**{names[chosen]: floats(value)}) for params in (start, found[0].params)
        )
        free = free & (np.arange(len(names)) != chosen)
        reasons = (*reasons, why)
        if not free.any():
            found = structure_of(plant, experiments, start)
            groups = found.not_identifiable if found else ()
            why = [f"{STRUCTURALLY_NOT}: {group.sentence}" for group in groups]
            raise ValueError("; ".join([*why, _NOTHING_SEEN]))
        found = _estimate(plant, experiments, estimator, start, free, progress, [last])


def _estimate(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: AbstractEstimator,
    start: Params,
    free: np.ndarray,
    progress: Progress,
    others: Sequence[Params] | None = None,
) -> list[Estimate]:
    """Estimates, the best first; the search is repeated where it may have missed the best one.

    Where more than noise is left, or a short record cannot tell, it begins at other starts as
    well, default random ones; where it does not converge, it has longer segments.
    """

    def search(estimator: AbstractEstimator, start: Params) -> Estimate:
        return jax.device_get(estimator(plant, experiments, *jax.device_put((start, free))))

    if isinstance(estimator, PEM):  # it begins where least squares ends
        least_squares = NLS(known=estimator.known)
        first = _estimate(plant, experiments, least_squares, start, free, progress, others)
        start = first[0].params
        progress("prediction error", 0.4, 1.0)
    found = [search(estimator, start)]
    if not isinstance(estimator, NLS):
        return found
    size, num_samples = experiments.valid.size, experiments.valid.shape[1]
    is_in_doubt = size < _TELLING or not _is_noise(plant, experiments, found[0])
    if size <= _SIZE_OF_MANY_STARTS and is_in_doubt:
        others = _starts_around(plant, start, free) if others is None else others
        for i, other in enumerate(others):
            best = min(found, key=quality)
            progress(
                f"search from start {i + 2} of {len(others) + 1} (best sum of squares "
                f"{float(best.cost):.6g}, found in {int(best.steps)} steps)",
                0.1 + 0.4 * i / len(others),
                1.0,
            )
            found.append(search(estimator, other))
        found.sort(key=quality)
    length = estimator.length_of_segments(plant, num_samples)
    while int(found[0].status) == Status.ITERATIONS_EXHAUSTED and length < num_samples:
        length *= 4
        longer = search(dataclasses.replace(estimator, segment_length=length), start)
        found = [longer] if int(longer.status) == Status.SUCCESSFUL else found
    return found


def _starts_around(plant: AbstractPlant, start: Params, free: np.ndarray) -> list[Params]:
    """Random starts around one, always the same: up to a factor of three away."""
    d, z = plant.definition, to_search(plant.definition, start)
    width = np.where(free, [np.log(3) if p.positive else 2.0 for p in d.parameters], 0.0)
    unit = jax.random.uniform(jax.random.key(0), (_STARTS - 1, len(width)), float, -1.0, 1.0)
    return [plant.Params(*from_search(d, z + width * row)) for row in unit]


def _is_noise(plant: AbstractPlant, experiments: Experiments, estimate: Estimate) -> bool:
    """Whether a search ended where only white noise is left; then it missed no better minimum."""
    if int(estimate.status) != Status.SUCCESSFUL:
        return False
    residual, valid = np.asarray(estimate.residual), np.asarray(experiments.valid)
    return all(
        not _whiteness([r[v, i] for r, v in zip(residual, valid[..., i], strict=True)], o.scale)
        < RARE
        for i, o in enumerate(plant.definition.outputs)
    )


def _to_hold(plant: AbstractPlant, fit: _Fit, start: Params) -> tuple[int, float, str] | None:
    """The parameter to hold next, its value, and the reason; None where there is none."""
    names = names_of(plant.definition.parameters)
    reached = bound_reached(plant.definition, fit.estimate.params)
    if reached is not None and fit.free[reached[0]]:
        name, value = names[reached[0]], float(fit.estimate.params[reached[0]])
        return reached[0], value, f"{name} ended at its bound {reached[1]:g} and was held there"
    # A positive parameter is searched by its logarithm, which ends nowhere if the data do not tell
    # it from zero; one of free sign is far from that as long as the equations can be solved.
    unit = np.array([1.0 if p.positive else _FREE for p in plant.definition.parameters])
    information = np.asarray(fit.estimate.information) * np.outer(unit, unit)
    unseen = worst_seen(names, information, fit.free)
    if unseen is None:
        return None
    value = float(start[unseen[0]])
    why = f"{unseen[1]}; {names[unseen[0]]} was held at {value:g}"
    only = "; the others hold only for this value" if "separately" in why else ""
    return unseen[0], value, why + only


def _residuals(
    plant: AbstractPlant,
    records: Sequence[Record],
    experiments: Experiments,
    estimator: AbstractEstimator,
    fit: _Fit,
) -> list[Float[np.ndarray, "_sample output"]]:
    """The residual of each record, at its length."""
    estimate = fit.estimate
    knows_state = experiments.initial_state_known or isinstance(estimator, AbstractSearch)
    if fit.is_successful and not knows_state:  # ARX does not estimate the state
        estimate = _with_initial_state(plant, experiments, estimate.params)
    return _by_record(records, np.asarray(estimate.residual))


def _with_initial_state(plant: AbstractPlant, experiments: Experiments, params: Params) -> Estimate:
    """The best initial states for given parameters."""
    held = jax.device_put(np.zeros(len(params), bool))
    return jax.device_get(NLS()(plant, experiments, jax.device_put(params), held))


def _confidence(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: AbstractEstimator,
    fit: _Fit,
    whiteness: Mapping[str, float],
    uncertain: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Covariance of the estimates, its degrees of freedom, and the sentences of the verdict."""
    names = names_of(plant.definition.parameters)
    covariance, its = np.asarray(fit.estimate.covariance), fit.estimate.degrees
    degrees = np.full(len(names), np.inf) if its is None else np.asarray(its)
    if not fit.is_successful:
        sentence = Status(int(fit.estimate.status)).sentence
        needed = f"; {estimator.name} needs {estimator.needs}" if estimator.needs else ""
        return covariance, degrees, (*fit.reasons, sentence + needed)
    parameters = zip(plant.definition.parameters, fit.estimate.params, strict=True)
    size = np.array([float(value) if p.positive else p.scale for p, value in parameters])
    coloured, remarks = [name for name, p in whiteness.items() if p < RARE], []
    not_white = f"the residual of {' and '.join(coloured)} is not white: the intervals"
    if not isinstance(estimator, NLS):
        if coloured:
            remarks.append(f"{not_white} assume white noise, and are too narrow")
    elif coloured or uncertain.any():
        estimate, free = jax.device_put((fit.estimate, fit.free))
        S, residual = map(np.asarray, estimator.sensitivity(plant, experiments, estimate, free))
        prior = np.asarray(estimator.prior_information(plant, estimate, S.shape[-1]))
        if coloured:
            robust, its = robust_covariance(S, residual, np.asarray(experiments.valid), prior)
            robust = np.outer(size, size) * robust[: len(names), : len(names)]
            is_wider = np.diag(robust) > np.diag(covariance)
            degrees = np.where(is_wider, its[: len(names)], degrees)
            covariance = widened(covariance, robust)
            remarks.append(
                f"{not_white} allow for coloured noise, not for an error in the plant's equations"
            )
        if uncertain.any():
            to_constants = np.asarray(estimator.constant_sensitivity(plant, experiments, estimate))
            effect = effect_of_constants(S, to_constants, prior)[: len(names)] * uncertain[None]
            effect = effect * size[:, None]
            covariance, degrees = with_independent(covariance, degrees, effect @ effect.T)
            remarks.append(
                f"the intervals include the standard deviation of {_told(plant, uncertain)}"
            )
    seen = identifiability(names, covariance / np.outer(size, size), fit.free)
    if isinstance(estimator, NLS) and estimator.prior is not None:
        rows = [names.index(name) for name in estimator.prior.names]
        values = dict(zip(names, map(float, fit.estimate.params), strict=True))
        white = np.asarray(fit.estimate.covariance)
        remarks += estimator.prior.verdict(values, white[np.ix_(rows, rows)])
    held = told_of_held(plant, experiments, fit.estimate, fit.free, fit.known)
    return covariance, degrees, (*fit.reasons, *held, seen, *remarks)


def _told(plant: AbstractPlant, uncertain: np.ndarray) -> str:
    """The uncertain constants with their standard deviations."""
    pairs = zip(plant.definition.constants, uncertain, strict=True)
    return ", ".join(f"{c.name} ({f'{sd:.3g} {c.unit}'.strip()})" for c, sd in pairs if sd)


def _fitted_all(
    plant: AbstractPlant,
    records: Sequence[Record],
    experiments: Experiments,
    estimate: Estimate,
    residual: list[np.ndarray],
) -> tuple[Fitted, ...]:
    """The records with what the plant makes of them."""
    predicted = _predicted(plant, records, estimate.prediction)
    if estimate.prediction is not None:
        residual = _by_record(records, _simulation_error(plant, experiments, estimate.params))
    parts = zip(records, residual, predicted, strict=True)
    return tuple(_fitted(plant.definition, *part) for part in parts)


def _fitted(
    description: PlantDescription,
    record: Record,
    residual: np.ndarray,
    predicted: Predicted | None = None,
) -> Fitted:
    """A record with its simulation, of which the residual is given."""
    simulated = record.outputs - residual
    return Fitted(record, simulated, _fits(description, record, simulated), predicted)


def _fits(description: PlantDescription, record: Record, outputs: np.ndarray) -> dict[str, float]:
    """Fit of each output in percent."""
    return {
        name: fit_percent(record.outputs[:, i], outputs[:, i])
        for i, name in enumerate(names_of(description.outputs))
    }


def _simulation_error(
    plant: AbstractPlant, experiments: Experiments, params: Params
) -> Float[np.ndarray, "experiment sample output"]:
    """Measured minus simulated outputs, from the initial states that fit best unless known."""
    if not experiments.initial_state_known:
        return np.asarray(_with_initial_state(plant, experiments, params).residual)
    begin, given = jax.device_put((experiments.initial_state, params))
    return np.asarray(
        residual_of(experiments, simulate_experiments(plant, given, experiments, begin))
    )


def _predicted(
    plant: AbstractPlant, records: Sequence[Record], prediction: Prediction | None
) -> list[Predicted | None]:
    """The one-step predictions of each record, of estimators that have one."""
    if prediction is None:
        return [None] * len(records)
    outputs = _by_record(records, np.asarray(prediction.outputs))
    sds = _by_record(records, np.asarray(prediction.sd))
    return [
        Predicted(
            values,
            sd,
            _fits(plant.definition, record, values),
            dict(zip(names_of(plant.definition.outputs), _inside(record, values, sd), strict=True)),
        )
        for record, values, sd in zip(records, outputs, sds, strict=True)
    ]


def _inside(record: Record, predicted: np.ndarray, sd: np.ndarray) -> list[float]:
    """Share of the measured values of each output inside the 95 % band [%]."""
    error = np.abs(record.outputs - predicted)
    return [
        100 * float(np.mean(e[s] <= HALF_95 * w[s]))
        for e, w in zip(error.T, sd.T, strict=True)
        for s in [np.isfinite(e)]
    ]


def _noise(description: PlantDescription, estimate: Estimate) -> Noise | None:
    """Estimated noise by name, of estimators that have one."""
    p = estimate.prediction
    if p is None:
        return None
    of_states = zip(names_of(description.states), map(float, p.process_noise), strict=True)
    of_outputs = zip(names_of(description.outputs), map(float, p.noise_sd), strict=True)
    return Noise(dict(of_states), dict(of_outputs))


def _whiteness(residuals: list[np.ndarray], scale: float) -> float:
    """p-value of white residuals; NaN where only rounding errors are left."""
    return ljung_box(*(r for r in residuals if _is_more_than_rounding(r, scale)))


def _is_more_than_rounding(residual: np.ndarray, scale: float) -> bool:
    return bool(np.any(np.abs(residual) > 1e-8 * scale))


def _dependence(
    residual: Sequence[np.ndarray], records: Sequence[Record], output: int, scale: float
) -> float:
    """p-value of an output's residual not following the input; see `_whiteness`."""
    pairs = [
        (r[seen, output], record.inputs[seen])
        for r, record in zip(residual, records, strict=True)
        for seen in [np.isfinite(r[:, output])]
    ]
    pairs = [(r, inputs) for r, inputs in pairs if _is_more_than_rounding(r, scale)]
    return input_dependence([r for r, _ in pairs], [inputs for _, inputs in pairs])


def _wrong_structure(
    structure: Mapping[str, float], estimator: AbstractEstimator
) -> tuple[str, ...]:
    """A sentence where a residual follows the input."""
    wrong = [name for name, p in structure.items() if p < RARE / len(structure)]
    if not wrong:
        return ()
    or_biased = (
        "" if isinstance(estimator, AbstractSearch) else "; or the estimator is biased: try nls"
    )
    return (
        f"the residual of {' and '.join(wrong)} follows the input: the structure of this plant is "
        "wrong for these data, or time, input or sensor differ from its description; the "
        f"intervals do not include this error{or_biased}",
    )


def _above_declared(plant: AbstractPlant, fit: _Fit) -> tuple[str, ...]:
    """A sentence on each output whose residual is far larger than its declared noise."""
    residual, declared = np.asarray(fit.estimate.residual), np.asarray(plant.sensor.sd)
    size = np.sqrt(np.sum(residual**2, axis=(0, 1)) / np.sum(residual != 0, axis=(0, 1)).clip(1))
    return tuple(
        f"the residual of {part.name} is {own / sd:.3g} times its declared noise ({own:.3g} for "
        f"{sd:.3g} {part.unit}): the plant leaves something out, or the declaration is wrong"
        for part, own, sd in zip(plant.definition.outputs, size, declared, strict=True)
        if sd > 0 and own > _FAR_ABOVE * sd
    )


def _suspects(
    plant: AbstractPlant,
    records: Sequence[Record],
    experiments: Experiments,
    estimator: AbstractEstimator,
    start: Params,
    fit: _Fit,
    linear: np.ndarray,
    progress: Progress,
) -> tuple[Suspect, ...]:
    """What the plant may leave out, where more than noise is left; not for long records."""
    if not isinstance(estimator, NLS) or not fit.is_successful:
        return ()
    if estimator.likelihood != "normal":  # outliers would hide them
        return ()
    if experiments.valid.size > _SIZE_OF_SUSPECTS:
        return ()
    residual, valid = np.asarray(fit.estimate.residual), np.asarray(experiments.valid)
    if _is_noise(plant, experiments, fit.estimate) and outliers(residual, valid) is None:
        return ()

    name, plus, extensions = plant.definition.name.partition("+")
    word = (
        f"{name if name in PLANTS else 'FILE.py:' + plain_kind(plant).__name__}{plus}{extensions}"
    )
    stacked = partial(_experiments, plant, records, experiments.initial_state_known)
    return suspects(
        plant,
        experiments,
        stacked,
        linear,
        estimator,
        start,
        fit.estimate,
        ~fit.known,
        word,
        lambda text, done, total: progress(text, 0.5 + 0.3 * done / total, 1.0),
    )


def _remedies(found: Sequence[Suspect]) -> tuple[str, ...]:
    """Sentences on the suspects, the likeliest first."""
    if not found:
        return ()
    others = [f"{s.name} ({100 * s.reduction:.3g} %)" for s in found[1:4] if s.reduction > 0]
    less = (f"less likely: {', '.join(others)}",) if others else ()
    return (f"likely cause: {found[0].sentence}", *less)


def _agreement(fit: _Fit) -> tuple[str, ...]:
    """A sentence on how many of several starts ended at the estimate."""
    if not fit.is_successful or not fit.others:
        return ()
    ends = [fit.estimate, *fit.others]
    most = (1 + _SAME / fit.estimate.residual.size) * float(fit.estimate.cost)
    same = sum(float(end.cost) <= most for end in ends)
    return (f"{same} of {len(ends)} starts of the search ended at this estimate",)


def _require_explanation(
    records: Sequence[Record], residual: Sequence[np.ndarray], unknowns: int
) -> None:
    """Raises ValueError where the best simulation fits the outputs no better than chance."""
    chances = [
        chance_of_fit(_finite(record.outputs[:, i]), _finite(r[:, i]), unknowns)
        for record, r in zip(records, residual, strict=True)
        for i in range(r.shape[1])
    ]
    if min(chances) > _BY_CHANCE:
        raise ValueError(_NOTHING_SEEN)


def _state_from(record: Record, plant: AbstractPlant, word: str | float) -> float | None:
    """Share of a held-out record that gives its initial state, 0 its first sample; None: known."""
    where, parts = record.source or "the record", parts_of(record)
    if word == "known" and len(parts) > 1:
        raise ValueError(f"{where} has gaps in time; the state after a gap is not known")
    if word == "known" or (word == "auto" and len(parts) == 1 and _starts_at(record, plant)):
        return None
    is_measured = all(np.isfinite(record.outputs[part.start]).all() for part in parts)
    if word in ("first", "auto") and is_measured and _outputs_give_state(plant):
        return 0.0
    if word == "first":
        raise ValueError(
            f"the first outputs of {where} do not determine the state of plant "
            f"{plant.definition.name!r}; give the share of the record from which it is estimated, "
            "such as 10%"
        )
    if word == "auto":
        return 1.0
    try:
        is_part = isinstance(word, str) and word.endswith("%")
        share = float(str(word).removesuffix("%")) * (0.01 if is_part else 1.0)
    except ValueError:
        share = math.nan
    if not 0 < share <= 1:
        raise ValueError(
            f"validate_state must be auto, known, first or a share such as 10%: got {word!r}"
        )
    return share


def _outputs_give_state(plant: AbstractPlant) -> bool:
    """Whether the outputs at one time determine the state, at the initial state."""
    scales = np.array([s.scale for s in plant.definition.states])
    slope = np.asarray(jax.jacfwd(plant.output)(plant.initial_state, plant.nominal)) * scales
    slope = slope / np.array([o.scale for o in plant.definition.outputs])[:, None]
    return bool(np.linalg.matrix_rank(slope, 1e-6) == len(scales))


def _validated(
    plant: AbstractPlant,
    record: Record,
    linear: np.ndarray,
    estimator: AbstractEstimator,
    estimate: Estimate,
    share: float | None,
) -> Fitted:
    """A held-out record with its simulation and prediction; `share`: see `_state_from`."""
    experiments, prediction = _experiments(plant, [record], False, linear), None
    if isinstance(estimator, PEM) and estimate.prediction is not None:
        found = jax.device_put((estimate.params, estimate.prediction))
        prediction = jax.device_get(estimator.predict(plant, experiments, *found))
    begun, valid = experiments, np.asarray(experiments.valid)
    used = np.zeros(valid.shape, bool)
    if share is not None:
        counts = valid.any(2).cumsum(1)
        used = valid & (counts <= np.ceil(counts[:, -1:] * share).clip(1))[..., None]
        begun = dataclasses.replace(experiments, valid=jax.device_put(used))
        initial = _with_initial_state(plant, begun, estimate.params).initial_state
        begun = dataclasses.replace(experiments, initial_state=jax.device_put(initial))
    begun = dataclasses.replace(begun, initial_state_known=True)
    (residual,) = _by_record([record], _simulation_error(plant, begun, estimate.params))
    (spent,) = _by_record([record], (used if share != 1 else ~valid).astype(float))
    fitted = _fitted(plant.definition, record, residual, *_predicted(plant, [record], prediction))
    scored = dataclasses.replace(record, outputs=np.where(spent == 0, record.outputs, np.nan))
    fits, words = _fits(plant.definition, scored, fitted.simulated), _in_words(share)
    if share == 1:
        begun = _validated(plant, record, linear, estimator, estimate, _SHARE).fit_percent.values()
        percent = " and ".join(f"{fit:.4g} %" for fit in begun)
        words += f" (from its first {100 * _SHARE:.0f} %, the rest fits {percent})"
    return dataclasses.replace(fitted, fit_percent=fits, initial_state=words)


def _in_words(share: float | None) -> str:
    """Where the initial state of a held-out record comes from."""
    if share is None:
        return "known initial state"
    if share == 0:
        return "initial state from the first measurements"
    if share == 1:
        return "initial state estimated from the whole record"
    return f"initial state estimated from the first {100 * share:.3g} %, which do not count"
