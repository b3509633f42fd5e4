"""The information gained by an experiment, as a reward at every step or at the end."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..information import relative_size
from ..plant import AbstractPlant, Params
from ..plant.fields import floats
from .objective import (
    MAX_SENSITIVITY,
    AbstractObjective,
    Knowledge,
    StepData,
    next_knowledge,
    prior_knowledge,
)


class InformationMemory(Knowledge):
    """The information so far, and the criterion at the last reward."""

    value: Float[Array, ""]


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
    """

    targets: tuple[bool, ...] = eqx.field(static=True)
    prior_sd: Float[Array, ""] = eqx.field(converter=floats)
    weight: Float[Array, ""] = eqx.field(converter=floats, default=1.0)
    criterion: str = eqx.field(static=True, default="D")
    dense: bool = eqx.field(static=True, default=True)
    max_sensitivity: Float[Array, ""] = eqx.field(converter=floats, default=MAX_SENSITIVITY)

    def __check_init__(self) -> None:
        """Raises ValueError for an unknown criterion."""
        if self.criterion not in ("D", "A", "E"):
            raise ValueError(f"criterion must be D, A or E: got {self.criterion!r}")

    def init(self, plant: AbstractPlant, measured: Float[Array, " output"]) -> InformationMemory:
        """The prior's information; the initial state is known."""
        del measured
        known = prior_knowledge(plant, len(self.targets), self.prior_sd)
        return InformationMemory(*known, self._value(known[1]))

    def update(
        self, plant: AbstractPlant, memory: InformationMemory, sample: StepData, k: Int[Array, ""]
    ) -> tuple[InformationMemory, Float[Array, ""]]:
        """Sensitivities after one step, and the information of the measurement at its end."""
        del k
        known = next_knowledge(plant, memory, sample, self.max_sensitivity)[:2]
        if not self.dense:
            return InformationMemory(*known, memory.value), jnp.zeros(())
        value = self._value(known[1])
        gain = self.weight * (value - memory.value)
        return InformationMemory(*known, value), gain

    def final(
        self, plant: AbstractPlant, memory: InformationMemory, params: Params
    ) -> Float[Array, ""]:
        """The total gain, unless it was rewarded at every step."""
        del plant, params
        if self.dense:
            return jnp.zeros(())
        return self.weight * (self._value(memory.information) - memory.value)

    def relative_errors(
        self, plant: AbstractPlant, memory: InformationMemory, params: Params
    ) -> Float[Array, " param"]:
        """Smallest relative standard deviations (Cramér-Rao with the prior)."""
        deviation = jnp.sqrt(jnp.diagonal(jnp.linalg.inv(memory.information)))
        return deviation * relative_size(plant, params) / jnp.abs(jnp.stack(params))

    def _value(self, information: Float[Array, "param param"]) -> Float[Array, ""]:
        chosen = np.flatnonzero(self.targets)
        if self.criterion == "D":
            others = np.flatnonzero(~np.array(self.targets))
            nuisance = information[np.ix_(others, others)]
            return jnp.linalg.slogdet(information)[1] - jnp.linalg.slogdet(nuisance)[1]
        bound = jnp.linalg.inv(information)[np.ix_(chosen, chosen)]
        size = jnp.trace(bound) if self.criterion == "A" else jnp.linalg.eigvalsh(bound)[-1]
        return -jnp.log(size)
