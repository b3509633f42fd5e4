"""Designed signals: better than classical ones, safe, reproducible, at least a known optimum."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import PLANTS

from excite.description import Input, Output, Parameter, PlantDescription, State, prior_sd_of
from excite.environment import run_episodes
from excite.excitation import Chirp, Replay
from excite.excitation.catalogue import EXCITATIONS, LOOP
from excite.plant import AbstractPlant, Aero2
from excite.plant.uncertainty import Uncertainty
from excite.record import read_record
from excite.training.design import design
from excite.training.signals import (
    CLAIRVOYANT,
    FULL_MARGIN,
    ROBUST,
    _margin,
    clairvoyant_signals,
    robust_signal,
    signal_env,
)
from excite.training.tuning import tuned_signal

STEPS = 100
KEYS = jax.random.split(jax.random.key(5), 2)
QUICK = dataclasses.replace(CLAIRVOYANT, num_updates=150)


def log_det(plant, signal, keys, spread=0.3):
    episodes = run_episodes(plant, signal, STEPS, spread, keys)
    return np.linalg.slogdet(np.asarray(episodes.information))[1], episodes


@pytest.mark.science
def test_a_clairvoyant_signal_beats_the_chirp_on_its_own_plant_and_is_safe():
    plant = Aero2()
    env = signal_env(plant, STEPS, 0.3)
    design = clairvoyant_signals(env, KEYS, 2, QUICK)
    chirp, _ = log_det(plant, Chirp(), KEYS)
    for i in range(2):
        own, episodes = log_det(plant, Replay(jnp.asarray(design.inputs[i])), KEYS[i : i + 1])
        assert own[0] > chirp[i] + 1
        assert not episodes.is_violation[0]
        prior = 3 * np.log(1 / prior_sd_of(0.3) ** 2)
        np.testing.assert_allclose(design.worth[i] + prior, own[0], rtol=1e-4)
    assert np.all(design.nearness < CLAIRVOYANT.near)
    assert np.all(design.nearness > CLAIRVOYANT.near - 2e-3)  # the whole level is used
    np.testing.assert_array_equal(design.worth, design.worth_by_start.max(axis=1))


def test_the_margin_of_a_search_closes_at_its_end():
    margins = [float(_margin(CLAIRVOYANT, i, FULL_MARGIN)) for i in range(0, 3001, 250)]
    assert margins[:9] == [CLAIRVOYANT.margin] * 9
    assert np.all(np.diff(margins[8:]) > 0)
    assert margins[-1] == pytest.approx(FULL_MARGIN[1])
    assert float(_margin(CLAIRVOYANT, 2999, None)) == CLAIRVOYANT.margin


@pytest.mark.science
def test_a_search_gives_the_same_signal_again():
    env = signal_env(Amplifier(), 12, 0.3)
    few = dataclasses.replace(QUICK, num_updates=5)
    first, again = (clairvoyant_signals(env, KEYS, 2, few).inputs for _ in range(2))
    np.testing.assert_array_equal(first, again)


@pytest.mark.science
def test_a_robust_signal_is_safe_for_plants_it_was_not_designed_on():
    plant = Aero2()
    settings = dataclasses.replace(ROBUST, num_updates=60, num_plants=16, watch_every=20)
    design = robust_signal(signal_env(plant, STEPS, 0.3), 0, 2, settings)
    keys = jax.random.split(jax.random.key(9), 300)
    own, episodes = log_det(plant, Replay(jnp.asarray(design.inputs[0])), keys)
    assert design.inputs.shape == (1, STEPS, 1)
    assert own.mean() > log_det(plant, Chirp(), keys)[0].mean()
    assert int(episodes.is_violation.sum()) <= 3


class Amplifier(AbstractPlant):
    """y' = (g u - y) / 1 ms: at its sampling time y = g u, whose best input is all there is."""

    definition = PlantDescription(
        name="amplifier",
        states=(State("y", "V"),),
        inputs=(Input("u", "V", -2.0, 2.0),),
        outputs=(Output("y", "V", 10.0, noise_sd=0.1),),
        parameters=(Parameter("g", "", 3.0),),
        dt=0.01, substeps=20, band=(1.0, 20.0),
    )  # fmt: skip

    def derivative(self, state, input, params):
        return 1000.0 * (params.g * input - state)

    def output(self, state, params):
        return state


@pytest.mark.science
def test_the_best_input_of_an_amplifier_is_its_limit():
    env = signal_env(Amplifier(), 20, 0.3)
    design = clairvoyant_signals(env, KEYS[:1], 2, dataclasses.replace(QUICK, num_updates=400))
    # The last steps of the ascent are flat, so that a few samples may end 1 % below the limit.
    assert np.all(np.abs(design.inputs) > 0.95 * 2.0)
    assert np.mean(design.inputs**2) > 0.99 * 2.0**2


@pytest.mark.science
@pytest.mark.parametrize("name", [*sorted(EXCITATIONS), LOOP + "square"])
def test_tuning_finds_options_that_are_allowed_and_the_same_again(name):
    env = signal_env(Aero2(), STEPS, 0.3)
    tuned = tuned_signal(env, name, trials=4)
    assert tuned.trials == 4
    assert np.isfinite(tuned.value)
    again = tuned_signal(env, name, trials=4)
    assert dict(again.options) == dict(tuned.options)


class Bomb(AbstractPlant):
    """Grows without bound whatever its input is."""

    definition = PlantDescription(
        name="bomb",
        states=(State("y", "V"),),
        inputs=(Input("u", "V", -2.0, 2.0),),
        outputs=(Output("y", "V", 9.0, noise_sd=0.1, warning_level=5.0, critical_level=9.0),),
        parameters=(Parameter("g", "", 3.0),),
        dt=0.1, substeps=4, band=(0.1, 1.0),
    )  # fmt: skip

    def derivative(self, state, input, params):
        return params.g * (1.0 + state**2) + input

    def output(self, state, params):
        return state


@pytest.mark.slow
def test_a_tuning_that_finds_no_usable_setting_says_so():
    with pytest.raises(ValueError, match="tuning 'chirp' found no usable setting"):
        tuned_signal(signal_env(Bomb(), 20, 0.3), "chirp", trials=2)


@pytest.mark.science
def test_another_seed_is_another_search():
    env = signal_env(Amplifier(), 12, 0.3)
    first, second = (
        clairvoyant_signals(env, KEYS[:1], 1, dataclasses.replace(QUICK, num_updates=2), seed=seed)
        for seed in (0, 1)
    )
    assert not np.allclose(first.inputs, second.inputs)


@pytest.mark.science
def test_tuning_beats_the_default_chirp():
    plant = Aero2()
    tuned = tuned_signal(signal_env(plant, STEPS, 0.3), "chirp", trials=40)
    default, _ = log_det(plant, Chirp(), jax.random.split(jax.random.key(3), 200))
    assert tuned.value > default.mean()
    assert tuned.violations <= 3


@pytest.mark.science
@pytest.mark.parametrize("name", ["two_masses", "dc_motor", "emps", "cart_pole"])
def test_every_plant_can_be_designed_for(name):
    env = signal_env(PLANTS[name], 30, 0.3)
    design = clairvoyant_signals(env, KEYS[:1], 1, dataclasses.replace(QUICK, num_updates=3))
    assert design.inputs.shape == (1, 30, len(PLANTS[name].definition.inputs))


@pytest.mark.slow
def test_a_design_is_saved_shown_and_played(tmp_path):
    plant, told = Amplifier(), []
    made = design(
        plant, steps=12, starts=1, updates=2, noise={"y": 0.2}, seed=3,
        progress=lambda *seen: told.append(seen),
    )  # fmt: skip
    assert told == [("updating 1 of 2", 1, 2), ("updating 2 of 2", 2, 2)]
    assert made.plant.outputs[0].noise_sd == 0.2
    assert repr(made).startswith("robust input for amplifier, 12 samples\nlog det ")
    assert max(map(len, repr(made).splitlines())) < 80
    assert all(line in made._repr_html_() for line in repr(made).splitlines())
    made.save(tmp_path / "signal.csv")
    with pytest.raises(ValueError, match="exists"):
        made.save(tmp_path / "signal.csv")
    record = read_record(tmp_path / "signal.csv", made.plant)
    np.testing.assert_array_equal(record.inputs[:-1], made.inputs)
    assert record.metadata["provenance"]["worth_by_start"] == list(made.worth_by_start)
    episodes = run_episodes(plant, made.excitation, 12, 0.3, KEYS)
    np.testing.assert_array_equal(episodes.trajectory.inputs[0], made.inputs)
    assert made.plot().axes


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"kind": "chrip"}, "unknown kind of design 'chrip'; did you mean 'chirp'"),
        ({"kind": "chirp", "updates": 3}, "a tuning has trials (--trials)"),
        ({"kind": "chirp", "starts": 3}, "a tuning has trials (--trials)"),
        ({"trials": 3}, "a robust design has updates (--updates)"),
        ({"steps": 1}, "steps must be a whole number from 2 to 10000000: got 1"),
        (
            {"spread": 1.0},
            "such as factor:3: got 1.0",
        ),
        ({"criterion": "F"}, "criterion must be D, A or E: got 'F'"),
        ({"noise": {"yaw": 1.0}}, "unknown aero2 output 'yaw'"),
        ({"out": "signal.txt"}, "experiment files end in .csv or .mat"),
    ],
)
def test_an_argument_of_a_design_that_is_not_allowed_is_a_sentence(arguments, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        design("aero2", **arguments)


class Limited(Amplifier):
    """With |y| below 9 V: at gain 2 and parameter 3.9 the input must stay below 1.154 V."""

    definition = dataclasses.replace(
        Amplifier.definition, outputs=(Output("y", "V", 10.0, noise_sd=0.1, critical_level=9.0),)
    )


@pytest.mark.science
def test_a_robust_signal_is_made_safe_in_a_declared_uncertainty():
    plant, few = Limited(), dataclasses.replace(ROBUST, num_updates=200, num_plants=4)
    box = Uncertainty.of(plant, 0.3, {"gain_u": (0.5, 2.0)})
    found = robust_signal(signal_env(plant, 12, 0.3, uncertainty=box), 0, 2, few)
    usual = robust_signal(signal_env(plant, 12, 0.3), 0, 2, few)
    highest = 9.0 / (2 * 1.3 * 3.0)
    assert 0.9 * highest < np.max(np.abs(found.inputs)) < highest
    assert np.max(np.abs(usual.inputs)) > 1.5 * highest
    assert found.worth[0] < usual.worth[0]


def test_only_a_robust_design_takes_an_uncertainty():
    with pytest.raises(ValueError, match="only a robust design takes an uncertainty"):
        design("aero2", "clairvoyant", uncertainty={"d_S": "10%"})
