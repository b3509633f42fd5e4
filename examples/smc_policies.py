"""The published policies of Inside-Out SMC² as excitations of the plants in smc_pendulums.py."""

import jax
import jax.numpy as jnp
import numpy as np

from excite.excitation.contract import AbstractExcitation


class RecurrentPolicy(AbstractExcitation):
    """A policy with two gated recurrent units, which sees the state at every sample.

    The weights are those of the authors' files, written as one NumPy archive: `enc1` to `enc3`,
    `gru4`, `gru5`, `mean1` to `mean3`, each matrix [in, out].
    """

    weights: dict[str, jax.Array]

    @classmethod
    def read(cls, path):
        """The policy in an archive (.npz)."""
        with np.load(path, allow_pickle=False) as archive:
            return cls({name: jnp.asarray(archive[name], float) for name in archive})

    def init(self, plant, num_steps, key):
        """The units' states, and the limits of the input."""
        first, second = (self.weights[f"{name}_state0"].ravel() for name in ("gru4", "gru5"))
        return first, second, plant.input_limits[1]

    def __call__(self, state, measurement):
        """The input is the limit times a hyperbolic tangent."""
        first, second, limit = state
        first = self._unit("gru4", first, self._layers("enc", measurement))
        second = self._unit("gru5", second, first)
        return (first, second, limit), limit * jnp.tanh(self._layers("mean", second))

    def _layers(self, name, x):
        """Three layers, rectified but for the last."""
        for i in (1, 2, 3):
            x = x @ self.weights[f"{name}{i}_weight"] + self.weights[f"{name}{i}_bias"]
            x = x if i == 3 else jax.nn.relu(x)
        return x

    def _unit(self, name, state, x):
        """A gated recurrent unit: reset, update and candidate gates."""
        own = jnp.split(x @ self.weights[f"{name}_Wi"], 3)
        past = jnp.split(state @ self.weights[f"{name}_Wh"], 3)
        bias = jnp.split(self.weights[f"{name}_b"], 3)
        reset, update = (jax.nn.sigmoid(own[i] + past[i] + bias[i]) for i in (0, 1))
        candidate = jnp.tanh(own[2] + reset * past[2] + bias[2])
        return (1 - update) * candidate + update * state
