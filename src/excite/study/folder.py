"""The run folder of a study: paths and contents of its files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from .. import files
from ..files import folder_word
from ..plant import AbstractPlant
from .spec import Study, study_from


def seed_folder(folder: Path, agent: str, seed: int) -> Path:
    """Folder of a seed of an agent."""
    return folder / "seeds" / folder_word(agent) / str(seed)


def agent_settings(study: Study, plant: AbstractPlant, agent: str) -> dict[str, object]:
    """All settings, except the plant, that determine the result of a seed, JSON-ready."""
    own = study.agent(agent).settings(plant, study.uncertainty)
    later = {"coast": study.coast, "prior": study.prior}
    used = {name: value for name, value in later.items() if value}  # older fingerprints stay valid
    return {**own, "spread": study.spread, "num_steps": study.num_steps, **used}


def fingerprint(study: Study, plant: AbstractPlant, agent: str) -> str:
    """SHA-256 of those settings and the plant's hash."""
    settings = {**agent_settings(study, plant, agent), "plant": plant.description.hash}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


def study_of(folder: Path) -> Study:
    """The study of a run folder; ValueError where there is none."""
    path = folder / "study.json"
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
    if not path.is_file():
        raise ValueError(f"{folder} holds no study")
    try:
        return study_from(read_json(path), "settings")
    except ValueError:
        raise damaged(path) from None


def read_json(path: Path, *keys: str) -> dict[str, Any]:
    """Content of a file of a run folder, an object with these keys.

    Raises:
        ValueError: where it cannot be read, or holds something else.
    """
    return files.read_json(path, *keys, advice=advice(path))


_REMEDIES = {
    "study.json": "if the folder is of this study, delete the file: 'excite study run' writes it",
    "run.json": "if the folder is of this study, delete the file: 'excite study run' writes it",
    "clairvoyant.json": "delete it: 'excite study run' designs them again",
    "methods.json": "delete it: 'excite study run' computes it again",
    "safety.json": "delete it: 'excite study run' counts the violations again",
    "table.json": "delete it: 'excite study run' writes it again",
}


def read_columns(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Columns of a CSV file of a run folder, these among them; ValueError for another file."""
    return files.read_columns(path, names, advice=advice(path))


def advice(path: Path) -> str:
    """Advice for a damaged file of a run folder."""
    of_seed = f"delete {path.parent}: 'excite study run' trains that seed from the beginning"
    return _REMEDIES.get(path.name, of_seed)


def damaged(path: Path) -> ValueError:
    """The error for a damaged file of a run folder, with advice."""
    return files.damaged(path, advice(path))
