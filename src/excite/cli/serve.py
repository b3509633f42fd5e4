"""`excite serve`: the bench page, for a browser on this computer."""

from __future__ import annotations

from pathlib import Path

import click
from click.core import ParameterSource

from .options import OUT_FILE, WholeNumber, cache_folder, json_option, show_json


@click.command()
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    metavar="ADDRESS",
    help="Address to listen on; other computers need the token.",
)
@click.option(
    "--port",
    type=WholeNumber(0, 65535),
    default=8000,
    show_default=True,
    help="Port to listen on; 0 takes a free one.",
)
@click.option(
    "--runs",
    type=OUT_FILE,
    default=Path("runs"),
    show_default=True,
    metavar="FOLDER",
    help="Run folder to show.",
)
@click.option(
    "--token",
    metavar="TEXT",
    help="Token that a browser must send; default none if --host is "
    "this computer alone, else a random one.",
)
@click.option(
    "--workers",
    type=WholeNumber(1, 64),
    help="Worker processes; default one per core, at most four.",
)
@click.option(
    "--plant",
    "plants",
    multiple=True,
    metavar="FILE",
    help="A plant of your own (path/to/file.py:ClassName), or the worst plant of 'excite falsify' "
    "(.json); repeat for several.",
)
@json_option
def serve(
    host: str,
    port: int,
    runs: Path,
    token: str | None,
    workers: int | None,
    plants: tuple[str, ...],
    as_json: bool,
) -> None:
    """Serve the bench page until interrupted: run an excitation and watch what it identifies.

    Other computers cannot reach it unless --host is set.
    """
    try:
        from ..web import PageSettings, address_of, listening_at
        from ..web import serve as serve_here
    except ImportError:
        raise ValueError("the bench page needs the extra: pip install 'excite[web]'") from None

    named = _by_name(plants)
    source = click.get_current_context().get_parameter_source("runs")
    if source is ParameterSource.DEFAULT and not runs.exists():
        runs.mkdir()  # no run yet
    settings = PageSettings.of(runs, host, token, workers, cache_folder(), named)
    with listening_at(host, port) as listening:
        address = address_of(settings, listening)
        told = {"address": address, "token": settings.token, "runs": str(runs)}
        code = serve_here(settings, listening, lambda: _tell(told, as_json))
    if code:  # a signal: nobody may be there to read
        click.get_current_context().exit(code)
    if not as_json:
        click.echo("stopped")


def _by_name(plants: tuple[str, ...]) -> dict[str, str]:
    """The plants by the name that the page shows: that of the class or of the file.

    Raises:
        ValueError: for a plant that cannot be made, or a name that cannot be used.
    """
    if not plants:
        return {}
    from ..plant.catalogue import PLANT_ENDING, PLANTS, plant_named
    from ..web.requests import WORD

    found: dict[str, str] = {}
    for given in plants:
        plant_named(given)
        is_json = given.endswith(PLANT_ENDING)
        file, colon, class_name = (given, "", "") if is_json else given.rpartition(":")
        name = class_name or Path(file).stem
        if name in PLANTS or name in found:
            raise ValueError(f"--plant {given}: the page has a plant {name!r} already")
        if not WORD.fullmatch(name):
            raise ValueError(
                f"--plant {given}: the page needs a name of letters, digits, _ and -: got {name!r}"
            )
        found[name] = f"{Path(file).absolute()}{colon}{class_name}"
    return found


def _tell(told: dict[str, str | None], as_json: bool) -> None:
    if as_json:
        show_json(told)
        return
    click.echo(f"bench page: {told['address']}")
    if told["token"]:
        click.echo(f"token: {told['token']}")
    click.echo(f"run folder: {told['runs']}; Ctrl-C ends it")
