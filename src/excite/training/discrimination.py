"""The signal that tells rival plants apart.

Two rivals are as far apart as the outputs of a plant of one are from those of the nearest plant
of the other, in standard deviations of the noise (T-optimality: A. Atkinson, V. Fedorov, The
design of experiments for discriminating between two rival models, 1975). The nearest plant is
searched again for every signal, and what earlier records tell of it counts.

The rival with the largest evidence is the wrong one with a probability of at most the sum over
all pairs of sqrt(p_i p_j) exp(-D_ij / 8), with their probabilities p before and the squared
distance D (T. Kailath, The divergence and Bhattacharyya distance measures in signal selection,
1967). This holds for two plants that are known. For two boxes it is an estimate, the mean over a
few plants of each. The signal makes it small, and is safe for plants of all rivals.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..environment.falsification import nearness
from ..estimation.evidence import Fit, Rival, nearest, probabilities
from ..excitation import Chirp, Square
from ..plant import AbstractPlant
from ..safety import safe_input
from .gradient import GradientSettings, mean_excess
from .redesign import JUDGES, SAFE, half_as_large, loudest_safe, searched
from .redesign import SEARCH as REDESIGN
from .signals import random_sines

SEARCH = dataclasses.replace(REDESIGN, num_updates=40)

_PLANTS, _WATCHED = 4, 12  # of each rival: of the bound, and of the penalty
_WIDE = 4.0  # standard deviations up to which a plant is possible, for safety
_STEPS = 20  # of the last search for the nearest plants
_SINES = 4  # sums of sines from which the search begins


class Discriminating(eqx.Module):
    """The best safe signal of a search.

    Attributes:
        inputs: in the inputs' units.
        log_bounds: of every start, the logarithm of the bound; infinite where no safe signal was
            found.
        nearness: largest output over its critical level, on plants of all rivals, coast included.
    """

    inputs: Float[Array, "time input"]
    log_bounds: Float[Array, " start"]
    nearness: Float[Array, ""]


def first_signals(
    plant: AbstractPlant, num_steps: int, seed: int = 0
) -> Float[Array, "start time input"]:
    """Where a search begins: sums of sines, one of them soft, a chirp, a square wave and a step.

    What acts near zero, such as a dead zone, shows in a soft signal, and a lag in a step.
    """
    keys = jax.random.split(jax.random.key(seed), _SINES)
    sines = jax.vmap(lambda key: random_sines(plant, num_steps, key))(keys)
    waves = [kind.shape(plant, num_steps, keys[0]) for kind in (Chirp(), Square())]
    step = jnp.ones_like(sines[0])
    shapes = jnp.concatenate([sines, 0.1 * sines[:1], jnp.stack([*waves, step])])
    return half_as_large(plant, shapes)


def error_bound(probabilities: Float[Array, " rival"]) -> Float[Array, ""]:
    """The bound before an experiment, or the probability that the likeliest rival is wrong."""
    pairs = (jnp.sum(jnp.sqrt(probabilities)) ** 2 - 1) / 2
    return jnp.minimum(pairs, 1 - jnp.max(probabilities))


@eqx.filter_jit
def discriminating(
    rivals: Sequence[Rival],
    fits: Sequence[Fit],
    starts: Float[Array, "start time input"],
    coast: int,
    settings: GradientSettings = SEARCH,
) -> Discriminating:
    """A signal, played from rest, that tells rivals apart and is safe for the plants of all.

    Args:
        rivals: with the same inputs and outputs, and the sensor of the experiment.
        fits: what is known of each.
        starts: of the search, side by side.
        coast: samples after the experiment in which it must be safe too.
        settings: of the search by Adam, and of its penalty of outputs near a level.
    """
    first = rivals[0].box.plant
    rest = jnp.tile(jnp.asarray(safe_input(first.definition)), (coast, 1))
    plants = [_possible(fit, _PLANTS) for fit in fits]
    judges = [_possible(fit, JUDGES, _WIDE) for fit in fits]
    log_p = jnp.log(probabilities(fits))
    others = [[j for j in range(len(rivals)) if j != i] for i in range(len(rivals))]

    def seen(rival: Rival, z: Array, inputs: Array) -> Array:
        outputs = jax.vmap(rival.response, (0, None))(z, inputs)
        return (outputs / first.sensor.sd[None, None]).reshape(len(z), -1)

    def targets(inputs: Array) -> list[Array]:
        """For each rival, the outputs of the others' plants."""
        all_seen = [seen(r, z, inputs) for r, z in zip(rivals, plants, strict=True)]
        return [jnp.concatenate([all_seen[j] for j in own]) for own in others]

    def told_apart(inputs: Array, starts: list[Array], num_steps: int) -> tuple[Array, list[Array]]:
        """The bound's logarithm, and for each rival its plants nearest to those of the others.

        The slope leaves out that the nearest plants move: there the distance is smallest.
        """
        outputs = targets(inputs)
        fixed, own = jax.lax.stop_gradient((outputs, inputs))

        def of(rival: Rival, fit: Fit, target: Array, start: Array) -> Array:
            def residual(z: Array) -> Array:
                return seen(rival, z[None], own)[0] - target

            return nearest(residual, fit, start, num_steps)[0]

        near = [
            jax.vmap(of, (None, None, 0, 0))(*each)
            for each in zip(rivals, fits, fixed, starts, strict=True)
        ]
        terms = []
        for i, target in enumerate(outputs):
            change = near[i] - fits[i].z[None]
            before = jnp.einsum("pi,ij,pj->p", change, fits[i].information, change)
            D = before + jnp.sum((seen(rivals[i], near[i], inputs) - target) ** 2, axis=1)
            pair = (log_p[i] + log_p[jnp.array(others[i])]) / 2
            terms.append(jnp.repeat(pair, _PLANTS) - D / 8)
        return jax.nn.logsumexp(jnp.concatenate(terms)) - math.log(2 * _PLANTS), near

    def outputs(inputs: Array, count: int) -> Array:
        """Of possible plants of all rivals, coast included."""
        whole = jnp.concatenate([inputs, rest])
        return jnp.concatenate(
            [
                jax.vmap(rival.response, (0, None))(z[:count], whole)
                for rival, z in zip(rivals, judges, strict=True)
            ]
        )

    def beyond(inputs: Array) -> Array:
        over = jax.vmap(lambda own: mean_excess(first, own, settings.margin))
        return jnp.mean(over(outputs(inputs, _WATCHED)))

    def largest(inputs: Array) -> Array:
        return jnp.max(jax.vmap(lambda own: nearness(first, own))(outputs(inputs, JUDGES)))

    def loss(inputs: Array, near: list[Array]) -> tuple[Array, list[Array]]:
        log_bound, near = told_apart(inputs, near, 1)
        return log_bound + settings.penalty_weight * beyond(inputs), near

    unmoved = [
        jnp.tile(fit.z, (_PLANTS * len(own), 1)) for fit, own in zip(fits, others, strict=True)
    ]

    def from_start(start: Array) -> tuple[Array, Array, Array]:
        found = searched(first, loss, start, unmoved, settings)
        inputs, size = loudest_safe(first, largest, found)
        log_bound, _ = told_apart(inputs, unmoved, _STEPS)
        return inputs, jnp.where(size < SAFE, log_bound, jnp.inf), size

    inputs, log_bounds, sizes = jax.vmap(from_start)(starts)
    best = jnp.argmin(log_bounds)
    return Discriminating(inputs[best], log_bounds, sizes[best])


def _possible(
    fit: Fit, count: int, distance: float | None = None
) -> Float[Array, "plant quantity"]:
    """Plants that are possible: the best fit, and others drawn around it.

    They are drawn from the normal distribution of the fit, or lie at this distance in standard
    deviations, the first of them on the axes.
    """
    size = len(fit.z)
    values, axes = jnp.linalg.eigh(fit.information)
    units = jax.random.normal(jax.random.key(0), (count, size))
    if distance is not None:
        units = units / jnp.linalg.norm(units, axis=1)[:, None]
        units = distance * jnp.concatenate([jnp.eye(size), -jnp.eye(size), units])
    units = jnp.concatenate([jnp.zeros((1, size)), units])[:count]
    return fit.z[None] + (units / jnp.sqrt(values)[None]) @ axes.T
