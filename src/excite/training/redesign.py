"""The next signal, for what is known of the parameters already.

A robust signal is designed for a spread of plants; this one for those that the records leave
possible (sequential design: L. Pronzato, A. Pazman, Design of Experiments in Nonlinear Models,
2013, chapter 8). They are represented by the estimate and by plants around it, on the ellipsoid
that holds the parameters with a probability of 99.9 %. The signal is as informative as can be on
average over some of them, and safe for all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from scipy.stats import chi2

from ..environment.falsification import nearness
from ..information import Past, Start, experiment_information, start_after
from ..plant import AbstractPlant, Params
from ..safety import about_to_reach, critical_levels, safe_input
from ..simulation import response
from .gradient import GradientSettings, mean_excess, optimiser
from .signals import random_sines

HELD = 0.999  # probability of the ellipsoid
POINTS, JUDGES = 12, 66  # around the estimate: of the criterion, and of the line search
SAFE = 0.97  # of the critical level: largest output that is allowed

SEARCH = GradientSettings(num_updates=100, learning_rate=0.15, margin=0.95, penalty_weight=100.0)

_STARTS = 2  # of the search
_FACTORS = np.concatenate([np.linspace(1.15, 0.8, 15), np.geomspace(0.75, 0.02, 12)])


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
        nearness: largest output over its critical level on the plants, coast included; at least
            one where a supervisor would predict that one of them reaches it, without noise.
    """

    inputs: Float[Array, "round time input"]
    shares: Float[Array, " start"]
    nearness: Float[Array, ""]


def first_signals(
    plant: AbstractPlant, num_rounds: int, num_steps: int, seed: int = 0
) -> Float[Array, "start round time input"]:
    """Where a search begins: sums of sines with random phases, of the usual amplitude."""
    keys = jax.random.split(jax.random.key(seed), (_STARTS, num_rounds))
    return half_as_large(plant, jax.vmap(jax.vmap(partial(random_sines, plant, num_steps)))(keys))


def half_as_large(
    plant: AbstractPlant, shapes: Float[Array, "*start time input"]
) -> Float[Array, "*start time input"]:
    """Signals of shapes between -1 and 1, around the middle, with half of the usual amplitude."""
    usual = jnp.asarray([i.amplitude for i in plant.definition.inputs])
    middle, _ = _range(plant, shapes)
    return middle + 0.5 * usual.reshape(middle.shape) * shapes


@eqx.filter_jit
def redesigned(
    plant: AbstractPlant,
    region: Region,
    asked: Float[Array, "goal param"],
    starts: Float[Array, "start round time input"],
    coast: int,
    settings: GradientSettings = SEARCH,
    past: Past | None = None,
) -> Redesigned:
    """Signals of the coming rounds that bring the parameters to their goals.

    Each round begins at rest, or the only one where another experiment has come to.

    The criterion is A-optimality in units of the goals: the logarithm of the root of the summed
    squares of standard deviation over goal, on average over the plants of the region
    (L-optimality in the parameters).

    Args:
        plant: with the sensor of the rounds.
        region: what is known before.
        asked: of each goal, the derivative of its quantity with respect to relative changes of the
            parameters, over the standard deviation that is to be reached.
        starts: of the search, side by side.
        coast: samples after a round's end in which it must be safe too.
        settings: of the search by Adam, and of its penalty of outputs near a level.
        past: what was played before the one round, in whose pause this signal is decided; None
            for rounds from rest.
    """
    safe, pause = jnp.asarray(safe_input(plant.definition)), 0 if past is None else past.pause
    before, rest = jnp.tile(safe, (pause, 1)), jnp.tile(safe, (coast, 1))

    def start(params: Params) -> Start | None:
        return None if past is None else start_after(plant, params, past)

    def begun(count: int) -> tuple[Params, Start | None]:
        """Plants of the region, and where each of them begins."""
        plants = region.plants(plant, count)
        return plants, jax.vmap(start)(plants)

    points, judges = begun(POINTS), begun(JUDGES)

    def uncertainty(
        params: Params, start: Start | None, inputs: Float[Array, "round time input"]
    ) -> Array:
        def information(own: Float[Array, "time input"]) -> Array:
            whole = jnp.concatenate([before, own])
            return experiment_information(plant, params, whole, start=start)

        gained = jax.vmap(information)(inputs)
        covariance = jnp.linalg.inv(region.information + jnp.sum(gained, axis=0))
        return 0.5 * jnp.log(jnp.einsum("gi,ij,gj->", asked, covariance, asked))

    def outputs(params: Params, start: Start | None, own: Float[Array, "time input"]) -> Array:
        state = None if start is None else start.state
        return response(plant, params, jnp.concatenate([before, own, rest]), state)

    def beyond(params: Params, start: Start | None, own: Float[Array, "time input"]) -> Array:
        return mean_excess(plant, outputs(params, start, own), settings.margin)

    def loss(inputs: Float[Array, "round time input"], _: None) -> tuple[Array, None]:
        unknown = jax.vmap(uncertainty, (0, 0, None))(*points, inputs)
        over = jax.vmap(jax.vmap(beyond, (None, None, 0)), (0, 0, None))(*points, inputs)
        return jnp.mean(unknown) + settings.penalty_weight * jnp.mean(over), None

    def size(params: Params, start: Start | None, own: Float[Array, "time input"]) -> Array:
        played = outputs(params, start, own)
        triples = jnp.stack([played[:-2], played[1:-1], played[2:]])
        is_tripped = jnp.any(about_to_reach(triples, critical_levels(plant.definition)[None]))
        return jnp.maximum(nearness(plant, played), is_tripped)

    def largest(inputs: Array) -> Array:
        return jnp.max(jax.vmap(jax.vmap(size, (None, None, 0)), (0, 0, None))(*judges, inputs))

    def from_start(start: Array) -> tuple[Array, Array, Array]:
        found = searched(plant, loss, start, None, settings)
        inputs, size = loudest_safe(plant, largest, found)
        unknown = jnp.mean(jax.vmap(uncertainty, (0, 0, None))(*points, inputs))
        return inputs, jnp.where(size < SAFE, jnp.exp(unknown), jnp.inf), size

    inputs, shares, sizes = jax.vmap(from_start)(starts)
    best = jnp.argmin(shares)
    return Redesigned(inputs[best], shares, sizes[best])


def searched(
    plant: AbstractPlant,
    loss: Callable[[Array, PyTree], tuple[Array, PyTree]],
    start: Float[Array, "*round time input"],
    carried: PyTree,
    settings: GradientSettings,
) -> Float[Array, "*round time input"]:
    """Inputs within the plant's limits for which a loss is small, by Adam.

    Args:
        plant: whose limits hold.
        loss: of the inputs, and of what is carried from update to update; it returns both.
        start: of the search, in the inputs' units.
        carried: by the first update.
        settings: of the search.
    """
    middle, half, adam = *_range(plant, start), optimiser(settings)
    latent = jnp.arctanh(jnp.clip((start - middle) / half, -0.98, 0.98))

    def of(latent: Array, carried: PyTree) -> tuple[Array, PyTree]:
        return loss(middle + half * jnp.tanh(latent), carried)

    def update(now: tuple, _: None) -> tuple[tuple, None]:
        latent, carried, state = now
        slope, carried = jax.grad(of, has_aux=True)(latent, carried)
        change, state = adam.update(slope, state)
        return (latent + change, carried, state), None

    begin = (latent, carried, adam.init(latent))
    (latent, _, _), _ = jax.lax.scan(update, begin, length=settings.num_updates)
    return middle + half * jnp.tanh(latent)


def loudest_safe(
    plant: AbstractPlant,
    largest: Callable[[Array], Float[Array, ""]],
    inputs: Float[Array, "*round time input"],
) -> tuple[Float[Array, "*round time input"], Float[Array, ""]]:
    """The inputs, made larger or smaller until they are just safe, and the nearness there.

    Args:
        plant: whose limits hold.
        largest: the largest output over its critical level under some inputs.
        inputs: in their units.
    """
    middle, half = _range(plant, inputs)
    factors = jnp.asarray(_FACTORS).reshape((-1,) + (1,) * inputs.ndim)
    scaled = jnp.clip(factors * ((inputs - middle) / half)[None], -1, 1)
    sizes = jax.lax.map(lambda own: largest(middle + half * own), scaled)
    first = jnp.argmax(sizes < SAFE)  # the largest factor that is safe
    return middle + half * scaled[first], sizes[first]


def _range(plant: AbstractPlant, inputs: Array) -> tuple[Array, Array]:
    """Middle and half of the inputs' limits, with the axes of some inputs."""
    lower, upper = (x.reshape((1,) * (inputs.ndim - 1) + (-1,)) for x in plant.input_limits)
    return (lower + upper) / 2, (upper - lower) / 2
