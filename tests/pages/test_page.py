"""The bench page in a real browser: what people see, press and get."""

import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from chromium import require_chromium
from cluster import wait_for
from commands import PATIENCE
from served import MAX_GAP, TRIES, served

import excite as ex
from excite.files import write_json
from excite.plant import Aero2
from excite.plant.catalogue import plant_in_file
from excite.plant.contract import with_nominal
from excite.policy import read_policy

require_chromium()

from axe_playwright_python.sync_playwright import Axe  # noqa: E402
from playwright.sync_api import Browser, Page, Route, expect  # noqa: E402

WAIT = 1000 * PATIENCE  # milliseconds
WIDTHS = (360, 1440)


def write_campaign(run: Path, decisions: list[str], reason: str = "") -> None:
    """A campaign after some rounds."""
    known = {"D_p": {"estimate": 1e-3, "ci95_half": 1e-5}}
    round_ = {"num_samples": 40, "played": "policy", "ended": "complete", "nearness": 0.5}
    write_json(run / "campaign.json", {
        "reason": reason, "interrupted": "", "targets": {"D_p": "1 %"}, "allowed": {"D_p": 1e-5},
        "estimate": known, "rounds": [{**round_, "decision": told} for told in decisions],
    })  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def address(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    campaign = folder / "the_campaign"
    campaign.mkdir()
    about = {"kind": "excite campaign", "plant": Aero2().description.to_dict()}
    write_json(campaign / "run.json", about)
    damaged = folder / "damaged"
    damaged.mkdir()
    (damaged / "run.json").write_text('{"kind": "\\ud800", "plant": {"name": NaN}}')
    run = folder / "a_study"
    (run / "seeds" / "agent" / "0").mkdir(parents=True)
    write_json(run / "run.json", {"kind": "excite study", "plant": {"name": "aero2"}})
    write_json(run / "table.json", {"rows": []})
    cells = "| method | a very wide column of a table | b |\n| --- | --- | --- |\n"
    (run / "table.md").write_text(cells + "| <img src=x onerror=alert(1)> | 1 | 2 |\n")
    curve = "steps,return,violation_rate,relative_error_J_p\n0,-1,0,1\n10,2,0,0.01\n"
    (run / "seeds" / "agent" / "0" / "curve.csv").write_text(curve)
    own = tmp_path_factory.mktemp("plants") / "worst.json"
    write_json(own, plant_in_file(with_nominal(Aero2(), {"J_p": 0.017})))
    with served(folder, "--workers", "1", "--plant", str(own)) as where:
        yield where


def ready(page: Page, address: str, part: str = "experiment") -> Page:
    page.goto(f"{address}/#{part}")
    expect(page.locator(f"#{part} .primary")).to_be_enabled(timeout=WAIT)
    if part == "experiment":
        page.locator("#experiment form summary").click()
    return page


def status(page: Page, part: str = "experiment") -> Any:
    return page.locator(f"#{part} .status")


def require_no_sideways_scroll(page: Page) -> None:
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_a_run_from_choosing_to_the_report(address: str, page: Page, tmp_path: Path):
    ready(page, address)
    page.locator("#seed").fill("7")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text("Done.", timeout=WAIT)
    rows = page.locator("#comparison tbody tr")
    assert [rows.nth(i).locator("th").inner_text() for i in range(3)] == ["chirp", "prbs", "aero2"]
    assert "±" in page.locator("#estimates figure").first.inner_text()
    assert "largest" in page.locator("#signals figure").nth(1).inner_text()
    for name in ("report.html", "record.csv", "estimate.json"):
        with page.expect_download(timeout=WAIT) as waiting:
            page.locator(f"#outcome a[href$='{name}']").click()
        waiting.value.save_as(tmp_path / name)
    report = (tmp_path / "report.html").read_text()
    params = json.loads((tmp_path / "estimate.json").read_text())["params"]
    for i, (name, p) in enumerate(params.items()):
        shown = page.locator("#estimates figure").nth(i).inner_text().partition("value")[2]
        reported = re.findall(rf"<td>{name}</td><td>[^<]*</td><td[^>]*>([^<]*)</td>", report)[0]
        assert float(re.findall(r"[\d.]+", shown)[0]) == pytest.approx(p["estimate"], rel=1e-4)
        assert float(reported) == pytest.approx(p["estimate"], rel=1e-4)
    assert (tmp_path / "record.csv").read_text().startswith("time,voltage,pitch\n")
    require_no_sideways_scroll(page)
    page.set_viewport_size({"width": 1440, "height": 1000})
    # Once more, warm: now nothing is to hold the stream up, nor the first paint.
    gaps, paints = [], []
    for _ in range(TRIES):
        page.evaluate("window.frames_seen.length = window.sentences_said.length = 0")
        page.get_by_role("button", name="Run", exact=True).click()
        expect(status(page)).to_have_text(re.compile("^Running"), timeout=WAIT)
        expect(status(page)).to_have_text("Done.", timeout=WAIT)
        times = page.evaluate("window.frames_seen")
        assert len(times) > 25
        said = page.evaluate("window.sentences_said")  # by a screen reader
        assert "Running." in said
        assert len(said) < 8, said
        gaps.append(max(b - a for a, b in itertools.pairwise(times)))
        if gaps[-1] < 1000 * MAX_GAP:
            break
    assert min(gaps) < 1000 * MAX_GAP, gaps
    entry = "performance.getEntriesByName('first-paint')[0]?.startTime"  # it may come after load
    for _ in range(TRIES):
        page.reload()
        poll(page, f"{entry} > 0")
        paints.append(page.evaluate(entry))
        if min(paints) < 1000:
            break
    assert min(paints) < 1000, paints


def test_a_plant_of_ones_own_is_played_with_a_policy_of_which_is_told_what_was_searched(
    address: str, page: Page, tmp_path: Path
):
    ready(page, address)
    expect(page.locator("#claim")).to_be_empty()
    page.locator("#plant").select_option("worst")
    page.get_by_label("Excitation or policy").select_option("aero2")
    expect(page.locator("#claim")).to_have_text(f"Safety: {read_policy('aero2').claim}.")
    for label in ("First", "Second"):
        page.get_by_label(label, exact=True).select_option("aero2")  # nothing to compare with
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text("Done.", timeout=WAIT)
    with page.expect_download(timeout=WAIT) as waiting:
        page.locator("#outcome a[href$='record.csv']").click()
    waiting.value.save_as(tmp_path / "record.csv")
    expected = ex.simulate(with_nominal(Aero2(), {"J_p": 0.017}), "aero2", seed=0)
    played = ex.read_record(tmp_path / "record.csv", Aero2().description)
    np.testing.assert_allclose(played.outputs, expected.outputs, rtol=1e-9)


def test_a_run_is_stopped(address: str, page: Page):
    ready(page, address)
    page.get_by_label("Played in").select_option("20")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text(re.compile("^Running"), timeout=WAIT)
    page.locator("#experiment .stop").click()
    expect(status(page)).to_have_text("Stopped.", timeout=WAIT)
    expect(page.get_by_role("button", name="Run", exact=True)).to_be_enabled()
    # What there is of it is played again.
    time, play = page.locator("#player output"), page.get_by_role("button", name="Play")
    expect(play).to_be_visible()
    last = time.inner_text()
    page.get_by_label("Time that is shown").fill("1")
    expect(time).to_have_text("0 s")
    play.click()
    expect(time).to_have_text(last, timeout=WAIT)
    expect(play).to_be_visible(timeout=WAIT)


def test_what_tells_nothing_of_a_parameter_is_told(address: str, page: Page):
    ready(page, address)
    page.locator("#amplitude").fill("1e-200")  # its square is zero
    page.get_by_label("Played in").select_option("0")
    for label in ("First", "Second"):
        page.get_by_label(label, exact=True).select_option("chirp")  # nothing to compare with
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text("Done.", timeout=WAIT)
    for i in range(2, 6):
        low, high = page.evaluate(PLOT.format("#overlays .chart", i) + ".what.y")
        assert low < high  # None is neither
    notes = page.locator("#overlays figcaption", has_text="chirp: not identifiable")
    expect(notes).to_have_count(3)


def test_long_lines_of_a_stream_are_read_once(address: str, page: Page):
    """How often a character is looked at does not grow with the number of parts of its line."""
    page.goto(f"{address}/static/first.json")  # where no other script runs
    looked = """async () => {
      const { stream } = await import("/static/api.js");
      const line = JSON.stringify("x".repeat(5e4)), whole = `${line}\n[1]\n${line}\n`, told = [];
      const parts = new ReadableStream({ start(own) {
        const bytes = new TextEncoder().encode(whole);
        for (let i = 0; i < bytes.length; i += 1000) own.enqueue(bytes.slice(i, i + 1000));
        own.close();
      } });
      const { split } = String.prototype;
      let looked = 0;
      window.fetch = async () => new Response(parts);
      String.prototype.split = function (...how) {
        looked += this.length;
        return split.apply(this, how);
      };
      await stream("", {}, (event) => told.push(event));
      return [told.map(({ length }) => length), told[1], looked / whole.length];
    }"""
    assert page.evaluate(looked) == [[50_000, 1, 50_000], [1], 1]


def test_a_value_that_is_not_allowed_is_one_sentence(address: str, page: Page):
    ready(page, address)
    expect(page.locator("#signals canvas")).to_have_count(2)  # what was prepared
    page.locator("#params input").first.fill("-1")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_contain_text("is not allowed", timeout=WAIT)
    expect(status(page)).to_have_class(re.compile("bad"))
    assert page.locator("#signals canvas").count() == 0  # nothing of the run before


def test_a_value_that_is_folded_away_is_told(address: str, page: Page):
    """The browser says nothing of a field that it cannot show."""
    page.goto(address)
    expect(page.locator("#experiment .primary")).to_be_enabled(timeout=WAIT)
    page.locator("#experiment form summary").click()
    for label, value, told in (
        ("amplitude", "99", "Amplitude V, at most 24: got 99, needed is a number from 0 to 24."),
        ("steps", "-10", "Length samples: got -10, needed is a whole number from 50 to 5000."),
    ):
        field = page.locator(f"#{label}")
        before = field.input_value()
        field.fill(value)
        page.locator("#experiment form summary").click()
        page.get_by_role("button", name="Run", exact=True).click()
        expect(status(page)).to_have_text(told)
        expect(field).to_be_focused()
        field.fill(before)
    page.locator("#amplitude").fill("0")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text("amplitude must be above 0: an input of 0 moves nothing")


def test_it_is_used_by_the_keyboard_alone(address: str, page: Page):
    page.goto(address)
    expect(page.locator("#experiment .primary")).to_be_enabled(timeout=WAIT)
    names = []
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.textContent") == "Advanced":
            page.keyboard.press("Enter")
        element = "document.activeElement"
        names.append(page.evaluate(f"{element}.id || {element}.textContent.trim()"))
        assert page.evaluate(f"{element} === document.body || {element}.matches(':focus-visible')")
        if names[-1] == "seed":
            break
    wanted = ["Skip to the bench", "Experiment", "plant", "excitation", "amplitude", "steps"]
    assert [n for n in names if n in (*wanted, "seed")] == [*wanted, "seed"]
    page.keyboard.press("Enter")
    expect(status(page)).to_have_text(re.compile("^Running"), timeout=WAIT)
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "stop"
    page.keyboard.press("Enter")
    expect(status(page)).to_have_text("Stopped.", timeout=WAIT)


def test_the_header_is_skipped_to_the_part_that_is_shown(address: str, page: Page):
    page.goto(f"{address}/#runs")
    expect(page.get_by_role("link", name="a_study")).to_be_visible()
    page.locator(".skip").focus()
    page.keyboard.press("Enter")
    expect(page).to_have_url(f"{address}/#main")
    expect(page.locator("#runs")).to_be_visible()
    page.keyboard.press("Tab")
    expect(page.get_by_label("Words of name, date, plant, kind or figures")).to_be_focused()


def test_columns_are_chosen_before_anything_is_identified(address: str, page: Page):
    page.goto(f"{address}/#record")
    expect(page.locator("#record-plant option").first).to_be_attached(timeout=WAIT)
    rows = (b"20,%g,1,%g\n" % (0.1 * k, 0.01 * k) for k in range(60))
    content = b"Temperature,t,u,y\n" + b"".join(rows)
    log: Any = {"name": "log.csv", "mimeType": "", "buffer": content}
    carried = page.evaluate_handle(
        """(text) => {
          const carried = new DataTransfer();
          carried.items.add(new File([text], "log.csv"));
          return carried;
        }""",
        content.decode(),
    )
    page.locator("#record .drop").dispatch_event("drop", {"dataTransfer": carried})
    expect(status(page, "record")).to_contain_text("4 columns, 60 samples", timeout=WAIT)
    identify = page.get_by_role("button", name="Identify")
    for name, column in (("time", "t"), ("voltage", ""), ("pitch", "")):
        expect(page.locator(f"#column-{name}")).to_have_value(column)
    page.locator("#column-voltage").select_option("u")
    expect(identify).to_be_disabled()
    page.locator("#column-pitch").select_option("u")
    expect(identify).to_be_enabled()
    identify.click()
    expect(status(page, "record")).to_contain_text("cannot be the same column", timeout=WAIT)
    # Another file while one is identified: one after the other.
    page.locator("#column-pitch").select_option("y")
    page.route("**/api/identifications", lambda route: None)  # takes for ever
    identify.click()
    other: Any = {**log, "name": "other.csv"}
    page.locator("#file").set_input_files(other)
    expect(status(page, "record")).to_contain_text("other.csv: 4 columns", timeout=WAIT)
    page.locator("#column-voltage").select_option("u")
    page.locator("#column-pitch").select_option("y")
    expect(identify).to_be_disabled()


def test_every_field_has_a_label(address: str, page: Page):
    ready(page, address)
    bare = "[...document.querySelectorAll('input, select')].filter((e) => !e.labels.length).length"
    assert page.evaluate(bare) == 0


def test_a_file_is_dropped_mapped_and_identified(address: str, page: Page, tmp_path: Path):
    ready(page, address)
    page.get_by_label("Played in").select_option("0")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(page.locator("#outcome a[href$='record.csv']")).to_be_visible(timeout=WAIT)
    with page.expect_download(timeout=WAIT) as waiting:
        page.locator("#outcome a[href$='record.csv']").click()
    record = tmp_path / "log.csv"
    waiting.value.save_as(record)
    script = "<img src=x onerror=alert(1)>"
    record.write_text(record.read_text().replace("pitch", script, 1))
    page.get_by_role("link", name="Record", exact=True).first.click()
    page.locator("#file").set_input_files(record)
    expect(status(page, "record")).to_contain_text("501 samples", timeout=WAIT)
    page.locator("#column-pitch").select_option(script)
    page.get_by_role("button", name="Identify").click()
    expect(status(page, "record")).to_have_text("Done: successful.", timeout=WAIT)
    assert page.locator("#identified tbody tr").count() == 3
    assert page.locator("#record img").count() == 0
    with page.expect_download(timeout=WAIT) as waiting:
        page.locator("#record a[href$='report.html']").click()
    assert waiting.value.suggested_filename == "report.html"
    require_no_sideways_scroll(page)
    page.locator("#scale-pitch").fill("1000")
    page.get_by_role("button", name="Identify").click()
    expect(status(page, "record")).to_contain_text("another unit", timeout=WAIT)


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("bad.mat", b"\x80\x04\x95", "not a readable MAT file"),
        ("notes.doc", b"hello", ".mcap or .db3"),
        ("cut.csv", b"time,pitch\n0,", "truncated"),
    ],
)
def test_a_bad_file_is_one_sentence(
    name: str, content: bytes, sentence: str, address: str, page: Page
):
    page.goto(f"{address}/#record")
    expect(page.locator("#record-plant option").first).to_be_attached(timeout=WAIT)
    page.locator("#file").set_input_files({"name": name, "mimeType": "", "buffer": content})
    expect(status(page, "record")).to_contain_text(sentence, timeout=WAIT)
    expect(page.get_by_role("button", name="Identify")).to_be_disabled()


PLOT = "document.querySelectorAll('{}')[{}].plot"


def shown_range(page: Page, which: str, i: int) -> list[float]:
    """The part of the time axis that a plot shows."""
    u = PLOT.format(which, i) + ".u.scales.x"
    return page.evaluate(f"[{u}.min, {u}.max]")


def poll(page: Page, truth: str) -> None:
    """Waits until something is true; the page itself evaluates no text."""
    assert wait_for(lambda: bool(page.evaluate(truth)), PATIENCE), truth


def prepared(page: Page, address: str) -> Page:
    """The page with its prepared result, in the middle of the screen."""
    page.goto(address)
    expect(status(page)).to_contain_text("What is shown was prepared", timeout=WAIT)
    return page


def test_a_prepared_result_is_drawn_before_anything_is_run(address: str, page: Page):
    prepared(page, address)
    rows = page.locator("#comparison tbody tr")
    assert [rows.nth(i).locator("th").inner_text() for i in range(3)] == ["chirp", "prbs", "aero2"]
    # The chirp stays below the warning level of 30 degrees, the policy goes to 37.7.
    assert [rows.nth(i).locator("td").first.inner_text() for i in (0, 2)] == ["safe", "warning"]
    assert page.locator("#overlays figure").count() == 6
    command = page.locator("#again pre").text_content()
    assert command is not None
    assert command.startswith("excite simulate aero2 --excitation chirp")
    require_no_sideways_scroll(page)


def test_the_estimates_of_all_excitations_are_in_the_colours_of_their_signals(
    address: str, page: Page
):
    """Each with its bound, up to the time that is shown; what was prepared has them, too."""
    prepared(page, address)
    lines = """(which) => document.querySelector(which).plot.what.lines
      .map(({ name, color, dash, x, y }) => ({ name, color, dash, x, y }))"""
    signals = page.evaluate(lines, "#overlays .chart")
    found = page.evaluate(lines, "#estimates .chart")
    own, bounds = found[:3], found[3:]
    for key in ("name", "color"):
        assert [line[key] for line in own] == [line[key] for line in signals]
    twice = [line for line in own for _ in range(2)]
    assert [line["name"] for line in bounds] == [f"{line['name']}, bound" for line in twice]
    assert [line["color"] for line in bounds] == [line["color"] for line in twice]
    for line, upper in zip(own, bounds[::2], strict=True):
        assert len(line["x"]) == 20
        row = page.locator("#comparison tbody tr", has_text=line["name"])
        error = float(row.locator("td").nth(3).inner_text().split()[0])
        assert abs(line["y"][-1]) == pytest.approx(error, abs=5e-6)  # of eight digits
        assert abs(line["y"][-1]) < 3 * upper["y"][-1]
    page.get_by_label("Time that is shown").fill("250")
    found = page.evaluate(lines, "#estimates .chart")
    assert {len(line["x"]) for line in found} == {9}
    figure = page.locator("#estimates figure").first
    toggle = figure.get_by_role("button", name="prbs, bound")
    toggle.focus()
    page.keyboard.press("Enter")
    expect(toggle).to_have_attribute("aria-pressed", "false")


def test_plots_share_a_cross_hair_and_a_zoom(address: str, page: Page):
    prepared(page, address)
    first, chart = page.locator("#signals .chart").first, page.locator("#signals .chart").nth(1)
    box = chart.bounding_box()
    assert box is not None
    left, right, y = box["x"] + 200, box["x"] + 400, box["y"] + 80
    page.mouse.move(left, y)
    for i in range(2):
        expect(page.locator("#signals .read").nth(i)).to_have_text(re.compile(r"^[\d.]+ s: "))
    page.mouse.down()
    page.mouse.move(right, y, steps=4)
    page.mouse.up()
    zoomed = shown_range(page, "#signals .chart", 1)
    assert 0 < zoomed[0] < zoomed[1] < 50
    for which, i in (("#signals .chart", 0), ("#overlays .chart", 2), ("#estimates .chart", 0)):
        assert shown_range(page, which, i) == pytest.approx(zoomed)
    chart.dblclick()
    assert shown_range(page, "#overlays .chart", 0) == [0, 50]
    # The same by the keyboard.
    first.focus()
    for key in ("Home", "ArrowRight", "Shift+ArrowRight"):
        page.keyboard.press(key)
    expect(page.locator("#signals .read").first).to_have_text(re.compile(r"^1\.1 s: "))
    page.keyboard.press("+")
    assert shown_range(page, "#signals .chart", 1) == pytest.approx([0, 25])
    page.keyboard.press("-")
    assert shown_range(page, "#signals .chart", 1) == [0, 50]
    page.keyboard.press("+")
    page.keyboard.press("0")
    assert shown_range(page, "#signals .chart", 0) == [0, 50]


def test_very_many_samples_are_drawn_by_what_they_cover(address: str, page: Page):
    """The number of shapes follows the pixels, not the samples; few samples are points again."""
    prepared(page, address)
    shapes = """async (zoom) => {
      const { Plot } = await import("/static/plot.js"), parent = document.querySelector("#signals");
      const x = Array.from({ length: 1e5 }, (_, k) => k), y = x.map((k) => Math.sin(k));
      const { arc } = Path2D.prototype, canvas = CanvasRenderingContext2D.prototype;
      const { fillRect } = canvas, drawn = { points: 0, columns: 0 };
      Path2D.prototype.arc = function (...how) { drawn.points++; return arc.apply(this, how); };
      canvas.fillRect = function (...how) { drawn.columns++; return fillRect.apply(this, how); };
      parent.replaceChildren();
      const plot = new Plot(parent, "many", "many samples"), told = [];
      plot.show({ x: [0, 1e5], y: [-1, 1], lines: [{ x, y, color: "output", points: true }] });
      const next = () => new Promise((done) => requestAnimationFrame(() => setTimeout(done)));
      while (!plot.u) await next();
      plot.rescale();
      await next();
      told.push({ ...drawn }, plot.u.bbox.width);
      Object.assign(drawn, { points: 0, columns: 0 });
      plot.group.show([100, 200]);
      await next();
      told.push(drawn, plot.u.scales.y.max);
      Path2D.prototype.arc = arc;
      canvas.fillRect = fillRect;
      return told;
    }"""
    whole, width, part, most = page.evaluate(shapes)
    assert 0 < whole["columns"] < 5 * width
    assert whole["points"] == 0
    assert 100 <= part["points"] < 500
    assert 1 < most < 1.2


def test_a_hidden_plot_shows_the_newest_when_it_is_seen_again(address: str, page: Page):
    ready(page, address)
    page.get_by_label("Played in").select_option("2")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text(re.compile("^Running"), timeout=WAIT)
    plot = PLOT.format("#signals .chart", 1)
    poll(page, f"{plot}.u?.data[0].length > 0")
    bright = page.evaluate(f"{plot}.u.series[1].stroke()")
    page.get_by_role("link", name="Runs").click()
    expect(page.locator("#experiment")).to_be_hidden()
    expect(status(page)).to_have_text("Done.", timeout=WAIT)
    page.emulate_media(color_scheme="dark")
    page.get_by_role("link", name="Experiment").click()
    poll(page, f"{plot}.u.data[0].length === 501")
    poll(page, f"{plot}.u.series[1].stroke() !== {bright!r}")


def test_a_plot_that_was_never_drawn_is_given_up(address: str, page: Page):
    page.goto(address)
    made = """async () => {
      const { Plot } = await import("/static/plot.js");
      const place = document.createElement("div");
      document.body.append(place);
      const plot = new Plot(place, "a", "a");
      const before = plot.group.plots.length;
      place.remove();
      return [before, plot.group.plots.length];
    }"""
    assert page.evaluate(made) == [1, 0]


def test_another_file_is_shown_whole(address: str, page: Page, tmp_path: Path):
    page.goto(f"{address}/#record")
    expect(page.locator("#record-plant option").first).to_be_attached(timeout=WAIT)
    for steps in (200, 100):
        ex.simulate("aero2", "chirp", steps=steps).save(tmp_path / f"{steps}.csv")
        page.locator("#file").set_input_files(tmp_path / f"{steps}.csv")
        expect(status(page, "record")).to_contain_text(f"{steps + 1} samples", timeout=WAIT)
        poll(page, f"{PLOT.format('#columns .chart', 0)}.u !== null")
        assert shown_range(page, "#columns .chart", 0) == [0, steps]
        page.get_by_role("button", name="Identify").click()
        expect(status(page, "record")).to_have_text("Done: successful.", timeout=WAIT)
        poll(page, f"{PLOT.format('#residual-echoes .chart', 0)}.u !== null")
        assert shown_range(page, "#record-signals .chart", 0) == [0, steps / 10]
        assert shown_range(page, "#residual-echoes .chart", 0) == [0, 30.5]
        for place in ("columns", "record-signals", "residual-echoes"):
            page.locator(f"#{place} .chart").first.focus()
            for key in ("End", "+", "+"):
                page.keyboard.press(key)
            assert shown_range(page, f"#{place} .chart", 0)[0] > 0


def test_a_line_is_hidden_and_a_plot_is_saved(address: str, page: Page, tmp_path: Path):
    prepared(page, address)
    figure = page.locator("#overlays figure").nth(1)
    toggle = figure.get_by_role("button", name="prbs")
    toggle.focus()
    page.keyboard.press("Enter")
    expect(toggle).to_have_attribute("aria-pressed", "false")
    expect(toggle).to_be_focused()
    made = {}
    for kind in ("PNG", "SVG", "CSV"):
        with page.expect_download(timeout=WAIT) as waiting:
            figure.get_by_role("button", name=kind).click()
        assert waiting.value.suggested_filename == f"pitch_deg.{kind.lower()}"
        waiting.value.save_as(tmp_path / kind)
        made[kind] = (tmp_path / kind).read_bytes()
    assert made["PNG"].startswith(b"\x89PNG")
    drawn = ElementTree.fromstring(made["SVG"])
    assert len(drawn.findall(".//{*}polyline[@stroke-width='1.6']")) == 2
    header, *rows = made["CSV"].decode().splitlines()
    assert (header, len(rows)) == ("time [s],chirp [deg],aero2 [deg]", 501)
    expected = np.degrees(ex.simulate("aero2", "chirp", noise={"pitch": 1e-12}).outputs[:, 0])
    found = [float(row.split(",")[1]) for row in rows]
    np.testing.assert_allclose(found, expected, atol=2e-3)  # five digits are kept


def test_a_plot_is_saved_as_it_is_shown(address: str, page: Page, tmp_path: Path):
    """With dots, gaps, levels and marks; the numbers are those of the part that is shown."""
    page.goto(address)
    page.evaluate("""async () => {
      const { Plot } = await import("/static/plot.js"), { el } = await import("/static/api.js");
      const place = el("div", { id: "place" }), x = [0, 1, 2, 3, 4, 5];
      document.querySelector("main").prepend(place);
      const title = el("span", {}, "Volt ", el("span", { class: "unit" }, "V"));
      const plot = new Plot(place, title, "a"), color = "critical";
      plot.show({
        x: [0, 5], y: [-4, 4], unit: "s",
        levels: [{ y: 1, until: 1.1, color: "warning", word: "" }, { y: 1.1, color, word: "high" }],
        marks: [{ x: 1.5, color, word: "passed" }, { x: 4.5, color, word: "later" }],
        lines: [
          { x, y: [0, 1, null, 1, 2, 3], name: "own", color: "output", dots: true },
          { x, y: [0, -1, -1, -1, -2, -3], name: "bound", color: "bound" },
          { x, y: [0, -2, -1, -1, -2, -3], name: "bound", color: "bound", step: true },
        ],
      });
      plot.group.show([0.5, 4.25]);
    }""")
    poll(page, PLOT.format("#place .chart", 0) + ".u?.scales.x.max === 4.25")
    made = {}
    for kind in ("SVG", "CSV"):
        with page.expect_download(timeout=WAIT) as waiting:
            page.locator("#place").get_by_role("button", name=kind).click()
        waiting.value.save_as(tmp_path / kind)
        made[kind] = (tmp_path / kind).read_text()
    header, *rows = made["CSV"].splitlines()
    assert header == "time [s],own [V],bound [V],bound (2) [V]"
    assert rows == ["1,1,-1,-2", "2,,-1,-1", "3,1,-1,-1", "4,2,-2,-2"]
    drawing = ElementTree.fromstring(made["SVG"])
    words = [text.text for text in drawing.iterfind(".//{*}text")]
    assert words[-2:] == ["high", "passed"]
    assert len(drawing.findall(".//{*}rect[@opacity='0.1']")) == 2
    (dots,) = drawing.iterfind(".//{*}path[@stroke-width='5']")
    assert dots.attrib["d"].count("h0") == 5
    lines = drawing.findall(".//{*}g/{*}polyline[@stroke-width='1.6']")
    assert [len(line.attrib["points"].split()) for line in lines] == [2, 3, 6, 11]


def test_labels_of_an_axis_differ_and_the_last_one_is_not_cut(
    address: str, page: Page, tmp_path: Path
):
    """Also of seconds since 1970, of which six digits are equal."""
    page.goto(address)
    page.evaluate("""async () => {
      const { Plot } = await import("/static/plot.js"), { el } = await import("/static/api.js");
      const place = el("div", { id: "place" }), x = [0, 0.5, 1, 1.5, 2];
      for (const i in x) x[i] += 1732718858;
      document.querySelector("main").prepend(place);
      const plot = new Plot(place, "Volt", "a");
      const lines = [{ x, y: x, name: "u", color: "output" }];
      plot.show({ x: [x[0], x[4]], y: [x[0], x[4]], unit: "s", lines });
    }""")
    poll(page, PLOT.format("#place .chart", 0) + ".u?.scales.x.max === 1732718860")
    with page.expect_download(timeout=WAIT) as waiting:
        page.locator("#place").get_by_role("button", name="SVG").click()
    waiting.value.save_as(tmp_path / "SVG")
    drawing = ElementTree.fromstring((tmp_path / "SVG").read_text())
    texts = list(drawing.iterfind(".//{*}text[@text-anchor='middle']"))
    words = [str(text.text) for text in texts]
    assert len(set(words)) == len(words) > 1
    assert words[-1] == "1732718860 s"
    width = float(drawing.attrib["viewBox"].split()[2])
    for text in texts:  # a character is about 6.7 px wide
        assert float(text.attrib["x"]) + 3.4 * len(str(text.text)) <= width
    heights = [text.text for text in drawing.iterfind(".//{*}text[@text-anchor='end']")]
    assert len(set(heights)) == len(heights) > 1
    left = min(
        float(text.attrib["x"]) for text in drawing.iterfind(".//{*}text[@text-anchor='end']")
    )
    assert left >= 6.7 * max(len(str(height)) for height in heights)


def test_very_many_samples_are_saved_in_a_small_drawing(address: str, page: Page, tmp_path: Path):
    """With the first, last, smallest and largest of them, as points and as a line."""
    page.goto(address)
    ends = page.evaluate("""async () => {
      const { Plot } = await import("/static/plot.js"), { el } = await import("/static/api.js");
      const place = el("div", { id: "place" }), x = Array.from({ length: 1e5 }, (_, k) => k);
      const y = x.map((k) => Math.sin(k * k)), color = "output";
      Object.assign(y, { 31414: 1.49, 31415: 1.5, 62831: -1.5, 62832: -1.49 });
      document.querySelector("main").prepend(place);
      const plot = new Plot(place, "many", "many samples");
      const lines = [{ x, y, color, points: true }, { x, y, color: "simulated" }];
      plot.show({ x: [0, 99999], y: [-2, 2], lines });
      return [0, 31415, 62831, 99999].map((k) => [k / 99999, (y[k] + 2) / 4]);
    }""")
    poll(page, PLOT.format("#place .chart", 0) + ".u")
    with page.expect_download(timeout=WAIT) as waiting:
        page.locator("#place").get_by_role("button", name="SVG").click()
    waiting.value.save_as(tmp_path / "many.svg")
    text = (tmp_path / "many.svg").read_text()
    assert len(text) < 2_000_000
    drawing = ElementTree.fromstring(text)
    *_, width, height = map(float, drawing.attrib["viewBox"].split())
    (points,) = drawing.iterfind(".//{*}path[@stroke-linecap='round']")
    (line,) = drawing.iterfind(".//{*}g/{*}polyline[@stroke-width='1.6']")
    drawn = points.attrib["d"].removeprefix("M").split("h0M"), line.attrib["points"].split()
    assert all(re.fullmatch(r"[\d.]+[ ,][\d.]+(h0)?", at) for own in drawn for at in own)
    assert len(drawn[1]) <= 4 * width
    for own in drawn:
        found = np.array([re.findall(r"\d+(?:\.\d{1,2})?(?!\d|\.)", at)[:2] for at in own], float)
        assert len(np.unique(found.round(), axis=0)) > width
        for x, y in ends:
            at = 54 + x * (width - 18 - 54), height - 26 - y * (height - 26 - 8)
            assert np.abs(found - at).max(axis=1).min() < 0.006
        assert (np.diff(found[:, 0]) >= 0).all()


def test_an_experiment_is_paused_and_played_again(address: str, page: Page):
    ready(page, address)
    page.get_by_label("Played in").select_option("20")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text(re.compile("^Running"), timeout=WAIT)
    page.get_by_role("button", name="Pause").click()
    count = PLOT.format("#signals .chart", 1) + ".what.lines[0].x.length"
    paused = page.evaluate(count)
    assert 0 < paused < 501
    expect(status(page)).to_have_text("Done.", timeout=WAIT)
    assert page.evaluate(count) == paused
    slider = page.get_by_label("Time that is shown")
    slider.fill("100")
    assert page.evaluate(count) == 100
    expect(page.locator("#player output")).to_have_text("9.90 s")
    page.get_by_role("button", name="Play").click()
    expect(page.locator("#player output")).to_have_text("50.0 s", timeout=WAIT)
    # The plots of the prepared result are given up.
    assert (
        page.evaluate("document.querySelector('#experiment .view').group.sync.plots.length") == 11
    )
    # A new run ends the playing of the one before.
    page.get_by_role("button", name="Play").click()
    page.get_by_label("Played in").select_option("0")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text("Done.", timeout=WAIT)
    expect(page.get_by_role("button", name="Play")).to_be_visible()
    assert page.evaluate(count) == 501


def test_the_time_at_which_a_level_is_passed_is_told(address: str, page: Page):
    ready(page, address)
    page.locator("#amplitude").fill("24")
    page.get_by_label("Played in").select_option("0")
    for label in ("First", "Second"):
        page.get_by_label(label, exact=True).select_option("chirp")  # nothing to compare with
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text("Done.", timeout=WAIT)
    loud = ex.simulate("aero2", "chirp", options={"amplitude": 24.0})
    level = Aero2().description.outputs[0].critical_level
    time = loud.time[np.argmax(np.abs(loud.outputs[:, 0]) >= level)]
    told = f"critical level passed at {time:.3g}"
    expect(page.locator("#signals figcaption").nth(1)).to_contain_text(told)
    expect(page.locator("#overlays figcaption").nth(1)).to_contain_text(f"chirp: {told}")
    expect(page.locator("#comparison td").first).to_have_text("violation")


def test_a_file_is_previewed_and_its_units_are_taken_from_the_names(address: str, page: Page):
    page.goto(f"{address}/#record")
    expect(page.locator("#record-plant option").first).to_be_attached(timeout=WAIT)
    record = ex.simulate("aero2", "chirp", steps=200)
    columns = 1000 * record.time, record.inputs[:, 0], np.degrees(record.outputs[:, 0])
    rows = "".join(f"{t:.9g},{u:.9g},{y:.9g}\n" for t, u, y in zip(*columns, strict=True))
    content = ("t [ms],voltage (V),pitch (°)\n" + rows).encode()
    page.locator("#file").set_input_files({"name": "a.csv", "mimeType": "", "buffer": content})
    expect(page.locator("#first-rows tbody tr")).to_have_count(5, timeout=WAIT)
    expect(page.locator("#columns figure")).to_have_count(3)
    notes = page.locator("#columns figcaption")
    expect(notes.nth(0)).to_contain_text("steps of 100, no gaps")
    for name, unit in (("time", "ms"), ("voltage", "V"), ("pitch", "°")):
        expect(page.locator(f"#unit-{name}")).to_have_value(unit)
    page.get_by_role("button", name="Identify").click()
    expect(status(page, "record")).to_have_text("Done: successful.", timeout=WAIT)
    shown = page.locator("#identified tbody td").first.inner_text()
    assert float(shown) == pytest.approx(ex.identify(record).params.J_p, rel=1e-3)
    command = page.locator("#record-again pre").text_content()
    assert command is not None
    assert "--unit 'time=ms,pitch=°'" in command
    page.locator("#record-again summary").click()
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.get_by_role("button", name="Copy").click()
    expect(page.locator("#record-again [role=status]")).to_have_text("Copied.")
    assert page.evaluate("navigator.clipboard.readText()") == command
    # What is known beforehand, by the words of the command line; and profiles.
    page.locator("#record form summary").click()
    page.get_by_label("hold Jp").fill("0.0232")
    page.get_by_label("prior of Kpu").fill("normal:0.0125:5%")
    page.get_by_label("Intervals").select_option("profile")
    page.get_by_role("button", name="Identify").click()
    expect(page.locator("#identified tbody tr").first).to_contain_text("held", timeout=WAIT)
    known = page.locator("#record-again pre").text_content()
    assert known is not None
    assert "--hold J_p=0.0232 --prior K_pu=normal:0.0125:5%" in known
    expect(page.locator("#profiles canvas")).to_have_count(2)
    page.get_by_label("prior of Kpu").fill("wide")
    page.get_by_role("button", name="Identify").click()
    expect(status(page, "record")).to_contain_text("prior of 'K_pu' must be", timeout=WAIT)


def test_the_preview_of_a_file_has_at_most_six_digits_of_a_fraction(address: str, page: Page):
    """And three behind those before the point, which it has all: of seconds since 1970."""
    page.goto(f"{address}/#record")
    expect(page.locator("#record-plant option").first).to_be_attached(timeout=WAIT)
    first = b"0.30000000000000004,-1.23456789e-5,1732718858.125,a1.23456789\n"
    content = b"time,u,y,word\n" + first + b"0.5,7,-2.5,b\n"
    page.locator("#file").set_input_files({"name": "a.csv", "mimeType": "", "buffer": content})
    cells = page.locator("#first-rows tbody td")
    shown = ["0.3", "-1.23457e-5", "1732718858.125", "a1.23456789", "0.5", "7", "-2.5", "b"]
    expect(cells).to_have_text(shown, timeout=WAIT)
    for i, title in enumerate(("0.30000000000000004", "-1.23456789e-05")):
        expect(cells.nth(i)).to_have_attribute("title", title)
    expect(page.locator("#first-rows [title]")).to_have_count(2)


def test_a_file_that_fails_late_says_nothing_about_the_next(address: str, page: Page):
    page.goto(f"{address}/#record")
    expect(page.locator("#record-plant option").first).to_be_attached(timeout=WAIT)
    held: list[Route] = []
    page.route("**/api/uploads?name=late.csv", lambda route: held.append(route))

    def choose(name: str) -> None:
        content: Any = {"name": name, "mimeType": "", "buffer": b"time,x\n0,1\n1,2\n"}
        page.locator("#file").set_input_files(content)

    with page.expect_request("**/api/uploads?name=late.csv"):
        choose("late.csv")
    choose("next.csv")
    expect(status(page, "record")).to_contain_text("next.csv: 2 columns", timeout=WAIT)
    page.evaluate("""() => {
      const said = (window.sentences_said = []);
      const status = document.querySelector("#record .status");
      const watch = new MutationObserver(() => said.push(status.textContent));
      watch.observe(status, { childList: true });
    }""")
    with page.expect_response("**/api/uploads?name=late.csv") as late:
        held[0].fulfill(status=422, json={"sentence": "too late"})
    late.value.finished()
    choose("third.csv")
    expect(status(page, "record")).to_contain_text("third.csv: 2 columns", timeout=WAIT)
    said = page.evaluate("window.sentences_said")
    assert "too late" not in said
    assert said[0] == "Reading third.csv…"


def test_a_unit_that_is_not_known_is_told(address: str, page: Page):
    page.goto(f"{address}/#record")
    expect(page.locator("#record-plant option").first).to_be_attached(timeout=WAIT)
    content = b"t [minutes],voltage [mV],pitch\n0,1,1\n1,2,1\n"
    page.locator("#file").set_input_files({"name": "a.csv", "mimeType": "", "buffer": content})
    hints = page.locator("#mapping .map .hint")
    expect(hints).to_have_text(['unit "minutes" is not known: choose one', "", ""], timeout=WAIT)
    page.locator("#unit-time").select_option("ms")
    expect(hints).to_have_text(["", "", ""])


def test_what_the_plant_leaves_out_is_estimated_by_one_click(
    address: str, page: Page, tmp_path: Path
):
    """Besides those that were chosen, whatever plant is chosen for the next file."""
    late = ex.simulate("aero2+delay_voltage", "chirp", params={"delay_voltage": 0.06}, steps=300)
    late.save(tmp_path / "late.csv")
    page.goto(f"{address}/#record")
    expect(page.locator("#record-plant option").first).to_be_attached(timeout=WAIT)
    page.locator("#file").set_input_files(tmp_path / "late.csv")
    expect(status(page, "record")).to_contain_text("301 samples", timeout=WAIT)
    page.locator("#record form summary").click()
    page.get_by_label("bias_pitch").check()
    page.get_by_role("button", name="Identify").click()
    cause = page.get_by_role("button", name="Estimate delay_voltage, too")
    expect(cause).to_be_visible(timeout=WAIT)
    cause.click()
    expect(page.locator("#identified tbody tr")).to_have_count(5, timeout=WAIT)
    expect(page.get_by_label("delay_voltage")).to_be_checked()
    page.get_by_label("delay_voltage").uncheck()
    page.get_by_role("button", name="Identify").click()
    expect(cause).to_be_visible(timeout=WAIT)
    page.locator("#record-plant").select_option("dc_motor")
    cause.click()
    expect(page.locator("#identified tbody tr")).to_have_count(5, timeout=WAIT)
    expect(page.get_by_label("delay_voltage")).not_to_be_checked()  # another plant's
    found = page.locator("#identified tbody tr", has_text="delay").locator("td").first
    assert float(found.inner_text()) == pytest.approx(0.06, rel=0.01)
    command = page.locator("#record-again pre").text_content()
    assert command is not None
    assert "--plant aero2+bias_pitch+delay_voltage" in command
    page.get_by_text("Correlation of the estimates").click()
    cells = page.locator("#correlations tbody td")
    expect(cells).to_have_count(25)
    expect(cells.first).to_have_text("1.00")
    # The residual is white now: about 95 % of 30 correlations within the band.
    plot = PLOT.format("#residual-echoes .chart", 0) + ".what"
    values, edge = page.evaluate(f"[{plot}.lines[0].y, {plot}.bands[0].upper[0]]")
    assert len(values) == 30
    assert sum(abs(v) > edge for v in values) <= 6


FORM = """(part) => Object.fromEntries([...document.querySelectorAll(`#${part} form [id]`)]
  .filter((field) => field.matches("select, input:not([type=file])"))
  .map((field) => [field.id, field.type === "checkbox" ? field.checked : field.value]))"""
PLOTS = """(part) => [...document.querySelectorAll(`#${part} .chart`)]
  .map(({ plot }) => JSON.stringify(plot.what))"""


def seen(page: Page, part: str) -> tuple[Any, ...]:
    """The form of a view, the texts of its result, and what its plots show."""
    texts = page.locator(f"#{part} .view").locator("table, li, pre, h2, .downloads a, figcaption")
    hidden = page.locator(f"#{part} .view > section[hidden]").count()
    return page.evaluate(FORM, part), texts.all_inner_texts(), page.evaluate(PLOTS, part), hidden


def test_an_experiment_comes_back_when_the_page_is_loaded_again(address: str, page: Page):
    beside = [prepared(page.context.new_page(), address)]
    ready(page, address)
    page.locator("#plant").select_option("cart_pole")
    page.locator("#plant").select_option("worst")
    page.locator("#excitation").select_option("multisine")
    page.get_by_label("First", exact=True).select_option("aero2")
    page.get_by_label("Second", exact=True).select_option("multisine")
    for field, value in (("amplitude", "6.5"), ("noise-pitch", "0.2")):
        page.locator(f"#{field}").fill(value)
    page.get_by_role("button", name="Draw within").click()
    page.get_by_label("Played in").select_option("0")
    beside.append(prepared(page.context.new_page(), address))
    assert beside[1].evaluate(FORM, "experiment") == page.evaluate(FORM, "experiment")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text("Done.", timeout=WAIT)
    page.locator("#seed").fill("9")  # for the next one
    page.locator("#steps").fill("400")
    before = seen(page, "experiment")
    assert (before[0]["plant"], before[0]["excitation"]) == ("worst", "multisine")
    page.reload()
    expect(status(page)).to_have_text("Done.", timeout=WAIT)
    assert seen(page, "experiment") == before
    with page.expect_download(timeout=WAIT) as waiting:
        page.locator("#outcome a[href$='record.csv']").click()
    assert len(waiting.value.path().read_text().splitlines()) == 502
    # The tabs beside it were open before: each has its own form, and no result.
    for tab, plant in zip(beside, ("aero2", "worst"), strict=True):
        prepared(tab, address)
        expect(tab.locator("#plant")).to_have_value(plant)
        expect(tab.locator("#seed")).to_have_value("0")
        tab.close()
    # The tab is closed, and the address opened again.
    later = page.context.new_page()
    page.close()
    later.goto(address)
    expect(status(later)).to_have_text("Done.", timeout=WAIT)
    later.set_viewport_size({"width": 390, "height": 800})
    assert seen(later, "experiment")[:2] == before[:2]
    assert Axe().run(later).response["violations"] == []
    # The server knows this browser no more, as after it was started again.
    later.context.clear_cookies()
    later.reload()
    expect(status(later)).to_contain_text("no longer on the server", timeout=WAIT)
    assert seen(later, "experiment")[0] == before[0]
    expect(later.get_by_role("button", name="Run", exact=True)).to_be_enabled()


def test_a_plant_that_is_gone_is_told(address: str, page: Page):
    page.goto(f"{address}/static/first.json")  # where no script runs
    page.evaluate("""localStorage.setItem("excite-experiment",
      JSON.stringify({ fields: { plant: "my_own", excitation: "prbs" } }))""")
    page.goto(address)
    expect(status(page)).to_have_text("the plant my_own is no longer on the server", timeout=WAIT)
    expect(page.locator("#signals canvas")).to_have_count(2)
    expect(status(page)).to_have_class(re.compile("bad"))
    expect(page.locator("#excitation")).to_have_value("chirp")


def test_a_storage_that_is_damaged_or_full_stops_nothing(address: str, page: Page):
    page.goto(f"{address}/static/first.json")
    page.evaluate("""["x", '{"fields": null}'].forEach((text, i) =>
      localStorage.setItem(`excite-${["experiment", "record"][i]}`, text))""")
    ready(page, address)
    page.locator("#seed").fill("4")
    kept = json.loads(page.evaluate("sessionStorage.getItem('excite-experiment')"))["fields"]
    assert kept["seed"] == "4"
    assert "amplitude" not in kept  # what was not changed follows the plant
    assert not [name for name in kept if name.startswith(("params-", "noise-"))]
    page.add_init_script("Storage.prototype.setItem = () => { throw new Error('full'); }")
    page.reload()
    expect(page.locator("#experiment .primary")).to_be_enabled(timeout=WAIT)
    page.get_by_label("Played in").select_option("20")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text(re.compile("^Running"), timeout=WAIT)
    page.locator("#experiment .stop").click()
    expect(status(page)).to_have_text("Stopped.", timeout=WAIT)


@pytest.mark.parametrize(
    "kept",
    ["x", "3", '{"column": null, "words": 5, "deletions": {}}'],
    ids=["text", "number", "kinds"],
)
def test_a_storage_that_is_damaged_or_full_does_not_stop_the_list_of_runs(
    kept: str, address: str, page: Page
):
    page.goto(f"{address}/static/first.json")  # where no script runs
    page.add_init_script("Storage.prototype.setItem = () => { throw new Error('full'); }")
    page.evaluate(
        "text => ['runs', 'excite-runs'].forEach((name) => sessionStorage.setItem(name, text))",
        kept,
    )
    page.goto(f"{address}/#runs")
    expect(page.locator("#run-list tbody tr")).to_have_count(3)
    page.get_by_label("Words of name").fill("study")
    expect(page.locator("#run-list tbody th")).to_have_text(["a_study"])


def test_an_experiment_that_runs_is_followed_again(address: str, page: Page):
    """And what was stopped is shown up to there."""
    ready(page, address)
    page.get_by_label("Played in").select_option("20")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text(re.compile("^Running"), timeout=WAIT)
    page.reload()
    expect(status(page)).to_have_text(re.compile("^Running"), timeout=WAIT)
    expect(page.get_by_role("button", name="Run", exact=True)).to_be_disabled()
    page.locator("#experiment .stop").click()
    expect(status(page)).to_have_text("Stopped.", timeout=WAIT)
    before = seen(page, "experiment")
    assert len(before[2]) == 5
    page.reload()
    expect(status(page)).to_have_text("Stopped.", timeout=WAIT)
    assert seen(page, "experiment") == before


def test_a_file_and_its_result_come_back_when_the_page_is_loaded_again(
    address: str, page: Page, tmp_path: Path
):
    page.goto(f"{address}/#record")
    expect(page.locator("#record-plant option").first).to_be_attached(timeout=WAIT)
    record = ex.simulate("aero2", "chirp", steps=200)
    columns = 1000 * record.time, record.inputs[:, 0] / 2, np.degrees(record.outputs[:, 0])
    rows = "".join(f"{t:.9g},{u:.9g},{y:.9g}\n" for t, u, y in zip(*columns, strict=True))
    (tmp_path / "log.csv").write_text("stamp,u,y\n" + rows)
    page.locator("#record-plant").select_option("worst")
    page.locator("#file").set_input_files(tmp_path / "log.csv")
    expect(status(page, "record")).to_contain_text("log.csv: 3 columns", timeout=WAIT)
    for name, column in (("time", "stamp"), ("voltage", "u"), ("pitch", "y")):
        page.locator(f"#column-{name}").select_option(column)
    page.locator("#unit-time").select_option("ms")
    page.locator("#unit-pitch").select_option("deg")
    page.locator("#scale-voltage").fill("2")
    page.locator("#record form summary").click()
    page.get_by_label("bias_pitch").check()
    page.get_by_label("hold Jp").fill("0.0232")
    page.get_by_label("prior of Kpu").fill("normal:0.0125:5%")
    page.get_by_label("Intervals").select_option("profile")
    page.get_by_label("Initial state").select_option("known")
    mapped = seen(page, "record")
    page.reload()  # before anything is identified
    expect(status(page, "record")).to_contain_text("log.csv: 3 columns", timeout=WAIT)
    assert seen(page, "record") == mapped
    page.get_by_label("bias_pitch").uncheck()  # "Advanced" is open, as it was
    page.get_by_label("Intervals").select_option("linear")
    page.get_by_role("button", name="Identify").click()
    expect(status(page, "record")).to_have_text("Done: successful.", timeout=WAIT)
    before = seen(page, "record")
    page.reload()
    expect(status(page, "record")).to_have_text("Done: successful.", timeout=WAIT)
    assert seen(page, "record") == before
    assert Axe().run(page).response["violations"] == []
    # The server knows this browser no more: the file is chosen again, and is mapped as before.
    page.context.clear_cookies()
    page.reload()
    gone = "this file is no longer on the server; choose it again"
    expect(status(page, "record")).to_have_text(gone, timeout=WAIT)
    expect(page.get_by_role("button", name="Identify")).to_be_disabled()
    page.locator("#file").set_input_files(tmp_path / "log.csv")
    expect(status(page, "record")).to_contain_text("log.csv: 3 columns", timeout=WAIT)
    assert seen(page, "record")[0] == before[0]
    page.get_by_role("button", name="Identify").click()
    expect(status(page, "record")).to_have_text("Done: successful.", timeout=WAIT)
    # Another file of that name is mapped anew.
    page.context.clear_cookies()
    page.reload()
    expect(status(page, "record")).to_have_text(gone, timeout=WAIT)
    (tmp_path / "log.csv").write_text("t [s],u,y\n" + rows)
    page.locator("#file").set_input_files(tmp_path / "log.csv")
    expect(status(page, "record")).to_contain_text("log.csv: 3 columns", timeout=WAIT)
    expect(page.locator("#unit-time")).to_have_value("s")
    expect(page.locator("#scale-voltage")).to_have_value("")


def test_records_and_plants_are_compared_side_by_side(address: str, page: Page, tmp_path: Path):
    """Two files without time and input, fitted or held out; two plants; results before."""
    page.goto(f"{address}/#record")
    expect(page.locator("#record-plant option").first).to_be_attached(timeout=WAIT)
    for seed, name in enumerate(("a.csv", "b.csv")):
        pitch = ex.simulate("aero2", np.full((200, 1), 5.0), seed=seed).outputs[:, 0]
        (tmp_path / name).write_text("\n".join(["pitch", *map(str, pitch.tolist()), ""]))
    page.locator("#file").set_input_files(tmp_path / "a.csv")
    expect(status(page, "record")).to_contain_text("a.csv: 1 column,", timeout=WAIT)
    identify = page.get_by_role("button", name="Identify")
    page.locator("#column-time").select_option(label="none: a sampling time")
    page.locator("#column-voltage").select_option(label="none: a constant")
    page.locator("#value-time").fill("0.1")
    identify.click()
    needed = "value [V] of voltage: got no number, needed is a number."
    expect(status(page, "record")).to_have_text(needed)
    page.locator("#value-voltage").fill("5")
    page.locator("#record form summary").click()
    page.get_by_label("Rows start:stop:step").fill(":150")
    page.get_by_label("Initial state").select_option("known")
    page.get_by_label("aero2_lag").check()
    identify.click()
    expect(status(page, "record")).to_have_text("Done: successful.", timeout=WAIT)
    plants = page.locator("#compared-plants tbody th")
    assert sorted(plants.all_inner_texts()) == ["aero2", "aero2_lag"]
    expect(page.locator("#side-by-side")).to_be_hidden()
    commands = page.locator("#record-again pre")
    expect(commands).to_contain_text("excite compare-plants aero2 aero2_lag --record a.csv")
    # A second file, held out; then fitted together with the first.
    page.get_by_label("aero2_lag").uncheck()
    more = page.get_by_label("Add a file")
    more.set_input_files(tmp_path / "b.csv")
    expect(status(page, "record")).to_contain_text("b.csv: 1 column,", timeout=WAIT)
    more.set_input_files(tmp_path / "b.csv")
    expect(status(page, "record")).to_contain_text("b.csv is there already", timeout=WAIT)
    expect(page.locator("#value-voltage")).to_have_value("5")  # assigned as before
    page.get_by_label("b.csv", exact=True).select_option("held out")
    identify.click()
    told = page.locator("#record-verdict")
    expect(told).to_contain_text("b.csv: held-out pitch fit", timeout=WAIT)
    expect(page.locator("#record-signals figcaption b").nth(3)).to_contain_text("b.csv, held out")
    assert page.locator("#compared-plants table").count() == 0
    page.get_by_label("b.csv", exact=True).select_option("fitted")
    identify.click()
    beside = page.locator("#side-by-side thead th")
    titles = ["1: a.csv, aero2", "2: a.csv, aero2", "3: a.csv, b.csv, aero2"]
    expect(beside).to_have_text(["unit", *titles], timeout=WAIT)
    expect(page.locator("#side-by-side")).to_contain_text("held-out fit of pitch")
    assert Axe().run(page).response["violations"] == []
    require_no_sideways_scroll(page)
    page.reload()
    expect(beside).to_have_text(["unit", *titles], timeout=WAIT)
    expect(page.get_by_label("b.csv", exact=True)).to_have_value("fitted")
    page.get_by_role("button", name="Forget the earlier ones").click()
    expect(page.locator("#side-by-side")).to_be_hidden()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1440, 1024, 390])
def test_nothing_hinders_people_who_do_not_see_or_point(
    scheme: Any, width: int, address: str, page: Page
):
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": 900})
    prepared(page, address)
    for part in ("experiment", "record", "runs/a_study", "training"):
        page.evaluate(f"location.hash = {part!r}")
        expect(page.locator(f"#{part.partition('/')[0]}")).to_be_visible()
        if "/" in part:
            expect(page.locator("#run-view canvas")).to_have_count(3)
        found = Axe().run(page).response["violations"]
        assert [(v["id"], v["nodes"][0]["html"]) for v in found] == []


def test_a_run_has_an_address_and_is_found_by_words(address: str, page: Page):
    page.goto(f"{address}/#runs/a_study")
    expect(page.locator("#run-view td").first).to_have_text("1")
    names = page.locator("#run-list a")
    expect(names).to_have_count(3)  # one damaged run hides no other
    page.get_by_label("Words of name, date, plant, kind or figures").fill("campaign aero2")
    expect(names).to_have_count(1)
    names.first.click()
    expect(page).to_have_url(f"{address}/#runs/the_campaign")
    page.go_back()
    expect(page.locator("#run-view td").first).to_have_text("1")
    page.goto(f"{address}/#runs/nothing")
    expect(status(page, "runs")).to_have_text("The run folder has no run nothing.")


def test_a_slow_list_of_runs_does_not_undo_a_later_address(address: str, page: Page):
    page.goto(f"{address}/#experiment")
    held: list[Route] = []
    page.route("**/api/runs", lambda route: route.continue_() if held else held.append(route))
    with page.expect_request("**/api/runs"):
        page.evaluate("location.hash = 'runs/a_study'")
    page.evaluate("location.hash = 'runs/nothing'")
    expect(status(page, "runs")).to_have_text("The run folder has no run nothing.")
    shown = list[str]()
    page.on("request", lambda sent: shown.append(sent.url.partition("/api/run?")[2]))
    with page.expect_response("**/api/runs") as late:
        held[0].continue_()
    late.value.finished()
    page.evaluate("location.hash = 'runs/damaged'")
    expect(page.locator("#run-view h2")).to_have_text("damaged")
    assert [name for name in shown if name] == ["name=damaged"]


def test_runs_are_looked_at(address: str, page: Page):
    page.goto(f"{address}/#runs")
    page.get_by_role("link", name="a_study").click()
    expect(page.locator("#run-view td").first).to_have_text("1")
    assert page.locator("#run-view img").count() == 0  # what looks like a picture is text
    assert page.locator("#run-view canvas").count() == 3
    require_no_sideways_scroll(page)


def test_a_campaign_is_followed_while_it_runs(address: str, folder: Path, page: Page):
    write_campaign(folder / "the_campaign", ["go on: D_p is 3 times as uncertain as asked"])
    page.clock.install()
    page.goto(f"{address}/#runs")
    page.get_by_role("link", name="the_campaign").click()
    shown = page.get_by_role("region", name="Rounds").locator("tbody tr")
    expect(shown).to_have_count(1)
    expect(page.locator("#run-view")).to_contain_text("Not finished")
    # It is followed again after a look at another part of the page.
    page.get_by_role("link", name="Training").click()
    expect(page.locator("#runs")).to_be_hidden()
    page.clock.fast_forward(60_000)
    page.get_by_role("link", name="Runs").click()
    write_campaign(folder / "the_campaign", ["go on", "end"], "every target is reached")
    expect(shown).to_have_count(2, timeout=WAIT)
    expect(page.get_by_role("link", name="Report")).to_be_visible()
    require_no_sideways_scroll(page)


def test_the_form_of_a_training_comes_back_when_the_page_is_loaded_again(address: str, page: Page):
    ready(page, address, "training")
    page.locator("#training-plant").select_option("worst")
    page.get_by_label("Name in the run folder").fill("cautious")
    page.get_by_label("Objective").select_option("goals")
    page.get_by_label("Updates").fill("120")
    page.locator("#training-seeds").fill("3")
    before = page.evaluate(FORM, "training")
    assert (before["training-plant"], before["objective"]) == ("worst", "goals")
    page.reload()
    expect(page.locator("#training .primary")).to_be_enabled(timeout=WAIT)
    expect(page.locator("#training")).to_be_visible()
    expect(page.locator("#resources")).to_contain_text("11.5 million samples")
    assert page.evaluate(FORM, "training") == before
    # The tab is closed, and the address opened again.
    later = ready(page.context.new_page(), address, "training")
    page.close()
    assert later.evaluate(FORM, "training") == before
    # The server was started again, without this plant.
    later.evaluate("""sessionStorage.setItem("excite-training",
      JSON.stringify({ fields: { "training-plant": "my_own", updates: "77" } }))""")
    later.reload()
    gone = "the plant my_own is no longer on the server"
    expect(status(later, "training")).to_have_text(gone, timeout=WAIT)
    expect(later.locator("#updates")).to_have_value("77")  # it is of any plant


def test_a_training_is_started_and_stopped(address: str, page: Page):
    ready(page, address, "training")
    page.get_by_label("Updates").fill("50000")
    page.locator("#training-steps").fill("50")
    expect(page.locator("#resources")).to_contain_text("64 plants an update, 160 million samples")
    page.get_by_role("button", name="Start").click()
    card = page.locator("#trainings section")
    expect(card.get_by_role("status")).to_contain_text("starting", timeout=WAIT)
    expect(card.locator("code")).to_contain_text("excite train aero2 --objective D")
    expect(card.locator(".progress")).to_contain_text("seed 0: ", timeout=WAIT)
    expect(card.get_by_role("status")).to_have_text("training", timeout=WAIT)
    expect(card.locator(".progress")).to_contain_text("of 50,000", timeout=WAIT)
    expect(card.locator("canvas")).to_have_count(5)  # what the curve is drawn on
    expect(card.locator("figcaption").nth(2)).to_have_text(re.compile(r"^bound of Jp %[\d.]+PNG"))
    card.get_by_role("button", name="Stop").click()
    expect(card.get_by_role("status")).to_contain_text("stopped", timeout=WAIT)
    card.get_by_role("button", name="Resume").click()
    expect(card.get_by_role("status")).to_contain_text("starting", timeout=WAIT)
    card.get_by_role("button", name="Stop").click()
    expect(card.get_by_role("status")).to_contain_text("stopped", timeout=WAIT)
    require_no_sideways_scroll(page)


def test_learning_curves_are_smoothed_on_scales_without_outliers(address: str, page: Page):
    """Two seeds of thin lines; one value far from the others is told, and shown on request."""
    page.goto(f"{address}/#runs/a_study")
    expect(page.locator("#run-view canvas")).to_have_count(3)
    place = "document.querySelector('#run-view .plots')"
    page.evaluate(f"""async () => {{
      const {{ curves }} = await import("/static/curves.js"), parent = {place};
      const steps = Array.from({{ length: 20 }}, (_, k) => k);
      const own = (seed) => ({{ agent: "a", is_bound: false, columns: {{ steps,
        return: steps.map((k) => (k || seed ? k : -1e6)), violation_rate: steps.map(() => 0) }} }});
      parent.previousElementSibling.remove();
      parent.replaceChildren();
      curves(parent, [own(0), own(1)]);
    }}""")
    plot = PLOT.format("#run-view .plots .chart", 0)
    note = page.locator("#run-view .plots figcaption").first
    expect(note).to_contain_text("1 outside")
    poll(page, f"{plot}.u?.series.length === 3")
    low, high, width = page.evaluate(f"[...{plot}.what.y, {plot}.what.lines[0].width]")
    assert -100 < low < 0 < 19 < high < 100
    assert width == 1
    page.get_by_label("scales with outliers").check()
    expect(note).not_to_contain_text("outside")
    assert page.evaluate(f"{plot}.what.y[0]") < -1e6
    page.get_by_label("scales with outliers").uncheck()
    page.get_by_label("Smoothing").fill("0.5")
    # Behind each smoothed line is what was measured: after 0, 1, 2 the mean (0/4 + 1/2 + 2) / 1.75.
    assert page.evaluate(f"{plot}.what.lines.length") == 4
    assert page.evaluate(f"{plot}.what.lines[3].y[2]") == pytest.approx(2.5 / 1.75)


def test_a_link_in_a_foreign_page_leaves_the_browser_its_own(address: str, page: Page):
    ready(page, address)
    [before] = page.context.cookies()
    link = f"<a href='{address}/'>look</a>"
    answer: Any = {"content_type": "text/html", "body": link}
    page.route("http://foreign.example/", lambda route: route.fulfill(**answer))
    page.goto("http://foreign.example/")
    page.get_by_role("link").click()
    expect(page.locator("#experiment .primary")).to_be_enabled(timeout=WAIT)
    [after] = page.context.cookies()
    assert after == before


def test_a_download_that_is_refused_says_why(address: str, page: Page):
    page.goto(f"{address}/#runs")
    page.get_by_role("link", name="a_study").click()
    refusal: Any = {"status": 429, "json": {"sentence": "4 jobs already running"}}
    page.route("**/report.html*", lambda route: route.fulfill(**refusal))
    page.locator("#run-view .downloads a").first.click()
    expect(status(page, "runs")).to_have_text("4 jobs already running")
    expect(status(page, "runs")).to_have_class(re.compile("bad"))
    with page.expect_download(timeout=WAIT) as waiting:
        page.locator("#run-view a[href$='table.md']").click()
    assert waiting.value.suggested_filename == "table.md"


def test_a_token_lets_the_browser_in_and_leaves_the_address(chromium: Browser, tmp_path: Path):
    with served(tmp_path, "--token", "schlüssel + 100%", "--workers", "1") as where:
        root = where.partition("#")[0].rstrip("/")
        stranger = chromium.new_page()
        stranger.goto(root)
        expect(stranger.locator("#door")).to_be_visible()
        stranger.get_by_label("Token").fill("a-bad-token")
        stranger.keyboard.press("Enter")
        expect(stranger.locator("#door .status")).to_have_text("wrong token")
        stranger.close()
        known = chromium.new_page()
        known.goto(where)
        expect(known).to_have_url(f"{root}/")
        expect(known.locator("#experiment .primary")).to_be_enabled(timeout=WAIT)
        known.close()


def test_the_answer_stands_above_the_plots(address: str, page: Page):
    prepared(page, address)
    answer = page.locator("#answer")
    expect(answer).to_have_text(
        re.compile(
            r"^Of these 3, aero2 tells most: the standard errors that it allows are 2\.4 times "
            r"smaller \(geometric mean\) than those of chirp\. In this experiment it reached a "
            r"warning level, but no critical one\.$"
        )
    )
    page.locator("#experiment form summary").click()
    page.get_by_label("Played in").select_option("0")
    page.locator("#amplitude").fill("20")
    for label in ("First", "Second"):
        page.get_by_label(label, exact=True).select_option("aero2")
    page.get_by_role("button", name="Run", exact=True).click()
    expect(status(page)).to_have_text("Done.", timeout=WAIT)
    expect(answer).to_have_text(
        "chirp reached a critical level (violation). aero2 reached a warning level, but no "
        "critical one in this experiment."
    )
    expect(page.locator("#comparison tbody tr").first.locator(".best")).to_have_count(0)


def test_columns_that_a_second_file_lacks_are_told(address: str, page: Page):
    page.goto(f"{address}/#record")
    expect(page.locator("#record-plant option").first).to_be_attached(timeout=WAIT)
    first: Any = {
        "name": "a.csv",
        "mimeType": "",
        "buffer": b"time,uEst,pitch,uVal\n0,1,1,1\n1,2,1,1\n",
    }
    page.locator("#file").set_input_files(first)
    expect(status(page, "record")).to_contain_text("Choose the column of voltage.", timeout=WAIT)
    page.locator("#column-voltage").select_option("uEst")
    expect(status(page, "record")).to_contain_text("Map them, then identify.")
    page.locator("#record form summary").click()
    page.locator("#held-out-voltage").select_option("uVal")
    told = "Map them, then identify. Held out, as chosen under Advanced: uVal."
    expect(status(page, "record")).to_contain_text(told)
    other: Any = {"name": "b.csv", "mimeType": "", "buffer": b"t,uEst,winkel\n0,1,1\n1,2,1\n"}
    page.get_by_label("Add a file").set_input_files(other)
    lacking = "b.csv has no column time, pitch: all files need the same names, or are not used."
    expect(status(page, "record")).to_have_text(lacking, timeout=WAIT)
    page.get_by_label("b.csv", exact=True).select_option("not used")
    expect(status(page, "record")).to_contain_text("b.csv: 3 columns")
    empty: Any = {"name": "c.csv", "mimeType": "", "buffer": b"time,pitch\n"}
    page.locator("#file").set_input_files(empty)
    expect(status(page, "record")).to_contain_text("c.csv", timeout=WAIT)
    expect(page.locator("#preview")).to_be_hidden()
