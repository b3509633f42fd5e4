"""The bench page: run experiments and identifications in a browser.

The server does not compute: it loads neither JAX nor a plant, so that the page opens fast.
Worker processes run `jobs` and send `events`. `requests` checks the content of a request,
`security` its origin and session, `sessions` stores the data of each browser. `streams`,
`places`, `runs`, `compared`, `deletions` and `trainings` answer.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import socket
import tempfile
from collections.abc import AsyncIterator, Callable, Generator
from functools import partial
from pathlib import Path
from urllib.parse import quote

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from .compared import routes as comparison_routes
from .connections import Connection
from .deletions import routes as deletion_routes
from .events import Catalogue
from .places import routes as place_routes
from .requests import MAX_BODY, RefusedError, parts
from .runs import routes as run_routes
from .runs import run_of
from .security import Guard
from .sessions import PageSettings, Sessions
from .streams import routes as stream_routes
from .trainings import Training
from .trainings import routes as training_routes
from .workers import Workers

__all__ = ["PageSettings", "address_of", "application", "listening_at", "serve"]

_STATIC = Path(__file__).with_name("static")


def application(
    settings: PageSettings, scratch: Path, ready: Callable[[], None] = lambda: None
) -> Starlette:
    """The application: the page and its requests.

    Args:
        scratch: an empty folder for uploads and results.
        ready: called when the server answers.
    """
    workers, trainings = Workers(settings.num_workers, settings.cache), list[Training]()
    known = list[Catalogue]()

    async def end_work() -> None:
        await asyncio.gather(workers.close(), *(training.stop() for training in trainings))

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        app.state.end_work = end_work
        await workers.open()
        ready()
        try:
            yield
        finally:
            await end_work()

    async def catalogue(request: Request) -> JSONResponse:
        del request
        if not known:
            arguments = {"plants": settings.plants}
            async with contextlib.aclosing(workers.events("catalogue", arguments, True)) as events:
                known.extend([event async for event in events if event["kind"] == "catalogue"])
        if not known:
            raise RefusedError(503, "the workers do not start; the terminal shows the reason")
        return JSONResponse(known[0])

    routes = [
        Route("/", lambda request: FileResponse(_STATIC / "index.html")),
        Route("/api/session", _session, methods=["POST"]),
        Route("/api/catalogue", catalogue),
        *stream_routes(workers, settings.plants, _body),
        *place_routes(workers, partial(run_of, settings.runs)),
        *run_routes(settings.runs),
        *comparison_routes(settings.runs),
        *deletion_routes(settings.runs, _body, trainings),
        *training_routes(settings.runs, settings.plants, _body, trainings),
        Mount("/static", StaticFiles(directory=_STATIC)),
    ]
    guard = Middleware(Guard, settings=settings, sessions=Sessions(scratch))
    return Starlette(
        routes=routes,
        middleware=[guard],
        exception_handlers={RefusedError: _refused},
        lifespan=lifespan,
    )


async def _session(request: Request) -> JSONResponse:
    """Opens a session if the browser sends the token, or if none is needed."""
    asked = await _body(request)
    if request.state.session is not None:  # the session is kept
        return JSONResponse({"is_known": True})
    cookie = request.state.enter(asked)
    headers = {} if cookie is None else {"set-cookie": cookie}
    return JSONResponse({"is_known": cookie is not None}, headers=headers)


async def _body(request: Request) -> dict[str, object]:
    """A request's JSON, an object of limited size."""
    content = bytearray()
    async for part in parts(request):
        content += part
        if len(content) > MAX_BODY:
            raise RefusedError(413, "the request is too large")
    try:
        asked = json.loads(bytes(content))
        # Refuses lone surrogates, and numbers that JSON does not have.
        json.dumps(asked, ensure_ascii=False, allow_nan=False).encode()
    except (ValueError, RecursionError):
        asked = None
    if not isinstance(asked, dict):
        raise RefusedError(400, "the request is not a JSON object")
    return asked


def _refused(request: Request, error: Exception) -> JSONResponse:
    del request
    if not isinstance(error, RefusedError):
        raise error
    return JSONResponse({"sentence": error.sentence}, error.status)


class _Server(uvicorn.Server):
    """A server that a signal ends; the workers end first, so that no request waits for them."""

    def __init__(self, app: Starlette, came: list[int]) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                http=Connection,
                log_level="error",
                server_header=False,
                proxy_headers=False,
                timeout_graceful_shutdown=1,
            )
        )
        self._app, self._came = app, came

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None]:
        """Leaves signals to `serve`, which cleans up."""
        yield

    async def on_tick(self, counter: int) -> bool:
        """Whether the server must end."""
        return await super().on_tick(counter) or bool(self._came)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Ends the workers, then the server."""
        await self._app.state.end_work()
        await super().shutdown(sockets)


@contextlib.contextmanager
def _signals() -> Generator[list[int]]:
    """Collects SIGINT, SIGTERM and SIGHUP, which then do not end the process."""
    came = list[int]()
    names = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has no SIGHUP
    kinds = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = {kind: signal.signal(kind, lambda number, _: came.append(number)) for kind in kinds}
    try:
        yield came
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


def listening_at(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes a free one.

    Raises:
        ValueError: where the address cannot be used.
    """
    try:
        [family, kind, _, _, address] = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (socket.gaierror, UnicodeError):
        raise ValueError(f"{host!r} is not an address of this computer") from None
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


def address_of(settings: PageSettings, listening: socket.socket) -> str:
    """The address to open: the computer's name where all its addresses are bound."""
    host = settings.host
    if host in ("0.0.0.0", "::"):
        host = socket.gethostname().lower()
    name = f"[{host}]" if ":" in host else host
    token = f"#{quote(settings.token, safe='')}" if settings.token else ""
    return f"http://{name}:{listening.getsockname()[1]}/{token}"


def serve(settings: PageSettings, listening: socket.socket, ready: Callable[[], None]) -> int:
    """Serves on a bound socket until a signal comes; calls `ready` at its start.

    Returns:
        The exit code: 0 after Ctrl-C, else that of the signal.
    """
    folder = partial(tempfile.TemporaryDirectory, ignore_cleanup_errors=True)
    with _signals() as came, folder(prefix="excite-bench-") as scratch:
        app = application(settings, Path(scratch), ready)
        _Server(app, came).run(sockets=[listening])
    first = (came or [signal.SIGINT])[0]
    return 0 if first == signal.SIGINT else 128 + first
