"""Settings of the server, and the data it stores for every browser."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import secrets
import shutil
import tempfile
import time
from collections.abc import AsyncGenerator, Coroutine, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ..files import read_json
from ..study.pool import num_cores
from .requests import RefusedError

MAX_JOBS = 4
"""Largest number of jobs that a browser may run at once."""
MAX_SESSIONS = 256
MAX_STORED = 2 * 2**30
"""Limit of the data stored for all browsers [bytes]; beyond it uploads are refused."""
MAX_KEPT = 8
"""Number of results, and of uploads, stored for a browser; the oldest is removed first."""
UPLOADED, COLUMNS = "files", "columns.json"
"""The folder of uploaded files, in that of their upload, and what they contain."""
MAX_FILES = 8
"""Largest number of files of an upload."""
GRACE = 10.0
"""A job that no page follows ends after so many seconds; loading a page again takes fewer."""
GONE = {
    "upload": "this file is no longer on the server; choose it again",
    "result": "this result is no longer on the server, or was interrupted; run it again",
}
"""The sentence for an upload or a result that this browser does not have, by its kind."""


@dataclass(frozen=True)
class PageSettings:
    """Settings of the server.

    Attributes:
        runs: the run folder; nothing outside of it is shown.
        host: the address to listen on.
        token: that a browser must send; None for no token.
        num_workers: number of worker processes.
        cache: where they keep compiled programs.
        plants: that are on the page beside the shipped ones, by the name shown there: files.
    """

    runs: Path
    host: str = "127.0.0.1"
    token: str | None = None
    num_workers: int = 2
    cache: Path | None = None
    plants: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        runs: Path,
        host: str,
        token: str | None,
        workers: int | None,
        cache: Path,
        plants: Mapping[str, str],
    ) -> PageSettings:
        """Checked settings; by default a token for other computers, one worker per core, at most 4.

        Raises:
            ValueError: for a short token, or a run folder that does not exist.
        """
        if token is not None and len(token) < 8:
            raise ValueError("a token needs eight characters or more")
        if not runs.is_dir():
            raise ValueError(f"{runs}: no such folder; --runs names the run folder to show")
        if token is None and not is_loopback(host):
            token = secrets.token_urlsafe(16)
        return cls(runs.absolute(), host, token, workers or min(4, num_cores()), cache, plants)


def files_of_upload(folder: Path) -> list[str]:
    """Names of the files of an upload, in the order in which they came.

    Args:
        folder: of the upload.
    """
    return [own["file"] for own in read_json(folder / COLUMNS)["files"]]


def is_loopback(host: str) -> bool:
    """Whether only this computer can reach an address."""
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
        kind: "upload" or "result"; each is replaced only by its kind.
        num_users: number of jobs that use it.
        is_done: whether its content is complete.
    """

    folder: Path
    kind: str
    num_users: int = 0
    is_done: bool = False


class Job:
    """A job that runs, whichever pages follow it; `GRACE` seconds without one end it.

    Attributes:
        stop: to be set to stop it.
        lines: what it has told so far.
    """

    def __init__(self) -> None:
        self.stop, self.lines = asyncio.Event(), list[str]()
        self._more, self._num_followers = asyncio.Event(), 0
        self._task: asyncio.Task[None]
        self._ending: asyncio.TimerHandle | None = None

    def start(self, work: Coroutine[None, None, None]) -> None:
        """Runs the work, which tells its lines."""
        self._task = asyncio.create_task(work)
        self._task.add_done_callback(lambda _: self._more.set())

    def tell(self, line: str) -> None:
        """Adds a line for all pages."""
        self.lines.append(line)
        self._more.set()
        self._more = asyncio.Event()

    async def follow(self) -> AsyncGenerator[str]:
        """All lines from the first, until it ends."""
        if self._ending is not None:
            self._ending.cancel()
            self._ending = None
        self._num_followers += 1
        sent = 0
        try:
            while True:
                more, is_over = self._more, self._task.done()
                while sent < len(self.lines):
                    sent += 1
                    yield self.lines[sent - 1]
                if is_over:
                    self._task.result()  # an unexpected error breaks the connection
                    return
                await more.wait()
        finally:
            self._num_followers -= 1
            if not self._num_followers and not self._task.done():
                self._ending = asyncio.get_running_loop().call_later(GRACE, self.end)

    @property
    def is_abandoned(self) -> bool:
        """Whether the pages that followed it have left."""
        return self._ending is not None

    def end(self) -> None:
        """Ends it at once."""
        if not self._task.cancelling():
            self._task.cancel()


@dataclass
class Session:
    """The session of one browser, and the data that only this browser can see.

    Attributes:
        folder: its uploads and results.
        jobs: those that run, by name; None for a short one, which cannot be stopped.
        kept: results and uploads by name, the one used last at the end.
    """

    folder: Path
    jobs: dict[str, Job | None] = field(default_factory=dict)
    kept: dict[str, Place] = field(default_factory=dict)
    seen: float = field(default_factory=time.monotonic)

    @contextlib.contextmanager
    def making(self, kind: str, name: str) -> Iterator[Place]:
        """A new folder for what the job of this name makes; it is removed if not completed."""
        place = self.kept[name] = Place(Path(tempfile.mkdtemp(dir=self.folder)), kind)
        try:
            with self.using(name, kind):
                yield place
        finally:
            if place.is_done:
                self._give_way(kind, name)
            else:
                self._forget(name)

    @contextlib.contextmanager
    def using(self, name: str, kind: str) -> Iterator[Path]:
        """The folder of a result or upload of this browser, not removed while in use."""
        place = self.kept.get(name)
        if place is None or place.kind != kind:
            raise RefusedError(404, GONE[kind])
        self.kept[name] = self.kept.pop(name)  # now the last one
        place.num_users += 1
        try:
            yield place.folder
        finally:
            place.num_users -= 1

    def _give_way(self, kind: str, new: str) -> None:
        """Removes the folders unused for longest, except those in use, where there are too many."""
        same = [name for name, place in self.kept.items() if place.kind == kind and place.is_done]
        free = [name for name in same if not self.kept[name].num_users and name != new]
        for name in free[: max(0, len(same) - MAX_KEPT)]:
            self._forget(name)

    def _forget(self, name: str) -> None:
        shutil.rmtree(self.kept.pop(name).folder, ignore_errors=True)

    @property
    def is_empty(self) -> bool:
        """Whether it holds no data."""
        return not self.kept

    @property
    def is_idle(self) -> bool:
        """Whether none of its jobs runs."""
        return not self.jobs

    def begin(self, job: Job | None = None) -> str:
        """The name of a new job, which runs until `end`; it cannot be guessed.

        Where too many run, the first that was abandoned ends.

        Raises:
            RefusedError: where all of them are followed.
        """
        if len(self.jobs) >= MAX_JOBS:
            left = [(name, one) for name, one in self.jobs.items() if one and one.is_abandoned]
            if not left:
                sentence = f"{MAX_JOBS} jobs already running in this browser; stop one"
                raise RefusedError(429, sentence)
            left[0][1].end()
            self.end(left[0][0])
        name = secrets.token_urlsafe(12)
        self.jobs[name] = job
        return name

    def end(self, name: str) -> None:
        """Ends the entry of a job."""
        self.jobs.pop(name, None)


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
        """The secret of a new session; where there are too many, an idle one is removed.

        Empty sessions are removed first, then those unused for longest.
        """
        idle = [secret for secret, session in self._all.items() if session.is_idle]
        if len(self._all) >= MAX_SESSIONS:
            if not idle:
                raise RefusedError(503, "too many browsers have running jobs")
            gone = min(idle, key=lambda s: (not self._all[s].is_empty, self._all[s].seen))
            shutil.rmtree(self._all.pop(gone).folder, ignore_errors=True)
        secret = secrets.token_urlsafe(32)
        self._all[secret] = Session(Path(tempfile.mkdtemp(dir=self._folder)))
        return secret
