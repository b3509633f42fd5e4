"""`excite benchmark`: the former name of `excite study run` for a study without agents."""

from __future__ import annotations

from pathlib import Path

import click

from .options import OUT_FILE, computing, json_option, plot_option
from .study import changes, run_study_here, study_in


@click.command(hidden=True)
@click.argument("study", metavar="STUDY")
@changes
@click.option("--out", type=OUT_FILE, metavar="FOLDER", help="Run folder to write.")
@plot_option
@json_option
@computing
def benchmark(
    study: str,
    episodes: int | None,
    seed: int | None,
    estimators: str | None,
    overwrite: bool,
    out: Path | None,
    plot: Path | None,
    as_json: bool,
) -> None:
    """Former name of `excite study run`, for a study without agents."""
    from ..files import require_free_run_folder
    from ..study.run import KIND

    if out is not None:
        require_free_run_folder(out, overwrite, KIND)
    chosen = study_in(study).changed(episodes=episodes, seed=seed, estimators=estimators)
    if chosen.agents or chosen.clairvoyant:
        what = "agents to train" if chosen.agents else "signals to design"
        raise ValueError(f"{study} has {what}: excite study run {study} --out FOLDER")
    run_study_here(chosen, out, as_json, plot, overwrite=overwrite)
