"""Samples until the parameters are known: a campaign, signals repeated, and redesign alone.

    python results/campaign/compare.py --out results/campaign/compare.json
    python results/campaign/compare.py --sd 0.002 --out results/campaign/compare_noisy.json

`aero2`, J_p, K_pu and D_p anywhere within a factor of three. All methods see the same plants, and
every round begins at rest. A target is reached at the first sample at which the relative standard
error of every parameter (Cramér-Rao bound at the true parameters) is below it. What a method
decides between rounds follows from estimates of noisy records.

- campaign: the policy, then the better of policy and redesigned signal, as `excite campaign`
- repeated: one signal again and again, safe for the whole spread: designed by gradient, or a
  classical one whose options were tuned
- redesign: a robust signal of 25 samples, then signals of 25, 50, 50, ... samples, each
  redesigned for what is known
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import excite as ex
from excite.description import HALF_95, names_of
from excite.environment import prior_sd_of
from excite.environment.falsification import nearness
from excite.estimation import NLS, Experiments, Status
from excite.excitation import PolicyExcitation
from excite.files import write_json
from excite.information import running_information
from excite.plant import draw_params
from excite.plant.catalogue import plant_from, with_sensor
from excite.safety import safe_input
from excite.simulation import response, run_episode
from excite.study.next_experiment import best_of, candidates
from excite.study.targets import targets_from
from excite.training.redesign import Region, first_signals, redesigned

SPREAD, TARGETS, MOST, SEED = "factor:3", (0.005, 0.001), 480, 4000
SHORT, LONG = 25, 50  # rounds of the redesign alone


@eqx.filter_jit
def learnt(plant, params, inputs, coast):
    """Information after every sample of a round, and its nearness, free motion included."""
    rest = jnp.tile(jnp.asarray(safe_input(plant.definition)), (coast, 1))
    outputs = response(plant, params, jnp.concatenate([inputs, rest]))
    return running_information(plant, params, inputs), nearness(plant, outputs)


@eqx.filter_jit
def measured(plant, params, inputs, key):
    """Noisy outputs of a round."""
    outputs = response(plant, params, inputs)
    noise = plant.sensor.noise_sd[None] * jax.random.normal(key, outputs.shape)
    return outputs + noise.at[0].set(0.0)


@eqx.filter_jit
def estimated(plant, inputs, measured, valid, start):
    """Estimate from padded rounds, its information, and whether the search was successful."""
    initial = jnp.tile(plant.initial_state, (len(inputs), 1))
    data = Experiments(inputs, measured, valid, initial, initial_state_known=True)
    found = NLS()(plant, data, plant.Params(*start))
    running = jax.vmap(lambda own: running_information(plant, found.params, own))(inputs)
    counts = jnp.sum(valid[:, 1:, 0], axis=1)
    last = running[jnp.arange(len(inputs)), jnp.maximum(counts - 1, 0)]
    gained = jnp.sum(jnp.where((counts > 0)[:, None, None], last, 0.0), axis=0)
    return jnp.stack(list(found.params)), gained, found.status == Status.SUCCESSFUL


class Known:
    """What the records of one plant tell: a region, from the rounds so far."""

    def __init__(self, plant, params, key, length):
        """Nothing is known but the spread."""
        count = len(params)
        self.plant, self.params, self.key = plant, params, key
        self.rounds, self.length, self.sizes = [], length, []
        self.before = jnp.eye(count) / prior_sd_of(SPREAD) ** 2
        self.region = Region(jnp.stack(list(plant.nominal)), self.before)
        self.information = []

    def play(self, inputs, coast, is_last=False):
        """One round; afterwards an estimate, unless it is the last."""
        gained, near = learnt(self.plant, self.params, inputs, coast)
        sum_before = self.information[-1][-1] if self.information else np.zeros_like(gained[0])
        self.information.append(sum_before[None] + np.asarray(gained))
        self.sizes.append(float(near))
        self.key, own = jax.random.split(self.key)
        self.rounds.append((inputs, measured(self.plant, self.params, inputs, own)))
        if is_last:
            return
        most = -(-MOST // LONG) + 1
        pads = [np.zeros((most, self.length + n, 1)) for n in (0, 1, 1)]
        for i, (u, y) in enumerate(self.rounds):
            pads[0][i, : len(u)], pads[1][i, : len(y)], pads[2][i, : len(y)] = u, y, 1
        given = jnp.asarray(pads[0]), jnp.asarray(pads[1]), jnp.asarray(pads[2]) > 0
        center, gained, sound = estimated(self.plant, *given, self.region.center)
        if sound:
            self.region = Region(center, self.before + gained)

    @property
    def errors(self):
        """The largest relative standard error after every sample."""
        infos = np.concatenate(self.information)
        with np.errstate(all="ignore"):
            variance = np.diagonal(np.linalg.pinv(infos, hermitian=True), axis1=-2, axis2=-1)
            singular = np.linalg.cond(infos) > 1e14
        return np.sqrt(np.where(singular, np.inf, variance.max(axis=-1)))

    @property
    def is_done(self):
        """Whether every target is reached, or the samples are used up."""
        errors = self.errors
        return errors[-1] <= min(TARGETS) or len(errors) >= MOST


def repeated(plant, params, keys, signal, coast):
    """One signal again and again."""
    for own, key in zip(params, keys, strict=True):
        known = Known(plant, own, key, len(signal))
        while not known.information or not known.is_done:
            known.play(signal, coast, is_last=True)
        yield known


def by_redesign(plant, params, keys, first, coast):
    """A robust signal, then redesigned ones."""
    starts = {n: first_signals(plant, 1, n) for n in (SHORT, LONG)}
    asked = jnp.eye(len(plant.nominal)) / min(TARGETS)
    for own, key in zip(params, keys, strict=True):
        known = Known(plant, own, key, LONG)
        known.play(first, coast)
        while not known.is_done:
            n = SHORT if len(known.rounds) == 1 else LONG
            made = redesigned(plant, known.region, asked, starts[n], coast)
            if not np.isfinite(made.shares).any():
                break
            known.play(made.inputs[0], coast)
        yield known


def by_campaign(plant, params, keys, policy, coast):
    """The policy, then the better of policy and redesigned signal."""
    steps = policy.layout.num_steps
    targets = targets_from(
        plant,
        {n: f"{100 * HALF_95 * min(TARGETS)}%" for n in names_of(plant.definition.parameters)},
    )
    excitation = PolicyExcitation.of(policy)
    play = eqx.filter_jit(lambda own, key: run_episode(plant, own, excitation, steps, key).inputs)
    for own, key in zip(params, keys, strict=True):
        known = Known(plant, own, key, steps)
        known.play(play(own, key), coast)
        while not known.is_done:
            seed = len(known.rounds)
            made = candidates(
                plant, known.region, targets, ("policy", policy), num_steps=steps, coast=coast,
                seed=seed,
            )  # fmt: skip
            best = best_of(made, targets)
            is_policy = best is None or best.name == "policy"
            again = jax.random.fold_in(key, seed)
            known.play(play(own, again) if is_policy else jnp.asarray(best.inputs), coast)
        yield known


def row(made):
    """Samples until each target, missed plants, and nearness of all whole rounds."""
    made, found = list(made), {}
    for target in TARGETS:
        reached = [known.errors <= target for known in made]
        first = np.array([r.argmax() + 1.0 if r.any() else np.inf for r in reached])
        first = np.where(first <= MOST, first, np.inf)
        q = np.quantile(first, [0.5, 0.9, 1.0], method="inverted_cdf").tolist()
        names = ("median", "90 %", "all")
        found[f"{target:g}"] = dict(zip(names, q, strict=True)) | {
            "missed": int(np.sum(np.isinf(first)))
        }
    sizes = np.array([max(known.sizes) for known in made])
    return {**found, "violations": int(np.sum(sizes >= 1)), "largest": float(sizes.max())}


def main():
    """Prints and writes a row for each method."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sd", type=float, default=0.0002, help="of the noise [rad]")
    parser.add_argument("--plants", type=int, default=200)
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    policy = ex.read_policy("aero2-wide")
    coast, noise = policy.provenance["coast"], {"pitch": asked.sd}
    plant = with_sensor(plant_from("aero2"), noise)
    keys = jax.random.split(jax.random.key(SEED), asked.plants)
    params = [draw_params(plant, key, SPREAD) for key in keys]
    steps = policy.layout.num_steps

    def design(kind, steps):
        made = ex.design("aero2", kind, steps=steps, spread=SPREAD, coast=coast, noise=noise,
                         trials=None if kind == "robust" else 200)  # fmt: skip
        print(made, flush=True)
        return jnp.asarray(made.inputs)

    table = {"sd": asked.sd, "spread": SPREAD, "plants": asked.plants, "seed": SEED, "rows": {}}
    methods = {
        "campaign": lambda: by_campaign(plant, params, keys, policy, coast),
        "redesign alone": lambda: by_redesign(plant, params, keys, design("robust", SHORT), coast),
        **{
            f"{kind} of {n} samples, repeated": lambda kind=kind, n=n: repeated(
                plant, params, keys, design(kind, n), coast
            )
            for kind, n in (("robust", steps), ("robust", steps // 2), ("multisine", steps),
                            ("chirp", steps), ("prbs", steps))
        },
    }  # fmt: skip
    for name, method in methods.items():
        table["rows"][name] = row(method())
        print(name, table["rows"][name], flush=True)
        write_json(asked.out, table)


if __name__ == "__main__":
    main()
