"""Runs the tasks of a study in processes of this computer, or on a Dask cluster.

A task is a function of a module with plain data; its result is plain data too. A failed task
is tried again, unless the failure is the user's mistake.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from functools import partial
from pathlib import Path
from typing import Protocol

from .pool import Pool
from .worker import Ending, Failure, Message

TICK = 1.0
"""Seconds between two calls of `on_tick`."""


class Executor(Protocol):
    """An executor of tasks."""

    def num_slots(self) -> int:
        """Number of tasks that it takes at a time."""
        ...

    def is_lost(self) -> bool:
        """Whether it has lost its tasks, so that another must be opened."""
        ...

    def submit(self, target: str, arguments: Mapping[str, object]) -> Future[Ending]:
        """Submits a call; the future is cancelled where the executor is lost."""
        ...

    def close(self, is_done: bool) -> None:
        """Ends it, and unless `is_done` its unfinished tasks."""
        ...


Engine = Callable[[int], Executor]
"""Opens an executor for this number of tasks."""


def local_engine(num_workers: int, cache: Path | None = None) -> Engine:
    """Worker processes on this computer.

    Args:
        cache: where they keep compiled programs.

    Raises:
        ValueError: for less than one.
    """
    if num_workers < 1:
        raise ValueError(f"num_workers must be at least 1: got {num_workers}")
    return partial(_Local, num_workers, cache)


class _Local:
    """The pool of this computer; a worker that dies affects only its task."""

    def __init__(self, num_workers: int, cache: Path | None, num_tasks: int) -> None:
        self._pool = Pool(min(num_workers, num_tasks), cache=cache)
        self._pool.open()

    def num_slots(self) -> int:
        return self._pool.num_workers

    def is_lost(self) -> bool:
        return False

    def submit(self, target: str, arguments: Mapping[str, object]) -> Future[Ending]:
        future: Future[Ending] = Future()

        def tell(message: Message) -> None:
            if isinstance(message, Ending):
                future.set_result(message)

        self._pool.submit(target, arguments, tell)
        return future

    def close(self, is_done: bool) -> None:
        del is_done  # its processes hold nothing that could be lost
        self._pool.close()


Stage = tuple[Callable[..., object], Mapping[str, Mapping[str, object]]]
"""A function of a module, which the workers import, and its tasks: keyword arguments by name."""


def run(
    stages: Iterable[Stage],
    engine: Engine,
    num_together: int,
    *,
    on_done: Callable[[str, object], object],
    on_tick: Callable[[], object] = lambda: None,
    num_tries: int = 3,
) -> dict[str, Exception]:
    """Calls a stage's function for each of its tasks, and passes each result to `on_done`.

    A stage is taken when those before it have ended. Its tasks run in the same workers, because a
    worker takes seconds to start. A task whose worker dies, or that raises, is tried again later,
    except for a ValueError, which is a mistake of the user. If this function ends by an exception,
    for example one of `on_done` or `on_tick`, none of its tasks continues on this computer.

    Args:
        stages: arguments are JSON-ready data or bytes; names are unique over all stages.
        engine: opened at the first task.
        num_together: largest number of tasks in a stage, for which the engine is opened.
        on_done: called with the name of a task and its result, in the order of completion.
        on_tick: called about once a second.
        num_tries: how often a task is tried in all.

    Returns:
        The error of each failed task by name; ValueError is a mistake of the user.

    Raises:
        ValueError: where the engine cannot be opened.
    """
    work = _Work(engine, num_together, num_tries)
    next_tick = time.monotonic() + TICK
    try:
        for function, tasks in stages:
            work.add(f"{function.__module__}:{function.__qualname__}", tasks)
            while work.queue or work.running:
                work.submit()
                for name, result in work.finished(max(0.0, next_tick - time.monotonic())):
                    on_done(name, result)
                if time.monotonic() >= next_tick:
                    on_tick()
                    next_tick = time.monotonic() + TICK
        work.close(is_done=True)
    except BaseException:
        work.close(is_done=False)
        raise
    return work.failures


class _Work:
    """The unfinished tasks, and the errors of failed ones."""

    def __init__(self, engine: Engine, num_together: int, num_tries: int) -> None:
        self.queue, self.running = deque[str](), dict[Future[Ending], str]()
        self.failures: dict[str, Exception] = {}
        self._calls: dict[str, tuple[str, Mapping[str, object]]] = {}
        self._engine, self._num_together, self._num_tries = engine, num_together, num_tries
        self._tries, self._deaths = Counter[str](), Counter[str]()
        self._executor: Executor | None = None

    def add(self, target: str, tasks: Mapping[str, Mapping[str, object]]) -> None:
        """More tasks, of this function."""
        self.queue.extend(tasks)
        self._calls |= {name: (target, arguments) for name, arguments in tasks.items()}

    def submit(self) -> None:
        """Submits tasks up to the capacity."""
        if self._executor is not None and self._executor.is_lost():
            self._lose()
        if not self.queue:
            return
        if self._executor is None:
            self._executor = self._engine(self._num_together)
        num_free = self._executor.num_slots() - len(self.running)
        for _ in range(min(num_free, len(self.queue))):
            name = self.queue.popleft()
            self.running[self._executor.submit(*self._calls[name])] = name

    def finished(self, seconds: float) -> Iterator[tuple[str, object]]:
        """Names and results of finished tasks, after the first one or the timeout."""
        done, _ = wait(self.running, seconds, FIRST_COMPLETED)
        lost = {future for future in done if future.cancelled()}
        for future in done - lost:
            name, outcome = self.running.pop(future), future.result()
            if isinstance(outcome, Failure):
                self._note(name, outcome)
            else:
                yield name, outcome.value
        if lost:  # nothing is cancelled while waiting, so the scheduler is lost
            self._lose()

    def close(self, is_done: bool) -> None:
        """Ends the executor; `submit` opens another."""
        if self._executor is not None:
            self._executor.close(is_done)
        self._executor = None

    def _lose(self) -> None:
        self.close(is_done=False)
        for name in self.running.values():
            self._note(name, Failure("", num_deaths=1))
        self.running.clear()

    def _note(self, name: str, failure: Failure) -> None:
        self._tries[name] += 1
        self._deaths[name] += failure.num_deaths
        if self._tries[name] < self._num_tries and not failure.is_mistake:
            self.queue.append(name)
        elif failure.num_deaths:
            times = "once" if self._deaths[name] == 1 else f"{self._deaths[name]} times"
            self.failures[name] = RuntimeError(f"its worker died {times}")
        else:
            kind = ValueError if failure.is_mistake else RuntimeError
            self.failures[name] = kind(failure.sentence)
