"""`excite serve`: the bench page, for a browser on this computer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from .options import OUT_FILE, WholeNumber, cache_folder, json_option, show_json


@click.command()
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    metavar="ADDRESS",
    help="Where to listen; other computers get in by the token alone.",
)
@click.option(
    "--port",
    type=WholeNumber(0, 65535),
    default=8000,
    show_default=True,
    help="0 takes a free one.",
)
@click.option(
    "--runs",
    type=OUT_FILE,
    default=Path("runs"),
    show_default=True,
    metavar="FOLDER",
    help="The run folder that is shown.",
)
@click.option(
    "--token",
    metavar="TEXT",
    help="What a browser must show; default one drawn at "
    "random where --host is not this computer alone, none where it is.",
)
@click.option(
    "--workers",
    type=WholeNumber(1, 64),
    help="Processes that compute; default one a core, at most four.",
)
@json_option
def serve(
    host: str, port: int, runs: Path, token: str | None, workers: int | None, as_json: bool
) -> None:  # fmt: skip
    """Serve the bench page until interrupted: run an excitation and watch what it identifies.

    Bound to this computer alone unless --host says otherwise.
    """
    import secrets
    from urllib.parse import quote

    try:
        from ..study.workers import num_cores
        from ..web import serve as serve_here
        from ..web.security import is_loopback
        from ..web.sessions import PageSettings
    except ImportError:
        raise ValueError("the bench page needs the extra: pip install 'excite[web]'") from None

    if token is not None and len(token) < 8:
        raise ValueError("a token needs eight characters or more")
    source = click.get_current_context().get_parameter_source("runs")
    if source is ParameterSource.DEFAULT and not runs.exists():
        runs.mkdir()  # nobody has left a run here yet
    if not runs.is_dir():
        raise ValueError(f"{runs}: no such folder; --runs names the run folder to be shown")
    if token is None and not is_loopback(host):
        token = secrets.token_urlsafe(16)
    listening = _bound(host, port)
    with listening:
        port = listening.getsockname()[1]
        address = f"http://{_name(host)}:{port}/" + (f"#{quote(token, safe='')}" if token else "")
        told = {"address": address, "token": token, "runs": str(runs)}
        num_workers = workers or min(4, num_cores())
        settings = PageSettings(runs.absolute(), host, token, num_workers, cache_folder())
        code = serve_here(settings, listening, lambda: _tell(told, as_json))
    if code:  # a signal: nobody may be there to read
        click.get_current_context().exit(code)
    if not as_json:
        click.echo("stopped")


def _bound(host: str, port: int) -> Any:
    """A socket that listens; one sentence where there can be none."""
    import socket

    try:
        [family, kind, _, _, address] = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (socket.gaierror, UnicodeError):
        raise ValueError(f"{host!r} is no address of this computer") from None
    listening = socket.socket(family, kind)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(address)
        listening.listen(128)
    except OSError as error:
        listening.close()
        raise ValueError(
            f"cannot listen at {host}, port {port} ({error.strerror}); is another page open, or "
            "the address another computer's? (--port 0 takes a free port)"
        ) from None
    return listening


def _name(host: str) -> str:
    """What others type: where all addresses are bound, the computer's own name."""
    import socket

    if host in ("0.0.0.0", "::"):
        return socket.gethostname().lower()
    return f"[{host}]" if ":" in host else host


def _tell(told: dict[str, Any], as_json: bool) -> None:
    if as_json:
        show_json(told)
        return
    click.echo(f"bench page: {told['address']}")
    if told["token"]:
        click.echo(f"token: {told['token']}")
    click.echo(f"run folder: {told['runs']}; Ctrl-C ends it")
