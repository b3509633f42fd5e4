"""What is known of parameters before the records are seen.

A normal distribution of some parameters, or of their logarithms, adds a weighted sum of squares to
that of the residual; the estimate is then the most probable one (maximum a posteriori; L. Ljung,
System Identification, 2nd ed., section 7.4). A uniform distribution bounds the search.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..description import RARE, Parameter, names_of, unknown, wrong_type
from ..files import read_json
from ..plant import AbstractPlant, Params
from .diagnosis import chi2_tail
from .result import Identification

_FORMS = "normal:MEAN:SD, lognormal:MEDIAN:SD or uniform:LOWEST:HIGHEST"
_ALLOWED = f"a dict by parameter ({_FORMS}), a run folder, a result of identify, or several"
_ADVICE = "give a run folder of `excite identify`, or a file with `mean` and `covariance`"
_LITTLE = 0.9  # of a prior's standard deviation; data that leave more of it tell little

PriorLike: TypeAlias = "Mapping[str, str] | str | Path | Identification | Prior"
"""Distributions by parameter ("normal:0.022:5%"), an earlier run, or a joint distribution."""


class Prior(eqx.Module):
    """A normal distribution of some parameters, or of their logarithms.

        >>> prior = Prior.normal(["J_p", "D_p"], [0.022, 0.007], [[1e-6, 0.0], [0.0, 1e-6]])
        >>> prior.names
        ('J_p', 'D_p')

    Attributes:
        names: of the parameters.
        logarithmic: whether it is the logarithm that is normal.
        mean: of the parameters or of their logarithms.
        root: W with W' W the inverse of their covariance.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    mean: Float[Array, " part"]
    root: Float[Array, "row part"]

    @classmethod
    def normal(
        cls,
        names: Sequence[str],
        mean: Sequence[float] | Float[np.ndarray, " part"],
        covariance: Sequence[Sequence[float]] | Float[np.ndarray, "part part"],
        logarithmic: Sequence[bool] | None = None,
    ) -> Prior:
        """A joint distribution; ValueError where its covariance is not positive definite."""
        center, spread = np.asarray(mean, float), np.asarray(covariance, float)
        expected = f"{len(names)} numbers and {len(names)} x {len(names)} covariances"
        if center.shape != (len(names),) or spread.shape != (len(names), len(names)):
            raise ValueError(
                f"the prior of {', '.join(names)} needs {expected}: got shapes {center.shape} and "
                f"{spread.shape}"
            )
        size = np.sqrt(np.maximum(np.diag(spread), 0.0))
        correlation = spread / np.outer(size, size) if np.all(size > 0) else np.full_like(spread, 2)
        is_symmetric = np.allclose(spread, spread.T, rtol=1e-6, atol=0)
        if not (np.isfinite(center).all() and np.isfinite(correlation).all() and is_symmetric):
            raise ValueError(f"the prior of {', '.join(names)} must be finite and symmetric")
        if np.linalg.eigvalsh(correlation)[0] < 1e-12:
            raise ValueError(
                f"the covariance of the prior of {', '.join(names)} is not positive definite"
            )
        root = np.linalg.cholesky(np.linalg.inv(correlation)).T / size
        kinds = tuple(map(bool, logarithmic or [False] * len(names)))
        return cls(tuple(names), kinds, jax.device_put(center), jax.device_put(root))

    @classmethod
    def joined(cls, priors: Sequence[Prior]) -> Prior:
        """Independent priors as one; ValueError where a parameter has two."""
        names = tuple(name for prior in priors for name in prior.names)
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"parameter {name!r} has two priors; give one")
        return cls(
            names,
            tuple(kind for prior in priors for kind in prior.logarithmic),
            jax.device_put(np.concatenate([prior.mean for prior in priors])),
            jax.scipy.linalg.block_diag(*[prior.root for prior in priors]),
        )

    def residual(
        self, description_names: Sequence[str], values: Float[Array, " param"]
    ) -> Float[Array, " row"]:
        """Distance from the mean in standard deviations, uncorrelated."""
        own = values[np.array([description_names.index(name) for name in self.names])]
        is_log = np.array(self.logarithmic)
        logarithm = jnp.log(jnp.where(is_log, own, 1.0))
        return self.root @ (jnp.where(is_log, logarithm, own) - self.mean)

    def sd(self) -> Float[np.ndarray, " part"]:
        """Standard deviation of each parameter, relative where its logarithm is normal."""
        inverse = np.linalg.inv(np.asarray(self.root))
        return np.linalg.norm(inverse, axis=1)

    def verdict(
        self, values: Mapping[str, float], covariance: Float[np.ndarray, "part part"]
    ) -> tuple[str, ...]:
        """Sentences where the data contradict the prior, or tell little beyond it.

        Args:
            values: estimated parameters.
            covariance: of the estimates of this prior's parameters.
        """
        own = np.array([values[name] for name in self.names])
        is_log = np.array(self.logarithmic)
        unit = np.where(is_log, own, 1.0)
        moved = np.where(is_log, np.log(np.where(is_log, own, 1.0)), own) - np.asarray(self.mean)
        inverse = np.linalg.inv(np.asarray(self.root))
        before, after = inverse @ inverse.T, covariance / np.outer(unit, unit)
        told = []
        # The covariance of what the data move is the prior's less the estimate's.
        gained = np.diag(before) - np.diag(after)
        for i, name in enumerate(self.names):
            ratio = math.sqrt(max(after[i, i], 0.0) / before[i, i])
            if 0 < gained[i] and chi2_tail(1, float(moved[i] ** 2 / gained[i])) < RARE:
                told.append(f"the data contradict the prior of {name}")
            elif ratio > _LITTLE:
                told.append(f"{name} rests on its prior; the data tell little of it")
        return tuple(told)


def with_prior(
    plant: AbstractPlant,
    given: PriorLike | Sequence[PriorLike] | None,
    start: Params,
) -> tuple[AbstractPlant, Prior | None]:
    """The plant, bounded by uniform priors, and all other priors as one.

    Raises:
        ValueError: for a prior that is none, or excludes the start.
        TypeError: for something else.
    """
    if given is None:
        return plant, None
    is_one = isinstance(given, Mapping | str | Path | Identification | Prior)
    if not is_one and not isinstance(given, Sequence):
        raise wrong_type("prior", given, _ALLOWED)
    normal: list[Prior] = []
    bounds: dict[str, tuple[float, float]] = {}
    for one in [given] if is_one else given:
        if isinstance(one, Mapping):
            for name, text in one.items():
                kind, a, b = _parsed(name, text, plant)
                if kind == "uniform":
                    bounds[name] = a, b
                else:
                    is_log = kind == "lognormal"
                    mean = math.log(a) if is_log else a
                    normal.append(Prior.normal([name], [mean], [[b**2]], [is_log]))
        elif isinstance(one, Identification):
            normal.append(_from_run(plant, one.to_dict(), "the result"))
        elif isinstance(one, str | Path):
            normal.append(_read(plant, Path(one)))
        elif isinstance(one, Prior):
            _require_names(plant, one.names)
            normal.append(one)
        else:
            raise wrong_type("prior", one, _ALLOWED)
    joint = Prior.joined(normal) if normal else None
    for name in joint.names if joint else ():
        if name in bounds:
            raise ValueError(f"parameter {name!r} has two priors; give one")
    return _bounded(plant, bounds, start), joint


def _require_names(plant: AbstractPlant, names: Sequence[str]) -> None:
    own = names_of(plant.definition.parameters)
    for name in names:
        if name not in own:
            raise unknown(f"{plant.definition.name} parameter", name, own)


def _parsed(name: str, text: object, plant: AbstractPlant) -> tuple[str, float, float]:
    """Kind of a prior, and its two numbers."""
    _require_names(plant, [name])
    kind, *words = str(text).strip().split(":")
    wrong = ValueError(f"prior of {name!r} must be {_FORMS}: got {text!r}")
    if kind not in ("normal", "lognormal", "uniform") or len(words) != 2:
        raise wrong
    try:
        first, is_part = float(words[0]), words[1].endswith("%")
        second = float(words[1].removesuffix("%"))
    except ValueError:
        raise wrong from None
    if is_part:
        second *= 0.01 if kind == "lognormal" else 0.01 * abs(first)
    is_ordered = first < second if kind == "uniform" else second > 0
    is_allowed = first > 0 if kind == "lognormal" else not (is_part and kind == "uniform")
    if not (math.isfinite(first) and math.isfinite(second) and is_ordered and is_allowed):
        raise wrong
    if kind == "lognormal" and not _parameter(plant, name).positive:
        raise ValueError(f"{name!r} may be negative and has no lognormal prior; give a normal one")
    return kind, first, second


def _parameter(plant: AbstractPlant, name: str) -> Parameter:
    return next(p for p in plant.definition.parameters if p.name == name)


def _read(plant: AbstractPlant, path: Path) -> Prior:
    """A prior from a run folder, or from a file with mean and covariance."""
    if path.is_dir():
        return _from_run(plant, read_json(path / "estimate.json", advice=_ADVICE), str(path))
    data = read_json(path, "mean", "covariance", advice=_ADVICE)
    if not isinstance(data["mean"], dict):
        raise ValueError(f"{path}: mean must be an object by parameter: got {data['mean']!r}")
    _require_names(plant, list(data["mean"]))
    try:
        return Prior.normal(list(data["mean"]), list(data["mean"].values()), data["covariance"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None


def _from_run(plant: AbstractPlant, result: Mapping[str, object], where: str) -> Prior:
    """The estimates of an earlier run that this plant has; positive ones by their logarithm."""
    try:
        params, correlation = dict(result["params"]), result["correlation"]  # pyright: ignore
        names = [
            name
            for name, p in params.items()
            if name in names_of(plant.definition.parameters) and not p["held"]
        ]
        index = [list(params).index(name) for name in names]
        values = np.array([params[name]["estimate"] for name in names], float)
        sd = np.array([params[name]["std_error"] for name in names], float)
        correlated = np.array(correlation, float)[np.ix_(index, index)]
    except (KeyError, TypeError, ValueError, IndexError):
        raise ValueError(f"{where} is no result of identify; {_ADVICE}") from None
    if not names:
        raise ValueError(f"{where} has no estimated parameter of plant {plant.definition.name!r}")
    is_log = [_parameter(plant, name).positive for name in names]
    relative = sd / np.where(is_log, values, 1.0)
    mean = np.where(is_log, np.log(np.where(is_log, values, 1.0)), values)
    try:
        return Prior.normal(names, mean, correlated * np.outer(relative, relative), is_log)
    except ValueError as error:
        raise ValueError(f"{where} is no prior: {error}") from None


def _bounded(
    plant: AbstractPlant, bounds: Mapping[str, tuple[float, float]], start: Params
) -> AbstractPlant:
    """The plant with bounds of parameters."""
    if not bounds:
        return plant
    for name, (lower, upper) in bounds.items():
        part, value = _parameter(plant, name), float(getattr(start, name))
        if not lower < value < upper:
            raise ValueError(
                f"the search begins at {name} = {value:g} {part.unit}, outside its uniform prior "
                f"{lower:g} to {upper:g}; give a start inside it ({name}={(lower + upper) / 2:g})"
            )
    limits = tuple((name, *pair) for name, pair in bounds.items())
    begin = tuple(float(getattr(start, name)) for name in bounds)
    narrow = _narrowed(type(plant), limits, begin)
    bounded = narrow(
        sensor=plant.sensor,
        initial_state=plant.initial_state,
        dt=plant.dt,
        **plant.constants._asdict(),
    )
    object.__setattr__(bounded, "substeps", plant.substeps)
    return bounded


@cache
def _narrowed(
    kind: type[AbstractPlant],
    limits: tuple[tuple[str, float, float], ...],
    begin: tuple[float, ...],
) -> type[AbstractPlant]:
    """The class of a plant with bounds inside its own, and nominal values inside the bounds."""
    d, by_name = kind.definition, {name: pair for name, *pair in limits}
    nominal = dict(zip(by_name, begin, strict=True))

    def within(part: Parameter) -> Parameter:
        if part.name not in by_name:
            return part
        lower, upper = by_name[part.name]
        lowest = [x for x in (lower, part.lower) if x is not None and (x > 0 or not part.positive)]
        highest = [x for x in (upper, part.upper) if x is not None]
        return dataclasses.replace(
            part,
            lower=max(lowest, default=None),
            upper=min(highest),
            nominal=nominal[part.name],
            scale=part.scale,
        )

    narrow = dataclasses.replace(d, parameters=tuple(map(within, d.parameters)))
    return type(kind.__name__, (kind,), {"definition": narrow, "__module__": kind.__module__})
