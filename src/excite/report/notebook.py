"""A report as a Jupyter notebook: the answer as text, the data and figures as Python."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

from . import content
from .content import Document
from .markdown import markdown, source, text

_IMPORTS = "from pathlib import Path\n\nimport excite as ex"


def notebook_page(document: Document, paths: Sequence[str]) -> str:
    """A report as a notebook that has not been executed.

    Args:
        document: what it says; figures that no code draws are left out.
        paths: of the runs, from the place of the notebook.
    """
    cells = [
        {"id": f"cell-{i}", "metadata": {}, "source": lines.splitlines(keepends=True), **kind}
        for i, (kind, lines) in enumerate(_cells(document, paths), 1)
    ]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook = {
        "cells": cells,
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


_TEXT: dict[str, Any] = {"cell_type": "markdown"}
_CODE: dict[str, Any] = {"cell_type": "code", "execution_count": None, "outputs": []}


def _cells(document: Document, paths: Sequence[str]) -> Iterator[tuple[dict[str, Any], str]]:
    """Kind and lines of every cell."""
    yield _TEXT, f"# {text(document.title)}"
    for title, body in document.beside:
        yield _TEXT, "\n\n".join([f"## {text(title)}", *map(markdown, body)])
    yield _CODE, _IMPORTS
    several = len(paths) > 1
    for title, section, path in zip(document.titles, document.sections, paths, strict=True):
        answers = [markdown(part) for part in section.body if isinstance(part, content.Answer)]
        head = [f"## {text(title)}"] * several
        yield _TEXT, "\n\n".join([*head, source(section), *answers])
        yield _CODE, f"run = Path({path!r})\n\n{section.code}"
        for part in section.body:
            if isinstance(part, content.Figure) and part.code:
                yield _TEXT, text(part.caption)
                yield _CODE, part.code
