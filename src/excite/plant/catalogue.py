"""Plants by name: those that are shipped, and a user's own file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp

from ..description import names_of, unknown
from ..files import class_at
from .aero2 import Aero2, Aero2Detailed, Aero2Lag
from .cart_pole import CartPole
from .contract import AbstractPlant, Sensor
from .dc_motor import DCMotor
from .emps import EMPS

PLANTS: Mapping[str, type[AbstractPlant]] = {
    "aero2": Aero2,
    "aero2_lag": Aero2Lag,
    "aero2_detailed": Aero2Detailed,
    "dc_motor": DCMotor,
    "cart_pole": CartPole,
    "emps": EMPS,
}


def plant_named(name: str) -> AbstractPlant:
    """A shipped plant by name, or a user's own as `path/to/file.py:ClassName`.

    The user's file is imported, that is run: a name of this kind is only ever taken from
    the user's own command line or study file.

    Raises:
        ValueError: for an unknown name, or a file without such a class.
    """
    if name in PLANTS:
        return PLANTS[name]()
    path, colon, class_name = name.rpartition(":")
    if not colon or not path.endswith(".py"):
        raise unknown("plant", name, [*PLANTS, "path/to/file.py:ClassName"])
    plant_class = class_at(Path(path), class_name, AbstractPlant, "plant")
    try:
        plant = plant_class()
    except (TypeError, AttributeError) as error:  # a method or the definition is missing
        raise ValueError(f"{class_name} in {path} is not a complete plant: {error}") from None
    _check_plant(plant, f"{class_name} in {path}")
    return plant


def _check_plant(plant: AbstractPlant, where: str) -> None:
    """Raises ValueError where the functions of a user's plant do not fit its description."""
    d = plant.definition
    state, inputs = plant.initial_state, jnp.zeros(len(d.inputs))
    for name, arguments, count in (
        ("derivative", (state, inputs, plant.nominal), len(d.states)),
        ("output", (state, plant.nominal), len(d.outputs)),
    ):
        try:
            shape = jnp.shape(jax.eval_shape(getattr(plant, name), *arguments))
        except Exception as error:
            raise ValueError(f"{name} of {where} fails: {type(error).__name__}: {error}") from error
        if shape != (count,):
            raise ValueError(f"{name} of {where} returns shape {shape}; ({count},) is needed")


def with_sensor(
    plant: AbstractPlant, noise_sd: Mapping[str, float], resolution: Mapping[str, float]
) -> AbstractPlant:
    """The plant with another noise or resolution of the outputs named, in their units.

    Raises:
        ValueError: for an unknown output, or a value that is negative or not finite.
    """
    outputs, sensor = names_of(plant.definition.outputs), plant.sensor
    numbers = {"noise": sensor.noise_sd.tolist(), "resolution": sensor.resolution.tolist()}
    for what, given in (("noise", noise_sd), ("resolution", resolution)):
        for name, value in given.items():
            if name not in outputs:
                raise unknown(f"{plant.definition.name} output", name, outputs)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{what} of {name!r} must be zero or positive: got {value:g}")
            numbers[what][outputs.index(name)] = value
    return plant.changed(sensor=Sensor(*(jnp.asarray(v) for v in numbers.values())))
