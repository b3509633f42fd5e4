"""From the episodes of one method to a row of the table: means, rates, intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..description import HALF_95, PlantDescription, display_unit, names_of
from ..estimation import Status
from ..report.rows import ErrorStatistics, LargestOutput, MeanSd, Rate, RigCounts, Row
from ..safety import watched_output
from .spec import Study


class Scores(eqx.Module):
    """All episodes of one method and one estimator, on NumPy arrays.

    Attributes:
        on_rig: events on a simulated rig by name; empty without one.
    """

    true: Float[np.ndarray, "episode param"]
    estimated: Float[np.ndarray, "episode param"]
    std_error: Float[np.ndarray, "episode param"]
    status: np.ndarray
    is_violation: np.ndarray
    max_abs_output: Float[np.ndarray, "episode output"]
    bound: Float[np.ndarray, "episode param"]
    log_det: Float[np.ndarray, " episode"]
    on_rig: Mapping[str, np.ndarray]


def table_row(
    study: Study, description: PlantDescription, names: tuple[str, str], outcome: Scores
) -> Row:
    """One row of the table.

    Args:
        names: of method and estimator.
    """
    is_tripped = outcome.on_rig.get("trips", np.zeros(len(outcome.status), bool))
    good = (outcome.status == Status.SUCCESSFUL) & ~is_tripped
    error = (outcome.estimated / outcome.true - 1)[good]
    std_error = (outcome.std_error / np.abs(outcome.true))[good]
    violations, count = int(outcome.is_violation.sum()), len(good)
    watched = watched_output(description)
    unit, factor = display_unit(description.outputs[watched].unit)
    params = names_of(description.parameters)
    reasons = ["tripped"] * int(is_tripped.sum())
    reasons += [Status(s).name.lower() for s in outcome.status[~good & ~is_tripped]]

    seen = {name: int(counts.sum()) for name, counts in outcome.on_rig.items()}
    row = Row(
        method=names[0],
        estimator=names[1],
        evaluations=count,
        failed=int(count - good.sum()),
        failures={reason: reasons.count(reason) for reason in sorted(set(reasons))},
        violations=violations,
        violation_rate=violation_rate(violations, count),
        max_abs_output=LargestOutput(
            output=description.outputs[watched].name,
            unit=unit,
            **dict(mean_sd(factor * outcome.max_abs_output[:, watched])),
        ),
        log_det_information=float(outcome.log_det.mean()),
        log_det_information_sd=mean_sd(outcome.log_det).sd,
        relative_error_percent=dict(
            zip(params, (_error(100 * np.abs(e)) for e in error.T), strict=True)
        ),
        cramer_rao_percent=_by_name(params, 100 * outcome.bound.mean(axis=0)),
        rms_over_cramer_rao=_by_name(params, _rms(error) / _rms(outcome.bound[good])),
        coverage95_percent=_by_name(params, 100 * _fraction(np.abs(error) < HALF_95 * std_error)),
        beyond_6_std_errors=int(np.any(np.abs(error) > 6 * std_error, axis=1).sum()),
    )
    if seen:
        row = row.model_copy(update={"on_rig": RigCounts(**seen)})
    if study.clairvoyant is not None:  # over the plants that its signals are designed for
        mean = float(outcome.log_det[: study.clairvoyant.plants].mean())
        row = row.model_copy(update={"log_det_of_clairvoyant_plants": mean})
    return row


def _by_name(params: Iterable[str], values: np.ndarray) -> dict[str, float]:
    return dict(zip(params, values.tolist(), strict=True))


def _rms(values: Float[np.ndarray, "episode param"]) -> Float[np.ndarray, " param"]:
    return np.sqrt(_fraction(values**2))


def _fraction(values: np.ndarray) -> Float[np.ndarray, " param"]:
    """Mean over episodes; NaN where no episode is left."""
    return values.mean(axis=0) if len(values) else np.full(values.shape[1], np.nan)


def mean_sd(values: np.ndarray) -> MeanSd:
    """Mean and standard deviation, where there are any; NaN for what is not finite."""
    with np.errstate(invalid="ignore"):
        return MeanSd(
            mean=float(values.mean()) if values.size else math.nan,
            sd=float(values.std(ddof=1)) if values.size > 1 else math.nan,
        )


def _error(values: np.ndarray) -> ErrorStatistics:
    """Mean, standard deviation and median of errors."""
    size = mean_sd(values)
    return ErrorStatistics(
        mean=size.mean,
        sd=size.sd,
        median=float(np.median(values)) if values.size else math.nan,
        rms=float(np.sqrt(np.mean(values**2))) if values.size else math.nan,
    )


def violation_rate(violations: int, count: int) -> Rate:
    """The rate and its 95 % interval."""
    return Rate(estimate=violations / count, ci95=wilson(violations, count))


def wilson(successes: int, count: int) -> tuple[float, float]:
    """95 % interval of a rate.

    E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    J. American Statistical Association 22, 1927.
    """
    z, rate = HALF_95, successes / count
    centre = rate + z**2 / (2 * count)
    half = z * math.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2))
    scale = 1 + z**2 / count
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)
