"""Any excitation as a player on a rig: its JAX functions, compiled before the experiment."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from ..excitation import AbstractExcitation
from ..plant import AbstractPlant
from .player import AbstractPlayer


class ExcitationPlayer(AbstractPlayer):
    """A player for any excitation, before its first sample."""

    def __init__(
        self,
        excitation: AbstractExcitation,
        plant: AbstractPlant,
        num_steps: int,
        key: PRNGKeyArray,
    ) -> None:
        """Compiles one step, so that the first sample is not late.

        Raises:
            ValueError: for an excitation that cannot be played on this plant.
        """
        self.num_steps, self._excitation = num_steps, excitation
        self._state = start = _start(excitation, plant, num_steps, key)
        measured = jnp.zeros(len(plant.definition.outputs))
        for _ in range(2):  # after a step, the state may have another type for the compiler
            self.applied(self(0, np.asarray(measured)))
        self._state = start

    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """The excitation's input after this measurement."""
        del k
        self._state, input = _step(self._excitation, self._state, jnp.asarray(measured, float))
        return np.array(input, float)

    def applied(self, input: np.ndarray) -> None:
        """Passes the applied input to the excitation."""
        if type(self._excitation).applied is not AbstractExcitation.applied:
            self._state = _applied(self._excitation, self._state, jnp.asarray(input, float))


def excitation_key(seed: int | Int[Array, ""]) -> PRNGKeyArray:
    """A key other than that of a simulated rig, which uses the seed directly."""
    return jax.random.fold_in(jax.random.key(seed), 1)


@eqx.filter_jit
def _start(
    excitation: AbstractExcitation, plant: AbstractPlant, num_steps: int, key: PRNGKeyArray
) -> PyTree:
    return excitation.init(plant, num_steps, key)


@eqx.filter_jit
def _step(
    excitation: AbstractExcitation, state: PyTree, measured: Float[Array, " output"]
) -> tuple[PyTree, Float[Array, " input"]]:
    return excitation(state, measured)


@eqx.filter_jit
def _applied(
    excitation: AbstractExcitation, state: PyTree, input: Float[Array, " input"]
) -> PyTree:
    return excitation.applied(state, input)
