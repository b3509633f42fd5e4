"""The guard on plants that are not as declared: violations without it and with it.

    python results/guard/scenarios.py aero2 --runs 300 --out results/guard/aero2.json

Every scenario is played on simulated rigs with plants drawn from the declared uncertainty of the
policy, on the same plants and noise without and with the guard.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

import excite as ex
from excite.excitation.catalogue import excitation_and_origin
from excite.plant.catalogue import plant_from
from excite.plant.uncertainty import Uncertainty
from excite.rig.faults import Faults
from excite.rig.guard_design import guard_for
from excite.rig.simulated import (
    Hardware,
    at_interval,
    num_written,
    readings_per_sample,
    run_batch,
    usual_numbers,
)
from excite.safety import Supervision
from excite.study.falsify import trained_in


def main() -> None:
    """Plays all scenarios of one policy."""
    parser = argparse.ArgumentParser()
    parser.add_argument("policy")
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--declared", type=int, default=2000)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    policy = ex.read_policy(given.policy)
    plant = plant_from(policy.plant.name)
    spread, ranges = trained_in(policy, plant)
    play = Play(plant, given.policy, spread, ranges)
    rows = []
    for name, effects, faults in scenarios(plant):
        if given.only and name not in given.only:
            continue
        runs = given.declared if name == "as declared" else given.runs
        rows.append(play.row(name, effects, faults, runs))
        sys.stdout.write(json.dumps(rows[-1]) + "\n")
        sys.stdout.flush()
        if given.out:
            given.out.write_text(json.dumps({"policy": given.policy, "rows": rows}, indent=1))


def scenarios(plant):
    """Name, effects from the beginning, and faults as a function of a key, in order."""
    dt, duration = float(plant.dt), 500 * float(plant.dt)
    by_input = [i.name for i in plant.definition.inputs]
    scale = np.array([o.scale for o in plant.definition.outputs])

    def of(kind, value):
        return {f"{kind}_{name}": value for name in by_input}

    def at(name, **more):
        def faults(key):
            time = jax.random.uniform(key, (), float, 0.0, 0.9 * duration)
            return Faults(**{name: time}, **more)

        return faults

    constant = {
        "wrong sign": of("gain", -1.0), "gain x 0.5": of("gain", 0.5),
        "gain x 1.5": of("gain", 1.5), "gain x 2": of("gain", 2.0), "gain x 3": of("gain", 3.0),
        **{f"delay {n}": of("delay", n * dt) for n in range(1, 6)},
        "lag of 3 samples": of("lag", 3 * dt),
    }  # fmt: skip
    yield "as declared", {}, lambda key: Faults()
    for name, effects in constant.items():
        yield name, effects, lambda key: Faults()
    yield "spread 0.6", {"parameters": 0.6}, lambda key: Faults()
    yield "sensor frozen", {}, at("sensor_frozen")
    yield "sensor slow", {}, lambda key: Faults(sensor_slow=2 * dt)
    yield "sensor biased", {}, at("sensor_bias_from", sensor_bias=0.1 * scale)
    yield "actuator stuck", {}, at("actuator_stuck")
    yield "actuator dead", {}, at("actuator_dead")
    yield "sign flip", {}, at("actuator_sign")


class Play:
    """Experiments of one policy on simulated rigs, without and with its guard."""

    def __init__(self, plant, policy, spread, ranges) -> None:
        self.plant, self.spread, self.ranges = plant, spread, ranges
        self.excitation, _ = excitation_and_origin(policy, {}, plant)
        self.num_readings = readings_per_sample(plant)
        self.rules = Supervision.of(plant.description)
        self.guard = guard_for(plant, self.excitation, spread, ranges)

    def row(self, name, effects, faults, runs):
        """Of one scenario."""
        spread = effects.get("parameters", self.spread)
        more = {k: (v, v) for k, v in effects.items() if k != "parameters"}
        own = {
            k: v for k, v in self.ranges.items() if "parameters" not in effects or k != "parameters"
        }
        box = Uncertainty.of(self.plant, spread, {**own, **more})
        hardware = hardware_of(box, faults, self.num_readings, runs)
        without, guarded = (
            run_batch(hardware, self.excitation, rules, 500, self.num_readings, *filter)
            for rules, filter in (
                (self.rules, ()), (self.guard.supervision(self.rules), (self.guard,)),
            )
        )  # fmt: skip
        belief = guarded.memory
        found = np.asarray(belief.num_braked) > 0
        sample = np.asarray(belief.tripped_at)
        rules = self.guard.rules
        size = np.asarray(guarded.max_abs_output)[:, rules.watched] / rules.critical
        bad, good = np.asarray(guarded.is_violation), np.asarray(without.is_violation)
        return {
            "scenario": name,
            "runs": runs,
            "without": int(good.sum()),
            "with": int(bad.sum()),
            "new": int((bad & ~good).sum()),
            "detected": int(found.sum()),
            "tripped_by_supervisor": int(((np.asarray(guarded.trip) > 0) & ~found).sum()),
            "median_sample": float(np.median(sample[found])) if found.any() else None,
            "largest": float(np.nanmax(size)),
        }


def hardware_of(box, faults, num_readings, runs):
    """Rigs with plants drawn from a box; the leading axis is the run."""
    dt = float(box.plant.dt)

    def delay(point):
        there, params = box.at(point)
        return there.delay(params)

    count = num_written(delay, len(box.names), dt)

    def draw(key):
        point, rig, fault = jax.random.split(key, 3)
        there, params = box.at(box.draw(point))
        return Hardware(
            at_interval(there, num_readings), params, *usual_numbers(dt, {}).values(), rig,
            faults=faults(fault), num_written=count,
        )  # fmt: skip

    return eqx.filter_vmap(draw)(jax.random.split(jax.random.key(77), runs))


if __name__ == "__main__":
    main()
