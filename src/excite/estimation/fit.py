"""The fit of a plant: searches from several starts; what the data do not tell is held."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import numpy as np

from ..description import RARE, names_of
from ..information.identifiability import STRUCTURALLY_NOT, worst_seen
from ..plant import AbstractPlant, Params, floats
from ..progress import Progress
from .contract import (
    AbstractEstimator,
    AbstractSearch,
    Estimate,
    Experiments,
    Status,
    bound_reached,
    from_search,
    quality,
    to_search,
)
from .diagnosis import is_more_than_rounding, mean_or_trend, whiteness_of
from .held import structure_of
from .nls import NLS
from .pem import PEM

PRIOR_TOO = " or is the prior far from the truth (--prior)?"
_STARTS, _SIZE_OF_MANY_STARTS = 8, 50_000  # measured values up to which so many are tried
_TELLING = 50  # measured values from which the residual tells whether the search missed something
_MORE_THAN_CHANCE = 10.0  # of a chi-squared variable of one degree of freedom
_STILL, _OFTEN = 1e-5, 0.1  # of an output's range: gaps are closed so far; of its samples
_SAME = 0.01  # difference of sums of squares at one minimum, over the noise
_FAR_ABOVE = 10.0  # times the declared noise
_FAR = 5.0  # standard errors between two ends of the search that are not one minimum
_FAR_OFF = 100.0  # times a positive parameter's start, or scales from it: the search ran away
_FREE = 100.0  # scales of a parameter of free sign that are small for its standard error


def nothing_seen(plant: AbstractPlant) -> str:
    """Why no parameter may be identifiable, as questions."""
    moves = "does the input move the plant" if plant.definition.inputs else "do the outputs move"
    return (
        f"no parameter is identifiable from the data; are columns, signs and units right, and "
        f"{moves} beyond the noise? or did the search begin too far from the truth (--start)?"
    )


def known_parameters(plant: AbstractPlant, estimator: AbstractEstimator) -> np.ndarray:
    """Which parameters the estimator holds because they are known; ValueError where all are."""
    names = names_of(plant.definition.parameters)
    held = estimator.held(plant) if isinstance(estimator, AbstractSearch) else (False,) * len(names)
    if all(held):
        raise ValueError("all parameters are held; none is left to estimate")
    return np.array(held)


class NothingLeftError(ValueError):
    """No parameter is left to estimate; `fit` is the one before any was held."""

    def __init__(self, sentence: str, fit: Fit) -> None:
        super().__init__(sentence)
        self.fit = fit


@dataclass(frozen=True)
class Fit:
    """An estimate, its free and known parameters, and why each held one was held, by name.

    `others` are the ends of searches that began elsewhere.
    """

    estimate: Estimate
    free: np.ndarray
    known: np.ndarray
    reasons: Mapping[str, str]
    others: Sequence[Estimate] = ()

    def has_ended_in(self, status: Status) -> bool:
        """Whether the estimate has this status."""
        return int(self.estimate.status) == status

    @property
    def is_successful(self) -> bool:
        """Whether the search converged."""
        return self.has_ended_in(Status.SUCCESSFUL)

    @property
    def status(self) -> str:
        """The status in words."""
        if self.is_successful and not (self.free | self.known).all():
            return "partly identifiable"
        return Status(int(self.estimate.status)).name.lower().replace("_", " ")


def fit_of(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: AbstractEstimator,
    start: Params,
    progress: Progress,
    room: tuple[int, int] = (0, 0),
) -> Fit:
    """Fits; parameters that were held are tested once more, from the estimate.

    Far from the true values a search can end at an estimate where the outputs hardly depend
    on a parameter, although the data determine it.

    Args:
        plant: with the sampling time of the experiments.
        experiments: the data.
        estimator: that fits.
        start: of its search.
        progress: called with a text, how much is done, and the total.
        room: number and length of the experiments for which the search is compiled, if that is
            more than there are.
    """
    fit = _fit_seen(plant, experiments, estimator, start, progress, room)
    if not (fit.reasons and fit.is_successful):
        return fit
    again = _fit_seen(plant, experiments, estimator, fit.estimate.params, progress, room)
    return again if again.is_successful and again.free.sum() > fit.free.sum() else fit


def _fit_seen(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: AbstractEstimator,
    start: Params,
    progress: Progress,
    room: tuple[int, int],
) -> Fit:
    """Fits; holds a parameter that ends at a bound or is not identifiable, and fits again."""
    names = names_of(plant.definition.parameters)
    known = known_parameters(plant, estimator)
    begin, free, reasons = start, ~known, {}
    found = _estimate(plant, experiments, estimator, start, free, progress, room)
    first = Fit(found[0], free, known, reasons, found[1:])
    while True:
        fit = Fit(found[0], free, known, reasons, found[1:])
        # ARX estimates all parameters or none.
        if not isinstance(estimator, AbstractSearch) or fit.has_ended_in(Status.NOT_FINITE):
            return fit
        held = _to_hold(plant, fit)
        if held is None:
            return fit
        chosen, why, bound = held
        name, ended = names[chosen], found[0]
        value = float(begin[chosen]) if bound is None else bound
        start, last = (params._replace(**{name: floats(value)}) for params in (start, ended.params))
        free = free & (np.arange(len(names)) != chosen)
        if not free.any():
            if bound is not None:
                every = "; ".join([*reasons.values(), why])
                raise NothingLeftError(f"no parameter is left to estimate: {every}", first)
            tested = structure_of(plant, experiments, start, known)
            groups = tested.not_identifiable if tested else ()
            lost = [f"{STRUCTURALLY_NOT}: {group.sentence}" for group in groups]
            raise NothingLeftError("; ".join([*lost, nothing_seen(plant)]), first)
        found = _estimate(plant, experiments, estimator, start, free, progress, room, [last])
        contradicts = ""
        if bound is None and _fits_worse(plant, found[0], ended):
            contradicts = ", which contradicts the data (--start)"
            if _is_near(plant, chosen, value, ended):
                start, value, contradicts = ended.params, float(ended.params[chosen]), ""
                found = _estimate(plant, experiments, estimator, start, free, progress, room, [])
        held_at = "" if bound is not None else f"; {name} was held at {value:g}{contradicts}"
        reasons = {**reasons, name: why + held_at}


def _estimate(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: AbstractEstimator,
    start: Params,
    free: np.ndarray,
    progress: Progress,
    room: tuple[int, int],
    others: Sequence[Params] | None = None,
) -> list[Estimate]:
    """Estimates, the best first; the search is repeated where it may have missed the best one.

    Where more than noise is left, or a short record cannot tell, it is repeated as one simulation,
    because segments in which little is measured lead astray, and from other starts, default random
    ones; where it does not converge, it has longer segments.
    """
    padded, (count, num_measured) = experiments.padded(*room), experiments.valid.shape[:2]

    def search(estimator: AbstractEstimator, start: Params) -> Estimate:
        found = jax.device_get(estimator(plant, padded, *jax.device_put((start, free))))
        own = found.initial_state[:count], found.residual[:count, :num_measured]
        return eqx.tree_at(lambda e: (e.initial_state, e.residual), found, own)

    if isinstance(estimator, PEM):  # it begins where least squares ends
        least_squares = NLS(known=estimator.known)
        first = _estimate(plant, experiments, least_squares, start, free, progress, room, others)
        start = first[0].params
        progress("prediction error", np.nan, 1.0)  # how long it takes is not known
    found = [search(estimator, start)]
    if not isinstance(estimator, NLS):
        return found
    size, num_samples = experiments.valid.size, padded.valid.shape[1]
    length, is_short = estimator.length_of_segments(plant, num_samples), size < _TELLING
    few = size <= _SIZE_OF_MANY_STARTS
    is_in_doubt = is_short or not is_noise(plant, experiments, found[0])
    if few and length < num_samples and (is_in_doubt or _is_saturated(experiments, found[0])):
        whole = search(dataclasses.replace(estimator, segment_length=num_samples), start)
        if is_elsewhere(whole, found[0]):
            found = sorted([whole, *found], key=quality)
            is_in_doubt = is_short or not is_noise(plant, experiments, found[0])
    if few and is_in_doubt:
        others = _starts_around(plant, start, free) if others is None else others
        for i, other in enumerate(others):
            best = min(found, key=quality)
            progress(
                f"search from start {i + 2} of {len(others) + 1} (best cost "
                f"{float(best.cost):.6g}, found in {int(best.steps)} steps)",
                0.1 + 0.4 * i / len(others),
                1.0,
            )
            found.append(search(estimator, other))
        found.sort(key=quality)
    while int(found[0].status) == Status.ITERATIONS_EXHAUSTED and length < num_samples:
        length *= 4
        longer = search(dataclasses.replace(estimator, segment_length=length), start)
        found = [longer, *found[1:]] if int(longer.status) == Status.SUCCESSFUL else found
    return found


def _starts_around(plant: AbstractPlant, start: Params, free: np.ndarray) -> list[Params]:
    """Random starts around one, always the same: up to a factor of three away."""
    d, z = plant.definition, to_search(plant.definition, start)
    width = np.where(free, [np.log(3) if p.positive else 2.0 for p in d.parameters], 0.0)
    unit = jax.random.uniform(jax.random.key(0), (_STARTS - 1, len(width)), float, -1.0, 1.0)
    points = jax.vmap(partial(from_search, d))(z[None] + width[None] * unit)
    return [plant.Params(*row) for row in jax.device_get(points)]


def is_noise(plant: AbstractPlant, experiments: Experiments, estimate: Estimate) -> bool:
    """Whether a search ended where only white noise is left; then it missed no better minimum.

    What is far larger than the declared noise is something else.
    """
    if int(estimate.status) != Status.SUCCESSFUL or far_above_declared(plant, estimate):
        return False
    residual, valid = np.asarray(estimate.residual), np.asarray(experiments.valid)
    return all(
        not whiteness_of([r[v, i] for r, v in zip(residual, valid[..., i], strict=True)], o.scale)
        < RARE
        for i, o in enumerate(plant.definition.outputs)
    )


def _is_saturated(experiments: Experiments, estimate: Estimate) -> bool:
    """Whether a simulated output is often exactly the largest or the smallest of its experiment.

    Not counted is a rest before the first change, which tells nothing of the parameters either.
    """
    if not np.isfinite(estimate.residual).all():
        return False
    simulated = np.asarray(experiments.measured) - np.asarray(estimate.residual)
    for own, valid in zip(simulated, np.asarray(experiments.valid), strict=True):
        for y in (column[seen] for column, seen in zip(own.T, valid.T, strict=True)):
            if not y.size:
                continue
            near = _STILL * np.ptp(y)
            changed = np.abs(y - y[:1]) > near
            after = y[np.argmax(changed) :] if changed.any() else y[:0]
            for end in (np.max(y), np.min(y)):
                if np.sum(np.abs(after - end) <= near) > _OFTEN * len(y):
                    return True
    return False


def is_elsewhere(estimate: Estimate, other: Estimate) -> bool:
    """Whether two ends of the search are not one minimum, by their costs or parameters."""
    costs, size = (float(estimate.cost), float(other.cost)), estimate.residual.size
    is_alike = abs(costs[0] - costs[1]) <= _SAME / size * min(costs)
    return not is_alike or is_far(estimate, other)


def is_far(estimate: Estimate, other: Estimate) -> bool:
    """Whether a parameter of an end is many standard errors from that of another one."""
    with np.errstate(invalid="ignore"):  # a search that failed may have no variances
        std_error = np.sqrt(np.diagonal(np.asarray(other.covariance)))
        away = np.abs(np.stack(estimate.params) - np.stack(other.params))
        return bool(np.any(away > _FAR * std_error))


def is_exact(plant: AbstractPlant, estimate: Estimate) -> bool:
    """Whether the residual is nothing but rounding."""
    scales = [o.scale for o in plant.definition.outputs]
    return not any(map(is_more_than_rounding, np.asarray(estimate.residual).T, scales))


def far_above_declared(plant: AbstractPlant, estimate: Estimate) -> list[tuple[int, float]]:
    """Outputs with a residual far larger than their declared noise, and its standard deviation."""
    residual, declared = np.asarray(estimate.residual), np.asarray(plant.sensor.sd)
    size = np.sqrt(np.sum(residual**2, axis=(0, 1)) / np.sum(residual != 0, axis=(0, 1)).clip(1))
    pairs = enumerate(zip(size, declared, strict=True))
    return [(i, float(own)) for i, (own, sd) in pairs if sd > 0 and own > _FAR_ABOVE * sd]


def is_centred(experiments: Experiments, estimate: Estimate) -> bool:
    """Whether the residual of no output has a mean or a trend."""
    residual, valid = np.asarray(estimate.residual), np.asarray(experiments.valid)
    return all(
        not mean_or_trend(*(r[v, i] for r, v in zip(residual, valid[..., i], strict=True))) < RARE
        for i in range(residual.shape[2])
    )


def _to_hold(plant: AbstractPlant, fit: Fit) -> tuple[int, str, float | None] | None:
    """The parameter to hold next, the reason, and where it ended if that is its bound.

    None where there is none to hold.
    """
    names = names_of(plant.definition.parameters)
    reached = bound_reached(plant.definition, fit.estimate.params)
    if reached is not None and fit.free[reached[0]]:
        index, bound = reached
        why = f"{names[index]} ended at its bound {bound:g} and was held there"
        return index, why, float(fit.estimate.params[index])
    # A positive parameter is searched by its logarithm, which ends nowhere if the data do not tell
    # it from zero; one of free sign is far from that as long as the equations can be solved.
    unit = np.array([1.0 if p.positive else _FREE for p in plant.definition.parameters])
    information = np.asarray(fit.estimate.information) * np.outer(unit, unit)
    unseen = worst_seen(names, information, fit.free)
    return None if unseen is None else (*unseen, None)


def _fits_worse(plant: AbstractPlant, estimate: Estimate, other: Estimate) -> bool:
    """Whether a fit with one free parameter less is worse than the other by more than chance.

    Fits that leave nothing but rounding are alike.
    """
    growth, residual = float(estimate.cost) - float(other.cost), np.asarray(estimate.residual)
    if estimate.prediction is not None:  # the cost is minus the logarithm of the likelihood
        return not growth < _MORE_THAN_CHANCE / 2
    noise = float(other.cost) / max(np.count_nonzero(other.residual), 1)
    is_seen = any(
        not np.all(np.isfinite(own)) or is_more_than_rounding(own, part.scale)
        for own, part in zip(np.moveaxis(residual, 2, 0), plant.definition.outputs, strict=True)
    )
    return is_seen and not growth < _MORE_THAN_CHANCE * noise


def _is_near(plant: AbstractPlant, index: int, start: float, estimate: Estimate) -> bool:
    """Whether a search ended so near a parameter's start that its end is a sensible value."""
    part, end = plant.definition.parameters[index], float(estimate.params[index])
    if part.positive:
        return 1 / _FAR_OFF < end / start < _FAR_OFF
    return abs(end - start) < _FAR_OFF * part.scale


def with_initial_state(
    plant: AbstractPlant,
    experiments: Experiments,
    params: Params,
    estimator: AbstractEstimator | None = None,
) -> Estimate:
    """The best initial states for given parameters, with the likelihood of an estimator."""
    is_nls = isinstance(estimator, NLS)
    search = NLS(likelihood=estimator.likelihood) if is_nls else NLS()
    held = jax.device_put(np.zeros(len(params), bool))
    return jax.device_get(search(plant, experiments, jax.device_put(params), held))
