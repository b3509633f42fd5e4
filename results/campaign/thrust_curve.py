"""The Aero 2 whose thrust is partly quadratic in the voltage: a rival of `aero2`."""

import dataclasses

import jax.numpy as jnp

from excite import AbstractPlant, Parameter
from excite.plant.aero2 import Aero2


class ThrustCurve(AbstractPlant):
    """`Aero2` with the thrust of (1 - c) u + c u |u| / 7.2 V; c is the curvature."""

    definition = dataclasses.replace(
        Aero2.definition,
        name="aero2_curve",
        parameters=(
            *Aero2.definition.parameters,
            Parameter("curvature", "", 0.5, target=False),
        ),
    )

    def derivative(self, state, input, params):
        """Of pitch and pitch rate."""
        pitch, pitch_rate = state
        (u,) = input
        curve = (1 - params.curvature) * u + params.curvature * u * jnp.abs(u) / 7.2
        stiffness = self.constants.m * self.constants.g * self.constants.d_S
        torque = -params.D_p * pitch_rate - stiffness * jnp.sin(pitch)
        return jnp.stack([pitch_rate, 2 * params.K_pu * curve + torque / params.J_p])

    def output(self, state, params):
        """The pitch."""
        return state[:1]
