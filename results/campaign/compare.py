"""Samples until the parameters are known: a campaign, signals repeated, and redesign alone.

    python results/campaign/compare.py --out results/campaign/compare.json
    python results/campaign/compare.py --sd 0.002 --out results/campaign/compare_noisy.json

Parameters anywhere within the spread of the policy's training, by default `aero2-wide` with a
factor of three. All methods see the same plants, and every round begins at rest, unless it is said
to go on. A target is reached at the first sample at which the relative standard error of every
parameter (Cramér-Rao bound at the true parameters) is below it. What a method decides between
rounds follows from estimates of noisy records.

- campaign: the policy, then the better of policy and redesigned signal, as `excite campaign`
- repeated: one signal again and again, safe for the whole spread: designed by gradient, or a
  classical one whose options were tuned, `loop-NAME` around a position loop
- redesign: a robust signal of 25 samples, then signals of 25, 50, 50, ... samples, each
  redesigned for what is known
- the same without rest: 10 samples of the safe input, then a signal that goes on from there

Rows of the same plants that are in the file already are kept, those of another policy are not.
"""

import argparse
import itertools
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import excite as ex
from excite.description import HALF_95, prior_sd_of
from excite.environment.falsification import nearness
from excite.estimation import NLS, Experiments, Status
from excite.excitation import PolicyExcitation, Replay
from excite.excitation.catalogue import excitation_named
from excite.files import write_json
from excite.information import Past, running_information
from excite.plant import draw_params
from excite.plant.catalogue import plant_from, with_sensor
from excite.safety import safe_input
from excite.simulation import response, run_episode
from excite.study.next_experiment import best_of, candidates
from excite.study.targets import targets_from
from excite.training.redesign import Region, first_signals, redesigned

MOST, SEED = 480, 4000  # samples of a campaign
SHORT, LONG = 25, 50  # rounds of the redesign alone
PAUSE = 10  # samples before one that goes on


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

    def __init__(self, plant, params, key, length, spread, target, most=None):
        """Nothing is known but the spread; `target` is the last standard error asked for."""
        self.most = most or -(-MOST // min(length, LONG)) + 1  # records
        count = len(params)
        self.plant, self.params, self.key, self.target = plant, params, key, target
        self.rounds, self.length, self.sizes = [], length, []
        self.before = jnp.eye(count) / prior_sd_of(spread) ** 2
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
        if not is_last:
            self.estimate()

    def estimate(self):
        """The region that the rounds leave possible."""
        (_, inputs), (_, outputs) = (x.shape for x in self.rounds[0])
        sizes = (0, inputs), (1, outputs), (1, outputs)
        pads = [np.zeros((self.most, self.length + n, width)) for n, width in sizes]
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
        return errors[-1] <= self.target or len(errors) >= MOST


def inputs_of(plant, excitation, steps):
    """The inputs of an excitation on a plant, from rest."""
    return eqx.filter_jit(lambda own, key: run_episode(plant, own, excitation, steps, key).inputs)


def repeated(begin, plant, play, coast):
    """One excitation again and again."""
    for known in begin(1):
        while not known.information or not known.is_done:
            key = jax.random.fold_in(known.key, len(known.information))
            known.play(play(known.params, key), coast, is_last=True)
        yield known


def by_redesign(begin, plant, first, coast):
    """A robust signal, then redesigned ones."""
    starts = {n: first_signals(plant, 1, n) for n in (SHORT, LONG)}
    for known in begin(LONG):
        asked = jnp.eye(len(plant.nominal)) / known.target
        known.play(first, coast)
        while not known.is_done:
            n = SHORT if len(known.rounds) == 1 else LONG
            made = redesigned(plant, known.region, asked, starts[n], coast)
            if not np.isfinite(made.shares).any():
                break
            known.play(made.inputs[0], coast)
        yield known


def without_rest(begin, plant, first, coast):
    """The same, where each signal goes on from the state after the last one."""
    starts = {n: first_signals(plant, 1, n) for n in (SHORT, LONG)}
    rest = jnp.tile(jnp.asarray(safe_input(plant.definition)), (PAUSE, 1))
    room = MOST + PAUSE + LONG
    for known in begin(room, most=1):
        asked = jnp.eye(len(plant.nominal)) / known.target
        noise = jax.random.normal(known.key, (room + 1, len(plant.definition.outputs)))
        noise = plant.sensor.noise_sd[None] * noise.at[0].set(0.0)
        whole, rounds = first, 1
        while True:
            gained, near = learnt(plant, known.params, whole, coast)
            known.information = [np.asarray(gained)]
            known.sizes.append(float(near))
            if known.is_done:
                break
            outputs = response(plant, known.params, whole)
            known.rounds = [(whole, outputs + noise[: len(outputs)])]
            known.estimate()
            past = Past.of(whole, PAUSE, room)
            n = SHORT if rounds == 1 else LONG
            made = redesigned(plant, known.region, asked, starts[n], coast, past=past)
            if not np.isfinite(made.shares).any():
                break
            whole, rounds = jnp.concatenate([whole, rest, made.inputs[0]]), rounds + 1
        yield known


def by_campaign(begin, plant, policy, coast):
    """The policy, then the better of policy and redesigned signal."""
    steps = policy.layout.num_steps
    play = inputs_of(plant, PolicyExcitation.of(policy), steps)
    for known in begin(steps):
        own, key = known.params, known.key
        half = HALF_95 * known.target
        targets = targets_from(
            plant, {p.name: half * p.scale if not p.positive else f"{100 * half}%"
                    for p in plant.definition.parameters},
        )  # fmt: skip
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


def row(made, targets):
    """Samples until each target, missed plants, and nearness of all whole rounds."""
    made, found = list(made), {}
    for target in targets:
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
    parser.add_argument("--policy", default="aero2-wide")
    parser.add_argument("--sd", type=float, help="noise of every output, in its unit")
    parser.add_argument("--targets", default="0.005,0.001", help="relative standard errors")
    parser.add_argument("--signals", default="robust,multisine,chirp,prbs", help="to be repeated")
    parser.add_argument("--lengths", help="of the repeated signals; default that of the policy")
    parser.add_argument("--plants", type=int, default=200)
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    policy = ex.read_policy(asked.policy)
    plant = plant_from(policy.plant.name)
    noise = {o.name: asked.sd for o in plant.definition.outputs} if asked.sd else {}
    plant = with_sensor(plant, noise)
    spread, coast = policy.provenance["spread"], policy.provenance["coast"]
    steps, targets = policy.layout.num_steps, [float(t) for t in asked.targets.split(",")]
    keys = jax.random.split(jax.random.key(SEED), asked.plants)
    params = [draw_params(plant, key, spread) for key in keys]

    def begin(length, most=None):
        return [Known(plant, *each, length, spread, min(targets), most)
                for each in zip(params, keys, strict=True)]  # fmt: skip

    def design(kind, steps):
        made = ex.design(policy.plant.name, kind, steps=steps, spread=spread, coast=coast,
                         noise=noise, trials=None if kind == "robust" else 200)  # fmt: skip
        print(made, flush=True)
        if made.tuned is None:
            return Replay(jnp.asarray(made.inputs))
        return excitation_named(kind, made.tuned.options, plant)

    def signal(kind, steps):
        return repeated(begin, plant, inputs_of(plant, design(kind, steps), steps), coast)

    lengths = [int(n) for n in asked.lengths.split(",")] if asked.lengths else [steps]
    kinds = asked.signals.split(",")
    methods = {"campaign": lambda: by_campaign(begin, plant, policy, coast)}
    if "robust" in kinds:
        methods["redesign alone"] = lambda: by_redesign(
            begin, plant, design("robust", SHORT).inputs, coast
        )
        methods["redesign alone, without rest"] = lambda: without_rest(
            begin, plant, design("robust", SHORT).inputs, coast
        )
    for kind, length in itertools.product(kinds, lengths):
        name = f"{kind} of {length} samples, repeated"
        methods[name] = lambda kind=kind, length=length: signal(kind, length)
    about = {"noise": noise, "spread": spread, "plants": asked.plants, "seed": SEED}
    table = {"policy_hash": policy.hash, **about, "rows": {}}
    before = json.loads(asked.out.read_text()) if asked.out.exists() else {}
    if {name: before.get(name) for name in about} == about:
        table["rows"] = before["rows"]
        if before["policy_hash"] != policy.hash:
            table["rows"].pop("campaign", None)
    for name, method in methods.items():
        if name in table["rows"]:
            continue
        table["rows"][name] = row(method(), targets)
        print(name, table["rows"][name], flush=True)
        write_json(asked.out, table)


if __name__ == "__main__":
    main()
