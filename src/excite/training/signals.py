"""Open-loop signals by the gradient of their information.

`robust_signal` is designed on average over the prior of the plant. `clairvoyant_signals`
are designed for each plant as if its parameters were known, as a reference for other
methods (L. Pronzato, A. Pazman, Design of Experiments in Nonlinear Models, 2013). Both
search locally from several starts under the limits of inputs and outputs; a line search
then scales the amplitude up to the limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from ..description import SpreadLike, prior_sd_of
from ..environment import Env, EnvState, InformationGain
from ..environment.falsification import Cases, OnPlant
from ..excitation import Multisine, Replay
from ..plant import AbstractPlant
from ..plant.uncertainty import Uncertainty
from ..policy import Layout, scaled_action
from ..progress import Progress
from .gradient import GradientSettings, Optimisation, Scores, experiments, update_all


def signal_env(
    plant: AbstractPlant,
    num_steps: int,
    spread: SpreadLike,
    criterion: str = "D",
    uncertainty: Uncertainty | None = None,
    coast: int = 0,
) -> Env:
    """The decision process for signals that do not use the measurements.

    All parameters have the same weight.
    """
    every = (True,) * len(plant.definition.parameters)
    objective = InformationGain(every, prior_sd_of(spread), criterion=criterion, dense=False)
    layout = Layout.of(plant.description, window=1, num_steps=num_steps)
    return Env.of(
        plant,
        objective=objective,
        layout=layout,
        spread=spread,
        uncertainty=uncertainty,
        coast=coast,
    )


CLAIRVOYANT = GradientSettings(num_updates=3000, learning_rate=0.1, margin=0.97, near=0.99975)
"""Its outputs may reach 0.99975 of the critical level (39.99 of 40 degrees)."""

CLAIRVOYANT_STARTS = 8

FULL_MARGIN = 2 / 3, 0.997
"""After this fraction of a clairvoyant search its penalty begins ever closer to the level, at
the end at this fraction of it: a signal with a wider margin leaves a part of the level unused."""

ROBUST = GradientSettings(num_updates=1000, num_plants=32, learning_rate=0.03)

NUM_JUDGES = 1000
"""Number of plants, not used in the search, for which a robust signal must be safe."""

AMPLITUDES = np.linspace(-1, 1, 25)
FIRST, WIDTHS = 0.92, (0.12, 0.01, 8e-4)
"""Of the line search: factors around the first, then around the best, ever closer."""


class OpenLoop(eqx.Module):
    """A signal being designed: the hyperbolic tangent of free numbers."""

    latent: Float[Array, "*search time input"]

    def __call__(self, state: EnvState) -> tuple[EnvState, Float[Array, " input"]]:
        """The action of this step."""
        return state, jnp.tanh(self.latent[state.k])

    def excitation(self, layout: Layout) -> Replay:
        """The same signal in input units, to be played on any plant."""
        return _replayed(layout, jnp.tanh(self.latent))


class _Played(eqx.Module):
    """A fixed signal within the input limits."""

    actions: Float[Array, "*search time input"]

    def __call__(self, state: EnvState) -> tuple[EnvState, Float[Array, " input"]]:
        return state, self.actions[state.k]

    def excitation(self, layout: Layout) -> Replay:
        """The same signal in input units, to be played on any plant."""
        return _replayed(layout, self.actions)


def _replayed(layout: Layout, actions: Float[Array, "time input"]) -> Replay:
    return Replay(jax.vmap(partial(scaled_action, jnp, layout))(actions))


@dataclass(frozen=True)
class FoundSignals:
    """Designed signals; the leading axis is the plant, a single one for a robust signal.

    Attributes:
        inputs: in input units.
        worth: gain of the criterion over the prior, mean over its plants.
        nearness: largest output over its critical level.
        worth_by_start: of the safe signal of each start; minus infinity where none was.
    """

    inputs: Float[np.ndarray, "plant time input"]
    worth: Float[np.ndarray, " plant"]
    nearness: Float[np.ndarray, " plant"]
    worth_by_start: Float[np.ndarray, "plant start"]


def clairvoyant_signals(
    env: Env,
    keys: Key[Array, " plant"],
    num_starts: int,
    settings: GradientSettings = CLAIRVOYANT,
    report: Progress = lambda *_: None,
    *,
    seed: int = 0,
) -> FoundSignals:
    """The best signal for each plant drawn with these keys; the seed is that of the starts.

    Raises:
        ValueError: where no safe signal was found for a plant.
    """
    own = jnp.repeat(keys, num_starts)[:, None]
    starts = _first_signals(env, jax.random.split(jax.random.key(seed), len(own)))
    found = _search(env, settings, starts, lambda _: own, report, FULL_MARGIN)
    return _at_the_limit(env, found, own, settings.near, len(keys), WIDTHS)


def robust_signal(
    env: Env,
    seed: int,
    num_starts: int = 4,
    settings: GradientSettings = ROBUST,
    report: Progress = lambda *_: None,
) -> FoundSignals:
    """The signal that is best on average over plants drawn at random, and safe for them.

    Raises:
        ValueError: where no safe signal was found.
    """
    first, second, key = jax.random.split(jax.random.key(seed), 3)

    def fresh(i: int) -> Key[Array, "start plant"]:
        drawn = jax.random.split(jax.random.fold_in(key, i), settings.num_plants)
        return jnp.tile(drawn[None], (num_starts, 1))

    starts = _first_signals(env, jax.random.split(first, num_starts))
    found = _search(env, settings, starts, fresh, report)
    judges = jnp.tile(jax.random.split(second, NUM_JUDGES)[None], (num_starts, 1))
    return _at_the_limit(env, found, judges, settings.near, 1, WIDTHS[:1])


def _search(
    env: Env,
    settings: GradientSettings,
    player: OpenLoop,
    keys: Callable[[int], Key[Array, "search plant"]],
    report: Progress,
    closing: tuple[float, float] | None = None,
) -> Float[Array, "search time input"]:
    """Actions at the end of all searches, side by side.

    Args:
        closing: from which fraction of the updates the distance of the margin from the level
            shrinks, geometrically, and the margin at the end.
    """
    now = eqx.filter_vmap(lambda p: Optimisation.start(p, settings, env))(player)
    for i in range(settings.num_updates):
        is_adversarial = settings.has_adversaries(i) and env.uncertainty is not None
        margin = _margin(settings, i, closing)
        now, _ = update_all(env, settings, now, keys(i), is_adversarial, margin)
        report(f"updating {i + 1:,} of {settings.num_updates:,}", i + 1, settings.num_updates)
    return jnp.tanh(now.player.latent)


def _margin(
    settings: GradientSettings, update: int, closing: tuple[float, float] | None
) -> Float[Array, ""]:
    """Of the penalty at this update."""
    if closing is None:
        return jnp.asarray(settings.margin)
    begin, end = closing
    part = max(0.0, (update / settings.num_updates - begin) / (1 - begin))
    return jnp.asarray(1 - (1 - settings.margin) ** (1 - part) * (1 - end) ** part)


@eqx.filter_jit
def _played(
    env: Env, actions: Float[Array, "search time input"], keys: Key[Array, "search plant"]
) -> Scores:
    return jax.vmap(lambda own, plants: experiments(env, _Played(own), plants, 0.9))(actions, keys)


def _at_the_limit(
    env: Env,
    actions: Float[Array, "search time input"],
    keys: Key[Array, "search plant"],
    limit: float,
    num_plants: int,
    widths: Sequence[float],
) -> FoundSignals:
    """Every signal at its best safe amplitude, and of every plant the best of its starts."""
    worth = np.full(len(actions), -np.inf)
    nearness, best = np.zeros(len(actions)), np.full(len(actions), FIRST)
    for width in widths:
        for factors in best + width * AMPLITUDES[:, None]:
            scaled = jnp.clip(factors[:, None, None] * actions, -1, 1)
            batch = _played(env, scaled, keys)
            own, nearest = np.mean(batch.worth, axis=1), np.max(batch.nearness, axis=1)
            if env.uncertainty is not None:
                nearest = np.maximum(nearest, _worst(env, scaled))
            is_better = (nearest < limit) & (own > worth)
            worth = np.where(is_better, own, worth)
            nearness = np.where(is_better, nearest, nearness)
            best = np.where(is_better, factors, best)
    by_start = worth.reshape(num_plants, -1)
    if np.any(np.isneginf(by_start.max(axis=1))):
        raise ValueError(
            "no safe signal was found: each reaches a critical level on some plant; a smaller "
            "spread, a shorter experiment or a longer search may help"
        )
    num_starts = by_start.shape[1]
    first = np.arange(num_plants) * num_starts + np.argmax(by_start, axis=1)
    chosen = np.clip(best[first, None, None] * np.asarray(actions)[first], -1, 1)
    middle, half = np.array(env.layout.input_middle), np.array(env.layout.input_half)
    return FoundSignals(middle + half * chosen, by_start.max(axis=1), nearness[first], by_start)


@eqx.filter_jit
def _worst(env: Env, actions: Float[Array, "search time input"]) -> Float[Array, " search"]:
    """The largest nearness of every signal at corners and random plants of the uncertainty."""
    box = env.uncertainty
    if box is None:
        raise TypeError("no uncertainty is declared")
    key = jax.random.key(0)
    drawn = jax.vmap(box.draw)(jax.random.split(key, NUM_JUDGES))
    points = jnp.concatenate([box.corners(key, NUM_JUDGES), drawn])
    cases = Cases(points, jnp.zeros(len(points), int))

    def one(own: Float[Array, "time input"]) -> Float[Array, ""]:
        play = OnPlant(box, _Played(own).excitation(env.layout), env.layout.num_steps)
        return jnp.max(jax.vmap(play)(cases))

    return jax.lax.map(one, actions)


def _first_signals(env: Env, keys: Key[Array, " search"]) -> OpenLoop:
    """Sums of sines in the plant's band with random phases, a fifth of its usual amplitude."""
    plant, steps = env.plant, env.layout.num_steps
    usual = np.array([i.amplitude for i in plant.definition.inputs]) / env.layout.input_half

    def one(key: PRNGKeyArray) -> Float[Array, "time input"]:
        noise = jax.random.normal(key, (steps, len(usual)))
        return 0.2 * jnp.asarray(usual)[None] * (random_sines(plant, steps, key) + 0.01 * noise)

    return OpenLoop(jax.vmap(one)(keys))


def random_sines(
    plant: AbstractPlant, num_steps: int, key: PRNGKeyArray
) -> Float[Array, "time input"]:
    """A sum of sines in the plant's band, with random phases; its peak is one."""
    smooth = Multisine().shape(plant, num_steps, key)
    phases = jax.random.uniform(key, (num_steps // 2 + 1, smooth.shape[1]))
    spectrum = jnp.abs(jnp.fft.rfft(smooth, axis=0)) * jnp.exp(2j * math.pi * phases)
    drawn = jnp.fft.irfft(spectrum, num_steps, axis=0)
    return drawn / jnp.maximum(jnp.max(jnp.abs(drawn), axis=0), 1e-12)[None]
