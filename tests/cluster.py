"""A Dask cluster on this computer, to be killed piece by piece."""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from commands import PATIENCE


def wait_for(condition: Callable[[], Any], seconds: float = 10.0) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.02)
    return bool(condition())


class Cluster:
    """A scheduler and its workers on this computer, each to be killed."""

    def __init__(self, folder: Path, num_workers: int = 3) -> None:
        self.processes: list[subprocess.Popen] = []
        file = folder / "scheduler.json"
        self.here = ("--no-dashboard", "--host", "127.0.0.1", "--scheduler-file", str(file))
        self.start("scheduler", *self.here, "--port", "0")
        for _ in range(num_workers):
            self.start_worker()

        def address() -> str:
            # The scheduler opens its file before it fills it.
            written = file.read_text() if file.exists() else ""
            return json.loads(written)["address"] if written.endswith("}") else ""

        if not wait_for(address, PATIENCE):
            self.close()
            pytest.fail("the scheduler does not start")
        self.address = address()

    def start_worker(self) -> None:
        options = ("--no-nanny", "--nthreads", "1", "--local-directory", self.here[-1] + ".d")
        self.start("worker", *self.here, *options)

    def start(self, name: str, *options: str) -> None:
        """Dask's own command; it tells a lot that nobody asks for."""
        command = [sys.executable, "-m", f"distributed.cli.dask_{name}", *options]
        silent = subprocess.DEVNULL
        self.processes.append(subprocess.Popen(command, stdout=silent, stderr=silent))

    def kill(self, which: int) -> None:
        self.processes[which].kill()
        self.processes[which].wait()

    def close(self) -> None:
        for which in range(len(self.processes)):
            self.kill(which)
