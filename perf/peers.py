"""What both scripts compare with: the Aero 2 written for SciPy, and a way to time things."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.integrate

MGD = 1.07 * 9.81 * 0.0019435
DT = 0.1


def seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median duration of one call."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def _rate(t: float, x: np.ndarray, u: float, p: np.ndarray) -> list[float]:
    J_p, K_pu, D_p = p
    return [x[1], 2 * K_pu * u - (D_p * x[1] + MGD * np.sin(x[0])) / J_p]


def pitch_by_samples(p: np.ndarray, inputs: np.ndarray, rtol: float = 1e-6) -> np.ndarray:
    """One call of solve_ivp a sample: exact at every switch of the held input."""
    x, pitch = np.zeros(2), [0.0]
    for u in inputs:
        run = scipy.integrate.solve_ivp(_rate, (0, DT), x, args=(u, p), rtol=rtol, atol=rtol * 1e-3)
        x = run.y[:, -1]
        pitch.append(x[0])
    return np.array(pitch)


def pitch_in_one_call(p: np.ndarray, inputs: np.ndarray, rtol: float = 1e-6) -> np.ndarray:
    """One call for the whole experiment, the held input looked up by time."""
    end = len(inputs) * DT

    def rate(t: float, x: np.ndarray) -> list[float]:
        return _rate(t, x, inputs[min(int(t / DT + 1e-9), len(inputs) - 1)], p)

    samples = np.linspace(0, end, len(inputs) + 1)
    run = scipy.integrate.solve_ivp(
        rate, (0, end), np.zeros(2), t_eval=samples, rtol=rtol, atol=rtol * 1e-3, max_step=DT
    )
    return run.y[0]
