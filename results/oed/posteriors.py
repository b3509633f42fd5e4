"""How often posteriors of a disturbed pendulum hold the true parameters.

    python results/oed/posteriors.py [--experiments 500]

Each experiment is that of a committed policy on another plant drawn from the prior. Its posterior
is computed by a normal approximation (Laplace: `identify` with the prior) and by samples (the
no-U-turn sampler, two chains of 500). Counts are written after every 25 experiments, and the script
goes on where it was interrupted.
"""

import argparse
import json

import compute
import jax

import excite as ex
from excite.estimation import NLS
from excite.estimation.prior_knowledge import plants_of
from excite.plant.catalogue import plant_named

TASK, PRICE, SEED = "nonlinear pendulum", 0.0, 0
TABLE = compute.HERE / "posteriors.json"


def intervals(task, number):
    """True parameters of an experiment, and its 95 % intervals by both ways."""
    plant = plant_named(task.word)
    true = plants_of(plant, task.prior).draw(jax.random.fold_in(jax.random.key(7), number))
    policy = compute.policy_path(TASK, PRICE, SEED)
    record = ex.simulate(plant, policy, params=true, seed=number)
    found = ex.identify(record, plant, estimator=NLS(noise="known"), prior=task.prior)
    drawn = found.posterior(num_samples=500, chains=2, seed=number)["posterior"].dataset
    sampled = {name: drawn[name].quantile([0.025, 0.975]).values for name in found.params}
    linear = {name: found.ci95(name) for name in found.params}
    return true._asdict(), {"laplace": linear, "nuts": sampled}


def main():
    """Counts the intervals that hold."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--experiments", type=int, default=500)
    asked, task = parser.parse_args(), compute.TASKS[TASK]
    kept = json.loads(TABLE.read_text()) if TABLE.is_file() else {"experiments": 0, "inside": {}}
    inside = kept["inside"]
    for number in range(kept["experiments"], asked.experiments):
        true, found = intervals(task, number)
        for way, ends in found.items():
            counts = inside.setdefault(way, dict.fromkeys(true, 0))
            for name, (low, high) in ends.items():
                counts[name] += bool(low <= true[name] <= high)
        if (number + 1) % 25 == 0 or number + 1 == asked.experiments:
            about = {"task": TASK, "experiments": number + 1, "inside": inside}
            TABLE.write_text(json.dumps(about, indent=1) + "\n")


if __name__ == "__main__":
    main()
