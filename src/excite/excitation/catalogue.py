"""Excitations by name, with options checked against the plant; no text is run as code."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Array, Float

from ..description import Listing, first_line, unknown, wrong_type
from ..files import is_class_word, made_at
from ..plant import AbstractPlant, floats
from ..plant.fields import with_options
from ..plant.static import AbstractStaticTask
from ..policy import POLICY_ENDING, Policy, mismatch, policy_path, read_policy, shipped_policies
from ..record import Record, read_signal, require_playable, require_within_limits
from ..record.read import SIGNAL_ENDINGS
from .contract import AbstractExcitation, AbstractShape
from .feedback import PolicyExcitation, PositionLoop
from .signals import (
    PRBS,
    Chirp,
    Decay,
    Multisine,
    NoInput,
    Random,
    Replay,
    Square,
    maximum_length_sequence,
)

EXCITATIONS: Mapping[str, type[AbstractShape]] = {
    "random": Random,
    "prbs": PRBS,
    "chirp": Chirp,
    "multisine": Multisine,
    "square": Square,
    "decay": Decay,
}
LOOP = "loop-"
"""Prefix of an excitation's name: it becomes the reference of a position loop."""


def excitations() -> Listing:
    """The excitations that need no training, by name.

    >>> import excite as ex
    >>> "chirp" in ex.excitations()
    True
    """
    listed = {name: first_line(kind) for name, kind in EXCITATIONS.items()}
    return Listing({**listed, f"{LOOP}NAME": first_line(PositionLoop)})


def usual_signal(plant: AbstractPlant) -> str:
    """The name of the excitation of a plant with inputs where none is named."""
    return "random" if isinstance(plant, AbstractStaticTask) else "chirp"


Inputs: TypeAlias = Float[np.ndarray, "time input"] | Float[Array, "time input"]


@runtime_checkable
class HasInputs(Protocol):
    """A record or a designed signal."""

    @property
    def inputs(self) -> Inputs:
        """By sample and input [input units]."""
        ...


ExcitationLike: TypeAlias = (
    str | Path | AbstractExcitation | type[AbstractExcitation] | Policy | HasInputs | Inputs
)
"""An excitation, its class or name; a policy, a record or a design, or its file; inputs."""


def excitation_named(
    name: ExcitationLike, options: Mapping[str, Any], plant: AbstractPlant
) -> AbstractExcitation:
    """An excitation by name, or a trained policy, checked against the plant.

    Raises:
        ValueError: as `excitation_and_origin`.
    """
    return excitation_and_origin(name, options, plant)[0]


def excitation_and_origin(
    given: ExcitationLike, options: Mapping[str, Any], plant: AbstractPlant
) -> tuple[AbstractExcitation, dict[str, str]]:
    """An excitation, and the entries of a record about its policy.

    These are `policy_hash`, and a `warning` where the policy was trained on another plant.
    Other excitations have none.

    Raises:
        ValueError: for an unknown name or option, a value that is not allowed, or a policy
            that may not excite this plant.
        TypeError: for an object that is no excitation.
    """
    name = str(given) if isinstance(given, str | Path) else name_of(given)
    path = policy_path(name) if isinstance(given, str | Path) else None
    if path is not None or isinstance(given, Policy):
        if options:
            raise ValueError(f"a policy has no options: got {', '.join(options)}")
        policy = given if isinstance(given, Policy) else read_policy(path or Path(name))
        try:
            warning = mismatch(policy, plant.description)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
        origin = {"policy_hash": policy.hash} | ({} if warning is None else {"warning": warning})
        return PolicyExcitation.of(policy), origin
    if isinstance(given, str | Path):
        if name.endswith(SIGNAL_ENDINGS):
            signal = _recorded(name, options, plant)
            return signal, {"signal_hash": hashlib.sha256(Path(name).read_bytes()).hexdigest()}
        if is_class_word(name):
            own = made_at(name, AbstractExcitation, "excitation")
            excitation = with_options(own, name, options)
        else:
            excitation = _classical(name, options, plant)
    else:
        excitation = _object(given, name, options, plant)
    _check_excitation(excitation, plant)
    return excitation, {}


def name_of(given: object) -> str:
    """The name of an excitation that is an object, for records and commands."""
    kind = given if isinstance(given, type) else type(given)
    if isinstance(given, PositionLoop):
        return LOOP + name_of(given.signal)
    if not issubclass(kind, AbstractExcitation):
        return "policy" if isinstance(given, Policy) else "replay"
    shipped = {c: word for word, c in EXCITATIONS.items()} | {NoInput: "no input"}
    return shipped.get(kind, kind.__name__)  # pyright: ignore[reportArgumentType, reportCallIssue]


def _object(
    given: object, name: str, options: Mapping[str, Any], plant: AbstractPlant
) -> AbstractExcitation:
    """An excitation from an object that is neither a name nor a policy."""
    if isinstance(given, type) and issubclass(given, AbstractExcitation):
        given = given()
    if isinstance(given, AbstractExcitation):
        return with_options(given, name, options) if options else given
    inputs = given.inputs if isinstance(given, HasInputs) else given
    if not (isinstance(inputs, np.ndarray | Array) and inputs.dtype.kind in "fiu"):
        raise wrong_type(
            "excitation",
            given,
            "a name, an excitation or its class, a policy, a record, or an array of inputs by "
            "sample and input",
        )
    if inputs.ndim != 2 or not len(inputs):
        raise ValueError(f"inputs need a row for each sample: got shape {inputs.shape}")
    if options:
        raise ValueError(f"recorded inputs have no options: got {', '.join(options)}")
    if isinstance(given, Record):
        require_playable(given, plant.definition)
    rows = np.asarray(inputs, float)
    if (bad := np.flatnonzero(~np.isfinite(rows).all(axis=1))).size:
        raise ValueError(f"inputs must be finite: got {rows[bad[0]].tolist()} at sample {bad[0]}")
    return Replay(floats(rows))


def _recorded(name: str, options: Mapping[str, Any], plant: AbstractPlant) -> Replay:
    """The designed or recorded input in a file."""
    if options:
        raise ValueError(f"a signal from a file has no options: got {', '.join(options)}")
    return Replay(floats(read_signal(Path(name), plant.description).inputs))


def _classical(name: str, options: Mapping[str, Any], plant: AbstractPlant) -> AbstractExcitation:
    """A signal, or one as the reference of a position loop, which shares its options."""
    shape = name.removeprefix(LOOP)
    if shape == "myopic":
        raise ValueError(
            "excitation 'myopic' chooses inputs for a prior: it is for `excite gain`, studies with "
            "a prior, and `ex.Myopic`"
        )
    if shape not in EXCITATIONS:
        known = [*EXCITATIONS, *(LOOP + word for word in EXCITATIONS), *shipped_policies()]
        files = [f"path/to/policy{POLICY_ENDING}", "path/to/file.py:ClassName"]
        raise unknown("excitation", name, [*known, *files])
    if shape == name:
        return with_options(EXCITATIONS[name](), name, options)
    own = {k: v for k, v in options.items() if k in ("amplitude", "gain", "damping")}
    rest = {k: v for k, v in options.items() if k not in own}
    signal = with_options(EXCITATIONS[shape](), shape, rest)
    _check_excitation(signal, plant)
    return with_options(PositionLoop(signal), name, own)


def _check_excitation(excitation: Any, plant: AbstractPlant) -> None:
    """Raises ValueError for values of an excitation that the plant does not allow."""
    if isinstance(excitation, Replay):
        require_within_limits(np.asarray(excitation.inputs), plant.description, "inputs")
    elif isinstance(excitation, PositionLoop):
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
