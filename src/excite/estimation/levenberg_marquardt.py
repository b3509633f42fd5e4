"""Levenberg-Marquardt: the minimum of a sum of squares, as one loop that JAX compiles.

Each step solves the damped linear least-squares problem |J d + r|^2 + |d|^2 / radius by an
orthogonal factorisation; the radius grows after good steps and shrinks after steps that are
refused (N. Gould et al., "Sensitivity of trust-region algorithms to their parameters", 4OR 3,
2005). A general library's loop would take several times as long to trace.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_ACCEPTED, _GOOD = 0.01, 0.75  # parts of the predicted reduction that a step must reach
_GROWTH, _SHRINKAGE = 3.5, 0.25  # of the radius after a good and after a refused step


class _Search(NamedTuple):
    """The best point so far with residual and Jacobian, and the next point to evaluate."""

    point: Float[Array, " unknown"]
    residual: Float[Array, " residual"]
    jacobian: Float[Array, "residual unknown"]
    candidate: Float[Array, " unknown"]
    radius: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def least_squares(
    residual: Callable[[Float[Array, " unknown"]], Float[Array, " residual"]],
    start: Float[Array, " unknown"],
    size: int,
    tolerance: float | Float[Array, ""],
    max_steps: int,
) -> tuple[Float[Array, " unknown"], Bool[Array, ""]]:
    """The point with the smallest sum of squared residuals near `start`, and whether it converged.

    Args:
        size: number of residuals.
        tolerance: the search ends after a step that changes every unknown and every residual by
            less than this, absolutely plus relatively.
    """

    def advance(s: _Search) -> _Search:
        # The residual is the auxiliary output of its derivative.
        def twice(z: Array) -> tuple[Array, Array]:
            return (r := residual(z)), r

        jacobian, found = jax.jacfwd(twice, has_aux=True)(s.candidate)
        is_first, change = s.steps == 0, s.candidate - s.point
        cost = jnp.sum(s.residual**2)
        predicted = 0.5 * (jnp.sum((s.jacobian @ change + s.residual) ** 2) - cost)
        gained = 0.5 * jnp.sum(found**2) - 0.5 * cost
        accepted = (gained <= _ACCEPTED * predicted) | is_first
        good = (gained < _GOOD * predicted) & (predicted < 0) & ~is_first
        radius = s.radius * jnp.where(accepted, jnp.where(good, _GROWTH, 1.0), _SHRINKAGE)
        settled = _is_small(change, s.candidate, tolerance)
        settled &= _is_small(found - s.residual, found, tolerance)
        point = jnp.where(accepted, s.candidate, s.point)
        best = jnp.where(accepted, found, s.residual)
        slope = jnp.where(accepted, jacobian, s.jacobian)
        return _Search(
            point=point,
            residual=best,
            jacobian=slope,
            candidate=point + _damped_step(slope, best, radius),
            radius=radius,
            steps=s.steps + 1,
            converged=accepted & settled,
        )

    def goes_on(s: _Search) -> Array:
        return ~s.converged & (s.steps < max_steps) & jnp.all(jnp.isfinite(s.point))

    empty = jnp.zeros(size), jnp.zeros((size, start.size))
    first = _Search(start, *empty, start, jnp.asarray(1.0), jnp.asarray(0), jnp.asarray(False))
    last = jax.lax.while_loop(goes_on, advance, first)
    return last.point, last.converged & jnp.all(jnp.isfinite(last.point))


def _is_small(change: Array, value: Array, tolerance: float | Array) -> Array:
    return jnp.max(jnp.abs(change) / (tolerance + tolerance * jnp.abs(value))) < 1


def _damped_step(jacobian: Array, residual: Array, radius: Array) -> Array:
    """The step d that minimises |J d + r|^2 + |d|^2 / radius."""
    info = jnp.finfo(radius.dtype)
    is_open = radius > info.eps
    damping = jnp.where(is_open, 1 / jnp.where(is_open, radius, 1.0), info.max)
    size = jacobian.shape[1]
    rows = jnp.concatenate([jacobian, jnp.sqrt(damping) * jnp.eye(size)])
    Q, R = jnp.linalg.qr(rows)
    right = Q.T @ jnp.concatenate([residual, jnp.zeros(size)])
    return -jax.scipy.linalg.solve_triangular(R, right)
