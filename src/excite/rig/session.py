"""`run`: one experiment on a rig, from names or objects to its record.

Where JAX is installed, any excitation can be played, an estimate runs beside the experiment,
and a safety filter can be added. A laboratory computer without JAX plays policies and signals
with NumPy alone.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from .. import __version__
from ..description import (
    LARGEST_SEED,
    PlantDescription,
    Spread,
    SpreadLike,
    display_unit,
    path_from,
    require_whole,
    wrong_type,
)
from ..policy import Policy, guard_of, mismatch, policy_path, read_policy, require_certified
from ..record import Record, read_record, read_signal, require_record_path
from ..record.read import SIGNAL_ENDINGS
from ..report.tables import html_table, text_table
from ..safety import Supervision, Watch, allowed
from .catalogue import HAS_JAX, RigOptions, rig_named
from .contract import AbstractRig, Interval, Sample, as_data
from .guard import Guard, GuardedPlayer, beside
from .loop import ENDS_OF_PROGRAM, Outcome, Stop, interruptible, run_loop
from .player import (
    AbstractPlayer,
    PolicyPlayer,
    Sequel,
    SequelPlayer,
    SignalPlayer,
    step_seconds,
)
from .recorder import Recorder

if TYPE_CHECKING or HAS_JAX:
    from ..excitation.catalogue import ExcitationLike, excitation_and_origin, name_of
    from ..plant import AbstractPlant
    from ..plant.catalogue import (
        PLANT_ENDING,
        PlantLike,
        known_plant,
        plant_from,
        require_inputs,
    )
    from ..simulation import experiment_length
    from .excitation import ExcitationPlayer, excitation_key
    from .filter import FilteredPlayer, SafetyFilter
    from .live_estimate import LiveEstimate

DEFAULT_POLICY = "aero2_detailed"
"""Of the simulated and the Quanser rig; also the name of their plant."""

_BUDGET = 0.25  # fraction of a sampling time that one step of a player may take

OnSample: TypeAlias = Callable[[Sample], None]


@dataclass(frozen=True)
class RunResult:
    """One experiment on a rig.

    Attributes:
        description: of the plant.
        played: name of the policy, signal or excitation.
        outcome: how the experiment ended.
        path: of the record.
        live_estimate: of the parameters by name, from all samples; empty without JAX, for a
            plant that is not the rig's, or where no fit succeeded.
        warnings: sentences about what was played.
    """

    description: PlantDescription
    played: str
    outcome: Outcome
    path: Path
    live_estimate: Mapping[str, Interval] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def record(self) -> Record:
        """The record, read from its file."""
        return read_record(self.path, self.description)

    def to_dict(self) -> dict[str, object]:
        """The result as JSON-ready data, as `excite run --json` prints it."""
        live = as_data(self.live_estimate)
        return {"file": str(self.path), "live_estimate": live, **self.outcome.to_dict()}

    @property
    def title(self) -> str:
        """Plant and what was played on it."""
        return f"{self.description.name}, {self.played}"

    def rows(self) -> list[list[str]]:
        """Rows of the table that `excite run` prints: name and value."""
        outcome = self.outcome
        rows = [["ended", outcome.reason], ["samples", str(outcome.num_samples)]]
        for output, largest in zip(self.description.outputs, outcome.max_abs_output, strict=True):
            unit, factor = display_unit(output.unit)
            level = output.critical_level
            limit = "" if level is None else f" (critical level {factor * level:g})"
            shown = f"{factor * largest:.4g} {unit}{limit}" if outcome.num_samples else "–"
            rows.append([f"largest |{output.name}|", shown])
        if late := outcome.late_ms_percentiles:
            shown = ", ".join(f"{p} %: {v:.3g}" for p, v in late.items())
            rows.append(["readings late, ms", f"{shown}; {outcome.num_missed} deadlines missed"])
        if (changed := outcome.player.get("filter_interventions")) is not None:
            unsafe = outcome.player["filter_without_safe_input"]
            told = f"; at {unsafe} samples no input was safe for every plant" if unsafe else ""
            rows.append(["filter interventions", f"{changed}{told}"])
        if isinstance(guard := outcome.player.get("guard"), Mapping):
            rows.append(["guard", _told(guard)])
        true = outcome.rig.get("true_params")
        for name, (value, half) in self.live_estimate.items():
            told = f"; true {true[name]:.5g}" if isinstance(true, Mapping) and name in true else ""
            rows.append([f"{name}, live estimate", f"{value:.5g} ± {half:.2g}{told}"])
        return rows

    def __repr__(self) -> str:
        """The table that `excite run` prints."""
        return text_table(self.title, ["", ""], self.rows()) + f"\nrecord: {self.path}"

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        return html_table(self.title, ["", ""], [*self.rows(), ["record", str(self.path)]])


def _told(guard: Mapping[str, Any]) -> str:
    """What a guard did, as a sentence."""
    share = max(value / limit for value, limit in guard["largest_and_threshold"].values())
    if guard["tripped_at"] is None:
        return f"did not trip: at most {100 * share:.0f} % of its thresholds"
    causes = {1.0: "", -1.0: "; the actuator acts with the wrong sign", 0.0: "; no actuator acts"}
    cause = (
        "; the sensor stands still" if guard["sensor_frozen"] else causes[guard["actuator_sign"]]
    )
    return f"tripped at sample {guard['tripped_at']}{cause}"


@dataclass(frozen=True)
class DryRun:
    """The inputs that would be sent to a plant that stays at rest.

    Attributes:
        description: of the plant.
        played: name of the policy, signal or excitation.
        inputs: shape [time, input], in the plant's units.
        warnings: sentences about what was played.
    """

    description: PlantDescription
    played: str
    inputs: np.ndarray
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """The result as JSON-ready data, as `excite run --dry-run --json` prints it."""
        inputs = {
            i.name: {
                "first": u[:5].tolist(),
                "smallest": float(u.min()),
                "largest": float(u.max()),
                "rms": float(np.sqrt(np.mean(u**2))),
            }
            for i, u in zip(self.description.inputs, self.inputs.T, strict=True)
        }
        dt, num_steps = self.description.dt, len(self.inputs)
        return {"played": self.played, "num_steps": num_steps, "dt": dt, "inputs": inputs}

    @property
    def title(self) -> str:
        """The title of the table."""
        return (
            f"{self.played}: {len(self.inputs)} samples of {self.description.dt:g} s; nothing is "
            "sent.\nA policy or a loop reacts to measurements; here the plant stays at rest."
        )

    header = ("input", "smallest", "largest", "rms", "first")

    def rows(self) -> list[list[str]]:
        """Rows of the table that `excite run --dry-run` prints: one per input."""
        return [
            [i.name, *(f"{x:.4g}" for x in (u.min(), u.max(), np.sqrt(np.mean(u**2)))),
             ", ".join(f"{x:.3g}" for x in u[:5])]
            for i, u in zip(self.description.inputs, self.inputs.T, strict=True)
        ]  # fmt: skip

    def __repr__(self) -> str:
        """The table that `excite run --dry-run` prints."""
        return text_table(self.title, self.header, self.rows())

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        return html_table(self.title, self.header, self.rows())


def run(
    rig: str | AbstractRig = "simulated",
    policy: str | Path | Policy | None = None,
    *,
    plant: PlantLike | None = None,
    signal: str | Path | None = None,
    excitation: ExcitationLike | None = None,
    options: Mapping[str, object] | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    steps: int | None = None,
    slew: float = math.inf,
    filter: bool = False,
    guard: bool = False,
    require_certificate: bool = False,
    address: str = "0",
    fast: bool = False,
    dry_run: bool = False,
    seed: int = 0,
    spread: SpreadLike = 0.3,
    fault: Mapping[str, float] | None = None,
    on_sample: OnSample = lambda _: None,
    on_warning: Callable[[str], None] = lambda _: None,
    stop: Stop | None = None,
    sequel: Sequel | None = None,
    live_estimate: bool = True,
) -> RunResult | DryRun:
    """One experiment on a rig: supervised, recorded as it happens, ended by the safe input.

    Of `policy`, `signal` and `excitation` one can be given. Without any, the policy with the
    plant's name is played.

    Args:
        rig: "simulated", "quanser", "FILE.fmu", "FILE.json" (a simulated rig whose true plant
            is that of the file), "path/to/file.py:ClassName", or a rig.
        policy: a shipped policy's name, a file, or a policy.
        plant: name or object, where JAX is installed; by default `aero2_detailed`.
        signal: file of a designed input (.csv, .mat).
        excitation: name ("chirp", "loop-multisine", ...) or object; needs JAX.
        options: of an excitation given by name: amplitude, frequencies and so on.
        out: file of the record (.csv); required unless `dry_run`.
        overwrite: replaces an existing record.
        steps: number of samples; by default all of a policy or signal, else 500.
        slew: largest change of an input in one second, in its unit.
        filter: adds a predictive safety filter for parameters within the `spread`.
        guard: watches whether a declared plant explains the measurements, and brakes where none
            does, and after the last sample; for a policy with a guard in its file
            (`excite falsify --guard`).
        require_certificate: refuses a policy without a certificate that a search on this plant,
            with this `spread`, found it safe.
        address: board identifier of the Quanser rig.
        fast: runs a simulated rig or an FMU as fast as it can, not in real time.
        dry_run: computes the inputs for a plant at rest; nothing is sent or written.
        seed: of a simulated rig's hidden parameters, noise and jitter, and of random signals.
        spread: of these parameters and of the filter's prior: a fraction of their scales, or a
            factor (`factor:3`).
        fault: of a simulated rig, by name: latency [s], jitter [s], dropout (probability);
            `sensor_frozen`, `actuator_dead` and others from a time on [s], see
            `rig.faults.Faults`; `gain_voltage`, `delay_voltage` and other effects of which
            policy, filter and estimate do not know.
        on_sample: called with every sample, after its input was applied.
        on_warning: called with a sentence, before the experiment, where the policy was trained
            on another plant.
        stop: a request to end, which a program can make at any time; without it, signals
            (Ctrl-C) end the experiment.
        sequel: signals that go on from what is played, given while the experiment runs; not with
            a guard, which knows one policy.
        live_estimate: whether parameters are estimated while the experiment runs.

    Returns:
        How it ended, with the path of the record; for a dry run, its inputs. An experiment
        that ends early is no error: see `RunResult.outcome`.

    Raises:
        ValueError: one sentence for what does not exist, does not fit together, needs JAX, or
            is too slow for the sampling time.
        RigError: for a rig that cannot be opened.
        SystemExit, GeneratorExit: of a rig or an excitation, after the end was recorded.

    Example:
        >>> import excite as ex
        >>> ex.run(policy="aero2", dry_run=True).inputs.shape
        (500, 1)
    """
    require_whole("seed", seed, 0, LARGEST_SEED)
    Spread.of(spread)
    if steps is not None:
        require_whole("steps", steps, 2)
    path = None if out is None else path_from("out", out)
    if path is not None:
        require_record_path(path, overwrite)
    elif not dry_run:
        raise ValueError("--out FILE.csv is missing: every experiment must be recorded")
    known = _plant(plant, rig)
    is_default = known is None or (plant is None and not _is_plant_file(rig))
    default = DEFAULT_POLICY if known is None or is_default else known.definition.name
    source = _source(policy, signal, excitation, options or {}, default)
    rig_options = RigOptions(address, fast, seed, spread, fault or {})
    if isinstance(rig, str):
        description = known.description if known is not None else _described(source.policy)
        opened = rig_named(rig, known, description, rig_options)
    elif isinstance(rig, AbstractRig):
        opened = rig
    else:
        raise wrong_type(
            "rig", rig, "a name, FILE.fmu, FILE.json, path/to/file.py:ClassName or a rig"
        )
    description = opened.description
    if known is not None and not _fits(known.description, description):
        if plant is not None or filter or source.excitation is not None:
            raise ValueError(
                f"the rig is of {description.name!r}, with other inputs, outputs, levels or "
                f"another sampling time than the plant {known.description.name!r}: --plant, "
                "--excitation and --filter need the rig's plant"
            )
        known = None
    warnings = tuple(source.warnings(description))
    for warning in warnings:
        on_warning(warning)
    if require_certificate:
        source.check_certificate(description, spread, filter)
    if guard and sequel is not None:
        raise ValueError("a guard knows one policy: it does not go with a sequel")
    watching = source.guard(description) if guard else None
    make = source.maker(description, known, steps, seed)
    prior = _required(known, "--filter") if filter else None
    safety_filter = None if prior is None else SafetyFilter.of(prior, spread, slew)

    def make_player() -> AbstractPlayer:
        player = make()
        if sequel is not None:
            player = SequelPlayer(player, sequel, opened.safe_input)
        if safety_filter is not None:
            player = FilteredPlayer(player, safety_filter)
        return player if watching is None else GuardedPlayer(player, watching)

    rules = Supervision.of(description, slew)
    rules = rules if watching is None else beside(rules)
    session = _Session(opened, known, source.name, make_player, rules, live_estimate)
    if path is None or dry_run:
        return DryRun(description, source.name, session.dry_run(), warnings)
    asked = {
        "rig": rig if isinstance(rig, str) else type(rig).__name__,
        "address": address,
        "slew": slew,
        "filtered": filter,
        "guarded": guard,
        "spread": Spread.of(spread).setting,
        "seed": seed,
        "fault": [dict(fault)] if fault else [],
        **({"options": dict(options)} if options else {}),
    }
    outcome, live = session.run(path, overwrite, asked, on_sample, stop)
    return RunResult(description, source.name, outcome, path, live, warnings)


@dataclass(frozen=True)
class _Source:
    """What is played: one of a policy, a file of inputs, and an excitation."""

    name: str
    policy: Policy | None = None
    signal: Path | None = None
    excitation: ExcitationLike | None = None
    options: Mapping[str, object] = field(default_factory=dict)

    def warnings(self, plant: PlantDescription) -> list[str]:
        """Sentences about a policy of another plant; ValueError where it cannot be played."""
        if self.policy is None:
            return []
        try:
            warning = mismatch(self.policy, plant)
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from None
        return [] if warning is None else [f"{self.name}: {warning}"]

    def check_certificate(
        self, plant: PlantDescription, spread: SpreadLike, filtered: bool
    ) -> None:
        """Raises ValueError for what is played without a certificate of its safety."""
        if self.policy is None:
            raise ValueError(f"{self.name} is no policy: only policies have certificates")
        try:
            require_certified(self.policy, plant, spread, filtered)
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from None

    def guard(self, plant: PlantDescription) -> Guard:
        """The guard in the policy's file; ValueError where there is none for this plant."""
        if self.policy is None:
            raise ValueError(f"{self.name} is no policy: only policies have a guard")
        try:
            found = guard_of(self.policy, plant)
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from None
        return Guard.from_dict(found)

    def maker(
        self,
        description: PlantDescription,
        plant: AbstractPlant | None,
        steps: int | None,
        seed: int,
    ) -> Callable[[], AbstractPlayer]:
        """A function that makes a player before its first sample."""
        if self.policy is not None:
            longest = self.policy.layout.num_steps
            make = functools.partial(PolicyPlayer, self.policy, steps)
        elif self.signal is not None:
            read = read_signal(self.signal, description)
            _require_from_rest(read, self.name)
            inputs = read.inputs[:-1]
            longest, make = len(inputs), functools.partial(SignalPlayer, inputs[:steps])
        else:
            plant, given = _required(plant, "--excitation"), self.excitation or self.name
            if isinstance(given, Record):
                _require_from_rest(given, "this record")
            excitation, _ = excitation_and_origin(given, self.options, plant)
            length = experiment_length(excitation, self.name, steps, isinstance(given, Record))
            key = excitation_key(seed)
            return functools.partial(ExcitationPlayer, excitation, plant, length, key)
        if steps is not None and steps > longest:
            raise ValueError(f"{self.name} was made for {longest} steps; --steps asks for {steps}")
        return make


def _require_from_rest(signal: Record, name: str) -> None:
    """Raises ValueError for a designed signal that goes on from the end of a record."""
    is_designed = "design" in (signal.metadata.get("provenance") or {})
    if is_designed and signal.metadata.get("starts_at_initial_state") is False:
        raise ValueError(f"{name} goes on from the end of a record (--carry): not from rest")


def _required(plant: AbstractPlant | None, option: str) -> AbstractPlant:
    if plant is None:
        raise ValueError(f"{option} needs JAX, which is not installed")
    return plant


def _source(
    policy: str | Path | Policy | None,
    signal: str | Path | None,
    excitation: ExcitationLike | None,
    options: Mapping[str, object],
    default_policy: str,
) -> _Source:
    """The source that is played."""
    if sum(given is not None for given in (policy, signal, excitation)) > 1:
        raise ValueError("--policy, --input and --excitation exclude each other: give one of them")
    if isinstance(excitation, Policy):
        policy = excitation
    elif isinstance(excitation, str | Path):
        if policy_path(str(excitation)) is not None:
            policy = excitation
        elif str(excitation).endswith(SIGNAL_ENDINGS):
            signal = excitation
    if options and (policy or signal or excitation is None):
        raise ValueError("--set needs an --excitation with options, such as chirp")
    if signal is not None:
        return _Source(str(signal), signal=Path(signal))
    if excitation is not None and policy is None:
        is_name = isinstance(excitation, str) or not HAS_JAX
        name = str(excitation) if is_name else name_of(excitation)
        return _Source(name, excitation=excitation, options=options)
    if isinstance(policy, Policy):
        return _Source(f"policy {policy.hash[:8]}", policy)
    if policy is None:
        policy = default_policy
    if not isinstance(policy, str | Path):
        raise wrong_type("policy", policy, "a shipped policy's name, a file or a policy")
    return _Source(str(policy), read_policy(policy))


def _is_plant_file(rig: str | AbstractRig) -> bool:
    return HAS_JAX and isinstance(rig, str) and rig.endswith(PLANT_ENDING)


def _plant(plant: PlantLike | None, rig: str | AbstractRig) -> AbstractPlant | None:
    """The plant; None without JAX."""
    if HAS_JAX:
        usual = known_plant(str(rig)) if _is_plant_file(rig) else DEFAULT_POLICY
        chosen = plant_from(usual if plant is None else plant)
        require_inputs(chosen)
        return chosen
    if plant is not None or rig == "simulated":
        raise ValueError("--plant and a simulated rig need JAX, which is not installed")
    return None


def _described(policy: Policy | None) -> PlantDescription:
    """The plant of a policy, used without JAX: the played policy, or a shipped one."""
    return (policy or read_policy(DEFAULT_POLICY)).plant


def _fits(plant: PlantDescription, rig: PlantDescription) -> bool:
    """Whether excitation, filter and live estimate for the plant can be used on the rig."""

    def seen(d: PlantDescription) -> tuple[object, ...]:
        inputs = [(i.name, i.lower, i.upper) for i in d.inputs]
        return d.dt, inputs, [(o.name, o.critical_level) for o in d.outputs]

    return seen(plant) == seen(rig)


class _Session:
    """A rig, and a player before its first sample."""

    def __init__(
        self,
        rig: AbstractRig,
        plant: AbstractPlant | None,
        played: str,
        make_player: Callable[[], AbstractPlayer],
        rules: Supervision,
        estimates: bool,
    ) -> None:
        self._rig, self._plant, self._played, self._estimates = rig, plant, played, estimates
        self._make_player, self._player, self._rules = make_player, make_player(), rules

    def dry_run(self) -> np.ndarray:
        """Inputs [time, input] for a plant that stays at rest."""
        rest = np.zeros(len(self._rig.description.outputs))
        inputs, watch = [], Watch.start(np, self._rules, rest)
        for k in range(self._player.num_steps):
            watch, input = allowed(np, self._rules, watch, self._player(k, rest))
            self._player.applied(input)
            inputs.append(input)
        return np.array(inputs)

    def run(
        self,
        path: Path,
        overwrite: bool,
        asked: Mapping[str, object],
        on_sample: OnSample,
        stop: Stop | None,
    ) -> tuple[Outcome, Mapping[str, Interval]]:
        """The experiment: how it ended, and the estimate from all its samples."""
        self._check_latency()
        live = self._live_estimate()

        def show(sample: Sample) -> None:
            if live is not None:
                live(sample)
                sample = replace(sample, live_estimate=live.latest)
            on_sample(sample)

        recorder = Recorder(path, self._rig.description, self._metadata(asked), overwrite)
        with interruptible() if stop is None else contextlib.nullcontext(stop) as stop:
            stop.has_begun = True
            try:
                with recorder:
                    outcome = self._play(recorder, stop, show)
            finally:
                stop.is_ending = True
                # The record is complete: an error of the live estimate does not change the outcome.
                with contextlib.suppress(Exception, KeyboardInterrupt):
                    if live is not None:
                        live.close()
        if isinstance(outcome.error, ENDS_OF_PROGRAM):
            raise outcome.error
        return outcome, {} if live is None else live.latest

    def _play(self, recorder: Recorder, stop: Stop, on_sample: OnSample) -> Outcome:
        """The experiment, with a rig that is released."""
        rig, outcome = self._rig, None
        try:
            with rig:
                outcome = run_loop(
                    rig, self._player, self._rules, recorder, stop=stop, on_sample=on_sample
                )
        except BaseException as error:
            if outcome is None:
                raise
            outcome.failed("the rig was not released", error)
            with contextlib.suppress(OSError, ValueError):
                recorder.end(outcome.to_dict())
        return outcome

    def _live_estimate(self) -> LiveEstimate | None:
        if self._plant is None or not self._estimates:
            return None
        return LiveEstimate(self._plant, self._player.num_steps, self._rig.starts_at_rest)

    def _metadata(self, asked: Mapping[str, object]) -> dict[str, object]:
        """Content of the sidecar before the experiment."""
        watchdog = self._rig.watchdog
        return {
            "starts_at_initial_state": self._rig.starts_at_rest,
            "provenance": {
                "excite": __version__,
                "numpy": np.__version__,
                "played": self._played,
                **self._player.origin(),
                **asked,
                "num_readings": self._rig.num_readings,
                "num_latency": self._rig.num_latency,
                **({} if watchdog is None else {"watchdog": watchdog.to_dict()}),
            },
        }

    def _check_latency(self) -> None:
        """Raises ValueError where a step of the player is too slow for the sampling time."""
        if not self._rig.is_real_time:
            return
        d = self._rig.description
        took, budget = step_seconds(self._make_player, len(d.outputs)), _BUDGET * d.dt
        if took > budget:
            raise ValueError(
                f"a step of {self._played} takes {1000 * took:.2g} ms; at a sampling time of "
                f"{1000 * d.dt:g} ms it may take {1000 * budget:.2g} ms"
            )
