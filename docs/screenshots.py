"""Pictures of the bench page and of a report for these pages: `python docs/screenshots.py`.

Needs the extras web and dev, and a Chromium (`apt-get install chromium`).
"""

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.image as mpimg
import numpy as np
from playwright.sync_api import Browser, Page, expect, sync_playwright

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "docs" / "figures"
PATIENCE = 120_000  # milliseconds; the first experiment waits for what is compiled


def main() -> None:
    with (
        tempfile.TemporaryDirectory() as folder,
        tempfile.TemporaryDirectory() as own,
        subprocess.Popen([*words(own), "--port", "0", "--json"], stdout=subprocess.PIPE) as server,
        sync_playwright() as playwright,
    ):
        told = b"".join(iter(server.stdout.readline, b"}\n")) + b"}"
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        experiment(page, json.loads(told)["address"], Path(folder))
        record(page, Path(folder))
        runs(page)
        training(page)
        dark_screens(browser, json.loads(told)["address"], Path(folder))
        dark = browser.new_page(viewport={"width": 1000, "height": 900}, color_scheme="dark")
        dark.goto((Path(folder) / "report.html").as_uri())
        dark.screenshot(path=FIGURES / "report.png")
        browser.close()
        server.terminate()


def words(own: str) -> list[str]:
    """The command of a page that shows the results of this repository, and trains elsewhere."""
    for run in (ROOT / "results").iterdir():
        if run.is_dir():
            (Path(own) / run.name).mkdir()
            for file in run.iterdir():
                if file.is_file():
                    shutil.copy(file, Path(own) / run.name)
    return [sys.executable, "-m", "excite", "serve", "--runs", own]


def training(page: Page) -> None:
    page.set_viewport_size({"width": 1440, "height": 900})
    page.evaluate("location.hash = 'training'")
    for label, value in (("Updates", "2000"), ("Length", "60"), ("Seeds", "2")):
        page.locator("#training").get_by_label(label).fill(value)
    page.get_by_role("button", name="Start").click()
    card = page.locator("#trainings section")
    expect(card.locator(".progress")).to_contain_text("left", timeout=PATIENCE)
    expect(card.locator(".progress")).to_contain_text("updating", timeout=PATIENCE)
    page.wait_for_timeout(20_000)  # some rows of the curves
    page.screenshot(path=FIGURES / "bench-page-training.png", full_page=True)
    card.get_by_role("button", name="Stop").click()
    expect(card.get_by_role("status")).to_contain_text("stopped", timeout=PATIENCE)


def dark_screens(browser: Browser, address: str, folder: Path) -> None:
    """The top of the page at 390 and 1024 px, dark, beside each other."""
    pictures = []
    for width in (390, 1024):
        page = browser.new_page(viewport={"width": width, "height": 1100}, color_scheme="dark")
        page.goto(address)
        expect(page.locator("#comparison tbody tr")).to_have_count(3, timeout=PATIENCE)
        page.evaluate("document.querySelector('#experiment .view').scrollIntoView()")
        page.screenshot(path=folder / f"{width}.png")
        pictures.append(mpimg.imread(folder / f"{width}.png")[..., :3])
        page.close()
    gap = np.ones((1100, 20, 3))
    mpimg.imsave(FIGURES / "bench-page-dark.png", np.hstack([pictures[0], gap, pictures[1]]))


def experiment(page: Page, address: str, folder: Path) -> None:
    page.goto(address)
    expect(page.locator("#experiment .primary")).to_be_enabled(timeout=PATIENCE)
    page.get_by_role("button", name="Run", exact=True).click()
    expect(page.locator("#experiment .status")).to_have_text("Done.", timeout=PATIENCE)
    page.screenshot(path=FIGURES / "bench-page.png", full_page=True)
    for name in ("record.csv", "report.html"):
        with page.expect_download() as waiting:
            page.locator(f"#outcome a[href$='{name}']").click()
        waiting.value.save_as(folder / name)


def record(page: Page, folder: Path) -> None:
    """A record, another one that is held out, and another plant."""
    page.get_by_role("link", name="Record", exact=True).first.click()
    words = ["excite", "simulate", "aero2", "--excitation", "prbs", "--seed", "1", "--out"]
    subprocess.run([sys.executable, "-m", *words, folder / "held_out.csv"], check=True)
    page.locator("#file").set_input_files([folder / "record.csv", folder / "held_out.csv"])
    page.get_by_label("held_out.csv", exact=True).select_option("held out")
    page.locator("#record form summary").click()
    page.get_by_label("aero2_lag").check()
    page.locator("#record form summary").click()
    page.get_by_role("button", name="Identify").click()
    expect(page.locator("#record .status")).to_have_text("Done: successful.", timeout=PATIENCE)
    page.screenshot(path=FIGURES / "bench-page-record.png", full_page=True)


def runs(page: Page) -> None:
    page.set_viewport_size({"width": 1280, "height": 1585})
    page.evaluate("location.hash = 'runs/frontier'")
    chart = page.locator(".frontier")
    expect(chart.locator(".method")).to_have_count(17)
    chart.press("End")
    chart.blur()
    page.locator("#run-view").evaluate("(view) => view.scrollIntoView()")
    page.screenshot(path=FIGURES / "bench-page-study.png")


if __name__ == "__main__":
    main()
