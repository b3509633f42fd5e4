"""Priors as a user gives them: distributions in words, runs of other records, files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from ..description import Spread, SpreadLike, names_of, unknown, wrong_type
from ..files import read_json
from ..plant import AbstractPlant, Params, floats
from ..report.rows import EstimateSummary
from .prior import Prior, PriorPlants, bounded
from .result import Identification

_FORMS = "normal:MEAN:SD, lognormal:MEDIAN:SD or uniform:LOWEST:HIGHEST"
_ALLOWED = f"a dict by parameter ({_FORMS}), a run folder, a result, a Prior, or several"
_ADVICE = "give a run folder of `excite identify`, or a file (JSON) with `mean` and `covariance`"

PriorLike: TypeAlias = Mapping[str, str] | str | Path | Identification | Prior
"""Distributions by parameter ("normal:0.022:5%"), an earlier run, or a joint distribution."""


def plants_of(
    plant: AbstractPlant,
    prior: PriorLike | Sequence[PriorLike] | None,
    spread: SpreadLike = 0.0,
) -> PriorPlants:
    """The plants of a prior, from which some can be drawn.

    Args:
        plant: has the parameters.
        prior: distributions of parameters, see `identify`.
        spread: of parameters without one.

    Raises:
        ValueError: as `with_prior`, and for a prior beyond a parameter's bounds.
        TypeError: for something else than a prior.
    """
    reach = Spread.of(spread)
    if prior is None:
        return PriorPlants(plant, None, reach)
    normal, bounds = _separated(plant, prior, {})
    for name, low, high in bounds:
        least, most = plant.definition.parameter(name).support
        if not (least <= low and high <= most):
            raise ValueError(
                f"the prior of {name!r} is {low:g} to {high:g}, and it must lie between {least:g} "
                f"and {most:g}"
            )
    joint = Prior.joined(normal) if normal else None
    for name, (low, high) in joint.reach().items() if joint else ():
        least, most = plant.definition.parameter(name).support
        if low < least or high > most:
            end = f"below {least:g}" if low < least else f"above {most:g}"
            raise ValueError(
                f"the prior of {name!r} reaches {end}, where there is no plant: take a narrower "
                "one, or another distribution"
            )
    return PriorPlants(plant, joint, reach, tuple(bounds))


def with_prior(
    plant: AbstractPlant,
    given: PriorLike | Sequence[PriorLike],
    begin: Params,
    start: Mapping[str, float] | Params,
    hold: Mapping[str, float] | Params,
) -> tuple[AbstractPlant, Prior | None, Params]:
    """The plant, bounded by uniform priors, all other priors as one, and where the search begins.

    That is the mean of a prior where no start is given.

    Args:
        plant: has the parameters.
        given: see `identify`.
        begin: start of the search, without priors.
        start: what the user chose of it.
        hold: values of known parameters.

    Raises:
        ValueError: for a prior that is none, or excludes the start.
        TypeError: for something else.
    """
    normal, bounds = _separated(plant, given, hold)
    joint = Prior.joined(normal) if normal else None
    chosen = {*_names(start), *_names(hold)}
    for name, mean in joint.center().items() if joint else ():
        lower, upper = plant.definition.parameter(name).support
        if name not in chosen and lower < mean < upper:
            begin = begin._replace(**{name: floats(mean)})
    return bounded(plant, bounds, begin), joint, begin


def _separated(
    plant: AbstractPlant,
    given: PriorLike | Sequence[PriorLike],
    hold: Mapping[str, float] | Params,
) -> tuple[list[Prior], list[tuple[str, float, float]]]:
    """Normal priors, and name, lowest and highest value of uniform ones."""
    is_one = isinstance(given, Mapping | str | Path | Identification | Prior)
    if not is_one and not isinstance(given, Sequence):
        raise wrong_type("prior", given, _ALLOWED)
    normal: list[Prior] = []
    bounds: list[tuple[str, float, float]] = []
    for one in [given] if is_one else given:
        if isinstance(one, Mapping):
            for name, text in one.items():
                kind, a, b = _parsed(name, text, plant)
                if name in _names(hold):
                    raise ValueError(f"{name!r} is held and needs no prior; give one of the two")
                if kind == "uniform":
                    bounds.append((name, a, b))
                else:
                    is_log = kind == "lognormal"
                    mean = math.log(a) if is_log else a
                    normal.append(Prior.normal([name], [mean], [[b**2]], [is_log]))
        elif isinstance(one, Identification | str | Path):
            normal.append(prior_of_run(plant, one))
        elif isinstance(one, Prior):
            _require_names(plant, one.names)
            normal.append(one)
        else:
            raise wrong_type("prior", one, _ALLOWED)
    named = [*(name for name, *_ in bounds), *(name for one in normal for name in one.names)]
    for name in named:
        if named.count(name) > 1:
            raise ValueError(f"parameter {name!r} has two priors; give one")
    return normal, bounds


def _names(values: Mapping[str, float] | Params) -> Sequence[str]:
    """Names of parameters given by name, or as the plant's named tuple."""
    return tuple(values) if isinstance(values, Mapping) else values._fields


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
        raise ValueError(
            f"prior of {name!r} needs finite numbers, SD and a lognormal MEDIAN above 0, and "
            f"LOWEST below HIGHEST: got {text!r}"
        )
    if kind == "lognormal" and not plant.definition.parameter(name).positive:
        raise ValueError(f"{name!r} may be negative and has no lognormal prior; give a normal one")
    return kind, first, second


def run_with_estimate(path: Path) -> Path:
    """The run folder of an identification: that of a campaign is inside its folder."""
    inside = path / "estimate"
    return inside if (path / "campaign.json").is_file() and inside.is_dir() else path


def prior_of_run(plant: AbstractPlant, given: Identification | str | Path) -> Prior:
    """A prior from a result, a run folder, or a file with mean and covariance; else ValueError."""
    if isinstance(given, Identification):
        return _from_run(plant, given.summary(), "the result")
    path = run_with_estimate(Path(given))
    if path.is_dir():
        if not (path / "estimate.json").is_file():
            raise ValueError(f"{path} has no estimate: {_ADVICE}")
        return _from_run(plant, EstimateSummary.read(path / "estimate.json", _ADVICE), str(path))
    if not path.exists():
        raise ValueError(f"prior {str(path)!r} is no run folder and no file; it may be {_ALLOWED}")
    try:
        data = read_json(path, "mean", "covariance")
    except ValueError:
        raise ValueError(f"{path} is no file with a mean and a covariance: {_ADVICE}") from None
    if not isinstance(data["mean"], dict):
        raise ValueError(f"{path}: mean must be an object by parameter: got {data['mean']!r}")
    _require_names(plant, list(data["mean"]))
    try:
        return Prior.normal(list(data["mean"]), list(data["mean"].values()), data["covariance"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None


def _from_run(plant: AbstractPlant, result: EstimateSummary, where: str) -> Prior:
    """The estimates of an earlier run that this plant has; positive ones by their logarithm."""
    own = names_of(plant.definition.parameters)
    index = [i for i, (n, p) in enumerate(result.params.items()) if n in own and not p.held]
    if not (index and result.is_usable):
        raise ValueError(f"{where} has no estimated parameter of plant {plant.definition.name!r}")
    names = [list(result.params)[i] for i in index]
    values = np.array([result.params[name].estimate for name in names])
    is_log = [plant.definition.parameter(name).positive for name in names]
    if np.any(values[is_log] <= 0):
        raise ValueError(f"{where} has a parameter below 0 that is positive in this plant")
    size = np.where(is_log, values, 1.0)
    relative = np.array([result.params[name].std_error for name in names]) / size
    mean = np.where(is_log, np.log(np.where(is_log, values, 1.0)), values)
    correlation = np.array(result.correlation, float)[np.ix_(index, index)]
    try:
        return Prior.normal(names, mean, correlation * np.outer(relative, relative), is_log)
    except ValueError as error:
        raise ValueError(f"{where} is no prior: {error}") from None
