"""Quanser Aero 2, yaw locked, as a seesaw of one degree of freedom."""

import math

import jax.numpy as jnp

from ..description import Constant, Input, Output, Parameter, PlantDescription, State
from .base import AbstractARXPlant


class Aero2(AbstractARXPlant):
    """Pitch of the Aero 2: Eq. 1 of Langschwert et al. (arXiv 2606.00059) with u1 = u, u2 = -u.

        pitch'' = 2 K_pu u - (D_p / J_p) pitch' - (m g d_S / J_p) sin(pitch)

    The paper leaves nominal values, sensor noise and d_S open. Those here are inferred:
    J_p and m are from Quanser's manual, D_p and the stiffness m g d_S = 0.0204 N m from its
    pitch laboratory, K_pu and the noise reproduce the baseline rows of the paper's Table 1.
    """

    definition = PlantDescription(
        name="aero2",
        states=(State("pitch", "rad", scale=0.5), State("pitch_rate", "rad/s", scale=0.5)),
        inputs=(Input("voltage", "V", -24.0, 24.0, amplitude=7.2),),
        outputs=(
            Output(
                "pitch", "rad", math.radians(45), noise_sd=0.0002,
                warning_level=math.radians(30), critical_level=math.radians(40),
            ),
        ),
        parameters=(
            Parameter("J_p", "kg m²", 0.0232),
            Parameter("K_pu", "rad/s²/V", 0.0125, symbol="K_{pu}"),
            Parameter("D_p", "N m s/rad", 0.00104),
        ),
        constants=(
            Constant("m", "kg", 1.07),
            Constant("g", "m/s²", 9.81),
            Constant("d_S", "m", 0.0019435),
        ),
        dt=0.1,
        substeps=2,
        band=(0.05, 2.0),
    )  # fmt: skip

    def derivative(self, state, input, params):
        pitch, pitch_rate = state
        (voltage,) = input
        torque = -params.D_p * pitch_rate - self._stiffness * jnp.sin(pitch)
        return jnp.stack([pitch_rate, 2 * params.K_pu * voltage + torque / params.J_p])

    def output(self, state, params):
        return state[:1]

    def from_transfer_function(self, c_0, c_1, d_0):
        inertia = self._stiffness / c_0
        return self.Params(J_p=inertia, K_pu=d_0 / 2, D_p=c_1 * inertia)

    @property
    def _stiffness(self):
        return self.constants.m * self.constants.g * self.constants.d_S
