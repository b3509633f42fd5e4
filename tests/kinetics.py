"""A reaction in both directions, a plant without inputs."""

import jax.numpy as jnp
import numpy as np
import scipy.linalg

from excite.description import Output, Parameter, PlantDescription, State
from excite.plant import AbstractPlant


class Conversion(AbstractPlant):
    """A turns into B and back again; both are measured."""

    definition = PlantDescription(
        name="conversion",
        states=(State("A", "mol/l", initial=1.0), State("B", "mol/l")),
        inputs=(),
        outputs=(
            Output("a", "mol/l", scale=1.0, noise_sd=0.02),
            Output("b", "mol/l", scale=1.0, noise_sd=0.02),
        ),
        parameters=(Parameter("k1", "1/s", 0.4), Parameter("k2", "1/s", 0.3)),
        dt=0.5,
    )

    def derivative(self, state, input, params):
        rate = params.k1 * state[0] - params.k2 * state[1]
        return jnp.stack([-rate, rate])

    def output(self, state, params):
        return state


class Product(Conversion):
    """The same; only B is measured."""

    definition = PlantDescription(
        name="product",
        states=Conversion.definition.states,
        inputs=(),
        outputs=Conversion.definition.outputs[1:],
        parameters=Conversion.definition.parameters,
        dt=0.5,
    )

    def output(self, state, params):
        return state[1:]


TIME = np.array([0.0, 0.2, 0.5, 0.9, 1.5, 2.2, 3.5, 5.0, 9.0, 20.0])
TRUTH = {"k1": 0.6, "k2": 0.25}


def concentrations(k1: float, k2: float, time: np.ndarray = TIME) -> np.ndarray:
    """A and B by the matrix exponential."""
    rates = np.array([[-k1, k2], [k1, -k2]])
    return np.stack([scipy.linalg.expm(rates * t) @ [1.0, 0.0] for t in time])
