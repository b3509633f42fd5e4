"""How often the intervals hold at the end of a campaign's round, which its own estimate decides.

    python results/campaign/coverage.py aero2-wide --out results/campaign/coverage.json

On every plant of the spread the policy is played once, from rest. After each sample, from the
eighth, the parameters are estimated from all samples so far, as the monitor of a campaign does. The
round ends at the first sample at which half of the 95 % interval of every parameter is within the
target. Rounds that do not end before the policy's last sample are counted beside.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import excite as ex
from excite.description import names_of
from excite.environment import run_episodes
from excite.estimation import NLS, Experiments, Status
from excite.estimation.diagnosis import half_95
from excite.excitation import PolicyExcitation
from excite.files import write_json
from excite.plant.catalogue import plant_from

FIRST, CHUNK = 8, 25


@eqx.filter_jit
def estimated(plant, inputs, measured, count):
    """Estimates of some plants from their first samples: values, covariance, degrees, success."""

    def one(inputs, measured):
        seen = jnp.arange(len(measured)) < count
        data = Experiments(
            inputs=inputs[None],
            measured=measured[None],
            valid=jnp.broadcast_to(seen[None, :, None], (1, *measured.shape)),
            initial_state=plant.initial_state[None],
            initial_state_known=True,
        )
        found = NLS()(plant, data)
        values = jnp.stack(found.params)
        return values, found.covariance, found.degrees, found.status == Status.SUCCESSFUL

    return jax.vmap(one)(inputs, measured)


def main() -> None:
    """Prints and writes the counts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("policy")
    parser.add_argument("--plants", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=2000)
    parser.add_argument("--target", type=float, default=0.01, help="half of the interval, relative")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    policy = ex.read_policy(asked.policy)
    plant, steps = plant_from(policy.plant.name), policy.layout.num_steps
    spread, excitation = policy.provenance["spread"], PolicyExcitation.of(policy)
    names = names_of(plant.definition.parameters)
    keys = jax.random.split(jax.random.key(asked.seed), asked.plants)
    held, samples = np.zeros((asked.plants, len(names)), bool), np.full(asked.plants, np.inf)
    for first in range(0, asked.plants, CHUNK):
        chunk = keys[first : first + CHUNK]
        episodes = run_episodes(plant, excitation, steps, spread, chunk)
        true = np.stack([np.asarray(v) for v in episodes.params], axis=-1)
        run = episodes.trajectory
        for k in range(FIRST, steps + 1):
            rows = slice(first, first + len(chunk))
            if np.all(np.isfinite(samples[rows])):
                break
            parts = estimated(plant, run.inputs, run.measured, jnp.asarray(k))
            values, covariance, degrees, sound = map(np.asarray, parts)
            for i in np.flatnonzero(sound & ~np.isfinite(samples[rows])):
                half = half_95(covariance[i], degrees[i])
                if np.all(half <= asked.target * np.abs(values[i])):
                    samples[first + i] = k
                    held[first + i] = np.abs(values[i] - true[i]) <= half
        sys.stderr.write(f"{first + len(chunk)} of {asked.plants} plants\n")
    ended = np.isfinite(samples)
    quantiles = np.quantile(samples, [0.5, 0.9], method="inverted_cdf")
    table = {
        "policy": asked.policy,
        "policy_hash": policy.hash,
        "plants": asked.plants,
        "seed": asked.seed,
        "target": asked.target,
        "not_ended": int(np.sum(~ended)),
        "samples": {"median": float(quantiles[0]), "90 %": float(quantiles[1])},
        "coverage_percent": {
            name: 100 * float(np.mean(held[ended, i])) for i, name in enumerate(names)
        },
    }
    print(json.dumps(table, indent=1))
    if asked.out:
        write_json(asked.out, table)


if __name__ == "__main__":
    main()
