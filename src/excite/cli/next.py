"""`excite next`: which experiment to make next, and what it will bring."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .identify import given_priors
from .options import (
    CARRY,
    COAST,
    OUT_FILE,
    SEED,
    SPREAD,
    Assignments,
    WholeNumber,
    computing,
    json_option,
    merged,
    plot_option,
    progress_bar,
    show_json,
)
from .simulate import show_warnings

TARGETS = Assignments(str, "a percentage such as 1% or a number")
OF_TARGETS = (
    "Half of the 95 % interval to be reached: D_p=1%,J_p=0.5%, a number in the unit, or with "
    "another unit. Also for a function of the parameters, path/to/file.py:function=1%, and for a "
    "predicted output, pitch@2:step.csv=0.1deg: after 2 s of the inputs in a file, or of a signal "
    "by name"
)


@click.command(name="next")
@click.argument("known", nargs=-1, required=True, type=OUT_FILE, metavar="RECORD|RUN...")
@click.option(
    "--plant", help="Name, or path/to/file.py:ClassName; default the plant the sidecar names."
)
@click.option(
    "--target",
    "targets",
    type=TARGETS,
    multiple=True,
    help=f"{OF_TARGETS}. Default half of what it is now, for each parameter.",
)
@click.option(
    "--prior",
    multiple=True,
    metavar="NAME=DISTRIBUTION|PATH",
    help="What is known beside the records, as for excite identify.",
)
@click.option("--policy", metavar="NAME", help="To compare with: a shipped one, or a file.")
@click.option(
    "--spread",
    type=SPREAD,
    default="factor:3",
    show_default=True,
    help="Spread of the parameters before the records (0.3, factor:3).",
)
@click.option(
    "--steps",
    type=WholeNumber(2),
    metavar="T",
    help="Samples of the experiment; default those of the policy, or 200.",
)
@click.option(
    "--ahead",
    type=WholeNumber(1, 20),
    default=1,
    show_default=True,
    help="Experiments of this length for which the redesign looks ahead.",
)
@click.option(
    "--carry",
    type=CARRY,
    metavar="N",
    help="Go on from the end of the last record, after N samples of the safe input; without it, "
    "the experiment begins at rest.",
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
    "--seed", type=SEED, default=0, show_default=True, help="Of the redesign's starts, and noise."
)
@click.option("--out", type=OUT_FILE, metavar="FILE.csv", help="Inputs to be played.")
@click.option("--overwrite", is_flag=True, help="Replace the file if it exists.")
@plot_option
@json_option
@computing
def next_experiment(
    known: tuple[Path, ...],
    targets: tuple[dict[str, str], ...],
    prior: tuple[str, ...],
    plot: Path | None,
    as_json: bool,
    **options: Any,
) -> None:
    """What the records tell of the parameters, and which experiment to make next.

    Records of one plant, from rest or as their sidecars say, and run folders of excite identify
    or excite campaign, of other records. A signal is redesigned for the plants that are still
    possible, and compared with a policy. Exit code 1 where no experiment is safe.
    """
    from ..study.next_experiment import next_experiment as verb

    with progress_bar("next experiment") as progress:
        found = verb(
            known, target=merged(targets) or None, prior=given_priors(prior), progress=progress,
            **options,
        )  # fmt: skip
    show_warnings(found.warnings)
    if plot is not None:
        from ..record.figure import save

        save(found.plot(), plot)
    if as_json:
        show_json(found.to_dict())
    else:
        click.echo(found)
        if options["out"] is not None:
            click.echo(f"signal: {options['out']}")
    click.get_current_context().exit(1 if found.chosen is None else 0)
