"""Tuning of classical signals: amplitude, band, clock, hold, phases, loop, by search.

A comparison with a classical signal is fair only if the signal is tuned. The search
(Optuna's tree-structured Parzen estimator) maximises the mean criterion over plants drawn
from the prior, among signals that reach no critical level.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import optuna
from jaxtyping import Array, Key
from optuna.trial import FrozenTrial

from ..environment import Env, run_episodes
from ..excitation.catalogue import LOOP, excitation_named
from ..information import a_optimality, d_optimality, e_optimality
from ..plant import AbstractPlant
from ..progress import Progress
from ..safety import critical_levels, watched_output

VIOLATION_COST = 5000.0
"""Penalty on the criterion when every experiment of a signal is a violation."""

NEAR = 0.97
"""Fraction of a critical level that counts as a violation while tuning."""

NUM_FINALISTS = 60
"""Number of best settings tested on new plants, until one is safe there too."""

Options: TypeAlias = dict[str, float | bool | list[float]]
"""Options of an excitation, as study files have them."""

_CRITERIA = {
    "D": d_optimality,
    "A": lambda m: -jnp.log(a_optimality(m)),
    "E": lambda m: jnp.log(e_optimality(m)),
}


@dataclass(frozen=True)
class Tuned:
    """A classical excitation with the options that were found best.

    Attributes:
        excitation, options: as names and study files have them.
        value: mean criterion over new plants.
        violations: on these plants.
        episodes: number of these plants.
        trials: number of settings tried.
    """

    excitation: str
    options: Options
    value: float
    violations: int
    episodes: int
    trials: int

    def __str__(self) -> str:
        """Its options on the command line, and its violations."""
        settings = ",".join(f"{k}={json.dumps(v)}" for k, v in self.options.items())
        return (
            f"as an excitation, generated for each plant: --excitation {self.excitation} "
            f"--set {settings}; {self.violations} violations on {self.episodes} new plants"
        )


def tuned_signal(
    env: Env,
    excitation: str,
    *,
    criterion: str = "D",
    trials: int = 400,
    seed: int = 0,
    report: Progress = lambda *_: None,
) -> Tuned:
    """The best options of a classical excitation, tested on plants not used in the search.

    Of the best settings the first without a violation on 1000 new plants is taken, or the
    one with the fewest.

    Args:
        env: the decision process, see `signal_env`.
        excitation: its name.
        criterion: of the information.
    """
    plant, num_steps = env.plant, env.layout.num_steps
    tuning, judging = jax.random.split(jax.random.key(seed))
    keys = jax.random.split(tuning, 500)

    def scored(options: Options, keys: Key[Array, " episode"], limit: float) -> tuple[float, int]:
        built = excitation_named(excitation, options, plant)
        episodes = run_episodes(plant, built, num_steps, env.spread, keys, None, env.coast)
        values = np.asarray(jax.vmap(_CRITERIA[criterion])(episodes.information))
        nearness = episodes.max_abs_output / critical_levels(plant.definition)[None]
        return float(np.mean(values)), int(np.sum(~np.all(nearness < limit, axis=1)))

    def objective(trial: optuna.Trial) -> float:
        options = _suggested(trial, plant, excitation, num_steps)
        trial.set_user_attr("options", options)
        value, violations = scored(options, keys, NEAR)
        report(f"trial {trial.number + 1:,} of {trials:,}", trial.number + 1, trials)
        value = value if np.isfinite(value) else -VIOLATION_COST
        return value - VIOLATION_COST * violations / len(keys)

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed))
    study.enqueue_trial(_usual(plant, num_steps))
    study.optimize(objective, n_trials=trials)
    fresh, judged = jax.random.split(judging, 1000), []
    for trial in sorted(study.trials, key=_cost)[:NUM_FINALISTS]:
        options = trial.user_attrs["options"]
        value, violations = scored(options, fresh, 1.0)
        judged.append(Tuned(excitation, options, value, violations, len(fresh), trials))
        if violations == 0:
            break
    best = min(judged, key=lambda tuned: tuned.violations)
    if best.violations == best.episodes or not np.isfinite(best.value):
        raise ValueError(
            f"tuning {excitation!r} found no usable setting: the best has {best.violations} "
            f"violations on {best.episodes} plants; a smaller spread, a shorter experiment or "
            "more trials may help"
        )
    return best


def _cost(trial: FrozenTrial) -> float:
    """Sorting key: a trial without a value comes last."""
    return np.inf if trial.value is None else -trial.value


def _usual(plant: AbstractPlant, num_steps: int) -> Options:
    """The default options, the first trial of every search."""
    d = plant.description
    halves = [(i.upper - i.lower) / 2 for i in d.inputs]
    amplitudes = {f"amplitude.{n}": i.amplitude / halves[n] for n, i in enumerate(d.inputs)}
    nyquist = 0.5 / d.dt
    low, high = (min(max(f, 1 / (num_steps * d.dt)), nyquist) for f in d.band)
    return {
        **amplitudes, "amplitude": 0.5, "gain": 1.0, "damping": 1.0, "hold": 1, "clock": 1,
        "register": 0, "phases": 0,
        "start_frequency": low, "stop_frequency": high, "frequency": (low * high) ** 0.5,
        "logarithmic": False, "pump": 0.3,
    }  # fmt: skip


def _suggested(
    trial: optuna.Trial, plant: AbstractPlant, excitation: str, num_steps: int
) -> Options:
    """Options of one trial, within what the plant and the experiment allow."""
    shape = excitation.removeprefix(LOOP)
    own = _OPTIONS[shape](trial, plant, num_steps)
    return own | (_loop(trial, plant) if shape != excitation else _amplitude(trial, plant))


def _amplitude(trial: optuna.Trial, plant: AbstractPlant) -> Options:
    """One amplitude per input, from a hundredth of half the width of its limits to all of it."""
    halves = [(i.upper - i.lower) / 2 for i in plant.definition.inputs]
    values = [
        half * trial.suggest_float(f"amplitude.{n}", 0.01, 1.0, log=True)
        for n, half in enumerate(halves)
    ]
    return {"amplitude": values[0] if len(values) == 1 else values}


def _loop(trial: optuna.Trial, plant: AbstractPlant) -> Options:
    d, level = plant.definition, critical_levels(plant.definition)[watched_output(plant.definition)]
    output = d.outputs[watched_output(d)]
    size = float(level) if np.isfinite(level) else output.scale
    gain = d.inputs[0].amplitude / output.scale
    return {
        "amplitude": size * trial.suggest_float("amplitude", 0.05, 1.5, log=True),
        "gain": gain * trial.suggest_float("gain", 0.03, 300.0, log=True),
        "damping": gain * float(plant.dt) * trial.suggest_float("damping", 1e-3, 1e3, log=True),
    }


def _frequency(trial: optuna.Trial, plant: AbstractPlant, name: str, num_steps: int) -> float:
    """A frequency between one period per experiment and the Nyquist frequency."""
    longest, nyquist = 1 / (num_steps * float(plant.dt)), 0.5 / float(plant.dt)
    return trial.suggest_float(name, longest, nyquist, log=True)


def _band(trial: optuna.Trial, plant: AbstractPlant, num_steps: int) -> Options:
    names = ("start_frequency", "stop_frequency")
    return {name: _frequency(trial, plant, name, num_steps) for name in names}


def _multisine(trial: optuna.Trial, plant: AbstractPlant, num_steps: int) -> Options:
    """A band wide enough for at least two harmonics."""
    low, high = sorted(_band(trial, plant, num_steps).values())
    high = min(max(high, 2 * low), 0.5 / float(plant.dt))
    phases = trial.suggest_categorical("phases", range(8))
    return {"start_frequency": low, "stop_frequency": high, "phases": phases}


_HOLDS = (1, 2, 3, 5, 8, 12, 20, 35, 60)

_OPTIONS: Mapping[str, Callable[[optuna.Trial, AbstractPlant, int], Options]] = {
    "random": lambda trial, plant, _: {"hold": trial.suggest_categorical("hold", _HOLDS)},
    "prbs": lambda trial, plant, _: {
        "clock": trial.suggest_categorical("clock", _HOLDS),
        "register": trial.suggest_categorical("register", (0, 6, 7, 8, 9, 10, 11)),
    },
    "chirp": lambda trial, plant, num_steps: {
        **_band(trial, plant, num_steps),
        "logarithmic": trial.suggest_categorical("logarithmic", (False, True)),
    },
    "multisine": _multisine,
    "square": lambda trial, plant, num_steps: {
        "frequency": _frequency(trial, plant, "frequency", num_steps)
    },
    "decay": lambda trial, plant, num_steps: {
        "frequency": _frequency(trial, plant, "frequency", num_steps),
        "pump": trial.suggest_float("pump", 0.02, 0.9),
    },
}
