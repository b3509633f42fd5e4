"""A watchdog that outlives the process: a child that sends the safe input when it is silent.

A process that was killed (`kill -9`, the memory ran out) or hangs cannot end its experiment.
A rig of one's own declares a `Watchdog`: a function that another process can import, which
opens a connection of its own and sends the safe input. While the rig is open, a small child
process waits at a pipe for signs of life, one a reading. It calls the function when the pipe
ends, which it does with the process, or when no sign comes in time. It has a session of its
own, so that Ctrl-C and a closed terminal do not end it. It does not outlive a power cut or
the computer: the hardware still needs a watchdog of its own.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ..description import told
from ..files import module_at

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
"""Requests to end a process; not every system has all of them."""

_BEAT, _REST, _END = b"b", b"r", b"e"
_SENT = 3  # exit code of a child that sent the safe input
_TRIES = 10.0  # seconds in which a function that fails is called again


@dataclass(frozen=True)
class Watchdog:
    """How another process sends a rig's safe input.

    Attributes:
        send: a function of a file or module that can be imported without starting an
            experiment; called as `send(safe_input, *arguments)` in a process that has no
            connection to the rig. If it raises, it is called again for ten seconds.
        arguments: JSON-ready, such as an address.
        timeout: time without a sign of life after which it is called [s]; at least that of
            two readings.
    """

    send: Callable[..., object]
    arguments: Sequence[object] = ()
    timeout: float = 0.5

    def to_dict(self) -> dict[str, object]:
        """The watchdog as JSON-ready data, for the record."""
        name = getattr(self.send, "__qualname__", repr(self.send))
        return {"send": name, "arguments": list(self.arguments), "timeout": self.timeout}


class WatchdogProcess:
    """The child process of a watchdog."""

    def __init__(self, watchdog: Watchdog, safe_input: np.ndarray, interval: float) -> None:
        """Starts it, and waits until it has imported its function.

        Args:
            watchdog: what it does.
            safe_input: of the rig.
            interval: between two readings [s].

        Raises:
            ValueError: one sentence for a watchdog that could not do its work.
        """
        self._timeout, self._last = watchdog.timeout, -math.inf
        if not 2 * interval <= watchdog.timeout < math.inf:
            raise ValueError(
                f"the timeout of a watchdog must be at least that of two readings, "
                f"{2 * interval:g} s: got {watchdog.timeout!r}"
            )
        task = {
            "path": sys.path,
            **_place(watchdog.send),
            "arguments": [np.asarray(safe_input, float).tolist(), *watchdog.arguments],
            "timeout": watchdog.timeout,
        }
        try:
            text = json.dumps(task)
        except (TypeError, ValueError) as error:
            raise ValueError(f"the arguments of a watchdog must be JSON-ready: {error}") from None
        program = (
            "import json, sys\n"
            "sys.path[:] = json.loads(sys.argv[1])['path']\n"
            f"from {__name__} import main\n"
            "main()"
        )
        self._process = subprocess.Popen(
            [sys.executable, "-c", program, text], bufsize=0,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )  # fmt: skip
        answer = self._process.stdout.read().decode().strip() if self._process.stdout else ""
        if answer != "ready":
            self.end(is_safe=True)
            raise ValueError(f"the watchdog could not be started: {answer or 'no answer'}")

    def beat(self) -> str:
        """A sign of life; a sentence where the child has ended, else an empty text."""
        now = time.monotonic()
        if now - self._last < self._timeout / 10:
            return ""
        self._last = now
        return self._tell(_BEAT)

    def rest(self) -> None:
        """The safe input was written: silence is no longer a reason to send it."""
        self._tell(_REST)

    def end(self, is_safe: bool) -> None:
        """Ends the child, which sends the safe input first if that has not been written."""
        if is_safe:
            self._tell(_END)
        with contextlib.suppress(OSError):
            if self._process.stdin is not None:
                self._process.stdin.close()
        if self._process.stdout is not None:
            self._process.stdout.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_TRIES + 5)

    def _tell(self, word: bytes) -> str:
        try:
            if self._process.stdin is not None:
                self._process.stdin.write(word)
        except (OSError, ValueError):
            code = None
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = self._process.wait(1.0)
            if code == _SENT:
                return f"the watchdog sent the safe input: silence of more than {self._timeout:g} s"
            return "the watchdog has ended"
        return ""


def _place(function: Callable[..., object]) -> dict[str, str]:
    """Module, file and name of a function, by which another process finds it."""
    module, name = getattr(function, "__module__", ""), getattr(function, "__qualname__", "")
    file = getattr(sys.modules.get(module), "__file__", None)
    if module == "__main__" or file is None or not name or "<" in name:
        raise ValueError(
            f"the function of a watchdog must be one that another process can import, in a file "
            f"other than the program or notebook that is run: got {function!r}"
        )
    return {"module": module, "file": str(Path(file).absolute()), "name": name}


def _found(task: Mapping[str, Any]) -> Callable[..., object]:
    """The function of a task."""
    try:
        found: Any = importlib.import_module(task["module"])
    except ModuleNotFoundError as error:
        if error.name != task["module"]:
            raise
        found = module_at(Path(task["file"]))  # a user's file, which has no name among modules
    for part in task["name"].split("."):
        found = getattr(found, part)
    return found


def main() -> None:
    """The child: waits for silence or the end of its standard input."""
    for name in SIGNALS:
        if (number := getattr(signal, name, None)) is not None:
            signal.signal(number, signal.SIG_IGN)
    answer = os.dup(1)
    os.dup2(2, 1)  # what the function's module prints is no answer
    task = json.loads(sys.argv[1])
    try:
        send = _found(task)
    except BaseException as error:
        os.write(answer, told(error).encode())
        sys.exit(1)
    os.write(answer, b"ready")
    os.close(answer)
    words = queue.SimpleQueue[bytes]()
    threading.Thread(target=_listen, args=(words,), daemon=True).start()
    timeout = None
    while True:
        try:
            word = words.get(timeout=timeout)
        except queue.Empty:
            _send(send, task["arguments"], f"silence of more than {timeout:g} s")
        if word == _END:
            return
        if not word:
            _send(send, task["arguments"], "the process of the experiment has ended")
        timeout = task["timeout"] if word == _BEAT else None


def _listen(words: queue.SimpleQueue[bytes]) -> None:
    """Passes on the newest word; an empty one at the end of the pipe."""
    word = _REST
    while word:
        word = os.read(0, 4096)[-1:]
        words.put(word)


def _send(send: Callable[..., object], arguments: Sequence[Any], why: str) -> NoReturn:
    """Sends the safe input, and ends the child."""
    safe_input, *others = arguments
    until, error = time.monotonic() + _TRIES, None
    while time.monotonic() < until:
        try:
            send(np.array(safe_input), *others)
        except BaseException as e:  # the process that ends may still hold the connection
            error = e
            time.sleep(0.05)
        else:
            _say(f"the watchdog sent the safe input: {why}")
            sys.exit(_SENT)
    _say(f"the watchdog could not send the safe input: {told(error or OSError(why))}")
    sys.exit(1)


def _say(sentence: str) -> None:
    with contextlib.suppress(OSError):  # the terminal may be closed
        sys.stderr.write(f"excite: {sentence}\n")
        sys.stderr.flush()
