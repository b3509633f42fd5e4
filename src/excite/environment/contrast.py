"""How much likelier an experiment's outcomes make the true plant than others of the prior."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from ..description import require_whole
from ..estimation.prior import PriorPlants
from ..plant import AbstractPlant, Params
from ..plant.fields import floats
from ..plant.static import AbstractStaticTask
from ..safety import safe_input
from ..simulation import log_likelihood, require_likelihood, step
from .objective import AbstractObjective, StepData

IMPOSSIBLE = -1e6
"""Logarithm of a likelihood where it is smaller, or not a number."""


@jax.custom_vjp
def with_finite_gradient(value: PyTree) -> PyTree:
    """The same value; what is not finite of its gradient is zero."""
    return value


with_finite_gradient.defvjp(
    lambda value: (value, None),
    lambda _, slope: (jax.tree.map(lambda g: jnp.where(jnp.isfinite(g), g, 0.0), slope),),
)


class AbstractFinalContrast(AbstractObjective):
    """A comparison of the true plant with others that is rewarded at the last step.

    Attributes:
        prior: of the parameters.
        num_steps: of an experiment.
        num_plants: that are compared with the true one.
        weight: factor of the reward.
        change_price: of the squared change of the input, subtracted at every step.
    """

    prior: PriorPlants
    num_steps: int = eqx.field(static=True)
    num_plants: int = eqx.field(static=True, default=255)
    weight: Float[Array, ""] = eqx.field(converter=floats, default=1.0)
    change_price: Float[Array, ""] = eqx.field(converter=floats, default=0.0)

    def __check_init__(self) -> None:
        """Raises ValueError without another plant, or a step."""
        require_whole("num_plants", self.num_plants, 1)
        require_whole("num_steps", self.num_steps, 1)

    def require_steps(self, num_steps: int) -> None:
        """Raises ValueError for experiments of another length."""
        if self.num_steps != num_steps:
            raise ValueError(
                f"the objective is for {self.num_steps} steps: got experiments of {num_steps}"
            )


class ContrastMemory(eqx.Module):
    """The other plants, and what the outcomes so far tell.

    Attributes:
        params: of the other plants.
        states: of these under the same inputs.
        log_likelihoods: of the outcomes so far; the true plant's is the last.
        value: the bound at the last reward [nats].
        input: the last one.
    """

    params: Params
    states: Float[Array, "plant state"]
    log_likelihoods: Float[Array, " compared"]
    value: Float[Array, ""]
    input: Float[Array, " input"]


class ContrastiveGain(AbstractObjective):
    """A lower bound of the expected information gain in nats: sPCE.

    The likelihood of the outcomes for the true plant, over its mean for this one and `num_plants`
    others of the prior, which are drawn for every experiment (sequential prior contrastive
    estimation; A. Foster et al., Deep adaptive design, ICML 2021). It needs no approximation of
    the posterior, and no derivative of the plant by its parameters, and is at most
    log(num_plants + 1). Outcomes that jump (answers, counts) have no gradient for it.

    Attributes:
        prior: of the parameters.
        num_plants: that are compared with the true one.
        weight: factor of the reward.
        dense: whether every step is rewarded by its increment, or the last by the total
            (T. Blau et al., Optimizing sequential experimental design with deep reinforcement
            learning, ICML 2022).
        change_price: of the squared change of the input, subtracted at every step.
    """

    prior: PriorPlants
    num_plants: int = eqx.field(static=True, default=255)
    weight: Float[Array, ""] = eqx.field(converter=floats, default=1.0)
    dense: bool = eqx.field(static=True, default=True)
    change_price: Float[Array, ""] = eqx.field(converter=floats, default=0.0)

    def __check_init__(self) -> None:
        """Raises ValueError without another plant."""
        require_whole("num_plants", self.num_plants, 1)

    def init(
        self, plant: AbstractPlant, measured: Float[Array, " output"], key: PRNGKeyArray
    ) -> ContrastMemory:
        """Other plants at the initial state, which is known."""
        del measured
        count = self.num_plants
        params = jax.vmap(self.prior.draw)(jax.random.split(key, count))
        states = jnp.broadcast_to(plant.initial_state, (count, len(plant.initial_state)))
        rest = jnp.asarray(safe_input(plant.definition))
        return ContrastMemory(params, states, jnp.zeros(count + 1), jnp.zeros(()), rest)

    def update(
        self, plant: AbstractPlant, memory: ContrastMemory, sample: StepData, k: Int[Array, ""]
    ) -> tuple[ContrastMemory, Float[Array, ""]]:
        """The likelihood of one more outcome, for every plant."""
        del k
        by_steps = isinstance(plant, AbstractStaticTask) or require_likelihood(plant)

        def likely(
            state: Array, params: Params, true_state: Array, input: Array, measured: Array
        ) -> tuple[Array, Array]:
            if by_steps:
                return state, log_likelihood(plant, measured, true_state, input, params)
            after = step(plant, state, input, params)
            misses = (measured - plant.output(after, params)) / plant.sensor.sd
            return jnp.where(jnp.all(jnp.isfinite(after)), after, state), -0.5 * jnp.sum(misses**2)

        made = sample.state, sample.input, sample.measured
        shape = (self.num_plants,)
        # Of a plant that cannot be computed, nothing is learnt: not even a gradient.
        of_each = [jnp.broadcast_to(value, shape + value.shape) for value in made]
        before, of_each = with_finite_gradient((memory.states, of_each))
        states, of_others = jax.vmap(likely)(before, memory.params, *of_each)
        own = likely(sample.state, sample.params, *made)[1]
        found = jnp.append(of_others, own)
        found = jnp.where(found > IMPOSSIBLE, found, IMPOSSIBLE)  # also for NaN
        total = memory.log_likelihoods + found
        cost = self.change_price * jnp.sum((sample.input - memory.input) ** 2)
        value = self._bound(total) if self.dense else memory.value
        gain = self.weight * (value - memory.value) - cost
        return ContrastMemory(memory.params, states, total, value, sample.input), gain

    def final(
        self, plant: AbstractPlant, memory: ContrastMemory, params: Params
    ) -> Float[Array, ""]:
        """The bound, unless it was rewarded at every step."""
        del plant, params
        return jnp.zeros(()) if self.dense else self.weight * self._bound(memory.log_likelihoods)

    def relative_errors(
        self, plant: AbstractPlant, memory: ContrastMemory, params: Params
    ) -> Float[Array, " param"]:
        """Root mean square of the compared plants' relative differences, by their probability.

        Too small where the outcomes tell so much that none of these plants is as probable as the
        true one.
        """
        del plant
        probable = jax.nn.softmax(memory.log_likelihoods)[:-1]
        differences = jnp.stack(memory.params) - jnp.stack(params)[:, None]
        return jnp.sqrt(differences**2 @ probable) / jnp.abs(jnp.stack(params))

    def _bound(self, log_likelihoods: Float[Array, " compared"]) -> Float[Array, ""]:
        others = jax.nn.logsumexp(log_likelihoods) - math.log(self.num_plants + 1)
        return log_likelihoods[-1] - others
