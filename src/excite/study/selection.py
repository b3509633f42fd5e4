"""Which of several possible experiments to make: the set of inputs, sensors, settings of the rig.

Each experiment is simulated on the plants that are possible, from rest. What a set of them brings
is predicted by the Cramér-Rao bound: information of independent experiments adds up. The set is
found by exchange (`information.exchange`).
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Bool, Float, Int

from ..description import (
    LARGEST_SEED,
    SpreadLike,
    as_number,
    by_name,
    names_of,
    require_whole,
    unknown,
)
from ..environment.falsification import nearness
from ..estimation.prior_knowledge import PriorLike
from ..excitation import AbstractExcitation, Coast
from ..information import experiment_information, require_noise
from ..information.exchange import exchanged
from ..plant import AbstractPlant, Params, Sensor, draw_params, floats
from ..plant.catalogue import PlantLike, plant_from
from ..progress import SHOWN, Progress
from ..report.numbers import number
from ..report.tables import html_table, text_table
from ..rig.contract import Interval, as_data
from ..simulation import Experiment, run_episode
from ..training.redesign import JUDGES, POINTS, Region
from .knowledge import KnownLike, intervals_in, known_before, known_from
from .next_experiment import COAST, LARGEST
from .quantities import require_defined
from .settings import Settings, excitation_beside, read_toml, sentence
from .targets import (
    Target,
    TargetLike,
    farthest,
    known_row,
    others_of,
    over_targets,
    quantities_of,
    relative_half,
    shares_of,
    targets_from,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class PlannedExperiment(Settings):
    """An experiment that can be made, from rest.

    Attributes:
        excitation: as for `simulate`: a name, a policy or a file of inputs.
        options: of the excitation.
        steps: samples; default as for `simulate`.
        constants: known constants that the rig then has, where they differ from the plant's.
        outputs: that are measured; default all.
        noise: standard deviation by output, where it differs from the plant's.
        cost: in a unit of your own; default the duration [s].
        most: times that it can be made.
    """

    model_config = pydantic.ConfigDict(
        extra="forbid", frozen=True, strict=True, arbitrary_types_allowed=True
    )

    excitation: Any = "chirp"
    options: dict[str, Any] = {}
    steps: int | None = None
    constants: dict[str, float] = {}
    outputs: list[str] | None = None
    noise: dict[str, float] = {}
    cost: float | None = None
    most: int | None = None


_SHOWN = 12  # names of an order

ExperimentsLike = Mapping[str, PlannedExperiment | Mapping[str, Any]] | str | Path
"""Experiments by name, or a TOML file with a table `[experiments.NAME]` for each."""


@dataclass(frozen=True)
class Option:
    """What one experiment would bring, alone.

    Attributes:
        name: of the experiment.
        num_steps: its samples.
        cost: of it.
        nearness: largest output over its critical level on the plants that are possible, coast
            included.
        after: what would be known after it.
        count: how often it is chosen.
    """

    name: str
    num_steps: int
    cost: float
    nearness: float
    after: Mapping[str, Interval]
    count: int

    @property
    def is_safe(self) -> bool:
        """Whether no possible plant comes near to a critical level."""
        return self.nearness < LARGEST


@dataclass(frozen=True, repr=False)
class Selection:
    """What is known, and the experiments to make.

    Attributes:
        plant: as identification knows it.
        targets: what is asked.
        known: of each parameter, and of what else the targets are about, the estimate with half
            of its 95 % interval.
        options: the experiments that can be made.
        order: names of the chosen experiments, the most informative first.
        then: what is known after each of them.
        warnings: sentences, where the plant does not explain the records.
    """

    plant: AbstractPlant
    targets: tuple[Target, ...]
    known: Mapping[str, Interval]
    options: tuple[Option, ...]
    order: tuple[str, ...]
    then: tuple[Mapping[str, Interval], ...]
    warnings: tuple[str, ...] = ()

    @property
    def cost(self) -> float:
        """Of all chosen experiments."""
        return sum(option.count * option.cost for option in self.options)

    @property
    def after(self) -> Mapping[str, Interval]:
        """What is known after all chosen experiments."""
        return self.then[-1] if self.then else self.known

    @property
    def decision(self) -> str:
        """What to make first, and what all of it brings, as a sentence."""
        if max(shares_of(self.targets, self.known).values()) <= 1:
            return "every target is reached"
        if not self.order:
            if not any(option.is_safe for option in self.options):
                return "no experiment is safe"
            return "no experiment is chosen: each costs too much, or tells nothing"
        each = [max(shares_of(self.targets, known).values()) for known in self.then]
        reached = next((i for i, share in enumerate(each, 1) if share <= 1), None)
        if reached is None:
            told = f"after all {len(self.order)}, {farthest(shares_of(self.targets, self.after))}"
        else:
            told = f"every target is reached after {reached} of {len(self.order)}"
        return f"make {self.order[0]} first: {told}"

    def to_dict(self) -> dict[str, Any]:
        """What is known, predicted and chosen, as JSON-ready data."""
        return {
            "plant": self.plant.description.name,
            "targets": {t.name: str(t) for t in self.targets},
            "known": as_data(self.known),
            "experiments": [
                {
                    "name": o.name,
                    "num_steps": o.num_steps,
                    "cost": o.cost,
                    "nearness": o.nearness if np.isfinite(o.nearness) else None,
                    "after": as_data(o.after),
                    "count": o.count,
                }
                for o in self.options
            ],
            "order": list(self.order),
            "after": as_data(self.after),
            "cost": self.cost,
            "decision": self.decision,
            "warnings": list(self.warnings),
        }

    header = ("parameter", "estimate", "± 95 %", "relative", "target", "after all")

    def rows(self) -> list[list[str]]:
        """Rows of the table of parameters: what is known now, and after all chosen experiments."""
        return [
            [*known_row(quantity, self.targets, self.known),
             relative_half(self.after[quantity.name])]
            for quantity in quantities_of(self.plant, self.targets)
        ]  # fmt: skip

    option_header = ("experiment", "samples", "cost", "of the level", "alone", "chosen")

    def option_rows(self) -> list[list[str]]:
        """Rows of the table of experiments; alone: the farthest target, over what is asked."""
        rows = []
        for o in self.options:
            near = f"{100 * o.nearness:.0f} %" if np.isfinite(o.nearness) else "diverges"
            share = max(shares_of(self.targets, o.after).values())
            alone = number(share, 2) if np.isfinite(share) else "not known"
            count = str(o.count or "") if o.is_safe else "not safe"
            rows.append([o.name, str(o.num_steps), f"{o.cost:g}", near, alone, count])
        return rows

    def __repr__(self) -> str:
        """The tables that `excite choose` prints."""
        title = f"{self.plant.description.name}: what is known, and would be known"
        return "\n".join(
            [
                text_table(title, self.header, self.rows()),
                text_table("experiments", self.option_header, self.option_rows()),
                f"in this order: {self._shown_order()}; cost {self.cost:g}",
                textwrap.fill(self.decision, 80),
            ]
        )

    def _shown_order(self) -> str:
        """The first names of the order."""
        more = len(self.order) - _SHOWN
        told = ", ".join(self.order[:_SHOWN]) or "none"
        return told + f", and {more} more" * (more > 0)

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        options = html_table(self.decision, self.option_header, self.option_rows())
        return html_table(self.plant.description.name, self.header, self.rows()) + options

    def plot(self) -> Figure:
        """What is known after each chosen experiment over what is asked, by cost."""
        from ..report.figures import selection_figure

        cost = {option.name: option.cost for option in self.options}
        spent = np.cumsum([0.0, *(cost[name] for name in self.order)])
        each = [shares_of(self.targets, known) for known in (self.known, *self.then)]
        shares = {t.name: np.array([own[t.name] for own in each]) for t in self.targets}
        return selection_figure(self.plant.description.name, spent, self.order, shares)


def choose_experiments(
    plant: PlantLike,
    experiments: ExperimentsLike,
    target: TargetLike,
    *,
    known: KnownLike | None = None,
    prior: PriorLike | Sequence[PriorLike] | None = None,
    spread: SpreadLike = "factor:3",
    rounds: int | None = None,
    budget: float | None = None,
    coast: int = COAST,
    seed: int = 0,
    progress: Progress = SHOWN,
) -> Selection:
    """Which of several experiments to make, and in which order.

    The set is chosen together, for all its experiments. Of the plants that are possible, no
    experiment may bring one near to a critical level.

        >>> import excite as ex
        >>> given = {"slow": {"excitation": "chirp", "steps": 300}, "fast": {"excitation": "prbs"}}
        >>> found = ex.choose_experiments("aero2", given, {"D_p": "1%"}, spread=0.1, rounds=2)
        >>> len(found.order)
        2

    Args:
        plant: its name, `path/to/file.py:ClassName`, the plant or its class.
        experiments: that can be made; see `PlannedExperiment`.
        target: half of a 95 % interval by quantity, as for `Campaign`.
        known: as for `next_experiment`; default nothing but the spread.
        prior: as for `identify`; without records normal distributions alone.
        spread: of the parameters before the records.
        rounds: experiments together, at most; default one, or as many as the budget allows.
        budget: costs together, at most.
        coast: samples after an experiment in which the plant must be safe too.
        seed: of the plants that are drawn where nothing is known, and of the noise.
        progress: called with a text, how much is done, and the total.

    Raises:
        ValueError: for a name or a value that is not allowed, and for records of another plant.
        TypeError: for an argument of another type.
    """
    require_whole("coast", coast, 0)
    require_whole("seed", seed, 0, LARGEST_SEED)
    if rounds is not None:
        require_whole("rounds", rounds, 1, 1000)
    if budget is not None and not 0 < as_number("budget", budget) < np.inf:
        raise ValueError(f"budget must be a number above 0: got {budget!r}")
    before = plant_from(plant)
    planned = _planned(experiments)
    for name, one in planned.items():
        _experiment(before, name, one)  # a wrong one is told before records are identified
    progress("estimating", 0, len(planned) + 1)
    if known is None:
        given = known_before(before, prior or {}, spread)
    else:
        given = known_from(known, before, prior, spread)
    plants = given.region.plants(given.plant, JUDGES)
    if known is None and prior is None:  # the ellipsoid of a box is far larger than the box
        keys = jax.random.split(jax.random.key(seed), JUDGES)
        drawn = jax.vmap(lambda key: draw_params(before, key, spread))(keys)
        plants = jax.tree.map(lambda a, b: jnp.append(floats(a), b), before.nominal, drawn)
    own, region = given.plant, given.region
    targets = targets_from(own, target)
    for quantity in others_of(own, targets):
        require_defined(quantity, own, own.Params(*region.center))
    each = [_experiment(own, name, one) for name, one in planned.items()]
    gains, sizes = [], []
    for i, (name, experiment) in enumerate(zip(planned, each, strict=True)):
        progress(f"simulating {name}", i + 1, len(each) + 1)
        gained, size = _learnt(*experiment, coast, plants, jax.random.key(seed))
        gains.append(np.nan_to_num(gained))
        sizes.append(float(np.nan_to_num(size, nan=np.inf)))
    costs = np.array([
        e.num_steps * float(e.plant.dt) if one.cost is None else one.cost
        for one, (e, _) in zip(planned.values(), each, strict=True)
    ])  # fmt: skip
    only = 1 if rounds is None and budget is None else rounds
    limit = only or 1000
    most = np.array([
        0 if size >= LARGEST else limit if one.most is None else min(one.most, limit)
        for one, size in zip(planned.values(), sizes, strict=True)
    ])  # fmt: skip
    asked = over_targets(own, own.Params(*region.center), targets)
    loss = partial(_loss, np.asarray(region.information), np.array(gains), asked)
    counts = exchanged(loss, costs, most, only, budget)
    others, order = others_of(own, targets), _order(loss, counts)

    def after(chosen: Sequence[int]) -> dict[str, Interval]:
        gained = sum((gains[i][0] for i in chosen), np.zeros(()))
        return intervals_in(own, Region(region.center, region.information + gained), others)

    names = list(planned)
    options = [
        Option(name, e.num_steps, float(costs[i]), sizes[i], after([i]), int(counts[i]))
        for i, (name, (e, _)) in enumerate(zip(names, each, strict=True))
    ]
    then = [after(order[: i + 1]) for i in range(len(order))]
    progress("done", len(each) + 1, len(each) + 1)
    return Selection(
        own, targets, given.of(others), tuple(options), tuple(names[i] for i in order),
        tuple(then), given.warnings,
    )  # fmt: skip


def _planned(given: ExperimentsLike) -> dict[str, PlannedExperiment]:
    """Experiments by name, checked; ValueError for what is not allowed."""
    where, content = "experiments", given
    if isinstance(given, str | Path):
        where, content = str(given), _content(Path(given))
    found = {}
    for name, one in by_name("experiments", content, "a dict of experiments by name").items():  # pyright: ignore[reportArgumentType]
        try:
            is_made = isinstance(one, PlannedExperiment)
            found[name] = one if is_made else PlannedExperiment.model_validate(one)
        except pydantic.ValidationError as error:
            tables = {"": PlannedExperiment}
            raise ValueError(f"{where}: {name}: {sentence(error, tables)}") from None
    if not found:
        raise ValueError(f"{where}: no experiment is given")
    return found


def _content(path: Path) -> dict[str, Any]:
    """The table of experiments of a file, with its file names relative to the file's folder."""
    content = read_toml(path)
    for key in content:
        if key != "experiments":
            raise ValueError(f"{path}: {unknown('key', key, ['experiments'])}")
    found = content.get("experiments", {})
    if not isinstance(found, dict):
        raise ValueError(f"{path}: experiments must be tables, such as [experiments.first]")
    for one in found.values():
        if isinstance(one, dict) and isinstance(word := one.get("excitation"), str):
            one["excitation"] = excitation_beside(path.parent, word)
    return found


def _experiment(
    plant: AbstractPlant, name: str, given: PlannedExperiment
) -> tuple[Experiment, Bool[np.ndarray, " output"]]:
    """One experiment, and the outputs that it measures; ValueError for what is not allowed."""
    d = plant.description
    constants, outputs = names_of(d.constants), names_of(d.outputs)
    try:
        for word, value in given.constants.items():
            if word not in constants:
                raise unknown(f"{d.name} constant", word, constants)
            usual = d.constants[constants.index(word)].value
            if not np.isfinite(value) or value * usual < 0:
                raise ValueError(
                    f"constant {word} must be finite, with the sign of {usual:g}: got {value!r}"
                )
        for word in given.outputs or ():
            if word not in outputs:
                raise unknown(f"{d.name} output", word, outputs)
        if given.outputs == []:
            raise ValueError("it measures no output")
        if given.cost is not None and not 0 < given.cost < np.inf:
            raise ValueError(f"cost must be a number above 0: got {given.cost!r}")
        if given.most is not None:
            require_whole("most", given.most, 0, 1000)
        if given.steps is not None:
            require_whole("steps", given.steps, 2, 1_000_000)
        own = plant.changed(**{word: floats(value) for word, value in given.constants.items()})
        made = Experiment.of(
            own, given.excitation, options=given.options, steps=given.steps, noise=given.noise
        )
        require_noise(made.plant)
    except (ValueError, TypeError) as error:
        raise ValueError(f"experiment {name!r}: {error}") from None
    measured = [given.outputs is None or word in given.outputs for word in outputs]
    return made, np.array(measured)


@eqx.filter_jit
def _simulated(
    plant: AbstractPlant,
    seen: AbstractPlant,
    excitation: AbstractExcitation,
    num_steps: int,
    coast: int,
    plants: Params,
    key: Array,
) -> tuple[Float[Array, "point param param"], Float[Array, ""]]:
    """Information on the first plants, and the largest nearness on all."""
    whole, length = Coast.after(excitation, num_steps, coast)
    runs = jax.vmap(lambda own: run_episode(plant, own, whole, length, key))(plants)
    near = jax.vmap(lambda outputs: nearness(plant, outputs))(runs.outputs)
    few, inputs = jax.tree.map(lambda x: x[: POINTS + 1], (plants, runs.inputs[:, :num_steps]))
    gained = jax.vmap(lambda own, inputs: experiment_information(seen, own, inputs))(few, inputs)
    return gained, jnp.max(near)


def _learnt(
    experiment: Experiment,
    measured: Bool[np.ndarray, " output"],
    coast: int,
    plants: Params,
    key: Array,
) -> tuple[Float[Array, "point param param"], Float[Array, ""]]:
    """What an experiment tells of the first plants, and its largest output on all."""
    e, sensor = experiment, experiment.plant.sensor
    sd = jnp.where(jnp.asarray(measured), sensor.noise_sd, jnp.inf)
    seen = e.plant.changed(sensor=Sensor(sd, sensor.resolution))
    return _simulated(e.plant, seen, e.excitation, e.num_steps, coast, plants, key)


def _loss(
    before: Float[np.ndarray, "param param"],
    gains: Float[np.ndarray, "experiment point param param"],
    asked: Float[np.ndarray, "target param"],
    counts: Int[np.ndarray, " experiment"],
) -> float:
    """Logarithm of how uncertain the targets are after some experiments, as in `redesigned`."""
    total = before[None] + np.einsum("e,epij->pij", counts, gains)
    uncertain = np.einsum("gi,pij,gj->p", asked, np.linalg.inv(total), asked)
    return float(np.mean(0.5 * np.log(uncertain)))


def _order(
    loss: Callable[[Int[np.ndarray, " experiment"]], float], counts: Int[np.ndarray, " experiment"]
) -> list[int]:
    """The chosen experiments, each time the one that brings most."""
    left, made, order = counts.copy(), np.zeros_like(counts), []
    units = np.eye(len(counts), dtype=int)
    while left.any():
        best = min(np.flatnonzero(left), key=lambda i: loss(made + units[i]))
        order.append(int(best))
        left, made = left - units[best], made + units[best]
    return order
