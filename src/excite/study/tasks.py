"""The tasks of a study in a worker: evaluate methods, design signals, train a seed.

Every task takes and returns plain data, so that it runs in any process on any machine. An
interrupted seed resumes from its checkpoint; a repeated seed gives the same result.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TypedDict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from .. import __version__
from ..description import SpreadLike
from ..environment import Env, Episodes, run_episodes
from ..excitation import PolicyExcitation, Replay
from ..files import write_bytes
from ..plant import AbstractPlant
from ..policy import Policy
from ..report.rows import CountsBySeed, Rows, SeedMetrics
from ..training.checkpoint import Checkpoint, Trained
from ..training.signals import CLAIRVOYANT, clairvoyant_signals, signal_env
from .agent import Agent
from .falsify import falsify
from .folder import agent_settings, fingerprint
from .methods import CHUNK, episode_keys, evaluate_method, method_rows, player_of, scores
from .progress import write_phase, write_progress
from .spec import Study, study_from
from .statistics import table_row

Data = dict[str, object]
"""JSON-ready result of a worker."""


class SeedResult(TypedDict):
    """Result of the training of a seed: policy file, learning curve, `SeedMetrics` as data."""

    policy: bytes
    curve: list[dict[str, float]]
    metrics: Data


@contextlib.contextmanager
def unpacked(
    settings: Mapping[str, object], source: Mapping[str, str | None]
) -> Iterator[tuple[Study, AbstractPlant]]:
    """The study of a task and its plant; a user's plant file is written for the time of the task.

    Args:
        settings: of the study.
        source: `text`, the source of a user's own plant or None, and the plant's `hash`.
    """
    settings = dict(settings)
    with tempfile.TemporaryDirectory() as folder:
        if (text := source["text"]) is not None:
            path, _, class_name = str(settings["plant"]).rpartition(":")
            file = Path(folder) / Path(path).name
            file.write_text(text, encoding="utf-8")
            settings["plant"] = f"{file}:{class_name}"
        study = study_from(settings, "study")
        plant = study.build_plant()
        if plant.description.hash != source["hash"]:
            raise ValueError(
                f"the plant {plant.definition.name!r} of this worker "
                f"(hash {plant.description.hash[:8]}) differs from that of the study "
                f"({str(source['hash'])[:8]})"
            )
        yield study, plant


COLLAPSED = 0.01
"""An agent with an RMS input below this fraction of its limit has collapsed."""


def seed_task(
    study: Mapping[str, object],
    plant: Mapping[str, str | None],
    agent: str,
    seed: int,
    folder: str | None,
    checkpoint_seconds: float,
) -> SeedResult:
    """A trained policy, its learning curve, and its evaluation.

    Args:
        study: its settings.
        plant: `text`, the source of a user's own plant or None, and the plant's `hash`.
        agent, seed: what to train.
        folder: for checkpoints and logs, if this machine can access it.
        checkpoint_seconds: least time between two checkpoints.
    """
    with unpacked(study, plant) as (chosen, built):
        mark, own = fingerprint(chosen, built, agent), chosen.agent(agent)
        place = Path(folder) if folder and Path(folder).is_dir() else None
        keeper = _Keeper(place, mark, checkpoint_seconds)
        keeper.enter("compiling")
        env = chosen.env(agent, built)
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
        if env.uncertainty is not None:
            policy = falsify(policy, built, progress=keeper.searching).certified()
        keeper.enter("evaluating")
        rows, rms = evaluate_method(chosen, built, agent, PolicyExcitation.of(policy))
        limit = np.array(policy.layout.input_half)
        metrics = SeedMetrics(
            agent=agent,
            seed=seed,
            rows=tuple(rows),
            rms_input_fraction=float(np.max(rms / limit)),
            viable=bool(np.any(rms >= COLLAPSED * limit)),
            validation=trained.validation,
            train_seconds=seconds,
            resumed_at_steps=keeper.resumed_at_steps,
            fingerprint=mark,
        )
        return {"policy": policy.to_bytes(), "curve": trained.curve, "metrics": metrics.data()}


def _trained(env: Env, agent: Agent, seed: int, keeper: _Keeper) -> Trained:
    """The trainer; imported here, because one trainer needs an extra."""
    own = {"log_folder": keeper.log_folder} if agent.method == "ppo" else {}
    train = importlib.import_module(f"excite.training.{agent.method}").train
    return train(env, agent.training, seed, resume=keeper.saved(), on_boundary=keeper.keep, **own)


class _Keeper:
    """Writes checkpoints and progress of one seed into its folder, if it has one."""

    def __init__(self, folder: Path | None, fingerprint: str, every: float) -> None:
        self.folder, self.fingerprint, self.every = folder, fingerprint, every
        self.resumed_at_steps: int | None = None
        self.path = None if folder is None else folder / "checkpoint.safetensors"
        self.log_folder = None if folder is None else str(folder / "tensorboard")
        self.before, self.start, self.last = 0.0, time.monotonic(), time.monotonic()
        self.last_search, self.num_boundaries = 0.0, 0

    def seconds(self) -> float:
        """Training time so far [s], that before an interruption included."""
        return self.before + time.monotonic() - self.start

    def saved(self) -> Checkpoint | None:
        """The checkpoint from which to resume."""
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
        """Called at every boundary."""
        if self.folder is None or self.path is None:
            return
        self.num_boundaries += 1
        if self.num_boundaries == 2:  # the first update is compiled and made
            self.enter("")
        if row is not None:
            write_progress(self.folder, row)
        if time.monotonic() - self.last >= self.every:
            made = checkpoint()
            own = {"seconds": self.seconds(), "fingerprint": self.fingerprint}
            state = {**made.state, **own}
            write_bytes(self.path, dataclasses.replace(made, state=state).to_bytes())
            self.last = time.monotonic()

    def enter(self, phase: str) -> None:
        """Says what is done before and after the updates."""
        if self.folder is not None:
            write_phase(self.folder, phase)

    def searching(self, part: str, done: float, total: float) -> None:
        """Called during the search for violations after the training."""
        if time.monotonic() - self.last_search >= 1 or done == total:
            self.enter(f"searching for violations ({part}, {100 * done / total:.0f} %)")
            self.last_search = time.monotonic()


def methods_task(study: Mapping[str, object], plant: Mapping[str, str | None]) -> Data:
    """Rows of a study's methods."""
    with unpacked(study, plant) as (chosen, _):
        return Rows(rows=tuple(method_rows(chosen))).data()


def safety_task(
    study: Mapping[str, object], plant: Mapping[str, str | None], seed: int, policy: bytes
) -> Data:
    """Violations of a trained policy on plants that are those of its seed alone."""
    with unpacked(study, plant) as (chosen, built):
        play, count = player_of(chosen, built), chosen.safety_episodes or 0
        own = jax.random.fold_in(jax.random.key(chosen.seed), seed + 1)
        keys, excitation = (
            jax.random.split(own, count),
            PolicyExcitation.of(Policy.from_bytes(policy)),
        )
        parts = [play(excitation, keys[i : i + CHUNK])[0] for i in range(0, count, CHUNK)]
        violations = sum(int(part.is_violation.sum()) for part in parts)
        return CountsBySeed(evaluations=count, violations=(violations,), own_plants=True).data()


METHOD = "clairvoyant"


def clairvoyant_task(study: Mapping[str, object], plant: Mapping[str, str | None]) -> Data:
    """Rows of the clairvoyant signals, and the spread of their starts."""
    with unpacked(study, plant) as (chosen, built):
        if chosen.clairvoyant is None:
            raise ValueError("the study has no clairvoyant signals")
        keys = episode_keys(chosen)[: chosen.clairvoyant.plants]
        env = signal_env(built, chosen.num_steps, chosen.spread)
        settings = dataclasses.replace(CLAIRVOYANT, num_updates=chosen.clairvoyant.updates)
        design = clairvoyant_signals(env, keys, chosen.clairvoyant.starts, settings)
        episodes = _played(built, jnp.asarray(design.inputs), chosen.spread, keys)
        rows = [
            table_row(chosen, built.description, (METHOD, name), scores(built, e, episodes))
            for name, e in chosen.build_estimators(built).items()
        ]
        spread = np.ptp(design.worth_by_start, axis=1).tolist()
        return Rows(rows=tuple(rows), log_det_spread_of_starts=spread).data()


@eqx.filter_jit
def _played(
    plant: AbstractPlant,
    inputs: Float[Array, "episode time input"],
    spread: SpreadLike,
    keys: Key[Array, " episode"],
) -> Episodes:
    """Each signal on the plant for which it was designed."""

    def one(own: Float[Array, "time input"], key: Key[Array, ""]) -> Episodes:
        episodes = run_episodes(plant, Replay(own), len(own), spread, key[None])
        return jax.tree.map(lambda leaf: leaf[0], episodes)

    return jax.vmap(one)(inputs, keys)
