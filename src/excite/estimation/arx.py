"""ARX model of order 2 by least squares, and its mapping to physical parameters.

The estimator of the paper: y_k = -a_1 y_{k-1} - a_2 y_{k-2} + b_1 u_{k-1} + b_2 u_{k-2},
fitted by recursive least squares (Ljung, System Identification, sec. 11.2), its poles
mapped to continuous time by the logarithm. The innovations are taken as white although
sensor noise enters past outputs too, which biases the damping; the start covariance acts
as a ridge penalty towards zero coefficients, which biases it further
(docs/how-to/choosing-an-estimator.md).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..plant import (
    AbstractARXPlant,
    AbstractPlant,
    Params,
    floats,
    require_double_precision,
)
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

Coefficients = Float[Array, "4"]
"""a_1, a_2, b_1, b_2."""


class RLSState(eqx.Module):
    """Memory of recursive least squares; it does not grow with time."""

    coefficients: Coefficients
    covariance: Float[Array, "4 4"]


def regressor(
    y_1: Float[Array, "*batch"],
    y_2: Float[Array, "*batch"],
    u_1: Float[Array, "*batch"],
    u_2: Float[Array, "*batch"],
) -> Float[Array, "*batch 4"]:
    """Regressor of y_k: outputs and inputs one and two samples ago."""
    return jnp.stack([-y_1, -y_2, u_1, u_2], axis=-1)


class ARX(AbstractEstimator):
    """ARX with (recursive) least squares and the plant's inverse mapping.

    Attributes:
        start_covariance: P_0 = start_covariance times identity. The paper does not state
            it; 1000 reproduces its baseline rows.
        forgetting_factor: weight of a sample one step older.
    """

    start_covariance: Float[Array, ""] = eqx.field(converter=floats, default=1000.0)
    forgetting_factor: Float[Array, ""] = eqx.field(converter=floats, default=1.0)
    name: str = eqx.field(static=True, default="arx-rls", kw_only=True)

    def init(self) -> RLSState:
        """Zero coefficients, covariance P_0."""
        return RLSState(jnp.zeros(4), self.start_covariance * jnp.eye(4))

    def update(
        self, state: RLSState, regressor: Float[Array, "4"], output: Float[Array, ""]
    ) -> RLSState:
        """Memory after one more sample."""
        P, lam = state.covariance, self.forgetting_factor
        gain = P @ regressor / (lam + regressor @ P @ regressor)
        innovation = output - regressor @ state.coefficients
        # Joseph's form: the covariance stays symmetric and positive, however small.
        rest = jnp.eye(4) - jnp.outer(gain, regressor)
        return RLSState(
            coefficients=state.coefficients + gain * innovation,
            covariance=(rest @ P @ rest.T + lam * jnp.outer(gain, gain)) / lam,
        )

    def batch(
        self,
        regressors: Float[Array, "sample 4"],
        outputs: Float[Array, " sample"],
        valid: Bool[Array, " sample"],
    ) -> RLSState:
        """The same memory from all samples at once: a ridge regression.

        The recursion from P_0 minimises the weighted squares of the innovations plus the
        weighted square of the coefficients over P_0.
        """
        later = jnp.cumsum(valid[::-1])[::-1] - valid
        weight = jnp.where(valid, self.forgetting_factor ** (later / 2), 0.0)
        start_weight = self.forgetting_factor ** (jnp.sum(valid) / 2)
        ridge = start_weight / jnp.sqrt(self.start_covariance) * jnp.eye(4)
        Q, R = jnp.linalg.qr(jnp.concatenate([regressors * weight[:, None], ridge]))
        right = Q.T @ jnp.concatenate([outputs * weight, jnp.zeros(4)])
        inverse = jax.scipy.linalg.solve_triangular(R, jnp.eye(4))
        return RLSState(inverse @ right, inverse @ inverse.T)

    @eqx.filter_jit
    def __call__(
        self,
        plant: AbstractPlant,
        experiments: Experiments,
        start: Params | None = None,
        free: Bool[Array, " param"] | None = None,
    ) -> Estimate:
        """Estimate; needs no start and cannot hold a parameter.

        Raises:
            ValueError: for a plant without inverse mapping from ARX.
        """
        del start, free
        require_double_precision()
        if not isinstance(plant, AbstractARXPlant):
            raise ValueError(
                f"plant {plant.definition.name!r} has no mapping from ARX coefficients to its "
                "parameters; use the estimator 'nls'"
            )
        regressors, outputs, valid = _regression(experiments)
        memory = self.batch(regressors, outputs, valid)
        innovations = jnp.where(valid, outputs - regressors @ memory.coefficients, 0.0)
        variance = jnp.sum(innovations**2) / jnp.maximum(jnp.sum(valid) - 4, 1)
        params, status = physical_params(plant, memory.coefficients)
        status = jnp.where(_is_ill_conditioned(regressors, valid), Status.ILL_CONDITIONED, status)
        slope = jax.jacfwd(lambda c: jnp.stack(physical_params(plant, c)[0]))(memory.coefficients)
        covariance = variance * slope @ memory.covariance @ slope.T
        simulated = simulate_experiments(plant, params, experiments, experiments.initial_state)
        return Estimate(
            params=params,
            covariance=covariance,
            information=relative_information(plant, params, covariance),
            status=status,
            initial_state=experiments.initial_state,
            residual=residual_of(experiments, simulated),
        )


def _regression(
    experiments: Experiments,
) -> tuple[Float[Array, "sample 4"], Float[Array, " sample"], Bool[Array, " sample"]]:
    """Regressors and outputs of all experiments; each regressor is from one experiment."""
    y, u = experiments.measured[..., 0], experiments.inputs[..., 0]
    rows = regressor(y[:, 1:-1], y[:, :-2], u[:, 1:], u[:, :-1])
    valid = experiments.valid[:, 2:, 0]
    return rows.reshape(-1, 4), y[:, 2:].ravel(), valid.ravel()


def _is_ill_conditioned(regressors: Array, valid: Array) -> Array:
    """Whether a regressor is zero, or nearly a combination of the others."""
    rows = jnp.where(valid[:, None], regressors, 0.0)
    size = jnp.sqrt(jnp.sum(rows**2, axis=0))
    values = jnp.linalg.svd(rows / jnp.where(size > 0, size, 1.0)[None], compute_uv=False)
    return jnp.any(size == 0) | (values[-1] < 1e-10 * values[0])


def transfer_function(
    coefficients: Coefficients, dt: Float[Array, ""]
) -> tuple[Array, Array, Array, Int[Array, ""]]:
    """c_0, c_1, d_0 of y'' + c_1 y' + c_0 y = d_0 u, and a status.

    Poles are mapped by s = log(z) / dt, the gain at zero frequency is kept. Two real
    positive poles are an overdamped system and valid; a negative real pole, or one not
    inside the unit circle, has no continuous-time counterpart of this order.
    """
    a_1, a_2, b_1, b_2 = coefficients
    discriminant = a_1**2 / 4 - a_2
    root = jnp.sqrt(discriminant.astype(complex))
    z = jnp.stack([-a_1 / 2 + root, -a_1 / 2 - root])
    s = jnp.log(z) / dt
    c_0, c_1 = (s[0] * s[1]).real, -(s[0] + s[1]).real
    d_0 = c_0 * (b_1 + b_2) / (1 + a_1 + a_2)
    negative = (discriminant >= 0) & jnp.any(z.real <= 0)
    unphysical = negative | jnp.any(jnp.abs(z) >= 1)
    finite = jnp.isfinite(c_0) & jnp.isfinite(c_1) & jnp.isfinite(d_0)
    status = jnp.where(unphysical, Status.UNPHYSICAL, Status.SUCCESSFUL)
    return c_0, c_1, d_0, jnp.where(finite, status, Status.NOT_FINITE)


def physical_params(
    plant: AbstractARXPlant, coefficients: Coefficients
) -> tuple[Params, Int[Array, ""]]:
    """The plant's parameters for ARX coefficients, and a status."""
    c_0, c_1, d_0, status = transfer_function(coefficients, plant.dt)
    params = plant.from_transfer_function(c_0, c_1, d_0)
    return params, status_of(plant, params, status)


@eqx.filter_jit
def running_params(
    estimator: ARX,
    plant: AbstractARXPlant,
    inputs: Float[Array, "time input"],
    measured: Float[Array, "sample output"],
) -> Float[Array, "sample param"]:
    """Estimates after every sample of one experiment; NaN before the first."""
    y, u = measured[:, 0], inputs[:, 0]
    rows = regressor(y[1:-1], y[:-2], u[1:], u[:-1])

    def advance(memory: RLSState, sample: tuple[Array, Array]) -> tuple[RLSState, Array]:
        memory = estimator.update(memory, *sample)
        return memory, jnp.stack(physical_params(plant, memory.coefficients)[0])

    _, params = jax.lax.scan(advance, estimator.init(), (rows, y[2:]))
    return jnp.concatenate([jnp.full((2, params.shape[1]), jnp.nan), params])
