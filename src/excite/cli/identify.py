"""`excite identify`: parameters and their confidence intervals from recorded experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from .completion import estimators
from .options import (
    NAMES,
    NUMBERS,
    OUT_FILE,
    Callback,
    Number,
    WholeNumber,
    command_line,
    computing,
    json_option,
    merged,
    plot_option,
    progress_bar,
    show_json,
)

_OF_RECORDS = (
    click.option(
        "--initial-state",
        type=click.Choice(["auto", "free", "known"]),
        default="auto",
        show_default=True,
        help="Estimate initial states, or use the plant's; auto: known where the "
        "sidecar says that the record starts there.",
    ),
    click.option(
        "--validate",
        type=OUT_FILE,
        multiple=True,
        metavar="FILE",
        help="Held-out record to simulate with the estimate.",
    ),
    click.option(
        "--validate-state",
        default="auto",
        show_default=True,
        metavar="auto|known|first|SHARE",
        help="Initial state of held-out records: the plant's, from the first measurements, or "
        "estimated from a share that does not count (10%).",
    ),
    click.option(
        "--validate-column",
        type=NAMES,
        multiple=True,
        help="Columns of held-out records where they differ from --column: u=uVal,y=yVal.",
    ),
    click.option(
        "--column",
        type=NAMES,
        multiple=True,
        help="Columns of the file that have another name: pitch=qm; of a bag by topic and field: "
        "pitch=/joint_states.position[0]; a comma in it is written \\,.",
    ),
    click.option(
        "--scale",
        type=NUMBERS,
        multiple=True,
        help="Factors from the file's units to the plant's: pitch=0.01745.",
    ),
    click.option(
        "--unit",
        type=NAMES,
        multiple=True,
        help="The file's units where they are not the plant's: time=ms,pitch=deg.",
    ),
    click.option(
        "--set-input",
        type=NUMBERS,
        multiple=True,
        help="Constant inputs that the file does not have: voltage=5.",
    ),
    click.option(
        "--dt", type=Number(), metavar="SECONDS", help="Sampling time of a file without time."
    ),
    click.option(
        "--rows",
        metavar="START:STOP:STEP",
        help="Rows to use, counted from 0 below the names: 100:1000:5.",
    ),
    click.option(
        "--hold-input",
        default="constant",
        show_default=True,
        metavar="constant|linear",
        help="Inputs between samples; one of several by its name: voltage=linear.",
    ),
)


def of_records(command: Callback) -> Callback:
    """Adds the options on how records are read and fitted."""
    for option in reversed(_OF_RECORDS):
        command = option(command)
    return command


def arguments_of(options: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of `excite.identify` that these options give."""
    hold_input = options["hold_input"]
    return {
        "initial_state": options["initial_state"],
        "hold_input": NAMES.convert(hold_input, None, None) if "=" in hold_input else hold_input,
        "validate": options["validate"],
        "validate_state": options["validate_state"],
        "validate_columns": merged(options["validate_column"]),
        "columns": merged(options["column"]),
        "scales": merged(options["scale"]),
        "units": merged(options["unit"]),
        "set_inputs": merged(options["set_input"]),
        "dt": options["dt"],
        "rows": options["rows"],
    }


def given_priors(words: Sequence[str]) -> list[dict[str, str] | Path] | None:
    """Priors by parameter, and paths of others."""
    found = [
        NAMES.convert(w, None, None) if "=" in w and not Path(w).exists() else Path(w)
        for w in words
    ]
    return found or None


@click.command()
@click.argument("files", nargs=-1, required=True, type=OUT_FILE, metavar="FILE...")
@click.option(
    "--plant", help="Name, or path/to/file.py:ClassName; default the plant the sidecar names."
)
@click.option(
    "--estimator",
    default="nls",
    show_default=True,
    metavar="NAME",
    help=f"{', '.join(estimators())}; arx-rls is the paper's.",
)
@click.option(
    "--intervals",
    type=click.Choice(["linear", "profile"]),
    default="linear",
    show_default=True,
    help="From standard errors, or from the profile likelihood (slower; sides may be open).",
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
    "--prior",
    multiple=True,
    metavar="NAME=DISTRIBUTION|PATH",
    help="What is known beforehand: J_p=normal:0.022:5%, lognormal:0.022:0.1, uniform:0.01:0.05; "
    "the run folder of other records; or a JSON file with mean and covariance.",
)
@click.option(
    "--likelihood",
    type=click.Choice(["normal", "student"]),
    default="normal",
    show_default=True,
    help="Distribution of the noise; with student, outliers hardly count.",
)
@click.option(
    "--uncertain",
    type=NAMES,
    multiple=True,
    help="Standard deviation of known constants, which widens the intervals: m=5%,g=0.02.",
)
@of_records
@click.option(
    "--posterior",
    type=OUT_FILE,
    metavar="FILE.nc",
    help="Draw posterior samples of the parameters, and write them as netCDF.",
)
@click.option(
    "--samples",
    type=WholeNumber(10),
    default=1000,
    show_default=True,
    help="Posterior samples of each of four chains.",
)
@click.option("--out", type=OUT_FILE, metavar="FOLDER", help="Run folder to write.")
@click.option("--overwrite", is_flag=True, help="Replace what exists.")
@plot_option
@click.option(
    "--plot-diagnosis",
    type=OUT_FILE,
    metavar="FILE",
    help="Write a figure of starts, correlations, residuals and profiles.",
)
@json_option
@computing
def identify(
    files: tuple[Path, ...],
    out: Path | None,
    plot: Path | None,
    plot_diagnosis: Path | None,
    posterior: Path | None,
    as_json: bool,
    **options: Any,
) -> int:
    """Estimate PLANT's parameters from one or several records.

    A record is a file .csv, .txt, .dat, .tsv, .mat, .h5, .hdf5, .parquet, .mcap or .db3, or the
    folder of a ROS 2 bag. Several records are fitted together: they share the parameters, each
    has its initial state.
    """
    from ..estimation.identify import identify as verb
    from ..estimation.result import KIND
    from ..files import require_free_run_folder

    if out is not None:
        require_free_run_folder(out, options["overwrite"], KIND)
    if posterior is not None:
        from ..estimation.posterior import require_extra
        from ..files import require_new_file

        require_extra()
        if options["estimator"] != "nls" or options["likelihood"] != "normal":
            raise ValueError("posterior samples need the estimator nls and the normal likelihood")
        if posterior.suffix != ".nc":
            raise ValueError(f"{posterior}: a file of posterior samples ends in .nc")
        require_new_file(posterior, options["overwrite"])
    with progress_bar("identifying") as progress:
        result = verb(
            files,
            options["plant"],
            options["estimator"],
            **{name: merged(options[name]) for name in ("start", "hold", "uncertain")},
            prior=given_priors(options["prior"]),
            likelihood=options["likelihood"],
            intervals=options["intervals"],
            progress=progress,
            **arguments_of(options),
        )
        is_drawn = posterior is not None and result.is_usable
        samples = result.posterior(options["samples"], progress=progress) if is_drawn else None
    if plot is not None or plot_diagnosis is not None:
        from ..record.figure import save

        if plot is not None:
            save(result.plot(), plot)
        if plot_diagnosis is not None:
            save(result.plot("diagnosis"), plot_diagnosis)
    if out is not None:
        result.save(out, options["overwrite"], command_line())
    found: dict[str, Any] | None = None
    if posterior is not None and samples is not None:
        from ..estimation.posterior import summary
        from ..files import write_bytes

        found = summary(samples)
        write_bytes(posterior, bytes(samples.to_netcdf(engine="h5netcdf")))
    if as_json:
        show_json(result.to_dict() | ({} if posterior is None else {"posterior": found}))
    else:
        click.echo(result)
        if found is not None:
            from ..report.results import posterior_text

            click.echo(f"\n{posterior_text(found)}")
        elif posterior is not None:
            click.echo("no posterior samples: a failed estimate has none")
        if out is not None:
            click.echo(f"run folder: {out}")
    return 0 if result.is_usable else 1
