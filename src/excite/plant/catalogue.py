"""Plants by name: shipped plants, and those in a user's file."""

from __future__ import annotations

import inspect
import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..description import (
    Listing,
    PlantDescription,
    as_number,
    first_line,
    listed,
    names_of,
    told,
    unknown,
    wrong_type,
)
from ..files import class_at, damaged, is_class_word, read_json
from .aero2 import Aero2, Aero2Detailed, Aero2Lag
from .cart_pole import CartPole
from .contract import (
    AbstractARXPlant,
    AbstractPlant,
    Sensor,
    require_double_precision,
    untuned,
    with_nominal,
)
from .dc_motor import DCMotor
from .emps import EMPS
from .extension import delayed_feedthrough, extended, plain_kind
from .fields import floats
from .static import AbstractStaticTask, has_own_noise, own_functions, require_sensor_noise

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

    Either may have extensions: `aero2+delay_voltage`. A file (.json) is read as
    `plant_in_file` writes it.

    The user's file is imported, so its code runs; a plant's file may name such a file, too.
    Take these names only from the user's command line, script or study file.

    Raises:
        ValueError: for an unknown name, or a file without such a class.
    """
    if name.endswith(PLANT_ENDING):
        return _plant_of_file(Path(name))
    if name.endswith(".py") and Path(name).is_file():
        name += ":"  # the refusal names the classes of the file
    path, colon, class_name = name.rpartition(":")
    plain, *extensions = class_name.split("+")
    if extensions:
        return extended(plant_named(f"{path}{colon}{plain}"), extensions)
    if name in PLANTS:
        return PLANTS[name]()
    if not is_class_word(name):
        if Path(path or name).is_file():
            raise ValueError(f"{path or name} is no file of a plant: the name of one ends in .py")
        known = [*PLANTS, "path/to/file.py:ClassName", f"path/to/plant{PLANT_ENDING}"]
        raise unknown("plant", name, known)
    plant_class = class_at(Path(path), class_name, AbstractPlant, "plant")
    plant = _complete(plant_class, f"{class_name} in {path}")
    _check_plant(plant, f"{class_name} in {path}")
    return plant


def trained_on(plant: PlantDescription) -> str:
    """The name of the plant of a policy, from its description.

    Raises:
        ValueError: where it is in a user's file, which a policy does not name.
    """
    if plant.name.partition("+")[0] not in PLANTS:
        raise ValueError(
            f"the policy's plant {plant.name!r} is in a file of yours: name it (--plant "
            "path/to/file.py:ClassName)"
        )
    return plant.name


def word_of(plant: AbstractPlant) -> str:
    """The name by which `plant_named` makes a plant of this class.

    Raises:
        ValueError: for a class that is in no file, as one of a notebook.
    """
    kind = untuned(plain_kind(plant))
    added = "".join(f"+{name}" for name in plant.definition.name.split("+")[1:])
    shipped = [name for name, plant_class in PLANTS.items() if plant_class is kind]
    if shipped:
        return shipped[0] + added
    try:
        return f"{inspect.getfile(kind)}:{kind.__name__}{added}"
    except (TypeError, OSError):  # defined in a notebook or a shell
        raise ValueError(
            f"other processes cannot import the plant class {kind.__name__}: save it in a file (in "
            f"a notebook by %%writefile plant.py) and name it as 'plant.py:{kind.__name__}'"
        ) from None


def word_in_command(plant: AbstractPlant) -> str:
    """The name for a shell, as short as the working directory allows; FILE.py:... if in no file."""
    try:
        path, colon, name = word_of(plant).rpartition(":")
    except ValueError:
        _, plus, extensions = plant.definition.name.partition("+")
        return f"FILE.py:{plain_kind(plant).__name__}{plus}{extensions}"
    here = Path.cwd()
    near = Path(path).relative_to(here) if path and Path(path).is_relative_to(here) else path
    return shlex.quote(f"{near}{colon}{name}")


PLANT_ENDING = ".json"


def plant_in_file(plant: AbstractPlant) -> dict[str, object]:
    """Content of a plant's file: its class, and its numbers by name, of which `substeps` follow.

    `plant_named` makes the plant of such a file.

    Raises:
        ValueError: as `word_of`.
    """
    d = plant.description
    return {
        "format": _FORMAT,
        "plant": word_of(plant),
        "params": {p.name: p.nominal for p in d.parameters},
        "constants": {c.name: c.value for c in d.constants},
        "initial_state": {s.name: s.initial for s in d.states},
        "noise_sd": {o.name: o.noise_sd for o in d.outputs},
        "resolution": {o.name: o.resolution for o in d.outputs},
        "dt": d.dt,
    }


_FORMAT = "excite plant 1"


def is_plant_file(path: Path) -> bool:
    """Whether a file is that of a plant."""
    try:
        return read_json(path).get("format") == _FORMAT
    except ValueError:
        return False


def known_plant(path: str | Path) -> AbstractPlant:
    """The plant of a file's class with its usual numbers, without the effects of the file.

    Raises:
        ValueError: for a file that holds no plant.
    """
    _plant_of_file(Path(path))
    return plain_kind(plant_named(read_json(Path(path))["plant"]))()


def _plant_of_file(path: Path) -> AbstractPlant:
    """The plant in a file; ValueError for a file that holds none."""
    advice = "a file of a plant is written by 'excite falsify'"
    content = read_json(path, advice=advice)
    try:
        if content["format"] != _FORMAT or str(content["plant"]).endswith(PLANT_ENDING):
            raise KeyError(path)
        plant = plant_named(content["plant"])
        if set(content["params"]) != {*names_of(plant.definition.parameters)}:
            raise KeyError(path)
        start = [float(content["initial_state"][s.name]) for s in plant.definition.states]
        constants = {name: float(value) for name, value in content["constants"].items()}
        if not 0 < content["dt"] < math.inf:
            raise KeyError(path)
        plant = with_sensor(plant, content["noise_sd"], content["resolution"])
        numbers = {"dt": float(content["dt"]), "initial_state": floats(start), **constants}
        return with_nominal(plant.changed(**numbers), content["params"])
    except (KeyError, TypeError, AttributeError, OverflowError):
        raise damaged(path, advice) from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _complete(plant_class: type[AbstractPlant], where: str) -> AbstractPlant:
    """A plant of a class with its default numbers."""
    if missing := sorted(getattr(plant_class, "__abstractmethods__", ())):
        raise ValueError(f"{where} is not a complete plant: it has no {listed(missing)}")
    try:
        return plant_class()
    except (TypeError, AttributeError) as error:  # the definition is missing
        raise ValueError(f"{where} is not a complete plant: {error}") from None
    except (ValueError, KeyboardInterrupt):
        raise
    except BaseException as error:  # also sys.exit
        raise ValueError(f"{where} cannot be made: {told(error)}") from error


def _check_plant(plant: AbstractPlant, where: str) -> None:
    """Raises ValueError where the functions of a plant do not fit its description."""
    d = plant.definition
    state, inputs = plant.initial_state, jnp.zeros(len(d.inputs))
    functions: list[tuple[str, tuple[Any, ...], int]] = [
        ("derivative", (state, inputs, plant.nominal), len(d.states)),
        ("output", (state, *plant.feedthrough_input(inputs), plant.nominal), len(d.outputs)),
        ("delay", (plant.nominal,), len(d.inputs)),
    ]
    if isinstance(plant, AbstractStaticTask):  # its other functions follow from this one
        functions = [("outcome", (inputs, plant.nominal), len(d.outputs))]
    if has_own_noise(plant):
        noise = jnp.zeros(len(d.outputs))
        functions.append(("measured", (inputs, plant.nominal, noise), len(d.outputs)))
    for name, arguments, count in functions:
        what = f"{name} of {where}"
        found = _traced(plant, name, arguments, what)
        if name == "delay" and found is None:
            continue
        needed = f"one array of shape ({count},) is needed, such as jnp.stack([...])"
        if not hasattr(found, "shape"):
            kind = "None" if found is None else f"a {type(found).__name__}"
            raise ValueError(f"{what} returns {kind}; {needed}")
        if found.shape != (count,):
            raise ValueError(f"{what} returns shape {found.shape}; {needed}")
        if jnp.issubdtype(found.dtype, jnp.complexfloating):
            raise ValueError(f"{what} returns complex numbers; real ones are needed")
    if plant.has_feedthrough and plant.delay(plant.nominal) is not None:
        raise ValueError(delayed_feedthrough(d.name))
    if isinstance(plant, AbstractARXPlant) and plant.has_feedthrough:
        raise ValueError(
            f"{where} is an ARX plant, whose output does not depend on the input directly: make it "
            "an AbstractPlant, or define output(self, state, params)"
        )
    if has_own_noise(plant):
        _check_own_noise(plant, where)


def _check_own_noise(plant: AbstractStaticTask, where: str) -> None:
    """Raises ValueError where what is measured of a task does not fit its likelihood."""
    own = own_functions(plant)
    if len(own) == 1:
        (lacks,) = {"measured", "log_likelihood"} - {*own}
        raise ValueError(
            f"{where} defines {own[0]}, and needs {lacks} too: both or none of the two"
        )
    lower, upper = plant.input_limits
    design = (lower + upper) / 2
    measured = plant.measured(design, plant.nominal, jnp.zeros(len(plant.definition.outputs)))
    found = _traced(
        plant, "log_likelihood", (measured, design, plant.nominal), f"log_likelihood of {where}"
    )
    if getattr(found, "shape", None) != ():
        kind = f"shape {found.shape}" if hasattr(found, "shape") else f"a {type(found).__name__}"
        raise ValueError(
            f"log_likelihood of {where} returns {kind}; one number is needed, such as jnp.sum(...)"
        )
    if not jnp.isfinite(plant.log_likelihood(measured, design, plant.nominal)):
        raise ValueError(
            f"log_likelihood of {where} is not finite for what is measured without noise, in the "
            "middle of the designs, with nominal parameters"
        )


def _traced(plant: AbstractPlant, name: str, arguments: tuple[Any, ...], what: str) -> Any:
    """What a function of a plant returns, where all numbers are traced as in a computation."""
    values = "a state, an input, a parameter or a constant"
    try:
        return eqx.filter_eval_shape(
            lambda own, given: getattr(own, name)(*given), plant, arguments
        )
    except jax.errors.TracerBoolConversionError as error:
        raise ValueError(
            f"{what} branches on the value of {values} (if, while, and, or): "
            "use jnp.where(condition, value, otherwise)"
        ) from error
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerIntegerConversionError) as error:
        raise ValueError(
            f"{what} gives {values} to float, int, range, a list (as an index) or a function of "
            "math, which take no JAX values: use jax.numpy, such as jnp.sin for math.sin"
        ) from error
    except jax.errors.TracerArrayConversionError as error:
        raise ValueError(f"{what} uses NumPy: use jax.numpy (import jax.numpy as jnp)") from error
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # also sys.exit
        hint = _missing_name(plant, error, what)
        raise hint or ValueError(f"{what} fails: {told(error)}{_SHAPES[name]}") from error


_SHAPES = {
    "derivative": "; its arguments are (self, state, input, params), arrays and a tuple: input[0]",
    "output": "; its arguments are (self, state, params), the first an array: state[0] (or (self, "
    "state, input, params), if an input acts on the outputs directly)",
    "delay": "; its arguments are (self, params)",
}


def _missing_name(plant: AbstractPlant, error: BaseException, what: str) -> ValueError | None:
    """The error for a parameter or constant that a plant does not have; None for another one."""
    if not isinstance(error, AttributeError) or error.name is None:
        return None
    for kind, own, place in (
        ("parameter", plant.nominal, "params"),
        ("constant", plant.constants, "self.constants"),
    ):
        if isinstance(error.obj, type(own)):
            return ValueError(f"{what}: {unknown(kind, error.name, own._fields or ['none'])}")
        if isinstance(error.obj, AbstractPlant) and error.name in own._fields:
            return ValueError(f"{what}: the {kind} self.{error.name} is {place}.{error.name}")
    return None


def require_inputs(plant: AbstractPlant) -> None:
    """Raises ValueError for a plant without inputs, with inputs that act late, or feedthrough.

    Policies and rigs measure, and then choose the input that acts next.
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
    if plant.has_feedthrough:
        raise ValueError(
            f"an input of plant {plant.definition.name!r} acts on an output directly: it can be "
            "simulated and identified, but not be used by design, train, studies and rigs"
        )


def with_sensor(
    plant: AbstractPlant,
    noise_sd: Mapping[str, float] | None,
    resolution: Mapping[str, float] | None = None,
) -> AbstractPlant:
    """The plant with another noise or resolution of the named outputs, in their units.

    Raises:
        ValueError: for an unknown output, or a value that is negative or not finite; for a task
            with its own noise.
        TypeError: for a value that is no number.
    """
    if noise_sd or resolution:
        require_sensor_noise(plant)
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
