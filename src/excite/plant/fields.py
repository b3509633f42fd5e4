"""Fields that users set by name: numbers become arrays, options are checked by their types.

Excitations, estimators and objectives are dataclasses. A field whose type is `bool`, `int`,
`float` or an array of numbers is an option of its class; a field of another type is not.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cache
from numbers import Integral, Real
from types import UnionType
from typing import TypeVar, get_args, get_type_hints

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..description import unknown

_Module = TypeVar("_Module", bound=eqx.Module)


def floats(value: object) -> Array:
    """An array in double precision, also from whole numbers; traced values stay traced.

    Raises:
        TypeError: for a text.
    """
    if isinstance(value, jax.core.Tracer):
        return jnp.asarray(value, float)
    if isinstance(value, str):
        raise TypeError(f"expected a number or several: got str {value!r}")
    return jax.device_put(np.asarray(value, float))  # unlike jnp.asarray, compiles nothing


def optional_floats(value: object) -> Array | None:
    """As `floats`, but None stays None."""
    return None if value is None else floats(value)


def with_options(default: _Module, name: str, options: Mapping[str, object]) -> _Module:
    """`default` with other options.

    Args:
        name: of the excitation or estimator, for messages.

    Raises:
        ValueError: for an option that does not exist, or a value of another type.
    """
    allowed = options_of(type(default))
    for option, value in options.items():
        if option not in allowed:
            raise unknown(f"{name} option", option, allowed)
        if not _FITS[allowed[option]](value):
            raise ValueError(f"{option} of {name!r} must be {allowed[option]}: got {value!r}")
    return dataclasses.replace(default, **options)


@cache
def options_of(kind: type[eqx.Module]) -> dict[str, str]:
    """Options of a class, and the allowed type of each in words."""
    types = get_type_hints(kind)
    options = {f.name: _allowed(types[f.name]) for f in dataclasses.fields(kind)}
    return {name: allowed for name, allowed in options.items() if allowed}


def _allowed(field: object) -> str:
    """The allowed values of a field of this type in words; empty for a type that is no option."""
    if isinstance(field, UnionType):  # with None, where the default depends on the plant
        field = get_args(field)[0]
    if field in (bool, int):
        return "true or false" if field is bool else "a whole number"
    axes = "" if field is float else getattr(field, "dim_str", "no array")
    return {"": "a number", "...": "a number or a list of numbers"}.get(axes, "")


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _are_numbers(value: object) -> bool:
    return isinstance(value, list | tuple) and all(map(_is_number, value))


_FITS = {
    "true or false": lambda value: isinstance(value, bool),
    "a whole number": lambda value: isinstance(value, Integral) and not isinstance(value, bool),
    "a number": _is_number,
    "a number or a list of numbers": lambda value: _is_number(value) or _are_numbers(value),
}
