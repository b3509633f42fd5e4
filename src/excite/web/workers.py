"""Warm processes that compute, and the queue before them.

A worker does one thing at a time. What is asked to stop is told so, and where it does not
listen within half a second, for it is deep in a computation, its process is killed and
another started; nothing half-written is left, for files appear whole or not at all.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import sys
from collections.abc import AsyncGenerator, Mapping
from pathlib import Path
from typing import Any

from .base import RefusedError

GRACE = 0.5
"""Seconds in which work stops by itself."""
MAX_WAITING = 64
"""Calls in the queue."""
_LINE = 64 * 2**20  # bytes; a longer event is a defect
_TIME_LIMIT = 900.0  # seconds a single call may take
_ONE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "JAX_ENABLE_X64")


class Workers:
    """Processes that answer calls of functions of `excite.live`."""

    def __init__(self, num_workers: int, cache: Path | None) -> None:
        self._num_workers, self._environment = num_workers, _environment(cache)
        self._queue: asyncio.PriorityQueue[tuple[int, int, _Job]] = asyncio.PriorityQueue()
        self._numbers, self._lanes = itertools.count(), list[asyncio.Task]()
        self._jobs = set[_Job]()

    async def open(self) -> None:
        """Starts the processes; they warm up while the page is served."""
        self._lanes = [asyncio.create_task(self._lane()) for _ in range(self._num_workers)]

    async def close(self) -> None:
        """Ends them all, and tells everybody who waits for one."""
        for job in self._jobs:
            job.events.put_nowait(_failure("the server has ended"))
        for lane in self._lanes:
            lane.cancel()
        await asyncio.gather(*self._lanes, return_exceptions=True)

    async def events(
        self, target: str, arguments: Mapping[str, Any], urgent: bool = False
    ) -> AsyncGenerator[dict[str, Any]]:
        """Events of one call, from `started` to `end` or `failed`; closing it ends the work.

        Args:
            urgent: before all that is not: somebody waits for the first sign of life.
        """
        if self._queue.qsize() >= MAX_WAITING:
            raise RefusedError(503, "too much is waiting for the workers; try again later")
        job = _Job(_call(target, arguments))
        self._queue.put_nowait((0 if urgent else 1, next(self._numbers), job))
        self._jobs.add(job)
        try:
            while True:
                event = await job.events.get()
                yield event
                if event["kind"] in ("end", "failed"):
                    return
        finally:
            self._jobs.discard(job)
            job.stop.set()

    async def _lane(self) -> None:
        """One worker, its successors, and what they do one after the other."""
        while True:
            process, is_warm = await self._started(), False
            try:
                while process.returncode is None:
                    if not is_warm and self._queue.empty():  # otherwise somebody waits already
                        await _served(process, _Job(_call("warm_up", {})))
                        is_warm = True
                        continue
                    _, _, job = await self._queue.get()
                    if not job.stop.is_set():
                        await _served(process, job)
            finally:
                await _ended(process)

    async def _started(self) -> asyncio.subprocess.Process:
        command = sys.executable, "-m", f"{__package__}.worker"
        pipe = asyncio.subprocess.PIPE
        process = await asyncio.create_subprocess_exec(
            *command, stdin=pipe, stdout=pipe, env=self._environment, limit=_LINE,
            start_new_session=True,  # Ctrl-C is the server's
            preexec_fn=_step_back,
        )  # fmt: skip
        try:
            await _next_event(process)  # it is ready
        except BaseException:
            await _ended(process)
            raise
        return process


def _call(target: str, arguments: Mapping[str, Any]) -> str:
    return json.dumps({"target": target, "arguments": dict(arguments)})


class _Job:
    """A call in the queue or under way, and its events."""

    def __init__(self, call: str) -> None:
        self.call, self.stop = call, asyncio.Event()
        self.events: asyncio.Queue[dict[str, Any]] = asyncio.Queue()


async def _served(process: asyncio.subprocess.Process, job: _Job) -> None:
    """Passes a call and its events on; kills the process where it will not stop."""
    job.events.put_nowait({"kind": "started"})
    stopped = asyncio.create_task(job.stop.wait())
    work = asyncio.create_task(_pass_on(process, job))
    try:
        await asyncio.wait({stopped, work}, timeout=_TIME_LIMIT, return_when="FIRST_COMPLETED")
        if not work.done():
            if not job.stop.is_set():
                job.events.put_nowait(_failure("this took too long and was stopped"))
            with contextlib.suppress(OSError):
                _send(process, '"stop"')
            await asyncio.wait({work}, timeout=GRACE)
        if not work.done():
            process.kill()
            await process.wait()
    finally:
        stopped.cancel()
        work.cancel()


async def _pass_on(process: asyncio.subprocess.Process, job: _Job) -> None:
    _send(process, job.call)
    event = {"kind": ""}
    while event["kind"] not in ("end", "failed"):
        event = await _next_event(process)
        job.events.put_nowait(event)


def _send(process: asyncio.subprocess.Process, line: str) -> None:
    if process.stdin is not None:
        process.stdin.write(f"{line}\n".encode())


async def _next_event(process: asyncio.subprocess.Process) -> dict[str, Any]:
    line = b"" if process.stdout is None else await process.stdout.readline()
    if line:
        return json.loads(line)
    await process.wait()
    return _failure("the worker ended unexpectedly; run it again")


async def _ended(process: asyncio.subprocess.Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.kill()
    await process.wait()


def _failure(sentence: str) -> dict[str, Any]:
    return {"kind": "failed", "sentence": sentence}


def _step_back() -> None:
    """The server comes first: a stream has to flow while others compute."""
    os.nice(5)


def _environment(cache: Path | None) -> dict[str, str]:
    """One thread a worker (NPROC is XLA's), double precision, compiled programs kept."""
    own = {**os.environ, **dict.fromkeys(_ONE, "1"), "TF_CPP_MIN_LOG_LEVEL": "3"}
    if cache is not None:
        own["JAX_COMPILATION_CACHE_DIR"] = str(cache)
        own["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
        own["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "0"
    return own
