"""The figure of docs/tutorials/own-plant.md: its plant under a multisine."""

import subprocess
import sys
from pathlib import Path

FIGURES = Path(__file__).parent
PLANT = FIGURES.parents[1] / "examples" / "flexible_drive.py"


def main() -> None:
    words = ["simulate", f"{PLANT}:FlexibleDrive", "--excitation", "multisine"]
    file = FIGURES / "own-plant.png"
    subprocess.run([sys.executable, "-m", "excite", *words, "--plot", str(file)], check=True)


if __name__ == "__main__":
    main()
