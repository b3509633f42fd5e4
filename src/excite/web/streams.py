"""Experiments and identifications as streams of events, one JSON object a line.

A simulated experiment is computed faster than real time and then played: samples are sent at
an even pace, and an estimate not before the sample at which it was made.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping
from contextlib import aclosing

from starlette.requests import Request
from starlette.responses import JSONResponse, StreamingResponse
from starlette.routing import Route

from ..files import is_class_word
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
    texts,
    whole,
    word,
    words,
)
from .sessions import Session
from .workers import Workers

FRAME = 0.04
"""Seconds between two parts of a stream."""
_PULSE = 1.0  # seconds without an event, then a pulse is sent

Events = AsyncGenerator[StreamEvent]


def routes(workers: Workers, plants: Mapping[str, str], body: Body) -> list[Route]:
    """Routes that start and stop an experiment or an identification.

    Args:
        plants: files of plants, by the name that a browser sends.
        body: reads a request's JSON.
    """

    async def experiment(request: Request) -> StreamingResponse:
        session, asked = request.state.session, await body(request)
        seconds, asked = number(asked, "seconds", 0, 60), _experiment(asked, plants)
        return _streamed(session, lambda stop: _played(workers, session, asked, seconds, stop))

    async def identification(request: Request) -> StreamingResponse:
        session, asked = request.state.session, await body(request)
        upload = str(asked.get("upload"))
        with session.using(upload):  # or there is none
            asked = _identification(asked, plants)
        return _streamed(session, lambda stop: _identified(workers, session, asked, upload, stop))

    async def stop(request: Request) -> JSONResponse:
        stops: dict[str, asyncio.Event | None] = request.state.session.stops
        asked = stops.get(request.path_params["job"])
        if asked is None:
            raise RefusedError(404, "this browser has no such job")
        asked.set()
        return JSONResponse({"stopped": True})

    return [
        Route("/api/experiments", experiment, methods=["POST"]),
        Route("/api/identifications", identification, methods=["POST"]),
        Route("/api/jobs/{job}", stop, methods=["DELETE"]),
    ]


def _experiment(asked: Asked, plants: Mapping[str, str]) -> ExperimentRequest:
    """An experiment for `excite.web.jobs`: only checked names and numbers."""
    return {
        "plant": plant_of(asked, plants),
        "excitation": word(asked, "excitation"),
        "amplitude": None if asked.get("amplitude") is None else number(asked, "amplitude", 0, 1e9),
        "noise": numbers(asked, "noise"),
        "params": numbers(asked, "params"),
        "steps": whole(asked, "steps", 50, MAX_STEPS),
        "seed": whole(asked, "seed", 0, 2**53),
        "others": words(asked, "others", 2),
    }


def _identification(asked: Asked, plants: Mapping[str, str]) -> IdentificationRequest:
    """An identification, likewise."""
    return {
        "plant": plant_of(asked, plants),
        "estimator": _estimator(word(asked, "estimator")),
        "initial_state": word(asked, "initial_state"),
        "columns": texts(asked, "columns"),
        "scales": numbers(asked, "scales"),
        "units": texts(asked, "units"),
        "intervals": word({"intervals": "linear", **asked}, "intervals"),
        "hold_input": word({"hold_input": "constant", **asked}, "hold_input"),
        "effects": words(asked, "effects", 32),
        "hold": numbers(asked, "hold"),
        "priors": texts(asked, "priors"),
    }


def _estimator(name: str) -> str:
    """A shipped one: a request runs no file's code."""
    if is_class_word(name):
        raise RefusedError(400, f"estimator: {name!r} is not one that can be chosen here")
    return name


def _streamed(session: Session, events: Callable[[asyncio.Event], Events]) -> StreamingResponse:
    """A response that continues until the events end, or the browser stops or leaves."""
    stop = asyncio.Event()
    job = session.begin(stop)

    async def lines() -> AsyncIterator[str]:
        try:
            yield _line({"kind": "job", "job": job})
            async with aclosing(events(stop)) as told:
                async for event in told:
                    yield _line(event)
        except RefusedError as refused:
            yield _line({"kind": "failed", "sentence": refused.sentence})
        finally:
            session.end(job)

    return StreamingResponse(lines(), media_type="application/x-ndjson")


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
    stop: asyncio.Event,
) -> Events:
    with session.using(upload) as source, session.making("result") as (name, place):
        arguments = {
            "asked": asked,
            "source": str(source),
            "name": next(iter(source.iterdir())).name,
            "folder": str(place.folder / "run"),
        }
        async with aclosing(_lively(workers.events("identified", arguments), stop)) as events:
            async for event in events:
                if event["kind"] == "identified":
                    place.is_done, event["result"] = True, name
                yield event


async def _played(
    workers: Workers,
    session: Session,
    asked: ExperimentRequest,
    seconds: float,
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
    with session.making("result") as (name, place):
        arguments = {"asked": asked, "folder": str(place.folder / "run")}
        async with aclosing(_followed(workers, arguments, player, stop)) as events:
            async for event in events:
                if event["kind"] == "result":
                    place.is_done, event["result"] = event["identification"] is not None, name
                yield event


async def _followed(
    workers: Workers, arguments: Mapping[str, object], player: _Player, stop: asyncio.Event
) -> Events:
    """Frames of samples, and the results."""
    waiting = asyncio.Queue[JobEvent]()

    async def follow() -> None:
        async with aclosing(workers.events("followed", arguments)) as events:
            async for event in events:
                if event["kind"] != "started":
                    waiting.put_nowait(event)

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
