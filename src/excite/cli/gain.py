"""`excite gain`: what an experiment is expected to tell of the parameters, in nats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .identify import given_priors
from .options import (
    OUT_FILE,
    SPREAD,
    WholeNumber,
    computing,
    json_option,
    progress_bar,
    show_json,
)
from .simulate import excitation_options, given_experiment, show_warnings


@click.command()
@click.argument("plant")
@click.argument("input_file", required=False, type=OUT_FILE)
@excitation_options
@click.option(
    "--prior",
    multiple=True,
    metavar="NAME=DISTRIBUTION|PATH",
    help="Distributions of parameters, as for excite identify, or an earlier run.",
)
@click.option(
    "--spread",
    type=SPREAD,
    default="0.3",
    show_default=True,
    help="Of parameters without a distribution: uniform within it (0.3, factor:3).",
)
@click.option(
    "--plants",
    type=WholeNumber(2, 1_000_000),
    default=256,
    show_default=True,
    metavar="N",
    help="That are drawn, each with a record.",
)
@click.option(
    "--samples",
    type=WholeNumber(1, 100_000_000),
    default=1000,
    show_default=True,
    metavar="L",
    help="Of the evidence of each record.",
)
@click.option(
    "--from-prior",
    is_flag=True,
    help="Draw these samples from the prior: the usual figure of benchmarks, which can only be "
    "compared for the same L.",
)
@json_option
@computing
def gain(
    plant: str, input_file: Path | None, prior: tuple[str, ...], as_json: bool, **options: Any
) -> None:
    """What an experiment on PLANT is expected to tell of its parameters, in nats.

    For an excitation, a policy, or the recorded or designed input in INPUT_FILE. The bounds are
    means over plants drawn from the prior. For a task without memory, or a plant whose state is
    observed, the excitation "myopic" makes each input that whose outcome is expected to tell most.
    """
    from ..estimation.information_gain import information_gain
    from ..simulation import DivergedError

    given = given_experiment(plant, input_file, options)
    if given.pop("params"):
        raise ValueError("the parameters are drawn from the prior: leave --params out")
    own = {name: options[name] for name in ("spread", "plants", "samples", "from_prior")}
    with progress_bar("information gain") as progress:
        try:
            found = information_gain(**given, prior=given_priors(prior), progress=progress, **own)
        except DivergedError as error:  # by what was given
            raise ValueError(str(error)) from None
    show_warnings(found.warnings)
    if as_json:
        show_json(found.to_dict())
    else:
        click.echo(found)
