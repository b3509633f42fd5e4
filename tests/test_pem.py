"""Prediction error: the filter against a Kalman filter in NumPy, the estimates by Monte Carlo."""

from collections.abc import Callable
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from experiments import record_of, spread_params

from excite.description import Input, Output, Parameter, PlantDescription, State
from excite.estimation import NLS, PEM, Estimate, Experiments, Status, stack_experiments
from excite.estimation.identify import identify
from excite.estimation.kalman import innovations
from excite.excitation import PRBS
from excite.plant import AbstractPlant, Aero2, DCMotor
from excite.record import Record


class Tank(AbstractPlant):
    """One tank: a linear plant of the first order."""

    definition = PlantDescription(
        name="tank",
        states=(State("level", "m", initial=1.0),),
        inputs=(Input("inflow", "m³/s", 0.0, 2.0),),
        outputs=(Output("level", "m", 1.0, noise_sd=0.02),),
        parameters=(Parameter("area", "m²", 2.0), Parameter("loss", "m²/s", 0.4)),
        dt=1.0,
        band=(0.01, 0.2),
    )

    def derivative(self, state, input, params):
        return (input - params.loss * state) / params.area

    def output(self, state, params):
        return state


class TwoTanks(AbstractPlant):
    """Two tanks in a row: linear, of two states and two outputs."""

    definition = PlantDescription(
        name="two_tanks",
        states=(State("upper", "m", initial=0.5), State("lower", "m", initial=0.2)),
        inputs=(Input("inflow", "m³/s", 0.0, 2.0),),
        outputs=(Output("sum", "m", 1.0, noise_sd=0.02), Output("lower", "m", 1.0, noise_sd=0.02)),
        parameters=(Parameter("a", "1/s", 0.3), Parameter("b", "1/s", 0.2)),
        dt=0.5,
        substeps=20,
        band=(0.01, 0.2),
    )

    def derivative(self, state, input, params):
        return jnp.stack([input[0] - params.a * state[0], params.a * state[0] - params.b * state[1]])

    def output(self, state, params):
        return jnp.stack([state[0] + state[1], state[1]])


# The filter


def discretised(F: np.ndarray, sigma: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """State transition and covariance of the process noise over h (Van Loan)."""
    n = len(F)
    block = np.block([[-F, np.diag(sigma**2)], [np.zeros((n, n)), F.T]])
    e = scipy.linalg.expm(block * h)
    return e[n:, n:].T, e[n:, n:].T @ e[:n, n:]


def log_likelihood(
    F: np.ndarray, B: np.ndarray, C: np.ndarray, sigma: np.ndarray, noise: np.ndarray,
    first: np.ndarray, u: np.ndarray, dt: np.ndarray, y: np.ndarray, linear: bool,
) -> float:  # fmt: skip
    """Log-likelihood by a Kalman filter in matrix form; NaN in y was not measured."""
    n, x, P, total = len(F), first, np.zeros_like(F), 0.0
    for k in range(len(y)):
        seen = np.isfinite(y[k])
        c, e = C[seen], (y[k] - C @ x)[seen]
        S = c @ P @ c.T + np.diag(noise[seen] ** 2)
        if seen.any():
            total -= 0.5 * (np.linalg.slogdet(2 * np.pi * S)[1] + e @ np.linalg.solve(S, e))
            K = P @ c.T @ np.linalg.inv(S)
            x, P = x + K @ e, P - K @ S @ K.T
        if k < len(y) - 1:
            A, Q = discretised(F, sigma, dt[k])
            slope = (u[k + 1] - u[k]) / dt[k] if linear else np.zeros_like(u[k])
            # State, input and its slope together have a linear homogeneous equation.
            m = B.shape[1]
            whole = np.zeros((n + 2 * m, n + 2 * m))
            whole[:n, :n], whole[:n, n : n + m] = F, B
            whole[n : n + m, n + m :] = np.eye(m)
            x = (scipy.linalg.expm(whole * dt[k]) @ np.concatenate([x, u[k], slope]))[:n]
            P = A @ P @ A.T + Q
    return total


@pytest.mark.parametrize("linear", [False, True], ids=["held", "linear"])
def test_the_likelihood_is_that_of_a_kalman_filter(linear):
    rng, plant, length = np.random.default_rng(0), TwoTanks(), 60
    dt = rng.uniform(0.1, 0.5, length)
    u, y = rng.uniform(0, 1, (length + 1, 1)), rng.normal(1, 0.3, (length + 1, 2))
    seen = rng.uniform(size=y.shape) < 0.7
    y[~seen] = np.nan
    sigma, noise, (a, b) = np.array([0.1, 0.03]), np.array([0.05, 0.02]), (0.3, 0.2)
    F, B, C = np.array([[-a, 0], [a, -b]]), np.array([[1.0], [0.0]]), np.array([[1.0, 1], [0, 1]])
    first = np.array([0.4, 0.3])
    expected = log_likelihood(F, B, C, sigma, noise, first, u, dt, y, linear)
    found = eqx.filter_jit(innovations)(
        plant, plant.nominal, *map(jnp.asarray, (sigma, noise, first)),
        (jnp.asarray(u[:-1]), jnp.asarray(dt), jnp.asarray(u[1:]) if linear else None),
        jnp.asarray(np.where(seen, y, 1e6)), jnp.asarray(seen),
    )  # fmt: skip
    own = -float(found.cost) - 0.5 * np.log(2 * np.pi) * seen.sum()
    assert own == pytest.approx(expected, rel=1e-8)
