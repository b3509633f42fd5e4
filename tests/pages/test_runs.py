"""The run folder on the bench page: its table, and what is done with several runs."""

import asyncio
import itertools
import os
import re
import shutil
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from anyio.from_thread import start_blocking_portal
from chromium import require_chromium
from commands import PATIENCE
from served import served
from starlette.testclient import TestClient

import excite as ex
from excite.files import json_ready, locked_folder, read_json, took_lock, write_json
from excite.plant import Aero2
from excite.report.answer import answered, best_columns
from excite.report.html import report_html
from excite.report.study_table import common_table, violations_cell
from excite.study.table import finished_table
from excite.web import application
from excite.web import runs as web_runs
from excite.web.deletions import _delete
from excite.web.requests import RefusedError
from excite.web.sessions import PageSettings
from excite.web.trainings import Training

require_chromium()

from axe_playwright_python.sync_playwright import Axe  # noqa: E402
from playwright.sync_api import Locator, Page, expect  # noqa: E402

HERE = "http://127.0.0.1:8000"
RESULTS = Path(__file__).parents[2] / "results"
WAIT = 1000 * PATIENCE  # milliseconds


@pytest.fixture(scope="module")
def identified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run folders of two identifications."""
    folder = tmp_path_factory.mktemp("identified")
    for name, seed in (("chirp", 1), ("prbs", 2)):
        record = ex.simulate("aero2", name, steps=200, seed=seed)
        command = f"excite identify {name}.csv --plant aero2"
        ex.identify(record, "aero2").save(folder / name, command=command)
    return folder


@pytest.fixture
def runs(identified: Path, tmp_path: Path) -> Path:
    """A run folder: two studies, two identifications, a campaign; the oldest is the first."""
    folder = tmp_path / "runs"
    folder.mkdir()
    files = ("run.json", "study.json", "table.json", "table.md")
    for name in ("frontier", "table1"):
        (folder / name).mkdir()
        for file in files:
            shutil.copy(RESULTS / name / file, folder / name / file)
    for name in ("chirp", "prbs"):
        shutil.copytree(identified / name, folder / "some" / name)
    (folder / "known").mkdir()
    plant = Aero2().description.to_dict()
    write_json(folder / "known" / "run.json", {"kind": "excite campaign", "plant": plant})
    write_json(folder / "known" / "campaign.json", {
        "reason": "every target is reached", "interrupted": "", "targets": {}, "allowed": {},
        "estimate": {}, "rounds": [{}, {}], "num_samples": 80,
    })  # fmt: skip
    for day, run in enumerate(("known", "table1", "some/prbs", "frontier", "some/chirp"), 1):
        for path in (folder / run).iterdir():
            os.utime(path, (86400 * day, 86400 * day))
    return folder


@pytest.fixture
def client(runs: Path, tmp_path: Path) -> TestClient:
    app = application(PageSettings(runs, num_workers=0), tmp_path)
    opened = TestClient(app, base_url=HERE, headers={"origin": HERE})
    assert opened.post("/api/session", json={}).is_success
    return opened


@pytest.fixture
def address(runs: Path) -> Iterator[str]:
    with served(runs, "--workers", "1") as where:
        yield where


def names(page: Page) -> Locator:
    """The runs in the table, from top to bottom."""
    return page.locator("#run-list tbody th")


def require_access(page: Page) -> None:
    """Nothing hinders people who do not see or point; nothing needs scrolling sideways."""
    schemes: tuple[Literal["light", "dark"], ...] = ("light", "dark")
    for scheme, width in itertools.product(schemes, (1440, 1024, 390)):
        page.emulate_media(color_scheme=scheme)
        page.set_viewport_size({"width": width, "height": 900})
        violations = Axe().run(page).response["violations"]
        assert [(v["id"], v["nodes"][0]["html"]) for v in violations] == []
        assert page.evaluate("document.documentElement.scrollWidth") <= width


# -------------------------------------------------------------------------- the table of runs


def test_key_figures_are_those_of_the_results(client: TestClient, runs: Path):
    listed = {run["name"]: run for run in client.get("/api/runs").json()["runs"]}
    assert {name: run["kind"] for name, run in listed.items()} == {
        "frontier": "study", "table1": "study", "known": "campaign",
        "some/chirp": "identification", "some/prbs": "identification",
    }  # fmt: skip
    table = finished_table(RESULTS / "frontier")
    best = answered(table.rows, table.study, {}).best
    assert best is not None
    told = listed["frontier"]["key_figures"]
    assert told.startswith(f"{best.method}: log det {best.log_det_information:.2f}, violations 0/")
    ended = "every target is reached (80 samples in 2 rounds)"
    assert listed["known"]["key_figures"] == ended
    words = listed["some/chirp"]["key_figures"].split(", ")
    assert [word.split()[0] for word in words] == ["J_p", "K_pu", "D_p", "fit"]


def test_key_figures_follow_what_is_written(client: TestClient, runs: Path):
    def told(name: str) -> Any:
        return next(r for r in client.get("/api/runs").json()["runs"] if r["name"] == name)

    assert "log det" in told("table1")["key_figures"]
    shutil.copy(RESULTS / "frontier" / "table.json", runs / "table1" / "table.json")
    shutil.copy(RESULTS / "frontier" / "study.json", runs / "table1" / "study.json")
    assert told("table1")["key_figures"] == told("frontier")["key_figures"]
    (runs / "table1" / "table.json").write_text("{}")
    assert told("table1")["key_figures"] == ""  # it is damaged, and listed all the same
    (runs / "table1" / "table.json").unlink()
    assert not told("table1")["is_finished"]
    (runs / "table1" / "table.json").symlink_to(RESULTS / "table1" / "table.json")
    assert told("table1")["key_figures"] == ""  # links are not followed


def test_a_training_is_told_by_its_agent(client: TestClient, runs: Path):
    marker = read_json(runs / "table1" / "run.json")
    write_json(runs / "table1" / "run.json", {**marker, "command": "excite train aero2 --out x"})
    [run] = [r for r in client.get("/api/runs").json()["runs"] if r["name"] == "table1"]
    assert run["kind"] == "training"
    agents = finished_table(RESULTS / "table1").study.agents
    assert {told.partition(":")[0] for told in run["key_figures"].split("; ")} == set(agents)


def test_runs_are_sorted_and_filtered(address: str, page: Page):
    page.goto(f"{address}/#runs")
    newest = ["some/chirp", "frontier", "some/prbs", "table1", "known"]
    expect(names(page)).to_have_text(newest)
    head = page.get_by_role("columnheader")
    expect(head.nth(1)).to_have_attribute("aria-sort", "descending")
    head.nth(1).get_by_role("button").click()
    expect(names(page)).to_have_text(newest[::-1])
    # The same by the keyboard; equal ones by their names.
    kind = page.get_by_role("button", name="kind")
    kind.focus()
    page.keyboard.press("Enter")
    expect(head.nth(3)).to_have_attribute("aria-sort", "ascending")
    by_kind = ["known", "some/chirp", "some/prbs", "frontier", "table1"]
    expect(names(page)).to_have_text(by_kind)
    expect(page.locator("[aria-sort]")).to_have_count(1)
    expect(kind).to_be_focused()
    words = page.get_by_label("Words of name")
    words.fill("STUDY gradient")
    expect(names(page)).to_have_text(["frontier"])
    expect(page.locator("#run-count")).to_have_text("1 of 5 runs")
    words.fill("some")
    # It is the same after a look at another part of the page, and after a reload.
    page.get_by_role("link", name="Training").click()
    page.get_by_role("link", name="Runs").click()
    expect(names(page)).to_have_text(["some/chirp", "some/prbs"])
    page.reload()
    expect(names(page)).to_have_text(["some/chirp", "some/prbs"])
    expect(words).to_have_value("some")
    expect(head.nth(3)).to_have_attribute("aria-sort", "ascending")


def test_a_run_is_opened_by_the_keyboard(address: str, page: Page):
    page.goto(f"{address}/#runs")
    page.get_by_role("link", name="some/prbs").focus()
    page.keyboard.press("Enter")
    expect(page).to_have_url(f"{address}/#runs/some%2Fprbs")
    expect(page.locator("#run-view td").first).to_be_visible()
    expect(page.get_by_role("link", name="some/prbs")).to_be_focused()
    expect(page.get_by_role("link", name="some/prbs")).to_have_attribute("aria-current", "true")


def test_nothing_hinders_at_the_table_of_runs(address: str, page: Page):
    page.goto(f"{address}/#runs/some%2Fchirp")
    expect(page.locator("#run-view td").first).to_be_visible()
    require_access(page)


# --------------------------------------------------------------------------------- deletion


def tree(folder: Path) -> dict[str, bytes]:
    """Every file of a folder and its content."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def delete(client: TestClient, *names: object) -> Any:
    return client.post("/api/deletions", json={"names": names})


def test_deleted_runs_are_moved_and_come_back(client: TestClient, runs: Path):
    (runs / "frontier" / "seeds" / "empty").mkdir(parents=True)  # no file, and kept all the same
    before = tree(runs)
    deletion = delete(client, "some/chirp", "frontier").json()["deletion"]
    [place] = (runs / ".deleted").iterdir()
    assert place.name == deletion
    moved = {name: text for name, text in before.items() if name.startswith(("some/c", "front"))}
    assert tree(place) == moved
    assert (place / "frontier" / "seeds" / "empty").is_dir()
    listed = [run["name"] for run in client.get("/api/runs").json()["runs"]]
    assert listed == ["known", "some/prbs", "table1"]
    asked = {"name": f".deleted/{deletion}/frontier", "file": "run.json"}
    assert client.get("/api/run/file", params=asked).status_code == 404  # no longer on the page
    undone = client.delete(f"/api/deletions/{deletion}").json()
    assert undone == {"names": ["frontier", "some/chirp"]}
    assert tree(runs) == before
    assert (runs / "frontier" / "seeds" / "empty").is_dir()
    assert list((runs / ".deleted").iterdir()) == []
    assert client.delete(f"/api/deletions/{deletion}").status_code == 404


def test_nothing_is_overwritten(client: TestClient, runs: Path):
    deletion = delete(client, "some/chirp", "frontier").json()["deletion"]
    for block in (Path.touch, Path.mkdir):  # a file and a folder, both empty
        block(runs / "some" / "chirp")
        before = tree(runs)
        answer = client.delete(f"/api/deletions/{deletion}")
        assert answer.status_code == 409
        assert answer.json()["sentence"] == "some/chirp exists already; nothing was moved"
        assert tree(runs) == before  # also what was moved first
        assert not (runs / "frontier").exists()
        (runs / "some" / "chirp").rename(runs / block.__name__)
    assert client.delete(f"/api/deletions/{deletion}").is_success
    assert (runs / "some" / "chirp" / "run.json").is_file()


def test_what_appears_at_the_instant_of_a_deletion_is_not_overwritten(
    client: TestClient, runs: Path, record: Path, monkeypatch: pytest.MonkeyPatch
):
    deletion = delete(client, "some/rig.csv").json()["deletion"]
    link = os.link

    def late(here: Path, there: Path, **how: bool) -> None:
        if there == record:
            record.write_text("of another process")
        link(here, there, **how)

    with monkeypatch.context() as changed:
        changed.setattr(os, "link", late)
        answer = client.delete(f"/api/deletions/{deletion}")
        assert answer.status_code == 409
        assert answer.json()["sentence"] == "some/rig.csv exists already; nothing was moved"
    assert record.read_text() == "of another process"
    assert not record.with_suffix(".json").exists()  # it was moved back
    record.unlink()
    # Without links, too; and where nothing can be moved back, a sentence says what is where.
    with monkeypatch.context() as changed:

        def without(*_: object, **__: object) -> None:
            raise PermissionError

        rename, moved = os.rename, list[str]()

        def once(here: Path, there: Path) -> None:
            moved.append(Path(here).name)
            if len(moved) > 1:
                raise OSError(5, "Input/output error")
            rename(here, there)

        changed.setattr(os, "link", without)
        changed.setattr(os, "rename", once)
        answer = client.delete(f"/api/deletions/{deletion}")
        assert (answer.status_code, moved) == (409, ["rig.json", "rig.csv", "rig.json"])
        assert answer.json()["sentence"] == (
            "some/rig.csv cannot be moved (Input/output error), but rig.json cannot be moved back "
            "from runs"
        )


def test_one_look_at_the_folder_answers_all_that_wait(runs: Path, monkeypatch: pytest.MonkeyPatch):
    """And never one that came after it began."""
    looks, listed = list[Path](), web_runs.routes(runs)[0].endpoint
    look = web_runs.found

    def counted(folder: Path) -> dict[str, Path]:
        looks.append(folder)
        seen = look(folder)
        if len(looks) == 1:
            shutil.copytree(folder / "frontier", folder / "later")
            waiting.wait(PATIENCE)
        return seen

    async def all_at_once() -> list[bytes]:
        first = asyncio.create_task(listed(None))
        while not (runs / "later").exists():
            await asyncio.sleep(0)
        others = [asyncio.create_task(listed(None)) for _ in range(20)]
        await asyncio.sleep(0)  # they wait
        waiting.set()
        return [answer.body for answer in await asyncio.gather(first, *others)]

    waiting = threading.Event()
    monkeypatch.setattr(web_runs, "found", counted)
    with start_blocking_portal() as portal:  # a browser has the loop of this thread
        first, *others = portal.call(all_at_once)
    assert b'"later"' not in first
    assert all(b'"later"' in answer for answer in others)
    assert len(looks) == 2


def test_a_sidecar_is_read_once_while_it_does_not_change(
    client: TestClient, record: Path, monkeypatch: pytest.MonkeyPatch
):
    client.get("/api/runs")
    read, read_text = list[str](), Path.read_text

    def counted(path: Path, *given: str, **named: str) -> str:
        read.append(path.name)
        return read_text(path, *given, **named)

    monkeypatch.setattr(Path, "read_text", counted)
    assert client.get("/api/runs").is_success
    assert read == []
    write_json(record.with_suffix(".json"), read_json(record.with_suffix(".json")))
    read.clear()
    assert client.get("/api/runs").is_success
    assert set(read) == {"rig.json"}


def test_a_link_is_not_followed_by_a_deletion(client: TestClient, runs: Path, tmp_path: Path):
    deletion = delete(client, "some/chirp", "some/prbs").json()["deletion"]
    (tmp_path / "elsewhere").mkdir()
    (runs / "some").rmdir()
    (runs / "some").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    answer = client.delete(f"/api/deletions/{deletion}")
    assert answer.status_code == 409
    assert "link" in answer.json()["sentence"]
    (runs / ".deleted").rename(tmp_path / "trash")
    (runs / ".deleted").symlink_to(tmp_path / "trash", target_is_directory=True)
    assert delete(client, "frontier").status_code == 409
    assert client.delete(f"/api/deletions/{deletion}").status_code == 409
    assert list((tmp_path / "elsewhere").iterdir()) == []
    assert (runs / "frontier" / "run.json").is_file()


@pytest.mark.parametrize(
    "name",
    ["..", "../runs/frontier", "/etc", "some", "some/../frontier", ".", "", "frontier/", 3, None,
     "known/../../secret", ".deleted", "frontier\x00"],
)  # fmt: skip
def test_only_listed_runs_are_deleted(name: object, client: TestClient, runs: Path):
    """All that are named, or none."""
    before = tree(runs)
    answer = delete(client, "frontier", name)
    assert answer.status_code == 404
    assert answer.json()["sentence"] == "the run folder has no such run"
    assert tree(runs) == before
    for path in ("..", "%2e%2e", "x", ""):
        assert client.delete(f"/api/deletions/{path}").status_code in (404, 405)
    assert tree(runs) == before


@pytest.mark.parametrize("names", [[], {}, "frontier", None])
def test_a_deletion_names_runs(names: object, client: TestClient):
    assert client.post("/api/deletions", json={"names": names}).status_code == 400


def test_a_run_folder_that_is_a_run_stays(runs: Path, tmp_path: Path):
    app = application(PageSettings(runs / "frontier", num_workers=0), tmp_path)
    client = TestClient(app, base_url=HERE, headers={"origin": HERE})
    client.post("/api/session", json={})
    assert delete(client, ".").status_code == 409
    assert (runs / "frontier" / "run.json").is_file()


def test_a_run_that_is_being_written_stays(client: TestClient, runs: Path):
    with locked_folder(runs / "frontier", "this study"):
        answer = delete(client, "table1", "frontier")
        assert answer.status_code == 409
        assert answer.json()["sentence"].startswith("frontier cannot be deleted: another process")
        assert (runs / "table1" / "run.json").is_file()
    assert delete(client, "table1", "frontier").is_success


def test_a_run_that_is_being_trained_stays(runs: Path):
    training = Training("x", runs / "frontier", ["train", "aero2", "--objective", "D"])
    with pytest.raises(RefusedError, match="frontier is being trained; stop it first"):
        _delete(runs, ["frontier"], [training])
    training.state = "stopped"
    assert _delete(runs, ["frontier"], [training])


@pytest.mark.parametrize("headers", [{"origin": "http://evil.example"}, {"cookie": ""}])
def test_who_does_not_come_from_the_page_deletes_nothing(headers, client: TestClient, runs: Path):
    deletion = delete(client, "known").json()["deletion"]
    before = tree(runs)
    asked = {"names": ["frontier"]}
    assert client.post("/api/deletions", json=asked, headers=headers).status_code == 403
    assert client.delete(f"/api/deletions/{deletion}", headers=headers).status_code == 403
    assert client.post("/api/deletions", json=asked, headers={"host": "evil"}).status_code == 421
    assert tree(runs) == before


def test_runs_are_deleted_and_restored_by_the_keyboard(address: str, page: Page, runs: Path):
    before = tree(runs)
    page.goto(f"{address}/#runs/frontier")
    expect(page.locator("#run-view h2").first).to_be_visible()
    button = page.get_by_role("button", name="Delete")
    expect(button).to_be_disabled()
    for name in ("frontier", "known"):
        page.get_by_label(f"Select {name}", exact=True).focus()
        page.keyboard.press("Space")
    button.focus()
    page.keyboard.press("Enter")
    expect(page.locator("#runs .status").first).to_have_text("Deleted: frontier, known.")
    expect(names(page)).to_have_text(["some/chirp", "some/prbs", "table1"])
    expect(page.locator("#run-view")).to_be_empty()  # what was shown is deleted
    expect(page).to_have_url(f"{address}/#runs")
    assert not (runs / "frontier").exists()
    undo = page.get_by_role("button", name="Undo deletion of 2 runs")
    expect(undo).to_be_focused()
    page.reload()
    undo.focus()
    page.keyboard.press("Enter")
    expect(page.locator("#runs .status").first).to_have_text("Restored: frontier, known.")
    expect(names(page)).to_have_count(5)
    expect(undo).to_be_hidden()
    expect(page.get_by_role("link", name="frontier")).to_be_focused()
    assert tree(runs) == before


def test_what_is_not_shown_is_not_selected(address: str, page: Page, runs: Path):
    page.goto(f"{address}/#runs")
    expect(names(page)).to_have_count(5)
    everything = page.get_by_label("Select all runs in the table")
    everything.check()
    page.get_by_label("Words of name").fill("some")
    expect(names(page)).to_have_count(2)
    page.get_by_label("Words of name").fill("")
    expect(names(page)).to_have_count(5)
    expect(page.locator("#run-list tbody input:checked")).to_have_count(2)
    expect(everything).not_to_be_checked()
    page.get_by_role("button", name="Delete").click()
    expect(names(page)).to_have_count(3)
    assert (runs / "frontier").is_dir()


def test_a_deletion_that_is_refused_says_why(address: str, page: Page, runs: Path):
    page.goto(f"{address}/#runs")
    page.get_by_label("Select frontier", exact=True).check()
    with locked_folder(runs / "frontier", "this study"):
        page.get_by_role("button", name="Delete").click()
        expect(page.locator("#runs .status").first).to_contain_text("another process writes")
    expect(names(page)).to_have_count(5)
    page.get_by_role("button", name="Delete").click()
    undo = page.get_by_role("button", name="Undo deletion of frontier")
    expect(undo).to_be_visible()
    shutil.rmtree(runs / ".deleted")  # emptied by the user
    undo.click()
    expect(page.locator("#runs .status").first).to_contain_text("no such deletion")
    expect(undo).to_be_hidden()


# ------------------------------------------------------------------------------- comparison


def compared(client: TestClient, *names: str) -> Any:
    answer = client.get("/api/runs/compared", params=[("name", name) for name in names])
    assert answer.is_success, answer.text
    return answer.json()


def test_identifications_are_compared_as_in_a_report(client: TestClient, runs: Path):
    names = ["some/chirp", "some/prbs"]
    told = compared(client, *names)
    [table] = told["tables"]
    assert table["header"] == ["", "unit", *names]
    report = report_html([runs / name for name in names])
    beside = report.partition("Experiments side by side")[2].partition("</table>")[0]
    for row in table["rows"]:
        assert "".join(re.findall(r"<td[^>]*>([^<]*)</td>", beside)).count("".join(row)) == 1
    assert told["notes"] == []
    assert told["experiments"]["total"] == 2
    for name, traces in zip(names, told["experiments"]["runs"], strict=True):
        record = ex.read_record(runs / name / "record.csv", Aero2().description)
        assert traces["name"] == name
        np.testing.assert_array_equal(traces["time"], record.time - record.time[0])
        np.testing.assert_array_equal(traces["inputs"], json_ready(record.inputs))
        np.testing.assert_array_equal(traces["outputs"], record.outputs)


def test_studies_are_compared_by_their_common_methods(client: TestClient):
    told = compared(client, "frontier", "table1", "some/chirp")
    tables = {name: finished_table(RESULTS / name) for name in ("frontier", "table1")}
    common = common_table(tables)
    assert common is not None
    assert [(t["header"], t["rows"]) for t in told["tables"]] == [common]
    assert told["experiments"] is None  # there is only one


def test_what_cannot_be_compared_is_told(client: TestClient, runs: Path):
    for file in ("run.json", "study.json", "table.json"):
        shutil.copy(RESULTS / "dc_motor" / file, runs / "table1" / file)
    told = compared(client, "frontier", "table1")
    assert told["notes"][0] == "frontier, table1: no method and estimator in common."
    assert "nothing in common" in compared(client, "known", "some/chirp")["notes"][0]
    marker = read_json(runs / "some/chirp" / "run.json")
    marker["plant"]["inputs"][0]["name"] = "force"
    write_json(runs / "known" / "run.json", marker)
    shutil.copy(runs / "some/chirp" / "record.csv", runs / "known" / "round-01.csv")
    told = compared(client, "some/chirp", "some/prbs", "known")
    assert told["notes"] == ["known: other inputs or outputs, which are not drawn."]
    (runs / "some/chirp" / "record.csv").rename(runs / "away.csv")
    (runs / "some/chirp" / "record.csv").symlink_to(runs / "away.csv")
    told = compared(client, "some/chirp", "some/prbs")
    assert told["experiments"] is None  # links are not followed
    asked = client.get("/api/runs/compared")
    sentence = "one to 12 runs can be compared: got 0"
    assert (asked.status_code, asked.json()["sentence"]) == (400, sentence)
    for name in ("..", "some", "", "/etc"):
        asked = client.get("/api/runs/compared", params=[("name", "frontier"), ("name", name)])
        assert asked.status_code == 404


def test_runs_are_compared_by_the_keyboard(address: str, page: Page, runs: Path):
    (runs / "some/prbs").rename(runs / "some/a, b")
    page.goto(f"{address}/#runs")
    button = page.get_by_role("button", name="Compare")
    for name in ("some/chirp", "some/a, b"):
        expect(button).to_be_disabled()
        page.get_by_label(f"Select {name}", exact=True).focus()
        page.keyboard.press("Space")
    button.focus()
    page.keyboard.press("Enter")
    expect(page).to_have_url(f"{address}/#runs/some%2Fchirp,some%2Fa%2C%20b")
    table = page.get_by_role("region", name="Estimates with 95 % intervals")
    for _ in range(2):  # also after a reload
        expect(table.get_by_role("columnheader")).to_have_text(["unit", "some/chirp", "some/a, b"])
        expect(table.locator("tbody tr")).to_have_count(6)
        legends = page.locator("#run-view .legend")
        expect(legends).to_have_text(2 * ["some/chirpsome/a, b"])
        expect(page.locator("#run-list input:checked")).to_have_count(2)
        page.reload()
    page.get_by_role("link", name="frontier").click()
    expect(page.locator("#run-view h2").first).to_have_text(re.compile("^Frontier"))
    page.go_back()
    expect(table).to_be_visible()
    page.goto(f"{address}/#runs/some%2Fchirp,nothing")
    expect(page.locator("#runs .status").first).to_have_text("The run folder has no run nothing.")
    expect(page.locator("#run-view")).to_be_empty()


def test_nothing_hinders_at_a_comparison(address: str, page: Page):
    page.goto(f"{address}/#runs/some%2Fchirp,some%2Fprbs")
    expect(page.locator("#run-view canvas")).to_have_count(2)
    require_access(page)


# ------------------------------------------------------------------------------- experiments


@pytest.fixture
def record(runs: Path) -> Path:
    """A record of a rig in the run folder, beside files that are none."""
    path = runs / "some" / "rig.csv"
    ended = {"reason": "trip", "num_samples": 61}
    about = {"provenance": {"played": "chirp", "rig": "simulated"}, "ended": ended}
    made = ex.simulate("aero2", "chirp", steps=60)
    replace(made, metadata={**made.metadata, **about}).save(path)
    (runs / "bare.csv").write_text("time\n0\n")
    for name in ("bare", "alone"):
        write_json(runs / f"{name}.json", {"kind": "something else"})
    for ending in (".csv", ".json"):
        (runs / f"link{ending}").symlink_to(path.with_suffix(ending))
        shutil.copy(path.with_suffix(ending), runs / "some" / "chirp" / f"inner{ending}")
    return path


def test_a_record_is_an_experiment(client: TestClient, record: Path):
    listed = {run["name"]: run for run in client.get("/api/runs").json()["runs"]}
    assert len(listed) == 6  # neither links, nor what is inside of another run
    run = listed["some/rig.csv"]
    assert (run["kind"], run["plant"], run["is_finished"]) == ("experiment", "aero2", True)
    assert run["key_figures"] == "chirp, rig simulated, trip, 61 samples"
    asked = {"name": "some/rig.csv"}
    assert client.get("/api/run", params=asked).json()["files"] == ["rig.json", "rig.csv"]
    served = client.get("/api/run/file", params={**asked, "file": "rig.csv"})
    assert served.text == record.read_text()
    for file in ("../chirp/record.csv", "run.json", "", "rig"):
        answer = client.get("/api/run/file", params={**asked, "file": file})
        assert answer.status_code == 404
    content = read_json(record.with_suffix(".json"))
    write_json(record.with_suffix(".json"), {**content, "ended": None})
    [run] = [r for r in client.get("/api/runs").json()["runs"] if r["name"] == "some/rig.csv"]
    assert not run["is_finished"]


def test_an_experiment_is_compared_with_the_record_of_an_identification(
    client: TestClient, record: Path
):
    told = compared(client, "some/chirp", "some/rig.csv")["experiments"]
    assert [(run["name"], len(run["time"])) for run in told["runs"]] == [
        ("some/chirp", 201), ("some/rig.csv", 61),
    ]  # fmt: skip
    [alone] = compared(client, "some/rig.csv")["experiments"]["runs"]
    assert alone["outputs"] == ex.read_record(record, Aero2().description).outputs.tolist()


def test_an_experiment_is_deleted_with_its_sidecar(client: TestClient, runs: Path, record: Path):
    before = tree(runs)
    with record.open("ab") as file:
        assert took_lock(file)  # as while it is recorded
        assert delete(client, "some/rig.csv").status_code == 409
    deletion = delete(client, "some/rig.csv", "frontier").json()["deletion"]
    place = runs / ".deleted" / deletion
    moved = {"some/rig.csv", "some/rig.json"}
    assert moved < set(tree(place))
    record.write_text("another")
    assert client.delete(f"/api/deletions/{deletion}").status_code == 409
    assert record.read_text() == "another"
    assert not record.with_suffix(".json").exists()  # not half of it
    record.unlink()
    assert client.delete(f"/api/deletions/{deletion}").is_success
    assert tree(runs) == before


def test_an_experiment_is_seen(address: str, page: Page, record: Path):
    page.goto(f"{address}/#runs")
    page.get_by_role("link", name="some/rig.csv").click()
    expect(page.locator("#run-view canvas")).to_have_count(2)
    expect(page.locator("#run-view p").first).to_have_text("chirp, rig simulated, trip, 61 samples")
    require_access(page)
    with page.expect_download(timeout=WAIT) as waiting:
        page.locator("#run-view").get_by_role("link", name="Report").click()
    assert "aero2: a record" in waiting.value.path().read_text()


# ----------------------------------------------------------------------------------- studies


def test_a_study_is_shown_as_its_table(client: TestClient):
    for name in ("frontier", "table1"):
        table, told = finished_table(RESULTS / name), client.get(f"/api/run?name={name}").json()
        study = told["study"]
        assert list(study["tables"]) == list(dict.fromkeys(row.estimator for row in table.rows))
        for estimator, shown in study["tables"].items():
            own = table.only(estimator)
            header, cells = own.cells()
            place = header.index("violations (95 %)")
            order = [place, *(i for i in range(2, len(header)) if i != place)]
            assert shown["header"] == [header[0], *(header[i] for i in order)]
            assert [row["cells"][1:] for row in shown["rows"]] == [
                [row[i] for i in order] for row in cells
            ]
            ours = {row["cells"][0]: row["best"] for row in shown["rows"]}
            best = {m: {order.index(i) + 1 for i in b} for m, b in best_columns(own).items()}
            assert best == {row.method: {*ours[row.method]} for row in own.rows}
            assert len({row["cells"][0] for row in shown["rows"]}) == len(shown["rows"])
        first = [row for row in table.rows if row.estimator == table.rows[0].estimator]
        for row, point in zip(first, study["points"], strict=True):
            assert (row.method, row.log_det_information) == (point["method"], point["told"])
            assert (row.violation_rate.estimate, list(row.violation_rate.ci95)) == (
                point["rate"], point["interval"]
            )  # fmt: skip


def test_a_study_that_is_damaged_is_shown_as_it_was_written(client: TestClient, runs: Path):
    (runs / "table1" / "table.json").write_text("{}")
    told = client.get("/api/run?name=table1").json()
    assert told["study"] == {}
    assert told["rows"]


def test_the_estimator_of_a_study_is_chosen(address: str, page: Page):
    page.goto(f"{address}/#runs/table1")
    choice = page.get_by_label("Estimator", exact=True).and_(page.locator("#study-estimator"))
    expect(choice).to_have_value("nls")
    rows = page.get_by_role("region", name="Table of the study").locator("tbody tr")
    expect(rows).to_have_count(14)  # seven methods, and as many published rows
    for estimator in ("nls", "arx-rls"):
        choice.select_option(estimator)
        table = finished_table(RESULTS / "table1").only(estimator)
        best = best_columns(table)
        column, method = next((min(columns), m) for m, columns in best.items() if columns)
        row = page.get_by_role("row", name=re.compile(rf"^{re.escape(method)} [^a]"))
        titles, title = page.locator("#run-view thead th"), table.cells()[0][column]
        marked = row.locator("td").nth(titles.all_inner_texts().index(title) - 1)
        expect(marked).to_have_class("best")
        text = next(cells for cells in table.cells()[1] if cells[0] == method)[column]
        expect(marked).to_have_text(f"{text} best")
        assert (
            page.evaluate("(cell) => +getComputedStyle(cell).fontWeight", marked.element_handle())
            > 600
        )
    # It is kept for the next study that has it.
    page.get_by_role("link", name="frontier").click()
    expect(page.locator("#run-view h2").first).to_have_text(re.compile("^Frontier"))
    expect(choice).to_have_value("arx-rls")


def test_the_frontier_answers_to_the_pointer_and_to_the_keyboard(address: str, page: Page):
    page.goto(f"{address}/#runs/frontier")
    chart, read = page.locator(".frontier"), page.locator("#run-view section [role=status]")
    expect(chart.locator(".method")).to_have_count(17)
    expect(chart.locator(".method.best")).to_have_count(1)
    table = finished_table(RESULTS / "frontier").only("nls")
    told = {
        row.method: f"{row.method}: log det {row.log_det_information:.2f}, violations "
        f"{violations_cell(row)}" for row in table.rows
    }  # fmt: skip
    told["gradient D"] += ", not beaten"
    chart.scroll_into_view_if_needed()
    for name in ("prbs", "gradient D"):
        method = chart.locator(".method", has=page.get_by_text(name, exact=True))
        box = method.locator("circle").bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + box["width"] / 2 + 3, box["y"] + box["height"] / 2)
        expect(read).to_have_text(told[name])
        expect(method).to_have_class(re.compile("active"))
    chart.focus()
    page.keyboard.press("End")  # the most violations
    expect(read).to_have_text(told["prbs"])
    seen = [read.inner_text()]
    for _ in range(20):
        page.keyboard.press("ArrowLeft")
        seen.append(read.inner_text())
    assert set(seen) == set(told.values())
    expect(read).to_have_text(told["random"])  # no violation, and the least information
    page.set_viewport_size({"width": 390, "height": 900})
    expect(chart.locator("svg")).to_have_attribute("width", re.compile(r"^3\d\d$"))
    expect(chart.locator(".active")).to_have_count(1)


@pytest.mark.parametrize("name", ["frontier", "table1"])
def test_nothing_hinders_at_a_study(name: str, address: str, page: Page):
    page.goto(f"{address}/#runs/{name}")
    expect(page.locator(".frontier .method").first).to_be_attached()
    require_access(page)
