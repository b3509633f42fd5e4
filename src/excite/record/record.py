"""`Record`: one recorded experiment, its file, and the sidecar beside it."""

from __future__ import annotations

import html
import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..description import PlantDescription, display_unit, path_from, wrong_type
from ..files import csv_text, require_new_file, require_unlocked, write_bytes, write_json
from .table import DataFrame, data_frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

RECORD_KIND = "excite record"

TEXT_ENDINGS = (".csv", ".txt", ".dat", ".tsv")
READ_ENDINGS = (*TEXT_ENDINGS, ".mat", ".h5", ".hdf5", ".parquet", ".mcap", ".db3")
WRONG_ENDING = f"experiment files end in {', '.join(READ_ENDINGS[:-1])} or {READ_ENDINGS[-1]}"
_SPREADSHEETS = (".xlsx", ".xlsm", ".xlsb", ".xls", ".ods")
_MAX_FILE, _MAX_SIDECAR = 2**29, 2**24  # bytes


@dataclass(frozen=True, repr=False)
class Record:
    """One recorded experiment.

        >>> import excite as ex
        >>> ex.simulate("aero2", "chirp", steps=100)
        record of aero2, chirp: 101 samples, every 0.1 s
          voltage: -7.19 to 7.18 V
          pitch: -8.36 to 9.85 deg

    Attributes:
        time: sampling instants [s].
        inputs: by sample and input; row k is held from time[k] on, the last acts after the end.
        outputs: measured, by sample and output.
        metadata: content of the sidecar; empty without one.
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
        time: ArrayLike,
        inputs: ArrayLike,
        outputs: ArrayLike,
        metadata: Mapping[str, Any] | None = None,
        source: str = "",
    ) -> Record:
        """A record of T + 1 samples from T inputs; its last row repeats the last input."""
        inputs = np.asarray(inputs)
        held = np.concatenate([inputs, inputs[-1:]])
        return cls(np.asarray(time), held, np.asarray(outputs), metadata or {}, source)

    def __post_init__(self) -> None:
        for name, dimensions in (("time", 1), ("inputs", 2), ("outputs", 2)):
            try:
                values = np.asarray(getattr(self, name), float)
            except (TypeError, ValueError):
                raise wrong_type(name, getattr(self, name), "an array of numbers") from None
            if values.ndim == 1 and dimensions == 2:  # of a plant with one input or output
                values = values[:, None]
            if values.ndim != dimensions or len(values) != np.size(self.time):
                raise ValueError(
                    f"{name} of a record needs one row for each of {np.size(self.time)} samples: "
                    f"got shape {values.shape}"
                )
            object.__setattr__(self, name, values)

    def __repr__(self) -> str:
        return "\n".join(
            [
                self._title(),
                *(
                    f"  {name}: {low} to {high} {unit}".rstrip()
                    for name, low, high, unit in self._ranges()
                ),
                *self._warning(),
            ]
        )

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        caption = html.escape("; ".join([self._title(), *self._warning()]))
        rows = [("", "smallest", "largest", "unit"), *self._ranges()]
        body = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows]
        lines = [f"<tr>{line}</tr>\n" for line in body]
        return f"<table>\n<caption>{caption}</caption>\n{''.join(lines)}</table>\n"

    def _title(self) -> str:
        """The plant, what was played, and the samples."""
        about = self.metadata.get("provenance") or {}
        made_with = self.metadata.get("plant") or {}
        played = f", {about['excitation']}" if "excitation" in about else ""
        return (
            f"record of {made_with.get('name', 'an unknown plant')}{played}: "
            f"{len(self.time)} samples, every {self.dt:.4g} s"
        )

    def _ranges(self) -> list[tuple[str, str, str, str]]:
        """Name, smallest and largest value, and unit of each input and output."""
        made_with, found = self.metadata.get("plant") or {}, []
        for kind, values in (("inputs", self.inputs), ("outputs", self.outputs)):
            parts = made_with.get(kind) or [
                {"name": f"{kind[:-1]} {i + 1}", "unit": ""} for i in range(values.shape[1])
            ]
            for part, column in zip(parts, values.T, strict=True):
                unit, factor = display_unit(part["unit"])
                low, high = factor * np.nanmin(column), factor * np.nanmax(column)
                found.append((part["name"], f"{low:.3g}", f"{high:.3g}", unit))
        return found

    def _warning(self) -> list[str]:
        """A sentence where the policy that was played is of another plant."""
        about = self.metadata.get("provenance") or {}
        return [f"warning: {about['warning']}"] if "warning" in about else []

    @property
    def description(self) -> PlantDescription:
        """The plant that the sidecar names; ValueError without one."""
        if not self.metadata.get("plant"):
            raise ValueError(
                f"{self.source or 'the record'} does not tell its plant: name the plant"
            )
        return PlantDescription.from_dict(self.metadata["plant"])

    def save(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Writes the record as CSV or MAT, by the file's ending, and its sidecar.

        Raises:
            ValueError: for another ending, a folder that does not exist, a file that exists
                and not `overwrite`, and a record without a plant.
        """
        require_record_path(path_from("path", path), overwrite)
        write_record(path, self, self.description)

    def plot(self) -> Figure:
        """Inputs and outputs over time, with the safety levels; ValueError without a plant."""
        from .figure import episode_figure

        return episode_figure(self.description, self)

    def to_pandas(self) -> DataFrame:
        """Columns time, inputs, outputs, by the plant's names; ValueError without pandas."""
        values = np.column_stack([self.time, self.inputs, self.outputs]).T
        return data_frame(dict(zip(self.description.columns, values, strict=True)))

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    @property
    def starts_at_initial_state(self) -> bool:
        """Whether the sidecar says that the plant was at its initial state."""
        return self.metadata.get("starts_at_initial_state") is True


def require_record_ending(path: Path) -> None:
    """Raises ValueError for a file to write that is neither .csv nor .mat."""
    if path.suffix.lower() not in (".csv", ".mat"):
        raise ValueError(f"{path}: experiment files end in .csv or .mat")


def require_readable(path: Path) -> None:
    """Raises ValueError, before anything is read, for what is no experiment file."""
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise ValueError(
                f"{path}: is a folder; only files can be read, and ROS 2 bags, folders with a "
                "metadata.yaml"
            )
        for part in path.iterdir():
            if not part.is_dir():
                _require_readable_file(part)
        return
    if path.suffix.lower() in _SPREADSHEETS:
        raise ValueError(
            f"{path}: spreadsheets are not read; save the sheet as CSV or Parquet (.csv, .parquet)"
        )
    if path.suffix.lower() not in READ_ENDINGS:
        raise ValueError(f"{path}: {WRONG_ENDING}")
    _require_readable_file(path)


def _require_readable_file(path: Path) -> None:
    if not path.exists():
        raise ValueError(f"{path}: no such file")
    if not os.access(path, os.R_OK):
        raise ValueError(f"{path}: you are not allowed to read this file")
    if not path.is_file():
        raise ValueError(f"{path}: is a pipe or a device; only files can be read")
    if (size := path.stat().st_size) > _MAX_FILE:
        raise ValueError(
            f"{path}: the file has {size / 2**20:.0f} MiB, more than {_MAX_FILE >> 20}; save it "
            "with fewer rows or columns"
        )


def require_record_path(path: Path, overwrite: bool) -> None:
    """Raises ValueError, before anything is computed, where a record may not be written."""
    require_record_ending(path)
    sidecar = path.with_suffix(".json")
    if sidecar.is_file() and not read_sidecar(path):
        raise ValueError(
            f"{sidecar} is no sidecar of a record and would be lost; choose another name for the "
            "record"
        )
    require_new_file(path, overwrite)


def require_matlab(path: Path) -> ModuleType:
    """SciPy's reader and writer of MAT files; ValueError where SciPy is not installed."""
    try:  # a laboratory computer runs experiments without it, on CSV files
        import scipy.io
    except ImportError:
        raise ValueError(
            f"{path}: MAT files need SciPy (pip install scipy); CSV does not"
        ) from None
    return scipy.io


def read_sidecar(path: Path) -> Mapping[str, Any]:
    """The sidecar's content; empty where there is none, or for another kind of file."""
    sidecar = path.with_suffix(".json")
    if not sidecar.is_file():
        return {}
    if sidecar.stat().st_size > _MAX_SIDECAR:
        raise ValueError(
            f"{sidecar}: has more than {_MAX_SIDECAR >> 20} MiB and is no sidecar of a record; "
            "rename it"
        )
    try:
        content = json.loads(sidecar.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{sidecar}: cannot be read ({error.strerror})") from None
    except (json.JSONDecodeError, UnicodeError) as error:
        raise ValueError(f"{sidecar}: cannot be read as JSON ({error})") from None
    except (ValueError, RecursionError):
        raise ValueError(
            f"{sidecar}: cannot be read as JSON (a number is too long, or lists are nested too "
            "deeply)"
        ) from None
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


def described_in(path: Path | DataFrame) -> PlantDescription:
    """The plant that a record's sidecar names; ValueError without one, as of a DataFrame."""
    if not isinstance(path, Path):
        raise ValueError("a DataFrame does not tell its plant: name the plant")
    require_readable(path)
    content = read_sidecar(path).get("plant")
    if not content:
        raise ValueError(
            f"{path} does not tell its plant (no file {path.with_suffix('.json').name} beside it "
            "does): name the plant (--plant in a command)"
        )
    return PlantDescription.from_dict(content)


def write_record(
    path: str | os.PathLike[str], record: Record, description: PlantDescription
) -> None:
    """Writes a record as CSV or MAT, by the file's ending, and its sidecar.

    Raises:
        ValueError: for another ending, a folder that does not exist, or a file into which
            another process records.
    """
    path = Path(path)
    require_record_path(path, overwrite=True)
    require_unlocked(path)
    values = np.column_stack([record.time, record.inputs, record.outputs]).T
    columns = dict(zip(description.columns, values, strict=True))
    buffer = io.BytesIO()
    if path.suffix.lower() == ".mat":
        require_matlab(path).savemat(buffer, {n: v[:, None] for n, v in columns.items()})
    else:
        buffer.write(csv_text(columns).encode())
    # The origin in an earlier sidecar is kept.
    sidecar = {
        "plant": description.to_dict(),
        "plant_hash": description.hash,
        **record.metadata,
        "kind": RECORD_KIND,
        "dt": record.dt,
    }
    # The sidecar first: without it the record's initial state would be read as unknown.
    write_json(path.with_suffix(".json"), sidecar)
    write_bytes(path, buffer.getvalue())
