"""Names of plants, excitations and estimators, as users write them, and what they stand for.

One plain dictionary a kind. A user's own plant is named by its file and class. Options are
checked here, at the door, down to their types; nothing is evaluated as code.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from .description import names_of
from .estimation import ARX, NLS, AbstractEstimator, Decrement
from .excitation import (
    PRBS,
    AbstractExcitation,
    AbstractShape,
    Chirp,
    Decay,
    Multisine,
    PolicyExcitation,
    PositionLoop,
    Random,
    Replay,
    Square,
    maximum_length_sequence,
)
from .files import class_at
from .plant import (
    EMPS,
    AbstractPlant,
    Aero2,
    Aero2Detailed,
    Aero2Lag,
    CartPole,
    DCMotor,
    Sensor,
)
from .policy import POLICY_ENDING, mismatch, policy_path, read_policy, shipped_policies
from .records import read_signal

PLANTS: Mapping[str, type[AbstractPlant]] = {
    "aero2": Aero2,
    "aero2_lag": Aero2Lag,
    "aero2_detailed": Aero2Detailed,
    "dc_motor": DCMotor,
    "cart_pole": CartPole,
    "emps": EMPS,
}
EXCITATIONS: Mapping[str, type[AbstractShape]] = {
    "random": Random,
    "prbs": PRBS,
    "chirp": Chirp,
    "multisine": Multisine,
    "square": Square,
    "decay": Decay,
}
LOOP = "loop-"
"""Before the name of an excitation: it is the reference of a position loop."""

ESTIMATORS: Mapping[str, AbstractEstimator] = {
    "arx-rls": ARX(),
    "arx-rls-wide": ARX(start_covariance=1e8, name="arx-rls-wide"),
    "nls": NLS(),
    "decrement": Decrement(),
}

SIGNAL_ENDINGS = (".csv", ".mat")


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


def excitation_named(
    name: str, options: Mapping[str, Any], plant: AbstractPlant
) -> AbstractExcitation:
    """An excitation by name, or a trained policy, checked against the plant.

    Raises:
        ValueError: as `excitation_and_origin`.
    """
    return excitation_and_origin(name, options, plant)[0]


def excitation_and_origin(
    name: str, options: Mapping[str, Any], plant: AbstractPlant
) -> tuple[AbstractExcitation, dict[str, str]]:
    """An excitation, and what a record must say of the policy that it is.

    That is `policy_hash`, and a `warning` where the policy was trained on another plant;
    nothing for other excitations.

    Raises:
        ValueError: for an unknown name or option, a value that is not allowed, or a policy
            that may not excite this plant.
    """
    path = policy_path(name)
    if path is not None:
        if options:
            raise ValueError(f"a policy has no options: got {', '.join(options)}")
        policy = read_policy(path)
        try:
            warning = mismatch(policy, plant.description)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
        origin = {"policy_hash": policy.hash} | ({} if warning is None else {"warning": warning})
        return PolicyExcitation.of(policy), origin
    if name.endswith(SIGNAL_ENDINGS):
        signal = _recorded(name, options, plant)
        return signal, {"signal_hash": hashlib.sha256(Path(name).read_bytes()).hexdigest()}
    excitation = _classical(name, options, plant)
    _check_excitation(excitation, plant)
    return excitation, {}


def _recorded(name: str, options: Mapping[str, Any], plant: AbstractPlant) -> Replay:
    """The designed or recorded input in a file."""
    if options:
        raise ValueError(f"a signal from a file has no options: got {', '.join(options)}")
    return Replay(jnp.asarray(read_signal(Path(name), plant.description).inputs))


def _classical(name: str, options: Mapping[str, Any], plant: AbstractPlant) -> AbstractExcitation:
    """A signal, or one as the reference of a position loop, which shares its options."""
    shape = name.removeprefix(LOOP)
    if shape not in EXCITATIONS:
        known = [*EXCITATIONS, *(LOOP + word for word in EXCITATIONS), *shipped_policies()]
        raise unknown("excitation", name, [*known, f"path/to/policy{POLICY_ENDING}"])
    if shape == name:
        return _build(EXCITATIONS[name](), name, options)
    own = {k: v for k, v in options.items() if k in ("amplitude", "gain", "damping")}
    rest = {k: v for k, v in options.items() if k not in own}
    signal = _build(EXCITATIONS[shape](), shape, rest)
    _check_excitation(signal, plant)
    return _build(PositionLoop(signal), name, own)


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
    hidden = ("name", "horizons", "inputs", "signal", "known")
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
    if isinstance(excitation, PositionLoop):
        _check_loop(excitation)
    else:
        _check_amplitude(excitation, plant)
    nyquist = 0.5 / float(plant.dt)
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
    if (phases := getattr(excitation, "phases", 0)) < 0:
        raise ValueError(f"phases is 0 or the seed of random ones: got {phases}")
    pump, register = getattr(excitation, "pump", 0.5), getattr(excitation, "register", 0)
    if not 0 < float(pump) < 1:
        raise ValueError(f"pump must lie between 0 and 1: got {float(pump):g}")
    if register:
        maximum_length_sequence(register)


def _check_amplitude(excitation: Any, plant: AbstractPlant) -> None:
    inputs, amplitude = plant.definition.inputs, getattr(excitation, "amplitude", None)
    if amplitude is None:
        return
    values = amplitude.tolist() if amplitude.ndim else [float(amplitude)] * len(inputs)
    if len(values) != len(inputs):
        raise ValueError(f"{len(values)} amplitudes were given for {len(inputs)} inputs")
    for value, part in zip(values, inputs, strict=True):
        half = (part.upper - part.lower) / 2
        if not 0 <= value <= half * (1 + 1e-9):
            raise ValueError(
                f"amplitude {value:g} {part.unit} is not allowed for {part.name!r}: "
                f"from 0 to {half:g} {part.unit}"
            )


def _check_loop(loop: PositionLoop) -> None:
    for option in ("amplitude", "gain", "damping"):
        value = getattr(loop, option)
        if value is not None and not (value.ndim == 0 and 0 <= float(value) < math.inf):
            raise ValueError(f"{option} of a position loop must not be negative: got {value}")
