"""The paper's decision process as one would write it in NumPy, without excite and without JAX.

An oracle for `excite.env`, and what its speed is compared with.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

NOMINAL = np.array([0.0232, 0.0125, 0.00104])  # J_p, K_pu, D_p
STIFFNESS = 1.07 * 9.81 * 0.0019435  # m g d_S [N m]
DT, SUBSTEPS = 0.1, 2
U_MAX = 24.0
Y_MAX, WARNING, CRITICAL = math.radians(45), math.radians(30), math.radians(40)
MAX_ERROR = 100.0


class PlainAero2Env(gymnasium.Env[np.ndarray, np.ndarray]):
    """Eq. 1-4 of Langschwert et al., one step after the other.

    Options of `reset`: `params`, the true J_p, K_pu, D_p (drawn within ± 30 % where not
    given); `noise`, sensor noise of the T + 1 measurements [rad] (zero where not given).
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, num_steps: int = 500, window: int = 80, spread: float = 0.3) -> None:
        self.num_steps, self.window, self.spread = num_steps, window, spread
        size = 2 * window + 1
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        options = options or {}
        factors = 1 + self.np_random.uniform(-self.spread, self.spread, 3)
        self.params = np.asarray(options.get("params", NOMINAL * factors), float)
        self.noise = np.asarray(options.get("noise", np.zeros(self.num_steps + 1)), float)
        self.k = 0
        self.theta, self.theta_dot = 0.0, 0.0
        self.largest = 0.0
        self.outputs, self.inputs = np.zeros(self.window), np.zeros(self.window)
        self.coefficients, self.P = np.zeros(4), 1000.0 * np.eye(4)
        self.y = [self.theta + self.noise[0]]
        self.u: list[float] = []
        self.outputs[-1] = self.y[0]
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        u = U_MAX * min(max(float(action[0]), -1.0), 1.0)
        self._integrate(u)
        self.k += 1
        y = self.theta + self.noise[self.k]
        self.y.append(y)
        self.u.append(u)
        if self.k >= 2:
            self._recursion(y)
        self.outputs[:-1], self.outputs[-1] = self.outputs[1:], y
        self.inputs[:-1], self.inputs[-1] = self.inputs[1:], u
        penalty = safety_penalty(self.theta)
        self.largest = max(self.largest, abs(self.theta))
        info = {"penalty": penalty, "is_violation": self.largest >= CRITICAL}
        reward, is_last = penalty, self.k == self.num_steps
        if is_last:
            info["estimate"] = physical_params(self.coefficients)
            info["relative_errors"] = relative_errors(info["estimate"], self.params)
            reward -= info["relative_errors"].sum()
        return self._observation(), float(reward), is_last, False, info

    def _observation(self) -> np.ndarray:
        observation = np.empty(2 * self.window + 1, np.float32)
        observation[: self.window] = self.outputs / Y_MAX
        observation[self.window : -1] = self.inputs / U_MAX
        observation[-1] = self.k / self.num_steps
        return observation

    def _integrate(self, u: float) -> None:
        J_p, K_pu, D_p = self.params.tolist()

        def acceleration(theta: float, theta_dot: float) -> float:
            return 2 * K_pu * u - (D_p * theta_dot + STIFFNESS * math.sin(theta)) / J_p

        h = DT / SUBSTEPS
        x, v = self.theta, self.theta_dot
        for _ in range(SUBSTEPS):
            v1, a1 = v, acceleration(x, v)
            v2, a2 = v + h / 2 * a1, acceleration(x + h / 2 * v1, v + h / 2 * a1)
            v3, a3 = v + h / 2 * a2, acceleration(x + h / 2 * v2, v + h / 2 * a2)
            v4, a4 = v + h * a3, acceleration(x + h * v3, v + h * a3)
            x += h / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
            v += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        self.theta, self.theta_dot = x, v

    def _recursion(self, y: float) -> None:
        """Recursive least squares without forgetting (Ljung, sec. 11.2)."""
        phi = np.array([-self.y[-2], -self.y[-3], self.u[-1], self.u[-2]])
        P_phi = self.P @ phi
        gain = P_phi / (1.0 + phi @ P_phi)
        self.coefficients = self.coefficients + gain * (y - phi @ self.coefficients)
        self.P = self.P - np.outer(gain, P_phi)


def safety_penalty(theta: float) -> float:
    """Eq. 3."""
    if abs(theta) >= CRITICAL:
        return -1 - 2 * (abs(theta) - CRITICAL) / CRITICAL
    if abs(theta) >= WARNING:
        return -0.1 * ((abs(theta) - WARNING) / (CRITICAL - WARNING)) ** 2
    return 0.0


def physical_params(coefficients: np.ndarray) -> np.ndarray:
    """J_p, K_pu, D_p whose linearised, sampled equation of motion has these coefficients."""
    a_1, a_2, b_1, b_2 = coefficients
    with np.errstate(divide="ignore", invalid="ignore"):
        poles = np.log(np.roots([1.0, a_1, a_2]).astype(complex)) / DT
        c_0, c_1 = np.prod(poles).real, -np.sum(poles).real
        J_p = STIFFNESS / c_0
        return np.array([J_p, c_0 * (b_1 + b_2) / (1 + a_1 + a_2) / 2, c_1 * J_p])


def relative_errors(estimate: np.ndarray, params: np.ndarray) -> np.ndarray:
    """The terms of Eq. 4, bounded so that one failed estimate is not worth all others."""
    errors = np.abs(estimate - params) / params
    return np.where(np.isfinite(errors), np.minimum(errors, MAX_ERROR), MAX_ERROR)
