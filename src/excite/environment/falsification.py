"""Falsification: a search for the plant on which an excitation comes nearest to a level.

The search goes over the box of an `Uncertainty` and over sensor noise: plants drawn at
random, the corners of the box with several noises, ascents by projected sign gradients of
the nearness through the whole experiment, and the worst plants again with more noises and
with noise that is itself searched within a bound. It finds violations; it proves nothing
where it finds none (Y. Annpureddy et al., S-TaLiRo: temporal logic falsification, 2011).
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..excitation import AbstractExcitation
from ..plant import AbstractPlant
from ..plant.uncertainty import Uncertainty
from ..safety import watched_levels
from ..simulation import run_episode, sensor_noise

_CHUNKS = 8, 64  # experiments of one call, where there are few and where there are many
_FIRST_STEP = 0.25  # of an ascent, in half widths of the box


@eqx.filter_jit
def nearness(plant: AbstractPlant, outputs: Float[Array, "time output"]) -> Float[Array, ""]:
    """Largest output over its critical level; infinite for an experiment that diverged."""
    watched, _, critical = watched_levels(plant.definition)
    size = jnp.max(jnp.abs(outputs[:, np.array(watched, int)]) / critical[None], initial=0.0)
    return jnp.where(jnp.all(jnp.isfinite(outputs)), size, jnp.inf)


class Cases(eqx.Module):
    """Experiments, each on a plant of the box; the leading axis is the experiment.

    Attributes:
        point: of the box.
        seed: of excitation and noise, as in `simulate`.
        noise: in standard deviations; None for that of the seed.
    """

    point: Float[Array, "*case quantity"]
    seed: Int[Array, "*case"]
    noise: Float[Array, "*case sample output"] | None = None


class AbstractExperiments(eqx.Module):
    """What a search simulates: `OnPlant`, or `OnRig` of `excite.rig.falsification`.

    Attributes:
        uncertainty: the box.
    """

    uncertainty: eqx.AbstractVar[Uncertainty]

    @abc.abstractmethod
    def __call__(self, case: Cases) -> Float[Array, ""]:
        """The nearness of one case."""

    @abc.abstractmethod
    def noise(self, case: Cases) -> Float[Array, "sample output"]:
        """The noise of a case's seed, in standard deviations."""


class OnPlant(AbstractExperiments):
    """Experiments of an excitation on the plants of a box.

    Attributes:
        uncertainty: the box.
        excitation: plays.
        num_steps: of an experiment.
    """

    uncertainty: Uncertainty
    excitation: AbstractExcitation
    num_steps: int = eqx.field(static=True)

    def __call__(self, case: Cases) -> Float[Array, ""]:
        """The nearness of one case."""
        return nearness(self.uncertainty.plant, self.outputs(case))

    def outputs(self, case: Cases) -> Float[Array, "sample output"]:
        """The true outputs of one case."""
        plant, params = self.uncertainty.at(case.point)
        key = jax.random.key(case.seed)
        run = run_episode(plant, params, self.excitation, self.num_steps, key, case.noise)
        return run.outputs

    def noise(self, case: Cases) -> Float[Array, "sample output"]:
        """The noise of a case's seed, in standard deviations."""
        return sensor_noise(self.uncertainty.plant, self.num_steps, jax.random.key(case.seed))


@dataclass(frozen=True)
class Effort:
    """How hard a search is.

    Attributes:
        random: plants drawn at random.
        corners: of the box, at most.
        noises: with which every corner is played.
        starts: of ascents, half from the worst cases so far, half drawn at random.
        steps: of each ascent.
        more_noises: with which the worst plant is played.
        searched_noises: of the worst cases, whose noise is searched too.
        noise_bound: of searched noise, in standard deviations.
    """

    random: int = 1000
    corners: int = 256
    noises: int = 8
    starts: int = 160
    steps: int = 40
    more_noises: int = 256
    searched_noises: int = 16
    noise_bound: float = 3.0

    @classmethod
    def of(cls, budget: int) -> Effort:
        """The usual effort, some 10,000 experiments, scaled to another number."""
        names = "random", "corners", "starts", "more_noises", "searched_noises"
        share = budget / 10_000
        return cls(**{name: max(1, round(share * getattr(cls, name))) for name in names})


@dataclass(frozen=True)
class Stage:
    """One part of a search.

    Attributes:
        name: what was searched.
        experiments: number simulated.
        violations: of these.
        nearness: the largest.
    """

    name: str
    experiments: int
    violations: int
    nearness: float


@dataclass(frozen=True)
class Found:
    """What a search found.

    Attributes:
        stages: in their order.
        worst: the worst case with the noise of a seed.
        worst_noise: the worst case with searched noise; None where noise was not searched.
    """

    stages: tuple[Stage, ...]
    worst: Cases
    worst_noise: Cases | None


def search(
    play: AbstractExperiments,
    effort: Effort,
    seed: int,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Found:
    """Searches the plants of a box for the one that comes nearest to a level.

    Args:
        play: the experiments.
        effort: how hard.
        seed: of the search.
        progress: called with a stage, how many of its experiments are done, and their number.
    """
    box, keys = play.uncertainty, jax.random.split(jax.random.key(seed), 7)
    stages, seen = list[Stage](), list[tuple[Cases, np.ndarray]]()

    def add(name: str, cases: Cases, sizes: np.ndarray, count: int, violations: int) -> None:
        stages.append(Stage(name, count, violations, float(sizes.max())))
        seen.append((jax.device_get(cases), sizes))

    def play_all(name: str, cases: Cases) -> None:
        sizes = _played(play, cases, lambda *done: progress(name, *done))
        add(name, cases, sizes, len(sizes), int(np.sum(sizes >= 1)))

    def worst(count: int) -> Cases:
        cases = _joined(*(found for found, _ in seen))
        order = np.argsort(np.concatenate([sizes for _, sizes in seen]))[::-1][:count]
        return jax.device_put(jax.tree.map(lambda leaf: leaf[order], cases))

    def climb(name: str, cases: Cases, bound: float = 0.0) -> None:
        top, sizes, violations = _climbed(
            play, cases, effort.steps, bound, lambda *done: progress(name, *done)
        )
        add(name, top, sizes, effort.steps * len(sizes), violations)

    drawn = jax.vmap(box.draw)(jax.random.split(keys[0], effort.random))
    play_all("random plants", Cases(drawn, _seeds(keys[1], effort.random)))
    corners = jnp.repeat(box.corners(keys[2], effort.corners), effort.noises, axis=0)
    play_all("corners of the box", Cases(corners, _seeds(keys[3], len(corners))))
    fresh = effort.starts // 2
    points = jax.vmap(box.draw)(jax.random.split(keys[4], fresh))
    starts = _joined(worst(effort.starts - fresh), Cases(points, _seeds(keys[6], fresh)))
    climb("ascents", starts)
    many = jnp.repeat(worst(1).point, effort.more_noises, axis=0)
    play_all("more noise on the worst plant", Cases(many, _seeds(keys[5], len(many))))
    end = worst(1)
    if not effort.searched_noises:
        return Found(tuple(stages), end, None)
    chosen, bound = worst(effort.searched_noises), effort.noise_bound
    noise = jnp.clip(jax.vmap(play.noise)(chosen), -bound, bound)
    seen.clear()
    climb(f"noise within {bound:g} sd", Cases(chosen.point, chosen.seed, noise), bound)
    return Found(tuple(stages), end, worst(1))


def _seeds(key: PRNGKeyArray, count: int) -> Int[Array, " case"]:
    return jax.random.randint(key, (count,), 0, 2**31 - 1)


def _joined(*parts: Cases) -> Cases:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def _chunks(cases: Cases, progress: Callable[[int, int], None]) -> Iterator[tuple[Cases, int]]:
    """Parts of one size, so that one program is compiled; the last is filled up with its end."""
    count = len(cases.seed)
    size = _CHUNKS[count > _CHUNKS[0]]
    for first in range(0, count, size):
        progress(first, count)
        rows = np.minimum(np.arange(first, first + size), count - 1)
        yield jax.tree.map(lambda leaf, rows=rows: leaf[rows], cases), min(size, count - first)
    progress(count, count)


@eqx.filter_jit
def _play_chunk(play: AbstractExperiments, cases: Cases) -> Float[Array, " case"]:
    return jax.vmap(play)(cases)


def _played(
    play: AbstractExperiments, cases: Cases, progress: Callable[[int, int], None]
) -> Float[np.ndarray, " case"]:
    """The nearness of every case."""
    parts = [np.asarray(_play_chunk(play, c))[:n] for c, n in _chunks(cases, progress)]
    return np.concatenate(parts)


def climbed(
    play: Callable[[Cases], Float[Array, ""]],
    first: Cases,
    num_steps: int,
    bound: Array | float = 0.0,
    decay: float = 0.93,
) -> tuple[Cases, Float[Array, ""], Int[Array, ""]]:
    """An ascent of the nearness by projected sign gradients, from one case.

    Args:
        play: nearness of a case.
        first: where the ascent begins.
        num_steps: of the ascent, and experiments.
        bound: of the case's noise, in standard deviations.
        decay: of the step, which begins with a quarter of the box's half width.

    Returns:
        The nearest case, its nearness, and how many of the experiments violate.
    """

    def advance(carry: tuple, i: Array) -> tuple[tuple, None]:
        case, best, top, over = carry
        moving, rest = eqx.partition(case, eqx.is_inexact_array)
        size, slope = jax.value_and_grad(lambda m: play(eqx.combine(m, rest)))(moving)
        best = jax.tree.map(lambda new, old: jnp.where(size > top, new, old), case, best)
        reach = _FIRST_STEP * decay**i
        signs = jax.tree.map(lambda g: jnp.sign(jnp.where(jnp.isfinite(g), g, 0.0)), slope)
        point, noise = jnp.clip(case.point + reach * signs.point, -1, 1), case.noise
        if noise is not None:
            noise = jnp.clip(noise + reach * bound * signs.noise, -bound, bound)
        now = Cases(point, case.seed, noise)
        return (now, best, jnp.maximum(top, size), over + (size >= 1)), None

    start = first, first, jnp.asarray(-jnp.inf), jnp.asarray(0)
    (_, best, top, over), _ = jax.lax.scan(advance, start, jnp.arange(num_steps))
    return best, top, over


@eqx.filter_jit
def _climb_chunk(play: AbstractExperiments, cases: Cases, num_steps: int, bound: Array) -> tuple:
    return jax.vmap(lambda first: climbed(play, first, num_steps, bound))(cases)


def _climbed(
    play: AbstractExperiments,
    cases: Cases,
    num_steps: int,
    bound: float,
    progress: Callable[[int, int], None],
) -> tuple[Cases, Float[np.ndarray, " case"], int]:
    """Ascents from all cases; the count of violations is that of all their experiments."""
    tops, sizes, over = [], [], 0
    for part, n in _chunks(cases, progress):
        best, top, violations = _climb_chunk(play, part, num_steps, jnp.asarray(bound))
        tops.append(jax.tree.map(lambda leaf, n=n: leaf[:n], best))
        sizes.append(np.asarray(top)[:n])
        over += int(np.sum(np.asarray(violations)[:n]))
    return _joined(*tops), np.concatenate(sizes), over
