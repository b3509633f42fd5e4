"""Simulated experiments for tests that read, fit or draw records."""

import os
from pathlib import Path

import jax
import numpy as np
import scipy.signal

from excite.description import Input, Output, Parameter, PlantDescription, State
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


def described(
    inputs: str = "u", outputs: str = "y", dt: float = 0.1, unit: str = "", size: float = 1e3
) -> PlantDescription:
    """A description with these columns; units and sizes are the same for all of them."""
    return PlantDescription(
        name="log",
        states=(State("x", ""),),
        inputs=tuple(Input(name, unit, -size, size) for name in inputs.split()),
        outputs=tuple(Output(name, unit, scale=size) for name in outputs.split()),
        parameters=(Parameter("k", "", 1.0),),
        dt=dt,
        band=(0.01 / dt, 0.5 / dt),
    )


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
