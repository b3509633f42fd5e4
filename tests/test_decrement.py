"""Logarithmic decrement against the poles of a linear oscillator, and its failures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import PLANTS

from excite.description import Constant, Input, Output, Parameter, PlantDescription, State
from excite.estimation import Decrement, Status, stack_experiments
from excite.excitation import Decay, Random
from excite.plant import Aero2
from excite.plant.contract import AbstractARXPlant
from excite.simulation import run_episode


class Oscillator(AbstractARXPlant):
    """m x'' + c x' + k x = b u with a known spring."""

    definition = PlantDescription(
        name="oscillator",
        states=(State("x", "m"), State("v", "m/s")),
        inputs=(Input("u", "N", -5.0, 5.0),),
        outputs=(Output("position", "m", 1.0, noise_sd=1e-6),),
        parameters=(
            Parameter("m", "kg", 2.0), Parameter("c", "N s/m", 0.1), Parameter("b", "", 3.0),
        ),
        constants=(Constant("k", "N/m", 8.0),),
        dt=0.05, substeps=4, band=(0.1, 2.0),
    )  # fmt: skip

    def derivative(self, state, input, params):
        x, v = state
        force = params.b * input[0] - params.c * v - self.constants.k * x
        return jnp.stack([v, force / params.m])

    def output(self, state, params):
        return state[:1]

    def from_transfer_function(self, c_0, c_1, d_0):
        m = self.constants.k / c_0
        return self.Params(m=m, c=c_1 * m, b=d_0 * m)


def estimated(plant, params, signal, num_steps=600):
    run = run_episode(plant, params, signal, num_steps, jax.random.key(0))
    return Decrement()(plant, stack_experiments(plant, [run.inputs], [run.measured], True))


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.3])
def test_a_linear_oscillator_is_recovered(factor):
    plant = Oscillator()
    params = plant.Params(*(factor * jnp.stack(plant.nominal)))
    estimate = estimated(plant, params, Decay(amplitude=1.0, frequency=0.32))
    assert estimate.status == Status.SUCCESSFUL
    np.testing.assert_allclose(jnp.stack(estimate.params), jnp.stack(params), rtol=2e-3)


@pytest.mark.science
def test_the_covariance_covers_repeated_noise():
    plant = Oscillator()
    noisy = plant.changed(sensor=dataclasses.replace(plant.sensor, noise_sd=jnp.array([2e-3])))

    def one(key):
        run = run_episode(noisy, noisy.nominal, Decay(amplitude=1.0, frequency=0.32), 600, key)
        data = stack_experiments(noisy, [run.inputs], [run.measured], True)
        estimate = Decrement()(noisy, data)
        return jnp.stack(estimate.params), jnp.sqrt(jnp.diagonal(estimate.covariance))

    found, claimed = jax.vmap(one)(jax.random.split(jax.random.key(1), 200))
    ratio = np.std(found, axis=0) / np.median(claimed, axis=0)
    assert np.all((ratio > 0.5) & (ratio < 2.0)), ratio


@pytest.mark.parametrize("num_steps", [600, 2400, 6000])
def test_what_is_left_when_the_decay_is_over_changes_nothing(num_steps):
    plant = Oscillator()
    noisy = plant.changed(sensor=dataclasses.replace(plant.sensor, noise_sd=jnp.array([2e-3])))
    params = noisy.nominal._replace(c=jnp.asarray(1.0))
    signal = Decay(amplitude=1.0, frequency=0.32, pump=120 / num_steps)
    estimate = estimated(noisy, params, signal, num_steps)
    assert estimate.status == Status.SUCCESSFUL
    np.testing.assert_allclose(jnp.stack(estimate.params), jnp.stack(params), rtol=0.05)


def test_too_few_swings_above_the_noise_are_no_decay():
    plant = Oscillator()
    noisy = plant.changed(sensor=dataclasses.replace(plant.sensor, noise_sd=jnp.array([2e-3])))
    params = noisy.nominal._replace(c=jnp.asarray(5.0))
    estimate = estimated(noisy, params, Decay(amplitude=1.0, frequency=0.32), 2000)
    assert estimate.status == Status.ILL_CONDITIONED


def test_a_record_that_begins_elsewhere_has_its_free_response_fitted():
    plant = Oscillator()
    away = plant.changed(initial_state=jnp.array([0.5, 0.0]))
    signal = Decay(amplitude=1.0, frequency=0.32)
    run = run_episode(away, away.nominal, signal, 600, jax.random.key(0))
    data = stack_experiments(plant, [run.inputs], [run.measured], False)
    estimate = Decrement()(plant, data)
    np.testing.assert_allclose(jnp.stack(estimate.params), jnp.stack(plant.nominal), rtol=2e-3)


def test_an_input_that_never_rests_has_no_decay():
    plant = Aero2()
    assert estimated(plant, plant.nominal, Random()).status == Status.ILL_CONDITIONED


def test_a_plant_without_a_mapping_is_refused():
    plant = PLANTS["cart_pole"]
    with pytest.raises(ValueError, match="'cart_pole' has no mapping"):
        estimated(plant, plant.nominal, Decay(), 50)
