"""Nonlinear least squares against what else a user could write: CPU seconds in one run.

Every peer gets the exact derivatives of the same simulation (Runge-Kutta, two steps a sample)
or, in pure Python, an adaptive integrator; it starts where ours does, at the nominal
parameters, in logarithms. All are measured without compilation, in turns of five plants; the
ratios are of medians. The first fit of a turn, which finds the processor's caches as another peer
has left them, is told beside. Numba and CasADi are no dependencies of the package:
`pip install numba casadi`.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import casadi  # pyright: ignore[reportMissingImports]
import jax
import jax.numpy as jnp
import numba  # pyright: ignore[reportMissingImports]
import numpy as np
import scipy.optimize
from peers import DT, MGD, pitch_by_samples

from excite.environment.episodes import run_episodes
from excite.estimation import NLS, stack_experiments
from excite.excitation import PRBS, Chirp
from excite.plant import Aero2, Sensor
from excite.simulation import run_episode
from excite.study.methods import estimate_all

SD, BATCH, STEPS, LONG = 0.00063, 1000, 500, 1_000_000
PLANTS, TURN = 40, 5
PLANT = Aero2(sensor=Sensor(jnp.array([SD]), jnp.array([0.0])))
NOMINAL = np.array([float(p) for p in PLANT.nominal])


def cpu_seconds(call: Callable[[], Any]) -> float:
    start = time.process_time()
    call()
    return time.process_time() - start


# ------------------------------------------------------------------ SciPy with Numba


@numba.njit
def _rate(x: np.ndarray, u: float, J_p: float, K_pu: float, D_p: float, out: np.ndarray) -> None:
    """State, then its derivatives by the logarithms of the parameters."""
    sine, cosine = np.sin(x[0]), np.cos(x[0])
    out[0] = x[1]
    out[1] = 2 * K_pu * u - (D_p * x[1] + MGD * sine) / J_p
    for i in range(3):
        out[2 + i] = x[5 + i]
        out[5 + i] = -(MGD * cosine * x[2 + i] + D_p * x[5 + i]) / J_p
    out[5] += (D_p * x[1] + MGD * sine) / J_p
    out[6] += 2 * K_pu * u
    out[7] -= D_p * x[1] / J_p


@numba.njit
def _simulate(p: np.ndarray, inputs: np.ndarray, pitch: np.ndarray, slope: np.ndarray) -> None:
    h = DT / 2
    x, k1, k2, k3, k4 = np.zeros(8), np.zeros(8), np.zeros(8), np.zeros(8), np.zeros(8)
    for k in range(len(pitch)):
        pitch[k] = x[0]
        slope[k] = x[2:5]
        if k == len(inputs):
            return
        for _ in range(2):
            _rate(x, inputs[k], p[0], p[1], p[2], k1)
            _rate(x + h / 2 * k1, inputs[k], p[0], p[1], p[2], k2)
            _rate(x + h / 2 * k2, inputs[k], p[0], p[1], p[2], k3)
            _rate(x + h * k3, inputs[k], p[0], p[1], p[2], k4)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def with_numba(inputs: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """`least_squares` (MINPACK) over a compiled simulation with its sensitivities."""
    pitch, slope = np.zeros(len(measured)), np.zeros((len(measured), 3))
    last = np.full(3, np.nan)

    def run(z: np.ndarray) -> None:
        if not np.array_equal(z, last):
            _simulate(NOMINAL * np.exp(z), inputs, pitch, slope)
            last[:] = z

    def residual(z: np.ndarray) -> np.ndarray:
        run(z)
        return (pitch - measured) / SD

    def jacobian(z: np.ndarray) -> np.ndarray:
        run(z)
        return slope / SD

    slope_at: Any = jacobian
    found = scipy.optimize.least_squares(residual, np.zeros(3), jac=slope_at, method="lm")
    return NOMINAL * np.exp(found.x)


# ------------------------------------------------------------------ CasADi


def casadi_problem(steps: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """`least_squares` over CasADi's simulation, compiled to its virtual machine, with Jacobian."""
    x, u, z = casadi.SX.sym("x", 2), casadi.SX.sym("u"), casadi.SX.sym("z", 3)
    J_p, K_pu, D_p = (NOMINAL[i] * casadi.exp(z[i]) for i in range(3))

    def rate(x: casadi.SX) -> casadi.SX:
        return casadi.vertcat(x[1], 2 * K_pu * u - (D_p * x[1] + MGD * casadi.sin(x[0])) / J_p)

    end, h = x, DT / 2
    for _ in range(2):
        k1 = rate(end)
        k2 = rate(end + h / 2 * k1)
        k3 = rate(end + h / 2 * k2)
        k4 = rate(end + h * k3)
        end = end + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    one = casadi.Function("step", [x, u, z], [end])
    all_inputs, all_z = casadi.MX.sym("inputs", 1, steps), casadi.MX.sym("z", 3)
    states = one.mapaccum(steps)(casadi.DM.zeros(2), all_inputs, all_z)
    pitch = casadi.horzcat(0, states[0, :]).T
    slope = casadi.jacobian(pitch, all_z)
    both = casadi.Function("both", [all_inputs, all_z], [pitch, slope])

    def fit(inputs: np.ndarray, measured: np.ndarray) -> np.ndarray:
        row = inputs[None]

        def residual(z: np.ndarray) -> np.ndarray:
            return (np.asarray(both(row, z)[0]).ravel() - measured) / SD

        def jacobian(z: np.ndarray) -> np.ndarray:
            return np.asarray(both(row, z)[1]) / SD

        slope_at: Any = jacobian
        found = scipy.optimize.least_squares(residual, np.zeros(3), jac=slope_at, method="lm")
        return NOMINAL * np.exp(found.x)

    return fit


# ------------------------------------------------------------------ SciPy in pure Python


def with_solve_ivp(inputs: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """`least_squares` over `solve_ivp` and finite differences."""
    found = scipy.optimize.least_squares(
        lambda z: (pitch_by_samples(NOMINAL * np.exp(z), inputs) - measured) / SD, np.zeros(3)
    )
    return NOMINAL * np.exp(found.x)


# ------------------------------------------------------------------ comparison


def with_excite(inputs: np.ndarray, measured: np.ndarray) -> np.ndarray:
    data = stack_experiments(PLANT, [inputs[:, None]], [measured[:, None]], True)
    return np.stack(jax.device_get(NLS()(PLANT, data).params))


def main() -> None:
    keys = jax.random.split(jax.random.key(0), BATCH)
    episodes = run_episodes(PLANT, Chirp(), STEPS, 0.3, keys)
    true = np.stack(episodes.params, axis=1)
    inputs = np.asarray(episodes.trajectory.inputs[..., 0])
    measured = np.asarray(episodes.trajectory.measured[..., 0])

    print(f"one fit of {STEPS} samples, CPU ms (median of {PLANTS} plants); largest error")
    peers = {
        "excite": with_excite,
        "SciPy + Numba": with_numba,
        "SciPy + CasADi": casadi_problem(STEPS),
        "SciPy + solve_ivp": with_solve_ivp,
    }
    times: dict[str, list[float]] = {name: [] for name in peers}
    errors = dict.fromkeys(peers, 0.0)
    for fit in peers.values():
        fit(inputs[0], measured[0])  # compiles
    for turn in range(0, PLANTS, TURN):
        for name, fit in peers.items():
            for i in range(turn, turn + TURN):
                if name == "SciPy + solve_ivp" and i > 1:
                    continue
                start = time.process_time()
                found = fit(inputs[i], measured[i])
                times[name].append(time.process_time() - start)
                errors[name] = max(errors[name], 100 * np.abs(found / true[i] - 1).max())
    first = {name: 1e3 * statistics.median(own[::TURN]) for name, own in times.items()}
    one = {name: 1e3 * statistics.median(own) for name, own in times.items()}
    for name, ms in one.items():
        cold = f"the first of a turn {first[name]:.2f} ms"
        ratio = f"ratio {one['excite'] / ms:.4g} ({first['excite'] / first[name]:.4g})"
        print(f"  {name:18} {ms:10.2f} ms ({cold})  {errors[name]:.2g} %  {ratio}")

    def batch() -> np.ndarray:
        return np.asarray(estimate_all(PLANT, NLS(), episodes.trajectory)[0])

    batch()
    each = 1e3 * statistics.median(cpu_seconds(batch) for _ in range(3)) / BATCH
    print(
        f"a batch of {BATCH}: {each:.2f} ms a fit, ratio to SciPy + Numba "
        f"{each / one['SciPy + Numba']:.2f}, to SciPy + solve_ivp "
        f"1/{one['SciPy + solve_ivp'] / each:,.0f}"
    )

    run = run_episode(PLANT, PLANT.Params(*true[0]), PRBS(), LONG, jax.random.key(1))
    u, y = np.asarray(run.inputs[:, 0]), np.asarray(run.measured[:, 0])
    long = {}
    for name, fit in (("excite", with_excite), ("SciPy + Numba", with_numba)):
        found = fit(u, y)
        long[name] = statistics.median(cpu_seconds(lambda fit=fit: fit(u, y)) for _ in range(3))
        error = 100 * np.abs(found / true[0] - 1).max()
        print(f"{LONG:,} samples: {name}, {long[name]:.2f} s, error {error:.2g} %")
    print(f"  ratio {long['excite'] / long['SciPy + Numba']:.2f}")


if __name__ == "__main__":
    main()
