"""The next experiment: a signal redesigned for what is known, and what it would bring."""

import dataclasses
import json
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from commands import excite
from scipy.stats import chi2

import excite as ex
from excite.description import HALF_95
from excite.excitation import Replay
from excite.information import experiment_information
from excite.plant import Aero2, DCMotor
from excite.rig.contract import Interval
from excite.safety import Supervision, Trip, Watch, check_reading, check_sample
from excite.simulation import response
from excite.study.knowledge import region_of
from excite.study.next_experiment import Candidate, NextExperiment, best_of
from excite.study.targets import targets_from
from excite.training.redesign import JUDGES, POINTS, SAFE, Region, first_signals, redesigned

STEPS, COAST = 40, 20
LEVEL = np.deg2rad(40)


def region(scale: float = 1.0) -> Region:
    """Of an `aero2` whose parameters are known to a few percent, with correlations."""
    root = np.array([[100.0, 0.0, 0.0], [60.0, 80.0, 0.0], [0.0, 10.0, 30.0]]) / scale
    return Region(jnp.asarray([0.025, 0.011, 0.0012]), jnp.asarray(root.T @ root))


def test_the_plants_of_a_region_lie_on_the_ellipsoid_that_holds_the_parameters():
    own = region()
    plants = np.log(np.array(own.plants(Aero2(), POINTS))).T  # positive ones by the logarithm
    assert len(plants) == POINTS + 1
    np.testing.assert_allclose(plants[0], np.log(own.center))
    changes = plants[1:] - plants[0]
    sizes = np.einsum("pi,ij,pj->p", changes, np.asarray(own.information), changes)
    np.testing.assert_allclose(sizes, chi2.ppf(0.999, 3))
    np.testing.assert_allclose(changes[0], -changes[3], atol=1e-12)  # to both sides of an axis


def test_a_region_of_draws_holds_as_many_as_it_says():
    own, rng = region(), np.random.default_rng(1)
    root = np.linalg.inv(np.linalg.cholesky(np.asarray(own.information))).T
    drawn = rng.normal(size=(20_000, 3)) @ root.T
    form = np.einsum("pi,ij,pj->p", drawn, np.asarray(own.information), drawn)
    assert np.mean(form < chi2.ppf(0.999, 3)) == pytest.approx(0.999, abs=0.001)


@pytest.fixture(scope="module")
def found():
    """A redesign of two rounds, and where it began."""
    plant = Aero2()
    starts, goals = first_signals(plant, 2, STEPS), jnp.asarray([0.001, jnp.inf, 0.005])
    return plant, starts, goals, redesigned(plant, region(), jnp.diag(1 / goals), starts, COAST)


def uncertainty(plant, inputs, goals):
    """Over the plants of the region, in units of the goals: independent of the redesign."""
    total = []
    for params in np.array(region().plants(plant, POINTS)).T:
        before = np.asarray(region().information)
        gained = [np.asarray(experiment_information(plant, plant.Params(*params), own))
                  for own in inputs]  # fmt: skip
        variance = np.diag(np.linalg.inv(before + sum(gained)))
        total.append(0.5 * np.log(np.sum(variance / np.asarray(goals) ** 2)))
    return math.exp(np.mean(total))


@pytest.mark.slow
def test_a_redesign_says_what_it_brings_and_brings_more_than_where_it_began(found):
    plant, starts, goals, made = found
    assert made.inputs.shape == (2, STEPS, 1)
    own = uncertainty(plant, made.inputs, goals)
    assert own == pytest.approx(float(np.min(made.shares)), rel=1e-6)
    assert own < 0.7 * min(uncertainty(plant, start, goals) for start in starts)


@pytest.mark.slow
def test_a_redesign_is_safe_on_every_plant_that_is_possible_after_its_end_too(found):
    plant, _, _, made = found
    largest = 0.0
    for params in np.array(region().plants(plant, 200)).T:
        for own in made.inputs:
            whole = jnp.concatenate([own, jnp.zeros((COAST, 1))])
            outputs = response(plant, plant.Params(*params), whole)
            largest = max(largest, float(jnp.max(jnp.abs(outputs))) / LEVEL)
    assert float(made.nearness) < SAFE
    assert largest < 1
    assert float(made.nearness) <= largest + 1e-9  # the plants of the line search are among them
    assert np.all(np.abs(made.inputs) <= plant.definition.inputs[0].upper)


@pytest.mark.slow
def test_no_supervisor_ends_a_redesigned_signal_on_a_plant_that_is_possible():
    """The current of `dc_motor` turns within a sample, which the supervisor does not know.

    It ended the round on 64 of these 67 plants, the nearest at 0.96 of its level.
    """
    plant, rest = DCMotor(), jnp.zeros((COAST, 1))
    known = Region(jnp.stack(list(plant.nominal)), 1e4 * jnp.eye(5))
    made = redesigned(plant, known, 100 * jnp.eye(5), first_signals(plant, 1, 30), COAST)
    assert 0.8 < float(made.nearness) < SAFE
    rules = Supervision.of(plant.description)
    for params in np.array(known.plants(plant, JUDGES)).T:
        inputs = jnp.concatenate([made.inputs[0], rest])
        outputs = np.asarray(response(plant, plant.Params(*params), inputs))
        watch = Watch.start(np, rules, outputs[0])
        for measured in outputs:
            watch = check_sample(np, rules, check_reading(np, rules, watch, measured, plant.dt))
        assert watch.trip == Trip.NONE


@pytest.mark.science
def test_what_a_candidate_brings_is_the_cramer_rao_bound_with_what_was_known():
    record = ex.simulate("aero2", "chirp", steps=60, seed=1)
    result = ex.identify(record)
    made = ex.next_experiment(result, target={"D_p": "1.5%"}, steps=STEPS, coast=COAST)
    (own,) = made.candidates
    known = region_of(Aero2(), result, "factor:3")
    params = Aero2().Params(*known.center)
    gained = experiment_information(Aero2(), params, jnp.asarray(own.inputs))
    sd = np.sqrt(np.diag(np.linalg.inv(np.asarray(known.information + gained))))
    for i, name in enumerate(params._fields):
        assert own.after[name].estimate == pytest.approx(result.params[name])
        assert own.after[name].ci95_half == pytest.approx(HALF_95 * sd[i] * float(params[i]))
    part = experiment_information(Aero2(), params, jnp.asarray(own.inputs[: int(own.samples)]))
    at_end = np.sqrt(np.linalg.inv(np.asarray(known.information + part))[2, 2])
    assert HALF_95 * at_end <= 0.015
    assert made.decision.endswith(f"every target is reached after {own.samples:.0f} samples")


@pytest.mark.slow
def test_a_parameter_that_was_not_estimated_is_known_by_the_spread_alone():
    record = ex.simulate("aero2", "chirp", steps=60, seed=1)
    held = ex.identify(record, hold={"D_p": 0.001})
    own = region_of(Aero2(), held, 0.3)
    assert float(own.information[2, 2]) == pytest.approx(3 / 0.3**2)
    np.testing.assert_array_equal(own.information[2, :2], 0)


def candidate(name: str, samples: float, half: float, nearness: float) -> Candidate:
    """One that brings this."""
    inputs = np.zeros((10, 1))
    return Candidate(
        name, Replay(jnp.zeros((10, 1))), inputs, np.zeros((10, 3)),
        {"D_p": Interval(0.001, half)}, samples, nearness,
    )  # fmt: skip


def test_the_safe_candidate_that_reaches_the_targets_first_is_chosen():
    targets = targets_from(Aero2(), {"D_p": "1%"})
    slow, quick = candidate("slow", 9, 1e-6, 0.9), candidate("quick", 5, 2e-6, 0.9)
    unsafe = candidate("unsafe", 1, 1e-7, 1.2)
    never, nearer = candidate("never", np.inf, 3e-4, 0.5), candidate("nearer", np.inf, 2e-4, 0.5)
    assert best_of([slow, quick, unsafe], targets) is quick
    assert best_of([never, nearer], targets) is nearer
    assert best_of([slow, dataclasses.replace(slow)], targets) is slow
    assert best_of([unsafe], targets) is None


@pytest.mark.slow
def test_the_command_writes_a_signal_that_can_be_played(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the names of files in the table's lines are short
    record, out = Path("a.csv"), Path("next.csv")
    ex.simulate("aero2", "chirp", steps=60, seed=1).save(record)
    asked = "--steps", STEPS, "--coast", COAST, "--target", "D_p=0.5%"
    done = excite("next", record, *asked, "--out", out, "--plot", tmp_path / "next.png")
    assert done.returncode == 0, done.stderr
    assert "after redesigned" in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert (tmp_path / "next.png").stat().st_size > 0
    played = ex.simulate("aero2", out, steps=STEPS)
    assert np.max(np.abs(played.outputs)) < LEVEL
    again = excite("next", record, *asked, "--json")
    told = json.loads(again.stdout)
    assert told["chosen"] == "redesigned"
    assert told["targets"] == {"D_p": "0.5 %"}
    refused = excite("next", record, *asked, "--out", out)
    assert refused.returncode == 2
    assert "exists" in refused.stderr


def test_the_inputs_of_a_policy_that_is_safe_only_because_it_reacts_are_not_written(tmp_path):
    targets = targets_from(Aero2(), {"D_p": "1%"})
    own = candidate("policy", 5, 1e-6, 0.9)
    usual = Aero2().nominal._asdict()
    known = {name: Interval(float(value), 0.1 * float(value)) for name, value in usual.items()}
    made = NextExperiment(Aero2(), known, targets, (own,), own, nearness=1.04)
    with pytest.raises(ValueError, match=r"does not react, reach 1\.04 of a critical level"):
        made.save(tmp_path / "next.csv")
    assert not (tmp_path / "next.csv").exists()
    dataclasses.replace(made, nearness=0.9).save(tmp_path / "next.csv")
    assert (tmp_path / "next.csv").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"target": {"D_q": "1%"}}, "unknown parameter 'D_q'"),
        ({"spread": 2.0}, "spread must lie in"),
        ({"spread": 0.001}, "the spread 0.001 excludes the estimate of "),
        ({"steps": 1}, "steps must be a whole number from 2"),
        ({"ahead": 0}, "ahead must be a whole number from 1 to 20: got 0"),
        ({"policy": "dc_motor"}, "the policy has 2 outputs; the plant has 1"),
        ({"prior": {"D_p": "normal:0.001:5%"}}, "a result has its prior"),
        ({"out": "next.txt"}, "next.txt"),
    ],
)
def test_what_is_not_allowed_is_one_sentence(options, words):
    true = {"J_p": 0.021, "K_pu": 0.0125, "D_p": 0.00104}
    result = ex.identify(ex.simulate("aero2", "chirp", params=true, steps=60, seed=1))
    with pytest.raises((ValueError, TypeError)) as error:
        ex.next_experiment(result, **{"target": {"D_p": "1%"}, **options})
    assert words in str(error.value)


@pytest.mark.slow
def test_records_that_contradict_what_was_known_are_refused(tmp_path):
    # A strong prior makes the residual large, so that its size hides the contradiction.
    ex.identify(ex.simulate("aero2", "chirp", params={"J_p": 0.03}, seed=1)).save(tmp_path / "run")
    record = ex.simulate("aero2", "chirp", seed=2)
    with pytest.raises(ValueError, match=r"the records contradict the earlier results in .*J_p"):
        ex.next_experiment([record, tmp_path / "run"])
    for prior in ({"J_p": "normal:0.03:1%"}, {"J_p": "normal:0.03:0.01%"}, tmp_path / "run"):
        with pytest.raises(ValueError, match=r"the records contradict the prior of .*J_p"):
            ex.next_experiment(record, prior=prior)


def test_the_usual_target_is_half_of_what_is_shown():
    record = ex.simulate("aero2", "chirp", steps=60, seed=1)
    made = ex.next_experiment(record, steps=10, coast=5)
    for target in made.targets:
        half = made.known[target.name].ci95_half
        assert float(target.allowed(made.known[target.name].estimate)) == pytest.approx(half / 2)


@pytest.mark.science
def test_run_folders_are_taken_as_results(tmp_path):
    record = ex.simulate("aero2", "chirp", steps=60, seed=1)
    result = ex.identify(record)
    result.save(tmp_path / "run")
    by_folder = region_of(Aero2(), tmp_path / "run", 0.3)
    by_result = region_of(Aero2(), result, 0.3)
    np.testing.assert_allclose(by_folder.information, by_result.information, rtol=1e-6)
    other = ex.simulate("aero2", "chirp", steps=60, seed=2)
    both = ex.next_experiment([tmp_path / "run", other], steps=30, coast=20).known
    alone = ex.next_experiment(other, steps=30, coast=20).known
    assert both["J_p"].ci95_half < 0.85 * alone["J_p"].ci95_half
    with pytest.raises(ValueError, match="has no estimate: give a run folder"):
        ex.next_experiment(tmp_path)


def test_a_free_parameter_keeps_within_its_bounds():
    plant = DCMotor()
    center = jnp.stack(list(plant.nominal))
    own = Region(center, jnp.eye(len(center)) / 0.2**2)
    for parameter, values in zip(plant.definition.parameters, own.plants(plant, 30), strict=True):
        lower, upper = parameter.support
        assert np.all((values >= lower) & (values <= upper))
