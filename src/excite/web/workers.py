"""Warm processes that compute, and the queue before them.

A worker does one thing at a time. What is asked to stop is told so, and where it does not
listen within half a second, for it is deep in a computation, its process is killed and
another started; nothing half-written is left, for files appear whole or not at all. So is
one that says anything but an event of the call it was given.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
import os
import sys
from collections.abc import AsyncGenerator, Mapping
from pathlib import Path
from typing import Any

from .requests import RefusedError

_LOG = logging.getLogger(__name__)
GRACE = 0.5
"""Seconds in which work stops by itself."""
MAX_WAITING = 64
"""Calls in the queue."""
MAX_FAILURES = 3
"""Processes that end before they are ready, one after the other, until a lane gives up."""
_MEMORY = 2 * 2**30, 6 * 2**30  # bytes of a worker: it needs the first, and gets no more
_LINE = 64 * 2**20  # bytes; a longer event is a defect
_TIME_LIMIT = 900.0  # seconds a single call may take
_ONE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "JAX_ENABLE_X64")


class Workers:
    """Processes that answer calls of functions of `excite.web.jobs`."""

    def __init__(self, num_workers: int, cache: Path | None) -> None:
        self._num_workers, self._environment = num_workers, _environment(cache)
        self._waiting, self._come = list[_Job](), asyncio.Semaphore(0)
        self._numbers, self._lanes = itertools.count(), list[asyncio.Task]()
        self._jobs, self._num_broken, self._is_closed = set[_Job](), 0, False

    async def open(self) -> None:
        """Starts the processes; they warm up while the page is served."""
        self._lanes = [asyncio.create_task(self._lane()) for _ in range(self._num_workers)]

    async def close(self) -> None:
        """Ends them all, and tells everybody who waits for one, or comes too late."""
        self._is_closed = True
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
        if self._is_closed:
            raise RefusedError(503, "the server has ended")
        if len(self._waiting) >= MAX_WAITING:
            raise RefusedError(503, "too much is waiting for the workers; try again later")
        job = _Job(next(self._numbers), target, arguments, urgent)
        self._waiting.append(job)
        self._come.release()
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
            if job in self._waiting:  # it takes nobody's place any longer
                self._waiting.remove(job)

    async def _next(self) -> _Job:
        """The call that is first in the queue, once there is one; an urgent one before others."""
        while True:
            await self._come.acquire()
            if self._waiting:  # what was announced may have left again
                job = min(self._waiting, key=lambda job: (not job.urgent, job.number))
                self._waiting.remove(job)
                return job

    async def _lane(self) -> None:
        """One worker and its successors; where none starts, the last lane tells everybody."""
        num_failures = 0
        while num_failures < MAX_FAILURES:
            is_good = await self._worked()
            num_failures = 0 if is_good else num_failures + 1
        self._num_broken += 1
        while self._num_broken == self._num_workers:
            job = await self._next()
            job.events.put_nowait(_failure("the workers do not start; the terminal says why"))

    async def _worked(self) -> bool:
        """What one worker does until it ends; whether it came to work at all."""
        process, is_warm = await self._started(), False
        if process is None:
            return False
        try:
            while process.returncode is None:
                if not is_warm and not self._waiting:  # otherwise somebody waits already
                    await _served(process, _Job(next(self._numbers), "warm_up", {}))
                    is_warm = process.returncode is None
                    if not is_warm:
                        return False
                    continue
                await _served(process, await self._next())
        finally:
            await _ended(process)
        return True

    async def _started(self) -> asyncio.subprocess.Process | None:
        """A process that is ready; None where there can be none."""
        limit = str(_memory(self._num_workers))
        command = sys.executable, "-m", f"{__package__}.worker", limit
        pipe = asyncio.subprocess.PIPE
        try:
            process = await asyncio.create_subprocess_exec(
                *command, stdin=pipe, stdout=pipe, env=self._environment, limit=_LINE,
                start_new_session=True,  # Ctrl-C is the server's
            )  # fmt: skip
        except OSError as error:
            _LOG.error("no worker can be started: %s", error)
            return None
        is_ready = False
        try:
            is_ready = await _next_event(process) == {"kind": "ready"}
        except ValueError as error:
            _LOG.error("a worker does not start: %s", error)
        finally:
            if not is_ready:
                await _ended(process)
        return process if is_ready else None


class _Job:
    """A call in the queue or under way, and its events."""

    def __init__(
        self, number: int, target: str, arguments: Mapping[str, Any], urgent: bool = False
    ) -> None:
        self.number, self.urgent, self.stop = number, urgent, asyncio.Event()
        call = {"number": number, "target": target, "arguments": dict(arguments)}
        self.call = json.dumps(call)
        self.events: asyncio.Queue[dict[str, Any]] = asyncio.Queue()


async def _served(process: asyncio.subprocess.Process, job: _Job) -> None:
    """Passes a call and its events on; kills the process where it will not stop, or errs."""
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
        if not work.done() or not work.result():
            await _ended(process)
    finally:
        stopped.cancel()
        work.cancel()


async def _pass_on(process: asyncio.subprocess.Process, job: _Job) -> bool:
    """Passes events on until the last; whether the process can be given another call."""
    try:
        _send(process, job.call)
        event = {"kind": ""}
        while event["kind"] not in ("end", "failed"):
            event = await _next_event(process)
            if event is None:
                job.events.put_nowait(_failure("the worker ended unexpectedly; run it again"))
                return False
            if event.pop("number", None) != job.number:
                raise ValueError("it answered another call")
            job.events.put_nowait(event)
    except Exception as error:  # what follows in the pipe would be taken for the next answer
        _LOG.error("a worker was replaced: %s", error)
        job.events.put_nowait(_failure("the answer of the worker cannot be used; it was replaced"))
        return False
    return True


def _memory(num_workers: int) -> int:
    """Bytes a worker may take: its part of half of what this computer has, within limits."""
    half = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    least, most = _MEMORY
    return max(least, min(most, half // num_workers))


def _send(process: asyncio.subprocess.Process, line: str) -> None:
    if process.stdin is not None:
        process.stdin.write(f"{line}\n".encode())


async def _next_event(process: asyncio.subprocess.Process) -> dict[str, Any] | None:
    """The next event; None where the process has ended."""
    line = b"" if process.stdout is None else await process.stdout.readline()
    return json.loads(line) if line else None


async def _ended(process: asyncio.subprocess.Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.kill()
    await process.wait()


def _failure(sentence: str) -> dict[str, Any]:
    return {"kind": "failed", "sentence": sentence}


def _environment(cache: Path | None) -> dict[str, str]:
    """One thread a worker (NPROC is XLA's), double precision, compiled programs kept."""
    own = {**os.environ, **dict.fromkeys(_ONE, "1"), "TF_CPP_MIN_LOG_LEVEL": "3"}
    if cache is not None:
        own["JAX_COMPILATION_CACHE_DIR"] = str(cache)
        own["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
        own["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "0"
    return own
