"""A process that computes for the page: `python -m excite.web.worker BYTES`.

One line of JSON in is a call, every line out an event of it, by its number. It ends with its
input, so that no worker outlives the server, and looks for a line between two events: that
stops the work. It takes no more data than BYTES: a file that unpacks to more than the
computer holds is refused, not loaded.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import resource
import select
import sys
from collections.abc import Iterator
from typing import Any

from ..files import json_ready
from .requests import without_folders

_MAX_SENTENCE = 1000  # characters; a file's content may be quoted in it


def main() -> None:
    """Answers calls until the input ends, or nobody is left to read the answers."""
    with contextlib.suppress(BrokenPipeError):
        _answer()


def _answer() -> None:
    with os.fdopen(os.dup(1), "w", encoding="utf-8", errors="replace") as out:
        os.dup2(2, 1)  # whatever a library prints is no event
        os.nice(5)  # the server comes first: a stream has to flow while others compute
        live = importlib.import_module("excite.web.jobs")
        limit = int(sys.argv[1])
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
        _write(out, {"kind": "ready"})
        for line in sys.stdin.buffer:
            call = json.loads(line)
            if call != "stop":  # one that came too late is of no concern
                number = call.pop("number")
                for event in _events(live, **call):
                    _write(out, {**event, "number": number})


def _events(live: Any, target: str, arguments: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The events of one call, with the last one that says how it ended."""
    try:
        with contextlib.closing(getattr(live, target)(**arguments)) as events:
            for event in events:
                yield event
                if select.select([0], [], [], 0)[0]:
                    break
        yield {"kind": "end"}
    except ValueError as error:  # subclasses come from libraries
        is_users = type(error) is ValueError
        yield _failure(str(error) if is_users else _named(error))
    except MemoryError:
        yield _failure("this needs more memory than a worker may take")
    except Exception as error:
        yield _failure(_named(error))


def _named(error: Exception) -> str:
    return f"failed: {type(error).__name__}: {error}"


def _failure(sentence: str) -> dict[str, Any]:
    sentence = without_folders(" ".join(sentence.split()))
    if len(sentence) > _MAX_SENTENCE:
        sentence = f"{sentence[:_MAX_SENTENCE]}…"
    return {"kind": "failed", "sentence": sentence}


def _write(out: Any, event: dict[str, Any]) -> None:
    out.write(json.dumps(json_ready(event), ensure_ascii=False, allow_nan=False) + "\n")
    out.flush()


if __name__ == "__main__":
    main()
