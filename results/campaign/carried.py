"""Campaigns whose rounds go on from the state of the last one, beside those that wait for rest.

    python results/campaign/carried.py --out results/campaign/carried.json

Whole campaigns of `aero2` without a policy, on the simulated rig without jitter. The parameters are
anywhere within 30 % of their nominal values, and known to 20 % (one standard deviation) before.
Rounds have 40 samples; without rest, 10 samples of the safe input before them count, too. Both
ways see the same plants. The nearness is that of the true outputs, with pauses and 100 samples of
free motion after every record. Campaigns that are in the file already are kept.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import excite as ex
from excite.environment.falsification import nearness
from excite.files import read_json, write_json
from excite.plant.catalogue import plant_from
from excite.simulation import response
from excite.study.campaign import REACHED

NOMINAL = {"J_p": 0.0232, "K_pu": 0.0125, "D_p": 0.00104}
PRIOR = {name: f"lognormal:{value}:20%" for name, value in NOMINAL.items()}
WAYS = {"from rest": None, "without rest": 10}


def campaign_on(seed: int, target: str, carry: int | None) -> dict[str, Any]:
    """What came of one campaign."""
    plant, coast = plant_from("aero2"), np.zeros((100, 1))
    with tempfile.TemporaryDirectory() as folder:
        made = ex.campaign(
            "aero2", dict.fromkeys(NOMINAL, target), policy="none", prior=PRIOR, steps=40,
            rounds=8, carry=carry, fast=True, seed=seed, out=folder, fault={"jitter": 0.0},
        )  # fmt: skip
        sizes = []
        for file in sorted(Path(folder).glob("round-*.csv")):
            true = read_json(file.with_suffix(".json"), "ended")["ended"]["rig"]["true_params"]
            played = ex.read_record(file).inputs[:-1]
            outputs = response(plant, plant.Params(**true), jnp.concatenate([played, coast]))
            sizes.append(float(nearness(plant, outputs)))
        known = made.known
    return {
        "samples": made.num_samples,
        "reached": made.reason == REACHED,
        "rounds": len(made.rounds),
        "rests": len(made.records) - 1,
        "nearness": max(sizes),
        "held": sum(abs(known[n].estimate - true[n]) <= known[n].ci95_half for n in NOMINAL),
    }


def summary(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Of all campaigns of one way."""
    samples = [c["samples"] if c["reached"] else np.inf for c in found]
    median, most = np.quantile(samples, [0.5, 0.9], method="inverted_cdf")
    return {
        "campaigns": len(found),
        "reached": sum(c["reached"] for c in found),
        "samples, median": float(median),
        "samples, 90 %": float(most),
        "rounds, mean": float(np.mean([c["rounds"] for c in found])),
        "rests, mean": float(np.mean([c["rests"] for c in found])),
        "violations": sum(c["nearness"] >= 1 for c in found),
        "largest": max(c["nearness"] for c in found),
        "intervals that hold, %": 100 * sum(c["held"] for c in found) / (3 * len(found)),
    }


def main() -> None:
    """Plays campaigns both ways; writes what came of each, and of all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--campaigns", type=int, default=60)
    parser.add_argument("--seed", type=int, default=70_000, help="of the first; then the next")
    parser.add_argument("--target", default="0.3%", help="of every parameter")
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    each: dict[str, list[dict[str, Any]]] = {way: [] for way in WAYS}
    if asked.out.exists():
        each = json.loads(asked.out.read_text())["each"]
    for i in range(asked.campaigns):
        for way, carry in WAYS.items():
            if i >= len(each[way]):
                each[way].append(campaign_on(asked.seed + i, asked.target, carry))
        told = {way: summary(found) for way, found in each.items()}
        write_json(asked.out, {"target": asked.target, "seed": asked.seed, **told, "each": each})
    print(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
