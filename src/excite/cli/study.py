"""`excite study`: compares methods, trains agents, prints the table."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .options import (
    OUT_FILE,
    SEED,
    RunFailedError,
    WholeNumber,
    command_line,
    computing,
    json_option,
    plot_option,
    progress_bar,
    screen_width,
    show_json,
    show_table,
    warnings_shown,
)

if TYPE_CHECKING:
    from ..report.study_table import StudyTable
    from ..study.spec import Study


@click.group()
def study() -> None:
    """Compare methods, train agents, resume, print the table."""


def changes(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that change a study; shared with `benchmark`."""
    for option in (
        click.option("--overwrite", is_flag=True, help="Replace the run folder if it exists."),
        click.option("--estimators", metavar="NAME,...", help="Instead of the study's."),
        click.option("--seed", type=SEED, help="Instead of the study's."),
        click.option("--episodes", type=WholeNumber(1), help="Instead of the study's."),
    ):
        command = option(command)
    return command


@study.command(short_help="Compare the methods of a study; train its agents first.")
@click.argument("study", metavar="STUDY")
@click.option("--out", type=OUT_FILE, metavar="FOLDER", help="Run folder; needed with agents.")
@changes
@click.option(
    "--engine",
    type=click.Choice(["local", "dask"]),
    default="local",
    show_default=True,
    help="Processes of this machine, or a Dask cluster.",
)
@click.option("--address", metavar="tcp://HOST:PORT", help="Scheduler of the Dask cluster.")
@click.option(
    "--workers",
    type=WholeNumber(1),
    help="Processes of the local engine, for agents and designed signals; default one a core.",
)
@plot_option
@json_option
@computing
def run(study: str, out: Path | None, plot: Path | None, as_json: bool, **options: Any) -> None:
    """Compare the methods of STUDY under identical conditions; train its agents first.

    STUDY is the name of a shipped study (`excite study list`) or a file, path/to/study.toml.
    Without agents it needs no run folder. Rerun the same command to resume where it was
    interrupted.
    """
    run_study_here(study_in(study), out, as_json, plot, **options)


def run_study_here(
    chosen: Study, out: Path | None, as_json: bool, plot: Path | None = None, **options: Any
) -> None:
    """Runs a study and shows its table; shared with `benchmark`."""
    from ..study.run import run_study

    def waiting() -> None:
        text = f"waiting for workers of the scheduler at {options['address']}"
        click.echo(text, err=True)

    has_tasks = bool(chosen.agents or chosen.clairvoyant)
    is_resumed = not options["overwrite"] or options.get("engine") == "dask"
    with running(chosen.name, out if has_tasks or is_resumed else None) as told:
        if not has_tasks:  # the table shows that the methods are done
            del told["on_done"]
        found = run_study(chosen, out, on_wait=waiting, **told, **options)
    if plot is not None:
        from ..record.figure import save

        save(found.plot(), plot)
    show_comparison(found, out, as_json)


@contextlib.contextmanager
def running(name: str, keeps: Path | None) -> Iterator[dict[str, Any]]:
    """Messages of a running study, as arguments of a verb; shared with `train`.

    Args:
        keeps: folder that keeps finished tasks after an interruption, if it exists by then.
    """
    from ..study.run import StudyFailedError

    def finished(task: str) -> None:
        click.echo(f"finished: {task}", err=True)

    try:
        with warnings_shown(), progress_bar(name) as progress:
            yield {"progress": progress, "on_done": finished, "command": command_line()}
    except StudyFailedError as error:
        raise RunFailedError(str(error)) from None
    except KeyboardInterrupt:
        if keeps is None or not keeps.exists():
            raise
        kept = f"what is finished is kept in {keeps}; rerun the same command to resume"
        click.echo(f"excite: interrupted; {kept}", err=True)
        sys.exit(130)


def study_in(name: str) -> Study:
    """A shipped study or one in a file, its warnings on stderr; shared with `benchmark`."""
    from ..study.catalogue import study_path
    from ..study.spec import read_study

    return warned(read_study(study_path(name)))


def warned(study: Study) -> Study:
    """The study, after its warnings on stderr; shared with `evaluate`."""
    for warning in study.warnings():
        click.echo(f"warning: {warning}", err=True)
    return study


def show_comparison(found: StudyTable, out: Path | None = None, as_json: bool = False) -> None:
    """A study's table and footnotes on stdout, or its numbers; shared with `evaluate`."""
    if as_json:
        show_json(found.data())
        return
    click.echo(found.text(screen_width()))
    if out is not None:
        click.echo(f"run folder: {out}")


@study.command("list")
@json_option
def list_studies(as_json: bool) -> None:
    """List the studies that come with the package."""
    from ..study.catalogue import shipped_studies, studies

    files = shipped_studies()
    found = [
        {"name": name, "title": title, "file": str(files[name])}
        for name, title in studies().items()
    ]
    if as_json:
        show_json({"studies": found})
    else:
        rows = [[study["name"], study["title"]] for study in found]
        show_table("shipped studies: excite study run NAME --out FOLDER", ["name", "title"], rows)


@study.command()
@click.argument("folder", type=OUT_FILE, metavar="FOLDER")
@click.option("--estimator", metavar="NAME", help="Only the rows of this estimator.")
@click.option("--sort", metavar="COLUMN", help="A parameter, or a column of table.csv.")
@json_option
@computing
def table(folder: Path, estimator: str | None, sort: str | None, as_json: bool) -> None:
    """Print the table of a finished study."""
    from ..study.table import finished_table

    found = finished_table(folder)
    if estimator is not None:
        found = found.only(estimator)
    if sort is not None:
        found = found.sorted_by(sort)
    show_comparison(found, folder, as_json)
