"""`excite plants`: the shipped plants, and the description of one plant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import computing, json_option, plot_option, show_json, show_table


@click.command()
@click.argument("plant", required=False)
@json_option
@plot_option
@computing
def plants(plant: str | None, as_json: bool, plot: Path | None) -> None:
    """List the plants, or describe PLANT: a name, or path/to/file.py:ClassName.

    --plot draws PLANT's nominal response to every classical excitation.
    """
    from ..plant.catalogue import PLANTS, plant_named

    if plant is None and plot is not None:
        raise ValueError("--plot needs a PLANT")
    chosen = [plant_named(name) for name in (PLANTS if plant is None else [plant])]
    descriptions = [p.description for p in chosen]
    if plot is not None:
        _plot(chosen[0], plot)
    if as_json:
        show_json({"plants": [{**d.to_dict(), "hash": d.hash} for d in descriptions]})
    elif plant is None:
        show_table(
            "Plants (details: excite plants NAME)",
            ["plant", "inputs", "outputs", "parameters", "dt [s]"],
            [
                [
                    d.name,
                    *(", ".join(p.name for p in ps) for ps in (d.inputs, d.outputs, d.parameters)),
                    f"{d.dt:g}",
                ]
                for d in descriptions
            ],
        )
    else:
        _describe(descriptions[0], (type(chosen[0]).__doc__ or "").strip())


def _describe(d: Any, text: str) -> None:
    import inspect

    from ..description import display_unit

    click.echo(inspect.cleandoc(text) + "\n")
    show_table(
        f"{d.name}: parameters",
        ["name", "unit", "nominal", "kind", "bounds", "target"],
        [
            [p.name, p.unit, f"{p.nominal:g}", "positive" if p.positive else "free",
             " to ".join("–" if b is None else f"{b:g}" for b in (p.lower, p.upper)),
             "yes" if p.target else "no"]
            for p in d.parameters
        ],
    )  # fmt: skip
    show_table(
        "constants",
        ["name", "unit", "value"],
        [[c.name, c.unit, f"{c.value:g}"] for c in d.constants],
    )
    show_table(
        "inputs",
        ["name", "unit", "limits", "classical amplitude"],
        [[i.name, i.unit, f"{i.lower:g} to {i.upper:g}", f"{i.amplitude:g}"] for i in d.inputs],
    )

    def level(value: float | None, unit: str) -> str:
        shown, factor = display_unit(unit)
        return "–" if value is None else f"{value * factor:g} {shown}"

    show_table(
        f"outputs, measured every {d.dt:g} s",
        ["name", "unit", "noise sd", "resolution", "warning level", "critical level"],
        [
            [o.name, o.unit, f"{o.noise_sd:g}", f"{o.resolution:g}",
             level(o.warning_level, o.unit), level(o.critical_level, o.unit)]
            for o in d.outputs
        ],
    )  # fmt: skip
    click.echo(f"band {d.band[0]:g} to {d.band[1]:g} Hz, hash {d.hash[:16]}")


def _plot(plant: Any, path: Path) -> None:
    import jax

    from ..excitation.catalogue import EXCITATIONS
    from ..record import Record
    from ..record.figure import episodes_figure, save
    from ..simulation import run_episode

    responses = {}
    for name, kind in EXCITATIONS.items():
        episode = run_episode(plant, plant.nominal, kind(), 500, jax.random.key(0))
        responses[name] = Record.of_episode(episode.time, episode.inputs, episode.outputs)
    save(episodes_figure(plant.description, responses), path)
