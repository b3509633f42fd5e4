"""`Study`: every choice of a comparison, read from a TOML file and checked at the door.

Names used in files and on the command line are mapped here, one dictionary a kind, and
nowhere else. Nothing in a study is evaluated as code.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib.util
import json
import math
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import pydantic
import tomlkit
import tomlkit.exceptions
from pydantic import BaseModel, ConfigDict, Field

from .description import names_of
from .estimation import ARX, NLS, AbstractEstimator
from .excitation import (
    PRBS,
    AbstractExcitation,
    Chirp,
    Multisine,
    Random,
    Square,
    maximum_length_sequence,
)
from .plant import EMPS, AbstractARXPlant, AbstractPlant, Aero2, CartPole, DCMotor, Sensor

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


def _unknown(kind: str, word: str, allowed: Iterable[str]) -> ValueError:
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
        raise _unknown("plant", name, [*PLANTS, "path/to/file.py:ClassName"])
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such file")
    plant_class = getattr(_module(Path(path)), class_name, None)
    if not (isinstance(plant_class, type) and issubclass(plant_class, AbstractPlant)):
        raise ValueError(f"{path} has no plant class {class_name!r}")
    try:
        plant = plant_class()
    except TypeError as error:  # an abstract method is missing
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
                raise _unknown(f"{plant.definition.name} output", name, outputs)
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
    except Exception as error:
        raise ValueError(f"{path} cannot be imported: {type(error).__name__}: {error}") from error
    return module


def excitation_named(
    name: str, options: Mapping[str, Any], plant: AbstractPlant
) -> AbstractExcitation:
    """An excitation by name, its options checked against the plant.

    Raises:
        ValueError: for an unknown name or option, or a value that is not allowed.
    """
    if name not in EXCITATIONS:
        raise _unknown("excitation", name, EXCITATIONS)
    excitation = _build(EXCITATIONS[name](), name, options)
    _check_excitation(excitation, plant)
    return excitation


def estimator_named(name: str, options: Mapping[str, Any] | None = None) -> AbstractEstimator:
    """An estimator by name, with other options where given.

    Raises:
        ValueError: for an unknown name or option, or a value that is not allowed.
    """
    if name not in ESTIMATORS:
        raise _unknown("estimator", name, ESTIMATORS)
    default = ESTIMATORS[name]
    if not options:
        return default
    for option, value in options.items():
        if option in ("start_covariance", "forgetting_factor") and not float(value) > 0:
            raise ValueError(f"{option} of {name!r} must be positive: got {value!r}")
    if float(options.get("forgetting_factor", 1.0)) > 1:
        raise ValueError(f"forgetting_factor of {name!r} must be at most 1")
    return _build(default, name, options)


def _build(default: Any, name: str, options: Mapping[str, Any]) -> Any:
    """`default` with other options, their names and types checked."""
    fields = {f.name: f for f in dataclasses.fields(default) if f.name != "name"}
    for option, value in options.items():
        if option not in fields:
            raise _unknown(f"{name} option", option, fields)
        expected = {"bool": bool, "int": int}.get(str(fields[option].type), (int, float, list))
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


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


Count = Annotated[int, Field(gt=0, strict=True)]
Magnitude = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class SensorSettings(_Settings):
    """Sensor of one output, in its unit; what is left out stays the plant's."""

    noise_sd: Magnitude | None = None
    resolution: Magnitude | None = None


class MethodSettings(_Settings):
    """One way to excite: a kind of excitation and its options."""

    model_config = ConfigDict(extra="allow", frozen=True)
    excitation: str

    @property
    def options(self) -> dict[str, Any]:
        """All but the kind."""
        return dict(self.model_extra or {})


class EstimatorSettings(_Settings):
    """One estimator: a kind and its options."""

    model_config = ConfigDict(extra="allow", frozen=True)
    kind: str

    @property
    def options(self) -> dict[str, Any]:
        """All but the kind."""
        return dict(self.model_extra or {})


class ReferenceRow(_Settings):
    """A published row of the same table: mean and standard deviation of each column."""

    relative_error_percent: dict[str, tuple[float, float]]
    max_abs_output: tuple[float, float]
    violations: str


class Study(_Settings):
    """Methods x estimators over common plants and noise.

    Attributes:
        name, title: a word, and a line for tables.
        plant: name, or path/to/file.py:ClassName.
        episodes: evaluation episodes of each method, each with a plant of its own.
        num_steps: T, steps of an episode.
        seed: of plants, noise and excitations.
        spread: parameters are uniform in nominal value ± spread times their scale (by
            default the nominal value itself).
        sensor: by output, where it differs from the plant's.
        methods, estimators: by the name that tables show.
        inferred: settings that the source of the study does not state, in words.
        reference: published rows by method, shown in tables for comparison.
        source: where they were published.
    """

    name: str
    title: str = ""
    plant: str
    episodes: Count = 100
    num_steps: Count = 500
    seed: Annotated[int, Field(ge=0, strict=True)] = 0
    spread: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.3
    sensor: dict[str, SensorSettings] = {}
    methods: dict[str, MethodSettings]
    estimators: dict[str, EstimatorSettings]
    inferred: list[str] = []
    reference: dict[str, ReferenceRow] = {}
    source: str = ""

    def build_plant(self) -> AbstractPlant:
        """The plant behind the study's sensor.

        Raises:
            ValueError: for an unknown plant or output.
        """
        own = self.sensor.items()
        return with_sensor(
            plant_named(self.plant),
            {n: s.noise_sd for n, s in own if s.noise_sd is not None},
            {n: s.resolution for n, s in own if s.resolution is not None},
        )

    def build_methods(self, plant: AbstractPlant) -> dict[str, AbstractExcitation]:
        """The study's excitations, checked against the plant."""
        return {
            n: excitation_named(m.excitation, m.options, plant) for n, m in self.methods.items()
        }

    def build_estimators(self, plant: AbstractPlant) -> dict[str, AbstractEstimator]:
        """The study's estimators.

        Raises:
            ValueError: also for an ARX estimator and a plant without inverse mapping.
        """
        estimators = {n: estimator_named(e.kind, e.options) for n, e in self.estimators.items()}
        for name, estimator in estimators.items():
            if isinstance(estimator, ARX) and not isinstance(plant, AbstractARXPlant):
                raise ValueError(
                    f"estimator {name!r} needs a plant with a mapping from ARX coefficients; "
                    f"{self.plant!r} has none, 'nls' needs none"
                )
        return estimators

    def changed(self, estimators: str | None = None, **values: Any) -> Study:
        """The same study with other settings; None leaves a setting as it is.

        Args:
            estimators: names of the study's own or of any estimator, with commas between.
        """
        settings = {k: v for k, v in values.items() if v is not None}
        if estimators is not None:
            chosen = [name.strip() for name in estimators.split(",")]
            known = {n: {"kind": n} for n in ESTIMATORS} | {
                n: e.model_dump() for n, e in self.estimators.items()
            }
            for name in chosen:
                if name not in known:
                    raise _unknown("estimator", name, known)
            settings["estimators"] = {name: known[name] for name in chosen}
        return _study({**self.model_dump(), **settings}, "settings")


def read_study(path: Path) -> Study:
    """The study in a TOML file, checked down to every option of every method.

    Raises:
        ValueError: one sentence for a file that cannot be read, a key that does not
            exist (with the nearest that does), or a value that is not allowed.
    """
    try:
        content = tomlkit.parse(path.read_text(encoding="utf-8")).unwrap()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{path}: cannot be read ({reason})") from None
    except tomlkit.exceptions.ParseError as error:
        raise ValueError(f"{path}: not valid TOML: {error}") from None
    study = _study(content, str(path))
    if ":" in study.plant and (path.parent / study.plant.rpartition(":")[0]).is_file():
        study = study.changed(plant=str(path.parent / study.plant))  # relative to the study
    try:
        plant = study.build_plant()
        study.build_methods(plant)
        study.build_estimators(plant)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return study


def _study(content: Mapping[str, Any], where: str) -> Study:
    try:
        study = Study.model_validate(content)
    except pydantic.ValidationError as error:
        raise ValueError(f"{where}: {_sentence(error)}") from None
    for kind in ("methods", "estimators"):
        if not getattr(study, kind):
            raise ValueError(f"{where}: the study has no {kind}")
    return study


def _sentence(error: pydantic.ValidationError) -> str:
    """One of pydantic's complaints as a sentence: a mistyped key before the one it misses."""
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    location = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        model = {"sensor": SensorSettings, "reference": ReferenceRow}.get(
            str(first["loc"][0]) if len(first["loc"]) > 1 else "", Study
        )
        return str(_unknown("key", location.rpartition(".")[2], model.model_fields))
    if first["type"] == "missing":
        return f"the key {location!r} is missing"
    got = json.dumps(first["input"], default=str)
    if isinstance(first["input"], float) and not math.isfinite(first["input"]):
        got = str(first["input"])
    return f"{location}: {first['msg']}, got {got}"
