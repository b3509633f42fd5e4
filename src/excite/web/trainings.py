"""Trainings: processes of `excite train`, started and interrupted as in a terminal.

A training continues when its page is closed, and ends with the server. Every browser with the
token sees it, stops it and resumes it from its last checkpoint.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import shutil
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, TypedDict

from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route

from ..study.objectives import OBJECTIVES, is_information
from ..study.pool import num_cores
from ..study.progress import read_progress
from ..training.settings import GradientSettings
from .requests import Asked, Body, RefusedError, number, plant_of, whole, without_folders, word

MAX_TRAININGS = 2
_MAX_KEPT = 16  # trainings that are shown; the oldest of more that have ended are left out
_PATIENCE = 10.0  # seconds for a training to end when it is interrupted
_MAX_ROWS = 500  # of a learning curve; a longer one is thinned to every second row
_MAX_SEEDS = 32
_MAX_SAID = 8192  # bytes of what the process has printed last
_STEP_BACK = """
import ctypes, os, signal, sys
if hasattr(os, "nice"):
    os.nice(10)  # experiments on the page have priority
if sys.platform == "linux":  # a server that is killed interrupts its trainings
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGINT)
    if os.getppid() != int(sys.argv[1]):  # the server was killed in the meantime
        sys.exit(1)
os.execv(sys.executable, [sys.executable, "-m", "excite", *sys.argv[2:]])
"""


class TrainingStatus(TypedDict):
    """A training as the page shows it.

    Keys:
        sentence: the error of a failed training.
        progress: what it does, how much is done, and the time left, as in a terminal.
        curves: rows of the learning curve by seed; None for a number that is not finite.
        is_bound: whether the curve has bounds instead of errors (objectives of information).
    """

    name: str
    folder: str
    state: State
    sentence: str
    progress: str
    curves: dict[str, Curve]
    is_bound: bool
    command: str


class Resources(TypedDict):
    """What a training can take of this computer.

    Keys:
        cores: at most so many processes at once, one for a seed.
        free_bytes: of the memory; None where it is not known.
        running: trainings.
        most: trainings at once.
        num_plants: simulated in every update.
    """

    cores: int
    free_bytes: int | None
    running: int
    most: int
    num_plants: int


State = Literal["starting", "training", "stopping", "stopped", "finished", "failed"]
Curve = list[dict[str, float | None]]


class Training:
    """One process of `excite train`, and its learning curves so far."""

    def __init__(self, name: str, folder: Path, words: list[str]) -> None:
        self.name, self.folder, self.words = name, folder, words
        self.curves: dict[str, Curve] = {}
        self.state: State = "starting"
        self.sentence, self._said = "", b""
        self._process: asyncio.subprocess.Process | None = None
        self._followed: asyncio.Task | None = None

    async def start(self) -> None:
        """Starts the process, also again, from its last checkpoint."""
        self.state, self.sentence, self._said = "starting", "", b""
        try:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable, "-c", _STEP_BACK, str(os.getpid()),
                *self.words, "--out", str(self.folder),
                stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.DEVNULL,
                stderr=asyncio.subprocess.PIPE, start_new_session=True,
                env={**os.environ, "EXCITE_PROGRESS": "1"},
            )  # fmt: skip
        except OSError as error:
            self.state, self.sentence = "failed", f"it cannot be started ({error.strerror})"
            return
        self._followed = asyncio.create_task(self._follow(self._process))

    @property
    def is_running(self) -> bool:
        """Whether it is running."""
        return self.state in ("starting", "training", "stopping")

    async def stop(self) -> None:
        """Interrupts it like Ctrl-C; kills it if it does not end."""
        process = self._process
        if process is None or not self.is_running:
            return
        self.state = "stopping"
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGINT)
        try:
            await asyncio.wait_for(process.wait(), _PATIENCE)
        except TimeoutError:
            with contextlib.suppress(ProcessLookupError):
                process.kill()  # its workers end with it
        if self._followed is not None:
            await self._followed

    async def _follow(self, process: asyncio.subprocess.Process) -> None:
        """Collects rows of the learning curves until the process ends."""
        reading = asyncio.create_task(self._read(process))
        while not reading.done():
            self._look()
            await asyncio.wait({reading}, timeout=0.5)
        self._look()
        if process.returncode == 0:
            self.state = "finished"
        elif self.state == "stopping":
            self.state = "stopped"
        else:
            self.state = "failed"
            told = [line for line in self._lines() if not self._is_progress(line)]
            silent = f"it ended without an error message (code {process.returncode})"
            self.sentence = without_folders(told[-1] if told else silent)
            if not any(self.folder.glob("seeds/*/*/*.safetensors")):  # nothing to resume
                shutil.rmtree(self.folder, ignore_errors=True)

    async def _read(self, process: asyncio.subprocess.Process) -> None:
        """Keeps what the process prints last."""
        printed = process.stderr
        while printed is not None and (part := await printed.read(_MAX_SAID)):
            self._said = (self._said + part)[-_MAX_SAID:]
        await process.wait()

    def _lines(self) -> list[str]:
        """The last whole lines that it has printed."""
        return self._said.decode(errors="replace").rpartition("\n")[0].splitlines()

    def _is_progress(self, line: str) -> bool:
        return line.startswith((f"{self.words[1]}: ", f"{self.words[1]}, "))

    def _look(self) -> None:
        for place in sorted(self.folder.glob("seeds/*/*/")):
            look, curve = read_progress(place), self.curves.setdefault(place.name, [])
            if look is None or look in curve[-1:]:
                continue
            steps = look["steps"] or 0.0
            while curve and (curve[-1]["steps"] or 0.0) >= steps:  # resumed from a checkpoint
                curve.pop()
            curve.append(look)
            if len(curve) > _MAX_ROWS:
                del curve[1:-1:2]
            self.state = "training" if self.state == "starting" else self.state

    def told(self) -> TrainingStatus:
        """Its state for the page."""
        lines = [line for line in self._lines() if self._is_progress(line)] * self.is_running
        return {
            "name": self.name,
            "folder": self.folder.name,
            "state": self.state,
            "sentence": self.sentence,
            "progress": lines[-1][len(self.words[1]) + 2 :] if lines else "",
            "curves": {seed: curve for seed, curve in self.curves.items() if curve},
            "is_bound": is_information(self.words[self.words.index("--objective") + 1]),
            "command": " ".join(["excite", *self.words, "--out", self.folder.name]),
        }


def routes(
    folder: Path, plants: Mapping[str, str], body: Body, every: list[Training]
) -> list[Route]:
    """Routes that start, show, stop and resume trainings.

    Args:
        plants: files of plants, by the name that a browser sends.
        every: all trainings of this server; updated here.
    """

    def require_room() -> None:
        if sum(t.is_running for t in every) >= MAX_TRAININGS:
            raise RefusedError(429, f"{MAX_TRAININGS} trainings already running; stop one")

    async def start(request: Request) -> JSONResponse:
        asked = await body(request)
        require_room()
        ended = [training for training in every if not training.is_running]
        for training in ended[: max(0, len(every) + 1 - _MAX_KEPT)]:
            every.remove(training)
        words, place = _words(asked, plants), _free(folder, word(asked, "name"), every)
        training = Training(secrets.token_urlsafe(12), place, words)
        every.append(training)
        await training.start()
        return JSONResponse(training.told())

    def named(request: Request) -> Training:
        name = request.path_params["name"]
        found = next((training for training in every if training.name == name), None)
        if found is None:
            raise RefusedError(404, "this server has no such training")
        return found

    async def stop(request: Request) -> JSONResponse:
        await named(request).stop()
        return JSONResponse(named(request).told())

    async def resume(request: Request) -> JSONResponse:
        training = named(request)
        if training.state != "stopped":
            raise RefusedError(409, f"{training.folder.name} was not stopped: {training.state}")
        require_room()
        await training.start()
        return JSONResponse(training.told())

    async def shown(request: Request) -> JSONResponse:
        del request
        resources: Resources = {
            "cores": num_cores(),
            "free_bytes": _free_bytes(),
            "running": sum(training.is_running for training in every),
            "most": MAX_TRAININGS,
            "num_plants": GradientSettings().num_plants,
        }
        told = [training.told() for training in every]
        return JSONResponse({"trainings": told, "resources": resources})

    return [
        Route("/api/trainings", start, methods=["POST"]),
        Route("/api/trainings", shown, methods=["GET"]),
        Route("/api/trainings/{name}", stop, methods=["DELETE"]),
        Route("/api/trainings/{name}", resume, methods=["POST"]),
    ]


def _free_bytes() -> int | None:
    """Memory that can be used without swapping (Linux); None where it is not known."""
    with contextlib.suppress(OSError, ValueError, LookupError):
        words = Path("/proc/meminfo").read_text().split()
        return 1024 * int(words[words.index("MemAvailable:") + 1])
    return None


def _words(asked: Asked, plants: Mapping[str, str]) -> list[str]:
    """The command, made of checked names and numbers only."""
    objective, updates = word(asked, "objective"), whole(asked, "updates", 1, 100_000)
    if objective not in OBJECTIVES:
        raise RefusedError(400, f"objective: one of {', '.join(OBJECTIVES)} is needed")
    spread = number(asked, "spread", 0, 0.9)
    seeds = whole({"seeds": 1, **asked}, "seeds", 1, _MAX_SEEDS)
    return [
        "train", plant_of(asked, plants), "--objective", objective,
        "--steps", str(whole(asked, "steps", 10, 5000)), "--spread", f"{spread:g}",
        "--set", f"num_updates={updates}", *(["--seeds", str(seeds)] if seeds > 1 else []),
    ]  # fmt: skip


def _free(folder: Path, name: str, running: Sequence[Training]) -> Path:
    """A folder for a training: a new one of this name in the run folder."""
    path = folder / name
    if path.exists() or path.is_symlink() or any(path == training.folder for training in running):
        raise RefusedError(409, f"{path.name} exists already; choose another name")
    return path
