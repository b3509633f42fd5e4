"""A campaign on a rig: its rounds are played, recorded in a folder, and resumed from there."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

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
from ..excitation import Replay
from ..files import csv_text, json_ready, locked_folder, read_json, write_bytes, write_json
from ..plant.catalogue import PlantLike
from ..policy import Policy, guard_of
from ..progress import SHOWN, Progress
from ..record import read_record
from ..rig.catalogue import RigOptions, rig_named
from ..rig.contract import AbstractRig, Sample
from ..rig.fmu import FMURig
from ..rig.loop import interruptible
from ..rig.session import RunResult, run
from ..rig.simulated import SimulatedRig
from ..safety import Trip
from .campaign import REACHED, WHOLE, Campaign, Round
from .discrimination import RivalLike
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

    Every round begins at rest and is recorded in the folder `out`. Rerun with the same arguments
    to resume an interrupted campaign: nothing is played twice.

        >>> import excite as ex, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     asked = {"D_p": "2%", "J_p": "1%"}
        ...     found = ex.campaign("aero2", asked, out=folder + "/first", fast=True)
        >>> found.reason
        'every target is reached'

    Args:
        plant: as for `Campaign`, and so are `target`, `policy`, `steps`, `spread`, `rounds`,
            `samples`, `coast`, `redesign`, `rivals` and `prior`.
        rig: a name, `FILE.fmu`, `FILE.json`, `path/to/file.py:ClassName` or a rig, as for `run`.
        out: folder of the campaign.
        address: board identifier of the Quanser rig.
        fast: whether a simulated rig runs as fast as it can, not in real time.
        seed: of a simulated rig's hidden parameters, noise and jitter.
        fault: of a simulated rig, as for `run`.
        filter: adds a predictive safety filter for parameters within the spread.
        guard: ends a round that no declared plant explains, as for `run`. Guard and filter know
            one plant: rounds that tell rivals apart are played without them.
        pause: before every round but the first, so that the plant comes to rest [s]. A simulated
            rig and an FMU begin at rest by themselves; for any other rig it must be given.
        command: stored in the folder, to repeat the campaign.
        progress: called with a text, how much is done, and the total.
        on_round: called after every round.
        on_warning: called with sentences about what is played.

    Raises:
        ValueError: for an argument that is not allowed, a target that no plant of the spread
            reaches, or a folder of another campaign.
        TypeError: for an argument of another type.
    """
    made = Campaign(
        plant, target, policy=policy, steps=steps, spread=spread, rounds=rounds, samples=samples,
        coast=coast,
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
                "guard": guard}  # fmt: skip
    folder = _Folder.checked(root, made, settings, command)
    if not folder.has_rounds:
        designing = "designing the first signal, and " * (made.policy is None)
        progress(f"{designing}predicting what can be reached", 0, rounds)
        made.require_reachable()
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
            played, signals = _played(
                made, asked, opened(count), folder.path(count), filter, guard,
                lambda count=count: progress(f"round {count + 1}", count, rounds),
            )  # fmt: skip
            outcome, warned = played.outcome, made.warnings
            if _has_samples(folder.path(count)):
                on_round(made.tell(played.record, outcome.reason, outcome.trip in _UNSAFE))
            for sentence in made.warnings:
                if sentence not in warned:
                    on_warning(sentence)
            if outcome.error is not None or (outcome.reason not in WHOLE and not made.reason):
                made.interrupted = outcome.reason
            elif signals and not made.reason:
                made.interrupted = signals[0]
            folder.write(made)
            folder.save_round(made)
    progress("done", rounds, rounds)
    return made


def _paused(seconds: float) -> str:
    """Waits; a signal ends the wait, and is what is returned."""
    end = time.monotonic() + seconds
    with interruptible() as stop:
        while not stop.reason and (left := end - time.monotonic()) > 0:
            time.sleep(min(left, 0.1))
    return stop.reason


def _played(
    made: Campaign,
    asked: Policy | Replay,
    rig: AbstractRig,
    path: Path,
    filter: bool,
    guard: bool,
    on_begin: Callable[[], None],
) -> tuple[RunResult, list[str]]:
    """One round on a rig, which ends as soon as enough is known, and signals that came."""
    is_decided = not made.is_undecided
    monitor = made.monitor(waits=not rig.is_real_time) if is_decided else None
    on_begin()
    with interruptible() as stop:

        def judge(sample: Sample) -> None:
            if monitor is not None and monitor(sample):
                stop.ask(REACHED)

        try:
            played = run(
                rig, asked if isinstance(asked, Policy) else None, plant=made.plant,
                excitation=asked if isinstance(asked, Replay) else None,
                steps=len(asked.inputs) if isinstance(asked, Replay) else None,
                out=path, overwrite=path.exists(),
                filter=filter and is_decided, guard=guard and is_decided, spread=made.spread,
                on_sample=judge,
                stop=stop, live_estimate=False,
            )  # fmt: skip
        finally:
            with contextlib.suppress(Exception):  # the record is complete
                if monitor is not None:
                    monitor.close()
    signals = [reason for reason in stop.asked if reason != REACHED]
    return cast("RunResult", played), signals  # without dry_run


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

    def write(self, made: Campaign) -> None:
        """Settings, what every round brought, and at the end what was known and the estimate."""
        about = {"excite": __version__, "settings": dict(self.settings)}
        write_json(self.root / "campaign.json", {**about, **made.to_dict()})
        marker = {"kind": "excite campaign", "excite": __version__, "command": self.command}
        write_json(self.root / "run.json", {**marker, "plant": made.plant.description.to_dict()})
        if (made.reason or made.interrupted) and made.result is not None:
            samples, halves = made.knowledge()
            columns = {"sample": samples, **dict(zip(made.known, halves.T, strict=True))}
            write_bytes(self.root / "knowledge.csv", csv_text(columns).encode())
            made.result.save(self.root / "estimate", overwrite=True)

    def save_round(self, made: Campaign) -> None:
        """The run folder of what the rounds so far tell together."""
        if made.result is not None and len(made.result.fitted) == len(made.rounds):
            made.result.save(self.path(len(made.rounds) - 1).with_suffix(""), overwrite=True)

    def resume(
        self,
        made: Campaign,
        on_round: Callable[[Round], None],
        on_warning: Callable[[str], None],
    ) -> None:
        """Takes the rounds that were played before; one that was hardly begun is played again."""
        names: list[str] = []
        is_same = True
        if self.has_rounds:
            before = read_json(self.root / "campaign.json", "expected", "rounds", "targets")
            is_same = before["targets"] == made.to_dict()["targets"]
            if not is_same:
                asked = ", ".join(f"{name} to {to}" for name, to in before["targets"].items())
                on_warning(
                    f"the rounds so far were played for other targets ({asked}); the tables "
                    "compare them with the new ones"
                )
            made.prediction = str(before["expected"]) if is_same else ""
            names = [*(str(r["played"]) for r in before["rounds"]), str(before.get("playing", ""))]
        while _has_samples(path := self.path(len(made.rounds))):
            record = read_record(path, made.declared.description)
            ended = record.metadata.get("ended") or {"reason": "interrupted", "trip": "none"}
            trip = Trip[str(ended["trip"]).upper()]
            count = len(made.rounds)
            goes_on, name = _has_samples(self.path(count + 1)), "".join(names[count : count + 1])
            on_round(made.tell(record, str(ended["reason"]), trip in _UNSAFE, goes_on, name))
            if not self.path(count).with_suffix("").is_dir():  # killed before it was written
                self.save_round(made)
            if not is_same:  # rounds that ended at other targets did not end too early
                made.haste = 1.0
        self.write(made)
