"""A campaign on a rig: its rounds are played, recorded in a folder, and resumed from there."""

from __future__ import annotations

import contextlib
import copy
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from .. import __version__
from ..description import (
    LARGEST_SEED,
    SpreadLike,
    as_number,
    by_name,
    path_from,
    require_whole,
    wrong_type,
)
from ..estimation.prior_knowledge import PriorLike
from ..estimation.result import Identification
from ..excitation import Replay
from ..files import csv_text, json_ready, locked_folder, read_json, write_bytes, write_json
from ..plant.catalogue import PlantLike, plant_from
from ..policy import Policy, guard_of
from ..progress import SHOWN, Progress
from ..record import Record, read_record
from ..rig.catalogue import RigOptions, rig_named
from ..rig.contract import AbstractRig, Sample
from ..rig.fmu import FMURig
from ..rig.loop import COMPLETE, Stop, interruptible
from ..rig.player import Sequel
from ..rig.session import RunResult, run
from ..rig.simulated import SimulatedRig
from ..safety import Trip
from ..simulation import simulate
from .campaign import REACHED, WHOLE, Campaign, Round, usual_policy
from .discrimination import RivalLike
from .monitor import Monitor
from .next_experiment import played_as
from .targets import TargetLike

_OWN = {"campaign.json", "run.json", ".lock"}  # files of a campaign without rounds
_UNSAFE = (Trip.LEVEL, Trip.PREDICTED_LEVEL, Trip.UNEXPLAINED)  # others interrupt a campaign


def campaign(
    plant: PlantLike,
    target: TargetLike,
    rig: str | AbstractRig = "simulated",
    *,
    out: str | Path,
    policy: str | Path | Policy | None = None,
    steps: int | None = None,
    spread: SpreadLike | None = None,
    rounds: int = 10,
    samples: int | None = None,
    coast: int | None = None,
    carry: int | None = None,
    redesign: bool = True,
    rivals: Sequence[RivalLike] = (),
    prior: PriorLike | Sequence[PriorLike] | None = None,
    address: str = "0",
    fast: bool = False,
    seed: int = 0,
    fault: Mapping[str, float] | None = None,
    filter: bool = False,
    guard: bool = False,
    pause: float | None = None,
    command: str = "",
    progress: Progress = SHOWN,
    on_round: Callable[[Round], None] = lambda _: None,
    on_warning: Callable[[str], None] = lambda _: None,
) -> Campaign:
    """Plays rounds of experiments on a rig until the parameters are known as asked.

    Every round is recorded in the folder `out`; it begins at rest, or with `carry` where the last
    one ended, in the same record. Rerun with the same arguments
    to resume an interrupted campaign: nothing is played twice.

        >>> import excite as ex, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     asked = {"D_p": "2%", "J_p": "1%"}
        ...     found = ex.campaign("aero2", asked, out=folder + "/first", fast=True)
        >>> found.reason
        'every target is reached'

    Args:
        plant: as for `Campaign`, and so are `target`, `policy`, `steps`, `spread`, `rounds`,
            `samples`, `coast`, `carry`, `redesign`, `rivals` and `prior`. In real time, where a
            decision takes longer than `carry` samples, the next round begins at rest.
        rig: a name, `FILE.fmu`, `FILE.json`, `path/to/file.py:ClassName` or a rig, as for `run`.
        out: folder of the campaign.
        address: board identifier of the Quanser rig.
        fast: whether a simulated rig runs as fast as it can, not in real time.
        seed: of a simulated rig's hidden parameters, noise and jitter.
        fault: of a simulated rig, as for `run`.
        filter: adds a predictive safety filter for parameters within the spread.
        guard: ends a round that no declared plant explains, as for `run`. The default policy is
            then one that has a guard, where one is shipped. Guard and filter know one plant:
            rounds that tell rivals apart are played without them.
        pause: before every round from rest but the first, so that the plant comes to rest [s]. A
            simulated rig and an FMU begin at rest by themselves; for any other rig it must be
            given.
        command: stored in the folder, to repeat the campaign.
        progress: called with a text, how much is done, and the total.
        on_round: called after every round; with `carry` from another thread, while the experiment
            goes on.
        on_warning: called with sentences about what is played.

    Raises:
        ValueError: for an argument that is not allowed, a target that no plant of the spread
            reaches, or a folder of another campaign.
        TypeError: for an argument of another type.
    """
    if guard and carry is not None:
        raise ValueError("a guard knows a policy, which begins at rest: it does not go with carry")
    plant = plant_from(plant)
    if guard and policy is None:
        policy = usual_policy(plant.description, guarded=True)
    made = Campaign(
        plant, target, policy=policy, steps=steps, spread=spread, rounds=rounds, samples=samples,
        coast=coast, carry=carry,
        redesign=redesign and not guard,  # a guard knows its policy
        rivals=rivals, prior=prior,
    )  # fmt: skip
    if guard and made.policy is None:
        raise ValueError("a guard knows a policy: it does not go without one")
    if guard and made.policy is not None:
        guard_of(made.policy, made.declared.description)  # before the first round
    require_whole("seed", seed, 0, LARGEST_SEED)
    if pause is not None and not 0 <= as_number("pause", pause) < 1e5:
        raise ValueError(f"pause must be a number of seconds, not below 0: got {pause!r}")
    root = path_from("out", out)

    def opened(count: int) -> AbstractRig:
        """The rig for a round, after so many others."""
        if isinstance(rig, AbstractRig):
            return rig
        if not isinstance(rig, str):
            raise wrong_type("rig", rig, "a name, a file, path/to/file.py:ClassName or a rig")
        options = RigOptions(address, fast, seed, made.spread, fault or {}, experiment=count)
        return rig_named(rig, made.declared, made.declared.description, options)

    first = opened(0)
    if not first.starts_at_rest:
        raise ValueError(
            "every round of a campaign begins at rest, and this rig does not say that it does "
            "(starts_at_rest)"
        )
    if pause is None and rounds > 1 and not isinstance(first, SimulatedRig | FMURig):
        raise ValueError(
            "say how long this rig takes to come to rest after a round: pause (--pause) in "
            "seconds, 0 if it comes to rest by itself"
        )
    name = rig if isinstance(rig, str) else type(rig).__name__
    settings = {"rig": name, "seed": seed, "fault": dict(by_name("fault", fault)), "filter": filter,
                "guard": guard, "carry": carry}  # fmt: skip
    folder = _Folder.checked(root, made, settings, command)
    if not folder.has_rounds:
        designing = "designing the first signal, and " * (made.policy is None)
        progress(f"{designing}predicting what can be reached", 0, rounds)
        made.require_reachable(brakes=guard)
    if rivals and (guard or filter):
        on_warning("rounds that tell rivals apart are played without guard and filter")
    for sentence in made.warnings:
        on_warning(sentence)
    with locked_folder(root, "this campaign", ["run.json", "campaign.json"]):
        folder.resume(made, on_round, on_warning)
        while not made.reason and not made.interrupted:
            count = len(made.rounds)
            if count and pause:
                made.interrupted = _paused(pause)
                if made.interrupted:
                    break
            progress(f"preparing round {count + 1}", count, rounds)
            warned = made.warnings
            if (asked := made.ask()) is None:
                folder.write(made)
                break
            folder.write(made)  # what is played, should the round be the last of this process
            for sentence in made.warnings:
                if sentence not in warned:
                    on_warning(sentence)
            own = opened(count)
            if carry is not None and own.is_real_time and not made.is_undecided:
                _rehearse(made)
            experiment = _Experiment(made, folder, on_round, progress)
            played, signals = experiment.play(asked, own, filter, guard)
            outcome = played.outcome
            if experiment.is_late and not made.reason:
                on_warning(f"a decision took longer than {carry} samples: give more (--carry)")
            for sentence in made.warnings:
                if sentence not in warned:
                    on_warning(sentence)
            if outcome.error is not None or (outcome.reason not in WHOLE and not made.reason):
                made.interrupted = outcome.reason
            elif signals and not made.reason:
                made.interrupted = signals[0]
            made.rest()
            folder.write(made)
    progress("done", rounds, rounds)
    return made


def _paused(seconds: float) -> str:
    """Waits; a signal ends the wait, and is what is returned."""
    end = time.monotonic() + seconds
    with interruptible() as stop:
        while not stop.reason and (left := end - time.monotonic()) > 0:
            time.sleep(min(left, 0.1))
    return stop.reason


def _rehearse(made: Campaign) -> None:
    """Decides about a simulated round, so that no decision waits for a compilation."""
    if len(made.rounds) + 1 >= made.most_rounds:
        return
    own = copy.copy(made)
    own.records, own.rounds = list(made.records), list(made.rounds)
    params = None if own.result is None else dict(own.result.params)
    with contextlib.suppress(ValueError):
        own.tell(simulate(own.plant, own.opening, params=params, seed=0))
        own.reason = ""
        own.ask()


class _Experiment:
    """One or more rounds on a rig: all but the first go on where the last one ended.

    Attributes:
        is_late: whether it ended because a decision came too late.
    """

    def __init__(
        self,
        made: Campaign,
        folder: _Folder,
        on_round: Callable[[Round], None],
        progress: Progress,
    ) -> None:
        self._made, self._folder, self._on_round = made, folder, on_round
        self._plant, self._progress = made.plant, progress
        self._path, self._first = folder.path(len(made.rounds)), len(made.rounds)
        self._stop, self._pool = Stop(), ThreadPoolExecutor(1)
        self._monitor: Monitor | None = None
        self._sequel: Sequel | None = None
        self._waits, self._end, self._ended = True, 0, COMPLETE
        self._decision: Future[np.ndarray | None] | None = None
        self._told: list[tuple[Path, Identification]] = []
        self._is_hasty = False  # the last round ended too early
        self.is_late = False

    def play(
        self,
        asked: Policy | Replay,
        rig: AbstractRig,
        filter: bool,
        guard: bool,
    ) -> tuple[RunResult, list[str]]:
        """Plays the rounds, each until enough is known, and tells the campaign of them.

        Returns:
            How the experiment ended, and signals that came.
        """
        made, path = self._made, self._path
        is_decided, self._waits = not made.is_undecided, not rig.is_real_time
        self._monitor = made.monitor(self._waits) if is_decided else None
        if made.carry is not None and is_decided:
            self._sequel, self._end = Sequel(made.longest), played_as(asked)[1]
        self._progress(f"round {self._first + 1}", self._first, made.most_rounds)
        with interruptible() as self._stop:
            try:
                played = run(
                    rig, asked if isinstance(asked, Policy) else None, plant=made.plant,
                    excitation=asked if isinstance(asked, Replay) else None,
                    steps=len(asked.inputs) if isinstance(asked, Replay) else None,
                    out=path, overwrite=path.exists(),
                    filter=filter and is_decided, guard=guard and is_decided, spread=made.spread,
                    on_sample=self._judge, stop=self._stop, sequel=self._sequel,
                    live_estimate=False,
                )  # fmt: skip
            finally:
                with contextlib.suppress(Exception):  # the record is complete
                    if self._monitor is not None:
                        self._monitor.close()
                self._pool.shutdown()  # a decision that came too late is told all the same
        outcome = cast("RunResult", played).outcome  # without dry_run
        is_unsafe = outcome.trip in _UNSAFE
        if is_unsafe and made.reason == REACHED:
            made.reason = f"unsafe: {outcome.reason}, although every target is reached"
        if _has_samples(path) and not made.reason:
            record = read_record(path, made.declared.description)
            if is_unsafe or self._is_new(record):
                self._tell(record, outcome.reason, is_unsafe)
        if self._decision is not None and outcome.error is None:
            self._decision.result()  # raises its error
        for path, result in self._told:  # now, because writing would make a real-time loop late
            result.save(path, overwrite=True)
        signals = [s for s in self._stop.asked if s not in WHOLE]
        return cast("RunResult", played), signals

    def _tell(self, record: Record, ended: str, unsafe: bool = False) -> None:
        """Tells the campaign of a round; its run folder is written at the experiment's end."""
        self._on_round(self._made.tell(record, ended, unsafe))
        if (told := self._folder.told(self._made)) is not None:
            self._told.append(told)

    def _is_new(self, record: Record) -> bool:
        """Whether a record has more than the rounds that were told, and the pause after them."""
        told = sum(r.num_samples for r in self._made.rounds[self._first :])
        return not told or len(record.time) - 1 > told + (self._made.carry or 0)

    def _judge(self, sample: Sample) -> None:
        """Takes a sample, with which a round may end, or the next one be decided."""
        is_enough = self._monitor is not None and self._monitor(sample)
        if self._sequel is None:
            if is_enough:
                self._stop.ask(REACHED)
            return
        if self._decision is None and sample.k < self._end and is_enough and not self._is_hasty:
            self._end, self._ended = sample.k + 1, REACHED
            self._sequel.end(sample.k + 1)
        elif self._decision is None and sample.k == self._end:
            self._decision = self._pool.submit(self._decide, sample.k, self._ended)
        if self._decision is not None:
            self._go_on(self._sequel, self._decision, sample.k)

    def _go_on(self, sequel: Sequel, decision: Future[np.ndarray | None], k: int) -> None:
        """Plays what was decided once the pause is over; without a decision the experiment ends."""
        begin = self._end + cast("int", self._made.carry)
        is_last = k + 1 == begin
        if self._waits or decision.done():
            inputs = None if decision.exception() else decision.result()
            if inputs is None:
                self._stop.ask(REACHED if self._made.reason == REACHED else COMPLETE)
            elif is_last:
                sequel.begin(begin, inputs)
                self._end, self._ended, self._decision = begin + len(inputs), COMPLETE, None
        elif is_last:
            self.is_late = True
            self._stop.ask(COMPLETE)

    def _decide(self, count: int, ended: str) -> np.ndarray | None:
        """Tells of the round that ended after so many samples; the signal that goes on, if any."""
        made = self._made
        record = read_record(self._path, made.declared.description, rows=slice(count + 1))
        self._tell(record, ended)
        self._folder.write_decisions(made)
        if self._monitor is not None:
            self._monitor.enough = 1 / made.haste
        self._is_hasty = ended == REACHED
        asked, count = made.ask(), len(made.rounds)
        self._folder.write_decisions(made)
        # Another plant needs another monitor and filter.
        is_same = made.plant.description.hash == self._plant.description.hash
        if not (is_same and made.continues and isinstance(asked, Replay)):
            return None
        self._progress(f"round {count + 1}", count, made.most_rounds)
        return np.asarray(asked.inputs)[made.carry :]


def _names_in(folder: Path) -> set[str]:
    """Names of files, without those that were being written when a process was killed."""
    begun = (".campaign.json.", ".run.json.")
    return {p.name for p in folder.iterdir() if not p.name.startswith(begun)}


def _has_samples(path: Path) -> bool:
    """Whether a record has more than its header and one sample."""
    return path.is_file() and len(path.read_bytes().splitlines()) > 2


@dataclass(frozen=True)
class _Folder:
    """Where a campaign is kept: its settings and rounds, and a record of each."""

    root: Path
    settings: Mapping[str, Any]
    command: str

    @classmethod
    def checked(
        cls, root: Path, made: Campaign, asked: Mapping[str, object], command: str
    ) -> _Folder:
        """A folder that is new, or of the same campaign; ValueError for anything else."""
        own = made.to_dict()
        kept = ("plant_hash", "policy_hash", "steps", "spread", "coast", "redesign", "rivals",
                "prior")  # fmt: skip
        settings = json_ready({**{name: own[name] for name in kept}, **asked})
        file = root / "campaign.json"
        if file.is_file() and (root / "round-01.csv").exists():
            before = read_json(file, "settings", "rounds")["settings"]
            # One that is missing was not there when the folder was begun.
            other = [n for n, value in settings.items() if before.get(n, type(value)()) != value]
            if other:
                name = other[0]
                told = f"{name} {before.get(name)!r} and not {settings[name]!r}"
                if name.endswith("_hash"):
                    told = f"another {name.removesuffix('_hash')}"
                raise ValueError(f"{root} is another campaign, with {told}: choose another folder")
        elif root.exists() and not (root.is_dir() and _names_in(root) <= _OWN):
            raise ValueError(f"{root} exists and is no campaign: choose another folder")
        return cls(root, settings, command)

    @property
    def has_rounds(self) -> bool:
        """Whether a round was played before."""
        return _has_samples(self.path(0))

    def path(self, index: int) -> Path:
        """Of the record of a round."""
        return self.root / f"round-{index + 1:02}.csv"

    def write_decisions(self, made: Campaign) -> None:
        """Settings, and what every round brought."""
        about = {"excite": __version__, "settings": dict(self.settings)}
        write_json(self.root / "campaign.json", {**about, **made.to_dict()})
        marker = {"kind": "excite campaign", "excite": __version__, "command": self.command}
        write_json(self.root / "run.json", {**marker, "plant": made.plant.description.to_dict()})

    def write(self, made: Campaign) -> None:
        """The same, and at the end what was known and the estimate."""
        self.write_decisions(made)
        if (made.reason or made.interrupted) and made.result is not None:
            samples, halves = made.knowledge()
            columns = {"sample": samples, **dict(zip(made.known, halves.T, strict=True))}
            write_bytes(self.root / "knowledge.csv", csv_text(columns).encode())
            made.result.save(self.root / "estimate", overwrite=True)

    def told(self, made: Campaign) -> tuple[Path, Identification] | None:
        """What the rounds so far tell together, if anything, and its run folder."""
        lengths = [len(record.time) for record in made.records]
        if made.result is None or [len(f.record.time) for f in made.result.fitted] != lengths:
            return None
        return self.path(len(made.rounds) - 1).with_suffix(""), made.result

    def _ends(
        self, first: int, total: int, before: Sequence[Mapping[str, Any]], pause: int | None
    ) -> list[int]:
        """Samples in a record after which its rounds ended: the first one, and those that went on.

        What follows the last of them is a round, too, unless it is but the pause after it.
        """
        if pause is None:
            return [total]
        later = (i for i in range(first + 1, len(before)) if self.path(i).exists())
        counts = [int(r["num_samples"]) for r in before[first : next(later, len(before))]]
        ends = list(itertools.accumulate(counts))
        return ends if ends and total <= ends[-1] + pause else [*ends, total]

    def resume(
        self,
        made: Campaign,
        on_round: Callable[[Round], None],
        on_warning: Callable[[str], None],
    ) -> None:
        """Takes the rounds that were played before; one that was hardly begun is played again."""
        names: list[str] = []
        before: list[dict[str, Any]] = []
        is_same = True
        if self.has_rounds:
            kept = read_json(self.root / "campaign.json", "expected", "rounds", "targets")
            before = kept["rounds"]
            is_same = kept["targets"] == made.to_dict()["targets"]
            if not is_same:
                asked = ", ".join(f"{name} to {to}" for name, to in kept["targets"].items())
                on_warning(
                    f"the rounds so far were played for other targets ({asked}); the tables "
                    "compare them with the new ones"
                )
            made.prediction = str(kept["expected"]) if is_same else ""
            made.unsafe = str(kept.get("unsafe", ""))
            names = [*(str(r["played"]) for r in before), str(kept.get("playing", ""))]
        while _has_samples(path := self.path(len(made.rounds))):
            record, first = read_record(path, made.declared.description), len(made.rounds)
            outcome = record.metadata.get("ended") or {"reason": "interrupted", "trip": "none"}
            unsafe = Trip[str(outcome["trip"]).upper()] in _UNSAFE
            pause = 0 if unsafe and made.carry else made.carry
            ends = self._ends(first, len(record.time) - 1, before, pause)
            for end in ends:
                count = len(made.rounds)
                is_last = end == len(record.time) - 1
                part = record
                if not is_last:
                    part = read_record(path, made.declared.description, rows=slice(end + 1))
                is_told = count < len(before) and made.carry is not None
                told = before[count]["ended"] if is_told else outcome["reason"]
                goes_on = end != ends[-1] or _has_samples(self.path(count + 1))
                name = "".join(names[count : count + 1])
                on_round(made.tell(part, str(told), unsafe and is_last, goes_on, name))
                known = self.told(made)
                if known is not None and not known[0].is_dir():  # killed before it was written
                    known[1].save(known[0], overwrite=True)
                if not is_same:  # rounds that ended at other targets did not end too early
                    made.haste = 1.0
        made.rest()
        self.write(made)
