"""What a worker does for a study: trains one seed of an agent, or evaluates the methods.

Every function here takes and returns plain data, so that it runs in any process on any
machine; it is called by name. A seed that was interrupted goes on from its checkpoint, a
seed repeated gives the same result.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..excitation import PolicyExcitation
from ..files import write_bytes, write_json
from ..plant import AbstractPlant
from ..policy import Policy
from ..study import Study, study_from
from ..training.base import Checkpoint
from ..training.ppo import train
from .base import evaluate_method

CHECKPOINT_SECONDS = float(os.environ.get("EXCITE_CHECKPOINT_SECONDS", "20"))
"""Least time between two checkpoints of a seed."""

COLLAPSED = 0.01
"""An agent whose RMS input over the evaluation is below this fraction of its limit."""


def methods_task(study: Mapping[str, Any], plant: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows of the study's own methods; the arguments are those of `seed_task`."""
    with _unpacked(study, plant) as (chosen, built):
        rows = []
        for name, excitation in chosen.build_methods(built).items():
            rows += evaluate_method(chosen, built, name, excitation)[0]
        return rows


def seed_task(
    study: Mapping[str, Any],
    plant: Mapping[str, Any],
    agent: str,
    seed: int,
    folder: str | None,
) -> dict[str, Any]:
    """A trained policy, its learning curve, and how it does in the evaluation.

    Args:
        study: its settings.
        plant: `text`, the source of a user's own plant or None, and the plant's `hash`.
        agent, seed: what to train.
        folder: for checkpoints and logs, where this machine sees it.
    """
    with _unpacked(study, plant) as (chosen, built):
        keeper = _Keeper(Path(folder) if folder and Path(folder).is_dir() else None)
        env, settings = chosen.build_env(built, agent), chosen.build_training(agent)
        trained = train(
            env,
            settings,
            seed,
            resume=keeper.saved(),
            on_rollout=keeper.on_rollout,
            log_folder=keeper.log_folder,
        )
        seconds = keeper.seconds()
        provenance = {
            "excite": __version__,
            "study": chosen.name,
            "agent": agent,
            "seed": seed,
            "targets": list(chosen.agents[agent].targets or []),
            "method": chosen.agents[agent].method,
            "training": dataclasses.asdict(settings),
        }
        policy = Policy(built.description, env.layout, trained.weights, provenance)
        metrics = {
            "agent": agent,
            "seed": seed,
            **_evaluated(chosen, built, agent, policy),
            "validation": trained.curve[-1],
            "train_seconds": seconds,
        }
        return {"policy": policy.to_bytes(), "curve": trained.curve, "metrics": metrics}


def _evaluated(study: Study, plant: AbstractPlant, agent: str, policy: Policy) -> dict[str, Any]:
    rows, rms = evaluate_method(study, plant, agent, PolicyExcitation.of(policy))
    limit = np.array(policy.layout.input_half)
    return {
        "rows": rows,
        "rms_input_fraction": float(np.max(rms / limit)),
        "viable": bool(np.any(rms >= COLLAPSED * limit)),
    }


class _Keeper:
    """Writes checkpoints and progress of one seed into its folder, if there is one."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.path = None if folder is None else folder / "checkpoint.safetensors"
        self.log_folder = None if folder is None else str(folder / "tensorboard")
        self.before, self.start, self.last = 0.0, time.monotonic(), time.monotonic()

    def seconds(self) -> float:
        """Training time so far [s], that before an interruption included."""
        return self.before + time.monotonic() - self.start

    def saved(self) -> Checkpoint | None:
        """The checkpoint to go on from."""
        if self.path is None or not self.path.is_file():
            return None
        checkpoint = Checkpoint.from_bytes(self.path.read_bytes(), str(self.path))
        self.before = float(checkpoint.state["seconds"])
        return checkpoint

    def on_rollout(
        self, checkpoint: Callable[[], Checkpoint], row: dict[str, float] | None
    ) -> None:
        """At every rollout boundary."""
        if self.folder is None or self.path is None:
            return
        if row is not None:
            write_json(self.folder / "progress.json", row)
        if time.monotonic() - self.last >= CHECKPOINT_SECONDS:
            made = checkpoint()
            state = {**made.state, "seconds": self.seconds()}
            write_bytes(self.path, dataclasses.replace(made, state=state).to_bytes())
            self.last = time.monotonic()


@contextlib.contextmanager
def _unpacked(
    settings: Mapping[str, Any], source: Mapping[str, Any]
) -> Iterator[tuple[Study, AbstractPlant]]:
    """The study of a task and its plant; a user's plant file lies here while it is needed."""
    settings = dict(settings)
    with tempfile.TemporaryDirectory() as folder:
        if source["text"] is not None:
            path, _, class_name = str(settings["plant"]).rpartition(":")
            file = Path(folder) / Path(path).name
            file.write_text(source["text"], encoding="utf-8")
            settings["plant"] = f"{file}:{class_name}"
        study = study_from(settings, "study")
        plant = study.build_plant()
        if plant.description.hash != source["hash"]:
            raise ValueError(
                f"the plant {plant.definition.name!r} of this worker is another one "
                f"(hash {plant.description.hash[:8]}) than that of the study "
                f"({source['hash'][:8]})"
            )
        yield study, plant
