"""Objectives: the contract, and functions that objectives share."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from ..description import PlantDescription, names_of
from ..estimation.prior import PriorPlants
from ..information import relative_size
from ..plant import AbstractPlant, Params
from ..plant.fields import floats, optional_floats
from ..safety import critical_levels
from ..simulation import step

MAX_ERROR = 100.0
"""Largest relative error that counts (10,000 %); also the error of an estimate not finite."""

MAX_SENSITIVITY = 30.0
"""Of an output to a relative parameter, over the output's critical level or scale.

Where a plant is chaotic, sensitivities grow without bound, and no estimator reaches the
information that they indicate.
"""


class StepData(eqx.Module):
    """Data of one step for an objective; only the last two are known on a rig.

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
    """What an experiment is rewarded for."""

    def first_trained(self, plant: AbstractPlant, key: PRNGKeyArray) -> PyTree:
        """What of the objective is trained with the policy, before the first update; often None."""
        del plant, key

    def with_trained(self, trained: PyTree) -> Self:
        """The objective with what was trained."""
        del trained
        return self

    def require_steps(self, num_steps: int) -> None:
        """Raises ValueError where the objective is for experiments of another length."""
        del num_steps

    @abc.abstractmethod
    def init(
        self, plant: AbstractPlant, measured: Float[Array, " output"], key: PRNGKeyArray
    ) -> PyTree:
        """Memory at the first measurement; `key` is for what an objective draws at random."""

    @abc.abstractmethod
    def update(
        self, plant: AbstractPlant, memory: PyTree, sample: StepData, k: Int[Array, ""]
    ) -> tuple[PyTree, Float[Array, ""]]:
        """Memory after step k (0, 1, ...), and the reward if every step were rewarded."""

    @abc.abstractmethod
    def final(self, plant: AbstractPlant, memory: PyTree, params: Params) -> Float[Array, ""]:
        """Reward added at the last step."""

    @abc.abstractmethod
    def relative_errors(
        self, plant: AbstractPlant, memory: PyTree, params: Params
    ) -> Float[Array, " param"]:
        """Relative error of each parameter as the objective knows it, for display."""

    def outcome(
        self, plant: AbstractPlant, memory: PyTree, params: Params, worth: Float[Array, ""]
    ) -> PyTree:
        """The outcome of one experiment for `of_batch`: the sum of its rewards, `worth`."""
        del plant, memory, params
        return worth

    def of_batch(self, outcomes: PyTree) -> Float[Array, ""]:
        """The worth of experiments on many plants from their outcomes: the mean."""
        return jnp.mean(outcomes)


def toward_goals(
    errors: Float[Array, "plant param"],
    goals: Float[Array, " param"],
    targets: tuple[bool, ...],
) -> Float[Array, ""]:
    """The largest mean error over its goal, smoothed.

    A soft maximum of mean error over goal. A tenth of the mean logarithm is added, so that
    the other errors have a gradient.
    """
    chosen = np.flatnonzero(targets)
    ratio = (errors / goals[None])[:, chosen]
    worst = jax.nn.logsumexp(4 * jnp.mean(ratio, axis=0)) / 4
    return worst + 0.1 * jnp.mean(jnp.log(ratio + 1e-3))


class AbstractError(AbstractObjective):
    """Terminal reward: minus the errors of an estimate, summed (Eq. 4) or otherwise.

    Attributes:
        targets: which parameters are rewarded.
        goals: relative error by which that of each parameter is divided; one in the paper.
        form: `relative`, the sum of error over goal; `log`, that of log(1 + error / goal),
            in which a factor has the same weight for any error above its goal;
            `goals`, the largest mean error over its goal, see `toward_goals`.
        weight: factor of the reward.
    """

    targets: tuple[bool, ...] = eqx.field(static=True)
    goals: Float[Array, " param"] | None = eqx.field(converter=optional_floats, default=None)
    form: str = eqx.field(static=True, default="relative")
    weight: Float[Array, ""] = eqx.field(converter=floats, default=1.0)

    def __check_init__(self) -> None:
        """Raises ValueError for an unknown form."""
        if self.form not in ("relative", "log", "goals"):
            raise ValueError(f"form must be relative, log or goals: got {self.form!r}")

    def final(self, plant: AbstractPlant, memory: PyTree, params: Params) -> Float[Array, ""]:
        """The reward of the estimate at the end."""
        return self.of_errors(self.relative_errors(plant, memory, params)[None])

    def of_errors(self, errors: Float[Array, "plant param"]) -> Float[Array, ""]:
        """The worth of the errors on some plants."""
        goals = jnp.ones(errors.shape[1]) if self.goals is None else self.goals
        if self.form == "goals":
            return -self.weight * toward_goals(errors, goals, self.targets)
        ratios = errors / goals[None]
        terms = jnp.log1p(ratios) if self.form == "log" else ratios
        of_plants = terms @ np.array(self.targets, float)
        return -self.weight * jnp.mean(of_plants)

    def outcome(
        self, plant: AbstractPlant, memory: PyTree, params: Params, worth: Float[Array, ""]
    ) -> Float[Array, " param"]:
        """The errors, which alone are rewarded."""
        del worth
        return self.relative_errors(plant, memory, params)

    def of_batch(self, outcomes: Float[Array, "plant param"]) -> Float[Array, ""]:
        """The worth of the errors on all plants, whose means may have goals."""
        return self.of_errors(outcomes)


def bounded(errors: Float[Array, " param"]) -> Float[Array, " param"]:
    """Relative errors, at most MAX_ERROR; an error that is not finite is MAX_ERROR."""
    return jnp.where(jnp.isfinite(errors), jnp.minimum(errors, MAX_ERROR), MAX_ERROR)


class Knowledge(eqx.Module):
    """Relative sensitivity of the state, and Fisher information, so far."""

    sensitivity: Float[Array, "state param"]
    information: Float[Array, "param param"]


def prior_knowledge(
    plant: AbstractPlant, num_params: int, prior_sd: Float[Array, ""]
) -> tuple[Float[Array, "state param"], Float[Array, "param param"]]:
    """Sensitivity and information before the experiment; the initial state is known."""
    sensitivity = jnp.zeros((len(plant.definition.states), num_params))
    return sensitivity, jnp.eye(num_params) / prior_sd**2


def next_knowledge(
    plant: AbstractPlant,
    memory: Knowledge,
    sample: StepData,
    limit: Float[Array, ""],
    prior: PriorPlants | None = None,
) -> tuple[
    Float[Array, "state param"], Float[Array, "param param"], Float[Array, "output param"], Array
]:
    """Sensitivity and information after one step.

    Args:
        prior: whose standard deviations are the units of the parameters; else they are relative.

    Returns:
        Both; sensitivities of the outputs over their standard deviation; the true outputs.
    """
    own = plant, memory.sensitivity, sample, limit, prior
    sensitivity, of_outputs, output = sensitivities(*own)
    if plant.definition.observes_state:  # the next step begins with what is measured
        sensitivity, sd = jnp.zeros_like(sensitivity), plant.process_noise_sd
    else:
        sd = plant.sensor.sd
    weighted = of_outputs / sd[:, None]
    return sensitivity, memory.information + weighted.T @ weighted, weighted, output


def sensitivities(
    plant: AbstractPlant,
    sensitivity: Float[Array, "state param"],
    sample: StepData,
    limit: Float[Array, ""],
    prior: PriorPlants | None = None,
) -> tuple[Float[Array, "state param"], Float[Array, "output param"], Float[Array, " output"]]:
    """Sensitivities of state and outputs after one step, and the true outputs."""
    theta, size = jnp.stack(sample.params), relative_size(plant, sample.params)
    changes = None if prior is None else prior.changes(sample.params)

    def response(state: Array, change: Array) -> tuple[Array, Array]:
        params = plant.Params(*(theta + (size * change if changes is None else changes @ change)))
        state = step(plant, state, sample.input, params)
        return state, plant.output(state, params)

    def derivative(direction: Array, change: Array) -> tuple[Array, Array]:
        start = sample.state, jnp.zeros_like(theta)
        return jax.jvp(response, start, (direction, change))[1]

    of_states, of_outputs = jax.vmap(derivative, (1, 0), 1)(sensitivity, jnp.eye(len(theta)))
    levels = critical_levels(plant.definition)
    scales = np.array([o.scale for o in plant.definition.outputs])
    ranges = np.where(np.isfinite(levels), levels, scales)
    largest = jnp.max(jnp.abs(of_outputs) / ranges[:, None], axis=0)
    factor = jnp.minimum(1.0, limit / jnp.maximum(largest, 1e-3))
    output = response(sample.state, jnp.zeros_like(theta))[1]
    return of_states * factor[None], of_outputs * factor[None], output


def target_mask(description: PlantDescription, targets: Sequence[str] | None) -> tuple[bool, ...]:
    """Mask of the target parameters: those named, or the plant's targets.

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
