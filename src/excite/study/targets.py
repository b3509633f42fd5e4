"""How precisely quantities are to be known, and how far they are from it."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from ..description import as_number, names_of, wrong_type
from ..information import relative_size
from ..plant import AbstractPlant, Params
from ..record.units import unit_factor
from ..report.numbers import digits_for, number
from ..rig.contract import Interval
from .quantities import AbstractQuantity, QuantityLike, parameters_of, quantity_of, slopes

TargetLike: TypeAlias = Mapping[QuantityLike, str | float] | Mapping[str, str | float]
"""Half of a 95 % interval by quantity: "1%" of the estimate, a number in the quantity's unit, or
with a unit of its own, "0.1 deg"."""

_NUMBER = re.compile(r"([-+]?[\d.]+(?:e[-+]?\d+)?)\s*(.*)", re.IGNORECASE)


@dataclass(frozen=True)
class Target:
    """How precisely a quantity is to be known.

    Attributes:
        quantity: a parameter, a function of them, or a prediction.
        half: half of the 95 % interval, in the quantity's unit or as a fraction of the estimate.
        is_relative: whether it is a fraction.
    """

    quantity: AbstractQuantity
    half: float
    is_relative: bool

    @property
    def name(self) -> str:
        """Of the quantity."""
        return self.quantity.name

    def share(self, value: Any, half: Any) -> Any:
        """Half of an interval over that allowed; the target is reached at one."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.divide(half, self.allowed(value))  # infinite for a share of nothing

    def allowed(self, value: Any) -> Any:
        """Half of the interval that is allowed, in the quantity's unit."""
        return self.half * np.abs(value) if self.is_relative else self.half

    def at(self, share: float) -> str:
        """A share of the interval that is allowed, in words."""
        return (
            f"{100 * self.half * share:.2g} %"
            if self.is_relative
            else (f"{self.half * share:.2g} {self.quantity.unit}".rstrip())
        )

    def __str__(self) -> str:
        if self.is_relative:
            return f"{100 * self.half:g} %"
        return f"{self.half:.4g} {self.quantity.unit}".rstrip()


def targets_from(plant: AbstractPlant, given: TargetLike) -> tuple[Target, ...]:
    """Targets by quantity, such as `{"D_p": "1%"}`; see `QuantityLike`.

    Raises:
        ValueError: for an unknown quantity, a target that is not above 0, two of the same name,
            or none at all.
        TypeError: for something else than a dict.
    """
    if not isinstance(given, Mapping) or not all(isinstance(n, str) or callable(n) for n in given):
        raise wrong_type("target", given, "a dict by parameter, function or prediction")
    found = []
    for word, value in given.items():
        quantity = quantity_of(plant, word)
        if quantity.name in [t.name for t in found]:
            raise ValueError(f"{quantity.name} has two targets")
        found.append(Target(quantity, *_half(quantity, value)))
    if not found:
        raise ValueError("a target is needed, such as D_p=1%")
    return tuple(found)


def _half(quantity: AbstractQuantity, value: str | float) -> tuple[float, bool]:
    """Half of an interval, and whether it is a fraction of the estimate."""
    what, half, unit = f"target of {quantity.name}", float("nan"), ""
    if not isinstance(value, str):
        half = as_number(what, value)
    elif (found := _NUMBER.fullmatch(value.strip())) is not None:
        with contextlib.suppress(ValueError):
            half, unit = float(found[1]), found[2]
    if not 0 < half < float("inf"):
        raise ValueError(
            f"{what} must be a number above 0, or a percentage such as 1%: got {value!r}"
        )
    if unit == "%":
        return half / 100, True
    try:
        return half * (unit_factor("", unit, quantity.unit) if unit else 1.0), False
    except ValueError:
        raise ValueError(
            f"{what} cannot be in {unit!r}: the unit is {quantity.unit or '1'!r}"
        ) from None


def quantities_of(plant: AbstractPlant, targets: Sequence[Target]) -> tuple[AbstractQuantity, ...]:
    """All parameters of a plant, and what else the targets are about."""
    return (*parameters_of(plant.description), *others_of(plant, targets))


def others_of(plant: AbstractPlant, targets: Sequence[Target]) -> tuple[AbstractQuantity, ...]:
    """What targets are about beside parameters."""
    names = names_of(plant.definition.parameters)
    return tuple(t.quantity for t in targets if t.name not in names)


def over_targets(
    plant: AbstractPlant, params: Params, targets: Sequence[Target]
) -> Float[np.ndarray, "target param"]:
    """How each target's quantity moves with relative changes of the parameters, over its half."""
    values, slope = slopes([t.quantity for t in targets], plant, params)
    allowed = [t.allowed(float(value)) for t, value in zip(targets, values, strict=True)]
    return np.asarray(slope * relative_size(plant, params)[None]) / np.array(allowed)[:, None]


def shares_of(targets: Sequence[Target], known: Mapping[str, Interval]) -> dict[str, float]:
    """Of each target, half of the interval over that allowed; empty where nothing is known."""
    return {t.name: float(t.share(*known[t.name])) for t in targets} if known else {}


def farthest(shares: Mapping[str, float]) -> str:
    """The target that is farthest from being reached, as a sentence."""
    name, share = max(shares.items(), key=lambda item: item[1])
    if not share < float("inf"):
        return f"{name} is not identifiable yet"
    if share < 1.05:
        return f"{name} is slightly more uncertain than asked"
    return f"{name} is {share:.2g} times as uncertain as asked"


def known_row(
    quantity: AbstractQuantity, targets: Sequence[Target], known: Mapping[str, Interval]
) -> list[str]:
    """Cells of a quantity: name, estimate, half of the interval, the same as a share, target."""
    name = quantity.name
    target = "".join(str(t) for t in targets if t.name == name)
    if name not in known:
        return [name, "–", "–", "–", target]
    value, half = known[name]
    shown = f"{number(value, digits_for(value, half))} {quantity.unit}".rstrip()
    return [name, shown, f"{half:.2g}", relative_half(known[name]), target]


def relative_half(known: Interval) -> str:
    """Half of an interval as a percentage of the estimate."""
    value, half = known
    if not half < float("inf"):
        return "not known"
    return f"{number(100 * half / abs(value), 2)} %" if value else "–"
