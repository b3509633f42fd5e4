"""What an experiment is worth: the reward of the decision process.

Two objectives: the error of the estimate at the end (the paper's), and the information
gained at every step, which any plant has. Their memory does not grow with time.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .description import PlantDescription, names_of
from .estimation import ARX
from .estimation.arx import RLSState, physical_params, regressor
from .excitation import optional_array
from .information import relative_size
from .plant import AbstractARXPlant, AbstractPlant, Params
from .simulation import step

MAX_ERROR = 100.0
"""Relative error at which an estimate counts as nothing (10,000 %); also for one not finite."""


def number(value: Any) -> Array:
    """An array of floating-point numbers, also from whole ones; converts fields."""
    return jnp.asarray(value, float)


class Sample(eqx.Module):
    """What one step shows an objective; only the last two are known on a rig.

    Attributes:
        params, state: true parameters, and the true state when the input began to act.
        input: held during the step.
        measured: outputs at its end.
    """

    params: Params
    state: Float[Array, " state"]
    input: Float[Array, " input"]
    measured: Float[Array, " output"]


class AbstractObjective(eqx.Module):
    """What an experiment is worth."""

    @abc.abstractmethod
    def init(self, plant: AbstractPlant, measured: Float[Array, " output"]) -> Any:
        """Memory at the first measurement."""

    @abc.abstractmethod
    def update(
        self, plant: AbstractPlant, memory: Any, sample: Sample, k: Int[Array, ""]
    ) -> tuple[Any, Float[Array, ""]]:
        """Memory after step k (0, 1, ...), and the reward if every step were rewarded."""

    @abc.abstractmethod
    def final(self, plant: AbstractPlant, memory: Any, params: Params) -> Float[Array, ""]:
        """Reward added at the last step."""

    @abc.abstractmethod
    def relative_errors(
        self, plant: AbstractPlant, memory: Any, params: Params
    ) -> Float[Array, " param"]:
        """Relative error of each parameter as far as the objective knows it, to watch."""


class ARXMemory(eqx.Module):
    """Recursive least squares, and the samples its next regressor needs."""

    rls: RLSState
    y_1: Float[Array, ""]
    y_2: Float[Array, ""]
    u_2: Float[Array, ""]


class EstimationError(AbstractObjective):
    """Terminal reward: minus the summed relative errors of recursive least squares (Eq. 4).

    Attributes:
        estimator: the ARX estimator in the reward.
        targets: which parameters count.
        goals: relative error of each parameter that counts as one; the paper's are ones.
        logarithmic: log(1 + error / goal) in place of error / goal: a factor counts the
            same however large the error is, until the goal is reached.
        weight: factor of the reward.
    """

    estimator: ARX
    targets: tuple[bool, ...] = eqx.field(static=True)
    goals: Float[Array, " param"] | None = eqx.field(converter=optional_array, default=None)
    logarithmic: bool = eqx.field(static=True, default=False)
    weight: Float[Array, ""] = eqx.field(converter=number, default=1.0)

    def init(self, plant: AbstractPlant, measured: Float[Array, " output"]) -> ARXMemory:
        """No coefficients yet.

        Raises:
            ValueError: for a plant without inverse mapping from ARX.
        """
        _require_arx(plant)
        zero = jnp.zeros(())
        return ARXMemory(self.estimator.init(), measured[0], zero, zero)

    def update(
        self, plant: AbstractPlant, memory: ARXMemory, sample: Sample, k: Int[Array, ""]
    ) -> tuple[ARXMemory, Float[Array, ""]]:
        """One recursion; the first sample with a whole regressor is the third."""
        del plant
        y, u_1 = sample.measured[0], sample.input[0]
        row = regressor(memory.y_1, memory.y_2, u_1, memory.u_2)
        updated = self.estimator.update(memory.rls, row, y)
        rls = jax.tree.map(lambda new, old: jnp.where(k >= 1, new, old), updated, memory.rls)
        return ARXMemory(rls, y, memory.y_1, u_1), jnp.zeros(())

    def final(self, plant: AbstractPlant, memory: ARXMemory, params: Params) -> Float[Array, ""]:
        """Eq. 4 for the targets."""
        errors = self.relative_errors(plant, memory, params)
        terms = errors if self.goals is None else errors / self.goals
        terms = jnp.log1p(terms) if self.logarithmic else terms
        return -self.weight * jnp.sum(terms * np.array(self.targets, float))

    def relative_errors(
        self, plant: AbstractPlant, memory: ARXMemory, params: Params
    ) -> Float[Array, " param"]:
        """Of the present estimate, at most MAX_ERROR."""
        estimate, _ = physical_params(_require_arx(plant), memory.rls.coefficients)
        errors = jnp.abs(jnp.stack(estimate) / jnp.stack(params) - 1)
        return jnp.where(jnp.isfinite(errors), jnp.minimum(errors, MAX_ERROR), MAX_ERROR)


def _require_arx(plant: AbstractPlant) -> AbstractARXPlant:
    if not isinstance(plant, AbstractARXPlant):
        raise ValueError(
            f"plant {plant.definition.name!r} has no mapping from ARX coefficients to its "
            "parameters; reward the information gained instead"
        )
    return plant


class InformationMemory(eqx.Module):
    """Sensitivity of the state, Fisher information, and the criterion as last rewarded."""

    sensitivity: Float[Array, "state param"]
    information: Float[Array, "param param"]
    value: Float[Array, ""]


class InformationGain(AbstractObjective):
    """Dense reward: the increment of log det of the Fisher information at every step.

    The information is relative (logarithms of positive parameters) and begins with that
    of the prior, so that the sum over an episode is what the experiment adds to what was
    known before. Where some parameters are no targets, they are eliminated first
    (D_s-optimality; A. Atkinson, A. Donev, R. Tobias, Optimum Experimental Designs, 2007).
    Sensitivities follow the state by one directional derivative a parameter.

    Attributes:
        targets: which parameters count.
        prior_sd: standard deviation of each relative parameter before the experiment.
        weight: factor of the reward.
        criterion: of the targets' covariance bound: minus the logarithm of its determinant
            (`D`), of its trace (`A`), or of its largest eigenvalue (`E`).
        dense: whether every step is rewarded by its increment, or the last by all of it.
    """

    targets: tuple[bool, ...] = eqx.field(static=True)
    prior_sd: Float[Array, ""] = eqx.field(converter=number)
    weight: Float[Array, ""] = eqx.field(converter=number, default=1.0)
    criterion: str = eqx.field(static=True, default="D")
    dense: bool = eqx.field(static=True, default=True)

    def init(self, plant: AbstractPlant, measured: Float[Array, " output"]) -> InformationMemory:
        """The prior's information; the initial state is known."""
        del measured
        num_params = len(self.targets)
        information = jnp.eye(num_params) / self.prior_sd**2
        sensitivity = jnp.zeros((len(plant.definition.states), num_params))
        return InformationMemory(sensitivity, information, self._value(information))

    def update(
        self, plant: AbstractPlant, memory: InformationMemory, sample: Sample, k: Int[Array, ""]
    ) -> tuple[InformationMemory, Float[Array, ""]]:
        """Sensitivities one step on, and what the measurement at its end adds."""
        del k
        theta, size = jnp.stack(sample.params), relative_size(plant, sample.params)

        def response(state: Array, change: Array) -> tuple[Array, Array]:
            params = plant.Params(*(theta + size * change))
            state = step(plant, state, sample.input, params)
            return state, plant.output(state, params)

        def derivative(direction: Array, change: Array) -> tuple[Array, Array]:
            start = sample.state, jnp.zeros_like(theta)
            return jax.jvp(response, start, (direction, change))[1]

        directions = memory.sensitivity, jnp.eye(len(self.targets))
        sensitivity, of_outputs = jax.vmap(derivative, (1, 0), 1)(*directions)
        weighted = of_outputs / plant.sensor.sd[:, None]
        information = memory.information + weighted.T @ weighted
        if not self.dense:
            return InformationMemory(sensitivity, information, memory.value), jnp.zeros(())
        value = self._value(information)
        gain = self.weight * (value - memory.value)
        return InformationMemory(sensitivity, information, value), gain

    def final(
        self, plant: AbstractPlant, memory: InformationMemory, params: Params
    ) -> Float[Array, ""]:
        """What was gained, unless it was rewarded on the way."""
        del plant, params
        if self.dense:
            return jnp.zeros(())
        return self.weight * (self._value(memory.information) - memory.value)

    def relative_errors(
        self, plant: AbstractPlant, memory: InformationMemory, params: Params
    ) -> Float[Array, " param"]:
        """Least relative standard deviations (Cramér-Rao with the prior)."""
        del plant, params
        return jnp.sqrt(jnp.diagonal(jnp.linalg.inv(memory.information)))

    def _value(self, information: Float[Array, "param param"]) -> Float[Array, ""]:
        chosen = np.flatnonzero(self.targets)
        if self.criterion == "D":
            others = np.flatnonzero(~np.array(self.targets))
            nuisance = information[np.ix_(others, others)]
            return jnp.linalg.slogdet(information)[1] - jnp.linalg.slogdet(nuisance)[1]
        bound = jnp.linalg.inv(information)[np.ix_(chosen, chosen)]
        size = jnp.trace(bound) if self.criterion == "A" else jnp.linalg.eigvalsh(bound)[-1]
        return -jnp.log(size)


def target_mask(description: PlantDescription, targets: Sequence[str] | None) -> tuple[bool, ...]:
    """Which parameters count: those named, or the plant's own targets.

    Raises:
        ValueError: for an unknown name, or none at all.
    """
    names = names_of(description.parameters)
    if targets is None:
        return tuple(p.target for p in description.parameters)
    for name in targets:
        if name not in names:
            raise ValueError(
                f"plant {description.name!r} has no parameter {name!r}; it has {', '.join(names)}"
            )
    if not targets:
        raise ValueError("an objective needs at least one parameter")
    return tuple(name in targets for name in names)


def default_objective(plant: AbstractPlant, spread: float) -> AbstractObjective:
    """The paper's for a plant with a mapping from ARX, else the information gained."""
    targets = target_mask(plant.definition, None)
    if isinstance(plant, AbstractARXPlant):
        return EstimationError(ARX(), targets)
    return InformationGain(targets, prior_sd_of(spread))


def prior_sd_of(spread: float) -> float:
    """Standard deviation of a relative parameter that is uniform within ± `spread`."""
    # A plant that is not drawn at random is still not known better than to one percent.
    return max(spread, 0.01) / 3**0.5
