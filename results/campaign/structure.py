"""How many samples it takes to tell `aero2` from a lag, a dead zone and a thrust curve.

    python results/campaign/structure.py --sd 0.002 --out results/campaign/structure_noisy.json

Plants are drawn from each rival's box with seeds of their own, and sensor noise with them. Rounds
of 20 samples, designed after every round, are compared with fixed signals of several lengths,
each at the largest amplitude that is safe on 200 plants of each rival, coast included. Chosen is
the rival of the largest evidence; with the designed rounds a campaign ends at a probability of
0.99.
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from excite.environment.falsification import nearness
from excite.estimation import Experiments
from excite.estimation.evidence import fitted, probabilities, unplayed
from excite.excitation.catalogue import excitation_named
from excite.plant.catalogue import plant_from, with_sensor
from excite.study.discrimination import DECIDED, rivals_from
from excite.training.discrimination import discriminating, first_signals
from excite.training.redesign import SAFE

HERE = Path(__file__).parent
RIVALS = (
    ("aero2", {}),
    ("aero2_lag", {"tau": "0.05:0.25"}),
    ("aero2+dead_zone", {"dead_zone_voltage": "0.1:2"}),
    (f"{HERE}/thrust_curve.py:ThrustCurve", {"curvature": "0.1:1"}),
)
NAMES = ("aero2", "lag", "dead zone", "thrust curve")
STEPS, COAST, ROUNDS = 20, 100, 5
FIXED, LENGTHS = ("chirp", "multisine", "prbs", "random"), (10, 20, 40, 60, 80, 120, 160, 200)


def drawn(rival, count, seed):
    """Coordinates of plants drawn uniformly from a box."""
    points = jax.random.uniform(jax.random.key(seed), (count, len(rival.box.names)), float, -1, 1)
    return jax.scipy.special.ndtri((1 + points) / 2)


def played(rival, z, inputs, noise, valid):
    """Experiments of one plant; inputs, noise, valid: round, time, channel."""
    outputs = jax.vmap(lambda own: rival.response(z, own))(inputs)
    outputs = outputs + rival.box.plant.sensor.noise_sd * noise.at[:, 0].set(0.0)
    start = jnp.tile(rival.box.plant.initial_state, (len(inputs), 1))
    return Experiments(inputs, outputs, valid, start, initial_state_known=True)


def designed(rivals, count, seed):
    """Of each truth and plant: rival that was chosen after each round, its probability, nearness.

    Yields all rows so far after each truth.
    """
    starts = first_signals(rivals[0].box.plant, STEPS)
    prior = [unplayed(rival) for rival in rivals]
    begin = discriminating(rivals, prior, starts, COAST)
    rows = []
    rest = jnp.zeros((COAST, 1))
    for truth, rival in enumerate(rivals):
        for plant, z in enumerate(drawn(rival, count, seed + truth)):
            rng = np.random.default_rng([seed, truth, plant])
            noise = jnp.asarray(rng.normal(size=(ROUNDS, STEPS + 1, 1)))
            inputs, valid = np.zeros((ROUNDS, STEPS, 1)), np.zeros((ROUNDS, STEPS + 1, 1), bool)
            fits, near, each = prior, 0.0, []
            for i in range(ROUNDS):
                made = discriminating(rivals, fits, starts, COAST) if i else begin
                inputs[i], valid[i] = made.inputs, True
                whole = rival.response(z, jnp.concatenate([made.inputs, rest]))
                near = max(near, float(nearness(rival.box.plant, whole)))
                data = played(rival, z, jnp.asarray(inputs), noise, jnp.asarray(valid))
                fits = [fitted(own, data) for own in rivals]
                p = np.asarray(probabilities(fits))
                each.append([int(p.argmax()), float(p.max())])
                if p.max() >= DECIDED:
                    break
            rows.append({"truth": truth, "rounds": each, "nearness": near})
        print(NAMES[truth], summary(rows, truth), flush=True)
        yield rows


def summary(rows, truth):
    """Share that is right after each number of samples, and wrong or no decisions."""
    own = [row for row in rows if row["truth"] == truth]
    after = [[row["rounds"][min(i, len(row["rounds"]) - 1)][0] == truth for row in own]
             for i in range(ROUNDS)]  # fmt: skip
    decided = [row["rounds"][-1][1] >= DECIDED for row in own]
    wrong = sum(d and row["rounds"][-1][0] != truth for d, row in zip(decided, own, strict=True))
    samples = np.array([STEPS * len(row["rounds"]) for row in own])
    return {
        "right_after": {STEPS * (i + 1): float(np.mean(a)) for i, a in enumerate(after)},
        "decided_wrong": int(wrong),
        "undecided": int(len(own) - sum(decided)),
        "samples": [float(q) for q in np.quantile(samples, [0.5, 0.9, 1.0])],
        "largest_nearness": max(row["nearness"] for row in own),
        "plants": len(own),
    }


def fixed(rivals, count, seed):
    """Of each fixed signal, truth and length, the share that is right."""
    first, table = rivals[0].box.plant, {}
    judges = [drawn(rival, 200, 1000 + i) for i, rival in enumerate(rivals)]
    fits = [jax.jit(jax.vmap(lambda data, own=own: fitted(own, data))) for own in rivals]

    @jax.jit
    def largest(inputs):
        whole = jnp.concatenate([inputs, jnp.zeros((COAST, 1))])
        of = [
            jax.vmap(lambda z, own=own: nearness(first, own.response(z, whole)))(z)
            for own, z in zip(rivals, judges, strict=True)
        ]
        return jnp.max(jnp.concatenate(of))

    for name in FIXED:
        for length in LENGTHS:
            shape = excitation_named(name, {}, first).sequence(first, length, jax.random.key(0))
            factors = np.geomspace(5, 0.02, 60)
            factor = next(f for f in factors if largest(jnp.clip(f * shape, -24, 24)) < SAFE)
            inputs = jnp.clip(factor * shape, -24, 24)[None]
            valid = jnp.ones((1, length + 1, 1), bool)
            for truth, rival in enumerate(rivals):
                data = [
                    played(rival, z, inputs, jax.random.normal(key, valid.shape), valid)
                    for z, key in zip(
                        drawn(rival, count, seed + truth),
                        jax.random.split(jax.random.key(seed + truth), count),
                        strict=True,
                    )
                ]
                data = jax.tree.map(lambda *rows: jnp.stack(rows), *data)
                evidence = np.stack([f(data).log_evidence for f in fits])
                right = float(np.mean(np.argmax(evidence, axis=0) == truth))
                table.setdefault(name, {}).setdefault(NAMES[truth], {})[length] = right
            right = [own[length] for own in table[name].values()]
            print(name, length, f"{factor:.3f}", right, flush=True)
            yield table


def main():
    """Draws, plays, writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sd", type=float, default=0.0002, help="of the noise [rad]")
    parser.add_argument("--spread", default="0.3", help="of J_p, K_pu, D_p")
    parser.add_argument("--count", type=int, default=200, help="plants of each rival")
    parser.add_argument("--fixed", type=int, default=0, help="plants for fixed signals")
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    spread = given.spread if ":" in given.spread else float(given.spread)
    plants = [(with_sensor(plant_from(n), {"pitch": given.sd}), r) for n, r in RIVALS]
    rivals = rivals_from(plants, spread)
    made = {"sd": given.sd, "spread": given.spread, "seed": given.seed, "designed": {}}
    for i, rows in enumerate(designed(rivals, given.count, given.seed)):
        made["designed"][NAMES[i]] = summary(rows, i)
        given.out.write_text(json.dumps(made, indent=1) + "\n")
    for table in fixed(rivals, given.fixed, given.seed) if given.fixed else ():
        made |= {"fixed": table, "plants_of_fixed": given.fixed}
        given.out.write_text(json.dumps(made, indent=1) + "\n")


if __name__ == "__main__":
    main()
