"""Continuous-time output-error estimation by nonlinear least squares.

The parameters whose simulated outputs come closest to the measured ones, in the norm of
the sensor's noise, are found by multiple shooting with exact derivatives. For Gaussian
noise that is the maximum-likelihood estimate (Ljung, System Identification, ch. 7).
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..information import relative_size
from ..plant import AbstractPlant, Params, require_double_precision
from .contract import (
    AbstractSearch,
    Estimate,
    Experiments,
    Status,
    from_search,
    residual_of,
    simulate_experiments,
    to_search,
)
from .multiple_shooting import MultipleShooting, Point, Segments

FAR = 30.0  # largest logarithm of a positive parameter over its nominal value
Noise = Literal["declared", "known", "estimated"]


class NLS(AbstractSearch):
    """Output-error nonlinear least squares by multiple shooting.

    Attributes:
        tolerance: the search ends before a step that would change the estimate by less than
            this part of its standard error.
        max_steps: of the search.
        segment_length: of multiple shooting [samples], default one for the record's length.
        noise: "declared": an output's weight follows from its declared noise (without one, from
            its scale), the size of the noise from the residual; "known": that follows from
            the declaration, too; "estimated": the weights follow from the residual, too.
        known: names of parameters that are held where the search starts.
    """

    tolerance: float = eqx.field(static=True, default=1e-4)
    max_steps: int = eqx.field(static=True, default=100)
    segment_length: int | None = eqx.field(static=True, default=None)
    noise: Noise = eqx.field(static=True, default="declared")
    known: tuple[str, ...] = eqx.field(static=True, default=())
    name: str = eqx.field(static=True, default="nls", kw_only=True)

    @eqx.filter_jit
    def __call__(
        self,
        plant: AbstractPlant,
        experiments: Experiments,
        start: Params | None = None,
        free: Bool[Array, " param"] | None = None,
    ) -> Estimate:
        """Estimate; the initial states are estimated too unless they are known."""
        require_double_precision()
        free = self.freed(plant, free)
        problem = Problem(plant, experiments, plant.nominal if start is None else start, free)
        return problem.estimate(self._search(problem), self.noise == "known")

    @eqx.filter_jit
    def sensitivity(
        self,
        plant: AbstractPlant,
        experiments: Experiments,
        estimate: Estimate,
        free: Bool[Array, " param"] | None = None,
    ) -> tuple[
        Float[Array, "experiment sample output unknown"], Float[Array, "experiment sample output"]
    ]:
        """Sensitivity and residual at an estimate, over the standard deviation of the weights.

        The unknowns are relative changes of the parameters, then the initial states if they
        were estimated.
        """
        problem = Problem(plant, experiments, estimate.params, free)
        is_estimated = self.noise == "estimated"
        sd = problem.noise_sd(estimate.residual) if is_estimated else problem.assumed_sd
        S = problem.sensitivity(estimate.params, estimate.initial_state)
        return S / sd[None, None, :, None], estimate.residual / sd[None, None]

    def weights(
        self, plant: AbstractPlant, experiments: Experiments, estimate: Estimate
    ) -> Float[Array, " output"]:
        """The standard deviations over which the residual of an estimate counts."""
        problem = Problem(plant, experiments, estimate.params, None)
        is_estimated = self.noise == "estimated"
        return problem.noise_sd(estimate.residual) if is_estimated else problem.assumed_sd

    @eqx.filter_jit
    def constant_sensitivity(
        self, plant: AbstractPlant, experiments: Experiments, estimate: Estimate
    ) -> Float[Array, "experiment sample output constant"]:
        """Derivative of the outputs with respect to the known constants, weighted like these."""
        sd = self.weights(plant, experiments, estimate)
        names = plant.constants._fields

        def outputs(values: Array) -> Array:
            changed = plant.changed(**dict(zip(names, values, strict=True)))
            simulated = simulate_experiments(
                changed, estimate.params, experiments, estimate.initial_state
            )
            return -residual_of(experiments, simulated)

        return jax.jacfwd(outputs)(jnp.stack(plant.constants)) / sd[None, None, :, None]

    def _search(self, problem: Problem) -> _Found:
        """The minimum."""
        experiments, plant = problem.experiments, problem.plant
        num_samples = experiments.valid.shape[1]
        segments = Segments.of(experiments, self.length_of_segments(plant, num_samples))
        is_free = not experiments.initial_state_known
        shooting = MultipleShooting(plant, segments, problem.params, is_free)

        def search(start: Point, sd: Array) -> _Found:
            point, sweep, converged = shooting.solve(
                start,
                sd,
                rounding=jnp.min(problem.rounding / sd),
                tolerance=self.tolerance,
                max_steps=self.max_steps,
            )
            misfit = sweep.misfit.reshape(segments.shape[0], -1, problem.num_outputs)
            return _Found(point, converged, sweep.triangles, -misfit[:, :num_samples], sd)

        first = experiments.initial_state / problem.state_scales[None]
        starts = jnp.tile(first[:, None], (1, segments.shape[1], 1))
        sd = problem.assumed_sd
        found = search(shooting.matched(Point(problem.start, starts), sd), sd)
        if self.noise == "estimated" and problem.num_outputs > 1:
            found = search(found.point, problem.noise_sd(found.residual))
        return found

    def length_of_segments(self, plant: AbstractPlant, num_samples: int) -> int:
        """Length of a segment: it is short, but determines its start state."""
        needed = 4 * len(plant.definition.states)
        usual = max(needed, min(math.isqrt(num_samples), 100))
        return min(self.segment_length or usual, num_samples)


class _Found(NamedTuple):
    """The end of a search: point, triangle of each output, residual, and the assumed noise."""

    point: Point
    converged: Bool[Array, ""]
    triangles: Float[Array, "experiment output column column"]
    residual: Float[Array, "experiment sample output"]
    sd: Float[Array, " output"]


class Problem(eqx.Module):
    """A plant, experiments, and which parameters are free."""

    plant: AbstractPlant
    experiments: Experiments
    start: Float[Array, " param"]
    free: Bool[Array, " param"]

    def __init__(
        self, plant: AbstractPlant, experiments: Experiments, start: Params, free: Array | None
    ) -> None:
        self.plant, self.experiments = plant, experiments
        self.start = to_search(plant.definition, start)
        self.free = jnp.ones(len(self.start), bool) if free is None else free

    @property
    def num_outputs(self) -> int:
        """Number of outputs."""
        return self.experiments.measured.shape[2]

    @property
    def state_scales(self) -> Array:
        """Typical size of each state."""
        return jnp.asarray([s.scale for s in self.plant.definition.states])

    @property
    def assumed_sd(self) -> Array:
        """The sensor's sd; a thousandth of an output's scale where there is no noise."""
        scales = jnp.asarray([o.scale for o in self.plant.definition.outputs])
        return jnp.where(self.plant.sensor.sd > 0, self.plant.sensor.sd, 1e-3 * scales)

    @property
    def rounding(self) -> Float[Array, " output"]:
        """A residual of each output that is nothing but rounding."""
        return 1e-9 * jnp.asarray([o.scale for o in self.plant.definition.outputs])

    def params(self, z: Float[Array, " param"]) -> Float[Array, " param"]:
        """Parameters at search coordinates; held ones stay at the start.

        A positive one stays within a factor of exp(30) of its nominal value.
        """
        d = self.plant.definition
        usual = to_search(d, self.plant.nominal)
        positive = jnp.asarray([p.positive for p in d.parameters])
        beyond = jax.lax.stop_gradient(z - jnp.clip(z, usual - FAR, usual + FAR))
        z = z - jnp.where(positive, beyond, 0.0)  # the derivative is kept beyond the limit
        return from_search(d, jnp.where(self.free, z, self.start))

    @property
    def degrees(self) -> Float[Array, " output"]:
        """Degrees of freedom of each output's residual: values less its share of the unknowns."""
        num_experiments, num_states = self.experiments.initial_state.shape
        states = 0 if self.experiments.initial_state_known else num_experiments * num_states
        spent = (jnp.sum(self.free) + states) / self.num_outputs
        return jnp.maximum(jnp.sum(self.experiments.valid, axis=(0, 1)) - spent, 1.0)

    def noise_sd(self, residual: Array) -> Array:
        """Standard deviation of each output's residual, corrected for the number of unknowns."""
        sd = jnp.sqrt(jnp.sum(residual**2, axis=(0, 1)) / self.degrees)
        return jnp.maximum(sd, self.rounding)  # noise-free data keep a finite weight

    def sensitivity(self, params: Params, initial_state: Array) -> Array:
        """Derivative of the outputs with respect to relative parameters, then initial states."""
        size = jnp.where(self.free, relative_size(self.plant, params), 0.0)
        states = initial_state.size if not self.experiments.initial_state_known else 0

        def response(change: Array) -> Array:
            values = jnp.stack(params) + size * change[: len(size)]
            moved = change[len(size) :].reshape(initial_state.shape) if states else 0.0
            simulated = simulate_experiments(
                self.plant,
                self.plant.Params(*values),
                self.experiments,
                initial_state + moved * self.state_scales[None],
            )
            return -residual_of(self.experiments, simulated)

        return jax.jacfwd(response)(jnp.zeros(len(size) + states))

    def estimate(self, found: _Found, noise_is_known: bool) -> Estimate:
        """The estimate at the end of the search, with its covariance."""
        z = found.point.z
        values, slope = jax.jvp(self.params, (z,), (jnp.ones_like(z),))
        params, n = self.plant.Params(*values), self.state_scales.size
        size = relative_size(self.plant, params)
        slope = jnp.where(self.free, slope / size, 1.0)  # of relative changes over z
        sd = self.assumed_sd if noise_is_known else self.noise_sd(found.residual)
        weighted = found.triangles[..., :-1] / found.sd[None, :, None, None]
        columns = weighted[..., n:] / slope[None, None, None]
        initial_state = self.experiments.initial_state
        if not self.experiments.initial_state_known:
            columns = jax.vmap(_without)(columns, weighted[..., :n])
            initial_state = found.point.starts[:, 0] * self.state_scales[None]
        # H of the weighted outputs, and V of their scores, whose sd is not the assumed one.
        ratio = (sd / found.sd)[None, :, None, None]
        by_output = jnp.einsum("eokp,eokq->opq", columns, columns)
        H = jnp.sum(by_output, axis=0)
        V = jnp.einsum("o,opq->pq", ratio[0, :, 0, 0] ** 2, by_output)
        held = jnp.diag(jnp.where(self.free, 0.0, 1.0))
        active = jnp.outer(self.free, self.free)
        # Over the columns' lengths: one parameter that hardly acts leaves the others' digits.
        length = jnp.sqrt(jnp.where(jnp.diagonal(H) > 0, jnp.diagonal(H), 1.0))
        cosines = jnp.where(active, H / jnp.outer(length, length), 0.0) + held
        inverse = jnp.where(active, jnp.linalg.inv(cosines) / jnp.outer(length, length), 0.0)
        relative = inverse @ V @ inverse
        # Of a sum of estimated variances (F. Satterthwaite, Biometrics Bulletin 2, 1946).
        parts = jnp.einsum("o,pq,oqr,rp->op", ratio[0, :, 0, 0] ** 2, inverse, by_output, inverse)
        spread = jnp.sum(parts**2 / self.degrees[:, None], axis=0)
        degrees = jnp.where(spread > 0, jnp.sum(parts, axis=0) ** 2 / spread, jnp.inf)
        information = jnp.einsum("eokp,eokq->pq", columns / ratio, columns / ratio)
        return Estimate(
            params=params,
            covariance=relative * jnp.outer(size, size),
            information=jnp.where(active, information, 0.0),
            status=status_of_search(values, found.residual, relative, found.converged),
            initial_state=initial_state,
            residual=found.residual,
            cost=jnp.sum((found.residual / found.sd[None, None]) ** 2),
            degrees=jnp.full_like(degrees, jnp.inf) if noise_is_known else degrees,
        )


def _without(
    columns: Float[Array, "output row param"], others: Float[Array, "output row state"]
) -> Array:
    """Columns less what the other columns explain of them, all outputs together.

    A direction of the others that is not determined explains nothing.
    """
    a, b = others.reshape(-1, others.shape[-1]), columns.reshape(-1, columns.shape[-1])
    prior = 1e-6 * jnp.eye(a.shape[1])
    q, _ = jnp.linalg.qr(jnp.concatenate([a, prior]))
    b = jnp.concatenate([b, jnp.zeros((a.shape[1], b.shape[1]))])
    return (b - q @ (q.T @ b))[: len(a)].reshape(columns.shape)


def status_of_search(params: Array, residual: Array, covariance: Array, converged: Array) -> Array:
    """The status of an estimate that was searched for."""
    finite = jnp.all(jnp.isfinite(params)) & jnp.all(jnp.isfinite(residual))
    seen = jnp.all(jnp.isfinite(covariance)) & jnp.all(jnp.diagonal(covariance) >= 0)
    status = jnp.where(converged, Status.SUCCESSFUL, Status.ITERATIONS_EXHAUSTED)
    status = jnp.where(seen, status, Status.ILL_CONDITIONED)
    return jnp.where(finite, status, Status.NOT_FINITE)
