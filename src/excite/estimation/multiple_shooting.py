"""Nonlinear least squares by multiple shooting, parallel in time.

A record is cut into segments, each with a start state of its own. All segments and all their
derivatives are simulated side by side, so a simulation is only as deep as one segment. The
search has two phases.

First phase: start states and parameters minimise the sum of squares of all misfits, over the
noise, and of all gaps between the end of a segment and the start of the next, over a width.
The width begins at the states' scales and shrinks with the gaps. Segments are short, so this is
almost a linear problem, and it succeeds from parameters that are several times too large or
too small. A step of Levenberg-Marquardt eliminates the start states one after the other by
orthogonal factorisations, as a square-root information filter does (G. J. Bierman,
Factorization Methods for Discrete Sequential Estimation, 1977). Before, every segment finds
its start state from its own first samples, which is nearly linear, too.

Second phase: the gaps are closed. A step of Gauss-Newton closes them to first order,

    dx_{s+1} = A_s dx_s + B_s dtheta + c_s

with A_s, B_s the derivatives of the end state and c_s the gap. All start states follow from
the first one and the parameters (condensing), so the unknowns are those of a single
simulation. At the minimum all gaps are zero: the estimate is that of a single simulation,
the maximum-likelihood estimate (H. G. Bock, "Recent advances in parameter identification
techniques for O.D.E.", Progress in Scientific Computing 2, 1983).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..plant import AbstractPlant, Params
from ..simulation import delayed, step
from .contract import Experiments

Tree = TypeVar("Tree")

_PLACEMENTS = 2
"""Steps in which every segment finds its start state from its first samples."""
_MATCHES = 38
"""Most steps of the first phase after these."""
_SHRINKAGE, _LEAST_WIDTH = 0.01, 1e-8  # of the gaps' width: in one step at most, and its end
_SMALL = 1e-2  # root mean square of the gaps, over state scales, that ends the first phase
_LEAST_PART = 0.01  # of a step; a search that needs smaller ones has stalled
_BOLD = 8
"""Steps of the second phase that are taken even if the sum of squares grows."""
_LIMIT = 1e3
"""Largest growth of the sum of squares in one of them."""
_ACCEPTED, _GOOD = 0.01, 0.75  # parts of the predicted reduction that a step must reach
_GROWTH, _SHRINKING = 10.0, 0.1  # of the radius after a good and after a refused step
_CAREFUL = 2.0  # growth after a step was refused
LARGEST_CHANGE = {True: 1.0, False: 10.0}
"""Change in one step of the logarithm of a positive parameter, of a free one over its scale."""
_IDLE = 1e-3  # a gain of the last step, over the noise, that ends a search without steps left
_SHORT = 0.3  # part of a step below which the radius shrinks
_MOST = 1e30  # largest damping over the squared length of a column
_CLOSED = 1e-6  # a gap that is closed to first order leaves its square
_BLOCK = 2**14
"""Samples that are simulated side by side; longer records are simulated in blocks."""
_EPS, _TINY = np.finfo(float).eps, np.finfo(float).tiny


class Steps(NamedTuple):
    """What acts from each sample to the next; see `Experiments`.

    `change`: of inputs and next inputs with the delay of each input.
    """

    inputs: Array
    dt: Array | None
    next_inputs: Array | None
    change: tuple[Array, Array] | None = None


class Segments(eqx.Module):
    """Experiments cut into blocks of segments of one length.

    `valid` is False for unused samples, `is_followed` for a segment after which none are used.
    """

    steps: Steps
    measured: Float[Array, "block experiment segment time output"]
    valid: Bool[Array, "block experiment segment time output"]
    is_followed: Bool[Array, "block experiment segment"]

    @classmethod
    def of(cls, experiments: Experiments, length: int, block: int = _BLOCK) -> Segments:
        """Segments of `length` samples, in blocks of about `block`; the last are padded."""
        num_experiments, num_samples, _ = experiments.valid.shape
        needed = -(-num_samples // length)
        num_blocks = -(-needed * length * num_experiments // block)
        in_block = -(-needed // num_blocks)

        def cut(rows: Array) -> Array:
            missing = num_blocks * in_block * length - rows.shape[1]
            padded = jnp.pad(rows, [(0, 0), (0, missing), *[(0, 0)] * (rows.ndim - 2)])
            shape = (len(rows), num_blocks, in_block, length, *rows.shape[2:])
            return jnp.moveaxis(padded.reshape(shape), 1, 0)

        valid = cut(experiments.valid)
        return cls(
            jax.tree.map(cut, Steps(experiments.inputs, experiments.dt, experiments.next_inputs)),
            cut(experiments.measured),
            valid,
            in_blocks(_next(over_segments(valid.any(axis=(3, 4)))), num_blocks),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of experiments, and of segments in each."""
        num_blocks, num_experiments, in_block, *_ = self.valid.shape
        return num_experiments, num_blocks * in_block


def over_segments(values: Array) -> Array:
    """Values by block, experiment and segment as values by experiment and segment."""
    values = jnp.moveaxis(values, 0, 1)
    num_experiments, num_blocks, in_block, *rest = values.shape  # no -1: inputs may have no column
    return values.reshape(num_experiments, num_blocks * in_block, *rest)


def in_blocks(values: Array, num_blocks: int) -> Array:
    """Values by experiment and segment as values by block, experiment and segment."""
    return jnp.moveaxis(values.reshape(len(values), num_blocks, -1, *values.shape[2:]), 1, 0)


def _next(values: Array) -> Array:
    """Values of the next segment, zero after the last; by experiment and segment."""
    return jnp.concatenate([values[:, 1:], jnp.zeros_like(values[:, :1])], axis=1)


class Shots(NamedTuple):
    """The segments of a block simulated from their start states, with derivatives.

    The derivatives are with respect to the start state, then the search coordinates of the
    parameters. States are over their scales.
    """

    misfit: Float[Array, "experiment segment time output"]  # simulated minus measured
    misfit_slope: Float[Array, "experiment segment time output state+param"]
    gap: Float[Array, "experiment segment state"]  # end of a segment minus start of the next
    end_slope: Float[Array, "experiment segment state state+param"]


class Sweep(NamedTuple):
    """All segments at one point, with their gaps closed to first order.

    Columns are the derivatives with respect to the first state and z, then the value.

    Attributes:
        moves: of the start states.
        triangles: of the misfit of each output, reduced by an orthogonal factorisation.
        misfit: simulated minus measured outputs.
    """

    moves: Float[Array, "experiment segment state column"]
    triangles: Float[Array, "experiment output column column"]
    misfit: Float[Array, "experiment segment time output"]


class Point(NamedTuple):
    """Search coordinates of the parameters, and start states over their scales."""

    z: Float[Array, " param"]
    starts: Float[Array, "experiment segment state"]


class Linear(NamedTuple):
    """Misfits and gaps near a point as linear functions, with the start states eliminated.

    Attributes:
        rows: triangular equations of each start state: its own change, that of the next one, of z,
            and the value.
        common: the triangle that is left for z, and the value.
        misfits, gaps: sums of squares at the point, over the noise and over state scales.
    """

    rows: Float[Array, "experiment segment state column"]
    common: Float[Array, "column column"]
    misfits: Float[Array, ""]
    gaps: Float[Array, ""]


class _Match(NamedTuple):
    """First phase: the best point so far, the step from it, and the next point."""

    best: Point
    change: Point
    here: Point
    misfits: Float[Array, ""]
    gaps: Float[Array, ""]
    hoped: Float[Array, ""]
    width: Float[Array, ""]
    next_width: Float[Array, ""]
    damping: Float[Array, ""]
    part: Float[Array, ""]
    steps: Int[Array, ""]
    is_closed: Bool[Array, ""]


class _Search(NamedTuple):
    """Second phase: the next point, and the best so far with its sweep."""

    here: Point
    best: Point
    sweep: Sweep
    cost: Float[Array, ""]
    predicted: Float[Array, ""]
    gained: Float[Array, ""]
    radius: Float[Array, ""]
    growth: Float[Array, ""]
    part: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class MultipleShooting(eqx.Module):
    """A sum of squares to be minimised: a plant, segments of experiments, and what z means.

    Attributes:
        params_at: parameters, as a vector, at search coordinates z.
        first_is_free: False where every experiment starts at its known initial state.
        prior: further residuals of the search coordinates, in standard deviations.
        student: scale of each output's noise, if it has Student's distribution; default normal.
    """

    plant: AbstractPlant
    segments: Segments
    params_at: Callable[[Float[Array, " param"]], Float[Array, " param"]]
    first_is_free: bool = eqx.field(static=True)
    prior: Callable[[Float[Array, " param"]], Float[Array, " row"]] | None = None
    student: Float[Array, " output"] | None = None

    @property
    def scales(self) -> Float[np.ndarray, " state"]:
        """Typical size of each state."""
        return np.array([s.scale for s in self.plant.definition.states])

    @property
    def num_states(self) -> int:
        """Number of states."""
        return len(self.plant.definition.states)

    @property
    def num_outputs(self) -> int:
        """Number of outputs."""
        return len(self.plant.definition.outputs)

    @property
    def largest(self) -> Float[np.ndarray, " param"]:
        """Largest change of each search coordinate in one step."""
        return np.array([LARGEST_CHANGE[p.positive] for p in self.plant.definition.parameters])

    def delayed(self, z: Array) -> Segments:
        """The segments with the inputs of a plant that delays them."""
        delay = self.plant.delay(self.plant.Params(*self.params_at(z)))
        if delay is None:
            return self.segments
        (num_blocks, *_, length), s = self.segments.valid.shape[:4], self.segments.steps
        dt = jnp.full(s.inputs.shape[:-1], self.plant.dt) if s.dt is None else s.dt
        held = s.inputs if s.next_inputs is None else s.next_inputs

        def joined(rows: Array) -> Array:
            rows = over_segments(rows)
            return rows.reshape(len(rows), -1, *rows.shape[3:])

        def cut(rows: Array) -> Array:
            return in_blocks(rows.reshape(len(rows), -1, length, *rows.shape[2:]), num_blocks)

        def acting(delay: Array) -> tuple[Array, Array]:
            arguments = joined(s.inputs), joined(dt), joined(held)
            return jax.vmap(lambda u, dt, v: delayed(u, delay, dt, v))(*arguments)

        now, change = jax.jvp(acting, (delay,), (jnp.ones_like(delay),))
        (first, last), change = jax.tree.map(cut, (now, change))
        return dataclasses.replace(self.segments, steps=Steps(first, s.dt, last, change))

    def simulated(
        self, start: Array, steps: Steps, params: Params, delay: Array | None = None
    ) -> tuple[Array, Array]:
        """The end state of a segment, and its outputs; the start state is over its scales.

        `delay` is that of the inputs, for the derivatives.
        """
        plant, own = self.plant, self.plant.delay(params)
        later = None if own is None or delay is None else own - delay

        def advance(x: Array, now: Steps) -> tuple[Array, Array]:
            ends = now.inputs, now.next_inputs
            if now.change is not None and later is not None:
                ends = jax.tree.map(lambda u, slope: u + later * slope, ends, now.change)
            outputs = plant.output(x, *plant.feedthrough_input(ends[0]), params)
            return step(plant, x, ends[0], params, now.dt, ends[1]), outputs

        return jax.lax.scan(advance, start * self.scales, steps)

    @eqx.filter_jit  # both phases simulate: it is traced once
    def shoot(self, z: Array, starts: Array, next_starts: Array, block: Segments) -> Shots:
        """Simulates the segments of one block."""
        n = self.num_states
        delay = self.plant.delay(self.plant.Params(*self.params_at(z)))

        def outputs_and_end(point: Array, steps: Steps) -> tuple[tuple, tuple]:
            params = self.plant.Params(*self.params_at(point[n:]))
            end, outputs = self.simulated(point[:n], steps, params, delay)
            return (found := (outputs, end / self.scales)), found

        def differentiated(start: Array, steps: Steps) -> tuple:
            point = jnp.concatenate([start, z])
            return jax.jacfwd(outputs_and_end, has_aux=True)(point, steps)

        shape = starts.shape[:2]
        count = shape[0] * shape[1]
        flat = jax.tree.map(lambda a: a.reshape(count, *a.shape[2:]), (starts, block.steps))
        (slope, end_slope), (outputs, end) = jax.tree.map(
            lambda a: a.reshape(*shape, *a.shape[1:]), jax.vmap(differentiated)(*flat)
        )
        is_followed = block.is_followed[..., None]
        misfit = jnp.where(block.valid, outputs - block.measured, 0.0)
        if self.student is not None:
            scale = self.student[None, None, None]
            root, its_slope = student_root(misfit / scale)
            misfit, slope = scale * root, slope * its_slope[..., None]
        return Shots(
            misfit=misfit,
            misfit_slope=jnp.where(block.valid[..., None], slope, 0.0),
            gap=jnp.where(is_followed, end - next_starts, 0.0),
            end_slope=jnp.where(is_followed[..., None], end_slope, 0.0),
        )

    def prior_rows(self, z: Float[Array, " param"]) -> Float[Array, "row column"]:
        """The derivative of the prior's residuals, then their values; no rows without a prior."""
        if self.prior is None:
            return jnp.zeros((0, len(z) + 1))
        slope, value = jax.jacfwd(self.prior)(z), self.prior(z)
        return jnp.concatenate([slope, value[:, None]], axis=1)

    def _blocks(self, point: Point) -> tuple[Array, Array, Segments]:
        """Start states, those of the next segments, and segments, by block."""
        num_blocks, starts = len(self.segments.valid), point.starts
        here, following = (in_blocks(x, num_blocks) for x in (starts, _next(starts)))
        return here, following, self.delayed(point.z)

    def sweep(self, point: Point) -> Sweep:
        """Simulates all segments, and closes their gaps to first order."""
        n, width = self.num_states, self.num_states + len(point.z) + 1
        num_experiments, num_outputs = self.segments.shape[0], self.num_outputs
        first = jnp.eye(n, width) if self.first_is_free else jnp.zeros((n, width))

        def follow(moves: Array, parts: tuple[Array, Array]) -> tuple[Array, Array]:
            A, B = parts
            return (A @ moves).at[:, n:].add(B), moves

        def simulate_block(carry: tuple, parts: tuple) -> tuple[tuple, tuple]:
            moves, triangles = carry
            shots = self.shoot(point.z, *parts)
            A, B = shots.end_slope[..., :n], shots.end_slope[..., n:]
            B = jnp.concatenate([B, shots.gap[..., None]], axis=-1)
            chain = jax.vmap(lambda moves, A, B: jax.lax.scan(follow, moves, (A, B)))
            moves, each = chain(moves, A, B)
            rows = jnp.einsum("eslon,esnq->esloq", shots.misfit_slope[..., :n], each)
            own = jnp.concatenate([shots.misfit_slope[..., n:], shots.misfit[..., None]], axis=-1)
            rows = rows.at[..., n:].add(own)
            by_output = jnp.moveaxis(rows, 3, 1).reshape(num_experiments, num_outputs, -1, width)
            stacked = jnp.concatenate([triangles, by_output], axis=2)
            return (moves, jnp.linalg.qr(stacked, mode="r")), (each, rows[..., -1])

        begin = (
            jnp.tile(first[None], (num_experiments, 1, 1)),
            jnp.zeros((num_experiments, num_outputs, width, width)),
        )
        (_, triangles), (moves, misfit) = jax.lax.scan(simulate_block, begin, self._blocks(point))
        return Sweep(over_segments(moves), triangles, over_segments(misfit))

    def placed(self, start: Point, sd: Array) -> tuple[Point, Float[Array, ""]]:
        """Start states that fit the first samples of each segment, and the misfits on the way.

        A step of Gauss-Newton also counts the change of a state, over its scale. The misfits
        are the sum of squares before the last step.
        """
        n, z = self.num_states, start.z
        params = self.plant.Params(*self.params_at(z))
        here, _, segments = self._blocks(start)
        few = min(-(-2 * n // self.num_outputs) + 1, segments.valid.shape[3])
        count = here[..., 0].size
        parts = segments.steps, segments.measured, segments.valid
        parts = jax.tree.map(lambda a: a[:, :, :, :few].reshape(count, few, *a.shape[4:]), parts)

        def misfits(x: Array, parts: tuple[Steps, Array, Array]) -> Array:
            steps, measured, valid = parts
            _, outputs = self.simulated(x, steps, params)
            return (jnp.where(valid, outputs - measured, 0.0) / sd[None]).ravel()

        def move(x: Array, parts: tuple[Steps, Array, Array]) -> tuple[Array, Array]:
            def twice(x: Array) -> tuple[Array, Array]:
                return (r := misfits(x, parts)), r

            J, r = jax.jacfwd(twice, has_aux=True)(x)
            rows = jnp.concatenate([jnp.concatenate([J, r[:, None]], axis=1), jnp.eye(n, n + 1)])
            R = jnp.linalg.qr(rows, mode="r")
            return x - jax.scipy.linalg.solve_triangular(R[:n, :n], R[:n, n]), jnp.sum(r**2)

        def improved(_: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            moved, squares = jax.vmap(move)(now[0].reshape(count, n), parts)
            moved = moved.reshape(here.shape)
            if not self.first_is_free:
                moved = moved.at[0, :, 0].set(now[0][0, :, 0])
            return moved, jnp.sum(squares)

        moved, squares = jax.lax.fori_loop(0, _PLACEMENTS, improved, (here, jnp.asarray(0.0)))
        return Point(z, over_segments(moved)), squares

    def linearised(self, point: Point, sd: Array, width: Array, damping: Array) -> Linear:
        """Simulates all segments; gaps count over `width` state scales."""
        n, p = self.num_states, len(point.z)
        num_experiments = self.segments.shape[0]
        prior = jnp.sqrt(damping + 1e-12)

        def eliminate(carry: Array, parts: tuple) -> tuple[Array, Array]:
            J, r, A, c = parts  # of one segment; J and A by its start state, then z
            wide = jnp.zeros((len(carry), n))
            rows = jnp.concatenate([
                jnp.concatenate([carry[:, :n], wide, carry[:, n:]], axis=1),
                prior * jnp.eye(n, 2 * n + p + 1),
                jnp.concatenate([J[:, :n], jnp.zeros((len(J), n)), J[:, n:], r], axis=1),
                jnp.concatenate([A[:, :n], -jnp.eye(n) / width, A[:, n:], c], axis=1),
            ])  # fmt: skip
            R = jnp.linalg.qr(rows, mode="r")
            return R[n:, n:], R[:n]

        def simulate_block(carry: tuple, parts: tuple) -> tuple[tuple, Array]:
            triangle, misfits, gaps, index = carry
            shots = self.shoot(point.z, *parts)
            weighted = shots.misfit / sd[None, None, None]
            misfits += jnp.sum(weighted**2)
            gaps += jnp.sum(shots.gap**2)
            joined = num_experiments, shots.gap.shape[1], -1
            J = (shots.misfit_slope / sd[None, None, None, :, None]).reshape(*joined, n + p)
            r = weighted.reshape(*joined, 1)
            A, c = shots.end_slope / width, shots.gap[..., None] / width
            if not self.first_is_free:
                knows = (index == 0) & (jnp.arange(J.shape[1]) == 0)[None, :, None, None]
                J = J.at[..., :n].multiply(~knows)
                A = A.at[..., :n].multiply(~knows)
            chain = jax.vmap(lambda own, *parts: jax.lax.scan(eliminate, own, parts))
            triangle, rows = chain(triangle, J, r, A, c)
            return (triangle, misfits, gaps, index + 1), rows

        nothing, known = jnp.asarray(0.0), self.prior_rows(point.z)
        more = jnp.sum(known[:, -1] ** 2)
        begin = jnp.zeros((num_experiments, n + p + 1, n + p + 1)), more, nothing, 0
        (triangle, misfits, gaps, _), rows = jax.lax.scan(
            simulate_block, begin, self._blocks(point)
        )
        left = triangle[:, n:, n:].reshape(-1, p + 1)
        common = jnp.linalg.qr(jnp.concatenate([left, known]), mode="r")
        return Linear(over_segments(rows), common, misfits, gaps)

    def step_of(self, found: Linear, damping: Array) -> tuple[Array, Point]:
        """The sum of squares that a Levenberg-Marquardt step would leave, and the step.

        The damping is raised until no search coordinate changes too much.
        """
        n, p = self.num_states, len(found.common) - 1
        scale = jnp.sum(found.common[:, :p] ** 2)
        damping = damping + _EPS**2 * scale + _TINY

        def damped(damping: Array) -> Array:
            extra = jnp.sqrt(damping) * jnp.eye(p, p + 1)
            R = jnp.linalg.qr(jnp.concatenate([found.common, extra]), mode="r")
            return -jax.scipy.linalg.solve_triangular(R[:p, :p], R[:p, p])

        def longer(found: tuple[Array, Array]) -> tuple[Array, Array]:
            damping = jnp.maximum(10 * found[0], _EPS * scale)
            return damping, damped(damping)

        _, dz = jax.lax.while_loop(
            lambda found: (
                (jnp.max(jnp.abs(found[1]) / self.largest) > 1) & (found[0] < 1e6 * scale)
            ),
            longer,
            (damping, damped(damping)),
        )
        change = jnp.append(dz, 1.0)

        def solved(row: Array) -> Array:
            return -jax.scipy.linalg.solve_triangular(row[:, :n], row[:, n:])

        def substitute(after: Array, row: Array) -> tuple[Array, Array]:
            own = row[:, :n] @ after + row[:, n:] @ change
            return own, own

        backwards = jax.vmap(
            lambda rows: jax.lax.scan(substitute, jnp.zeros(n), rows, reverse=True)[1]
        )
        left = jnp.sum((found.common @ change) ** 2)
        return left, Point(dz, backwards(jax.vmap(jax.vmap(solved))(found.rows)))

    def matched(self, start: Point, sd: Array) -> Point:
        """Where the segments fit and the gaps are closed, or as far as that succeeds."""
        num_gaps = jnp.maximum(jnp.sum(self.segments.is_followed) * self.num_states, 1)
        start, misfits = self.placed(start, sd)

        def match(s: _Match) -> _Match:
            found = self.linearised(s.here, sd, s.next_width, s.damping * s.misfits)
            gained = s.misfits - found.misfits + (s.gaps - found.gaps) / s.width**2
            accepted = (s.steps == 0) | (gained >= _ACCEPTED * s.part * s.hoped)
            is_good = (s.part == 1) & (gained >= _GOOD * s.hoped)
            factor = jnp.where(is_good, 0.01, jnp.where(s.part < 1, 10.0, 1.0))
            damping = jnp.clip(s.damping * factor, 1e-18, 1e3)
            cost = found.misfits + found.gaps / s.next_width**2
            left, change = self.step_of(found, damping * cost)
            mean_square = found.gaps / num_gaps
            moved = _Match(
                best=s.here,
                change=change,
                here=jax.tree.map(jnp.add, s.here, change),
                misfits=found.misfits,
                gaps=found.gaps,
                hoped=cost - left,
                width=s.next_width,
                next_width=_next_width(s.next_width, mean_square),
                damping=damping,
                part=jnp.asarray(1.0),
                steps=s.steps + 1,
                is_closed=mean_square < _SMALL**2,
            )
            part = 0.25 * s.part
            nearer = jax.tree.map(lambda at, by: at + part * by, s.best, s.change)
            stayed = s._replace(here=nearer, part=part, steps=s.steps + 1)
            return where_tree(accepted, moved, stayed)

        def goes_on(s: _Match) -> Array:
            is_sound = (s.part > _LEAST_PART) & ((s.steps == 0) | jnp.isfinite(s.misfits))
            return ~s.is_closed & is_sound & (s.steps < _MATCHES)

        begin = _Match(
            best=start,
            change=jax.tree.map(jnp.zeros_like, start),
            here=start,
            misfits=misfits,
            gaps=jnp.asarray(jnp.inf),
            hoped=jnp.asarray(0.0),
            width=jnp.asarray(1.0),
            next_width=jnp.asarray(1.0),
            damping=jnp.asarray(1e-3),
            part=jnp.asarray(1.0),
            steps=jnp.asarray(0),
            is_closed=jnp.asarray(False),
        )
        found = jax.lax.while_loop(goes_on, match, begin)
        return where_tree(found.is_closed, found.here, found.best)

    def weighted(
        self, sweep: Sweep, z: Array, sd: Array
    ) -> Float[Array, "experiment unknown unknown"]:
        """The triangle of all outputs over their standard deviations; unknowns, then value.

        The prior comes last, as an experiment that tells nothing of its initial state.
        """
        triangles = sweep.triangles / sd[None, :, None, None]
        if not self.first_is_free:
            triangles = triangles[..., self.num_states :]
        stacked = triangles.reshape(len(triangles), -1, triangles.shape[-1])
        is_triangular = triangles.shape[1] == 1 and self.first_is_free
        found = stacked if is_triangular else jnp.linalg.qr(stacked, mode="r")
        if self.prior is None:
            return found
        rows, width = self.prior_rows(z), found.shape[-1]
        own = jnp.zeros((width, width)).at[: len(rows), width - rows.shape[1] :].set(rows)
        return jnp.concatenate([found, own[None]])

    def newton_step(
        self, moves: Array, triangle: Array, damping: Array, more: Float[Array, " param"]
    ) -> tuple[Point, Float[Array, "experiment unknown"]]:
        """Damped Gauss-Newton step: the change of the point, and of the weighted outputs.

        `more` is a factor of each parameter's damping.
        """
        n, width = self.num_states, moves.shape[-1]
        k, p = n if self.first_is_free else 0, width - n - 1

        def damped(rows: Array, factors: Array) -> Array:
            count = len(factors)
            squares = jnp.sum(rows[:, :count] ** 2, axis=0)
            least = _EPS**2 * jnp.sum(triangle[..., :-1] ** 2) + _TINY
            size = jnp.sqrt(damping * factors * squares + least)
            extra = jnp.eye(count, rows.shape[-1]) * size[:, None]
            return jnp.linalg.qr(jnp.concatenate([rows, extra]), mode="r")

        R = jax.vmap(lambda own: damped(own, jnp.ones(k)))(triangle) if k else triangle
        common = damped(R[:, k:, k:].reshape(-1, p + 1), more)
        dz = -jax.scipy.linalg.solve_triangular(common[:p, :p], common[:p, p])
        change = jnp.zeros((len(R), width)).at[:, n:].set(jnp.append(dz, 1.0)[None])
        if k:
            right = jnp.einsum("ekq,eq->ek", R[:, :k, k:], change[:, n:])
            first = -jax.vmap(jax.scipy.linalg.solve_triangular)(R[:, :k, :k], right)
            change = change.at[:, :n].set(first)
        outputs = jnp.einsum("erq,eq->er", triangle[..., :-1], change[:, n - k : -1])
        return Point(dz, jnp.einsum("esnq,eq->esn", moves, change[: len(moves)])), outputs

    def limited_step(
        self, moves: Array, triangle: Array, damping: Array
    ) -> tuple[Point, Float[Array, "experiment unknown"]]:
        """A step in which no search coordinate changes too much; one that would is damped more."""

        def is_too_long(found: tuple) -> Array:
            more, change, _ = found
            return (jnp.abs(change.z) > self.largest) & (damping * more < _MOST)

        def shorter(found: tuple) -> tuple:
            more = jnp.where(is_too_long(found), 10 * found[0], found[0])
            return more, *self.newton_step(moves, triangle, damping, more)

        # The loop begins with a step that is too long: `newton_step` is traced and compiled once.
        endless = Point(jnp.full(len(self.largest), jnp.inf), jnp.zeros(moves.shape[:3]))
        begin = jnp.full(len(self.largest), 0.1), endless, jnp.zeros(triangle.shape[:2])
        return jax.lax.while_loop(lambda found: jnp.any(is_too_long(found)), shorter, begin)[1:]

    def solve(
        self,
        start: Point,
        sd: Float[Array, " output"],
        *,
        rounding: Float[Array, ""],
        tolerance: float,
        max_steps: int,
    ) -> tuple[Point, Sweep, Bool[Array, ""], Int[Array, ""]]:
        """The minimum, its sweep, whether the search converged, and its steps.

        Args:
            start: near the minimum, or `matched`.
            sd: standard deviation of each output's noise.
            rounding: a change of a weighted output that is nothing but rounding.
            tolerance: the search ends before a step that would change the estimate by less
                than this part of its standard error.
            max_steps: of the second phase.
        """
        count = jnp.sum(self.segments.valid)

        def improve(s: _Search) -> _Search:
            sweep = self.sweep(s.here)
            cost = jnp.sum((sweep.triangles[..., -1] / sd[None, :, None]) ** 2)
            cost += jnp.sum(self.prior_rows(s.here.z)[:, -1] ** 2)
            hoped, gained = s.cost - s.predicted, s.cost - cost
            is_bold = (s.steps < _BOLD) & (cost < _LIMIT * s.cost)
            is_equal = jnp.abs(gained) <= 100 * _EPS * cost
            accepted = (gained >= _ACCEPTED * hoped) | is_equal | is_bold | (s.steps == 0)
            best, sweep, cost = where_tree(
                accepted, (s.here, sweep, cost), (s.best, s.sweep, s.cost)
            )
            triangle = self.weighted(sweep, best.z, sd)
            is_good = gained > _GOOD * hoped
            # Where the residual is large a step may be too long, and its direction right: a part
            # of it is tried before the radius shrinks.
            shrinking = jnp.where(s.part > _SHORT, 1.0, _SHRINKING)
            grown = jnp.where(is_good, s.growth, 1.0)
            radius = jnp.clip(s.radius * jnp.where(accepted, grown, shrinking), 1e-9, 1e18)
            growth = jnp.where(accepted, s.growth, _CAREFUL)
            longer = jnp.where(is_good, jnp.minimum(2 * s.part, 1.0), s.part)
            part = jnp.where(accepted, longer, 0.5 * s.part)
            change, outputs = self.limited_step(sweep.moves, triangle, 1 / radius)
            reached = jnp.sum((triangle[..., -1] + outputs) ** 2)
            least = jnp.maximum(tolerance**2 * cost / count, rounding**2)
            is_closed = jnp.max(jnp.abs(sweep.moves[..., -1])) < _CLOSED
            settled = accepted & is_closed & (jnp.sum(outputs**2) <= least)
            here = jax.tree.map(lambda at, by: at + part * by, best, change)
            return _Search(
                here=here,
                best=best,
                sweep=sweep,
                cost=cost,
                predicted=cost + part * (reached - cost),
                gained=jnp.where(accepted, gained, s.gained),
                radius=radius,
                growth=growth,
                part=part,
                steps=s.steps + 1,
                converged=settled,
            )

        def goes_on(s: _Search) -> Array:
            is_sound = (s.steps == 0) | (jnp.isfinite(s.cost) & (s.part > 1e-6))
            return ~s.converged & is_sound & (s.steps < max_steps)

        nothing = jax.eval_shape(self.sweep, start)
        search = _Search(
            here=start,
            best=start,
            sweep=jax.tree.map(lambda a: jnp.zeros(a.shape), nothing),
            cost=jnp.asarray(jnp.inf),
            predicted=jnp.asarray(0.0),
            gained=jnp.asarray(jnp.inf),
            radius=jnp.asarray(1e3),
            growth=jnp.asarray(_GROWTH),
            part=jnp.asarray(1.0),
            steps=jnp.asarray(0),
            converged=jnp.asarray(False),
        )
        found = jax.lax.while_loop(goes_on, improve, search)
        # The last step is taken too; it is too small for the sweep to change.
        point = where_tree(found.converged, found.here, found.best)
        is_idle = found.gained <= _IDLE * found.cost / count
        converged = found.converged | (found.steps == max_steps) & is_idle
        return point, found.sweep, converged, found.steps


FREEDOM = 4.0
"""Degrees of freedom of Student's distribution, where noise with outliers is taken to have it."""


def student_root(u: Array) -> tuple[Array, Array]:
    """A function whose square is minus twice Student's log-likelihood, and its derivative.

    Without the constant; least squares of these values is then maximum likelihood (K. Lange,
    R. Little and J. Taylor, "Robust statistical modeling using the t distribution", JASA 84, 1989).
    """
    v = u**2 / FREEDOM
    is_small = v < 1e-8
    ratio = jnp.where(is_small, 1 - v / 2, jnp.log1p(v) / jnp.where(is_small, 1.0, v))
    root = jnp.sqrt((FREEDOM + 1) / FREEDOM * ratio)
    return u * root, (FREEDOM + 1) / ((FREEDOM + u**2) * root)


def _next_width(width: Array, mean_square: Array) -> Array:
    """Width of the gaps in the next step: it shrinks with the gaps, at last quadratically."""
    least = jnp.maximum(_SHRINKAGE * width, _LEAST_WIDTH)
    return jnp.clip(mean_square, least, width / 3)


def where_tree(condition: Array, new: Tree, old: Tree) -> Tree:
    """One of two trees of arrays."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)
