"""`excite identify`: from recorded experiments to parameters with confidence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import (
    NAMES,
    NUMBERS,
    OUT_FILE,
    command_line,
    computing,
    json_option,
    merged,
    plot_option,
    progress_bar,
    show_json,
    show_table,
)


@click.command()
@click.argument("files", nargs=-1, required=True, type=OUT_FILE, metavar="FILE...")
@click.option("--plant", required=True, help="Name, or path/to/file.py:ClassName.")
@click.option(
    "--estimator",
    default="nls",
    show_default=True,
    metavar="NAME",
    help="nls, arx-rls (the paper's), arx-rls-wide (wide start covariance) or decrement.",
)
@click.option(
    "--initial-state",
    type=click.Choice(["auto", "free", "known"]),
    default="auto",
    show_default=True,
    help="Estimate initial states, or take the plant's; auto: known where the "
    "sidecar says that the record starts there.",
)
@click.option(
    "--start",
    type=NUMBERS,
    multiple=True,
    help="Where the search begins; default the nominal parameters.",
)
@click.option(
    "--hold",
    type=NUMBERS,
    multiple=True,
    help="Known values, not to be estimated: tau=0.162.",
)
@click.option(
    "--validate",
    "validation",
    type=OUT_FILE,
    multiple=True,
    metavar="FILE",
    help="Held-out record to simulate with the estimate.",
)
@click.option(
    "--column",
    type=NAMES,
    multiple=True,
    help="Columns of the file that have another name: pitch=qm; a comma in it is written \\,.",
)
@click.option(
    "--scale",
    type=NUMBERS,
    multiple=True,
    help="Factors from the file's units to the plant's: pitch=0.01745.",
)
@click.option("--out", type=OUT_FILE, metavar="FOLDER", help="Leave a run folder.")
@click.option("--overwrite", is_flag=True, help="Replace the run folder if it exists.")
@plot_option
@json_option
@computing
def identify(
    files: tuple[Path, ...], out: Path | None, plot: Path | None, as_json: bool, **options: Any
) -> int:
    """Estimate PLANT's parameters from one or several records (.csv, .mat).

    Several records are fitted together: they share the parameters, each has an initial
    state of its own.
    """
    import dataclasses

    from ..estimation import NLS
    from ..estimation.catalogue import estimator_named
    from ..estimation.identify import identify as run
    from ..estimation.result import write_run
    from ..files import require_free_run_folder
    from ..plant.catalogue import plant_named
    from ..record import read_record
    from ..report.figure import save
    from ..report.figures import identification_figure

    if out is not None:
        require_free_run_folder(out, options["overwrite"])
    chosen, method = plant_named(options["plant"]), estimator_named(options["estimator"])
    for name in ("start", "hold"):
        if options[name] and not isinstance(method, NLS):
            raise ValueError(f"{method.name} estimates all at once and takes no --{name}")
    held = merged(options["hold"])
    if held:
        method = dataclasses.replace(method, known=tuple(held))
    mapping = merged(options["column"]), merged(options["scale"])
    records = [read_record(file, chosen.description, *mapping) for file in files]
    held_out = [read_record(file, chosen.description, *mapping) for file in options["validation"]]
    with progress_bar("identifying"):
        result = run(
            chosen,
            records,
            method,
            start={**merged(options["start"]), **held},
            initial_state=options["initial_state"],
            validation=held_out,
        )
    data = result.to_dict()
    if plot is not None:
        first = result.fitted[0]
        save(identification_figure(result.plant, data, first.record, first.simulated), plot)
    if out is not None:
        write_run(result, out, options["overwrite"], command_line())
    if as_json:
        show_json(data)
    else:
        _show(result.plant, data, out)
    return 0 if result.is_usable else 1


def _show(description: Any, data: dict[str, Any], out: Path | None) -> None:
    from ..report.numbers import number
    from ..report.tables import (
        largest_correlation,
        parameter_cells,
        parameter_header,
        residual_in_words,
    )

    show_table(
        f"{data['plant']}, {data['estimator']}, initial state {data['initial_state']}: "
        f"{data['status']}",
        parameter_header(),
        [parameter_cells(name, p) for name, p in data["params"].items()],
    )
    for name, percent in data["fit_percent"].items():
        click.echo(f"{name}: fit {number(percent, 4)} %, {residual_in_words(data, name)}")
    for v in data["validation"]:
        for name, percent in v["fit_percent"].items():
            click.echo(f"{v['file']}: held-out {name} fit {number(percent, 4)} %")
    for sentence in data["verdict"]:
        click.echo(sentence)
    if len(description.parameters) > 1:
        click.echo(f"largest correlation: {largest_correlation(data)}")
    if out is not None:
        click.echo(f"run folder: {out}")
