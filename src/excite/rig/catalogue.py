"""Rigs by name. A simulated rig needs JAX, which a laboratory computer need not have."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ..description import PlantDescription, SpreadLike, listed, names_of, unknown
from ..files import class_at, is_class_word
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

    from ..plant import AbstractPlant, params_from
    from ..plant.catalogue import PLANT_ENDING, plant_named
    from ..plant.extension import extended, extensions_of
    from .faults import Faults, fault_names, faults_from
    from .simulated import Hardware, SimulatedRig, readings_per_sample

_NUMBERS = ("latency", "jitter", "dropout")
_LONGEST_DELAY = 1000  # samples


@dataclass(frozen=True)
class RigOptions:
    """Choices of which each kind of rig takes its part.

    Attributes:
        address: board identifier of the Quanser rig.
        fast: whether a simulated rig or an FMU runs as fast as it can, not in real time.
        seed: of a simulated rig's hidden parameters, noise and jitter.
        spread: of these parameters.
        fault: of a simulated rig: latency [s], jitter [s] and dropout (probability); those of
            `faults.Faults`, a bias as `sensor_bias_pitch`; and effects of its true plant
            (`plant.extension`) that its known plant has not, such as `gain_voltage`.
        experiment: of a simulated rig, how many were made before; each has its own noise.
    """

    address: str = "0"
    fast: bool = False
    seed: int = 0
    spread: SpreadLike = 0.3
    fault: Mapping[str, float] = field(default_factory=dict)
    experiment: int = 0


def _simulated(
    plant: AbstractPlant | None, description: PlantDescription, options: RigOptions
) -> AbstractRig:
    del description
    if plant is None:
        raise ValueError("a simulated rig needs JAX, which is not installed")
    return _rig_of(plant, plant, options.spread, options)


def _rig_of(
    plant: AbstractPlant, true: AbstractPlant, spread: SpreadLike, options: RigOptions
) -> AbstractRig:
    """A simulated rig of a plant; its true one is another where its description differs."""
    numbers, faults, effects = _faults(true, options.fault)
    num_readings, key = readings_per_sample(plant), jax.random.key(options.seed)
    hardware = Hardware.draw(
        true, num_readings, spread, key, effects=effects, faults=faults, **numbers
    ).repeated(options.experiment)
    return SimulatedRig(plant, hardware, num_readings, is_real_time=not options.fast)


def _of_file(path: str, plant: AbstractPlant | None, options: RigOptions) -> AbstractRig:
    """A simulated rig whose true plant is exactly that of a file."""
    if plant is None:
        raise ValueError("a simulated rig needs JAX, which is not installed")
    true = plant_named(path)
    ours, theirs = plant.description, true.description
    for kind in ("inputs", "outputs"):
        if names_of(getattr(ours, kind)) != names_of(getattr(theirs, kind)) or ours.dt != theirs.dt:
            raise ValueError(
                f"{path} is a plant {theirs.name!r}, with other inputs, outputs or another "
                f"sampling time than {ours.name!r}: --plant names the known plant"
            )
    return _rig_of(plant, true, 0.0, options)


def _faults(
    plant: AbstractPlant, given: Mapping[str, float]
) -> tuple[dict[str, float], Faults, dict[str, float]]:
    """Numbers of a rig, its faults, and the effects of its true plant."""
    outputs, possible = names_of(plant.definition.outputs), extensions_of(plant)
    allowed = (*_NUMBERS, *fault_names(outputs), *possible)
    for name, value in given.items():
        if name not in allowed:
            raise unknown("fault of a simulated rig", name, allowed)
        longest = _LONGEST_DELAY * float(plant.dt)
        if name in _NUMBERS and not 0 <= value < 1:
            raise ValueError(f"--fault {name}={value:g} is not allowed: it must lie in [0, 1)")
        if name in possible and name.startswith("delay") and not 0 <= value <= longest:
            raise ValueError(f"--fault {name}={value:g} is not allowed: 0 to {longest:g} s")
    effects = {name: value for name, value in given.items() if name in possible}
    params_from(extended(plant, list(effects)) if effects else plant, effects)
    numbers = {name: value for name, value in given.items() if name in _NUMBERS}
    return numbers, faults_from(outputs, given), effects


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
    """A rig by name, or in a file.

    `FILE.fmu` is a co-simulation unit, `FILE.json` a simulated rig whose true plant is that of
    the file, as `excite falsify` writes it, and `path/to/file.py:ClassName` a user's class.

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
    is_fmu, is_plant = name.endswith(".fmu"), HAS_JAX and name.endswith(PLANT_ENDING)
    path, _, class_name = name.rpartition(":")
    if name in RIGS:
        rig = RIGS[name](plant, description, options)
    elif is_plant:
        rig = _of_file(name, plant, options)
    elif is_fmu:
        rig = FMURig(Path(name), description, is_real_time=not options.fast)
    elif is_class_word(name):
        rig = _users_rig(Path(path), class_name, description)
    else:
        raise unknown("rig", name, [*RIGS, "FILE.fmu", "FILE.json", "path/to/file.py:ClassName"])
    is_simulated = name == "simulated" or is_plant
    for option, is_there in (("fault", is_simulated), ("fast", is_simulated or is_fmu)):
        if getattr(options, option) and not is_there:
            raise ValueError(f"--{option} is an option of a simulated rig, not of {name!r}")
    return rig


def _users_rig(path: Path, class_name: str, description: PlantDescription) -> AbstractRig:
    rig_class = class_at(path, class_name, AbstractRig, "rig")
    if missing := sorted(rig_class.__abstractmethods__):
        raise ValueError(
            f"{class_name} in {path} is not a complete rig: it has no {listed(missing)}"
        )
    try:
        rig: AbstractRig = rig_class()
    except TypeError as error:  # it takes arguments
        raise ValueError(f"{class_name} in {path} is not a complete rig: {error}") from None
    if not hasattr(rig, "description"):
        rig.description = description
    return rig
