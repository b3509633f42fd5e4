"""Simulation against SciPy's integrator; the closed loop, its sensor and its derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from catalogue import PLANTS, TwoMasses

from excite.excitation import AbstractExcitation, Chirp, Multisine, Random, Replay
from excite.plant import Aero2, CartPole, Sensor
from excite.simulation import response, run_episode, sensed, step

plants = pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
KEY = jax.random.key(5)
NUM_STEPS = 120


class Feedback(AbstractExcitation):
    """A closed loop: the input is the measurement times a gain."""

    gain: float

    def init(self, plant, num_steps, key):
        return jnp.asarray(0)

    def __call__(self, state, measurement):
        return state + 1, self.gain * measurement


def integrated(plant, params, inputs, start) -> np.ndarray:
    """Outputs at all samples by SciPy, to tight tolerance, the inputs held."""
    derivative = jax.jit(lambda x, u: plant.derivative(x, u, params))
    states = [np.asarray(start)]
    for u in inputs:
        solution = scipy.integrate.solve_ivp(
            lambda _, x, u=u: np.asarray(derivative(x, u)),
            (0.0, float(plant.dt)),
            states[-1],
            method="DOP853",
            rtol=1e-10,
            atol=1e-12,
        )
        states.append(solution.y[:, -1])
    return np.stack([plant.output(x, params) for x in states])


# ------------------------------------------------------------------------- simulate


@plants
def test_simulation_agrees_with_scipy(plant):
    # Small beside the sensor is small enough: 3 % of its sd adds 0.1 % to its power. The
    # Coulomb friction of EMPS is a kink that any fixed step cuts: 20 % adds 4 %.
    allowed = 0.2 if plant.definition.name == "emps" else 0.03
    start = plant.initial_state + 0.3 * jnp.array([s.scale for s in plant.definition.states])
    inputs = Random(hold=3).sequence(plant, NUM_STEPS, KEY)
    params = plant.Params(*(1.2 * v for v in plant.nominal))
    ours = response(plant, params, inputs, start)
    error = np.abs(ours - integrated(plant, params, inputs, start)).max(axis=0)
    assert np.all(error < allowed * plant.sensor.sd), (
        f"more substeps are needed: the error of the outputs is {error / plant.sensor.sd} times "
        f"the sensor's sd, and must be below {allowed}"
    )


def test_halving_the_step_divides_the_error_by_sixteen():
    plant, start = Aero2(), jnp.array([1.5, 0.0])
    inputs = jnp.full((8, 1), 10.0)
    exact = integrated(plant.changed(dt=0.4), plant.nominal, inputs, start)
    errors = []
    for halvings in (3, 4, 5):  # steps of 50, 25, 12.5 ms: one a sample
        fine = plant.changed(dt=0.4 / 2**halvings)
        assert fine.substeps == 1
        held = jnp.repeat(inputs, 2**halvings, axis=0)
        ours = response(fine, plant.nominal, held, start)[:: 2**halvings]
        errors.append(np.linalg.norm(ours - exact))
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 16, rtol=0.1)


def test_substeps_are_steps_of_their_own():
    coarse, start = Aero2().changed(dt=0.3), jnp.array([1.0, 0.5])
    fine = coarse.changed(dt=0.05)
    assert (coarse.substeps, fine.substeps) == (6, 1)
    state, u = start, jnp.array([5.0])
    for _ in range(6):
        state = step(fine, state, u, fine.nominal)
    np.testing.assert_allclose(step(coarse, start, u, coarse.nominal), state, rtol=1e-13)


def test_an_input_acts_after_its_own_sample_and_before_the_next():
    plant = Aero2()
    impulse = jnp.zeros((10, 1)).at[4].set(20.0)
    outputs = response(plant, plant.nominal, impulse)[:, 0]
    np.testing.assert_array_equal(outputs[:5], 0.0)
    assert outputs[5] > 0


@plants
def test_vmap_over_parameters_equals_a_loop(plant):
    inputs = Multisine().sequence(plant, NUM_STEPS, KEY)
    factors = jnp.array([0.8, 1.0, 1.3])
    batch = plant.Params(*(factors * v for v in plant.nominal))
    together = jax.vmap(response, in_axes=(None, 0, None))(plant, batch, inputs)
    for i in range(3):
        alone = response(plant, plant.Params(*(v[i] for v in batch)), inputs)
        np.testing.assert_allclose(together[i], alone, rtol=1e-9, atol=1e-12)


# ---------------------------------------------------------------------- run_episode


@plants
def test_without_noise_an_episode_is_the_simulation_of_its_inputs(plant):
    silent = jnp.zeros(len(plant.definition.outputs))
    plant = plant.changed(sensor=Sensor(silent, silent))
    episode = run_episode(plant, plant.nominal, Random(), NUM_STEPS, KEY)
    expected = response(plant, plant.nominal, episode.inputs)
    np.testing.assert_allclose(episode.outputs, expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(episode.measured, episode.outputs)
    np.testing.assert_allclose(episode.time, plant.dt * np.arange(NUM_STEPS + 1))
    assert episode.inputs.shape == (NUM_STEPS, len(plant.definition.inputs))


def test_an_episode_plays_the_sequence_of_its_signal():
    inputs = Multisine().sequence(TwoMasses(), NUM_STEPS, KEY)
    episode = run_episode(TwoMasses(), TwoMasses().nominal, Replay(inputs), NUM_STEPS, KEY)
    np.testing.assert_array_equal(episode.inputs, inputs)


def test_feedback_sees_the_measurement_of_its_sample_and_is_clipped():
    plant = Aero2(
        initial_state=jnp.array([0.5, 0.0]), sensor=Sensor(jnp.array([0.01]), jnp.zeros(1))
    )
    episode = run_episode(plant, plant.nominal, Feedback(-60.0), NUM_STEPS, KEY)
    wanted = -60.0 * episode.measured[:-1]
    np.testing.assert_array_equal(episode.inputs, np.clip(wanted, -24.0, 24.0))
    assert np.abs(wanted).max() > 24 > np.abs(wanted).min()


def test_noise_has_the_sd_of_its_sensor_and_is_white():
    plant = CartPole(sensor=Sensor(jnp.array([0.003, 0.05]), jnp.zeros(2)))
    n = 4000
    episode = run_episode(plant, plant.nominal, Chirp(), n - 1, KEY)
    noise = np.asarray((episode.measured - episode.outputs) / plant.sensor.noise_sd[None])
    # Five standard deviations of each statistic.
    assert np.all(np.abs(noise.mean(axis=0)) < 5 / np.sqrt(n))
    np.testing.assert_allclose(noise.std(axis=0), 1.0, atol=5 / np.sqrt(2 * n))
    assert abs(np.mean(noise[:, 0] * noise[:, 1])) < 5 / np.sqrt(n)
    assert np.all(np.abs(np.mean(noise[1:] * noise[:-1], axis=0)) < 5 / np.sqrt(n))
    assert abs(np.mean(noise**4) - 3.0) < 5 * np.sqrt(96 / (2 * n))  # Gaussian


def test_a_key_gives_every_excitation_the_same_noise():
    plant = Aero2()
    noise = []
    for excitation in (Random(), Chirp(), Feedback(-3.0)):
        episode = run_episode(plant, plant.nominal, excitation, NUM_STEPS, KEY)
        noise.append(episode.measured - episode.outputs)
    # Equal but for the rounding of outputs of size one.
    np.testing.assert_allclose(noise[1], noise[0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(noise[2], noise[0], rtol=0, atol=1e-15)
    assert np.ptp(noise[0]) > 0


def test_an_encoder_rounds_to_multiples_of_its_resolution():
    resolution = 2 * np.pi / 2880
    plant = Aero2(sensor=Sensor(jnp.array([0.0]), jnp.array([resolution])))
    episode = run_episode(plant, plant.nominal, Chirp(), NUM_STEPS, KEY)
    counts = np.asarray(episode.measured) / resolution
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.abs(episode.measured - episode.outputs).max() <= resolution / 2 + 1e-15
    assert len(np.unique(np.round(counts))) > 20


def test_noise_is_added_before_the_encoder_rounds():
    plant = Aero2(sensor=Sensor(jnp.array([0.3]), jnp.array([0.1])))
    rough = plant.changed(sensor=Sensor(jnp.array([0.3]), jnp.array([0.0])))
    keys = jax.random.split(KEY, 200)
    shown, before = (
        jax.vmap(lambda key, p=p: sensed(p, jnp.array([0.77]), jax.random.normal(key, (1,))))(keys)
        for p in (plant, rough)
    )
    np.testing.assert_allclose(shown, np.round(before / 0.1) * 0.1, atol=1e-12)


def test_vmap_over_keys_and_parameters_equals_a_loop():
    plant = TwoMasses()
    keys = jax.random.split(KEY, 3)
    batch = plant.Params(*(jnp.array([0.8, 1.0, 1.3]) * v for v in plant.nominal))
    many = jax.vmap(run_episode, in_axes=(None, 0, None, None, 0))
    together = many(plant, batch, Random(), 50, keys)
    for i in range(3):
        params = plant.Params(*(v[i] for v in batch))
        alone = run_episode(plant, params, Random(), 50, keys[i])
        for ours, theirs in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(
                ours if ours.shape == theirs.shape else ours[i], theirs, rtol=1e-9, atol=1e-12
            )


# ---------------------------------------------------------------------- derivatives


def central_difference(function, x: float, h: float) -> float:
    return float(function(jnp.asarray(x + h)) - function(jnp.asarray(x - h))) / (2 * h)


def power(plant, params, excitation):
    return jnp.mean(run_episode(plant, params, excitation, NUM_STEPS, KEY).measured ** 2)


@pytest.mark.parametrize("excitation", [Random(), Feedback(-3.0)], ids=["open", "closed loop"])
def test_an_episode_is_differentiable_in_a_parameter(excitation):
    plant = Aero2(initial_state=jnp.array([0.3, 0.0]))

    def of_inertia(J_p):
        return power(plant, plant.nominal._replace(J_p=J_p), excitation)

    slope = jax.grad(of_inertia)(0.0232)
    assert slope != 0
    assert slope == pytest.approx(central_difference(of_inertia, 0.0232, 1e-6), rel=1e-6)


def test_an_episode_is_differentiable_in_the_settings_of_its_excitation():
    plant = Aero2()

    def of_amplitude(amplitude):
        return power(plant, plant.nominal, Chirp(amplitude, 0.1, 1.0))

    slope = jax.grad(of_amplitude)(5.0)
    assert slope > 0
    assert slope == pytest.approx(central_difference(of_amplitude, 5.0, 1e-4), rel=1e-6)


def test_the_derivative_passes_straight_through_an_encoder():
    resolution = jnp.array([0.05])
    encoder = Aero2(sensor=Sensor(jnp.zeros(1), resolution))

    def last(J_p, attribute):
        params = encoder.nominal._replace(J_p=J_p)
        return getattr(run_episode(encoder, params, Chirp(), NUM_STEPS, KEY), attribute)[-1, 0]

    slope = jax.grad(last)(0.0232, "measured")
    assert slope == pytest.approx(jax.grad(last)(0.0232, "outputs"))
    assert slope == pytest.approx(
        central_difference(lambda J_p: last(J_p, "outputs"), 0.0232, 1e-6), rel=1e-6
    )


def test_derivatives_reach_the_constants_and_the_initial_state_of_a_plant():
    plant = Aero2(initial_state=jnp.array([0.3, 0.0]))
    inputs = jnp.zeros((40, 1))

    @eqx.filter_grad
    def slope(plant):
        return response(plant, plant.nominal, inputs)[-1, 0]

    def of_gravity(g):
        return response(plant.changed(g=g), plant.nominal, inputs)[-1, 0]

    def of_start(pitch):
        return response(plant, plant.nominal, inputs, jnp.array([pitch, 0.0]))[-1, 0]

    gradient = slope(plant)
    assert gradient.constants.g == pytest.approx(
        central_difference(of_gravity, 9.81, 1e-4), rel=1e-6
    )
    assert gradient.initial_state[0] == pytest.approx(
        central_difference(of_start, 0.3, 1e-5), rel=1e-6
    )
