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
    SpreadLike,
    require_whole,
)
from ..environment.falsification import nearness
from ..estimation.prior_knowledge import PriorLike
from ..excitation import AbstractExcitation, Coast, PolicyExcitation, Replay
from ..information import Past, running_information, start_after
from ..plant import AbstractPlant, Params
from ..plant.catalogue import PlantLike
from ..policy import Policy, mismatch, read_policy
from ..progress import SHOWN, Progress
from ..record import Record, require_record_path, write_record
from ..report.tables import html_table, text_table
from ..rig.contract import Interval, as_data
from ..safety import safe_input
from ..simulation import response, run_episode
from ..training.design import designed_record
from ..training.redesign import JUDGES, Region, first_signals, redesigned
from .knowledge import Knowledge, KnownLike, intervals_in, known_from
from .quantities import (
    AbstractQuantity,
    estimates,
    half_intervals,
    require_defined,
    slopes,
)
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

REDESIGNED = "redesigned"
COAST = 100  # samples of free motion that must be safe, unless another number is given

LARGEST = 0.99  # of the critical level: largest output of a candidate on the possible plants


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
        return self.nearness < LARGEST

    def to_dict(self) -> dict[str, Any]:
        """What is predicted, as JSON-ready data."""
        return {
            "name": self.name,
            "num_steps": len(self.inputs),
            "after": as_data(self.after),
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


def candidates(
    plant: AbstractPlant,
    region: Region,
    targets: Sequence[Target],
    opening: tuple[str, Policy | Replay] | None,
    *,
    num_steps: int,
    coast: int,
    ahead: int = 1,
    seed: int = 0,
    past: Past | None = None,
) -> list[Candidate]:
    """What could be played next: a given excitation, and a signal redesigned for the region.

    Args:
        plant: with the sensor of the experiment.
        region: plants that are possible.
        targets: by parameter.
        opening: name of a policy or a signal from rest, and itself; None for none.
        num_steps: of the experiment, without its pause.
        coast: samples of free motion after it that must be safe too.
        ahead: experiments for which the redesign looks ahead; the first of them is the candidate.
        seed: of its starts, and of the noise.
        past: what was played before the redesigned signal; None for a signal from rest.
    """
    found, starts = [], first_signals(plant, ahead, num_steps, seed)
    if opening is not None:
        name, given = opening
        found.append(candidate(plant, region, targets, name, given, num_steps, coast, seed))
        inputs = jnp.asarray(np.resize(found[0].inputs, (num_steps, found[0].inputs.shape[1])))
        starts = jnp.concatenate([starts, jnp.broadcast_to(inputs, (1, *starts.shape[1:]))])
    asked = over_targets(plant, plant.Params(*region.center), targets)
    made = redesigned(plant, region, jnp.asarray(asked), starts, coast, past=past)
    pause = 0 if past is None else past.pause
    before = jnp.tile(jnp.asarray(safe_input(plant.definition)), (pause, 1))
    replay = Replay(jnp.concatenate([before, made.inputs[0]]))
    redesign = candidate(
        plant, region, targets, REDESIGNED, replay, pause + num_steps, coast, seed, past
    )
    is_found = bool(jnp.isfinite(made.shares).any())
    return [*found, redesign if is_found else replace(redesign, nearness=np.inf)]


def played_as(given: Policy | Replay) -> tuple[AbstractExcitation, int]:
    """A policy or a signal as an excitation, and its number of samples."""
    if isinstance(given, Policy):
        return PolicyExcitation.of(given), given.layout.num_steps
    return given, len(given.inputs)


def candidate(
    plant: AbstractPlant,
    region: Region,
    targets: Sequence[Target],
    name: str,
    given: Policy | Replay,
    num_steps: int,
    coast: int,
    seed: int,
    past: Past | None = None,
) -> Candidate:
    """What an excitation would bring, in this many samples or as many as it has.

    It begins at rest, or as a signal where another experiment has come to.
    """
    own, length = played_as(given)
    key = jax.random.key(seed)
    quantities = quantities_of(plant, targets)
    outlook = _outlook(plant, region, own, min(num_steps, length), coast, key, quantities, past)
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
    past: Past | None,
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

    def run(own: Params, key: Array) -> tuple[Array, Array]:
        state = plant.initial_state if past is None else start_after(plant, own, past).state
        there = eqx.tree_at(lambda at_rest: at_rest.initial_state, plant, state)
        episode = run_episode(there, own, whole, length, key)
        return episode.inputs, episode.outputs

    played, outputs = jax.vmap(run)(plants, keys)
    inputs, params = played[0, :num_steps], plant.Params(*region.center)
    start = None if past is None else start_after(plant, params, past)
    information = region.information[None] + running_information(plant, params, inputs, start)
    sizes = jax.vmap(lambda own: nearness(plant, own))(outputs)
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
        warnings: sentences, where the plant does not explain the records.
        nearness: largest output over its critical level on the possible plants, where the inputs
            of the chosen one are played as a signal: of a policy, without its reactions.
        past: what was played before, where it goes on from the last record; None from rest.
    """

    plant: AbstractPlant
    known: Mapping[str, Interval]
    targets: tuple[Target, ...]
    candidates: tuple[Candidate, ...]
    chosen: Candidate | None
    warnings: tuple[str, ...] = ()
    nearness: float = 0.0
    past: Past | None = None

    @property
    def decision(self) -> str:
        """What to play, and why, as a sentence."""
        shares = shares_of(self.targets, self.known)
        if max(shares.values()) <= 1:
            return "every target is reached"
        if self.chosen is None:
            return f"{farthest(shares)}; no candidate is safe on all plants that are possible"
        if np.isfinite(self.chosen.samples):
            count = round(self.chosen.samples)
            told = f"every target is reached after {count} sample{'s' * (count != 1)}"
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
        state = None if self.past is None else start_after(self.plant, params, self.past).state
        outputs = response(self.plant, params, inputs, state)
        return designed_record(self.plant, inputs, outputs, about, self.past is None)

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Writes the inputs to be played (.csv, .mat); `excite run --input` plays the file.

        A signal that goes on from a record is for a loop of your own, and not for `excite run`,
        which begins at rest. Of a policy these are the inputs on the estimated plant; played as a
        policy, it reacts.

        Raises:
            ValueError: for another ending, a file that exists, unless `overwrite`, where no
                candidate is safe, or where a policy is safe only because it reacts.
        """
        require_record_path(Path(path), overwrite)
        if self.chosen is not None and self.nearness >= LARGEST:
            raise ValueError(
                f"the inputs of {self.chosen.name}, as a signal that does not react, reach "
                f"{self.nearness:.2f} of a critical level on a possible plant, and are not "
                "written: play the policy itself (excite run --policy)"
            )
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
            "known": as_data(self.known),
            "targets": {t.name: str(t) for t in self.targets},
            "candidates": [c.to_dict() for c in self.candidates],
            "chosen": None if self.chosen is None else self.chosen.name,
            "decision": self.decision,
            "warnings": list(self.warnings),
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
    known: KnownLike,
    plant: PlantLike | None = None,
    target: TargetLike | None = None,
    *,
    prior: PriorLike | Sequence[PriorLike] | None = None,
    policy: str | Path | Policy | None = None,
    spread: SpreadLike = "factor:3",
    steps: int | None = None,
    ahead: int = 1,
    carry: int | None = None,
    coast: int = COAST,
    seed: int = 0,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress = SHOWN,
) -> NextExperiment:
    """Which experiment to make next, and what it will bring.

    A signal is redesigned for the plants that the records leave possible, and compared with a
    policy where one is given. The one that reaches every target first is chosen, of those that
    are safe on all these plants.

        >>> import excite as ex
        >>> record = ex.simulate("aero2", "chirp", steps=100, seed=1)
        >>> found = ex.next_experiment(record, target={"D_p": "1%"}, steps=50)
        >>> found.chosen.name
        'redesigned'

    Args:
        known: a record or its file, a result of `identify` or its run folder, or several of these,
            each record once.
        plant: a name, `path/to/file.py:ClassName`, a plant or its class; default that of the
            record, the result or the run folder.
        target: half of a 95 % interval by quantity, as for `Campaign`; default half of what it is
            now, for each parameter; of one of which the spread tells much more, half of that.
        prior: as for `identify`, where records are given.
        policy: to compare with; its name or file.
        spread: of the parameters before the records.
        steps: samples of the experiment; default those of the policy, or 200.
        ahead: experiments of this length for which the redesign looks ahead.
        carry: samples of the safe input after the end of the last record, while you decide. The
            signal begins with them, in the state that is predicted there. Default is rest. Not
            with a policy, and not with `ahead`.
        coast: samples after the experiment in which the plant must be safe too.
        seed: of the redesign's starts, and of the noise.
        out: file of the inputs (.csv, .mat); `excite run --input` plays it, but for one that goes
            on from a record.
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
    if carry is not None:
        require_whole("carry", carry, 1, 10_000)
        if policy is not None or ahead > 1:
            other = "policy" if policy is not None else "ahead"
            raise ValueError(f"{other} is for experiments from rest: it does not go with carry")
    if out is not None:
        require_record_path(Path(out), overwrite)
    found = (
        None if policy is None else policy if isinstance(policy, Policy) else read_policy(policy)
    )
    progress("estimating", 0, 2)
    given = known_from(known, plant, prior, spread)
    own, region = given.plant, given.region
    played = None
    if found is not None:
        mismatch(found, own.description)
        played = ("policy" if isinstance(policy, Policy) else f"policy {policy}", found)
    now, within = given.of(()), intervals_in(own, region, ())
    usual = {}
    for name, (_, half) in now.items():  # what the spread tells of it may be much more
        usual[name] = (half if half <= 2 * within[name].ci95_half else within[name].ci95_half) / 2
    targets = targets_from(own, usual if target is None else target)
    for quantity in others_of(own, targets):
        require_defined(quantity, own, own.Params(*region.center))
    now = given.of(others_of(own, targets))
    length = steps or (played[1].layout.num_steps if played else 200)
    past = None if carry is None else _past(given, carry)
    progress("redesigning", 1, 2)
    made = candidates(
        own, region, targets, played,
        num_steps=length, coast=coast, ahead=ahead, seed=seed, past=past,
    )  # fmt: skip
    progress("done", 2, 2)
    best = best_of(made, targets)
    nearness = 0.0 if best is None else best.nearness
    if best is not None and isinstance(best.excitation, Policy):
        replay = Replay(jnp.asarray(best.inputs))
        as_signal = candidate(own, region, targets, best.name, replay, length, coast, seed)
        nearness = as_signal.nearness
    result = NextExperiment(own, now, targets, tuple(made), best, given.warnings, nearness, past)
    if out is not None:
        result.save(out, overwrite)
    return result


def _past(given: Knowledge, carry: int) -> Past:
    """What was played in the last record; ValueError where its state cannot be predicted."""
    if given.result is None:
        raise ValueError("carry goes on from a record: give it as the last one, and not its run")
    if given.plant.delay(given.plant.nominal) is not None:
        raise ValueError("carry is for plants without input delay")
    record, dt = given.result.fitted[-1].record, float(given.plant.dt)
    where = record.source or "the last record"
    if not record.starts_at_initial_state:
        raise ValueError(
            f"{where} does not say that it begins at rest (starts_at_initial_state): from "
            "another record the state after its end is not predicted"
        )
    if not np.allclose(np.diff(record.time), dt, rtol=0.1, atol=0.0):
        raise ValueError(f"{where} is not sampled every {dt:g} s throughout, as carry needs it")
    return Past.of(record.inputs[:-1], carry)
