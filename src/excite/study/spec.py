"""`Study`: all settings of a comparison, read from a TOML file and checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import pydantic
from pydantic import Field

from ..description import by_name, names_of, unknown, wrong_type
from ..environment import Env, InformationGain
from ..estimation import ARX, AbstractEstimator, Decrement
from ..estimation.catalogue import ESTIMATORS, estimator_named
from ..estimation.myopic import MYOPIC, Myopic
from ..estimation.prior import PriorPlants
from ..estimation.prior_knowledge import plants_of
from ..excitation import AbstractExcitation
from ..excitation.catalogue import excitation_and_origin, excitation_named
from ..files import folder_word
from ..information import require_bound
from ..plant import AbstractARXPlant, AbstractPlant
from ..plant.catalogue import (
    PlantLike,
    plant_from,
    plant_named,
    require_inputs,
    with_sensor,
    word_of,
)
from ..plant.uncertainty import Uncertainty
from ..training.settings import GradientSettings, PPOSettings
from ..training.signals import CLAIRVOYANT, CLAIRVOYANT_STARTS
from .agent import REWARD_TABLES, Agent, AgentSettings, DecisionSettings
from .catalogue import study_path
from .settings import (
    Choice,
    Count,
    EstimatorSettings,
    Magnitude,
    Settings,
    SpreadSetting,
    checked,
    excitation_beside,
    read_toml,
    sentence,
)


class SensorSettings(Settings):
    """Sensor of one output, in its unit; a value left out is the plant's."""

    noise_sd: Magnitude | None = None
    resolution: Magnitude | None = None


class MethodSettings(Choice):
    """One way to excite: a kind of excitation and its options."""

    excitation: str


class ClairvoyantSettings(Settings):
    """Signals designed for known parameters, as a reference for the methods.

    Attributes:
        plants: for how many of the evaluation episodes' plants.
        starts: of the search for each.
        updates: steps of each search.
    """

    plants: Count = 32
    starts: Count = CLAIRVOYANT_STARTS
    updates: Count = CLAIRVOYANT.num_updates


class GainSettings(Settings):
    """Expected information gain of every method, in nats; see `information_gain`.

    Attributes:
        plants: that are drawn, each with a record.
        samples: of the evidence of each record.
        from_prior: whether these are drawn from the prior: the usual figure of benchmarks, which
            can only be compared for the same number of samples.
    """

    plants: Annotated[int, Field(ge=2, le=1_000_000, strict=True)] = 256
    samples: Annotated[int, Field(ge=1, le=100_000_000, strict=True)] = 1000
    from_prior: Annotated[bool, Field(strict=True)] = False


class RigSettings(Settings):
    """Experiments on the plant's simulated rig (`excite.rig.simulated`), not on the plant.

    Attributes:
        latency, jitter: of an input's action [s], by default the rig's.
        dropout: probability that a reading repeats the one before it.
        filter: whether every method is also run behind the predictive safety filter.
    """

    latency: Magnitude | None = None
    jitter: Magnitude | None = None
    dropout: Annotated[float, Field(ge=0, lt=1, strict=True)] | None = None
    filter: Annotated[bool, Field(strict=True)] = False

    def numbers(self) -> dict[str, float]:
        """The settings of the rig that are given."""
        return self.model_dump(exclude={"filter"}, exclude_none=True)


class ReferenceRow(Settings):
    """A published row of the same table: mean and standard deviation of each column."""

    relative_error_percent: dict[str, tuple[float, float]]
    max_abs_output: tuple[float, float]
    violations: str
    viable_seeds: str = ""


class Study(Settings):
    """Methods x estimators over common plants and noise.

        >>> import excite as ex
        >>> ex.read_study("table1").episodes
        100

    Attributes:
        name, title: a word, and a line for tables.
        plant: name, or path/to/file.py:ClassName.
        episodes: evaluation episodes of each method, each on another plant.
        num_steps: T, steps of an episode.
        seed: of plants, noise and excitations.
        spread: parameters are uniform in nominal value ± spread times their scale (by
            default the nominal value itself), or within a factor such as "factor:3".
        prior: distributions of parameters ("normal:MEAN:SD", "lognormal:MEDIAN:SD", with SD in
            percent or not, "uniform:LOWEST:HIGHEST"); the others have the spread. Plants are drawn
            from it.
        gain: where every method's expected information gain is computed.
        uncertainty: what else may differ, see `Uncertainty`: all are evaluated on plants drawn
            from it; agents by gradient are trained to be safe in it, and falsified.
        coast: samples after an experiment, under the input that ends it, in which it must be safe
            too; nothing is measured there.
        sensor: by output, where it differs from the plant's.
        methods, estimators: by the name that tables show.
        agents: to be trained, by the name that tables show.
        seeds: trainings of each agent, with the seeds 0, 1, ...
        safety_episodes: of every seed of an agent, on plants that no other seed has, to count
            violations alone; without it they are counted in the `episodes`, whose plants the
            seeds share.
        decision: settings of all agents.
        training, gradient: hyper-parameters of all agents trained by PPO, and by gradient.
        clairvoyant: signals as a reference for the methods.
        lengths: numbers of steps at which every method's Cramér-Rao bound is computed.
        rig: where experiments are made on a simulated rig.
        note: sentences that come first in the text under the table.
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
    spread: SpreadSetting = 0.3
    prior: dict[str, str] = {}
    gain: GainSettings | None = None
    uncertainty: dict[str, Any] = {}
    coast: Annotated[int, Field(ge=0, le=100_000, strict=True)] = 0
    sensor: dict[str, SensorSettings] = {}
    methods: dict[str, MethodSettings] = {}
    estimators: dict[str, EstimatorSettings]
    agents: dict[str, AgentSettings] = {}
    seeds: Count = 10
    safety_episodes: Count | None = None
    decision: dict[str, object] = {}
    training: dict[str, object] = {}
    gradient: dict[str, object] = {}
    clairvoyant: ClairvoyantSettings | None = None
    lengths: list[Count] = []
    rig: RigSettings | None = None
    note: str = ""
    inferred: list[str] = []
    ours: list[str] = []
    reference: dict[str, ReferenceRow] = {}
    source: str = ""

    def build_plant(self) -> AbstractPlant:
        """The plant with the study's sensor.

        Raises:
            ValueError: for an unknown plant or output, and for a plant without inputs.
        """
        own, plant = self.sensor.items(), plant_named(self.plant)
        require_inputs(plant)
        return with_sensor(
            plant,
            {n: s.noise_sd for n, s in own if s.noise_sd is not None},
            {n: s.resolution for n, s in own if s.resolution is not None},
        )

    def build_uncertainty(self, plant: AbstractPlant) -> Uncertainty | None:
        """The declared uncertainty; None where only the parameters differ.

        Raises:
            ValueError: for a name or a range that is not allowed.
        """
        if not self.uncertainty:
            return None
        if self.rig is not None:
            raise ValueError("experiments on a rig differ by spread alone: leave uncertainty out")
        return Uncertainty.of(plant, self.spread, self.uncertainty)

    def build_prior(self, plant: AbstractPlant) -> PriorPlants | None:
        """The distribution of the parameters; None where they have the spread alone.

        Raises:
            ValueError: for a distribution that is not allowed, and beside what knows none.
        """
        others = {"uncertainty": self.uncertainty, "rig": self.rig, "clairvoyant": self.clairvoyant}
        for name, other in others.items():
            if self.prior and other:
                raise ValueError(f"{name} is for plants of the spread: leave it or the prior out")
        for name in ("rig", "uncertainty"):
            if self.gain is not None and others[name]:
                raise ValueError(f"gain is that of the plant and its prior: leave it or {name} out")
        return plants_of(plant, self.prior, self.spread) if self.prior else None

    def build_methods(self, plant: AbstractPlant) -> dict[str, AbstractExcitation]:
        """The study's excitations, checked against the plant and the number of steps."""
        methods = {}
        for length in self.lengths:
            if not 2 <= length <= self.num_steps:
                raise ValueError(f"lengths must lie between 2 and num_steps: got {length}")
        for name, method in self.methods.items():
            if _is_myopic(method):
                made = Myopic.of(plant, self.prior or None, self.spread)
            else:
                made = excitation_named(method.excitation, method.options, plant)
            try:
                jax.eval_shape(partial(made.init, plant, self.num_steps), jax.random.key(0))
            except ValueError as error:
                raise ValueError(f"{method.excitation}: {error}") from None
            methods[name] = made
        return methods

    def warnings(self) -> list[str]:
        """A sentence for every policy among the methods that was trained on another plant."""
        origins = self.origins(self.build_plant())
        found = {
            self.methods[n].excitation: o["warning"] for n, o in origins.items() if "warning" in o
        }
        return [f"{path}: {warning}" for path, warning in found.items()]

    def origins(self, plant: AbstractPlant) -> dict[str, dict[str, str]]:
        """Entries of a record about each method that is a policy, see `excitation_and_origin`."""
        own = {
            name: excitation_and_origin(m.excitation, m.options, plant)[1]
            for name, m in self.methods.items()
            if not _is_myopic(m)
        }
        return {name: origin for name, origin in own.items() if origin}

    def build_estimators(self, plant: AbstractPlant) -> dict[str, AbstractEstimator]:
        """The study's estimators.

        Raises:
            ValueError: also for an ARX estimator and a plant without inverse mapping.
        """
        estimators = {n: estimator_named(e.kind, e.options) for n, e in self.estimators.items()}
        for name, estimator in estimators.items():
            if isinstance(estimator, ARX | Decrement) and not isinstance(plant, AbstractARXPlant):
                raise ValueError(
                    f"estimator {name!r} needs a plant with a mapping from ARX coefficients; "
                    f"{self.plant!r} has none, 'nls' needs none"
                )
        return estimators

    def agent(self, name: str) -> Agent:
        """An agent with all its settings; ValueError for one that is not allowed."""
        own = self.agents[name]
        shared = {"ppo": self.training, "gradient": self.gradient}[own.method]
        return Agent.of(own, self.decision, shared, self.estimators)

    def env(self, agent: str, plant: AbstractPlant) -> Env:
        """The decision process of an agent."""
        own = self.agent(agent)
        prior = self.build_prior(plant)
        return own.env(plant, self.spread, self.num_steps, self.uncertainty, self.coast, prior)

    def bound_curves(self) -> list[str]:
        """Agents whose learning curves hold the Cramér-Rao bound instead of errors."""
        plant = self.build_plant()
        envs = {name: self.env(name, plant) for name in self.agents}
        return [n for n, env in envs.items() if isinstance(env.objective, InformationGain)]

    def checked(self, where: str) -> Study:
        """Validates all settings; returns self. ValueError, naming `where`, for a mistake."""
        try:
            plant = self.build_plant()
            self.build_uncertainty(plant)
            self.build_prior(plant)
            if self.coast and self.rig is not None:
                raise ValueError("experiments on a rig end with the last sample: leave coast out")
            self.build_methods(plant)
            self.build_estimators(plant)
            self.check_agents(plant)
            self.check_reference(plant)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        return self

    def check_agents(self, plant: AbstractPlant) -> None:
        """Raises ValueError where an agent cannot be built, or its name is taken."""
        checked(DecisionSettings, self.decision, "decision", REWARD_TABLES)
        checked(PPOSettings, self.training, "training")
        checked(GradientSettings, self.gradient, "gradient")
        words: dict[str, str] = {}
        for name in self.agents:
            if name in self.methods:
                raise ValueError(f"{name!r} is both a method and an agent")
            other = words.setdefault(folder_word(name), name)
            if other != name or not folder_word(name):
                raise ValueError(
                    f"the agent {name!r} needs a unique name with letters or digits"
                    + (f"; {other!r} has the same" if other != name else "")
                )
            try:
                self.env(name, plant)
            except ValueError as error:
                raise ValueError(f"agents.{name}: {error}") from None
        if self.agents:
            require_bound(plant)
            if self.num_steps < 2:
                raise ValueError("num_steps must be at least 2 where agents are trained, got 1")

    def check_reference(self, plant: AbstractPlant) -> None:
        """Raises ValueError for published rows of an unknown method or parameter."""
        parameters = names_of(plant.definition.parameters)
        for method, row in self.reference.items():
            if method not in (known := [*self.methods, *self.agents]):
                raise unknown("method in reference", method, known)
            for name in row.relative_error_percent:
                if name not in parameters:
                    raise unknown(f"parameter in reference.{method}", name, parameters)

    def changed(self, estimators: str | Sequence[str] | None = None, **values: object) -> Study:
        """The same study with other settings; None leaves a setting as it is.

        Args:
            estimators: names of the study's or of any estimator, or these with commas between.
        """
        settings = {k: v for k, v in values.items() if v is not None}
        if estimators is not None:
            names = estimators.split(",") if isinstance(estimators, str) else estimators
            if not (isinstance(names, Sequence) and all(isinstance(n, str) for n in names)):
                raise wrong_type("estimators", estimators, "a name or several names")
            chosen = [name.strip() for name in names]
            known = {n: {"kind": n} for n in ESTIMATORS} | {
                n: e.model_dump() for n, e in self.estimators.items()
            }
            for name in chosen:
                if name not in known:
                    raise unknown("estimator", name, known)
            settings["estimators"] = {name: known[name] for name in chosen}
        return study_from({**self.model_dump(), **settings}, "settings")


def _is_myopic(method: MethodSettings) -> bool:
    """Whether a method chooses designs for the study's prior; ValueError for options."""
    if method.excitation != MYOPIC:
        return False
    if method.options:
        raise ValueError(f"excitation {MYOPIC!r} has no option {next(iter(method.options))!r}")
    return True


def of_prior(prior: Mapping[str, str] | None) -> dict[str, object]:
    """The settings of a study file for a prior, under which the expected gain is computed too."""
    given = by_name("prior", prior, "a dict of distributions by parameter")
    return {"prior": given, "gain": {} if given else None}


_TABLES = {
    "": Study,
    "clairvoyant": ClairvoyantSettings,
    "gain": GainSettings,
    "rig": RigSettings,
    "sensor": SensorSettings,
    "reference": ReferenceRow,
    "agents": AgentSettings,
}


def read_study(path: str | Path) -> Study:
    """The study in a TOML file or of a shipped name, fully validated.

        >>> import excite as ex
        >>> ex.read_study("baselines").plant
        'aero2'

    Raises:
        ValueError: one sentence for a file that cannot be read, a key that does not
            exist (with the nearest that does), or a value that is not allowed.
    """
    path = study_path(path)
    study = study_from(read_toml(path), str(path))
    return _beside(study, path.parent).checked(str(path))


def _beside(study: Study, folder: Path) -> Study:
    """The study with its file names relative to its folder resolved."""
    plant, methods = study.plant, study.model_dump()["methods"]
    if ":" in plant and (folder / plant.rpartition(":")[0]).is_file():
        plant = str(folder / plant)
    for method in methods.values():
        method["excitation"] = excitation_beside(folder, method["excitation"])
    return study.changed(plant=plant, methods=methods)


def study_from(content: Mapping[str, object], where: str) -> Study:
    """A study from its settings; ValueError, naming `where`, for what is not allowed."""
    try:
        study = Study.model_validate(content)
    except pydantic.ValidationError as error:
        raise ValueError(f"{where}: {sentence(error, _TABLES)}") from None
    if not (study.methods or study.agents):
        raise ValueError(f"{where}: the study has no methods")
    if not study.estimators:
        raise ValueError(f"{where}: the study has no estimators")
    return study


def plant_tables(
    plant: PlantLike, noise: Mapping[str, float] | None = None
) -> tuple[dict[str, object], AbstractPlant]:
    """The settings of a study file for a plant and its sensor, and that plant.

    Args:
        noise: standard deviation by output, in its unit, where it differs from the plant's.

    Raises:
        ValueError: for a class that is in no file, or a plant with other numbers than its class.
        TypeError: for an object that is no plant.
    """
    given = plant_from(plant)
    require_inputs(given)
    word = plant if isinstance(plant, str) else word_of(given)
    usual = given if isinstance(plant, str) else plant_named(word)
    if usual.changed(sensor=given.sensor).description.hash != given.description.hash:
        raise ValueError(
            f"a study names its plant, and this {word} differs from its class in nominal values, "
            "constants, dt or initial state: write a class with these numbers"
        )
    pairs = zip(usual.description.outputs, given.description.outputs, strict=True)
    sensor = {
        mine.name: {"noise_sd": mine.noise_sd, "resolution": mine.resolution}
        for own, mine in pairs
        if mine != own
    }
    built = with_sensor(given, noise)
    for name, sd in (noise or {}).items():
        sensor[name] = {**sensor.get(name, {}), "noise_sd": sd}
    return {"plant": word, "sensor": sensor}, built
