"""The pool of worker processes behind the page, in the page's event loop."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncGenerator, Mapping
from pathlib import Path
from typing import Literal, cast

from ..study.pool import Pool
from ..study.worker import Ending, Event, Failure, Message, Started
from .events import JobEvent
from .requests import RefusedError, without_folders

MAX_WAITING = 64
"""Largest number of calls in the queue."""
_MEMORY = 2 * 2**30, 6 * 2**30  # smallest and largest memory limit of a worker [bytes]
_TIME_LIMIT = 900.0  # seconds a single call may take
_NICENESS = 5  # the server has priority, so that streams are not delayed

JOBS = "excite.web.jobs"
"""The module of the workers' functions, by name, because this process must not load JAX."""
Call = Literal["catalogue", "episode", "followed", "columns", "identified", "reported"]


class Workers:
    """Processes that run the functions of `excite.web.jobs`."""

    def __init__(self, num_workers: int, cache: Path | None) -> None:
        self._pool = Pool(
            num_workers,
            memory=_memory(num_workers),
            niceness=_NICENESS,
            time_limit=_TIME_LIMIT,
            warm_up=f"{JOBS}:warm_up",
            cache=cache,
        )
        self._is_closed = False

    async def open(self) -> None:
        """Starts the processes; they warm up while the page is served."""
        self._pool.open()

    async def close(self) -> None:
        """Ends all workers; waiting and later calls fail."""
        self._is_closed = True
        await asyncio.to_thread(self._pool.close, "the server has ended")

    async def events(
        self, job: Call, arguments: Mapping[str, object], urgent: bool = False
    ) -> AsyncGenerator[JobEvent]:
        """Events of one call, from `started` to `end` or `failed`; closing it ends the work.

        Args:
            urgent: before all calls that are not, because a user is waiting.
        """
        if self._is_closed:
            raise RefusedError(503, "the server has ended")
        if self._pool.num_waiting >= MAX_WAITING:
            raise RefusedError(503, "the queue of the workers is full; try again later")
        loop, said = asyncio.get_running_loop(), asyncio.Queue[Message]()

        def tell(message: Message) -> None:
            with contextlib.suppress(RuntimeError):  # of a loop that has ended
                loop.call_soon_threadsafe(said.put_nowait, message)

        call = self._pool.submit(f"{JOBS}:{job}", arguments, tell, urgent)
        try:
            is_over = False
            while not is_over:
                message = await said.get()
                is_over = isinstance(message, Ending)
                yield _event(message)
        finally:
            self._pool.withdraw(call)


def _event(message: Message) -> JobEvent:
    """A message as an event for the page."""
    if isinstance(message, Started):
        return {"kind": "started"}
    if isinstance(message, Event):
        return cast(JobEvent, message.value)
    if isinstance(message, Failure):
        return {"kind": "failed", "sentence": without_folders(message.sentence)}
    return {"kind": "end"}


def _memory(num_workers: int) -> int:
    """Memory limit of a worker [bytes]: its share of half the memory, within limits."""
    if not hasattr(os, "sysconf"):  # Windows: no limit
        return 0
    half = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    least, most = _MEMORY
    return max(least, min(most, half // max(1, num_workers)))
