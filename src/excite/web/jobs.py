"""Jobs of the bench page, run in workers: experiments, identification of files, reports.

Every function is a generator of JSON-ready events, so that the page can show the first while
the next is computed, and can stop in between. Excitations and policies are taken by their
shipped names only: a name from a browser must never become a path. Plants are shipped ones, and
files that were named where the server was started.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import shlex
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from .. import __version__
from ..description import (
    HALF_95,
    Output,
    Parameter,
    PlantDescription,
    names_of,
    unknown,
)
from ..estimation import NLS, Experiments, Status, stack_experiments
from ..estimation.catalogue import ESTIMATORS
from ..estimation.comparison import compare_plants
from ..estimation.diagnosis import half_95
from ..estimation.identify import Intervals, identify
from ..estimation.nls import Likelihood
from ..estimation.result import Fitted, Identification
from ..excitation.catalogue import EXCITATIONS, LOOP
from ..files import write_bytes
from ..information import (
    cramer_rao_bound,
    d_optimality,
    relative_size,
    require_noise,
    running_information,
)
from ..plant import AbstractPlant
from ..plant.catalogue import PLANTS, plant_named
from ..plant.extension import extended, extensions_of
from ..policy import Policy, mismatch, read_policy, shipped_policies
from ..record import column_lengths
from ..record.bags import is_bag
from ..record.figure import kept_samples
from ..record.formats import columns_in
from ..report.answer import told_of_identification, told_of_levels
from ..report.html import report_html
from ..report.results import compared_plants, judgement
from ..report.rows import EstimateSummary
from ..safety import critical_levels, is_violation, max_abs_output
from ..simulation import Experiment, Trajectory
from .events import (
    Estimate,
    ExperimentRequest,
    IdentificationRequest,
    ParameterRow,
    Preview,
    Row,
    ShownRecord,
    Traces,
)
from .events import JobEvent as Event
from .shown import shown_plant, shown_table

NUM_ESTIMATES = 20
_FIRST = 40  # samples before the first estimate
_RECORD = "record.csv"  # name of a simulated record
_MAX_POINTS = 200_000  # of a record on the page; longer ones show the extremes of each section
_MAX_PREVIEW, _FIRST_ROWS = 400, 5  # points of a column's plot, and its rows in the table
_GAP = 1.5  # steps of time over the usual one
_FEW_VALUES, _OFTEN = 10, 0.02  # values of a signal with levels; a share of samples at its end
_MAX_COLUMNS, _MAX_NAME = 500, 200  # of an uploaded file, and characters of a column's name


# ------------------------------------------------------------------------- what there is


def catalogue(plants: Mapping[str, str]) -> Iterator[Event]:
    """Plants, excitations, policies and estimators that can be chosen.

    Args:
        plants: files of plants, by the name shown; they are the last.
    """
    policies = {name: read_policy(path) for name, path in shipped_policies().items()}
    names = [*EXCITATIONS, *(LOOP + name for name in EXCITATIONS)]
    shown = {}
    for name, file in {**{name: name for name in PLANTS}, **plants}.items():
        plant = _plant(file)
        description = plant.description
        fitting = {
            n: {"num_steps": p.layout.num_steps, "claim": p.claim}
            for n, p in policies.items()
            if _fits(p, description)
        }
        effects = list(extensions_of(plant))
        shown[name] = {**shown_plant(description), "policies": fitting, "effects": effects}
    yield {
        "kind": "catalogue",
        "version": __version__,
        "plants": shown,
        "excitations": names,
        "estimators": list(ESTIMATORS),
    }


DEFAULT: ExperimentRequest = {
    "plant": "aero2", "excitation": "chirp",
    "amplitude": PLANTS["aero2"]().definition.inputs[0].amplitude,
    "noise": {}, "params": {}, "steps": 500, "seed": 0, "others": ["prbs", "aero2"],
}  # fmt: skip
"""What the page asks for, if nothing is changed."""


def warm_up() -> Iterator[Event]:
    """Compiles the default experiment, so that a worker's first run starts fast."""
    yield from episode(DEFAULT)
    with tempfile.TemporaryDirectory() as folder:
        yield from followed(DEFAULT, f"{folder}/run")


def _fits(policy: Policy, description: PlantDescription) -> bool:
    try:
        mismatch(policy, description)
    except ValueError:
        return False
    return True


# --------------------------------------------------------------------------- experiments


def _experiment(asked: ExperimentRequest, name: str) -> Experiment:
    """The requested experiment, or the same with another excitation.

    Raises:
        ValueError: for an unknown name or a value that is not allowed.
    """
    allowed = [*EXCITATIONS, *(LOOP + n for n in EXCITATIONS), *shipped_policies()]
    if name not in allowed:
        raise unknown("excitation", name, allowed)
    # An amplitude is in units of the input, that of a loop in units of the output.
    amplitude = asked["amplitude"] if name in EXCITATIONS else None
    experiment = Experiment.of(
        _plant(asked["plant"]),
        name,
        options={} if amplitude is None else {"amplitude": amplitude},
        steps=asked["steps"],
        params=asked["params"],
        noise=asked["noise"],
        seed=asked["seed"],
    )
    require_noise(experiment.plant)
    return experiment


def _plant(name: str) -> AbstractPlant:
    """A shipped plant, or one in a file that the server was started with.

    A name from a browser has no dot, so that it is never that of a file (`requests.word`).
    """
    if "." not in name and name not in PLANTS:
        raise unknown("plant", name, PLANTS)
    return plant_named(name)


def episode(asked: ExperimentRequest) -> Iterator[Event]:
    """All samples of the requested experiment."""
    own = _experiment(asked, asked["excitation"])
    run, d = own.run(), own.plant.description
    yield {
        "kind": "episode",
        "plant": shown_plant(d),
        "excitation": own.name,
        "warning": own.origin.get("warning"),
        "params": _by_name(d.parameters, own.params),
        "time": run.time.tolist(),
        "inputs": run.inputs.tolist(),
        "outputs": run.measured.tolist(),
    }


def followed(asked: ExperimentRequest, folder: str) -> Iterator[Event]:
    """Running estimates, then the result, then the comparison with two other excitations.

    The run folder of the identification is written to `folder`. It is the same as that of
    `excite simulate` followed by `excite identify`.
    """
    own, plant = _experiment(asked, asked["excitation"]), _plant(asked["plant"])
    run = own.run()
    information = running_information(own.plant, own.params, run.inputs)
    yield from _estimates(plant, own, run, information)
    row, result = _outcome(plant, own, run, information[-1])
    command = _experiment_again(asked)
    if result is not None:
        result.save(folder, command=command)
    identification = None if result is None else result.to_dict()
    yield {
        "kind": "result", "row": row, "traces": _traces(own, run, information),
        "command": command, "identification": identification,
    }  # fmt: skip
    for name in asked["others"]:
        try:
            other = _experiment(asked, name)
            its_run = other.run()
        except ValueError as error:  # the requested experiment is complete without it
            yield {"kind": "left_out", "excitation": name, "sentence": str(error)}
            continue
        its = running_information(other.plant, other.params, its_run.inputs)
        row, traces = _outcome(plant, other, its_run, its[-1])[0], _traces(other, its_run, its)
        estimates = list(_estimates(plant, other, its_run, its))
        yield {"kind": "other", "row": row, "traces": traces, "estimates": estimates}


def _estimates(
    plant: AbstractPlant, own: Experiment, run: Trajectory, information: Array
) -> Iterator[Estimate]:
    """Estimates from growing numbers of samples, the last one from all."""
    size = relative_size(own.plant, own.params)
    data = stack_experiments(plant, [run.inputs], [run.measured], True)
    free = jnp.ones(len(own.params), bool)
    counts = np.linspace(min(_FIRST, own.num_steps + 1), own.num_steps + 1, NUM_ESTIMATES)
    for count in np.unique(counts.astype(int)):
        estimate = jax.device_get(NLS()(plant, _first(data, int(count)), plant.nominal, free))
        is_good = int(estimate.status) == Status.SUCCESSFUL
        half = half_95(estimate.covariance, estimate.degrees)
        bound = HALF_95 * np.asarray(cramer_rao_bound(information[count - 2]) * size)
        parts = plant.definition.parameters
        yield {
            "kind": "estimate",
            "k": int(count) - 1,
            "estimate": _by_name(parts, estimate.params if is_good else bound * np.nan),
            "half": _by_name(parts, half if is_good else bound * np.nan),
            "bound": _by_name(parts, bound),
        }


def _experiment_again(asked: ExperimentRequest) -> str:
    """The commands that make the same run folder, one per line."""
    has_amplitude = asked["amplitude"] is not None and asked["excitation"] in EXCITATIONS
    simulate = [
        "excite", "simulate", asked["plant"], "--excitation", asked["excitation"],
        *_given("--set", {"amplitude": asked["amplitude"]} if has_amplitude else {}),
        "--steps", str(asked["steps"]), *_given("--params", asked["params"]),
        *_given("--noise", asked["noise"]), "--seed", str(asked["seed"]), "--out", _RECORD,
    ]  # fmt: skip
    identify = ["excite", "identify", _RECORD, "--plant", asked["plant"], "--out", "run"]
    return f"{shlex.join(simulate)}\n{shlex.join(identify)}"


def _identification_again(asked: IdentificationRequest) -> str:
    """The command that makes the same run folder, and that which compares the same plants."""
    plant = "+".join([asked["plant"], *asked["effects"]])
    fitted, held_out = (
        [f"./{name}" if name[0] == "-" else name for name in asked[kind]]
        for kind in ("fitted", "held_out")
    )
    options = [
        "--initial-state", asked["initial_state"], *_named("--validate", held_out),
        *_given("--validate-column", asked["validate_columns"]),
        *_given("--column", asked["columns"]),
        *_given("--scale", asked["scales"]), *_given("--unit", asked["units"]),
        *_given("--set-input", asked["set_inputs"]), *_unusual(asked, "dt", "rows", "hold_input"),
    ]  # fmt: skip
    again = [
        "excite", "identify", *fitted, "--plant", plant, "--estimator", asked["estimator"],
        *_unusual(asked, "intervals", "likelihood"),
        *_given("--start", asked["start"]), *_given("--hold", asked["hold"]),
        *itertools.chain(*(_given("--prior", {n: text}) for n, text in asked["priors"].items())),
        *_given("--uncertain", asked["uncertain"]), *options, "--out", "run",
    ]  # fmt: skip
    plants = [plant, *_others(asked)]
    compare = ["excite", "compare-plants", *plants, *_named("--record", fitted), *options]
    return "\n".join(shlex.join(words) for words in (again, compare)[: len(plants)])


_USUAL = {
    "intervals": "linear", "likelihood": "normal", "hold_input": "constant", "dt": None,
    "rows": None,
}  # fmt: skip


def _unusual(asked: IdentificationRequest, *names: str) -> list[str]:
    """The options of these arguments that are not the usual ones."""
    values = {name: asked[name] for name in names if asked[name] != _USUAL[name]}
    return [w for n, value in values.items() for w in (f"--{n.replace('_', '-')}", str(value))]


def _named(option: str, values: Iterable[str]) -> list[str]:
    """An option that is repeated."""
    return [word for value in values for word in (option, value)]


def _others(asked: IdentificationRequest) -> list[str]:
    """The plants to compare with: none of them is the plant itself, and none is there twice."""
    whole = "+".join([asked["plant"], *asked["effects"]])
    return [name for name in dict.fromkeys(asked["others"]) if name != whole]


def _given(option: str, values: Mapping[str, object]) -> list[str]:
    """An option with its assignments, numbers with all digits; empty where there are none."""
    pairs = [f"{name}={value}".replace(",", "\\,") for name, value in values.items()]
    return [option, ",".join(pairs)] if pairs else []


def _first(data: Experiments, count: int) -> Experiments:
    """The experiment after some samples, padded so that nothing is compiled again."""
    return dataclasses.replace(
        data, valid=data.valid & (jnp.arange(data.valid.shape[1])[None, :, None] < count)
    )


def _outcome(
    plant: AbstractPlant, own: Experiment, run: Trajectory, information: Array
) -> tuple[Row, Identification | None]:
    """A row of the comparison, and the identification; None where it failed."""
    d = own.plant.description
    record = dataclasses.replace(own.record(run), source=_RECORD)
    result, sentence = None, ""
    try:
        # The estimator uses the shipped plant, not the noise of this one.
        result = identify(record, plant)
    except ValueError as error:
        sentence = str(error)
    bound = np.asarray(cramer_rao_bound(information) * relative_size(own.plant, own.params))
    params: dict[str, ParameterRow] = {}
    for p, true, least in zip(d.parameters, map(float, own.params), bound, strict=True):
        found = None if result is None or p.name in result.held else result.params[p.name]
        half = None if found is None or result is None else result.ci95(p.name)[1] - found
        per = abs(true) or p.scale
        params[p.name] = {
            "estimate": found,
            "true": true,
            "error_percent": None if found is None else 100 * abs(found - true) / per,
            "half_percent": None if half is None else 100 * half / per,
            "cramer_rao_bound": float(least),
            "cramer_rao_percent": float(100 * least / per),
            "unit": p.unit,
        }
    return {
        "excitation": own.name,
        "status": result.status if result else sentence,
        "params": params,
        "is_violation": bool(is_violation(run.outputs, critical_levels(d))),
        "max_abs_output": _by_name(d.outputs, max_abs_output(run.outputs)),
        "log_det_information": float(d_optimality(information)),
    }, result


def _traces(own: Experiment, run: Trajectory, information: Array) -> Traces:
    """Signals without noise, and what is known after each sample."""
    params = zip(own.plant.definition.parameters, map(float, own.params), strict=True)
    per = np.array([abs(true) or p.scale for p, true in params])
    bounds = np.asarray(jax.vmap(cramer_rao_bound)(information))
    percent = 100 * bounds * np.asarray(relative_size(own.plant, own.params)) / per
    names = names_of(own.plant.definition.parameters)
    return {
        "inputs": run.inputs.tolist(),
        "outputs": run.outputs.tolist(),
        "log_det": jax.vmap(d_optimality)(information).tolist(),
        "bound_percent": dict(zip(names, percent.T.tolist(), strict=True)),
    }


def _by_name(parts: Sequence[Parameter | Output], values: Iterable[ArrayLike]) -> dict[str, float]:
    return {part.name: float(np.asarray(v)) for part, v in zip(parts, values, strict=True)}


# --------------------------------------------------------------------------------- files


def columns(folder: str, name: str) -> Iterator[Event]:
    """The columns of an uploaded file, and how many samples each has; no preview of a bag."""
    with contextlib.chdir(folder):  # so that messages have the file's name without its folder
        path = Path(name)
        cells = {} if is_bag(path) else columns_in(path)
        counts = {n: len(own) for n, own in cells.items()} if cells else column_lengths(path)
    previews = _previews(cells)
    if counts and not max(counts.values()):
        raise ValueError(f"{name} has names of columns, but no samples below them")
    if not counts or (cells and not any(own["index"] for own in previews.values())):
        raise ValueError(f"{name} has no column of numbers")
    if len(counts) > _MAX_COLUMNS or max(map(len, counts)) > _MAX_NAME:
        raise ValueError(
            f"{name} has {len(counts)} columns, the longest name has {max(map(len, counts))} "
            f"characters; at most {_MAX_COLUMNS} columns of {_MAX_NAME} characters are taken"
        )
    yield {"kind": "columns", "columns": counts, "previews": previews}


def _previews(columns: Mapping[str, np.ndarray]) -> dict[str, Preview]:
    """The first cells of each column, and what its plot shows."""
    found: dict[str, Preview] = {}
    for name, cells in columns.items():
        try:
            values = cells.astype(float)
        except (TypeError, ValueError):
            values = np.zeros(0)
        kept = kept_samples([values], _MAX_PREVIEW) if len(values) else np.zeros(0, int)
        first = [str(cell)[:_MAX_NAME] for cell in cells[:_FIRST_ROWS]]
        found[name] = {
            "first": first,
            "note": _noted(values),
            "index": kept.tolist(),
            "values": values[kept].tolist(),
        }
    return found


def _noted(values: np.ndarray) -> str:
    """What a column shows: its sampling and gaps, missing values, a suspected saturation.

    A signal that rests at zero is off, and not saturated.
    """
    known = values[np.isfinite(values)]
    if len(known) < 3:
        return ""
    missing = len(values) - len(known)
    notes = [f"{missing} missing"] * (missing > 0)
    steps = np.diff(known)
    if np.all(steps > 0):
        usual = float(np.median(steps))
        longer = steps[steps > _GAP * usual]
        gap = f"gaps: {len(longer)}, the longest {longer.max(initial=0.0):.4g}"
        notes += [f"steps of {usual:.4g}", gap if len(longer) else "no gaps"]
    elif not steps.any():
        notes.append("constant")
    elif len(np.unique(known)) > _FEW_VALUES:
        for end, word in ((known.max(), "largest"), (known.min(), "smallest")):
            is_at = known == end
            if end and is_at.mean() >= _OFTEN and np.any(is_at[:-2] & is_at[1:-1] & is_at[2:]):
                notes.append(f"{100 * is_at.mean():.0f} % at its {word} value: saturated?")
    return ", ".join(notes)


def identified(asked: IdentificationRequest, source: str, folder: str) -> Iterator[Event]:
    """Parameters from uploaded files; writes a run folder like `excite identify`."""
    plant = _plant(asked["plant"])
    plant = extended(plant, asked["effects"]) if asked["effects"] else plant
    files = [Path(name) for name in asked["fitted"]]
    options = {
        "initial_state": asked["initial_state"],
        "hold_input": asked["hold_input"],
        "validate": [Path(name) for name in asked["held_out"]],
        "validate_columns": asked["validate_columns"] or None,
        "columns": asked["columns"],
        "scales": asked["scales"],
        "units": asked["units"],
        "set_inputs": asked["set_inputs"] or None,
        "dt": asked["dt"],
        "rows": asked["rows"],
    }
    with contextlib.chdir(source):  # so that messages have the files' names without their folder
        result = identify(
            files,
            plant,
            asked["estimator"],
            start=asked["start"] or None,
            hold=asked["hold"],
            prior=asked["priors"] or None,
            uncertain=asked["uncertain"] or None,
            likelihood=cast(Likelihood, asked["likelihood"]),  # checked there, as the others
            intervals=cast(Intervals, asked["intervals"]),
            **options,
        )
        plants = [plant, *map(_plant, _others(asked))]
        compared = compare_plants(files, plants, **options).to_dict() if plants[1:] else None
    comparison = None if compared is None else shown_table(*compared_plants(compared))
    command = _identification_again(asked)
    result.save(folder, command=command.partition("\n")[0])
    data = result.to_dict()
    summary = EstimateSummary.of(data)
    records = [fitted.record for fitted in (*result.fitted, *result.validation)]
    told = *told_of_levels(result.plant, records), *told_of_identification(summary)
    data |= {"verdict": judgement(summary), "answer": told}
    yield {
        "kind": "identified",
        "command": command,
        "plant": shown_plant(result.plant),
        "identification": data,
        "records": [_shown(fitted) for fitted in (*result.fitted, *result.validation)],
        "comparison": comparison,
    }


def _shown(fitted: Fitted) -> ShownRecord:
    """The samples of a record that a screen can show."""
    record = fitted.record
    kept = kept_samples([*record.inputs.T, *record.outputs.T, *fitted.simulated.T], _MAX_POINTS)
    return {
        "file": record.source,
        "time": record.time[kept].tolist(),
        "inputs": record.inputs[kept].tolist(),
        "outputs": record.outputs[kept].tolist(),
        "simulated": fitted.simulated[kept].tolist(),
        "is_whole": len(kept) == len(record.time),
    }


def reported(folders: Sequence[str], out: str) -> Iterator[Event]:
    """A self-contained report of run folders, written to `out`."""
    text = report_html([Path(folder) for folder in folders])
    write_bytes(Path(out), text.encode())
    yield {"kind": "reported", "bytes": len(text)}
