"""Records as experiments: their parts without gaps, sampling times, inputs between samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..description import names_of
from ..plant import AbstractPlant, Params
from ..plant.extension import HOLDS
from ..record import Record, is_even, require_even, unbroken
from .contract import (
    AbstractEstimator,
    Experiments,
    stack_experiments,
)


def starts_at(record: Record, plant: AbstractPlant) -> bool:
    """Whether the sidecar says that the record starts at this plant's initial state."""
    states = record.metadata.get("plant", {}).get("states", [])
    initial = [s.get("initial") for s in states]
    return record.starts_at_initial_state and initial == np.asarray(plant.initial_state).tolist()


def linear_inputs(
    plant: AbstractPlant, hold_input: str | Mapping[str, str]
) -> Bool[np.ndarray, " input"]:
    """Which inputs are linear between samples; ValueError for another word or name."""
    names = names_of(plant.definition.inputs)
    by_name = hold_input if isinstance(hold_input, Mapping) else dict.fromkeys(names, hold_input)
    for name, word in by_name.items():
        if name not in names:
            raise ValueError(
                f"plant {plant.definition.name!r} has no input {name!r} to hold; it has "
                f"{', '.join(names)}"
            )
        if word not in HOLDS:
            raise ValueError(f"hold_input of {name!r} must be constant or linear: got {word!r}")
    return np.array([by_name.get(name) == "linear" for name in names], bool)


def require_complete(
    estimator: AbstractEstimator, records: Sequence[Record], linear: np.ndarray
) -> None:
    """Raises ValueError where an estimator in discrete time cannot use the records."""
    for record in records:
        require_even(record, f"{estimator.name} needs one sampling time (nls does not)")
        if not np.isfinite(record.outputs).all():
            raise ValueError(
                f"{record.source or 'the record'} has samples without a measurement; "
                f"{estimator.name} needs them all (nls does not)"
            )
    if linear.any():
        raise ValueError(
            f"{estimator.name} takes inputs as constant between samples; nls also as linear"
        )
    first = records[0]
    for record in records[1:]:
        if abs(record.dt - first.dt) > 1e-3 * first.dt:
            raise ValueError(
                f"{record.source} is sampled every {record.dt:g} s and {first.source} every "
                f"{first.dt:g} s; {estimator.name} needs one sampling time (nls does not)"
            )


def require_enough(
    plant: AbstractPlant,
    records: Sequence[Record],
    num_params: int,
    knows_state: bool,
    num_priors: int = 0,
    has_prior: bool = False,
) -> None:
    """Raises ValueError where there are not more measured values, and priors, than unknowns.

    Args:
        num_priors: how many priors count as values.
        has_prior: whether there are priors, which may not count.
    """
    where = " and ".join(record.source or "the record" for record in records)
    if any(len(record.time) < 2 for record in records):
        raise ValueError(f"{where}: a record needs at least two samples")
    values = sum(int(np.isfinite(record.outputs).sum()) for record in records)
    parts = sum(len(parts_of(record)) for record in records)
    states = 0 if knows_state and parts == len(records) else parts * len(plant.definition.states)
    if values + num_priors <= num_params + states:
        known = f"{values} measured values" + f" and {num_priors} priors" * bool(num_priors)
        counted = " (with NLS(noise='known') a normal prior of a parameter counts as a value)"
        raise ValueError(
            f"{where}: {known} for {num_params + states} unknowns ({num_params} parameters, "
            f"{states} initial states); more values than unknowns are needed{counted * has_prior}"
        )


def given_twice(records: Sequence[Record], held_out: Sequence[Record]) -> tuple[str, ...]:
    """A sentence on each record that is there twice, and each held-out one that was fitted."""
    told = []
    for i, record in enumerate([*records, *held_out]):
        twin = next((r for r in records[:i] if _is_same(r, record)), None)
        if twin is None:
            continue
        where = record.source or "a record"
        if i >= len(records):
            told.append(
                f"{where} is also a record of the estimation: its fit says nothing about new data"
            )
        else:
            same = f" (the same data as {twin.source})" * (twin.source not in ("", record.source))
            told.append(f"{where}{same} is there twice: it counts double, which narrows intervals")
    return tuple(told)


def _is_same(one: Record, other: Record) -> bool:
    """Whether two records hold the same data; a recording may begin at another time."""
    values = [(r.time - r.time[0], r.inputs, r.outputs) for r in (one, other)]
    return len(one.time) == len(other.time) and all(
        np.allclose(a, b, rtol=1e-9, atol=0, equal_nan=True) for a, b in zip(*values, strict=True)
    )


def require_short_delays(plant: AbstractPlant, begin: Params, records: Sequence[Record]) -> None:
    """Raises ValueError where the search begins with a delay that moves all inputs out."""
    delay, span = plant.delay(begin), max(float(np.ptp(record.time)) for record in records)
    names = names_of(plant.definition.inputs)
    for name, value in zip(names, () if delay is None else delay, strict=False):
        if abs(value) >= span:
            raise ValueError(
                f"the delay of input {name!r} is {float(value):g} s, and the longest record has "
                f"{span:g} s; begin with a shorter one (--start, --hold)"
            )


def parts_of(record: Record) -> list[slice]:
    """Parts without a gap in time; without inputs nothing is unknown in a gap."""
    return unbroken(record.time) if record.inputs.shape[1] else [slice(0, len(record.time))]


def sampled_as(records: Sequence[Record], plant: AbstractPlant) -> AbstractPlant:
    """The plant with the sampling time of the records.

    It is rounded, because it enters the plant's hash. Where the steps differ, the longest
    is integrated no more coarsely than in the definition.
    """
    first, own = _mean_step(records[0].time[parts_of(records[0])[0]]), float(plant.dt)
    usual = own if abs(first - own) < 1e-6 * own else float(f"{first:.6g}")
    sampled = plant.changed(dt=usual)
    if _are_even(records, usual):
        return sampled
    steps = [np.diff(r.time[part]).max() for r in records for part in parts_of(r)]
    longest = plant.changed(dt=max(steps))
    return eqx.tree_at(lambda p: p.dt, longest, sampled.dt)


def _mean_step(time: Float[np.ndarray, " sample"]) -> float:
    return float((time[-1] - time[0]) / (time.size - 1))


def _are_even(records: Sequence[Record], dt: float) -> bool:
    """Whether all parts of the records are sampled with this time."""
    parts = [record.time[part] for record in records for part in parts_of(record)]
    own = list(map(_mean_step, parts))
    return all(map(is_even, parts)) and bool(np.allclose(own, dt, rtol=1e-3, atol=0))


def experiments_of(
    plant: AbstractPlant,
    records: Sequence[Record],
    known: bool,
    linear: np.ndarray,
) -> Experiments:
    """The parts of all records without gaps, as experiments.

    They have next inputs even where all are held: one program is compiled for both.
    """
    parts = [(record, part) for record in records for part in parts_of(record)]
    inputs = [record.inputs[part] for record, part in parts]
    outputs = [record.outputs[part] for record, part in parts]
    evenly = _are_even(records, float(plant.dt))
    seen = [np.isfinite(rows) for rows in outputs]
    acting = slice(None) if plant.has_feedthrough else slice(-1)  # the last input, or not
    ends = [np.concatenate([rows[1:], rows[-1:]]) for rows in inputs]
    return stack_experiments(
        plant,
        [rows[acting] for rows in inputs],
        outputs,
        known,
        dt=None if evenly else [np.diff(record.time[part]) for record, part in parts],
        next_inputs=[
            np.where(linear, end, rows)[acting] for rows, end in zip(inputs, ends, strict=True)
        ],
        seen=None if all(rows.all() for rows in seen) else seen,
    )


def rows_of(records: Sequence[Record], spans: Sequence[tuple[int, int, int]]) -> str:
    """Rows of records in words, from their parts' samples: part, first one, one behind the last."""
    parts = [(record, part.start) for record in records for part in parts_of(record)]
    rows: dict[str, list[str]] = {}
    for index, first, stop in spans:
        record, start = parts[index]
        where = f" of {record.source or 'the record'}" if len(records) > 1 else ""
        rows.setdefault(where, []).append(f"{start + first} to {start + stop - 1}")
    return "rows " + "; ".join(f"{', '.join(own)}{where}" for where, own in rows.items())


def by_record(
    records: Sequence[Record], values: Float[np.ndarray, "experiment sample output"]
) -> list[Float[np.ndarray, "_sample output"]]:
    """Values of the parts of records, joined; NaN where no output was measured."""
    experiments, joined = iter(values), []
    for record in records:
        own = np.full(record.outputs.shape, np.nan)
        for part in parts_of(record):
            rows = part.stop - part.start
            own[part] = next(experiments)[:rows]
        joined.append(np.where(np.isfinite(record.outputs), own, np.nan))
    return joined


def finite(values: np.ndarray) -> np.ndarray:
    """The finite ones of some values."""
    return values[np.isfinite(values)]
