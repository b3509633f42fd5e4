"""The experiment that the page shows before anything is run: the events of the default one.

`python -m excite.web.first` writes them to `static/first.json`, with five digits a number,
eight of an estimate, which is shown by its small distance from the true value, four of inputs and
information over time and three of bounds, as many as a plot tells.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from ..files import json_ready, write_bytes
from . import jobs

FILE = Path(__file__).with_name("static") / "first.json"
DIGITS = {"estimate": 8, "inputs": 4, "log_det": 4, "bound_percent": 3}


def events() -> list[dict[str, Any]]:
    """What a stream sends: the plan, all samples, estimates and comparisons."""
    episode: dict[str, Any] = dict(next(jobs.episode(jobs.DEFAULT)))
    signals = ("time", "inputs", "outputs")
    plan = {name: value for name, value in episode.items() if name not in signals}
    samples = {"kind": "samples", **{name: episode[name] for name in signals}}
    with tempfile.TemporaryDirectory() as folder:
        followed = list(jobs.followed(jobs.DEFAULT, f"{folder}/run"))
    plan |= {"kind": "plan", "num_samples": len(episode["time"])}
    return [_shortened(json_ready(event)) for event in [plan, samples, *followed]]


def _shortened(value: Any, digits: int = 5) -> Any:
    """The same with numbers of so many digits."""
    if isinstance(value, dict):
        return {
            name: _shortened(part, DIGITS.get(name, digits))
            for name, part in value.items()
            if name != "profiles"
        }
    if isinstance(value, list):
        return [_shortened(part, digits) for part in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


if __name__ == "__main__":
    write_bytes(FILE, json.dumps(events(), separators=(",", ":")).encode())
