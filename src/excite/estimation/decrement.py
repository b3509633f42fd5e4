"""Logarithmic decrement: poles and damping from a free decay.

After the input has come to rest a plant of order 2 swings with y = A exp(-sigma t) cos(...).
The times at which it passes zero give the damped frequency, the logarithms of its peaks the
decay rate sigma (W. T. Thomson, Theory of Vibration with Applications, ch. 2); the gain is
then one least-squares factor of the whole response.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..plant import AbstractARXPlant, AbstractPlant, Params, require_double_precision
from .contract import (
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
"""Smallest number of half swings of a decay."""

MIN_PEAK = 8.0
"""Smallest peak of the decay, in standard deviations of the sensor."""

SMALL = 1e-6


class Line(eqx.Module):
    """A straight line through points: its slope, and the slope's variance."""

    slope: Float[Array, ""]
    variance: Float[Array, ""]


class Decrement(AbstractEstimator):
    """Logarithmic decrement of the free decay at the end of one experiment.

    Its covariance counts the scatter of peaks and zero crossings about their lines.
    """

    name: str = eqx.field(static=True, default="decrement", kw_only=True)
    needs: ClassVar[str] = "an input that ends at rest, and a free decay after it"

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
        poles = jnp.stack([jnp.pi / frequency.slope, -rate.slope])
        variance = jnp.stack(
            [frequency.variance * (jnp.pi / frequency.slope**2) ** 2, rate.variance]
        )
        gain, response = _gain(plant, experiments, poles)
        # Effect of the poles' errors on the gain; the error of the gain alone is added.
        slope = jax.jacfwd(lambda poles: _gain(plant, experiments, poles)[0].slope)(poles)
        mixing = jnp.concatenate([jnp.eye(2), slope[None]])
        own = jnp.zeros((3, 3)).at[2, 2].set(gain.variance)
        spread = (mixing * variance[None]) @ mixing.T + own

        def physical(found: Float[Array, "3"]) -> Float[Array, " param"]:
            omega, sigma, gain = found
            squares = omega**2 + sigma**2
            return jnp.stack(plant.from_transfer_function(squares, 2 * sigma, SMALL * gain))

        found = jnp.concatenate([poles, gain.slope[None]])
        to_params = jax.jacfwd(physical)(found)
        covariance = to_params @ spread @ to_params.T
        params = plant.Params(*physical(found))
        status = status_of(plant, params, jnp.asarray(Status.SUCCESSFUL))
        return Estimate(
            params=params,
            covariance=covariance,
            information=relative_information(plant, params, covariance),
            status=jnp.where(count < MIN_SWINGS, Status.ILL_CONDITIONED, status),
            initial_state=experiments.initial_state,
            residual=residual_of(experiments, response),
        )


def _gain(
    plant: AbstractARXPlant, experiments: Experiments, poles: Float[Array, "2"]
) -> tuple[Line, Float[Array, "1 sample output"]]:
    """The gain that fits the whole response best, and the response.

    Where the initial state is not known, the free response to it is fitted too.
    """
    omega, sigma = poles
    c_0, c_1 = omega**2 + sigma**2, 2 * sigma
    # The gain is small only to keep the response linear.
    unit = plant.from_transfer_function(c_0, c_1, jnp.asarray(SMALL))
    columns = [simulate_experiments(plant, unit, experiments, experiments.initial_state)]
    if not experiments.initial_state_known:
        silent = eqx.tree_at(lambda e: e.inputs, experiments, 0 * experiments.inputs)
        rest = plant.initial_state
        columns = [simulate_experiments(plant, unit, experiments, rest[None])]
        columns += [
            simulate_experiments(plant, unit, silent, (rest + SMALL * away)[None])
            for away in jnp.eye(len(rest))
        ]
    seen = experiments.valid[0, :, 0]
    X = jnp.stack([jnp.where(seen, column[0, :, 0], 0.0) for column in columns], axis=1)
    inverse = jnp.linalg.inv(X.T @ X)
    factors = inverse @ (X.T @ jnp.where(seen, experiments.measured[0, :, 0], 0.0))
    response = (X @ factors)[None, :, None]
    power = jnp.sum(residual_of(experiments, response) ** 2) / jnp.sum(seen)
    return Line(factors[0], power * inverse[0, 0]), response


def _decay(plant: AbstractPlant, experiments: Experiments) -> tuple[Line, Line, Array]:
    """Log of peaks over time, time of zero crossings over their number, complete half swings."""
    inputs, y = experiments.inputs[0], experiments.measured[0, :, 0]
    valid = experiments.valid[0, :, 0]
    num_inputs = jnp.sum(valid) - 1
    index = jnp.arange(len(y))
    last = inputs[num_inputs - 1]
    moving = jnp.any(inputs != last[None], axis=1) & (index[:-1] < num_inputs)
    begin = jnp.max(jnp.where(moving, index[:-1] + 1, 0))  # the input is constant from here on
    is_free = valid & (index >= begin)
    crossing = is_free[1:] & is_free[:-1] & ((y[1:] >= 0) != (y[:-1] >= 0))
    fraction = y[:-1] / jnp.where(crossing, y[:-1] - y[1:], 1.0)
    times = plant.dt * (index[:-1] + fraction)
    number = jnp.cumsum(crossing)
    swing = jnp.concatenate([jnp.zeros(1, number.dtype), number])  # of every sample
    peaks = jax.ops.segment_max(jnp.where(is_free, jnp.abs(y), 0.0), swing, len(y))
    # The decay ends with the last half swing before the first one below the noise.
    is_low = (peaks < MIN_PEAK * plant.sensor.sd[0]) & (jnp.arange(len(y)) >= 1)
    last_swing = jnp.minimum(jnp.argmax(is_low), number[-1])
    is_whole = is_free & (swing >= 1) & (swing < last_swing)
    is_peak = is_whole & (jnp.abs(y) == peaks[swing]) & (y != 0)
    crossing = crossing & (number <= last_swing)
    top, when = _vertex(jnp.abs(y))
    rate = _line((index + when) * plant.dt, jnp.log(jnp.where(is_peak, top, 1.0)), is_peak)
    return rate, _line(number.astype(float), times, crossing), last_swing - 1


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
