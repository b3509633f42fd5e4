"""`identify`: parameters and confidence intervals from recorded experiments."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..description import (
    HALF_95,
    RARE,
    Named,
    PlantDescription,
    by_name,
    listed,
    names_of,
    require_whole,
    unknown,
    wrong_type,
)
from ..files import json_ready
from ..information.identifiability import UNSEEN_SD, identifiability
from ..plant import AbstractPlant, Params, params_from
from ..plant.catalogue import PLANTS, PlantLike, plant_from, word_in_command
from ..plant.extension import plain_kind
from ..plant.static import require_sensor_noise
from ..progress import SHOWN, Progress
from ..record import (
    DataFrame,
    Record,
    described_in,
    read_record,
    require_columns,
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
    simulate_experiments,
    transitions,
)
from .diagnosis import (
    chance_of_fit,
    effect_of_constants,
    half_95,
    input_dependence,
    inverse_information,
    is_more_than_rounding,
    misfit_factor,
    robust_covariance,
    student_95,
    whiteness_of,
    widened,
    with_independent,
)
from .excerpt import spans_of
from .fit import (
    PRIOR_TOO,
    Fit,
    NothingLeftError,
    far_above_declared,
    fit_of,
    is_centred,
    is_elsewhere,
    is_exact,
    is_far,
    is_noise,
    known_parameters,
    nothing_seen,
    with_initial_state,
)
from .from_records import (
    by_record,
    experiments_of,
    finite,
    given_twice,
    linear_inputs,
    parts_of,
    require_complete,
    require_enough,
    require_short_delays,
    rows_of,
    sampled_as,
    starts_at,
)
from .held import told_of_held
from .integration import infinite_slope, too_coarse
from .nls import NLS, Likelihood
from .pem import PEM
from .prior import unbounded, within_support
from .prior_knowledge import PriorLike, with_prior
from .profile import profile_intervals
from .remedies import Question, Suspect, outliers, suspects, suspects_in
from .result import Fitted, Identification, Noise
from .validation import fitted_all, predicted_in_steps, state_from, validated, way_to_state

InitialState = Literal["auto", "free", "known"]
Intervals = Literal["linear", "profile"]
_SIZE_OF_SUSPECTS = 10_000  # measured values in which suspects are looked for
_FEW_DEGREES = 5.0  # of Student's t, below which it widens an interval by a third and more
_POOR = -1.0  # percent of fit, below which least squares are worse than a constant by no chance
_FAR_FACTOR = 10.0  # between an estimate and what was expected of it; a larger one is remarked
_BY_CHANCE = 1e-3  # a fit with a larger p-value explains nothing


RecordLike: TypeAlias = Record | str | Path | DataFrame
"""A record, the path of an experiment file, or a pandas DataFrame."""


def identify(
    records: RecordLike | Sequence[RecordLike],
    plant: PlantLike | None = None,
    estimator: str | AbstractEstimator | type[AbstractEstimator] = "nls",
    *,
    start: Mapping[str, float] | Params | None = None,
    hold: Mapping[str, float] | None = None,
    prior: PriorLike | Sequence[PriorLike] | None = None,
    uncertain: Mapping[str, float | str] | None = None,
    likelihood: Likelihood | None = None,
    initial_state: InitialState = "auto",
    intervals: Intervals = "linear",
    hold_input: str | Mapping[str, str] = "constant",
    validate: RecordLike | Sequence[RecordLike] = (),
    validate_state: str | float = "auto",
    validate_columns: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None,
    set_inputs: Mapping[str, float] | None = None,
    dt: float | None = None,
    rows: slice | str | None = None,
    room: tuple[int, int] = (0, 0),
    causes: bool = True,
    progress: Progress = SHOWN,
) -> Identification:
    """Parameters of one plant from one or several records.

        >>> import excite as ex
        >>> result = ex.identify(ex.simulate("aero2", "chirp", seed=0))
        >>> result.status
        'successful'
        >>> round(result.params.K_pu, 4)
        0.0125

    Args:
        records: a record, the path of an experiment file or a pandas DataFrame, or several.
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
        likelihood: of the noise, "normal" (default) or "student", with which outliers hardly
            count. With "student", or a prior, likely causes of a residual are not looked for.
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
        validate_columns: names in the files of held-out records where they differ from `columns`:
            {"u": "uVal", "y": "yVal"}. One file may hold both kinds of records.
        progress: called with a text, how much is done (NaN where it is not known), and the total.
        columns: names in the files where they are not the plant's: {"pitch": "qm"}.
        scales: factors from the files' units to the plant's: {"pitch": 0.01745}.
        units: the files' units where they are not the plant's: {"time": "ms", "pitch": "deg"}.
        set_inputs: values of constant inputs that the files do not have: {"voltage": 5.0}.
        dt: sampling time of files without time [s].
        rows: rows of the files to use, counted from 0: slice(100, 1000, 5) or "100:1000:5".
        room: number of records, and of samples in each, for which the estimator nls is compiled.
            After the first of many fits, those of no more records and samples take no time for it.
        causes: whether likely causes are looked for where the residual is not noise, which takes
            seconds.

    Raises:
        ValueError: for records too short, or in which no parameter can be identified, for a
            file that cannot be used, and for a name or a value that is not allowed.
        TypeError: for an argument of another type.
    """
    given = records_in(records, "records")
    if not given:
        raise ValueError("no record is given")
    if not isinstance(room, tuple) or len(room) != 2:
        raise wrong_type("room", room, "a pair of whole numbers")
    for number in room:
        require_whole("room", number, 0)
    held_out = records_in(validate, "validate")
    if validate_columns and not held_out:
        raise ValueError("validate_columns need a held-out record (--validate)")
    plant = plant_from(plant_named_by(given[0]) if plant is None else plant)
    estimator, begin = _chosen(estimator, plant, start, hold)
    require_sensor_noise(plant)
    by_steps = plant.definition.observes_state and isinstance(estimator, NLS)
    if plant.definition.is_disturbed and not (by_steps or isinstance(estimator, PEM)):
        raise ValueError(
            f"plant {plant.definition.name!r} has process noise, which {estimator.name} takes for "
            "noise of its sensors: use the estimator pem"
        )
    estimator = _with_likelihood(estimator, likelihood)
    if prior is not None:
        if not isinstance(estimator, NLS):
            raise ValueError(f"a prior needs the estimator nls: got {estimator.name}")
        if estimator.prior is not None:
            raise ValueError("the estimator has a prior already; give one of the two")
        plant, joint, begin = with_prior(plant, prior, begin, start or {}, hold or {})
        estimator = dataclasses.replace(estimator, prior=joint)
    if intervals not in get_args(Intervals):
        raise ValueError(f"intervals {intervals!r} are not one of: linear, profile")
    if intervals == "profile" and not isinstance(estimator, NLS):
        raise ValueError(f"profile intervals need the estimator nls: got {estimator.name}")
    uncertain_sd = _uncertain(plant, estimator, uncertain)
    if initial_state not in get_args(InitialState):
        raise ValueError(f"initial state {initial_state!r} is not one of: known, free, auto")
    progress("reading", 0.0, 1.0)
    of_files = {"scales": scales, "units": units, "set_inputs": set_inputs, "dt": dt, "rows": rows}
    _require_files([*given, *held_out], columns=columns, **of_files)
    read = partial(record_for, plant.description, **of_files)
    of_held_out = by_name("columns", columns) | by_name("validate_columns", validate_columns)
    records = [read(record, columns=columns) for record in given]
    validation = [read(record, columns=of_held_out) for record in held_out]
    known = initial_state == "known" or (
        initial_state == "auto" and all(starts_at(record, plant) for record in records)
    )
    num_free, num_priors = int(np.sum(~known_parameters(plant, estimator))), _priors(estimator)
    has_prior = prior is not None or (isinstance(estimator, NLS) and estimator.prior is not None)
    require_enough(plant, records, num_free, known or by_steps, num_priors, has_prior)
    way = way_to_state(validate_state)
    shares = [state_from(record, plant, way) for record in validation]
    for record in validation:
        require_enough(plant, [record], 0, False)
    require_short_delays(plant, begin, records)
    linear = linear_inputs(plant, hold_input)
    if not isinstance(estimator, AbstractSearch):
        require_complete(estimator, [*records, *validation], linear)
    plant = sampled_as([*records, *validation], plant)
    known = known and all(len(parts_of(record)) == 1 for record in records)
    whole = experiments_of(plant, records, known, linear)
    seen, experiments = transitions(plant, whole) if by_steps else (plant, whole)
    if not isinstance(estimator, NLS) or by_steps:
        room = (0, 0)
    progress("first search", 0.0, 1.0)
    find = partial(
        _suspects, seen, records, experiments, estimator, begin, linear, causes, progress
    )
    too = PRIOR_TOO * bool(num_priors)
    try:
        fit = fit_of(seen, experiments, estimator, begin, progress, room)
    except NothingLeftError as refusal:
        raise _with_causes(str(refusal) + too, find(refusal.fit, False, False)[0]) from None
    params, prediction = fit.estimate.params, fit.estimate.prediction
    if by_steps:
        error, prediction = predicted_in_steps(seen, whole, experiments, params)
        residual = by_record(records, error)
    else:
        residual = _residuals(plant, records, experiments, estimator, fit)
    fitted = fitted_all(plant, records, whole, params, residual, prediction)
    is_normal = isinstance(estimator, NLS) and estimator.likelihood == "normal"
    free = {n for n, own in zip(params._fields, fit.free, strict=True) if own}
    known_before = set() if not is_normal or estimator.prior is None else {*estimator.prior.names}
    # What the data do not tell of parameters that all have a prior, the prior does.
    is_judged = is_normal and not fit.has_ended_in(Status.NOT_FINITE) and not free <= known_before
    is_fit = not is_judged or _explains(records, residual, int(fit.free.sum()) - num_priors)
    whiteness = {
        name: whiteness_of([finite(r[:, i]) for r in residual], plant.definition.outputs[i].scale)
        for i, name in enumerate(names_of(plant.definition.outputs))
    }
    structure = {
        name: _dependence(residual, records, i, plant.definition.outputs[i].scale)
        for i, name in enumerate(whiteness)
    }
    wrong = [n for n, p in structure.items() if p < RARE / len(structure)] * fit.is_successful
    found, where = find(fit, is_fit and fit.is_successful, bool(wrong))
    if not is_fit:
        raise _with_causes(nothing_seen(plant) + too, found)
    covariance, degrees, factor, verdict = _confidence(
        seen, experiments, estimator, fit, whiteness, uncertain_sd, bool(wrong), by_steps, room
    )
    others = (
        *(s for record in [*records, *validation] for s in _other_plant(record, plant)),
        *given_twice(records, validation),
    )
    wrong = _wrong_structure(wrong, factor, estimator)
    large = _above_declared(seen, fit) if fit.is_successful else ()
    astray = _simulates_poorly(fitted, prediction is not None) if fit.is_successful else ()
    remedies = *_remedies(found), *where
    verdict = (*others, *wrong, *large, *astray, *remedies, *agreement(fit), *verdict)
    if fit.has_ended_in(Status.NOT_FINITE) and not by_steps:
        verdict = (*verdict, *infinite_slope(plant, begin, whole))
    names = names_of(plant.definition.parameters)
    values = np.array([float(value) for value in fit.estimate.params])
    sd = np.where(fit.free, np.sqrt(np.maximum(np.diag(covariance), 0.0)), np.nan)
    half = np.where(fit.free, half_95(covariance, degrees), np.nan)
    if isinstance(estimator, NLS) and fit.is_successful and not by_steps:
        coarse = too_coarse(plant, experiments, fit.estimate, fit.free, sd, room)
        verdict = (*coarse, *verdict)
    ends = np.stack([values - half, values + half], axis=1)
    ends = within_support(plant, ends) if fit.is_successful else ends
    if isinstance(estimator, AbstractSearch):  # others can be biased as much
        verdict = (*_far_from_expected(plant, begin, fit.free, values, ends), *verdict)
    profiles = {}
    if intervals == "profile" and isinstance(estimator, NLS) and fit.is_successful:
        estimate = jax.device_put(fit.estimate)
        ends, profiles = profile_intervals(
            seen,
            experiments,
            estimator,
            estimate,
            fit.free,
            half,
            lambda text, done, total: progress(text, 0.8 + 0.2 * done / total, 1.0),
        )
        verdict = (*verdict, *_open_sides(plant.definition, ends))
    return Identification(
        plant=unbounded(plant).description,
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
        misfit_factor=factor,
        verdict=verdict,
        suspects=found,
        fitted=fitted,
        validation=tuple(
            validated(plant, record, linear, estimator, fit.estimate, prediction, share)
            for record, share in zip(validation, shares, strict=True)
        ),
        initial_state_known=known or by_steps,
        noise=_noise(plant.definition, prediction),
        starts=tuple(float(end.cost) for end in (fit.estimate, *fit.others)) if fit.others else (),
        profiles=profiles,
        basis=Basis(seen, experiments, estimator, fit.estimate, fit.free, uncertain_sd),
    )


def records_in(records: RecordLike | Sequence[RecordLike], what: str) -> list[RecordLike]:
    """One or several records as a list."""
    listed = [records] if isinstance(records, RecordLike) else records
    allowed = "a record, the path of an experiment file or a DataFrame, or several"
    if not isinstance(listed, Sequence):
        raise wrong_type(what, records, allowed)
    for record in listed:
        _require_record(record, what, allowed)
    return list(listed)


def _require_record(given: object, what: str, allowed: str) -> None:
    """Raises TypeError for anything but a `RecordLike`; the class DataFrame looks like one."""
    if isinstance(given, type) or not isinstance(given, RecordLike):
        raise wrong_type(what, given, allowed)


def plant_named_by(record: RecordLike) -> str:
    """The plant that a record's sidecar names."""
    if isinstance(record, Record):
        return require_shipped(record.description.name, record.source or "the record")
    path = record if isinstance(record, DataFrame) else Path(record)
    return require_shipped(described_in(path).name, str(path))


def require_shipped(name: str, where: str) -> str:
    """The name of a plant that a record or a result is of; ValueError for a user's own plant."""
    if name.partition("+")[0] not in PLANTS:
        raise ValueError(
            f"{where} is of plant {name!r}, which does not come with the package: give the plant "
            "(--plant) as path/to/file.py:ClassName, or in Python as an object or a class"
        )
    return name


def _require_files(records: Sequence[RecordLike], **options: object) -> None:
    """Raises ValueError for an option of files where no record is read from one."""
    if all(isinstance(record, Record) for record in records):
        for name, value in options.items():
            if value not in (None, {}):
                raise ValueError(f"{name} is for files, and the records are given as objects")


def record_for(description: PlantDescription, given: RecordLike, **options: Any) -> Record:
    """A record, read where it is a file or a DataFrame.

    Raises:
        ValueError: where it does not have the plant's columns.
        TypeError: for anything else.
    """
    _require_record(given, "record", "a record, a path or a DataFrame")
    if not isinstance(given, Record):
        return read_record(given, description, **options)
    found = given.inputs.shape[1], given.outputs.shape[1]
    if found != (len(description.inputs), len(description.outputs)):
        has = " and ".join(
            f"{count} {word}{'s' * (count != 1)}"
            for count, word in zip(found, ("input", "output"), strict=True)
        )
        raise ValueError(
            f"{given.source or 'the record'} has {has}; plant {description.name!r} has "
            f"{len(description.inputs)} and {len(description.outputs)}"
        )
    require_columns(given, description)
    return given


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
    begin = params_from(plant, start, "start")
    if not hold:
        return method, begin
    held = params_from(plant, hold, "hold")
    names = tuple(hold if isinstance(hold, Mapping) else begin._fields)
    begin = begin._replace(**{name: getattr(held, name) for name in names})
    return dataclasses.replace(method, known=names), begin


def _with_likelihood(
    estimator: AbstractEstimator, likelihood: Likelihood | None
) -> AbstractEstimator:
    """The estimator with the likelihood that is asked for."""
    if likelihood is None:
        return estimator
    if likelihood not in get_args(Likelihood):
        raise ValueError(f"likelihood {likelihood!r} is not one of: normal, student")
    if isinstance(estimator, NLS):
        return dataclasses.replace(estimator, likelihood=likelihood)
    if likelihood != "normal":
        raise ValueError(f"likelihood {likelihood} needs the estimator nls: got {estimator.name}")
    return estimator


def _uncertain(
    plant: AbstractPlant, estimator: AbstractEstimator, given: Mapping[str, float | str] | None
) -> Float[np.ndarray, " constant"]:
    """Standard deviation of each known constant, zero where none is given."""
    given = by_name("uncertain", given, "a dict by constant")
    if given and not isinstance(estimator, NLS):
        raise ValueError(f"uncertain constants need the estimator nls: got {estimator.name}")
    values = {name: float(value) for name, value in plant.constants._asdict().items()}
    sd = dict.fromkeys(values, 0.0)
    for name, spread in given.items():
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


def _priors(estimator: AbstractEstimator) -> int:
    """How many free parameters have a normal prior that counts as a measured value.

    None where the noise is found from the residual: a residual of priors alone would be zero.
    """
    if not isinstance(estimator, NLS) or estimator.prior is None or estimator.noise != "known":
        return 0
    return len({*estimator.prior.names} - {*estimator.known})


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


def _other_plant(record: Record, plant: AbstractPlant) -> tuple[str, ...]:
    """A warning where the record was made with another plant or other constants."""
    made_with, own = record.metadata.get("plant", {}), json_ready(plant.description.to_dict())
    if all(made_with.get(key, own[key]) == own[key] for key in ("name", "constants")):
        return ()
    where, name = record.source or "the record", made_with.get("name", own["name"])
    if name != own["name"]:
        return (f"{where} was made with plant {name!r}, not with {own['name']!r}",)
    return (f"{where} was made with other known constants of {name!r}",)


def _residuals(
    plant: AbstractPlant,
    records: Sequence[Record],
    experiments: Experiments,
    estimator: AbstractEstimator,
    fit: Fit,
) -> list[Float[np.ndarray, "_sample output"]]:
    """The residual of each record, at its length."""
    estimate = fit.estimate
    knows_state = experiments.initial_state_known or isinstance(estimator, AbstractSearch)
    if fit.is_successful and not knows_state:  # ARX does not estimate the state
        estimate = with_initial_state(plant, experiments, estimate.params)
    return by_record(records, np.asarray(estimate.residual))


def _confidence(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: AbstractEstimator,
    fit: Fit,
    whiteness: Mapping[str, float],
    uncertain: np.ndarray,
    is_wrong: bool,
    by_steps: bool,
    room: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray, float, tuple[str, ...]]:
    """Covariance of the estimates, its degrees of freedom, and the sentences of the verdict.

    A wrong structure widens what the data tell, and not what a prior tells: by the factor that
    stands before the sentences. Intervals from one-step predictions assume white noise.
    """
    names = names_of(plant.definition.parameters)
    covariance, its = np.asarray(fit.estimate.covariance), fit.estimate.degrees
    degrees = np.full(len(names), np.inf) if its is None else np.asarray(its)
    if not fit.is_successful:
        sentence = Status(int(fit.estimate.status)).sentence
        needed = f"; {estimator.name} needs {estimator.needs}" if estimator.needs else ""
        return covariance, degrees, 1.0, (*fit.reasons.values(), sentence + needed)
    coloured, remarks, factor = [name for name, p in whiteness.items() if p < RARE], [], 1.0
    not_white = f"the residual of {' and '.join(coloured)} is not white: the intervals"
    parameters = zip(plant.definition.parameters, fit.estimate.params, strict=True)
    size = np.array([float(value) if p.positive else p.scale for p, value in parameters])
    if coloured and (by_steps or not isinstance(estimator, NLS)):
        remarks.append(f"{not_white} assume white noise, and are too narrow")
    if by_steps:
        coloured, is_wrong = [], False
    if isinstance(estimator, NLS) and (coloured or uncertain.any() or is_wrong):
        is_known = experiments.initial_state_known
        whole = experiments.padded(*room) if is_known else experiments  # as for the search
        estimate, free = jax.device_put((fit.estimate.of(whole), fit.free))
        S, residual = map(np.asarray, estimator.sensitivity(plant, whole, estimate, free))
        prior = np.asarray(estimator.prior_information(plant, estimate, S.shape[-1], free))
        valid = np.asarray(whole.valid)
        if is_wrong:
            signals = _signals(plant, whole, estimate)
            factor = misfit_factor(S, residual, valid, signals, len(plant.definition.states))
        if coloured:
            robust, its = robust_covariance(S, residual, valid, prior)
            robust = np.outer(size, size) * robust[: len(names), : len(names)]
            is_wider = np.diag(robust) > np.diag(covariance)
            degrees = np.where(is_wider, its[: len(names)], degrees)
            covariance = widened(covariance, robust)
            but = "" if factor > 1 else ", not for an error in the plant's equations"
            remarks.append(f"{not_white} allow for coloured noise{but}")
        inverse = inverse_information(S, prior)
        known = (inverse @ prior @ inverse)[: len(names), : len(names)] * np.outer(size, size)
        covariance = factor**2 * (covariance - known) + known
        if uncertain.any():
            to_constants = np.asarray(estimator.constant_sensitivity(plant, whole, estimate))
            effect = effect_of_constants(S, to_constants, prior)[: len(names)] * uncertain[None]
            effect = effect * size[:, None]
            covariance, degrees = with_independent(covariance, degrees, effect @ effect.T)
            remarks.append(
                f"the intervals include the standard deviation of {_sd_in_words(plant, uncertain)}"
            )
    if isinstance(estimator, NLS) and estimator.prior is not None:
        values = dict(zip(names, map(float, fit.estimate.params), strict=True))
        sd = dict(zip(names, np.sqrt(np.diag(np.asarray(fit.estimate.covariance))), strict=True))
        remarks += estimator.prior.verdict(values, {n: sd[n] for n in names if sd[n] > 0})
    remarks += [*_recorded_late(plant, fit.estimate, covariance), *_few_degrees(fit)]
    held = told_of_held(
        plant, experiments, estimator, fit.estimate, fit.free, fit.known, tuple(fit.reasons)
    )
    seen = _certainty(names, covariance / np.outer(size, size), fit.free)
    return covariance, degrees, factor, (*fit.reasons.values(), *held, *seen, *remarks)


def _recorded_late(
    plant: AbstractPlant, estimate: Estimate, covariance: np.ndarray
) -> tuple[str, ...]:
    """A sentence on each input whose estimated delay is below zero by more than chance."""
    found = jnp.stack([*estimate.params])

    def delays(values: jax.Array) -> jax.Array | None:
        return plant.delay(plant.Params(*values))

    if (delay := delays(found)) is None:
        return ()
    slope = np.asarray(jax.jacfwd(delays)(found))
    std_error = np.sqrt(np.maximum(np.diagonal(slope @ covariance @ slope.T), 0.0))
    names = names_of(plant.definition.inputs)
    return tuple(
        f"the delay of {name} is negative ({value:.4g} s): {name} is recorded later than it acts, "
        "or is not as assumed between samples (--hold-input), or the plant answers faster than its "
        "equations"
        for name, value, sd in zip(names, map(float, delay), std_error, strict=True)
        if sd > 0 and value < -HALF_95 * sd
    )


def _few_degrees(fit: Fit) -> tuple[str, ...]:
    """A sentence where few values make the intervals wide."""
    if fit.estimate.degrees is None:
        return ()
    least = float(np.min(np.asarray(fit.estimate.degrees)[fit.free], initial=np.inf))
    if not least < _FEW_DEGREES:
        return ()
    return (
        f"few values are left to tell the noise ({least:.3g} degrees of freedom): Student's t, "
        f"{student_95(least):.3g} in place of 1.96, makes the intervals wide",
    )


def _certainty(names: tuple[str, ...], covariance: np.ndarray, free: np.ndarray) -> tuple[str, ...]:
    """Sentences on the certainty of the free parameters by their relative covariance.

    With intervals that are wider than those of white noise, some may be as uncertain as what is not
    identifiable.
    """
    is_told = free & (np.diag(covariance) < UNSEEN_SD**2)
    lost = [name for name, is_lost in zip(names, free & ~is_told, strict=True) if is_lost]
    told = [identifiability(names, covariance, is_told)] if is_told.any() else []
    if lost:
        told.append(f"{listed(lost)}: standard error above {100 * UNSEEN_SD:.0f} %")
    return tuple(told)


def _sd_in_words(plant: AbstractPlant, uncertain: np.ndarray) -> str:
    """The uncertain constants with their standard deviations."""
    pairs = zip(plant.definition.constants, uncertain, strict=True)
    return ", ".join(f"{c.name} ({f'{sd:.3g} {c.unit}'.strip()})" for c, sd in pairs if sd)


def _noise(description: PlantDescription, p: Prediction | None) -> Noise | None:
    """Estimated noise by name, of estimators that have a one-step prediction."""
    if p is None:
        return None
    of_states = zip(names_of(description.states), map(float, p.process_noise), strict=True)
    of_outputs = zip(names_of(description.outputs), map(float, p.noise_sd), strict=True)
    return Noise(dict(of_states), dict(of_outputs))


def _dependence(
    residual: Sequence[np.ndarray], records: Sequence[Record], output: int, scale: float
) -> float:
    """p-value of an output's residual not following the input; see `whiteness_of`."""
    pairs = [
        (r[seen, output], record.inputs[seen])
        for r, record in zip(residual, records, strict=True)
        for seen in [np.isfinite(r[:, output])]
    ]
    pairs = [(r, inputs) for r, inputs in pairs if is_more_than_rounding(r, scale)]
    return input_dependence([r for r, _ in pairs], [inputs for _, inputs in pairs])


def _signals(
    plant: AbstractPlant, experiments: Experiments, estimate: Estimate
) -> Float[np.ndarray, "experiment sample signal"]:
    """Inputs and simulated outputs: what an error of the structure follows."""
    e = experiments
    simulated = simulate_experiments(plant, estimate.params, e, estimate.initial_state)
    inputs = np.pad(np.asarray(e.inputs), [(0, 0), (0, 1), (0, 0)])  # the last one acts no more
    return np.concatenate([inputs, np.asarray(simulated)], axis=2)


def _wrong_structure(
    outputs: Sequence[str], factor: float, estimator: AbstractEstimator
) -> tuple[str, ...]:
    """A sentence where residuals follow the input."""
    if not outputs:
        return ()
    or_biased = (
        "" if isinstance(estimator, AbstractSearch) else "; or the estimator is biased: try nls"
    )
    allowed = "do not include this error"
    if factor > 1:
        times = f"{factor:.2g}" if factor < 10 else f"{factor:.0f}"
        allowed = f"are {times} times as wide for this error, taken as alike in all directions"
    return (
        f"the residual of {listed(outputs)} follows the input: the structure of this plant is "
        "wrong for these data, or time, input or sensor differ from its description; the "
        f"intervals {allowed}{or_biased}",
    )


def _above_declared(plant: AbstractPlant, fit: Fit) -> tuple[str, ...]:
    """A sentence on each output whose residual is far larger than its declared noise."""
    found = far_above_declared(plant, fit.estimate)
    parts = [(plant.definition.outputs[i], own, float(plant.sensor.sd[i])) for i, own in found]
    return tuple(
        f"the residual of {part.name} is {own / sd:.3g} times its declared noise ({own:.3g} for "
        f"{sd:.3g} {part.unit}): the plant leaves something out, or the declaration is wrong"
        for part, own, sd in parts
    )


def _simulates_poorly(fitted: Sequence[Fitted], is_predicted: bool) -> tuple[str, ...]:
    """A sentence where a simulation is no better than a constant."""
    least = 0.0 if is_predicted else _POOR
    poor = {n for own in fitted for n, fit in own.fit_percent.items() if fit < least}
    if not poor:
        return ()
    because = (
        "process noise explains what the equations should; use these parameters to predict, not to "
        "simulate"
        if is_predicted
        else "the plant leaves something out, or the search ended far from the truth (--start)"
    )
    return (f"the simulation of {listed(sorted(poor))} is worse than a constant: {because}",)


def _far_from_expected(
    plant: AbstractPlant,
    start: Params,
    free: np.ndarray,
    values: Float[np.ndarray, " param"],
    ends: Float[np.ndarray, "param end"],
) -> tuple[str, ...]:
    """A sentence on positive parameters that are far from their nominal and their start value.

    What cannot be told from zero, or from its nominal value, is not far, and the nominal value of
    an extension's parameter says nothing.
    """
    own, far = names_of(plain_kind(plant).definition.parameters), []
    for part, begin, is_free, value, (low, high) in zip(
        plant.definition.parameters, start, free, values, ends, strict=True
    ):
        if not (part.positive and is_free and part.name in own and low > 0):
            continue
        factors = value / np.array([part.nominal, float(begin)])
        if min(abs(np.log(factors))) > np.log(_FAR_FACTOR) and not low < part.nominal < high:
            far.append(
                f"{part.name} = {f'{value:.4g} {part.unit}'.strip()} ({factors[0]:.2g} times its "
                "nominal value)"
            )
    if not far:
        return ()
    return (
        f"{', '.join(far)}: are units, scales and sampling time right (--unit, --scale, --dt)?",
    )


def _suspects(
    plant: AbstractPlant,
    records: Sequence[Record],
    experiments: Experiments,
    estimator: AbstractEstimator,
    start: Params,
    linear: np.ndarray,
    is_asked: bool,
    progress: Progress,
    fit: Fit,
    is_best: bool,
    follows_input: bool,
) -> tuple[tuple[Suspect, ...], tuple[str, ...]]:
    """What the plant may leave out, where more than noise is left, and in which rows."""
    if not (is_asked and isinstance(estimator, NLS)) or fit.has_ended_in(Status.NOT_FINITE):
        return (), ()
    if plant.definition.is_disturbed:
        return (), ()  # disturbances explain what a suspect would
    if estimator.likelihood != "normal" or estimator.prior is not None:
        return (), ()  # outliers would hide them, a prior explain what they explain
    residual, valid = np.asarray(fit.estimate.residual), np.asarray(experiments.valid)
    if is_exact(plant, fit.estimate):
        return (), ()  # nothing is left to explain
    is_white = is_noise(plant, experiments, fit.estimate) and is_centred(experiments, fit.estimate)
    if is_white and not follows_input and outliers(residual, valid) is None:
        return (), ()

    question = Question(
        plant,
        experiments,
        estimator,
        lambda plant, linear: experiments_of(
            plant, records, experiments.initial_state_known, linear
        ),
        linear,
        start,
        fit.estimate,
        is_best,
        ~fit.known,
        word_in_command(plant),
    )

    def told(text: str, done: float, total: float) -> None:
        progress(text, 0.5 + 0.3 * done / total, 1.0)

    if valid.size <= _SIZE_OF_SUSPECTS:
        return suspects(question, told), ()
    spans = spans_of(experiments, residual, _SIZE_OF_SUSPECTS)
    where = rows_of(records, [(span.experiment, span.first, span.stop) for span in spans])
    found = suspects_in(question, spans, told)
    if not found:
        return found, (f"no likely cause was found in {where}",)
    return found, (f"likely causes were looked for in {where}",)


def _remedies(found: Sequence[Suspect]) -> tuple[str, ...]:
    """Sentences on the suspects, the likeliest first."""
    if not found:
        return ()
    others = [f"{s.name} ({100 * s.reduction:.3g} %)" for s in found[1:4] if s.reduction > 0]
    less = (f"less likely: {', '.join(others)}",) if others else ()
    return (f"likely cause: {found[0].sentence}", *less)


def agreement(fit: Fit) -> tuple[str, ...]:
    """How many of several starts ended at the estimate, and one elsewhere that fits as well."""
    if not fit.is_successful or not fit.others:
        return ()
    best, count = fit.estimate, 1 + len(fit.others)
    noise = float(best.cost) / max(np.count_nonzero(best.residual), 1)
    others = [end for end in fit.others if is_elsewhere(end, best)]
    told = f"{count - len(others)} of {count} starts of the search ended at this estimate"
    for end in others:
        is_as_good = float(end.cost) - float(best.cost) <= HALF_95**2 * noise
        if int(end.status) == Status.SUCCESSFUL and is_as_good and is_far(end, best):
            found = zip(end.params._fields, end.params, fit.free, strict=True)
            values = ", ".join(f"{name}={float(value):.4g}" for name, value, own in found if own)
            return (
                f"{told}; another ended at {values}, which fits as well but for chance and lies "
                "outside the intervals",
            )
    return (told,)


def _with_causes(refusal: str, found: Sequence[Suspect]) -> ValueError:
    """A refusal, with what the plant may leave out."""
    return ValueError("; ".join([refusal, *_remedies(found)]))


def _explains(records: Sequence[Record], residual: Sequence[np.ndarray], unknowns: int) -> bool:
    """Whether the best simulation fits an output better than chance.

    What has no more values than unknowns cannot be tested.
    """
    chances = [
        chance_of_fit(record.outputs[np.isfinite(r[:, i]), i], finite(r[:, i]), unknowns)
        for record, r in zip(records, residual, strict=True)
        for i in range(r.shape[1])
        if np.isfinite(r[:, i]).sum() > unknowns > 0
    ]
    return min(chances, default=0.0) <= _BY_CHANCE
