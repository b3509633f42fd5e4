"""What a study is made of: its tables, and agents."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar

import pydantic
from pydantic import BaseModel, ConfigDict, Field

from ..description import names_of
from ..env import Env
from ..estimation import ARX
from ..names import estimator_named, unknown
from ..objective import (
    AbstractObjective,
    EstimationError,
    InformationGain,
    prior_sd_of,
    target_mask,
)
from ..plant import AbstractARXPlant, AbstractPlant
from ..policy import Layout
from ..training.base import PPOSettings
from ..training.gradient import GradientSettings

_T = TypeVar("_T")


class Settings(BaseModel):
    """A table of a study file: keys that do not exist are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Count = Annotated[int, Field(gt=0, strict=True)]
Magnitude = Annotated[float, Field(ge=0, strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, strict=True, allow_inf_nan=False)]


class EstimatorSettings(Settings):
    """One estimator: a kind and its options."""

    model_config = ConfigDict(extra="allow", frozen=True)
    kind: str

    @property
    def options(self) -> dict[str, Any]:
        """All but the kind."""
        return dict(self.model_extra or {})


METHODS = {"ppo": PPOSettings, "gradient": GradientSettings}
"""Trainers, and their hyper-parameters."""


class DecisionSettings(Settings):
    """The decision process an agent is trained on; the paper's, but for what is set.

    Attributes:
        window: samples observed.
        clocks: frequencies [Hz] whose sine and cosine are observed too.
        output_scale: y_max by output, in its unit, where it differs from the output's scale.
        reward: of the experiment: `relative` errors (Eq. 4), `log` of them, or
            `information`; by default the plant's.
        weight: factor of that reward.
        criterion: of the information, see `InformationGain`.
        goals: by parameter, the relative error that counts as one, default one.
        estimator: ARX estimator in the reward, by the study's name or any.
        start_covariance: instead of that estimator's; a smaller one lets its bias, which is
            a smooth function of the inputs, outweigh the sensor's noise.
        normalise_penalty: whether the safety penalty is divided by the number of steps.
    """

    window: Count = 80
    clocks: list[Positive] = []
    output_scale: dict[str, Positive] = {}
    reward: Literal["relative", "log", "information"] | None = None
    weight: Positive = 1.0
    criterion: Literal["D", "A", "E"] = "D"
    goals: dict[str, Positive] = {}
    estimator: str = "arx-rls"
    start_covariance: Positive | None = None
    normalise_penalty: Annotated[bool, Field(strict=True)] = False


class AgentSettings(Settings):
    """An agent as a study file has it: where it differs from the study's other agents.

    Attributes:
        targets: parameters in its reward, default the plant's targets.
        method: how it is trained.
        decision, training: instead of the study's.
    """

    targets: list[str] | None = None
    method: Literal["ppo", "gradient"] = "ppo"
    decision: dict[str, Any] = {}
    training: dict[str, Any] = {}


@dataclass(frozen=True)
class Agent:
    """What a policy is trained for, on which decision process, and how.

    Attributes:
        targets: parameters that count, default the plant's targets.
        method: of training.
        decision: settings of the process.
        training: hyper-parameters of the method.
        estimators: those that the reward may name beside the usual ones.
    """

    targets: Sequence[str] | None
    method: str
    decision: DecisionSettings
    training: PPOSettings | GradientSettings
    estimators: Mapping[str, EstimatorSettings] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(
        cls,
        own: AgentSettings,
        decision: Mapping[str, Any],
        training: Mapping[str, Any],
        estimators: Mapping[str, EstimatorSettings],
    ) -> Agent:
        """An agent from its own settings and those it shares with others.

        Raises:
            ValueError: for a setting that does not exist or is not allowed.
        """
        process = checked(DecisionSettings, {**decision, **own.decision}, "decision")
        unused = {"estimator", "goals", "start_covariance"} & own.decision.keys()
        if process.reward == "information" and unused:
            raise ValueError(f"decision: the reward 'information' has no {sorted(unused)[0]!r}")
        chosen = checked(METHODS[own.method], {**training, **own.training}, "training")
        return cls(own.targets, own.method, process, chosen, estimators)

    def env(self, plant: AbstractPlant, spread: float, num_steps: int) -> Env:
        """The decision process of this agent.

        Raises:
            ValueError: for a target or output that does not exist, or a reward from an
                ARX estimator where the plant has no mapping from it.
        """
        decision, outputs = self.decision, plant.definition.outputs
        for name in decision.output_scale:
            if name not in names_of(outputs):
                raise unknown("output in output_scale", name, names_of(outputs))
        layout = dataclasses.replace(
            Layout.of(plant.description, decision.window, num_steps),
            output_scale=tuple(decision.output_scale.get(o.name, o.scale) for o in outputs),
            clocks=_cycles(decision.clocks, float(plant.dt)),
        )
        return Env.of(
            plant,
            objective=self._objective(plant, spread),
            layout=layout,
            spread=spread,
            penalty_weight=1 / num_steps if decision.normalise_penalty else 1.0,
        )

    def _objective(self, plant: AbstractPlant, spread: float) -> AbstractObjective:
        decision, has_mapping = self.decision, isinstance(plant, AbstractARXPlant)
        targets = target_mask(plant.definition, self.targets)
        if decision.reward == "information" or (decision.reward is None and not has_mapping):
            return InformationGain(
                targets,
                prior_sd_of(spread),
                decision.weight,
                criterion=decision.criterion,
                dense=self.method == "ppo",  # a gradient needs no reward on the way
            )
        own = self.estimators.get(decision.estimator, EstimatorSettings(kind=decision.estimator))
        estimator = estimator_named(own.kind, own.options)
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

    def total_steps(self, num_steps: int) -> int:
        """Sampling times of the whole training, for experiments of so many."""
        if isinstance(self.training, PPOSettings):
            return self.training.total_steps
        return self.training.num_updates * self.training.num_plants * num_steps

    def settings(self, plant: AbstractPlant) -> dict[str, Any]:
        """All that decides what it becomes, defaults included, JSON-ready."""
        names = names_of(plant.definition.parameters)
        mask = target_mask(plant.definition, self.targets)
        # What settings did not have from the first stands here only where it is used, so
        # that seeds trained before it are still known.
        later = {"clocks", "criterion"} - self.decision.model_fields_set
        return {
            "method": self.method,
            "targets": [name for name, chosen in zip(names, mask, strict=True) if chosen],
            "decision": self.decision.model_dump(exclude=later),
            "training": dataclasses.asdict(self.training),
        }


def _cycles(clocks: Sequence[float], dt: float) -> tuple[float, ...]:
    """Cycles a step of clocks given in Hz; ValueError beyond half the sampling frequency."""
    for frequency in clocks:
        if frequency * dt > 0.5:
            raise ValueError(
                f"a clock of {frequency:g} Hz is too fast: at most {0.5 / dt:g} Hz at this "
                "sampling time"
            )
    return tuple(frequency * dt for frequency in clocks)


def checked(kind: type[_T], values: Mapping[str, Any], where: str) -> _T:
    """Settings of one kind from a table of the study; ValueError for what is not allowed."""
    fields = [f.name for f in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else []
    fields = fields or list(getattr(kind, "model_fields", {}))
    for name in values:
        if name not in fields:
            raise unknown(f"{where} setting", name, fields)
    try:
        # As JSON, because a strict check of Python's own types would want tuples for lists.
        return pydantic.TypeAdapter(kind).validate_json(json.dumps(dict(values)), strict=True)
    except pydantic.ValidationError as error:
        raise ValueError(f"{where}: {sentence(error)}") from None


def sentence(
    error: pydantic.ValidationError, tables: Mapping[str, type[BaseModel]] = MappingProxyType({})
) -> str:
    """One of pydantic's complaints as a sentence: a mistyped key before the one it misses.

    Args:
        tables: the settings in each table of the file, those of the file itself under "".
    """
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    location = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        table = str(first["loc"][0]) if len(first["loc"]) > 1 else ""
        model = tables[table if table in tables else ""]
        where, _, key = location.rpartition(".")
        return f"{where}: " * bool(where) + str(unknown("key", key, model.model_fields))
    if first["type"] == "missing":
        return f"the key {location!r} is missing"
    got = json.dumps(first["input"], default=str)
    if isinstance(first["input"], float) and not math.isfinite(first["input"]):
        got = str(first["input"])
    return f"{location}: {first['msg']}, got {got}" if location else f"{first['msg']}, got {got}"
