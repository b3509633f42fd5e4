"""`Study`: every choice of a comparison, read from a TOML file and checked at the door."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import pydantic
import tomlkit
import tomlkit.exceptions
from pydantic import BaseModel, ConfigDict, Field

from .description import names_of
from .env import Env
from .estimation import ARX, AbstractEstimator
from .excitation import AbstractExcitation
from .files import folder_word
from .information import require_noise
from .names import ESTIMATORS, estimator_named, excitation_named, plant_named, unknown, with_sensor
from .objective import (
    AbstractObjective,
    EstimationError,
    InformationGain,
    prior_sd_of,
    target_mask,
)
from .plant import AbstractARXPlant, AbstractPlant
from .policy import Layout
from .training.base import PPOSettings

_T = TypeVar("_T")


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


Count = Annotated[int, Field(gt=0, strict=True)]
Magnitude = Annotated[float, Field(ge=0, strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, strict=True, allow_inf_nan=False)]


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


class DecisionSettings(_Settings):
    """The decision process an agent is trained on; the paper's, but for what is set.

    Attributes:
        window: samples observed.
        output_scale: y_max by output, in its unit, where it differs from the output's scale.
        reward: of the experiment: `relative` errors (Eq. 4), `log` of them, or
            `information` (its increment at every step); by default the plant's.
        weight: factor of that reward.
        goals: by parameter, the relative error that counts as one, default one.
        estimator: ARX estimator in the reward, by the study's name or any.
        start_covariance: instead of that estimator's; a smaller one lets its bias, which is
            a smooth function of the inputs, outweigh the sensor's noise.
        normalise_penalty: whether the safety penalty is divided by the number of steps.
    """

    window: Count = 80
    output_scale: dict[str, Positive] = {}
    reward: Literal["relative", "log", "information"] | None = None
    weight: Positive = 1.0
    goals: dict[str, Positive] = {}
    estimator: str = "arx-rls"
    start_covariance: Positive | None = None
    normalise_penalty: Annotated[bool, Field(strict=True)] = False


class AgentSettings(_Settings):
    """An agent to be trained: what it is to estimate, and where it differs from the others.

    Attributes:
        targets: parameters in its reward, default the plant's targets.
        decision, training: instead of the study's.
    """

    targets: list[str] | None = None
    method: Literal["ppo"] = "ppo"
    decision: dict[str, Any] = {}
    training: dict[str, Any] = {}


class ReferenceRow(_Settings):
    """A published row of the same table: mean and standard deviation of each column."""

    relative_error_percent: dict[str, tuple[float, float]]
    max_abs_output: tuple[float, float]
    violations: str
    viable_seeds: str = ""


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
        agents: to be trained, by the name that tables show.
        seeds: trainings of each agent, with the seeds 0, 1, ...
        decision, training: settings of all agents.
        inferred: settings that the source of the study does not state, in words.
        ours: settings that differ from the source's, in words.
        reference: published rows by method, shown in tables for comparison.
        source: where they were published.
    """

    name: str
    title: str = ""
    plant: str
    episodes: Count = 100
    num_steps: Count = 500
    seed: Annotated[int, Field(ge=0, lt=2**63, strict=True)] = 0
    spread: Annotated[float, Field(ge=0, lt=1, strict=True, allow_inf_nan=False)] = 0.3
    sensor: dict[str, SensorSettings] = {}
    methods: dict[str, MethodSettings] = {}
    estimators: dict[str, EstimatorSettings]
    agents: dict[str, AgentSettings] = {}
    seeds: Count = 10
    decision: dict[str, Any] = {}
    training: dict[str, Any] = {}
    inferred: list[str] = []
    ours: list[str] = []
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

    def build_env(self, plant: AbstractPlant, agent: str) -> Env:
        """The decision process of an agent.

        Raises:
            ValueError: for a setting or target that does not exist, or a reward from an
                ARX estimator where the plant has no mapping from it.
        """
        own, decision = self.agents[agent], self.build_decision(agent)
        outputs = plant.definition.outputs
        for name in decision.output_scale:
            if name not in names_of(outputs):
                raise unknown("output in output_scale", name, names_of(outputs))
        scales = tuple(decision.output_scale.get(o.name, o.scale) for o in outputs)
        layout = dataclasses.replace(
            Layout.of(plant.description, decision.window, self.num_steps), output_scale=scales
        )
        return Env.of(
            plant,
            objective=self._objective(plant, own, decision),
            layout=layout,
            spread=self.spread,
            penalty_weight=1 / self.num_steps if decision.normalise_penalty else 1.0,
        )

    def _objective(
        self, plant: AbstractPlant, agent: AgentSettings, decision: DecisionSettings
    ) -> AbstractObjective:
        targets = target_mask(plant.definition, agent.targets)
        has_mapping = isinstance(plant, AbstractARXPlant)
        if decision.reward == "information" or (decision.reward is None and not has_mapping):
            return InformationGain(targets, prior_sd_of(self.spread), decision.weight)
        chosen = self.estimators.get(decision.estimator, EstimatorSettings(kind=decision.estimator))
        estimator = estimator_named(chosen.kind, chosen.options)
        if not (has_mapping and isinstance(estimator, ARX)):
            raise ValueError(
                f"the reward {decision.reward!r} from the estimator {decision.estimator!r} needs "
                "an ARX estimator, and a plant with a mapping from ARX coefficients; the reward "
                "'information' needs neither"
            )
        target_mask(plant.definition, list(decision.goals) or None)  # checks the names
        goals = [decision.goals.get(p.name, 1.0) for p in plant.definition.parameters]
        if decision.start_covariance is not None:
            estimator = dataclasses.replace(estimator, start_covariance=decision.start_covariance)
        is_log = decision.reward == "log"
        return EstimationError(estimator, targets, goals, is_log, decision.weight)

    def build_decision(self, agent: str) -> DecisionSettings:
        """How an agent's experiments are rewarded; ValueError for what is not allowed."""
        own = {**self.decision, **self.agents[agent].decision}
        decision = _settings(DecisionSettings, own, "decision")
        unused = {"estimator", "goals", "start_covariance"} & self.agents[agent].decision.keys()
        if decision.reward == "information" and unused:
            raise ValueError(f"decision: the reward 'information' has no {sorted(unused)[0]!r}")
        return decision

    def build_training(self, agent: str) -> PPOSettings:
        """Hyper-parameters of an agent; ValueError for one that is not allowed."""
        return _settings(PPOSettings, {**self.training, **self.agents[agent].training}, "training")

    def agent_settings(self, plant: AbstractPlant, agent: str) -> dict[str, Any]:
        """All that decides what an agent becomes, defaults included, JSON-ready."""
        names = names_of(plant.definition.parameters)
        mask = target_mask(plant.definition, self.agents[agent].targets)
        return {
            "method": self.agents[agent].method,
            "targets": [name for name, chosen in zip(names, mask, strict=True) if chosen],
            "decision": self.build_decision(agent).model_dump(),
            "training": dataclasses.asdict(self.build_training(agent)),
            "spread": self.spread,
            "num_steps": self.num_steps,
        }

    def check_agents(self, plant: AbstractPlant) -> None:
        """Raises ValueError where an agent cannot be built, or its name is taken."""
        _settings(DecisionSettings, self.decision, "decision")
        _settings(PPOSettings, self.training, "training")
        words: dict[str, str] = {}
        for name in self.agents:
            if name in self.methods:
                raise ValueError(f"{name!r} is both a method and an agent")
            other = words.setdefault(folder_word(name), name)
            if other != name or not folder_word(name):
                raise ValueError(
                    f"the agent {name!r} needs a name of its own in letters and digits"
                    + (f"; {other!r} has the same" if other != name else "")
                )
            try:
                self.build_env(plant, name)
                self.build_training(name)
            except ValueError as error:
                raise ValueError(f"agents.{name}: {error}") from None
        if self.agents:
            require_noise(plant)

    def check_reference(self, plant: AbstractPlant) -> None:
        """Raises ValueError for published rows of an unknown method or parameter."""
        parameters = names_of(plant.definition.parameters)
        for method, row in self.reference.items():
            if method not in (known := [*self.methods, *self.agents]):
                raise unknown("method in reference", method, known)
            for name in row.relative_error_percent:
                if name not in parameters:
                    raise unknown(f"parameter in reference.{method}", name, parameters)

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
                    raise unknown("estimator", name, known)
            settings["estimators"] = {name: known[name] for name in chosen}
        return study_from({**self.model_dump(), **settings}, "settings")


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
    study = study_from(content, str(path))
    if ":" in study.plant and (path.parent / study.plant.rpartition(":")[0]).is_file():
        study = study.changed(plant=str(path.parent / study.plant))  # relative to the study
    try:
        plant = study.build_plant()
        study.build_methods(plant)
        study.build_estimators(plant)
        study.check_agents(plant)
        study.check_reference(plant)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return study


def study_from(content: Mapping[str, Any], where: str) -> Study:
    """A study from its settings; ValueError, naming `where`, for what is not allowed."""
    try:
        study = Study.model_validate(content)
    except pydantic.ValidationError as error:
        raise ValueError(f"{where}: {_sentence(error)}") from None
    if not (study.methods or study.agents):
        raise ValueError(f"{where}: the study has no methods")
    if not study.estimators:
        raise ValueError(f"{where}: the study has no estimators")
    return study


def _settings(kind: type[_T], values: Mapping[str, Any], where: str) -> _T:
    """Checked settings of one kind from a table of the study."""
    fields = [f.name for f in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else []
    fields = fields or list(getattr(kind, "model_fields", {}))
    for name in values:
        if name not in fields:
            raise unknown(f"{where} setting", name, fields)
    try:
        # As JSON, because a strict check of Python's own types would want tuples for lists.
        return pydantic.TypeAdapter(kind).validate_json(json.dumps(dict(values)), strict=True)
    except pydantic.ValidationError as error:
        raise ValueError(f"{where}: {_sentence(error)}") from None


def _sentence(error: pydantic.ValidationError) -> str:
    """One of pydantic's complaints as a sentence: a mistyped key before the one it misses."""
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    location = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        tables = {"sensor": SensorSettings, "reference": ReferenceRow, "agents": AgentSettings}
        model = tables.get(str(first["loc"][0]) if len(first["loc"]) > 1 else "", Study)
        where, _, key = location.rpartition(".")
        return f"{where}: " * bool(where) + str(unknown("key", key, model.model_fields))
    if first["type"] == "missing":
        return f"the key {location!r} is missing"
    got = json.dumps(first["input"], default=str)
    if isinstance(first["input"], float) and not math.isfinite(first["input"]):
        got = str(first["input"])
    return f"{location}: {first['msg']}, got {got}" if location else f"{first['msg']}, got {got}"
