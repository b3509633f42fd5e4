"""A run folder: records, what was computed of each, and results as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ..description import PlantDescription, names_of
from ..files import csv_text, new_run_folder, write_json
from .record import Record, write_record


def write_run(
    path: Path,
    plant: PlantDescription,
    records: Sequence[tuple[Record, Mapping[str, np.ndarray]]],
    contents: Mapping[str, object],
    overwrite: bool = False,
    kind: str = "",
) -> None:
    """Writes a run folder, completely or not at all.

    Args:
        path: of the folder.
        plant: names the columns.
        records: each with values by output [sample, output], which get a file by their name.
        contents: JSON-ready, by the name of their file; `run` marks the folder.
        overwrite: whether a run folder at `path` is replaced; your own files in it are kept.
        kind: of that run.

    Raises:
        ValueError: where `path` is not a run folder, is one and `overwrite` is False, or is one of
            another kind.
    """
    outputs = names_of(plant.outputs)
    tables = r"(simulated|residual|predicted|predicted_sd)(_\d+)?\.csv"
    own = rf"record(_\d+)?\.(csv|json)|{tables}|({'|'.join(contents)})\.json"
    with new_run_folder(path, overwrite, kind, own) as folder:
        for i, (record, computed) in enumerate(records, 1):
            ending = "" if len(records) == 1 else f"_{i}"
            write_record(folder / f"record{ending}.csv", record, plant)
            for name, values in computed.items():
                table = {"time": record.time, **dict(zip(outputs, values.T, strict=True))}
                (folder / f"{name}{ending}.csv").write_text(csv_text(table))
        for name, content in contents.items():
            write_json(folder / f"{name}.json", content)
