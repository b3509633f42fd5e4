"""The next signal, for what is known of the parameters already.

A robust signal is designed for a spread of plants; this one for those that the records leave
possible (sequential design: L. Pronzato, A. Pazman, Design of Experiments in Nonlinear Models,
2013, chapter 8). They are represented by the estimate and by plants around it, on the ellipsoid
that holds the parameters with a probability of 99.9 %. The signal is as informative as can be on
average over some of them, and safe for all.
"""

from __future__ import annotations

import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import chi2

from ..environment.falsification import nearness
from ..information import experiment_information
from ..plant import AbstractPlant, Params
from ..safety import safe_input
from ..simulation import response
from .gradient import GradientSettings, mean_excess, optimiser
from .signals import random_sines

HELD = 0.999  # probability of the ellipsoid
POINTS, JUDGES = 12, 66  # around the estimate: of the criterion, and of the line search
SAFE = 0.97  # of the critical level: largest output that is allowed

SEARCH = GradientSettings(num_updates=100, learning_rate=0.15, margin=0.95, penalty_weight=100.0)

_STARTS = 2  # of the search
FACTORS = np.concatenate([np.linspace(1.15, 0.8, 15), np.geomspace(0.75, 0.02, 12)])


class Region(eqx.Module):
    """What is known of a plant's parameters: an estimate and its information.

    Attributes:
        center: the estimate, in the parameters' units.
        information: relative Fisher information of records and prior together.
    """

    center: Float[Array, " param"]
    information: Float[Array, "param param"]

    def plants(self, plant: AbstractPlant, count: int) -> Params:
        """The estimate, and `count` plants on the ellipsoid; fields have an axis of plants.

        The first lie on its axes, to both sides, the others in directions that never change.
        """
        size = len(self.center)
        values, axes = jnp.linalg.eigh(self.information)
        radius = math.sqrt(chi2.ppf(HELD, size)) / jnp.sqrt(values)
        drawn = jax.random.normal(jax.random.key(0), (count, size))
        drawn = drawn / jnp.linalg.norm(drawn, axis=1)[:, None]
        middle = jnp.zeros((1, size))
        units = jnp.concatenate([middle, jnp.eye(size), -jnp.eye(size), drawn])[: count + 1]
        changes = (units * radius[None]) @ axes.T
        moved = []
        for i, parameter in enumerate(plant.definition.parameters):
            middle, change = self.center[i], changes[:, i]
            if parameter.positive:
                moved.append(middle * jnp.exp(change))
            else:
                lower, upper = parameter.support
                moved.append(jnp.clip(middle + parameter.scale * change, lower, upper))
        return plant.Params(*moved)


class Redesigned(eqx.Module):
    """The best safe signals of a search.

    Attributes:
        inputs: of each of the coming rounds, in the inputs' units; the first is to be played.
        shares: of every start, the mean over plants of how uncertain the parameters would be
            after all of these rounds, over the goals (root of the sum of squares).
        nearness: largest output over its critical level on the plants, coast included.
    """

    inputs: Float[Array, "round time input"]
    shares: Float[Array, " start"]
    nearness: Float[Array, ""]


def first_signals(
    plant: AbstractPlant, num_rounds: int, num_steps: int, seed: int = 0
) -> Float[Array, "start round time input"]:
    """Where a search begins: sums of sines with random phases, of the usual amplitude."""
    keys = jax.random.split(jax.random.key(seed), (_STARTS, num_rounds))
    usual = np.array([i.amplitude for i in plant.definition.inputs])[None, None, None]
    shapes = jax.vmap(jax.vmap(partial(random_sines, plant, num_steps)))(keys)
    lower, upper = (x[None, None, None] for x in plant.input_limits)
    return (lower + upper) / 2 + 0.5 * usual * shapes


@eqx.filter_jit
def redesigned(
    plant: AbstractPlant,
    region: Region,
    goals: Float[Array, " param"],
    starts: Float[Array, "start round time input"],
    coast: int,
    settings: GradientSettings = SEARCH,
) -> Redesigned:
    """Signals of the coming rounds, each from rest, that bring the parameters to their goals.

    The criterion is A-optimality in units of the goals: the logarithm of the root of the summed
    squares of standard deviation over goal, on average over the plants of the region.

    Args:
        plant: with the sensor of the rounds.
        region: what is known before.
        goals: relative standard deviation of each parameter; infinite for one that is not asked.
        starts: of the search, side by side.
        coast: samples after a round's end in which it must be safe too.
        settings: of the search by Adam, and of its penalty of outputs near a level.
    """
    lower, upper = (x[None, None] for x in plant.input_limits)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    rest = jnp.tile(jnp.asarray(safe_input(plant.definition)), (coast, 1))
    points, judges = region.plants(plant, POINTS), region.plants(plant, JUDGES)

    def uncertainty(params: Params, inputs: Float[Array, "round time input"]) -> Array:
        gained = jax.vmap(lambda own: experiment_information(plant, params, own))(inputs)
        variance = jnp.diagonal(jnp.linalg.inv(region.information + jnp.sum(gained, axis=0)))
        return 0.5 * jnp.log(jnp.sum(variance / goals**2))

    def outputs(params: Params, own: Float[Array, "time input"]) -> Array:
        return response(plant, params, jnp.concatenate([own, rest]))

    def beyond(params: Params, own: Float[Array, "time input"]) -> Array:
        return mean_excess(plant, outputs(params, own), settings.margin)

    def loss(latent: Array) -> Array:
        inputs = middle + half * jnp.tanh(latent)
        unknown = jax.vmap(uncertainty, (0, None))(points, inputs)
        over = jax.vmap(jax.vmap(beyond, (None, 0)), (0, None))(points, inputs)
        return jnp.mean(unknown) + settings.penalty_weight * jnp.mean(over)

    adam = optimiser(settings)

    def search(inputs: Array) -> Array:
        latent = jnp.arctanh(jnp.clip((inputs - middle) / half, -0.98, 0.98))

        def update(now: tuple, _: None) -> tuple[tuple, None]:
            latent, state = now
            change, state = adam.update(jax.grad(loss)(latent), state)
            return (latent + change, state), None

        length = settings.num_updates
        (latent, _), _ = jax.lax.scan(update, (latent, adam.init(latent)), length=length)
        return jnp.tanh(latent)

    def largest(inputs: Array) -> Array:
        def of(own: Array) -> Array:
            return jax.vmap(lambda params: nearness(plant, outputs(params, own)))(judges)

        return jnp.max(jax.vmap(of)(inputs))

    def line_search(actions: Array) -> tuple[Array, Array, Array]:
        scaled = jnp.clip(jnp.asarray(FACTORS)[:, None, None, None] * actions[None], -1, 1)
        sizes = jax.lax.map(lambda own: largest(middle + half * own), scaled)
        first = jnp.argmax(sizes < SAFE)  # the largest factor that is safe
        inputs = middle + half * scaled[first]
        unknown = jnp.mean(jax.vmap(uncertainty, (0, None))(points, inputs))
        return inputs, jnp.where(sizes[first] < SAFE, jnp.exp(unknown), jnp.inf), sizes[first]

    inputs, shares, sizes = jax.vmap(lambda own: line_search(search(own)))(starts)
    best = jnp.argmin(shares)
    return Redesigned(inputs[best], shares, sizes[best])
