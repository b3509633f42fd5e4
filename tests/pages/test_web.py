"""The server of the bench page: its numbers, its limits, and who may ask for what."""

import asyncio
import contextlib
import csv
import io
import json
import math
import os
import pickle
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import httpx2 as httpx
import numpy as np
import pandas
import pytest
import scipy.io
from bags import write
from cluster import wait_for
from commands import PATIENCE, excite
from served import EXPERIMENT, MAX_GAP, TRIES, Told, browser, served, streamed
from starlette.requests import Request
from starlette.testclient import TestClient

import excite as ex
from excite import web
from excite.files import locked_folder, write_json
from excite.plant import Aero2
from excite.record import READ_ENDINGS
from excite.record.bags import BAG_ENDINGS
from excite.report.html import report_html
from excite.study.objectives import OBJECTIVES
from excite.web import _Server, application, connections, listening_at, requests
from excite.web.first import FILE, events
from excite.web.jobs import _noted
from excite.web.places import _file_name, _receive
from excite.web.requests import MAX_UPLOAD, RefusedError
from excite.web.runs import found
from excite.web.security import MAX_TRIES, _source
from excite.web.sessions import MAX_JOBS, MAX_SESSIONS, PageSettings, Place, Session, Sessions
from excite.web.trainings import Training, TrainingStatus, _free

HERE = "http://127.0.0.1:8000"
TRAINING = {
    "plant": "aero2", "name": "mine", "objective": "D", "updates": 1, "steps": 60, "spread": 0.3,
}  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with one run, a secret beside it, and links to the secret."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "secret.json").write_text('{"secret": 1}')
    run = folder / "runs" / "some" / "study"
    run.mkdir(parents=True)
    write_json(run / "run.json", {"kind": "excite study", "plant": {"name": "aero2"}})
    (run / "table.md").write_text("| method | <b>x</b> |\n| --- | --- |\n| chirp | 1 |\n\nnote\n")
    (run / "program.py").write_text("raise SystemExit\n")
    (run / "link.json").symlink_to(folder / "secret.json")
    (folder / "runs" / "elsewhere").symlink_to(folder, target_is_directory=True)
    return folder / "runs"


@pytest.fixture(scope="module")
def temporary(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the server keeps what it keeps for browsers."""
    return tmp_path_factory.mktemp("scratch")


@pytest.fixture(scope="module")
def address(runs: Path, temporary: Path) -> Iterator[str]:
    with served(runs, "--workers", "2", scratch=temporary) as where:
        yield where


@pytest.fixture
def client(address: str) -> Iterator[httpx.Client]:
    with browser(address) as opened:
        yield opened


@pytest.fixture(scope="module")
def told(address: str) -> Told:
    """One experiment; the first of a server also waits for what is compiled."""
    with browser(address) as opened:
        streamed(opened, "/api/experiments", {**EXPERIMENT, "seconds": 0})
        events = streamed(opened, "/api/experiments", EXPERIMENT)
        for _ in range(TRIES):
            if events.gap >= MAX_GAP:
                events = streamed(opened, "/api/experiments", EXPERIMENT)
        result = events.of("result")[0]["result"]
        for name in ("record.csv", "record.json"):
            events.append({"kind": name, "text": opened.get(f"/api/results/{result}/{name}").text})
    return events


def printed(*words: str, folder: Path) -> dict[str, Any]:
    """What a command prints as JSON."""
    done = excite(*words, "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


# -------------------------------------------------------------------------------- numbers


@contextlib.contextmanager
def in_this_process(listening: socket.socket, folder: Path) -> Iterator[None]:
    """A page without workers, served by a thread of this process."""
    ended, app = list[int](), application(PageSettings(folder, num_workers=0), folder)
    thread = threading.Thread(target=_Server(app, ended).run, args=([listening],))
    thread.start()
    try:
        yield
    finally:
        ended.append(signal.SIGINT)
        thread.join()


def test_connections_that_ask_nothing_hold_nobody_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """More than are kept, with unfinished heads; the oldest are closed, and the page answers."""
    monkeypatch.setattr(connections, "PATIENCE", PATIENCE)
    monkeypatch.setattr(connections, "MAX_SILENT", 20)
    listening, opened = listening_at("127.0.0.1", 0), list[socket.socket]()
    where = listening.getsockname()
    with in_this_process(listening, tmp_path), contextlib.ExitStack() as stack:
        for _ in range(50):
            opened.append(stack.enter_context(socket.create_connection(where, PATIENCE)))
            opened[-1].sendall(b"GET / HTTP/1.1\r\nHost: ")
        answer = httpx.get(f"http://127.0.0.1:{where[1]}/", timeout=PATIENCE)
        assert answer.status_code == 200
        for one in opened[:30]:
            with contextlib.suppress(ConnectionResetError):
                assert one.recv(1) == b""
        opened[-1].setblocking(False)
        with pytest.raises(BlockingIOError):  # the newest is still open
            opened[-1].recv(1)


@pytest.mark.parametrize("sent", [b"", b"GET / HT"])
def test_a_request_that_does_not_come_is_not_awaited(
    sent: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(connections, "PATIENCE", 0.4)
    listening = listening_at("127.0.0.1", 0)
    with socket.create_connection(listening.getsockname(), PATIENCE) as one:
        one.sendall(sent)
        with in_this_process(listening, tmp_path):
            assert one.recv(1) == b""


@pytest.mark.parametrize(
    ("origin", "status", "sentence"),
    [("http://{}:{}", 408, "the upload stopped"), ("http://foreign.example", 403, "not come from")],
)
def test_a_body_that_stops_is_refused_and_its_connection_is_closed(
    origin: str, status: int, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """In a sentence; also where the answer does not wait for the body, and more of it comes."""
    monkeypatch.setattr(connections, "PATIENCE", 1.0)
    monkeypatch.setattr(requests, "SILENCE", 3.0)
    listening = listening_at("127.0.0.1", 0)
    where = listening.getsockname()
    head = f"Host: {where[0]}:{where[1]}\r\nOrigin: {origin.format(*where)}\r\n"
    with socket.create_connection(where, PATIENCE) as one:
        one.sendall(f"POST /api/session HTTP/1.1\r\n{head}Content-Length: 9\r\n\r\n{{".encode())
        with in_this_process(listening, tmp_path):
            answer = one.recv(2**16)
            with contextlib.suppress(ConnectionError):
                one.sendall(b" ")
                while more := one.recv(2**16):
                    answer += more
    assert answer.startswith(f"HTTP/1.1 {status} ".encode())
    assert sentence in json.loads(answer.partition(b"\r\n\r\n")[2])["sentence"]


def test_what_the_page_shows_first_is_what_its_workers_compute():
    kept, now = json.loads(FILE.read_text()), events()
    assert [event["kind"] for event in kept] == [event["kind"] for event in now]
    assert [event["kind"] for event in kept].count("other") == 2
    for before, after in zip(kept, now, strict=True):
        if after["kind"] == "samples":
            np.testing.assert_allclose(before["time"], after["time"])
        if "traces" not in after:
            continue
        assert before["row"]["is_violation"] == after["row"]["is_violation"]
        for name in ("inputs", "outputs", "log_det"):  # None becomes NaN
            old, new = (np.array(e["traces"][name], float) for e in (before, after))
            if name == "log_det":  # below, the information is singular but for rounding
                old, new = (np.where(x > -35, x, np.nan) for x in (old, new))
            np.testing.assert_allclose(old, new, rtol=1e-3, atol=1e-6)
        for old, new in zip(before.get("estimates", []), after.get("estimates", []), strict=True):
            assert old["k"] == new["k"]
            assert old["bound"] == pytest.approx(new["bound"], rel=1e-3, nan_ok=True)


def test_traces_are_the_experiment_and_its_information(told: Told):
    result = told.of("result")[0]
    record = ex.simulate(
        "aero2", "chirp", options={"amplitude": 7.2}, params={"J_p": 0.025}, seed=3
    )
    np.testing.assert_allclose(result["traces"]["inputs"], record.inputs[:-1], rtol=1e-12)
    assert result["traces"]["log_det"][-1] == result["row"]["log_det_information"]
    assert result["traces"]["log_det"][0] is None  # one sample does not tell three parameters
    for name, p in result["row"]["params"].items():
        last = result["traces"]["bound_percent"][name][-1]
        assert last == pytest.approx(p["cramer_rao_percent"], rel=1e-12)
    assert [len(event["traces"]["outputs"]) for event in told.of("other")] == [501, 501]


def test_numbers_are_those_of_the_command_line(told: Told, tmp_path: Path):
    chosen = ["--params", "J_p=0.025"]
    words = ["simulate", "aero2", "--excitation", "chirp", "--set", "amplitude=7.2", *chosen]
    simulated = printed(*words, "--seed", "3", "--out", "record.csv", folder=tmp_path)
    assert told.of("record.csv")[0]["text"] == (tmp_path / "record.csv").read_text()
    assert told.of("record.json")[0]["text"] == (tmp_path / "record.json").read_text()
    result = told.of("result")[0]
    identified = printed("identify", "record.csv", "--plant", "aero2", folder=tmp_path)
    assert result["identification"] == identified
    bound = printed("information", "aero2", "record.csv", *chosen, folder=tmp_path)
    assert result["row"]["max_abs_output"] == pytest.approx(simulated["max_abs_output"])
    assert result["row"]["is_violation"] == simulated["is_violation"]
    assert result["row"]["log_det_information"] == pytest.approx(bound["log_det_information"])
    for name, p in result["row"]["params"].items():
        assert p["cramer_rao_bound"] == pytest.approx(bound["params"][name]["cramer_rao_bound"])
        assert p["estimate"] == identified["params"][name]["estimate"]


def test_samples_on_the_way_are_those_of_the_record(told: Told):
    rows = list(csv.DictReader(told.of("record.csv")[0]["text"].splitlines()))
    for key, column in (("time", "time"), ("outputs", "pitch"), ("inputs", "voltage")):
        parts = [value for event in told.of("samples") for value in event[key]]
        values = [part[0] if isinstance(part, list) else part for part in parts]
        assert values == [float(row[column]) for row in rows][: len(values)]
        assert len(values) == 500 + (key != "inputs")


def test_the_running_estimate_ends_where_the_identification_does(told: Told):
    estimates, result = told.of("estimate"), told.of("result")[0]
    assert [e["k"] for e in estimates] == sorted(e["k"] for e in estimates)
    for name, p in result["identification"]["params"].items():
        assert estimates[-1]["estimate"][name] == pytest.approx(p["estimate"], rel=1e-9)
        least = 1.959964 * result["row"]["params"][name]["cramer_rao_bound"]
        assert estimates[-1]["bound"][name] == pytest.approx(least)
        bounds = [e["bound"][name] for e in estimates]
        assert bounds == sorted(bounds, reverse=True)
        assert estimates[-1]["half"][name] < estimates[0]["half"][name] / 10


def test_an_estimate_is_not_told_before_its_sample(told: Told):
    seen = 0
    for event in told:
        seen += len(event["time"]) if event["kind"] == "samples" else 0
        assert event["kind"] != "estimate" or event["k"] < seen


def test_two_others_are_compared_on_the_same_plant(told: Told):
    others = [event["row"] for event in told.of("other")]
    assert [row["excitation"] for row in others] == ["prbs", "aero2"]
    assert all(row["params"]["J_p"]["true"] == 0.025 for row in others)
    for event in told.of("other"):  # their estimates over time end where they do
        assert [e["k"] for e in event["estimates"]] == [e["k"] for e in told.of("estimate")]
        last = event["estimates"][-1]
        for name, p in event["row"]["params"].items():
            assert last["estimate"][name] == pytest.approx(p["estimate"], rel=1e-9)
            assert last["bound"][name] == pytest.approx(1.959964 * p["cramer_rao_bound"])


def test_another_excitation_that_does_not_fit_is_left_out(client, told: Told):
    """The policy was made for 500 samples; the experiment asked for stands without it."""
    del told
    asked = {**EXPERIMENT, "steps": 600, "others": ["aero2"], "seconds": 0}
    events = streamed(client, "/api/experiments", asked)
    [left] = events.of("left_out")
    assert (left["excitation"], events[-1]["kind"]) == ("aero2", "end")
    assert "made for 500 steps" in left["sentence"]


def test_a_stream_has_no_gaps(told: Told):
    assert told.gap < MAX_GAP


def test_an_uploaded_file_is_identified_as_at_the_command_line(client, told: Told, temporary: Path):
    text = told.of("record.csv")[0]["text"].replace("pitch", "theta")
    uploaded = client.post("/api/uploads?name=my log.csv", content=text).json()
    assert uploaded["files"][0]["columns"] == {"time": 501, "voltage": 501, "theta": 501}
    asked = {"upload": uploaded["upload"], "plant": "aero2", "estimator": "nls"}
    asked |= {"columns": {"pitch": "theta"}, "scales": {}, "initial_state": "known"}
    [event] = streamed(client, "/api/identifications", asked).of("identified")
    own = told.of("result")[0]["identification"]
    assert event["identification"]["params"] == own["params"]
    assert event["identification"]["files"] == ["my log.csv"]
    report = client.get(f"/api/results/{event['result']}/report.html")
    assert "attachment" in report.headers["content-disposition"]
    estimate = client.get(f"/api/results/{event['result']}/estimate.json").content
    files = temporary.glob("*/*/*/run/estimate.json")
    [run] = [file.parent for file in files if file.read_bytes() == estimate]
    assert report.text == report_html([run])


@pytest.mark.parametrize("column", ["pitch, rad=1", "it's [x,y] $HOME"])
def test_the_command_of_an_upload_does_the_same(
    column: str, client, told: Told, temporary: Path, tmp_path: Path
):
    text = io.StringIO()
    rows = list(csv.reader(told.of("record.csv")[0]["text"].splitlines()))
    csv.writer(text, lineterminator="\n").writerows([["time", "voltage", column], *rows[1:]])
    name = "-it's $HOME [1] ü.CSV"
    uploaded = client.post(f"/api/uploads?name={name}", content=text.getvalue()).json()
    asked = {"upload": uploaded["upload"], "plant": "aero2", "estimator": "nls"}
    asked |= {"columns": {"pitch": column}, "scales": {"pitch": 1}, "initial_state": "known"}
    asked |= {"hold": {"J_p": 0.0215}, "priors": {"D_p": "lognormal:0.007:5%"}}
    [event] = streamed(client, "/api/identifications", asked).of("identified")
    run = max(temporary.glob("*/*/*/run"), key=lambda path: path.stat().st_mtime)
    (tmp_path / name).write_text(text.getvalue())
    words = shlex.split(json.loads((run / "run.json").read_text())["command"])
    assert words[:3] == ["excite", "identify", f"./{name}"]
    assert printed(*words[1:], folder=tmp_path)["params"] == event["identification"]["params"]


def test_an_uploaded_mat_file_is_identified(client, told: Told, tmp_path: Path):
    rows = list(csv.DictReader(told.of("record.csv")[0]["text"].splitlines()))
    path = tmp_path / "log.mat"
    table = {name: [float(row[name]) for row in rows] for name in rows[0]}
    scipy.io.savemat(path, {**table, "notes": "text"}, do_compression=True)
    uploaded = client.post("/api/uploads?name=log.mat", content=path.read_bytes()).json()
    assert uploaded["files"][0]["columns"] == dict.fromkeys(("time", "voltage", "pitch"), 501)
    asked = {"upload": uploaded["upload"], "plant": "aero2", "estimator": "nls"}
    asked |= {"columns": {}, "scales": {}, "initial_state": "known"}
    [event] = streamed(client, "/api/identifications", asked).of("identified")
    own = told.of("result")[0]["identification"]
    assert event["identification"]["params"] == own["params"]


@pytest.mark.parametrize("ending", READ_ENDINGS)
def test_the_page_takes_every_file_that_is_read(ending: str, client, told: Told, tmp_path: Path):
    del told
    table, path = {"t": [0.0, 0.5], "a b": [1.0, 2.0]}, tmp_path / f"log{ending}"
    if ending == ".mat":
        scipy.io.savemat(path, {"t": table["t"], "a": table["a b"]})
    elif ending in (".h5", ".hdf5"):
        with h5py.File(path, "w") as file:
            file.update(table)
    elif ending == ".parquet":
        pandas.DataFrame(table).to_parquet(path)
    elif ending in BAG_ENDINGS:
        rows = [(t, None, {"data": value}) for t, value in zip(*table.values(), strict=True)]
        path = write("json" if ending == ".mcap" else "db3", tmp_path, {"/force": rows})
    else:
        path.write_text("# t;a b\n0,0;1,0\n0,5;2,0\n")
    content = path.read_bytes()
    answer = client.post(f"/api/uploads?name={path.name}", content=content).json()
    names = ("time", "/force.data") if ending in BAG_ENDINGS else ("t", "a b")
    names = names if ending != ".mat" else ("t", "a")
    assert answer["files"][0]["columns"] == dict.fromkeys(names, 2)
    assert ending in client.get("/").text.partition('accept="')[2].partition('"')[0].split(",")


def test_an_initial_state_that_does_not_exist_is_refused(client, told: Told):
    text = told.of("record.csv")[0]["text"]
    uploaded = client.post("/api/uploads?name=a.csv", content=text).json()
    asked = {"upload": uploaded["upload"], "plant": "aero2", "estimator": "nls"}
    asked |= {"columns": {}, "scales": {}, "initial_state": "maybe"}
    [failed] = streamed(client, "/api/identifications", asked).of("failed")
    assert "known, free, auto" in failed["sentence"]


def test_a_mat_file_that_unpacks_to_very_much_is_refused(client, told: Told, tmp_path: Path):
    del told
    bomb = {"time": np.zeros(150_000_000, np.uint8)}
    scipy.io.savemat(tmp_path / "a.mat", bomb, do_compression=True)
    content = (tmp_path / "a.mat").read_bytes()
    answer = client.post("/api/uploads?name=a.mat", content=content)
    assert answer.status_code == 422
    assert "unpacked" in answer.json()["sentence"]


def test_ten_clients_at_once(address: str, told: Told):
    """Every one of them gets a stream without gaps, and its result."""
    del told  # the server is warm

    async def one(opened: httpx.AsyncClient, seed: int) -> tuple[float, float, set[str]]:
        gap, start, last, first, kinds = 0.0, time.perf_counter(), 0.0, 0.0, set[str]()
        asked = {**EXPERIMENT, "seed": seed, "others": []}
        async with opened.stream("POST", "/api/experiments", json=asked) as answer:
            async for line in answer.aiter_lines():
                now, kind = time.perf_counter(), json.loads(line)["kind"]
                if kind == "samples":
                    gap, first = max(gap, now - last if first else 0), first or now - start
                    last = now
                kinds.add(kind)
        return gap, first, kinds

    async def all_of_them() -> list[tuple[float, float, set[str]]]:
        clients = [
            httpx.AsyncClient(base_url=address, headers={"origin": address}, timeout=PATIENCE)
            for _ in range(10)
        ]
        try:
            await asyncio.gather(*(c.post("/api/session", json={}) for c in clients))
            return await asyncio.gather(*(one(c, seed) for seed, c in enumerate(clients)))
        finally:
            await asyncio.gather(*(c.aclose() for c in clients))

    seen = asyncio.run(all_of_them())
    for _ in range(TRIES):
        if max(gap for gap, _, _ in seen) >= MAX_GAP:
            seen = asyncio.run(all_of_them())
    assert all(kinds >= {"samples", "estimate", "result", "end"} for _, _, kinds in seen)
    firsts = [first for _, first, _ in seen]
    assert max(firsts) < max(30, 10 * min(firsts))  # seconds; nobody is forgotten in the queue
    assert max(gap for gap, _, _ in seen) < MAX_GAP


# --------------------------------------------------------------------------------- stopping


def processes_of(address: str) -> set[int]:
    """Workers of the server that listens at this address."""
    port = int(address.rpartition(":")[2])
    found = set()
    for place in Path("/proc").glob("[0-9]*"):
        try:
            words = (place / "cmdline").read_bytes().split(b"\0")
            parent = int((place / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        if b"excite.study.worker" in words and listens(parent, port):
            found.add(int(place.name))
    return found


def is_at_work(process: int) -> bool:
    """Whether a process uses the processor for most of a second."""

    def used() -> float:
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    try:
        before = used()
        time.sleep(1)
        return used() - before > 0.5
    except OSError:
        return False


def listens(process: int, port: int) -> bool:
    """Whether a process has the socket of a port."""
    inodes = {
        line.split()[9]
        for line in Path("/proc/net/tcp").read_text().splitlines()[1:]
        if line.split()[1].endswith(f":{port:04X}") and line.split()[3] == "0A"
    }
    try:
        links = {os.readlink(link) for link in Path(f"/proc/{process}/fd").iterdir()}
    except OSError:
        return False
    return any(f"socket:[{inode}]" in links for inode in inodes)


def test_what_is_stopped_ends_and_its_worker_is_free(tmp_path: Path):
    with contextlib.ExitStack() as opened:
        # No compiled program is on disk, so that it is stopped while it compiles.
        where = served(tmp_path, "--workers", "2", cache=tmp_path / "cache")
        address = opened.enter_context(where)
        stopped_while_it_compiles(address, opened.enter_context(browser(address)))


def stopped_while_it_compiles(address: str, client: httpx.Client) -> None:
    before = processes_of(address)
    assert len(before) == 2
    long = {**EXPERIMENT, "plant": "cart_pole", "params": {}, "steps": 2000, "others": []}
    long |= {"amplitude": 1.0, "seconds": 60}
    kinds, job = [], ""
    with client.stream("POST", "/api/experiments", json=long) as answer:
        for line in answer.iter_lines():
            event = json.loads(line)
            kinds.append(event["kind"])
            job = event.get("job", job)
            if event["kind"] == "started":  # a plant and a length that are not compiled yet
                assert client.delete(f"/api/jobs/{job}").status_code == 200
    assert kinds[-1] == "stopped"
    assert "samples" not in kinds, "it was stopped after the compilation only"
    # It stopped by itself within the time that it has, or its process was replaced.
    assert wait_for(lambda: not any(map(is_at_work, before)), PATIENCE), "its worker goes on"
    assert wait_for(lambda: len(processes_of(address)) == 2, PATIENCE)
    again = client.post("/api/uploads?name=a.csv", content="time,x\n0,1\n1,2\n")
    assert again.status_code == 200


def test_a_browser_that_leaves_takes_its_work_along(address: str, told: Told):
    del told
    with browser(address) as other:

        def is_begun() -> bool:
            with other.stream("POST", "/api/experiments", json=EXPERIMENT) as answer:
                assert answer.status_code in (200, 429)  # it may not know yet who has left
                line = next(answer.iter_lines())
                return answer.status_code == 200 and json.loads(line)["kind"] == "job"

        for _ in range(MAX_JOBS + 1):  # more than it may have under way
            assert wait_for(is_begun, PATIENCE)


def trainings_in(folder: Path) -> set[int]:
    """Processes of `excite train` into this folder, with those that they have started."""
    found = set()
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if f"--out\0{folder}".encode() in (place / "cmdline").read_bytes():
                found.add(int(place.name))
    return found


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 0),
        (signal.SIGTERM, 143),
        (signal.SIGHUP, 129),
        (signal.SIGKILL, -9),
    ],
)
def test_nothing_outlives_the_server(number: int, code: int, tmp_path: Path):
    """Neither a training, nor a worker, nor what was uploaded."""
    runs, scratch = tmp_path / "runs", tmp_path / "scratch"
    runs.mkdir()
    scratch.mkdir()
    asked = {**TRAINING, "updates": 100_000}
    with served(runs, "--workers", "1", ended_by=number, code=code, scratch=scratch) as where:
        with browser(where) as opened:
            assert opened.post("/api/uploads?name=a.csv", content="time,x\n0,1\n1,2\n").is_success
            assert opened.post("/api/trainings", json=asked).is_success
            assert list(scratch.glob("excite-bench-*/**/a.csv"))
        workers = processes_of(where)
        assert workers
        deadline = time.monotonic() + PATIENCE
        while not trainings_in(runs) and time.monotonic() < deadline:
            time.sleep(0.01)  # while one program takes the other's place it has no words
        assert trainings_in(runs)
    assert number == signal.SIGKILL or not list(scratch.glob("excite-bench-*"))
    deadline = time.monotonic() + PATIENCE
    while trainings_in(runs) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not trainings_in(runs)
    assert not [pid for pid in workers if is_running(pid)]


def test_an_experiment_that_is_played_ends_with_the_server(tmp_path: Path):
    """In a sentence, and without a word in the terminal; `served` sees to that."""
    with contextlib.ExitStack() as opened:
        with served(tmp_path, "--workers", "1") as where:
            client = opened.enter_context(browser(where))
            long = {**EXPERIMENT, "others": [], "seconds": 60}
            answer = opened.enter_context(client.stream("POST", "/api/experiments", json=long))
            lines = answer.iter_lines()
            while json.loads(next(lines))["kind"] != "samples":
                pass
        last = json.loads(list(lines)[-1])
    assert last == {"kind": "failed", "sentence": "the server has ended"}


SLOW = """
import pathlib, signal, sys, time
here = pathlib.Path(__file__).parent
if "train" in sys.orig_argv:
    def end(*_):
        (here / "ending").touch()
        time.sleep(3)
        sys.exit(130)
    signal.signal(signal.SIGINT, end)
    (here / "listening").touch()
    time.sleep(60)
"""


def test_a_training_that_ends_slowly_ends_with_the_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """And whoever stopped it gets an answer; `served` sees that the terminal stays silent."""
    (tmp_path / "sitecustomize.py").write_text(SLOW)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    answers = []
    with contextlib.ExitStack() as opened:
        with served(tmp_path, "--workers", "1") as where:
            client = opened.enter_context(browser(where))
            begun = client.post("/api/trainings", json=TRAINING).json()
            assert wait_for((tmp_path / "listening").exists, PATIENCE)
            place = f"/api/trainings/{begun['name']}"
            stopping = threading.Thread(target=lambda: answers.append(client.delete(place)))
            stopping.start()
            assert wait_for((tmp_path / "ending").exists, PATIENCE)
        stopping.join()
    assert answers[0].json()["state"] == "stopped"


def is_running(process: int) -> bool:
    try:
        return "excite.study.worker" in Path(f"/proc/{process}/cmdline").read_text()
    except OSError:
        return False


@pytest.mark.parametrize(
    ("values", "note"),
    [
        ([0.0, 0.1, 0.2, 0.5, 0.6], "steps of 0.1, gaps: 1, the longest 0.3"),
        ([0.0, 1.0, 2.0, 3.0], "steps of 1, no gaps"),
        ([2.0, 2.0, 2.0], "constant"),
        ([1.0, math.nan, 1.0, 0.5], "1 missing"),
        ([*np.minimum(np.arange(20.0), 15), 0.5], "24 % at its largest value: saturated?"),
        ([0.0, 1.0, 1.0, 1.0, 0.0, 1.0], ""),  # a signal of two levels
        ([], ""),
    ],
)
def test_what_a_column_shows_is_told(values: list[float], note: str):
    assert _noted(np.array(values)) == note


# ------------------------------------------------------------------------------ bad files


BAD_FILES = {
    "pickle.mat": (pickle.dumps({"time": os.system}), "not a readable MAT file"),
    "noise.mat": (bytes(range(256)) * 40, "not a readable MAT file"),
    "empty.csv": (b"", "empty"),
    "binary.csv": (b"\x00\xff\xfe" * 30, "cannot be read as CSV text"),
    "cut.csv": (b"time,pitch\n0,1\n1,", "does not end with a line break"),
    "ragged.csv": (b"time,pitch\n0,1\n1,2,3\n", "is the file truncated?"),
    "program.py": (b"raise SystemExit\n", ".mcap or .db3"),
    "policy.safetensors": (b"{}", ".mcap or .db3"),
    "archive.csv.gz": (b"\x1f\x8b", ".mcap or .db3"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_one_sentence_and_nothing_is_run(name: str, client, told: Told):
    del told
    content, sentence = BAD_FILES[name]
    answer = client.post(f"/api/uploads?name={name}", content=content)
    assert answer.status_code in (400, 415, 422)
    assert sentence in answer.json()["sentence"]
    assert "/tmp" not in answer.text


@pytest.mark.parametrize("header", [26 * 2**20 * "\x01", 13 * 2**20 * "\x01,"])
def test_a_file_of_names_alone_leaves_the_others_alone(header: str, client, told: Told):
    """As JSON it is six times longer, more than a worker may say at once."""
    del told
    answer = client.post("/api/uploads?name=a.csv", content=f"{header}\n".encode())
    assert answer.status_code == 422
    assert len(answer.json()["sentence"]) < 1100
    for _ in range(3):  # one worker and the other
        again = client.post("/api/uploads?name=a.csv", content="time,x\n0,1\n1,2\n")
        assert again.json()["files"][0]["columns"] == {"time": 2, "x": 2}


def test_a_script_in_a_column_stays_text(client, told: Told):
    del told
    script = "<script>alert(1)</script>"
    text = f"time,{script},pitch\n0,1,2\n1,2,3\n"
    answer = client.post(f"/api/uploads?name=../../{script}.csv", content=text)
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert script in answer.json()["files"][0]["columns"]
    assert answer.json()["files"][0]["file"] == f".._.._{script.replace('/', '_')}.csv"
    assert "/" not in answer.json()["files"][0]["file"]


# ------------------------------------------- who may ask for what, on a server without workers


@pytest.fixture
def scratch(tmp_path: Path) -> Path:
    return tmp_path


def guarded(runs: Path, scratch: Path, **settings: Any) -> TestClient:
    app = application(PageSettings(runs, num_workers=0, **settings), scratch)
    return TestClient(app, base_url=HERE, headers={"origin": HERE})


@pytest.fixture
def page(runs: Path, scratch: Path) -> TestClient:
    opened = guarded(runs, scratch)
    assert opened.post("/api/session", json={}).json() == {"is_known": True}
    return opened


def test_the_page_comes_with_its_headers_and_its_door_with_a_secret(page: TestClient):
    answer = page.get("/")
    assert "default-src 'self'" in answer.headers["content-security-policy"]
    assert answer.headers["x-content-type-options"] == "nosniff"
    cookie = page.post("/api/session", json={}, headers={"cookie": ""}).headers["set-cookie"]
    assert cookie.startswith("excite_8000=")
    assert "HttpOnly; SameSite=Strict" in cookie
    text = answer.text + page.get("/static/bench.js").text
    assert "http://" not in text.replace("http://www.w3.org", "")
    assert "https://" not in text


def test_the_page_is_small():
    static = Path(web.__file__).with_name("static")
    assert sum(path.stat().st_size for path in static.rglob("*") if path.is_file()) < 300_000


def contrast(first: str, second: str) -> float:
    """Of two colours, as the Web Content Accessibility Guidelines count it."""

    def luminance(colour: str) -> float:
        digits = colour if len(colour) == 6 else "".join(2 * digit for digit in colour)
        parts = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    low, high = sorted((luminance(first), luminance(second)))
    return (high + 0.05) / (low + 0.05)


def test_texts_and_borders_can_be_seen(page: TestClient):
    style = page.get("/static/bench.css").text
    light, dark = re.findall(r":root \{(.*?)\}", style, re.DOTALL)
    assert contrast("000", "ffffff") == pytest.approx(21)
    for scheme in (light, dark):
        colour = dict(re.findall(r"--([a-z]+): #([0-9a-f]+);", scheme))
        for text in ("ink", "soft", "warning", "critical", "good", "accent"):
            assert contrast(colour[text], colour["card"]) >= 4.5, text
        for behind in ("field", "card", "paper"):
            assert contrast(colour["edge"], colour[behind]) >= 3
    for rule in ("input, select { width", "button { padding"):
        assert "1px solid var(--edge)" in style.partition(rule)[2].partition("}")[0]


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:8000", "127.0.0.1:8001", "127.0.0.1", "", "[", "a:b:c",
     "x@127.0.0.1:8000", "127.0.0.1:8000/a", "127.0.0.1:8000#a", "127.0.0.1:08000"],
)  # fmt: skip
def test_another_host_is_refused(host: str, page: TestClient):
    for path in ("/", "/api/runs", "/static/bench.js"):
        assert page.get(path, headers={"host": host}).status_code == 421


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": ""},
        {"origin": "http://127.0.0.1:8001"},
        {"origin": "https://127.0.0.1:8000"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
    ],
)
def test_a_request_from_elsewhere_changes_nothing(headers: dict[str, str], page: TestClient):
    for method, path in (
        ("POST", "/api/experiments"),
        ("POST", "/api/uploads?name=a.csv"),
        ("POST", "/api/trainings"),
        ("POST", "/api/session"),
        ("DELETE", "/api/jobs/x"),
        ("DELETE", "/api/trainings/x"),
        ("POST", "/api/deletions"),
        ("DELETE", "/api/deletions/x"),
    ):
        assert page.request(method, path, headers=headers, json={}).status_code == 403
    if "sec-fetch-site" in headers:
        assert page.get("/api/runs", headers=headers).status_code == 403


def test_without_its_secret_a_browser_sees_nothing(runs: Path, scratch: Path):
    stranger = guarded(runs, scratch)
    for cookie in ("", "excite_8000=guess", "excite_8000=", ";;=;", "excite_9000=x"):
        answer = stranger.get("/api/runs", headers={"cookie": cookie})
        assert answer.status_code == 403


@pytest.mark.parametrize(
    "name",
    [
        "..", "../", "../secret.json", "..%2fsecret.json", "%2e%2e/secret.json", "/etc", "some",
        "some/../some/study", "some/study/..", "elsewhere", "elsewhere/runs/some/study", ".",
        "some\\study", "some/study\x00", "", "//some/study",
    ],
)  # fmt: skip
def test_nothing_outside_the_run_folder_is_served(name: str, page: TestClient, runs: Path):
    for path in ("/api/run", "/api/run/file", "/api/run/report.html"):
        answer = page.get(path, params={"name": name, "file": "run.json"})
        assert answer.status_code == 404
    for raw in (f"/static/{name}", f"/static/../{name}", f"/api/results/{name}/record.csv"):
        answer = page.get(httpx.URL(HERE).copy_with(raw_path=raw.encode().replace(b"\0", b"%00")))
        assert "secret" not in answer.text
        # A client may have taken the dots for its own: what is left is the page itself.
        assert answer.status_code == 404 or answer.text.startswith("<!doctype html>")
    assert (runs.parent / "secret.json").read_text() == '{"secret": 1}'


@pytest.mark.parametrize(
    "file", ["../../../secret.json", "link.json", "program.py", "/etc/passwd", "", "run.json/.."]
)
def test_only_listed_files_of_a_run_are_served(file: str, page: TestClient):
    asked = {"name": "some/study", "file": file}
    assert page.get("/api/run/file", params=asked).status_code == 404


def test_the_run_folder_is_listed_as_it_is(page: TestClient, runs: Path):
    assert list(found(runs)) == ["some/study"]
    [run] = page.get("/api/runs").json()["runs"]
    assert (run["name"], run["kind"], run["plant"]) == ("some/study", "study", "aero2")
    content = page.get("/api/run", params={"name": "some/study"}).json()
    assert content["header"] == ["method", "<b>x</b>"]
    assert content["rows"] == [["chirp", "1"]]
    assert content["notes"] == ["note"]
    assert content["files"] == ["run.json", "table.md"]
    served_file = page.get("/api/run/file", params={"name": "some/study", "file": "table.md"})
    assert served_file.headers["content-disposition"].startswith("attachment")


@pytest.mark.parametrize("name", ["b\u00a0c", "測定\u3000一", "a\tb"])
def test_a_run_has_any_name_that_is_text(name: str, tmp_path: Path, scratch: Path):
    for word in (name, os.fsdecode(b"\xff")):
        (tmp_path / "runs" / word).mkdir(parents=True)
        for file in ("run.json", "table.md", os.fsdecode(b"\xff.csv")):
            (tmp_path / "runs" / word / file).write_text("{}")
    page = guarded(tmp_path / "runs", scratch)
    page.post("/api/session", json={})
    assert [run["name"] for run in page.get("/api/runs").json()["runs"]] == [name]
    content = page.get("/api/run", params={"name": name}).json()
    assert content["files"] == ["run.json", "table.md"]


def test_a_run_that_is_being_written_is_listed(
    page: TestClient, runs: Path, monkeypatch: pytest.MonkeyPatch
):
    """Temporary files are hidden, and any file may be gone before it is looked at."""
    run = runs / "some" / "study"
    [before] = page.get("/api/runs").json()["runs"]
    hidden, renamed = run / ".table.md.part", run / "table.json.part"
    for path in (hidden, renamed):
        path.touch()
        os.utime(path, (4e9, 4e9))
    look = Path.lstat

    def gone(path: Path) -> os.stat_result:
        if path in (hidden, renamed):
            raise FileNotFoundError(path)
        return look(path)

    monkeypatch.setattr(Path, "lstat", gone)
    assert page.get("/api/runs").json()["runs"] == [before]
    monkeypatch.undo()
    renamed.unlink()
    assert page.get("/api/runs").json()["runs"] == [before]
    hidden.unlink()


def test_a_campaign_is_shown_with_what_is_known_and_its_rounds(page: TestClient, runs: Path):
    folder = runs / "known"
    folder.mkdir()
    marker = {"kind": "excite campaign", "plant": Aero2().description.to_dict()}
    (folder / "run.json").write_text(json.dumps(marker))
    told = {"num_samples": 40, "played": "policy", "ended": "complete", "nearness": 0.5,
            "decision": "go on: D_p is 3 times as uncertain as asked"}  # fmt: skip
    content = {
        "reason": "", "interrupted": "", "targets": {"D_p": "1 %"}, "allowed": {"D_p": 1e-5},
        "estimate": {"D_p": {"estimate": 1e-3, "ci95_half": 3e-5}}, "rounds": [told],
    }  # fmt: skip
    (folder / "campaign.json").write_text(json.dumps(content))
    shown = page.get("/api/run", params={"name": "known"}).json()
    assert not shown["is_finished"]
    assert shown["kind"] == "campaign"
    assert shown["campaign"]["rounds"]["rows"][0][:4] == ["1", "policy", "40", "50 %"]
    [row] = [row for row in shown["campaign"]["known"]["rows"] if row[0] == "D_p"]
    assert row[-2:] == ["1 %", "missed"]
    assert shown["campaign"]["now"] == ""
    with locked_folder(folder, "this campaign"):
        now = [page.get("/api/run", params={"name": "known"}).json()["campaign"]["now"]]
        content["playing"] = "redesigned"
        (folder / "campaign.json").write_text(json.dumps(content))
        (folder / "round-02.csv").write_text("time,voltage,pitch\n0,0,0\n0.1,1,0.01\n")
        now.append(page.get("/api/run", params={"name": "known"}).json()["campaign"]["now"])
    assert now == ["Round 2 is prepared.", "Round 2 (redesigned): 1 sample so far."]
    content["reason"] = "every target is reached"
    (folder / "campaign.json").write_text(json.dumps(content))
    assert page.get("/api/run", params={"name": "known"}).json()["is_finished"]
    (folder / "campaign.json").write_text('{"rounds": 3}')
    assert page.get("/api/run", params={"name": "known"}).json()["campaign"] == {}
    shutil.rmtree(folder)


@pytest.mark.parametrize(
    "change",
    [
        {"plant": "examples/flexible_drive.py:FlexibleDrive"},
        {"plant": "flexible_drive.py:FlexibleDrive"},
        {"plant": 3},
        {"excitation": "signal.csv"},
        {"excitation": "../policy.safetensors"},
        {"others": ["/tmp/policy.safetensors"]},
        {"others": ["chirp", "prbs", "random"]},
        {"others": "prbs"},
        {"steps": 10**9},
        {"steps": 2.5},
        {"steps": True},
        {"amplitude": "7"},
        {"seconds": -1},
        {"params": [1]},
        {"params": {"J_p": "0.1"}},
        {"noise": {str(i): 1 for i in range(40)}},
        {"seed": -1},
        {"amplitude": 10**400},
        {"params": {"\ud800": "x"}},
        {"params": {"J_p": -(10**400)}},
    ],
)
def test_a_request_is_names_and_numbers_and_nothing_else(change: dict, page: TestClient):
    answer = page.post("/api/experiments", content=json.dumps({**EXPERIMENT, **change}))
    assert answer.status_code == 400
    assert answer.json()["sentence"]


def test_a_defect_is_one_sentence(page: TestClient, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("excite.web.runs.found", lambda folder: 1 / 0)
    answer = page.get("/api/runs")
    assert answer.status_code == 500
    assert "its terminal shows the reason" in answer.json()["sentence"]
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_half_a_character_is_no_token(runs: Path, scratch: Path):
    client = guarded(runs, scratch, token="right-token")
    answer = client.post("/api/session", content=b'{"token": "\\ud800"}')
    assert (answer.status_code, answer.json()["sentence"]) == (
        400,
        "the request is not a JSON object",
    )


@pytest.mark.parametrize("content", [b"", b"[1]", b"{", b"\xff", b"[" * 10000, b"NaN"])
def test_a_malformed_request_is_refused(content: bytes, page: TestClient):
    assert page.post("/api/experiments", content=content).status_code == 400


def test_what_is_too_large_is_refused_before_it_is_read(page: TestClient, scratch: Path):
    assert page.post("/api/experiments", content=b" " * 100_000).status_code == 413
    big = str(MAX_UPLOAD + 1)
    answer = page.post("/api/uploads?name=a.csv", content=b"x", headers={"content-length": big})
    assert answer.status_code == 413

    def endless() -> Iterator[bytes]:
        for _ in range(MAX_UPLOAD // 2**20 + 2):
            yield b"0" * 2**20

    assert page.post("/api/uploads?name=a.csv", content=endless()).status_code == 413
    assert not list(scratch.glob("*/*/*"))


@pytest.mark.parametrize(
    "change",
    [
        {"plant": "mine.py:Mine"}, {"name": "../out"}, {"name": "/tmp/out"}, {"name": "a b"},
        {"objective": "D;rm"}, {"objective": "--set"}, {"updates": 0}, {"spread": 2},
        {"steps": "60"}, {"name": "-x"},
    ],
)  # fmt: skip
def test_a_training_takes_names_and_numbers_alone(change: dict, page: TestClient, runs: Path):
    answer = page.post("/api/trainings", json={**TRAINING, **change})
    assert answer.status_code == 400
    assert sorted(p.name for p in runs.iterdir()) == ["elsewhere", "some"]


def test_a_training_never_goes_where_something_is(page: TestClient, runs: Path):
    assert page.post("/api/trainings", json={**TRAINING, "name": "some"}).status_code == 409
    begun = Training("x", runs / "other", ["train", "aero2", "--objective", "D"])
    with pytest.raises(RefusedError, match="exists already"):
        _free(runs, "other", [begun])  # its folder comes later
    assert _free(runs, "another", [begun]) == runs / "another"


def test_the_page_offers_what_can_be_trained_for(page: TestClient):
    select = re.findall(r'<select id="objective">(.*?)</select>', page.get("/").text)[0]
    assert tuple(re.findall(r'value="(\w+)"', select)) == tuple(OBJECTIVES)


def test_a_long_learning_curve_is_thinned(tmp_path: Path):
    training = Training("x", tmp_path, ["train", "aero2", "--objective", "D"])
    progress = tmp_path / "seeds" / "agent" / "0" / "progress.json"
    progress.parent.mkdir(parents=True)
    for i in range(2000):
        progress.write_text(f'{{"steps": {i}}}')
        training._look()
    steps = [row["steps"] or 0.0 for row in training.told()["curves"]["0"]]
    assert len(steps) <= 501
    assert (steps[0], steps[-1], steps) == (0, 1999, sorted(steps))
    progress.write_text('{"steps": 1500}')
    training._look()  # it was resumed from a checkpoint
    resumed = [row["steps"] or 0.0 for row in training.told()["curves"]["0"]]
    assert resumed == [step for step in steps if step < 1500] + [1500]


FAILING = """
import os, pathlib, sys
if "train" in sys.orig_argv:
    folder = pathlib.Path(sys.orig_argv[-1])
    folder.mkdir(exist_ok=True)
    (folder / "methods.json").write_text("{}")
    print("aero2: agent seed 0: compiling, 3 s so far", file=sys.stderr)
    print("the last words", file=sys.stderr)
    print("aero2, 4 s so far", file=sys.stderr, flush=True)
    os._exit(1)
"""


def test_a_training_that_fails_at_its_start_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "sitecustomize.py").write_text(FAILING)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    folder = tmp_path / "mine"

    async def ended(is_resumable: bool) -> TrainingStatus:
        training = Training("x", folder, ["train", "aero2", "--objective", "D"])
        if is_resumable:
            (folder / "seeds" / "agent" / "0").mkdir(parents=True)
            (folder / "seeds" / "agent" / "0" / "checkpoint.safetensors").write_text("")
        await training.start()
        assert training._followed is not None
        await training._followed
        return training.told()

    told = asyncio.run(ended(is_resumable=False))
    assert (told["state"], told["sentence"]) == ("failed", "the last words")
    assert told["progress"] == ""
    assert not folder.exists()
    assert asyncio.run(ended(is_resumable=True))["state"] == "failed"
    assert folder.exists()


def test_what_a_training_does_is_told_as_in_a_terminal(tmp_path: Path):
    training = Training("x", tmp_path, ["train", "aero2", "--objective", "D"])
    training._said = (
        b"warning: aero2: old\n"
        b"aero2: agent seed 0: updating 120 of 2,000; return 3, 6 %, 4 min left\n"
        b"finished: methods\naero2: agent seed 0: upda"
    )
    expected = "agent seed 0: updating 120 of 2,000; return 3, 6 %, 4 min left"
    assert training.told()["progress"] == expected


def test_a_full_store_takes_no_more(page: TestClient, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("excite.web.places.MAX_STORED", -1)
    answer = page.post("/api/uploads?name=a.csv", content="time,x\n0,1\n")
    assert answer.status_code == 507


def test_a_file_that_stops_coming_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(requests, "SILENCE", 0.05)
    come = iter([{"type": "http.request", "body": b"time", "more_body": True}])

    async def receive() -> Any:
        message = next(come, None)
        await asyncio.sleep(0 if message else 60)
        return message

    request = Request({"type": "http", "headers": []}, receive)
    with pytest.raises(RefusedError, match="the upload stopped"):
        asyncio.run(_receive(request, tmp_path / "a.csv", tmp_path))


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("my log [2], a=1.csv", "my log [2], a=1.csv"), ("../../etc/x.csv", ".._.._etc_x.csv"),
        ("-rf.CSV", "-rf.CSV"), ("a\0b\n\u202e.mat", "a_b__.mat"), ("Größe.csv", "Größe.csv"),
        (300 * "x" + ".csv", "file.csv"), (300 * "x" + ".parquet", "file.parquet"),
    ],
)  # fmt: skip
def test_a_files_name_is_freed_of_what_could_be_mistaken(name: str, kept: str):
    assert _file_name(name) == kept


def test_a_browser_cannot_see_or_stop_what_is_anothers(address: str, client, told: Told):
    result = told.of("result")[0]["result"]
    with browser(address) as other:
        for file in ("record.csv", "report.html", "estimate.json"):
            assert other.get(f"/api/results/{result}/{file}").status_code == 404
        short = {**EXPERIMENT, "others": [], "seconds": 1}
        with client.stream("POST", "/api/experiments", json=short) as answer:
            lines = answer.iter_lines()
            job = json.loads(next(lines))["job"]
            assert other.delete(f"/api/jobs/{job}").status_code == 404
            kinds = [json.loads(line)["kind"] for line in lines]
        assert kinds[-1] == "end"


def test_any_browser_with_a_session_stops_a_training_and_resumes_it(tmp_path: Path):
    asked = {**TRAINING, "updates": 100_000, "seeds": 2}
    with (
        served(tmp_path, "--workers", "1") as where,
        browser(where) as own,
        browser(where) as other,
    ):
        name = own.post("/api/trainings", json=asked).json()["name"]
        assert other.post(f"/api/trainings/{name}", json={}).status_code == 409  # it runs
        told = other.get("/api/trainings").json()
        [training] = told["trainings"]
        assert training["state"] in ("starting", "training")
        assert training["command"].endswith("--set num_updates=100000 --seeds 2 --out mine")
        assert told["resources"]["running"] == 1
        assert trainings_in(tmp_path)
        assert other.delete(f"/api/trainings/{name}").json()["state"] == "stopped"
        assert not trainings_in(tmp_path)
        assert other.post(f"/api/trainings/{name}", json={}).json()["state"] == "starting"
        assert own.post("/api/trainings/x", json={}).status_code == 404


def test_a_browser_has_so_many_things_under_way(tmp_path: Path):
    session = Session(tmp_path)
    jobs = [session.begin() for _ in range(MAX_JOBS)]
    with pytest.raises(RefusedError, match="stop one"):
        session.begin()
    session.end(jobs[0])
    session.begin()


def test_who_only_comes_to_the_page_gets_no_secret(runs: Path, scratch: Path):
    """A link in a foreign page, which comes without the cookie, would take the old one away."""
    stranger = guarded(runs, scratch)
    for headers in ({}, {"sec-fetch-site": "cross-site"}, {"sec-fetch-dest": "image"}):
        answer = stranger.get("/", headers=headers)
        assert answer.status_code == 200
        assert "set-cookie" not in answer.headers
    assert not list(scratch.iterdir())


def test_who_has_a_secret_keeps_it(page: TestClient, scratch: Path):
    answer = page.post("/api/session", json={})
    assert answer.json() == {"is_known": True}
    assert "set-cookie" not in answer.headers
    assert len(list(scratch.iterdir())) == 1


def test_what_computes_is_not_idle(tmp_path: Path):
    sessions = Sessions(tmp_path)
    first, second, *_ = [sessions.new() for _ in range(MAX_SESSIONS)]
    busy, done = sessions.get(first), sessions.get(second)
    assert busy is not None
    assert done is not None
    busy.begin()
    done.kept["x"] = Place(tmp_path, "upload")
    sessions.new()
    assert sessions.get(first) is busy
    assert sessions.get(second) is done, "what holds nothing goes first"
    for session in (sessions.get(key) for key in list(sessions._all)[2:]):
        assert session is not None
        session.kept["x"] = Place(tmp_path, "upload")
        session.seen = time.monotonic() + 1
    sessions.new()
    assert sessions.get(first) is busy
    assert sessions.get(second) is None


# -------------------------------------------------------------------------------- the token


def test_a_token_is_needed_where_there_is_one(runs: Path, scratch: Path):
    client = guarded(runs, scratch, token="right-token")
    assert client.get("/").status_code == 200  # the page itself says nothing
    for _ in range(MAX_SESSIONS + 1):
        answer = client.post("/api/session", json={})
        assert answer.json() == {"is_known": False}
        assert "set-cookie" not in answer.headers
    assert not list(scratch.iterdir()), "nothing is kept for strangers"
    for path in ("/api/runs", "/api/catalogue", "/api/run?name=some/study", "/api/trainings"):
        assert client.get(path).status_code == 401
    assert client.post("/api/experiments", json=EXPERIMENT).status_code == 401
    assert client.post("/api/session", json={"token": "right-token"}).json()["is_known"]
    assert client.get("/api/runs").status_code == 200


def test_a_token_cannot_be_guessed(runs: Path, scratch: Path):
    client = guarded(runs, scratch, token="right-token")
    for guess in ["", "right-toke", None, 7, ["right-token"], "x" * 60, *"abcdefg"][:MAX_TRIES]:
        assert client.post("/api/session", json={"token": guess}).status_code == 401
    answer = client.post("/api/session", json={"token": "right-token"})
    assert answer.status_code == 429, "the right one, too, has to wait then"
    assert client.get("/api/runs").status_code == 401
    other = TestClient(client.app, HERE, client=("10.0.0.9", 1), headers={"origin": HERE})
    answer = other.post("/api/session", json={"token": "right-token"})
    assert answer.status_code == 200, "who comes from elsewhere does not"


@pytest.mark.parametrize(
    ("address", "source"),
    [
        ("10.0.0.9", "10.0.0.9/32"),
        ("2001:db8:1:2:3::4", "2001:db8:1:2::/64"),
        ("::ffff:10.0.0.9", "10.0.0.9/32"),
        ("testclient", "testclient"),
    ],
)
def test_tries_are_counted_by_address(address: str, source: str):
    assert _source({"client": (address, 1)}) == source


def test_its_own_names_are_looked_up_once(runs, scratch, monkeypatch: pytest.MonkeyPatch):
    asked = []
    monkeypatch.setattr(socket, "getfqdn", lambda: asked.append(1) or "Its.Own.Name")
    client = guarded(runs, scratch, host="0.0.0.0", token="right-token")
    for _ in range(3):
        assert client.get("/", headers={"host": "its.own.name:8000"}).status_code == 200
    assert len(asked) == 1


def test_every_address_of_this_computer_is_answered_where_all_are_bound(runs, scratch):
    client = guarded(runs, scratch, host="0.0.0.0", token="right-token")
    own = socket.gethostname().lower()
    for host, status in (("10.0.0.7:8000", 200), (f"{own}:8000", 200), ("evil.example:8000", 421)):
        assert client.get("/", headers={"host": host}).status_code == status


# ----------------------------------------------------------------------- the command line


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--runs", "nowhere"], "no such folder"),
        (["--host", "no.such.host.invalid"], "is not an address"),
        (["--host", "192.0.2.1"], "cannot listen"),
        (["--token", "short"], "eight characters"),
        (["--port", "70000"], "70000"),
        (["--port", "TAKEN"], "--port 0 takes a free port"),
    ],
)
def test_a_mistake_is_one_sentence(words: list[str], sentence: str, tmp_path: Path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        words = [w.replace("TAKEN", str(taken.getsockname()[1])) for w in words]
        runs = [] if "--runs" in words else ["--runs", str(tmp_path)]
        command = [sys.executable, "-m", "excite", "serve", *words, *runs]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=PATIENCE
        )
    assert done.returncode == 2
    assert sentence in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert done.stdout == ""


def test_without_the_extra_one_sentence_says_what_to_install(tmp_path: Path):
    program = "import sys; sys.modules['starlette'] = None; from excite.cli import main; main()"
    command = [sys.executable, "-c", program, "serve", "--runs", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "pip install 'excite[web]'" in done.stderr


def test_other_computers_need_a_token_that_is_printed(tmp_path: Path):
    words = [sys.executable, "-m", "excite", "serve", "--host", "0.0.0.0", "--port", "0", "--json"]
    words, own = [*words, "--runs", str(tmp_path)], {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(words, stdout=subprocess.PIPE, env=own) as process:
        try:
            lines = iter(process.stdout.readline, b"}\n") if process.stdout else iter([])
            told = json.loads(b"".join([*lines, b"}"]))
        finally:
            process.kill()
    assert len(told["token"]) > 20
    assert told["address"].endswith("#" + told["token"])
