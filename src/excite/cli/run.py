"""`excite run`: an experiment on a rig, in real time, supervised and recorded."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from .options import (
    NUMBERS,
    OUT_FILE,
    SEED,
    SPREAD,
    VALUES,
    Number,
    RunFailedError,
    WholeNumber,
    json_option,
    merged,
    prepare_jax,
    show_json,
    show_table,
    stdout_for,
)

if TYPE_CHECKING:
    from ..rig.session import RunResult

EXIT_CODES = {
    "interrupted by SIGINT": 130,
    "interrupted": 130,  # by a second Ctrl-C, where the rig hangs
    "interrupted by SIGTERM": 143,
    "interrupted by SIGHUP": 129,
}


def _options(command: Callable[..., int]) -> Callable[..., int]:
    for option in reversed([
        click.option("--rig", default="simulated", show_default=True, metavar="NAME",
                     help="simulated, quanser, a co-simulation unit FILE.fmu, a simulated rig "
                     "with the plant of a FILE.json (excite falsify), or your class as "
                     "path/to/file.py:ClassName."),
        click.option("--plant", help="Plant of the rig; needs JAX; default aero2_detailed."),
        click.option("--policy", metavar="NAME",
                     help="Play a policy: shipped, or a file; default that of the plant."),
        click.option("--input", "signal", type=OUT_FILE, metavar="FILE",
                     help="Play a designed input (.csv, .mat)."),
        click.option("--excitation", metavar="NAME",
                     help="Play any excitation of `excite simulate`, such as loop-multisine; "
                     "needs JAX."),
        click.option("--set", "settings", type=VALUES, multiple=True,
                     help="Options of the excitation: amplitude, gain, frequencies, ..."),
        click.option("--out", type=OUT_FILE, metavar="FILE.csv", help="Record to write."),
        click.option("--overwrite", is_flag=True, help="Replace the record if it exists."),
        click.option("--steps", type=WholeNumber(2), metavar="T",
                     help="Number of samples; default all of a policy or file, else 500."),
        click.option("--slew", type=Number(), metavar="RATE",
                     help="Largest change of an input per second, in its unit; default no limit."),
        click.option("--filter", is_flag=True,
                     help="Predictive safety filter: changes an input where a plant of the prior "
                     "could no longer be brought to rest before its critical level."),
        click.option("--guard", is_flag=True,
                     help="Brake where no plant of the policy's declared uncertainty explains the "
                     "measurements, and after the last sample (excite falsify --guard)."),
        click.option("--require-certificate", is_flag=True,
                     help="Refuse a policy without a certificate (excite falsify) for this plant "
                     "and spread."),
        click.option("--address", default="0", show_default=True,
                     help="Board of the Quanser rig, or a virtual one "
                     "(0@tcpip://localhost:18950)."),
        click.option("--fast", is_flag=True,
                     help="Run a simulated rig or an FMU as fast as it can."),
        click.option("--dry-run", is_flag=True, help="Show the inputs; send nothing."),
        click.option("--seed", type=SEED, default=0, show_default=True,
                     help="Seed of a simulated rig's hidden parameters, noise and jitter, and of "
                     "random signals."),
        click.option("--spread", type=SPREAD, default=0.3,
                     show_default=True,
                     help="Spread of these parameters and of the filter's prior: a fraction of "
                     "their scales, or factor:3."),
        click.option("--fault", "faults", type=NUMBERS, multiple=True,
                     help="Faults of a simulated rig: latency, jitter [s], dropout (probability "
                     "of a lost reading); sensor_frozen, actuator_stuck, actuator_dead, "
                     "actuator_sign (from when on [s]); sensor_slow (time constant [s]); "
                     "sensor_bias_OUTPUT [its unit], sensor_bias_from [s]; effects of the true "
                     "plant: gain_INPUT, delay_INPUT, lag_INPUT, ..."),
    ]):  # fmt: skip
        command = option(command)
    return command


@click.command()
@_options
@json_option
def run(
    settings: tuple[dict[str, object], ...],
    faults: tuple[dict[str, float], ...],
    as_json: bool,
    **options: Any,
) -> int:
    """Run a supervised experiment on a rig; record every sample; end with zero input.

    Without JAX, a policy or a signal is played with NumPy alone; the live estimate and the
    filter are then off.
    """
    _prepare()
    from ..rig.loop import ignore_signals, interruptible

    with interruptible(has_begun=False) as stop:
        try:
            given = {**options, "options": merged(settings), "fault": merged(faults)}
            given["slew"] = math.inf if given["slew"] is None else given["slew"]
            return _run_and_show(as_json, stop=stop, **given)
        finally:
            if stop.has_begun:
                ignore_signals()  # until the process has ended


def _run_and_show(as_json: bool, **options: Any) -> int:
    """The experiment and its result; the exit code."""
    from ..rig import RigError
    from ..rig.session import DryRun
    from ..rig.session import run as run_on_rig
    from .live_view import LiveView

    view = LiveView()
    try:
        with stdout_for(as_json):
            result = run_on_rig(
                **options,
                on_sample=view,
                on_warning=lambda sentence: click.echo(f"warning: {sentence}", err=True),
            )
    except RigError as error:
        raise RunFailedError(f"the rig failed: {error}") from error
    finally:
        # The record is complete: an error of the view does not change how the command ends.
        with contextlib.suppress(Exception, KeyboardInterrupt):
            view.end()
    if as_json:
        show_json(result.to_dict())
    elif isinstance(result, DryRun):
        show_table(result.title, result.header, result.rows())
    else:
        _show(result, options["plant"] or _plant_of(options["rig"]))
    if isinstance(result, DryRun) or result.outcome.is_complete:
        return 0
    return EXIT_CODES.get(result.outcome.reason, 1)


def _prepare() -> None:
    try:
        prepare_jax()
    except ImportError:
        click.echo("JAX is not installed: the live estimate and the filter are off", err=True)


def _plant_of(rig: str) -> str | None:
    """The plant of a rig that is given by a file (JSON), as it is typed; None for others."""
    if not rig.endswith(".json"):
        return None
    from ..plant.catalogue import known_plant, word_in_command

    return word_in_command(known_plant(rig))


def _show(result: RunResult, plant: str | None) -> None:
    show_table(result.title, ["", ""], result.rows())
    next_command = f"excite identify {result.path} --plant {plant or result.description.name}"
    told = f"; next: {next_command}" if result.outcome.num_samples else ""
    click.echo(f"record: {result.path}{told}")
