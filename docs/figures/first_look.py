"""The README's figure: two experiments on the nominal plant, and what the study says of them."""

import json
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

from excite.excitation.catalogue import excitation_named
from excite.plant import Aero2, params_from
from excite.simulation import run_episode

ROOT = Path(__file__).parents[2]
METHODS = {  # excitation: title, row of results/frontier, colour
    "chirp": ("chirp, ±7.2 V", "chirp", "#767676"),
    "aero2-ideal": ("learned, ±24 V", "gradient D", "#0072B2"),
}


def main() -> None:
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    figure, panels = plt.subplot_mosaic(
        [["u chirp", "u aero2-ideal", "bound"], ["y chirp", "y aero2-ideal", "bound"]],
        figsize=(10, 3.6), layout="constrained",
    )  # fmt: skip
    rows = json.loads((ROOT / "results" / "frontier" / "table.json").read_text())["rows"]
    plant = Aero2()
    for name, (title, method, colour) in METHODS.items():
        made = excitation_named(name, {}, plant)
        run = run_episode(plant, params_from(plant, {}), made, 500, jax.random.key(0))
        u, y = panels[f"u {name}"], panels[f"y {name}"]
        u.step(run.time[: len(run.inputs)], run.inputs[:, 0], color=colour, where="post")
        y.plot(run.time, np.rad2deg(run.outputs[:, 0]), color=colour)
        u.set(title=title, ylim=(-26, 26), ylabel="voltage [V]", xticklabels=[])
        y.set(ylim=(-45, 45), ylabel="pitch [°]", xlabel="time [s]")
        for level, dash in ((30, ":"), (40, "--")):
            for side in (level, -level):
                y.axhline(side, color="#D55E00", linestyle=dash, linewidth=0.8)
        row = next(r for r in rows if (r["method"], r["estimator"]) == (method, "nls"))
        lengths = row["bound_by_length"]
        percent = lengths["cramer_rao_percent"]["D_p"]
        label = title.split(",")[0]
        panels["bound"].loglog(lengths["num_steps"], percent, "o-", color=colour, label=label)
    panels["bound"].set(
        title="how well D_p can be known", xlabel="samples", ylabel="least standard deviation [%]"
    )
    panels["bound"].set_xticks([50, 100, 200, 500], ["50", "100", "200", "500"])
    panels["bound"].minorticks_off()
    panels["bound"].grid(alpha=0.2, which="both")
    panels["bound"].legend()
    figure.savefig(ROOT / "docs" / "figures" / "first-look.png", dpi=130)


if __name__ == "__main__":
    main()
