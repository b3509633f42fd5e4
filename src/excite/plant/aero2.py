"""Quanser Aero 2, yaw locked, as a seesaw of one degree of freedom: ideal, lagging, detailed."""

import dataclasses
import math

import jax.numpy as jnp

from ..description import Constant, Input, Output, Parameter, PlantDescription, State
from .contract import AbstractARXPlant, AbstractPlant


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


class Aero2Lag(AbstractPlant):
    """`Aero2` whose thrust follows the voltage with a first-order lag, tau v' = u - v.

    The rotor's time constant tau is a parameter; 0.162 s by Quanser's data.
    """

    definition = dataclasses.replace(
        Aero2.definition,
        name="aero2_lag",
        states=(*Aero2.definition.states, State("rotor", "V", scale=10.0)),
        parameters=(
            *Aero2.definition.parameters,
            Parameter("tau", "s", 0.162, symbol=r"\tau", target=False),
        ),
        substeps=4,
    )

    def derivative(self, state, input, params):
        pitch, rate, rotor = state
        stiffness = self.constants.m * self.constants.g * self.constants.d_S
        torque = -params.D_p * rate - stiffness * jnp.sin(pitch)
        acceleration = 2 * params.K_pu * rotor + torque / params.J_p
        return jnp.stack([rate, acceleration, (input[0] - rotor) / params.tau])

    def output(self, state, params):
        return state[:1]


class Aero2Detailed(AbstractPlant):
    """The Aero 2 in detail: lag, thrust curve, dead zone, asymmetry, stops, encoder.

    The rotor's speed, in volts, follows the voltage with the lag tau. Its thrust is
    quadratic beyond the dead zone d and equals that of the ideal plant at V_0 = 7.2 V,

        f(v) = V_0 sign(v) ((|v| - d) / (V_0 - d))^2,

    mixed with the linear v by `curvature` (1: all quadratic), and stronger by half the
    asymmetry for v > 0, weaker for v < 0. Edges are smooth within 0.1 V; stops are springs.
    Numbers: docs/reference/real-time.md. Here they are known; those of a rig may differ.
    """

    definition = dataclasses.replace(
        Aero2.definition,
        name="aero2_detailed",
        states=(*Aero2.definition.states, State("rotor", "V", scale=10.0)),
        outputs=(
            dataclasses.replace(
                Aero2.definition.outputs[0], noise_sd=0.0, resolution=2 * math.pi / 2880
            ),
        ),
        constants=(
            *Aero2.definition.constants,
            Constant("tau", "s", 0.162),
            Constant("dead_zone", "V", 1.5),
            Constant("asymmetry", "", 0.17),
            Constant("curvature", "", 1.0),
            Constant("stop", "rad", math.radians(49)),
        ),
        substeps=5,
    )

    def derivative(self, state, input, params):
        pitch, rate, rotor = state
        c = self.constants
        # The body rebounds from a stop within a tenth of a second, and loses most of its speed.
        depth = jnp.maximum(jnp.abs(pitch) - c.stop, 0.0)
        stop = -1000.0 * jnp.sign(pitch) * depth - 20.0 * jnp.minimum(depth / 0.01, 1.0) * rate
        torque = -params.D_p * rate - c.m * c.g * c.d_S * jnp.sin(pitch)
        acceleration = 2 * params.K_pu * self._thrust(rotor) + torque / params.J_p + stop
        return jnp.stack([rate, acceleration, (input[0] - rotor) / c.tau])

    def output(self, state, params):
        return state[:1]

    def _thrust(self, rotor):
        """Voltage of the ideal plant with the same thrust."""
        c, smooth, usual = self.constants, 0.1, 7.2
        size = jnp.sqrt(rotor**2 + smooth**2)
        over = (size - c.dead_zone + jnp.sqrt((size - c.dead_zone) ** 2 + smooth**2)) / 2
        quadratic = usual * (rotor / size) * (over / (usual - c.dead_zone)) ** 2
        mixed = c.curvature * quadratic + (1 - c.curvature) * rotor
        return mixed * (1 + c.asymmetry / 2 * rotor / size)
