"""Continuous-time output-error estimation by nonlinear least squares.

The parameters whose simulated outputs come closest to the measured ones, in the norm of
the sensor's noise, are found by Levenberg-Marquardt on exact sensitivities. For Gaussian
noise that is the maximum-likelihood estimate (Ljung, System Identification, ch. 7).

With a wrong resonance frequency, simulation and measurement are out of phase after many
periods, and the sum of squares has other minima. The search therefore uses a growing part
of the experiment: each part determines the frequency well enough for the next, longer one.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..description import names_of
from ..information import marginal_information, relative_size
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
from .levenberg_marquardt import least_squares


class NLS(AbstractEstimator):
    """Output-error nonlinear least squares with a growing horizon.

    Attributes:
        horizons: parts of the experiment that the search uses one after the other.
        tolerance: of the last search, in search coordinates and relative to the residual;
            the first searches stop at 0.1.
        max_steps: of each search.
        known: names of parameters that are held where the search starts.
    """

    horizons: tuple[float, ...] = eqx.field(static=True, default=(0.08, 0.16, 0.32, 0.6, 1.0))
    tolerance: float = eqx.field(static=True, default=1e-5)
    max_steps: int = eqx.field(static=True, default=200)
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
        unknowns, converged = self._search(problem)
        return problem.estimate(unknowns, converged)

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

    def _search(self, problem: _Problem) -> tuple[Array, Bool[Array, ""]]:
        """Unknowns at the minimum, and whether the last search converged."""
        samples = problem.experiments.valid.shape[1]
        stages = _stages(self, samples, reweighted=problem.num_outputs > 1)

        def search(carry: tuple, stage: tuple) -> tuple[tuple, Array]:
            unknowns, sd = carry
            horizon, tolerance, boldness = stage
            seen = jnp.arange(samples)[None, :, None] < horizon

            def weighted(unknowns: Array) -> Array:
                return jnp.where(seen, problem.residual(unknowns) / sd[None, None], 0.0)

            # Relative to its size at the start, so that the damping does not depend on the data.
            size = jnp.maximum(jnp.linalg.norm(weighted(unknowns)), 1e-6) / boldness
            unknowns, converged = least_squares(
                lambda z: (weighted(z) / size).ravel(),
                unknowns,
                problem.experiments.measured.size,
                tolerance,
                self.max_steps,
            )
            if problem.num_outputs > 1:
                complete = horizon >= samples
                sd = jnp.where(complete, problem.noise_sd(problem.residual(unknowns)), sd)
            return (unknowns, sd), converged

        start = problem.with_initial_state(problem.experiments.initial_state), problem.assumed_sd
        (unknowns, _), converged = jax.lax.scan(search, start, stages)
        return unknowns, converged[-1]


def _stages(nls: NLS, samples: int, reweighted: bool) -> tuple[Array, Array, Array]:
    """Horizon [samples], tolerance and boldness (inverse damping) of each search.

    The first searches start far away and take small steps. The last starts close to the
    minimum and takes large ones, with damping 1 / boldness^2 of its initial misfit: small
    steps would be slow in the narrow valleys that friction causes.
    """
    horizons = [max(part * samples, min(samples, 40)) for part in nls.horizons]
    early = len(horizons) - 1
    tolerances, boldness = [0.1] * early + [nls.tolerance], [1.0] * early + [100.0]
    if reweighted:
        # Again, with each output weighted by its estimated noise.
        horizons, tolerances = [*horizons, horizons[-1]], [*tolerances, nls.tolerance]
        boldness = [*boldness, boldness[-1]]
    return jnp.asarray(horizons), jnp.asarray(tolerances), jnp.asarray(boldness)


class _Problem(eqx.Module):
    """The residual as a function of one vector: parameters, then initial states."""

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
        return self.experiments.measured.shape[2]

    def with_initial_state(self, initial_state: Array) -> Array:
        """Unknowns at the start parameters and this initial state."""
        if self.experiments.initial_state_known:
            return self.start
        return jnp.concatenate([self.start, (initial_state / self._state_scales[None]).ravel()])

    @property
    def _state_scales(self) -> Array:
        return jnp.asarray([s.scale for s in self.plant.definition.states])

    @property
    def assumed_sd(self) -> Array:
        """The sensor's sd; a thousandth of an output's scale where there is no noise."""
        scales = jnp.asarray([o.scale for o in self.plant.definition.outputs])
        return jnp.where(self.plant.sensor.sd > 0, self.plant.sensor.sd, 1e-3 * scales)

    def params(self, unknowns: Array) -> Array:
        z = jnp.where(self.free, unknowns[: len(self.start)], self.start)
        return from_search(self.plant.definition, z)

    def initial_state(self, unknowns: Array) -> Array:
        if self.experiments.initial_state_known:
            return self.experiments.initial_state
        rest = unknowns[len(self.start) :].reshape(self.experiments.initial_state.shape)
        return rest * self._state_scales[None]

    def residual(self, unknowns: Array) -> Array:
        params = self.plant.Params(*self.params(unknowns))
        simulated = simulate_experiments(
            self.plant, params, self.experiments, self.initial_state(unknowns)
        )
        return residual_of(self.experiments, simulated)

    def noise_sd(self, residual: Array) -> Array:
        """Standard deviation of each output's residual, corrected for the number of unknowns."""
        num_states = 0 if self.experiments.initial_state_known else self._state_scales.size
        spent = jnp.sum(self.free) + num_states * residual.shape[0]
        count = jnp.sum(self.experiments.valid) - spent / self.num_outputs
        sd = jnp.sqrt(jnp.sum(residual**2, axis=(0, 1)) / jnp.maximum(count, 1.0))
        scales = jnp.asarray([o.scale for o in self.plant.definition.outputs])
        return jnp.maximum(sd, 1e-9 * scales)  # noise-free data keep a finite weight

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
                initial_state + moved * self._state_scales[None],
            )
            return -residual_of(self.experiments, simulated)

        return jax.jacfwd(response)(jnp.zeros(len(size) + states))

    def estimate(self, unknowns: Array, converged: Array) -> Estimate:
        """The estimate at the end of the search, with its covariance from the estimated noise."""
        params = self.plant.Params(*self.params(unknowns))
        initial_state, residual = self.initial_state(unknowns), self.residual(unknowns)
        S = self.sensitivity(params, initial_state)
        S = S.reshape(-1, *S.shape[2:])  # experiments one after the other
        information = marginal_information(S, self.noise_sd(residual), len(self.start))
        held = jnp.diag(jnp.where(self.free, 0.0, 1.0))
        active = jnp.outer(self.free, self.free)
        relative = jnp.where(active, jnp.linalg.inv(information + held), 0.0)
        size = relative_size(self.plant, params)
        return Estimate(
            params=params,
            covariance=relative * jnp.outer(size, size),
            information=jnp.where(active, information, 0.0),
            status=_status(jnp.stack(params), residual, relative, converged),
            initial_state=initial_state,
            residual=residual,
        )


def _status(params: Array, residual: Array, covariance: Array, converged: Array) -> Array:
    finite = jnp.all(jnp.isfinite(params)) & jnp.all(jnp.isfinite(residual))
    seen = jnp.all(jnp.isfinite(covariance)) & jnp.all(jnp.diagonal(covariance) >= 0)
    status = jnp.where(converged, Status.SUCCESSFUL, Status.ITERATIONS_EXHAUSTED)
    status = jnp.where(seen, status, Status.ILL_CONDITIONED)
    return jnp.where(finite, status, Status.NOT_FINITE)
