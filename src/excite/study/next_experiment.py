"""Which experiment to make next: what each candidate would bring, and whether it is safe.

A candidate is a policy, or a signal redesigned for the plants that the records leave possible.
Each is simulated on these plants. What it brings is predicted by the Cramér-Rao bound at the
estimate, with the sensor of the plant's description.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..description import (
    LARGEST_SEED,
    Spread,
    SpreadLike,
    names_of,
    require_whole,
)
from ..environment import prior_sd_of
from ..environment.falsification import nearness
from ..estimation.identify import RecordLike, identify, plant_named_by
from ..estimation.prior_knowledge import PriorLike, with_prior
from ..estimation.result import Identification
from ..excitation import AbstractExcitation, Coast, PolicyExcitation, Replay
from ..information import relative_size, running_information
from ..plant import AbstractPlant
from ..plant.catalogue import PlantLike, plant_from
from ..policy import Policy, mismatch, read_policy
from ..record import Record, require_record_path, write_record
from ..report.rows import EstimateSummary
from ..report.tables import html_table, text_table
from ..rig.contract import Interval
from ..simulation import response, run_episode
from ..training.checkpoint import Progress
from ..training.design import designed_record
from ..training.redesign import JUDGES, Region, first_signals, redesigned
from .quantities import (
    AbstractQuantity,
    estimates,
    half_intervals,
    known_of,
    parameters_of,
    slopes,
)
from .targets import (
    Target,
    TargetLike,
    farthest,
    known_row,
    others_of,
    quantities_of,
    relative_half,
    shares_of,
    targets_from,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REDESIGNED = "redesigned"
COAST = 100  # samples of free motion that must be safe, unless another number is given

_SAFE = 0.99  # of the critical level: largest output of a candidate on the possible plants


@dataclass(frozen=True)
class Candidate:
    """An experiment that could be made next.

    Attributes:
        name: `redesigned`, or that of the policy.
        excitation: to be played.
        inputs: on the estimated plant, in the inputs' units.
        halves: half of the 95 % interval after each sample, of each parameter and of what else the
            targets are about.
        after: the same after the last one, with the estimate.
        samples: after which every target is reached; infinite where it is not.
        nearness: largest output over its critical level on the plants that are possible, coast
            included.
    """

    name: str
    excitation: Policy | Replay
    inputs: Float[np.ndarray, "time input"]
    halves: Float[np.ndarray, "time quantity"]
    after: Mapping[str, Interval]
    samples: float
    nearness: float

    @property
    def is_safe(self) -> bool:
        """Whether no possible plant comes near to a critical level."""
        return self.nearness < _SAFE

    def to_dict(self) -> dict[str, Any]:
        """What is predicted, as JSON-ready data."""
        return {
            "name": self.name,
            "num_steps": len(self.inputs),
            "after": {name: interval._asdict() for name, interval in self.after.items()},
            "samples_until_every_target": self.samples if np.isfinite(self.samples) else None,
            "nearness": self.nearness if np.isfinite(self.nearness) else None,
        }


def best_of(candidates: Sequence[Candidate], targets: Sequence[Target]) -> Candidate | None:
    """The safe candidate that reaches every target first, or else comes nearest to them.

    None where no candidate is safe. The first one wins a draw.
    """
    safe = [c for c in candidates if c.is_safe]
    return min(
        safe, key=lambda c: (c.samples, max(shares_of(targets, c.after).values())), default=None
    )


def region_of(
    plant: AbstractPlant, known: Identification | str | Path, spread: SpreadLike
) -> Region:
    """The plants that an identification leaves possible, within the spread.

    Args:
        plant: whose parameters were estimated.
        known: the result, or its run folder.
        spread: of the parameters before; it is all that is known of one that was not estimated.
    """
    _, prior, center = with_prior(plant, known, plant.nominal, {}, {})
    size = np.asarray(relative_size(plant, center))
    information = np.eye(len(size)) / prior_sd_of(spread) ** 2
    if prior is not None:
        names = names_of(plant.definition.parameters)
        index = [names.index(name) for name in prior.names]
        unit = np.where(prior.logarithmic, 1.0, size[index])
        root = np.asarray(prior.root) * unit[None]
        information[np.ix_(index, index)] += root.T @ root
    return Region(jnp.stack(list(center)), jnp.asarray(information))


def candidates(
    plant: AbstractPlant,
    region: Region,
    targets: Sequence[Target],
    policy: tuple[str, Policy] | None,
    *,
    num_steps: int,
    coast: int,
    ahead: int = 1,
    seed: int = 0,
) -> list[Candidate]:
    """What could be played next: the policy, and a signal redesigned for the region.

    Args:
        plant: with the sensor of the experiment.
        region: plants that are possible.
        targets: by parameter.
        policy: its name and itself; None for none.
        num_steps: of the experiment.
        coast: samples of free motion after it that must be safe too.
        ahead: experiments for which the redesign looks ahead; the first of them is the candidate.
        seed: of its starts, and of the noise.
    """
    found, starts = [], first_signals(plant, ahead, num_steps, seed)
    if policy is not None:
        name, given = policy
        length = min(num_steps, given.layout.num_steps)
        found.append(_candidate(plant, region, targets, name, given, length, coast, seed))
        inputs = jnp.asarray(np.resize(found[0].inputs, (num_steps, found[0].inputs.shape[1])))
        starts = jnp.concatenate([starts, jnp.broadcast_to(inputs, (1, *starts.shape[1:]))])
    params = plant.Params(*region.center)
    values, slope = slopes([t.quantity for t in targets], plant, params)
    allowed = [t.allowed(float(value)) for t, value in zip(targets, values, strict=True)]
    asked = slope * relative_size(plant, params)[None] / jnp.asarray(allowed)[:, None]
    made = redesigned(plant, region, asked, starts, coast)
    replay = Replay(made.inputs[0])
    redesign = _candidate(plant, region, targets, REDESIGNED, replay, num_steps, coast, seed)
    is_found = bool(jnp.isfinite(made.shares).any())
    return [*found, redesign if is_found else replace(redesign, nearness=np.inf)]


def _candidate(
    plant: AbstractPlant,
    region: Region,
    targets: Sequence[Target],
    name: str,
    given: Policy | Replay,
    num_steps: int,
    coast: int,
    seed: int,
) -> Candidate:
    """What an excitation would bring."""
    own = PolicyExcitation.of(given) if isinstance(given, Policy) else given
    key = jax.random.key(seed)
    quantities = quantities_of(plant, targets)
    outlook = _outlook(plant, region, own, num_steps, coast, key, quantities)
    inputs, values, halves, size = map(np.asarray, outlook)
    after = {
        q.name: Interval(float(value), float(half))
        for q, value, half in zip(quantities, values, halves[-1], strict=True)
    }
    names = list(after)
    shares = [t.share(after[t.name].estimate, halves[:, names.index(t.name)]) for t in targets]
    is_reached = np.max(shares, axis=0) <= 1
    samples = float(np.argmax(is_reached) + 1) if is_reached.any() else np.inf
    return Candidate(name, given, inputs, halves, after, samples, float(size))


@eqx.filter_jit
def _outlook(
    plant: AbstractPlant,
    region: Region,
    excitation: AbstractExcitation,
    num_steps: int,
    coast: int,
    key: Array,
    quantities: Sequence[AbstractQuantity],
) -> tuple[
    Float[Array, "time input"],
    Float[Array, " quantity"],
    Float[Array, "time quantity"],
    Float[Array, ""],
]:
    """Inputs on the estimated plant, values, their halves after each sample, the nearness."""
    whole, length = Coast.after(excitation, num_steps, coast)
    plants = region.plants(plant, JUDGES)
    keys = jax.random.split(key, JUDGES + 1)
    runs = jax.vmap(lambda own, key: run_episode(plant, own, whole, length, key))(plants, keys)
    inputs, params = runs.inputs[0, :num_steps], plant.Params(*region.center)
    information = region.information[None] + running_information(plant, params, inputs)
    sizes = jax.vmap(lambda outputs: nearness(plant, outputs))(runs.outputs)
    values, _ = slopes(quantities, plant, params)
    halves = half_intervals(quantities, plant, params, information)
    return inputs, values, halves, jnp.max(sizes)


@dataclass(frozen=True, repr=False)
class NextExperiment:
    """What is known, and the experiment to make next.

    Attributes:
        plant: as identification knows it.
        known: of each parameter, and of what else the targets are about, the estimate with half of
            its 95 % interval.
        targets: what is asked.
        candidates: that were compared.
        chosen: the best safe one; None where none is safe.
    """

    plant: AbstractPlant
    known: Mapping[str, Interval]
    targets: tuple[Target, ...]
    candidates: tuple[Candidate, ...]
    chosen: Candidate | None

    @property
    def decision(self) -> str:
        """What to play, and why, as a sentence."""
        shares = shares_of(self.targets, self.known)
        if max(shares.values()) <= 1:
            return "every target is reached"
        if self.chosen is None:
            return f"{farthest(shares)}; no candidate is safe on all plants that are possible"
        if np.isfinite(self.chosen.samples):
            told = f"every target is reached after {self.chosen.samples:.0f} samples"
        else:
            left = shares_of(self.targets, self.chosen.after)
            told = f"afterwards {farthest(left)}"
        return f"{farthest(shares)}; play {self.chosen.name}: {told}"

    @property
    def record(self) -> Record:
        """The inputs to be played, and the noise-free response of the estimated plant.

        Raises:
            ValueError: where no candidate is safe.
        """
        if self.chosen is None:
            raise ValueError(f"there is no experiment to write: {self.decision}")
        params = estimates(self.known, self.plant)
        inputs = jnp.asarray(self.chosen.inputs)
        about = {"design": "next experiment", "candidate": self.chosen.name}
        return designed_record(self.plant, inputs, response(self.plant, params, inputs), about)

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Writes the inputs to be played (.csv, .mat); `excite run --input` plays the file.

        Of a policy these are the inputs on the estimated plant; played as a policy, it reacts.

        Raises:
            ValueError: for another ending, a file that exists, unless `overwrite`, or where no
                candidate is safe.
        """
        require_record_path(Path(path), overwrite)
        write_record(path, self.record, self.plant.description)

    def plot(self) -> Figure:
        """The candidates' inputs, and what is known after each sample over what is asked."""
        from ..report.figures import candidates_figure

        time = np.arange(max(len(c.inputs) for c in self.candidates)) * float(self.plant.dt)
        names = list(self.known)
        shares = [
            {
                t.name: np.asarray(
                    t.share(self.known[t.name].estimate, c.halves[:, names.index(t.name)])
                )
                for t in self.targets
            }
            for c in self.candidates
        ]
        inputs = [c.inputs for c in self.candidates]
        labels = [c.name for c in self.candidates]
        return candidates_figure(self.plant.description, time, labels, inputs, shares)

    def to_dict(self) -> dict[str, Any]:
        """What is known, predicted and decided, as JSON-ready data."""
        return {
            "plant": self.plant.description.name,
            "known": {name: interval._asdict() for name, interval in self.known.items()},
            "targets": {t.name: str(t) for t in self.targets},
            "candidates": [c.to_dict() for c in self.candidates],
            "chosen": None if self.chosen is None else self.chosen.name,
            "decision": self.decision,
        }

    @property
    def header(self) -> tuple[str, ...]:
        """Of the table of parameters."""
        return (
            "parameter",
            "estimate",
            "± 95 %",
            "relative",
            "target",
            *(f"after {c.name}" for c in self.candidates),
        )

    def rows(self) -> list[list[str]]:
        """Rows of the table of parameters: what is known now, and after each candidate."""
        return [
            [*known_row(quantity, self.targets, self.known),
             *(relative_half(c.after[quantity.name]) for c in self.candidates)]
            for quantity in quantities_of(self.plant, self.targets)
        ]  # fmt: skip

    candidate_header = ("candidate", "samples", "time", "targets reached after", "of the level")

    def candidate_rows(self) -> list[list[str]]:
        """Rows of the table of candidates."""
        rows = []
        for c in self.candidates:
            reached = f"{c.samples:.0f} samples" if np.isfinite(c.samples) else "not reached"
            near = f"{100 * c.nearness:.0f} %" if np.isfinite(c.nearness) else "not safe"
            seconds = f"{len(c.inputs) * float(self.plant.dt):g} s"
            rows.append([c.name, str(len(c.inputs)), seconds, reached, near])
        return rows

    def __repr__(self) -> str:
        """The tables that `excite next` prints."""
        title = f"{self.plant.description.name}: what is known, and would be known"
        return "\n".join(
            [
                text_table(title, self.header, self.rows()),
                text_table("candidates", self.candidate_header, self.candidate_rows()),
                textwrap.fill(self.decision, 80),
            ]
        )

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        candidates = html_table(self.decision, self.candidate_header, self.candidate_rows())
        return html_table(self.plant.description.name, self.header, self.rows()) + candidates


def next_experiment(
    known: RecordLike | Sequence[RecordLike] | Identification,
    plant: PlantLike | None = None,
    target: TargetLike | None = None,
    *,
    prior: PriorLike | Sequence[PriorLike] | None = None,
    policy: str | Path | Policy | None = None,
    spread: SpreadLike = "factor:3",
    steps: int | None = None,
    ahead: int = 1,
    coast: int = COAST,
    seed: int = 0,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress = lambda *_: None,
) -> NextExperiment:
    """Which experiment to make next, from rest, and what it will bring.

    A signal is redesigned for the plants that the records leave possible, and compared with a
    policy where one is given. The one that reaches every target first is chosen, of those that
    are safe on all these plants.

        >>> import excite as ex
        >>> record = ex.simulate("aero2", "chirp", steps=100, seed=1)
        >>> found = ex.next_experiment(record, target={"D_p": "1%"}, steps=50)
        >>> found.chosen.name
        'redesigned'

    Args:
        known: a record, its file, or several; or the result of `identify`, or its run folder.
        plant: a name, `path/to/file.py:ClassName`, a plant or its class; default that of the
            record, the result or the run folder.
        target: half of a 95 % interval by quantity, as for `Campaign`; default half of what it is
            now, for each parameter.
        prior: as for `identify`, where records are given.
        policy: to compare with; its name or file.
        spread: of the parameters before the records.
        steps: samples of the experiment; default those of the policy, or 200.
        ahead: experiments of this length for which the redesign looks ahead.
        coast: samples after the experiment in which the plant must be safe too.
        seed: of the redesign's starts, and of the noise.
        out: file of the inputs (.csv, .mat); `excite run --input` plays it.
        overwrite: replaces an existing file.
        progress: called with a text, how much is done, and the total.

    Raises:
        ValueError: for records of another plant, an estimate outside the spread, and a name or a
            value that is not allowed.
        TypeError: for an argument of another type.
    """
    require_whole("ahead", ahead, 1, 20)
    require_whole("coast", coast, 0)
    require_whole("seed", seed, 0, LARGEST_SEED)
    if steps is not None:
        require_whole("steps", steps, 2)
    if out is not None:
        require_record_path(Path(out), overwrite)
    reach = Spread.of(spread)
    parts, own = _parts(known, plant, prior)
    d = own.description
    targets = None if target is None else targets_from(own, target)
    played = None
    if policy is not None:
        found = policy if isinstance(policy, Policy) else read_policy(policy)
        mismatch(found, d)
        played = ("policy" if isinstance(policy, Policy) else f"policy {policy}", found)
    progress("estimating", 0, 2)
    given = _estimate(parts, own, prior)
    if isinstance(given, Identification) and given.basis is not None:
        own = given.basis.plant  # sampled as the records are
    region = region_of(own, given, reach)
    _require_within(own, region, reach)
    now = _known(own, region, parameters_of(d))
    targets = targets or targets_from(own, {n: known.ci95_half / 2 for n, known in now.items()})
    now = (
        known_of(own, given, others_of(own, targets))
        if isinstance(given, Identification)
        else _known(own, region, quantities_of(own, targets))
    )
    length = steps or (played[1].layout.num_steps if played else 200)
    progress("redesigning", 1, 2)
    made = candidates(
        own, region, targets, played, num_steps=length, coast=coast, ahead=ahead, seed=seed
    )
    progress("done", 2, 2)
    result = NextExperiment(own, now, targets, tuple(made), best_of(made, targets))
    if out is not None:
        result.save(out, overwrite)
    return result


def _known(
    plant: AbstractPlant, region: Region, quantities: Sequence[AbstractQuantity]
) -> dict[str, Interval]:
    """What is known of quantities of the region's plants."""
    params = plant.Params(*region.center)
    values, _ = slopes(quantities, plant, params)
    halves = half_intervals(quantities, plant, params, region.information)
    each = zip(quantities, values, halves, strict=True)
    return {q.name: Interval(float(value), float(half)) for q, value, half in each}


def _parts(
    known: RecordLike | Sequence[RecordLike] | Identification,
    plant: PlantLike | None,
    prior: PriorLike | Sequence[PriorLike] | None,
) -> tuple[list[Any], AbstractPlant]:
    """What is known, as a list, and the plant; ValueError for what cannot be used together."""
    parts = [known] if isinstance(known, str | Path | Record | Identification) else list(known)
    if not parts:
        raise ValueError("no record is given")
    if any(map(_is_result, parts)) and (len(parts) > 1 or prior is not None):
        raise ValueError(
            "a run folder or a result is taken alone, without a prior: identify its records "
            "together with the others, or give the records"
        )
    if plant is not None:
        return parts, plant_from(plant)
    first = parts[0]
    if isinstance(first, Identification):
        return parts, plant_from(first.plant.name) if first.basis is None else first.basis.plant
    if isinstance(first, str | Path) and Path(first).is_dir():
        path = Path(first) / "estimate.json"
        return parts, plant_from(EstimateSummary.read(path, "identify the records again").plant)
    return parts, plant_from(plant_named_by(first))


def _is_result(part: object) -> bool:
    """Whether it is an identification or its run folder, and not a record."""
    is_folder = isinstance(part, str | Path) and Path(part).is_dir()
    return is_folder or isinstance(part, Identification)


def _estimate(
    parts: list[Any], plant: AbstractPlant, prior: PriorLike | Sequence[PriorLike] | None
) -> Identification | Path:
    """The parameters' estimate: a result, or the folder of one."""
    if isinstance(parts[0], Identification):
        return parts[0]
    if _is_result(parts[0]):
        return Path(parts[0])
    result = identify(parts, plant, prior=prior)
    if not result.is_usable:
        raise ValueError(f"the records give no estimate ({result.status})")
    return result


def _require_within(plant: AbstractPlant, region: Region, spread: Spread) -> None:
    """Raises ValueError where the spread excludes an estimate."""
    sd = 1 / np.sqrt(np.diag(np.asarray(region.information)))
    for i, parameter in enumerate(plant.definition.parameters):
        value, nominal = float(region.center[i]), float(plant.nominal[i])
        lower, upper = (spread.value(parameter, nominal, unit) for unit in (-1.0, 1.0))
        slack = 4 * sd[i] * (value if parameter.positive else parameter.scale)
        if not lower - slack <= value <= upper + slack:
            raise ValueError(
                f"the spread {spread} excludes the estimate of {parameter.name}, {value:.4g} "
                f"{parameter.unit}: it allows {lower:.4g} to {upper:.4g}; give a wider spread"
            )
