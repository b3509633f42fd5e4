"""Policies for published tasks of adaptive experiment design, by gradient, and what they tell.

    python results/oed/compute.py [--seeds N] [--published FOLDER] [TASK ...]

Trains one policy for each task, price of the squared input changes and seed, and evaluates it, the
published policies (archives in FOLDER), a designed signal, designs chosen one after the other and
simple inputs on other plants. Rows that are in a task's table already are not computed again.
"""

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import excite as ex
from excite.environment import ContrastiveGain, CriticGain, Env, InformationGain
from excite.estimation.prior_knowledge import plants_of
from excite.excitation import PRBS, Random, Replay
from excite.files import module_at
from excite.plant.catalogue import plant_named
from excite.policy import Layout, Policy
from excite.training.gradient import rank, train
from excite.training.settings import GradientSettings
from excite.training.signals import ROBUST, robust_signal

HERE = Path(__file__).parent
EXAMPLES = HERE.parent.parent / "examples"


@dataclass(frozen=True, kw_only=True)
class Rival:
    """After a published method: its kind of network and bound, with settings of our own.

    Attributes:
        memory, memory_kind, window: of its policy.
        objective: whose bound its training makes large.
        compared: plants in that bound.
        settings: of the training.
    """

    memory: int
    memory_kind: str
    window: int = 1
    objective: str = "sPCE"
    compared: int
    settings: GradientSettings


NEAR_THE_POSTERIOR = {"plants": 2048, "samples": 100, "seed": 1}
FROM_THE_PRIOR = {"plants": 256, "samples": 100_000, "from_prior": True, "seed": 1}


@dataclass(frozen=True, kw_only=True)
class Task:
    """A published task.

    Attributes:
        plant: its file and class.
        prior: of its parameters.
        trainings: settings by the price of squared input changes, in the order in which they are
            made: each begins with the policy of the one before. The last price of a pendulum is the
            authors'.
        archive: of their policy.
        steps: of an experiment.
        memory: of the policies.
        seeds: of trainings.
        chains: trainings side by side of a seed; for each price the best on validation is kept.
        evaluation: of every row.
        also: another evaluation of every row, near the posterior.
        myopic: evaluation of designs chosen one after the other, for each seed; for plants with
            states, `evaluation` with fewer plants, once. Another one of a task without memory has
            as many plants and 1,000 samples near the posterior.
        pool: number of designs, drawn at random, that are allowed to these; 0 for all.
        rivals: other methods, by their names.
    """

    plant: str
    prior: Mapping[str, str]
    trainings: Mapping[float, GradientSettings] = field(default_factory=dict)
    archive: str = ""
    steps: int = 50
    memory: int = 0
    seeds: int = 10
    chains: int = 1
    evaluation: Mapping[str, object]
    also: Mapping[str, object] | None = None
    myopic: Mapping[str, object] | None = None
    pool: int = 0
    rivals: Mapping[str, Rival] = field(default_factory=dict)

    @property
    def word(self):
        """The name of the plant."""
        return str(EXAMPLES / self.plant)

    def env(self, price):
        """The decision process whose total reward is the gain in nats less the price of changes."""
        plant = plant_named(self.word)
        prior, count = plants_of(plant, self.prior), len(plant.nominal)
        objective = InformationGain(
            (True,) * count, 1.0, 0.5, dense=False, prior=prior, change_price=price
        )
        layout = Layout.of(plant.description, 1, self.steps, self.memory)
        return Env.of(plant, objective=objective, layout=layout, prior=prior)

    def rival_env(self, rival):
        """The decision process of another method."""
        plant = plant_named(self.word)
        prior = plants_of(plant, self.prior)
        if rival.objective == "sPCE":
            objective = ContrastiveGain(prior, rival.compared, dense=False)
        else:
            objective = CriticGain(prior, self.steps, rival.compared)
        remembers = rival.memory, rival.memory_kind
        layout = Layout.of(plant.description, rival.window, self.steps, *remembers)
        return Env.of(plant, objective=objective, layout=layout, prior=prior)


def pendulum(name, prior, small, price, archive, chains=1):
    """A plant of Inside-Out SMC², with a smaller price between none and the authors'."""

    def settings(num_updates):
        return GradientSettings(
            starts=96, num_updates=num_updates, num_plants=64, learning_rate=1e-3,
            watch_every=num_updates // 10, watch_episodes=256,
        )  # fmt: skip

    return Task(
        plant=f"smc_pendulums.py:{name}",
        prior=prior,
        trainings={0.0: settings(1200), small: settings(1200), price: settings(3600)},
        archive=archive,
        chains=chains,
        evaluation=NEAR_THE_POSTERIOR,
    )


def lognormal(*names):
    """A tenth of relative standard deviation each."""
    return dict.fromkeys(names, "lognormal:1:0.1")


LINEAR = {"a": "normal:14.7:0.316228", "b": "normal:0:0.1", "c": "normal:3:0.316228"}
TASKS = {
    "linear pendulum": pendulum(
        "LinearPendulum", LINEAR, 0.03, 0.1, "linear_pendulum_rb_csmc_ctl.npz"
    ),
    "nonlinear pendulum": pendulum(
        "NonlinearPendulum", lognormal("m", "l"), 0.05, 0.2,
        "nonlinear_pendulum_ibis_csmc_ctl.npz", chains=2,
    ),
    "cart-pole": pendulum(
        "CartPole", lognormal("l", "m_p", "m_c"), 0.01, 0.1, "cartpole_ibis_csmc_ctl.npz"
    ),
    "double pendulum": pendulum(
        "DoublePendulum", lognormal("m_1", "m_2", "l_1", "l_2"), 0.01, 0.1,
        "double_pendulum_ibis_csmc_ctl.npz",
    ),
    "location finding": Task(
        plant="location_finding.py:TwoSources",
        prior=dict.fromkeys(("x_1", "y_1", "x_2", "y_2"), "normal:0:1"),
        trainings={
            0.0: GradientSettings(
                num_updates=7000, num_plants=256, learning_rate=2e-3, hidden=(128,), last_gain=0.3,
                watch_every=700, watch_episodes=512, through_measurements=False,
            )
        },
        steps=30,
        memory=64,
        seeds=3,
        evaluation=FROM_THE_PRIOR,
        also={"plants": 256, "samples": 5000, "seed": 1},
        myopic={"plants": 667, "samples": 1_000_000, "from_prior": True},
        rivals={
            "DAD": Rival(
                memory=16, memory_kind="sum", compared=1023,
                settings=GradientSettings(
                    num_updates=8000, num_plants=128, learning_rate=1e-3, hidden=(256,),
                    last_gain=0.3, watch_every=500, watch_episodes=512, through_measurements=False,
                ),
            ),
            "iDAD": Rival(
                memory=16, memory_kind="attention", window=30, objective="InfoNCE", compared=255,
                settings=GradientSettings(
                    num_updates=2500, num_plants=128, learning_rate=1e-3, hidden=(256,),
                    last_gain=0.3, watch_every=500, watch_episodes=256, through_measurements=False,
                ),
            ),
        },
    ),
    "one source": Task(
        plant="location_finding.py:OneSource",
        prior={"x_1": "uniform:0:1", "y_1": "uniform:0:1"},
        steps=30,
        seeds=1,
        evaluation=FROM_THE_PRIOR,
        also={"plants": 256, "samples": 5000, "seed": 1},
        myopic={"plants": 256, "samples": 1_000_000, "from_prior": True},
        pool=2000,
    ),
    "elasticity": Task(
        plant="constant_elasticity.py:Elasticity",
        prior={
            "rho": "uniform:0.01:1", "v_1": "uniform:0:1", "v_2": "uniform:0:1",
            "u": "lognormal:2.718281828:3",
        },
        steps=10,
        seeds=1,
        evaluation=FROM_THE_PRIOR,
        also={"plants": 256, "samples": 5000, "seed": 1},
        myopic={"plants": 667, "samples": 10_000_000, "from_prior": True},
    ),
}  # fmt: skip


def path_of(task, rest):
    """A file of a task."""
    return HERE / f"{task.replace(' ', '_')}{rest}"


def policy_path(task, price, seed):
    """The file of a trained policy."""
    return path_of(task, f"-{price:g}-{seed}.safetensors")


def row(task, method, excitation, evaluation=None, also=None, **about):
    """What an excitation is expected to tell, on plants that no training has seen."""
    own = TASKS[task]
    evaluation, also = evaluation or own.evaluation, also or own.also
    gain = partial(ex.information_gain, own.word, excitation, steps=own.steps, prior=own.prior)
    found = gain(**evaluation)
    content = {"task": task, "method": method, **about, **found.to_dict()}
    price = max(own.trainings, default=0.0)
    content["gain_less_changes"] = found.lower.value - price * found.changes.value
    if also is not None:
        near = gain(**also).to_dict()
        kept = ("lower", "upper", "num_samples", "few_effective_samples")
        content["near_posterior"] = {name: near[name] for name in kept}
    return {k: v for k, v in content.items() if k not in ("plant", "excitation")}


def trained(task, seed):
    """By price, the best of some chains of trainings; and the seconds of them all."""
    own, start, found = TASKS[task], time.process_time(), {}
    for chain in range(own.chains):
        first = None
        for price, settings in own.trainings.items():
            made = train(own.env(price), settings, seed + 100 * chain, first=first)
            first = jax.tree.map(jnp.asarray, made.weights)
            found.setdefault(price, []).append(made)
    best = {
        price: max(
            several, key=lambda made, price=price: rank(own.trainings[price], made.validation)
        )
        for price, several in found.items()
    }
    return best, time.process_time() - start


def trained_rows(task, seed):
    """A row for each price; the policies are written beside the table."""
    best, seconds = trained(task, seed)
    for price, made in best.items():
        env = TASKS[task].env(price)
        about = {"excite": ex.__version__, "task": task, "change_price": price, "seed": seed}
        policy = Policy(env.plant.description, env.layout, made.weights, about)
        policy.save(policy_path(task, price, seed), overwrite=True)
        told = {"price": price, "seed": seed, "train_cpu_seconds": seconds / len(best)}
        yield row(task, "gradient", policy, **told)


def rival_row(task, name):
    """Of another method, trained once; its policy is written beside the table."""
    rival, start = TASKS[task].rivals[name], time.process_time()
    env = TASKS[task].rival_env(rival)
    made = train(env, rival.settings, 0)
    seconds = time.process_time() - start
    about = {"excite": ex.__version__, "task": task, "method": name, "seed": 0}
    policy = Policy(env.plant.description, env.layout, made.weights, about)
    policy.save(path_of(task, f"-{name}.safetensors"), overwrite=True)
    return row(task, name, policy, train_cpu_seconds=seconds)


def myopic_row(task, seed):
    """Of designs chosen one after the other; the seed is that of plants, noise and designs."""
    own, start = TASKS[task], time.process_time()
    pool = np.random.default_rng(seed).uniform(size=(own.pool, 2)) if own.pool else None
    chosen = ex.Myopic.of(own.word, own.prior, pool=pool)
    near = {"plants": own.myopic["plants"], "samples": 1000, "seed": seed}
    made = row(task, "myopic", chosen, {**own.myopic, "seed": seed}, near, seed=seed)
    device = jax.devices()[0].device_kind
    told = {} if device == "cpu" else {"device": device}
    return made | {"cpu_seconds": time.process_time() - start} | told


def open_loop_row(task):
    """Of the signal designed for the prior, which does not use the measurements."""
    found = robust_signal(TASKS[task].env(0.0), seed=0, settings=ROBUST)
    return row(task, "open loop", Replay(found.inputs[0]))


def rows_of(task):
    """The rows that are computed."""
    path = path_of(task, ".json")
    return json.loads(path.read_text())["rows"] if path.is_file() else []


def lines(task):
    """The lines of a task, as the page has them for the pendulums; ranges are over seeds."""
    rows, told = rows_of(task), []
    for method in dict.fromkeys((r["method"], r.get("price")) for r in rows):
        own = [r for r in rows if (r["method"], r.get("price")) == method]
        gains = [r["lower"]["nats"] for r in own]
        less = [r["gain_less_changes"] for r in own]
        changes = np.mean([r["input_changes"]["value"] for r in own])
        cells = [task, method[0] + ("" if method[1] is None else f", price {method[1]:g}")]
        if len(own) == 1:
            cells += [f"{gains[0]:.2f} ± {own[0]['lower']['std_error']:.2f}", f"{changes:.1f}"]
            cells += [f"{less[0]:.2f}"]
        else:
            cells += [_range(gains), f"{changes:.1f}", _range(less)]
        told.append(f"| {' | '.join(cells)} |")
    return told


def _range(values):
    return f"{np.mean(values):.2f} ({min(values):.2f} to {max(values):.2f})"


def main():
    """Computes what is missing in the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--published", type=Path)
    parser.add_argument("tasks", nargs="*", default=list(TASKS))
    asked = parser.parse_args()
    for task in asked.tasks:
        own, path, rows = TASKS[task], path_of(task, ".json"), rows_of(task)

        def keep(method, made, seed=None, path=path, rows=rows):
            if (method, seed) not in {(r["method"], r.get("seed")) for r in rows}:
                rows += made()
                path.write_text(json.dumps({"rows": rows}, indent=1) + "\n")

        def keep_input(method, excitation, task=task, keep=keep):
            keep(method, lambda: [row(task, method, excitation)])

        keep_input("random", Random(hold=1))
        if own.archive:
            limit = np.array([i.upper for i in plant_named(own.word).description.inputs])
            keep_input("PRBS", PRBS(clock=1))
            keep_input("constant", Replay(np.tile(limit, (own.steps, 1))))
            keep("open loop", lambda task=task: [open_loop_row(task)])
            few = {**own.evaluation, "plants": 128}
            keep("myopic", lambda task=task, few=few: [row(task, "myopic", "myopic", few)])
        if own.archive and asked.published is not None:
            module = module_at(EXAMPLES / "smc_policies.py")
            keep_input("published", module.RecurrentPolicy.read(asked.published / own.archive))
        seeds = range(own.seeds if asked.seeds is None else asked.seeds)
        if own.myopic is not None:
            for seed in seeds:
                keep("myopic", lambda task=task, seed=seed: [myopic_row(task, seed)], seed)
        for name in own.rivals:
            keep(name, lambda task=task, name=name: [rival_row(task, name)])
        for seed in seeds if own.trainings else ():
            keep("gradient", partial(trained_rows, task, seed), seed)
        print("\n".join(lines(task)))


if __name__ == "__main__":
    main()
