"""The information gained by an experiment, as a reward at every step or at the end."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..estimation.prior import PriorPlants
from ..information import relative_size
from ..plant import AbstractPlant, Params
from ..plant.fields import floats
from ..safety import safe_input
from .objective import (
    MAX_SENSITIVITY,
    AbstractObjective,
    Knowledge,
    StepData,
    next_knowledge,
    prior_knowledge,
)


class InformationMemory(Knowledge):
    """The information so far, the criterion at the last reward, and the last input."""

    value: Float[Array, ""]
    input: Float[Array, " input"]


class InformationGain(AbstractObjective):
    """Dense reward: the increment of log det of the Fisher information at every step.

    The information is relative (logarithms of positive parameters) and begins with that
    of the prior, so that the sum over an episode is the gain of the experiment over the
    prior. Parameters that are not targets are eliminated first
    (D_s-optimality; A. Atkinson, A. Donev, R. Tobias, Optimum Experimental Designs, 2007).
    Sensitivities are computed with the state, by one directional derivative per parameter.

    Attributes:
        targets: which parameters are rewarded.
        prior_sd: standard deviation of each relative parameter before the experiment.
        weight: factor of the reward.
        criterion: of the targets' covariance bound: minus the logarithm of its determinant
            (`D`), of its trace (`A`), or of its largest eigenvalue (`E`).
        dense: whether every step is rewarded by its increment, or the last by the total.
        max_sensitivity: larger ones are scaled down, see MAX_SENSITIVITY.
        prior: of the parameters, in place of `prior_sd`. With the weight one half and the criterion
            D, the total is the information gained in nats, by the posterior's normal
            approximation; for each uniform prior up to 0.18 nats more, because the approximation
            takes a normal one of the same standard deviation.
        change_price: of the squared change of the input, subtracted at every step.
    """

    targets: tuple[bool, ...] = eqx.field(static=True)
    prior_sd: Float[Array, ""] = eqx.field(converter=floats)
    weight: Float[Array, ""] = eqx.field(converter=floats, default=1.0)
    criterion: str = eqx.field(static=True, default="D")
    dense: bool = eqx.field(static=True, default=True)
    max_sensitivity: Float[Array, ""] = eqx.field(converter=floats, default=MAX_SENSITIVITY)
    prior: PriorPlants | None = None
    change_price: Float[Array, ""] = eqx.field(converter=floats, default=0.0)

    def __check_init__(self) -> None:
        """Raises ValueError for an unknown criterion."""
        if self.criterion not in ("D", "A", "E"):
            raise ValueError(f"criterion must be D, A or E: got {self.criterion!r}")

    def init(
        self, plant: AbstractPlant, measured: Float[Array, " output"], key: PRNGKeyArray
    ) -> InformationMemory:
        """The prior's information; the initial state is known."""
        del measured, key
        sd = 1.0 if self.prior is not None else self.prior_sd
        known = prior_knowledge(plant, len(self.targets), jnp.asarray(sd))
        rest = jnp.asarray(safe_input(plant.definition))
        value = jnp.zeros(()) if self.prior is not None else self._value(known[1])
        return InformationMemory(*known, value, rest)

    def update(
        self, plant: AbstractPlant, memory: InformationMemory, sample: StepData, k: Int[Array, ""]
    ) -> tuple[InformationMemory, Float[Array, ""]]:
        """Sensitivities after one step, and the information of the measurement at its end."""
        del k
        own = plant, memory, sample, self.max_sensitivity, self.prior
        known = next_knowledge(*own)[:2]
        cost = self.change_price * jnp.sum((sample.input - memory.input) ** 2)
        if not self.dense:
            return InformationMemory(*known, memory.value, sample.input), -cost
        value = self._worth(plant, known[1], sample.params)
        gain = self.weight * (value - memory.value) - cost
        return InformationMemory(*known, value, sample.input), gain

    def final(
        self, plant: AbstractPlant, memory: InformationMemory, params: Params
    ) -> Float[Array, ""]:
        """The total gain, unless it was rewarded at every step."""
        if self.dense:
            return jnp.zeros(())
        return self.weight * (self._worth(plant, memory.information, params) - memory.value)

    def relative_errors(
        self, plant: AbstractPlant, memory: InformationMemory, params: Params
    ) -> Float[Array, " param"]:
        """Smallest relative standard deviations (Cramér-Rao with the prior)."""
        covariance = jnp.linalg.inv(memory.information)
        if self.prior is None:
            deviation = jnp.sqrt(jnp.diagonal(covariance)) * relative_size(plant, params)
        else:
            changes = self.prior.changes(params)
            deviation = jnp.sqrt(jnp.diagonal(changes @ covariance @ changes.T))
        return deviation / jnp.abs(jnp.stack(params))

    def _worth(
        self, plant: AbstractPlant, information: Float[Array, "param param"], params: Params
    ) -> Float[Array, ""]:
        """The criterion; with a prior, what the experiment adds to it."""
        if self.prior is None:
            return self._value(information)
        changes = self.prior.changes(params) / relative_size(plant, params)[:, None]
        after = changes @ jnp.linalg.inv(information) @ changes.T
        return self._of_covariance(after) - self._of_covariance(changes @ changes.T)

    def _of_covariance(self, covariance: Float[Array, "param param"]) -> Float[Array, ""]:
        """The criterion of the relative parameters' covariance."""
        chosen = np.flatnonzero(self.targets)
        own = covariance[np.ix_(chosen, chosen)]
        if self.criterion == "D":
            return -jnp.linalg.slogdet(own)[1]
        return -jnp.log(jnp.trace(own) if self.criterion == "A" else jnp.linalg.eigvalsh(own)[-1])

    def _value(self, information: Float[Array, "param param"]) -> Float[Array, ""]:
        if self.criterion == "D":
            others = np.flatnonzero(~np.array(self.targets))
            nuisance = information[np.ix_(others, others)]
            return jnp.linalg.slogdet(information)[1] - jnp.linalg.slogdet(nuisance)[1]
        return self._of_covariance(jnp.linalg.inv(information))
