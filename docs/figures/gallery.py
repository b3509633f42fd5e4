"""The figures of docs/reference/gallery.md, from the committed results."""

import json
import re
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "figures" / "gallery"
SHOWN = {  # file: study and method
    "random": ("frontier", "random"),
    "prbs": ("frontier", "prbs"),
    "chirp": ("frontier", "chirp"),
    "multisine": ("frontier", "multisine tuned"),
    "square": ("frontier", "square tuned"),
    "decay": ("decay", "decay 1 V"),
    "loop": ("emps", "loop-multisine tuned"),
    "robust": ("frontier", "robust"),
    "aero2": ("robust", "gradient D"),
    "aero2-wide": ("wide", "gradient A"),
    "aero2-ideal": ("frontier", "gradient D"),
    "aero2-goals": ("frontier", "gradient goals"),
    "aero2-damping": ("robust", "gradient D_p"),
    "aero2_lag": ("aero2_lag", "gradient D"),
    "aero2_detailed": ("sim_to_real", "gradient robust"),
    "dc_motor": ("dc_motor", "gradient D"),
    "dc_motor-wide": ("dc_motor_wide", "gradient(A)"),
    "cart_pole": ("cart_pole", "gradient D"),
    "cart_pole-wide": ("cart_pole_wide", "gradient(A)"),
    "emps": ("emps", "gradient D"),
    "emps-wide": ("emps_wide", "gradient(A)"),
    "aero2-ppo-all": ("table1", "RL(all)"),
    "aero2-ppo-J_p": ("table1", "RL(J_p)"),
    "aero2-ppo-K_pu": ("table1", "RL(K_pu)"),
    "aero2-ppo-D_p": ("table1", "RL(D_p)"),
}
BLUE, ORANGE = "#0072B2", "#D55E00"


def main() -> None:
    plt.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False})
    FOLDER.mkdir(exist_ok=True)
    for file, (study, method) in SHOWN.items():
        draw(file, study, method)
    for heading in without_figure((ROOT / "docs" / "reference" / "gallery.md").read_text()):
        print(f"no figure of {heading}")


def without_figure(page: str) -> list[str]:
    """Headings of excitations under which the page shows no figure."""
    sections = re.split(r"^### ", page, flags=re.M)[1:]
    return [section.partition("\n")[0] for section in sections if "![" not in section]


def read(study: str, name: str) -> dict:
    return json.loads((ROOT / "results" / study / f"{name}.json").read_text())


def draw(file: str, study: str, method: str) -> None:
    """One episode, and the mean bounds of all: input, first output, least deviations."""
    plant, episode = read(study, "run")["plant"], read(study, "episodes")[method]
    row = next(row for row in read(study, "table")["rows"] if row["method"] == method)
    input, output, time = plant["inputs"][0], plant["outputs"][0], episode["time"]
    factor, unit = (180 / np.pi, "°") if output["unit"] == "rad" else (1.0, output["unit"])
    figure, (left, middle, right) = plt.subplots(
        1, 3, figsize=(9, 1.9), width_ratios=(3, 3, 2), layout="constrained"
    )
    played = episode["inputs"][input["name"]]
    left.step(time[: len(played)], played, color=BLUE, linewidth=0.7, where="post")
    left.set(xlabel="time [s]", ylabel=f"{input['name']} [{input['unit']}]")
    response = factor * np.array(episode["outputs"][output["name"]])
    middle.plot(time[: len(response)], response, color=BLUE, linewidth=0.9)
    middle.set(xlabel="time [s]", ylabel=f"{output['name']} [{unit}]")
    for level, dash in (("warning_level", ":"), ("critical_level", "--")):
        for side in (1, -1) if output[level] is not None else ():
            middle.axhline(side * factor * output[level], color=ORANGE, ls=dash, lw=0.8)
    percent = row["cramer_rao_percent"]
    right.barh(list(percent), list(percent.values()), color=BLUE, height=0.5)
    for place, value in enumerate(percent.values()):
        right.text(value, place, f" {value:.2g}", va="center", fontsize=7)
    right.set(xscale="log", xlabel="least standard deviation [%]")
    right.set_xlim(min(percent.values()) / 3, 4 * max(percent.values()))
    if row["log_det_information"] is not None:
        right.set_title(f"log det {row['log_det_information']:.1f}", fontsize=8)
    right.invert_yaxis()
    figure.savefig(FOLDER / f"{file}.png", dpi=90)
    plt.close(figure)


if __name__ == "__main__":
    main()
