"""Agents: objective, decision process and training of a policy."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeAlias

from jaxtyping import PyTree
from pydantic import Field

from ..description import Spread, SpreadLike, names_of, prior_sd_of, unknown
from ..environment import (
    MAX_SENSITIVITY,
    AbstractObjective,
    AdaptiveContrastiveGain,
    ContrastiveGain,
    CriticGain,
    Env,
    EstimationError,
    InformationGain,
    OutputError,
    WeightedSum,
    target_mask,
)
from ..estimation import ARX, NLS
from ..estimation.catalogue import estimator_named
from ..estimation.prior import PriorPlants
from ..estimation.prior_knowledge import plants_of
from ..plant import AbstractARXPlant, AbstractPlant
from ..plant.uncertainty import Range, Uncertainty
from ..policy import NO_MEMORY, Layout
from ..safety import watched_levels
from ..training.settings import AGAINST_UNCERTAINTY, ONE_START, GradientSettings, PPOSettings
from .objectives import CONTRASTS
from .settings import (
    Count,
    EstimatorSettings,
    Magnitude,
    Positive,
    Settings,
    SpreadSetting,
    checked,
)

METHODS = {"ppo": PPOSettings, "gradient": GradientSettings}
"""Trainers, and their hyper-parameters."""


Reward: TypeAlias = Literal[
    "relative", "log", "goals", "information", "contrast", "adaptive_contrast", "critic"
]


class RewardSettings(Settings):
    """The reward of an agent.

    Attributes:
        reward: of the experiment: `relative` errors (Eq. 4), `log` of them, the largest over
            its goal (`goals`), `information`, the `contrast` with other plants of the prior (see
            `ContrastiveGain`), an `adaptive_contrast` with probable ones (see
            `AdaptiveContrastiveGain`), or the scores of a `critic` that is trained too (by
            gradient, see `CriticGain`); the default depends on the plant.
        dense: whether information or contrast is rewarded at every step, by default for PPO alone;
            the other two are not.
        weight: factor of that reward.
        criterion, max_sensitivity: of the information, see `InformationGain`.
        goals: by parameter, the relative error that is scaled to one, default one.
        estimator: in the reward, by its name in the study or a shipped name; an ARX estimator,
            or `nls` to first order in the noise, for any plant.
        change_price: of the squared change of an input [1 / input unit²], subtracted from
            information or contrast at every step.
        contrast_plants: with which the true one is compared, by default 255, or 15 probable ones.
        start_covariance: replaces that of the estimator; with a smaller one its bias, which
            is a smooth function of the inputs, is larger than the effect of sensor noise.
    """

    reward: Reward | None = None
    dense: Annotated[bool, Field(strict=True)] | None = None
    weight: Positive = 1.0
    criterion: Literal["D", "A", "E"] = "D"
    max_sensitivity: Positive = MAX_SENSITIVITY
    change_price: Magnitude = 0.0
    contrast_plants: Annotated[Count, Field(le=1_000_000)] | None = None
    goals: dict[str, Positive] = {}
    estimator: str = "arx-rls"
    start_covariance: Positive | None = None


REWARD_TABLES: Mapping[str, type[Settings]] = {"terms": RewardSettings}
"""Tables inside the settings of a decision process."""


class DecisionSettings(RewardSettings):
    """The decision process of an agent: the paper's, except for what is set.

    Attributes:
        terms: several rewards instead of one, which are added.
        window: number of samples observed.
        memory: numbers in which the policy keeps what it has seen (by gradient), beside the window.
        memory_kind: `gru`, a gated recurrent unit; `sum`, of the encoded samples; `attention`,
            over the samples of the window.
        clocks: frequencies [Hz] whose sine and cosine are observed too.
        output_scale: y_max by output, in its unit, where it differs from the output's scale.
        input_amplitude: by input, in its unit, how far from the middle of its limits the
            policy may go, where that is less than the limits allow.
        spread: of the plants it is trained on, where it differs from the study's.
        constants: of these plants, each drawn from a range such as [0.12, 0.21].
        uncertainty: in which it is trained to be safe, where that differs from the study's.
        normalise_penalty: whether the safety penalty is divided by the number of steps.
    """

    terms: Annotated[list[RewardSettings], Field(min_length=1)] = []
    window: Annotated[Count, Field(le=10_000)] = 80
    memory: Annotated[int, Field(ge=0, le=10_000, strict=True)] = 0
    memory_kind: Literal["gru", "sum", "attention"] = "gru"
    clocks: list[Positive] = []
    output_scale: dict[str, Positive] = {}
    input_amplitude: dict[str, Positive] = {}
    spread: SpreadSetting | None = None
    constants: dict[str, tuple[float, float]] = {}
    uncertainty: dict[str, Any] = {}
    normalise_penalty: Annotated[bool, Field(strict=True)] = False


class AgentSettings(Settings):
    """An agent in a study file: its differences from the study's settings.

    Attributes:
        targets: parameters in its reward, default the plant's targets.
        method: how it is trained.
        decision, training: replace the study's.
    """

    targets: list[str] | None = None
    method: Literal["ppo", "gradient"] = "ppo"
    decision: dict[str, object] = {}
    training: dict[str, object] = {}


@dataclass(frozen=True)
class Agent:
    """Objective, decision process and training of a policy.

    Attributes:
        targets: parameters in the reward, default the plant's targets.
        method: of training.
        decision: settings of the process.
        training: hyper-parameters of the method.
        estimators: those that the reward may name in addition to the shipped ones.
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
        decision: Mapping[str, object],
        training: Mapping[str, object],
        estimators: Mapping[str, EstimatorSettings],
    ) -> Agent:
        """An agent from its settings and those of the study.

        Raises:
            ValueError: for a setting that does not exist or is not allowed.
        """
        replaced = {"terms"} if "reward" in own.decision else set()
        if "terms" in own.decision:
            replaced = set(RewardSettings.model_fields)
        if own.decision.get("memory") == 0:  # the kind is for the other agents
            replaced.add("memory_kind")
        shared = {name: value for name, value in decision.items() if name not in replaced}
        process = checked(DecisionSettings, {**shared, **own.decision}, "decision", REWARD_TABLES)
        _require_one_reward(process)
        if process.reward is not None:  # common settings may be for another agent
            stated = own.decision if "reward" in own.decision else process.model_fields_set
            _require_used(_kind(process.reward, process, estimators), stated)
        targets = own.targets or []
        if len(set(targets)) < len(targets):
            raise ValueError(f"targets must differ from each other, got {', '.join(targets)}")
        chosen = checked(METHODS[own.method], {**training, **own.training}, "training")
        if "memory_kind" in process.model_fields_set and not process.memory:
            raise ValueError(NO_MEMORY)
        if process.memory and own.method == "ppo":
            raise ValueError("ppo trains policies without a memory: take the method gradient")
        if process.memory and isinstance(chosen, GradientSettings) and chosen.starts > 1:
            raise ValueError(ONE_START)
        return cls(own.targets, own.method, process, chosen, estimators)

    def env(
        self,
        plant: AbstractPlant,
        spread: SpreadLike,
        num_steps: int,
        ranges: Mapping[str, Range] = MappingProxyType({}),
        coast: int = 0,
        prior: PriorPlants | None = None,
    ) -> Env:
        """The decision process of this agent.

        Args:
            plant: it is trained on.
            spread: of the study.
            num_steps: of an experiment.
            ranges: declared uncertainty of the study.
            coast: of the study.
            prior: of the study, in place of the spread; the criterion D is then rewarded in nats.

        Raises:
            ValueError: for a target, output or input that does not exist, an amplitude
                beyond the input's limits, or a reward from an ARX estimator where the
                plant has no mapping from it.
        """
        decision = self.decision
        own = spread if decision.spread is None else decision.spread
        ranges = self.ranges(ranges)
        if ranges and not watched_levels(plant.definition)[0]:
            raise ValueError(
                f"plant {plant.definition.name!r} has no critical level: leave uncertainty out"
            )
        if prior is not None and decision.spread is not None:
            raise ValueError("an agent of a study with a prior has that prior: leave spread out")
        if prior is not None and ranges:
            raise ValueError("uncertainty is for plants of the spread: leave it or the prior out")
        if coast and self.method == "ppo":
            raise ValueError("ppo does not train on the coast: take the method gradient")
        return Env.of(
            plant,
            objective=self._objective(plant, own, prior, num_steps),
            layout=self._layout(plant, num_steps),
            spread=own,
            penalty_weight=1 / num_steps if decision.normalise_penalty else 1.0,
            constants=_ends(plant, decision.constants),
            uncertainty=Uncertainty.of(plant, own, ranges) if ranges else None,
            coast=coast,
            prior=prior,
        )

    def ranges(self, of_study: Mapping[str, Range]) -> Mapping[str, Range]:
        """The declared uncertainty: this agent's, or that of the study."""
        return self.decision.uncertainty or of_study

    def _layout(self, plant: AbstractPlant, num_steps: int) -> Layout:
        decision, outputs = self.decision, plant.definition.outputs
        remembers = decision.memory, decision.memory_kind
        usual = Layout.of(plant.description, decision.window, num_steps, *remembers)
        halves = dict(zip(names_of(plant.definition.inputs), usual.input_half, strict=True))
        for name in decision.output_scale:
            if name not in names_of(outputs):
                raise unknown("output in output_scale", name, names_of(outputs))
        for name, amplitude in decision.input_amplitude.items():
            if name not in halves:
                raise unknown("input in input_amplitude", name, halves)
            if amplitude > halves[name]:
                raise ValueError(
                    f"input_amplitude of {name!r} is at most {halves[name]:g}: got {amplitude:g}"
                )
        return dataclasses.replace(
            usual,
            output_scale=tuple(decision.output_scale.get(o.name, o.scale) for o in outputs),
            input_half=tuple((halves | decision.input_amplitude).values()),
            clocks=_cycles(decision.clocks, float(plant.dt)),
        )

    def _objective(
        self,
        plant: AbstractPlant,
        spread: SpreadLike,
        prior: PriorPlants | None,
        num_steps: int,
    ) -> AbstractObjective:
        own = plant, spread, prior, num_steps
        terms = [self._term(reward, *own) for reward in self.decision.terms]
        return WeightedSum(terms) if terms else self._term(self.decision, *own)

    def _term(
        self,
        chosen: RewardSettings,
        plant: AbstractPlant,
        spread: SpreadLike,
        prior: PriorPlants | None,
        num_steps: int,
    ) -> AbstractObjective:
        has_mapping = isinstance(plant, AbstractARXPlant)
        form = chosen.reward or ("relative" if has_mapping else "information")
        if chosen.reward is None or chosen is not self.decision:  # the others were checked
            _require_used(_kind(form, chosen, self.estimators), chosen.model_fields_set)
        targets = target_mask(plant.definition, self.targets)
        # A gradient needs no reward before the last step.
        dense = self.method == "ppo" if chosen.dense is None else chosen.dense
        if form in CONTRASTS:
            named = f"the objective {CONTRASTS[form]} (reward {form!r})"
            if not all(targets):
                raise ValueError(
                    f"{named} is of all parameters: name all of them as targets, or take the "
                    "objective D"
                )
            if prior is None and not Spread.of(spread).relative:
                raise ValueError(f"{named} compares plants that differ: give a spread or a prior")
            population = plants_of(plant, None, spread) if prior is None else prior
            count = {} if (n := chosen.contrast_plants) is None else {"num_plants": n}
            own = {**count, "weight": chosen.weight, "change_price": chosen.change_price}
            if form == "contrast":
                return ContrastiveGain(population, dense=dense, **own)
            if form == "critic":
                if self.method == "ppo":
                    raise ValueError(
                        f"ppo does not train a critic: take the method gradient for {named}"
                    )
                if isinstance(self.training, GradientSettings) and self.training.starts > 1:
                    raise ValueError(
                        f"{named} cannot compare several starts, whose critic has learnt nothing: "
                        "leave starts out"
                    )
                return CriticGain(population, num_steps, **own)
            if self.decision.constants:
                raise ValueError(
                    f"{named} is of plants with the same constants: leave their ranges out, or "
                    "take the objective sPCE (reward 'contrast')"
                )
            return AdaptiveContrastiveGain(population, num_steps, **own)
        if form == "information":
            in_nats = prior is not None and chosen.criterion == "D"  # half of log det
            return InformationGain(
                targets,
                prior_sd_of(spread),
                chosen.weight / 2 if in_nats else chosen.weight,
                criterion=chosen.criterion,
                max_sensitivity=chosen.max_sensitivity,
                dense=dense,
                prior=prior,
                change_price=chosen.change_price,
            )
        own = _estimator(chosen, self.estimators)
        estimator = estimator_named(own.kind, own.options)
        target_mask(plant.definition, list(chosen.goals) or None)  # checks the names
        goals = [chosen.goals.get(p.name, 1.0) for p in plant.definition.parameters]
        common = targets, goals, form, chosen.weight
        if isinstance(estimator, NLS) and prior is not None:
            raise ValueError(
                f"the reward {form!r} of nls is for plants of the spread: leave the prior out, or "
                "take the reward 'information'"
            )
        if isinstance(estimator, NLS):
            bound = {"max_sensitivity": chosen.max_sensitivity}
            return OutputError(*common, prior_sd=prior_sd_of(spread), **bound)
        if not (has_mapping and isinstance(estimator, ARX)):
            raise ValueError(
                f"the reward {form!r} from the estimator {chosen.estimator!r} needs "
                "an ARX estimator, and a plant with a mapping from ARX coefficients; the "
                "estimator 'nls' and the reward 'information' need neither"
            )
        if chosen.start_covariance is not None:
            estimator = dataclasses.replace(estimator, start_covariance=chosen.start_covariance)
        return EstimationError(*common, estimator=estimator)

    def total_steps(self, num_steps: int) -> int:
        """Sampling times of the whole training, for experiments of `num_steps`."""
        if isinstance(self.training, PPOSettings):
            return self.training.whole_steps
        return self.training.num_updates * self.training.num_plants * num_steps

    def stage(self, steps: float, num_steps: int) -> str:
        """Progress of a training after `steps` sampling times, in its unit."""
        if isinstance(self.training, PPOSettings):
            return f"step {steps:,.0f} of {self.training.whole_steps:,}"
        done = steps / (self.training.num_plants * num_steps)
        return f"updating {done:,.0f} of {self.training.num_updates:,}"

    def settings(
        self, plant: AbstractPlant, ranges: Mapping[str, Range] = MappingProxyType({})
    ) -> dict[str, Any]:
        """All settings that determine the policy, defaults included, JSON-ready.

        Args:
            plant: it is trained on.
            ranges: declared uncertainty of the study.
        """
        is_uncertain = bool(self.ranges(ranges))
        names = names_of(plant.definition.parameters)
        mask = target_mask(plant.definition, self.targets)
        # Settings that were added later enter only where they are used, so that the
        # fingerprints of earlier trainings stay valid.
        later = {"clocks", "criterion", "max_sensitivity", "input_amplitude", "spread", "dense"}
        later |= {"constants", "terms", "uncertainty", "memory", "memory_kind", "change_price"}
        later |= {"contrast_plants"}
        process = self.decision.model_dump(exclude=later - self.decision.model_fields_set)
        if self.decision.memory_kind == "gru":
            process.pop("memory_kind", None)
        for term, own in zip(process.get("terms", ()), self.decision.terms, strict=False):
            for name in {"change_price", "contrast_plants"} - own.model_fields_set:
                del term[name]
        return {
            "method": self.method,
            "targets": [name for name, chosen in zip(names, mask, strict=True) if chosen],
            "decision": process,
            "training": {
                name: value
                for name, value in dataclasses.asdict(self.training).items()
                if (is_uncertain or name not in AGAINST_UNCERTAINTY)
                and (name, value) not in (("starts", 1), ("through_measurements", True))
            },
            **({"uncertainty": dict(self.ranges(ranges))} if is_uncertain else {}),
        }


def _ends(
    plant: AbstractPlant, ranges: Mapping[str, tuple[float, float]]
) -> tuple[PyTree, PyTree] | None:
    """Lowest and highest constants of a plant; ValueError for a range that is not allowed."""
    if not ranges:
        return None
    names = names_of(plant.definition.constants)
    for name, (low, high) in ranges.items():
        if name not in names:
            raise unknown("constant in constants", name, names)
        if not low <= high:
            raise ValueError(f"range of constant {name!r} must increase: got {low:g} to {high:g}")
    low, high = ({name: ends[i] for name, ends in ranges.items()} for i in (0, 1))
    return plant.changed(**low).constants, plant.changed(**high).constants


def _require_one_reward(process: DecisionSettings) -> None:
    """Raises ValueError for a reward beside terms, which have their own, and for a term twice."""
    beside = sorted(set(RewardSettings.model_fields) & process.model_fields_set)
    if process.terms and beside:
        raise ValueError(f"decision: with terms, set {beside[0]!r} in one of them")
    for i, term in enumerate(process.terms):
        if term in process.terms[:i]:
            raise ValueError(f"decision: terms must differ: got {term.reward!r} twice, the same")


_USED = {
    "information": {"dense", "criterion", "max_sensitivity", "change_price"},
    "contrast": {"dense", "change_price", "contrast_plants"},
    "adaptive_contrast": {"change_price", "contrast_plants"},
    "critic": {"change_price", "contrast_plants"},
    "errors of nls": {"goals", "estimator", "max_sensitivity"},
    "errors of an ARX estimator": {"goals", "estimator", "start_covariance"},
}
"""Settings of each kind of reward in addition to `reward` and `weight`."""


def _kind(form: str, chosen: RewardSettings, estimators: Mapping[str, EstimatorSettings]) -> str:
    if form in ("information", *CONTRASTS):
        return form
    is_nls = _estimator(chosen, estimators).kind == "nls"
    return "errors of nls" if is_nls else "errors of an ARX estimator"


def _estimator(
    chosen: RewardSettings, estimators: Mapping[str, EstimatorSettings]
) -> EstimatorSettings:
    """The estimator of a reward: that of the study with this name, or the shipped one."""
    return estimators.get(chosen.estimator, EstimatorSettings(kind=chosen.estimator))


def _require_used(kind: str, names: Iterable[str]) -> None:
    """Raises ValueError for a setting of another kind of reward."""
    unused = sorted(set().union(*_USED.values()) & set(names) - _USED[kind])
    if unused:
        raise ValueError(f"decision: the reward {kind!r} has no {unused[0]!r}")


def _cycles(clocks: Sequence[float], dt: float) -> tuple[float, ...]:
    """Cycles per step of clocks given in Hz; ValueError beyond half the sampling frequency."""
    for frequency in clocks:
        if frequency * dt > 0.5:
            raise ValueError(
                f"a clock of {frequency:g} Hz is too fast: at most {0.5 / dt:g} Hz at this "
                "sampling time"
            )
    return tuple(frequency * dt for frequency in clocks)
