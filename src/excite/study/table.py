"""The table of a finished study, from the files of its run folder alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import scipy.stats

from ..description import PlantDescription, names_of
from ..policy import read_policy, shown_nearness
from ..report.rows import (
    BoundByLength,
    CountsBySeed,
    Difference,
    ErrorStatistics,
    ExpectedGain,
    Gap,
    LargestOutput,
    MeanSd,
    Nats,
    RigCounts,
    Row,
    Rows,
    SeedMetrics,
)
from ..report.study_table import StudyTable
from ..training.gradient import GradientSettings, rank
from .folder import advice, damaged, read_columns, read_json, seed_folder, study_of
from .methods import facts
from .spec import Study
from .statistics import mean_sd, violation_rate

_UNTRAINED = {"viable_seeds": None, "seeds": None, "train_seconds": None}


def study_table(folder: Path) -> StudyTable:
    """Table of a finished study: rows, and paired differences between its methods.

    Raises:
        ValueError: where the folder holds no study, or one that is not finished.
    """
    study = study_of(folder)
    params = _params(folder)
    seeds = {
        agent: [
            _metrics(study, folder, agent, seed)
            for seed in range(study.seeds)
            if (seed_folder(folder, agent, seed) / "metrics.json").is_file()
        ]
        for agent in study.agents
    }
    _require_finished(study, folder, seeds)
    rows: list[Row] = []
    untrained = _UNTRAINED if study.agents else {}
    if study.methods:
        names = [(m, e) for m in study.methods for e in study.estimators]
        found = _rows(folder / "methods.json", names, params)
        rows += [row.model_copy(update=untrained) for row in found]
    for agent, metrics in seeds.items():
        counts = _counts(study, folder, agent)
        rows += [across_seeds(metrics, e, counts) for e in range(len(study.estimators))]
    if study.clairvoyant is not None:
        rows = _with_efficiency(study, folder, rows)
    table = StudyTable(rows=tuple(rows), study=facts(study))
    if not study.agents:
        return table
    return table.model_copy(update={"differences": _differences(study, rows, seeds)})


def _with_efficiency(study: Study, folder: Path, rows: Sequence[Row]) -> list[Row]:
    """The rows and those of the clairvoyant signals, each with its D-efficiency.

    exp((log det - log det of the clairvoyant) / number of parameters), both of the same
    plants (A. Atkinson, A. Donev, R. Tobias, Optimum Experimental Designs, 2007).
    """
    path, params = folder / "clairvoyant.json", _params(folder)
    best = _rows(path, [("clairvoyant", e) for e in study.estimators], params)
    reference = best[0].log_det_of_clairvoyant_plants
    if reference is None:
        raise damaged(path)

    def efficiency(row: Row) -> float:
        found = row.log_det_of_clairvoyant_plants
        # There is none where no seed is viable.
        return math.nan if found is None else math.exp((found - reference) / len(params))

    untrained = _UNTRAINED if study.agents else {}
    rows = [*rows, *(row.model_copy(update=untrained) for row in best)]
    return [row.model_copy(update={"d_efficiency": efficiency(row)}) for row in rows]


def _params(folder: Path) -> tuple[str, ...]:
    """Names of the parameters of the run folder's plant."""
    plant = read_json(folder / "run.json", "plant")["plant"]
    try:
        return names_of(PlantDescription.from_dict(plant).parameters)
    except (ValueError, TypeError, AttributeError):
        raise damaged(folder / "run.json") from None


def _rows(path: Path, names: Sequence[tuple[str, str]], params: Sequence[str]) -> Sequence[Row]:
    rows = Rows.read(path, advice(path)).rows
    _require_rows(path, rows, names, params)
    return rows


def _require_rows(
    path: Path, rows: Iterable[Row], names: Sequence[tuple[str, str]], params: Sequence[str]
) -> None:
    """Raises ValueError where rows are of other methods, estimators or parameters."""
    found = [(row.method, row.estimator, *row.parameters) for row in rows]
    if found != [(*pair, *params) for pair in names]:
        raise damaged(path)


def _metrics(study: Study, folder: Path, agent: str, seed: int) -> SeedMetrics:
    path = seed_folder(folder, agent, seed) / "metrics.json"
    metrics = SeedMetrics.read(path, advice(path))
    _require_rows(path, metrics.rows, [(agent, e) for e in study.estimators], _params(folder))
    if "return" not in metrics.validation:
        raise damaged(path)
    return metrics


def _counts(study: Study, folder: Path, agent: str) -> CountsBySeed | None:
    """Violations by seed on plants of their own; None where the study has none."""
    if study.safety_episodes is None:
        return None
    paths = [seed_folder(folder, agent, seed) / "safety.json" for seed in range(study.seeds)]
    counts = [CountsBySeed.read(path, advice(path)) for path in paths]
    for path, count in zip(paths, counts, strict=True):
        if (count.evaluations, len(count.violations)) != (study.safety_episodes, 1):
            raise damaged(path)
    return CountsBySeed(
        evaluations=study.safety_episodes,
        violations=tuple(count.violations[0] for count in counts),
        own_plants=True,
    )


def _require_finished(
    study: Study, folder: Path, seeds: Mapping[str, Sequence[SeedMetrics]]
) -> None:
    missing = sum(study.seeds - len(found) for found in seeds.values())
    what = f"{missing} of {study.seeds * len(study.agents)} trainings are missing"
    if not missing and study.methods and not (folder / "methods.json").is_file():
        what = "its methods are not evaluated yet"
    elif (
        not missing
        and study.safety_episodes
        and not all(
            (seed_folder(folder, agent, seed) / "safety.json").is_file()
            for agent in study.agents
            for seed in range(study.seeds)
        )
    ):
        what = "its violations by seed are not counted yet"
    elif not missing and study.clairvoyant and not (folder / "clairvoyant.json").is_file():
        what = "its clairvoyant signals are not designed yet"
    elif not missing:
        return
    raise ValueError(
        f"{folder}: the study is not finished, {what}; rerun 'excite study run' to resume"
    )


def across_seeds(
    metrics: Sequence[SeedMetrics], estimator: int, counts: CountsBySeed | None = None
) -> Row:
    """One row of an agent: means over its viable seeds, counts over all of them.

    The seed is the unit of replication: standard deviations are those between the means of
    the seeds. A seed without a successful estimate has no mean and is left out. Without
    viable seeds there are no means.

    Args:
        metrics: of every seed.
        estimator: its place in the study.
        counts: of violations on plants of the seeds' own, where they were counted.
    """
    rows = [m.rows[estimator] for m in metrics]
    viable = [row for m, row in zip(metrics, rows, strict=True) if m.viable]
    first, names = rows[0], rows[0].parameters
    evaluations, violations = sum(r.evaluations for r in rows), sum(r.violations for r in rows)
    largest = _mean_sd([r.max_abs_output.mean for r in viable])
    if counts is None and len(rows) > 1:
        by_seed = tuple(r.violations for r in rows)
        counts = CountsBySeed(evaluations=first.evaluations, violations=by_seed, own_plants=False)

    def error(name: str) -> ErrorStatistics:
        errors = [r.relative_error_percent[name] for r in viable]
        means = _mean_sd([e.mean for e in errors])
        finite = [e.mean for e in errors if not math.isnan(e.mean)]
        return ErrorStatistics(
            mean=means.mean,
            sd=means.sd,
            median=float(np.median(finite)) if finite else math.nan,
            rms=math.sqrt(_mean([e.rms**2 for e in errors])),
            all_seeds=_mean_sd([r.relative_error_percent[name].mean for r in rows]),
        )

    row = Row(
        method=first.method,
        estimator=first.estimator,
        evaluations=evaluations,
        failed=sum(r.failed for r in rows),
        failures=_sums(r.failures for r in rows),
        violations=violations,
        violation_rate=violation_rate(violations, evaluations),
        max_abs_output=LargestOutput(
            output=first.max_abs_output.output,
            unit=first.max_abs_output.unit,
            mean=largest.mean,
            sd=largest.sd,
        ),
        log_det_information=_mean([r.log_det_information for r in viable]),
        log_det_information_sd=_mean([r.log_det_information_sd for r in viable]),
        relative_error_percent={name: error(name) for name in names},
        cramer_rao_percent={n: _mean([r.cramer_rao_percent[n] for r in viable]) for n in names},
        rms_over_cramer_rao={n: _mean([r.rms_over_cramer_rao[n] for r in viable]) for n in names},
        coverage95_percent={n: _mean([r.coverage95_percent[n] for r in viable]) for n in names},
        beyond_6_std_errors=sum(r.beyond_6_std_errors for r in rows),
        viable_seeds=len(viable),
        seeds=len(rows),
        train_seconds=sum(m.train_seconds for m in metrics),
    )
    if counts is not None:
        row = row.model_copy(update={"by_seed": counts})
    return row.model_copy(update=_where_asked_for(rows, viable))


def _where_asked_for(
    rows: Sequence[Row], viable: Sequence[Row]
) -> dict[str, RigCounts | BoundByLength | ExpectedGain | float]:
    """Entries of a row that only some studies have."""
    found: dict[str, RigCounts | BoundByLength | ExpectedGain | float] = {}
    counts = [row.on_rig.model_dump(exclude_unset=True) for row in rows if row.on_rig is not None]
    if counts:
        found["on_rig"] = RigCounts(**_sums(counts))
    log_dets = [row.log_det_of_clairvoyant_plants for row in rows]
    if None not in log_dets:
        of_viable = [row.log_det_of_clairvoyant_plants for row in viable]
        found["log_det_of_clairvoyant_plants"] = _mean([v for v in of_viable if v is not None])
    bounds = [row.bound_by_length for row in viable if row.bound_by_length is not None]
    if bounds:
        percent = {
            name: tuple(np.mean([b.cramer_rao_percent[name] for b in bounds], axis=0).tolist())
            for name in bounds[0].cramer_rao_percent
        }
        lengths = bounds[0].num_steps
        found["bound_by_length"] = BoundByLength(num_steps=lengths, cramer_rao_percent=percent)
    gains = [row.expected_gain for row in viable if row.expected_gain is not None]
    if gains:
        told = dict.fromkeys(text for gain in gains for text in gain.warnings)
        bounds_of = {
            name: _mean_of_seeds([getattr(gain, name) for gain in gains])
            for name in ("lower", "upper")
        }
        found["expected_gain"] = gains[0].model_copy(update={**bounds_of, "warnings": tuple(told)})
    return found


def _mean_of_seeds(bounds: Sequence[Nats]) -> Nats:
    """Mean of a bound over seeds, which share their plants and differ in their policies."""
    of_plants = _mean([bound.std_error**2 for bound in bounds])
    means = np.array([bound.mean for bound in bounds])
    of_seeds = float(np.var(means, ddof=1)) / len(means) if len(means) > 1 else 0.0
    return Nats(mean=float(np.mean(means)), std_error=math.sqrt(of_plants + of_seeds))


def _sums(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    every = list(counts)
    names = sorted({name for count in every for name in count})
    return {name: sum(count.get(name, 0) for count in every) for name in names}


def _mean_sd(values: Sequence[float]) -> MeanSd:
    """Mean and standard deviation of the numbers among the values."""
    return mean_sd(np.array([v for v in values if not math.isnan(v)]))


def _mean(values: Sequence[float]) -> float:
    return _mean_sd(values).mean


def _differences(
    study: Study, rows: Sequence[Row], seeds: Mapping[str, Sequence[SeedMetrics]]
) -> tuple[Difference, ...]:
    """Mean error of every agent minus that of every other method, with 95 % intervals.

    Plants and noise are common to all methods. The difference is that of the mean errors,
    seed by seed (a method that is not trained is the same for every seed), over the seeds
    that are viable and have an estimate in both; the interval is Student's over the seeds.
    """
    differences = []
    methods, params = [*study.methods, *study.agents], rows[0].parameters
    for i, estimator in enumerate(study.estimators):
        by_seed: dict[str, list[Row | None]] = {
            agent: [m.rows[i] if m.viable else None for m in found]
            for agent, found in seeds.items()
        }
        for row in rows:
            if row.estimator == estimator and row.method in study.methods:
                by_seed[row.method] = [row] * study.seeds
        for agent in study.agents:
            for other in methods[: methods.index(agent)]:
                pairs = list(zip(by_seed[agent], by_seed[other], strict=True))
                gaps = {name: _gap(pairs, name) for name in params}
                differences.append(
                    Difference(
                        method=agent,
                        minus=other,
                        estimator=estimator,
                        relative_error_percent=gaps,
                    )
                )
    return tuple(differences)


def _gap(pairs: Sequence[tuple[Row | None, Row | None]], name: str) -> Gap:
    gaps = [
        a.relative_error_percent[name].mean - b.relative_error_percent[name].mean
        for a, b in pairs
        if a is not None and b is not None
    ]
    known = [gap for gap in gaps if not math.isnan(gap)]
    size, count = mean_sd(np.array(known)), len(known)
    quantile = float(scipy.stats.t.ppf(0.975, count - 1)) if count > 1 else math.nan
    half = quantile * size.sd / math.sqrt(max(count, 1))
    return Gap(mean=size.mean, ci95=(size.mean - half, size.mean + half), seeds=count)


def finished_table(folder: Path) -> StudyTable:
    """The table as it was written when the study was finished.

    Raises:
        ValueError: where there is none, and why.
    """
    study, path = facts(study_of(folder)), folder / "table.json"
    if not path.is_file():
        study_table(folder)  # reports what is missing
        raise ValueError(f"{folder}: the table is missing; rerun 'excite study run' to write it")
    return StudyTable.in_folder(folder, study, advice(path))


def best_seeds(study: Study, folder: Path) -> dict[str, int]:
    """By agent, the best seed in the validation episodes.

    By the objective among the seeds that are safe enough, if the training reports it; else
    by the return, which includes safety.
    """

    def value(agent: str, seed: int) -> tuple[float, float]:
        look = _metrics(study, folder, agent, seed).validation
        training = study.agent(agent).training
        if isinstance(training, GradientSettings) and "worth" in look:
            return rank(training, look)
        return 0.0, -math.inf if math.isnan(look["return"]) else look["return"]

    seeds = range(study.seeds)
    return {a: max(seeds, key=lambda seed, a=a: value(a, seed)) for a in study.agents}


def too_near(study: Study, folder: Path) -> list[str]:
    """A sentence for every best policy with which a search came too near to a critical level."""
    sentences = []
    for agent, seed in best_seeds(study, folder).items():
        found = read_policy(seed_folder(folder, agent, seed) / "policy.safetensors").certificate
        if found is None:
            continue
        sizes = [found["nearness"], found["noise_nearness"]]  # None for infinity
        largest = None if None in sizes else max(sizes)
        allowed = getattr(study.agent(agent).training, "allowed_nearness", 1.0)
        if largest is None or largest > allowed:
            sentences.append(
                f"{agent} seed {seed}: a search in the declared uncertainty found "
                f"{shown_nearness(largest)} of the critical level, and {allowed:g} is allowed: "
                "more updates or a smaller uncertainty may help"
            )
    return sentences


def learning_curves(study: Study, folder: Path) -> dict[str, list[dict[str, np.ndarray]]]:
    """Learning curves of all seeds by agent."""
    names = {"steps", "violation_rate", *(f"relative_error_{p}" for p in _params(folder))}
    seeds, curves = range(study.seeds), {}
    for agent in study.agents:
        paths = [seed_folder(folder, agent, seed) / "curve.csv" for seed in seeds]
        curves[agent] = [read_columns(path, names) for path in paths]
        lengths = [len(curve["steps"]) for curve in curves[agent]]
        if min(lengths) < max(lengths):  # all seeds have the same number of validations
            raise damaged(paths[lengths.index(min(lengths))])
    return curves
