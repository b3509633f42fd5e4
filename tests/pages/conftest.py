"""A browser for the tests of pages."""

from collections.abc import Iterator
from typing import Any

import pytest
from chromium import ARGUMENTS, CHROMIUM
from playwright.sync_api import Browser, Page, sync_playwright

WATCH = """
addEventListener("DOMContentLoaded", () => {
  const times = (window.frames_seen = []);
  const said = (window.sentences_said = []);
  const status = document.querySelector("#experiment .status");
  const progress = document.querySelector("#experiment .progress");
  if (!status) return; // another page
  new MutationObserver(() => said.push(status.textContent)).observe(status, { childList: true });
  new MutationObserver(() => {
    if (progress.textContent) times.push(performance.now());
  }).observe(progress, { childList: true });
});
"""


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    assert CHROMIUM, "EXCITE_BROWSER_TESTS=1 asks for a browser, and there is no chromium"
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield opened
        opened.close()


@pytest.fixture
def page(chromium: Browser) -> Iterator[Page]:
    """A browser of its own; whatever its console says is an error."""
    context = chromium.new_context(viewport={"width": 1440, "height": 1000})
    opened, said = context.new_page(), list[Any]()
    opened.on("console", lambda message: said.append(message.text))
    opened.on("pageerror", lambda error: said.append(str(error)))
    opened.on("dialog", lambda dialog: said.append(dialog.message))
    opened.add_init_script(WATCH)
    yield opened
    context.close()
    # A refused request is told to the user; the browser itself notes it, too.
    assert [text for text in said if "Failed to load resource" not in text] == []
