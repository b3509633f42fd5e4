"""`excite run`: an experiment on a rig, in real time, supervised and recorded."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..description import display_unit
from .options import (
    NUMBERS,
    OUT_FILE,
    RunFailedError,
    WholeNumber,
    json_option,
    prepare_jax,
    show_json,
    show_table,
)

if TYPE_CHECKING:
    from .rigs import Job

_EXIT_CODES = {
    "interrupted by SIGINT": 130,
    "interrupted": 130,  # by a second Ctrl-C
    "interrupted by SIGTERM": 143,
    "interrupted by SIGHUP": 129,
}


def _options(command: Any) -> Any:
    for option in reversed([
        click.option("--rig", default="simulated", show_default=True, metavar="NAME",
                     help="simulated, quanser, a co-simulation unit FILE.fmu, or your own as "
                     "path/to/file.py:ClassName."),
        click.option("--plant", help="Of the rig, where JAX is installed; default aero2_detailed."),
        click.option("--policy", metavar="NAME",
                     help="Shipped policy or file; default the rig's own."),
        click.option("--input", "signal", type=OUT_FILE, metavar="FILE",
                     help="Plays this designed input (.csv) in place of a policy."),
        click.option("--out", type=OUT_FILE, metavar="FILE.csv", help="The record."),
        click.option("--overwrite", is_flag=True, help="Replace the record if it exists."),
        click.option("--steps", type=WholeNumber(2), metavar="T", help="Samples; default all."),
        click.option("--slew", type=float, default=math.inf, metavar="RATE",
                     help="Largest change of an input in a second, in its unit; default any."),
        click.option("--filter", "filtered", is_flag=True,
                     help="Predictive safety filter: changes an input where a plant of the prior "
                     "could no longer be brought to rest within its limit."),
        click.option("--address", default="0", show_default=True,
                     help="Of the Quanser rig: hardware, or a virtual one "
                     "(0@tcpip://localhost:18950)."),
        click.option("--fast", is_flag=True, help="A simulated rig as fast as it can."),
        click.option("--dry-run", is_flag=True, help="Shows what would be sent, sends nothing."),
        click.option("--seed", type=WholeNumber(0), default=0, show_default=True,
                     help="Of a simulated rig's hidden parameters, noise and jitter."),
        click.option("--spread", type=click.FloatRange(0, 1, max_open=True), default=0.3,
                     show_default=True, help="Of these parameters, and of the filter's prior."),
        click.option("--fault", type=NUMBERS, multiple=True,
                     help="Of a simulated rig: latency, jitter [s], dropout (probability of a "
                     "lost reading)."),
    ]):  # fmt: skip
        command = option(command)
    return command


@click.command()
@_options
@json_option
def run(out: Path | None, overwrite: bool, dry_run: bool, as_json: bool, **options: Any) -> int:
    """Run an experiment on a rig: supervised, recorded as it happens, ended by zero input.

    Without JAX, a policy or a signal is played with NumPy alone; the live estimate and the
    filter are then off.
    """
    from ..record import require_record_path
    from ..rig import Recorder, RigError, interruptible
    from ..rig import run as play
    from ..safety import Supervision
    from .rigs import LiveView, job_from

    if options["policy"] and options["signal"]:
        raise ValueError("--policy and --input exclude each other")
    if not dry_run and out is None:
        raise ValueError("--out FILE.csv is missing: an experiment is always recorded")
    if out is not None:
        require_record_path(out, overwrite)
    has_jax = _has_jax()
    job = job_from(options, has_jax)
    rules = Supervision.of(job.rig.description, options["slew"])
    if dry_run or out is None:
        return _show_dry_run(job, rules, as_json)
    job.check_latency()
    tracker = _tracker(job, has_jax)
    view = LiveView(job.rig.description, tracker, job.player.num_steps)
    recorder = Recorder(out, job.rig.description, job.metadata(options), overwrite)
    outcome = None
    try:
        with interruptible() as stop, job.rig, recorder as record:
            outcome = play(job.rig, job.player, rules, record, stop=stop, on_sample=view)
    except (Exception, KeyboardInterrupt) as error:
        if outcome is None and isinstance(error, RigError):
            raise RunFailedError(f"the rig failed: {error}") from error
        if outcome is None:
            raise
        outcome.failed("the rig was not released", error)
        with contextlib.suppress(OSError, ValueError):
            recorder.end(outcome.to_dict())
    finally:
        # The record is complete: nothing of what shows it may change how the command ends.
        with contextlib.suppress(Exception, KeyboardInterrupt):
            view.end()
            if tracker is not None:
                tracker.close()
    _show(job, outcome, tracker, out, as_json)
    return 0 if outcome.is_complete else _EXIT_CODES.get(outcome.reason, 1)


def _has_jax() -> bool:
    try:
        prepare_jax()
    except ImportError:
        click.echo("JAX is not installed: the live estimate and the filter are off", err=True)
        return False
    return True


def _tracker(job: Job, has_jax: bool) -> Any:
    if not has_jax or job.plant is None:
        return None
    from ..rig.live_estimate import Tracker

    return Tracker(job.plant, job.player.num_steps, job.rig.starts_at_rest)


def _show_dry_run(job: Job, rules: Any, as_json: bool) -> int:
    """What the player would send on a plant that stays at rest: all of a signal."""
    import numpy as np

    from ..safety import Watch, allowed

    d, rest = job.rig.description, np.zeros(len(job.rig.description.outputs))
    inputs, watch = [], Watch.start(np, rules, rest)
    for k in range(job.player.num_steps):
        watch, input = allowed(np, rules, watch, job.player(k, rest))
        job.player.applied(input)
        inputs.append(input)
    sent = np.array(inputs)
    summary = {
        "played": job.name, "num_steps": len(sent), "dt": d.dt,
        "inputs": {i.name: {"first": u[:5].tolist(), "smallest": float(u.min()),
                            "largest": float(u.max()), "rms": float(np.sqrt(np.mean(u**2)))}
                   for i, u in zip(d.inputs, sent.T, strict=True)},
    }  # fmt: skip
    if as_json:
        show_json(summary)
        return 0
    words = ("smallest", "largest", "rms")
    rows = [
        [name, *(f"{v[word]:.4g}" for word in words), ", ".join(f"{x:.3g}" for x in v["first"])]
        for name, v in summary["inputs"].items()
    ]
    show_table(
        f"{job.name}: {len(sent)} samples of {d.dt:g} s; nothing is sent. A policy answers to what "
        "it measures; this is its answer to a plant that does not move.",
        ["input", *words, "first"], rows,
    )  # fmt: skip
    return 0


def _show(job: Job, outcome: Any, tracker: Any, out: Path, as_json: bool) -> None:
    d = job.rig.description
    estimate = {} if tracker is None else tracker.latest
    if as_json:
        live = {n: {"estimate": v, "ci95_half": h} for n, (v, h) in estimate.items()}
        show_json({"file": str(out), "live_estimate": live, **outcome.to_dict()})
        return
    rows = [["ended", outcome.reason], ["samples", str(outcome.num_samples)]]
    for output, largest in zip(d.outputs, outcome.max_abs_output, strict=True):
        unit, factor = display_unit(output.unit)
        level = output.critical_level
        limit = "" if level is None else f" (critical level {factor * level:g})"
        rows.append([f"largest |{output.name}|", f"{factor * largest:.4g} {unit}{limit}"])
    late = outcome.to_dict()["late_ms_percentiles"]
    if late:
        shown = ", ".join(f"{p} %: {v:.3g}" for p, v in late.items())
        rows.append(["readings late, ms", f"{shown}; {outcome.num_missed} deadlines missed"])
    if "filter_interventions" in outcome.player:
        unsafe = outcome.player["filter_without_safe_input"]
        told = f"; at {unsafe} samples no input was safe for every plant" if unsafe else ""
        rows.append(["filter interventions", f"{outcome.player['filter_interventions']}{told}"])
    true = outcome.rig.get("true_params", {})
    for name, (value, half) in estimate.items():
        told = f"; true {true[name]:.5g}" if name in true else ""
        rows.append([f"{name}, live estimate", f"{value:.5g} ± {half:.2g}{told}"])
    show_table(f"{d.name}, {job.name}", ["", ""], rows)
    told = f"; next: excite identify {out} --plant {d.name}" if outcome.num_samples else ""
    click.echo(f"record: {out}{told}")
