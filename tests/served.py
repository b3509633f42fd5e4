"""A bench page as users start it: `excite serve` in a process of its own."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2 as httpx
from commands import PATIENCE

EXPERIMENT = {
    "plant": "aero2",
    "excitation": "chirp",
    "amplitude": 7.2,
    "noise": {},
    "params": {"J_p": 0.025},
    "steps": 500,
    "seed": 3,
    "others": ["prbs", "aero2"],
    "seconds": 5,
}
TMP = Path(tempfile.gettempdir())
MAX_GAP = 0.2
"""Seconds between two parts of a stream."""
TRIES = 10
"""How often a stream is measured until it has no gap; the computer has other tests to run."""


@contextlib.contextmanager
def served(
    runs: Path,
    *options: str,
    ended_by: int = signal.SIGINT,
    code: int = 0,
    scratch: Path = TMP,
    cache: Path | None = None,
) -> Iterator[str]:
    """The address of a page; a signal ends it afterwards, cleanly.

    Args:
        code: its exit code then.
        scratch: the folder of temporary files.
        cache: the folder of compiled programs; without, that of all tests.
    """
    words = [sys.executable, "-m", "excite", "serve", "--port", "0", "--json", *options]
    pipe, own = subprocess.PIPE, {**os.environ, "TMPDIR": str(scratch)}
    if cache is not None:
        own |= dict.fromkeys(("EXCITE_CACHE", "JAX_COMPILATION_CACHE_DIR"), str(cache))
    words += ["--runs", str(runs)]
    with subprocess.Popen(words, stdout=pipe, stderr=pipe, env=own) as process:
        try:
            told = b""
            while not told.endswith(b"}\n") and process.stdout:
                line = process.stdout.readline()
                assert line, process.stderr and process.stderr.read().decode()
                told += line
            yield json.loads(told)["address"].rstrip("/")
            process.send_signal(ended_by)
            out, err = process.communicate(timeout=PATIENCE)
            assert (process.returncode, out, err) == (code, b"", b""), err.decode()
        finally:
            process.kill()


@contextlib.contextmanager
def browser(address: str) -> Iterator[httpx.Client]:
    """A client that has opened the page, and tells where its requests come from."""
    with httpx.Client(base_url=address, headers={"origin": address}, timeout=PATIENCE) as client:
        assert client.get("/").status_code == 200
        assert client.post("/api/session", json={}).json() == {"is_known": True}
        yield client


class Told(list[dict[str, Any]]):
    """Events of a stream; `gap` is the longest silence while its samples came, in seconds."""

    gap = 0.0

    def of(self, kind: str) -> list[dict[str, Any]]:
        """The events of a kind."""
        return [event for event in self if event["kind"] == kind]


def streamed(client: httpx.Client, address: str, asked: dict[str, Any]) -> Told:
    """All events of a stream."""
    told, last = Told(), 0.0
    with client.stream("POST", address, json=asked) as answer:
        assert answer.status_code == 200, answer.read()
        for line in answer.iter_lines():
            event, now = json.loads(line), time.perf_counter()
            if event["kind"] == "samples":
                told.gap = max(told.gap, now - last if told.of("samples") else 0.0)
                last = now
            told.append(event)
    return told
