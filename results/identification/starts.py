"""How often identification finds plants that are far from where its search starts.

    python results/identification/starts.py [--plants N] [CASE ...]

The parameters of each plant are drawn at random: within 60 % of the nominal values, or within a
factor of three of them. Each is recorded once, with the noise of its own sensors, and identified
from the nominal values, with a known initial state. The searches run in batches; where one fails
or where the record does not tell all parameters, it is identified by `ex.identify`, which begins
elsewhere too.

A failure is a search that does not end, or an estimate of a free parameter that is more than five
standard errors and more than 1 % away from the true value. A parameter that a record does not tell
(its standard error would be above half of its value) is held at its nominal value by `identify`,
which then calls the result partly identifiable. These plants are counted beside, with the least
Cramér-Rao bound of what was held, relative to its true value.

The judged lines, 3 of 3,000 plants within a factor of three and 1 % of the others, are kept. The
one failure of 5,700 plants is no matter of the start: with the friction of a DC motor held at a
wrong value, the interval of K is too narrow.

Counts are written to starts.json after every batch, and the script goes on where it was
interrupted.
"""

import argparse
import json
import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

import excite as ex
from excite.description import names_of
from excite.estimation import NLS, Status, stack_experiments
from excite.excitation.catalogue import excitation_and_origin
from excite.files import write_json
from excite.information import cramer_rao_bound, experiment_information
from excite.information.identifiability import UNSEEN_SD
from excite.plant.catalogue import plant_named
from excite.plant.contract import params_within
from excite.record import Record
from excite.simulation import run_episode

TABLE = Path(__file__).parent / "starts.json"
STEPS, BATCH, SEED = 500, 50, 16
FAR, MUCH = 5.0, 0.01  # standard errors and part of the true value that an estimate may be off


class Case(NamedTuple):
    """Plants around a nominal one and how they are excited."""

    plant: str
    excitation: str
    spread: float | str
    plants: int

    @property
    def name(self) -> str:
        """The row of the table."""
        return f"{self.plant} {self.excitation}"


PLAYED = {
    "dc_motor": ("chirp", "prbs", "multisine"),
    "emps": ("loop-chirp", "loop-prbs", "loop-multisine"),
    "cart_pole": ("chirp", "prbs", "loop-square"),
}
CASES = [
    *(Case("aero2", played, "factor:3", 1000) for played in ("chirp", "prbs", "random")),
    *(Case(plant, played, 0.6, 300) for plant, own in PLAYED.items() for played in own),
]


class Batch(NamedTuple):
    """Records of several plants, and what the first search finds in each."""

    true: np.ndarray
    inputs: np.ndarray
    measured: np.ndarray
    values: np.ndarray
    errors: np.ndarray
    is_clear: np.ndarray


@cache
def programs(case: Case):
    """How records of a case are made, and how they are identified."""
    plant = plant_named(case.plant)
    played = excitation_and_origin(case.excitation, {}, plant)[0]

    def recorded(key):
        draw, play = jax.random.split(key)
        unit = jax.random.uniform(draw, (len(plant.nominal),), float, -1.0, 1.0)
        true = params_within(plant, case.spread, unit)
        run = run_episode(plant, true, played, STEPS, play)
        return jnp.stack(true), run.inputs, run.measured

    def fitted(inputs, measured):
        found = NLS()(plant, stack_experiments(plant, [inputs], [measured], True))
        errors = jnp.sqrt(jnp.diagonal(found.covariance))
        is_told = jnp.linalg.eigvalsh(found.information)[0] * UNSEEN_SD**2 >= 1
        return jnp.stack(found.params), errors, (found.status == Status.SUCCESSFUL) & is_told

    return jax.jit(jax.vmap(recorded)), jax.jit(jax.vmap(fitted))


def batch(case: Case, first: int, count: int = BATCH) -> Batch:
    """Some plants of a case; plant i is the same in every batch."""
    record, fit = programs(case)
    key = jax.random.fold_in(jax.random.key(SEED), CASES.index(case))
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(first, first + count))
    runs = record(keys)
    return Batch(*jax.device_get((*runs, *fit(*runs[1:]))))


def is_away(true: ArrayLike, values: ArrayLike, errors: ArrayLike) -> np.ndarray:
    """Which estimates are further from the true values than noise explains."""
    true, values, errors = map(np.asarray, (true, values, errors))
    off = np.abs(values - true)
    return ~((off <= FAR * errors) | (off <= MUCH * np.abs(true)))


def identified(case: Case, made: Batch, i: int) -> dict:
    """What `ex.identify` says of a plant of a batch."""
    plant = plant_named(case.plant)
    time = np.arange(STEPS + 1) * float(plant.dt)
    record = Record.of_episode(time, made.inputs[i], made.measured[i], {})
    try:
        found = ex.identify(record, plant, initial_state="known")
    except ValueError as refusal:
        return {"status": f"refused: {refusal}", "held": {}, "wrong": {}}
    names = names_of(plant.definition.parameters)
    true = dict(zip(names, made.true[i].tolist(), strict=True))
    params = plant.Params(*jax.device_put(list(true.values())))
    bound = cramer_rao_bound(experiment_information(plant, params, made.inputs[i]))
    wrong = {
        name: {
            "estimate_over_true": found.params[name] / true[name],
            "std_error": found.std_error[name] / true[name],
        }
        for name in names
        if name not in found.held and is_away(true[name], found.params[name], found.std_error[name])
    }
    held = {name: float(bound[names.index(name)]) for name in found.held}
    return {"status": found.status, "held": held, "wrong": wrong, "true": true}


def counted(case: Case, row: dict, plants: int) -> dict:
    """A row of the table, with one batch more."""
    first = row["plants"]
    made = batch(case, first)
    size = min(BATCH, plants - first)
    is_wrong = is_away(made.true, made.values, made.errors).any(axis=1)
    doubtful = np.flatnonzero(~made.is_clear | is_wrong)
    failures, not_told, again = list(row["failures"]), row["not_told"], row["identified_again"]
    for i in doubtful[doubtful < size]:
        found, again = identified(case, made, i), again + 1
        for name, bound in found["held"].items():
            own = not_told.setdefault(name, {"plants": 0, "least_bound": np.inf})
            own["plants"] += 1
            own["least_bound"] = min(own["least_bound"], bound)
        if found["status"] not in ("successful", "partly identifiable") or found["wrong"]:
            failures.append({"plant": first + int(i), **found})
    return {
        "plants": first + size,
        "identified_again": again,
        "not_told": not_told,
        "failures": failures,
    }


def main() -> None:
    """Counts failures, case by case."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", nargs="*", metavar="CASE", help="regular expression")
    parser.add_argument("--plants", type=int, help="of each case, default those of the table")
    asked = parser.parse_args()
    rows = json.loads(TABLE.read_text()) if TABLE.is_file() else {}
    for case in CASES:
        if asked.cases and not any(re.search(word, case.name) for word in asked.cases):
            continue
        nothing = {"plants": 0, "identified_again": 0, "not_told": {}, "failures": []}
        row = rows.get(case.name, nothing)
        plants = asked.plants or case.plants
        while row["plants"] < plants:
            row = counted(case, row, plants)
            rows[case.name] = row
            write_json(TABLE, rows)
            print(f"{case.name}: {len(row['failures'])} of {row['plants']} failed", flush=True)


if __name__ == "__main__":
    main()
