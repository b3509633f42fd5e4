"""Deletion of runs: they are moved into `.deleted` in the run folder, and moved back on request.

Nothing is removed from the disk, and nothing is overwritten. A deletion is one folder there, with
its runs at the paths that they had in the run folder.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from asyncio import to_thread
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route

from ..files import is_locked
from .requests import Body, RefusedError
from .runs import files_of, found, run_named
from .trainings import Training

FOLDER = ".deleted"
"""Where deleted runs are, in the run folder."""


def routes(folder: Path, body: Body, trainings: Sequence[Training]) -> list[Route]:
    """Routes that delete runs and undo it.

    Args:
        trainings: all of this server.
    """

    async def deleted(request: Request) -> JSONResponse:
        names = (await body(request)).get("names")
        if not isinstance(names, list) or not names:
            raise RefusedError(400, "names: a list of runs is needed")
        return JSONResponse({"deletion": await to_thread(_delete, folder, names, trainings)})

    async def undone(request: Request) -> JSONResponse:
        names = await to_thread(_restore, folder, request.path_params["name"])
        return JSONResponse({"names": names})

    return [
        Route("/api/deletions", deleted, methods=["POST"]),
        Route("/api/deletions/{name}", undone, methods=["DELETE"]),
    ]


def _delete(folder: Path, names: Iterable[object], trainings: Sequence[Training]) -> str:
    """Moves runs, all or none; the name of the deletion."""
    every = found(folder)
    runs = {str(name): run_named(every, name) for name in names}
    for name, run in runs.items():
        if run == folder:
            raise RefusedError(409, "the run folder itself is a run; it cannot be deleted here")
        if any(training.is_running and training.folder == run for training in trainings):
            raise RefusedError(409, f"{name} is being trained; stop it first")
        if is_locked(run / ".lock" if run.is_dir() else run):
            raise RefusedError(409, f"{name} cannot be deleted: another process writes into it")
    now = datetime.now(UTC).strftime("%Y-%m-%d-%H%M%S-")
    try:
        trash = _trash(folder)
        trash.mkdir(exist_ok=True)
        place = Path(tempfile.mkdtemp(prefix=now, dir=trash))
        place.chmod(0o755)  # mkdtemp makes folders that other users cannot read
    except OSError as error:
        raise RefusedError(409, f"{FOLDER}: cannot be written ({error.strerror})") from None
    try:
        _move(runs, place)
    except RefusedError:
        _remove_empty(place)
        raise
    return place.name


def _restore(folder: Path, deletion: str) -> list[str]:
    """Moves the runs of a deletion back, all or none; their names."""
    trash = _trash(folder)
    places = {path.name: path for path in trash.iterdir()} if trash.is_dir() else {}
    place = places.get(deletion)
    runs = {} if place is None or place.is_symlink() else found(place)
    if place is None or not runs:
        raise RefusedError(404, f"{FOLDER} in the run folder has no such deletion")
    for name in runs:
        for parent in (folder / inside for inside in list(Path(name).parents)[:-1]):
            if parent.is_symlink() or (parent / "run.json").exists():
                raise RefusedError(409, f"{name} cannot be restored: its folder is a link or a run")
    if (folder / "run.json").exists():
        raise RefusedError(409, "the run folder itself is a run; nothing can be restored into it")
    _move(runs, folder)
    _remove_empty(place)
    return list(runs)


def _trash(folder: Path) -> Path:
    if (folder / FOLDER).is_symlink():
        raise RefusedError(409, f"{FOLDER} in the run folder is a link, which is not followed")
    return folder / FOLDER


def _move(runs: Mapping[str, Path], folder: Path) -> None:
    """Moves runs to their names in a folder, all or none, to where nothing is."""
    done = list[tuple[Path, Path]]()
    try:
        for name, run in runs.items():
            for here in files_of(run).values() if run.is_file() else [run]:
                there = (folder / name).with_name(here.name)
                where = there.relative_to(folder).as_posix()
                if os.path.lexists(there):
                    raise RefusedError(409, f"{where} exists already; nothing was moved")
                try:
                    there.parent.mkdir(parents=True, exist_ok=True)
                    _rename(here, there)
                except FileExistsError:
                    raise RefusedError(409, f"{where} exists already; nothing was moved") from None
                except OSError as error:
                    raise RefusedError(409, f"{name} cannot be moved ({error.strerror})") from None
                done.append((here, there))
    except RefusedError as refused:
        left = [there for here, there in reversed(done) if not _is_renamed(there, here)]
        if left:
            names = ", ".join(sorted(there.name for there in left))
            raise RefusedError(
                409, f"{refused.sentence}, but {names} cannot be moved back from {folder.name}"
            ) from None
        raise


def _rename(here: Path, there: Path) -> None:
    """Renames a file or a folder; FileExistsError where something is there by now.

    A file gets its new name beside the old one, which fails where there is another. `os.rename`
    of a folder replaces at most an empty one; a file on a file system without hard links is the
    only one that could replace what appears between the look and the renaming.
    """
    if not here.is_dir():
        try:
            os.link(here, there, follow_symlinks=False)
        except FileExistsError:
            raise
        except OSError:
            pass  # no links here
        else:
            try:
                os.unlink(here)
            except OSError:
                os.unlink(there)
                raise
            return
    if os.path.lexists(there):
        raise FileExistsError(str(there))
    os.rename(here, there)


def _is_renamed(here: Path, there: Path) -> bool:
    """Renames back; whether that succeeded."""
    try:
        _rename(here, there)
    except OSError:
        return False
    return True


def _remove_empty(place: Path) -> None:
    """Removes a folder and those in it, as far as they are empty."""
    for path, _, _ in os.walk(place, topdown=False):
        with contextlib.suppress(OSError):  # it is not empty
            os.rmdir(path)
