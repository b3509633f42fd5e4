"""The browser in which pages are tested."""

import os
import shutil

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


def require_chromium() -> None:
    """Skips a module where there is none, unless it is asked for."""
    if CHROMIUM is None and os.environ.get("EXCITE_BROWSER_TESTS") != "1":
        pytest.skip(
            "no chromium on this computer (apt-get install chromium)", allow_module_level=True
        )
