"""Continuous-time output-error estimation by nonlinear least squares.

The parameters whose simulated outputs come closest to the measured ones, in the norm of
the sensor's noise, are found by multiple shooting with exact derivatives. For Gaussian
noise that is the maximum-likelihood estimate (Ljung, System Identification, ch. 7).
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..description import names_of
from ..information import fisher_information, marginal_information, relative_size
from ..plant import AbstractPlant, Params, require_double_precision
from .contract import (
    AbstractEstimator,
    Estimate,
    Experiments,
    Status,
    from_search,
    residual_of,
    simulate_experiments,
    to_search,
)
from .multiple_shooting import MultipleShooting, Segments, Solution


class NLS(AbstractEstimator):
    """Output-error nonlinear least squares by multiple shooting.

    Attributes:
        tolerance: the search ends before a step that would change the estimate by less than
            this part of its standard error.
        max_steps: of the search.
        segment_length: of multiple shooting [samples], default one for the record's length.
        known: names of parameters that are held where the search starts.
    """

    tolerance: float = eqx.field(static=True, default=1e-4)
    max_steps: int = eqx.field(static=True, default=100)
    segment_length: int | None = eqx.field(static=True, default=None)
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
        others = ~jnp.asarray(self.held(plant))
        free = others if free is None else free & others
        problem = _Problem(plant, experiments, plant.nominal if start is None else start, free)
        return problem.estimate(*self._search(problem))

    def held(self, plant: AbstractPlant) -> tuple[bool, ...]:
        """Which parameters of a plant are held; ValueError for a name it does not have."""
        names = names_of(plant.definition.parameters)
        for name in self.known:
            if name not in names:
                raise ValueError(
                    f"plant {plant.definition.name!r} has no parameter {name!r} to hold; it has "
                    f"{', '.join(names)}"
                )
        return tuple(name in self.known for name in names)

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
        """Sensitivity and residual at an estimate, over the noise's standard deviation.

        The unknowns are relative changes of the parameters, then the initial states if they
        were estimated.
        """
        problem = _Problem(plant, experiments, estimate.params, free)
        sd = problem.noise_sd(estimate.residual)
        S = problem.sensitivity(estimate.params, estimate.initial_state)
        return S / sd[None, None, :, None], estimate.residual / sd[None, None]

    def _search(self, problem: _Problem) -> tuple[Solution, Float[Array, " output"]]:
        """The minimum, its rows by sample, and the standard deviation of each output's noise."""
        experiments, plant = problem.experiments, problem.plant
        num_samples = experiments.valid.shape[1]
        segments = Segments.of(experiments, self._length(plant, num_samples))

        def weighted(sd: Array) -> MultipleShooting:
            is_free = not experiments.initial_state_known
            return MultipleShooting(plant, segments, problem.params, is_free, sd)

        def search(last: tuple[Solution, Array], stage: Array) -> tuple[tuple, None]:
            start, sd = last
            found = weighted(sd).solve(
                start,
                is_refinement=stage > 0,
                rounding=jnp.min(problem.rounding / sd),
                tolerance=self.tolerance,
                max_steps=self.max_steps,
            )
            residual = segments.joined(found.rows[..., -1], num_samples)
            return (found, problem.noise_sd(residual)), None

        first = experiments.initial_state / problem.state_scales[None]
        starts = jnp.tile(first[:, None], (1, segments.valid.shape[1], 1))
        start = weighted(problem.assumed_sd).start(problem.start, starts)
        # Several outputs: again, each weighted by its estimated noise.
        stages = jnp.arange(2 if problem.num_outputs > 1 else 1)
        (found, sd), _ = jax.lax.scan(search, (start, problem.assumed_sd), stages)
        return found._replace(rows=segments.joined(found.rows, num_samples)), sd

    def _length(self, plant: AbstractPlant, num_samples: int) -> int:
        """Length of a segment: it is short, but determines its start state."""
        needed = 4 * len(plant.definition.states)
        usual = max(needed, min(math.isqrt(num_samples), 100))
        return min(self.segment_length or usual, num_samples)


class _Problem(eqx.Module):
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
        """Parameters at search coordinates; held ones stay at the start."""
        return from_search(self.plant.definition, jnp.where(self.free, z, self.start))

    def noise_sd(self, residual: Array) -> Array:
        """Standard deviation of each output's residual, corrected for the number of unknowns."""
        num_states = 0 if self.experiments.initial_state_known else self.state_scales.size
        spent = jnp.sum(self.free) + num_states * residual.shape[0]
        count = jnp.sum(self.experiments.valid) - spent / self.num_outputs
        sd = jnp.sqrt(jnp.sum(residual**2, axis=(0, 1)) / jnp.maximum(count, 1.0))
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

    def estimate(self, found: Solution, sd: Float[Array, " output"]) -> Estimate:
        """The estimate at the end of the search, with its covariance from the estimated noise."""
        values, slope = jax.jvp(self.params, (found.z,), (jnp.ones_like(found.z),))
        params, num_params = self.plant.Params(*values), len(values)
        size = relative_size(self.plant, params)
        # From search coordinates to relative changes.
        slope = jnp.where(self.free, slope / size, 1.0)
        first, others = jnp.split(found.rows[..., :-1], [self.state_scales.size], axis=-1)
        S = others / slope[None, None, None]
        initial_state = self.experiments.initial_state
        if self.experiments.initial_state_known:
            each = jax.vmap(lambda own: fisher_information(own, sd))(S)
        else:
            S = jnp.concatenate([S, first], axis=-1)
            each = jax.vmap(lambda own: marginal_information(own, sd, num_params))(S)
            initial_state = found.starts[:, 0] * self.state_scales[None]
        information = jnp.sum(each, axis=0)
        held = jnp.diag(jnp.where(self.free, 0.0, 1.0))
        active = jnp.outer(self.free, self.free)
        relative = jnp.where(active, jnp.linalg.inv(information + held), 0.0)
        residual = -found.rows[..., -1]
        return Estimate(
            params=params,
            covariance=relative * jnp.outer(size, size),
            information=jnp.where(active, information, 0.0),
            status=_status(values, residual, relative, found.converged),
            initial_state=initial_state,
            residual=residual,
        )


def _status(params: Array, residual: Array, covariance: Array, converged: Array) -> Array:
    finite = jnp.all(jnp.isfinite(params)) & jnp.all(jnp.isfinite(residual))
    seen = jnp.all(jnp.isfinite(covariance)) & jnp.all(jnp.diagonal(covariance) >= 0)
    status = jnp.where(converged, Status.SUCCESSFUL, Status.ITERATIONS_EXHAUSTED)
    status = jnp.where(seen, status, Status.ILL_CONDITIONED)
    return jnp.where(finite, status, Status.NOT_FINITE)
