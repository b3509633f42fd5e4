"""One-step prediction of a disturbed plant by a continuous-discrete extended Kalman filter.

The state follows dx = f(x, u) dt + diag(sigma) dw with independent Wiener processes w; sigma is
the process noise [state unit / sqrt(s)]. Between samples the mean is integrated by
`simulation.step`, the covariance by the Jacobian A of each of its Runge-Kutta steps,

    P' = A P A' + Q,    Q = integral of Phi diag(sigma^2) Phi' over the step

with Simpson's rule for Q, which is of the integrator's order and always positive. The outputs
of a sample enter one after the other, so nothing is inverted, and in Joseph's form, so that P
stays positive (A. Jazwinski, Stochastic Processes and Filtering Theory, 1970, ch. 7 and 8). Their
slopes are differences over a standard deviation of each state (M. Norgaard, N. Poulsen, O. Ravn,
"New developments in state estimation for nonlinear systems", Automatica 36, 2000): where an
output saturates, the likelihood remains continuous.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..plant import AbstractPlant, Params
from ..simulation import acting, over_substeps, step

_NARROW = 1e-5  # least width of a difference, over a state's scale


class Innovations(NamedTuple):
    """One-step prediction errors of one experiment.

    Attributes:
        value, variance: of each output, given all before it, also the outputs before it in the
            same sample; 0 and 1 where it was not measured. They are independent.
        predicted: outputs, from all earlier samples.
        sd: of measured minus predicted outputs.
    """

    value: Float[Array, "sample output"]
    variance: Float[Array, "sample output"]
    predicted: Float[Array, "sample output"]
    sd: Float[Array, "sample output"]

    @property
    def cost(self) -> Float[Array, ""]:
        """Minus the logarithm of the likelihood, less log(2 pi)/2 for each measured value."""
        return 0.5 * jnp.sum(jnp.log(self.variance) + self.value**2 / self.variance)


def innovations(
    plant: AbstractPlant,
    params: Params,
    process_noise: Float[Array, " state"],
    noise_sd: Float[Array, " output"],
    initial_state: Float[Array, " state"],
    steps: tuple[Array, Array | None, Array | None],
    measured: Float[Array, "sample output"],
    valid: Bool[Array, "sample output"],
) -> Innovations:
    """Filters one experiment from an initial state without uncertainty.

    Args:
        process_noise: sigma [state unit / sqrt(s)].
        noise_sd: of the sensors [output unit].
        steps: inputs, dt and next inputs of one of the `Experiments`.
    """

    def advance(belief: tuple[Array, Array], now: tuple) -> tuple[tuple[Array, Array], Innovations]:
        inputs, measured, valid = now
        belief, found = _corrected(plant, params, noise_sd, *belief, inputs[0], measured, valid)
        return _predicted(plant, params, process_noise, *belief, *inputs), found

    now = acting(plant, params, *steps)
    padded = jax.tree.map(lambda rows: jnp.concatenate([rows, rows[-1:]]), now)
    begin = initial_state, jnp.zeros((len(initial_state),) * 2)
    return jax.lax.scan(advance, begin, (padded, measured, valid))[1]


def _corrected(
    plant: AbstractPlant,
    params: Params,
    noise_sd: Float[Array, " output"],
    state: Float[Array, " state"],
    covariance: Float[Array, "state state"],
    input: Float[Array, " input"],
    measured: Float[Array, " output"],
    valid: Bool[Array, " output"],
) -> tuple[tuple[Array, Array], Innovations]:
    """Mean and covariance after the outputs of one sample, and the innovations."""
    scales = jnp.asarray([s.scale for s in plant.definition.states])
    width = jnp.sqrt(jnp.diagonal(covariance) + (_NARROW * scales) ** 2)

    def output(state: Array) -> Array:
        return plant.output(state, *plant.feedthrough_input(input), params)

    aside = jnp.diag(width)
    above, below = jax.vmap(output)(state[None] + aside), jax.vmap(output)(state[None] - aside)
    C, predicted = ((above - below) / (2 * width[:, None])).T, output(state)
    sd = jnp.sqrt(jnp.einsum("oi,ij,oj->o", C, covariance, C) + noise_sd**2)
    error = jnp.where(valid, measured - predicted, 0.0)
    change, P, each = jnp.zeros_like(state), covariance, []
    for c, e, r, is_seen in zip(C, error, noise_sd, valid, strict=True):
        value, variance = e - c @ change, c @ P @ c + r**2
        K = jnp.where(is_seen, P @ c / variance, 0.0)
        L = jnp.eye(len(c)) - jnp.outer(K, c)
        change, P = change + K * value, L @ P @ L.T + r**2 * jnp.outer(K, K)
        each.append((jnp.where(is_seen, value, 0.0), jnp.where(is_seen, variance, 1.0)))
    value, variance = (jnp.stack(parts) for parts in zip(*each, strict=True))
    return (state + change, P), Innovations(value, variance, predicted, sd)


def _predicted(
    plant: AbstractPlant,
    params: Params,
    process_noise: Float[Array, " state"],
    state: Float[Array, " state"],
    covariance: Float[Array, "state state"],
    input: Float[Array, " input"],
    dt: Float[Array, ""] | None,
    next_input: Float[Array, " input"] | None,
) -> tuple[Array, Array]:
    """Mean and covariance at the next sample; one Runge-Kutta step after the other."""
    d, n = plant.definition, plant.substeps
    single = plant.changed(dt=d.dt / d.substeps)  # integrated in one Runge-Kutta step
    h = (plant.dt if dt is None else dt) / n
    Q = jnp.diag(process_noise**2) * (h / 6)

    def at(fraction: Array) -> Array:
        return input if next_input is None else input + fraction * (next_input - input)

    def substep(belief: tuple[Array, Array], k: Array) -> tuple[tuple[Array, Array], None]:
        x, P = belief
        first, middle, last = (at((k + part) / n) for part in (0.0, 0.5, 1.0))

        def end(x: Array, begin: Array, duration: Array) -> tuple[Array, Array]:
            after = step(single, x, begin, params, duration, None if next_input is None else last)
            return after, after

        differentiated = jax.jacfwd(end, has_aux=True)
        half = step(single, x, first, params, h / 2, None if next_input is None else middle)
        A, after = differentiated(x, first, h)
        B, _ = differentiated(half, middle, h / 2)
        return (after, A @ (P + Q) @ A.T + 4 * (B @ Q @ B.T) + Q), None

    return over_substeps(substep, (state, covariance), n)
