"""Uploads and results of a browser, which others cannot reach, and reports of runs."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from ..files import read_json, write_json
from ..record import READ_ENDINGS, WRONG_ENDING
from .events import JobEvent
from .requests import MAX_UPLOAD, RefusedError, parts
from .sessions import COLUMNS, MAX_FILES, MAX_STORED, UPLOADED, Session, files_of_upload
from .workers import Call, Workers

_MAX_NAME = 200  # bytes of a file's name
_DOWNLOADS = {
    "record.csv": "text/csv",
    "record.json": "application/json",
    "estimate.json": "application/json",
}


def routes(workers: Workers, run_of: Callable[[Request], Path]) -> list[Route]:
    """Routes that receive files and return results.

    Args:
        run_of: the run in the run folder that a request names.
    """

    async def upload(request: Request) -> FileResponse:
        """A new upload."""
        session: Session = request.state.session
        file = _file_name(request.query_params.get("name", ""))
        name = session.begin()
        try:
            with session.making("upload", name) as place:
                (place.folder / UPLOADED).mkdir()
                own = await take(request, place.folder, file)
                write_json(place.folder / COLUMNS, {"upload": name, "files": [own]})
                place.is_done = True
        finally:
            session.end(name)
        return FileResponse(place.folder / COLUMNS)

    async def another(request: Request) -> FileResponse:
        """One more file of an upload."""
        session: Session = request.state.session
        upload, file = request.path_params["name"], _file_name(request.query_params.get("name", ""))
        with session.using(upload, "upload") as folder:
            if (folder / UPLOADED / file).exists():
                raise RefusedError(409, f"{file} is there already; rename one of the two files")
            if len(files_of_upload(folder)) >= MAX_FILES:
                raise RefusedError(409, f"at most {MAX_FILES} files are identified together")
            job = session.begin()
            try:
                own = await take(request, folder, file)
            except BaseException:
                (folder / UPLOADED / file).unlink(missing_ok=True)
                raise
            finally:
                session.end(job)
            before = read_json(folder / COLUMNS)
            write_json(folder / COLUMNS, {**before, "files": [*before["files"], own]})
            return FileResponse(folder / COLUMNS)

    async def take(request: Request, folder: Path, file: str) -> dict[str, object]:
        """Receives a file of an upload, and says what its columns are."""
        source = folder / UPLOADED
        await _receive(request, source / file, request.state.session.folder.parent)
        wanted = {"folder": str(source), "name": file}
        told = await _last(workers, "columns", wanted, True)
        columns = told if told["kind"] == "columns" else {"columns": {}, "previews": {}}
        return {"file": file, "columns": columns["columns"], "previews": columns["previews"]}

    def uploaded(request: Request) -> FileResponse:
        with request.state.session.using(request.path_params["name"], "upload") as folder:
            return FileResponse(folder / COLUMNS)

    def file(request: Request) -> FileResponse:
        asked = request.path_params
        with request.state.session.using(asked["name"], "result") as folder:
            path = folder / "run" / asked["file"]
        if asked["file"] not in _DOWNLOADS or not path.is_file():
            raise RefusedError(404, "this result has no such file")
        return FileResponse(path, media_type=_DOWNLOADS[path.name], filename=path.name)

    async def report(request: Request) -> Response:
        session: Session = request.state.session
        with session.using(request.path_params["name"], "result") as folder:
            if not (folder / "run").is_dir():
                raise RefusedError(404, "there is no result to report yet")
            return await _reported(workers, session, folder / "run")

    async def run_report(request: Request) -> Response:
        run = run_of(request)
        if any(path.is_symlink() for path in run.rglob("*")):
            raise RefusedError(422, "this run contains links, which the page does not follow")
        return await _reported(workers, request.state.session, run)

    return [
        Route("/api/uploads", upload, methods=["POST"]),
        Route("/api/uploads/{name}", uploaded),
        Route("/api/uploads/{name}", another, methods=["POST"]),
        Route("/api/results/{name}/report.html", report),
        Route("/api/results/{name}/{file}", file),
        Route("/api/run/report.html", run_report),
    ]


async def _reported(workers: Workers, session: Session, run: Path) -> Response:
    """The report of a run, made in a temporary folder."""
    job = session.begin()
    try:
        with tempfile.TemporaryDirectory(dir=session.folder) as folder:
            out = Path(folder) / "report.html"
            wanted = {"folders": [str(run)], "out": str(out)}
            await _last(workers, "reported", wanted, False)
            content = out.read_bytes()
    finally:
        session.end(job)
    return Response(
        content,
        media_type="text/html",
        # For download only; shown in the browser it could not run or load anything.
        headers={
            "content-disposition": 'attachment; filename="report.html"',
            "content-security-policy": "sandbox; default-src 'none'",
        },
    )


def _file_name(name: str) -> str:
    """The name of an uploaded file, without folders and control characters."""
    ending = Path(name).suffix
    if ending.lower() not in READ_ENDINGS:
        raise RefusedError(415, f"{name!r} is none of them: {WRONG_ENDING}")
    plain = "".join(c if c.isprintable() and c not in "/\\" else "_" for c in name)
    return plain if len(plain.encode()) <= _MAX_NAME else f"file{ending}"


def _stored(scratch: Path) -> int:
    """Bytes stored for all browsers."""
    size = 0
    for file in scratch.rglob("*"):
        with contextlib.suppress(OSError):  # removed in the meantime
            size += file.stat().st_size
    return size


async def _receive(request: Request, path: Path, scratch: Path) -> None:
    """Writes the body of a request, up to the allowed length."""
    too_large = RefusedError(413, f"the file is larger than {MAX_UPLOAD >> 20} MiB")
    if int(request.headers.get("content-length") or 0) > MAX_UPLOAD:
        raise too_large
    if _stored(scratch) > MAX_STORED:
        raise RefusedError(507, "the server's storage is full; try again later")
    try:
        with path.open("wb") as file:
            async for part in parts(request):
                file.write(part)
                if file.tell() > MAX_UPLOAD:
                    raise too_large
    except OSError as error:
        raise RefusedError(507, f"the file cannot be stored ({error.strerror})") from None
    if not path.stat().st_size:
        raise RefusedError(400, f"{path.name} is empty; a table with names and samples is needed")


async def _last(
    workers: Workers, job: Call, arguments: Mapping[str, object], urgent: bool
) -> JobEvent:
    """The last event of a call before its end."""
    told: JobEvent = {"kind": "end"}
    async with contextlib.aclosing(workers.events(job, arguments, urgent)) as events:
        async for event in events:
            if event["kind"] == "failed":
                raise RefusedError(422, event["sentence"])
            told = told if event["kind"] == "end" else event
    return told
