"""Errors of the estimate at the end of an experiment: ARX and output error."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..estimation import ARX
from ..estimation.arx import RLSState, physical_params, regressor
from ..information import relative_size
from ..plant import AbstractARXPlant, AbstractPlant, Params
from ..plant.fields import floats
from .objective import (
    MAX_SENSITIVITY,
    AbstractError,
    Knowledge,
    StepData,
    bounded,
    next_knowledge,
    prior_knowledge,
)


class ARXMemory(eqx.Module):
    """State of recursive least squares, and the samples for the next regressor."""

    rls: RLSState
    y_1: Float[Array, ""]
    y_2: Float[Array, ""]
    u_2: Float[Array, ""]


class EstimationError(AbstractError):
    """Errors of recursive least squares: the paper's reward (Eq. 4).

    Attributes:
        estimator: the ARX estimator in the reward.
    """

    estimator: ARX = eqx.field(default_factory=ARX)

    def init(
        self, plant: AbstractPlant, measured: Float[Array, " output"], key: PRNGKeyArray
    ) -> ARXMemory:
        """No coefficients yet.

        Raises:
            ValueError: for a plant without inverse mapping from ARX.
        """
        del key
        _require_arx(plant)
        zero = jnp.zeros(())
        return ARXMemory(self.estimator.init(), measured[0], zero, zero)

    def update(
        self, plant: AbstractPlant, memory: ARXMemory, sample: StepData, k: Int[Array, ""]
    ) -> tuple[ARXMemory, Float[Array, ""]]:
        """One recursion; the third sample is the first with a complete regressor."""
        del plant
        y, u_1 = sample.measured[0], sample.input[0]
        row = regressor(memory.y_1, memory.y_2, u_1, memory.u_2)
        updated = self.estimator.update(memory.rls, row, y)
        rls = jax.tree.map(lambda new, old: jnp.where(k >= 1, new, old), updated, memory.rls)
        return ARXMemory(rls, y, memory.y_1, u_1), jnp.zeros(())

    def relative_errors(
        self, plant: AbstractPlant, memory: ARXMemory, params: Params
    ) -> Float[Array, " param"]:
        """Of the present estimate, at most MAX_ERROR."""
        estimate, _ = physical_params(_require_arx(plant), memory.rls.coefficients)
        return bounded(jnp.abs(jnp.stack(estimate) / jnp.stack(params) - 1))


def _require_arx(plant: AbstractPlant) -> AbstractARXPlant:
    if not isinstance(plant, AbstractARXPlant):
        raise ValueError(
            f"plant {plant.definition.name!r} has no mapping from ARX coefficients to its "
            "parameters; reward the information gained instead"
        )
    return plant


class OutputErrorMemory(Knowledge):
    """The information so far, and the score S' (y - y_true) / sigma^2."""

    score: Float[Array, " param"]


class OutputError(AbstractError):
    """Errors of the output-error estimate (nonlinear least squares), for any plant.

    To first order in the noise: the estimate is one Gauss-Newton step away from the true
    parameters, M^-1 S' (y - y_true) / sigma^2, with the noise of the episode
    (L. Ljung, System Identification, 2nd ed., ch. 9).

    Attributes:
        prior_sd: standard deviation of each relative parameter before the experiment; it
            keeps the step finite at the start.
        max_sensitivity: larger ones are scaled down, see MAX_SENSITIVITY.
    """

    prior_sd: Float[Array, ""] = eqx.field(converter=floats, default=0.3)
    max_sensitivity: Float[Array, ""] = eqx.field(converter=floats, default=MAX_SENSITIVITY)

    def init(
        self, plant: AbstractPlant, measured: Float[Array, " output"], key: PRNGKeyArray
    ) -> OutputErrorMemory:
        """The prior's information; the initial state is known."""
        del measured, key
        num_params = len(self.targets)
        known = prior_knowledge(plant, num_params, self.prior_sd)
        return OutputErrorMemory(*known, jnp.zeros(num_params))

    def update(
        self, plant: AbstractPlant, memory: OutputErrorMemory, sample: StepData, k: Int[Array, ""]
    ) -> tuple[OutputErrorMemory, Float[Array, ""]]:
        """Adds one measurement."""
        del k
        sensitivity, information, weighted, output = next_knowledge(
            plant, memory, sample, self.max_sensitivity
        )
        score = memory.score + weighted.T @ ((sample.measured - output) / plant.sensor.sd)
        return OutputErrorMemory(sensitivity, information, score), jnp.zeros(())

    def relative_errors(
        self, plant: AbstractPlant, memory: OutputErrorMemory, params: Params
    ) -> Float[Array, " param"]:
        """Of the present estimate, at most MAX_ERROR."""
        step = jnp.linalg.solve(memory.information, memory.score)
        return bounded(jnp.abs(step * relative_size(plant, params) / jnp.stack(params)))
