"""Rigs by name. A simulated rig needs JAX, which a laboratory computer need not have."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ..description import PlantDescription, unknown
from ..files import class_at
from .contract import AbstractRig
from .fmu import FMURig
from .quanser import QuanserAero2


def _is_installed(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except ModuleNotFoundError:
        return False


HAS_JAX = _is_installed("jax")

if TYPE_CHECKING or HAS_JAX:
    import jax

    from ..plant import AbstractPlant
    from .simulated import Hardware, SimulatedRig, readings_per_sample

FAULTS = ("latency", "jitter", "dropout")
"""Of a simulated rig, see `simulated.Hardware`."""


@dataclass(frozen=True)
class RigOptions:
    """Choices of which each kind of rig takes its part.

    Attributes:
        address: board identifier of the Quanser rig.
        fast: whether a simulated rig or an FMU runs as fast as it can, not in real time.
        seed: of a simulated rig's hidden parameters, noise and jitter.
        spread: of these parameters, as a fraction of their scales.
        fault: latency [s], jitter [s] and dropout (probability) of a simulated rig.
    """

    address: str = "0"
    fast: bool = False
    seed: int = 0
    spread: float = 0.3
    fault: Mapping[str, float] = field(default_factory=dict)


def _simulated(
    plant: AbstractPlant | None, description: PlantDescription, options: RigOptions
) -> AbstractRig:
    del description
    if plant is None:
        raise ValueError("a simulated rig needs JAX, which is not installed")
    for name, value in options.fault.items():
        if name not in FAULTS or not 0 <= value < 1:
            raise ValueError(
                f"--fault {name}={value:g} is not allowed: latency, jitter or dropout in [0, 1)"
            )
    num_readings = readings_per_sample(plant)
    key = jax.random.key(options.seed)
    hardware = Hardware.draw(plant, num_readings, options.spread, key, **options.fault)
    return SimulatedRig(plant, hardware, num_readings, is_real_time=not options.fast)


def _quanser(
    plant: AbstractPlant | None, description: PlantDescription, options: RigOptions
) -> AbstractRig:
    del plant
    return QuanserAero2(description, options.address)


Make = Callable[["AbstractPlant | None", PlantDescription, RigOptions], AbstractRig]

RIGS: Mapping[str, Make] = {"simulated": _simulated, "quanser": _quanser}


def rig_named(
    name: str, plant: AbstractPlant | None, description: PlantDescription, options: RigOptions
) -> AbstractRig:
    """A rig by name, an FMU as `FILE.fmu`, or a user's class as `path/to/file.py:ClassName`.

    The user's file is imported, that is run.

    Args:
        name: of the rig.
        plant: None without JAX.
        description: of the plant.
        options: of the rig.

    Raises:
        ValueError: for an unknown name, a file without such a rig, or an option that this rig
            does not have.
    """
    is_fmu = name.endswith(".fmu")
    path, colon, class_name = name.rpartition(":")
    if name in RIGS:
        rig = RIGS[name](plant, description, options)
    elif is_fmu:
        rig = FMURig(Path(name), description, is_real_time=not options.fast)
    elif colon and path.endswith(".py"):
        rig = _users_rig(Path(path), class_name, description)
    else:
        raise unknown("rig", name, [*RIGS, "FILE.fmu", "path/to/file.py:ClassName"])
    is_simulated = name == "simulated"
    for option, is_there in (("fault", is_simulated), ("fast", is_simulated or is_fmu)):
        if getattr(options, option) and not is_there:
            raise ValueError(f"--{option} is an option of a simulated rig, not of {name!r}")
    return rig


def _users_rig(path: Path, class_name: str, description: PlantDescription) -> AbstractRig:
    rig_class = class_at(path, class_name, AbstractRig, "rig")
    try:
        rig: AbstractRig = rig_class()
    except TypeError as error:  # a method of the contract is missing
        raise ValueError(f"{class_name} in {path} is not a complete rig: {error}") from None
    if not hasattr(rig, "description"):
        rig.description = description
    return rig
