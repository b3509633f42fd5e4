"""Campaigns: rounds of experiments until the parameters are known as precisely as asked.

A round plays a policy from rest. It ends with the policy's last sample, or as soon as the
running estimate reaches every target and the free motion that would follow is predicted to
be safe. After every round all records are identified together. The policy needs to know
nothing of the plant but the spread that it was trained for.
"""

from __future__ import annotations

import contextlib
import dataclasses
import textwrap
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .. import __version__
from ..description import (
    HALF_95,
    LARGEST_SEED,
    PlantDescription,
    Spread,
    SpreadLike,
    as_number,
    by_name,
    names_of,
    path_from,
    require_whole,
    unknown,
    wrong_type,
)
from ..environment import run_episodes
from ..environment.falsification import nearness
from ..estimation import NLS
from ..estimation.identify import RecordLike, identify
from ..estimation.prior_knowledge import with_prior
from ..estimation.result import Identification
from ..excitation import PolicyExcitation
from ..files import read_json, write_json
from ..information import relative_size, running_information
from ..plant import AbstractPlant, Params
from ..plant.catalogue import PlantLike, plant_from
from ..plant.contract import with_nominal
from ..policy import Policy, mismatch, read_policy
from ..policy.file import shipped_policies
from ..record import Record, read_record
from ..report.numbers import digits_for, number
from ..report.tables import html_table, text_table
from ..rig.catalogue import RigOptions, rig_named
from ..rig.contract import AbstractRig, Interval, Sample
from ..rig.live_estimate import LiveEstimate
from ..rig.loop import COMPLETE, interruptible
from ..rig.session import RunResult, run
from ..safety import Trip, critical_levels, safe_input
from ..simulation import response
from ..training.checkpoint import Progress
from .falsify import trained_in

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REACHED = "every target is reached"

_OWN = {"campaign.json", ".lock"}  # files of a campaign without rounds
_UNSAFE = (Trip.LEVEL, Trip.PREDICTED_LEVEL, Trip.UNEXPLAINED)  # others interrupt a campaign
_WHOLE = (COMPLETE, REACHED)  # ends of rounds that count in the budget
_FIRST = 8  # samples before the first running estimate of a round
_COAST = 100  # samples of free motion that must be safe, where the policy's training had none
_SAFE = 0.97  # of the critical level: largest output allowed in the predicted free motion
_PLANTS = 32  # drawn to predict what a campaign reaches


@dataclass(frozen=True)
class Target:
    """How precisely a parameter is to be known.

    Attributes:
        parameter: its name.
        half: half of the 95 % interval, in the parameter's unit or as a fraction of the estimate.
        is_relative: whether it is a fraction.
    """

    parameter: str
    half: float
    is_relative: bool

    def share(self, value: Any, half: Any) -> Any:
        """Half of an interval over that allowed; the target is reached at one."""
        allowed = self.half * np.abs(value) if self.is_relative else self.half
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.divide(half, allowed)  # infinite for a share of nothing

    def __str__(self) -> str:
        return f"{100 * self.half:g} %" if self.is_relative else f"{self.half:g}"


def targets_from(plant: PlantDescription, given: Mapping[str, str | float]) -> tuple[Target, ...]:
    """Targets by parameter: `{"D_p": "1%"}` of the estimate, or a number in its unit.

    Raises:
        ValueError: for an unknown parameter, a target that is not above 0, or none at all.
    """
    found, names = [], names_of(plant.parameters)
    for name, value in by_name("target", given, "a dict by parameter").items():
        if name not in names:
            raise unknown("parameter", name, names)
        is_relative = isinstance(value, str) and value.strip().endswith("%")
        text = value.strip().removesuffix("%") if isinstance(value, str) else value
        try:
            half = float(text) if isinstance(text, str) else as_number(f"target of {name}", text)
        except ValueError:
            half = float("nan")
        if not 0 < half < float("inf"):
            raise ValueError(
                f"target of {name} must be a number above 0, or a percentage such as 1%: got "
                f"{value!r}"
            )
        found.append(Target(name, half / 100 if is_relative else half, is_relative))
    if not found:
        raise ValueError("a campaign needs a target, such as D_p=1%")
    return tuple(found)


@dataclass(frozen=True)
class Round:
    """One round of a campaign.

    Attributes:
        num_samples: played.
        ended: why, as a sentence.
        nearness: largest measured output over its critical level.
        known: of each parameter, the estimate from this and all earlier rounds with half of its
            95 % interval; empty where there is no estimate.
        status: of that estimate.
        decision: what follows, and why.
    """

    num_samples: int
    ended: str
    nearness: float
    known: Mapping[str, Interval]
    status: str
    decision: str

    def to_dict(self) -> dict[str, Any]:
        """The round as JSON-ready data."""
        known = {name: interval._asdict() for name, interval in self.known.items()}
        return {**dataclasses.asdict(self), "known": known}


@dataclass(frozen=True)
class Expected:
    """What a campaign reaches on plants drawn from its spread, by the Cramér-Rao bound.

    Attributes:
        samples: of each plant, until every target is reached; infinite where that takes more
            rounds than there are.
        shares: of each target, half of the interval over that allowed after all rounds, of the
            plant on which it is smallest.
    """

    samples: Float[np.ndarray, " plant"]
    shares: Mapping[str, float]

    def __str__(self) -> str:
        reached = np.isfinite(self.samples)
        if not reached.any():
            return "no plant of the spread reaches every target"
        median, most = np.quantile(self.samples, [0.5, 0.9], method="inverted_cdf")
        told = f"{median:.0f} samples" if np.isfinite(median) else "more rounds than there are"
        often = f"{most:.0f}" if np.isfinite(most) else "more rounds than there are"
        return f"{told} (median of {len(reached)} plants of the spread; 90 %: {often})"


class Campaign:
    """Rounds of experiments on one plant, until its parameters are known.

    `run` plays them on a rig. Whoever has a loop of their own asks and tells:

        >>> import excite as ex
        >>> campaign = ex.Campaign("aero2", {"D_p": "2%"}, policy="aero2", rounds=2)
        >>> while (policy := campaign.ask()) is not None:
        ...     record = ex.simulate("aero2", policy, params={"D_p": 0.0012}, seed=1)
        ...     told = campaign.tell(record)
        >>> campaign.reason
        'every target is reached'

    Attributes:
        plant: as identification knows it.
        targets: by parameter.
        policy: that is played.
        spread: of the parameters before the campaign.
        most_rounds: the budget.
        coast: samples of free motion after an end that must be safe.
        records: of all rounds.
        rounds: what each of them brought.
        result: estimate from all records; None before the first.
        reason: why the campaign ended; empty while it goes on.
        interrupted: why `campaign` stopped before its end; empty where it did not.
    """

    def __init__(
        self,
        plant: PlantLike,
        target: Mapping[str, str | float],
        *,
        policy: str | Path | Policy | None = None,
        spread: SpreadLike | None = None,
        rounds: int = 10,
        coast: int | None = None,
    ) -> None:
        """A campaign before its first round.

        Args:
            plant: its name, `path/to/file.py:ClassName`, the plant or its class.
            target: half of the 95 % interval by parameter: "1%" of the estimate, or a number in
                the parameter's unit.
            policy: to be played, its name or file; default the plant's shipped policy for a
                spread by a factor, or its usual one.
            spread: of the parameters; default that of the policy's training.
            rounds: that are played at most.
            coast: samples after a round's end in which the plant must be safe; default that of the
                policy's training, or 100.

        Raises:
            ValueError: for a name or a value that is not allowed.
            TypeError: for an argument of another type.
        """
        self.plant = plant_from(plant)
        description = self.plant.description
        self.targets = targets_from(description, target)
        require_whole("rounds", rounds, 1, 1000)
        self.most_rounds = rounds
        self.policy = _policy(policy, description)
        usual, _, usual_coast = trained_in(self.policy, self.plant)
        self.spread = Spread.of(usual if spread is None else spread)
        self.coast = coast if coast is not None else usual_coast or _COAST
        require_whole("coast", self.coast, 0)
        self.records: list[Record] = []
        self.rounds: list[Round] = []
        self.result: Identification | None = None
        self.reason, self.interrupted = "", ""

    def ask(self) -> Policy | None:
        """The policy to play in the next round, from rest; None once the campaign has ended."""
        return None if self.reason else self.policy

    def tell(self, record: RecordLike, ended: str = COMPLETE, unsafe: bool = False) -> Round:
        """Takes the record of a round, identifies, and decides whether another one follows.

        Args:
            record: of the round, from rest, or its file.
            ended: why the round ended.
            unsafe: whether it ended because a level was near, or no declared plant explains it.

        Raises:
            ValueError: where the campaign has ended, or for a record of another plant.
        """
        if self.reason:
            raise ValueError(f"the campaign has ended: {self.reason}")
        d = self.plant.description
        if not isinstance(record, Record):
            record = read_record(path_from("record", record, "a record or a path"), d)
        if record.outputs.shape[1] != len(d.outputs) or record.inputs.shape[1] != len(d.inputs):
            raise ValueError(f"the record has other inputs or outputs than {d.name!r}")
        if len(record.time) < 2:
            raise ValueError("the record of a round needs at least two samples: got one")
        self.records.append(record)
        count, status = len(record.time) - 1, "too few samples for an estimate"
        try:
            result = identify(self.records, self.plant, start=self._start(), initial_state="known")
            status = result.status
            self.result = result if result.is_usable else self.result
        except ValueError as error:  # this record tells nothing; another one may
            status = str(error)
        sizes = np.abs(record.outputs) / critical_levels(d)[None]
        near = float(np.nanmax(sizes, initial=0.0))
        known = {} if self.result is None else known_of(self.result)
        shares = self.shares(known)
        if unsafe or near >= 1:
            self.reason = f"unsafe: {ended if unsafe else 'a critical level was reached'}"
        elif shares and max(shares.values()) <= 1:
            self.reason = REACHED
        elif sum(e in _WHOLE for e in [*(r.ended for r in self.rounds), ended]) >= self.most_rounds:
            self.reason = "all rounds are played"
        missing = _missing(shares) if shares else f"there is no estimate yet ({status})"
        decision = f"end: {self.reason}" if self.reason else f"go on: {missing}"
        told = Round(count, ended, near, known, status, decision)
        self.rounds.append(told)
        return told

    def shares(self, known: Mapping[str, Interval]) -> dict[str, float]:
        """Of each target, half of the interval over that allowed; empty without an estimate."""
        if not known:
            return {}
        return {t.parameter: float(t.share(*known[t.parameter])) for t in self.targets}

    def _start(self) -> dict[str, float] | None:
        return None if self.result is None else dict(self.result.params)

    def monitor(self, waits: bool = False) -> Monitor:
        """A judge of the next round while it runs; see `Monitor`."""
        return Monitor(self, waits)

    @cached_property
    def expected(self) -> Expected:
        """What the campaign will reach; computed once, which takes seconds."""
        steps = self.policy.layout.num_steps
        keys = jax.random.split(jax.random.key(0), _PLANTS)
        excitation = PolicyExcitation.of(self.policy)
        episodes = run_episodes(self.plant, excitation, steps, self.spread, keys)
        halves = _halves(self.plant, episodes.params, episodes.trajectory.inputs, self.most_rounds)
        values = np.stack([np.asarray(v) for v in episodes.params], axis=-1)
        names = list(self.plant.nominal._fields)
        shares = {
            t.parameter: t.share(values[None, :, None, i], np.asarray(halves)[..., i])
            for t in self.targets
            for i in [names.index(t.parameter)]
        }
        worst = np.max(list(shares.values()), axis=0)  # round, plant, step
        is_reached = worst.transpose(1, 0, 2).reshape(_PLANTS, -1) <= 1
        first = np.where(is_reached.any(axis=1), is_reached.argmax(axis=1) + 1.0, np.inf)
        return Expected(first, {name: float(np.nanmin(s[-1, :, -1])) for name, s in shares.items()})

    def require_reachable(self) -> None:
        """Raises ValueError where no plant of the spread would reach every target."""
        far = {name: share for name, share in self.expected.shares.items() if not share <= 1}
        if far:
            name, share = max(far.items(), key=lambda item: item[1])
            target = next(t for t in self.targets if t.parameter == name)
            best = dataclasses.replace(target, half=target.half * share)
            raise ValueError(
                f"no experiment of {self.most_rounds} x {self.policy.layout.num_steps} samples "
                f"reaches {name} to {target}: at best {_rounded(best)}; ask for less, or for more "
                "rounds"
            )

    @property
    def num_samples(self) -> int:
        """Played in all rounds."""
        return sum(r.num_samples for r in self.rounds)

    def to_dict(self) -> dict[str, Any]:
        """The campaign as JSON-ready data."""
        return {
            "plant": self.plant.description.name,
            "plant_hash": self.plant.description.hash,
            "policy_hash": self.policy.hash,
            "targets": {t.parameter: str(t) for t in self.targets},
            "spread": self.spread.setting,
            "most_rounds": self.most_rounds,
            "coast": self.coast,
            "reason": self.reason,
            "num_samples": self.num_samples,
            "rounds": [r.to_dict() for r in self.rounds],
        }

    header = ("parameter", "estimate", "± 95 %", "relative", "target", "")

    @property
    def title(self) -> str:
        """What was played, and how it ended."""
        count = len(self.rounds)
        played = f"{self.num_samples} samples in {count} round{'s' * (count != 1)}"
        return f"{self.plant.description.name}: {self.reason or 'not ended'} ({played})"

    def rows(self) -> list[list[str]]:
        """Rows of the table: one per parameter."""
        known = self.rounds[-1].known if self.rounds else {}
        shares, rows = self.shares(known), []
        targets = {t.parameter: t for t in self.targets}
        for p in self.plant.description.parameters:
            if p.name not in known:
                rows.append([p.name, "–", "–", "–", _told(targets.get(p.name)), ""])
                continue
            value, half = known[p.name]
            reached = ("reached" if shares[p.name] <= 1 else "missed") if p.name in shares else ""
            relative = f"{number(100 * half / abs(value), 2)} %" if value else "–"
            shown = f"{number(value, digits_for(value, half))} {p.unit}".rstrip()
            rows.append([p.name, shown, f"{half:.2g}", relative,
                         _told(targets.get(p.name)), reached])  # fmt: skip
        return rows

    def round_rows(self) -> list[list[str]]:
        """Rows of the table of rounds."""
        rows = []
        for i, r in enumerate(self.rounds, 1):
            is_told = r.ended == COMPLETE or r.ended in r.decision
            decision = r.decision if is_told else f"{r.ended}; {r.decision}"
            rows.append([str(i), str(r.num_samples), f"{100 * r.nearness:.0f} %", decision])
        return rows

    round_header = ("round", "samples", "of the level", "decision")

    def __repr__(self) -> str:
        """The tables that `excite campaign` prints."""
        tables = [
            text_table(self.title, self.header, self.rows()),
            text_table("rounds", self.round_header, self.round_rows()),
        ]
        if "expected" in vars(self):  # where it was computed
            tables.append(textwrap.fill(f"expected before the first round: {self.expected}", 80))
        return "\n".join(tables)

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        rounds = html_table("rounds", self.round_header, self.round_rows())
        return html_table(self.title, self.header, self.rows()) + rounds

    def knowledge(self) -> tuple[Int[np.ndarray, " sample"], Float[np.ndarray, "sample param"]]:
        """Half of the 95 % interval of each parameter after each sample, by the Cramér-Rao bound.

        At the final estimate, for the inputs that were played; infinite before a parameter is
        identifiable.
        """
        if self.result is None:
            raise ValueError("the campaign has no estimate yet")
        params = self.plant.Params(*self.result.params.values())
        before, parts = jnp.zeros((len(params), len(params))), []
        for record in self.records:
            inputs = jnp.asarray(record.inputs[:-1])
            parts.append(running_information(self.plant, params, inputs) + before[None])
            before = parts[-1][-1]
        halves = _half_of(self.plant, params, jnp.concatenate(parts))
        return np.arange(1, len(halves) + 1), np.asarray(halves)

    def plot(self) -> Figure:
        """What was known after each sample, over what was asked."""
        from ..report.figures import knowledge_figure

        samples, halves = self.knowledge()
        names = list(self.plant.nominal._fields)
        known = known_of(self.result) if self.result is not None else {}
        shares = {
            t.parameter: t.share(known[t.parameter].estimate, halves[:, names.index(t.parameter)])
            for t in self.targets
        }
        ends = np.cumsum([r.num_samples for r in self.rounds]).tolist()
        return knowledge_figure(self.title, samples, shares, ends)


class Monitor:
    """Judges a round while it runs: whether it can end, because enough is known.

    Call it with every sample, in a loop of your own or as `on_sample` of `ex.run`.
    """

    def __init__(self, campaign: Campaign, waits: bool) -> None:
        """Compiles the estimator; this takes seconds.

        Args:
            campaign: whose next round is judged.
            waits: whether a call waits for its estimate; otherwise it is computed beside the
                experiment, and the judgement follows some samples later.
        """
        plant, before = campaign.plant, campaign.result
        estimator = NLS()
        if before is not None:
            _, prior, _ = with_prior(plant, before, plant.nominal, {}, {})
            estimator = dataclasses.replace(estimator, prior=prior)
            plant = with_nominal(plant, dict(before.params))
        steps = campaign.policy.layout.num_steps
        self._campaign = campaign
        self._live = LiveEstimate(plant, steps, True, estimator, first=_FIRST, waits=waits)
        self._inputs = np.tile(safe_input(plant.definition), (steps + campaign.coast, 1))
        self._after(plant.nominal)  # compiles, before the first sample

    def __call__(self, sample: Sample) -> bool:
        """Takes one more sample; whether every target is reached and ending now is safe."""
        self._live(sample)
        known = self._live.latest
        shares, plant = self._campaign.shares(known), self._campaign.plant
        is_enough = bool(shares) and max(shares.values()) <= 1
        if is_enough:
            values = jnp.asarray([known[name].estimate for name in plant.nominal._fields])
            params = plant.Params(*values)  # as numbers they would be compiled into the program
            is_enough = self._after(params) < _SAFE
        self._inputs[sample.k] = sample.input
        return is_enough

    def _after(self, params: Params) -> float:
        """Largest output over its critical level if the round ended now."""
        return float(_free_motion(self._campaign.plant, params, jnp.asarray(self._inputs)))

    def close(self) -> None:
        """Waits for the running estimate."""
        self._live.close()


@eqx.filter_jit
def _free_motion(
    plant: AbstractPlant, params: Params, inputs: Float[Array, "time input"]
) -> Float[Array, ""]:
    """Largest output over its critical level under these inputs."""
    return nearness(plant, response(plant, params, inputs))


@eqx.filter_jit
def _halves(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[Array, "plant time input"],
    rounds: int,
) -> Float[Array, "round plant time param"]:
    """Half of each interval after every sample of every round, if all rounds were alike."""

    def one(params: Params, inputs: Array) -> Array:
        running = running_information(plant, params, inputs)
        before = jnp.arange(rounds)[:, None, None, None] * running[-1][None, None]
        return _half_of(plant, params, before + running[None])

    return jnp.swapaxes(jax.vmap(one)(params, inputs), 0, 1)


def _half_of(
    plant: AbstractPlant, params: Params, information: Float[Array, "*step param param"]
) -> Float[Array, "*step param"]:
    """Half of the 95 % intervals, in the parameters' units; infinite for singular information."""
    inverse = jnp.linalg.inv(information)
    variance = jnp.diagonal(inverse, axis1=-2, axis2=-1)
    sound = jnp.isfinite(variance) & (variance > 0)
    size = relative_size(plant, params).reshape((1,) * (variance.ndim - 1) + (-1,))
    return HALF_95 * size * jnp.sqrt(jnp.where(sound, variance, jnp.inf))


def known_of(result: Identification) -> dict[str, Interval]:
    """Of each parameter, the estimate and half of its 95 % interval; infinite for a held one."""
    found = {}
    for name, value in result.params.items():
        low, high = result.ci95(name)
        half = float("inf") if name in result.held else (high - low) / 2
        found[name] = Interval(float(value), half if half == half else float("inf"))
    return found


def _missing(shares: Mapping[str, float]) -> str:
    """The target that is farthest from being reached."""
    name, share = max(shares.items(), key=lambda item: item[1])
    if not share < float("inf"):
        return f"{name} is not identifiable yet"
    return f"{name} is {share:.2g} times as uncertain as asked"


def _told(target: Target | None) -> str:
    return "" if target is None else str(target)


def _rounded(target: Target) -> str:
    return f"{100 * target.half:.2g} %" if target.is_relative else f"{target.half:.2g}"


def _policy(given: str | Path | Policy | None, plant: PlantDescription) -> Policy:
    """The policy to play; ValueError where it cannot be played on the plant."""
    if given is None:
        shipped = shipped_policies()
        wide = f"{plant.name}-wide"
        given = wide if wide in shipped else plant.name
        if given not in shipped:
            raise ValueError(f"there is no shipped policy for {plant.name!r}: give one (--policy)")
    found = given if isinstance(given, Policy) else read_policy(given)
    mismatch(found, plant)
    return found


def campaign(
    plant: PlantLike,
    target: Mapping[str, str | float],
    rig: str | AbstractRig = "simulated",
    *,
    out: str | Path,
    policy: str | Path | Policy | None = None,
    spread: SpreadLike | None = None,
    rounds: int = 10,
    coast: int | None = None,
    address: str = "0",
    fast: bool = False,
    seed: int = 0,
    fault: Mapping[str, float] | None = None,
    filter: bool = False,
    guard: bool = False,
    pause: float = 0.0,
    progress: Progress = lambda *_: None,
    on_round: Callable[[Round], None] = lambda _: None,
    on_warning: Callable[[str], None] = lambda _: None,
) -> Campaign:
    """Plays rounds of experiments on a rig until the parameters are known as asked.

    Every round begins at rest and is recorded in the folder `out`. Rerun with the same arguments
    to resume an interrupted campaign: nothing is played twice.

        >>> import excite as ex, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     asked = {"D_p": "2%", "J_p": "1%"}
        ...     found = ex.campaign("aero2", asked, out=folder + "/first", fast=True)
        >>> found.reason
        'every target is reached'

    Args:
        plant: as for `Campaign`, and so are `target`, `policy`, `spread`, `rounds` and `coast`.
        rig: a name, `FILE.fmu`, `FILE.json`, `path/to/file.py:ClassName` or a rig, as for `run`.
        out: folder of the campaign.
        address: board identifier of the Quanser rig.
        fast: whether a simulated rig runs as fast as it can, not in real time.
        seed: of a simulated rig's hidden parameters, noise and jitter.
        fault: of a simulated rig, as for `run`.
        filter: adds a predictive safety filter for parameters within the spread.
        guard: ends a round that no declared plant explains, as for `run`.
        pause: before every round but the first, so that the plant comes to rest [s].
        progress: called with a text, how much is done, and the total.
        on_round: called after every round.
        on_warning: called with sentences about what is played.

    Raises:
        ValueError: for an argument that is not allowed, a target that no plant of the spread
            reaches, or a folder of another campaign.
        TypeError: for an argument of another type.
    """
    made = Campaign(plant, target, policy=policy, spread=spread, rounds=rounds, coast=coast)
    require_whole("seed", seed, 0, LARGEST_SEED)
    if not 0 <= as_number("pause", pause) < 1e5:
        raise ValueError(f"pause must be a number of seconds, not below 0: got {pause!r}")
    root = path_from("out", out)

    def opened(count: int) -> AbstractRig:
        """The rig for a round, after so many others."""
        if isinstance(rig, AbstractRig):
            return rig
        if not isinstance(rig, str):
            raise wrong_type("rig", rig, "a name, a file, path/to/file.py:ClassName or a rig")
        options = RigOptions(address, fast, seed, made.spread, fault or {}, experiment=count)
        return rig_named(rig, made.plant, made.plant.description, options)

    if not opened(0).starts_at_rest:
        raise ValueError(
            "every round of a campaign begins at rest, and this rig does not say that it does "
            "(starts_at_rest)"
        )
    progress("predicting what can be reached", 0, rounds)
    made.require_reachable()
    name = rig if isinstance(rig, str) else type(rig).__name__
    asked = {"rig": name, "seed": seed, "fault": dict(by_name("fault", fault)), "filter": filter,
             "guard": guard}  # fmt: skip
    folder = _Folder.opened(root, made, asked)
    folder.resume(made, on_round)
    while made.ask() is not None and not made.interrupted:
        count = len(made.rounds)
        progress(f"round {count + 1}", count, rounds)
        if count and pause:
            time.sleep(pause)
        path = folder.path(count)
        played, signals = _played(made, opened(count), path, filter, guard, on_warning)
        outcome = played.outcome
        if _has_samples(path):
            on_round(_taken(made, played.record, outcome.reason, outcome.trip))
            folder.write(made)
        if outcome.error is not None or (outcome.reason not in _WHOLE and not made.reason):
            made.interrupted = outcome.reason
        elif signals and not made.reason:
            made.interrupted = signals[0]
    progress("done", rounds, rounds)
    return made


def _played(
    made: Campaign,
    rig: AbstractRig,
    path: Path,
    filter: bool,
    guard: bool,
    on_warning: Callable[[str], None],
) -> tuple[RunResult, list[str]]:
    """One round on a rig, which ends as soon as enough is known, and signals that came."""
    monitor = made.monitor(waits=not rig.is_real_time)
    with interruptible() as stop:

        def judge(sample: Sample) -> None:
            if monitor(sample):
                stop.ask(REACHED)

        try:
            played = run(
                rig, made.policy, plant=made.plant, out=path, overwrite=path.exists(),
                filter=filter, guard=guard, spread=made.spread, on_sample=judge,
                on_warning=on_warning, stop=stop, live_estimate=False,
            )  # fmt: skip
        finally:
            with contextlib.suppress(Exception):  # the record is complete
                monitor.close()
    signals = [reason for reason in stop.asked if reason != REACHED]
    return cast("RunResult", played), signals  # without dry_run


def _taken(made: Campaign, record: Record, reason: str, trip: Trip) -> Round:
    """The campaign after a round of a rig."""
    return made.tell(record, reason, trip in _UNSAFE)


def _has_samples(path: Path) -> bool:
    """Whether a record has more than its header and one sample."""
    return path.is_file() and len(path.read_bytes().splitlines()) > 2


@dataclass(frozen=True)
class _Folder:
    """Where a campaign is kept: its settings and rounds, and a record of each."""

    root: Path
    settings: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def opened(cls, root: Path, made: Campaign, asked: Mapping[str, object]) -> _Folder:
        """A new folder, or that of the same campaign; ValueError for anything else."""
        own = made.to_dict()
        kept = ("plant_hash", "policy_hash", "spread", "coast")
        settings = {**{name: own[name] for name in kept}, **asked}
        file = root / "campaign.json"
        if file.is_file() and (root / "round-01.csv").exists():
            before = read_json(file, "settings", "rounds")["settings"]
            other = [name for name, value in settings.items() if before.get(name) != value]
            if other:
                raise ValueError(
                    f"{root} is another campaign, with {other[0]} {before.get(other[0])!r} and not "
                    f"{settings[other[0]]!r}: choose another folder"
                )
        elif root.exists() and not (root.is_dir() and {p.name for p in root.iterdir()} <= _OWN):
            raise ValueError(f"{root} exists and is no campaign: choose another folder")
        root.mkdir(parents=True, exist_ok=True)
        folder = cls(root, settings)
        if not (root / "round-01.csv").exists():
            folder.write(made)
        return folder

    def path(self, index: int) -> Path:
        """Of the record of a round."""
        return self.root / f"round-{index + 1:02}.csv"

    def write(self, made: Campaign) -> None:
        """Settings, and what every round brought."""
        about = {"excite": __version__, "settings": dict(self.settings)}
        write_json(self.root / "campaign.json", {**about, **made.to_dict()})

    def resume(self, made: Campaign, on_round: Callable[[Round], None]) -> None:
        """Takes the rounds that were played before; one that was hardly begun is played again."""
        while made.ask() is not None and _has_samples(path := self.path(len(made.rounds))):
            record = read_record(path, made.plant.description)
            ended = record.metadata.get("ended") or {"reason": "interrupted", "trip": "none"}
            trip = Trip[str(ended["trip"]).upper()]
            on_round(_taken(made, record, str(ended["reason"]), trip))
        if made.rounds:
            self.write(made)
