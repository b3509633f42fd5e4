"""A cart on a rail with a hanging pendulum."""

import math

import jax.numpy as jnp

from ..description import Constant, Input, Output, Parameter, PlantDescription, State
from .contract import AbstractPlant


class CartPole(AbstractPlant):
    """Cart with a hanging pendulum of point mass, from force to position and angle.

        (M + m_p) x'' + m_p l (a'' cos a - a'^2 sin a) = F - B_c x'
        m_p l^2 a'' + m_p l (x'' cos a + g sin a)      = -B_p a'

    The angle a is zero when the pendulum hangs down and at rest.
    """

    definition = PlantDescription(
        name="cart_pole",
        states=(
            State("position", "m", scale=0.1), State("angle", "rad", scale=0.3),
            State("velocity", "m/s", scale=0.3), State("angle_rate", "rad/s", scale=1.0),
        ),
        inputs=(Input("force", "N", -10.0, 10.0, amplitude=1.0),),
        outputs=(
            Output("position", "m", 0.4, noise_sd=0.0005, warning_level=0.3, critical_level=0.4),
            Output("angle", "rad", math.radians(60), noise_sd=0.002),
        ),
        parameters=(
            Parameter("M", "kg", 0.6), Parameter("m_p", "kg", 0.2), Parameter("l", "m", 0.3),
            Parameter("B_c", "N s/m", 2.0), Parameter("B_p", "N m s/rad", 0.002),
        ),
        constants=(Constant("g", "m/s²", 9.81),),
        dt=0.04,
        substeps=4,
        band=(0.1, 4.0),
    )  # fmt: skip

    def derivative(self, state, input, params):
        _, angle, velocity, rate = state
        sine, cosine = jnp.sin(angle), jnp.cos(angle)
        force = input[0] - params.B_c * velocity + params.m_p * params.l * rate**2 * sine
        # Torque on the pendulum over m_p l: it accelerates cart and pendulum alike.
        pull = params.B_p * rate / (params.m_p * params.l) + self.constants.g * sine
        mass = params.M + params.m_p * sine**2
        acceleration = (force + params.m_p * cosine * pull) / mass
        angle_acceleration = -(acceleration * cosine + pull) / params.l
        return jnp.stack([velocity, rate, acceleration, angle_acceleration])

    def output(self, state, params):
        return state[:2]
