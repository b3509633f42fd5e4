"""`excite simulate`: one experiment on a simulated plant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import (
    NAMES,
    NUMBERS,
    OUT_FILE,
    VALUES,
    RunFailedError,
    computing,
    json_option,
    merged,
    plot_option,
    progress_bar,
    show_json,
    show_table,
)


def excitation_options(command: Any) -> Any:
    """Options that choose an excitation; shared with `information`."""
    for option in reversed(
        [
            click.option("--excitation", metavar="NAME",
                         help="random, prbs, chirp, multisine, square, decay, loop-NAME around one "
                         "of them, a shipped policy, or a file: policy (.safetensors) or signal "
                         "(.csv, .mat); default chirp."),
            click.option("--set", "settings", type=VALUES, multiple=True,
                         help="Options of the excitation: amplitude, hold, clock, register, "
                         "start_frequency, stop_frequency, frequency, logarithmic, pump; of a "
                         "loop also gain, damping."),
            click.option("--steps", type=click.IntRange(2, 10_000_000), metavar="T",
                         help="Length in samples; default 500, that of a policy, or all of a "
                         "file."),
            click.option("--params", type=NUMBERS, multiple=True,
                         help="True parameters where they are not the nominal ones."),
            click.option("--noise", type=NUMBERS, multiple=True,
                         help="Standard deviation of an output's noise, in its unit."),
            click.option("--resolution", type=NUMBERS, multiple=True,
                         help="Step of an output's encoder, in its unit."),
            click.option("--seed", type=click.IntRange(0, 2**63 - 1), default=0, show_default=True),
            click.option("--column", type=NAMES, multiple=True,
                         help="Columns of the input file that have another name."),
            click.option("--scale", type=NUMBERS, multiple=True,
                         help="Factors from the input file's units to the plant's."),
        ]
    ):  # fmt: skip
        command = option(command)
    return command


def prepared(options: dict[str, Any], plant_name: str, file: Path | None) -> dict[str, Any]:
    """Plant, true parameters, excitation, length and key from the options above.

    A policy of another plant is warned of.
    """
    import jax
    import jax.numpy as jnp

    from ..excitation import Replay
    from ..plant import params_from
    from ..plant.catalogue import plant_named, with_sensor
    from ..record import read_record, require_playable

    plant = with_sensor(
        plant_named(plant_name), merged(options["noise"]), merged(options["resolution"])
    )
    record, origin, name = None, {}, options["excitation"]
    if file is not None and (options["settings"] or name):
        raise ValueError("an input file takes the place of --excitation and --set")
    if file is None:
        name = name or "chirp"
        excitation, origin, steps = _named(name, options, plant)
    else:
        columns, scales = merged(options["column"]), merged(options["scale"])
        record = read_record(file, plant.definition, columns, scales, inputs_only=True)
        require_playable(record, plant.definition)
        plant = plant.changed(dt=record.dt)
        excitation, name = Replay(jnp.asarray(record.inputs)), "replay"
        steps = options["steps"] or len(record.inputs) - 1
        if steps > len(record.inputs):
            raise ValueError(f"{file} has {len(record.inputs)} inputs, --steps asks for {steps}")
    job = {
        "plant": plant,
        "params": params_from(plant, merged(options["params"])),
        "excitation": excitation,
        "excitation_name": name,
        "origin": origin,
        "warnings": [origin["warning"]] if "warning" in origin else [],
        "steps": steps,
        "key": jax.random.key(options["seed"]),
        "record": record,
    }
    for warning in job["warnings"]:
        click.echo(f"warning: {warning}", err=True)
    return job


def _named(name: str, options: dict[str, Any], plant: Any) -> tuple[Any, dict[str, str], int]:
    """An excitation by name, the origin of a policy, and how many steps."""
    from ..excitation import PolicyExcitation, Replay
    from ..excitation.catalogue import excitation_and_origin

    excitation, origin = excitation_and_origin(name, merged(options["settings"]), plant)
    if isinstance(excitation, PolicyExcitation):
        longest = excitation.layout.num_steps
    elif isinstance(excitation, Replay):
        longest = len(excitation.inputs)
    else:
        return excitation, origin, options["steps"] or 500
    steps = options["steps"] or longest
    if steps > longest:
        raise ValueError(f"{name} was made for {longest} steps; --steps asks for {steps}")
    return excitation, origin, steps


@click.command()
@click.argument("plant")
@click.argument("input_file", required=False, type=OUT_FILE)
@excitation_options
@click.option("--out", type=OUT_FILE, metavar="FILE", help="Write the record (.csv, .mat).")
@click.option("--overwrite", is_flag=True, help="Replace the record if it exists.")
@plot_option
@json_option
@computing
def simulate(
    plant: str, input_file: Path | None, out: Path | None, plot: Path | None, as_json: bool,
    **options: Any,
) -> None:  # fmt: skip
    """Run one experiment on PLANT and record what its sensor shows.

    The input is an excitation, or replayed from INPUT_FILE (columns: time and the inputs).
    """
    import numpy as np

    from ..excitation import crest_factor
    from ..record import require_record_path, write_record
    from ..report.figure import save
    from ..report.figures import episode_figure
    from ..safety import critical_levels, is_violation, max_abs_output
    from ..simulation import run_episode

    if out is not None:
        require_record_path(out, options["overwrite"])
    job = prepared(options, plant, input_file)
    with progress_bar("simulating"):
        run = run_episode(job["plant"], job["params"], job["excitation"], job["steps"], job["key"])
    if not np.all(np.isfinite(run.outputs)):
        raise RunFailedError(
            "the simulation left the finite numbers: these parameters make the plant too fast "
            "for its integration step, or unstable"
        )
    description = job["plant"].description
    record = _record(run, job, options["seed"])
    summary = {
        "plant": description.name,
        "excitation": job["excitation_name"],
        "num_steps": job["steps"],
        "dt": description.dt,
        "params": record.metadata["params"],
        "crest_factor": _by_name(description.inputs, crest_factor(run.inputs)),
        "max_abs_output": _by_name(description.outputs, max_abs_output(run.outputs)),
        "is_violation": bool(is_violation(run.outputs, critical_levels(description))),
        "file": None if out is None else str(out),
        "warnings": job["warnings"],
    }
    if plot is not None:
        save(episode_figure(description, record), plot)
    if out is not None:
        write_record(out, record, description)
    if as_json:
        show_json(summary)
    else:
        _show(description, summary)


def _by_name(parts: Any, values: Any) -> dict[str, float]:
    return {part.name: float(value) for part, value in zip(parts, values, strict=True)}


def _record(run: Any, job: dict[str, Any], seed: int) -> Any:
    from ..web.jobs import simulated_record

    provenance = {"excitation": job["excitation_name"], "seed": seed, **job["origin"]}
    return simulated_record(run, job["plant"], job["params"], provenance)


def _show(description: Any, summary: dict[str, Any]) -> None:
    from ..description import display_unit
    from ..report.numbers import number

    rows = [
        [f"crest factor of {name}", number(value), ""]
        for name, value in summary["crest_factor"].items()
    ]
    for part in description.outputs:
        unit, factor = display_unit(part.unit)
        value = number(factor * summary["max_abs_output"][part.name])
        level = part.critical_level
        limit = "" if level is None else f"critical level {factor * level:g} {unit}"
        rows.append([f"largest |{part.name}|", f"{value} {unit}", limit])
    title = (
        f"{summary['plant']}, {summary['excitation']}, {summary['num_steps']} steps of "
        f"{summary['dt']:g} s: {'VIOLATION' if summary['is_violation'] else 'safe'}"
    )
    show_table(title, ["", "", ""], rows)
    if summary["file"]:
        click.echo(f"record: {summary['file']}")
