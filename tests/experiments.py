"""Simulated experiments for tests that read, fit or draw records."""

import os
from pathlib import Path

import jax
import numpy as np
import scipy.signal

from excite.excitation import AbstractExcitation, Chirp
from excite.files import json_ready
from excite.plant import AbstractPlant, Params
from excite.record import Record
from excite.simulation import run_episode

ROOT = Path(__file__).parent.parent
NUM_STEPS = 200
"""One length for all: another one would be compiled anew."""


def recording(name: str) -> Path | None:
    """A real recording, which is not shipped, where this computer has it."""
    folder = Path(os.environ.get("EXCITE_DATA") or ROOT.parent / "shared" / "data")
    return next(folder.rglob(name), None)


def record_of(
    plant: AbstractPlant,
    excitation: AbstractExcitation | None = None,
    *,
    params: Params = None,
    num_steps: int = NUM_STEPS,
    seed: int = 0,
    sidecar: bool = True,
) -> Record:
    """What an experiment on `plant` leaves; without `sidecar` nothing tells how it began."""
    episode = run_episode(
        plant,
        plant.nominal if params is None else params,
        Chirp() if excitation is None else excitation,
        num_steps,
        jax.random.key(seed),
    )
    description = json_ready(plant.description.to_dict())
    metadata = {"starts_at_initial_state": True, "plant": description}
    measured = np.array(episode.measured)  # a copy, for tests that spoil it
    return Record.of_episode(episode.time, episode.inputs, measured, metadata if sidecar else {})


def spread_params(plant: AbstractPlant, relative: float = 0.2) -> Params:
    """True parameters off the nominal ones, up and down in turn."""
    signs = [(-1) ** i for i in range(len(plant.nominal))]
    return plant.Params(
        *(v * (1 + relative * s) for v, s in zip(plant.nominal, signs, strict=True))
    )


def autoregressive(rng: np.random.Generator, shape: tuple[int, ...], rho: float) -> np.ndarray:
    """Stationary noise of unit variance along the last axis, x_k = rho x_{k-1} + e_k."""
    white = rng.normal(size=(*shape[:-1], shape[-1] + 300))
    noise = np.asarray(scipy.signal.lfilter([np.sqrt(1 - rho**2)], [1, -rho], white))
    return noise[..., 300:]
