"""Campaigns with rivals and guard on the simulated rig, and each of them decided again.

    python results/campaign/detailed_rig.py --out results/campaign/detailed_rig.json

The rig's plant is `aero2_detailed`, with parameters drawn at random within ± 30 %; `aero2` and
`aero2_lag` are its rivals. The first rounds tell them apart, then the policy plays behind its
guard until half of every 95 % interval is within 0.1 %. Then a new campaign is told the same
records: before each it must ask for what was played, and decide the same after it. Violations are
of the measured outputs of all rounds. Campaigns that are in the file already are kept.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

import excite as ex
from excite.excitation import Replay
from excite.files import write_json

PLANT, RIVALS = "aero2_detailed", ["aero2", "aero2_lag,tau=0.05:0.25"]
TARGETS = {"J_p": "0.1%", "K_pu": "0.1%", "D_p": "0.1%"}


def played(seed: int, folder: Path) -> dict[str, Any]:
    """What came of one campaign."""
    asked: dict[str, Any] = {"rivals": RIVALS, "guard": True, "fast": True, "seed": seed}
    quiet = {"progress": lambda *_: None, "on_warning": lambda _: None}
    campaign = ex.campaign(PLANT, TARGETS, out=folder / "first", **asked, **quiet)
    truth = campaign.records[0].metadata["ended"]["rig"]["true_params"]
    known = campaign.rounds[-1].known
    again, same = ex.Campaign(PLANT, TARGETS, rivals=RIVALS, redesign=False), True
    for record, before in zip(campaign.records, campaign.rounds, strict=True):
        asked_for = again.ask()
        same &= again.playing == before.played
        if isinstance(asked_for, Replay):
            same &= np.array_equal(record.inputs[:-1], asked_for.inputs[: before.num_samples])
        same &= again.tell(record, before.ended).to_dict() == before.to_dict()
    return {
        "seed": seed,
        "plant": campaign.plant.description.name,
        "reason": campaign.reason or campaign.interrupted,
        "samples": campaign.num_samples,
        "rounds": [r.played for r in campaign.rounds],
        "largest": max(r.nearness for r in campaign.rounds),
        "errors": {n: known[n].estimate - truth[n] for n in TARGETS if n in known},
        "ci95_half": {n: known[n].ci95_half for n in TARGETS if n in known},
        "same_decisions": bool(same) and again.reason == campaign.reason,
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The rows in few figures."""
    reached = [r for r in rows if r["reason"] == "every target is reached"]
    inside = {
        n: float(np.mean([abs(r["errors"][n]) <= r["ci95_half"][n] for r in reached]))
        for n in TARGETS
    }
    samples = np.array([r["samples"] for r in reached])
    return {
        "campaigns": len(rows),
        "right_plant": sum(r["plant"] == PLANT for r in rows),
        "reached": len(reached),
        "other_ends": sorted({r["reason"] for r in rows if r not in reached}),
        "violations": sum(r["largest"] >= 1 for r in rows),
        "largest": max(r["largest"] for r in rows),
        "coverage": inside,
        "coverage_of_all_parameters": float(np.mean(list(inside.values()))),
        "samples": {"median": float(np.median(samples)), "most": int(samples.max())},
        "told_again": sum("same_decisions" in r for r in rows),
        "same_decisions": sum(r.get("same_decisions", False) for r in rows),
    }


def main() -> None:
    """Plays campaigns; writes what came of each, and of all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--campaigns", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1000, help="of the first; then the next ones")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    rows = json.loads(asked.out.read_text())["rows"] if asked.out and asked.out.exists() else []
    for seed in range(asked.seed + len(rows), asked.seed + asked.campaigns):
        if len(rows) % 20 == 0:
            jax.clear_caches()  # compiled programs would use up the memory maps of a process
        with tempfile.TemporaryDirectory() as folder:
            rows.append(played(seed, Path(folder)))
        print(json.dumps(rows[-1]), flush=True)
        if asked.out:  # should the next one fail
            write_json(asked.out, {"rows": rows})
    table = {"plant": PLANT, "policy_hash": ex.read_policy(PLANT).hash, "rivals": RIVALS,
             "targets": TARGETS, **summary(rows), "rows": rows}  # fmt: skip
    print(json.dumps({k: v for k, v in table.items() if k != "rows"}, indent=1))
    if asked.out:
        write_json(asked.out, table)


if __name__ == "__main__":
    main()
