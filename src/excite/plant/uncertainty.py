"""What may differ from a plant's description: the declared uncertainty, a box.

    parameters, J_p                 unknown parameters, all or one
    d_S                             a known constant
    delay_voltage, lag_voltage, ... an effect that the equations leave out (`plant.extension`)
    initial_state, initial_pitch    where an experiment starts, all states or one
    noise                           factor of the sensor's standard deviations

A range is (low, high), or a text: `0:0.1`, `10%` of the nominal value (of a parameter's or a
state's scale), or `factor:3` for a third to three times the nominal value (for a parameter of
either sign, log 3 times its scale to both sides).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..description import Spread, SpreadLike, by_name, names_of, unknown
from .contract import AbstractPlant, Params, Sensor
from .extension import extended, extensions_of, plain_kind
from .fields import floats

Range: TypeAlias = str | Sequence[float]
"""Lowest and highest value, or a text: `0:0.1`, `10%`, `factor:3`."""

_PARAMETERS, _STATES, _START, _NOISE = "parameters", "initial_state", "initial_", "noise"
_ALLOWED = "two numbers LOW:HIGH, a percentage such as 10%, or factor:3"


class Uncertainty(eqx.Module):
    """A box of plants; a point of it has one coordinate in [-1, 1] for each quantity.

    Attributes:
        plant: with the extensions that the box needs.
        lower, upper: of each quantity, in its unit.
        names: of the quantities.
        is_factor: whether the range of a quantity is symmetric in its logarithm.
    """

    plant: AbstractPlant
    lower: Float[Array, " quantity"]
    upper: Float[Array, " quantity"]
    names: tuple[str, ...] = eqx.field(static=True)
    is_factor: tuple[bool, ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        plant: AbstractPlant,
        spread: SpreadLike = 0.3,
        ranges: Mapping[str, Any] | None = None,
    ) -> Uncertainty:
        """The box around a plant.

        Args:
            spread: of parameters without a range.
            ranges: by name, each a `Range`; see the module.

        Raises:
            ValueError: for an unknown name, or a range that is empty, not finite, or beyond the
                bounds of a parameter.
        """
        ranges = by_name("uncertainty", ranges, "a dict of ranges by name")
        reach = Spread.of(spread)
        usual = str(reach) if reach.is_factor else f"{100 * reach.reach}%"
        given = {_PARAMETERS: usual, **ranges}
        possible = extensions_of(plant)
        added = [name for name in given if name in possible]
        whole = extended(plant, added) if added else plant
        groups = {
            _PARAMETERS: names_of(plant.definition.parameters),
            _STATES: tuple(_START + name for name in names_of(plain_kind(plant).definition.states)),
        }
        each = {n: given[word] for word, names in groups.items() if word in given for n in names}
        each |= {word: value for word, value in given.items() if word not in groups}
        quantities = _quantities(whole, groups[_STATES])
        for name in each:
            if name not in quantities:
                known = dict.fromkeys([*quantities, *possible, *groups])
                where = f"quantity in the uncertainty of {plant.definition.name!r}:"
                raise unknown(where, name, known)
        boxes = {}
        for name, value in each.items():
            try:
                boxes[name] = _interval(name, value, quantities[name])
            except ValueError as error:
                by_spread = _PARAMETERS not in ranges and name in groups[_PARAMETERS]
                if name in ranges or not by_spread:
                    raise
                advice = f"a smaller spread, or a range of its own ({name}=LOW:HIGH)"
                raise ValueError(f"{error}: take {advice}") from None
        return cls(
            whole,
            floats([box.lower for box in boxes.values()]),
            floats([box.upper for box in boxes.values()]),
            tuple(boxes),
            tuple(box.is_factor for box in boxes.values()),
        )

    @eqx.filter_jit
    def values(self, point: Float[Array, " quantity"]) -> Float[Array, " quantity"]:
        """Of each quantity, in its unit."""
        share, is_factor = (point + 1) / 2, np.array(self.is_factor, bool)
        plain = self.lower + share * (self.upper - self.lower)
        low, high = (jnp.where(is_factor, x, 1.0) for x in (self.lower, self.upper))
        return jnp.where(is_factor, low * (high / low) ** share, plain)

    def at(self, point: Float[Array, " quantity"]) -> tuple[AbstractPlant, Params]:
        """The plant at a point of the box, and its parameters."""
        value = dict(zip(self.names, self.values(point), strict=True))
        plant, d = self.plant, self.plant.definition
        params = plant.nominal._replace(
            **{p.name: value[p.name] for p in d.parameters if p.name in value}
        )
        start = plant.initial_state
        for i, state in enumerate(d.states):
            if _START + state.name in value:
                start = start.at[i].set(value[_START + state.name])
        factor = value.get(_NOISE, 1.0)
        sensor = Sensor(plant.sensor.noise_sd * factor, plant.sensor.resolution)
        constants = {c.name: value[c.name] for c in d.constants if c.name in value}
        return plant.changed(initial_state=start, sensor=sensor, **constants), params

    @eqx.filter_jit
    def draw(self, key: PRNGKeyArray) -> Float[Array, " quantity"]:
        """A point drawn at random."""
        return jax.random.uniform(key, (len(self.names),), float, -1.0, 1.0)

    @eqx.filter_jit
    def corners(self, key: PRNGKeyArray, most: int) -> Float[Array, "corner quantity"]:
        """All corners of the box, or `most` of them drawn at random where there are more.

        No corner is drawn twice.
        """
        count = len(self.names)
        if 2**count <= most:
            every = itertools.product((-1.0, 1.0), repeat=count)
            return jnp.asarray(list(every)).reshape(-1, count)
        first = min(count, max(16, most.bit_length()))  # these quantities make corners differ
        own_key, other_key = jax.random.split(key)
        drawn = jax.random.choice(own_key, 2**first, (most,), replace=False)
        signs = 2.0 * (drawn[:, None] >> jnp.arange(first)[None] & 1) - 1.0
        rest = jax.random.rademacher(other_key, (most, count - first), float)
        return jnp.concatenate([signs, rest], axis=1)

    def ranges(self) -> dict[str, list[float]]:
        """Lowest and highest value of each quantity, JSON-ready."""
        ends = zip(self.lower.tolist(), self.upper.tolist(), strict=True)
        return dict(zip(self.names, map(list, ends), strict=True))


@dataclass(frozen=True)
class _Quantity:
    """What may differ: nominal value, what a percentage refers to, and bounds.

    Attributes:
        is_positive: whether it is a parameter estimated by its logarithm.
        is_signed: whether it is a parameter of either sign.
    """

    nominal: float
    size: float
    unit: str
    lower: float = -math.inf
    upper: float = math.inf
    is_positive: bool = False
    is_signed: bool = False


@dataclass(frozen=True)
class _Interval:
    lower: float
    upper: float
    is_factor: bool = False


def _quantities(plant: AbstractPlant, starts: Sequence[str]) -> dict[str, _Quantity]:
    """All quantities of a plant that may differ, by name; `starts` are those of its states."""
    d = plant.description
    found = {
        p.name: _Quantity(p.nominal, p.scale, p.unit, *p.support, p.positive, not p.positive)
        for p in d.parameters
    }
    for name in d.name.split("+")[1:]:  # what a percentage of an effect would be is not plain
        if not name.startswith(("gain_", "saturation_")):
            found[name] = dataclasses.replace(found[name], size=0.0)
    for name in names_of(d.inputs):  # an input cannot act before it is chosen
        if (delay := f"delay_{name}") in found:
            found[delay] = dataclasses.replace(found[delay], lower=0.0)
    found |= {c.name: _Quantity(c.value, abs(c.value), c.unit) for c in d.constants}
    states = zip(starts, d.states, strict=False)  # those of extensions come last
    found |= {name: _Quantity(s.initial, s.scale, s.unit) for name, s in states}
    return {**found, _NOISE: _Quantity(1.0, 1.0, "", lower=0.0)}


def _interval(name: str, given: Any, about: _Quantity) -> _Interval:
    """The range of one quantity; ValueError for one that is not allowed."""
    found = _read(name, given, about)
    if not (math.isfinite(found.lower) and math.isfinite(found.upper)):
        raise ValueError(f"range of {name} must be finite: got {_shown(given)}")
    if found.lower > found.upper:
        raise ValueError(
            f"range of {name} contains no plant: it goes from {found.lower:g} to {found.upper:g}"
        )
    if found.lower <= 0 and about.is_positive:
        raise ValueError(f"range of {name} must be above 0: it begins at {found.lower:g}")
    if found.lower < about.lower or found.upper > about.upper:
        raise ValueError(
            f"range of {name} goes from {found.lower:g} to {found.upper:g}, beyond its bounds "
            f"{about.lower:g} to {about.upper:g} {about.unit}".rstrip()
        )
    return found


def _read(name: str, given: Any, about: _Quantity) -> _Interval:
    """A range as it is written."""
    if isinstance(given, Sequence) and not isinstance(given, str):
        if len(given) != 2:
            raise ValueError(f"range of {name} must be {_ALLOWED}: got {list(given)}")
        return _Interval(_as_number(name, given[0], given), _as_number(name, given[1], given))
    if not isinstance(given, str):
        raise ValueError(f"range of {name} must be {_ALLOWED}: got {given!r}")
    text = given.strip()
    first, colon, second = text.partition(":")
    if not about.size and (text.endswith("%") or (first == "factor" and about.is_signed)):
        raise ValueError(f"range of {name} needs two numbers LOW:HIGH: got {given!r}")
    if text.endswith("%"):
        reach = _as_number(name, text[:-1], given) / 100 * about.size
        return _Interval(about.nominal - reach, about.nominal + reach)
    if first == "factor":
        factor = _as_number(name, second, given)
        if about.is_signed:
            reach = math.log(factor) * about.size if factor >= 1 else math.nan
            return _Interval(about.nominal - reach, about.nominal + reach)
        if not (factor >= 1 and about.nominal > 0):
            raise ValueError(
                f"range of {name}: a factor is 1 or more, for a quantity with a positive nominal "
                f"value; got {given!r} and the nominal value {about.nominal:g}"
            )
        return _Interval(about.nominal / factor, about.nominal * factor, is_factor=True)
    if not colon:
        hint = f" ({text}:{text} is one value)" if _is_number(text) else ""
        raise ValueError(f"range of {name} must be {_ALLOWED}: got {given!r}{hint}")
    return _Interval(_as_number(name, first, given), _as_number(name, second, given))


def _as_number(name: str, value: object, given: Any) -> float:
    try:
        if isinstance(value, bool) or isinstance(value, str) != isinstance(given, str):
            raise ValueError
        return float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"range of {name} must be {_ALLOWED}: got {_shown(given)}") from None


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _shown(given: Any) -> str:
    text = given if isinstance(given, str) else str(list(given))
    return repr(text) if len(text) < 60 else repr(text[:60] + "...")
