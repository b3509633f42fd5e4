"""Falsification: the worst plant of a box, against closed forms and an exhaustive search."""

import dataclasses
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import excite

import excite as ex
from excite.description import Input, Output, Parameter, PlantDescription, State
from excite.environment import Env, run_episodes
from excite.environment.falsification import Cases, Effort, OnPlant, nearness, search
from excite.excitation import Coast, PositionLoop, Replay, Square
from excite.files import json_text, write_json
from excite.plant import EMPS, AbstractPlant, Aero2, params_within
from excite.plant.catalogue import plant_from, plant_in_file, plant_named, with_sensor, word_of
from excite.plant.contract import with_nominal
from excite.plant.extension import extended
from excite.plant.uncertainty import Uncertainty
from excite.policy import Layout, shown_nearness
from excite.safety import critical_levels
from excite.simulation import response, run_episode
from excite.study.agent import Agent, AgentSettings

SMALL = Effort(
    random=64, corners=8, noises=1, starts=16, steps=20, more_noises=4, searched_noises=2
)


class Oscillator(AbstractPlant):
    """y'' + 2 zeta w y' + w² y = w² u, noise-free: the worst w is where the input resonates."""

    definition = PlantDescription(
        name="oscillator",
        states=(State("y", "m"), State("v", "m/s")),
        inputs=(Input("u", "m", -1.0, 1.0),),
        outputs=(Output("y", "m", 1.0, noise_sd=0.01, critical_level=4.0),),
        parameters=(Parameter("w", "rad/s", 5.0), Parameter("zeta", "", 0.1)),
        dt=0.05,
        substeps=2,
        band=(0.1, 5.0),
    )

    def derivative(self, state, input, params):
        y, v = state
        acceleration = params.w**2 * (input[0] - y) - 2 * params.zeta * params.w * v
        return jnp.stack([v, acceleration])

    def output(self, state, params):
        return state[:1]


def sine(frequency: float, steps: int = 300) -> Replay:
    return Replay(jnp.sin(frequency * 0.05 * jnp.arange(steps))[:, None])


def largest(plant: AbstractPlant, params, excitation, steps: int, seed: int = 0) -> float:
    run = run_episode(plant, params, excitation, steps, jax.random.key(seed))
    return float(np.max(np.abs(run.outputs[:, 0]))) / float(critical_levels(plant.definition)[0])


# --------------------------------------------------------------------- declared uncertainty


@pytest.mark.parametrize(
    ("given", "lower", "upper"),
    [
        ((0.001, 0.003), 0.001, 0.003),
        ("0.001:0.003", 0.001, 0.003),
        ("10%", 0.9 * 0.0019435, 1.1 * 0.0019435),
        ("factor:2", 0.0019435 / 2, 0.0019435 * 2),
    ],
)
def test_a_range_is_read_as_it_is_written(given, lower, upper):
    box = Uncertainty.of(Aero2(), 0.0, {"d_S": given})
    found = box.ranges()
    assert found.keys() == {"J_p", "K_pu", "D_p", "d_S"}
    np.testing.assert_allclose(found["d_S"], [lower, upper], rtol=1e-12)
    middle = dict(zip(box.names, box.values(jnp.zeros(4)).tolist(), strict=True))["d_S"]
    is_factor = given == "factor:2"
    expected = np.sqrt(lower * upper) if is_factor else (lower + upper) / 2
    np.testing.assert_allclose(middle, expected, rtol=1e-12)


def test_a_factor_of_parameters_is_that_of_their_spread():
    plant = EMPS()
    box = Uncertainty.of(plant, "factor:2")
    whole = Uncertainty.of(plant, 0.1, {"parameters": "factor:2"})
    assert box.ranges() == whole.ranges()
    for corner in (-1.0, 1.0):
        expected = params_within(plant, "factor:2", corner * jnp.ones(len(box.names)))
        _, params = box.at(corner * jnp.ones(len(box.names)))
        np.testing.assert_allclose(params, expected, rtol=1e-12)


def test_a_point_of_the_box_is_the_plant_with_these_numbers():
    plant = Aero2()
    ranges = {
        "d_S": "10%", "delay_voltage": (0, 0.1), "initial_state": "2%",
        "initial_pitch_rate": (0, 0.3), "noise": (1, 2),
    }  # fmt: skip
    box = Uncertainty.of(plant, 0.4, ranges)
    made, params = box.at(jnp.ones(len(box.names)))
    np.testing.assert_allclose(params[:3], 1.4 * np.array(plant.nominal), rtol=1e-12)
    np.testing.assert_allclose(params.delay_voltage, 0.1)
    np.testing.assert_allclose(made.constants.d_S, 1.1 * 0.0019435, rtol=1e-12)
    scale = plant.definition.states[0].scale
    np.testing.assert_allclose(made.initial_state, [0.02 * scale, 0.3], rtol=1e-12)
    np.testing.assert_allclose(made.sensor.noise_sd, 2 * plant.sensor.noise_sd)
    assert made.constants.m == plant.constants.m


def test_corners_are_all_corners_or_as_many_as_asked_for():
    box = Uncertainty.of(Aero2(), 0.3)
    every = {tuple(row) for row in np.asarray(box.corners(jax.random.key(0), 8)).tolist()}
    assert every == set(itertools.product((-1.0, 1.0), repeat=3))
    few = np.asarray(box.corners(jax.random.key(0), 7))
    assert few.shape == (7, 3)
    assert len({tuple(row) for row in few.tolist()}) == 7
    assert set(few.ravel().tolist()) == {-1.0, 1.0}


def test_corners_of_a_box_of_many_quantities_differ():
    plant = with_parameters(20)
    many = np.asarray(Uncertainty.of(plant).corners(jax.random.key(1), 300))
    assert many.shape == (300, 20)
    assert len(np.unique(many, axis=0)) == 300
    assert abs(many.mean()) < 0.05


def with_parameters(count: int) -> AbstractPlant:
    own = tuple(Parameter(f"p{i}", "", 1.0) for i in range(count))
    definition = dataclasses.replace(Oscillator.definition, parameters=own)
    return type("Many", (Oscillator,), {"definition": definition})()


def test_a_spread_beyond_a_bound_names_the_remedy():
    narrow = dataclasses.replace(Oscillator.definition.parameter("zeta"), upper=0.11)
    parameters = (Oscillator.definition.parameter("w"), narrow)
    definition = dataclasses.replace(Oscillator.definition, parameters=parameters)
    plant = type("Narrow", (Oscillator,), {"definition": definition})()
    with pytest.raises(ValueError, match=r"smaller spread, or .*\(zeta=LOW:HIGH"):
        Uncertainty.of(plant, 0.3)
    with pytest.raises(ValueError, match=r"bounds 0 to 0.11$"):
        Uncertainty.of(plant, 0.3, {"zeta": (0.1, 0.2)})
    assert Uncertainty.of(plant, 0.3, {"zeta": (0.1, 0.105)}).ranges()["zeta"] == [0.1, 0.105]


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ({"d_s": "10%"}, "did you mean 'd_S'"),
        ({"d_S": (2, 1)}, "contains no plant"),
        ({"lag_voltage": (-1, 1)}, "beyond its bounds"),
        ({"delay_voltage": (-0.1, 0)}, "beyond its bounds"),
        ({"d_S": (float("nan"), 1)}, "must be finite"),
        ({"d_S": "often"}, "a percentage such as 10%"),
        ({"d_S": (1, 2, 3)}, "a percentage such as 10%"),
        ({"d_S": ("0", "1")}, "a percentage such as 10%"),
        ({"d_S": 0.1}, "a percentage such as 10%"),
        ({"J_p": (0, 1)}, "must be above 0"),
        ({"delay_voltage": "10%"}, "needs two numbers"),
        ({"d_S": "factor:0.5"}, "a factor is 1 or more"),
        ({"initial_pitch": "factor:2"}, "a positive nominal value"),
    ],
)
def test_a_range_that_is_not_allowed_is_one_sentence(ranges, words):
    with pytest.raises(ValueError, match=words):
        Uncertainty.of(Aero2(), 0.3, ranges)


@pytest.mark.science
@pytest.mark.parametrize("effect", ["bias_y", "drift_y"])
def test_levels_are_judged_without_errors_of_the_sensor(effect):
    plant = Oscillator()
    box = Uncertainty.of(plant, 0.0, {effect: (0.5, 0.5)})
    case = Cases(jnp.zeros(len(box.names)), jnp.asarray(0), jnp.zeros((51, 1)))
    true, params = box.at(case.point)
    expected = largest(plant, plant.nominal, sine(5.0), 50)
    np.testing.assert_allclose(OnPlant(box, sine(5.0), 50)(case), expected, rtol=1e-12)
    run = run_episode(true, params, sine(5.0), 50, jax.random.key(0), case.noise)
    error = 0.5 * np.ones(51) if effect == "bias_y" else 0.5 * np.asarray(run.time)
    np.testing.assert_allclose((run.measured - run.outputs)[:, 0], error, atol=1e-9)
    np.testing.assert_allclose(response(true, params, run.inputs), run.measured, atol=1e-9)
    own = with_nominal(true, {name: float(x) for name, x in params._asdict().items()})
    env = Env.of(own, layout=Layout.of(true.description, 5, 4))
    state, _ = env.reset(jax.random.key(1))
    assert float(state.max_abs_output[0]) == 0.0
    np.testing.assert_allclose(env.advance(state, jnp.zeros(1))[1], 0.0, atol=1e-12)


# -------------------------------------------------------------------------------- the search


@pytest.mark.science
def test_the_search_finds_a_resonance_inside_the_box_that_no_corner_shows():
    plant = Oscillator()
    box = Uncertainty.of(plant, 0.3, {"zeta": (0.05, 0.05)})
    found = search(OnPlant(box, sine(5.3), 300), SMALL, seed=0)
    stages = {stage.name: stage.nearness for stage in found.stages}
    grid = [
        largest(plant, plant.Params(w, 0.05), sine(5.3), 300) for w in np.linspace(3.5, 6.5, 201)
    ]
    assert stages["ascents"] > max(grid) - 1e-3
    assert stages["corners of the box"] < 0.9 * max(grid)
    w, _ = box.values(found.worst.point[0]).tolist()
    assert abs(w - np.linspace(3.5, 6.5, 201)[int(np.argmax(grid))]) < 0.03


@pytest.mark.science
def test_searched_noise_is_at_least_as_bad_as_that_of_a_seed_and_stays_within_its_bound():
    loop = PositionLoop(Square(), amplitude=0.5, gain=1.5)
    found = search(OnPlant(Uncertainty.of(Oscillator(), 0.1), loop, 100), SMALL, seed=1)
    *plain, noisy = (stage.nearness for stage in found.stages)
    assert noisy > max(plain)
    assert found.worst_noise is not None
    noise = np.asarray(found.worst_noise.noise)
    assert np.max(np.abs(noise)) <= 3.0
    assert len(noise[0]) == 101


def test_a_case_is_the_episode_of_its_plant_and_seed():
    box = Uncertainty.of(Oscillator(), 0.3)
    play = OnPlant(box, sine(4.0), 100)
    point = jnp.array([0.5, -0.5])
    plant, params = box.at(point)
    expected = largest(plant, params, sine(4.0), 100, seed=7)
    np.testing.assert_allclose(play(Cases(point, jnp.asarray(7))), expected, rtol=1e-12)
    noise = play.noise(Cases(point, jnp.asarray(7)))
    given = play(Cases(point, jnp.asarray(7), noise))
    np.testing.assert_allclose(given, expected, rtol=1e-12)


KICK, AFTER = 4, 40
"""Samples of an input at its limit, and of the free motion after it, which swings farther."""


def test_the_free_motion_after_the_end_counts_for_safety_alone():
    plant, keys = Aero2(), jax.random.split(jax.random.key(3), 2)
    kick = Replay(12 * jnp.ones((KICK, 1)))
    short = run_episodes(plant, kick, KICK, "factor:3", keys)
    long = run_episodes(plant, kick, KICK, "factor:3", keys, None, AFTER)
    np.testing.assert_array_equal(short.trajectory.inputs, long.trajectory.inputs)
    np.testing.assert_allclose(short.information, long.information, rtol=1e-12)
    inputs = jnp.concatenate([kick.inputs, jnp.zeros((AFTER, 1))])
    for i in range(2):
        params = plant.Params(*(float(column[i]) for column in short.params))
        whole = np.abs(response(plant, params, inputs)).max()
        assert whole > 1.5 * float(short.max_abs_output[i, 0])
        np.testing.assert_allclose(long.max_abs_output[i, 0], whole, rtol=1e-9)
    box = Uncertainty.of(plant, "factor:3")
    play = OnPlant(box, *Coast.after(kick, KICK, AFTER))
    _, params = box.at(-jnp.ones(3))
    expected = np.abs(response(plant, params, inputs)).max() / critical_levels(plant.definition)[0]
    np.testing.assert_allclose(play(Cases(-jnp.ones(3), jnp.asarray(0))), expected, rtol=1e-9)


@pytest.mark.slow
def test_a_search_goes_on_after_the_end_and_is_replayed():
    kick = 12 * jnp.ones((KICK, 1))
    short, long = (
        ex.falsify(Replay(kick), "aero2", steps=KICK, coast=coast, budget=100)
        for coast in (0, AFTER)
    )
    assert long.nearness > 1.5 * short.nearness
    assert long.certificate()["coast"] == AFTER
    assert f"{KICK} steps and {AFTER} after them" in repr(long)
    replay = ex.simulate(
        long.worst_plant, Replay(kick), steps=KICK, coast=AFTER, seed=long.worst_seed
    )
    np.testing.assert_allclose(replay.outputs, long.record.outputs, atol=1e-9)
    with pytest.raises(ValueError, match="leave coast out"):
        ex.falsify("aero2", rig=True, coast=5)


def test_a_search_gives_the_same_answer_again():
    play = OnPlant(Uncertainty.of(Oscillator(), 0.3), sine(5.3), 50)
    few = dataclasses.replace(SMALL, random=8, starts=4, steps=3, searched_noises=0)
    first, again = (search(play, few, seed=3) for _ in range(2))
    assert first.stages == again.stages
    assert first.worst_noise is None
    np.testing.assert_array_equal(first.worst.point, again.worst.point)


def test_a_plant_that_diverges_is_a_violation():
    box = Uncertainty.of(Oscillator(), 0.3, {"w": (500.0, 600.0)})
    assert float(OnPlant(box, sine(5.0), 100)(Cases(jnp.zeros(2), jnp.asarray(0)))) == np.inf


# ------------------------------------------------------------------------ verb and command


@pytest.fixture(scope="module")
def found():
    ranges = {"delay_voltage": (0, 0.1), "initial_state": "2%"}
    return ex.falsify("chirp", "aero2", steps=60, budget=200, uncertainty=ranges)


@pytest.mark.science
def test_the_worst_plant_is_replayed_from_its_file(found, tmp_path):
    path = tmp_path / "worst.json"
    found.save(path)
    record = ex.simulate(str(path), "chirp", steps=60, seed=found.worst_seed)
    np.testing.assert_array_equal(record.inputs, found.record.inputs)
    np.testing.assert_array_equal(record.outputs, found.record.outputs)
    plant = plant_named(str(path))
    values = {**plant.nominal._asdict(), **plant.constants._asdict()}
    assert all(values[n] == v for n, v in found.worst.items() if n in values)
    run = run_episode(
        plant, plant.nominal, ex.excitation.Chirp(), 60, jax.random.key(found.worst_seed)
    )
    size = np.max(np.abs(run.outputs)) / critical_levels(plant.definition)[0]
    np.testing.assert_allclose(size, found.nearness, rtol=1e-9)


def test_the_result_says_what_was_searched_and_proves_nothing(found):
    text = repr(found)
    assert "this is no proof" in text
    assert "delay_voltage 0 to 0.100" in text
    assert "random plants" in text
    assert "<table" in found._repr_html_()
    assert sum(s.experiments for s in found.stages) == found.certificate()["experiments"]


def small_policy(plant: AbstractPlant, steps: int = 20, **provenance) -> ex.Policy:
    """A policy with a small input."""
    layout = Layout.of(plant.description, 2, steps)
    width = len(layout.input_half)
    weights = [(np.full((width, layout.size), 0.05), np.full(width, 0.05))]
    return ex.Policy(plant.description, layout, tuple(weights), provenance)


@pytest.mark.slow
def test_a_certificate_travels_in_the_policy_and_leaves_its_hash():
    policy = small_policy(Aero2())
    found = ex.falsify(policy, budget=100)
    certified = found.certified()
    again = ex.Policy.from_bytes(certified.to_bytes())
    assert again.certificate == json.loads(json.dumps(found.certificate()))
    certificate = again.certificate or {}
    assert certificate["num_steps"] == 20
    assert certificate["plant"] == "aero2"
    assert again.hash == policy.hash
    assert again.certified(None).to_bytes() == policy.certified(None).to_bytes()


@pytest.mark.science
def test_a_part_of_the_policys_length_gives_no_certificate(tmp_path):
    short = ex.falsify(small_policy(Aero2()), budget=100, steps=10)
    with pytest.raises(ValueError, match="whole length of 20 steps: got 10"):
        short.certified()
    file = str(tmp_path / "x.safetensors")
    result = excite("falsify", "aero2", "--steps", "20", "--certify", file)
    assert result.returncode == 2
    assert "whole length of 500 steps" in result.stderr


@pytest.mark.science
def test_the_plants_of_the_training_are_the_default():
    decision = {"spread": 0.4, "constants": {"d_S": [0.0018, 0.0021], "of_another": [0, 1]}}
    made = {"spread": 0.1, "decision": decision, "uncertainty": {"initial_pitch": [-0.1, 0.1]}}
    policy = small_policy(Aero2(), **made)
    nominal = float(Aero2().nominal.J_p)
    ranges = ex.falsify(policy, budget=100).ranges
    np.testing.assert_allclose(ranges["J_p"], [0.6 * nominal, 1.4 * nominal])
    assert ranges["d_S"] == (0.0018, 0.0021)
    assert ranges["initial_pitch"] == (-0.1, 0.1)
    assert ranges.keys() == {*Aero2().nominal._fields, "d_S", "initial_pitch"}
    only = ex.falsify(policy, budget=100, spread=0.2, uncertainty={"m": "1%"}).ranges
    assert only.keys() == {*Aero2().nominal._fields, "m"}
    np.testing.assert_allclose(only["J_p"], [0.8 * nominal, 1.2 * nominal])


@pytest.mark.science
def test_a_policy_of_another_plant_is_warned_of():
    with pytest.warns(UserWarning, match="was trained on another 'aero2'"):
        ex.falsify(small_policy(Aero2()), Aero2(d_S=0.002), budget=100)


class Unstable(Oscillator):
    """An oscillator that is too fast for its integration step at the upper end of its box."""

    definition = dataclasses.replace(
        Oscillator.definition, name="unstable", parameters=(Parameter("w", "rad/s", 300.0),)
    )

    def derivative(self, state, input, params):
        y, v = state
        return jnp.stack([v, -(params.w**2) * y + params.w**2 * input[0]])


@pytest.fixture(scope="module")
def diverged():
    return ex.falsify("chirp", Unstable(), steps=300, budget=100)


@pytest.mark.science
def test_a_search_that_diverges_has_a_result(diverged, tmp_path):
    assert diverged.nearness == np.inf
    assert not diverged.is_safe
    assert "its simulation diverges" in repr(diverged)
    assert 2 <= len(diverged.record.time) < 301
    assert np.all(np.isfinite(diverged.record.outputs))
    certificate = json.loads(json_text(diverged.certificate()))
    assert certificate["nearness"] is None
    diverged.save(tmp_path / "worst.json")
    with pytest.raises(ValueError, match="diverged"):
        ex.simulate(str(tmp_path / "worst.json"), "chirp", steps=300)


@pytest.mark.science
def test_a_policy_that_diverges_is_certified_as_unsafe():
    policy = small_policy(Unstable(), steps=300)
    certified = ex.falsify(policy, Unstable(), budget=100).certified()
    again = ex.Policy.from_bytes(certified.to_bytes())
    assert "a simulation diverged" in again.claim


@pytest.mark.parametrize(
    ("value", "text"), [(0.97312, "0.973"), (1e130, "> 1000"), (None, "diverged")]
)
def test_a_largest_output_is_shown_in_few_digits(value, text):
    assert shown_nearness(value) == text


@pytest.mark.science
def test_the_worst_experiment_with_searched_noise_is_kept():
    loop = PositionLoop(Square(), amplitude=0.5, gain=1.5)
    found = ex.falsify(loop, Oscillator(), steps=60, budget=100)
    assert found.noise_nearness > found.nearness
    box = Uncertainty.of(Oscillator())
    ends = np.array(list(found.ranges.values()))
    values = np.array(list(found.noise_worst.values()))
    point = 2 * (values - ends[:, 0]) / (ends[:, 1] - ends[:, 0]) - 1
    plant, params = box.at(jnp.asarray(point))
    seed = jax.random.key(found.noise_record.metadata["provenance"]["seed"])
    run = run_episode(plant, params, loop, 60, seed, jnp.asarray(found.noise))
    np.testing.assert_allclose(run.measured, found.noise_record.outputs, rtol=1e-9, atol=1e-12)
    size = np.max(np.abs(run.outputs)) / 4.0
    np.testing.assert_allclose(size, found.noise_nearness, rtol=1e-9)
    assert f"{found.noise_nearness:.3f} of the level" in repr(found)


@pytest.mark.science
def test_a_policys_nearness_is_that_of_its_replay(tmp_path):
    policy = small_policy(Aero2(), steps=60)
    found = ex.falsify(policy, budget=100)
    plant = found.worst_plant
    key = jax.random.key(found.worst_seed)
    run = run_episode(plant, plant.nominal, ex.excitation.PolicyExcitation.of(policy), 60, key)
    assert float(nearness(plant, run.outputs)) == found.nearness


@pytest.mark.science
def test_a_record_is_played_at_its_own_sampling_time():
    record = ex.simulate(Oscillator().changed(dt=0.02), "chirp", steps=40)
    found = ex.falsify(record, Oscillator(), budget=100)
    np.testing.assert_allclose(found.record.dt, 0.02)


@pytest.mark.science
def test_a_plant_of_a_notebook_is_searched_and_cannot_be_saved(tmp_path):
    kind = type("Own", (Oscillator,), {"__module__": "a_notebook"})
    found = ex.falsify("chirp", kind(), steps=10, budget=100)
    with pytest.raises(ValueError, match="cannot import the plant class Own"):
        found.save(tmp_path / "worst.json")


def test_a_plants_file_keeps_all_its_numbers(tmp_path):
    given = plant_from("aero2+lag_voltage+bias_pitch")
    given = with_sensor(given, {"pitch": 0.01}, {"pitch": 0.002})
    given = with_nominal(given.changed(dt=0.02, d_S=0.002), {"lag_voltage": 0.07, "J_p": 0.03})
    given = given.changed(initial_state=jnp.array([0.1, 0.2, 3.0]))
    write_json(tmp_path / "w.json", plant_in_file(given))
    plant = plant_named(str(tmp_path / "w.json"))
    assert plant.description.to_dict() == given.description.to_dict()
    assert word_of(plant) == "aero2+lag_voltage+bias_pitch"
    more = extended(plant, ["delay_voltage"])
    shared = dict(zip(plant.nominal._fields, plant.nominal, strict=True))
    assert {n: float(getattr(more.nominal, n)) for n in shared} == {
        n: float(x) for n, x in shared.items()
    }
    np.testing.assert_array_equal(more.initial_state, [0.1, 0.2, 3.0])
    assert plant_named(f"{tmp_path}/w.json").dt == 0.02


@pytest.mark.parametrize("content", [{"format": "other"}, {"format": "excite plant 1"}, {}])
def test_a_damaged_file_of_a_plant_is_named_once(content, tmp_path):
    write_json(tmp_path / "bad.json", content)
    with pytest.raises(ValueError, match="is damaged") as caught:
        plant_named(str(tmp_path / "bad.json"))
    assert str(caught.value).count("bad.json") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["chirp"], "give the plant"),
        (["chirp", "--plant", "aero2", "--certify", "x.safetensors"], "only a policy"),
        (["aero2", "--certify", "x.json"], "policy files end in .safetensors"),
        (["aero2", "--out", "x.csv"], "files of plants end in .json"),
        (["aero2", "--uncertainty", "d_S=5"], "a percentage such as 10%"),
        (["aero2", "--uncertainty", "d_S"], "NAME=VALUE"),
        (["aero2", "--uncertainty", "noise=2"], "(2:2 is one value)"),
        (["aero2", "--uncertainty", "d_S=1:2,d_S=2:3"], "given twice"),
        (["aero3"], "did you mean 'aero2'"),
        (["aero2+lag_voltage"], "is a plant: give a policy or a signal for it"),
        (["plant.py:Tank"], "such as chirp --plant plant.py:Tank"),
        (["aero2", "--budget", "10"], "100<=x"),
        (["aero2", "--spread", "nan"], "spread"),
        (["chirp", "--plant", "missing.json"], "missing.json: cannot be read"),
    ],
)
def test_the_command_refuses_in_one_sentence(arguments, words, tmp_path):
    result = excite("falsify", *arguments, cwd=tmp_path)
    assert result.returncode == 2
    assert words in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_command_ends_with_1_where_a_level_is_reached(tmp_path):
    worst = tmp_path / "worst.json"
    loud = ["prbs", "--set", "amplitude=20", "--plant", "dc_motor", "--steps", "40"]
    arguments = [*loud, "--budget", "100", "--json"]
    result = excite("falsify", *arguments, "--out", str(worst))
    assert result.returncode == 1, result.stderr
    told = json.loads(result.stdout)
    assert told["nearness"] >= 1
    assert json.loads(worst.read_text())["plant"] == "dc_motor"


def test_a_figure_that_exists_is_kept(tmp_path):
    figure = tmp_path / "worst.png"
    figure.write_text("mine")
    result = excite("falsify", "aero2", "--plot", str(figure))
    assert result.returncode == 2
    assert "add --overwrite" in result.stderr
    assert figure.read_text() == "mine"


def test_a_record_beside_the_file_of_a_plant_keeps_it(tmp_path):
    write_json(tmp_path / "worst.json", plant_in_file(Aero2()))
    with pytest.raises(ValueError, match="is no sidecar of a record and would be lost"):
        ex.simulate("aero2", steps=5).save(tmp_path / "worst.csv")
    assert plant_named(str(tmp_path / "worst.json")).definition.name == "aero2"


def test_the_policies_of_files_are_listed(tmp_path):
    found = ex.falsify(small_policy(Aero2()), budget=100)
    file = tmp_path / "mine.safetensors"
    found.certified().save(file)
    result = excite("policies", str(file), "--json")
    (told,) = json.loads(result.stdout)["policies"]
    assert told["file"] == str(file)
    assert told["certificate"]["nearness"] == found.nearness
    assert not told["default"]
    assert (
        f"{max(found.nearness, found.noise_nearness):.3f}" in excite("policies", str(file)).stdout
    )


# -------------------------------------------------------------------------------- training


BRIEF = {"num_updates": 1, "num_plants": 2, "hidden": [4]}


@pytest.mark.science
def test_a_policy_that_is_kept_although_a_search_broke_it_is_warned_of(tmp_path):
    told = list[str]()
    with pytest.warns(UserWarning, match="of the critical level, and 0.975 is allowed"):
        policy = ex.train(
            "aero2", tmp_path / "run", steps=5, window=2, episodes=2, training=BRIEF,
            uncertainty={"initial_pitch": (0.6, 0.8)}, progress=lambda text, *_: told.append(text),
        )  # fmt: skip
    assert policy.certificate is not None
    assert policy.certificate["nearness"] > 1
    assert policy.certificate["num_steps"] == 5
    assert any("searching for violations" in text for text in told)
    assert not list(tmp_path.rglob("phase.json"))


def test_ppo_takes_no_uncertainty():
    with pytest.raises(ValueError, match="ppo does not train against an uncertainty"):
        ex.train("aero2", method="ppo", uncertainty={"d_S": "10%"})


def test_progress_of_ppo_counts_whole_rollouts():
    settings = AgentSettings(training={"total_steps": 100, "n_steps": 64})
    agent = Agent.of(settings, {}, {}, {})
    assert agent.total_steps(500) == 128
    assert agent.stage(128, 500) == "step 128 of 128"


def test_help_shows_no_range_where_there_is_none():
    assert "x<=None" not in excite("train", "--help").stdout


@pytest.fixture(scope="module")
def certified():
    return ex.falsify(small_policy(Aero2()), budget=100).certified()


@pytest.mark.science
@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        (None, {}, "has no certificate"),
        ({"nearness": 1.01}, {}, "is not safe"),
        ({"noise_nearness": None}, {}, "is not safe"),
        ({"violations": 1}, {}, "is not safe"),
        ({"num_steps": 19}, {}, "first 19 of 20 steps"),
        ({}, {"plant": "aero2_lag"}, "for another plant"),
        ({}, {"spread": 0.4}, "for another uncertainty: J_p"),
        ({"filter": True}, {}, "behind the safety filter: add --filter"),
    ],
)
def test_a_run_that_needs_a_certificate_refuses_any_other(certified, change, options, words):
    certificate = None if change is None else {**certified.certificate, **change}
    policy = certified.certified(certificate)
    arguments = {"plant": "aero2", "dry_run": True, "require_certificate": True, **options}
    with pytest.raises(ValueError, match=words):
        ex.run(policy=policy, **arguments)


@pytest.mark.science
def test_a_run_with_the_certificate_it_needs(certified):
    planned = ex.run(policy=certified, plant="aero2", dry_run=True, require_certificate=True)
    assert len(planned.inputs) == 20
    with pytest.raises(ValueError, match="only policies have certificates"):
        ex.run(excitation="chirp", plant="aero2", dry_run=True, require_certificate=True)


@pytest.mark.science
@pytest.mark.parametrize(
    "change",
    [
        {"nearness": "low"},
        {"uncertainty": {"J_p": [1]}},
        {"plant_hash": None},
        {"experiments": None},
        {"experiments": True},
        {"experiments": 0.5},
        {"num_steps": 10**400},
        {"nearness": 10**400},
        {"noise_bound": False},
    ],
)
def test_a_certificate_that_is_malformed_is_refused(certified, change):
    broken = certified.certified({**certified.certificate, **change})
    with pytest.raises(ValueError, match="its certificate is malformed"):
        ex.Policy.from_bytes(broken.to_bytes())
