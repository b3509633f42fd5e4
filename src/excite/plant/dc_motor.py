"""A permanent-magnet DC motor, from voltage to speed and current."""

import jax.numpy as jnp

from ..description import Input, Output, Parameter, PlantDescription, State
from .contract import AbstractPlant


class DCMotor(AbstractPlant):
    """Armature circuit and rotor: L i' = u - R i - K w, J w' = K i - b w.

    The constant K is that of torque and back-EMF (equal in SI units). The numbers are those
    of a typical 24 V laboratory motor. The critical level of the current is 5 A.
    """

    definition = PlantDescription(
        name="dc_motor",
        states=(State("speed", "rad/s", scale=100.0), State("current", "A", scale=2.0)),
        inputs=(Input("voltage", "V", -24.0, 24.0, amplitude=3.0),),
        outputs=(
            Output("speed", "rad/s", 200.0, noise_sd=0.5),
            Output("current", "A", 5.0, noise_sd=0.02, warning_level=4.0, critical_level=5.0),
        ),
        parameters=(
            Parameter("R", "ohm", 2.0),
            Parameter("L", "H", 0.002),
            Parameter("K", "N m/A", 0.05),
            Parameter("J", "kg m²", 2e-5),
            Parameter("b", "N m s/rad", 2e-5),
        ),
        dt=0.001,
        substeps=2,
        band=(2.0, 200.0),
    )

    def derivative(self, state, input, params):
        speed, current = state
        (voltage,) = input
        torque = params.K * current - params.b * speed
        drop = voltage - params.R * current - params.K * speed
        return jnp.stack([torque / params.J, drop / params.L])

    def output(self, state, params):
        return state
