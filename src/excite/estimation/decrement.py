"""Logarithmic decrement: poles from a free decay, the classical way to a damping.

After the input has come to rest a plant of order 2 swings with y = A exp(-sigma t) cos(...).
The times at which it passes zero give the damped frequency, the logarithms of its peaks the
decay rate sigma (W. T. Thomson, Theory of Vibration with Applications, ch. 2); the gain is
then one least-squares factor of the whole response.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..information import require_double_precision
from ..plant import AbstractARXPlant, AbstractPlant, Params
from .base import (
    AbstractEstimator,
    Estimate,
    Experiments,
    Status,
    relative_information,
    residual_of,
    simulate_experiments,
    status_of,
)

MIN_SWINGS = 3
"""Half swings that a decay must show."""

SMALL_GAIN = 1e-6


class Line(eqx.Module):
    """A straight line through points: its slope, and the slope's variance."""

    slope: Float[Array, ""]
    variance: Float[Array, ""]


class Decrement(AbstractEstimator):
    """Logarithmic decrement of the free decay at the end of one experiment.

    Its covariance counts the scatter of peaks and zero crossings about their lines.
    """

    name: str = eqx.field(static=True, default="decrement", kw_only=True)

    @eqx.filter_jit
    def __call__(
        self,
        plant: AbstractPlant,
        experiments: Experiments,
        start: Params | None = None,
        free: Bool[Array, " param"] | None = None,
    ) -> Estimate:
        """Estimate from one experiment; needs no start and cannot hold a parameter.

        Raises:
            ValueError: for several experiments, or a plant whose parameters do not follow
                from its poles and gain.
        """
        del start, free
        require_double_precision()
        if not isinstance(plant, AbstractARXPlant):
            raise ValueError(
                f"plant {plant.definition.name!r} has no mapping from poles and gain to its "
                "parameters; use the estimator 'nls'"
            )
        if len(experiments.inputs) != 1:
            raise ValueError(f"'decrement' takes one record: got {len(experiments.inputs)}")
        rate, frequency, count = _decay(plant, experiments)
        sigma, omega = -rate.slope, jnp.pi / frequency.slope
        c_0, c_1 = omega**2 + sigma**2, 2 * sigma
        # So small a gain keeps the response linear, and that is all it is for.
        unit = plant.from_transfer_function(c_0, c_1, jnp.asarray(SMALL_GAIN))
        response = simulate_experiments(plant, unit, experiments, experiments.initial_state)
        response = jnp.where(experiments.valid[..., None], response, 0.0)
        power = jnp.sum(response**2)
        gain = jnp.sum(response * experiments.measured) / power
        residual = residual_of(experiments, gain * response)
        variance_omega = frequency.variance * (jnp.pi / frequency.slope**2) ** 2
        spread = jnp.stack([variance_omega, rate.variance, jnp.mean(residual**2) / power])

        def physical(poles: Float[Array, "3"]) -> Float[Array, " param"]:
            omega, sigma, gain = poles
            squares = omega**2 + sigma**2
            return jnp.stack(plant.from_transfer_function(squares, 2 * sigma, SMALL_GAIN * gain))

        found = jnp.stack([omega, sigma, gain])
        slope = jax.jacfwd(physical)(found)
        covariance = (slope * spread[None]) @ slope.T
        params = plant.Params(*physical(found))
        status = status_of(plant, params, jnp.asarray(Status.SUCCESSFUL))
        return Estimate(
            params=params,
            covariance=covariance,
            information=relative_information(plant, params, covariance),
            status=jnp.where(count < MIN_SWINGS, Status.ILL_CONDITIONED, status),
            initial_state=experiments.initial_state,
            residual=residual,
        )


def _decay(plant: AbstractPlant, experiments: Experiments) -> tuple[Line, Line, Array]:
    """Log of peaks over time, time of zero crossings over their number, and whole half swings."""
    inputs, y = experiments.inputs[0], experiments.measured[0, :, 0]
    valid = experiments.valid[0]
    num_inputs = jnp.sum(valid) - 1
    index = jnp.arange(len(y))
    last = inputs[num_inputs - 1]
    moving = jnp.any(inputs != last[None], axis=1) & (index[:-1] < num_inputs)
    begin = jnp.max(jnp.where(moving, index[:-1] + 1, 0))  # the input rests from here on
    is_free = valid & (index >= begin)
    crossing = is_free[1:] & is_free[:-1] & ((y[1:] >= 0) != (y[:-1] >= 0))
    fraction = y[:-1] / jnp.where(crossing, y[:-1] - y[1:], 1.0)
    times = plant.dt * (index[:-1] + fraction)
    number = jnp.cumsum(crossing)
    swing = jnp.concatenate([jnp.zeros(1, number.dtype), number])  # of every sample
    is_whole = is_free & (swing >= 1) & (swing < number[-1])
    peaks = jax.ops.segment_max(jnp.where(is_whole, jnp.abs(y), 0.0), swing, len(y))
    is_peak = is_whole & (jnp.abs(y) == peaks[swing]) & (y != 0)
    top, when = _vertex(jnp.abs(y))
    rate = _line((index + when) * plant.dt, jnp.log(jnp.where(is_peak, top, 1.0)), is_peak)
    return rate, _line(number.astype(float), times, crossing), number[-1] - 1


def _vertex(y: Float[Array, " sample"]) -> tuple[Array, Array]:
    """Height, and place in samples, of the parabola's vertex about every sample."""
    before, after = jnp.roll(y, 1), jnp.roll(y, -1)
    bend = before - 2 * y + after
    place = jnp.where(bend < 0, (before - after) / (2 * jnp.where(bend < 0, bend, 1.0)), 0.0)
    return y - (before - after) * place / 4, place


def _line(
    x: Float[Array, " point"], y: Float[Array, " point"], chosen: Bool[Array, " point"]
) -> Line:
    """Least-squares line through the chosen points."""
    count = jnp.sum(chosen)
    mean_x = jnp.sum(jnp.where(chosen, x, 0.0)) / count
    mean_y = jnp.sum(jnp.where(chosen, y, 0.0)) / count
    dx, dy = jnp.where(chosen, x - mean_x, 0.0), jnp.where(chosen, y - mean_y, 0.0)
    power = jnp.sum(dx**2)
    slope = jnp.sum(dx * dy) / power
    return Line(slope, jnp.sum((dy - slope * dx) ** 2) / jnp.maximum(count - 2, 1) / power)
