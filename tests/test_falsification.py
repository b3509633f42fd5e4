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
from excite.environment.falsification import Cases, Effort, OnPlant, search
from excite.excitation import PositionLoop, Replay, Square
from excite.plant import AbstractPlant, Aero2
from excite.plant.catalogue import plant_named
from excite.plant.uncertainty import Uncertainty
from excite.safety import critical_levels
from excite.simulation import run_episode

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
    few = np.asarray(box.corners(jax.random.key(0), 5))
    assert few.shape == (5, 3)
    assert set(few.ravel().tolist()) <= {-1.0, 1.0}


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


# -------------------------------------------------------------------------------- the search


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


def test_a_certificate_travels_in_the_policy_and_leaves_its_hash():
    policy = ex.read_policy("dc_motor")
    found = ex.falsify(policy, budget=100, steps=20)
    certified = found.certified()
    again = ex.Policy.from_bytes(certified.to_bytes())
    assert again.certificate == json.loads(json.dumps(found.certificate()))
    assert again.hash == policy.hash
    assert again.certified(None).to_bytes() == policy.certified(None).to_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["chirp"], "give the plant"),
        (["chirp", "--plant", "aero2", "--certify", "x.safetensors"], "only a policy"),
        (["aero2", "--certify", "x.json"], "policy files end in .safetensors"),
        (["aero2", "--out", "x.csv"], "files of plants end in .json"),
        (["aero2", "--uncertainty", "d_S=5"], "a percentage such as 10%"),
        (["aero2", "--uncertainty", "d_S"], "NAME=VALUE"),
        (["aero2", "--uncertainty", "d_S=1:2,d_S=2:3"], "given twice"),
        (["aero3"], "did you mean 'aero2'"),
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


def test_the_command_ends_with_1_where_a_level_is_reached(tmp_path):
    worst = tmp_path / "worst.json"
    loud = ["prbs", "--set", "amplitude=20", "--plant", "dc_motor", "--steps", "40"]
    arguments = [*loud, "--budget", "100", "--json"]
    result = excite("falsify", *arguments, "--out", str(worst))
    assert result.returncode == 1, result.stderr
    told = json.loads(result.stdout)
    assert told["nearness"] >= 1
    assert json.loads(worst.read_text())["plant"] == "dc_motor"


@pytest.fixture(scope="module")
def certified():
    return ex.falsify("aero2-goals", budget=100, steps=20).certified()


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        (None, {}, "has no certificate"),
        ({"nearness": 1.01}, {}, "is not safe"),
        ({"noise_nearness": None}, {}, "is not safe"),
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


def test_a_run_with_the_certificate_it_needs(certified):
    planned = ex.run(policy=certified, plant="aero2", dry_run=True, require_certificate=True)
    assert len(planned.inputs) == 500
    with pytest.raises(ValueError, match="only policies have certificates"):
        ex.run(excitation="chirp", plant="aero2", dry_run=True, require_certificate=True)


@pytest.mark.parametrize(
    "change",
    [
        {"nearness": "low"},
        {"uncertainty": {"J_p": [1]}},
        {"plant_hash": None},
        {"experiments": None},
    ],
)
def test_a_certificate_that_is_malformed_is_refused(certified, change):
    broken = certified.certified({**certified.certificate, **change})
    with pytest.raises(ValueError, match="its certificate is malformed"):
        ex.Policy.from_bytes(broken.to_bytes())
