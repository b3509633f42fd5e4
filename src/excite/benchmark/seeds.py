"""What a worker does for a study: trains one seed of an agent and evaluates it.

`seed_task` takes and returns plain data, so that it runs in any process on any machine;
it is called by name. A seed that was interrupted goes on from its checkpoint, a
seed repeated gives the same result.
"""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..env import Env
from ..excitation import PolicyExcitation
from ..files import write_bytes, write_json
from ..plant import AbstractPlant
from ..policy import Policy
from ..study import Agent, Study
from ..training.base import Checkpoint, Trained
from .base import agent_settings, evaluate_method, fingerprint, unpacked

COLLAPSED = 0.01
"""An agent whose RMS input over the evaluation is below this fraction of its limit."""


def seed_task(
    study: Mapping[str, Any],
    plant: Mapping[str, Any],
    agent: str,
    seed: int,
    folder: str | None,
    checkpoint_seconds: float,
) -> dict[str, Any]:
    """A trained policy, its learning curve, and how it does in the evaluation.

    Args:
        study: its settings.
        plant: `text`, the source of a user's own plant or None, and the plant's `hash`.
        agent, seed: what to train.
        folder: for checkpoints and logs, where this machine sees it.
        checkpoint_seconds: least time between two checkpoints.
    """
    with unpacked(study, plant) as (chosen, built):
        mark, own = fingerprint(chosen, built, agent), chosen.agent(agent)
        place = Path(folder) if folder and Path(folder).is_dir() else None
        keeper = _Keeper(place, mark, checkpoint_seconds)
        env = own.env(built, chosen.spread, chosen.num_steps)
        trained = _trained(env, own, seed, keeper)
        seconds = keeper.seconds()
        provenance = {
            "excite": __version__,
            "study": chosen.name,
            "agent": agent,
            "seed": seed,
            **agent_settings(chosen, built, agent),
        }
        policy = Policy(built.description, env.layout, trained.weights, provenance)
        metrics = {
            "agent": agent,
            "seed": seed,
            **_evaluated(chosen, built, agent, policy),
            "validation": trained.validation,
            "train_seconds": seconds,
            "resumed_at_steps": keeper.resumed_at_steps,
            "fingerprint": mark,
        }
        return {"policy": policy.to_bytes(), "curve": trained.curve, "metrics": metrics}


def _trained(env: Env, agent: Agent, seed: int, keeper: _Keeper) -> Trained:
    """By name, because the libraries of one trainer come with an extra."""
    own = {"log_folder": keeper.log_folder} if agent.method == "ppo" else {}
    train = importlib.import_module(f"excite.training.{agent.method}").train
    return train(env, agent.training, seed, resume=keeper.saved(), on_boundary=keeper.keep, **own)


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

    def __init__(self, folder: Path | None, fingerprint: str, every: float) -> None:
        self.folder, self.fingerprint, self.every = folder, fingerprint, every
        self.resumed_at_steps: int | None = None
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
        try:
            checkpoint = Checkpoint.from_bytes(self.path.read_bytes(), str(self.path))
            if checkpoint.state["fingerprint"] != self.fingerprint:
                raise ValueError(f"{self.path} is of another training")
            self.before = float(checkpoint.state["seconds"])
            self.resumed_at_steps = int(checkpoint.state["num_steps"])
        except (ValueError, KeyError, TypeError) as error:
            what = error if type(error) is ValueError else f"{self.path} is damaged"
            raise ValueError(f"{what}; delete it to train this seed from the beginning") from None
        return checkpoint

    def keep(self, checkpoint: Callable[[], Checkpoint], row: dict[str, float] | None) -> None:
        """At every boundary."""
        if self.folder is None or self.path is None:
            return
        if row is not None:
            write_json(self.folder / "progress.json", row)
        if time.monotonic() - self.last >= self.every:
            made = checkpoint()
            own = {"seconds": self.seconds(), "fingerprint": self.fingerprint}
            state = {**made.state, **own}
            write_bytes(self.path, dataclasses.replace(made, state=state).to_bytes())
            self.last = time.monotonic()
