"""Tasks without memory: an experiment is a sequence of designs, each with its own outcome.

Where to place a sensor, which question to ask, which dose to give: the outcome of one design does
not depend on the designs before it. A plant of this kind has the same excitations, policies,
trainings and evaluations as one that moves.
"""

from __future__ import annotations

import abc
from typing import TypeGuard

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..description import Input, Output, Parameter, PlantDescription, State
from .contract import AbstractPlant, Params

_MADE = "is_made"


def static_description(
    name: str,
    *,
    designs: tuple[Input, ...],
    outcomes: tuple[Output, ...],
    parameters: tuple[Parameter, ...],
) -> PlantDescription:
    """The description of a static task: one step is one design, and lasts one second.

    Args:
        name: of the task.
        designs: what is chosen, with its limits.
        outcomes: what is measured, with its noise.
        parameters: what is to be learnt.
    """
    states = *(State(f"{i.name}_before", i.unit) for i in designs), State(_MADE, "")
    return PlantDescription(
        name=name,
        states=states,
        inputs=designs,
        outputs=outcomes,
        parameters=parameters,
        dt=1.0,
        integrator="euler",
    )


class AbstractStaticTask(AbstractPlant):
    """Base of tasks without memory: a class with a `definition` and an `outcome`.

        >>> import excite as ex
        >>> from excite.plant import AbstractStaticTask, static_description
        >>> class Beacon(AbstractStaticTask):
        ...     definition = static_description(
        ...         "beacon",
        ...         designs=(ex.Input("place", "m", -4.0, 4.0),),
        ...         outcomes=(ex.Output("level", "", scale=1.0, noise_sd=0.1),),
        ...         parameters=(ex.Parameter("at", "m", 0.0, scale=1.0, positive=False),),
        ...     )
        ...     def outcome(self, design, params):
        ...         return 1 / (1 + (design - params.at) ** 2)
        >>> ex.simulate(Beacon, "random", steps=30).outputs.shape
        (31, 1)

    The outcome of a design is measured one sample later. The first sample, before any design, is
    noise about zero and tells nothing.
    """

    @abc.abstractmethod
    def outcome(self, design: Float[Array, " input"], params: Params) -> Float[Array, " output"]:
        """Mean of what is measured of a design; the sensor's noise is added to it."""

    def measured(
        self, design: Float[Array, " input"], params: Params, noise: Float[Array, " output"]
    ) -> Float[Array, " output"]:
        """What is measured of a design: its outcome, and the sensor's noise.

        A task with another noise than a normal one of fixed size defines this and `log_likelihood`.

        Args:
            noise: standard normal, one number for each output.
        """
        return self.outcome(design, params) + self.sensor.sd * noise

    def log_likelihood(
        self, measured: Float[Array, " output"], design: Float[Array, " input"], params: Params
    ) -> Float[Array, ""]:
        """Logarithm of the density of what is measured of a design, but for a constant."""
        misses = (measured - self.outcome(design, params)) / self.sensor.sd
        return -0.5 * jnp.sum(misses**2)

    def after(self, design: Float[Array, " input"]) -> Float[Array, " state"]:
        """The state after a design, whatever time it took: the design, and that one was made."""
        return jnp.append(design, 1.0)

    def derivative(
        self, state: Float[Array, " state"], input: Float[Array, " input"], params: Params
    ) -> Float[Array, " state"]:
        """Toward the design, in one step of Euler's method; a simulation takes `after`."""
        del params
        return (self.after(input) - state) / self.dt

    def output(self, state: Float[Array, " state"], params: Params) -> Float[Array, " output"]:
        """The outcome of the last design, zero before the first."""
        *last, made = state
        lower, upper = self.input_limits
        # An outcome that is not finite at zero would spoil the gradient of the others.
        design = jnp.where(made > 0.5, jnp.stack(last), (lower + upper) / 2)
        return jnp.where(made > 0.5, self.outcome(design, params), 0.0)


def has_own_noise(plant: AbstractPlant) -> TypeGuard[AbstractStaticTask]:
    """Whether a plant is a static task with another noise than its sensor's."""
    return isinstance(plant, AbstractStaticTask) and bool(own_functions(plant))


def own_functions(task: AbstractStaticTask) -> list[str]:
    """Names of the functions of its own noise that a task defines: both or none, if it is right."""
    functions = "measured", "log_likelihood"
    usual = AbstractStaticTask
    return [name for name in functions if getattr(type(task), name) is not getattr(usual, name)]


def require_sensor_noise(plant: AbstractPlant) -> None:
    """Raises ValueError for a static task with another noise than its sensor's."""
    if has_own_noise(plant):
        raise ValueError(
            f"plant {plant.definition.name!r} has its own log_likelihood: it has expected "
            "information gains and myopic designs (excite gain), but nothing that needs the normal "
            "noise of a sensor: fits, information, designs of signals, trainings, studies, rigs"
        )
