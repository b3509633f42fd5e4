"""How the page is served, and what it keeps for every browser."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ..study.workers import num_cores
from .requests import RefusedError
from .trainings import Training

MAX_JOBS = 4
"""Jobs that a browser may run at once."""
MAX_SESSIONS = 256
MAX_STORED = 2 * 2**30
"""Bytes of what is kept for all browsers, beyond which no more is uploaded."""
MAX_KEPT = 8
"""Results, and likewise uploads, that are kept for a browser; what was used last stays."""


@dataclass(frozen=True)
class PageSettings:
    """How the page is served.

    Attributes:
        runs: the run folder; nothing outside of it is ever shown.
        host: the address that is bound to.
        token: what a browser must know; None where everybody on this computer may.
        num_workers: processes that compute.
        cache: where they keep compiled programs.
    """

    runs: Path
    host: str = "127.0.0.1"
    token: str | None = None
    num_workers: int = 2
    cache: Path | None = None

    @classmethod
    def of(
        cls, runs: Path, host: str, token: str | None, workers: int | None, cache: Path
    ) -> PageSettings:
        """Checked; a token is drawn where other computers may come, and a worker a core, at most 4.

        Raises:
            ValueError: for a short token, or a run folder that does not exist.
        """
        if token is not None and len(token) < 8:
            raise ValueError("a token needs eight characters or more")
        if not runs.is_dir():
            raise ValueError(f"{runs}: no such folder; --runs names the run folder to be shown")
        if token is None and not is_loopback(host):
            token = secrets.token_urlsafe(16)
        return cls(runs.absolute(), host, token, workers or min(4, num_cores()), cache)


def is_loopback(host: str) -> bool:
    """Whether an address is of this computer alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass
class Place:
    """A folder for an upload or a result.

    Attributes:
        kind: "upload" or "result"; each gives way to its own kind alone.
        num_users: how many jobs need it now.
        is_done: whether it holds what it was made for.
    """

    folder: Path
    kind: str
    num_users: int = 0
    is_done: bool = False


@dataclass
class Session:
    """One browser that may come in: what it may see, and nobody else.

    Attributes:
        folder: its uploads and results.
        stops: how to stop each running job, by its name; None for a short one.
        kept: results and uploads by name, the one used last at the end.
        trainings: trainings it has started, by name.
    """

    folder: Path
    stops: dict[str, asyncio.Event | None] = field(default_factory=dict)
    kept: dict[str, Place] = field(default_factory=dict)
    trainings: dict[str, Training] = field(default_factory=dict)
    seen: float = field(default_factory=time.monotonic)

    @contextlib.contextmanager
    def making(self, kind: str) -> Iterator[tuple[str, Place]]:
        """A name that cannot be guessed, and its place, which goes where it is not done."""
        name, folder = secrets.token_urlsafe(12), Path(tempfile.mkdtemp(dir=self.folder))
        place = self.kept[name] = Place(folder, kind)
        self._give_way(kind, name)
        try:
            with self.using(name):
                yield name, place
        finally:
            if not place.is_done:
                self._forget(name)

    @contextlib.contextmanager
    def using(self, name: str) -> Iterator[Path]:
        """The folder of a result or upload of this browser, which stays for that long."""
        place = self.kept.pop(name, None)
        if place is None:
            raise RefusedError(404, "there is no such result in this browser; run it again")
        self.kept[name] = place  # the last one now
        place.num_users += 1
        try:
            yield place.folder
        finally:
            place.num_users -= 1

    def _give_way(self, kind: str, new: str) -> None:
        """Removes what was not used for longest, and is not in use, where there is too much."""
        same = [name for name, place in self.kept.items() if place.kind == kind]
        free = [name for name in same if not self.kept[name].num_users and name != new]
        for name in free[: max(0, len(same) - MAX_KEPT)]:
            self._forget(name)

    def _forget(self, name: str) -> None:
        shutil.rmtree(self.kept.pop(name).folder, ignore_errors=True)

    @property
    def is_empty(self) -> bool:
        """Whether nothing would be lost with it."""
        return not (self.kept or self.trainings)

    @property
    def is_idle(self) -> bool:
        """Whether none of its jobs runs."""
        return not (self.stops or any(t.is_running for t in self.trainings.values()))

    def begin(self, stop: asyncio.Event | None = None) -> str:
        """The name of one more job that runs, until `end`.

        Raises:
            RefusedError: where too many run already.
        """
        if len(self.stops) >= MAX_JOBS:
            raise RefusedError(429, f"{MAX_JOBS} jobs already running in this browser; stop one")
        name = secrets.token_urlsafe(12)
        self.stops[name] = stop
        return name

    def end(self, name: str) -> None:
        """That job is over."""
        self.stops.pop(name, None)


class Sessions:
    """All browsers, by the secret in their cookie."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._all = folder, dict[str, Session]()

    def get(self, secret: str) -> Session | None:
        """The session of a secret."""
        session = self._all.get(secret)
        if session is not None:
            session.seen = time.monotonic()
        return session

    def new(self) -> str:
        """The secret of a new session; where there are too many, an idle one gives way.

        Empty ones go before those that hold results, and then those that rested for longest.
        """
        idle = [secret for secret, session in self._all.items() if session.is_idle]
        if len(self._all) >= MAX_SESSIONS:
            if not idle:
                raise RefusedError(503, "too many browsers are working here")
            gone = min(idle, key=lambda s: (not self._all[s].is_empty, self._all[s].seen))
            shutil.rmtree(self._all.pop(gone).folder, ignore_errors=True)
        secret = secrets.token_urlsafe(32)
        self._all[secret] = Session(Path(tempfile.mkdtemp(dir=self._folder)))
        return secret
