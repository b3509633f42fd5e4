"""Rigs and players as the command line names them, and the live view of an experiment."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from ..description import PlantDescription, display_unit
from ..rig.contract import AbstractRig, Sample
from ..rig.player import AbstractPlayer, PolicyPlayer, SignalPlayer

DEFAULT_POLICY = "aero2_detailed"
"""Of the simulated and the Quanser rig: robust against what the ideal plant leaves out."""

_SHOWN_EVERY = 0.2  # seconds; drawing takes a part of a millisecond
_BUDGET = 0.25  # part of a sampling time that a player may take


@dataclass
class Job:
    """What is to be run.

    Attributes:
        rig: closed.
        plant: with JAX the plant, for the live estimate and the filter; else None.
        make_player: a player before its experiment, each time another.
        player: the one to be played.
        name: of the player.
    """

    rig: AbstractRig
    plant: Any
    make_player: Callable[[], AbstractPlayer]
    player: AbstractPlayer
    name: str

    def metadata(self, options: dict[str, Any]) -> dict[str, Any]:
        """What the sidecar says before the experiment."""
        import numpy as np

        from .. import __version__

        rig, asked = self.rig, ("rig", "address", "slew", "filtered", "spread", "seed", "fault")
        return {
            "starts_at_initial_state": rig.starts_at_rest,
            "provenance": {
                "excite": __version__,
                "numpy": np.__version__,
                "played": self.name,
                **self.player.origin(),
                **{name: options[name] for name in asked},
                "num_readings": rig.num_readings,
                "num_latency": rig.num_latency,
            },
        }

    def check_latency(self) -> None:
        """Raises ValueError where a step of the player takes too long for the sampling time."""
        from ..rig import step_seconds

        d = self.rig.description
        took, allowed = step_seconds(self.make_player, len(d.outputs)), _BUDGET * d.dt
        if self.rig.is_real_time and took > allowed:
            raise ValueError(
                f"a step of {self.name} takes {1000 * took:.2g} ms; at a sampling time of "
                f"{1000 * d.dt:g} ms it may take {1000 * allowed:.2g} ms"
            )


def job_from(options: dict[str, Any], has_jax: bool) -> Job:
    """Rig and player from the options of `excite run`.

    Raises:
        ValueError: for what does not exist, does not fit together, or needs JAX.
    """
    from ..policy import mismatch

    policy, name = (None, "") if options["signal"] else _policy(options)
    plant, rig = _rig(options, policy, has_jax)
    _require_own(options)
    d = rig.description
    if plant is not None and not _fits(plant.description, d):
        if options["plant"] or options["filtered"]:
            raise ValueError(
                f"the rig is of {d.name!r}, with other inputs, outputs, levels or another "
                f"sampling time than the plant {plant.description.name!r}: --plant and --filter "
                "need the rig's"
            )
        plant = None
    if policy is not None:
        try:
            warning = mismatch(policy, d)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
        if warning is not None:
            click.echo(f"warning: {name}: {warning}", err=True)
    make = _maker(options, policy, d, plant)
    player = make()
    steps = options["steps"] or player.num_steps
    if steps > player.num_steps:
        raise ValueError(
            f"{name or options['signal']} was made for {player.num_steps} steps; "
            f"--steps asks for {steps}"
        )
    player.num_steps = steps
    return Job(rig, plant, make, player, name or str(options["signal"]))


def _fits(plant: PlantDescription, rig: PlantDescription) -> bool:
    """Whether a filter and a live estimate for the plant may look at the rig."""

    def seen(d: PlantDescription) -> Any:
        inputs = [(i.name, i.lower, i.upper) for i in d.inputs]
        return d.dt, inputs, [(o.name, o.critical_level) for o in d.outputs]

    return seen(plant) == seen(rig)


def _policy(options: dict[str, Any]) -> tuple[Any, str]:
    """The policy and its name: the one asked for, that of the plant, or the rig's own."""
    from ..policy import policy_path, read_policy, shipped_policies

    name = options["policy"] or options["plant"] or DEFAULT_POLICY
    path = policy_path(name)
    if path is None:
        known = ", ".join(shipped_policies())
        raise ValueError(f"no policy {name!r} (there is {known}, path/to/policy.safetensors)")
    return read_policy(path), name


def _rig(options: dict[str, Any], policy: Any, has_jax: bool) -> tuple[Any, AbstractRig]:
    """The plant, None without JAX, and the rig."""
    name = options["rig"]
    plant = _plant(options, has_jax)
    description = plant.description if plant is not None else _described(policy)
    if name == "simulated":
        return plant, _simulated(options, plant)
    if name == "quanser":
        from ..rig.quanser import QuanserAero2

        return plant, QuanserAero2(description, options["address"])
    if name.endswith(".fmu"):
        from ..rig.fmu import FMURig

        return plant, FMURig(Path(name), description, is_real_time=not options["fast"])
    path, colon, word = name.rpartition(":")
    if not (colon and path.endswith(".py")):
        raise ValueError(
            f"unknown rig {name!r} (there is simulated, quanser, FILE.fmu, "
            "path/to/file.py:ClassName)"
        )
    return plant, _own_rig(Path(path), word, description)


def _require_own(options: dict[str, Any]) -> None:
    """Raises ValueError for an option that this rig does not have."""
    is_simulated = options["rig"] == "simulated"
    for option, is_there in (("fault", False), ("fast", options["rig"].endswith(".fmu"))):
        if options[option] and not (is_simulated or is_there):
            raise ValueError(f"--{option} is of a simulated rig, not of {options['rig']!r}")


def _plant(options: dict[str, Any], has_jax: bool) -> Any:
    if not has_jax:
        if options["plant"] or options["rig"] == "simulated":
            raise ValueError("--plant and a simulated rig need JAX, which is not installed")
        return None
    from ..plant.catalogue import plant_named

    return plant_named(options["plant"] or DEFAULT_POLICY)


def _described(policy: Any) -> PlantDescription:
    """Without JAX a plant is known from a policy: the one to be played, or a shipped one."""
    from ..policy import read_policy, shipped_policies

    shipped = shipped_policies()
    return (policy or read_policy(shipped.get(DEFAULT_POLICY, shipped["aero2"]))).plant


def _simulated(options: dict[str, Any], plant: Any) -> AbstractRig:
    import jax

    from ..rig.simulated import Body, SimulatedRig, readings_per_sample
    from .options import merged

    num_readings = readings_per_sample(plant)
    faults = merged(options["fault"])
    for name, value in faults.items():
        if name not in ("latency", "jitter", "dropout") or not 0 <= value < 1:
            raise ValueError(
                f"--fault {name}={value:g} is not allowed: latency, jitter or dropout in [0, 1)"
            )
    key = jax.random.key(options["seed"])
    body = Body.draw(plant, num_readings, options["spread"], key, **faults)
    return SimulatedRig(plant, body, num_readings, not options["fast"])


def _own_rig(path: Path, word: str, description: PlantDescription) -> AbstractRig:
    from ..files import class_at

    found = class_at(path, word, AbstractRig, "rig")
    try:
        rig: Any = found()
        if not hasattr(rig, "description"):
            rig.description = description
        return rig
    except TypeError as error:  # a method of the contract is missing
        raise ValueError(f"{word} in {path} is not a complete rig: {error}") from None


def _maker(
    options: dict[str, Any], policy: Any, description: PlantDescription, plant: Any
) -> Callable[[], AbstractPlayer]:
    """How a player is made, with a filter where one is asked for."""
    if policy is not None:

        def bare() -> AbstractPlayer:
            return PolicyPlayer(policy)
    else:
        from ..record import read_signal

        record = read_signal(options["signal"], description)

        def bare() -> AbstractPlayer:
            return SignalPlayer(record.inputs[:-1])

    if not options["filtered"]:
        return bare
    if plant is None:
        raise ValueError("--filter needs JAX, which is not installed")
    from ..rig.filter import FilteredPlayer, SafetyFilter

    filter = SafetyFilter.of(plant, options["spread"], options["slew"])
    return lambda: FilteredPlayer(bare(), filter)


class LiveView:
    """One line on a terminal: time, outputs between their levels, inputs, running estimate."""

    def __init__(self, description: PlantDescription, tracker: Any, num_steps: int) -> None:
        """`tracker` may be None."""
        self._description, self._tracker = description, tracker
        self._duration, self._latest = num_steps * description.dt, None
        self._end = threading.Event()
        # A terminal may stop taking what is written to it; the loop must not wait for that.
        self._thread = threading.Thread(target=self._draw, daemon=True)
        if sys.stderr.isatty():
            self._thread.start()

    def __call__(self, sample: Sample) -> None:
        """Keeps the estimate going; the sample is drawn now or later."""
        if self._tracker is not None:
            self._tracker(sample)
        self._latest = sample

    def _draw(self) -> None:
        shown = None
        while not self._end.wait(_SHOWN_EVERY):
            if (sample := self._latest) is not None and sample is not shown:
                sys.stderr.write("\r\x1b[2K" + self.line(sample))
                sys.stderr.flush()
                shown = sample

    def line(self, sample: Sample) -> str:
        """What is shown of a sample."""
        d = self._description
        parts = [f"{sample.time:5.1f} / {self._duration:g} s"]
        parts += [_gauge(o, y) for o, y in zip(d.outputs, sample.measured, strict=True)]
        parts += [
            f"{i.name} {u:+6.2f} {i.unit}" for i, u in zip(d.inputs, sample.input, strict=True)
        ]
        if self._tracker is not None:
            parts += [f"{n} {v:.3g} ± {h:.1g}" for n, (v, h) in self._tracker.latest.items()]
        return "  ".join(parts)

    def end(self) -> None:
        """Leaves the line."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join(1.0)
            sys.stderr.write("\n")


def _gauge(output: Any, value: float) -> str:
    """An output in its place between its critical levels, with the warning levels marked."""
    unit, factor = display_unit(output.unit)
    text = f"{output.name} {factor * value:+7.2f} {unit}"
    if output.critical_level is None:
        return text
    width = 10
    marks = [" "] * (2 * width + 1)
    marks[width] = "."
    if output.warning_level is not None:
        near = round(width * output.warning_level / output.critical_level)
        marks[width - near] = marks[width + near] = ":"
    place = width + round(width * max(-1.0, min(1.0, value / output.critical_level)))
    marks[place] = "#"
    return f"{text} |{''.join(marks)}|"
