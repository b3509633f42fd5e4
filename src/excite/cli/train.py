"""`excite train`: one policy for a plant, without a study file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from .options import NUMBERS, OUT_FILE, VALUES, WholeNumber, computing, json_option, merged
from .study import run_study_here

_OBJECTIVES = {
    "D": {"reward": "information", "criterion": "D"},
    "A": {"reward": "information", "criterion": "A"},
    "E": {"reward": "information", "criterion": "E"},
    "relative": {"reward": "relative"},
    "log": {"reward": "log"},
    "goals": {"reward": "goals"},
    "nls": {"reward": "relative", "estimator": "nls"},
}


class Objective(click.ParamType):
    """One of the objectives, and its weight where others are added."""

    name = "NAME[=WEIGHT]"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, float | None]:
        """The two of them."""
        from ..description import unknown

        name, has_weight, weight = value.partition("=")
        if name not in _OBJECTIVES:
            self.fail(str(unknown("objective", name, _OBJECTIVES)), param, ctx)
        try:
            return name, float(weight) if has_weight else None
        except ValueError:
            self.fail(f"the weight of {name!r} must be a number, got {weight!r}", param, ctx)


def _options(command: Any) -> Any:
    """What is trained, on what, and for what."""
    for option in reversed(
        [
            click.option("--method", type=click.Choice(["gradient", "ppo"]), default="gradient",
                         show_default=True, help="Gradient of the simulated experiment, or PPO."),
            click.option("--objective", "objectives", type=Objective(), multiple=True,
                         help="Criterion of the Fisher information (D, A, E), or errors of the ARX "
                         "estimator (relative, log, goals) or of nonlinear least squares (nls); "
                         "repeated, a sum with these weights. Default D."),
            click.option("--target", "targets", multiple=True, metavar="NAME",
                         help="Parameter that counts; default the plant's targets."),
            click.option("--goal", "goals", type=NUMBERS, multiple=True,
                         help="Relative error of a parameter that counts as one."),
            click.option("--output-scale", type=NUMBERS, multiple=True,
                         help="What an output is divided by before it is observed, in its unit."),
            click.option("--window", type=WholeNumber(1, 10_000),
                         help="Samples observed; default 80."),
            click.option("--clock", "clocks", type=float, multiple=True, metavar="HZ",
                         help="Observe sine and cosine of this frequency too."),
            click.option("--set", "training", type=VALUES, multiple=True,
                         help="Hyper-parameters of the method, for instance num_updates=300."),
            click.option("--seeds", type=WholeNumber(1, 1000), default=1, show_default=True,
                         help="Independent trainings."),
            click.option("--spread", type=click.FloatRange(0, 1, max_open=True), default=0.3,
                         show_default=True,
                         help="Plants are drawn from nominal values ± this fraction."),
            click.option("--steps", type=WholeNumber(2, 1_000_000), default=500,
                         show_default=True, metavar="T", help="Length of an experiment."),
            click.option("--noise", type=NUMBERS, multiple=True,
                         help="Standard deviation of an output's noise, in its unit."),
            click.option("--episodes", type=WholeNumber(1), default=100, show_default=True,
                         help="Evaluation episodes."),
        ]
    ):  # fmt: skip
        command = option(command)
    return command


@click.command()
@click.argument("plant")
@click.option("--out", type=OUT_FILE, required=True, metavar="FOLDER", help="Its run folder.")
@_options
@json_option
@computing
def train(plant: str, out: Path, as_json: bool, **options: Any) -> None:  # fmt: skip
    """Train a policy that excites PLANT, and compare it with a chirp.

    The run folder is that of a study with one agent: FOLDER/seeds/METHOD_OBJECTIVE/0 holds
    policy.safetensors. After an interruption, rerun the same command to resume.
    """
    from ..study.spec import study_from

    chosen = study_from(_study(plant, out, options), "train").checked("train")
    run_study_here(chosen, out, as_json)


def _rewards(
    objectives: list[tuple[str, float | None]], goals: dict[str, float]
) -> dict[str, dict[str, Any]]:
    """What every objective means in a study; goals belong to those that know errors."""
    names = [name for name, _ in objectives]
    if len(set(names)) < len(names):
        raise ValueError(f"objectives must differ from each other, got {', '.join(names)}")
    with_goals = [name for name in names if name not in ("D", "A", "E")] or names
    return {
        name: {
            **_OBJECTIVES[name],
            **({"goals": goals} if goals and name in with_goals else {}),
            **({} if weight is None else {"weight": weight}),
        }
        for name, weight in objectives
    }


def _study(plant: str, out: Path, options: dict[str, Any]) -> dict[str, Any]:
    """The study that these options mean."""
    from ..plant import AbstractARXPlant
    from ..plant.catalogue import plant_named

    rewards = _rewards(options["objectives"] or [("D", None)], merged(options["goals"]))
    name = f"{options['method']}({', '.join(rewards)})"
    decision = {
        **(
            next(iter(rewards.values())) if len(rewards) == 1 else {"terms": list(rewards.values())}
        ),
        "output_scale": merged(options["output_scale"]),
        "window": options["window"],
        "clocks": list(options["clocks"]),
    }
    estimators = ["nls"] + ["arx-rls"] * isinstance(plant_named(plant), AbstractARXPlant)
    return {
        "name": os.path.abspath(out).rpartition(os.sep)[2],
        "title": f"{plant}: {name}",
        "plant": plant,
        "episodes": options["episodes"],
        "num_steps": options["steps"],
        "spread": options["spread"],
        "seeds": options["seeds"],
        "sensor": {n: {"noise_sd": sd} for n, sd in merged(options["noise"]).items()},
        "methods": {"chirp": {"excitation": "chirp"}},
        "estimators": {n: {"kind": n} for n in estimators},
        "agents": {
            name: {
                "targets": list(options["targets"]) or None,
                "method": options["method"],
                "decision": {n: value for n, value in decision.items() if value},
                "training": merged(options["training"]),
            }
        },
    }
