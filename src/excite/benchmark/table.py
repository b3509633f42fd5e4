"""The table of a finished study, from the files of its run folder alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import scipy.stats

from ..description import names_of
from ..estimation import ARX
from ..estimation.arx import running_params
from ..excitation import PolicyExcitation
from ..plant import AbstractARXPlant, AbstractPlant
from ..policy import read_policy
from ..records import Record
from ..study import Study
from .base import (
    episode_keys,
    evaluate,
    mean_sd,
    numbers_of,
    read_json,
    seed_folder,
    study_of,
    violation_rate,
)

_UNTRAINED = {"viable_seeds": None, "seeds": None, "train_seconds": None}


def study_table(folder: Path) -> dict[str, Any]:
    """Table of a finished study: rows, and paired differences between its methods.

    Raises:
        ValueError: where the folder holds no study, or one that is not finished.
    """
    study = study_of(folder)
    seeds = {
        agent: [
            numbers_of(read_json(path, "rows", "viable"))
            for seed in range(study.seeds)
            if (path := seed_folder(folder, agent, seed) / "metrics.json").is_file()
        ]
        for agent in study.agents
    }
    _require_finished(study, folder, seeds)
    rows = numbers_of(read_json(folder / "methods.json", "rows")["rows"]) if study.methods else []
    rows = [{**row, **_UNTRAINED} for row in rows]
    for metrics in seeds.values():
        rows += [across_seeds(metrics, e) for e in range(len(study.estimators))]
    return {"rows": rows, "differences": _differences(study, rows, seeds)}


def _require_finished(
    study: Study, folder: Path, seeds: Mapping[str, list[dict[str, Any]]]
) -> None:
    missing = sum(study.seeds - len(found) for found in seeds.values())
    what = f"{missing} of {study.seeds * len(study.agents)} trainings are missing"
    if not missing and study.methods and not (folder / "methods.json").is_file():
        what = "its methods are not evaluated yet"
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
        "max_abs_output": {
            **rows[0]["max_abs_output"],
            **_mean_sd([r["max_abs_output"]["mean"] for r in viable]),
        },
        "relative_error_percent": {name: error(name) for name in names},
        "cramer_rao_percent": of_viable("cramer_rao_percent"),
        "rms_over_cramer_rao": of_viable("rms_over_cramer_rao"),
        "coverage95_percent": of_viable("coverage95_percent"),
        "beyond_6_std_errors": _total(rows, "beyond_6_std_errors"),
        "viable_seeds": len(viable),
        "seeds": len(rows),
        "train_seconds": sum(m["train_seconds"] for m in metrics),
    }


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
    return {**content, "rows": [{**_UNTRAINED, **row} for row in content["rows"]]}


def best_seeds(study: Study, folder: Path) -> dict[str, int]:
    """By agent, the seed with the highest return in the validation episodes."""

    def value(agent: str, seed: int) -> float:
        metrics = read_json(seed_folder(folder, agent, seed) / "metrics.json", "validation")
        reward = metrics["validation"]["return"]
        return -math.inf if reward is None else reward

    seeds = range(study.seeds)
    return {a: max(seeds, key=lambda seed, a=a: value(a, seed)) for a in study.agents}


def learning_curves(study: Study, folder: Path) -> dict[str, list[dict[str, np.ndarray]]]:
    """Learning curves of all seeds by agent."""

    def curve(agent: str, seed: int) -> dict[str, np.ndarray]:
        text = (seed_folder(folder, agent, seed) / "curve.csv").read_text(encoding="utf-8")
        names, *rows = (line.split(",") for line in text.splitlines())
        return dict(zip(names, np.array(rows, float).T, strict=True))

    return {a: [curve(a, seed) for seed in range(study.seeds)] for a in study.agents}


def example_episodes(study: Study, folder: Path) -> dict[str, tuple[Record, np.ndarray]]:
    """The first evaluation episode of every agent's best seed, and its running estimates.

    The estimates are those of the study's first ARX estimator, over the true parameters;
    not numbers where there is none.
    """
    plant, episodes = study.build_plant(), {}
    first = episode_keys(study)[:1]
    for agent, seed in best_seeds(study, folder).items():
        policy = read_policy(seed_folder(folder, agent, seed) / "policy.safetensors")
        excitation = PolicyExcitation.of(policy)
        batch = evaluate(plant, excitation, study.num_steps, study.spread, first)
        run, params = jax.tree.map(lambda leaf: leaf[0], (batch.trajectory, batch.params))
        record = Record.of_episode(run.time, run.inputs, run.outputs)
        estimates = _running(study, plant, run.inputs, run.measured)
        episodes[agent] = record, estimates / np.stack(params)
    return episodes


def _running(study: Study, plant: AbstractPlant, inputs: Any, measured: Any) -> np.ndarray:
    estimators = [e for e in study.build_estimators(plant).values() if isinstance(e, ARX)]
    if not (estimators and isinstance(plant, AbstractARXPlant)):
        return np.full((len(measured), len(names_of(plant.definition.parameters))), np.nan)
    return np.asarray(running_params(estimators[0], plant, inputs, measured))
