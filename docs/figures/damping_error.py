"""The figure of docs/damping-error.md, from the committed results."""

import json
from pathlib import Path

import matplotlib.pyplot as plt

ROOT = Path(__file__).parents[2]
STUDIES = {  # sensor noise and its colour (M. Okabe and K. Ito, 2008)
    "damping_encoder": ("0.00063 rad, as an encoder", "#D55E00"),
    "damping": ("0.0002 rad", "#0072B2"),
    "damping_noise_free": ("none", "#767676"),
}
SIGNALS = {"random": "random", "prbs": "PRBS", "chirp": "chirp"}


def main() -> None:
    plt.rcParams.update({"svg.hashsalt": "excite", "svg.fonttype": "none", "font.size": 9})
    figure, panels = plt.subplots(1, 3, figsize=(9, 3.4), sharey=True, layout="constrained")
    for panel, (method, title) in zip(panels, SIGNALS.items(), strict=True):
        for study, (noise, colour) in STUDIES.items():
            start, error = damping_errors(study, method)
            panel.loglog(start, error, "o-", color=colour, markersize=3, label=noise)
        least = 0.8 * bound("damping", method)
        panel.axhline(least, color="#009E73", label="attainable at 0.0002 rad, and by `nls`")
        panel.axvline(1e3, color="black", linewidth=0.8, linestyle=":")
        panel.text(1.4e3, 0.12, "the paper's\nrow (inferred)", fontsize=7, va="bottom")
        panel.set(title=title, xlabel="start covariance $P_0$ (times I)")
        panel.grid(alpha=0.2)
    panels[0].set_ylabel("mean error of $D_p$ [%]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, title="sensor noise")
    figure.savefig(ROOT / "docs" / "figures" / "damping-error.svg", metadata={"Date": None})


def rows(study: str, method: str) -> list[dict]:
    table = json.loads((ROOT / "results" / study / "table.json").read_text())
    return [row for row in table["rows"] if row["method"] == method]


def damping_errors(study: str, method: str) -> tuple[list[float], list[float]]:
    """Start covariances, and mean errors of D_p with them in percent."""
    found = rows(study, method)
    start = [float(row["estimator"].removeprefix("P0 = ")) for row in found]
    return start, [row["relative_error_percent"]["D_p"]["mean"] for row in found]


def bound(study: str, method: str) -> float:
    return rows(study, method)[0]["cramer_rao_percent"]["D_p"]


if __name__ == "__main__":
    main()
