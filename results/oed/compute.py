"""Policies for four plants of Inside-Out SMC², by gradient, and what they are expected to tell.

    python results/oed/compute.py [--seeds 3] [--published FOLDER] [TASK ...]

Trains one policy for each task, price of the squared input changes and seed, and evaluates it, the
published policies (archives in FOLDER) and random inputs on other plants. Rows that are in a task's
table already are not computed again.
"""

import argparse
import json
import time
from functools import partial
from pathlib import Path

import excite as ex
from excite.environment import Env, InformationGain
from excite.estimation.prior_knowledge import plants_of
from excite.excitation import Random
from excite.files import module_at
from excite.plant.catalogue import plant_named
from excite.policy import Layout, Policy
from excite.training.gradient import train
from excite.training.settings import GradientSettings

HERE = Path(__file__).parent
EXAMPLES = HERE.parent.parent / "examples"
STEPS = 50
EVALUATED = {"plants": 2048, "samples": 400, "seed": 1}


def lognormal(*names):
    """A tenth of relative standard deviation each."""
    return dict.fromkeys(names, "lognormal:1:0.1")


# Class, prior, the authors' price of squared input changes, another price, archive of their policy.
TASKS = {
    "linear pendulum": (
        "LinearPendulum",
        {"a": "normal:14.7:0.316228", "b": "normal:0:0.1", "c": "normal:3:0.316228"},
        (0.1, 0.03), "linear_pendulum_rb_csmc_ctl.npz",
    ),
    "nonlinear pendulum": (
        "NonlinearPendulum", lognormal("m", "l"), (0.2, 0.05),
        "nonlinear_pendulum_ibis_csmc_ctl.npz",
    ),
    "cart-pole": (
        "CartPole", lognormal("l", "m_p", "m_c"), (0.1, 0.01), "cartpole_ibis_csmc_ctl.npz",
    ),
    "double pendulum": (
        "DoublePendulum", lognormal("m_1", "m_2", "l_1", "l_2"), (0.1, 0.01),
        "double_pendulum_ibis_csmc_ctl.npz",
    ),
}  # fmt: skip
SETTINGS = GradientSettings(
    starts=96, num_updates=600, num_plants=64, learning_rate=1e-3, watch_every=60,
    watch_episodes=256,
)  # fmt: skip


def word_of(task):
    """The name of a task's plant."""
    return f"{EXAMPLES / 'smc_pendulums.py'}:{TASKS[task][0]}"


def path_of(task, rest):
    """A file of a task."""
    return HERE / f"{task.replace(' ', '_')}{rest}"


def policy_path(task, price, seed):
    """The file of a trained policy."""
    return path_of(task, f"-{price:g}-{seed}.safetensors")


def env_of(task, price):
    """The decision process whose total reward is the gain in nats less the price of changes."""
    plant, given = plant_named(word_of(task)), TASKS[task][1]
    prior, count = plants_of(plant, given), len(plant.nominal)
    objective = InformationGain(
        (True,) * count, 1.0, 0.5, dense=False, prior=prior, change_price=price
    )
    layout = Layout.of(plant.description, window=1, num_steps=STEPS)
    return Env.of(plant, objective=objective, layout=layout, prior=prior)


def row(task, method, excitation, **about):
    """What an excitation is expected to tell, on plants that no training has seen."""
    _, prior, (price, _), _ = TASKS[task]
    found = ex.information_gain(word_of(task), excitation, steps=STEPS, prior=prior, **EVALUATED)
    content = {"task": task, "method": method, **about, **found.to_dict()}
    content["gain_less_changes"] = found.lower.value - price * found.changes.value
    return {k: v for k, v in content.items() if k not in ("plant", "excitation")}


def trained_row(task, price, seed):
    """Of a policy trained for this price; the policy is written beside the table."""
    env, start = env_of(task, price), time.process_time()
    trained = train(env, SETTINGS, seed)
    seconds = time.process_time() - start
    policy = Policy(
        env.plant.description, env.layout, trained.weights,
        {"excite": ex.__version__, "task": task, "change_price": price, "seed": seed},
    )  # fmt: skip
    policy.save(policy_path(task, price, seed), overwrite=True)
    return row(task, "gradient", policy, price=price, seed=seed, train_cpu_seconds=seconds)


def main():
    """Computes what is missing in the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--published", type=Path)
    parser.add_argument("tasks", nargs="*", default=list(TASKS))
    asked = parser.parse_args()
    for task in asked.tasks:
        path = path_of(task, ".json")
        rows = json.loads(path.read_text())["rows"] if path.is_file() else []
        done = {(r["method"], r.get("price"), r.get("seed")) for r in rows}

        def keep(key, made, path=path, rows=rows, done=done):
            if key not in done:
                rows.append(made())
                path.write_text(json.dumps({"rows": rows}, indent=1) + "\n")

        keep(("random", None, None), partial(row, task, "random", Random(hold=1)))
        if asked.published is not None:
            own = module_at(EXAMPLES / "smc_policies.py")
            kept = own.RecurrentPolicy.read(asked.published / TASKS[task][3])
            keep(("published", None, None), partial(row, task, "published", kept))
        for seed in range(asked.seeds):
            for price in (0.0, *TASKS[task][2]):
                keep(("gradient", price, seed), partial(trained_row, task, price, seed))


if __name__ == "__main__":
    main()
