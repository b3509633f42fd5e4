"""The workers of a Dask cluster, reached through its scheduler."""

from __future__ import annotations

import contextlib
import os
import threading
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import partial
from typing import Any
from urllib.parse import urlsplit

from .. import __version__
from .engine import Engine
from .pool import environment
from .worker import Ending, Failure, answers, sentence_of

try:
    import distributed
except ImportError:
    distributed: Any = None

CONNECT_TIMEOUT = 10.0
"""Timeout of a scheduler [s]."""


def dask_engine(address: str, on_wait: Callable[[], object] = lambda: None) -> Engine:
    """The workers of a Dask cluster, by the address of its scheduler.

    Opening it raises ValueError if no scheduler answers, and calls `on_wait` if the
    scheduler has no workers yet.

    Raises:
        ValueError: for a malformed address, or where Dask is not installed.
    """
    if distributed is None:
        raise ValueError("the engine 'dask' needs the extra: pip install 'excite[dask]'")
    is_good, url = False, address if "://" in address else f"tcp://{address}"
    with contextlib.suppress(ValueError):  # an invalid port or host
        parts = urlsplit(url)
        host = (parts.hostname or "").encode("idna")
        is_good = bool(host and parts.port and url == f"tcp://{parts.netloc}")
    if not is_good:
        raise ValueError(f"{address!r} is no address of a scheduler, like tcp://10.0.0.5:8786")
    return partial(_Cluster, address, on_wait)


def call(target: str, version: str, arguments: Mapping[str, object]) -> Ending:
    """Runs in a worker of the cluster: calls the function `target`, returns its last answer.

    The function is given by name and imported here. Unpickling a function object would
    import JAX before its environment is set.
    """
    if version != __version__:
        sentence = f"the worker runs excite {__version__}, the study was started by {version}"
        return Failure(sentence, is_mistake=True)
    os.environ.update(environment())
    endings = [answer for answer in answers(target, arguments) if isinstance(answer, Ending)]
    return endings[-1]


class _Cluster:
    """A Dask client and its executor, closed together.

    A running task cannot be stopped: after a cancellation it still runs to its end.
    """

    def __init__(self, address: str, on_wait: Callable[[], object], num_tasks: int) -> None:
        del num_tasks
        with contextlib.ExitStack() as stack:
            # A lost scheduler is reported by an error; Dask's log messages are not needed.
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
        """Number of threads of all workers; 1 without workers; 0 where the scheduler is lost.

            With this number no task waits in a worker. A waiting task would count as failed when
        the worker dies.
        """
        # The exception of a client without scheduler depends on the state of its closing.
        with contextlib.suppress(OSError, RuntimeError, AttributeError):
            return max(1, sum(self._client.nthreads().values()))
        return 0

    def is_lost(self) -> bool:
        """Whether the scheduler was lost, with every task; some futures do not report this."""
        return self._client.status != "running"

    def submit(self, target: str, arguments: Mapping[str, object]) -> Future[Ending]:
        future: Future[Ending] = Future()
        try:
            task = self._executor.submit(call, target, __version__, dict(arguments))
        except Exception:
            if not self.is_lost():
                raise
            _cancel(future)
        else:
            task.add_done_callback(lambda task: _pass_on(task, future))
        return future

    def close(self, is_done: bool) -> None:
        with self._quiet, contextlib.suppress(TimeoutError):  # the scheduler is lost
            if self._client.status == "running":
                self._executor.shutdown(wait=is_done)
            self._client.close()


def _pass_on(task: Future[Ending], future: Future[Ending]) -> None:
    """The outcome of a task of the cluster."""
    if task.cancelled():
        _cancel(future)
        return
    error = task.exception()
    if error is None:
        future.set_result(task.result())
    elif isinstance(error, distributed.KilledWorker):
        # The scheduler itself has tried this number of other workers.
        future.set_result(Failure(sentence_of(error), num_deaths=error.args[2] + 1))
    else:
        future.set_result(Failure(sentence_of(error)))


def _cancel(future: Future[Ending]) -> None:
    future.cancel()
    future.set_running_or_notify_cancel()


def _connected(address: str) -> Any:
    """A client of the scheduler.

    It is made in a thread, because it ignores its timeout where another program listens but
    does not answer.
    """
    made: Future[object] = Future()

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
        sentence = sentence_of(error)
        raise ValueError(f"the scheduler at {address} cannot be used: {sentence}") from None
