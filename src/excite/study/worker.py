"""A process that computes for another: `python -m excite.study.worker MEMORY NICENESS`.

One line of JSON in is a call of a function. Every line out is an answer to a call, by its
number: the events of a generator, then the result or the error. The process ends when its
input ends, so that it does not outlive the process that started it. Its data are limited to
MEMORY bytes (0: no limit), which also limits the unpacked size of a file.
"""

from __future__ import annotations

import base64
import contextlib
import importlib
import json
import os
import queue
import signal
import sys
import threading
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from typing import IO, Any

import numpy as np

from ..files import json_ready

try:
    import resource
except ImportError:  # Windows: no limit
    resource = None

_MAX_SENTENCE = 1000  # characters; a file's content may be quoted in it
_BYTES = "__bytes__"
OF_PPO = ("stable_baselines3", "torch", "tensorboard")
"""Modules of the extra `ppo`."""

READY = {"kind": "ready"}
"""The first line of a worker."""


@dataclass(frozen=True)
class Started:
    """A worker has started a call."""


@dataclass(frozen=True)
class Event:
    """Something that a generator yielded."""

    value: object


@dataclass(frozen=True)
class Result:
    """The last answer to a call: the result of the function; None of a generator."""

    value: object = None


@dataclass(frozen=True)
class Failure:
    """The last answer to a call that failed.

    Attributes:
        is_mistake: whether it is the caller's mistake, so that another try is useless.
        num_deaths: number of workers that died during the call.
    """

    sentence: str
    is_mistake: bool = False
    num_deaths: int = 0


Answer = Event | Result | Failure
Ending = Result | Failure
Message = Started | Answer
_KINDS: dict[str, type[Answer]] = {"event": Event, "end": Result, "failed": Failure}


def main() -> None:
    """Answers calls until the input or the reader of the answers ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    memory, niceness = map(int, sys.argv[1:])
    with os.fdopen(os.dup(1), "w", encoding="utf-8", errors="replace") as out:
        os.dup2(2, 1)  # output of a library is not an answer
        if niceness and hasattr(os, "nice"):
            os.nice(niceness)
        if memory and resource is not None:
            resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
        with contextlib.suppress(BrokenPipeError):
            _answer_calls(out)
    os._exit(0)  # a thread still reads the input


def _answer_calls(out: IO[str]) -> None:
    inbox = _Inbox()
    _write(out, encoded(READY))
    while True:
        call = inbox.calls.get()
        number = call["number"]
        answer: Answer = Result()
        with contextlib.closing(answers(call["target"], call["arguments"])) as told:
            for answer in told:
                _write(out, line_of(answer, number))
                if inbox.stopped == number:
                    break
        if isinstance(answer, Event):  # it was stopped
            _write(out, line_of(Result(), number))


class _Inbox:
    """The input, read in a thread, so that its end ends any computation."""

    def __init__(self) -> None:
        self.calls: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self.stopped = -1
        """Number of the last call that was asked to stop."""
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in sys.stdin.buffer:
            message = decoded(line)
            if "stop" in message:
                self.stopped = message["stop"]
            else:
                self.calls.put(message)
        os._exit(0)


def answers(target: str, arguments: Mapping[str, object]) -> Generator[Answer, None, None]:
    """The answers of the function `target`, "package.module:function"."""
    module, _, name = target.partition(":")
    try:
        result = getattr(importlib.import_module(module), name)(**arguments)
        if isinstance(result, Iterator):
            for event in result:
                yield Event(json_ready(event))
            result = None
        yield Result(result)
    except ModuleNotFoundError as error:
        lack = f"the worker has no module {error.name!r}"
        if (error.name or "").partition(".")[0] in OF_PPO:
            lack += "; PPO needs the extra: pip install 'excite[ppo]'"
        yield _failure(lack, is_mistake=True)
    except MemoryError:
        yield _failure("this needs more memory than a worker may use")
    except (Exception, SystemExit) as error:  # subclasses of ValueError come from libraries
        is_mistake = type(error) is ValueError or type(error).__module__.startswith("excite.")
        yield _failure(str(error) if is_mistake else sentence_of(error), is_mistake)


def _failure(sentence: str, is_mistake: bool = False) -> Failure:
    """A text as one line of limited length."""
    sentence = " ".join(sentence.split())
    if len(sentence) > _MAX_SENTENCE:
        sentence = f"{sentence[:_MAX_SENTENCE]}…"
    return Failure(sentence, is_mistake)


def sentence_of(error: BaseException) -> str:
    """Kind and text of an error, in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")


def _write(out: IO[str], line: str) -> None:
    out.write(line + "\n")
    out.flush()


def line_of(answer: Answer, number: int) -> str:
    """An answer to the call of a number, as a line of JSON."""
    [kind] = [kind for kind, of in _KINDS.items() if isinstance(answer, of)]
    try:
        return encoded({**vars(answer), "kind": kind, "number": number})
    except (TypeError, ValueError, RecursionError) as error:  # not plain data
        return line_of(_failure(sentence_of(error)), number)


def message_of(line: bytes) -> tuple[int, Answer]:
    """The number of a call, and the answer that a line holds.

    Raises:
        AttributeError, KeyError, TypeError, ValueError: for any other line.
    """
    content = decoded(line)
    return content.pop("number"), _KINDS[content.pop("kind")](**content)


def encoded(message: object) -> str:
    """Plain data, arrays and bytes as a line of JSON; numbers keep every digit."""
    return json.dumps(message, ensure_ascii=False, default=_plain)


def decoded(line: bytes) -> Any:
    """The inverse of `encoded`; arrays become lists."""
    return json.loads(line, object_hook=_bytes)


def _plain(value: object) -> object:
    if isinstance(value, bytes):
        return {_BYTES: base64.b64encode(value).decode()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not plain data")


def _bytes(found: dict[str, Any]) -> object:
    if found.keys() == {_BYTES} and isinstance(found[_BYTES], str):
        return base64.b64decode(found[_BYTES])
    return found


if __name__ == "__main__":
    main()
