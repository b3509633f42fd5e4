"""The figure of docs/tutorials/rig.md: its first command, and the record it leaves."""

import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

ROOT = Path(__file__).parents[2]


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rehearsal.csv"
        words = ["run", "--rig", "simulated", "--fast", "--seed", "3", "--out"]
        subprocess.run(
            [sys.executable, "-m", "excite", *words, str(file)], check=True, stdout=subprocess.PIPE
        )
        record = np.genfromtxt(file, delimiter=",", names=True)
    plt.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False})
    figure, (above, below) = plt.subplots(2, 1, figsize=(8, 3.2), sharex=True, layout="constrained")
    above.step(record["time"], record["voltage"], color="#0072B2", linewidth=0.8, where="post")
    above.set(title="excite run --rig simulated --fast --seed 3", ylabel="voltage [V]")
    below.plot(record["time"], np.rad2deg(record["pitch"]), color="#0072B2", linewidth=0.8)
    below.set(xlabel="time [s]", ylabel="pitch [°]", ylim=(-45, 45))
    for level, dash in ((30, ":"), (40, "--")):
        for side in (level, -level):
            below.axhline(side, color="#D55E00", linestyle=dash, linewidth=0.8)
    figure.savefig(ROOT / "docs" / "figures" / "rig.png", dpi=120)


if __name__ == "__main__":
    main()
