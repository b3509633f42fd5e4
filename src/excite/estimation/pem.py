"""Prediction-error estimation of disturbed plants by maximum likelihood of the innovations.

A plant remembers a disturbance of its states. The errors of a simulation are then far from
white, and least squares weights them wrongly; the errors of a one-step prediction are white.
Parameters, process noise, measurement noise and initial states together maximise the likelihood
of these innovations (L. Ljung, System Identification, 2nd ed. 1999, ch. 3 and 7; N. Kristensen,
H. Madsen, S. Jorgensen, "Parameter estimation in stochastic grey-box models", Automatica 40,
2004). With innovations e of variance v, the gradient and the information are

    sum e de/v + (1 - e^2/v) dv/(2 v),    sum de' de/v + dv' dv/(2 v^2)

which need first derivatives only. The search is Fisher's scoring, damped as by Marquardt.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..information import relative_size
from ..plant import AbstractPlant, Params, require_double_precision
from .contract import (
    AbstractSearch,
    Estimate,
    Experiments,
    Prediction,
    residual_of,
    to_search,
)
from .kalman import Innovations, innovations
from .multiple_shooting import LARGEST_CHANGE, where_tree
from .nls import NLS, Problem, status_of_search

_LEAST, _MOST = math.log(1e-8), math.log(10.0)
"""Logarithms of noise: of an output over its scale, of a state in one sample over its scale."""
_LEVELS = np.log([1e-4, 1e-3, 1e-2, 1e-1, 1.0])  # of process noise, tried as a start
_PARTS = np.log([1.0, 0.3, 0.1, 0.03])  # of the simulation's error that are measurement noise
_LARGEST = 2.0  # change of a logarithm of noise in one step
_UNSEEN = 1e3  # standard deviation of the logarithm of a noise that does not act
_LARGEST_DAMPING = 1e8


class PEM(AbstractSearch):
    """Prediction error with an extended Kalman filter, for plants that are disturbed.

    The search begins at the estimate of `NLS`.

    Attributes:
        tolerance: the search ends before a step that would change the estimate by less than
            this part of its standard error.
        max_steps: of the search.
        known: names of parameters that are held where the search starts.
    """

    tolerance: float = eqx.field(static=True, default=1e-3)
    max_steps: int = eqx.field(static=True, default=200)
    known: tuple[str, ...] = eqx.field(static=True, default=())
    name: str = eqx.field(static=True, default="pem", kw_only=True)

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
        start = plant.nominal if start is None else start
        first = NLS()(plant, experiments, start, free)
        likelihood = _Likelihood(plant, experiments, start, free)
        begin = likelihood.begin(first)
        return likelihood.estimate(likelihood.maximum(begin, self.tolerance, self.max_steps))

    @eqx.filter_jit
    def predict(
        self, plant: AbstractPlant, experiments: Experiments, params: Params, found: Prediction
    ) -> Prediction:
        """One-step prediction of other experiments, for which only initial states are fitted.

        Args:
            found: its noise was estimated with `params`.
        """
        held = jnp.zeros(len(plant.nominal), bool)
        first = NLS()(plant, experiments, params, held)
        likelihood = _Likelihood(plant, experiments, params, held, noise_is_free=False)
        noise = jnp.append(found.process_noise, found.noise_sd)
        begin = likelihood.at(params, noise, first.initial_state)
        end = likelihood.maximum(begin, self.tolerance, self.max_steps)
        return likelihood.prediction(end.here)


class _Point(NamedTuple):
    """Unknowns: logarithms of process and measurement noise, search coordinates; start states.

    Noise is over the scale of its state or output, process noise times the square root of the
    sampling time; start states are over their scales.
    """

    common: Float[Array, " noise+param"]
    starts: Float[Array, "experiment state"]


class _Search(NamedTuple):
    """The next point, and the best so far with its derivatives, reduced to a triangle."""

    here: _Point
    best: _Point
    triangles: Float[Array, "experiment column column"]
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class _Likelihood:
    """The likelihood of the innovations of some experiments."""

    def __init__(
        self,
        plant: AbstractPlant,
        experiments: Experiments,
        start: Params,
        free: Bool[Array, " param"],
        noise_is_free: bool = True,
    ) -> None:
        d = plant.definition
        self.plant, self.experiments = plant, experiments
        self.problem = Problem(plant, experiments, start, free)
        self.state_scales = self.problem.state_scales
        output_scales = jnp.asarray([o.scale for o in d.outputs])
        self.noise_scales = jnp.concatenate([self.state_scales / jnp.sqrt(plant.dt), output_scales])
        num_noises = len(self.noise_scales)
        self.is_noise = np.arange(num_noises + len(d.parameters)) < num_noises
        self.active = jnp.concatenate([jnp.full(num_noises, noise_is_free), free])
        largest = [LARGEST_CHANGE[p.positive] for p in d.parameters]
        self.largest = jnp.asarray([_LARGEST] * num_noises + largest)

    @property
    def _num_starts(self) -> int:
        """Number of unknown start states of each experiment."""
        return 0 if self.experiments.initial_state_known else len(self.state_scales)

    def at(self, params: Params, noise: Array, initial_state: Array) -> _Point:
        """The point at some parameters, noise of states and outputs, and initial states."""
        coordinates = to_search(self.plant.definition, params)
        # A parameter at a bound has none.
        coordinates = jnp.where(jnp.isfinite(coordinates), coordinates, self.problem.start)
        logarithm = jnp.clip(jnp.log(noise / self.noise_scales), _LEAST, _MOST)
        starts = initial_state / self.state_scales[None]
        return _Point(jnp.concatenate([logarithm, coordinates]), starts)

    def begin(self, first: Estimate) -> _Point:
        """Where the search begins: an estimate without disturbance, the likeliest noise."""
        n = len(self.state_scales)
        sd = self.problem.noise_sd(first.residual)
        point = self.at(first.params, jnp.append(self.noise_scales[:n], sd), first.initial_state)

        def with_noise(level: Array, part: Array) -> _Point:
            noise = point.common[: self.is_noise.sum()]
            tried = jnp.concatenate([jnp.full(n, level), noise[n:] + part])
            tried = jnp.clip(tried, _LEAST, _MOST)
            return point._replace(common=point.common.at[: len(tried)].set(tried))

        levels, parts = (jnp.asarray(a.ravel()) for a in np.meshgrid(_LEVELS, _PARTS))
        points = jax.vmap(with_noise)(levels, parts)
        costs = jax.vmap(lambda tried: jnp.sum(self._innovations(tried).cost))(points)
        best = jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))
        return jax.tree.map(lambda a: a[best], points)

    def natural(self, common: Array) -> tuple[Params, Array, Array]:
        """Parameters, process noise and measurement noise in their units."""
        num_noises, n = len(self.noise_scales), len(self.state_scales)
        noise = jnp.exp(common[:num_noises]) * self.noise_scales
        params = self.plant.Params(*self.problem.params(common[num_noises:]))
        return params, noise[:n], noise[n:]

    def _one(self, common: Array, start: Array, data: tuple) -> Innovations:
        """The innovations of one experiment."""
        return innovations(self.plant, *self.natural(common), start * self.state_scales, *data)

    @property
    def _data(self) -> tuple:
        e = self.experiments
        return (e.inputs, e.dt, e.next_inputs), e.measured, e.valid

    def _innovations(self, point: _Point) -> Innovations:
        """The innovations of all experiments."""
        return jax.vmap(self._one, in_axes=(None, 0, 0))(point.common, point.starts, self._data)

    def _reduced(self, point: _Point) -> tuple[Array, Array]:
        """Weighted derivatives and errors of each experiment as a triangle, and the cost.

        Columns: own start state, common unknowns, error.
        """
        k = self._num_starts

        def differentiated(start: Array, data: tuple) -> tuple[Array, Array]:
            def values(unknown: Array) -> tuple:
                own = unknown[:k] if k else start
                found = self._one(unknown[k:], own, data)
                return (found.value, found.variance), found

            unknown = jnp.concatenate([start[:k], point.common])
            slopes, found = jax.jacfwd(values, has_aux=True)(unknown)
            e, v = found.value.ravel(), found.variance.ravel()
            de, dv = (slope.reshape(e.size, -1) for slope in slopes)
            J = jnp.concatenate([de / jnp.sqrt(v)[:, None], dv / (math.sqrt(2) * v)[:, None]])
            J = jnp.where(jnp.append(jnp.ones(k, bool), self.active)[None], J, 0.0)
            r = jnp.concatenate([e / jnp.sqrt(v), (1 - e**2 / v) / math.sqrt(2)])
            rows = jnp.concatenate([J, r[:, None]], axis=1)
            return jnp.linalg.qr(rows, mode="r"), found.cost

        triangles, costs = jax.vmap(differentiated)(point.starts, self._data)
        return triangles, jnp.sum(costs)

    def _eliminated(self, triangles: Array, damping: Array) -> tuple[Array, Array]:
        """Triangles of each experiment, and of the common unknowns without the start states."""
        k, c = self._num_starts, len(self.active)
        R = jax.vmap(lambda own: _damped(own, k, damping))(triangles) if k else triangles
        return R, _damped(R[:, k:, k:].reshape(-1, c + 1), c, damping)

    def _step(self, point: _Point, triangles: Array, damping: Array, part: Array) -> _Point:
        """Part of a damped step."""
        k, c = self._num_starts, len(self.active)
        R, rows = self._eliminated(triangles, damping)

        def solved(rows: Array) -> tuple[Array, Array]:
            change = -jax.scipy.linalg.solve_triangular(rows[:c, :c], rows[:c, c])
            lower = jnp.where(self.is_noise, _LEAST - point.common, -jnp.inf)
            upper = jnp.where(self.is_noise, _MOST - point.common, jnp.inf)
            lower, upper = jnp.maximum(lower, -self.largest), jnp.minimum(upper, self.largest)
            limited = jnp.clip(change, lower, upper)
            return jnp.where(self.active, limited, 0.0), limited != change

        # What is limited is taken as known, and the others are solved for once more.
        change, is_limited = solved(rows)
        known = jnp.where(is_limited, change, 0.0)
        others = rows.at[:, :c].multiply(~is_limited[None]).at[:, c].add(rows[:, :c] @ known)
        change = part * (known + solved(_damped(others, c, jnp.asarray(0.0)))[0])
        starts, both = jnp.zeros_like(point.starts), jnp.append(change, part)
        if k:
            right = jnp.einsum("ekq,q->ek", R[:, :k, k:], both)
            starts = -jax.vmap(jax.scipy.linalg.solve_triangular)(R[:, :k, :k], right)
        return _Point(change, starts)

    def _along(self, triangles: Array, change: _Point) -> tuple[Array, Array]:
        """Slope of the cost along a change, and its square over the standard errors."""
        k = self._num_starts
        rows = jnp.einsum("erk,ek->er", triangles[..., :k], change.starts[:, :k])
        rows += jnp.einsum("erq,q->er", triangles[..., k:-1], change.common)
        return jnp.sum(rows * triangles[..., -1]), jnp.sum(rows**2)

    def maximum(self, begin: _Point, tolerance: float, max_steps: int) -> _Search:
        """The likeliest point."""

        def improve(s: _Search) -> _Search:
            triangles, cost = self._reduced(s.here)
            # The information is an expected curvature; the real one may be twice as large.
            moved = jax.tree.map(jnp.subtract, s.here, s.best)
            slope, expected = self._along(s.triangles, moved)
            curvature = self._along(triangles, moved)[0] - slope
            part = jnp.where(curvature > 0, jnp.clip(expected / curvature, 0.3, 1.0), 1.0)
            accepted = cost <= s.cost + 1e-10 * jnp.abs(cost)
            found = where_tree(accepted, (s.here, triangles, cost), (s.best, s.triangles, s.cost))
            best, triangles, cost = found
            damping = jnp.where(accepted, jnp.maximum(s.damping / 3, 1e-12), 5 * s.damping)
            change = self._step(best, triangles, damping, part)
            here, size = jax.tree.map(jnp.add, best, change), self._along(triangles, change)[1]
            # Where an output saturates the likelihood has edges, and even small steps gain nothing.
            settled = (size <= tolerance**2) & (~accepted | (damping <= 1))
            return _Search(here, best, triangles, cost, damping, s.steps + 1, settled)

        def goes_on(s: _Search) -> Array:
            is_sound = (s.steps == 0) | (jnp.isfinite(s.cost) & (s.damping < _LARGEST_DAMPING))
            return ~s.converged & is_sound & (s.steps < max_steps)

        triangles, _ = jax.eval_shape(self._reduced, begin)
        search = _Search(
            here=begin,
            best=begin,
            triangles=jnp.zeros(triangles.shape),
            cost=jnp.asarray(jnp.inf),
            damping=jnp.asarray(1e-2),
            steps=jnp.asarray(0),
            converged=jnp.asarray(False),
        )
        found = jax.lax.while_loop(goes_on, improve, search)
        return found._replace(here=found.best)

    def prediction(self, point: _Point) -> Prediction:
        """The one-step prediction at a point."""
        _, process_noise, noise_sd = self.natural(point.common)
        found = self._innovations(point)
        return Prediction(found.predicted, found.sd, process_noise, noise_sd)

    def estimate(self, found: _Search) -> Estimate:
        """The estimate at the end of the search, with its covariance."""
        n, free = len(self.noise_scales), self.problem.free
        point, z = found.here, found.here.common[n:]
        values, slope = jax.jvp(self.problem.params, (z,), (jnp.ones_like(z),))
        params = self.plant.Params(*values)
        size = relative_size(self.plant, params)
        slope = jnp.where(free, slope / size, 1.0)  # of relative changes over z
        _, rows = self._eliminated(found.triangles, jnp.asarray(1e-20))
        prior = jnp.eye(n, rows.shape[1]) / _UNSEEN
        rows = jnp.linalg.qr(jnp.concatenate([rows[:-1], prior]), mode="r")
        columns = rows[n:-1, n:-1] / slope[None]
        active = jnp.outer(free, free)
        information = jnp.where(active, columns.T @ columns, 0.0)
        # Over the columns' lengths: one parameter that hardly acts leaves the others' digits.
        squares = jnp.diagonal(information)
        length = jnp.sqrt(jnp.where(squares > 0, squares, 1.0))
        cosines = information / jnp.outer(length, length) + jnp.diag(jnp.where(free, 0.0, 1.0))
        relative = jnp.where(active, jnp.linalg.inv(cosines) / jnp.outer(length, length), 0.0)
        prediction = self.prediction(point)
        residual = residual_of(self.experiments, prediction.outputs)
        return Estimate(
            params=params,
            covariance=relative * jnp.outer(size, size),
            information=information,
            status=status_of_search(values, residual, relative, found.converged),
            initial_state=point.starts * self.state_scales[None],
            residual=residual,
            cost=found.cost,
            prediction=prediction,
        )


def _damped(rows: Array, count: int, damping: Array) -> Array:
    """Rows with the first columns damped as by Marquardt, as a triangle."""
    squares = jnp.sum(rows[:, :count] ** 2, axis=0)
    extra = jnp.sqrt(damping * squares + jnp.where(squares > 0, 0.0, 1.0))
    extra = jnp.eye(count, rows.shape[-1]) * extra[:, None]
    return jnp.linalg.qr(jnp.concatenate([rows, extra]), mode="r")
