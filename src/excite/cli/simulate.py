"""`excite simulate`: one experiment on a simulated plant."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .completion import signals
from .options import (
    NAMES,
    NUMBERS,
    OUT_FILE,
    SEED,
    VALUES,
    RunFailedError,
    WholeNumber,
    coast_option,
    computing,
    json_option,
    merged,
    plot_option,
    progress_bar,
    show_json,
    show_table,
)

if TYPE_CHECKING:
    from ..description import Input, Output, PlantDescription


def excitation_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options that choose an excitation; shared with `information`."""
    for option in reversed(
        [
            click.option("--excitation", metavar="NAME",
                         help=f"{', '.join(signals())}, loop-NAME around one of them, a shipped "
                         "policy, or a file: policy (.safetensors) or signal (.csv, .mat); default "
                         "chirp, for a task without memory random, and none for a plant without "
                         "inputs."),
            click.option("--set", "settings", type=VALUES, multiple=True,
                         help="Options of the excitation, such as amplitude=5 (the message about "
                         "an unknown one lists them); of a loop also gain, damping."),
            click.option("--steps", type=WholeNumber(2), metavar="T",
                         help="Length in samples; default 500, that of a policy, or all of a "
                         "file."),
            click.option("--params", type=NUMBERS, multiple=True,
                         help="True parameters that differ from the nominal ones."),
            click.option("--noise", type=NUMBERS, multiple=True,
                         help="Standard deviation of an output's noise, in its unit."),
            click.option("--resolution", type=NUMBERS, multiple=True,
                         help="Step of an output's encoder, in its unit."),
            click.option("--seed", type=SEED, default=0, show_default=True),
            click.option("--column", type=NAMES, multiple=True,
                         help="Columns of the input file with another name: voltage=u."),
            click.option("--scale", type=NUMBERS, multiple=True,
                         help="Factors from the input file's units to the plant's."),
        ]
    ):  # fmt: skip
        command = option(command)
    return command


def given_experiment(plant: str, file: Path | None, options: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of the verbs `simulate` and `information` from the options above."""
    from ..plant.catalogue import plant_from
    from ..record import read_record

    chosen, excitation = plant_from(plant), options["excitation"]
    if file is not None:
        if options["settings"] or options["excitation"]:
            raise ValueError("an input file takes the place of --excitation and --set")
        mapping = merged(options["column"]), merged(options["scale"])
        excitation = read_record(file, chosen.description, *mapping, inputs_only=True)
    return {
        "plant": chosen,
        "excitation": excitation,
        "options": merged(options["settings"]),
        "steps": options["steps"],
        **{name: merged(options[name]) for name in ("params", "noise", "resolution")},
        "seed": options["seed"],
    }


def show_warnings(warnings: Iterable[str]) -> None:
    """Warnings on stderr, one a line."""
    for warning in warnings:
        click.echo(f"warning: {warning}", err=True)


@click.command()
@click.argument("plant")
@click.argument("input_file", required=False, type=OUT_FILE)
@excitation_options
@coast_option
@click.option("--out", type=OUT_FILE, metavar="FILE", help="Write the record (.csv, .mat).")
@click.option("--overwrite", is_flag=True, help="Replace the record if it exists.")
@plot_option
@json_option
@computing
def simulate(
    plant: str, input_file: Path | None, out: Path | None, plot: Path | None, as_json: bool,
    **options: Any,
) -> None:  # fmt: skip
    """Run one experiment on PLANT and record its measured outputs.

    The input is an excitation, or replayed from INPUT_FILE (columns: time and the inputs).
    """
    from ..excitation import crest_factor
    from ..record import require_record_path, write_record
    from ..safety import critical_levels, is_violation, max_abs_output
    from ..simulation import DivergedError, Experiment

    if out is not None:
        require_record_path(out, options["overwrite"])
    experiment = Experiment.of(
        **given_experiment(plant, input_file, options), coast=options["coast"]
    )
    show_warnings(experiment.warnings)
    with progress_bar("simulating"):
        try:
            run = experiment.run()
        except DivergedError as error:
            raise RunFailedError(str(error)) from None
    description, record = experiment.plant.description, experiment.record(run)
    summary = {
        "plant": description.name,
        "excitation": experiment.name,
        "num_steps": experiment.num_steps,
        "dt": description.dt,
        "params": record.metadata["params"],
        "crest_factor": _by_name(description.inputs, crest_factor(run.inputs)),
        "max_abs_output": _by_name(description.outputs, max_abs_output(run.outputs)),
        "is_violation": bool(is_violation(run.outputs, critical_levels(description))),
        "file": None if out is None else str(out),
        "warnings": experiment.warnings,
    }
    if plot is not None:
        from ..record.figure import episode_figure, save

        save(episode_figure(description, record), plot)
    if out is not None:
        write_record(out, record, description)
    if as_json:
        show_json(summary)
    else:
        _show(description, summary)


def _by_name(parts: Iterable[Input | Output], values: Iterable[Any]) -> dict[str, float]:
    return {part.name: float(value) for part, value in zip(parts, values, strict=True)}


def _show(description: PlantDescription, summary: dict[str, Any]) -> None:
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
