"""The guard on plants that are not as declared: violations without it, with it, and at best.

    python results/guard/scenarios.py aero2 --declared 2000 --out results/guard/aero2.json

Every scenario is played on simulated rigs with plants drawn from the declared uncertainty of the
policy, on the same plants and noise without and with the guard of the policy's file. What follows
the last sample counts, too: the free motion without a guard, the brake with it. Where
something breaks in mid-run, an oracle is played too: it knows the true state and the fault, and
brakes at the first sample after the fault. What it leaves is what braking at once would leave.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import excite as ex
from excite.excitation.catalogue import excitation_and_origin
from excite.plant.catalogue import plant_from
from excite.plant.uncertainty import Uncertainty
from excite.rig import guard
from excite.rig.faults import Faults
from excite.rig.filter import AbstractFilter
from excite.rig.guard import Guard, GuardedPlayer
from excite.rig.guard_design import GuardFilter, GuardModel
from excite.rig.player import PolicyPlayer
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

SEED = 77
"""Of plants, noise and faults; that of the calibration is 0."""

STEPS = 500


def main() -> None:
    """Plays all scenarios of one policy."""
    parser = argparse.ArgumentParser()
    parser.add_argument("policy", help="a shipped policy or a file, with a guard")
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--declared", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    policy = ex.read_policy(given.policy)
    play = Play(policy, given.seed)
    result = {
        "policy": given.policy, "policy_hash": policy.hash, "seed": given.seed,
        "thresholds": play.guard.rules.thresholds.tolist(), "step_ms": step_ms(policy), "rows": [],
    }  # fmt: skip
    for name, effects, faults in scenarios(play.plant):
        if given.only and name not in given.only:
            continue
        runs = given.declared if name == "as declared" else given.runs
        row = play.row(name, effects, faults, runs)
        result["rows"].append(row)
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()
        if given.out:
            given.out.write_text(json.dumps(result, indent=1) + "\n")
    sys.stdout.write("\n".join(table(result)) + "\n")


COLUMNS = ("without", "with", "new", "detected", "median_sample", "largest", "oracle",
           "more_than_oracle")  # fmt: skip


def table(result):
    """Lines of the documentation."""
    rows = [["scenario", "runs", *(name.replace("_", " ") for name in COLUMNS)]]
    rows.append(["---"] * len(rows[0]))
    for row in result["rows"]:
        cells = [row["scenario"], f"{row['runs']:,}"]
        for name in COLUMNS:
            value = row.get(name)
            digits = ".3f" if name == "largest" else "g"
            cells.append("–" if value is None else format(value, digits))
        rows.append(cells)
    return ["| " + " | ".join(cells) + " |" for cells in rows]


def scenarios(plant):
    """Name, effects from the beginning, and faults as a function of a key, in order."""
    dt, duration = float(plant.dt), STEPS * float(plant.dt)
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


BREAKING = {"actuator stuck": 0.0, "actuator dead": 0.0, "sign flip": -1.0}
"""Scenarios with an oracle, and the factor of the actuator after the fault."""


class FreeMotion(AbstractFilter):
    """The safe input after the experiment, for as long as a guard may brake."""

    rest: jax.Array
    num_more = guard.LONGEST_BRAKE

    def start(self):
        """The first sample."""
        return jnp.asarray(0)

    def __call__(self, memory, measured, proposed):
        """The proposed input, or the safe one."""
        return memory + 1, jnp.where(memory < STEPS, proposed, self.rest), jnp.asarray(False)


class Play:
    """Experiments of one policy on simulated rigs, without and with its guard."""

    def __init__(self, policy, seed) -> None:
        self.plant = plant_from(policy.plant.name)
        self.spread, self.ranges, _ = trained_in(policy, self.plant)
        self.excitation, _ = excitation_and_origin(policy, {}, self.plant)
        self.num_readings, self.seed = readings_per_sample(self.plant), seed
        self.rules = Supervision.of(self.plant.description)
        model = GuardModel.for_rig(self.plant, self.spread, self.ranges)
        self.guard = GuardFilter(model, Guard.from_dict(policy.guard).rules, STEPS)

    def row(self, name, effects, faults, runs):
        """Of one scenario."""
        hardware = self.hardware(effects, faults, runs)
        free = FreeMotion(jnp.asarray(self.guard.rules.rest))
        without, guarded = (
            run_batch(hardware, self.excitation, rules, STEPS, self.num_readings, *filter)
            for rules, filter in (
                (self.rules, (free,)), (self.guard.supervision(self.rules), (self.guard,)),
            )
        )  # fmt: skip
        belief = guarded.memory
        sample = np.asarray(belief.tripped_at)
        found = sample < STEPS
        size, alone = self.size(guarded.max_abs_output), self.size(without.max_abs_output)
        bad, is_bad_alone = ~(size < 1), ~(alone < 1)
        row = {
            "scenario": name,
            "runs": runs,
            "without": int(is_bad_alone.sum()),
            "with": int(bad.sum()),
            "new": int((bad & ~is_bad_alone).sum()),
            "detected": int(found.sum()),
            "by_supervisor": int(((np.asarray(guarded.trip) > 0) & ~found).sum()),
            "median_sample": float(np.median(sample[found])) if found.any() else None,
            "largest": float(np.nanmax(size)),
        }
        if name not in BREAKING:
            return row
        times = (getattr(hardware.faults, f) for f in ("actuator_stuck", "actuator_dead",
                                                       "actuator_sign"))  # fmt: skip
        onset = jnp.min(jnp.stack(list(times)), axis=0)
        best = self.size(
            braked_at_once(hardware, onset, BREAKING[name], self.excitation, self.guard,
                           float(self.plant.dt), self.num_readings)
        )  # fmt: skip
        late = sample - np.ceil(np.asarray(onset) / float(self.plant.dt))
        return row | {
            "oracle": int((best >= 1).sum()),
            "oracle_largest": float(best.max()),
            "more_than_oracle": int((bad & (size > best + 1e-3)).sum()),
            "median_delay": float(np.median(late[found])) if found.any() else None,
        }

    def hardware(self, effects, faults, runs):
        """Rigs with plants drawn from a box; the leading axis is the run."""
        spread = effects.get("parameters", self.spread)
        more = {k: (v, v) for k, v in effects.items() if k != "parameters"}
        own = {
            k: v for k, v in self.ranges.items() if "parameters" not in effects or k != "parameters"
        }
        box, dt = Uncertainty.of(self.plant, spread, {**own, **more}), float(self.plant.dt)

        def delay(point):
            there, params = box.at(point)
            return there.delay(params)

        count = num_written(delay, len(box.names), dt)
        numbers = usual_numbers(dt, self.num_readings, {"latency": dt / 10})

        def draw(key):
            point, rig, fault = jax.random.split(key, 3)
            there, params = box.at(box.draw(point))
            return Hardware(
                at_interval(there, self.num_readings), params, *numbers.values(),
                rig, faults=faults(fault), num_written=count,
            )  # fmt: skip

        return eqx.filter_vmap(draw)(jax.random.split(jax.random.key(self.seed), runs))

    def size(self, outputs):
        """The largest output over its critical level."""
        rules = self.guard.rules
        return (np.asarray(outputs)[:, rules.watched] / rules.critical).max(axis=1)


@eqx.filter_jit
def braked_at_once(hardware, onset, sign, excitation, guarding, dt, num_readings):
    """Largest outputs where the guard's brake acts from the first sample after the fault on.

    It knows the true state, and the factor of the actuator.
    """
    rules, model = guarding.rules, guarding.model.functions()

    def one(hardware, onset):
        def sample(carry, k):
            state, player, belief = carry
            player, proposed = excitation(player, state.shown)
            away = jnp.zeros(len(rules.mean) - rules.num_states)
            known = belief._replace(
                mean=jnp.concatenate([state.plant_state, away]),
                num_braked=jnp.where(k * dt >= onset, 1, 0),
            )
            input = guard.decided(jnp, rules, model, known, proposed)
            input = jnp.clip(input, rules.lower, rules.upper)
            player = excitation.applied(player, input)
            belief = belief._replace(inputs=jnp.concatenate([belief.inputs[1:], input[None]]))
            state, _ = jax.lax.scan(
                lambda s, _: (hardware.advance(s), None), hardware.write(state, input), None,
                length=num_readings,
            )  # fmt: skip
            return (state, player, belief), None

        plant = eqx.tree_at(lambda p: p.dt, hardware.plant, jnp.asarray(dt))
        belief = guard.start(jnp, rules)._replace(sign=jnp.asarray(sign))
        carry = hardware.start(), excitation.init(plant, STEPS, hardware.key), belief
        count = STEPS + guard.LONGEST_BRAKE
        (state, _, _), _ = jax.lax.scan(sample, carry, jnp.arange(count))
        return state.largest

    return jax.vmap(one)(hardware, onset)


def step_ms(policy):
    """Milliseconds of one sample of the guard in NumPy, policy included: median and 99 %.

    Before a trip, on a nominal plant, and while it brakes.
    """
    outputs, result = ex.simulate(policy.plant.name, policy, seed=1).outputs, {}
    for word, measured in (("watching", outputs), ("braking", -outputs)):
        player, took = GuardedPlayer(PolicyPlayer(policy), Guard.from_dict(policy.guard)), []
        for k in range(STEPS):
            begin = time.perf_counter()
            player.applied(player(k, measured[k]))
            took.append(1000 * (time.perf_counter() - begin))
        assert (player.facts()["guard"]["tripped_at"] is None) == (word == "watching")
        result[word] = {"median": np.median(took), "99 %": np.percentile(took, 99)}
    return result


if __name__ == "__main__":
    main()
