"""Pages and files that stand beside `docs/` and are linked from it become part of the site.

A link that works in the repository (`../results/nls/table.md`) works on the site, too, and nothing
is written twice. A link to a notebook leads to the page that `notebooks.py` makes of it.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

_ROOT = Path(__file__).parents[2]
_LINK = re.compile(r"(?P<image>!?)\[(?P<text>[^\]]*)\]\((?P<path>[^)#\s]*)(?P<anchor>#[^)\s]*)?\)")


def on_files(files: Files, *, config: Any) -> Files:
    """Adds what the pages link to, and what these pages link to in turn."""
    waiting = [_ROOT / "CHANGELOG.md", _ROOT / "CONTRIBUTING.md"]
    waiting += sorted((_ROOT / "docs").rglob("*.md"))
    seen = set(waiting)
    while waiting:
        path = waiting.pop()
        uri = _uri(path)
        if path.suffix != ".ipynb" and files.get_file_from_path(uri) is None:
            files.append(File.generated(config, uri, abs_src_path=str(path)))
        targets = _targets(path) if path.suffix == ".md" else set()
        waiting += sorted(targets - seen)
        seen |= targets
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Links between pages of the site instead of files; a folder is no page, its name remains."""
    here = _ROOT / "docs" / page.file.src_uri
    if (_ROOT / page.file.src_uri).exists():
        here = _ROOT / page.file.src_uri
    if page.file.src_uri.startswith("results/"):
        page.meta["search"] = {"exclude": True}  # rows of numbers would be found before words
    if page.file.src_uri == "index.md":
        page.meta["hide"] = ["navigation"]  # the tabs above are enough
    start = posixpath.dirname(page.file.src_uri) or "."

    def link(found: re.Match[str]) -> str:
        path = (here.parent / found["path"]).resolve()
        if not found["path"] or not path.exists():
            return found[0]
        if path.is_dir():
            return found["text"]
        target = posixpath.relpath(_uri(path), start)
        return f"{found['image']}[{found['text']}]({target}{found['anchor'] or ''})"

    return _LINK.sub(link, markdown)


def _targets(page: Path) -> set[Path]:
    links = [page.parent / found["path"] for found in _LINK.finditer(page.read_text())]
    return {path.resolve() for path in links if path.is_file()}


def _uri(path: Path) -> str:
    """Where a file stands in the site."""
    place = path.relative_to(_ROOT).as_posix().removeprefix("docs/")
    return place.removesuffix(".ipynb") + ".md" if place.endswith(".ipynb") else place
