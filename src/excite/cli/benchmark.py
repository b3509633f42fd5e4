"""`excite benchmark`: the table of a study file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from .options import (
    OUT_FILE,
    command_line,
    computing,
    json_option,
    plot_option,
    progress_bar,
    show_json,
    show_table,
)


@click.command()
@click.argument("study", metavar="STUDY")
@click.option("--episodes", type=click.IntRange(min=1), help="Instead of the study's.")
@click.option("--seed", type=click.IntRange(0, 2**63 - 1), help="Instead of the study's.")
@click.option("--estimators", metavar="NAME,...", help="Instead of the study's.")
@click.option("--out", type=OUT_FILE, metavar="FOLDER", help="Leave a run folder.")
@click.option("--overwrite", is_flag=True, help="Replace the run folder if it exists.")
@plot_option
@json_option
@computing
def benchmark(
    study: str, out: Path | None, plot: Path | None, as_json: bool, **options: Any
) -> None:
    """Compare the methods of STUDY, a shipped study or a file, under identical conditions."""
    from ..files import require_free_run_folder
    from ..report.figure import save
    from ..report.figures import benchmark_figure
    from ..study.episodes import example_episodes
    from ..study.tasks import run_benchmark, write_benchmark

    overwrite = options.pop("overwrite")
    if out is not None:
        require_free_run_folder(out, overwrite)
    chosen = study_in(study).changed(**options)
    if chosen.agents or chosen.clairvoyant:
        what = "agents to train" if chosen.agents else "signals to design"
        raise ValueError(f"{study} has {what}: excite study run {study} --out FOLDER")
    with progress_bar(chosen.name) as progress:
        rows = run_benchmark(chosen, progress)
    settings = chosen.model_dump()
    if plot is not None:
        save(benchmark_figure(rows, chosen.title or chosen.name), plot)
    if out is not None:
        shown = comparison_files(rows, settings)
        shown["episodes.json"] = episodes_file(chosen, example_episodes(chosen))
        write_benchmark(chosen, rows, shown, out, overwrite, command_line())
    if as_json:
        show_json({"rows": rows})
    else:
        show_comparison(rows, settings, out)


def study_in(name: str) -> Any:
    """A shipped study or one in a file, its warnings on stderr; shared with `study`."""
    from ..study.catalogue import study_path
    from ..study.spec import read_study

    return warned(read_study(study_path(name)))


def warned(study: Any) -> Any:
    """The study, after its warnings on stderr; shared with `evaluate`."""
    for warning in study.warnings():
        click.echo(f"warning: {warning}", err=True)
    return study


def comparison_files(rows: Any, settings: Any) -> dict[str, bytes]:
    """Table and figure of a study's rows, by file name; shared with `study`."""
    from ..report.figure import image
    from ..report.figures import benchmark_figure
    from ..report.tables import benchmark_csv, benchmark_markdown

    figure = benchmark_figure(rows, settings["title"] or settings["name"])
    return {
        "table.md": benchmark_markdown(rows, settings).encode(),
        "table.csv": benchmark_csv(rows).encode(),
        "errors.png": image(figure, "png"),
    }


def episodes_file(study: Any, episodes: Any) -> bytes:
    """Example episodes of a study as the content of a file; shared with `study`."""
    from ..files import json_ready
    from ..study.episodes import episodes_data

    data = episodes_data(study.build_plant().description, episodes)
    return json.dumps(json_ready(data), ensure_ascii=False).encode()


def show_comparison(rows: Any, settings: Any, out: Path | None) -> None:
    """A study's table and footnotes on stdout; shared with `study`."""
    from ..report.tables import all_cells, footnotes, table_header

    title = settings["title"] or settings["name"]
    show_table(title, table_header(rows), all_cells(rows, settings["reference"]), labels=2)
    for note in footnotes(settings):
        click.echo(note)
    if out is not None:
        click.echo(f"run folder: {out}")
