"""`excite campaign`: rounds of experiments on a rig until the parameters are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .identify import given_priors
from .next import OF_TARGETS, TARGETS
from .options import (
    CARRY,
    COAST,
    NUMBERS,
    OUT_FILE,
    SEED,
    SPREAD,
    Number,
    WholeNumber,
    command_line,
    computing,
    json_option,
    merged,
    plot_option,
    progress_bar,
    show_json,
    stdout_for,
)


@click.command()
@click.argument("plant")
@click.option(
    "--target",
    "targets",
    type=TARGETS,
    multiple=True,
    required=True,
    help=f"{OF_TARGETS}.",
)
@click.option(
    "--rig",
    default="simulated",
    show_default=True,
    metavar="NAME",
    help="As for excite run: simulated, quanser, FILE.fmu, FILE.json, path/to/file.py:ClassName.",
)
@click.option(
    "--policy",
    metavar="NAME",
    help="Shipped, or a file; default the plant's policy for a spread by a factor, or its usual "
    "one. Without one, or with none, the first round plays a robust signal.",
)
@click.option(
    "--steps",
    type=WholeNumber(4),
    metavar="N",
    help="Samples of a round without a policy, default 50; the first has half as many.",
)
@click.option(
    "--out",
    type=OUT_FILE,
    required=True,
    metavar="FOLDER",
    help="Records and decisions; rerun the same command to resume.",
)
@click.option(
    "--spread",
    type=SPREAD,
    help="Spread of the parameters (0.3, factor:3); default that of the policy's training, or 0.3.",
)
@click.option("--rounds", type=WholeNumber(1, 1000), default=10, show_default=True, help="At most.")
@click.option(
    "--samples",
    type=WholeNumber(1),
    metavar="N",
    help="Of all rounds together, at most: a round that could take more does not begin.",
)
@click.option(
    "--coast",
    type=COAST,
    metavar="N",
    help="Samples after a round's end in which the plant must be safe; default that of the "
    "policy's training, or 100.",
)
@click.option(
    "--carry",
    type=CARRY,
    metavar="N",
    help="Play the safe input for N samples after a round while the next one is decided, and go "
    "on from there; without it, and where no redesigned signal is safe, rounds begin at rest.",
)
@click.option(
    "--redesign/--no-redesign",
    default=True,
    help="Play signals redesigned for what is known, after the first round, where they need fewer "
    "samples than the first one's; not with --guard.",
)
@click.option(
    "--rival",
    "rivals",
    multiple=True,
    metavar="PLANT,NAME=LOW:HIGH",
    help="Another plant that may be the true one, as for excite discriminate; repeatable. Signals "
    "tell them apart first, in rounds without --guard and --filter.",
)
@click.option(
    "--prior",
    multiple=True,
    metavar="NAME=DISTRIBUTION|PATH",
    help="What is known before the first round, as for excite identify: an earlier run, too.",
)
@click.option(
    "--pause",
    type=Number(0),
    metavar="SECONDS",
    help="Wait before every round from rest but the first, so that the plant comes to rest; needed "
    "but for a simulated rig or an FMU.",
)
@click.option("--filter", is_flag=True, help="Predictive safety filter for this spread.")
@click.option("--guard", is_flag=True, help="Brake where no declared plant explains a round.")
@click.option("--address", default="0", show_default=True, help="Board of the Quanser rig.")
@click.option("--fast", is_flag=True, help="Run a simulated rig or an FMU as fast as it can.")
@click.option(
    "--seed",
    type=SEED,
    default=0,
    show_default=True,
    help="Seed of a simulated rig's hidden parameters, noise and jitter.",
)
@click.option(
    "--fault", "faults", type=NUMBERS, multiple=True, help="Of a simulated rig, see excite run."
)
@plot_option
@json_option
@computing
def campaign(
    plant: str,
    targets: tuple[dict[str, str], ...],
    faults: tuple[dict[str, float], ...],
    prior: tuple[str, ...],
    plot: Path | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Play rounds of experiments on PLANT until its parameters are known as asked.

    A round plays a policy or a designed signal and ends as soon as enough is known. It begins at
    rest, or with --carry where the last one ended.
    Exit code 1 where the campaign ends without every target.
    """
    from ..study.campaign import REACHED
    from ..study.campaign_on_rig import campaign as campaigned
    from .run import EXIT_CODES

    with progress_bar(f"campaign on {plant}") as progress, stdout_for(as_json):
        made = campaigned(
            plant,
            merged(targets),
            fault=merged(faults),
            prior=given_priors(prior),
            command=command_line(),
            progress=progress,
            on_warning=lambda sentence: click.echo(f"warning: {sentence}", err=True),
            **options,
        )
    if as_json:
        show_json(made.to_dict())
    else:
        click.echo(made)
        if made.interrupted:
            click.echo(f"{made.interrupted}: rerun the same command to resume", err=True)
        click.echo(f"campaign: {options['out']}")
    if plot is not None and made.result is not None:
        from ..record.figure import save

        save(made.plot(), plot)
    failed = 1 if made.interrupted or made.reason != REACHED else 0
    code = EXIT_CODES.get(made.interrupted, failed)
    click.get_current_context().exit(code)
