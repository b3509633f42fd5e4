"""How precisely parameters are to be known, and how precisely they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..description import HALF_95, PlantDescription, as_number, by_name, names_of, unknown
from ..estimation.result import Identification
from ..information import relative_size
from ..plant import AbstractPlant, Params
from ..report.numbers import digits_for, number
from ..rig.contract import Interval


@dataclass(frozen=True)
class Target:
    """How precisely a parameter is to be known.

    Attributes:
        parameter: its name.
        half: half of the 95 % interval, in the parameter's unit or as a fraction of the estimate.
        is_relative: whether it is a fraction.
    """

    parameter: str
    half: float
    is_relative: bool

    def share(self, value: Any, half: Any) -> Any:
        """Half of an interval over that allowed; the target is reached at one."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.divide(half, self.allowed(value))  # infinite for a share of nothing

    def allowed(self, value: Any) -> Any:
        """Half of the interval that is allowed, in the parameter's unit."""
        return self.half * np.abs(value) if self.is_relative else self.half

    def __str__(self) -> str:
        return f"{100 * self.half:g} %" if self.is_relative else f"{self.half:g}"


def targets_from(plant: PlantDescription, given: Mapping[str, str | float]) -> tuple[Target, ...]:
    """Targets by parameter: `{"D_p": "1%"}` of the estimate, or a number in its unit.

    Raises:
        ValueError: for an unknown parameter, a target that is not above 0, or none at all.
        TypeError: for something else than a dict by name.
    """
    found, names = [], names_of(plant.parameters)
    for name, value in by_name("target", given, "a dict by parameter").items():
        if name not in names:
            raise unknown("parameter", name, names)
        is_relative = isinstance(value, str) and value.strip().endswith("%")
        text = value.strip().removesuffix("%") if isinstance(value, str) else value
        try:
            half = float(text) if isinstance(text, str) else as_number(f"target of {name}", text)
        except ValueError:
            half = float("nan")
        if not 0 < half < float("inf"):
            raise ValueError(
                f"target of {name} must be a number above 0, or a percentage such as 1%: got "
                f"{value!r}"
            )
        found.append(Target(name, half / 100 if is_relative else half, is_relative))
    if not found:
        raise ValueError("a target is needed, such as D_p=1%")
    return tuple(found)


def known_of(result: Identification) -> dict[str, Interval]:
    """Of each parameter, the estimate and half of its 95 % interval; infinite for a held one."""
    found = {}
    for name, value in result.params.items():
        low, high = result.ci95(name)
        half = float("inf") if name in result.held else (high - low) / 2
        found[name] = Interval(float(value), half if half == half else float("inf"))
    return found


def half_intervals(
    plant: AbstractPlant, params: Params, information: Float[Array, "*step param param"]
) -> Float[Array, "*step param"]:
    """Half of the 95 % intervals, in the parameters' units; infinite for singular information."""
    inverse = jnp.linalg.inv(information)
    variance = jnp.diagonal(inverse, axis1=-2, axis2=-1)
    sound = jnp.isfinite(variance) & (variance > 0)
    size = relative_size(plant, params).reshape((1,) * (variance.ndim - 1) + (-1,))
    return HALF_95 * size * jnp.sqrt(jnp.where(sound, variance, jnp.inf))


def shares_of(targets: Sequence[Target], known: Mapping[str, Interval]) -> dict[str, float]:
    """Of each target, half of the interval over that allowed; empty where nothing is known."""
    return {t.parameter: float(t.share(*known[t.parameter])) for t in targets} if known else {}


def farthest(shares: Mapping[str, float]) -> str:
    """The target that is farthest from being reached, as a sentence."""
    name, share = max(shares.items(), key=lambda item: item[1])
    if not share < float("inf"):
        return f"{name} is not identifiable yet"
    return f"{name} is {share:.2g} times as uncertain as asked"


def known_row(
    plant: PlantDescription, targets: Sequence[Target], known: Mapping[str, Interval], name: str
) -> list[str]:
    """Cells of a parameter: name, estimate, half of the interval, the same as a share, target."""
    target = "".join(str(t) for t in targets if t.parameter == name)
    if name not in known:
        return [name, "–", "–", "–", target]
    value, half = known[name]
    shown = f"{number(value, digits_for(value, half))} {plant.parameter(name).unit}".rstrip()
    return [name, shown, f"{half:.2g}", relative_half(known[name]), target]


def relative_half(known: Interval) -> str:
    """Half of an interval as a percentage of the estimate."""
    value, half = known
    if not half < float("inf"):
        return "not known"
    return f"{number(100 * half / abs(value), 2)} %" if value else "–"
