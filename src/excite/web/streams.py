"""Experiments and identifications as streams of events, one JSON object a line.

A simulated experiment is computed faster than real time and then played: samples are sent at
an even pace, and an estimate not before the sample at which it was made.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from contextlib import aclosing
from pathlib import Path

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, StreamingResponse
from starlette.routing import Route

from ..files import is_class_word, write_bytes
from .events import (
    Episode,
    ExperimentRequest,
    IdentificationRequest,
    JobEvent,
    Plan,
    Samples,
    StreamEvent,
)
from .requests import (
    MAX_STEPS,
    Asked,
    Body,
    RefusedError,
    number,
    numbers,
    plant_of,
    text,
    texts,
    whole,
    word,
    words,
)
from .sessions import GONE, UPLOADED, Job, Session, files_of_upload
from .workers import Workers

FRAME = 0.04
"""Seconds between two parts of a stream."""
_PULSE = 1.0  # seconds without an event, then a pulse is sent
_KEPT, _LINES = "events.ndjson", "application/x-ndjson"
_COMPLETE = ("result", "identified", "stopped")  # there is something to show again

Events = AsyncGenerator[StreamEvent]


def routes(workers: Workers, plants: Mapping[str, str], body: Body) -> list[Route]:
    """Routes that start and stop an experiment or an identification.

    Args:
        plants: files of plants, by the name that a browser sends.
        body: reads a request's JSON.
    """

    async def experiment(request: Request) -> StreamingResponse:
        wanted = await body(request)
        seconds, asked = number(wanted, "seconds", 0, 60), _experiment(wanted, plants)

        def events(folder: Path, stop: asyncio.Event) -> Events:
            return _played(workers, asked, seconds, folder, stop)

        return _streamed(request.state.session, wanted, events)

    async def identification(request: Request) -> StreamingResponse:
        session, wanted = request.state.session, await body(request)
        upload = str(wanted.get("upload"))
        with session.using(upload, "upload") as kept:  # or there is none
            asked = _identification(wanted, plants, files_of_upload(kept))

        def events(folder: Path, stop: asyncio.Event) -> Events:
            return _identified(workers, session, asked, upload, folder, stop)

        return _streamed(session, wanted, events)

    async def again(request: Request) -> StreamingResponse | FileResponse:
        """All events from the first, of a job that runs or has ended."""
        session, name = request.state.session, request.path_params["name"]
        job = session.jobs.get(name)
        if job is not None:
            return StreamingResponse(job.follow(), media_type=_LINES)
        with session.using(name, "result") as folder:
            if not (folder / _KEPT).is_file():
                raise RefusedError(404, GONE["result"])
            return FileResponse(folder / _KEPT, media_type=_LINES)

    async def stop(request: Request) -> JSONResponse:
        job = request.state.session.jobs.get(request.path_params["job"])
        if job is None:
            raise RefusedError(404, "this browser has no such job")
        job.stop.set()
        return JSONResponse({"stopped": True})

    return [
        Route("/api/experiments", experiment, methods=["POST"]),
        Route("/api/identifications", identification, methods=["POST"]),
        Route("/api/results/{name}/events", again),
        Route("/api/jobs/{job}", stop, methods=["DELETE"]),
    ]


def _experiment(asked: Asked, plants: Mapping[str, str]) -> ExperimentRequest:
    """An experiment for `excite.web.jobs`: only checked names and numbers."""
    amplitude = asked.get("amplitude")
    if amplitude == 0:
        raise RefusedError(400, "amplitude must be above 0: an input of 0 moves nothing")
    return {
        "plant": plant_of(asked, plants),
        "excitation": word(asked, "excitation"),
        "amplitude": None if amplitude is None else number(asked, "amplitude", 0, 1e9),
        "noise": numbers(asked, "noise"),
        "params": numbers(asked, "params"),
        "steps": whole(asked, "steps", 50, MAX_STEPS),
        "seed": whole(asked, "seed", 0, 2**53),
        "others": words(asked, "others", 2),
    }


def _identification(
    asked: Asked, plants: Mapping[str, str], files: Sequence[str]
) -> IdentificationRequest:
    """An identification, likewise; `files` are those of the upload."""
    return {
        "plant": plant_of(asked, plants),
        "effects": words(asked, "effects", 32),
        "others": [plants.get(name, name) for name in words(asked, "others", 8)],
        "fitted": _files({"fitted": files, **asked}, "fitted", files),
        "held_out": _files({"held_out": [], **asked}, "held_out", files),
        "estimator": _estimator(word(asked, "estimator")),
        "initial_state": word(asked, "initial_state"),
        "intervals": word({"intervals": "linear", **asked}, "intervals"),
        "likelihood": word({"likelihood": "normal", **asked}, "likelihood"),
        "hold_input": word({"hold_input": "constant", **asked}, "hold_input"),
        "columns": texts(asked, "columns"),
        "validate_columns": texts(asked, "validate_columns"),
        "scales": numbers(asked, "scales"),
        "units": texts(asked, "units"),
        "set_inputs": numbers(asked, "set_inputs"),
        "dt": None if asked.get("dt") is None else number(asked, "dt", 1e-9, 1e9),
        "rows": text({"rows": "", **asked}, "rows") or None,
        "start": numbers(asked, "start"),
        "hold": numbers(asked, "hold"),
        "priors": texts(asked, "priors"),
        "uncertain": texts(asked, "uncertain"),
    }


def _files(asked: Asked, key: str, files: Sequence[str]) -> list[str]:
    """Names of files of the upload."""
    value = asked[key]
    if not isinstance(value, list) or any(name not in files for name in value):
        raise RefusedError(400, f"{key}: names of files of the upload are needed")
    return [name for name in files if name in value]


def _estimator(name: str) -> str:
    """A shipped one: a request runs no file's code."""
    if is_class_word(name):
        raise RefusedError(400, f"estimator: {name!r} is not one that can be chosen here")
    return name


def _streamed(
    session: Session, wanted: Asked, events: Callable[[Path, asyncio.Event], Events]
) -> StreamingResponse:
    """The events of a new job, which a page follows; those of a completed one are kept.

    Args:
        wanted: what the browser asked for.
        events: of the job that writes its run folder there, until it is stopped.
    """
    job = Job()
    name = session.begin(job)

    async def work() -> None:
        job.tell(_line({"kind": "job", "job": name, "asked": wanted}))
        try:
            with session.making("result", name) as place:
                try:
                    async with aclosing(events(place.folder / "run", job.stop)) as told:
                        async for event in told:
                            if event["kind"] == "result" or event["kind"] == "identified":
                                event["result"] = name
                            job.tell(_line(event))
                            place.is_done |= event["kind"] in _COMPLETE
                except asyncio.CancelledError:
                    job.tell(_line({"kind": "stopped"}))
                    raise
                finally:
                    if place.is_done:
                        with contextlib.suppress(OSError):  # it cannot be shown again
                            write_bytes(place.folder / _KEPT, "".join(job.lines).encode())
        except RefusedError as refused:
            job.tell(_line({"kind": "failed", "sentence": refused.sentence}))
        finally:
            session.end(name)

    job.start(work())
    return StreamingResponse(job.follow(), media_type=_LINES)


def _line(event: StreamEvent) -> str:
    return json.dumps(event, ensure_ascii=False, allow_nan=False) + "\n"


async def _lively(events: AsyncGenerator[JobEvent], stop: asyncio.Event) -> Events:
    """The events, with a pulse during long pauses, and an end when the browser stops."""
    stopped = asyncio.ensure_future(stop.wait())
    following = None
    try:
        while True:
            following = following or asyncio.ensure_future(anext(events))
            await asyncio.wait({stopped, following}, timeout=_PULSE, return_when="FIRST_COMPLETED")
            if stopped.done():
                yield {"kind": "stopped"}
                return
            if following.done():
                event, following = following.result(), None
                yield event
                if event["kind"] in ("end", "failed"):
                    return
            else:
                yield {"kind": "pulse"}
    finally:
        stopped.cancel()
        if following is not None:
            following.cancel()
            await asyncio.gather(following, return_exceptions=True)
        await events.aclose()


async def _identified(
    workers: Workers,
    session: Session,
    asked: IdentificationRequest,
    upload: str,
    folder: Path,
    stop: asyncio.Event,
) -> Events:
    with session.using(upload, "upload") as kept:
        arguments = {"asked": asked, "source": str(kept / UPLOADED), "folder": str(folder)}
        async with aclosing(_lively(workers.events("identified", arguments), stop)) as events:
            async for event in events:
                yield event


async def _played(
    workers: Workers,
    asked: ExperimentRequest,
    seconds: float,
    folder: Path,
    stop: asyncio.Event,
) -> Events:
    """Samples at their pace with estimates between them, then the remaining events."""
    shown = None
    async with aclosing(_lively(workers.events("episode", {"asked": asked}, True), stop)) as events:
        async for event in events:
            if event["kind"] == "episode":
                shown = event
            elif event["kind"] != "end":
                yield event
    if shown is None:
        return
    player = _Player(shown, seconds)
    yield player.plan()
    arguments = {"asked": asked, "folder": str(folder)}
    async with aclosing(_followed(workers, arguments, player, stop)) as events:
        async for event in events:
            yield event


async def _followed(
    workers: Workers, arguments: Mapping[str, object], player: _Player, stop: asyncio.Event
) -> Events:
    """Frames of samples, and the results."""
    waiting = asyncio.Queue[JobEvent]()

    async def follow() -> None:
        try:
            async with aclosing(workers.events("followed", arguments)) as events:
                async for event in events:
                    if event["kind"] != "started":
                        waiting.put_nowait(event)
        except RefusedError as refused:
            waiting.put_nowait({"kind": "failed", "sentence": refused.sentence})

    following = asyncio.create_task(follow())
    try:
        async for event in _mixed(player, waiting, stop):
            yield event
    finally:
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)


async def _mixed(player: _Player, waiting: asyncio.Queue[JobEvent], stop: asyncio.Event) -> Events:
    """Frames of samples with the estimates up to then; afterwards all events."""
    early, silent = list[JobEvent](), 0.0
    while not stop.is_set():
        while not waiting.empty():
            early.append(waiting.get_nowait())
            if early[-1]["kind"] == "failed":  # no more events will come
                player.hurry()
        if (frame := player.frame()) is not None:
            yield frame
        while early and player.allows(early[0]):
            event = early.pop(0)
            yield event
            silent = 0.0
            if event["kind"] in ("end", "failed"):
                return
        silent += FRAME
        if player.is_over and silent > _PULSE:
            yield {"kind": "pulse"}
            silent = 0.0
        await asyncio.sleep(FRAME)
    yield {"kind": "stopped"}


class _Player:
    """State of the playback of an experiment."""

    def __init__(self, shown: Episode, seconds: float) -> None:
        self._shown, self._seconds, self._sent = shown, seconds, 0
        self._start = asyncio.get_running_loop().time()

    def plan(self) -> Plan:
        """The plan of the experiment, before the first sample."""
        shown = self._shown
        return {
            "kind": "plan",
            "plant": shown["plant"],
            "excitation": shown["excitation"],
            "warning": shown["warning"],
            "params": shown["params"],
            "num_samples": len(shown["time"]),
        }

    @property
    def is_over(self) -> bool:
        """Whether all samples were shown."""
        return self._sent == len(self._shown["time"])

    def allows(self, event: JobEvent) -> bool:
        """Whether an event may be shown: not before its sample, or the last one."""
        return self.is_over or (event["kind"] == "estimate" and event["k"] < self._sent)

    def hurry(self) -> None:
        """Shows the rest at once."""
        self._seconds = 0.0

    def frame(self) -> Samples | None:
        """Samples that are due."""
        total, elapsed = len(self._shown["time"]), asyncio.get_running_loop().time() - self._start
        part = 1.0 if self._seconds == 0 else min(1.0, elapsed / self._seconds)
        due = slice(self._sent, math.ceil(part * total))
        self._sent = max(self._sent, due.stop)
        if due.start >= due.stop:
            return None
        return {
            "kind": "samples",
            "time": self._shown["time"][due],
            "inputs": self._shown["inputs"][due],
            "outputs": self._shown["outputs"][due],
        }
