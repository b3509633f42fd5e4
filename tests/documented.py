"""What the documentation promises, for tests to hold against what is printed."""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent


def section(command: str) -> str:
    """What docs/reference/machine-readable.md says of `excite COMMAND --json`."""
    page = (ROOT / "docs" / "reference" / "machine-readable.md").read_text()
    return page.split(f"## `excite {command} --json`")[1].split("\n## ")[0]


def documented_words(command: str) -> set[str]:
    """Every key that the section names."""
    return {
        word
        for span in re.findall("`(.+?)`", section(command))
        for word in re.findall(r"\w+", span)
    }


def documented(command: str) -> set[str]:
    """The keys in the first column of the section's table."""
    cells = [line.split("|")[1] for line in section(command).splitlines() if line[:3] == "| `"]
    return {key for cell in cells for key in re.findall(r"`(\w+)`", cell)}
