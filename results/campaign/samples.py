"""How many samples a campaign needs, and whether it is safe, on plants of a wide spread.

    python results/campaign/samples.py aero2-wide --out results/campaign/aero2.json
    python results/campaign/samples.py results/campaign/policies/aero2-wide-robust.safetensors \
        --plants 1000 --uncertain --out results/campaign/aero2_uncertain.json

Of every plant the policy's experiments are simulated, from rest and with fresh noise. A target is
reached at the first sample at which the relative standard error of every parameter (Cramér-Rao
bound at the true parameters) is below it. The experiment ends there, or at the next sample from
which the free motion under the input that ends it stays below 0.97 of the critical level. A second
experiment follows where one is not enough.

With --uncertain, what else the policy's training declared (delay, lag, stiffness, initial state)
is drawn with every plant, too. The bound takes it as known.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import excite as ex
from excite.environment.falsification import nearness
from excite.excitation import PolicyExcitation
from excite.files import write_json
from excite.information import running_information
from excite.plant.catalogue import plant_from, with_sensor
from excite.plant.uncertainty import Uncertainty
from excite.safety import safe_input
from excite.simulation import response, run_episode

SAFE, ROUNDS = 0.97, 3


@eqx.filter_jit
def played(box, num_own, excitation, num_steps, coast, key):
    """Of one plant: information after every sample, nearness of every round and of every end."""
    params_key, *keys = jax.random.split(key, ROUNDS + 1)
    plant, params = box.at(box.draw(params_key))
    rest = jnp.asarray(safe_input(plant.definition))
    infos, sizes, after = [], [], []
    before = jnp.zeros((num_own, num_own))
    for key in keys:
        run = run_episode(plant, params, excitation, num_steps, key)
        info = running_information(plant, params, run.inputs)
        infos.append(before[None] + info[:, :num_own, :num_own])  # delay and lag follow: known
        before = infos[-1][-1]
        sizes.append(nearness(plant, run.outputs))

        def ending(k, run=run):
            """The nearness where the experiment ends at sample k."""
            count = num_steps + coast
            padded = jnp.concatenate([run.inputs, jnp.tile(rest, (coast, 1))])
            inputs = jnp.where((jnp.arange(count) < k)[:, None], padded, rest[None])
            return nearness(plant, response(plant, params, inputs))

        after.append(jax.lax.map(ending, jnp.arange(1, num_steps + 1), batch_size=50))
    return jnp.concatenate(infos), jnp.stack(sizes), jnp.concatenate(after)


def quantiles(samples):
    """Median, 90 % and largest."""
    found = np.quantile(samples, [0.5, 0.9, 1.0], method="inverted_cdf").tolist()
    return {"median": found[0], "90 %": found[1], "all": found[2]}


def main() -> None:
    """Prints and writes the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("policy")
    parser.add_argument("--plants", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--spread")
    parser.add_argument("--sd", type=float, help="noise of every output, in its unit")
    parser.add_argument("--uncertain", action="store_true", help="as declared in its training")
    parser.add_argument("--targets", default="0.005,0.001")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    policy = ex.read_policy(asked.policy)
    plant = plant_from(policy.plant.name)
    if asked.sd:
        plant = with_sensor(plant, {o.name: asked.sd for o in plant.definition.outputs})
    spread = asked.spread or policy.provenance["spread"]
    steps, coast = policy.layout.num_steps, policy.provenance.get("coast") or 100
    excitation = PolicyExcitation.of(policy)
    ranges = policy.provenance.get("uncertainty") or {} if asked.uncertain else {}
    box = Uncertainty.of(plant, spread, ranges)
    keys = jax.random.split(jax.random.key(asked.seed), asked.plants)
    num_own = len(plant.definition.parameters)
    batch = eqx.filter_jit(
        lambda keys: jax.vmap(lambda key: played(box, num_own, excitation, steps, coast, key))(keys)
    )
    parts = [batch(keys[i : i + 50]) for i in range(0, asked.plants, 50)]
    infos, sizes, after = (np.concatenate([np.asarray(p[i]) for p in parts]) for i in range(3))
    variance = np.diagonal(np.asarray(jnp.linalg.inv(infos)), axis1=-2, axis2=-1)
    error = np.sqrt(np.where(variance > 0, variance, np.inf))
    worst = np.max(error, axis=-1)
    table = {
        "policy": asked.policy,
        "policy_hash": policy.hash,
        "plant": plant.definition.name,
        "noise_sd": np.asarray(plant.sensor.noise_sd).tolist(),
        "spread": spread,
        **({"uncertainty": ranges} if ranges else {}),
        "plants": asked.plants,
        "seed": asked.seed,
        "steps": steps,
        "coast": coast,
        "violations_of_whole_rounds": int(np.sum(np.any(sizes >= 1, axis=1))),
        "violations_after_whole_rounds": int(
            np.sum(np.any(after[:, steps - 1 :: steps] >= 1, axis=1))
        ),
        "largest": float(np.max(sizes)),
        "targets": {},
    }
    for target in map(float, asked.targets.split(",")):
        known = worst <= target
        ends = known & (after < SAFE)
        ends[:, steps - 1 :: steps] |= known[:, steps - 1 :: steps]  # the policy's last sample
        reached = known.any(axis=1)
        first = np.where(reached, known.argmax(axis=1) + 1.0, np.inf)
        stop = np.where(ends.any(axis=1), ends.argmax(axis=1), known.shape[1] - 1)
        near = np.array([after[i, k] for i, k in enumerate(stop)])
        table["targets"][f"{target:g}"] = {
            "samples_until_known": quantiles(first),
            "samples_until_the_end": quantiles(stop + 1.0),
            "missed": int(np.sum(~reached)),
            "violations": int(np.sum(near >= 1)),
            "largest": float(near.max()),
        }
    print(json.dumps(table, indent=1))
    if asked.out:
        write_json(asked.out, table)


if __name__ == "__main__":
    main()
