"""`design`: an open-loop input for a plant, searched, then tested on new plants.

`robust` and `clairvoyant` search by gradient (`signals`); a classical excitation is tuned
(`tuning`). In each case the input is then tested as the fixed sequence that a rig plays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import __version__
from ..description import (
    LARGEST_SEED,
    PlantDescription,
    Spread,
    SpreadLike,
    require_whole,
    unknown,
    wrong_type,
)
from ..environment import Env, run_episodes
from ..excitation import Replay
from ..excitation.catalogue import EXCITATIONS, LOOP, excitation_named
from ..information import d_optimality, require_noise
from ..plant import AbstractPlant
from ..plant.catalogue import PlantLike, plant_from, require_inputs, with_sensor
from ..plant.uncertainty import Range, Uncertainty
from ..progress import SHOWN, Progress
from ..record import Record, require_record_path, write_record
from ..report.tables import html_table
from ..simulation import response, run_episode
from .signals import (
    CLAIRVOYANT,
    CLAIRVOYANT_STARTS,
    ROBUST,
    clairvoyant_signals,
    robust_signal,
    signal_env,
)

if TYPE_CHECKING:
    import matplotlib.figure

try:  # Optuna comes with the extra 'tune'
    from .tuning import Tuned, tuned_signal
except ImportError:
    tuned_signal = None

NUM_FRESH = 1000
"""Number of plants on which an input is tested."""

BY_GRADIENT = ("robust", "clairvoyant")


@dataclass(frozen=True, repr=False)
class Design:
    """A designed input.

    Attributes:
        plant: for which it was designed.
        kind: `robust`, `clairvoyant`, or the classical excitation that was tuned.
        criterion, seed: of the search.
        inputs: by sample and input, in input units.
        record: these inputs and the noise-free response of the nominal plant.
        log_det_information: mean logarithm of the determinant of the Fisher information.
        violations: experiments that reached a critical level, of `evaluations`.
        worth_by_start: gain of the criterion over the prior, by start of a search by gradient;
            minus infinity where a start found no safe signal.
        tuned: the excitation and its options, where one was tuned.
    """

    plant: PlantDescription
    kind: str
    criterion: str
    seed: int
    inputs: Float[np.ndarray, "time input"]
    record: Record
    log_det_information: float
    violations: int
    evaluations: int
    worth_by_start: tuple[float, ...] = ()
    tuned: Tuned | None = None

    @property
    def excitation(self) -> Replay:
        """The input as an excitation."""
        return Replay(jnp.asarray(self.inputs))

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Writes the record as CSV or MAT, by the file's ending; `excite run` plays the file.

        Raises:
            ValueError: for another ending, or a file that exists, unless `overwrite`.
        """
        require_record_path(Path(path), overwrite)
        write_record(path, self.record, self.plant)

    def plot(self) -> matplotlib.figure.Figure:
        """The inputs and the nominal plant's response over time, with limits and levels."""
        from ..record.figure import episode_figure

        return episode_figure(self.plant, self.record)

    def summary(self) -> dict[str, object]:
        """How it was found, its information and violations, JSON-ready."""
        return {
            "plant": self.plant.name,
            **_found(self.kind, self.criterion, self.seed, self.worth_by_start, self.tuned),
            "num_steps": len(self.inputs),
            "log_det_information": self.log_det_information,
            "violations": self.violations,
            "evaluations": self.evaluations,
        }

    def __repr__(self) -> str:
        """Two lines, a third for a tuned excitation."""
        return "\n".join(self._lines())

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        title, *lines = self._lines()
        return html_table(title, [""], [[line] for line in lines])

    def _lines(self) -> list[str]:
        where = f"{self.evaluations} new plants" if self.evaluations > 1 else "the nominal plant"
        lines = [
            f"{self.kind} input for {self.plant.name}, {len(self.inputs)} samples",
            f"log det {self.log_det_information:.2f}, {self.violations} violations on {where}",
        ]
        return lines + [str(self.tuned)] * (self.tuned is not None)


def design(
    plant: PlantLike,
    kind: str = "robust",
    *,
    criterion: str = "D",
    steps: int = 500,
    spread: SpreadLike = 0.3,
    uncertainty: Mapping[str, Range] | None = None,
    coast: int = 0,
    noise: Mapping[str, float] | None = None,
    seed: int = 0,
    starts: int | None = None,
    updates: int | None = None,
    trials: int | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress = SHOWN,
) -> Design:
    """Designs an open-loop input within a plant's limits, safe for uncertain parameters.

    A robust design takes about four minutes on two cores; fewer `updates` shorten it.

        >>> import excite as ex
        >>> signal = ex.design("aero2", "clairvoyant", steps=60, starts=1, updates=3)
        >>> ex.simulate("aero2", signal, steps=60).inputs.shape
        (61, 1)

    Args:
        plant: its name, `path/to/file.py:ClassName`, or the plant.
        kind: `robust`, safe for all plants of the spread; `clairvoyant`, for the nominal plant;
            or a classical excitation to be tuned, `loop-NAME` in a position loop.
        criterion: of the Fisher information: its determinant (`D`), the trace of its inverse
            (`A`), or its smallest eigenvalue (`E`).
        steps: samples of the experiment.
        spread: parameters are uniform in nominal value ± spread times their scale, or within a
            factor (`factor:3`).
        uncertainty: what else may differ, as in `falsify`: a robust input is made safe there
            too, and tested on plants drawn from it.
        coast: samples after the experiment, under the input that ends it, in which it must be
            safe too.
        noise: standard deviation by output, in its unit, where it differs from the plant's.
        seed: of the search, and of the plants on which the input is tested.
        starts: of a search by gradient, default 4 (robust) or 8 (clairvoyant).
        updates: gradient updates, default 1000 (robust) or 3000 (clairvoyant).
        trials: of a tuning, default 400.
        out: file to write, .csv or .mat.
        overwrite: whether the file may exist.
        progress: called with a text, the number of updates or trials done, and their total.

    Raises:
        ValueError: for an option that is not allowed, or where no safe input was found.
    """
    if not isinstance(kind, str):
        raise wrong_type("kind", kind, "the name of a kind of design")
    _check(steps, spread, coast, seed, starts, updates, trials)
    if out is not None:
        require_record_path(Path(out), overwrite)
    chosen = with_sensor(plant_from(plant), noise)
    require_inputs(chosen)
    require_noise(chosen)
    if uncertainty and kind != "robust":
        raise ValueError(f"only a robust design takes an uncertainty (--uncertainty); got {kind!r}")
    box = Uncertainty.of(chosen, spread, uncertainty) if uncertainty else None
    env = signal_env(chosen, steps, spread, criterion, box, coast)
    worth_by_start: tuple[float, ...] = ()
    tuned = None
    if kind in BY_GRADIENT:
        if trials is not None:
            raise ValueError(f"trials are for tuning; a {kind} design has updates (--updates)")
        if kind == "clairvoyant":  # the plant is known, the objective is the same
            env = dataclasses.replace(env, spread=0.0)
        inputs, worth_by_start = _searched(env, kind, seed, starts, updates, progress)
    else:
        if updates is not None or starts is not None:
            name = "starts" if updates is None else "updates"
            raise ValueError(f"{name} are for designs by gradient; a tuning has trials (--trials)")
        inputs, tuned = _tuned(env, kind, criterion, seed, trials, progress)
    count = 1 if kind == "clairvoyant" else NUM_FRESH
    keys = jax.random.split(jax.random.key(seed + 1), count)
    judged = run_episodes(chosen, Replay(inputs), steps, env.spread, keys, box, coast)
    found = _found(kind, criterion, seed, worth_by_start, tuned)
    made = Design(
        plant=chosen.description,
        kind=kind,
        criterion=criterion,
        seed=seed,
        inputs=np.asarray(inputs),
        record=designed_record(chosen, inputs, response(chosen, chosen.nominal, inputs), found),
        log_det_information=float(jax.vmap(d_optimality)(judged.information).mean()),
        violations=int(np.sum(judged.is_violation)),
        evaluations=count,
        worth_by_start=worth_by_start,
        tuned=tuned,
    )
    if out is not None:
        made.save(out, overwrite)
    return made


def _check(
    steps: int, spread: SpreadLike, coast: int, seed: int, starts: int | None,
    updates: int | None, trials: int | None,
) -> None:  # fmt: skip
    """Raises ValueError for a number that is not allowed."""
    counts = {"steps": (steps, 2), "starts": (starts, 1)}
    counts |= {"updates": (updates, 1), "trials": (trials, 1)}
    for name, (value, least) in counts.items():
        if value is not None:
            require_whole(name, value, least)
    require_whole("coast", coast, 0)
    require_whole("seed", seed, 0, LARGEST_SEED - 1)  # the next one judges the signal
    Spread.of(spread)


def _searched(
    env: Env, kind: str, seed: int, starts: int | None, updates: int | None, progress: Progress
) -> tuple[Float[Array, "time input"], tuple[float, ...]]:
    """The input found by gradient, and the worth of each start."""
    settings = ROBUST if kind == "robust" else CLAIRVOYANT
    if updates is not None:
        settings = dataclasses.replace(settings, num_updates=updates)
    if kind == "robust":
        found = robust_signal(env, seed, starts or 4, settings, progress)
    else:
        key = jax.random.split(jax.random.key(seed), 1)
        count = starts or CLAIRVOYANT_STARTS
        found = clairvoyant_signals(env, key, count, settings, progress, seed=seed)
    return jnp.asarray(found.inputs[0]), tuple(found.worth_by_start[0].tolist())


def _tuned(
    env: Env, kind: str, criterion: str, seed: int, trials: int | None, progress: Progress
) -> tuple[Float[Array, "time input"], Tuned]:
    """The tuned excitation, and its inputs on the nominal plant."""
    if kind.removeprefix(LOOP) not in EXCITATIONS:
        known = [*BY_GRADIENT, *EXCITATIONS, *(LOOP + name for name in EXCITATIONS)]
        raise unknown("kind of design", kind, known)
    if tuned_signal is None:
        raise ValueError("tuning needs Optuna: pip install 'excite[tune]'")
    best = tuned_signal(
        env, kind, criterion=criterion, trials=trials or 400, seed=seed, report=progress
    )
    played = excitation_named(kind, best.options, env.plant)
    key = jax.random.key(seed)
    run = run_episode(env.plant, env.plant.nominal, played, env.layout.num_steps, key)
    return run.inputs, best


def _found(
    kind: str, criterion: str, seed: int, worth_by_start: tuple[float, ...], tuned: Tuned | None
) -> dict[str, object]:
    """How an input was found, for its file."""
    found = {"design": kind, "criterion": criterion, "seed": seed}
    if tuned is None:
        return {**found, "worth_by_start": list(worth_by_start)}
    judged = {"violations": tuned.violations, "evaluations": tuned.episodes}
    return {
        **found, "options": dict(tuned.options), "trials": tuned.trials, "as_excitation": judged,
    }  # fmt: skip


def designed_record(
    plant: AbstractPlant,
    inputs: Float[Array, "time input"],
    outputs: Float[Array, "sample output"],
    found: Mapping[str, object],
    from_rest: bool = True,
) -> Record:
    """A designed input with a noise-free response, as it is written to a file.

    Args:
        plant: whose sampling time holds.
        inputs: in their units.
        outputs: of the response.
        found: how the input was found, JSON-ready.
        from_rest: whether that begins at rest.
    """
    time = np.arange(len(outputs)) * float(plant.dt)
    origin = {
        "starts_at_initial_state": from_rest,
        "provenance": {"excite": __version__, "simulated": True, **found},
    }
    return Record.of_episode(time, np.asarray(inputs), np.asarray(outputs), origin)
