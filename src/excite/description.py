"""The description of a plant as plain data: names, units, limits, levels, sensor, values.

A `PlantDescription` needs neither JAX nor NumPy, so that a report, a web page or a
laboratory computer can read it fast. Its hash identifies the plant in records and
policies. It is the SHA-256 of canonical JSON with a format number, not of source code:
it changes with any number, but not when a plant file is moved or reformatted.

All values are in SI units and radians.
"""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import json
import math
import os
import reprlib
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

FORMAT = 1
"""Version of the canonical JSON below; it enters every hash."""

HALF_95 = 1.959964
"""Half of a 95 % interval in standard deviations, wherever one is shown."""

RARE = 0.01
"""p-value below which a residual is reported as not white, or as following the input, and
below which intervals are widened."""


_LONGEST = 500  # characters of another program's message

_T = TypeVar("_T")


def _require(condition: bool, sentence: str) -> None:
    if not condition:
        raise ValueError(sentence)


def _number(value: object) -> float:
    """As a float, infinite where it is too large for one; NaN for what is no number."""
    if isinstance(value, bool) or not hasattr(value, "__float__"):
        return math.nan
    try:
        return float(value)  # pyright: ignore[reportArgumentType]
    except OverflowError:
        return math.inf
    except (TypeError, ValueError):
        return math.nan


class _Named:
    """Checks and normalises the fields that all parts of a description share."""

    name: str

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise wrong_type(f"name of a {type(self).__name__.lower()}", self.name, "a text")
        _require(
            self.name.isidentifier() and not self.name.startswith("_"),
            f"{type(self).__name__.lower()} name {self.name!r} is not allowed: "
            "letters, digits and underscores, beginning with a letter",
        )
        for field in fields(self):  # pyright: ignore[reportArgumentType]
            value = getattr(self, field.name)
            if field.type == "str":
                if not isinstance(value, str):
                    raise wrong_type(f"{field.name} of {self.name!r}", value, "a text")
            elif isinstance(value, int | float) and not isinstance(value, bool):
                # 1 and 1.0, 0 and -0 are the same number and must give the same hash.
                number = _number(value)
                _require(
                    math.isfinite(number),
                    f"{field.name} of {self.name!r} is {number}; a finite number is needed "
                    "(leave a bound out for none)",
                )
                object.__setattr__(self, field.name, number + 0.0)
            elif field.type == "float" or (field.type == "float | None" and value is not None):
                raise wrong_type(f"{field.name} of {self.name!r}", value, "a number")


@dataclass(frozen=True)
class State(_Named):
    """One component of the state: its value at rest and a typical size, in `unit`.

    `noise_sd` is the standard deviation of what a disturbance adds to it in every `dt`
    (process noise).

    >>> import excite as ex
    >>> ex.State("pitch", "rad", scale=0.5).initial
    0.0
    """

    name: str
    unit: str
    initial: float = 0.0
    scale: float = 1.0
    noise_sd: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(self.scale > 0, f"scale of state {self.name!r} must be positive")
        _require(self.noise_sd >= 0, f"noise_sd of state {self.name!r} must not be negative")


@dataclass(frozen=True)
class Input(_Named):
    """One input with its limits, and the amplitude at which classical signals are safe.

    `amplitude` counts from the middle of the limits; left out (0) it is half their width.

        >>> import excite as ex
        >>> ex.Input("voltage", "V", -24.0, 24.0).amplitude
        24.0
    """

    name: str
    unit: str
    lower: float
    upper: float
    amplitude: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(
            self.lower < self.upper,
            f"limits of input {self.name!r} must increase: got {self.lower} to {self.upper}",
        )
        half = (self.upper - self.lower) / 2
        if self.amplitude == 0:
            object.__setattr__(self, "amplitude", half)
        _require(
            0 < self.amplitude <= half,
            f"amplitude of input {self.name!r} must lie in (0, {half}]: got {self.amplitude}",
        )


@dataclass(frozen=True)
class Output(_Named):
    """One measured output: typical size, sensor, and the safety levels of its magnitude.

    `noise_sd` is the standard deviation of Gaussian sensor noise, `resolution` the step
    of an encoder (0: none), both in `unit`. A level left out is not checked.

        >>> import excite as ex
        >>> ex.Output("pitch", "rad", scale=0.8, resolution=0.002).critical_level is None
        True
    """

    name: str
    unit: str
    scale: float
    noise_sd: float = 0.0
    resolution: float = 0.0
    warning_level: float | None = None
    critical_level: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(self.scale > 0, f"scale of output {self.name!r} must be positive")
        _require(
            self.noise_sd >= 0 and self.resolution >= 0,
            f"noise_sd and resolution of output {self.name!r} must not be negative",
        )
        _require(
            all(v is None or v > 0 for v in (self.warning_level, self.critical_level)),
            f"the levels of output {self.name!r} are magnitudes and must be positive",
        )
        if self.warning_level is not None and self.critical_level is not None:
            _require(
                self.warning_level < self.critical_level,
                f"warning level of output {self.name!r} must be below its critical level",
            )


@dataclass(frozen=True)
class Parameter(_Named):
    """One unknown parameter.

    `positive` parameters are estimated through their logarithm, free ones over `scale`.
    `target`: whether an experiment is designed for it. `symbol`: TeX for a report.
    `scale`: size of a relevant change (left out: the size of the nominal value).

        >>> import excite as ex
        >>> ex.Parameter("J_p", "kg m²", 0.0232).scale
        0.0232
    """

    name: str
    unit: str
    nominal: float
    symbol: str = ""
    scale: float = 0.0
    lower: float | None = None
    upper: float | None = None
    positive: bool = True
    target: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.symbol:
            object.__setattr__(self, "symbol", self.name)
        if self.scale == 0:
            object.__setattr__(self, "scale", abs(self.nominal))
        _require(self.scale > 0, f"scale of parameter {self.name!r} must be positive")
        _require(
            not self.positive or self.nominal > 0,
            f"parameter {self.name!r} is positive, its nominal value {self.nominal} is not",
        )
        lower, upper = self.support
        _require(
            lower < self.nominal < upper,
            f"nominal value of parameter {self.name!r} must lie inside its bounds: "
            f"got {self.nominal} for {lower} to {upper}",
        )
        _require(
            not self.positive or self.lower is None or self.lower > 0,
            f"lower bound of the positive parameter {self.name!r} must be positive",
        )

    @property
    def support(self) -> tuple[float, float]:
        """The values between these two are allowed; an end may be infinite."""
        least = 0.0 if self.positive else -math.inf
        return (
            least if self.lower is None else self.lower,
            math.inf if self.upper is None else self.upper,
        )


@dataclass(frozen=True)
class Constant(_Named):
    """One known physical constant.

    >>> import excite as ex
    >>> ex.Constant("g", "m/s²", 9.81).value
    9.81
    """

    name: str
    unit: str
    value: float


_PARTS = {
    "states": State,
    "inputs": Input,
    "outputs": Output,
    "parameters": Parameter,
    "constants": Constant,
}
_MOST_SUBSTEPS = 10_000
INTEGRATORS = ("runge_kutta", "euler")


@dataclass(frozen=True, repr=False)
class PlantDescription:
    """A plant as plain data.

        >>> import excite as ex
        >>> tank = ex.PlantDescription(
        ...     name="tank",
        ...     states=(ex.State("level", "m"),),
        ...     inputs=(ex.Input("inflow", "m³/s", 0.0, 0.02),),
        ...     outputs=(ex.Output("level", "m", scale=1.0, noise_sd=0.01, critical_level=3.0),),
        ...     parameters=(ex.Parameter("area", "m²", 1.5),),
        ...     constants=(ex.Constant("g", "m/s²", 9.81),),
        ...     dt=1.0,
        ...     band=(0.001, 0.1),
        ... )
        >>> tank
        plant tank, sampled every 1 s
          input inflow: 0 to 0.02 m³/s
          output level [m], critical level 3 m
          parameters area = 1.5 m²

    Attributes:
        name: used by the command line, studies and records.
        states, inputs, outputs, parameters, constants: in the order of their arrays. A plant may
            have no inputs: a free decay, a reaction, a body that cools.
        dt: sampling time [s]; inputs are held over it.
        substeps: of the integration, in one `dt`.
        integrator: `runge_kutta` (of order 4) or `euler`, whose process with noise is that of
            Euler and Maruyama.
        band: lowest and highest frequency [Hz] that a signal excites by default; left out, a
            hundredth and a half of the largest one, half the sampling rate.
    """

    name: str
    states: tuple[State, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    parameters: tuple[Parameter, ...]
    dt: float
    band: tuple[float, float] = (0.0, 0.0)
    constants: tuple[Constant, ...] = ()
    substeps: int = 1
    integrator: str = "runge_kutta"

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise wrong_type("name of a plant", self.name, "a text")
        dt = _number(self.dt)
        _require(
            dt >= sys.float_info.min and math.isfinite(dt),
            f"dt must be positive: got {reprlib.repr(self.dt)}",
        )
        object.__setattr__(self, "dt", dt)
        object.__setattr__(self, "band", self._own_band())
        substeps = self.substeps
        _require(
            _number(substeps).is_integer() and 1 <= substeps <= _MOST_SUBSTEPS,
            f"substeps must be a whole number from 1 to {_MOST_SUBSTEPS}: got "
            f"{reprlib.repr(substeps)}",
        )
        object.__setattr__(self, "substeps", int(substeps))
        if self.integrator not in INTEGRATORS:
            raise unknown("integrator", str(self.integrator), INTEGRATORS)
        _require(
            0 < self.band[0] < self.band[1] <= 0.5 / self.dt,
            f"band must increase and end at or below {0.5 / self.dt:g} Hz, half the sampling "
            f"rate: got {self.band[0]:g} to {self.band[1]:g} Hz",
        )
        for kind, part_type in _PARTS.items():
            parts = getattr(self, kind)
            if not isinstance(parts, Iterable) or not all(isinstance(p, part_type) for p in parts):
                allowed = f"a tuple of ex.{part_type.__name__}"
                raise wrong_type(f"{kind} of {self.name!r}", parts, allowed)
            names = [part.name for part in parts]
            may_lack = kind in ("inputs", "constants")
            _require(bool(parts) or may_lack, f"plant {self.name!r} has no {kind}")
            twice = next((name for name in names if names.count(name) > 1), None)
            _require(twice is None, f"{kind} of {self.name!r} repeat the name {twice!r}")
        columns = {"time", *names_of(self.inputs)}
        _require(
            columns.isdisjoint(names_of(self.outputs)) and "time" not in names_of(self.inputs),
            f"inputs and outputs of {self.name!r} are file columns beside 'time': "
            "all their names must differ",
        )

    def _own_band(self) -> tuple[float, float]:
        """The band as two numbers, by default from the sampling time."""
        try:
            numbers = [_number(frequency) for frequency in self.band]
        except TypeError:
            numbers = []
        if len(numbers) != 2 or any(map(math.isnan, numbers)):
            raise ValueError(
                "band must be two frequencies in Hz, the lowest and the highest: got "
                f"{reprlib.repr(self.band)}"
            )
        low, high = numbers if any(numbers) else (0.005 / self.dt, 0.25 / self.dt)
        return low, high

    def __repr__(self) -> str:
        lines = [f"plant {self.name}, sampled every {self.dt:g} s"]
        lines += [
            f"  input {i.name}: {i.lower:g} to {i.upper:g} {i.unit}".rstrip() for i in self.inputs
        ]
        for o in self.outputs:
            unit, factor = display_unit(o.unit)
            level = o.critical_level
            words = "" if level is None else f", critical level {factor * level:g} {unit}"
            lines.append(f"  output {with_unit(o.name, o.unit)}{words}")
        named = [f"{p.name} = {p.nominal:g} {p.unit}".rstrip() for p in self.parameters[:12]]
        rest = f", and {len(self.parameters) - 12} more" if len(self.parameters) > 12 else ""
        return "\n".join([*lines, f"  parameters {', '.join(named)}{rest}"])

    def parameter(self, name: str) -> Parameter:
        """One of the parameters, by name."""
        return next(p for p in self.parameters if p.name == name)

    @property
    def is_disturbed(self) -> bool:
        """Whether a state has process noise."""
        return any(state.noise_sd for state in self.states)

    @property
    def observes_state(self) -> bool:
        """Whether the outputs are the states, which have noise, and are measured without error."""
        is_exact = not any(o.noise_sd or o.resolution for o in self.outputs)
        is_state = names_of(self.outputs) == names_of(self.states)
        return is_exact and is_state and all(state.noise_sd for state in self.states)

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of an experiment file: time, inputs, outputs."""
        return ("time", *names_of(self.inputs), *names_of(self.outputs))

    def to_dict(self) -> dict[str, Any]:
        """The description as JSON-ready data; `from_dict` reads it back."""
        content = {"format": FORMAT, **asdict(self)}
        # What a plant does not have is left out: the hashes of others stay what they were.
        if self.integrator == INTEGRATORS[0]:
            del content["integrator"]
        for state in content["states"]:
            if not state["noise_sd"]:
                del state["noise_sd"]
        return content

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PlantDescription:
        """The description written by `to_dict`.

        Raises:
            ValueError: for another format number, or a missing or unknown field.
        """
        if data.get("format") != FORMAT:
            raise ValueError(
                f"plant description has format {data.get('format')!r}; this version reads {FORMAT}"
            )
        try:
            parts = {k: tuple(kind(**entry) for entry in data[k]) for k, kind in _PARTS.items()}
            rest = {k: v for k, v in data.items() if k != "format" and k not in _PARTS}
            return cls(**{**rest, **parts, "band": tuple(data["band"])})
        except (KeyError, TypeError, OverflowError) as error:
            raise ValueError(f"plant description is incomplete or malformed: {error}") from None

    @property
    def hash(self) -> str:
        """SHA-256 of the canonical JSON, as 64 hexadecimal digits."""
        text = json.dumps(self.to_dict(), sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()


def names_of(parts: Iterable[_Named]) -> tuple[str, ...]:
    """Names of states, inputs, outputs, parameters or constants, in order."""
    return tuple(part.name for part in parts)


def listed(names: Sequence[str]) -> str:
    """Names in a sentence: a, b and c."""
    return " and ".join([*[", ".join(names[:-1])] * (len(names) > 1), *names[-1:]])


def first_line(kind: type) -> str:
    """The first sentence of a class's docstring."""
    return (kind.__doc__ or "").strip().partition("\n")[0]


class Listing(dict[str, str]):
    """A list of names with one line each; its `repr` has two columns."""

    def __repr__(self) -> str:
        widest = max(map(len, self), default=0)
        gap = " " * (widest + 2)
        lines = (f"{name:{widest}}  {line}" for name, line in self.items())
        return "\n".join(textwrap.fill(line, 80, subsequent_indent=gap) for line in lines)


class Named(dict[str, _T]):
    """Values by name, also as attributes: `values["D_p"]` is `values.D_p`."""

    def __getattr__(self, name: str) -> _T:
        if name in self:
            return self[name]
        raise AttributeError(str(unknown("name", name, self)))

    def __missing__(self, name: str) -> _T:
        raise KeyError(str(unknown("name", name, self)))

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self]


def display_unit(unit: str) -> tuple[str, float]:
    """Unit in which a quantity is shown, and its factor: degrees for radians."""
    if unit in ("rad", "rad/s"):
        return unit.replace("rad", "deg"), 180 / math.pi
    return unit, 1.0


def with_unit(name: str, unit: str) -> str:
    """A name and, in brackets, its unit, if it has one."""
    return f"{name} [{unit}]" if unit else name


def unknown(kind: str, word: str, allowed: Iterable[str]) -> ValueError:
    """The error for an unknown word; it names the nearest known one."""
    allowed = list(allowed)
    same = [name for name in allowed if name.lower() == word.lower()]
    nearest = same or difflib.get_close_matches(word, allowed, n=1, cutoff=0.5)
    hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
    return ValueError(f"unknown {kind} {word!r}{hint} (there is {', '.join(allowed)})")


def wrong_type(what: str, value: object, allowed: str) -> TypeError:
    """The error for an object of a wrong type: what is allowed, and what was given."""
    text = reprlib.repr(value)
    shown = "" if text.startswith("<") or "\n" in text else f" {text}"
    kind = f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
    return TypeError(f"{what} must be {allowed}: got {kind}{shown * (not isinstance(value, type))}")


def by_name(
    what: str, given: Mapping[str, _T] | None, allowed: str = "a dict by name"
) -> dict[str, _T]:
    """A copy of values by name, empty for None; TypeError for anything else."""
    if not isinstance(given, Mapping | None) or not all(isinstance(n, str) for n in given or {}):
        raise wrong_type(what, given, allowed)
    return dict(given or {})


def as_number(what: str, value: object) -> float:
    """One number; TypeError for a text, a list or anything else."""
    is_one = not getattr(value, "shape", ()) and not isinstance(value, str | bool)
    if is_one and hasattr(value, "__float__"):
        with contextlib.suppress(TypeError, ValueError):
            return float(value)  # pyright: ignore[reportArgumentType]
    raise wrong_type(what, value, "a number")


LARGEST_SEED = 2**63 - 1


def require_whole(what: str, value: Any, least: int, most: int = 10_000_000) -> None:
    """Raises ValueError for anything but a whole number in a range."""
    is_whole = hasattr(value, "__index__") and not isinstance(value, bool)
    if not (is_whole and least <= int(value) <= most):
        raise ValueError(
            f"{what} must be a whole number from {least} to {most}: got {reprlib.repr(value)}"
        )


@dataclass(frozen=True)
class Spread:
    """How far the parameters of plants lie from their nominal values.

        >>> Spread.of("factor:3").value(Parameter("J_p", "kg m²", 0.03), 0.03, 1.0)
        0.09

    Attributes:
        reach: a fraction of each parameter's scale, or a factor.
        relative: half the width in relative parameters: the fraction, or the factor's logarithm.
        is_factor: whether it is a factor. Positive parameters then lie between the nominal value
            over the factor and the nominal value times the factor, uniform in their logarithm;
            the others within the factor's logarithm times their scale.

    The numbers may be arrays.
    """

    reach: Any
    relative: Any
    is_factor: bool = False

    @classmethod
    def of(cls, given: SpreadLike) -> Spread:
        """From a fraction such as 0.3, or a text such as `factor:3`; ValueError otherwise."""
        if isinstance(given, Spread):
            return given
        word, _, number = given.partition(":") if isinstance(given, str) else ("", "", "")
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            if word == "factor" and 1 <= float(number) <= LARGEST_FACTOR:
                return cls(float(number), math.log(float(number)), is_factor=True)
            if not isinstance(given, str | bool) and 0 <= float(given) < 1:
                return cls(float(given), float(given))
        raise ValueError(
            "spread must lie in [0, 1), or be a factor from 1 to "
            f"{LARGEST_FACTOR:g} such as factor:3: got {reprlib.repr(given)}"
        )

    def value(self, parameter: Parameter, nominal: Any, unit: Any) -> Any:
        """The parameter at a coordinate in [-1, 1], for numbers or arrays."""
        if self.is_factor and parameter.positive:
            return nominal * self.reach**unit
        return nominal + self.relative * parameter.scale * unit

    @property
    def setting(self) -> float | str:
        """As it is given and saved."""
        return f"factor:{self.reach:.12g}" if self.is_factor else self.reach

    def __str__(self) -> str:
        """As it is given on the command line."""
        return str(self.setting) if self.is_factor else f"{self.reach:g}"


SpreadLike: TypeAlias = float | str | Spread
"""A fraction of each parameter's scale, or a factor such as `factor:3`."""

LARGEST_FACTOR = 1000.0


def prior_sd_of(spread: SpreadLike) -> float:
    """Standard deviation of a relative parameter, uniform within the spread."""
    # Without a spread, it is as if it were one percent.
    return max(Spread.of(spread).relative, 0.01) / 3**0.5


def told(error: BaseException) -> str:
    """The type of an error of a user's code and what it says, in one short line."""
    try:
        text = " ".join(str(error).split())
    except BaseException:  # its own `__str__` fails
        text = ""
    text = textwrap.shorten(text, _LONGEST) if len(text) > _LONGEST else text
    return f"{type(error).__name__}: {text}".removesuffix(": ")


def path_from(what: str, value: object, allowed: str = "a path") -> Path:
    """A path from a text or a path; TypeError for anything else."""
    if not isinstance(value, str | os.PathLike):
        raise wrong_type(what, value, allowed)
    return Path(value)
