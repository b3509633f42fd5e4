"""A contrast by a network that learns which parameters belong to which record."""

from __future__ import annotations

import dataclasses
import math
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..plant import AbstractPlant, Params
from ..policy import Weights
from ..policy.contract import network
from ..safety import safe_input
from .contrast import AbstractFinalContrast
from .objective import StepData

_WIDTH, _SIZE = 64, 32  # of the hidden layers, and of what a record and a plant are encoded to


class Critic(eqx.Module):
    """Three networks; a record's code times that of some parameters is their score.

    Attributes:
        sample: encoder of a sample: the input, the measurement after it and when it was made.
        record: code of a record, from the sum of its encoded samples.
        params: code of the parameters, as coordinates of the prior.
    """

    sample: Weights
    record: Weights
    params: Weights

    @classmethod
    def of(cls, plant: AbstractPlant, key: PRNGKeyArray) -> Critic:
        """With random weights (X. Glorot, Y. Bengio, 2010)."""
        d, glorot = plant.definition, jax.nn.initializers.glorot_uniform()

        def weights(key: PRNGKeyArray, size: int) -> Weights:
            widths = size, _WIDTH, _WIDTH, _SIZE
            pairs = zip(jax.random.split(key, 3), widths, widths[1:], strict=False)
            return tuple(
                (glorot(own, (after, before), jnp.float32), jnp.zeros(after, jnp.float32))
                for own, before, after in pairs
            )

        sizes = len(d.inputs) + len(d.outputs) + 1, _SIZE, len(d.parameters)
        return cls(*map(weights, jax.random.split(key, 3), sizes))


class CriticMemory(eqx.Module):
    """The encoded record so far, and the other plants.

    Attributes:
        total: of the encoded samples.
        others: coordinates of the other plants.
        input: the last one.
    """

    total: Float[Array, " code"]
    others: Float[Array, "plant param"]
    input: Float[Array, " input"]


class CriticGain(AbstractFinalContrast):
    """A lower bound of the expected information gain in nats that needs no likelihood: InfoNCE.

    A critic, which is trained with the policy, scores how well parameters fit a record. The reward,
    at the last step, is the true plant's score less the logarithm of the mean exponential over it
    and `num_plants` others of the prior, at most log(num_plants + 1) (A. van den Oord et al., 2018;
    for policies D. Ivanova et al., Implicit deep adaptive design, NeurIPS 2021). It is a bound for
    any critic, and the closer the better the critic has learnt. By gradient only.

    With an `Env` of your own, it also serves tasks and plants without a likelihood, which
    `excite train` and studies refuse.

    Attributes:
        prior: of the parameters.
        num_steps: of an experiment.
        num_plants: that are compared with the true one.
        weight: factor of the reward.
        change_price: of the squared change of the input, subtracted at every step.
        critic: with which records are scored; without one, the reward is zero.
    """

    critic: Critic | None = None

    def first_trained(self, plant: AbstractPlant, key: PRNGKeyArray) -> Critic:
        """A critic that has learnt nothing."""
        return Critic.of(plant, key)

    def with_trained(self, trained: Critic | None) -> Self:
        """With this critic."""
        return dataclasses.replace(self, critic=trained)

    def init(
        self, plant: AbstractPlant, measured: Float[Array, " output"], key: PRNGKeyArray
    ) -> CriticMemory:
        """Nothing is measured of an input yet."""
        del measured
        others = jax.random.normal(key, (self.num_plants, len(plant.nominal)), float)
        rest = jnp.asarray(safe_input(plant.definition))
        return CriticMemory(jnp.zeros(_SIZE, jnp.float32), others, rest)

    def update(
        self, plant: AbstractPlant, memory: CriticMemory, sample: StepData, k: Int[Array, ""]
    ) -> tuple[CriticMemory, Float[Array, ""]]:
        """One more sample is encoded."""
        cost = self.change_price * jnp.sum((sample.input - memory.input) ** 2)
        if self.critic is None:
            return dataclasses.replace(memory, input=sample.input), -cost
        lower, upper = plant.input_limits
        scales = jnp.array([o.scale for o in plant.definition.outputs])
        parts = (
            (2 * sample.input - lower - upper) / (upper - lower),
            sample.measured / scales,
            jnp.asarray(k / self.num_steps)[None],
        )
        shown = jnp.concatenate(parts).astype(jnp.float32)
        encoded = network(jnp, self.critic.sample, shown)
        total = memory.total + encoded / math.sqrt(self.num_steps)
        return CriticMemory(total, memory.others, sample.input), -cost

    def final(self, plant: AbstractPlant, memory: CriticMemory, params: Params) -> Float[Array, ""]:
        """The bound."""
        del plant
        scores = self._scores(memory, params)
        others = jax.nn.logsumexp(scores) - math.log(len(scores))
        return self.weight * (scores[-1] - others)

    def relative_errors(
        self, plant: AbstractPlant, memory: CriticMemory, params: Params
    ) -> Float[Array, " param"]:
        """Root mean square of the compared plants' relative differences, by their scores."""
        del plant
        true = jnp.stack(params)
        others = jax.vmap(lambda z: jnp.stack(self.prior.params(z)))(memory.others)
        probable = jax.nn.softmax(self._scores(memory, params)[:-1])
        return jnp.sqrt(probable @ ((others - true[None]) / true[None]) ** 2)

    def _scores(self, memory: CriticMemory, params: Params) -> Float[Array, " compared"]:
        """Of the other plants and, last, of the true one; zero without a critic."""
        z = jnp.concatenate([memory.others, self.prior.coordinates(params)[None]])
        if (critic := self.critic) is None:
            return jnp.zeros(len(z))
        codes = jax.vmap(lambda own: network(jnp, critic.params, own))(z.astype(jnp.float32))
        return (codes @ network(jnp, critic.record, memory.total)).astype(float)
