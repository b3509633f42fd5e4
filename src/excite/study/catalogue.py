"""Studies by name: shipped studies, and files."""

from __future__ import annotations

import tomllib
from pathlib import Path

from ..description import Listing, path_from, unknown

SHIPPED = Path(__file__).parent / "shipped"


def studies() -> Listing:
    """The studies that come with the package, by name.

    >>> import excite as ex
    >>> ex.studies()["nls"]
    'Nonlinear least squares, Gaussian noise of 0.00063 rad'
    """
    return Listing(
        {n: tomllib.loads(p.read_text("utf-8"))["title"] for n, p in shipped_studies().items()}
    )


def shipped_studies() -> dict[str, Path]:
    """The files of these studies, by name."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}


def study_path(name: str | Path) -> Path:
    """File of a study: that of a shipped one by its name, or the path itself.

    Raises:
        ValueError: for a word that is neither the name of a shipped study nor a file.
    """
    path, shipped = path_from("study", name, "a name or a path"), shipped_studies()
    if str(name) in shipped:
        return shipped[str(name)]
    if path.suffix == ".toml" or path.exists():
        return path
    raise unknown("study", str(name), [*shipped, "path/to/study.toml"])
