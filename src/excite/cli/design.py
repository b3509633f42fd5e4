"""`excite design`: an open-loop signal to be played on a rig."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .completion import signals
from .options import (
    NUMBERS,
    OUT_FILE,
    SPREAD,
    WholeNumber,
    coast_option,
    computing,
    json_option,
    merged,
    plot_option,
    progress_bar,
    show_json,
    uncertainty_option,
)


@click.command()
@click.argument("plant")
@click.option(
    "--criterion",
    type=click.Choice(["D", "A", "E"]),
    default="D",
    show_default=True,
    help="Criterion of the Fisher information: determinant, trace of the inverse, or "
    "smallest eigenvalue.",
)
@click.option("--out", type=OUT_FILE, required=True, metavar="FILE.csv", help="Signal to write.")
@click.option("--overwrite", is_flag=True, help="Replace the file if it exists.")
@click.option(
    "--kind",
    default="robust",
    show_default=True,
    metavar="NAME",
    help="robust: by gradient, safe for all plants of the spread; clairvoyant: for the nominal "
    f"plant; or a classical excitation to be tuned: {', '.join(signals())}, or loop-NAME around "
    "one of them, whose run on the nominal plant is then written.",
)
@click.option(
    "--steps",
    type=WholeNumber(2),
    default=500,
    show_default=True,
    metavar="T",
    help="Length in samples.",
)
@click.option(
    "--spread",
    type=SPREAD,
    default=0.3,
    show_default=True,
    help="Spread of the plants (0.3, factor:3).",
)
@uncertainty_option("What else may differ: a robust design is made safe there too.")
@coast_option
@click.option("--noise", type=NUMBERS, multiple=True, help="Noise sd of an output, in its unit.")
@click.option(
    "--seed",
    type=WholeNumber(0, 2**63 - 2),
    default=0,
    show_default=True,
    help="Seed of the search.",
)
@click.option(
    "--starts",
    type=WholeNumber(1),
    help="Starts of a search by gradient; default 4 (robust) or 8 (clairvoyant).",
)
@click.option(
    "--updates",
    type=WholeNumber(1),
    help="Gradient updates; default 1000 (robust) or 3000 (clairvoyant).",
)
@click.option("--trials", type=WholeNumber(1), help="Trials of a tuning; default 400.")
@plot_option
@json_option
@computing
def design(
    plant: str, out: Path, plot: Path | None, noise: Any, as_json: bool, **options: Any
) -> None:
    """Design an open-loop input for PLANT, within its limits and safe for uncertain parameters."""
    from ..record.figure import save
    from ..training.design import design as designed

    options["uncertainty"] = merged(options["uncertainty"])
    with progress_bar(f"designing for {plant}") as progress:
        made = designed(plant, noise=merged(noise), out=out, progress=progress, **options)
    if plot is not None:
        save(made.plot(), plot)
    if as_json:
        show_json({**made.summary(), "file": str(out)})
    else:
        click.echo(f"{out}: {made}")
