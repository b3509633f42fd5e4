"""A simulated rig that misbehaves: delays and effects that are not known, and faults."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import excite as ex
from excite.environment.falsification import Cases
from excite.excitation import Chirp, Replay
from excite.plant import Aero2, CartPole
from excite.plant.catalogue import with_sensor
from excite.plant.extension import extended
from excite.plant.uncertainty import Uncertainty
from excite.rig.catalogue import RigOptions, rig_named
from excite.rig.falsification import OnRig
from excite.rig.faults import Faults
from excite.rig.filter import SafetyFilter
from excite.rig.simulated import (
    NO_FILTER,
    Hardware,
    at_interval,
    drawn_hardware,
    one_run,
)
from excite.safety import Supervision, Trip
from excite.simulation import response, run_episode

PLANT = with_sensor(Aero2(), {"pitch": 0.0}, {"pitch": 0.0})
RULES = Supervision.of(PLANT.description)
READINGS, STEPS = 10, 40
INTERVAL = 0.1 / READINGS
CHIRP = Chirp(amplitude=4.0)
INPUTS = CHIRP.sequence(PLANT, STEPS, jax.random.key(0))
AT_ONCE: dict[str, Any] = {"latency": 0.0, "jitter": 0.0}


@eqx.filter_jit
def readings(hardware: Hardware, inputs=INPUTS):
    """Outputs, readings and acting inputs; no supervisor looks."""

    def reading(state, _):
        state = hardware.advance(state)
        return state, (hardware.plant.output(state.plant_state, hardware.params), state.shown,
                       state.acting)  # fmt: skip

    def sample(state, input):
        return jax.lax.scan(reading, hardware.write(state, input), None, length=READINGS)

    _, seen = jax.lax.scan(sample, hardware.start(), inputs)
    return tuple(part.reshape(-1, part.shape[-1]) for part in seen)


def hardware(plant=PLANT, effects=None, **options) -> Hardware:
    options = {**AT_ONCE, **options}
    return Hardware.draw(plant, READINGS, 0.2, jax.random.key(3), effects=effects, **options)


# ----------------------------------------------------------------------------------- delays


@pytest.mark.science
def test_a_delay_acts_on_the_rig_as_in_an_episode():
    """Exactly for whole samples; parts of them are an approximation in the episode."""
    plant, delays = extended(PLANT, ["delay_voltage"]), (0.0, 0.1, 0.3, 0.04, 0.17)
    longest = hardware(effects={"delay_voltage": 0.3})

    def both(delay):
        rig = dataclasses.replace(longest, params=plant.Params(*longest.params[:3], delay))
        episode = run_episode(plant, rig.params, CHIRP, STEPS, jax.random.key(0))
        return one_run(rig, CHIRP, RULES, STEPS, READINGS, NO_FILTER), episode

    runs, episodes = jax.jit(jax.vmap(both))(jnp.array(delays))
    np.testing.assert_allclose(runs.inputs, episodes.inputs, rtol=1e-12)
    fine, size = at_interval(PLANT, READINGS), float(np.max(np.abs(episodes.outputs)))
    for i, delay in enumerate(delays):
        bound = (1e-6 if i < 3 else 3e-3) * size  # steps of integration are shorter on the rig
        np.testing.assert_allclose(runs.measured[i], episodes.outputs[i], rtol=0, atol=bound)
        # With the same steps it is exact for parts of a sample, too.
        late, held = round(delay / INTERVAL), jnp.repeat(INPUTS, READINGS, axis=0)
        held = jnp.concatenate([jnp.zeros((late, 1)), held])[: len(held)]
        true = response(fine, fine.Params(*longest.params[:3]), held)[::READINGS]
        np.testing.assert_allclose(runs.measured[i], true, rtol=0, atol=1e-12)


@pytest.mark.science
def test_latency_and_delay_are_one_time():
    late = hardware(latency=0.03)
    both = hardware(effects={"delay_voltage": 0.02}, latency=0.01)
    np.testing.assert_allclose(readings(late)[0], readings(both)[0], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_delay_that_is_no_whole_number_of_readings():
    """Against fine steps, in which each input is constant."""
    plant = Aero2()
    delays = jnp.array([0.013, 0.047, 0.111, 0.358])
    many = jax.vmap(
        lambda d: dataclasses.replace(
            hardware(effects={"delay_voltage": 0.36}),
            params=extended(plant, ["delay_voltage"]).Params(*plant.nominal, d),
        )
    )(delays)
    outputs = jax.vmap(lambda rig: readings(rig)[0])(many)
    fine = at_interval(PLANT, 100)
    for delay, found in zip(delays.tolist(), outputs, strict=True):
        late, held = round(delay / 0.001), jnp.repeat(INPUTS, 100, axis=0)
        held = jnp.concatenate([jnp.zeros((late, 1)), held])[: len(held)]
        true = response(fine, plant.nominal, held)[10::10]
        np.testing.assert_allclose(found, true, rtol=0, atol=1e-9)


def test_a_safe_input_does_not_overtake_those_before_it():
    rig = hardware(effects={"delay_voltage": 0.25}, latency=0.01)
    advance, write = eqx.filter_jit(Hardware.advance), eqx.filter_jit(Hardware.write)
    state, acted = rig.start(), []
    for n in range(60):
        if n in (0, 10, 13):  # two samples, and a trip soon after the second
            state = write(rig, state, jnp.array({0: [3.0], 10: [5.0], 13: [0.0]}[n]))
        state = advance(rig, state)
        acted.append(float(state.acting[0]))
    late = 26  # readings; what acts at the end of an interval is shown
    expected = np.repeat([0.0, 3.0, 5.0, 0.0], [late - 1, 10, 3, 60 - late - 12])
    np.testing.assert_allclose(acted, expected)


@pytest.mark.science
def test_a_derivative_by_the_delay_is_that_of_differences():
    plant = extended(PLANT, ["delay_voltage"])
    rig = hardware(effects={"delay_voltage": 0.2})

    @jax.jit
    def last(delay):
        there = dataclasses.replace(rig, params=plant.Params(*rig.params[:3], delay))
        return readings(there)[0][-1, 0]

    slope = jax.grad(last)(0.123)
    differences = (last(0.1231) - last(0.1229)) / 0.0002
    np.testing.assert_allclose(slope, differences, rtol=1e-3)


# ---------------------------------------------------------------------------------- effects


@pytest.mark.slow
def test_effects_leave_the_drawn_parameters_and_the_known_plant():
    keys = jax.random.split(jax.random.key(0), 3)
    bare = drawn_hardware(PLANT, READINGS, 0.3, keys, **AT_ONCE)
    wrong = drawn_hardware(PLANT, READINGS, 0.3, keys, effects={"gain_voltage": -1.0}, **AT_ONCE)
    np.testing.assert_array_equal(np.array(wrong.params)[:3], bare.params)
    for i in range(3):
        rigs = [jax.tree.map(lambda leaf, i=i: leaf[i], many) for many in (bare, wrong)]
        usual, turned = (readings(rig)[0] for rig in rigs)
        np.testing.assert_allclose(turned, -usual)  # the plant is odd


# ----------------------------------------------------------------------------------- faults


def test_no_fault_changes_nothing_and_an_infinite_time_is_never():
    never = Faults(sensor_frozen=math.inf, sensor_bias=0.1, sensor_bias_from=math.inf)
    for part, other in zip(readings(hardware()), readings(hardware(faults=never)), strict=True):
        np.testing.assert_array_equal(part, other)


FROM = 1.0
AFTER = round(FROM / INTERVAL)  # readings


def test_a_frozen_sensor_repeats_and_a_biased_one_is_off_from_a_time_on():
    true, usual, _ = readings(hardware())
    np.testing.assert_allclose(true, usual, rtol=0, atol=1e-15)
    _, frozen, _ = readings(hardware(faults=Faults(sensor_frozen=FROM)))
    np.testing.assert_allclose(frozen[: AFTER - 1], true[: AFTER - 1], rtol=0, atol=1e-15)
    assert set(np.asarray(frozen[AFTER - 1 :, 0]).tolist()) == {float(frozen[AFTER - 2, 0])}
    bias = Faults(sensor_bias=[0.07], sensor_bias_from=FROM)
    same, biased, _ = readings(hardware(faults=bias))
    np.testing.assert_allclose(same, true, rtol=0, atol=1e-15)
    off = biased - true
    np.testing.assert_allclose(off[: AFTER - 1], 0.0, atol=1e-15)
    np.testing.assert_allclose(off[AFTER - 1 :], 0.07, rtol=1e-12)


def test_a_slow_sensor_is_a_first_order_lag():
    true, slow, _ = readings(hardware(faults=Faults(sensor_slow=0.2)))
    share, expected = math.exp(-INTERVAL / 0.2), [0.0]
    for output in np.asarray(true)[:, 0]:
        expected.append(share * expected[-1] + (1 - share) * output)
    np.testing.assert_allclose(slow[:, 0], expected[1:], rtol=0, atol=1e-12)
    assert np.max(np.abs(slow - true)) > 0.15 * np.max(np.abs(true))


@pytest.mark.parametrize("delay", [0.0, 0.15])
def test_an_actuator_sticks_dies_or_turns_round_from_a_time_on(delay):
    effects = {"delay_voltage": delay}
    _, _, usual = readings(hardware(effects=effects))
    for name, expected in (
        ("actuator_stuck", jnp.broadcast_to(usual[AFTER - 1], usual[AFTER:].shape)),
        ("actuator_dead", jnp.zeros_like(usual[AFTER:])),
        ("actuator_sign", -usual[AFTER:]),
    ):
        faulty = hardware(effects=effects, faults=Faults(**{name: FROM}))
        _, _, acting = readings(faulty)
        np.testing.assert_array_equal(acting[:AFTER], usual[:AFTER])
        np.testing.assert_array_equal(acting[AFTER:], expected, err_msg=name)
    # From the beginning, a sign is a gain.
    turned = readings(hardware(effects=effects, faults=Faults(actuator_sign=0.0)))[0]
    gain = readings(hardware(effects={**effects, "gain_voltage": -1.0}))[0]
    np.testing.assert_allclose(turned, gain, rtol=1e-12, atol=1e-15)


@pytest.mark.slow
def test_a_stuck_actuator_holds_its_input_also_after_a_trip():
    faults = Faults(actuator_stuck=FROM)
    loud = Replay(jnp.full((STEPS, 1), 20.0))
    run = one_run(hardware(faults=faults), loud, RULES, STEPS, READINGS, NO_FILTER)
    assert int(run.trip) != Trip.NONE
    assert not np.asarray(run.inputs[-1]).any()
    assert bool(run.is_violation)


# --------------------------------------------------------------------------------- by name


@pytest.fixture(scope="module")
def worst(tmp_path_factory):
    """The file of a plant with a delay, as a search writes it."""
    found = ex.falsify(
        "chirp", "aero2", steps=20, budget=100, rig=True, uncertainty={"delay_voltage": (0, 0.3)}
    )
    path = tmp_path_factory.mktemp("worst") / "worst.json"
    found.save(path)
    return found, str(path)


def facts(fault, name="simulated", plant=PLANT):
    rig = rig_named(name, plant, plant.description, RigOptions(fast=True, fault=fault))
    rig.open()
    rig.write(np.array([4.0] * len(plant.definition.inputs)))
    return [rig.read().outputs[0] for _ in range(30)], rig.facts()["true_params"], rig


@pytest.mark.slow
def test_faults_and_effects_go_by_name():
    usual, params, _ = facts({})
    biased, _, _ = facts({"sensor_bias_pitch": 0.1})
    np.testing.assert_allclose(np.subtract(biased, usual), 0.1)
    turned, other, _ = facts({"gain_voltage": -1.0, "latency": 0.0})
    assert other == {**params, "gain_voltage": -1.0}
    assert turned[-1] * usual[-1] < 0
    dead, _, _ = facts({"actuator_dead": 0.0})
    np.testing.assert_array_equal(dead, 0.0)


def test_a_bias_of_one_of_two_outputs_leaves_the_other():
    plant = with_sensor(CartPole(), {o.name: 0.0 for o in CartPole.definition.outputs})
    name = plant.definition.outputs[1].name
    rig = rig_named(
        "simulated", plant, plant.description,
        RigOptions(fast=True, fault={f"sensor_bias_{name}": 0.05}),
    )  # fmt: skip
    rig.open()
    np.testing.assert_allclose(rig.read().outputs, [0.0, 0.05], atol=1e-2)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"sensor_frozn": 1.0}, "did you mean 'sensor_frozen'"),
        ({"sensor_frozen": -1.0}, "must be 0 s or more"),
        ({"actuator_dead": math.nan}, "must be 0 s or more"),
        ({"sensor_bias_pitch": math.inf}, "must be finite"),
        ({"delay_voltage": -0.1}, "0 to 100 s"),
        ({"delay_voltage": 1e6}, "0 to 100 s"),
        ({"lag_voltage": -1.0}, "lag_voltage = -1 s is not allowed"),
        ({"gain_voltage": math.nan}, "gain_voltage = nan"),
        ({"dropout": 1.0}, "must lie in"),
    ],
)
def test_a_fault_that_is_not_allowed_is_one_sentence(fault, words):
    with pytest.raises(ValueError, match=words):
        facts(fault)


# --------------------------------------------------------------------------- falsification


@pytest.mark.science
def test_a_case_on_the_rig_is_the_run_of_its_plant_and_seed():
    plant = Aero2()
    box = Uncertainty.of(plant, 0.3, {"delay_voltage": (0.0, 0.2), "initial_pitch": (-0.1, 0.1)})
    play = OnRig.of(box, CHIRP, STEPS, num_readings=READINGS, **AT_ONCE)
    assert play.num_written == 5
    case = Cases(jnp.array([0.3, -0.4, 0.8, 1.0, -0.5]), jnp.asarray(5))
    made, params = box.at(case.point)
    assert play.hardware(case).params == params
    episode = run_episode(made, params, CHIRP, STEPS, jax.random.key(0))
    played = eqx.filter_jit(lambda play, case: (play.run(case), play(case)))
    run, nearness = played(play, case)
    far = np.abs(run.measured - episode.outputs)
    assert np.max(far) < 5 * float(plant.sensor.noise_sd[0])
    np.testing.assert_allclose(nearness, run.max_abs_output[0] / RULES.critical[0], rtol=1e-12)
    assert run.max_abs_output[0] >= np.max(np.abs(episode.outputs)) * (1 - 1e-5)
    noise = play.noise(case)
    assert noise.shape == ((STEPS + 1) * READINGS + 1, 1)
    given, _ = played(play, Cases(case.point, case.seed, noise))
    np.testing.assert_allclose(given.measured, run.measured, rtol=0, atol=1e-15)
    silent, _ = played(play, Cases(case.point, case.seed, 0 * noise))
    np.testing.assert_allclose(silent.measured, episode.outputs, rtol=0, atol=1e-5)


@pytest.mark.science
def test_a_gradient_through_the_rig_is_that_of_differences():
    box = Uncertainty.of(PLANT, 0.3, {"delay_voltage": (0.0, 0.25)})
    play = OnRig.of(box, CHIRP, 20, num_readings=5)
    point = jnp.array([0.3, -0.4, 0.8, 0.1])

    @jax.jit
    @jax.value_and_grad
    def size(point):
        return play(Cases(point, jnp.asarray(5)))

    slope = size(point)[1]
    assert np.all(np.isfinite(slope))
    assert np.count_nonzero(slope) == 4
    for i, move in enumerate(1e-4 * np.eye(4)):
        differences = (size(point + move)[0] - size(point - move)[0]) / 2e-4
        np.testing.assert_allclose(slope[i], differences, rtol=0.02)


@pytest.mark.science
def test_the_worst_plant_on_the_rig_is_replayed_from_its_file(worst, tmp_path):
    found, path = worst
    assert found.certificate()["rig"] is True
    assert found.certificate()["filter"] is False
    assert "aero2's simulated rig" in repr(found)
    options = {"excitation": "chirp", "fast": True, "steps": 20, "seed": found.worst_seed}
    again: Any = ex.run(rig=path, out=tmp_path / "replay.csv", **options)
    np.testing.assert_allclose(again.record.outputs, found.record.outputs, atol=1e-9)
    np.testing.assert_allclose(again.record.inputs[:-1], found.record.inputs[:-1], atol=1e-9)
    true = again.outcome.rig["true_params"]
    assert true == {n: v for n, v in found.worst.items() if n in true}
    assert again.description.name == "aero2"
    largest = np.ravel(again.outcome.rig["true_max_abs_output"])[0] / RULES.critical[0]
    # A search also looks at the sample after the last one.
    assert largest * (1 - 1e-9) <= found.nearness < 1.02 * largest
    stages = {stage.name: stage.nearness for stage in found.stages}
    assert stages["ascents"] > stages["random plants"]


@pytest.mark.science
def test_a_case_behind_the_filter_stays_below_the_level():
    box, loud = Uncertainty.of(Aero2(), 0.3), Chirp(amplitude=20.0)
    case = Cases(jnp.array([1.0, 1.0, -1.0]), jnp.asarray(0))
    near = [
        float(eqx.filter_jit(OnRig.of(box, loud, 150, safety, num_readings=2))(case))
        for safety in (NO_FILTER, SafetyFilter.of(Aero2(), 0.3))
    ]
    assert near[1] < 1 < near[0], near


@pytest.mark.science
def test_what_was_searched_is_said(worst):
    found, _ = worst
    filtered = dataclasses.replace(
        found, filter=True, policy=ex.read_policy("aero2"), num_steps=500
    )
    assert "aero2's simulated rig behind the safety filter" in repr(filtered)
    claim = filtered.certified().claim
    assert "experiments on the simulated rig behind the safety filter" in claim


def test_a_filter_without_a_rig_is_refused():
    with pytest.raises(ValueError, match=r"needs rig \(--rig\)"):
        ex.falsify("chirp", "aero2", filter=True)
