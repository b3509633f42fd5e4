"""`excite discriminate`: which of several plants is the true one, and what tells them apart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import (
    COAST,
    OUT_FILE,
    SEED,
    SPREAD,
    WholeNumber,
    computing,
    json_option,
    plot_option,
    progress_bar,
    show_json,
)


@click.command()
@click.argument("plants", nargs=-1, required=True, metavar="PLANT PLANT...")
@click.option(
    "--record",
    "records",
    type=OUT_FILE,
    multiple=True,
    metavar="FILE",
    help="Of an experiment so far, from rest; repeatable. Without records every plant is as "
    "probable as the others.",
)
@click.option(
    "--spread",
    type=SPREAD,
    default="0.3",
    show_default=True,
    help="Of parameters without a range (0.3, factor:3).",
)
@click.option(
    "--steps",
    type=WholeNumber(2, 10_000),
    default=20,
    show_default=True,
    metavar="T",
    help="Samples of the experiment.",
)
@click.option(
    "--coast",
    type=COAST,
    default=100,
    show_default=True,
    metavar="N",
    help="Samples after the experiment in which the plant must be safe too.",
)
@click.option(
    "--initial-state",
    type=click.Choice(["auto", "known"]),
    default="auto",
    show_default=True,
    help="known: the records are from rest, though their sidecars do not say so.",
)
@click.option("--seed", type=SEED, default=0, show_default=True, help="Of the search's starts.")
@click.option("--out", type=OUT_FILE, metavar="FILE.csv", help="Inputs to be played.")
@click.option("--overwrite", is_flag=True, help="Replace the file if it exists.")
@plot_option
@json_option
@computing
def discriminate(
    plants: tuple[str, ...],
    records: tuple[Path, ...],
    plot: Path | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Which PLANT is the true one, and which experiment tells them apart.

    A PLANT may have ranges of its parameters, constants and effects:
    aero2+dead_zone,dead_zone_voltage=0.1:2. Probabilities follow from the records; a signal is
    designed that is safe for all plants. Exit code 1 where no plant explains the records, or no
    signal is safe.
    """
    from ..study.discrimination import discriminate as verb

    with progress_bar("discriminate") as progress:
        found = verb(plants, records, progress=progress, **options)
    if found.inputs is None:
        for path in filter(None, (options["out"], plot)):
            click.echo(f"no signal was designed: {path} is not written", err=True)
    elif plot is not None:
        from ..record.figure import save

        save(found.plot(), plot)
    if as_json:
        show_json(found.to_dict())
    else:
        click.echo(found)
        if options["out"] is not None and found.inputs is not None:
            click.echo(f"signal: {options['out']}")
    click.get_current_context().exit(1 if found.chosen is None and found.inputs is None else 0)
