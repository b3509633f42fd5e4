"""A guard for experiments on a rig: it notices a plant that is not a declared one, and brakes.

A filter follows the experiment. It estimates the plant's state and where in the declared
uncertainty the plant lies (the divided-difference filter of second order: M. Nørgaard,
N. Poulsen, O. Ravn, New developments in state estimation for nonlinear systems, Automatica
2000, in its square-root form). The guard trips where no declared plant explains the
measurements: an innovation is too large, the last ten are on average, or the estimate leaves
the declared box. Its thresholds are those that declared plants do not reach (`calibrated`).

Zero is no safe input in mid-swing. After a trip, and after the last sample of a whole
experiment, the guard brakes with linear feedback of the estimated state, then the experiment
ends. What was wrong is inferred from the last samples:
where the actuator acted with the other sign, or not at all, it brakes with that in mind, and
where a sensor stands still it does not believe it.

As for a supervisor (`excite.safety`), the functions are pure, over arrays of NumPy or JAX
(`xp`). On a rig they need NumPy alone; the plant's equations come as a `Program`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, NamedTuple, Self

import numpy as np

from ..policy import AnyArray
from ..safety import Supervision
from .player import AbstractPlayer
from .program import Program

NUM_RECENT = 10
"""Innovations of which the mean is watched."""

NUM_REPLAYED = 5
"""Samples from which the guard infers what was wrong."""

_GAINS, _LATE = (1.5, 2.0, 3.0), (1, 2, 3)
"""Factors of the actuator, and samples by which it is late, that may explain the last samples."""

_CAUSES = np.array(
    [
        (1.0, 0, 0),
        *((gain, 0, 0) for gain in _GAINS),
        *((1.0, 0, late) for late in _LATE),
        *((sign, since, 0) for sign in (-1.0, 0.0) for since in range(NUM_REPLAYED - 1)),
    ]
)
"""Factor of the actuator, the sample at which it began, and samples by which the input is late.

The first is as declared. A fault of the newest input alone is not told from a late plant.
"""

_SQUARE = 3.0  # of the distance of the filter's points, in standard deviations: that of a normal
# Parts of the way from the last input to the one of the feedback, and the fraction of a critical
# level that they must keep below.
_PARTS, _NEAR = np.linspace(1.0, 0.0, 6), 0.9
_WIDE = 0.05  # after a trip, how far a state may move in one sample unexplained, in its scales
_QUIET = 0.25  # fraction of critical levels and input limits below which it is at rest
_NUM_QUIET, _LONGEST = 5, 60  # samples of rest that end the brake; after a trip, its last sample
LONGEST_BRAKE = 150
"""Samples of the brake after a whole experiment, at most."""

_LOST = 2.0  # times the critical levels: what is beyond is not braked any more
# Another sign must explain the last samples better by _BETTER, in squares of standard deviations,
# and leave less than _EXPLAINED, or than the part _PART of what the present sign leaves.
_BETTER, _EXPLAINED, _PART = 15.0, 50.0, 0.02
_STEEPEST = 1e6  # largest change of an output that is counted, in standard deviations of its noise
_BIAS = 300.0  # of a sensor, in standard deviations of its noise, as far as it may have jumped


@dataclass(frozen=True, eq=False)
class GuardRules:
    """What a guard knows of the declared plants; arrays are in the plant's units.

    A quantity of the declared uncertainty is a coordinate in [-1, 1].

    Attributes:
        mean: states, then quantities, before the first sample.
        root: of their covariance, its lower triangular root.
        walk: standard deviation of their unexplained change in one sample.
        noise: standard deviation of a measurement.
        feedback: of the brake, of the distance of the states from the start.
        past_feedback: of the brake, of the distance of the last inputs from rest, oldest first.
        rest: input at rest.
        lower, upper: input limits.
        watched: indices of the outputs with a critical level.
        critical: their levels.
        state_scale: usual size of each state.
        depth: samples for which an input can act.
        thresholds: of the largest squared innovation in standard deviations, of the mean of the
            last ten, and of the distance of an estimate from the declared box.
    """

    mean: np.ndarray
    root: np.ndarray
    walk: np.ndarray
    noise: np.ndarray
    feedback: np.ndarray
    past_feedback: np.ndarray
    rest: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    watched: np.ndarray
    critical: np.ndarray
    state_scale: np.ndarray
    depth: int
    thresholds: np.ndarray

    @property
    def num_states(self) -> int:
        """Of the plant; the quantities follow."""
        return len(self.state_scale)


def beside(rules: Supervision) -> Supervision:
    """A supervisor's rules beside a guard: what the guard notices, too, is left to its brake."""
    return replace(rules, is_guarded=True)


@dataclass(frozen=True, eq=False)
class Guard:
    """A guard as it is kept in a policy's certificate.

    Attributes:
        rules: what it knows.
        advance, output: the model's functions, for as many points as the filter has.
    """

    rules: GuardRules
    advance: Program
    output: Program

    @property
    def model(self) -> Model:
        """The declared plants; a program has a fixed number of points, and some may be spare."""
        count = num_points(self.rules)

        def filled(rows: np.ndarray) -> np.ndarray:  # np.resize takes five times as long
            return rows[np.arange(count) % len(rows)]

        def advance(points: np.ndarray, past: np.ndarray) -> np.ndarray:
            return self.advance(filled(points), filled(past))[: len(points)]

        def output(points: np.ndarray) -> np.ndarray:
            return self.output(filled(points))[: len(points)]

        return Model(advance, output)

    def to_dict(self) -> dict[str, Any]:
        """The guard as JSON-ready data."""
        rules = {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in vars(self.rules).items()
        }
        programs = {name: getattr(self, name).to_text() for name in _PROGRAMS}
        return {"rules": rules, **programs}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """The guard that `to_dict` wrote.

        Raises:
            ValueError: for data of another form.
        """
        try:
            rules = dict(data["rules"])
            depth, watched = int(rules.pop("depth")), np.array(rules.pop("watched"), int)
            arrays = {name: np.array(value, float) for name, value in rules.items()}
            programs = (Program.from_text(data[name]) for name in _PROGRAMS)
            read = cls(GuardRules(depth=depth, watched=watched, **arrays), *programs)
            count = num_points(read.rules)
            points = np.tile(read.rules.mean, (count, 1))
            past = np.broadcast_to(read.rules.rest, (count, depth, len(read.rules.lower)))
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"the guard is damaged ({error!r})") from None
        except ValueError as error:
            raise ValueError(f"the guard is damaged: {error}") from None
        if not read._computes(points, past):
            raise ValueError(
                "the guard was made by another version of excite: make it again "
                "(excite falsify POLICY --guard --certify FILE)"
            )
        return read

    def _computes(self, points: np.ndarray, past: np.ndarray) -> bool:
        """Whether the programs are for these points: as many as the filter has."""
        if (self.advance.num_inputs, self.output.num_inputs) != (2, 1):
            return False
        try:
            with np.errstate(all="ignore"):
                states, outputs = self.advance(points, past), self.output(points)
        except (ValueError, IndexError, TypeError):
            return False
        shape = len(points), self.rules.num_states
        return states.shape == shape and outputs.shape[:1] == shape[:1]


_PROGRAMS = "advance", "output"


def num_points(rules: GuardRules) -> int:
    """Points of a guard's programs: those of its filter, or of a replay."""
    n = len(rules.mean)
    return max(2 * n + 1, len(_CAUSES) + n)


class Model(NamedTuple):
    """The declared plants, over points: states, then quantities.

    Attributes:
        advance: states one sample later, of points [point, quantity] with their last inputs
            [point, depth, input], oldest first.
        output: of points.
    """

    advance: Callable[[AnyArray, AnyArray], AnyArray]
    output: Callable[[AnyArray], AnyArray]


class Belief(NamedTuple):
    """State of a guard; the buffers of the last samples have the oldest first.

    Attributes:
        mean, root: of states and quantities.
        inputs: applied.
        means, roots: estimates, and roots of their covariance.
        measured: outputs.
        recent: squared innovations.
        score: the three numbers that are compared with the thresholds, now.
        largest: their largest values so far.
        sign: factor of the actuator in the brake: 1, -1 or 0.
        num_since: samples since it was inferred.
        is_blind: whether the brake does not believe the sensor.
        k: samples so far.
        num_braked: samples since the trip; 0 before it.
        num_quiet: samples of rest since; -1 where the brake seems to push, or takes too long.
    """

    mean: AnyArray
    root: AnyArray
    inputs: AnyArray
    means: AnyArray
    roots: AnyArray
    measured: AnyArray
    recent: AnyArray
    score: AnyArray
    largest: AnyArray
    sign: AnyArray
    num_since: AnyArray
    is_blind: AnyArray
    k: AnyArray
    num_braked: AnyArray
    num_quiet: AnyArray

    @property
    def tripped_at(self) -> AnyArray:
        """Sample of the trip; that after the last one before it."""
        return self.k - self.num_braked

    @property
    def is_at_rest(self) -> AnyArray:
        """Whether the brake has brought the plant to rest."""
        return self.num_quiet >= _NUM_QUIET

    @property
    def is_over(self) -> AnyArray:
        """Whether the brake ends."""
        return self.is_at_rest | (self.num_quiet < 0) | (self.num_braked >= LONGEST_BRAKE)

    def is_unexplained(self, num_steps: int) -> AnyArray:
        """Whether it braked before the last of so many samples, or not as declared plants brake."""
        has_tripped = (self.num_braked > 0) & (self.tripped_at < num_steps)
        has_failed = self.is_over & ~self.is_at_rest
        return has_tripped | has_failed | (self.sign != 1) | self.is_blind


def start(xp: ModuleType, rules: GuardRules) -> Belief:
    """Before the first measurement."""
    mean, root = (xp.asarray(x, float) for x in (rules.mean, rules.root))
    count = max(_LATE) + NUM_REPLAYED + rules.depth
    return Belief(
        mean=mean,
        root=root,
        inputs=xp.tile(xp.asarray(rules.rest, float), (count, 1)),
        means=xp.tile(mean, (NUM_REPLAYED, 1)),
        roots=xp.tile(root, (NUM_REPLAYED, 1, 1)),
        measured=xp.full((NUM_REPLAYED, len(rules.noise)), np.nan),
        recent=xp.ones(NUM_RECENT) * len(rules.noise),
        score=xp.zeros(3),
        largest=xp.zeros(3),
        sign=xp.asarray(1.0),
        num_since=xp.asarray(0),
        is_blind=xp.asarray(False),
        k=xp.asarray(0),
        num_braked=xp.asarray(0),
        num_quiet=xp.asarray(0),
    )


def observed(
    xp: ModuleType,
    rules: GuardRules,
    model: Model,
    belief: Belief,
    measured: AnyArray,
    is_asked: AnyArray = False,
) -> Belief:
    """The belief after a measurement; it says whether the guard trips.

    Args:
        measured: outputs.
        is_asked: whether it brakes in any case; then a reading that stands still is believed.
    """
    is_braking = belief.num_braked > 0
    mean, root, innovation = _corrected(xp, rules, model, belief, measured)
    square = xp.sum(innovation**2)
    recent = xp.concatenate([belief.recent[1:], square[None]])
    sd = xp.sqrt(xp.sum(root**2, axis=1))[rules.num_states :]
    outside = xp.max(abs(mean[rules.num_states :]) - 1 - 3 * sd, initial=-1.0)
    score = xp.stack([square, xp.mean(recent), outside])
    is_over = (abs(measured[rules.watched]) >= xp.asarray(rules.critical)).any()
    is_explained = (score < xp.asarray(rules.thresholds)).all() & ~is_over & ~xp.asarray(is_asked)
    trips = ~is_braking & ~is_explained
    was_frozen = (measured == belief.measured[-1]).any()
    is_blind = belief.is_blind | ((is_braking | trips) & was_frozen & ~xp.asarray(is_asked))
    if xp is np and not (trips or is_braking):  # on a rig, what is not needed takes time
        state, sign = mean[: rules.num_states], belief.sign
    else:
        state, sign = _replayed(xp, rules, model, belief, measured)
    sign = xp.where(is_braking | trips, xp.where(is_blind, 1.0, sign), belief.sign)
    starts_again = trips | (is_blind & ~belief.is_blind) | (sign != belief.sign)
    quantities = xp.clip(belief.mean[rules.num_states :], -1.0, 1.0)
    braking_mean = xp.concatenate([state, quantities])
    braking_root = xp.diag(
        xp.concatenate([_WIDE * xp.asarray(rules.state_scale), xp.zeros(len(quantities))])
    )
    mean = xp.where(starts_again, braking_mean, xp.where(is_blind, belief.mean, mean))
    root = xp.where(starts_again, braking_root, xp.where(is_blind, belief.root, root))
    shown = xp.where(is_blind, model.output(mean[None])[0], measured)  # what is believed
    # A motor at full speed may have no current: it is at rest where the brake asks for nothing.
    size = abs(shown[rules.watched]) / xp.asarray(rules.critical)
    reach = _QUIET * (xp.asarray(rules.upper) - xp.asarray(rules.lower)) / 2
    is_quiet = (size < _QUIET).all() & (abs(belief.inputs[-1] - rules.rest) < reach).all()
    num_quiet = xp.where(is_quiet, belief.num_quiet + 1, 0)
    gives_up = (size > _LOST).any() | (belief.num_braked >= _LONGEST) & ~xp.asarray(is_asked)
    num_quiet = xp.where(gives_up, -1, num_quiet)
    num_quiet = xp.where(belief.is_over, belief.num_quiet, num_quiet)
    return belief._replace(
        mean=mean,
        root=root,
        means=xp.concatenate([belief.means[1:], mean[None]]),
        roots=xp.concatenate([belief.roots[1:], root[None]]),
        measured=xp.concatenate([belief.measured[1:], measured[None]]),
        recent=recent,
        score=score,
        largest=xp.where(is_braking, belief.largest, xp.fmax(belief.largest, score)),
        sign=sign,
        num_since=xp.where(sign != belief.sign, 0, belief.num_since + 1),
        is_blind=is_blind,
        k=belief.k + 1,
        num_braked=belief.num_braked + (is_braking | trips),
        num_quiet=xp.where(is_braking, num_quiet, 0),
    )


def decided(
    xp: ModuleType, rules: GuardRules, model: Model, belief: Belief, proposed: AnyArray
) -> AnyArray:
    """The input to apply: the proposed one, or that of the brake.

    A sudden brake may itself pass a level, as the current of a fast motor: it goes only so far
    from the last input to that of the feedback as the estimated plant stays below its levels.
    """
    if xp is np and not belief.num_braked:  # on a rig, what is not needed takes time
        return proposed
    last, brake = belief.inputs[-1], _fed_back(xp, rules, belief)
    tried = last[None] + xp.asarray(_PARTS)[:, None] * (brake - last)[None]
    past = xp.broadcast_to(belief.inputs[-rules.depth :], (len(tried), rules.depth, len(last)))
    points = xp.broadcast_to(belief.mean, (len(tried), len(belief.mean)))
    near = xp.zeros(len(tried))
    for _ in range(rules.depth):
        past = xp.concatenate([past[:, 1:], tried[:, None]], axis=1)
        states = model.advance(points, belief.sign * past)
        points = xp.concatenate([states, points[:, rules.num_states :]], axis=1)
        sizes = abs(model.output(points)[:, rules.watched]) / xp.asarray(rules.critical)[None]
        near = xp.maximum(near, xp.max(sizes, axis=1, initial=0.0))
    # The first that keeps below, or the one that comes least near.
    near = xp.where(xp.isfinite(near), near, xp.inf)
    brake = tried[xp.argmin(xp.where(near < _NEAR, 0.0, near))]
    return xp.where(belief.num_braked > 0, brake, proposed)


def _fed_back(xp: ModuleType, rules: GuardRules, belief: Belief) -> AnyArray:
    """The input of linear feedback of the estimated state."""
    away, rest = (belief.mean - xp.asarray(rules.mean))[: rules.num_states], xp.asarray(rules.rest)
    count = rules.depth - 1
    past = belief.sign * belief.inputs[len(belief.inputs) - count :] - rest[None]
    brake = xp.asarray(rules.feedback) @ away + xp.asarray(rules.past_feedback) @ xp.ravel(past)
    # One that seems dead may only be late: it is driven all the same.
    brake = xp.where(belief.sign < 0, -1.0, 1.0) * (rest - brake)
    return xp.clip(xp.where(xp.isfinite(brake), brake, rules.rest), rules.lower, rules.upper)


def moved(
    xp: ModuleType, rules: GuardRules, model: Model, belief: Belief, input: AnyArray
) -> Belief:
    """The belief at the next sample, before its measurement."""
    inputs = xp.concatenate([belief.inputs[1:], input[None]])
    is_braking, n = belief.num_braked > 0, rules.num_states
    points = _points(xp, belief.mean, belief.root)
    acting = xp.where(is_braking, belief.sign, 1.0) * inputs[-rules.depth :]
    past = xp.broadcast_to(acting, (len(points), *acting.shape))
    state, first, second = _moments(xp, model.advance(points, past), len(belief.mean))
    walk = xp.where(is_braking, _walk_of_brake(xp, rules), xp.asarray(rules.walk))
    count = len(belief.mean) - n
    below = xp.concatenate([belief.root[n:], xp.zeros((count, len(belief.mean)))], axis=1)
    above = xp.concatenate([first, second], axis=1)
    whole = xp.concatenate([xp.concatenate([above, below]), xp.diag(walk)], axis=1)
    mean = xp.concatenate([state, belief.mean[n:]])
    return belief._replace(mean=mean, root=_triangular(xp, whole), inputs=inputs)


def _walk_of_brake(xp: ModuleType, rules: GuardRules) -> AnyArray:
    """After a trip the state may do what the model does not explain; quantities stay."""
    still = xp.zeros(len(rules.mean) - rules.num_states)
    return xp.concatenate([_WIDE * xp.asarray(rules.state_scale), still])


def _points(xp: ModuleType, mean: AnyArray, root: AnyArray) -> AnyArray:
    """The mean, and points on both sides of it along every column of the root."""
    reach = _SQUARE**0.5 * root.T
    return xp.concatenate([mean[None], mean[None] + reach, mean[None] - reach])


def _moments(xp: ModuleType, values: AnyArray, n: int) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Mean of a function of the points, and the roots of its covariance of first and second order.

    The differences of Nørgaard et al., Eqs. 27 to 31.
    """
    middle, after, before = values[0], values[1 : n + 1], values[n + 1 :]
    mean = (_SQUARE - n) / _SQUARE * middle + xp.sum(after + before, axis=0) / (2 * _SQUARE)
    first = (after - before).T / (2 * _SQUARE**0.5)
    second = (_SQUARE - 1) ** 0.5 / (2 * _SQUARE) * (after + before - 2 * middle[None]).T
    return mean, first, second


def _triangular(xp: ModuleType, root: AnyArray) -> AnyArray:
    """The lower triangular root of the same covariance."""
    return xp.linalg.qr(root.T, mode="r").T


def _corrected(
    xp: ModuleType, rules: GuardRules, model: Model, belief: Belief, measured: AnyArray
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Mean and root after a measurement, and the innovation in standard deviations."""
    n, count = len(belief.mean), len(rules.noise)
    outputs = model.output(_points(xp, belief.mean, belief.root))
    expected, first, second = _moments(xp, outputs, n)
    above = xp.concatenate([xp.diag(xp.asarray(rules.noise)), second, first], axis=1)
    below = xp.concatenate([xp.zeros((n, count + n)), belief.root], axis=1)
    joint = _triangular(xp, xp.concatenate([above, below]))
    innovation = xp.linalg.solve(joint[:count, :count], measured - expected)
    mean = belief.mean + joint[count:, :count] @ innovation
    return mean, joint[count:, count:], innovation


def _replayed(
    xp: ModuleType, rules: GuardRules, model: Model, belief: Belief, measured: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """State now, and the actuator's sign, that explain the last samples best.

    The last samples are played again from the estimate before them, once for each cause. How well
    a cause explains them is its marginal likelihood, to first order in what was uncertain of that
    estimate. A jump of the sensor explains them, too: for it, a declared plant is believed.
    """
    n, depth, count = rules.num_states, rules.depth, len(_CAUSES)
    noise = xp.asarray(rules.noise)
    gain, since, late = _CAUSES.T
    # A fault since the first of these samples was there before: older inputs had it too.
    begins = np.where(since == 0, -depth, since)
    factor = np.where(np.arange(-depth, NUM_REPLAYED) >= begins[:, None], gain[:, None], 1.0)
    starts, length = (max(_LATE) - late).astype(int), NUM_REPLAYED + depth
    acting = xp.stack([belief.inputs[first : first + length] for first in starts])
    acting = xp.asarray(factor)[:, :, None] * acting
    before = xp.concatenate([belief.means[0, :n], xp.clip(belief.means[0, n:], -1.0, 1.0)])
    # Each cause from the estimate, then as declared from one standard deviation beside it.
    points = xp.concatenate([xp.tile(before, (count, 1)), before[None] + belief.roots[0].T])
    inputs = xp.concatenate([acting, xp.tile(acting[:1], (len(before), 1, 1))])
    offs, slopes = [], []
    for i, seen in enumerate([*belief.measured[1:], measured]):
        states = model.advance(points, inputs[:, i + 1 : i + 1 + depth])
        points = xp.concatenate([states, points[:, n:]], axis=1)
        outputs, is_seen = model.output(points), xp.isfinite(seen)[None]
        offs.append(xp.where(is_seen, (outputs[:count] - seen[None]) / noise[None], 0.0))
        slope = (outputs[count:] - outputs[:1]) / noise[None]
        # One that a simulation cannot give tells nothing; larger ones would be lost in rounding.
        known = xp.clip(slope, -_STEEPEST, _STEEPEST)
        slopes.append(xp.where(is_seen & xp.isfinite(slope), known, 0.0))
    off, slope = xp.concatenate(offs, axis=1), xp.concatenate(slopes, axis=1)
    covariance = xp.eye(off.shape[1]) + slope.T @ slope
    # A sensor that jumped at one of the samples: one more uncertain number.
    jumps = _jumps(len(noise))
    solved = xp.linalg.solve(covariance, xp.concatenate([off.T, xp.asarray(jumps.T)], axis=1))
    error = xp.sum(off.T * solved[:, :count], axis=0)
    size = 1 + _BIAS**2 * xp.sum(jumps.T * solved[:, count:], axis=0)
    told = _BIAS**2 * (off[0] @ solved[:, count:]) ** 2 / size - xp.log(size)
    as_declared = error[:1] - xp.maximum(xp.max(told), 0.0)
    error = xp.concatenate([as_declared, error[1:]])
    error = xp.where(xp.isfinite(error), error, xp.inf)
    signs = np.minimum(gain, 1.0)
    # The first estimates after a fault are of a plant without it, and would favour the usual sign.
    is_early = (belief.sign != 1.0) & (belief.num_since < NUM_REPLAYED)
    error = xp.where((signs == 1.0) & is_early, xp.inf, error)
    best, as_now = xp.argmin(error), xp.argmin(xp.where(signs == belief.sign, error, xp.inf))
    is_explained = error[best] < xp.maximum(_EXPLAINED, _PART * error[as_now])
    is_clear = is_explained & (error[as_now] - error[best] > _BETTER)
    best = xp.where(is_clear, best, as_now)
    sign = xp.where(xp.isfinite(error[best]), xp.asarray(signs)[best], belief.sign)
    return xp.where(xp.isfinite(points[best, :n]), points[best, :n], belief.mean[:n]), sign


def _jumps(num_outputs: int) -> np.ndarray:
    """A step of each output at each of the last samples; columns are samples, then outputs."""
    since = np.tril(np.ones((NUM_REPLAYED, NUM_REPLAYED))).T
    return np.kron(since, np.eye(num_outputs))


class GuardedPlayer(AbstractPlayer):
    """A player and its guard; NumPy alone."""

    def __init__(self, player: AbstractPlayer, guard: Guard) -> None:
        """Before the first sample."""
        self._player, self._rules, self._model = player, guard.rules, guard.model
        self.num_steps = player.num_steps
        self._belief, self._reaches_level = start(np, guard.rules), False

    def __call__(self, k: int, measured: np.ndarray) -> np.ndarray:
        """The player's input, or that of the brake."""
        with np.errstate(all="ignore"):  # what is not finite trips
            measured, rules, model = np.asarray(measured), self._rules, self._model
            belief = observed(np, rules, model, self._belief, measured, k >= self.num_steps)
            self._reaches_level |= bool((abs(measured[rules.watched]) >= rules.critical).any())
            self._belief = belief
            proposed = rules.rest if belief.num_braked > 0 else self._player(k, measured)
            return np.array(decided(np, rules, model, belief, proposed))

    @property
    def is_over(self) -> bool:
        """Whether the brake has ended, and not as after a whole experiment of a declared plant."""
        return self._is_unexplained and bool(self._belief.is_over)

    @property
    def is_at_rest(self) -> bool:
        """Whether the brake has brought the plant to rest."""
        return bool(self._belief.is_at_rest)

    @property
    def _is_unexplained(self) -> bool:
        """Whether a declared plant would have ended the experiment in another way."""
        return self._reaches_level or bool(self._belief.is_unexplained(self.num_steps))

    def applied(self, input: np.ndarray) -> None:
        """Passes the applied input to the player, and moves the belief to the next sample."""
        self._player.applied(input)
        with np.errstate(all="ignore"):
            self._belief = moved(np, self._rules, self._model, self._belief, np.asarray(input))

    def origin(self) -> Mapping[str, object]:
        """As for the player without guard."""
        return self._player.origin()

    def facts(self) -> Mapping[str, object]:
        """Also whether and when the guard tripped, and how near to its thresholds it came."""
        belief, names = self._belief, ("innovation", "mean of innovations", "outside the box")
        shares = zip(names, belief.largest.tolist(), self._rules.thresholds.tolist(), strict=True)
        return {
            **self._player.facts(),
            "guard": {
                "tripped_at": int(belief.tripped_at) if self._is_unexplained else None,
                "num_braked": int(belief.num_braked),
                "largest_and_threshold": {name: [a, b] for name, a, b in shares},
                "actuator_sign": float(belief.sign),
                "sensor_frozen": bool(belief.is_blind),
            },
        }
