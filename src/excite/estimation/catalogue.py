"""Estimators by name."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from ..description import Listing, first_line, unknown, wrong_type
from ..files import is_class_word, made_at
from ..plant.fields import with_options
from .arx import ARX
from .contract import AbstractEstimator
from .decrement import Decrement
from .nls import NLS
from .pem import PEM

ESTIMATORS: Mapping[str, AbstractEstimator] = {
    "arx-rls": ARX(),
    "arx-rls-wide": ARX(start_covariance=1e8, name="arx-rls-wide"),
    "nls": NLS(),
    "pem": PEM(),
    "decrement": Decrement(),
}


def estimators() -> Listing:
    """The estimators, by name.

    >>> import excite as ex
    >>> "nls" in ex.estimators()
    True
    """
    return Listing({name: _line(chosen) for name, chosen in ESTIMATORS.items()})


def _line(estimator: AbstractEstimator) -> str:
    """What an estimator is, and its options that are not the usual ones."""
    kind = type(estimator)
    usual = kind()  # pyright: ignore[reportCallIssue] - finals have defaults
    names = [field.name for field in dataclasses.fields(kind) if field.name != "name"]
    own = {n: getattr(estimator, n) for n in names if getattr(estimator, n) != getattr(usual, n)}
    options = ", ".join(f"{name} = {value:g}" for name, value in own.items())
    return first_line(kind) + (f" With {options}." if own else "")


def estimator_from(
    given: str | AbstractEstimator | type[AbstractEstimator],
) -> AbstractEstimator:
    """An estimator from a name, a class or an estimator.

    Raises:
        ValueError: for an unknown name.
        TypeError: for anything else.
    """
    if isinstance(given, str):
        return estimator_named(given)
    if isinstance(given, type) and issubclass(given, AbstractEstimator):
        given = given()  # pyright: ignore[reportCallIssue] - finals have defaults
    if not isinstance(given, AbstractEstimator):
        raise wrong_type("estimator", given, "a name, an estimator or its class")
    return given


def estimator_named(name: str, options: Mapping[str, Any] | None = None) -> AbstractEstimator:
    """An estimator by name or as `path/to/file.py:ClassName`, with other options where given.

    The user's file is imported, so its code runs.

    Raises:
        ValueError: for an unknown name or option, or a value that is not allowed.
    """
    if is_class_word(name):
        default = made_at(name, AbstractEstimator, "estimator")
    elif name in ESTIMATORS:
        default = ESTIMATORS[name]
    else:
        raise unknown("estimator", name, [*ESTIMATORS, "path/to/file.py:ClassName"])
    if not options:
        return default
    estimator = with_options(default, name, options)
    for option in (
        "start_covariance", "forgetting_factor", "tolerance", "max_steps", "segment_length",
    ):  # fmt: skip
        value = getattr(estimator, option, None)
        if value is not None and not 0 < float(value) < math.inf:
            raise ValueError(f"{option} of {name!r} must be positive: got {options[option]!r}")
    if float(getattr(estimator, "forgetting_factor", 1.0)) > 1:
        got = options["forgetting_factor"]
        raise ValueError(f"forgetting_factor of {name!r} must be at most 1: got {got!r}")
    return estimator
