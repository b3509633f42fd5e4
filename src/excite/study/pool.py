"""Worker processes of this computer: one pool for studies and the bench page.

A worker runs one call at a time. A call is stopped by a message. If it does not stop within
half a second, its process is killed and replaced. Files are written completely or not at
all, so no partial file is left. A process that sends anything except an answer to its call
is also replaced. JAX is not loaded here.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

from .worker import READY, Ending, Failure, Message, Started, decoded, encoded, message_of

_LOG = logging.getLogger(__name__)
GRACE = 0.5
"""Time for a call to stop before its process is killed [s]."""
MAX_FAILURES = 3
"""Number of successive processes that end before they are ready, until a lane gives up."""
_LINE = 64 * 2**20  # bytes; a longer answer is a defect
_ONE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "JAX_ENABLE_X64")
_ONE_THREAD = "--xla_cpu_multi_thread_eigen=false"


def num_cores() -> int:
    """Number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def environment(cache: Path | None = None) -> dict[str, str]:
    """Variables of a worker: one thread (NPROC is XLA's), double precision.

    They are set before it starts, because OpenBLAS and JAX read them when they are imported.
    Other flags of XLA are kept.

    Args:
        cache: where compiled programs are kept.
    """
    told = os.environ.get("XLA_FLAGS", "").split()
    others = [flag for flag in told if not flag.startswith(_ONE_THREAD.partition("=")[0])]
    flags = " ".join([_ONE_THREAD, *others])  # XLA takes a first word without -- for a file
    variables = {**dict.fromkeys(_ONE, "1"), "TF_CPP_MIN_LOG_LEVEL": "3", "XLA_FLAGS": flags}
    if cache is not None:
        variables["JAX_COMPILATION_CACHE_DIR"] = str(cache)
        variables["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
        variables["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "0"
    return variables


class Call:
    """A call that is waiting or running."""

    def __init__(
        self, number: int, line: str, tell: Callable[[Message], None], is_urgent: bool
    ) -> None:
        self.number, self.line, self.is_urgent = number, line, is_urgent
        self.process: _Process | None = None
        self._tell, self._is_over, self._lock = tell, False, threading.Lock()

    @property
    def is_over(self) -> bool:
        """Whether its last message was passed on."""
        return self._is_over

    def say(self, message: Message) -> None:
        """Passes a message on, unless the call is over."""
        with self._lock:
            if self._is_over:
                return
            self._is_over = isinstance(message, Ending)
        self._tell(message)

    def forget(self) -> None:
        """Stops passing messages on."""
        with self._lock:
            self._is_over = True


# ------------------------------------------------------------------------------------ the pool


class Pool:
    """Processes that answer calls, and their queue.

    Args:
        memory: limit of the data of a process [bytes]; 0 for no limit.
        niceness: added to the niceness of the processes.
        time_limit: of a call [s].
        warm_up: a function that every process runs first, unless a call is waiting.
        cache: where they keep compiled programs.
    """

    def __init__(
        self,
        num_workers: int,
        *,
        memory: int = 0,
        niceness: int = 0,
        time_limit: float | None = None,
        warm_up: str = "",
        cache: Path | None = None,
    ) -> None:
        self.num_workers = num_workers
        self._limits, self._cache = (str(memory), str(niceness)), cache
        self._time_limit, self._warm_up = time_limit, warm_up
        self._numbers, self._num_broken = itertools.count(), 0
        self._waiting, self._running = list[Call](), set[Call]()
        self._processes, self._lanes = set[_Process](), list[threading.Thread]()
        self._changed, self._is_closed = threading.Condition(), False

    @property
    def num_waiting(self) -> int:
        """Number of calls in the queue."""
        return len(self._waiting)

    def open(self) -> None:
        """Starts the processes."""
        self._lanes = [
            threading.Thread(target=self._lane, daemon=True) for _ in range(self.num_workers)
        ]
        for lane in self._lanes:
            lane.start()

    def close(self, sentence: str = "the workers were ended") -> None:
        """Ends the processes at once; every open call fails with `sentence`."""
        with self._changed:
            self._is_closed = True
            calls = [*self._waiting, *self._running]
            for process in self._processes:
                process.kill()
            self._changed.notify_all()
        for call in calls:
            call.say(Failure(sentence))
        for lane in self._lanes:
            lane.join()

    def submit(
        self,
        target: str,
        arguments: Mapping[str, object],
        tell: Callable[[Message], None],
        is_urgent: bool = False,
    ) -> Call:
        """Queues a call; its messages are passed to `tell` in a thread of this pool.

        Args:
            target: "package.module:function".
            is_urgent: before all calls that are not, because a user is waiting.
        """
        with self._changed:
            number = next(self._numbers)
            line = encoded({"number": number, "target": target, "arguments": dict(arguments)})
            call = Call(number, line, tell, is_urgent)
            if not self._is_closed:
                self._waiting.append(call)
                self._changed.notify()
                return call
        call.say(Failure("the workers were ended"))
        return call

    def withdraw(self, call: Call) -> None:
        """Ends a call that is no longer needed, also in the queue."""
        with self._changed:
            if call.is_over:
                return
            call.forget()
            if call in self._waiting:
                self._waiting.remove(call)
        self._stop(call)

    def _expire(self, call: Call) -> None:
        call.say(Failure("this took too long and was stopped"))
        self._stop(call)

    def _stop(self, call: Call) -> None:
        with self._changed:
            if call.process is not None:
                call.process.send({"stop": call.number})
                _later(GRACE, self._kill, call)

    def _kill(self, call: Call) -> None:
        with self._changed:
            if call.process is not None:
                call.process.kill()

    def _next(self) -> Call | None:
        """Waits for the first call in the queue; None where the pool is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed)
            if self._is_closed:
                return None
            call = min(self._waiting, key=lambda call: (not call.is_urgent, call.number))
            self._waiting.remove(call)
            self._running.add(call)
            return call

    def _lane(self) -> None:
        """One worker and its successors; if none starts, the last lane fails all calls."""
        num_failures = 0
        while num_failures < MAX_FAILURES and not self._is_closed:
            num_failures = 0 if self._worked() else num_failures + 1
        with self._changed:
            self._num_broken += 1
        while self._num_broken == self.num_workers and (call := self._next()) is not None:
            call.say(Failure("the workers do not start; the terminal shows the reason"))
            self._running.discard(call)

    def _worked(self) -> bool:
        """Runs one process until it ends; whether it became ready."""
        process = self._started()
        if process is None:
            return False
        is_warm = not self._warm_up
        try:
            while True:
                if is_warm or self._waiting:  # a call is waiting
                    if (call := self._next()) is None:
                        return True
                    if not self._answered(process, call):
                        return True
                elif not self._answered(process, self._warming()):
                    return False
                else:
                    is_warm = True
        finally:
            with self._changed:
                self._processes.discard(process)
            process.end()

    def _warming(self) -> Call:
        line = encoded({"number": -1, "target": self._warm_up, "arguments": {}})
        return Call(-1, line, lambda message: None, False)

    def _started(self) -> _Process | None:
        """A process that is ready; None where none can be started."""
        try:
            process = _Process(self._limits, {**os.environ, **environment(self._cache)})
        except OSError as error:
            _LOG.error("no worker can be started: %s", error)
            return None
        with self._changed:
            self._processes.add(process)
            if self._is_closed:
                process.kill()
        is_ready = False
        try:
            line = process.line()
            is_ready = bool(line) and decoded(line) == READY
        except (ValueError, RecursionError) as error:
            _LOG.error("a worker does not start: %s", error)
        if is_ready:
            return process
        with self._changed:
            self._processes.discard(process)
        process.end()
        return None

    def _answered(self, process: _Process, call: Call) -> bool:
        """Passes on a call and its answers; whether the process can take another call."""
        with self._changed:
            if call.is_over:  # cancelled in the meantime
                self._running.discard(call)
                return True
            call.process = process
        call.say(Started())
        limit = None if self._time_limit is None else _later(self._time_limit, self._expire, call)
        try:
            process.send(call.line)
            while True:
                line = process.line()
                if not line:
                    sentence = "the worker ended unexpectedly; run it again"
                    call.say(Failure(sentence, num_deaths=1))
                    return False
                number, message = message_of(line)
                if number != call.number:
                    raise ValueError("it answered another call")
                call.say(message)
                if isinstance(message, Ending):
                    return True
        except Exception as error:  # the rest would be read as the next answer
            _LOG.error("a worker was replaced: %s", error)
            call.say(Failure("invalid worker response; worker restarted"))
            return False
        finally:
            if limit is not None:
                limit.cancel()
            with self._changed:
                call.process = None
                self._running.discard(call)


def _later(seconds: float, function: Callable[[Call], None], call: Call) -> threading.Timer:
    timer = threading.Timer(seconds, function, [call])
    timer.daemon = True
    timer.start()
    return timer


class _Process:
    """A worker process with its input and output."""

    def __init__(self, limits: tuple[str, str], variables: Mapping[str, str]) -> None:
        path = os.pathsep.join(folder for folder in sys.path if folder)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", f"{__package__}.worker", *limits],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**variables, "PYTHONPATH": path},
            start_new_session=True,  # Ctrl-C is for the parent; on Windows by the next line
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )
        self._lock = threading.Lock()

    def send(self, message: object) -> None:
        """Sends a line; if the process has ended, the next answer is empty."""
        line = message if isinstance(message, str) else encoded(message)
        with self._lock, contextlib.suppress(OSError, ValueError):
            if self._process.stdin is not None:
                self._process.stdin.write(f"{line}\n".encode())
                self._process.stdin.flush()

    def line(self) -> bytes:
        """The next line of output; empty where the process has ended.

        Raises:
            ValueError: for one that is too long.
        """
        line = b"" if self._process.stdout is None else self._process.stdout.readline(_LINE)
        if len(line) >= _LINE:
            raise ValueError("its answer is too long")
        return line if line.endswith(b"\n") else b""

    def kill(self) -> None:
        """Kills the process."""
        self._process.kill()

    def end(self) -> None:
        """Kills the process and waits for its end."""
        self.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):  # unsent input
                if pipe is not None:
                    pipe.close()
