"""`Record`: one recorded experiment, its file, and the sidecar beside it."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..description import PlantDescription
from ..files import csv_text, require_new_file, write_bytes, write_json

try:  # a laboratory computer runs experiments without it, on CSV files
    import scipy.io as matlab
except ImportError:
    matlab = None

RECORD_KIND = "excite record"


@dataclass(frozen=True)
class Record:
    """One recorded experiment.

    Attributes:
        time: sampling instants [s].
        inputs: by sample and input; row k is held from time[k] on, the last acts after the end.
        outputs: measured, by sample and output.
        metadata: what the sidecar says; empty without one.
        source: where the record came from, for messages.
    """

    time: np.ndarray
    inputs: np.ndarray
    outputs: np.ndarray
    metadata: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""

    @classmethod
    def of_episode(
        cls,
        time: Any,
        inputs: Any,
        outputs: Any,
        metadata: Mapping[str, Any] | None = None,
        source: str = "",
    ) -> Record:
        """A record of T + 1 samples from T inputs; its last row goes on holding the last."""
        inputs = np.asarray(inputs)
        held = np.concatenate([inputs, inputs[-1:]])
        return cls(np.asarray(time), held, np.asarray(outputs), metadata or {}, source)

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    @property
    def starts_at_initial_state(self) -> bool:
        """Whether the sidecar says that the plant was at its initial state."""
        return self.metadata.get("starts_at_initial_state") is True


def require_record_ending(path: Path) -> None:
    """Raises ValueError for a file that is neither .csv nor .mat."""
    if path.suffix.lower() not in (".csv", ".mat"):
        raise ValueError(f"{path}: experiment files end in .csv or .mat")


def require_record_path(path: Path, overwrite: bool) -> None:
    """Raises ValueError, before anything is computed, where no record may be written."""
    require_record_ending(path)
    sidecar = path.with_suffix(".json")
    if sidecar.is_file() and not read_sidecar(path):
        raise ValueError(f"{sidecar} is no sidecar of a record and would be lost; rename one")
    require_new_file(path, overwrite)


def require_matlab(path: Path) -> Any:
    """SciPy's reader and writer of MAT files; ValueError where SciPy is not installed."""
    if matlab is None:
        raise ValueError(f"{path}: MAT files need SciPy (pip install scipy); CSV does not")
    return matlab


def read_sidecar(path: Path) -> Mapping[str, Any]:
    """The sidecar's content; empty where there is none, or where it is not ours."""
    sidecar = path.with_suffix(".json")
    if not sidecar.is_file():
        return {}
    try:
        content = json.loads(sidecar.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise ValueError(f"{sidecar}: cannot be read as JSON ({error})") from None
    if not (isinstance(content, dict) and content.get("kind") == RECORD_KIND):
        return {}
    plant = content.get("plant", {})
    if not isinstance(plant, dict):
        raise ValueError(f"{sidecar}: 'plant' is no plant description")
    if plant:
        try:
            PlantDescription.from_dict(plant)
        except ValueError as error:
            raise ValueError(f"{sidecar}: {error}") from None
    return content


def write_record(
    path: str | os.PathLike[str], record: Record, description: PlantDescription
) -> None:
    """Writes a record as CSV or MAT, as the ending says, and its sidecar.

    Raises:
        ValueError: for another ending, or a folder that does not exist.
    """
    path = Path(path)
    require_record_path(path, overwrite=True)
    values = np.column_stack([record.time, record.inputs, record.outputs]).T
    columns = dict(zip(description.columns, values, strict=True))
    buffer = io.BytesIO()
    if path.suffix.lower() == ".mat":
        require_matlab(path).savemat(buffer, {n: v[:, None] for n, v in columns.items()})
    else:
        buffer.write(csv_text(columns).encode())
    # What an earlier sidecar says of the record's origin outlives later uses of it.
    sidecar = {
        "plant": description.to_dict(),
        "plant_hash": description.hash,
        **record.metadata,
        "kind": RECORD_KIND,
        "dt": record.dt,
    }
    # The sidecar first: a record without one would be read as one of unknown start.
    write_json(path.with_suffix(".json"), sidecar)
    write_bytes(path, buffer.getvalue())
