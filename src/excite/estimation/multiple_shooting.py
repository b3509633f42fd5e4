"""Nonlinear least squares by multiple shooting, parallel in time.

A record is cut into segments, each with a start state of its own. All segments and all their
derivatives are simulated side by side, so a simulation is only as deep as one segment. The
search has two phases.

First every segment fits its start state to its own samples, and the parameters make the gaps
small between the end of a segment and the start of the next (weighted by what the segments
know of their states). Segments are short, so this is almost a linear problem, and it succeeds
from parameters that are several times too large or too small.

Then the gaps are closed. A step of Gauss-Newton closes them to first order,

    dx_{s+1} = A_s dx_s + B_s dtheta + c_s

with A_s, B_s the derivatives of the end state and c_s the gap. All start states follow from
the first one and the parameters (condensing), so the unknowns are those of a single
simulation. At the minimum all gaps are zero: the estimate is that of a single simulation,
the maximum-likelihood estimate (H. G. Bock, "Recent advances in parameter identification
techniques for O.D.E.", Progress in Scientific Computing 2, 1983).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..plant import AbstractPlant
from ..simulation import step
from .contract import Experiments

_MATCHES = 5
"""Steps of the first phase."""
_BOLD = 8
"""Steps of the second phase that are taken even if the sum of squares grows."""
_LIMIT = 1e3
"""Largest growth of the sum of squares in one of them."""
_ACCEPTED, _GOOD = 0.01, 0.75  # parts of the predicted reduction that a later step must reach
_GROWTH, _SHRINKAGE = 10.0, 0.1  # of the radius after a good and after a refused step
_LARGEST = 1.0  # change of a search coordinate in one step
_WIDTH = 0.5  # how far a start state may be from the end of the segment before, in state scales
_CLOSED = 1e-6  # a gap that is closed to first order leaves its square
_EPS, _TINY = np.finfo(float).eps, np.finfo(float).tiny


class Segments(eqx.Module):
    """Experiments cut into segments of one length; `valid` is False for unused samples."""

    inputs: Float[Array, "experiment segment time input"]
    measured: Float[Array, "experiment segment time output"]
    valid: Bool[Array, "experiment segment time"]

    @classmethod
    def of(cls, experiments: Experiments, length: int) -> Segments:
        """Segments of `length` samples; the last is padded."""

        def cut(rows: Array) -> Array:
            missing = -(-experiments.valid.shape[1] // length) * length - rows.shape[1]
            padded = jnp.pad(rows, [(0, 0), (0, missing), *[(0, 0)] * (rows.ndim - 2)])
            return padded.reshape(len(rows), -1, length, *rows.shape[2:])

        return cls(cut(experiments.inputs), cut(experiments.measured), cut(experiments.valid))

    def joined(self, rows: Array, num_samples: int) -> Array:
        """Values by experiment, segment and time as values by experiment and sample."""
        return rows.reshape(len(rows), -1, *rows.shape[3:])[:, :num_samples]


class Shots(NamedTuple):
    """All segments simulated from their start states, with derivatives.

    The derivatives are with respect to the start state, then the search coordinates of the
    parameters. States are over their scales.
    """

    misfit: Float[Array, "experiment segment time output"]  # simulated minus measured
    misfit_slope: Float[Array, "experiment segment time output state+param"]
    gap: Float[Array, "experiment gap state"]  # end of a segment minus start of the next
    end_slope: Float[Array, "experiment gap state state+param"]


class Solution(NamedTuple):
    """A point of the search, and the outputs near it as linear functions of the unknowns.

    Attributes:
        z: search coordinates of the parameters.
        starts: start states over their scales.
        rows: derivatives of the misfit with respect to the first state and z, then the misfit,
            with all gaps closed to first order.
        moves: the same for the start states: derivatives, then what closes the gaps.
        converged: whether the search ended here.
    """

    z: Float[Array, " param"]
    starts: Float[Array, "experiment segment state"]
    rows: Float[Array, "experiment segment time output column"]
    moves: Float[Array, "experiment segment state column"]
    converged: Bool[Array, ""]


class _Search(NamedTuple):
    """The best point so far, its weighted rows as a triangle, and the next point."""

    best: Solution
    triangle: Float[Array, "experiment unknown unknown"]
    cost: Float[Array, ""]
    predicted: Float[Array, ""]
    z: Float[Array, " param"]
    starts: Float[Array, "experiment segment state"]
    radius: Float[Array, ""]
    part: Float[Array, ""]
    steps: Int[Array, ""]


class MultipleShooting:
    """A sum of squares to be minimised: a plant, segments of experiments, and what z means.

    Args:
        params_at: parameters, as a vector, at search coordinates z.
        first_is_free: False where every experiment starts at its known initial state.
        sd: standard deviation of each output's noise.
    """

    def __init__(
        self,
        plant: AbstractPlant,
        segments: Segments,
        params_at: Callable[[Float[Array, " param"]], Float[Array, " param"]],
        first_is_free: bool,
        sd: Float[Array, " output"],
    ) -> None:
        self.plant, self.segments, self.params_at = plant, segments, params_at
        self.first_is_free, self.sd = first_is_free, sd
        self.scales = jnp.asarray([s.scale for s in plant.definition.states])
        self.num_states = len(plant.definition.states)

    def shoot(self, z: Float[Array, " param"], starts: Array) -> Shots:
        """Simulates all segments."""
        n, segments = self.num_states, self.segments

        def outputs_and_end(point: Array, inputs: Array) -> tuple[tuple, tuple]:
            params = self.plant.Params(*self.params_at(point[n:]))

            def advance(x: Array, u: Array) -> tuple[Array, Array]:
                return step(self.plant, x, u, params), self.plant.output(x, params)

            end, outputs = jax.lax.scan(advance, point[:n] * self.scales, inputs)
            return (found := (outputs, end / self.scales)), found

        def differentiated(start: Array, inputs: Array) -> tuple:
            point = jnp.concatenate([start, z])
            return jax.jacfwd(outputs_and_end, has_aux=True)(point, inputs)

        shape = segments.inputs.shape
        flat = starts.reshape(-1, n), segments.inputs.reshape(-1, *shape[2:])
        (slope, end_slope), (outputs, end) = jax.tree.map(
            lambda a: a.reshape(*shape[:2], *a.shape[1:]), jax.vmap(differentiated)(*flat)
        )
        used = segments.valid[..., None]
        is_gap = segments.valid.any(axis=2)[:, 1:, None]  # before a segment with samples
        return Shots(
            misfit=jnp.where(used, outputs - segments.measured, 0.0),
            misfit_slope=jnp.where(used[..., None], slope, 0.0),
            gap=jnp.where(is_gap, end[:, :-1] - starts[:, 1:], 0.0),
            end_slope=jnp.where(is_gap[..., None], end_slope[:, :-1], 0.0),
        )

    def matching_step(self, shots: Shots) -> tuple[Array, Array]:
        """Changes of z and of the start states that make the gaps small (first phase).

        Every segment fits its start state to its own samples, for any z. The gaps are weighted
        by the covariance of these fits.
        """
        n, sd = self.num_states, self.sd[None, None, None]
        J, r = shots.misfit_slope / sd[..., None], shots.misfit / sd
        others = jnp.concatenate([J[..., n:], r[..., None]], axis=-1)
        information = jnp.einsum("eslon,eslom->esnm", J[..., :n], J[..., :n])
        covariance = jnp.linalg.inv(information + jnp.eye(n)[None, None] / _WIDTH**2)
        # The start states as functions of z: D (dz, 1).
        right = jnp.einsum("eslon,eslop->esnp", J[..., :n], others)
        D = -covariance @ right.at[:, 1:, :, -1].add(-shots.gap / _WIDTH**2)
        if not self.first_is_free:
            covariance, D = covariance.at[:, 0].set(0.0), D.at[:, 0].set(0.0)
        A = shots.end_slope[..., :n]
        own = jnp.concatenate([shots.end_slope[..., n:], shots.gap[..., None]], axis=-1)
        gap = A @ D[:, :-1] + own - D[:, 1:]
        spread = A @ covariance[:, :-1] @ jnp.swapaxes(A, -1, -2) + covariance[:, 1:]
        gap = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(spread), gap, lower=True)
        M = jnp.einsum("esnp,esnq->pq", gap, gap)
        damping = 1e-3 * M[-1, -1] + 1e-9 * jnp.trace(M) + _TINY
        dz = -jnp.linalg.solve(M[:-1, :-1] + damping * jnp.eye(len(M) - 1), M[:-1, -1])
        dz = jnp.clip(dz, -_LARGEST, _LARGEST)
        return dz, D @ jnp.append(dz, 1.0)

    def condensed(self, shots: Shots, z: Array, starts: Array) -> Solution:
        """The point, with misfit and start states as functions of the first state and z."""
        n = self.num_states
        width = shots.misfit_slope.shape[-1] + 1
        first = jnp.eye(n, width) if self.first_is_free else jnp.zeros((n, width))
        by_z = jnp.concatenate([shots.end_slope[..., n:], shots.gap[..., None]], axis=-1)

        def follow(moves: Array, parts: tuple[Array, Array]) -> tuple[Array, Array]:
            A, B = parts
            moves = (A @ moves).at[:, n:].add(B)
            return moves, moves

        def chained(A: Array, B: Array) -> Array:
            return jnp.concatenate([first[None], jax.lax.scan(follow, first, (A, B))[1]])

        moves = jax.vmap(chained)(shots.end_slope[..., :n], by_z)
        rows = jnp.einsum("eslon,esnq->esloq", shots.misfit_slope[..., :n], moves)
        own = jnp.concatenate([shots.misfit_slope[..., n:], shots.misfit[..., None]], axis=-1)
        return Solution(z, starts, rows.at[..., n:].add(own), moves, jnp.asarray(False))

    def triangle(self, found: Solution) -> Float[Array, "experiment unknown unknown"]:
        """The weighted rows of each experiment, reduced by an orthogonal factorisation."""
        rows = found.rows / self.sd[None, None, None, :, None]
        rows = rows if self.first_is_free else rows[..., self.num_states :]
        rows = rows.reshape(len(rows), -1, rows.shape[-1])
        return jax.vmap(lambda own: jnp.linalg.qr(own, mode="r"))(rows)

    def newton_step(
        self, found: Solution, triangle: Array, damping: Array
    ) -> tuple[Array, Array, Array]:
        """Damped Gauss-Newton step: changes of z, start states and weighted outputs."""
        n, p = self.num_states, len(found.z)
        k = n if self.first_is_free else 0

        def damped(rows: Array, count: int) -> Array:
            extra = jnp.sqrt(damping) * jnp.eye(count, rows.shape[-1])
            return jnp.linalg.qr(jnp.concatenate([rows, extra]), mode="r")

        R = jax.vmap(lambda own: damped(own, k))(triangle) if k else triangle
        common = damped(R[:, k:, k:].reshape(-1, p + 1), p)
        dz = -jax.scipy.linalg.solve_triangular(common[:p, :p], common[:p, p])
        dz = dz * _LARGEST / jnp.maximum(jnp.max(jnp.abs(dz)), _LARGEST)
        change = jnp.zeros((len(R), n + p + 1)).at[:, n:].set(jnp.append(dz, 1.0)[None])
        if k:
            right = jnp.einsum("ekq,eq->ek", R[:, :k, k:], change[:, n:])
            first = -jax.vmap(jax.scipy.linalg.solve_triangular)(R[:, :k, :k], right)
            change = change.at[:, :n].set(first)
        outputs = jnp.einsum("erq,eq->er", triangle[..., :-1], change[:, n - k : -1])
        return dz, jnp.einsum("esnq,eq->esn", found.moves, change), outputs

    def start(self, z: Float[Array, " param"], starts: Array) -> Solution:
        """A point where a search begins; the start states are over their scales."""
        width = self.num_states + len(z) + 1
        rows = jnp.zeros((*self.segments.measured.shape, width))
        return Solution(z, starts, rows, jnp.zeros((*starts.shape, width)), jnp.asarray(False))

    def solve(
        self,
        start: Solution,
        *,
        is_refinement: Bool[Array, ""],
        rounding: Float[Array, ""],
        tolerance: float,
        max_steps: int,
    ) -> Solution:
        """The minimum.

        Args:
            is_refinement: the start is near the minimum, so the first phase is left out.
            rounding: a change of a weighted output that is nothing but rounding.
            tolerance: the search ends before a step that would change the estimate by less
                than this part of its standard error.
            max_steps: of the second phase.
        """
        count = jnp.sum(self.segments.valid) * self.segments.measured.shape[-1]

        def advance(s: _Search) -> _Search:
            shots = self.shoot(s.z, s.starts)
            return jax.lax.cond(s.steps < _MATCHES, match, improve, s, shots)

        def match(s: _Search, shots: Shots) -> _Search:
            dz, moved = self.matching_step(shots)
            # At first no segment knows more of its start than the one before.
            follow = jnp.zeros_like(moved).at[:, 1:].set(shots.gap)
            dz, moved = jnp.where(s.steps == 0, 0.0, dz), jnp.where(s.steps == 0, follow, moved)
            is_finite = jnp.all(jnp.isfinite(dz)) & jnp.all(jnp.isfinite(moved))
            z = jnp.where(is_finite, s.z + dz, start.z)
            starts = jnp.where(is_finite, s.starts + moved, start.starts)
            return s._replace(z=z, starts=starts, steps=s.steps + 1)

        def improve(s: _Search, shots: Shots) -> _Search:
            found = self.condensed(shots, s.z, s.starts)
            triangle = self.triangle(found)
            cost = jnp.sum(triangle[..., -1] ** 2)
            hoped, gained = s.cost - s.predicted, s.cost - cost
            is_bold = (s.steps < _MATCHES + _BOLD) & (cost < _LIMIT * s.cost)
            accepted = (gained >= _ACCEPTED * hoped) | is_bold | (s.steps == _MATCHES)
            best, triangle, cost = jax.tree.map(
                lambda new, old: jnp.where(accepted, new, old),
                (found, triangle, cost), (s.best, s.triangle, s.cost),
            )  # fmt: skip
            growth = jnp.where(gained > _GOOD * hoped, _GROWTH, 1.0)
            radius = jnp.clip(s.radius * jnp.where(accepted, growth, _SHRINKAGE), 1e-9, 1e9)
            part = jnp.where(accepted, jnp.minimum(2 * s.part, 1.0), 0.5 * s.part)
            damping = cost / radius + _EPS**2 * jnp.sum(triangle**2) + _TINY
            dz, moved, outputs = self.newton_step(best, triangle, damping)
            reached = jnp.sum((triangle[..., -1] + outputs) ** 2)
            least = jnp.maximum(tolerance**2 * cost / count, rounding**2)
            is_closed = jnp.max(jnp.abs(best.moves[..., -1])) < _CLOSED
            settled = accepted & is_closed & (jnp.sum(outputs**2) <= least)
            z, starts = best.z + part * dz, best.starts + part * moved
            # The last step is taken too; it is too small for the rows to change.
            last = best._replace(z=z, starts=starts, converged=settled)
            best = jax.tree.map(lambda new, old: jnp.where(settled, new, old), last, best)
            predicted = cost + part * (reached - cost)
            return _Search(best, triangle, cost, predicted, z, starts, radius, part, s.steps + 1)

        def goes_on(s: _Search) -> Array:
            is_sound = (s.steps <= _MATCHES) | jnp.isfinite(s.cost)
            return ~s.best.converged & is_sound & (s.steps < max_steps + _MATCHES)

        unknowns = start.rows.shape[-1] - (0 if self.first_is_free else self.num_states)
        search = _Search(
            best=start._replace(converged=jnp.asarray(False)),
            triangle=jnp.zeros((len(start.starts), unknowns, unknowns)),
            cost=jnp.asarray(jnp.inf),
            predicted=jnp.asarray(0.0),
            z=start.z,
            starts=start.starts,
            radius=jnp.asarray(1e3),
            part=jnp.asarray(1.0),
            steps=jnp.where(is_refinement, _MATCHES, 0),
        )
        return jax.lax.while_loop(goes_on, advance, search).best
