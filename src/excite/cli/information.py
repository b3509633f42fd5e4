"""`excite information`: how precisely an experiment can determine each parameter."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import click

from .options import (
    OUT_FILE,
    computing,
    json_option,
    plot_option,
    progress_bar,
    show_json,
)
from .simulate import excitation_options, given_experiment, show_warnings


@click.command()
@click.argument("plant")
@click.argument("input_file", required=False, type=OUT_FILE)
@excitation_options
@click.option(
    "--initial-state",
    type=click.Choice(["known", "free"]),
    help="free: estimated too; default known, for a file only where its sidecar says so.",
)
@plot_option
@json_option
@computing
def information(
    plant: str, input_file: Path | None, initial_state: Literal["free", "known"] | None,
    plot: Path | None, as_json: bool, **options: Any,
) -> None:  # fmt: skip
    """Smallest possible standard deviation of each parameter of PLANT (Cramér-Rao bound).

    For an excitation, or for the recorded or designed input in INPUT_FILE.
    """
    from ..information import information as verb

    given = given_experiment(plant, input_file, options)
    with progress_bar("information"):
        result = verb(**given, initial_state=initial_state or "auto")
    show_warnings(result.warnings)
    if plot is not None:
        from ..record.figure import save

        save(result.plot(), plot)
    if as_json:
        show_json(result.to_dict())
    else:
        click.echo(result)
