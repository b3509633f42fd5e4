"""The table of a finished study, from the files of its run folder alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from ..description import PlantDescription, names_of
from ..files import numbers_of
from ..training.gradient import GradientSettings, rank
from .folder import damaged, read_columns, read_json, seed_folder, study_of
from .spec import Study
from .statistics import mean_sd, violation_rate

_UNTRAINED = {"viable_seeds": None, "seeds": None, "train_seconds": None}


def study_table(folder: Path) -> dict[str, Any]:
    """Table of a finished study: rows, and paired differences between its methods.

    Raises:
        ValueError: where the folder holds no study, or one that is not finished.
    """
    study = study_of(folder)
    seeds = {
        agent: [
            _metrics(study, folder, agent, seed)
            for seed in range(study.seeds)
            if (seed_folder(folder, agent, seed) / "metrics.json").is_file()
        ]
        for agent in study.agents
    }
    _require_finished(study, folder, seeds)
    rows = []
    if study.methods:
        params = _params(folder)
        shapes = [_row_shape(params, m, e) for m in study.methods for e in study.estimators]
        rows = _read(folder / "methods.json", {"rows": shapes})["rows"]
        rows = [{**row, **_UNTRAINED} for row in rows]
    for metrics in seeds.values():
        rows += [across_seeds(metrics, e) for e in range(len(study.estimators))]
    if study.clairvoyant is not None:
        rows = _with_efficiency(study, folder, rows)
    return {"rows": rows, "differences": _differences(study, rows, seeds)}


def _with_efficiency(
    study: Study, folder: Path, rows: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """The rows and the clairvoyant signals' own, each with its D-efficiency.

    exp((log det - log det of the clairvoyant) / number of parameters), both of the same
    plants: how much of the information a parameter that can be had (A. Atkinson, A. Donev,
    R. Tobias, Optimum Experimental Designs, 2007).
    """
    params = _params(folder)
    shapes = [_row_shape(params, str, e) for e in study.estimators]
    shapes = [{**shape, "log_det_of_clairvoyant_plants": _NUMBER} for shape in shapes]
    best = _read(folder / "clairvoyant.json", {"rows": shapes})["rows"]
    reference = best[0]["log_det_of_clairvoyant_plants"]

    def efficiency(row: Mapping[str, Any]) -> float:
        own = row.get("log_det_of_clairvoyant_plants", math.nan)  # none where no seed is viable
        return math.exp((own - reference) / len(params))

    rows = [*rows, *({**row, **_UNTRAINED} for row in best)]
    return [{**row, "d_efficiency": efficiency(row)} for row in rows]


_NUMBER = int | float
_NUMBERS: dict[str, Any] = {"mean": _NUMBER, "sd": _NUMBER}


def _params(folder: Path) -> tuple[str, ...]:
    """Names of the parameters of the run folder's plant."""
    plant = read_json(folder / "run.json", "plant")["plant"]
    try:
        return names_of(PlantDescription.from_dict(plant).parameters)
    except (ValueError, TypeError, AttributeError):
        raise damaged(folder / "run.json") from None


def _row_shape(
    params: Sequence[str], method: Any = str, estimator: Any = str, is_agents: bool = False
) -> dict[str, Any]:
    """What a row has; one of a whole agent has more than those of its seeds."""
    error = {**_NUMBERS, "median": _NUMBER, "rms": _NUMBER}
    trained: dict[str, Any] = {}
    if is_agents:
        error["all_seeds"] = _NUMBERS
        trained = {"seeds": int, "viable_seeds": int, "train_seconds": _NUMBER}
    counts = ("evaluations", "failed", "violations", "beyond_6_std_errors")
    numbers = ("cramer_rao_percent", "rms_over_cramer_rao", "coverage95_percent")
    return {
        "method": method,
        "estimator": estimator,
        **dict.fromkeys(counts, int),
        "failures": dict,
        "violation_rate": {"ci95": [_NUMBER, _NUMBER]},
        "max_abs_output": {"output": str, "unit": str, **_NUMBERS},
        "relative_error_percent": dict.fromkeys(params, error),
        **dict.fromkeys(numbers, dict.fromkeys(params, _NUMBER)),
        **trained,
    }


def _fits(value: Any, shape: Any) -> bool:
    """Whether a value has the keys, lengths and types of `shape`, and the words in it."""
    if isinstance(shape, dict):
        return isinstance(value, dict) and all(
            key in value and _fits(value[key], part) for key, part in shape.items()
        )
    if isinstance(shape, list):
        return (
            isinstance(value, list) and len(value) == len(shape) and all(map(_fits, value, shape))
        )
    return value == shape if isinstance(shape, str) else isinstance(value, shape)


def _read(path: Path, shape: Mapping[str, Any]) -> dict[str, Any]:
    """Content of a file of a run folder, numbers that do not exist included."""
    content = numbers_of(read_json(path))
    if not _fits(content, shape):
        raise damaged(path)
    return content


def _metrics(study: Study, folder: Path, agent: str, seed: int) -> dict[str, Any]:
    params = _params(folder)
    shape = {
        "rows": [_row_shape(params, agent, estimator) for estimator in study.estimators],
        "viable": bool,
        "train_seconds": _NUMBER,
        "validation": {"return": _NUMBER},
    }
    return _read(seed_folder(folder, agent, seed) / "metrics.json", shape)


def _require_finished(
    study: Study, folder: Path, seeds: Mapping[str, list[dict[str, Any]]]
) -> None:
    missing = sum(study.seeds - len(found) for found in seeds.values())
    what = f"{missing} of {study.seeds * len(study.agents)} trainings are missing"
    if not missing and study.methods and not (folder / "methods.json").is_file():
        what = "its methods are not evaluated yet"
    elif not missing and study.clairvoyant and not (folder / "clairvoyant.json").is_file():
        what = "its clairvoyant signals are not designed yet"
    elif not missing:
        return
    raise ValueError(
        f"{folder}: the study is not finished, {what}; 'excite study run' goes on with it"
    )


def across_seeds(metrics: list[dict[str, Any]], estimator: int) -> dict[str, Any]:
    """One row of an agent: means over its viable seeds, counts over all of them.

    The seed is the unit of replication: standard deviations are those between the seeds'
    own means. A seed none of whose estimates succeeded has no mean, and is left out of it;
    where no seed is viable, there are no means.
    """
    rows = [m["rows"][estimator] for m in metrics]
    viable = [row for m, row in zip(metrics, rows, strict=True) if m["viable"]]
    evaluations, violations = _total(rows, "evaluations"), _total(rows, "violations")
    names = list(rows[0]["relative_error_percent"])

    def of_viable(key: str) -> dict[str, Any]:
        return {n: _mean_sd([r[key][n] for r in viable])["mean"] for n in names}

    def error(name: str) -> dict[str, Any]:
        means = [r["relative_error_percent"][name]["mean"] for r in rows]
        own = [r["relative_error_percent"][name] for r in viable]
        finite = [e["mean"] for e in own if not math.isnan(e["mean"])]
        return {
            **_mean_sd([e["mean"] for e in own]),
            "median": float(np.median(finite)) if finite else math.nan,
            "rms": math.sqrt(_mean_sd([e["rms"] ** 2 for e in own])["mean"]),
            "all_seeds": _mean_sd(means),
        }

    return {
        **{key: rows[0][key] for key in ("method", "estimator")},
        "evaluations": evaluations,
        "failed": _total(rows, "failed"),
        "failures": _sums([r["failures"] for r in rows]),
        "violations": violations,
        "violation_rate": violation_rate(violations, evaluations),
        **({"on_rig": _sums([r["on_rig"] for r in rows])} if "on_rig" in rows[0] else {}),
        "max_abs_output": {
            **rows[0]["max_abs_output"],
            **_mean_sd([r["max_abs_output"]["mean"] for r in viable]),
        },
        **_means(rows, viable, "log_det"),
        **_mean_lengths(viable),
        "relative_error_percent": {name: error(name) for name in names},
        "cramer_rao_percent": of_viable("cramer_rao_percent"),
        "rms_over_cramer_rao": of_viable("rms_over_cramer_rao"),
        "coverage95_percent": of_viable("coverage95_percent"),
        "beyond_6_std_errors": _total(rows, "beyond_6_std_errors"),
        "viable_seeds": len(viable),
        "seeds": len(rows),
        "train_seconds": sum(m["train_seconds"] for m in metrics),
    }


def _means(
    rows: list[dict[str, Any]], viable: list[dict[str, Any]], prefix: str
) -> dict[str, float]:
    """Means of numbers that rows of an older version do not have; none where one lacks them."""
    keys = [key for key in rows[0] if key.startswith(prefix) and all(key in r for r in rows)]
    return {key: _mean_sd([r[key] for r in viable])["mean"] for key in keys}


def _mean_lengths(rows: list[dict[str, Any]]) -> dict[str, Any]:
    own = [row["bound_by_length"] for row in rows if "bound_by_length" in row]
    if not own:
        return {}
    percent = {
        name: np.mean([o["cramer_rao_percent"][name] for o in own], axis=0).tolist()
        for name in own[0]["cramer_rao_percent"]
    }
    return {"bound_by_length": {"num_steps": own[0]["num_steps"], "cramer_rao_percent": percent}}


def _total(rows: list[dict[str, Any]], key: str) -> int:
    return sum(row[key] for row in rows)


def _sums(counts: list[dict[str, int]]) -> dict[str, int]:
    names = sorted({name for c in counts for name in c})
    return {name: sum(c.get(name, 0) for c in counts) for name in names}


def _mean_sd(values: list[float]) -> dict[str, float]:
    """Mean and standard deviation of the numbers among the values."""
    return mean_sd(np.array([v for v in values if not math.isnan(v)]))


def _differences(
    study: Study, rows: list[dict[str, Any]], seeds: Mapping[str, list[dict[str, Any]]]
) -> list[dict[str, Any]]:
    """Mean error of every agent minus that of every other method, with 95 % intervals.

    Plants and noise are common to all methods. The difference is that of the mean errors,
    seed by seed (a method that is not trained is the same for every seed), over the seeds
    that are viable and have an estimate in both; the interval is Student's over the seeds.
    """
    differences = []
    methods, params = [*study.methods, *study.agents], list(rows[0]["relative_error_percent"])
    for i, estimator in enumerate(study.estimators):
        means: dict[str, list[dict[str, Any]]] = {
            agent: [m["rows"][i]["relative_error_percent"] if m["viable"] else {} for m in found]
            for agent, found in seeds.items()
        }
        for row in rows:
            if row["estimator"] == estimator and row["method"] in study.methods:
                means[row["method"]] = [row["relative_error_percent"]] * study.seeds
        for agent in study.agents:
            for other in methods[: methods.index(agent)]:
                pair = {"method": agent, "minus": other, "estimator": estimator}
                parts = zip(means[agent], means[other], strict=True)
                differences.append({**pair, **_paired(list(parts), params)})
    return differences


def _paired(pairs: list[tuple[dict[str, Any], dict[str, Any]]], names: list[str]) -> dict[str, Any]:
    result = {}
    for name in names:
        both = [(a[name]["mean"], b[name]["mean"]) for a, b in pairs if name in a and name in b]
        gaps = [gap for a, b in both if not math.isnan(gap := a - b)]
        summary, count = _mean_sd(gaps), len(gaps)
        quantile = scipy.stats.t.ppf(0.975, count - 1) if count > 1 else math.nan
        half = quantile * summary["sd"] / math.sqrt(max(count, 1))
        mean = summary["mean"]
        result[name] = {"mean": mean, "ci95": (mean - half, mean + half), "seeds": count}
    return {"relative_error_percent": result}


def finished_table(folder: Path) -> dict[str, Any]:
    """The table as it was written when the study was finished.

    Raises:
        ValueError: where there is none, and why.
    """
    path = folder / "table.json"
    if not path.is_file():
        study_table(folder)  # says what is missing
        raise ValueError(f"{folder}: the table was not written; 'excite study run' writes it")
    content = read_json(path, "rows")
    try:
        params = list(content["rows"][0]["relative_error_percent"])
        is_agents = [row.get("seeds") is not None for row in content["rows"]]
    except (AttributeError, LookupError, TypeError):
        raise damaged(path) from None
    shapes = [_row_shape(params, is_agents=is_agent) for is_agent in is_agents]
    if not _fits(numbers_of(content["rows"]), shapes):
        raise damaged(path)
    return {**content, "rows": [{**_UNTRAINED, **row} for row in content["rows"]]}


def best_seeds(study: Study, folder: Path) -> dict[str, int]:
    """By agent, the seed that was worth most in the validation episodes.

    By the objective among those that are safe enough where training tells it, else by the
    return, which counts safety.
    """

    def value(agent: str, seed: int) -> tuple[float, float]:
        look, training = (
            _metrics(study, folder, agent, seed)["validation"],
            study.agent(agent).training,
        )
        if isinstance(training, GradientSettings) and "worth" in look:
            return rank(training, look)
        return 0.0, -math.inf if math.isnan(look["return"]) else look["return"]

    seeds = range(study.seeds)
    return {a: max(seeds, key=lambda seed, a=a: value(a, seed)) for a in study.agents}


def learning_curves(study: Study, folder: Path) -> dict[str, list[dict[str, np.ndarray]]]:
    """Learning curves of all seeds by agent."""
    names = {"steps", "violation_rate", *(f"relative_error_{p}" for p in _params(folder))}
    seeds, curves = range(study.seeds), {}
    for agent in study.agents:
        paths = [seed_folder(folder, agent, seed) / "curve.csv" for seed in seeds]
        curves[agent] = [read_columns(path, names) for path in paths]
        lengths = [len(curve["steps"]) for curve in curves[agent]]
        if min(lengths) < max(lengths):  # every seed is looked at as often
            raise damaged(paths[lengths.index(min(lengths))])
    return curves
