"""The record of a running experiment: every sample is on disk before the next.

The file belongs to one process from the beginning: another one that wants to record into it
is refused. The lock is the system's, and ends with the process. The sidecar is written before
the first sample, and again at the end with the reason. A process that is killed leaves a
valid record of all samples so far.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Self

import numpy as np

from ..description import PlantDescription
from ..files import json_text, took_lock, write_bytes
from ..record import RECORD_KIND, require_record_path

_RESERVE = 16_384  # spaces in a sidecar, overwritten by its end if the disk is full


class Recorder:
    """Appends to a CSV record; a context manager."""

    def __init__(
        self,
        path: Path,
        description: PlantDescription,
        metadata: Mapping[str, object],
        overwrite: bool = False,
    ) -> None:
        """A record at `path`, which ends in .csv.

        Args:
            metadata: for the sidecar: policy hash, limits, versions.

        Raises:
            ValueError: if it may not be written.
        """
        require_record_path(path, overwrite)
        if path.suffix.lower() != ".csv":
            raise ValueError(f"{path}: an experiment is recorded as .csv, line by line")
        if "clock" in description.columns:
            raise ValueError(
                "no input or output may be called 'clock': records have a column of this name"
            )
        self._path, self._description = path, description
        self._metadata = {
            "plant": description.to_dict(),
            "plant_hash": description.hash,
            "starts_at_initial_state": False,
            **metadata,
            "kind": RECORD_KIND,
            "dt": description.dt,
        }
        self._overwrite, self._has_begun = overwrite, False
        self.num_samples = 0

    def __enter__(self) -> Self:
        """Takes the file for this process; an older record is kept until `begin`.

        Raises:
            ValueError: if another process records into it.
        """
        self._was_there = self._path.exists()
        # Unbuffered: a line is one call.
        self._file = self._path.open("ab", buffering=0)
        try:
            if not took_lock(self._file):
                raise ValueError(f"{self._path}: another process records into this file")
            found = os.fstat(self._file.fileno())
            if not (self._path.exists() and os.path.samestat(found, self._path.stat())):
                raise ValueError(f"{self._path}: another process has just removed this file")
            # Another process may have recorded into it meanwhile.
            require_record_path(self._path, self._overwrite or not found.st_size)
        except BaseException:
            self._file.close()
            raise
        return self

    def begin(self) -> None:
        """Writes the sidecar and the header.

        Raises:
            ValueError, OSError: if that fails; an older record is then kept if possible.
        """
        self._write_sidecar({"ended": None}, _RESERVE)
        self._has_begun = True
        self._file.truncate(0)
        self._line([*self._description.columns, "clock"])

    def append(self, inputs: np.ndarray, outputs: np.ndarray, clock: float) -> None:
        """One more sample: outputs measured at it and inputs held from it.

        Args:
            clock: the rig's time [s]; the column `time` has the nominal one.
        """
        nominal = self.num_samples * self._description.dt
        numbers = (nominal, *np.asarray(inputs).tolist(), *np.asarray(outputs).tolist(), clock)
        self._line([repr(float(x)) for x in numbers])
        self.num_samples += 1

    def end(self, ended: Mapping[str, object]) -> None:
        """Writes to the sidecar how the experiment ended, also on a full disk."""
        try:
            self._write_sidecar({"ended": dict(ended)})
        except ValueError:
            text = json_text({**self._metadata, "ended": dict(ended)}).encode()
            with self._path.with_suffix(".json").open("r+b") as file:
                if len(text) > file.seek(0, os.SEEK_END):
                    raise
                file.seek(0)
                file.write(text)
                file.truncate()

    def __exit__(self, *_: object) -> None:
        """Closes the file, and removes it if nothing was written."""
        is_empty = not os.fstat(self._file.fileno()).st_size
        is_mine = self._has_begun or not self._was_there
        if is_empty and is_mine and os.name != "nt":  # before another process can lock it
            self._remove()
        self._file.close()
        if is_empty and is_mine and os.name == "nt":  # open files cannot be removed
            self._remove()

    def _remove(self) -> None:
        for path in [self._path, self._path.with_suffix(".json")][: 1 + self._has_begun]:
            with contextlib.suppress(OSError):
                path.unlink()

    def _line(self, words: list[str]) -> None:
        line, before = (",".join(words) + "\n").encode(), self._file.tell()
        try:
            num_written = self._file.write(line)
        except OSError as error:
            raise OSError(f"{self._path}: cannot be written ({error.strerror})") from None
        if num_written != len(line):
            self._file.truncate(before)  # a partial line would make the file unreadable
            raise OSError(f"{self._path}: the disk is full")

    def _write_sidecar(self, more: Mapping[str, object], reserve: int = 0) -> None:
        text = json_text({**self._metadata, **more}) + " " * reserve + "\n"
        write_bytes(self._path.with_suffix(".json"), text.encode())
