"""The agents of the committed studies, evaluated again on the same plants and noise.

    python results/evaluate_again.py                    # the first agent of each study
    python results/evaluate_again.py cart_pole --write  # all agents of one; keeps their rows

Only the first seed of an agent is evaluated. Numbers are compared as they are printed: three digits
of the errors and the bound, four of the information. The errors of `oed_location_finding` depend on
rounding, and so on the processor: two sources have many local optima. After `--write`, `excite
study run` with the same folder makes the table again.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from excite.excitation import PolicyExcitation
from excite.files import write_json
from excite.policy import read_policy
from excite.study.folder import read_json, seed_folder, study_of
from excite.study.methods import evaluate_method

_RESULTS = Path(__file__).parent


def _printed(row: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """The numbers of a row as a table shows them."""
    yield "log det", f"{row['log_det_information']:.4g}"
    yield "violations", f"{row['violations']}/{row['evaluations']}"
    yield "failed", f"{row['failed']}"
    for name, error in row["relative_error_percent"].items():
        yield name, f"{error['mean']:.3g} ± {error['sd']:.3g}"
        yield f"bound of {name}", f"{row['cramer_rao_percent'][name]:.3g}"


def _again(folder: Path, agent: str, keep: bool) -> int:
    """How many printed numbers differ; `keep` replaces the rows."""
    study, place = study_of(folder), seed_folder(folder, agent, 0)
    policy = read_policy(place / "policy.safetensors")
    rows, _ = evaluate_method(study, study.build_plant(), agent, PolicyExcitation.of(policy))
    metrics = read_json(place / "metrics.json", "rows")
    new, count = [row.data() for row in rows], 0
    for before, after in zip(metrics["rows"], new, strict=True):
        for (name, old), (_, now) in zip(_printed(before), _printed(after), strict=True):
            if old != now:
                print(f"  {before['estimator']}, {name}: {old} before, {now} now")
                count += 1
    if keep:
        write_json(place / "metrics.json", {**metrics, "rows": new})
    return count


def main(arguments: list[str]) -> int:
    """Evaluates; the exit code says whether a number differs."""
    keep = "--write" in arguments
    chosen = [name for name in arguments if name != "--write"]
    with_agents = sorted(place.parent for place in _RESULTS.glob("*/seeds"))
    folders = [_RESULTS / name for name in chosen] or with_agents
    differing = 0
    for folder in folders:
        agents = list(study_of(folder).agents)
        for agent in agents if chosen else agents[:1]:
            print(f"{folder.name}, {agent}, seed 0", flush=True)
            differing += _again(folder, agent, keep)
    print(f"{differing} numbers differ")
    return min(differing, 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
