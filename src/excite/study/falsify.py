"""`falsify`: the plant within a declared uncertainty on which an excitation is least safe."""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Array, Float

from .. import __version__
from ..description import LARGEST_SEED, PlantDescription, SpreadLike, names_of, require_whole
from ..environment.falsification import Cases, Effort, OnPlant, Stage, nearness, search
from ..excitation import Coast
from ..excitation.catalogue import (
    EXCITATIONS,
    LOOP,
    SIGNAL_ENDINGS,
    ExcitationLike,
    excitation_and_origin,
    name_of,
)
from ..files import require_new_file, write_json
from ..plant import AbstractPlant
from ..plant.catalogue import (
    PLANT_ENDING,
    PLANTS,
    PlantLike,
    is_plant_file,
    plant_from,
    plant_in_file,
    require_inputs,
    trained_on,
    with_sensor,
)
from ..plant.contract import with_nominal
from ..plant.uncertainty import Range, Uncertainty
from ..policy import POLICY_ENDING, Policy, policy_path, read_policy, shown_nearness
from ..progress import SHOWN, Progress
from ..record import Record
from ..report.numbers import number
from ..report.tables import html_table, text_table
from ..rig.falsification import OnRig
from ..rig.filter import SafetyFilter
from ..rig.guard import Guard
from ..rig.guard_design import guard_for
from ..rig.simulated import NO_FILTER
from ..safety import watched_levels
from ..simulation import Experiment, Trajectory, experiment_length, run_episode

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
            a seed, as `simulate` repeats it; 1 and more are violations, infinite is a simulation
            that diverged.
        noise_nearness: the same with noise that is searched too, within `noise_bound`.
        noise_bound: in standard deviations.
        worst: quantities of the worst plant.
        worst_seed: of its noise, for `simulate`.
        worst_plant: with its parameters as nominal ones.
        record: its experiment, until it diverged.
        noise_worst: quantities of the worst plant with searched noise.
        noise: that noise, in standard deviations.
        noise_record: its experiment.
        seed: of the search.
        guard: for rigs, of a policy; None where it was not asked for.
        rig: whether experiments were made on the plant's simulated rig.
        filter: whether they were made there behind the predictive safety filter.
        spread: of parameters without a range, and of the filter's prior.
        coast: samples after the experiment that were searched too.
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
    worst_plant: AbstractPlant
    record: Record
    noise_worst: Mapping[str, float]
    noise: Float[np.ndarray, "sample output"]
    noise_record: Record
    seed: int
    guard: Guard | None = None
    rig: bool = False
    filter: bool = False
    spread: SpreadLike = 0.3
    coast: int = 0

    @property
    def is_safe(self) -> bool:
        """Whether no experiment reached a critical level, with searched noise neither."""
        is_reached = any(stage.violations for stage in self.stages)
        return max(self.nearness, self.noise_nearness) < 1 and not is_reached

    def certificate(self) -> dict[str, Any]:
        """What was searched, how hard, and what was found, JSON-ready."""
        return {
            "excite": __version__,
            "plant": self.plant.name,
            "plant_hash": self.plant.hash,
            "sensor": {
                o.name: {"noise_sd": o.noise_sd, "resolution": o.resolution}
                for o in self.plant.outputs
            },
            "num_steps": self.num_steps,
            "coast": self.coast,
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
            "noise_worst": dict(self.noise_worst),
        }

    def certified(self) -> Policy:
        """The policy with this certificate in its file.

        Raises:
            ValueError: where the excitation is not a policy, or was played for a part of its
                length.
        """
        if self.policy is None:
            raise ValueError(f"only a policy has a certificate; {self.excitation} is none")
        _require_whole(self.policy, self.num_steps)
        guard = None if self.guard is None else self.guard.to_dict()
        return self.policy.certified(self.certificate(), guard)

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Writes the worst plant as JSON, a plant for every verb: `ex.simulate("worst.json")`.

        Raises:
            ValueError: for another ending, a file that exists, unless `overwrite`, or a class of
                plant that is in no file.
        """
        path = Path(path)
        require_plant_path(path, overwrite)
        write_json(path, plant_in_file(self.worst_plant))

    def plot(self) -> matplotlib.figure.Figure:
        """Inputs and outputs of the worst experiment over time, with limits and levels.

        That with searched noise where it is worse.
        """
        from ..record.figure import episode_figure

        with_noise = self.noise_nearness > self.nearness
        return episode_figure(self.plant, self.noise_record if with_noise else self.record)

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
            [s.name, f"{s.experiments:,}", f"{s.violations:,}", shown_nearness(s.nearness)]
            for s in self.stages
        ]
        return title, ["searched", "experiments", "violations", "largest"], rows

    def _sentences(self) -> list[str]:
        box = ", ".join(f"{n} {number(a)} to {number(b)}" for n, (a, b) in self.ranges.items())
        total = sum(stage.experiments for stage in self.stages)
        found = (
            f"no violation found in {total:,} experiments; this is no proof"
            if self.is_safe
            else f"UNSAFE: {sum(s.violations for s in self.stages):,} of {total:,} experiments "
            "reach a critical level"
        )
        after = f" and {self.coast} after them" * bool(self.coast)
        bound = f"noise searched within {self.noise_bound:g} sd"
        return [
            found,
            f"searched: {box}; {self.num_steps} steps{after}",
            f"worst plant ({_told(self.nearness)}, noise of seed {self.worst_seed}): "
            f"{_values(self.worst)}",
            f"worst plant with {bound} ({_told(self.noise_nearness)}): {_values(self.noise_worst)}",
        ]


def require_plant_path(path: Path, overwrite: bool) -> None:
    """Raises ValueError where the file of a plant cannot be written."""
    if path.suffix != PLANT_ENDING:
        raise ValueError(f"{path}: files of plants end in {PLANT_ENDING}")
    require_new_file(path, overwrite)
    if path.exists() and not is_plant_file(path):
        raise ValueError(f"{path} is no file of a plant and would be lost; choose another name")


def _told(nearness: float) -> str:
    is_number = math.isfinite(nearness)
    return f"{shown_nearness(nearness)} of the level" if is_number else "its simulation diverges"


def _values(quantities: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {number(value)}" for name, value in quantities.items())


def require_certifiable(excitation: str, path: Path, overwrite: bool, steps: int | None) -> None:
    """Raises ValueError where a certificate cannot be written.

    That is for no policy, a part of its length, or a file that exists.
    """
    if policy_path(excitation) is None:
        raise ValueError(f"only a policy has a certificate; {excitation!r} is none")
    if steps is not None:
        _require_whole(read_policy(excitation), steps)
    if path.suffix != POLICY_ENDING:
        raise ValueError(f"{path}: policy files end in {POLICY_ENDING}")
    require_new_file(path, overwrite)


def _require_whole(policy: Policy, steps: int) -> None:
    if steps != policy.layout.num_steps:
        raise ValueError(
            f"a certificate is for the policy's whole length of {policy.layout.num_steps} steps: "
            f"got {steps} (leave --steps out)"
        )


def falsify(
    excitation: ExcitationLike,
    plant: PlantLike | None = None,
    *,
    options: Mapping[str, object] | None = None,
    spread: SpreadLike | None = None,
    uncertainty: Mapping[str, Range] | None = None,
    coast: int | None = None,
    noise: Mapping[str, float] | None = None,
    steps: int | None = None,
    budget: int = 10_000,
    seed: int = 0,
    rig: bool = False,
    filter: bool = False,
    guard: bool = False,
    progress: Progress = SHOWN,
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
        spread: of parameters without a range, a fraction of the scale or a factor; default
            that of the policy's training, or 0.3.
        uncertainty: ranges by name, such as `{"delay_voltage": (0, 0.1), "d_S": "10%",
            "initial_state": "2%"}`; default that of the policy's training, and the constants that
            were drawn there.
        coast: samples after the experiment, under the input that ends it, that are searched too;
            default that of the policy's training, or 0.
        noise: standard deviation of an output's noise, by name [output unit].
        steps: length [samples]; default 500, or that of a policy or a signal.
        budget: number of simulated experiments, about.
        seed: of the search.
        rig: whether experiments are made on the plant's simulated rig, with its latency, readings
            between the samples and supervisor.
        filter: whether they are made there behind the predictive safety filter.
        guard: makes a guard of the policy for rigs, too, see `excite.rig.guard`. It is calibrated
            with 500 more experiments, or with a twentieth of the budget where that is more.
        progress: called with a text, how much is done, and the total.

    Raises:
        ValueError: for a name, an option or a range that is not allowed, or a plant without a
            critical level.
        TypeError: for an argument of another type.
    """
    if guard and _policy_of(excitation) is None:
        raise ValueError(f"only a policy has a guard; {_word(excitation)!r} is none")
    if filter and not rig:
        raise ValueError("the safety filter is part of a rig: filter (--filter) needs rig (--rig)")
    policy = _policy_of(excitation)
    if plant is None:
        if policy is None:
            if isinstance(excitation, str) and not _is_signal(excitation):
                if _is_plant(excitation):
                    raise ValueError(
                        f"{excitation!r} is a plant: give a policy or a signal for it, such as "
                        f"chirp --plant {excitation}"
                    )
                read_policy(excitation)  # says which policies there are
            raise ValueError(
                f"{_word(excitation)} is no policy, which would name its plant: give the plant "
                "(--plant)"
            )
        plant = trained_on(policy.plant)
    chosen = with_sensor(plant_from(plant), noise)
    if isinstance(excitation, Record):
        chosen = chosen.changed(dt=excitation.dt)
    require_inputs(chosen)
    if not watched_levels(chosen.definition)[0]:
        raise ValueError(
            f"plant {chosen.definition.name!r} has no critical level: there is nothing to violate"
        )
    require_whole("budget", budget, MIN_BUDGET)
    require_whole("seed", seed, 0, LARGEST_SEED)
    found, origin = excitation_and_origin(excitation, options or {}, chosen)
    name = _word(excitation)
    if "warning" in origin:
        warnings.warn(f"{name}: {origin['warning']}", stacklevel=2)
    num_steps = experiment_length(found, name, steps, isinstance(excitation, Record))
    usual_spread, usual, usual_coast = trained_in(policy, chosen)
    reach = usual_spread if spread is None else spread
    ranges = usual if uncertainty is None else uncertainty
    box = Uncertainty.of(chosen, reach, ranges)
    if coast is None:
        coast = 0 if rig else usual_coast
    require_whole("coast", coast, 0)
    if rig and coast:
        raise ValueError("experiments on a rig end with the last sample: leave coast out (--coast)")
    whole, length = Coast.after(found, num_steps, coast)
    effort, play = Effort.of(budget), OnPlant(box, whole, length)
    if rig:
        safety_filter = SafetyFilter.of(chosen, reach) if filter else NO_FILTER
        play = OnRig.of(box, found, num_steps, safety_filter)
    result = search(play, effort, seed, progress)
    with_noise = result.worst_noise or result.worst

    def replayed(case: Cases) -> tuple[Record, float, dict[str, float], AbstractPlant]:
        """The first case alone, as `simulate` makes it: record, nearness, quantities, plant.

        A batch is another program, and the single precision of a policy shows in the 7th digit.
        """
        own = jax.tree.map(lambda leaf: leaf[0], case)
        (worst, params), key = box.at(own.point), int(own.seed)
        experiment = Experiment(worst, params, whole, name, origin, length, key)
        if isinstance(play, OnRig):
            run, size = play.replayed(own)
        else:
            run = run_episode(worst, params, whole, length, experiment.key, own.noise)
            size = float(nearness(worst, run.outputs))
        values = dict(zip(box.names, box.values(own.point).tolist(), strict=True))
        tuned = with_nominal(worst, {n: float(x) for n, x in params._asdict().items()})
        return experiment.record(_until_diverged(run)), size, values, tuned

    made = None
    if guard:
        made = guard_for(
            chosen, found, reach, ranges, num_steps=num_steps, num_runs=max(500, budget // 20),
            seed=seed, progress=progress,
        ).guard()  # fmt: skip
    record, largest, values, tuned = replayed(result.worst)
    noise_record, noise_largest, noise_values, _ = replayed(with_noise)
    return Falsification(
        plant=chosen.description,
        excitation=name,
        policy=policy,
        num_steps=num_steps,
        ranges={name: (low, high) for name, (low, high) in box.ranges().items()},
        stages=result.stages,
        nearness=largest,
        noise_nearness=noise_largest,
        noise_bound=effort.noise_bound,
        worst=values,
        worst_seed=int(result.worst.seed[0]),
        worst_plant=tuned,
        record=record,
        noise_worst=noise_values,
        noise=np.asarray(_noise(play, with_noise)),
        noise_record=noise_record,
        seed=seed,
        guard=made,
        rig=rig,
        filter=filter,
        spread=reach,
        coast=coast,
    )


def _is_signal(word: str) -> bool:
    return word.removeprefix(LOOP) in EXCITATIONS or word.endswith(SIGNAL_ENDINGS)


def _noise(play: OnPlant | OnRig, cases: Cases) -> Float[Array, "sample output"]:
    """Of the first case, in standard deviations."""
    return (
        play.noise(jax.tree.map(lambda leaf: leaf[0], cases))
        if cases.noise is None
        else cases.noise[0]
    )


def _is_plant(word: str) -> bool:
    return word.split("+")[0] in PLANTS or ".py:" in word or word.endswith(PLANT_ENDING)


def trained_in(
    policy: Policy | None, plant: AbstractPlant
) -> tuple[SpreadLike, Mapping[str, Range], int]:
    """Spread and ranges of the plants that a policy was trained for, and its coast."""
    made = {} if policy is None else policy.provenance
    decision = made.get("decision") or {}
    spread = decision.get("spread")
    drawn, known = decision.get("constants") or {}, names_of(plant.definition.constants)
    constants = {name: tuple(ends) for name, ends in drawn.items() if name in known}
    ranges = {**constants, **(made.get("uncertainty") or {})}
    spread = made.get("spread", 0.3) if spread is None else spread
    return spread, ranges, made.get("coast", 0)


def _until_diverged(run: Trajectory) -> Trajectory:
    """The samples before the first that is not finite, at least two."""
    is_finite = np.isfinite(np.hstack([run.outputs, run.measured])).all(axis=1)
    count = len(run.time) if np.all(is_finite) else max(2, int(np.argmin(is_finite)))
    time, inputs, *outputs = run.time[:count], run.inputs[: count - 1], run.measured, run.outputs
    return Trajectory(time, inputs, *(rows[:count] for rows in outputs))


def on_rig(rig: bool, filter: bool) -> str:
    """Where experiments were made, after the plant's name; empty for the plant itself."""
    return "'s simulated rig" * rig + " behind the safety filter" * filter


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
