"""An example plant: a motor that turns a load through a flexible shaft."""

import jax.numpy as jnp

from excite.description import Constant, Input, Output, Parameter, PlantDescription, State
from excite.plant import AbstractPlant


class FlexibleDrive(AbstractPlant):
    """Two inertias, a shaft between them, viscous friction at the motor; torque to angles."""

    definition = PlantDescription(
        name="flexible_drive",
        states=(
            State("motor_angle", "rad"), State("load_angle", "rad"),
            State("motor_speed", "rad/s", scale=10.0), State("load_speed", "rad/s", scale=10.0),
        ),
        inputs=(Input("torque", "N m", -2.0, 2.0, amplitude=0.5),),
        outputs=(
            Output("motor_angle", "rad", scale=6.0, resolution=0.0015, noise_sd=0.0005),
            Output("load_angle", "rad", scale=6.0, noise_sd=0.002, critical_level=40.0),
        ),
        parameters=(
            Parameter("J_l", "kg m²", 0.004), Parameter("c", "N m/rad", 8.0),
            Parameter("d", "N m s/rad", 0.01), Parameter("b", "N m s/rad", 0.02),
        ),
        constants=(Constant("J_m", "kg m²", 0.002),),
        dt=0.005,
        substeps=2,
        band=(0.5, 30.0),
    )  # fmt: skip

    def derivative(self, state, input, params):
        twist = state[0] - state[1]
        shaft = params.c * twist + params.d * (state[2] - state[3])
        motor = (input[0] - shaft - params.b * state[2]) / self.constants.J_m
        return jnp.stack([state[2], state[3], motor, shaft / params.J_l])

    def output(self, state, params):
        return state[:2]
