"""Names of plants, excitations and estimators, as users write them, and what they stand for.

One plain dictionary a kind. A user's own plant is named by its file and class. Options are
checked here, at the door, down to their types; nothing is evaluated as code.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib.util
import math
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from .description import names_of
from .estimation import ARX, NLS, AbstractEstimator
from .excitation import (
    PRBS,
    AbstractExcitation,
    Chirp,
    Multisine,
    PolicyExcitation,
    Random,
    Square,
    maximum_length_sequence,
)
from .plant import EMPS, AbstractPlant, Aero2, CartPole, DCMotor, Sensor
from .policy import Policy, mismatch, read_policy

PLANTS: Mapping[str, type[AbstractPlant]] = {
    "aero2": Aero2,
    "dc_motor": DCMotor,
    "cart_pole": CartPole,
    "emps": EMPS,
}
EXCITATIONS: Mapping[str, type[AbstractExcitation]] = {
    "random": Random,
    "prbs": PRBS,
    "chirp": Chirp,
    "multisine": Multisine,
    "square": Square,
}
ESTIMATORS: Mapping[str, AbstractEstimator] = {
    "arx-rls": ARX(),
    "arx-rls-wide": ARX(start_covariance=1e8, name="arx-rls-wide"),
    "nls": NLS(),
}


POLICY_ENDING = ".safetensors"


def unknown(kind: str, word: str, allowed: Iterable[str]) -> ValueError:
    """The error for a word that is not known, with the nearest that is."""
    allowed = list(allowed)
    nearest = difflib.get_close_matches(word, allowed, n=1, cutoff=0.5)
    hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
    return ValueError(f"unknown {kind} {word!r}{hint} (there is {', '.join(allowed)})")


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
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such file")
    plant_class = getattr(_module(Path(path)), class_name, None)
    if not (isinstance(plant_class, type) and issubclass(plant_class, AbstractPlant)):
        raise ValueError(f"{path} has no plant class {class_name!r}")
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


def _module(path: Path) -> Any:
    name = f"excite_plant_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Equinox looks a class's module up by name
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ValueError(f"{path} cannot be imported: {type(error).__name__}: {error}") from error
    return module


def excitation_named(
    name: str, options: Mapping[str, Any], plant: AbstractPlant
) -> AbstractExcitation:
    """An excitation by name, or a trained policy by its file, checked against the plant.

    Raises:
        ValueError: for an unknown name or option, a value that is not allowed, or a policy
            that may not excite this plant.
    """
    if name.endswith(POLICY_ENDING):
        if options:
            raise ValueError(f"a policy has no options: got {', '.join(options)}")
        policy = read_policy(Path(name))
        _check_policy(policy, name, plant)
        return PolicyExcitation.of(policy)
    if name not in EXCITATIONS:
        raise unknown("excitation", name, [*EXCITATIONS, f"path/to/policy{POLICY_ENDING}"])
    excitation = _build(EXCITATIONS[name](), name, options)
    _check_excitation(excitation, plant)
    return excitation


def policy_origin(name: str, plant: AbstractPlant) -> dict[str, str]:
    """What a record must say of the policy that made it; nothing for other excitations.

    `policy_hash`, and a `warning` where the policy was trained on another plant.
    """
    if not name.endswith(POLICY_ENDING):
        return {}
    policy = read_policy(Path(name))
    warning = _check_policy(policy, name, plant)
    return {"policy_hash": policy.hash} | ({} if warning is None else {"warning": warning})


def _check_policy(policy: Policy, name: str, plant: AbstractPlant) -> str | None:
    try:
        return mismatch(policy, plant.description)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def estimator_named(name: str, options: Mapping[str, Any] | None = None) -> AbstractEstimator:
    """An estimator by name, with other options where given.

    Raises:
        ValueError: for an unknown name or option, or a value that is not allowed.
    """
    if name not in ESTIMATORS:
        raise unknown("estimator", name, ESTIMATORS)
    default = ESTIMATORS[name]
    if not options:
        return default
    estimator = _build(default, name, options)
    for option in ("start_covariance", "forgetting_factor", "tolerance", "max_steps"):
        value = float(getattr(estimator, option, 1.0))
        if not 0 < value < math.inf:
            raise ValueError(f"{option} of {name!r} must be positive: got {options[option]!r}")
    if float(getattr(estimator, "forgetting_factor", 1.0)) > 1:
        got = options["forgetting_factor"]
        raise ValueError(f"forgetting_factor of {name!r} must be at most 1: got {got!r}")
    return estimator


def _build(default: Any, name: str, options: Mapping[str, Any]) -> Any:
    """`default` with other options, their names and types checked."""
    hidden = ("name", "horizons", "inputs")
    fields = {f.name: f for f in dataclasses.fields(default) if f.name not in hidden}
    for option, value in options.items():
        if option not in fields:
            raise unknown(f"{name} option", option, fields)
        several = (int, float, list) if option == "amplitude" else (int, float)
        expected = {"bool": bool, "int": int}.get(str(fields[option].type), several)
        is_wrong = not isinstance(value, expected) or (
            isinstance(value, bool) and expected is not bool
        )
        if is_wrong or (
            isinstance(value, list) and not all(isinstance(v, int | float) for v in value)
        ):
            word = {bool: "true or false", int: "a whole number"}.get(expected, "a number")  # pyright: ignore[reportArgumentType, reportCallIssue]
            raise ValueError(f"{option} of {name!r} must be {word}: got {value!r}")
    return dataclasses.replace(default, **options)


def _check_excitation(excitation: Any, plant: AbstractPlant) -> None:
    """Values of an excitation that the plant does not allow."""
    d, nyquist = plant.definition, 0.5 / float(plant.dt)
    amplitude = getattr(excitation, "amplitude", None)
    if amplitude is not None:
        values = amplitude.tolist() if amplitude.ndim else [float(amplitude)] * len(d.inputs)
        if len(values) != len(d.inputs):
            raise ValueError(f"{len(values)} amplitudes were given for {len(d.inputs)} inputs")
        for value, part in zip(values, d.inputs, strict=True):
            half = (part.upper - part.lower) / 2
            if not 0 <= value <= half * (1 + 1e-9):
                raise ValueError(
                    f"amplitude {value:g} {part.unit} is not allowed for {part.name!r}: "
                    f"from 0 to {half:g} {part.unit}"
                )
    for option in ("start_frequency", "stop_frequency", "frequency"):
        value = getattr(excitation, option, None)
        if value is not None and not 0 < float(value) <= nyquist * (1 + 1e-9):
            raise ValueError(
                f"{option} {float(value):g} Hz is not allowed: above 0, and at most "
                f"{nyquist:g} Hz at this sampling time"
            )
    for option in ("hold", "clock"):
        if getattr(excitation, option, 1) < 1:
            raise ValueError(f"{option} is a number of samples, at least 1")
    if getattr(excitation, "register", 0):
        maximum_length_sequence(excitation.register)
