"""Where the work of a study is done: in processes started here, or on a Dask cluster.

Either way it goes through one `concurrent.futures.Executor`, so that nobody else asks
which. A task is a function, named by a word, and plain data; its result is plain data too.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import pickle
import signal
import threading
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from concurrent.futures import ProcessPoolExecutor as Pool
from functools import partial
from typing import Any
from urllib.parse import urlsplit

from .. import __version__

try:
    import distributed
except ImportError:
    distributed: Any = None

TICK = 1.0
"""Seconds between two calls of `on_tick`."""

CONNECT_TIMEOUT = 10.0
"""Seconds in which a scheduler has to answer."""

_ONE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "JAX_ENABLE_X64")
_ONE_THREAD = "--xla_cpu_multi_thread_eigen=false"

# ------------------------------------------------------------------------ in a worker


def call(target: str, version: str, arguments: Mapping[str, Any]) -> Any:
    """What a worker runs: the function `target`, "package.module:function", by keyword.

    Raises:
        ValueError: where the worker has another version of excite, or lacks a library.
        RuntimeError: in place of an error of the function that cannot travel.
    """
    if version != __version__:
        raise ValueError(
            f"the worker runs excite {__version__}, the study was started by {version}"
        )
    # The function comes as a word and is imported here: sent as itself, unpickling it would
    # import JAX before this line, and JAX reads its environment once.
    os.environ.update(_environment())
    module, _, name = target.partition(":")
    try:
        return getattr(importlib.import_module(module), name)(**arguments)
    except ModuleNotFoundError as error:
        lack = f"the worker has no module {error.name!r}; training needs the extra 'ppo'"
        told = ValueError(lack)
    except Exception as error:
        kind = ValueError if isinstance(error, ValueError) else RuntimeError
        told = error if _can_travel(error) else kind(_sentence(error))
    raise told  # out here, for Dask sends what an error was raised from along with it


def _environment() -> dict[str, str]:
    """One thread a worker (NPROC is XLA's), double precision; other flags of XLA stay."""
    told = os.environ.get("XLA_FLAGS", "").split()
    others = [flag for flag in told if not flag.startswith(_ONE_THREAD.partition("=")[0])]
    flags = " ".join([*others, _ONE_THREAD])
    return {**dict.fromkeys(_ONE, "1"), "TF_CPP_MIN_LOG_LEVEL": "3", "XLA_FLAGS": flags}


def _can_travel(error: Exception) -> bool:
    """Whether an error is pickled and back; one that is only pickled breaks the pool."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return False
    return True


def _sentence(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")


def _prepare_process() -> None:
    """Leaves Ctrl-C to the parent, and no orphan where the parent is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


# -------------------------------------------------------------------------- executors


class _Processes(Executor):
    """Workers of one process each: one that dies takes only its own task along."""

    def __init__(self, num_workers: int) -> None:
        self._others = set(multiprocessing.active_children())
        self._pools = [_pool() for _ in range(num_workers)]
        self._futures: list[Future | None] = [None] * num_workers

    def num_slots(self) -> int:
        """How many tasks it takes at a time."""
        return len(self._pools)

    def is_lost(self) -> bool:
        """Never: a pool that is broken is replaced."""
        return False

    def submit(self, fn: Callable, /, *args: Any, **kwargs: Any) -> Future:
        is_busy = [future is not None and not future.done() for future in self._futures]
        slot = is_busy.index(False) if False in is_busy else 0
        with _ready_to_spawn():
            try:
                future = self._pools[slot].submit(fn, *args, **kwargs)
            except BrokenExecutor:  # its process died with the task before
                self._pools[slot] = _pool()
                future = self._pools[slot].submit(fn, *args, **kwargs)
        self._futures[slot] = future
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        workers = set(multiprocessing.active_children()) - self._others
        for worker in workers if not wait else ():
            worker.kill()
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=cancel_futures or not wait)
        for worker in workers:
            worker.join()


def _pool() -> Pool:
    # A fork would copy the locks of JAX's threads, but not the threads that open them.
    return Pool(1, multiprocessing.get_context("spawn"), _prepare_process)


@contextlib.contextmanager
def _ready_to_spawn() -> Iterator[None]:
    """The environment of a worker, and no Ctrl-C, for a process that is started in here.

    It inherits both, for its first imports come before anything it is told to do: OpenBLAS
    counts its threads then, and an import that is interrupted shows a traceback.
    """
    changed = _environment()
    before = {name: os.environ[name] for name in changed if name in os.environ}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(changed)
    try:
        yield
    finally:
        for name in changed.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


class _Cluster(Executor):
    """A Dask client and its executor, closed together.

    What runs on a cluster cannot be stopped: a task that is cancelled comes to its end there.
    """

    def __init__(self, address: str, on_wait: Callable[[], Any]) -> None:
        with contextlib.ExitStack() as stack:
            # A lost scheduler is told by an error, not by lines all over our terminal.
            stack.enter_context(distributed.utils.silence_logging_cmgr("CRITICAL"))
            warnings.simplefilter("ignore", distributed.versions.VersionMismatchWarning)
            self._client = _connected(address)
            threads = self._client.nthreads().values()
            if max(threads, default=1) > 1:
                self._client.close()
                raise ValueError(
                    f"workers at {address} have several threads, which trainings would share; "
                    "start them with --nthreads 1"
                )
            self._quiet = stack.pop_all()
        if not threads:
            on_wait()
        self._executor = self._client.get_executor(pure=False, retries=0)

    def num_slots(self) -> int:
        """Threads of all workers, or one task that waits for the first; 0 where it cannot ask.

        No task waits in a worker then, where it would be blamed for the death of another.
        """
        # What a client raises that loses its scheduler depends on how far it has come in closing.
        with contextlib.suppress(OSError, RuntimeError, AttributeError):
            return max(1, sum(self._client.nthreads().values()))
        return 0

    def is_lost(self) -> bool:
        """Whether the scheduler was away, which forgets every task; some futures never learn."""
        return self._client.status != "running"

    def submit(self, fn: Callable, /, *args: Any, **kwargs: Any) -> Future:
        try:
            return self._executor.submit(fn, *args, **kwargs)
        except Exception:
            if not self.is_lost():
                raise
            future = Future()
            future.cancel()
            future.set_running_or_notify_cancel()
            return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        with self._quiet, contextlib.suppress(TimeoutError):  # of a scheduler that is gone
            if self._client.status == "running":
                self._executor.shutdown(wait=wait and not cancel_futures)
            self._client.close()


def _connected(address: str) -> Any:
    """A client of the scheduler.

    It is made in a thread, for where something listens that never answers it waits without
    end, whatever timeout it is given.
    """
    made: Future = Future()

    def connect() -> None:
        try:
            timeout = CONNECT_TIMEOUT
            made.set_result(distributed.Client(address, timeout=timeout, set_as_default=False))
        except BaseException as error:
            made.set_exception(error)

    threading.Thread(target=connect, daemon=True).start()
    try:
        return made.result(CONNECT_TIMEOUT + 1)
    except OSError:  # TimeoutError is one
        raise ValueError(f"no Dask scheduler answers at {address}") from None
    except Exception as error:
        raise ValueError(f"the scheduler at {address} is of no use: {_sentence(error)}") from None


# ------------------------------------------------------------------------- the driver

Engine = Callable[[], _Processes | _Cluster]
"""Opens an executor, and another where that one is lost; `shutdown(False)` ends its work."""


def local_engine(num_workers: int) -> Engine:
    """As many processes on this computer.

    Raises:
        ValueError: for less than one.
    """
    if num_workers < 1:
        raise ValueError(f"{num_workers} workers can do no work; ask for at least one")
    return partial(_Processes, num_workers)


def dask_engine(address: str, on_wait: Callable[[], Any] = lambda: None) -> Engine:
    """The workers of a Dask cluster, by the address of its scheduler.

    Opening it raises ValueError where no scheduler answers, and calls `on_wait` where the
    scheduler has no workers yet.

    Raises:
        ValueError: for a malformed address, or where Dask is not installed.
    """
    if distributed is None:
        raise ValueError("the engine 'dask' needs the extra: pip install 'excite[dask]'")
    is_good, url = False, address if "://" in address else f"tcp://{address}"
    with contextlib.suppress(ValueError):  # of a port that is no number, a host that is no name
        parts = urlsplit(url)
        host = (parts.hostname or "").encode("idna")
        is_good = bool(host and parts.port and url == f"tcp://{parts.netloc}")
    if not is_good:
        raise ValueError(f"{address!r} is no address of a scheduler, like tcp://10.0.0.5:8786")
    return partial(_Cluster, address, on_wait)


def run(
    target: str,
    tasks: Mapping[str, Mapping[str, Any]],
    engine: Engine,
    *,
    on_done: Callable[[str, Any], Any],
    on_tick: Callable[[], Any] = lambda: None,
    num_tries: int = 3,
) -> dict[str, Exception]:
    """Calls `target` once a task, with its arguments, and gives every result to `on_done`.

    A task whose worker dies, or that raises, is tried again later; but for a ValueError,
    which is a user's mistake and stays one. Where this function is left by an exception, by
    one of `on_done` or `on_tick` for example, nothing of it runs on in this computer.

    Args:
        target: "package.module:function".
        tasks: keyword arguments by the name of the task: JSON-ready data or bytes.
        on_done: takes the name of a task and its result, in the order in which they come.
        on_tick: called about once a second.
        num_tries: how often a task is tried in all.

    Returns:
        Why, by the name of each task that failed: ValueError is a mistake of the user's.

    Raises:
        ValueError: where the engine cannot be opened.
    """
    work = _Work(target, tasks, engine, num_tries)
    next_tick = time.monotonic() + TICK
    try:
        while work.queue or work.running:
            work.submit()
            for name, result in work.finished(max(0.0, next_tick - time.monotonic())):
                on_done(name, result)
            if time.monotonic() >= next_tick:
                on_tick()
                next_tick = time.monotonic() + TICK
        work.close(wait=True)
    except BaseException:
        work.close(wait=False)
        raise
    return work.failures


class _Work:
    """What is left of the tasks, and why some failed."""

    def __init__(
        self, target: str, tasks: Mapping[str, Mapping[str, Any]], engine: Engine, num_tries: int
    ) -> None:
        self.queue, self.running = deque(tasks), {}
        self.failures: dict[str, Exception] = {}
        self._target, self._tasks, self._engine = target, tasks, engine
        self._num_tries, self._tries, self._deaths = num_tries, Counter(), Counter()
        self._executor: _Processes | _Cluster | None = None

    def submit(self) -> None:
        """Hands over what there is room for."""
        if self._executor is not None and self._executor.is_lost():
            self._lose()
        if not self.queue:
            return
        if self._executor is None:
            self._executor = self._engine()
        num_free = self._executor.num_slots() - len(self.running)
        for _ in range(min(num_free, len(self.queue))):
            name = self.queue.popleft()
            arguments = dict(self._tasks[name])
            future = self._executor.submit(call, self._target, __version__, arguments)
            self.running[future] = name

    def finished(self, seconds: float) -> Iterator[tuple[str, Any]]:
        """Names and results of what is finished, after the first or after so many seconds."""
        done, _ = wait(self.running, seconds, FIRST_COMPLETED)
        lost = {future for future in done if future.cancelled()}
        for future in done - lost:
            name = self.running.pop(future)
            error = future.exception()
            if error is None:
                yield name, future.result()
            else:
                self._note(name, error)
        if lost:  # we cancel nothing while we wait: it is the scheduler that has gone
            self._lose()

    def close(self, wait: bool) -> None:
        """Ends the executor; `submit` opens another."""
        if self._executor is not None:
            self._executor.shutdown(wait=wait, cancel_futures=not wait)
        self._executor = None

    def _lose(self) -> None:
        self.close(wait=False)
        for name in self.running.values():
            self._note(name, BrokenExecutor())
        self.running.clear()

    def _note(self, name: str, error: BaseException) -> None:
        num_deaths = int(isinstance(error, BrokenExecutor))
        if distributed is not None and isinstance(error, distributed.KilledWorker):
            num_deaths = error.args[2] + 1  # the scheduler has tried that many others itself
        self._tries[name] += 1
        self._deaths[name] += num_deaths
        if self._tries[name] < self._num_tries and not isinstance(error, ValueError):
            self.queue.append(name)
        elif num_deaths:
            times = "once" if self._deaths[name] == 1 else f"{self._deaths[name]} times"
            self.failures[name] = RuntimeError(f"its worker died {times}")
        else:  # subclasses of ValueError come from libraries
            is_users = type(error) is ValueError
            self.failures[name] = error if is_users else RuntimeError(_sentence(error))
