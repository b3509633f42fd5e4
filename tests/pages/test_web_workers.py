"""The processes behind the bench page, when they misbehave."""

import asyncio
import os
import queue
import sys
from contextlib import aclosing
from pathlib import Path
from typing import Any

import pytest
from commands import PATIENCE

from excite.study import pool as processes
from excite.study.worker import Message, Result, Started
from excite.web import workers as module
from excite.web.jobs import columns
from excite.web.requests import RefusedError, without_folders
from excite.web.workers import Workers

HEADER = f"""#!{sys.executable}
import json, sys
print(json.dumps({{"kind": "ready"}}), flush=True)
for line in sys.stdin:
    call = json.loads(line)
    number, target = call["number"], call["target"].partition(":")[2]
    good = json.dumps({{"kind": "end", "number": number}})
"""
ANSWERS = {
    "too long": 'print("x" * 200_000 + "\\n" + good if target == "bad" else good, flush=True)',
    "no JSON": 'print("hello\\n" + good if target == "bad" else good, flush=True)',
    "no event": 'print("[1]\\n" + good if target == "bad" else good, flush=True)',
    "nobody's": 'print(good.replace("number", "x") if target == "bad" else good, flush=True)',
    "another's": 'print(good.replace(": ", ": 9") if target == "bad" else good, flush=True)',
}  # fmt: skip


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What is started in place of Python."""
    path = tmp_path / "python"
    monkeypatch.setattr("sys.executable", str(path))
    monkeypatch.setattr(processes, "_LINE", 2**16)
    return path


def write(program: Path, text: str) -> None:
    program.write_text(text)
    program.chmod(0o700)


async def told(workers: Workers, target: Any) -> list[Any]:
    async with aclosing(workers.events(target, {})) as events:
        return [event async for event in events]


def answers(*targets: str) -> list[list[Any]]:
    """What one worker says to calls, one after the other."""

    async def ask() -> list[list[Any]]:
        workers = Workers(1, None)
        await workers.open()
        try:
            async with asyncio.timeout(PATIENCE):
                return [await told(workers, target) for target in targets]
        finally:
            await workers.close()

    return asyncio.run(ask())


@pytest.mark.parametrize("kind", ANSWERS)
def test_a_worker_that_answers_oddly_is_replaced_and_nobody_waits(kind: str, program: Path):
    write(program, HEADER + "    " + ANSWERS[kind] + "\n")
    bad, *good = answers("bad", "good", "good")
    assert [event["kind"] for event in bad] == ["started", "failed"]
    assert "invalid worker response" in bad[-1]["sentence"]
    assert good == 2 * [[{"kind": "started"}, {"kind": "end"}]]


def test_a_call_that_is_over_is_not_stopped(program: Path):
    """The program ends at a message that is not a call."""
    write(program, HEADER + "    print(good, flush=True)\n")
    pool, said = processes.Pool(1), queue.SimpleQueue[Message]()
    calls = queue.SimpleQueue[processes.Call]()

    def tell(message: Message) -> None:
        if isinstance(message, Result):
            pool.withdraw(calls.get())
        said.put(message)

    pool.open()
    try:
        for _ in range(2):
            calls.put(pool.submit("good", {}, tell))
            assert said.get(timeout=PATIENCE) == Started()
            assert said.get(timeout=PATIENCE) == Result()
    finally:
        pool.close()


def test_what_comes_after_the_end_is_refused(program: Path):
    write(program, HEADER)

    async def late() -> None:
        workers = Workers(1, None)
        await workers.open()
        await workers.close()
        async with asyncio.timeout(PATIENCE):
            await told(workers, "good")

    with pytest.raises(RefusedError, match="the server has ended"):
        asyncio.run(late())


def test_what_was_given_up_takes_no_place_in_the_queue(program: Path):
    """Or one browser could shut the others out, with a worker that is busy."""
    write(program, HEADER + "    if target != 'busy': print(good, flush=True)\n")

    async def kinds() -> list[str]:
        workers = Workers(1, None)
        await workers.open()
        job: Any = "busy"
        busy = workers.events(job, {})
        try:
            assert await anext(busy) == {"kind": "started"}
            for _ in range(2 * module.MAX_WAITING):
                waits = asyncio.create_task(told(workers, "good"))
                await asyncio.sleep(0)
                waits.cancel()
                await asyncio.gather(waits, return_exceptions=True)
            last = asyncio.create_task(told(workers, "good"))
            await asyncio.sleep(0)
            await busy.aclose()
            async with asyncio.timeout(PATIENCE):
                return [event["kind"] for event in await last]
        finally:
            await workers.close()

    assert asyncio.run(kinds()) == ["started", "end"]


@pytest.mark.parametrize(
    "text",
    [
        None,
        f"#!{sys.executable}\nraise SystemExit(1)\n",
        f"#!{sys.executable}\nprint('x' * 200_000)\n",
        f'#!{sys.executable}\nprint(\'{{"kind": "failed"}}\', flush=True)\ninput()\n',
    ],
    ids=["none", "ends", "long", "failed"],
)
def test_workers_that_do_not_start_are_said_to(text: str | None, program: Path):
    if text is not None:
        write(program, text)
    for events in answers("catalogue", "episode", "episode"):
        assert events[-1]["kind"] == "failed"
        assert "do not start" in events[-1]["sentence"]


def test_workers_that_do_not_start_are_tried_only_so_often(program: Path, tmp_path: Path):
    write(program, f"#!/bin/sh\necho x >> {tmp_path}/starts\nexit 1\n")
    answers("catalogue", "catalogue")
    assert len((tmp_path / "starts").read_text().split()) == processes.MAX_FAILURES


@pytest.mark.parametrize(
    ("gib", "num_workers", "limit"), [(64, 2, 6), (16, 2, 4), (16, 4, 2), (4, 4, 2)]
)
def test_a_worker_takes_its_part_of_half_of_the_memory(
    gib: int, num_workers: int, limit: int, monkeypatch: pytest.MonkeyPatch
):
    sizes = {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": gib * 2**18}
    monkeypatch.setattr("os.sysconf", sizes.get)
    assert module._memory(num_workers) == limit * 2**30


@pytest.mark.parametrize(
    ("sentence", "shown"),
    [
        ("/tmp/excite-bench-a1/b2/run: no such folder", "run: no such folder"),
        ("[Errno 2] No such file: '/tmp/x/y.json'", "[Errno 2] No such file: 'y.json'"),
        ("the rate is 3 rad/s, not 1/2/3 of it", "the rate is 3 rad/s, not 1/2/3 of it"),
        ("a.csv: see https://example.org/a/b", "a.csv: see https://example.org/a/b"),
    ],
)
def test_sentences_name_files_and_not_their_folders(sentence: str, shown: str):
    assert without_folders(sentence) == shown


@pytest.mark.parametrize("header", ["\x01" * 201, ",".join(f"c{i}" for i in range(501))])
def test_a_file_of_very_many_or_very_long_names_is_refused(header: str, tmp_path: Path):
    (tmp_path / "a.csv").write_text(f"time,{header}\n0{',1' * (1 + header.count(','))}\n")
    with pytest.raises(ValueError, match="at most 500 columns of 200 characters"):
        list(columns(os.fspath(tmp_path), "a.csv"))
