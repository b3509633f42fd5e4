"""`excite information`: how well an experiment can determine each parameter at best."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import (
    OUT_FILE,
    computing,
    json_option,
    plot_option,
    progress_bar,
    show_json,
    show_table,
)
from .simulate import excitation_options, prepared


@click.command()
@click.argument("plant")
@click.argument("input_file", required=False, type=OUT_FILE)
@excitation_options
@click.option(
    "--initial-state",
    type=click.Choice(["known", "free"]),
    help="Whether it must be estimated along; default known, for a file only where its "
    "sidecar says so.",
)
@plot_option
@json_option
@computing
def information(
    plant: str, input_file: Path | None, initial_state: str | None, plot: Path | None,
    as_json: bool, **options: Any,
) -> None:  # fmt: skip
    """Standard deviation that each parameter of PLANT can at best reach (Cramér-Rao bound).

    For an excitation, or for the recorded or designed input in INPUT_FILE.
    """
    import numpy as np

    from ..information import best_possible
    from ..record import Record
    from ..report.figure import save
    from ..report.figures import information_figure
    from ..simulation import run_episode

    job = prepared(options, plant, input_file)
    chosen, record = job["plant"], job["record"]
    if initial_state is None:
        elsewhere = record is not None and not record.starts_at_initial_state
        initial_state = "free" if elsewhere else "known"
    known = initial_state == "known"
    with progress_bar("information"):
        inputs = run_episode(
            chosen, job["params"], job["excitation"], job["steps"], job["key"]
        ).inputs
        result = best_possible(chosen, job["params"], inputs, initial_state_known=known)
    if plot is not None:
        time = np.arange(len(inputs) + 1) * float(chosen.dt)
        drawn = Record.of_episode(time, inputs, np.empty((len(time), 0)))
        percent = {n: p["cramer_rao_percent"] for n, p in result["params"].items()}
        save(information_figure(chosen.description, drawn, percent), plot)
    if as_json:
        kept = {"num_steps": job["steps"], "warnings": job["warnings"]}
        show_json({**result, "excitation": job["excitation_name"], **kept})
    else:
        _show(chosen.description, result, job)


def _show(description: Any, result: dict[str, Any], job: dict[str, Any]) -> None:
    from ..report.numbers import number

    show_table(
        f"{description.name}, {job['excitation_name']}, {job['steps']} steps, "
        f"initial state {result['initial_state']}: best possible standard deviation",
        ["symbol", "unit", "value", "standard deviation", "percent"],
        [
            [
                n,
                p["unit"],
                number(p["value"], 5),
                number(p["cramer_rao_bound"]),
                number(p["cramer_rao_percent"]),
            ]
            for n, p in result["params"].items()
        ],
    )
    click.echo(
        f"relative information: log det {number(result['log_det_information'], 4)}, "
        f"trace of the inverse {number(result['a_optimality'])}, "
        f"smallest eigenvalue {number(result['e_optimality'])}"
    )
    for sentence in result["verdict"]:
        click.echo(sentence)
