"""`excite choose`: which of several experiments to make."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .identify import given_priors
from .next import OF_TARGETS, TARGETS
from .options import (
    COAST,
    OUT_FILE,
    SEED,
    SPREAD,
    Number,
    WholeNumber,
    computing,
    json_option,
    merged,
    plot_option,
    progress_bar,
    show_json,
)
from .simulate import show_warnings


@click.command(name="choose")
@click.argument("plant")
@click.argument("experiments", type=OUT_FILE, metavar="EXPERIMENTS.toml")
@click.option(
    "--target", "targets", type=TARGETS, multiple=True, required=True, help=f"{OF_TARGETS}."
)
@click.option(
    "--known",
    multiple=True,
    type=OUT_FILE,
    metavar="RECORD|RUN",
    help="A record that exists, or a run folder of excite identify; repeatable. Default nothing "
    "but the spread.",
)
@click.option(
    "--prior",
    multiple=True,
    metavar="NAME=DISTRIBUTION|PATH",
    help="What is known beside records, as for excite identify.",
)
@click.option(
    "--spread",
    type=SPREAD,
    default="factor:3",
    show_default=True,
    help="Spread of the parameters before the records (0.3, factor:3).",
)
@click.option(
    "--rounds",
    type=WholeNumber(1, 1000),
    metavar="N",
    help="Experiments together, at most; default 1, or as many as the budget allows.",
)
@click.option("--budget", type=Number(0), metavar="COST", help="Costs together, at most.")
@click.option(
    "--coast",
    type=COAST,
    default=100,
    show_default=True,
    metavar="N",
    help="Samples after an experiment in which the plant must be safe too.",
)
@click.option(
    "--seed",
    type=SEED,
    default=0,
    show_default=True,
    help="Of the plants that are drawn where nothing is known, and noise.",
)
@plot_option
@json_option
@computing
def choose(
    plant: str,
    experiments: Path,
    targets: tuple[dict[str, str], ...],
    known: tuple[Path, ...],
    prior: tuple[str, ...],
    plot: Path | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Which of the experiments in a file to make on PLANT, and in which order.

    EXPERIMENTS.toml has a table [experiments.NAME] for each: excitation, options, steps, constants,
    outputs, noise, cost, most. Exit code 1 where no experiment is safe, or within the budget.
    """
    from ..study.selection import choose_experiments

    with progress_bar("choosing experiments") as progress:
        found = choose_experiments(
            plant, experiments, merged(targets), known=known or None, prior=given_priors(prior),
            progress=progress, **options,
        )  # fmt: skip
    show_warnings(found.warnings)
    if plot is not None:
        from ..record.figure import save

        save(found.plot(), plot)
    if as_json:
        show_json(found.to_dict())
    else:
        click.echo(found)
    click.get_current_context().exit(0 if found.order else 1)
