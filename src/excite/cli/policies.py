"""`excite policies` and `excite evaluate`: the shipped policies, and the score of one."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from .options import (
    NUMBERS,
    SEED,
    SPREAD,
    WholeNumber,
    coast_option,
    computing,
    json_option,
    merged,
    prior_option,
    progress_bar,
    show_json,
    show_table,
    uncertainty_option,
    warnings_shown,
)
from .study import show_comparison


@click.command()
@click.argument("files", metavar="[FILE]...", nargs=-1)
@json_option
def policies(files: tuple[str, ...], as_json: bool) -> None:
    """List the policies that come with the package, or those in files.

    A policy with its plant's name is the default of that plant. Campaigns prefer the one that
    ends in -wide.
    """
    from ..policy import policy_path, read_policy, shipped_policies

    shipped, found = shipped_policies(), []
    chosen = {name: policy_path(name) or Path(name) for name in files or shipped}
    for name, path in chosen.items():
        policy = read_policy(path if path.suffix else name)
        found.append(
            {
                "name": name,
                "plant": policy.plant.name,
                "default": name == policy.plant.name and name in shipped,
                "num_steps": policy.layout.num_steps,
                "method": policy.provenance.get("method"),
                "agent": policy.provenance.get("agent"),
                "study": policy.provenance.get("study"),
                "bytes": path.stat().st_size,
                "hash": policy.hash,
                "certificate": policy.certificate,
                "file": str(path),
            }
        )
    if as_json:
        show_json({"policies": found})
        return
    header = ["name", "plant", "default", "steps", "agent", "study", "worst found"]
    rows = [
        [p["name"], p["plant"], "yes" if p["default"] else "", str(p["num_steps"]),
         str(p["agent"]), str(p["study"]), _worst(p["certificate"])]
        for p in found
    ]  # fmt: skip
    title = "policies in files" if files else "shipped policies"
    show_table(f"{title}; use a name as --excitation", header, rows)
    click.echo(
        "worst found: largest output over its critical level that a search found in the "
        "uncertainty\ndeclared in the policy's file (--json shows it; excite falsify)"
    )


def _worst(certificate: Mapping[str, Any] | None) -> str:
    if certificate is None:
        return "-"
    from ..policy import shown_nearness

    sizes = [certificate["nearness"], certificate["noise_nearness"]]
    return shown_nearness(None if None in sizes else max(sizes))


@click.command()
@click.argument("policy")
@click.option("--plant", help="Name or path/to/file.py:ClassName; default the policy's plant.")
@click.option(
    "--episodes", type=WholeNumber(1), default=1000, show_default=True, help="Plants drawn."
)
@click.option("--seed", type=SEED, default=0, show_default=True, help="Seed of the plants.")
@click.option(
    "--spread",
    type=SPREAD,
    default=0.3,
    show_default=True,
    help="Spread of the plants (0.3, factor:3).",
)
@prior_option
@uncertainty_option("What else may differ, as in 'excite falsify'.")
@coast_option
@click.option("--noise", type=NUMBERS, multiple=True, help="Noise sd of an output, in its unit.")
@click.option("--estimators", metavar="NAME,...", help="Default nls, and arx-rls if possible.")
@click.option("--rig", "on_rig", is_flag=True, help="Use the plant's simulated rig.")
@click.option("--filter", "filtered", is_flag=True, help="With --rig: also behind a safety filter.")
@json_option
@computing
def evaluate(policy: str, as_json: bool, **options: Any) -> None:
    """Score POLICY, a file or a shipped name, on plants drawn at random."""
    from ..policy import read_policy
    from ..study.evaluate import evaluate as evaluated

    on_rig, filtered, noise = (options.pop(n) for n in ("on_rig", "filtered", "noise"))
    for name in ("uncertainty", "prior"):
        options[name] = merged(options[name])
    with warnings_shown(), progress_bar(f"evaluating {policy}") as progress:
        found = evaluated(
            policy, rig=on_rig, filter=filtered, noise=merged(noise), progress=progress, **options
        )
    if as_json:
        settings = found.study.data()
        own = read_policy(policy)
        known = {"policy_hash": own.hash, "certificate": own.certificate}
        show_json({**known, "study": settings, **found.data()})
    else:
        show_comparison(found)
        click.echo(f"log det of the Fisher information: {found.rows[0].log_det_information:.2f}")
        click.echo(textwrap.fill(read_policy(policy).claim, 80))
