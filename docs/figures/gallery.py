"""The figures of docs/reference/gallery.md: input, response and information of each excitation."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import excite as ex

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "figures" / "gallery"
ROBUST = str(ROOT / "studies" / "frontier_robust.csv")
SIGNALS = {  # file: plant, excitation, options
    "random": ("aero2", "random", {}),
    "prbs": ("aero2", "prbs", {}),
    "chirp": ("aero2", "chirp", {}),
    "multisine": ("aero2", "multisine", {}),
    "square": ("aero2", "square", {}),
    "decay": ("aero2", "decay", {"amplitude": 1.0, "frequency": 0.149, "pump": 0.2}),
    "loop": ("emps", "loop-multisine", {"amplitude": 0.05, "gain": 2000.0, "damping": 300.0}),
    "robust": ("aero2", ROBUST, {}),
}
POLICIES = {
    "aero2": "aero2", "aero2-goals": "aero2", "aero2-damping": "aero2", "aero2-ppo-all": "aero2",
    "aero2-ppo-J_p": "aero2", "aero2-ppo-K_pu": "aero2", "aero2-ppo-D_p": "aero2",
    "aero2_lag": "aero2_lag", "aero2_detailed": "aero2_detailed", "dc_motor": "dc_motor",
    "cart_pole": "cart_pole", "emps": "emps",
}  # fmt: skip
BLUE, ORANGE = "#0072B2", "#D55E00"


def main() -> None:
    plt.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False})
    FOLDER.mkdir(exist_ok=True)
    shown = SIGNALS | {name: (plant, name, {}) for name, plant in POLICIES.items()}
    for file, (plant, excitation, options) in shown.items():
        draw(file, plant, excitation, options)


def draw(file: str, plant: str, excitation: str, options: dict) -> None:
    """Input, first output that has a critical level (or the first), and the bounds."""
    record = ex.simulate(plant, excitation, options=options)
    bounds = ex.information(plant, excitation, options=options)
    outputs = record.description.outputs
    i = next((i for i, o in enumerate(outputs) if o.critical_level is not None), 0)
    output, input = outputs[i], record.description.inputs[0]
    factor, unit = (180 / np.pi, "°") if output.unit == "rad" else (1.0, output.unit)
    figure, (left, middle, right) = plt.subplots(
        1, 3, figsize=(9, 1.9), width_ratios=(3, 3, 2), layout="constrained"
    )
    left.step(record.time, record.inputs[:, 0], color=BLUE, linewidth=0.7, where="post")
    left.set(xlabel="time [s]", ylabel=f"{input.name} [{input.unit}]")
    middle.plot(record.time, factor * record.outputs[:, i], color=BLUE, linewidth=0.9)
    middle.set(xlabel="time [s]", ylabel=f"{output.name} [{unit}]")
    for level in filter(None, (output.warning_level, output.critical_level)):
        dash = "--" if level == output.critical_level else ":"
        for side in (level, -level):
            middle.axhline(factor * side, color=ORANGE, linestyle=dash, linewidth=0.8)
    percent = {name: bound.cramer_rao_percent for name, bound in bounds.params.items()}
    right.barh(list(percent), [p or np.nan for p in percent.values()], color=BLUE, height=0.5)
    right.set_xscale("log")
    right.set(title=f"log det {bounds.log_det_information:.1f}", xlabel="least sd [%]")
    right.invert_yaxis()
    figure.savefig(FOLDER / f"{file}.png", dpi=90)
    plt.close(figure)


if __name__ == "__main__":
    main()
