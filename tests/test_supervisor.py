"""The supervisor: every rule trips when it should and not otherwise, in NumPy and in JAX."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import PLANTS, TwoMasses

from excite.plant import Aero2Detailed, DCMotor
from excite.safety import Supervision, Trip, Watch, allowed, check_reading, check_sample, tripped

AERO = Aero2Detailed.definition
RULES = Supervision.of(AERO)
CRITICAL = float(RULES.critical[0])
STEP = float(RULES.resolution[0])  # of the encoder
LARGE = np.array([AERO.inputs[0].amplitude])


def watched(outputs, inputs=0.0, rules=RULES, elapsed=None):
    """The watch after samples of one output, each followed by an input."""
    outputs = np.asarray(outputs, float).reshape(len(outputs), -1)
    inputs = np.broadcast_to(np.asarray(inputs, float), (len(outputs),))
    watch = Watch.start(np, rules, outputs[0])
    for measured, input in zip(outputs, inputs, strict=True):
        watch = check_reading(np, rules, watch, measured, elapsed or rules.dt)
        watch = check_sample(np, rules, watch)
        watch, _ = allowed(np, rules, watch, np.full(len(rules.lower), input))
    return watch


def trip_of(*arguments, **choices):
    return Trip(int(watched(*arguments, **choices).trip))


def seen(measured, before=0.0, elapsed=0.002):
    """The trip after one reading."""
    watch = Watch.start(np, RULES, np.array([before]))
    return check_reading(np, RULES, watch, np.array([measured]), elapsed).trip


# ---------------------------------------------------------------------------- readings


@pytest.mark.parametrize(("share", "trip"), [
    (0.9999, Trip.NONE), (-0.9999, Trip.NONE), (1.0, Trip.LEVEL), (-1.0, Trip.LEVEL),
    (1.001, Trip.LEVEL),
])  # fmt: skip
def test_a_reading_at_the_critical_level_trips(share, trip):
    assert seen(share * CRITICAL, before=math.copysign(0.998, share) * CRITICAL) == trip


def test_an_output_without_a_level_has_none():
    rules = Supervision.of(TwoMasses.definition)
    watch = Watch.start(np, rules, np.array([0.0, 50.0]))
    assert check_reading(np, rules, watch, np.array([0.0, 50.0]), 0.01).trip == Trip.NONE
    assert check_reading(np, rules, watch, np.array([0.5, 50.0]), 1.0).trip == Trip.LEVEL


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_reading_that_is_no_number_trips_and_is_not_remembered(number):
    watch = Watch.start(np, RULES, np.array([0.1]))
    watch = check_reading(np, RULES, watch, np.array([number]), 0.002)
    assert watch.trip == Trip.NOT_FINITE
    assert watch.reading == 0.1


def test_one_output_that_is_no_number_is_enough():
    rules = Supervision.of(TwoMasses.definition)
    watch = Watch.start(np, rules, np.zeros(2))
    watch = check_reading(np, rules, watch, np.array([0.01, math.nan]), 0.05)
    assert watch.trip == Trip.NOT_FINITE
    np.testing.assert_array_equal(watch.reading, [0.01, 0.0])


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("elapsed", [0.002, 0.02, 0.1 + 0.2 - 0.25])
def test_a_change_beyond_what_the_plant_can_do_is_a_jump(sign, elapsed):
    most = 10 * CRITICAL * elapsed + 8 * STEP
    assert most < CRITICAL
    assert seen(sign * 0.99 * most, elapsed=elapsed) == Trip.NONE
    assert seen(sign * 1.01 * most, elapsed=elapsed) == Trip.JUMP


def test_a_fast_plant_that_is_read_once_in_a_sampling_time_does_not_jump():
    rules = Supervision.of(DCMotor.definition)
    watch = Watch.start(np, rules, np.array([0.0, -4.0]))
    assert check_reading(np, rules, watch, np.array([19.0, 4.0]), rules.dt).trip == Trip.NONE
    watch = Watch.start(np, rules, np.array([0.0, -4.0]))
    assert check_reading(np, rules, watch, np.array([0.0, 6.1]), rules.dt).trip == Trip.JUMP


def test_a_plant_that_turns_within_a_sample_is_not_predicted():
    assert trip_of(np.array([0.33, -0.84, -0.93]) * CRITICAL) == Trip.NONE
    assert trip_of(np.array([-0.1, 0.8, 0.91]) * CRITICAL) == Trip.NONE


def test_beside_a_guard_only_what_is_no_number_trips():
    rules = dataclasses.replace(RULES, is_guarded=True)
    assert trip_of([0.0, 0.5, 0.6, 1.2 * CRITICAL, -0.5], rules=rules) == Trip.NONE
    assert trip_of([0.1] * 30, inputs=LARGE, rules=rules) == Trip.NONE
    assert trip_of([0.1, math.nan], rules=rules) == Trip.NOT_FINITE


def test_a_jump_over_the_level_is_told_as_a_jump():
    assert seen(2 * CRITICAL) == Trip.JUMP  # the record must not hold what no plant does


# -------------------------------------------------------------------------- prediction


@pytest.mark.parametrize(("shares", "trip"), [
    ((0.80, 0.88, 0.96), Trip.PREDICTED_LEVEL),
    ((-0.80, -0.88, -0.96), Trip.PREDICTED_LEVEL),
    ((0.5, 0.68, 0.86), Trip.NONE),  # predicted beyond it, but not near yet
    ((0.80, 0.90, 0.95), Trip.NONE),  # slows down: predicted 0.95
    ((0.96, 0.94, 0.92), Trip.NONE),  # moves away
    ((0.91, 0.96), Trip.NONE),  # too few samples to tell
])  # fmt: skip
def test_the_level_one_sample_ahead_trips_where_the_output_is_near(shares, trip):
    assert trip_of(np.array(shares) * CRITICAL) == trip


@pytest.mark.parametrize("frequency", [0.05, 0.2, 0.4])
def test_a_swing_that_turns_below_its_level_is_let_be(frequency):
    time = RULES.dt * np.arange(300)
    # The largest output is under the level, and the parabola knows that it is about to turn.
    pitch = 0.94 * CRITICAL * np.sin(2 * math.pi * frequency * time)
    quantised = np.round(pitch / STEP) * STEP
    assert trip_of(quantised, 5 * np.sin(time)) == Trip.NONE


# --------------------------------------------------------------------------- staleness


def ramp_then_still(num_still, size=5.0):
    """A movement of `size` resolutions a sample that stops at once."""
    moving = np.arange(10) * size * STEP
    return np.concatenate([moving, np.full(num_still, moving[-1])])


def test_what_stops_at_once_while_it_moves_is_stuck():
    assert trip_of(ramp_then_still(3)) == Trip.NONE
    assert trip_of(ramp_then_still(4)) == Trip.STALE
    assert trip_of(ramp_then_still(30, size=4.0)) == Trip.NONE  # as fast as a swing that turns


def test_one_more_movement_begins_the_count_anew():
    still = ramp_then_still(3)
    assert trip_of([*still, still[-1] + 9 * STEP, *([still[-1] + 9 * STEP] * 3)]) == Trip.NONE


def test_a_plant_that_is_driven_and_does_not_move_is_dead():
    assert trip_of(np.zeros(21), LARGE[0]) == Trip.STALE
    assert trip_of(np.zeros(20), LARGE[0]) == Trip.NONE
    assert trip_of(np.zeros(21), -LARGE[0]) == Trip.STALE


@pytest.mark.parametrize("share", [0.0, 0.2, -0.24])
def test_a_plant_at_rest_may_rest(share):
    assert trip_of(np.zeros(500), share * LARGE[0]) == Trip.NONE


def test_a_plant_that_answers_now_and_then_is_not_dead():
    outputs = np.repeat([0.0, STEP, 0.0, STEP], 20)
    assert trip_of(outputs, LARGE[0]) == Trip.NONE


def test_a_slow_turning_point_stands_still_without_a_trip():
    """Ever slower, six samples on one count, and back."""
    moves = np.array([6, 4, 3, 2, 1, 0, 0, 0, 0, 0, 0, -1, -2, -3, -4, -6])
    assert trip_of(np.cumsum(moves) * STEP, 0.0) == Trip.NONE


def test_one_stuck_output_of_two_is_enough():
    rules = Supervision.of(TwoMasses.definition)
    k = np.arange(14.0)
    noise = np.array([5 * k, 6 * np.minimum(k, 9)]) * rules.resolution[:, None]
    assert trip_of(noise.T, rules=rules) == Trip.STALE
    noise[1] = 6 * k * rules.resolution[1]
    assert trip_of(noise.T, rules=rules) == Trip.NONE


# ------------------------------------------------------------------------------ inputs


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_an_input_that_is_no_number_trips_and_the_safe_one_is_applied(number):
    watch = Watch.start(np, RULES, np.zeros(1))
    watch, input = allowed(np, RULES, watch, np.array([number]))
    assert watch.trip == Trip.INPUT_NOT_FINITE
    np.testing.assert_array_equal(input, [0.0])


@pytest.mark.parametrize(("proposed", "expected"), [(3.0, 3.0), (30.0, 24.0), (-1e9, -24.0)])
def test_an_input_stays_within_its_limits(proposed, expected):
    watch, input = allowed(np, RULES, Watch.start(np, RULES, np.zeros(1)), np.array([proposed]))
    assert watch.trip == Trip.NONE
    assert input == watch.input == expected


def test_an_input_changes_no_faster_than_allowed():
    rules = Supervision.of(AERO, slew=20.0)  # V/s: 2 V in a sample
    watch, inputs = Watch.start(np, rules, np.zeros(1)), []
    for proposed in (24.0, 24.0, 24.0, -24.0, -24.0, 1.5):
        watch, input = allowed(np, rules, watch, np.array([proposed]))
        inputs.append(float(input[0]))
    assert inputs == pytest.approx([2.0, 4.0, 6.0, 4.0, 2.0, 1.5])


def test_the_safe_input_after_a_trip_does_not_wait_for_the_slew():
    rules = Supervision.of(AERO, slew=20.0)
    watch = Watch.start(np, rules, np.zeros(1))
    for _ in range(5):
        watch, _ = allowed(np, rules, watch, np.array([24.0]))
    watch, input = allowed(np, rules, tripped(np, watch, np.True_, Trip.LEVEL), np.array([24.0]))
    assert input == 0


@pytest.mark.parametrize("slew", [0.0, -1.0, math.nan])
def test_a_slew_that_is_not_positive_is_refused(slew):
    with pytest.raises(ValueError, match="the slew limit must be positive"):
        Supervision.of(AERO, slew)


def test_the_safe_input_is_the_limit_nearest_to_zero():
    pulling = dataclasses.replace(AERO.inputs[0], lower=2.0)
    rules = Supervision.of(dataclasses.replace(AERO, inputs=(pulling,)))
    np.testing.assert_array_equal(rules.safe_input, [2.0])


# ----------------------------------------------------------------------------- latched


def test_the_first_reason_stays_and_only_the_safe_input_is_left():
    watch = Watch.start(np, RULES, np.array([0.998 * CRITICAL]))
    watch = check_reading(np, RULES, watch, np.array([CRITICAL]), 0.002)
    assert watch.trip == Trip.LEVEL
    for measured in (math.nan, 0.0, -2 * CRITICAL, 0.0):
        watch = check_reading(np, RULES, watch, np.array([measured]), 0.002)
        watch = check_sample(np, RULES, watch)
        for proposed in (5.0, math.nan):
            watch, input = allowed(np, RULES, watch, np.array([proposed]))
            assert watch.trip == Trip.LEVEL
            np.testing.assert_array_equal(input, RULES.safe_input)


def test_every_trip_has_a_sentence_of_its_own():
    sentences = [trip.sentence for trip in Trip if trip != Trip.NONE]
    assert all(sentences)
    assert len(set(sentences)) == len(sentences)


# --------------------------------------------------------------------- NumPy and JAX


def sampled(xp, rules, watch, readings, proposed):
    """The watch and the input after one sample of a few readings."""
    for measured in readings:
        watch = check_reading(xp, rules, watch, measured, rules.dt / 3)
    return allowed(xp, rules, check_sample(xp, rules, watch), proposed)


def sequences(rng, rules, count, length):
    """Wandering outputs and inputs: some stick, jump, grow too large, or are no numbers."""
    size = np.where(np.isfinite(rules.critical), rules.critical, 10 * rules.resolution)
    shape = (count, length, 3, len(size))
    strength = rng.choice([0.001, 0.02, 0.1], (count, 1, 1, 1))
    steps = strength * rng.normal(size=shape) * size
    stuck = (np.arange(length)[:, None] > rng.integers(3, length, (count, 1, 1)))[..., None]
    steps *= np.where(stuck & (rng.random((count, 1, 1, 1)) < 0.4), 0.0, 1.0)
    outputs = np.cumsum(steps.reshape(count, -1, len(size)), axis=1).reshape(shape)
    outputs[rng.random(shape) < 0.002] += 0.6
    outputs[rng.random(shape) < 0.001] = math.nan
    outputs[rng.random(shape) < 0.001] = math.inf
    inputs = rng.normal(size=(count, length, len(rules.lower))) * rules.upper
    inputs[rng.random(inputs.shape) < 0.005] = math.nan
    return outputs, inputs


@pytest.mark.parametrize("name", ["aero2_detailed", "two_masses"])
def test_numpy_and_jax_judge_alike(name):
    rules = Supervision.of(PLANTS[name].definition, slew=50.0)
    outputs, inputs = sequences(np.random.default_rng(0), rules, 100, 30)
    in_jax = jax.jit(jax.vmap(lambda w, y, u: sampled(jnp, rules, w, y, u)))
    ours = [Watch.start(np, rules, first) for first in outputs[:, 0, 0]]
    theirs = jax.vmap(lambda first: Watch.start(jnp, rules, first))(jnp.asarray(outputs[:, 0, 0]))
    for k in range(outputs.shape[1]):
        with np.errstate(invalid="ignore"):  # a NaN is only compared
            steps = zip(ours, outputs[:, k], inputs[:, k], strict=True)
            pairs = [sampled(np, rules, *step) for step in steps]
        theirs, applied = in_jax(theirs, outputs[:, k], inputs[:, k])
        ours = [watch for watch, _ in pairs]
        alike(applied, np.array([input for _, input in pairs]))
        for part, values in zip(theirs, zip(*ours, strict=True), strict=True):
            alike(part, np.array(values))
    assert {Trip(int(watch.trip)) for watch in ours} >= WANTED


WANTED = {Trip.NONE, Trip.NOT_FINITE, Trip.JUMP, Trip.STALE, Trip.INPUT_NOT_FINITE}


def alike(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-12)
