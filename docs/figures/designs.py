"""The figure of docs/how-to/designing-an-excitation.md, from results/frontier."""

import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

ROOT = Path(__file__).parents[2]
METHODS = {  # of the study: title
    "chirp": "chirp",
    "chirp tuned": "tuned chirp",
    "robust": "robust signal",
    "gradient D": "policy aero2",
}


def main() -> None:
    plt.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False})
    episodes = json.loads((ROOT / "results" / "frontier" / "episodes.json").read_text())
    figure, panels = plt.subplots(
        2, len(METHODS), figsize=(9, 3), sharex=True, sharey="row", layout="constrained"
    )
    for (method, title), (above, below) in zip(METHODS.items(), panels.T, strict=True):
        episode = episodes[method]
        time, [(_, voltage)] = episode["time"], episode["inputs"].items()
        above.step(time[: len(voltage)], voltage, color="#0072B2", linewidth=0.7, where="post")
        below.plot(time, np.rad2deg(episode["outputs"]["pitch"]), color="#0072B2", linewidth=0.7)
        above.set_title(title)
        below.set_xlabel("time [s]")
        for level, dash in ((30, ":"), (40, "--")):
            for side in (level, -level):
                below.axhline(side, color="#D55E00", linestyle=dash, linewidth=0.8)
    panels[0, 0].set_ylabel("voltage [V]")
    panels[1, 0].set_ylabel("pitch [°]")
    figure.savefig(ROOT / "docs" / "figures" / "designs.png", dpi=120)


if __name__ == "__main__":
    main()
