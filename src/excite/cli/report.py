"""`excite report`: runs as one page, document or notebook."""

from __future__ import annotations

from pathlib import Path

import click

from .options import OUT_FILE, json_option, progress_bar, show_json


@click.command()
@click.argument("runs", nargs=-1, required=True, type=OUT_FILE, metavar="RUN...")
@click.option("--out", type=OUT_FILE, required=True, metavar="FILE", help="File to write.")
@click.option(
    "--format",
    metavar="html|md|tex|ipynb",
    help="HTML page, Markdown, LaTeX or Jupyter notebook; default that of the file's ending.",
)
@click.option("--overwrite", is_flag=True, help="Replace the file and its figures if they exist.")
@json_option
def report(
    runs: tuple[Path, ...], out: Path, format: str | None, overwrite: bool, as_json: bool
) -> None:
    """Write one report of figures, tables and provenance.

    RUN is a run folder of `excite identify`, `excite campaign` or `excite study run`, or a
    record with its sidecar; several are shown side by side. FILE.html is one self-contained page.
    FILE.md and FILE.tex have their figures in the folder FILE_files beside them. FILE.ipynb reads
    the runs in Python, draws their figures, and is not executed yet.
    """
    from ..report.report import figures_of, format_of
    from ..report.report import report as verb

    with progress_bar("report") as progress:
        page = verb(runs, out, format=format, overwrite=overwrite, progress=progress).encode()
    figures, size = figures_of(out, format_of(out, format)), f"{len(page) / 1e6:.2g} MB"
    if as_json:
        content = {"file": str(out), "runs": [str(run) for run in runs], "bytes": len(page)}
        show_json({**content, "figures": None if figures is None else str(figures)})
    else:
        click.echo(f"report: {out}, {size}" + f", and figures in {figures}" * bool(figures))
