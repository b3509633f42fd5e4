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
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..description import names_of
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
from .multiple_shooting import (
    FREEDOM,
    MultipleShooting,
    Point,
    Segments,
    student_root,
    where_tree,
)
from .prior import Prior

FAR = 30.0  # largest logarithm of a positive parameter over its nominal value
_POOR = 4.0  # mean square of the residual over the assumed noise, beyond which a search is repeated
_LITTLE = 0.02  # part of an output's variation left, beyond which a search begins elsewhere
_ASIDE = 0.2  # how far, in search coordinates
_ROUNDS, _SCALE_STEPS = 3, 20  # searches with the noise found by the one before; of its scale
Noise = Literal["declared", "known", "estimated"]
Likelihood = Literal["normal", "student"]


class NLS(AbstractSearch):
    """Output-error nonlinear least squares by multiple shooting.

    A search that leaves much more than the declared noise is repeated without the first phase of
    multiple shooting, and where more than a fiftieth of an output's variation is left, from two
    other starts; the best end counts.

    Attributes:
        tolerance: the search ends before a step that would change the estimate by less than
            this part of its standard error.
        max_steps: of the search.
        segment_length: of multiple shooting [samples], default one for the record's length.
        noise: "declared": an output's weight follows from its declared noise (without one, from
            its scale), the size of the noise from the residual; "known": that follows from
            the declaration, too; "estimated": the weights follow from the residual, too.
        known: names of parameters that are held where the search starts.
        likelihood: "student": the noise has Student's distribution with 4 degrees of freedom, so
            that outliers hardly count.
        prior: of parameters. It is weighed against the noise that is found, so with it, and with
            Student's distribution, a noise that is not known is estimated for each output.
    """

    tolerance: float = eqx.field(static=True, default=1e-4)
    max_steps: int = eqx.field(static=True, default=100)
    segment_length: int | None = eqx.field(static=True, default=None)
    noise: Noise = eqx.field(static=True, default="declared")
    known: tuple[str, ...] = eqx.field(static=True, default=())
    likelihood: Likelihood = eqx.field(static=True, default="normal")
    prior: Prior | None = None
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
        begin = plant.nominal if start is None else start
        problem = Problem(plant, experiments, begin, free, self.prior)
        found = self._search(problem)
        cost = self._cost(problem, found)
        sd, residual = self._as_normal(problem, found.residual, found.sd)
        is_known = self.noise == "known" and self.likelihood == "normal"
        noise_sd = sd if is_known else problem.noise_sd(residual)
        return problem.estimate(found._replace(sd=sd), cost, noise_sd, self.noise == "known")

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
        were estimated. With Student's distribution they are those of the normal problem that has
        the same estimate and covariance.
        """
        problem = Problem(plant, experiments, estimate.params, free, self.prior)
        sd = self.weights(plant, experiments, estimate)
        sd, residual = self._as_normal(problem, estimate.residual, sd)
        S = problem.sensitivity(estimate.params, estimate.initial_state)
        return S / sd[None, None, :, None], residual / sd[None, None]

    @eqx.filter_jit
    def weights(
        self, plant: AbstractPlant, experiments: Experiments, estimate: Estimate
    ) -> Float[Array, " output"]:
        """The standard deviations over which the residual of an estimate counts."""
        problem = Problem(plant, experiments, estimate.params, None)
        return self.scale(problem, estimate.residual) if self.finds_noise else problem.assumed_sd

    @eqx.filter_jit
    def sum_of_squares(
        self, plant: AbstractPlant, experiments: Experiments, estimate: Estimate
    ) -> Float[Array, ""]:
        """What a search with this noise minimises, at an estimate."""
        problem = Problem(plant, experiments, estimate.params, None, self.prior)
        sd = self.weights(plant, experiments, estimate)
        return self._squares(problem, problem.start, estimate.residual, sd)

    @eqx.filter_jit
    def prior_information(
        self,
        plant: AbstractPlant,
        estimate: Estimate,
        num_unknowns: int,
        free: Bool[Array, " param"] | None = None,
    ) -> Float[Array, "unknown unknown"]:
        """What the prior tells of the unknowns of `sensitivity`; nothing of held ones."""
        found = jnp.zeros((num_unknowns, num_unknowns))
        if self.prior is None:
            return found
        size, names = relative_size(plant, estimate.params), names_of(plant.definition.parameters)
        rows = jax.jacfwd(self.prior.residual, argnums=1)(names, jnp.stack(estimate.params))
        rows = rows * (size if free is None else jnp.where(free, size, 0.0))[None]
        return found.at[: len(names), : len(names)].set(rows.T @ rows)

    @property
    def finds_noise(self) -> bool:
        """Whether the weights follow from the residual."""
        estimates = self.prior is not None or self.likelihood == "student"
        return self.noise == "estimated" or (estimates and self.noise != "known")

    def _squares(self, problem: Problem, z: Array, residual: Array, sd: Array) -> Array:
        """Sum of squares of the residual over its scale, and of the prior."""
        u = residual / sd[None, None]
        u = student_root(u)[0] if self.likelihood == "student" else u
        return jnp.sum(u**2) + jnp.sum(problem.prior_residual(z) ** 2)

    def _cost(self, problem: Problem, found: _Found) -> Float[Array, ""]:
        """That sum, or one that grows with the negative logarithm of the likelihood.

        Where noise is estimated, sums over different noise cannot be compared.
        """
        squares = self._squares(problem, found.point.z, found.residual, found.sd)
        if not self.finds_noise:
            return squares
        counts = jnp.sum(problem.experiments.valid, axis=(0, 1))
        logarithm = jnp.sum(counts * jnp.log((found.sd / problem.assumed_sd) ** 2))
        return jnp.sum(counts) * jnp.exp((logarithm + squares) / jnp.sum(counts) - 1)

    def _as_normal(
        self, problem: Problem, residual: Float[Array, "experiment sample output"], scale: Array
    ) -> tuple[Float[Array, " output"], Float[Array, "experiment sample output"]]:
        """Weights and residual of the normal problem with the same estimate and covariance.

        Of an M-estimator (P. Huber, Robust Statistics, 1981, section 7.6).
        """
        if self.likelihood == "normal":
            return scale, residual
        u2 = (residual / scale[None, None]) ** 2
        slope = (FREEDOM + 1) * (FREEDOM - u2) / (FREEDOM + u2) ** 2
        counts = jnp.sum(problem.experiments.valid, axis=(0, 1))
        mean = jnp.sum(jnp.where(problem.experiments.valid, slope, 0.0), axis=(0, 1)) / counts
        mean = jnp.maximum(mean, 0.05)  # never zero: then all samples would be outliers
        pseudo = (FREEDOM + 1) / (FREEDOM + u2) * residual / mean[None, None]
        return scale / jnp.sqrt(mean), pseudo

    @eqx.filter_jit
    def constant_sensitivity(
        self, plant: AbstractPlant, experiments: Experiments, estimate: Estimate
    ) -> Float[Array, "experiment sample output constant"]:
        """Derivative of the outputs with respect to the known constants, weighted like these."""
        problem = Problem(plant, experiments, estimate.params, None)
        sd = self.weights(plant, experiments, estimate)
        sd, _ = self._as_normal(problem, estimate.residual, sd)
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
        prior = None if self.prior is None else problem.prior_residual

        def shooting(student: Array | None = None) -> MultipleShooting:
            return MultipleShooting(plant, segments, problem.params, is_free, prior, student)

        def search(start: Point, sd: Array, student: Array | None = None) -> _Found:
            point, sweep, converged, steps = shooting(student).solve(
                start,
                sd,
                rounding=jnp.min(problem.rounding / sd),
                tolerance=self.tolerance,
                max_steps=self.max_steps,
            )
            sweep = sweep if student is None else shooting().sweep(point)
            misfit = sweep.misfit.reshape(segments.shape[0], -1, problem.num_outputs)
            return _Found(point, converged, sweep.triangles, -misfit[:, :num_samples], sd, steps)

        def again(found: _Found) -> _Found:
            sd = found.sd if self.noise == "known" else self.scale(problem, found.residual)
            return search(found.point, sd, sd if self.likelihood == "student" else None)

        first = experiments.initial_state / problem.state_scales[None]
        begin = Point(problem.start, jnp.tile(first[:, None], (1, segments.shape[1], 1)))
        sd, count = problem.assumed_sd, jnp.sum(experiments.valid)

        def squares(found: _Found) -> Array:
            prior = problem.prior_residual(found.point.z)
            return jnp.sum((found.residual / sd[None, None]) ** 2) + jnp.sum(prior**2)

        counts = jnp.sum(experiments.valid, axis=(0, 1))
        measured = jnp.where(experiments.valid, experiments.measured, 0.0)
        mean = jnp.sum(measured, axis=(0, 1)) / jnp.maximum(counts, 1)
        away = jnp.where(experiments.valid, experiments.measured - mean[None, None], 0.0)
        variation = jnp.sum((away / sd[None, None]) ** 2, axis=(0, 1))
        can_move = (variation > _POOR * counts) & jnp.any(problem.free)
        aside = jnp.resize(jnp.array([_ASIDE, -_ASIDE]), begin.z.shape)
        sides = jnp.array([0.0, 0.0, 1.0, -1.0])

        def attempt(state: tuple[_Found, Array]) -> tuple[_Found, Array]:
            best, tries = state
            start = begin._replace(z=begin.z + sides[tries] * aside)
            matched = jax.lax.cond(tries == 1, lambda: start, lambda: shooting().matched(start, sd))
            found = search(matched, sd)
            return where_tree(squares(found) < squares(best), found, best), tries + 1

        # Where segments that fit and gaps that close have led astray: again, without their phase.
        # Where an output is hardly explained even so: from other starts.
        def goes_on(state: tuple[_Found, Array]) -> Array:
            best, tries = state
            is_poor = ~(squares(best) < _POOR * count)
            left = jnp.sum((best.residual / sd[None, None]) ** 2, axis=(0, 1))
            is_lost = jnp.any(can_move & ~(left < _LITTLE * variation))
            return (tries == 0) | is_poor & ((tries == 1) | is_lost & (tries < len(sides)))

        width = begin.starts.shape[2] + len(begin.z) + 1
        nothing = _Found(
            begin,
            jnp.asarray(False),
            jnp.zeros((segments.shape[0], problem.num_outputs, width, width)),
            jnp.full(experiments.measured.shape, jnp.inf),
            sd,
            jnp.asarray(0),
        )
        found, _ = jax.lax.while_loop(goes_on, attempt, (nothing, jnp.asarray(0)))
        if self.likelihood == "student" or (self.prior is not None and self.finds_noise):
            return jax.lax.fori_loop(0, _ROUNDS, lambda _, found: again(found), found)
        if self.noise == "estimated" and problem.num_outputs > 1:
            return again(found)
        return found

    def scale(
        self, problem: Problem, residual: Float[Array, "experiment sample output"]
    ) -> Float[Array, " output"]:
        """Scale of each output's noise: standard deviation, or the likeliest one of Student's."""
        usual = problem.noise_sd(residual)
        if self.likelihood == "normal":
            return usual
        size = jnp.where(problem.experiments.valid, jnp.abs(residual), jnp.nan)
        begin = jnp.nanmedian(size.reshape(-1, size.shape[2]), axis=0)

        def improved(_: Array, sd: Array) -> Array:
            u2 = (residual / sd[None, None]) ** 2
            weighted = (FREEDOM + 1) / (FREEDOM + u2) * residual**2
            found = jnp.sqrt(jnp.sum(weighted, axis=(0, 1)) / problem.degrees)
            return jnp.maximum(found, problem.rounding)

        start = jnp.maximum(begin, problem.rounding)
        return jax.lax.fori_loop(0, _SCALE_STEPS, improved, start)

    def length_of_segments(self, plant: AbstractPlant, num_samples: int) -> int:
        """Length of a segment: it is short, but determines its start state."""
        needed = 4 * len(plant.definition.states)
        usual = max(needed, min(3 * math.isqrt(num_samples) // 4, 100))
        return min(self.segment_length or usual, num_samples)


class _Found(NamedTuple):
    """The end of a search: point, triangle of each output, residual, assumed noise, steps."""

    point: Point
    converged: Bool[Array, ""]
    triangles: Float[Array, "experiment output column column"]
    residual: Float[Array, "experiment sample output"]
    sd: Float[Array, " output"]
    steps: Int[Array, ""]


class Problem(eqx.Module):
    """A plant, experiments, and which parameters are free.

    `start` and `usual` are search coordinates: of the search's start, and of the nominal values.
    """

    plant: AbstractPlant
    experiments: Experiments
    start: Float[Array, " param"]
    usual: Float[Array, " param"]
    free: Bool[Array, " param"]
    prior: Prior | None

    def __init__(
        self,
        plant: AbstractPlant,
        experiments: Experiments,
        start: Params,
        free: Array | None,
        prior: Prior | None = None,
    ) -> None:
        self.plant, self.experiments, self.prior = plant, experiments, prior
        self.start, self.usual = (to_search(plant.definition, p) for p in (start, plant.nominal))
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
        positive = np.array([p.positive for p in d.parameters])
        beyond = jax.lax.stop_gradient(z - jnp.clip(z, self.usual - FAR, self.usual + FAR))
        z = z - jnp.where(positive, beyond, 0.0)  # the derivative is kept beyond the limit
        return from_search(d, jnp.where(self.free, z, self.start))

    def prior_residual(self, z: Float[Array, " param"]) -> Float[Array, " row"]:
        """Distance of the parameters from their prior, in standard deviations."""
        if self.prior is None:
            return jnp.zeros(0)
        return self.prior.residual(names_of(self.plant.definition.parameters), self.params(z))

    @property
    def degrees(self) -> Float[Array, " output"]:
        """Degrees of freedom of each output's residual: values less its share of the unknowns."""
        is_measured = jnp.any(self.experiments.valid, axis=(1, 2))
        states = jnp.sum(is_measured) * self.experiments.initial_state.shape[1]
        states = 0 if self.experiments.initial_state_known else states
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

    def estimate(
        self, found: _Found, cost: Array, sd: Float[Array, " output"], noise_is_known: bool
    ) -> Estimate:
        """The estimate at the end of the search, with its covariance; `sd` is of the noise."""
        z = found.point.z
        values, slope = jax.jvp(self.params, (z,), (jnp.ones_like(z),))
        params, n = self.plant.Params(*values), self.state_scales.size
        size = relative_size(self.plant, params)
        slope = jnp.where(self.free, slope / size, 1.0)  # of relative changes over z
        weighted = found.triangles[..., :-1] / found.sd[None, :, None, None]
        columns = weighted[..., n:] / slope[None, None, None]
        initial_state = self.experiments.initial_state
        if not self.experiments.initial_state_known:
            columns = jax.vmap(_without)(columns, weighted[..., :n])
            initial_state = found.point.starts[:, 0] * self.state_scales[None]
        # H of the weighted outputs, and V of their scores, whose sd is not the assumed one.
        ratio = (sd / found.sd)[None, :, None, None]
        by_output = jnp.einsum("eokp,eokq->opq", columns, columns)
        beforehand = jax.jacfwd(self.prior_residual)(z) / slope[None]
        beforehand = beforehand.T @ beforehand
        H = jnp.sum(by_output, axis=0) + beforehand
        V = jnp.einsum("o,opq->pq", ratio[0, :, 0, 0] ** 2, by_output) + beforehand
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
        degrees = jnp.where(spread > 0, jnp.diagonal(relative) ** 2 / spread, jnp.inf)
        information = jnp.einsum("eokp,eokq->pq", columns / ratio, columns / ratio) + beforehand
        return Estimate(
            params=params,
            covariance=relative * jnp.outer(size, size),
            information=jnp.where(active, information, 0.0),
            status=status_of_search(values, found.residual, relative, found.converged),
            initial_state=initial_state,
            residual=found.residual,
            cost=cost,
            steps=found.steps,
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
