"""Excitations that use the measurements: a position loop, learned policies, and a coast."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from ..plant import AbstractPlant
from ..plant.fields import floats, optional_floats
from ..policy import Layout, Policy, Window, empty_window, respond, with_input
from ..safety import safe_input, watched_output
from .contract import AbstractExcitation, AbstractShape


class LoopState(NamedTuple):
    """State of a position loop.

    Attributes:
        reference: of all samples [output unit].
        which: index of the output.
        gain: of the loop [input unit / output unit].
        dt: sampling time [s].
        middle: of the input limits.
        output: measured at the last sample.
        k: index of the next sample.
    """

    reference: Float[Array, " time"]
    which: Int[Array, ""]
    gain: Float[Array, ""] | float
    dt: Float[Array, ""]
    middle: Float[Array, " input"]
    output: Float[Array, ""]
    k: Int[Array, ""]


class PositionLoop(AbstractExcitation):
    """A signal as the reference of a proportional-derivative loop around one output.

    The classical excitation of a plant with an integrator, whose output drifts under an
    open-loop signal. The loop closes around the first output with a critical level:
    u = gain (r - y) - damping dy/dt, the derivative a difference of two measurements.

    Attributes:
        signal: whose shape the reference has.
        amplitude: of the reference [output unit], by default half the output's scale.
        gain: [input unit / output unit], by default the input's amplitude over the output's
            scale.
        damping: [input unit / (output unit / s)].
    """

    signal: AbstractShape
    amplitude: Float[Array, ""] | None = eqx.field(converter=optional_floats, default=None)
    gain: Float[Array, ""] | None = eqx.field(converter=optional_floats, default=None)
    damping: Float[Array, ""] = eqx.field(converter=floats, default=0.0)

    def init(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> LoopState:
        """The reference, and the numbers of the plant that a step needs.

        Raises:
            ValueError: for a plant with more than one input.
        """
        d = plant.definition
        if len(d.inputs) != 1:
            raise ValueError(f"a position loop drives one input; {d.name!r} has {len(d.inputs)}")
        watched = watched_output(d)
        scale = d.outputs[watched].scale
        amplitude = 0.5 * scale if self.amplitude is None else self.amplitude
        gain = d.inputs[0].amplitude / scale if self.gain is None else self.gain
        reference = amplitude * self.signal.shape(plant, num_steps, key)[:, 0]
        lower, upper = plant.input_limits
        output = plant.output(plant.initial_state, plant.nominal)[watched]
        which = jnp.asarray(watched)
        middle = (lower + upper) / 2
        return LoopState(reference, which, gain, plant.dt, middle, output, jnp.asarray(0))

    def __call__(
        self, state: LoopState, measurement: Float[Array, " output"]
    ) -> tuple[LoopState, Float[Array, " input"]]:
        """The loop's input, before it is clipped to the limits."""
        y, k = measurement[state.which], state.k
        rate = jnp.where(k > 0, (y - state.output) / state.dt, 0.0)
        input = state.middle + state.gain * (state.reference[k] - y) - self.damping * rate
        return state._replace(output=y, k=k + 1), input


class PolicyExcitation(AbstractExcitation):
    """A learned policy.

    Attributes:
        weights: of the network, single precision.
        layout: what it observes.
    """

    weights: tuple[tuple[Float[Array, "_to _from"], Float[Array, " _to"]], ...]
    layout: Layout = eqx.field(static=True)

    @classmethod
    def of(cls, policy: Policy) -> PolicyExcitation:
        """The excitation of a policy read from a file."""
        layers = tuple((jnp.asarray(m), jnp.asarray(b)) for m, b in policy.weights)
        return cls(layers, policy.layout)

    def init(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> tuple[Window, Array]:
        """An empty window and k = 0.

        Raises:
            ValueError: for an experiment longer than the policy was made for.
        """
        del plant, key
        if num_steps > self.layout.num_steps:
            raise ValueError(
                f"the policy was made for {self.layout.num_steps} steps; "
                f"the experiment has {num_steps}"
            )
        return empty_window(jnp, self.layout), jnp.asarray(0)

    def __call__(
        self, state: tuple[Window, Array], measurement: Float[Array, " output"]
    ) -> tuple[tuple[Window, Array], Float[Array, " input"]]:
        """The network's input for the window that ends with this measurement."""
        window, k = state
        window, input = respond(jnp, self.layout, self.weights, window, k, measurement)
        return (with_input(jnp, self.layout, window, input), k + 1), input

    def applied(
        self, state: tuple[Window, Array], input: Float[Array, " input"]
    ) -> tuple[Window, Array]:
        """The window with the applied input in place of the proposed one."""
        window, k = state
        newest = with_input(jnp, self.layout, window, input).inputs[-1]
        return window._replace(inputs=window.inputs.at[-1].set(newest)), k


class CoastState(NamedTuple):
    """State of a `Coast`.

    Attributes:
        own: of the excitation.
        rest: input after its end [input unit].
        k: index of the next sample.
    """

    own: PyTree
    rest: Float[Array, " input"]
    k: Int[Array, ""]


class Coast(AbstractExcitation):
    """An excitation, and after its end the input that ends an experiment.

    What the plant then does is part of an experiment's safety (`Env.coast`).

    Attributes:
        excitation: plays first.
        num_steps: for so many samples.
    """

    excitation: AbstractExcitation
    num_steps: int = eqx.field(static=True)

    @property
    def uses_measurements(self) -> bool:
        """As the excitation."""
        return self.excitation.uses_measurements

    @classmethod
    def after(
        cls, excitation: AbstractExcitation, num_steps: int, coast: int
    ) -> tuple[AbstractExcitation, int]:
        """An excitation with `coast` samples after its end, and the whole length."""
        return (cls(excitation, num_steps) if coast else excitation), num_steps + coast

    def init(self, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray) -> CoastState:
        """The state of the excitation."""
        del num_steps
        start = self.excitation.init(plant, self.num_steps, key)
        return CoastState(start, jnp.asarray(safe_input(plant.definition)), jnp.asarray(0))

    def __call__(
        self, state: CoastState, measurement: Float[Array, " output"]
    ) -> tuple[CoastState, Float[Array, " input"]]:
        """The excitation's input, or the one that ends the experiment."""
        own, input = self.excitation(state.own, measurement)
        input = jnp.where(state.k < self.num_steps, input, state.rest)
        return state._replace(own=own, k=state.k + 1), input

    def applied(self, state: CoastState, input: Float[Array, " input"]) -> CoastState:
        """The state after an input was applied that may not be the proposed one."""
        return state._replace(own=self.excitation.applied(state.own, input))
