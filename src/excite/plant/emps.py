"""EMPS: an electro-mechanical positioning system of motor, ball screw and carriage."""

import jax.numpy as jnp

from ..description import Constant, Input, Output, Parameter, PlantDescription, State
from .contract import AbstractPlant


class EMPS(AbstractPlant):
    """Carriage with viscous and Coulomb friction, from motor force to position.

        M q'' = force - F_v q' - F_c sign(q') - offset

    Model and nominal values (inverse model, least squares): A. Janot, M. Gautier,
    M. Brunot, "Data set and reference models of EMPS", Workshop on Nonlinear System
    Identification Benchmarks, 2019. The sign is smoothed as tanh(q' / v_s), v_s = 1 mm/s,
    which needs integration steps of a few milliseconds. An experiment starts at mid-stroke.
    """

    definition = PlantDescription(
        name="emps",
        states=(State("position", "m", scale=0.1), State("velocity", "m/s", scale=0.1)),
        inputs=(Input("force", "N", -300.0, 300.0, amplitude=60.0),),
        outputs=(
            Output("position", "m", 0.12, noise_sd=1e-5, warning_level=0.10, critical_level=0.12),
        ),
        parameters=(
            Parameter("M", "kg", 95.1089),
            Parameter("F_v", "N s/m", 203.5034),
            Parameter("F_c", "N", 20.3935),
            Parameter("offset", "N", -3.1648, positive=False, target=False),
        ),
        constants=(Constant("v_s", "m/s", 0.001),),
        dt=0.02,
        substeps=5,
        band=(0.05, 5.0),
    )

    def derivative(self, state, input, params):
        _, velocity = state
        (force,) = input
        friction = params.F_v * velocity + params.F_c * jnp.tanh(velocity / self.constants.v_s)
        return jnp.stack([velocity, (force - friction - params.offset) / params.M])

    def output(self, state, params):
        return state[:1]
