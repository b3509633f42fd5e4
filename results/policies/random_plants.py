"""Violations of shipped policies on plants drawn at random from their declared uncertainty.

For a policy without one the initial state is within 2 % of its scale, as in its certificate. The
free motion after the end counts where it did in the training.
And those of `aero2` where one thing differs from the plant's description. Names of policies
choose among them.

    python results/policies/random_plants.py [NAME ...]
"""

from __future__ import annotations

import sys
from collections.abc import Mapping

from excite.environment.falsification import Effort, OnPlant, search
from excite.excitation import Coast, PolicyExcitation
from excite.plant.catalogue import plant_named
from excite.plant.uncertainty import Range, Uncertainty
from excite.policy import read_policy, shipped_policies
from excite.study.falsify import trained_in

SEED = 7
COUNT = 100_000
NOT_DECLARED: dict[str, Range] = {"initial_state": "2%"}
DIFFERENT: dict[str, dict[str, Range]] = {
    "one sample of delay": {"delay_voltage": "0.1:0.1"},
    "a rotor lag of 0.162 s": {"lag_voltage": "0.162:0.162"},
    "m g d_S within 10 %": {"d_S": "10%"},
    "parameters within 40 %": {"parameters": "40%"},
    "parameters within 50 %": {"parameters": "50%"},
}


def main(*names: str) -> None:
    """Prints a line for each policy and condition."""
    for name in names or shipped_policies():
        if name == "aero2":
            for words, ranges in DIFFERENT.items():
                show(name, words, ranges, 2000)
        declared = read_policy(name).provenance.get("uncertainty")
        words = "declared uncertainty" if declared else "initial state within 2 %"
        show(name, words, declared or NOT_DECLARED, COUNT)


def show(name: str, words: str, ranges: Mapping[str, Range], count: int) -> None:
    """Prints the number of violations on plants of a box, and the largest output."""
    policy = read_policy(name)
    plant = plant_named(policy.plant.name)
    spread, _, coast = trained_in(policy, plant)
    box = Uncertainty.of(plant, spread, ranges)
    steps = policy.layout.num_steps
    play = OnPlant(box, *Coast.after(PolicyExcitation.of(policy), steps, coast))
    least = Effort(count, corners=1, noises=1, starts=2, steps=1, more_noises=1, searched_noises=0)
    drawn = search(play, least, SEED).stages[0]
    within = ", ".join(f"{n} {low:g} to {high:g}" for n, (low, high) in box.ranges().items())
    sys.stdout.write(
        f"{name}, {words}: {drawn.violations} violations in {drawn.experiments:,} experiments, "
        f"largest output {drawn.nearness:.3f} of its critical level ({within})\n"
    )
    sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
