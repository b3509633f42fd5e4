"""Campaigns that are killed (kill -9) at random moments, and resumed.

    python results/campaign/killed.py --out results/campaign/killed.json

Campaigns run in real time on the simulated rig, one after the other. Each is killed at a random
moment of its first minute and started again with the same command, until it ends. So is one that
is interrupted, as where a busy computer misses deadlines. After every end it is checked that no
record of an earlier round has changed since, and at the last that each record is one round, that
rounds follow each other without a gap, and that its targets are reached. With --carry, a record may
be of several rounds, and end with a pause.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import shutil
import subprocess
import sys
from pathlib import Path

import excite as ex
from excite.files import write_json

TARGETS = "D_p=0.2%,J_p=0.2%"
PRIOR = ["--prior", "J_p=lognormal:0.0232:20%", "--prior", "K_pu=lognormal:0.0125:20%",
         "--prior", "D_p=lognormal:0.00104:20%"]  # fmt: skip
LONGEST = 60.0


def records(folder: Path) -> dict[str, bytes]:
    """Of all rounds, by file name; those that have at least one sample."""
    found = {path.name: path.read_bytes() for path in sorted(folder.glob("round-*.csv"))}
    return {name: content for name, content in found.items() if len(content.splitlines()) > 2}


def main() -> None:
    """Kills campaigns until it was done as often as asked; prints and writes what was seen."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--carry", type=int, help="as for excite campaign, without a policy")
    parser.add_argument("--folder", type=Path, default=Path("runs/killed"))
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    draw = random.Random(asked.seed)
    kills: list[dict[str, object]] = []
    interrupted: list[str] = []
    campaigns: list[dict[str, object]] = []
    while len(kills) < asked.kills:
        folder = asked.folder / str(len(campaigns))
        shutil.rmtree(folder, ignore_errors=True)
        command = [
            sys.executable, "-m", "excite", "campaign", "aero2", "--target", TARGETS,
            "--seed", str(len(campaigns)), "--out", str(folder),
            *(["--carry", str(asked.carry), "--steps", "40", "--policy", "none", *PRIOR]
              if asked.carry else []),
        ]  # fmt: skip
        kept: dict[str, bytes] = {}
        while True:
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
            after = draw.uniform(1.0, LONGEST)
            try:
                told = process.communicate(timeout=after if len(kills) < asked.kills else None)[1]
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
                told = None
            now = records(folder)
            changed = [name for name, content in kept.items() if now.get(name) != content]
            if changed:
                sys.exit(f"{folder}: {changed} changed after a kill")
            if told is None:
                samples = {name: len(content.splitlines()) - 2 for name, content in now.items()}
                about = {"campaign": len(campaigns), "after": round(after, 1)}
                kills.append({**about, "samples": samples})
                print(json.dumps(kills[-1]), flush=True)
                kept = now
                continue
            ended = json.loads((folder / "campaign.json").read_text())
            if ended["interrupted"]:  # such as missed deadlines on a busy computer
                interrupted.append(ended["interrupted"])
                print(folder, interrupted[-1], flush=True)
                kept = now
                continue
            lengths = [len(ex.read_record(folder / name).time) - 1 for name in now]
            first = [int(name[6:8]) - 1 for name in now]
            counts = [r["num_samples"] for r in ended["rounds"]]
            sums = [sum(counts[i:j]) for i, j in itertools.pairwise([*first, len(counts)])]
            if asked.carry is None and first != [*range(len(counts))]:
                sys.exit(f"{folder}: rounds {list(now)}")
            if any(
                not 0 <= n - t <= (asked.carry or 0) for n, t in zip(lengths, sums, strict=True)
            ):
                sys.exit(f"{folder}: the rounds {counts} are not the records {lengths}")
            if (ended["reason"], process.returncode) != ("every target is reached", 0):
                sys.exit(f"{folder}: {ended['reason']}, exit code {process.returncode}")
            campaigns.append({"reason": ended["reason"], "exit_code": process.returncode,
                              "rounds": counts if asked.carry else lengths})  # fmt: skip
            print(json.dumps(campaigns[-1]), told.decode()[-300:], flush=True)
            break
    table = {"targets": TARGETS, "kills": kills, "interrupted": interrupted, "campaigns": campaigns}
    if asked.out:
        write_json(asked.out, table)


if __name__ == "__main__":
    main()
