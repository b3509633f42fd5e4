"""`excite report`: runs as one self-contained HTML page."""

from __future__ import annotations

from pathlib import Path

import click

from .options import OUT_FILE, json_option, progress_bar, show_json


@click.command()
@click.argument("runs", nargs=-1, required=True, type=OUT_FILE, metavar="RUN...")
@click.option("--out", type=OUT_FILE, required=True, metavar="FILE.html", help="Page to write.")
@click.option("--overwrite", is_flag=True, help="Replace the page if it exists.")
@json_option
def report(runs: tuple[Path, ...], out: Path, overwrite: bool, as_json: bool) -> None:
    """Write one self-contained page of figures, tables and provenance.

    RUN is a run folder of `excite identify`, `excite campaign` or `excite study run`, or a
    record with its sidecar; several are shown side by side.
    """
    from ..report.report import report as verb

    with progress_bar("report") as progress:
        page = verb(runs, out, overwrite=overwrite, progress=progress).encode()
    if as_json:
        show_json({"file": str(out), "runs": [str(run) for run in runs], "bytes": len(page)})
    else:
        click.echo(f"report: {out}, {len(page) / 1e6:.2g} MB")
