"""What is known of a plant's parameters: from the spread, from records, or from earlier results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..description import HALF_95, RARE, Spread, SpreadLike, names_of, prior_sd_of, wrong_type
from ..estimation.identify import RecordLike, identify, plant_named_by, require_shipped
from ..estimation.prior import Prior
from ..estimation.prior_knowledge import PriorLike, prior_of_run, run_with_estimate, with_prior
from ..estimation.result import Identification
from ..information import relative_size
from ..plant import AbstractPlant
from ..plant.catalogue import PlantLike, plant_from
from ..report.rows import EstimateSummary
from ..rig.contract import Interval
from ..training.redesign import Region
from .quantities import (
    AbstractQuantity,
    half_intervals,
    known_of,
    parameters_of,
    propagated,
    slopes,
)

KnownLike = RecordLike | Identification | Sequence[RecordLike | Identification]
"""Records, their files or DataFrames, results of `identify`, their run folders, or several."""


_LARGE = 2.0  # root mean square of a residual over the declared noise
_CONTRADICTED = 1e-4  # chance of records by which they contradict a prior, over its parameters


@dataclass(frozen=True)
class Knowledge:
    """What is known of a plant's parameters.

    Attributes:
        plant: sampled as the records are.
        region: the parameters that are possible.
        result: of identification, where there is one.
        warnings: sentences, where the plant does not explain the records.
    """

    plant: AbstractPlant
    region: Region
    result: Identification | None = None
    warnings: tuple[str, ...] = ()

    def of(self, others: Sequence[AbstractQuantity]) -> dict[str, Interval]:
        """Of each parameter, and of other quantities, the estimate and half of its interval."""
        if self.result is not None:
            return known_of(self.plant, self.result, others)
        return intervals_in(self.plant, self.region, others)


def intervals_in(
    plant: AbstractPlant, region: Region, others: Sequence[AbstractQuantity]
) -> dict[str, Interval]:
    """Of each parameter, and of other quantities, value and half of the interval in a region."""
    params, quantities = plant.Params(*region.center), (*parameters_of(plant.description), *others)
    values, _ = slopes(quantities, plant, params)
    halves = half_intervals(quantities, plant, params, region.information)
    each = zip(quantities, values, halves, strict=True)
    return {q.name: Interval(float(value), float(half)) for q, value, half in each}


def intervals_of_prior(
    plant: AbstractPlant, told: Region, others: Sequence[AbstractQuantity]
) -> dict[str, Interval]:
    """The same of a prior: infinite for a parameter, or a quantity of one, that it leaves out."""
    params, information = plant.Params(*told.center), np.asarray(told.information)
    own = np.flatnonzero(np.diag(information) > 0)
    covariance = np.zeros(information.shape)
    covariance[np.ix_(own, own)] = np.linalg.inv(information[np.ix_(own, own)])
    size = np.asarray(relative_size(plant, params))
    covariance *= np.outer(size, size)
    halves = np.full(len(size), np.inf)
    halves[own] = HALF_95 * np.sqrt(np.diag(covariance)[own])
    halves = np.array([float(f"{half:.9g}") for half in halves])  # alike on other machines
    each = zip(params._fields, map(float, told.center), halves.tolist(), strict=True)
    known = {name: Interval(value, half) for name, value, half in each}
    return known | propagated(others, plant, params, covariance, halves)


def known_before(
    plant: AbstractPlant, prior: PriorLike | Sequence[PriorLike], spread: SpreadLike
) -> Knowledge:
    """What is known before the first record: a prior, of other parameters the spread."""
    return Knowledge(plant, region_of(plant, prior, spread))


def known_from(
    known: KnownLike,
    plant: PlantLike | None,
    prior: PriorLike | Sequence[PriorLike] | None,
    spread: SpreadLike,
) -> Knowledge:
    """What records and earlier results tell together.

    Records are identified together; the results of other records count as what was known before.

    Args:
        known: records and results, each record once.
        plant: default that of the first of them.
        prior: as for `identify`, where only records are given.
        spread: of the parameters before.

    Raises:
        ValueError: for results of another plant, records and results that contradict each other,
            a record or a result that is given twice, and an estimate outside the spread.
        TypeError: for something else than records and results.
    """
    is_one = isinstance(known, RecordLike | Identification)
    if not is_one and not isinstance(known, Sequence):
        raise wrong_type("known", known, "a record, a result, a run folder, or several")
    parts: list[Any] = [known] if is_one else list(known)
    if not parts:
        raise ValueError("no record is given")
    named = [str(Path(p).resolve()) if isinstance(p, str | Path) else str(id(p)) for p in parts]
    for part, name in zip(parts, named, strict=True):
        if named.count(name) > 1:
            what = part if isinstance(part, str | Path) else "a record or a result"
            raise ValueError(f"{what} is given twice: give each record and each result once")
    results = [part for part in parts if _is_result(part)]
    records = [part for part in parts if not _is_result(part)]
    if results and prior is not None:
        raise ValueError("a result has its prior: a prior is given with records alone")
    own, reach = plant_from(plant) if plant is not None else _plant_of(parts[0]), Spread.of(spread)
    for part in results:
        name = _plant_name(part)
        if name != own.definition.name:
            raise ValueError(f"a result is of plant {name!r}, and not of {own.definition.name!r}")
    before = Prior.product([prior_of_run(own, part) for part in results]) if results else None
    result = None
    if records:
        result = identify(records, own, prior=prior if before is None else before)
        if not result.is_usable:
            raise ValueError(f"the records give no estimate ({result.status})")
        found = result

        def alone() -> Identification:
            return identify(records, own, start=dict(found.params), causes=False)

        joint = before if prior is None else with_prior(own, prior, own.nominal, {}, {})[1]
        told = [] if joint is None else contradicted(joint, result, alone)
        if told and before is not None:
            raise ValueError(
                f"the records contradict the earlier results in {', '.join(told)}: identify all "
                "records together, and see whether the plant explains them"
            )
        if told:
            raise ValueError(
                f"the records contradict the prior of {', '.join(told)}: leave it out, or give a "
                "wider one"
            )
    elif len(results) == 1 and isinstance(results[0], Identification):
        result = results[0]
    if result is not None and result.basis is not None:  # sampled as the records are
        own = result.basis.plant if plant is None else own.changed(dt=result.basis.plant.dt)
    region = region_of(own, result or before or {}, reach)
    if told := excluded(own, region, reach):
        raise ValueError(told)
    return Knowledge(own, region, result, unexplained(result))


def contradicted(
    prior: Prior, result: Identification, alone: Callable[[], Identification]
) -> list[str]:
    """Parameters in which records contradict a prior with which they were identified.

    Where the residual is not white noise, they are asked without it. If the plant does not
    explain them then either, they say nothing of the prior.

    Args:
        prior: that is asked about.
        result: from the records and the prior.
        alone: identifies the records without it.
    """
    is_coloured = any(p < RARE for p in result.whiteness.values())
    is_alone = is_coloured or bool(unexplained(result))
    if is_alone:
        try:
            result = alone()
        except ValueError:  # without the prior the records tell nothing
            return []
    if not result.is_usable or unexplained(result):
        return []
    chances = prior.chances(result.params, result.std_error, not is_alone)
    return [name for name, chance in chances.items() if chance < _CONTRADICTED / len(chances)]


def unexplained(result: Identification | None) -> tuple[str, ...]:
    """Sentences, where the plant does not explain the records of a result."""
    if result is None or result.basis is None:
        return ()
    size = float(np.nanmax(noise_factors(result.basis.plant, result)))
    cause = "".join(f" (likely cause: {suspect.name})" for suspect in result.suspects[:1])
    why = f"the plant may be wrong, and what is predicted too good{cause}"
    if size > _LARGE:
        return (f"the residual is {size:.2g} times the declared noise: {why}",)
    return (f"the residual follows the input: {why}",) * (result.misfit_factor > 1)


def noise_factors(plant: AbstractPlant, result: Identification) -> Float[np.ndarray, " output"]:
    """Of each output, the residual's root mean square over the declared noise."""
    residual = np.concatenate([part.computed["residual"] for part in result.fitted])
    return np.sqrt(np.nanmean((residual / np.asarray(plant.sensor.sd)[None]) ** 2, axis=0))


def region_of(
    plant: AbstractPlant, known: PriorLike | Sequence[PriorLike], spread: SpreadLike
) -> Region:
    """The plants that an identification leaves possible, within the spread.

    Args:
        plant: whose parameters were estimated.
        known: the result, its run folder, or a normal distribution.
        spread: of the parameters before; it is all that is known of one that was not estimated.
    """
    told = told_by(plant, known)
    before = jnp.eye(len(told.center)) / prior_sd_of(spread) ** 2
    return Region(told.center, told.information + before)


def told_by(plant: AbstractPlant, known: PriorLike | Sequence[PriorLike]) -> Region:
    """What a result or a prior tells by itself: nothing of a parameter that it leaves out."""
    _, prior, center = with_prior(plant, known, plant.nominal, {}, {})
    size = np.asarray(relative_size(plant, center))
    information = np.zeros((len(size), len(size)))
    if prior is not None:
        names = names_of(plant.definition.parameters)
        index = [names.index(name) for name in prior.names]
        unit = np.where(prior.logarithmic, 1.0, size[index])
        root = np.asarray(prior.root) * unit[None]
        information[np.ix_(index, index)] += root.T @ root
    return Region(jnp.stack(list(center)), jnp.asarray(information))


def _plant_of(part: Any) -> AbstractPlant:
    """The plant of a record, a result or a run folder."""
    if (basis := getattr(part, "basis", None)) is not None:
        return basis.plant
    if not _is_result(part):
        return plant_from(plant_named_by(part))
    where = str(part) if isinstance(part, str | Path) else "the result"
    return plant_from(require_shipped(_plant_name(part), where))


def _plant_name(part: Identification | str | Path) -> str:
    """The name of the plant of a result or a run folder."""
    if isinstance(part, Identification):
        return part.plant.name
    path = run_with_estimate(Path(part)) / "estimate.json"
    if not path.is_file():
        raise ValueError(f"{part} has no estimate: give a run folder of `excite identify`")
    return EstimateSummary.read(path, "identify the records again").plant


def _is_result(part: object) -> bool:
    """Whether it is an identification or its run folder, and not a record."""
    is_folder = isinstance(part, str | Path) and Path(part).is_dir()
    return is_folder or isinstance(part, Identification)


def excluded(
    plant: AbstractPlant, region: Region, spread: Spread, what: str = "the estimate"
) -> str:
    """A sentence where the spread excludes an estimate, or the mean of a prior; else nothing."""
    sd = 1 / np.sqrt(np.diag(np.asarray(region.information)))
    for i, parameter in enumerate(plant.definition.parameters):
        value, nominal = float(region.center[i]), float(plant.nominal[i])
        lower, upper = (spread.value(parameter, nominal, unit) for unit in (-1.0, 1.0))
        slack = 4 * sd[i] * (value if parameter.positive else parameter.scale)
        if not lower - slack <= value <= upper + slack:
            return (
                f"the spread {spread} excludes {what} of {parameter.name}, {value:.4g} "
                f"{parameter.unit}: it allows {lower:.4g} to {upper:.4g}; give a wider spread"
            )
    return ""
