"""A policy that finds two sources, by gradient, and what it is expected to tell.

    python results/oed/location_finding.py [--seed N ...] [--plants 256] [--samples 100000]

Trains one policy for each seed, default 1, and evaluates it and random designs with samples from
the prior. Rows that are in the table already are not computed again.
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
from excite.plant.catalogue import plant_named
from excite.policy import Layout, Policy
from excite.training.gradient import train
from excite.training.settings import GradientSettings

HERE = Path(__file__).parent
TABLE = HERE / "location_finding.json"
WORD = f"{HERE.parent.parent / 'examples' / 'location_finding.py'}:TwoSources"
PRIOR = dict.fromkeys(("x_1", "y_1", "x_2", "y_2"), "normal:0:1")
STEPS = 30
SETTINGS = GradientSettings(
    num_updates=7000, num_plants=256, learning_rate=2e-3, hidden=(128,), last_gain=0.3,
    watch_every=700, watch_episodes=512, through_measurements=False,
)  # fmt: skip


def env():
    """The decision process whose total reward is the gain in nats, by normal approximations."""
    plant = plant_named(WORD)
    prior = plants_of(plant, PRIOR)
    objective = InformationGain((True,) * 4, 1.0, 0.5, dense=False, prior=prior)
    layout = Layout.of(plant.description, window=1, num_steps=STEPS, memory=64)
    return Env.of(plant, objective=objective, layout=layout, prior=prior)


def row(method, excitation, asked, **about):
    """What an excitation is expected to tell, on plants that no training has seen."""
    found = ex.information_gain(
        WORD, excitation, steps=STEPS, prior=PRIOR, plants=asked.plants, samples=asked.samples,
        from_prior=True, seed=1,
    )  # fmt: skip
    content = {"task": "location finding", "method": method, **about, **found.to_dict()}
    return {k: v for k, v in content.items() if k not in ("plant", "excitation")}


def trained_row(asked, seed):
    """Of a trained policy, which is written beside the table."""
    process, start = env(), time.process_time()
    trained = train(process, SETTINGS, seed)
    seconds = time.process_time() - start
    about = {"excite": ex.__version__, "task": "location finding", "seed": seed}
    policy = Policy(process.plant.description, process.layout, trained.weights, about)
    policy.save(HERE / f"location_finding-{seed}.safetensors", overwrite=True)
    return row("gradient", policy, asked, seed=seed, train_cpu_seconds=seconds)


def main():
    """Computes what is missing in the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, nargs="+", default=[1])
    parser.add_argument("--plants", type=int, default=256)
    parser.add_argument("--samples", type=int, default=100_000)
    asked = parser.parse_args()
    rows = json.loads(TABLE.read_text())["rows"] if TABLE.is_file() else []
    if any((r["num_plants"], r["num_samples"]) != (asked.plants, asked.samples) for r in rows):
        parser.error(f"{TABLE.name} has rows of another number of plants or samples: remove it")
    done = {(r["method"], r.get("seed")) for r in rows}
    makers = {("random", None): partial(row, "random", Random(hold=1), asked)}
    makers |= {("gradient", s): partial(trained_row, asked, s) for s in asked.seed}
    for key, make in makers.items():
        if key not in done:
            rows.append(make())
            TABLE.write_text(json.dumps({"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
