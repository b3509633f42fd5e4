"""Studies by name: shipped studies, and files."""

from __future__ import annotations

from pathlib import Path

from ..description import path_from, unknown

SHIPPED = Path(__file__).parent / "shipped"


def studies() -> dict[str, Path]:
    """The study files that come with the package, by name.

    >>> import excite as ex
    >>> "table1" in ex.studies()
    True
    """
    return {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}


def study_path(name: str | Path) -> Path:
    """File of a study: that of a shipped one by its name, or the path itself.

    Raises:
        ValueError: for a word that is neither the name of a shipped study nor a file.
    """
    path, shipped = path_from("study", name, "a name or a path"), studies()
    if str(name) in shipped:
        return shipped[str(name)]
    if path.suffix == ".toml" or path.exists():
        return path
    raise unknown("study", str(name), [*shipped, "path/to/study.toml"])
