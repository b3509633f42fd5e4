"""`excite train`: one policy for a plant, without a study file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import (
    NUMBERS,
    OUT_FILE,
    SPREAD,
    VALUES,
    Number,
    WholeNumber,
    coast_option,
    computing,
    json_option,
    merged,
    prior_option,
    uncertainty_option,
)
from .study import running, show_comparison


def _options(command: Any) -> Any:
    """The options that choose objective, method, plants and experiment."""
    for option in reversed(
        [
            click.option("--method", type=click.Choice(["gradient", "ppo"]), default="gradient",
                         show_default=True, help="Gradient of the simulated experiment, or PPO."),
            click.option("--objective", multiple=True, metavar="NAME[=WEIGHT]",
                         help="Criterion of the Fisher information (D, A, E), lower bounds of the "
                         "expected information gain (sPCE, ACE, InfoNCE), or errors of the ARX "
                         "estimator (relative, log, goals) or of nonlinear least squares (nls); "
                         "repeated, a sum with these weights. Default D."),
            click.option("--target", multiple=True, metavar="NAME",
                         help="Parameter in the objective; default the plant's targets."),
            click.option("--goal", type=NUMBERS, multiple=True,
                         help="Relative error of a parameter that is scaled to one."),
            click.option("--output-scale", type=NUMBERS, multiple=True,
                         help="Scale by which an observed output is divided, in its unit."),
            click.option("--window", type=WholeNumber(1, 10_000),
                         help="Number of samples observed; default 80."),
            click.option("--memory", type=WholeNumber(0, 10_000),
                         help="Numbers in which the policy keeps what it has seen; default none."),
            click.option("--memory-kind", type=click.Choice(["gru", "sum", "attention"]),
                         help="Gated recurrent unit (default), sum of the encoded samples, "
                         "whatever their order, or attention over the window."),
            click.option("--clock", type=Number(), multiple=True, metavar="HZ",
                         help="Also observe sine and cosine of this frequency."),
            click.option("--contrast-plants", type=WholeNumber(1, 1_000_000), metavar="NUMBER",
                         help="Plants with which the true one is compared; default 255, for "
                         "ACE 15."),
            click.option("--change-price", type=Number(min=0), default=0.0, metavar="PRICE",
                         help="Subtracted from the information for each squared change of an "
                         "input [1 / input unit²]; default none."),
            click.option("--updates", type=WholeNumber(1), metavar="N",
                         help="Gradient updates; default 1000."),
            click.option("--set", "training", type=VALUES, multiple=True,
                         help="Hyper-parameters of the method, for instance num_plants=32."),
            click.option("--seeds", type=WholeNumber(1, 1000), default=1, show_default=True,
                         help="Number of independent trainings."),
            click.option("--spread", type=SPREAD, default=0.3,
                         show_default=True,
                         help="Plants are drawn from nominal values ± this fraction, or within a "
                         "factor (factor:3)."),
            prior_option,
            uncertainty_option("What else may differ: the policy is made safe there too."),
            coast_option,
            click.option("--steps", type=WholeNumber(2, 1_000_000), default=500,
                         show_default=True, metavar="T", help="Length of an experiment."),
            click.option("--noise", type=NUMBERS, multiple=True,
                         help="Standard deviation of an output's noise, in its unit."),
            click.option("--episodes", type=WholeNumber(1), default=100, show_default=True,
                         help="Number of evaluation episodes."),
        ]
    ):  # fmt: skip
        command = option(command)
    return command


@click.command()
@click.argument("plant")
@click.option("--out", type=OUT_FILE, required=True, metavar="FOLDER", help="Run folder.")
@_options
@json_option
@computing
def train(plant: str, out: Path, as_json: bool, **options: Any) -> None:
    """Train a policy that excites PLANT, and compare it with a chirp.

    In a task without memory it is compared with random designs.
    The run folder is that of a study with one agent: FOLDER/seeds/METHOD_OBJECTIVE/0 holds
    policy.safetensors. After an interruption, rerun the same command to resume.
    """
    from ..study.table import finished_table
    from ..study.train import train as trained

    for name in ("goal", "training", "noise", "output_scale", "prior"):
        options[name] = merged(options[name])
    options["uncertainty"] = merged(options["uncertainty"])
    options["objective"] = options["objective"] or "D"
    with running(plant, out) as told:
        trained(plant, out, workers=None, **told, **options)
    show_comparison(finished_table(out), out, as_json)
