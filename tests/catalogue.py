"""The grid: a new plant or excitation is tested by being listed here."""

from functools import partial

import jax.numpy as jnp
import pytest

from excite.description import Constant, Input, Output, Parameter, PlantDescription, State
from excite.excitation import PRBS, AbstractShape, Chirp, Decay, Multisine, Random, Square
from excite.plant import EMPS, AbstractPlant, Aero2, Aero2Detailed, Aero2Lag, CartPole, DCMotor


class TwoMasses(AbstractPlant):
    """What a user writes: two masses between walls, joined by a spring, each with a force.

    m_1 x_1'' = F_1 - k_0 x_1 - k (x_1 - x_2) - c x_1', and likewise for the second mass.
    The second force can only pull, so that its limits are not symmetric.
    """

    definition = PlantDescription(
        name="two_masses",
        states=(
            State("x_1", "m", scale=0.1), State("x_2", "m", scale=0.1),
            State("v_1", "m/s", scale=0.3), State("v_2", "m/s", scale=0.3),
        ),
        inputs=(Input("F_1", "N", -5.0, 5.0, amplitude=2.0), Input("F_2", "N", 0.0, 6.0, 2.5)),
        outputs=(
            Output("x_1m", "m", 0.2, noise_sd=1e-3, critical_level=0.5),
            Output("x_2m", "m", 0.2, noise_sd=2e-3),
        ),
        parameters=(
            Parameter("m_1", "kg", 1.0), Parameter("m_2", "kg", 2.0),
            Parameter("k", "N/m", 30.0), Parameter("c", "N s/m", 0.8),
        ),
        constants=(Constant("k_0", "N/m", 20.0),),
        dt=0.05, substeps=2, band=(0.2, 4.0),
    )  # fmt: skip

    def derivative(self, state, input, params):
        x, v = state[:2], state[2:]
        joint = params.k * (x[0] - x[1]) * jnp.array([1.0, -1.0])
        force = input - self.constants.k_0 * x - joint - params.c * v
        return jnp.concatenate([v, force / jnp.stack([params.m_1, params.m_2])])

    def output(self, state, params):
        return state[:2]


PLANTS: dict[str, AbstractPlant] = {
    plant.definition.name: plant
    for plant in (
        Aero2(),
        Aero2Lag(),
        Aero2Detailed(),
        CartPole(),
        DCMotor(),
        EMPS(),
        TwoMasses(),
    )
}

LONG = partial(pytest.param, marks=pytest.mark.science)
"""A parameter of the long tests."""
SLOW = partial(pytest.param, marks=pytest.mark.slow)
"""A parameter of the slow ones."""

FEW_AND_ALL = [name if name in ("aero2", "two_masses") else LONG(name) for name in PLANTS]
"""Names of two plants that differ in everything, and of the others in the long tests."""

EXCITATIONS: dict[str, AbstractShape] = {
    "random": Random(),
    "random held": Random(hold=7),
    "random clipped": Random(amplitude=1e4),
    "prbs": PRBS(),
    "prbs clocked": PRBS(clock=4, amplitude=0.5),
    "prbs register": PRBS(register=6),
    "prbs register clocked": PRBS(register=5, clock=3),
    "chirp": Chirp(),
    "chirp logarithmic": Chirp(logarithmic=True),
    "chirp down": Chirp(start_frequency=2.0, stop_frequency=0.5),
    "multisine": Multisine(),
    "multisine weak": Multisine(amplitude=0.3),
    "square": Square(),
    "decay": Decay(),
    "decay late": Decay(pump=0.8),
}
