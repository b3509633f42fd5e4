"""`excite design`: a signal that anyone can play on a rig."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import (
    NUMBERS,
    OUT_FILE,
    WholeNumber,
    computing,
    json_option,
    merged,
    plot_option,
    progress_bar,
    show_json,
)


@click.command()
@click.argument("plant")
@click.option(
    "--criterion",
    type=click.Choice(["D", "A", "E"]),
    default="D",
    show_default=True,
    help="Of the Fisher information: its determinant, the trace of its inverse, or its "
    "smallest eigenvalue.",
)
@click.option("--out", type=OUT_FILE, required=True, metavar="FILE.csv", help="The signal.")
@click.option("--overwrite", is_flag=True, help="Replace the file if it exists.")
@click.option(
    "--kind",
    default="robust",
    show_default=True,
    metavar="NAME",
    help="robust: by gradient, safe for all plants of the spread; clairvoyant: for the nominal "
    "plant; or a classical excitation to be tuned: random, prbs, chirp, multisine, square, decay, "
    "or loop-NAME around one of them, whose run on the nominal plant is then written.",
)
@click.option(
    "--steps",
    type=WholeNumber(2),
    default=500,
    show_default=True,
    metavar="T",
    help="Length in samples.",
)
@click.option("--spread", type=float, default=0.3, show_default=True, help="Of the parameters.")
@click.option("--noise", type=NUMBERS, multiple=True, help="An output's noise, in its unit.")
@click.option(
    "--seed", type=WholeNumber(0, 2**63 - 2), default=0, show_default=True, help="Of the search."
)
@click.option(
    "--starts", type=WholeNumber(1), help="Of a search by gradient, side by side; default 4."
)
@click.option("--updates", type=WholeNumber(1), help="Steps of the search, or trials of a tuning.")
@plot_option
@json_option
@computing
def design(
    plant: str, out: Path, overwrite: bool, plot: Path | None, as_json: bool, **options: Any
) -> None:  # fmt: skip
    """Design an open-loop input for PLANT, within its limits and safe for uncertain parameters."""
    import dataclasses

    import jax
    import numpy as np

    from ..environment import run_episodes
    from ..excitation import Replay
    from ..information import d_optimality, require_noise
    from ..plant.catalogue import plant_named, with_sensor
    from ..record import require_record_path, write_record
    from ..report.figure import save
    from ..report.figures import episode_figure
    from ..training.signals import signal_env

    require_record_path(out, overwrite)
    if not 0 <= options["spread"] < 1:
        raise ValueError(f"--spread must lie in [0, 1): got {options['spread']:g}")
    chosen = with_sensor(plant_named(plant), merged(options["noise"]), {})
    require_noise(chosen)
    env = signal_env(chosen, options["steps"], options["spread"], options["criterion"])
    is_nominal = options["kind"] == "clairvoyant"
    if is_nominal:  # the plant is known, what an experiment is worth stays the same
        env = dataclasses.replace(env, spread=0.0)
    with progress_bar(f"designing for {plant}") as progress:
        inputs, found, tuned = _designed(env, options, lambda i, n: progress("", i, n))
    count = 1 if is_nominal else 1000
    keys = jax.random.split(jax.random.key(options["seed"] + 1), count)
    # The file is played as it stands, whatever closed a loop or drew numbers to make it.
    judged = run_episodes(chosen, Replay(inputs), options["steps"], float(env.spread), keys)
    information = jax.vmap(d_optimality)(judged.information)
    description = chosen.description
    record = _record(chosen, inputs, found)
    if plot is not None:
        save(episode_figure(description, record), plot)
    write_record(out, record, description)
    summary = {
        "plant": description.name,
        **found,
        "num_steps": options["steps"],
        "log_det_information": float(information.mean()),
        "violations": int(np.sum(judged.is_violation)),
        "evaluations": count,
        "file": str(out),
    }
    if as_json:
        show_json(summary)
    else:
        click.echo(
            f"{out}: {options['kind']} input for {description.name}, {options['steps']} samples; "
            f"log det {summary['log_det_information']:.2f}, {summary['violations']} violations on "
            + ("the nominal plant" if is_nominal else f"{count} fresh plants")
        )
        if tuned is not None:
            click.echo(_as_excitation(tuned))


def _as_excitation(tuned: Any) -> str:
    """How a tuned signal is drawn, or its loop closed, anew, and what that is worth."""
    import json

    settings = ",".join(f"{k}={json.dumps(v)}" for k, v in tuned.options.items())
    return (
        f"as an excitation, drawn or closed anew each time: --excitation {tuned.excitation} "
        f"--set {settings}; {tuned.violations} violations on {tuned.episodes} fresh plants"
    )


def _record(plant: Any, inputs: Any, found: dict[str, Any]) -> Any:
    """The design and what the nominal plant answers to it."""
    import numpy as np

    from .. import __version__
    from ..record import Record
    from ..simulation import response

    outputs = np.asarray(response(plant, plant.nominal, inputs))
    time = np.arange(len(outputs)) * float(plant.dt)
    origin = {
        "starts_at_initial_state": True,
        "provenance": {"excite": __version__, "simulated": True, **found},
    }
    return Record.of_episode(time, np.asarray(inputs), outputs, origin)


def _designed(env: Any, options: dict[str, Any], report: Any) -> tuple[Any, dict[str, Any], Any]:
    """Inputs, how they were found, and the tuned excitation they are of, if they are."""
    import dataclasses

    import jax
    import jax.numpy as jnp

    from ..training.signals import CLAIRVOYANT, ROBUST, clairvoyant_signals, robust_signal

    kind, seed, updates = options["kind"], options["seed"], options["updates"]
    found = {"design": kind, "criterion": options["criterion"], "seed": seed}
    if kind not in ("robust", "clairvoyant"):
        if options["starts"] is not None:
            raise ValueError("--starts is of designs by gradient; a tuning has --updates trials")
        return _tuned(env, options, found, report)
    starts = options["starts"] or 4
    settings = ROBUST if kind == "robust" else CLAIRVOYANT
    if updates is not None:
        settings = dataclasses.replace(settings, num_updates=updates)
    if kind == "robust":
        made = robust_signal(env, seed, starts, settings, report)
    else:
        key = jax.random.split(jax.random.key(seed), 1)
        made = clairvoyant_signals(env, key, starts, settings, report, seed=seed)
    inputs, by_start = jnp.asarray(made.inputs[0]), made.worth_by_start[0]
    return inputs, {**found, "worth_by_start": by_start.tolist()}, None


def _tuned(
    env: Any, options: dict[str, Any], found: dict[str, Any], report: Any
) -> tuple[Any, dict[str, Any], Any]:
    """The inputs of a tuned classical excitation, those of a loop on the nominal plant."""
    from importlib.util import find_spec

    import jax

    from ..description import unknown
    from ..excitation.catalogue import EXCITATIONS, LOOP, excitation_named
    from ..simulation import run_episode

    kind, plant = options["kind"], env.plant
    if kind.removeprefix(LOOP) not in EXCITATIONS:
        known = ["robust", "clairvoyant", *EXCITATIONS, *(LOOP + name for name in EXCITATIONS)]
        raise unknown("kind of design", kind, known)
    if find_spec("optuna") is None:
        raise ValueError("tuning needs optuna: python -m pip install -e '.[tune]'")
    from ..training.tuning import tuned_signal

    trials = options["updates"] or 400
    best = tuned_signal(
        env, kind, criterion=options["criterion"], trials=trials, seed=options["seed"],
        report=report,
    )  # fmt: skip
    played: Any = excitation_named(kind, best.options, plant)
    key = jax.random.key(options["seed"])
    run = run_episode(plant, plant.nominal, played, env.layout.num_steps, key)
    own = {"violations": best.violations, "evaluations": best.episodes}
    found |= {"options": dict(best.options), "trials": trials, "as_excitation": own}
    return run.inputs, found, best
