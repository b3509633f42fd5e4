"""Samples until the parameters are known: a policy, a repeated signal, a chirp, redesigned signals.

    python results/campaign/compare.py --out results/campaign/methods.json

On the same plants, drawn within a factor of three, and by the same rule: the first sample at which
the relative standard error of every parameter (Cramér-Rao bound at the true parameters) is below
the target. Every round begins at rest. The repeated signal is the robust design of
`--signal` samples on the A-criterion, safe for 1,000 plants of the spread in its coast too; the
chirp is tuned to be. The redesign begins with that signal's first round; before every later one an
estimate is drawn from the normal distribution of what is known so far, and a signal of `--steps`
samples is redesigned for it.
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
from excite.environment import prior_sd_of
from excite.environment.falsification import nearness
from excite.excitation import PolicyExcitation
from excite.files import write_json
from excite.information import running_information
from excite.plant import draw_params
from excite.plant.catalogue import plant_from
from excite.simulation import response, run_episode
from excite.training.redesign import Region, first_signals, redesigned

SPREAD, COAST, MOST = "factor:3", 50, 1000
PLANT = plant_from("aero2")
PRIOR = jnp.eye(3) / prior_sd_of(SPREAD) ** 2


@eqx.filter_jit
def of_signal(params, inputs):
    """Information after every sample of one round, and the nearness with its coast."""
    whole = jnp.concatenate([inputs, jnp.zeros((COAST, 1))])
    return running_information(PLANT, params, inputs), nearness(
        PLANT, response(PLANT, params, whole)
    )


@eqx.filter_jit
def of_policy(params, excitation, steps, key):
    """The same of a round of a policy, without its coast."""
    run = run_episode(PLANT, params, excitation, steps, key)
    return running_information(PLANT, params, run.inputs), nearness(PLANT, run.outputs)


@eqx.filter_jit
def redesign(params, information, key, starts):
    """The signal for an estimate that is drawn from what is known."""
    known = information + PRIOR
    root = jnp.linalg.cholesky(jnp.linalg.inv(known))
    center = jnp.stack(list(params)) * jnp.exp(root @ jax.random.normal(key, (3,)))
    return redesigned(PLANT, Region(center, known), jnp.ones(3), starts, COAST).inputs[0]


def errors(infos):
    """Of every sample, the largest relative standard error."""
    variance = np.diagonal(np.linalg.inv(np.concatenate(infos)), axis1=-2, axis2=-1)
    return np.max(np.sqrt(np.where(variance > 0, variance, np.inf)), axis=-1)


def campaign(params, key, round_of, most):
    """Errors after every sample of all rounds, and the largest nearness."""
    infos, sizes, before, count = [], [], jnp.zeros((3, 3)), 0
    while count < most:
        key, own = jax.random.split(key)
        running, size = round_of(params, before, own, len(infos))
        infos.append(np.asarray(before[None] + running) + 1e-9 * np.eye(3))
        before, count = before + running[-1], count + len(running)
        sizes.append(float(size))
    return errors(infos), max(sizes)


def main() -> None:
    """Prints and writes the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plants", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--signal", type=int, default=200)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    policy = ex.read_policy("aero2-wide")
    excitation, length = PolicyExcitation.of(policy), policy.layout.num_steps
    made = {
        "repeated signal": ex.design("aero2", spread=SPREAD, criterion="A", coast=COAST,
                                     steps=asked.signal, seed=1).inputs,
        "chirp": ex.design("aero2", "chirp", spread=SPREAD, coast=COAST, steps=500,
                           seed=1).inputs,
    }  # fmt: skip
    first = jnp.asarray(made["repeated signal"][: asked.steps])

    def by_redesign(params, before, key, index):
        starts = first_signals(PLANT, 1, asked.steps)
        inputs = first if index == 0 else redesign(params, before, key, starts)
        return of_signal(params, inputs)

    def repeated(inputs):
        return lambda params, before, key, index: of_signal(params, jnp.asarray(inputs))

    def by_policy(params, before, key, index):
        return of_policy(params, excitation, length, key)

    methods = {
        "policy": (by_policy, 480),
        **{name: (repeated(inputs), MOST) for name, inputs in made.items()},
        "redesign": (by_redesign, 300),
    }
    table = {"plants": asked.plants, "seed": asked.seed, "spread": SPREAD, "coast": COAST,
             "signal": asked.signal, "steps": asked.steps, "methods": {}}  # fmt: skip
    for name, (round_of, most) in methods.items():
        found, sizes = [], []
        for key in jax.random.split(jax.random.key(asked.seed), asked.plants):
            params_key, key = jax.random.split(key)
            worst, size = campaign(draw_params(PLANT, params_key, SPREAD), key, round_of, most)
            found.append(worst)
            sizes.append(size)
        row = {"samples_at_most": most, "violations": int(np.sum(np.array(sizes) >= 1))}
        for target in (0.005, 0.001):
            known = np.array(found) <= target
            samples = np.where(known.any(axis=1), known.argmax(axis=1) + 1.0, np.inf)
            half, most_of = np.quantile(samples, [0.5, 0.9], method="inverted_cdf").tolist()
            missed = int(np.sum(np.isinf(samples)))
            row[f"{target:g}"] = {"median": half, "90 %": most_of, "missed": missed}
        table["methods"][name] = row
        print(name, json.dumps(row), flush=True)
    if asked.out:
        write_json(asked.out, table)


if __name__ == "__main__":
    main()
