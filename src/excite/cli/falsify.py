"""`excite falsify`: a search for the plant on which a policy or a signal is least safe."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from .options import (
    COAST,
    NUMBERS,
    OUT_FILE,
    SEED,
    SPREAD,
    VALUES,
    WholeNumber,
    computing,
    json_option,
    merged,
    plot_option,
    progress_bar,
    show_json,
    uncertainty_option,
    warnings_shown,
)


@click.command()
@click.argument("excitation", metavar="POLICY")
@click.option("--plant", help="Name or path/to/file.py:ClassName; default the policy's plant.")
@click.option(
    "--set",
    "settings",
    type=VALUES,
    multiple=True,
    help="Options of a signal, such as amplitude=5.",
)
@click.option(
    "--spread",
    type=SPREAD,
    help="Spread of the parameters (0.3, factor:3); default that of the policy's training, or 0.3.",
)
@uncertainty_option("What else may differ; default that of the policy's training.")
@click.option(
    "--coast",
    type=COAST,
    metavar="N",
    help="Samples after the end that are searched too; default that of the training, or 0.",
)
@click.option("--noise", type=NUMBERS, multiple=True, help="Noise sd of an output, in its unit.")
@click.option(
    "--steps",
    type=WholeNumber(2, 1_000_000),
    metavar="T",
    help="Length in samples; default 500, or that of a policy or a file.",
)
@click.option(
    "--budget",
    type=WholeNumber(100, 10_000_000),
    default=10_000,
    show_default=True,
    metavar="N",
    help="Number of simulated experiments, about.",
)
@click.option(
    "--seed",
    type=SEED,
    default=0,
    show_default=True,
    help="Seed of the search.",
)
@click.option("--rig", is_flag=True, help="Search on the plant's simulated rig.")
@click.option("--filter", is_flag=True, help="With --rig: behind the predictive safety filter.")
@click.option("--out", type=OUT_FILE, metavar="FILE", help="Write the worst plant (.json).")
@click.option(
    "--certify",
    type=OUT_FILE,
    metavar="FILE",
    help="Write the policy with this search as its certificate (.safetensors).",
)
@click.option(
    "--guard",
    is_flag=True,
    help="Make a guard for rigs, too, in the file of --certify (see excite run --guard), from "
    "500 more experiments, or a twentieth of the budget where that is more.",
)
@click.option("--overwrite", is_flag=True, help="Replace these files if they exist.")
@plot_option
@json_option
@computing
def falsify(
    excitation: str, out: Path | None, certify: Path | None, overwrite: bool, plot: Path | None,
    as_json: bool, **options: Any,
) -> None:  # fmt: skip
    """Search for the plant on which POLICY, or a signal, comes nearest to a critical level.

    The search goes over the declared uncertainty and over sensor noise. What it finds is
    found; what it does not find is not proved. Exit code 1 where a level is reached.
    """
    from ..files import require_new_file
    from ..study.falsify import falsify as falsified
    from ..study.falsify import require_certifiable, require_plant_path

    if out is not None:
        require_plant_path(out, overwrite)
    if options["guard"] and certify is None:
        raise click.UsageError("--guard needs --certify FILE, where it is kept")
    if certify is not None:
        require_certifiable(excitation, certify, overwrite, options["steps"])
    if plot is not None:
        require_new_file(plot, overwrite)
    options["uncertainty"] = merged(options["uncertainty"]) or None
    settings, noise = merged(options.pop("settings")), merged(options.pop("noise"))
    with warnings_shown(), progress_bar(f"falsifying {excitation}") as progress:
        found = falsified(
            excitation, options=settings, noise=noise, progress=progress, **options,
        )  # fmt: skip
    if as_json:
        show_json(
            {"excitation": found.excitation, "plant": found.plant.name, **found.certificate()}
        )
    else:
        click.echo(found)
    if out is not None:
        found.save(out, overwrite)
        if not as_json:
            chosen = "".join(
                f" --set {name}={json.dumps(value)}" for name, value in settings.items()
            )
            coast = f" --coast {found.coast}" * bool(found.coast)
            replay = f"excite simulate {out}"
            if found.rig:
                known = "" if options["plant"] is None else f" --plant {options['plant']}"
                filtered = f" --filter --spread {found.spread}" if found.filter else ""
                replay = f"excite run --rig {out}{known}{filtered} --fast --out replay.csv"
            click.echo(
                f"worst plant: {out}\nreplay: {replay} --excitation {excitation}"
                f"{chosen} --steps {found.num_steps}{coast} --seed {found.worst_seed}"
            )
    if certify is not None:
        found.certified().save(certify, overwrite)
        if not as_json:
            click.echo(f"policy with this certificate: {certify}")
    if plot is not None:
        from ..record.figure import save

        save(found.plot(), plot)
    click.get_current_context().exit(0 if found.is_safe else 1)
