"""Signals against SciPy, spectra and laws; the grid of all signals on all plants."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from catalogue import EXCITATIONS, PLANTS, TwoMasses

from excite.environment import Env
from excite.excitation import (
    PRBS,
    AbstractSignal,
    Chirp,
    Decay,
    Multisine,
    PolicyExcitation,
    PositionLoop,
    Random,
    Replay,
    Square,
    crest_factor,
    maximum_length_sequence,
)
from excite.plant import Aero2
from excite.plant.contract import Sensor
from excite.policy import Layout, Policy
from excite.simulation import run_episode

NUM_STEPS = 200
KEY = jax.random.key(7)
AERO2, TWO = Aero2(), TwoMasses()

excitations = pytest.mark.parametrize("excitation", EXCITATIONS)
plants = pytest.mark.parametrize("plant", PLANTS)


@functools.cache
def of(plant: str, excitation: str) -> np.ndarray:
    return np.asarray(EXCITATIONS[excitation].sequence(PLANTS[plant], NUM_STEPS, KEY))


def of_aero2(signal: AbstractSignal, num_steps: int = NUM_STEPS, key=KEY) -> np.ndarray:
    return np.asarray(signal.sequence(AERO2, num_steps, key)[:, 0])


# ------------------------------------------------------------------------- the grid


@excitations
@plants
def test_values_stay_within_the_input_limits(plant, excitation):
    definition, sequence = PLANTS[plant].definition, of(plant, excitation)
    assert sequence.shape == (NUM_STEPS, len(definition.inputs))
    for column, part in zip(sequence.T, definition.inputs, strict=True):
        assert part.lower <= column.min() < column.max() <= part.upper


@excitations
@plants
def test_values_stay_within_the_amplitude_around_the_middle_of_the_limits(plant, excitation):
    amplitude = EXCITATIONS[excitation].amplitude
    for column, part in zip(of(plant, excitation).T, PLANTS[plant].definition.inputs, strict=True):
        largest = part.amplitude if amplitude is None else float(amplitude)
        distance = np.abs(column - (part.lower + part.upper) / 2).max()
        assert distance <= min(largest, (part.upper - part.lower) / 2) * (1 + 1e-12)
        assert distance > 0.9 * min(largest, (part.upper - part.lower) / 2)


@excitations
@plants
def test_a_key_gives_the_same_sequence_again(plant, excitation):
    again = EXCITATIONS[excitation].sequence(PLANTS[plant], NUM_STEPS, KEY)
    np.testing.assert_array_equal(again, of(plant, excitation))


@excitations
def test_another_key_changes_random_signals_only(excitation):
    other = EXCITATIONS[excitation].sequence(AERO2, NUM_STEPS, jax.random.key(8))
    drawn = excitation.startswith(("random", "prbs"))
    assert np.array_equal(other, of("aero2", excitation)) == (not drawn)


@excitations
def test_several_inputs_are_not_multiples_of_each_other(excitation):
    sequence = of("two_masses", excitation)
    values = np.linalg.svd(scipy.signal.detrend(sequence, 0, "constant"), compute_uv=False)
    assert values[1] > 0.2 * values[0]


@excitations
def test_vmap_over_keys_equals_a_loop(excitation):
    keys = jax.random.split(KEY, 3)
    make = functools.partial(EXCITATIONS[excitation].sequence, TWO, NUM_STEPS)
    for key, sequence in zip(keys, jax.jit(jax.vmap(make))(keys), strict=True):
        np.testing.assert_allclose(sequence, make(key), rtol=0, atol=1e-12)


@excitations
def test_an_experiment_reads_the_sequence_row_by_row_whatever_is_measured(excitation):
    signal = EXCITATIONS[excitation]
    state, rows = signal.init(TWO, NUM_STEPS, KEY), []
    for _ in range(3):
        state, row = signal(state, jnp.full(2, jnp.nan))
        rows.append(row)
    np.testing.assert_array_equal(rows, of("two_masses", excitation)[:3])


def test_each_input_may_have_an_amplitude_of_its_own():
    sequence = PRBS(amplitude=jnp.array([1.0, 2.0])).sequence(TWO, 50, KEY)
    np.testing.assert_array_equal(np.unique(sequence[:, 0]), [-1.0, 1.0])
    np.testing.assert_array_equal(np.unique(sequence[:, 1]), [1.0, 5.0])


# --------------------------------------------------------------------- random, PRBS


@pytest.mark.parametrize("samples", [1, 3, 8])
@pytest.mark.parametrize("kind", [
    lambda n: Random(hold=n), lambda n: PRBS(clock=n), lambda n: PRBS(clock=n, register=9),
], ids=["random", "prbs", "register"])  # fmt: skip
def test_a_value_is_held_for_its_number_of_samples(kind, samples):
    values = of_aero2(kind(samples), 301)
    changes = np.flatnonzero(np.diff(values)) + 1
    assert changes.size > 0
    assert np.all(changes % samples == 0)
    assert np.gcd.reduce(changes) == samples


def test_random_is_uniform():
    num_steps = 4000
    values = of_aero2(Random(amplitude=3.0), num_steps) / 3.0
    # Five standard deviations of the mean, and of the mean square (variance 4 / 45).
    assert abs(values.mean()) < 5 * np.sqrt(1 / 3 / num_steps)
    assert abs(np.mean(values**2) - 1 / 3) < 5 * np.sqrt(4 / 45 / num_steps)


@pytest.mark.parametrize("signal", [PRBS(), PRBS(clock=5), PRBS(register=7)])
def test_prbs_takes_two_values_about_equally_often(signal):
    values = of_aero2(signal, 2000)
    np.testing.assert_array_equal(np.unique(values), [-7.2, 7.2])
    assert abs(np.mean(values > 0) - 0.5) < 5 * 0.5 / np.sqrt(2000 / signal.clock)


@pytest.mark.parametrize("bits", range(2, 17))
def test_a_maximum_length_sequence_has_the_autocorrelation_of_noise(bits):
    sequence, period = maximum_length_sequence(bits), 2**bits - 1
    assert sequence.shape == (period,)
    assert set(sequence) == {-1.0, 1.0}
    assert sequence.sum() == 1  # one 1 more than -1
    autocorrelation = np.fft.irfft(np.abs(np.fft.rfft(sequence)) ** 2, period) / period
    np.testing.assert_allclose(autocorrelation, [1.0] + [-1 / period] * (period - 1), atol=1e-9)


@pytest.mark.parametrize("bits", [4, 7])
def test_a_maximum_length_sequence_is_that_of_scipy_or_its_reversal(bits):
    ours = maximum_length_sequence(bits)
    theirs = 2.0 * scipy.signal.max_len_seq(bits)[0] - 1
    spectra = np.fft.rfft(ours), np.fft.rfft(theirs)
    # The largest circular cross-correlation of equal sequences is their length.
    ahead = np.fft.irfft(spectra[0] * spectra[1].conj(), ours.size).max()
    reversed_ = np.fft.irfft(spectra[0] * spectra[1], ours.size).max()
    assert max(ahead, reversed_) == pytest.approx(ours.size)


def test_a_register_repeats_with_its_period_and_a_second_input_lags():
    period = 2**6 - 1
    sequence = np.asarray(PRBS(register=6).sequence(TWO, 3 * period, KEY))
    np.testing.assert_array_equal(sequence[period:], sequence[:-period])
    first, second = np.sign(sequence - [[0.0, 3.0]]).T
    delay = period // 2
    np.testing.assert_array_equal(second[delay:], first[:-delay])
    assert abs(first[:period] @ second[:period]) == 1  # as uncorrelated as can be


# ---------------------------------------------------------------- chirp, multisine


@pytest.mark.parametrize("method", ["linear", "logarithmic"])
@pytest.mark.parametrize(("low", "high"), [(0.05, 2.0), (1.5, 0.1)])
def test_a_chirp_is_that_of_scipy(method, low, high):
    signal = Chirp(7.0, low, high, logarithmic=method == "logarithmic")
    time = 0.1 * np.arange(500)
    theirs = scipy.signal.chirp(time, low, 50.0, high, method, phi=-90)
    np.testing.assert_allclose(of_aero2(signal, 500), 7.0 * theirs, atol=1e-9)


@pytest.mark.parametrize("logarithmic", [False, True])
def test_a_chirp_begins_and_ends_with_the_frequencies_of_its_band(logarithmic):
    signal = Chirp(1.0, 0.5, 4.0, logarithmic=logarithmic)
    fine, duration = AERO2.changed(dt=1e-4), 4.0
    values = np.asarray(signal.sequence(fine, 40000, KEY))[:, 0]
    rises = np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0)) * 1e-4
    cycles = np.concatenate([[0.0], rises])
    # The sweep's own law gives the frequency in the middle of a cycle.
    for start, stop in ((cycles[0], cycles[1]), (cycles[-2], cycles[-1])):
        middle = (start + stop) / 2 / duration
        expected = 0.5 * 8.0**middle if logarithmic else 0.5 + 3.5 * middle
        assert 1 / (stop - start) == pytest.approx(expected, rel=0.02 if start else 0.1)


def test_signals_sweep_the_band_of_the_plant_unless_told_otherwise():
    low, high = Aero2.definition.band
    for kind in (Chirp, Multisine):
        stated = kind(start_frequency=low, stop_frequency=high)
        np.testing.assert_array_equal(of_aero2(kind()), of_aero2(stated))
    np.testing.assert_array_equal(
        of_aero2(Square()), of_aero2(Square(frequency=np.sqrt(low * high)))
    )


def test_a_band_beyond_half_the_sampling_rate_ends_there():
    slow = Aero2().changed(dt=0.5)  # the band of aero2 reaches 2 Hz, half the rate is 1 Hz
    expected = Chirp(stop_frequency=1.0).sequence(slow, 50, KEY)
    np.testing.assert_array_equal(Chirp().sequence(slow, 50, KEY), expected)


def test_the_second_input_of_a_chirp_is_the_first_half_an_experiment_later():
    first, second = (np.asarray(Chirp().sequence(TWO, 200, KEY)) - [[0.0, 3.0]]).T
    np.testing.assert_allclose(np.roll(first / 2.0, 100), second / 2.5, atol=1e-12)


@pytest.mark.parametrize("num_steps", [500, 501])
@pytest.mark.parametrize(("low", "high"), [(0.1, 2.0), (0.5, 0.6), (0.02, 5.0)])
def test_a_multisine_is_flat_in_its_band_and_zero_outside(low, high, num_steps):
    values = of_aero2(Multisine(3.0, low, high), num_steps)
    magnitude = np.abs(np.fft.rfft(values))
    frequency = np.fft.rfftfreq(num_steps, 0.1)
    inside = (frequency >= low - 1e-9) & (frequency <= high + 1e-9)
    assert inside.sum() > 3
    np.testing.assert_allclose(magnitude[inside], magnitude[inside][0], rtol=1e-9)
    assert magnitude[~inside].max() < 1e-9 * magnitude.max()
    assert np.abs(values).max() == pytest.approx(3.0)


def test_phases_change_a_multisine_and_not_its_spectrum():
    usual, drawn, again, other = (of_aero2(Multisine(phases=n)) for n in (0, 1, 1, 2))
    np.testing.assert_array_equal(drawn, again)
    shapes = [np.abs(np.fft.rfft(own)) for own in (usual, drawn, other)]
    for own in shapes[1:]:
        np.testing.assert_allclose(own / own.max(), shapes[0] / shapes[0].max(), atol=1e-9)
    for one, two in ((usual, drawn), (drawn, other)):
        assert abs(one @ two) < 0.5 * np.sqrt((one @ one) * (two @ two))


@pytest.mark.parametrize(("low", "high"), [(0.1, 2.0), (0.05, 4.0), (1.0, 2.0)])
def test_schroeder_phases_lower_the_crest_factor(low, high):
    values = of_aero2(Multisine(1.0, low, high), 500)
    zero_phases = np.fft.irfft(np.abs(np.fft.rfft(values)), 500)
    ours, theirs = np.asarray(crest_factor(jnp.stack([values, zero_phases], axis=1)))
    assert ours < 2.0 < theirs


def test_several_inputs_of_a_multisine_share_out_the_harmonics():
    sequence = np.asarray(Multisine().sequence(TWO, 300, KEY)) - [[0.0, 3.0]]
    first, second = (np.abs(np.fft.rfft(column)) > 1e-6 for column in sequence.T)
    frequency = np.fft.rfftfreq(300, 0.05)
    np.testing.assert_array_equal(first ^ second, (frequency > 0.199) & (frequency < 4.001))
    assert not np.any(first & second)
    assert abs(sequence[:, 0] @ sequence[:, 1]) < 1e-9


def test_a_multisine_of_a_band_without_harmonics_is_zero():
    np.testing.assert_array_equal(of_aero2(Multisine(1.0, 0.021, 0.039), 500), 0.0)


# ------------------------------------------------------- square, replay, crest factor


def test_a_square_wave_is_that_of_scipy():
    # A quarter of a sample later: scipy leaves the value at the switch to rounding.
    time = 0.1 * np.arange(300) + 0.025
    theirs = scipy.signal.square(2 * np.pi * 0.25 * time)
    np.testing.assert_array_equal(of_aero2(Square(2.0, 0.25), 300), 2.0 * theirs)


def test_the_second_input_of_a_square_wave_switches_twice_as_fast():
    first, second = np.sign(
        np.asarray(Square(frequency=0.5).sequence(TWO, 400, KEY)) - [[0.0, 3.0]]
    ).T
    np.testing.assert_array_equal(second[:200], first[::2])
    assert first[:40] @ second[:40] == 0


def test_replay_gives_the_first_rows_clipped_to_the_limits():
    recorded = np.array([[1.0, -5.0], [-9.0, 7.0], [2.0, 2.0]])
    signal = Replay(jnp.asarray(recorded))
    np.testing.assert_array_equal(signal.sequence(TWO, 2, KEY), [[1.0, 0.0], [-5.0, 6.0]])


def test_crest_factor_of_known_signals():
    time = np.arange(1000) / 1000
    signals = np.stack([np.sin(2 * np.pi * 5 * time), np.sign(time - 0.4), 0 * time], axis=1)
    np.testing.assert_allclose(
        crest_factor(jnp.asarray(signals)), [np.sqrt(2), 1.0, np.inf], rtol=1e-3
    )


@pytest.mark.parametrize(("signal", "sentence"), [
    (Random(hold=0), "hold is a number of samples, at least 1: got 0"),
    (PRBS(clock=-2), "clock is a number of samples, at least 1: got -2"),
    (PRBS(register=17), "register has 2 to 16 bits, or 0 for none: got 17"),
    (PRBS(register=1), "register has 2 to 16 bits, or 0 for none: got 1"),
    (Replay(jnp.zeros((9, 1))), "has 9 samples of 1 inputs; the experiment needs 10 samples of 1"),
    (Replay(jnp.zeros((10, 2))), "has 10 samples of 2 inputs; the experiment needs 10 samples"),
])  # fmt: skip
def test_a_setting_that_makes_no_sense_is_refused_in_a_sentence(signal, sentence):
    with pytest.raises(ValueError, match=sentence):
        signal.sequence(AERO2, 10, KEY)


def test_a_logarithmic_chirp_that_stays_at_its_frequency_is_a_sine():
    expected = np.sin(2 * np.pi * 0.5 * 0.1 * np.arange(100))
    np.testing.assert_allclose(
        of_aero2(Chirp(1.0, 0.5, 0.5, logarithmic=True), 100), expected, atol=1e-9
    )


# --------------------------------------------------------------------------- a policy


def policy_of(plant, num_steps: int = 30, gain: float = 0.1) -> Policy:
    """Random weights: what it does matters less than that it is done twice."""
    layout = Layout.of(plant.description, window=6, num_steps=num_steps)
    rng, num_inputs = np.random.default_rng(5), len(layout.input_half)
    weights = (
        (rng.normal(size=(8, layout.size)), 0.3 * rng.normal(size=8)),
        (gain * rng.normal(size=(num_inputs, 8)), np.zeros(num_inputs)),
    )
    return Policy(plant.description, layout, weights)


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.1, 3.0])
@pytest.mark.parametrize("plant", [AERO2, TWO], ids=["aero2", "two_masses"])
def test_a_policy_meets_in_an_experiment_what_it_met_in_training(plant, gain):
    num_outputs = len(plant.definition.outputs)
    silent = plant.changed(sensor=Sensor(jnp.zeros(num_outputs), jnp.zeros(num_outputs)))
    policy = policy_of(plant, gain=gain)
    env = Env.of(silent, layout=policy.layout)
    state, observation = env.reset(KEY)
    step = eqx.filter_jit(env.step)
    params, actions, states = state.params, [], []
    for _ in range(30):
        actions.append(policy(np.asarray(observation)))
        state, transition = step(state, jnp.asarray(actions[-1]))
        observation = transition.observation
        states.append(state.plant_state)
    episode = run_episode(silent, params, PolicyExcitation.of(policy), 30, jax.random.key(0))
    lower = np.array([part.lower for part in plant.definition.inputs])
    upper = np.array([part.upper for part in plant.definition.inputs])
    inputs = (lower + upper) / 2 + (upper - lower) / 2 * np.array(actions, float)
    np.testing.assert_allclose(episode.inputs, inputs, rtol=1e-5, atol=1e-5 * upper.max())
    outputs = [plant.output(state, params) for state in states]
    np.testing.assert_allclose(episode.outputs[1:], outputs, rtol=1e-5, atol=1e-6)
    assert np.all(np.std(episode.inputs, axis=0) > 0)
    limits = (episode.inputs == lower[None]) | (episode.inputs == upper[None])
    assert np.any(limits) == (gain == 3.0)


def test_a_policy_looks_at_the_measurements():
    policy = policy_of(AERO2)
    loud = AERO2.changed(sensor=Sensor(jnp.ones(1), jnp.zeros(1)))
    excitation = PolicyExcitation.of(policy)
    ours, other = (
        run_episode(plant, plant.nominal, excitation, 30, KEY).inputs for plant in (AERO2, loud)
    )
    assert np.all(ours != other)


def test_a_shorter_experiment_is_the_beginning_of_a_longer_one():
    # k / T is that of the policy, not of the experiment.
    excitation = PolicyExcitation.of(policy_of(AERO2))
    silent = AERO2.changed(sensor=Sensor(jnp.zeros(1), jnp.zeros(1)))
    long, short = (
        run_episode(silent, AERO2.nominal, excitation, num_steps, KEY) for num_steps in (30, 11)
    )
    np.testing.assert_allclose(short.inputs, long.inputs[:11], rtol=1e-6)


def test_an_experiment_longer_than_the_policy_was_made_for_is_refused():
    excitation = PolicyExcitation.of(policy_of(AERO2))
    with pytest.raises(ValueError, match="made for 30 steps; the experiment has 31"):
        run_episode(AERO2, AERO2.nominal, excitation, 31, KEY)


def test_a_decay_is_a_square_wave_and_then_rests():
    signal = of_aero2(Decay(amplitude=3.0, frequency=0.15, pump=0.4))
    wave = of_aero2(Square(amplitude=3.0, frequency=0.15))
    np.testing.assert_array_equal(signal[:80], wave[:80])
    np.testing.assert_array_equal(signal[80:], 0.0)


def test_a_position_loop_is_the_law_it_states():
    loop = PositionLoop(Square(frequency=0.1), amplitude=0.2, gain=3.0, damping=0.5)
    run = run_episode(AERO2, AERO2.nominal, loop, NUM_STEPS, KEY)
    reference = 0.2 * np.asarray(Square(frequency=0.1).shape(AERO2, NUM_STEPS, KEY)[:, 0])
    y = np.asarray(run.measured[:-1, 0])
    rate = np.diff(y, prepend=y[0]) / 0.1
    np.testing.assert_allclose(run.inputs[:, 0], 3.0 * (reference - y) - 0.5 * rate, atol=1e-9)


def test_a_position_loop_keeps_a_plant_with_an_integrator_near_its_reference():
    plant = PLANTS["emps"]
    loop = PositionLoop(Chirp(start_frequency=0.1, stop_frequency=0.3), amplitude=0.05,
                        gain=20_000.0, damping=1500.0)  # fmt: skip
    run = run_episode(plant, plant.nominal, loop, 500, KEY)
    assert 0.03 < np.abs(run.outputs[:, 0]).max() < 0.07
    with pytest.raises(ValueError, match="drives one input; 'two_masses' has 2"):
        PositionLoop(Chirp()).init(TWO, 10, KEY)
