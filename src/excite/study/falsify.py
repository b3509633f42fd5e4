"""`falsify`: the plant within a declared uncertainty on which an excitation is least safe."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax

from .. import __version__
from ..description import LARGEST_SEED, PlantDescription, names_of, require_whole
from ..environment.falsification import Cases, Effort, OnPlant, Stage, search
from ..excitation.catalogue import (
    EXCITATIONS,
    LOOP,
    SIGNAL_ENDINGS,
    ExcitationLike,
    excitation_and_origin,
    name_of,
)
from ..files import require_new_file, write_json
from ..plant.catalogue import (
    PLANT_ENDING,
    PlantLike,
    is_plant_file,
    plant_from,
    plant_in_file,
    require_inputs,
    with_sensor,
)
from ..plant.uncertainty import Range, Uncertainty
from ..policy import POLICY_ENDING, Policy, policy_path, read_policy
from ..record import Record
from ..report.numbers import number
from ..report.tables import html_table, text_table
from ..rig.falsification import OnRig
from ..rig.filter import SafetyFilter
from ..rig.simulated import NO_FILTER
from ..safety import watched_levels
from ..simulation import DivergedError, Experiment, Trajectory, experiment_length
from ..training.checkpoint import Progress

if TYPE_CHECKING:
    import matplotlib.figure


MIN_BUDGET = 100
"""Smallest number of experiments of a search."""


@dataclass(frozen=True, repr=False)
class Falsification:
    """What a search for the least safe plant found; it proves nothing about other plants.

    Attributes:
        plant: for which the excitation was made.
        excitation: its name.
        policy: its policy, if it is one.
        num_steps: of an experiment.
        ranges: the declared uncertainty: lowest and highest value of each quantity.
        stages: of the search.
        nearness: the largest output over its critical level that was found, with the noise of
            a seed; 1 and more are violations.
        noise_nearness: the same with noise that is searched too, within `noise_bound`.
        noise_bound: in standard deviations.
        worst: quantities of the worst plant.
        worst_seed: of its noise, for `simulate`.
        worst_plant: content of that plant's file.
        record: its experiment.
        seed: of the search.
        rig: whether experiments were made on the plant's simulated rig.
        filter: whether they were made there behind the predictive safety filter.
        spread: of parameters without a range, and of the filter's prior.
    """

    plant: PlantDescription
    excitation: str
    policy: Policy | None
    num_steps: int
    ranges: Mapping[str, tuple[float, float]]
    stages: tuple[Stage, ...]
    nearness: float
    noise_nearness: float
    noise_bound: float
    worst: Mapping[str, float]
    worst_seed: int
    worst_plant: Mapping[str, object]
    record: Record
    seed: int
    rig: bool = False
    filter: bool = False
    spread: float = 0.3

    @property
    def is_safe(self) -> bool:
        """Whether no experiment reached a critical level, with searched noise neither."""
        return max(self.nearness, self.noise_nearness) < 1

    def certificate(self) -> dict[str, Any]:
        """What was searched, how hard, and what was found, JSON-ready."""
        return {
            "excite": __version__,
            "plant_hash": self.plant.hash,
            "uncertainty": {name: list(ends) for name, ends in self.ranges.items()},
            "rig": self.rig,
            "filter": self.filter,
            "seed": self.seed,
            "experiments": sum(stage.experiments for stage in self.stages),
            "violations": sum(stage.violations for stage in self.stages),
            "stages": [vars(stage) for stage in self.stages],
            "noise_bound": self.noise_bound,
            "nearness": self.nearness,
            "noise_nearness": self.noise_nearness,
            "worst": dict(self.worst),
            "worst_seed": self.worst_seed,
        }

    def certified(self) -> Policy:
        """The policy with this certificate in its file.

        Raises:
            ValueError: where the excitation is not a policy.
        """
        if self.policy is None:
            raise ValueError(f"only a policy has a certificate; {self.excitation} is none")
        return self.policy.certified(self.certificate())

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Writes the worst plant as JSON, a plant for every verb: `ex.simulate("worst.json")`.

        Raises:
            ValueError: for another ending, or a file that exists, unless `overwrite`.
        """
        path = Path(path)
        require_plant_path(path, overwrite)
        write_json(path, self.worst_plant)

    def plot(self) -> matplotlib.figure.Figure:
        """Inputs and outputs of the worst experiment over time, with limits and levels."""
        from ..figure import episode_figure

        return episode_figure(self.plant, self.record)

    def __repr__(self) -> str:
        """The stages as a table, the verdict, and the worst plant."""
        title, header, rows = self._table()
        lines = [textwrap.fill(line, 80) for line in self._sentences()]
        return "\n".join([text_table(title, header, rows), *lines])

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        return html_table(*self._table()) + "".join(f"<p>{line}</p>" for line in self._sentences())

    def _table(self) -> tuple[str, list[str], list[list[str]]]:
        where = on_rig(self.rig, self.filter)
        title = (
            f"{self.excitation} on {self.plant.name}{where}: largest output over its critical level"
        )
        rows = [
            [s.name, f"{s.experiments:,}", f"{s.violations:,}", f"{s.nearness:.3f}"]
            for s in self.stages
        ]
        return title, ["searched", "experiments", "violations", "largest"], rows

    def _sentences(self) -> list[str]:
        box = ", ".join(f"{n} {number(a)} to {number(b)}" for n, (a, b) in self.ranges.items())
        worst = ", ".join(f"{name} = {number(value)}" for name, value in self.worst.items())
        total = sum(stage.experiments for stage in self.stages)
        found = (
            f"no violation found in {total:,} experiments; this is no proof"
            if self.is_safe
            else f"UNSAFE: {sum(s.violations for s in self.stages):,} of {total:,} experiments "
            "reach a critical level"
        )
        return [
            found,
            f"searched: {box}",
            f"worst plant ({self.nearness:.3f} of the level, noise of seed {self.worst_seed}): "
            f"{worst}",
        ]


def require_plant_path(path: Path, overwrite: bool) -> None:
    """Raises ValueError where the file of a plant cannot be written."""
    if path.suffix != PLANT_ENDING:
        raise ValueError(f"{path}: files of plants end in {PLANT_ENDING}")
    require_new_file(path, overwrite)
    if path.exists() and not is_plant_file(path):
        raise ValueError(f"{path} is no file of a plant and would be lost; choose another name")


def require_certifiable(excitation: str, path: Path, overwrite: bool) -> None:
    """Raises ValueError where a certificate cannot be written: no policy, or a file that exists."""
    if policy_path(excitation) is None:
        raise ValueError(f"only a policy has a certificate; {excitation!r} is none")
    if path.suffix != POLICY_ENDING:
        raise ValueError(f"{path}: policy files end in {POLICY_ENDING}")
    require_new_file(path, overwrite)


def falsify(
    excitation: ExcitationLike,
    plant: PlantLike | None = None,
    *,
    options: Mapping[str, object] | None = None,
    spread: float | None = None,
    uncertainty: Mapping[str, Range] | None = None,
    noise: Mapping[str, float] | None = None,
    steps: int | None = None,
    budget: int = 10_000,
    seed: int = 0,
    rig: bool = False,
    filter: bool = False,
    progress: Progress = lambda *_: None,
) -> Falsification:
    """Searches a declared uncertainty for the plant on which an excitation is least safe.

        >>> import excite as ex
        >>> found = ex.falsify("multisine", "dc_motor", steps=50, budget=100)
        >>> found.is_safe
        True

    Args:
        excitation: a policy, its name or file; any other excitation, as in `simulate`.
        plant: as in `simulate`; default the policy's plant.
        options: of the excitation, by name.
        spread: of parameters without a range: nominal value ± spread times the scale; default
            that of the policy's training, or 0.3.
        uncertainty: ranges by name, such as `{"delay_voltage": (0, 0.1), "d_S": "10%",
            "initial_state": "2%"}`; default that of the policy's training.
        noise: standard deviation of an output's noise, by name [output unit].
        steps: length [samples]; default 500, or that of a policy or a signal.
        budget: number of simulated experiments, about.
        seed: of the search.
        rig: whether experiments are made on the plant's simulated rig, with its latency, readings
            between the samples and supervisor.
        filter: whether they are made there behind the predictive safety filter.
        progress: called with a text, how much is done, and the total.

    Raises:
        ValueError: for a name, an option or a range that is not allowed, or a plant without a
            critical level.
        TypeError: for an argument of another type.
    """
    if filter and not rig:
        raise ValueError("the safety filter is part of a rig: filter (--filter) needs rig (--rig)")
    policy = _policy_of(excitation)
    made = {} if policy is None else policy.provenance
    if plant is None:
        if policy is None:
            if isinstance(excitation, str) and not _is_signal(excitation):
                read_policy(excitation)  # says which policies there are
            raise ValueError(
                f"{_word(excitation)} is no policy, which would name its plant: give the plant "
                "(--plant)"
            )
        plant = policy.plant.name
    chosen = with_sensor(plant_from(plant), noise)
    require_inputs(chosen)
    if not watched_levels(chosen.definition)[0]:
        raise ValueError(
            f"plant {chosen.definition.name!r} has no critical level: there is nothing to violate"
        )
    require_whole("budget", budget, MIN_BUDGET)
    require_whole("seed", seed, 0, LARGEST_SEED)
    found, origin = excitation_and_origin(excitation, options or {}, chosen)
    name = _word(excitation)
    num_steps = experiment_length(found, name, steps, isinstance(excitation, Record))
    own = {} if spread is None and uncertainty is not None else made.get("uncertainty", {})
    reach = float(made.get("spread", 0.3)) if spread is None else spread
    box = Uncertainty.of(chosen, reach, own if uncertainty is None else uncertainty)
    effort, play = Effort.of(budget), OnPlant(box, found, num_steps)
    if rig:
        safety_filter = SafetyFilter.of(chosen, reach) if filter else NO_FILTER
        play = OnRig.of(box, found, num_steps, safety_filter)
    result = search(play, effort, seed, progress)
    worst, params = box.at(result.worst.point[0])
    worst_seed = int(result.worst.seed[0])
    experiment = Experiment(worst, params, found, name, origin, num_steps, worst_seed)
    plain = [stage.nearness for stage in result.stages[:-1]]
    return Falsification(
        plant=chosen.description,
        excitation=name,
        policy=policy,
        num_steps=num_steps,
        ranges={name: (low, high) for name, (low, high) in box.ranges().items()},
        stages=result.stages,
        nearness=max(plain),
        noise_nearness=result.stages[-1].nearness,
        noise_bound=effort.noise_bound,
        worst=dict(zip(box.names, box.values(result.worst.point[0]).tolist(), strict=True)),
        worst_seed=worst_seed,
        worst_plant=plant_in_file(worst, params),
        record=experiment.record(_run(experiment, play, result.worst)),
        seed=seed,
        rig=rig,
        filter=filter,
        spread=reach,
    )


def _is_signal(word: str) -> bool:
    return word.removeprefix(LOOP) in EXCITATIONS or word.endswith(SIGNAL_ENDINGS)


def on_rig(rig: bool, filter: bool) -> str:
    """Where experiments were made, after the plant's name; empty for the plant itself."""
    return "'s simulated rig" * rig + " behind the safety filter" * filter


def _run(experiment: Experiment, play: OnPlant | OnRig, worst: Cases) -> Trajectory:
    """The worst experiment; ValueError where it diverged."""
    try:
        if isinstance(play, OnRig):
            return play.trajectory(jax.tree.map(lambda leaf: leaf[0], worst))
        return experiment.run()
    except DivergedError:
        values = zip(
            names_of(experiment.plant.definition.parameters), experiment.params, strict=True
        )
        told = ", ".join(f"{name} = {number(float(value))}" for name, value in values)
        raise ValueError(
            "the simulation of a plant of the declared uncertainty diverges (NaN or infinity): "
            f"{told}; a narrower uncertainty may help"
        ) from None


def _word(excitation: ExcitationLike) -> str:
    return str(excitation) if isinstance(excitation, str | Path) else name_of(excitation)


def _policy_of(excitation: ExcitationLike) -> Policy | None:
    """The policy behind an excitation, if it is one."""
    if isinstance(excitation, Policy):
        return excitation
    if isinstance(excitation, str | Path):
        path = policy_path(str(excitation))
        return None if path is None else read_policy(path)
    return None
