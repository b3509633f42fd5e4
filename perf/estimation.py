"""Batched nonlinear least squares against SciPy's: ratio of fits per second.

SciPy starts where ours does, at the nominal parameters, in logarithms, and may stop at its
default tolerances; whether it finds the right minimum is printed, not asked for.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from peers import pitch_by_samples, pitch_in_one_call, seconds

from excite.environment.episodes import run_episodes
from excite.estimation import NLS
from excite.excitation import Chirp
from excite.plant import Aero2, Sensor
from excite.study.evaluation import estimate_all

BATCH, STEPS, PEER_FITS = 200, 500, 3


def main() -> None:
    plant = Aero2(sensor=Sensor(jnp.array([0.00063]), jnp.array([0.0])))
    keys = jax.random.split(jax.random.key(0), BATCH)
    episodes = run_episodes(plant, Chirp(), STEPS, 0.3, keys)
    true = np.stack(episodes.params, axis=1)

    def fit() -> np.ndarray:
        return np.asarray(estimate_all(plant, NLS(), episodes.trajectory)[0])

    worst = 100 * np.abs(fit() / true - 1).max()
    ours = BATCH / seconds(fit, 3)
    print(f"ours: {ours:.1f} fits/s, largest error {worst:.2g} %")

    inputs = np.asarray(episodes.trajectory.inputs[..., 0])
    measured = np.asarray(episodes.trajectory.measured[..., 0])
    nominal = np.array([float(p) for p in plant.nominal])
    best = 0.0
    for response in (pitch_by_samples, pitch_in_one_call):
        errors = []

        def fit_all(response=response, errors=errors) -> None:
            for u, y, p in zip(inputs[:PEER_FITS], measured, true, strict=False):
                solution = scipy.optimize.least_squares(
                    lambda z, u=u, y=y: (response(nominal * np.exp(z), u) - y) / 0.00063,
                    np.zeros(3),
                )
                errors.append(100 * np.abs(nominal * np.exp(solution.x) / p - 1).max())

        rate = PEER_FITS / seconds(fit_all, 1)
        found = ", ".join(f"{e:.2g}" for e in errors)
        print(f"least_squares, {response.__name__}: {rate:.3f} fits/s, errors {found} %")
        best = max(best, rate)
    print(f"ratio to the faster of the two: {ours / best:,.0f}")


if __name__ == "__main__":
    main()
