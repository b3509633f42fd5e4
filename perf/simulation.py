"""Batched simulation against SciPy's solve_ivp: ratio of plant-steps per second."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from peers import pitch_by_samples, pitch_in_one_call, seconds

from excite.excitation import PRBS
from excite.plant import Aero2, draw_params
from excite.simulation import response

BATCH, STEPS = 1000, 500


def main() -> None:
    plant = Aero2()
    keys = jax.random.split(jax.random.key(0), BATCH)
    params = jax.vmap(lambda key: draw_params(plant, key, 0.3))(keys)
    inputs = jax.vmap(lambda key: PRBS().sequence(plant, STEPS, key))(keys)
    batched = jax.jit(jax.vmap(lambda p, u: response(plant, p, u)))
    outputs = np.asarray(batched(params, inputs))[..., 0]
    ours = BATCH * STEPS / seconds(lambda: jax.block_until_ready(batched(params, inputs)), 20)

    first = np.array([float(p[0]) for p in params]), np.asarray(inputs[0, :, 0])
    exact = pitch_by_samples(*first, rtol=1e-12)
    print(f"ours: {ours:,.0f} plant-steps/s, error {np.abs(outputs[0] - exact).max():.1e} rad")
    best = 0.0
    for peer in (pitch_by_samples, pitch_in_one_call):
        rate = STEPS / seconds(lambda peer=peer: peer(*first), 5)
        error = np.abs(peer(*first) - exact).max()
        print(f"solve_ivp, {peer.__name__}: {rate:,.0f} plant-steps/s, error {error:.1e} rad")
        best = max(best, rate)
    print(f"ratio to the faster of the two: {ours / best:,.0f}")
    print(f"device: {jnp.zeros(1).devices()}")


if __name__ == "__main__":
    main()
