"""Pictures of the bench page and of a report for these pages: `python docs/screenshots.py`.

Needs the extras web and dev, and a Chromium (`apt-get install chromium`).
"""

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import Page, expect, sync_playwright

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "docs" / "figures"
PATIENCE = 120_000  # milliseconds; the first experiment waits for what is compiled


def main() -> None:
    words = [sys.executable, "-m", "excite", "serve", "--runs", str(ROOT / "results")]
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen([*words, "--port", "0", "--json"], stdout=subprocess.PIPE) as server,
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
        dark = browser.new_page(viewport={"width": 1000, "height": 900}, color_scheme="dark")
        dark.goto((Path(folder) / "report.html").as_uri())
        dark.screenshot(path=FIGURES / "report.png")
        browser.close()
        server.terminate()


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
    page.get_by_role("link", name="Record", exact=True).first.click()
    page.locator("#file").set_input_files(folder / "record.csv")
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
