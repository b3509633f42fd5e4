"""What the bench page keeps for a browser, and for how long; links in the run folder."""

import asyncio
import json
import shutil
from collections.abc import AsyncGenerator, AsyncIterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from starlette.testclient import TestClient

from excite.files import write_json
from excite.web import application, sessions, streams
from excite.web.requests import RefusedError
from excite.web.sessions import MAX_FILES, MAX_JOBS, MAX_KEPT, Job, PageSettings, Session
from excite.web.workers import Workers

HERE = "http://127.0.0.1:8000"
ASKED = {"plant": "aero2", "estimator": "nls", "initial_state": "free"}


async def answered(
    workers: Workers, target: str, arguments: Mapping[str, Any], urgent: bool = False
) -> AsyncGenerator[dict[str, Any]]:
    """What workers would say, at once; identifications with a column "bad" fail."""
    del workers, urgent
    if target == "columns":
        yield {"kind": "columns", "columns": {"time": 2}, "previews": {}}
    elif target == "reported":
        if not all(Path(folder).is_dir() for folder in arguments["folders"]):
            yield {"kind": "failed", "sentence": f"{arguments['folders'][0]}: no such folder"}
            return
        Path(arguments["out"]).write_text("a report")
    elif "bad" in arguments["asked"]["columns"].values():
        yield {"kind": "failed", "sentence": "no column 'bad'"}
        return
    else:
        Path(arguments["folder"]).mkdir()
        (Path(arguments["folder"]) / "record.csv").write_text("time\n")
        yield {"kind": "identified"}
    yield {"kind": "end"}


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TestClient:
    monkeypatch.setattr(Workers, "events", answered)
    (tmp_path / "runs").mkdir()
    (tmp_path / "scratch").mkdir()
    app = application(PageSettings(tmp_path / "runs", num_workers=0), tmp_path / "scratch")
    client = TestClient(app, base_url=HERE, headers={"origin": HERE})
    assert client.post("/api/session", json={}).is_success
    return client


def uploaded(page: TestClient) -> str:
    return page.post("/api/uploads?name=a.csv", content="time\n0\n").json()["upload"]


def identified(page: TestClient, upload: str, column: str = "time") -> str | None:
    """The name of the result, where there is one."""
    asked = {**ASKED, "upload": upload, "columns": {"time": column}}
    lines = page.post("/api/identifications", json=asked).text.splitlines()
    return json.loads(lines[1]).get("result")


def test_the_oldest_of_all_that_is_kept_has_a_report(page: TestClient):
    upload = uploaded(page)
    results = [identified(page, upload) for _ in range(MAX_KEPT)]
    for result in results:
        answer = page.get(f"/api/results/{result}/report.html")
        assert (answer.status_code, answer.text) == (200, "a report")
    assert page.get(f"/api/results/{results[0]}/record.csv").is_success


def test_mistakes_take_no_place(page: TestClient, tmp_path: Path):
    upload = uploaded(page)
    result = identified(page, upload)
    for _ in range(2 * MAX_KEPT):
        assert identified(page, upload, "bad") is None
    assert identified(page, upload)
    assert page.get(f"/api/results/{result}/record.csv").is_success
    assert len(list(tmp_path.glob("scratch/*/*"))) == 3


def test_what_was_used_last_stays(page: TestClient):
    uploads = [uploaded(page) for _ in range(MAX_KEPT)]
    results = [identified(page, uploads[0]) for _ in range(MAX_KEPT)]
    assert page.get(f"/api/results/{results[0]}/record.csv").is_success
    assert identified(page, uploads[0]), "results take no upload's place"
    assert page.get(f"/api/results/{results[0]}/record.csv").is_success
    assert page.get(f"/api/results/{results[1]}/record.csv").status_code == 404
    assert uploaded(page)
    assert identified(page, uploads[0])
    asked = {**ASKED, "upload": uploads[1], "columns": {}}
    assert page.post("/api/identifications", json=asked).status_code == 404


def test_what_is_in_use_stays(tmp_path: Path):
    session = Session(tmp_path)

    def made() -> str:
        name = session.begin()
        with session.making("result", name) as place:
            place.is_done = True
        session.end(name)
        return name

    oldest = made()
    with session.using(oldest, "result") as folder, session.making("result", "new") as place:
        for _ in range(2 * MAX_KEPT):
            made()
        assert folder.is_dir()
        assert place.folder.is_dir()
    assert "new" not in session.kept
    made()
    made()
    with pytest.raises(RefusedError, match="run it again"), session.using(oldest, "result"):
        pass
    assert not folder.exists()
    assert len(session.kept) == MAX_KEPT


# ------------------------------------------------------------- a page that is loaded again


def test_what_was_shown_is_told_again(page: TestClient):
    """The request and all events of a result, and the columns of an upload; one by one."""
    upload = uploaded(page)
    asked = {**ASKED, "upload": upload, "columns": {"time": "time"}}
    told = page.post("/api/identifications", json=asked)
    first, found, _ = map(json.loads, told.text.splitlines())
    assert (first["kind"], first["asked"]) == ("job", asked)
    assert first["job"] == found["result"]
    again = page.get(f"/api/results/{first['job']}/events")
    assert (again.status_code, again.text) == (200, told.text)
    assert page.get(f"/api/uploads/{upload}").json() == {
        "upload": upload, "files": [{"file": "a.csv", "columns": {"time": 2}, "previews": {}}],
    }  # fmt: skip
    for name in (upload, "none"):
        answer = page.get(f"/api/results/{name}/events")
        assert (answer.status_code, "run it again" in answer.text) == (404, True)
    answer = page.get(f"/api/uploads/{first['job']}")
    assert (answer.status_code, "choose it again" in answer.text) == (404, True)


def test_files_of_an_upload_have_different_names_and_are_few(page: TestClient):
    upload, csv = uploaded(page), "time\n0\n1\n"
    for number in range(1, MAX_FILES):
        answer = page.post(f"/api/uploads/{upload}?name={number}.csv", content=csv)
        assert [own["file"] for own in answer.json()["files"]][1:] == [
            f"{i}.csv" for i in range(1, number + 1)
        ]
    for name, sentence in (("1.csv", "there already"), ("many.csv", f"at most {MAX_FILES} files")):
        answer = page.post(f"/api/uploads/{upload}?name={name}", content=csv)
        assert (answer.status_code, sentence in answer.text) == (409, True)
    assert len(page.get(f"/api/uploads/{upload}").json()["files"]) == MAX_FILES
    assert page.post("/api/uploads/none?name=a.csv", content=csv).status_code == 404


def test_a_file_that_is_not_read_is_no_part_of_an_upload(page: TestClient):
    upload = uploaded(page)
    for tried in ("", "time\n0\n1\n"):  # refused, then taken under the same name
        answer = page.post(f"/api/uploads/{upload}?name=b.csv", content=tried)
        assert answer.status_code == (200 if tried else 400)
    assert [own["file"] for own in answer.json()["files"]] == ["a.csv", "b.csv"]


@pytest.mark.parametrize(
    "change",
    [
        {"fitted": ["other.csv"]}, {"held_out": ["../a.csv"]}, {"fitted": "a.csv"},
        {"rows": 3}, {"rows": "1" * 201}, {"dt": -1}, {"dt": "0.1"}, {"others": ["a.py:B"]},
        {"start": {"J_p": "x"}}, {"uncertain": {"m": 0.1}}, {"likelihood": "a b"},
        {"set_inputs": [1]}, {"validate_columns": {"u": 1}},
    ],
)  # fmt: skip
def test_an_identification_takes_names_and_numbers_alone(change: dict[str, Any], page: TestClient):
    asked = {**ASKED, "upload": uploaded(page), "columns": {"time": "time"}, **change}
    answer = page.post("/api/identifications", json=asked)
    assert (answer.status_code, bool(answer.json()["sentence"])) == (400, True)


def test_results_of_this_browser_stand_side_by_side(page: TestClient):
    """A result without an estimate, and those of others, are left out."""
    result = identified(page, uploaded(page))
    answer = page.get("/api/results/compared", params={"name": [result, "none"]})
    assert answer.json()["header"] == ["", "unit"]


def test_another_browser_is_told_nothing_again(page: TestClient):
    upload = uploaded(page)
    result = identified(page, upload)
    page.cookies.clear()
    assert page.get(f"/api/results/{result}/events").status_code == 403
    assert page.post("/api/session", json={}).is_success
    for place in (f"results/{result}/events", f"uploads/{upload}"):
        assert page.get(f"/api/{place}").status_code == 404


@pytest.mark.parametrize("grace", [0.0, 60.0])
def test_a_job_goes_on_while_its_page_is_loaded_again(
    grace: float, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sessions, "GRACE", grace)

    async def left_and_followed() -> list[str]:
        job, may_end = Job(), asyncio.Event()

        async def work() -> None:
            job.tell("first")
            await may_end.wait()
            job.tell("last")

        job.start(work())
        page = job.follow()
        assert await anext(page) == "first"
        assert not job.is_abandoned
        await page.aclose()
        assert job.is_abandoned
        await asyncio.sleep(0.01)  # the page is being loaded
        may_end.set()
        return [line async for line in job.follow()]

    if grace:
        assert asyncio.run(left_and_followed()) == ["first", "last"]
    else:
        with pytest.raises(asyncio.CancelledError):
            asyncio.run(left_and_followed())


def test_a_result_whose_page_left_before_the_comparisons_is_shown_again(tmp_path: Path):
    """And it is told that what was to follow was stopped."""

    async def events(folder: Path, stop: asyncio.Event) -> AsyncIterator[Any]:
        yield {"kind": "result"}
        await stop.wait()

    async def left() -> list[Any]:
        session, making = Session(tmp_path), cast(Any, events)
        lines = cast(Any, streams._streamed(session, {}, making).body_iterator)
        name = json.loads(await anext(lines))["job"]
        assert json.loads(await anext(lines))["result"] == name
        cast(Job, session.jobs[name]).end()
        with pytest.raises(asyncio.CancelledError):
            _ = [line async for line in lines]
        with session.using(name, "result") as folder:
            return (folder / "events.ndjson").read_text().splitlines()

    told = [json.loads(line)["kind"] for line in asyncio.run(left())]
    assert told == ["job", "result", "stopped"]


def test_an_experiment_that_no_worker_takes_fails():
    class Full:
        async def events(self, *_: object) -> AsyncIterator[Any]:
            raise RefusedError(503, "the queue is full")
            yield

    player: Any = SimpleNamespace(hurry=lambda: None, frame=lambda: None, allows=lambda _: True)
    player.is_over = True

    async def told() -> list[Any]:
        full: Any = Full()
        return [e async for e in streams._followed(full, {}, player, asyncio.Event())]

    assert asyncio.run(told()) == [{"kind": "failed", "sentence": "the queue is full"}]


def test_a_job_that_was_left_gives_way(tmp_path: Path):
    async def one_more() -> tuple[str, dict[str, Job | None]]:
        session, jobs = Session(tmp_path), [Job() for _ in range(MAX_JOBS)]
        names = [session.begin(job) for job in jobs]
        for job in jobs:
            job.start(asyncio.sleep(60))
        followed = [asyncio.ensure_future(anext(job.follow())) for job in jobs]
        await asyncio.sleep(0)
        with pytest.raises(RefusedError, match="stop one"):
            session.begin()
        followed[1].cancel()
        await asyncio.wait({followed[1]})
        session.begin()
        return names[1], session.jobs

    left, jobs = asyncio.run(one_more())
    assert left not in jobs
    assert len(jobs) == MAX_JOBS


# ---------------------------------------------------------------------------------- links


LINKED = ("run.json", "study.json", "estimate.json", "table.json", "table.md", "figure.png")


@pytest.fixture
def run(page: TestClient, tmp_path: Path) -> Path:
    """A run every file of which is a link to a secret beside the run folder, but its marker."""
    del page
    run = tmp_path / "runs" / "a"
    run.mkdir()
    secret = {"kind": "SECRET", "title": "SECRET", "plant": {"name": "SECRET"}}
    write_json(tmp_path / "secret.json", secret)
    (tmp_path / "secret.md").write_text("| SECRET |\n| --- |\n| SECRET |\n")
    (tmp_path / "curves").mkdir()
    (tmp_path / "curves" / "curve.csv").write_text("SECRET\n1\n")
    shutil.copy(tmp_path / "curves" / "curve.csv", tmp_path / "curves" / "policy.safetensors")
    for name in LINKED:
        (run / name).symlink_to(tmp_path / f"secret.{'md' if name == 'table.md' else 'json'}")
    (run / "seeds" / "agent").mkdir(parents=True)
    (run / "seeds" / "agent" / "0").symlink_to(tmp_path / "curves", target_is_directory=True)
    return run


def test_links_in_a_run_are_not_followed(page: TestClient, run: Path):
    shown = [page.get("/api/runs"), page.get("/api/run", params={"name": "a"})]
    for name in (*LINKED, "seeds/agent/0/policy.safetensors", "seeds/agent/0/curve.csv"):
        shown.append(page.get("/api/run/file", params={"name": "a", "file": name}))
        assert shown[-1].status_code == 404
    assert all("SECRET" not in answer.text for answer in shown)
    assert not shown[0].json()["runs"][0]["is_finished"]
    assert shown[1].json()["curves"] == []


def test_a_run_with_links_has_no_report(page: TestClient, run: Path):
    answer = page.get("/api/run/report.html", params={"name": "a"})
    assert answer.status_code == 422
    assert "links" in answer.json()["sentence"]
    shutil.rmtree(run)
    run.mkdir()
    write_json(run / "run.json", {"kind": "excite study"})
    assert page.get("/api/run/report.html", params={"name": "a"}).text == "a report"
