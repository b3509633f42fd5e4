"""The notebooks in `docs/notebooks` are executed when the site is built, and become pages of it."""

from __future__ import annotations

import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import nbformat
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient
from nbconvert import MarkdownExporter

_NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
_SECONDS = 900  # at most, for one cell


def on_files(files: Files, *, config: Any) -> Files:
    """Adds a page and its figures for every notebook; a cell that raises ends the build."""
    paths = sorted(_NOTEBOOKS.glob("*.ipynb"))
    with ThreadPoolExecutor(2) as pool:
        for path, (markdown, figures) in zip(paths, pool.map(executed, paths), strict=True):
            page = f"notebooks/{path.stem}"
            link = f'<a href="{path.name}" download>Download this notebook</a>\n\n'
            files.append(File.generated(config, f"{page}.md", content=link + markdown))
            for name, content in figures.items():
                uri = f"notebooks/{name}"
                files.append(File.generated(config, uri, content=content))
    return files


def executed(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown with what its cells print, and its figures by file name."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        NotebookClient(
            notebook, timeout=_SECONDS, kernel_name="python3", resources=resources
        ).execute()
    names = {"output_files_dir": f"{path.stem}_files", "unique_key": path.stem}
    markdown, resources = MarkdownExporter().from_notebook_node(notebook, dict(names))
    return markdown, resources["outputs"]
