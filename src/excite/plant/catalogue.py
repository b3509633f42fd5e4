"""Plants by name: shipped plants, and those in a user's file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from ..description import Listing, first_line, names_of, told, unknown, wrong_type
from ..files import class_at
from .aero2 import Aero2, Aero2Detailed, Aero2Lag
from .cart_pole import CartPole
from .contract import AbstractPlant, Sensor, as_number, require_double_precision
from .dc_motor import DCMotor
from .emps import EMPS
from .extension import extended
from .fields import floats

PLANTS: Mapping[str, type[AbstractPlant]] = {
    "aero2": Aero2,
    "aero2_lag": Aero2Lag,
    "aero2_detailed": Aero2Detailed,
    "dc_motor": DCMotor,
    "cart_pole": CartPole,
    "emps": EMPS,
}


def plants() -> Listing:
    """The plants that come with the package, by name.

    >>> import excite as ex
    >>> "aero2" in ex.plants()
    True
    """
    return Listing({name: first_line(kind) for name, kind in PLANTS.items()})


PlantLike: TypeAlias = str | AbstractPlant | type[AbstractPlant]
"""A plant, its class, its name, or `path/to/file.py:ClassName`."""


def plant_from(given: PlantLike) -> AbstractPlant:
    """A plant in double precision, from a name, a class or a plant.

    Raises:
        ValueError: as `plant_named`, and for functions that do not fit the description.
        TypeError: for anything else.
    """
    require_double_precision()
    if isinstance(given, str):
        return plant_named(given)
    where = given.__name__ if isinstance(given, type) else type(given).__name__
    if isinstance(given, type) and issubclass(given, AbstractPlant):
        given = _complete(given, where)
    if not isinstance(given, AbstractPlant):
        allowed = "a name, path/to/file.py:ClassName, a plant or its class"
        raise wrong_type("plant", given, allowed)
    if given.dt.dtype != float:  # made in single precision: use the definition's numbers
        return jax.tree.map(lambda x: floats(np.asarray(x).astype(str).astype(float)), given)
    _check_plant(given, where)
    return given


def plant_named(name: str) -> AbstractPlant:
    """A shipped plant by name, or one in a user's file as `path/to/file.py:ClassName`.

    Either may have extensions: `aero2+delay_voltage`.

    The user's file is imported, so its code runs. Take such a name only from the user's
    command line, script or study file.

    Raises:
        ValueError: for an unknown name, or a file without such a class.
    """
    path, colon, class_name = name.rpartition(":")
    plain, *extensions = class_name.split("+")
    if extensions:
        return extended(plant_named(f"{path}{colon}{plain}"), extensions)
    if name in PLANTS:
        return PLANTS[name]()
    if not colon or not path.endswith(".py"):
        raise unknown("plant", name, [*PLANTS, "path/to/file.py:ClassName"])
    plant_class = class_at(Path(path), class_name, AbstractPlant, "plant")
    plant = _complete(plant_class, f"{class_name} in {path}")
    _check_plant(plant, f"{class_name} in {path}")
    return plant


def _complete(plant_class: type[AbstractPlant], where: str) -> AbstractPlant:
    """A plant of a class with its default numbers."""
    try:
        return plant_class()
    except (TypeError, AttributeError) as error:  # a method or the definition is missing
        raise ValueError(f"{where} is not a complete plant: {error}") from None
    except (ValueError, KeyboardInterrupt):
        raise
    except BaseException as error:  # also sys.exit
        raise ValueError(f"{where} cannot be made: {told(error)}") from error


def _check_plant(plant: AbstractPlant, where: str) -> None:
    """Raises ValueError where the functions of a plant do not fit its description."""
    d = plant.definition
    state, inputs = plant.initial_state, jnp.zeros(len(d.inputs))
    for name, arguments, count in (
        ("derivative", (state, inputs, plant.nominal), len(d.states)),
        ("output", (state, plant.nominal), len(d.outputs)),
    ):
        try:
            found = jax.eval_shape(getattr(plant, name), *arguments)
            shape, kind = jnp.shape(found), getattr(found, "dtype", float)
        except jax.errors.ConcretizationTypeError as error:
            raise ValueError(
                f"{name} of {where} branches on the value of a state, an input or a parameter "
                "(if, while, and, or, float, int): use jnp.where(condition, value, otherwise)"
            ) from error
        except jax.errors.TracerArrayConversionError as error:
            raise ValueError(
                f"{name} of {where} uses NumPy: use jax.numpy (import jax.numpy as jnp)"
            ) from error
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # also sys.exit
            raise ValueError(f"{name} of {where} fails: {told(error)}") from error
        if shape != (count,):
            raise ValueError(f"{name} of {where} returns shape {shape}; ({count},) is needed")
        if jnp.issubdtype(kind, jnp.complexfloating):
            raise ValueError(f"{name} of {where} returns complex numbers; real ones are needed")


def require_inputs(plant: AbstractPlant) -> None:
    """Raises ValueError for a plant without inputs, or with inputs that act late.

    Designs, policies, studies and rigs need inputs that act at once.
    """
    if not plant.definition.inputs:
        raise ValueError(
            f"plant {plant.definition.name!r} has no inputs: there is no signal to design or to "
            "play, and no policy to train"
        )
    if plant.delay(plant.nominal) is not None:
        raise ValueError(
            f"plant {plant.definition.name!r} delays its inputs: it can be simulated and "
            "identified, but not be used for designs, policies, studies and rigs"
        )


def with_sensor(
    plant: AbstractPlant,
    noise_sd: Mapping[str, float] | None,
    resolution: Mapping[str, float] | None = None,
) -> AbstractPlant:
    """The plant with another noise or resolution of the named outputs, in their units.

    Raises:
        ValueError: for an unknown output, or a value that is negative or not finite.
        TypeError: for a value that is no number.
    """
    outputs, sensor = names_of(plant.definition.outputs), plant.sensor
    numbers = {"noise": sensor.noise_sd.tolist(), "resolution": sensor.resolution.tolist()}
    for what, given in (("noise", noise_sd or {}), ("resolution", resolution or {})):
        if not isinstance(given, Mapping):
            raise wrong_type(what, given, "a dict by output")
        for name, value in given.items():
            if name not in outputs:
                raise unknown(f"{plant.definition.name} output", name, outputs)
            value = as_number(f"{what} of {name!r}", value)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{what} of {name!r} must be zero or positive: got {value:g}")
            numbers[what][outputs.index(name)] = value
    return plant.changed(sensor=Sensor(*map(floats, numbers.values())))
