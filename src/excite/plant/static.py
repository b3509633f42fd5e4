"""Tasks without memory: an experiment is a sequence of designs, each with its own outcome.

Where to place a sensor, which question to ask, which dose to give: the outcome of one design does
not depend on the designs before it. A plant of this kind has the same excitations, policies,
trainings and evaluations as one that moves.
"""

from __future__ import annotations

import abc

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..description import Input, Output, Parameter, PlantDescription, State
from .contract import AbstractPlant, Params

_MADE = "num_designs"


def static_description(
    name: str,
    *,
    designs: tuple[Input, ...],
    outcomes: tuple[Output, ...],
    parameters: tuple[Parameter, ...],
) -> PlantDescription:
    """The description of a static task: one step, of one second, is one design.

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

    def derivative(
        self, state: Float[Array, " state"], input: Float[Array, " input"], params: Params
    ) -> Float[Array, " state"]:
        """In one step of Euler's method the state becomes the design."""
        del params
        made = jnp.ones(1)
        return (jnp.concatenate([input, made]) - state) / self.dt

    def output(self, state: Float[Array, " state"], params: Params) -> Float[Array, " output"]:
        """The outcome of the last design."""
        *design, made = state
        return jnp.where(made > 0.5, self.outcome(jnp.stack(design), params), 0.0)
