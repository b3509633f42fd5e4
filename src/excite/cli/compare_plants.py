"""`excite compare-plants`: which of several plants explains the same records best."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .identify import arguments_of, of_records
from .options import OUT_FILE, computing, json_option, progress_bar, show_json


@click.command("compare-plants")
@click.argument("plants", nargs=-1, required=True, metavar="PLANT PLANT...")
@click.option(
    "--record",
    "files",
    type=OUT_FILE,
    multiple=True,
    required=True,
    metavar="FILE",
    help="Record to fit; several are fitted together.",
)
@of_records
@json_option
@computing
def compare_plants(
    plants: tuple[str, ...], files: tuple[Path, ...], as_json: bool, **options: Any
) -> int:
    """Fit several PLANTs to the same records and compare them.

    The plant with the smallest Bayesian information criterion comes first. The p-value tests a
    plant with more unknowns against the first one given, which must be a special case of it.
    """
    from ..estimation.comparison import compare_plants as verb

    with progress_bar("comparing"):
        result = verb(files, plants, **arguments_of(options))
    if as_json:
        show_json(result.to_dict())
    else:
        click.echo(result)
    return 0 if result.plants[0].result.is_usable else 1
