"""Trainings: processes of `excite train`, started and interrupted as in a terminal.

A training continues when its page is closed, and ends with the server. An interrupted
training keeps its checkpoint; rerun the same command to resume.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, TypedDict

from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route

from ..study.objectives import OBJECTIVES, is_information
from ..study.progress import read_progress
from .requests import Asked, Body, RefusedError, number, plant_of, whole, without_folders, word

MAX_TRAININGS = 2
_PATIENCE = 10.0  # seconds for a training to end when it is interrupted
_MAX_ROWS = 500  # of a learning curve; a longer one is thinned to every second row
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
        curve: rows of its learning curve; None for a number that is not finite.
        is_bound: whether the curve has bounds instead of errors (objectives of information).
    """

    name: str
    folder: str
    state: State
    sentence: str
    curve: list[dict[str, float | None]]
    is_bound: bool
    command: str


State = Literal["starting", "training", "stopping", "stopped", "finished", "failed"]


class Training:
    """One process of `excite train`, and its learning curve so far."""

    def __init__(self, name: str, folder: Path, words: list[str]) -> None:
        self.name, self.folder, self.words = name, folder, words
        self.curve: list[dict[str, float | None]] = []
        self.state: State = "starting"
        self.sentence = ""
        self._process: asyncio.subprocess.Process | None = None
        self._followed: asyncio.Task | None = None

    async def start(self) -> None:
        """Starts the process."""
        self._process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", _STEP_BACK, str(os.getpid()),
            *self.words, "--out", str(self.folder),
            stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
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
        """Collects rows of the learning curve until the process ends."""
        told = asyncio.create_task(process.communicate())
        while not told.done():
            self._look()
            await asyncio.wait({told}, timeout=0.5)
        self._look()
        last = ((await told)[1] or b"").decode(errors="replace").strip().splitlines()[-1:]
        if process.returncode == 0:
            self.state = "finished"
        elif self.state == "stopping":
            self.state = "stopped"
        else:
            self.state = "failed"
            self.sentence = without_folders((last or ["it exited without an error message"])[0])

    def _look(self) -> None:
        for place in self.folder.glob("seeds/*/0"):
            look = read_progress(place)
            if look is None or look in self.curve[-1:]:
                continue
            self.curve.append(look)
            if len(self.curve) > _MAX_ROWS:
                del self.curve[1:-1:2]
            self.state = "training" if self.state == "starting" else self.state

    def told(self) -> TrainingStatus:
        """Its state for the page."""
        return {
            "name": self.name,
            "folder": self.folder.name,
            "state": self.state,
            "sentence": self.sentence,
            "curve": self.curve,
            "is_bound": is_information(self.words[self.words.index("--objective") + 1]),
            "command": " ".join(["excite", *self.words, "--out", self.folder.name]),
        }


def routes(
    folder: Path, plants: Mapping[str, str], body: Body, every: list[Training]
) -> list[Route]:
    """Routes that start, show and stop trainings.

    Args:
        plants: files of plants, by the name that a browser sends.
        every: all running trainings of this server; updated here.
    """

    async def start(request: Request) -> JSONResponse:
        asked = await body(request)
        if sum(t.is_running for t in every) >= MAX_TRAININGS:
            raise RefusedError(429, f"{MAX_TRAININGS} trainings already running; stop one")
        every[:] = [training for training in every if training.is_running]
        words, place = _words(asked, plants), _free(folder, word(asked, "name"), every)
        training = Training(secrets.token_urlsafe(12), place, words)
        every.append(training)
        request.state.session.trainings[training.name] = training
        await training.start()
        return JSONResponse(training.told())

    def own(request: Request) -> Training:
        trainings = request.state.session.trainings
        if request.path_params["name"] not in trainings:
            raise RefusedError(404, "this browser has no such training")
        return trainings[request.path_params["name"]]

    async def stop(request: Request) -> JSONResponse:
        await own(request).stop()
        return JSONResponse(own(request).told())

    async def shown(request: Request) -> JSONResponse:
        trainings = request.state.session.trainings.values()
        return JSONResponse({"trainings": [training.told() for training in trainings]})

    return [
        Route("/api/trainings", start, methods=["POST"]),
        Route("/api/trainings", shown, methods=["GET"]),
        Route("/api/trainings/{name}", stop, methods=["DELETE"]),
    ]


def _words(asked: Asked, plants: Mapping[str, str]) -> list[str]:
    """The command, made of checked names and numbers only."""
    objective, updates = word(asked, "objective"), whole(asked, "updates", 1, 100_000)
    if objective not in OBJECTIVES:
        raise RefusedError(400, f"objective: one of {', '.join(OBJECTIVES)} is needed")
    spread = number(asked, "spread", 0, 0.9)
    return [
        "train", plant_of(asked, plants), "--objective", objective,
        "--steps", str(whole(asked, "steps", 10, 5000)), "--spread", f"{spread:g}",
        "--set", f"num_updates={updates}",
    ]  # fmt: skip


def _free(folder: Path, name: str, running: Sequence[Training]) -> Path:
    """A folder for a training: a new one of this name in the run folder."""
    path = folder / name
    if path.exists() or path.is_symlink() or any(path == training.folder for training in running):
        raise RefusedError(409, f"{path.name} exists already; choose another name")
    return path
