"""Whether whole campaigns are safe on plants that also have delay, lag and another stiffness.

    python results/campaign/uncertain.py --out results/campaign/uncertain.json

The plant is `aero2` as the training of `aero2-wide-robust` declared it: J_p, K_pu and D_p within a
factor of three, up to one sample of delay, a lag, m g d_S and the initial state. Campaigns know
nothing of these: they identify `aero2`, and play the policy, or a signal that is redesigned for
what they believe. Every round is played to its last sample, and its free motion follows. Campaigns
that are in the file already are kept.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

import excite as ex
from excite.environment.falsification import nearness
from excite.excitation import Coast, PolicyExcitation
from excite.files import write_json
from excite.plant.catalogue import plant_from
from excite.plant.uncertainty import Uncertainty
from excite.record import Record
from excite.simulation import run_episode

POLICY = Path(__file__).parent / "policies" / "aero2-wide-robust.safetensors"
TARGETS, ROUNDS = {"J_p": "0.1%", "K_pu": "0.1%", "D_p": "0.1%"}, 3


@eqx.filter_jit
def played(box, point, excitation, num_steps, coast, key):
    """Inputs and outputs of a round, and the largest output over its level, coast included."""
    plant, params = box.at(point)
    whole, length = Coast.after(excitation, num_steps, coast)
    run = run_episode(plant, params, whole, length, key)
    return run.inputs[:num_steps], run.measured[: num_steps + 1], nearness(plant, run.outputs)


def campaign_on(box: Uncertainty, policy: ex.Policy, seed: int) -> dict[str, Any]:
    """What came of one campaign."""
    point_key, *keys = jax.random.split(jax.random.key(seed), ROUNDS + 1)
    point, largest = box.draw(point_key), []
    campaign = ex.Campaign("aero2", TARGETS, policy=policy, rounds=ROUNDS)
    for key in keys:
        if (asked := campaign.ask()) is None:
            break
        excitation = PolicyExcitation.of(asked) if isinstance(asked, ex.Policy) else asked
        inputs, outputs, size = played(box, point, excitation, campaign.steps, campaign.coast, key)
        largest.append(float(size))
        time = np.arange(len(outputs)) * float(box.plant.dt)
        campaign.tell(Record.of_episode(time, inputs, outputs))
    return {
        "campaigns": 1,
        "rounds": len(campaign.rounds),
        "redesigned": sum(r.played == "redesigned" for r in campaign.rounds),
        "warned": int(bool(campaign.warnings)),
        "violations": int(max(largest) >= 1),
        "largest": max(largest),
    }


def main() -> None:
    """Plays campaigns; writes what came of each, and of all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--campaigns", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=50_000, help="of the first; then the next")
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    policy = ex.read_policy(POLICY)
    ranges = policy.provenance["uncertainty"]
    box = Uncertainty.of(plant_from("aero2"), policy.provenance["spread"], ranges)
    table: dict[str, Any] = {"policy_hash": policy.hash, "uncertainty": ranges, "campaigns": 0}
    if asked.out.exists():
        table = json.loads(asked.out.read_text())
    for seed in range(asked.seed + table["campaigns"], asked.seed + asked.campaigns):
        own = campaign_on(box, policy, seed)
        largest = max(table.get("largest", 0.0), own.pop("largest"))
        table |= {name: table.get(name, 0) + count for name, count in own.items()}
        table["largest"] = largest
        write_json(asked.out, table)
        print(json.dumps(table), flush=True)


if __name__ == "__main__":
    main()
