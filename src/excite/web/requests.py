"""Checks of the content of requests: names, numbers and limits; an error is one sentence."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping

from starlette.requests import Request

MAX_UPLOAD = 32 * 2**20
"""Largest size of an uploaded file [bytes]."""
MAX_STEPS = 5000
"""Largest number of samples of a simulated experiment."""
MAX_BODY = 64 * 2**10
"""Largest size of a request that is not an upload [bytes]."""

SILENCE = 30.0
"""Seconds that a request's body may pause."""

Asked = Mapping[str, object]
"""The content of a request, as JSON."""
Body = Callable[[Request], Awaitable[dict[str, object]]]
"""Reads it."""

_MAX_TEXT = 200  # characters
_FOLDERS = re.compile(r"(?<![\w.:/])/(?:[^\s/:'\"]+/)+")
WORD = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,63}")
"""A name from a browser: without dots, slashes and colons, so that it is never a path."""


def without_folders(sentence: str) -> str:
    """A sentence with the names of files but without their folders."""
    return _FOLDERS.sub("", sentence)


class RefusedError(Exception):
    """A request that is refused: an HTTP status and one sentence for the user."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status, self.sentence = status, sentence


async def parts(request: Request) -> AsyncIterator[bytes]:
    """The parts of a request's body as they come, until it ends or stops."""
    body = request.stream()
    try:
        while part := await asyncio.wait_for(anext(body, b""), SILENCE):
            yield part
    except TimeoutError:
        raise RefusedError(408, "the upload stopped") from None


# ------------------------------------------------------------- what a browser may ask for


def word(asked: Asked, key: str) -> str:
    """A name without dots, slashes and colons, so that it is never a path."""
    value = asked.get(key)
    if not (isinstance(value, str) and WORD.fullmatch(value)):
        raise RefusedError(400, f"{key}: a name from the page is needed")
    return value


def words(asked: Asked, key: str, most: int) -> list[str]:
    """Such names, at most so many."""
    value = asked.get(key, [])
    if not isinstance(value, list) or len(value) > most:
        raise RefusedError(400, f"{key}: a list of at most {most} names is needed")
    return [word({key: name}, key) for name in value]


def plant_of(asked: Asked, plants: Mapping[str, str]) -> str:
    """The name of a shipped plant, or the file of one that the server was started with."""
    name = word(asked, "plant")
    return plants.get(name, name)


def number(asked: Asked, key: str, lower: float, upper: float) -> float:
    """A finite number in a range."""
    value = asked.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not _is_finite(value):
        raise RefusedError(400, f"{key}: a number is needed")
    if not lower <= value <= upper:
        raise RefusedError(400, f"{key} must lie between {lower:g} and {upper:g}: got {value:g}")
    return float(value)


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number of very many digits
        return False


def whole(asked: Asked, key: str, lower: int, upper: int) -> int:
    """A whole number in a range."""
    value = number(asked, key, lower, upper)
    if value != int(value):
        raise RefusedError(400, f"{key} must be a whole number: got {value:g}")
    return int(value)


def numbers(asked: Asked, key: str) -> dict[str, float]:
    """Numbers by name; at most 32."""
    value = asked.get(key, {})
    if not isinstance(value, dict) or len(value) > 32:
        raise RefusedError(400, f"{key}: numbers by name are needed")
    return {str(name): number(value, name, -1e12, 1e12) for name in value}


def text(asked: Asked, key: str) -> str:
    """A short text."""
    value = asked.get(key)
    if not isinstance(value, str) or len(value) > _MAX_TEXT:
        raise RefusedError(400, f"{key}: a short text is needed")
    return value


def texts(asked: Asked, key: str) -> dict[str, str]:
    """Short texts by name; at most 32."""
    value = asked.get(key, {})
    if not isinstance(value, dict) or len(value) > 32:
        raise RefusedError(400, f"{key}: texts by name are needed")
    return {str(name): text(value, name) for name in value}
