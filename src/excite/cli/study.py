"""`excite study`: trains and compares the agents of a study file, and shows the table."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from .benchmark import comparison_files, episodes_file, show_comparison, study_in
from .options import (
    OUT_FILE,
    RunFailedError,
    WholeNumber,
    cache_folder,
    command_line,
    computing,
    json_option,
    progress_bar,
    show_json,
    show_table,
)


@click.group()
def study() -> None:
    """Train the agents of a study, resume it, print its table."""


@study.command()
@click.argument("study_name", metavar="STUDY")
@click.option("--out", type=OUT_FILE, required=True, metavar="FOLDER", help="Its run folder.")
@click.option(
    "--engine",
    type=click.Choice(["local", "dask"]),
    default="local",
    show_default=True,
    help="Processes of this machine, or a Dask cluster.",
)
@click.option("--address", metavar="tcp://HOST:PORT", help="Scheduler of the Dask cluster.")
@click.option(
    "--workers", type=WholeNumber(1), help="Processes of the local engine; default one a core."
)
@json_option
@computing
def run(
    study_name: str, out: Path, engine: str, address: str | None, workers: int | None,
    as_json: bool,
) -> None:  # fmt: skip
    """Train what STUDY lacks in its run folder, then write its table and figures.

    STUDY is the name of a shipped study (`excite study list`) or a file, path/to/study.toml.

    Interrupted at any moment, the same command goes on where it was.
    """
    chosen = study_in(study_name)
    run_study_here(chosen, out, as_json, engine, address, workers)


def run_study_here(
    chosen: Any,
    out: Path,
    as_json: bool,
    engine: str = "local",
    address: str | None = None,
    workers: int | None = None,
) -> None:
    """Runs a study, writes and shows its table; shared with `train`."""
    from ..study.run import run_study

    if engine == "local":
        _require_trainer(chosen, out)
    machine = _engine(engine, address, workers)

    def finished(name: str) -> None:
        click.echo(f"finished: {name}", err=True)

    try:
        with progress_bar(chosen.name) as progress:
            failures = run_study(chosen, out, machine, progress, finished, command_line())
        if failures:
            raise _failed(failures, out)
        _finish(chosen, out)
        _show(out, as_json)
    except KeyboardInterrupt:
        kept = f"what is finished is kept in {out}, the same command goes on"
        click.echo(f"excite: interrupted; {kept}", err=True)
        sys.exit(130)


def _failed(failures: dict[str, Exception], out: Path) -> Exception:
    """One error for all tasks that failed; the user's mistake where every one of them is."""
    names: dict[str, list[str]] = {}
    for name, error in failures.items():
        names.setdefault(str(error), []).append(name)
    reasons = "; ".join(f"{', '.join(some)}: {reason}" for reason, some in names.items())
    is_mistake = all(isinstance(error, ValueError) for error in failures.values())
    return (ValueError if is_mistake else RunFailedError)(
        f"{len(failures)} task{'s' * (len(failures) > 1)} failed ({reasons}); what is finished "
        f"is kept in {out}, the same command tries the rest again"
    )


@study.command("list")
@json_option
def list_studies(as_json: bool) -> None:
    """List the studies that come with the package."""
    import tomllib

    from ..study.catalogue import studies

    found = [
        {"name": name, "title": tomllib.loads(path.read_text("utf-8"))["title"], "file": str(path)}
        for name, path in studies().items()
    ]
    if as_json:
        show_json({"studies": found})
    else:
        rows = [[study["name"], study["title"]] for study in found]
        show_table("shipped studies: excite study run NAME --out FOLDER", ["name", "title"], rows)


@study.command()
@click.argument("folder", type=OUT_FILE, metavar="FOLDER")
@json_option
@computing
def table(folder: Path, as_json: bool) -> None:
    """Print the table of a finished study."""
    _show(folder, as_json)


def _require_trainer(chosen: Any, out: Path) -> None:
    """Raises ValueError where seeds are left to train and a library is missing."""
    from importlib.util import find_spec

    from ..study.folder import seed_folder

    agents = [name for name, agent in chosen.agents.items() if agent.method == "ppo"]
    folders = [seed_folder(out, a, seed) for a in agents for seed in range(chosen.seeds)]
    if all((folder / "metrics.json").is_file() for folder in folders):
        return
    missing = [n for n in ("stable_baselines3", "torch", "tensorboard") if find_spec(n) is None]
    if missing:
        raise ValueError(f"training needs {', '.join(missing)}: pip install 'excite[ppo]'")


def _engine(engine: str, address: str | None, workers: int | None) -> Any:
    from ..study.cluster import dask_engine
    from ..study.engine import local_engine
    from ..study.workers import num_cores

    if engine == "dask":
        if address is None:
            raise ValueError("--engine dask needs --address tcp://HOST:PORT of its scheduler")
        if workers is not None:
            raise ValueError("--workers is for the local engine; a Dask cluster has its own")
        waiting = f"waiting for workers of the scheduler at {address}"
        return dask_engine(address, lambda: click.echo(waiting, err=True))
    if address is not None:
        raise ValueError("--address is for --engine dask")
    return local_engine(workers or num_cores(), cache_folder())


def _finish(chosen: Any, folder: Path) -> None:
    """Writes the table and the figures into the run folder."""
    from ..files import write_bytes, write_json
    from ..report.figure import image
    from ..report.frontier import frontier_figure, lengths_figure
    from ..report.study_figures import agents_figure, curves_figure
    from ..report.tables import benchmark_latex, differences_csv, differences_markdown
    from ..study.episodes import example_episodes
    from ..study.table import best_seeds, learning_curves, study_table

    content, settings = study_table(folder), chosen.model_dump()
    rows, title = content["rows"], chosen.title or chosen.name
    shown = {
        **comparison_files(rows, settings),
        "table.tex": benchmark_latex(rows, settings).encode(),
        "differences.csv": differences_csv(content["differences"]).encode(),
    }
    shown["table.md"] += differences_markdown(content["differences"]).encode()
    if chosen.clairvoyant is not None:
        shown["frontier.png"] = image(frontier_figure(rows, title), "png")
    if chosen.lengths:
        shown["lengths.png"] = image(lengths_figure(rows, title), "png")
    seeds = best_seeds(chosen, folder)
    episodes = example_episodes(chosen, folder, seeds)
    shown["episodes.json"] = episodes_file(chosen, episodes)
    if chosen.agents:
        plant, bounds = chosen.build_plant().description, chosen.bound_curves()
        curves = curves_figure(plant, learning_curves(chosen, folder), title, bounds)
        played = agents_figure(plant, {agent: episodes[agent] for agent in seeds}, title)
        shown |= {"curves.png": image(curves, "png"), "episodes.png": image(played, "png")}
        content |= {"best_seeds": seeds, "bound_curves": bounds}
    for name, data in shown.items():
        write_bytes(folder / name, data)
    write_json(folder / "table.json", content)


def _show(folder: Path, as_json: bool) -> None:
    from ..study.folder import study_of
    from ..study.table import finished_table

    content, settings = finished_table(folder), study_of(folder).model_dump()
    if as_json:
        show_json(content)
    else:
        show_comparison(content["rows"], settings, folder)
