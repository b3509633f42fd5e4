"""`compare_plants`: which of several plants explains the same records best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..description import names_of
from ..plant.catalogue import PlantLike, plant_from
from ..report.results import comparison_html, comparison_text, wrapped
from .diagnosis import chi2_tail, log_likelihood
from .from_records import parts_of
from .identify import RecordLike, identify
from .result import Identification


@dataclass(frozen=True)
class ComparedPlant:
    """A plant of a comparison.

    Attributes:
        name: of the plant.
        result: of its identification.
        num_unknowns: estimated parameters, initial states, and the noise of each output.
        log_likelihood: of the residual as white noise; its size is estimated.
        bic: Bayesian information criterion, num_unknowns log(num_values) - 2 log_likelihood.
        p_value: of a likelihood-ratio test against the first plant given, which must be a special
            case of this one; it allows for a coloured residual. None where this plant has no
            more unknowns.
    """

    name: str
    result: Identification
    num_unknowns: int
    log_likelihood: float
    bic: float
    p_value: float | None


@dataclass(frozen=True, repr=False)
class Comparison:
    """The result of `compare_plants`; its `repr` is the table of `excite compare-plants`.

    Attributes:
        plants: the one with the smallest BIC first, those without an estimate last.
    """

    plants: tuple[ComparedPlant, ...]

    def __str__(self) -> str:
        return comparison_text(self.to_dict())

    def __repr__(self) -> str:
        return wrapped(str(self))

    def _repr_html_(self) -> str:
        return comparison_html(self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """The result as JSON-ready data; docs/reference/machine-readable.md lists its keys."""
        return {
            "plants": [
                {
                    "plant": p.name,
                    "num_unknowns": p.num_unknowns,
                    "log_likelihood": p.log_likelihood,
                    "bic": p.bic,
                    "p_value": p.p_value,
                    "identification": p.result.to_dict(),
                }
                for p in self.plants
            ]
        }


def compare_plants(
    records: RecordLike | Sequence[RecordLike], plants: Sequence[PlantLike], **options: Any
) -> Comparison:
    """Fits several plants to the same records and compares them.

        >>> import excite as ex
        >>> record = ex.simulate("aero2+coulomb", "multisine", seed=0)
        >>> ex.compare_plants(record, ["aero2", "aero2+coulomb"]).plants[0].name
        'aero2+coulomb_pitch_rate'

    Args:
        records: as for `identify`.
        plants: names, `path/to/file.py:ClassName`, plants or classes, with the same outputs. Where
            the initial state of one is not known, those of all are estimated.
        options: of `identify`, for all plants alike.

    Raises:
        ValueError: for fewer than two plants or different outputs, and as `identify` does.
    """
    if isinstance(plants, str) or not isinstance(plants, Sequence) or len(plants) < 2:
        got = len(plants) if isinstance(plants, list | tuple) else repr(plants)
        raise ValueError(f"a comparison needs at least two plants: got {got}")
    if options.keys() & {"prior", "likelihood"}:
        raise ValueError("plants are compared by a normal likelihood, without priors")
    chosen = [plant_from(plant) for plant in plants]
    outputs = [names_of(plant.definition.outputs) for plant in chosen]
    for plant, own in zip(chosen, outputs, strict=True):
        if own != outputs[0]:
            raise ValueError(
                f"plants with different outputs cannot be compared: {plant.definition.name!r} has "
                f"{', '.join(own)}; {chosen[0].definition.name!r} has {', '.join(outputs[0])}"
            )
    results = [identify(records, plant, **options) for plant in chosen]
    if len({result.initial_state_known for result in results}) > 1:  # compared alike
        results = [
            identify(records, plant, **{**options, "initial_state": "free"})
            if result.initial_state_known
            else result
            for plant, result in zip(chosen, results, strict=True)
        ]
    first = _compared(results[0], None)
    compared = [first, *(_compared(result, first) for result in results[1:])]
    return Comparison(tuple(sorted(compared, key=lambda p: (not p.result.is_usable, p.bic))))


def _compared(result: Identification, first: ComparedPlant | None) -> ComparedPlant:
    residual = _residual(result)
    likelihood, count = log_likelihood(residual), sum(len(r) for parts in residual for r in parts)
    unknowns = len(result.params) - len(result.held) + len(result.plant.outputs)
    if not result.initial_state_known:
        parts = sum(len(parts_of(fitted.record)) for fitted in result.fitted)
        unknowns += parts * len(result.plant.states)
    p_value = None
    if first is not None and unknowns > first.num_unknowns:
        before = log_likelihood(_residual(first.result), whiten=True)
        gained = log_likelihood(residual, whiten=True) - before
        p_value = chi2_tail(unknowns - first.num_unknowns, 2 * max(gained, 0.0))
    bic = unknowns * math.log(count) - 2 * likelihood
    return ComparedPlant(result.plant.name, result, unknowns, likelihood, bic, p_value)


def _residual(result: Identification) -> list[list[np.ndarray]]:
    """Measured residuals by output and record."""
    residuals = [f.record.outputs - f.model for f in result.fitted]
    num_outputs = len(result.plant.outputs)
    return [[r[np.isfinite(r[:, i]), i] for r in residuals] for i in range(num_outputs)]
