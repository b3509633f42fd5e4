"""Which of several experiments to make: exchange, results of several runs, costs and sensors."""

import itertools
import json
import math
import re

import jax.numpy as jnp
import numpy as np
import pytest
from commands import excite

import excite as ex
from excite.estimation.prior import Prior
from excite.information.exchange import exchanged
from excite.plant import Aero2
from excite.study.knowledge import known_from, region_of

QUIET = {"excitation": "chirp", "options": {"amplitude": 0.3}, "steps": 60}
SQUARE = {"excitation": "square", "options": {"amplitude": 0.3}, "steps": 60}
EXPERIMENTS = {
    "slow": {**QUIET, "options": {"amplitude": 0.3, "stop_frequency": 0.3}},
    "square": SQUARE,
    "exact": {**SQUARE, "noise": {"pitch": 2e-5}, "cost": 20.0},
    "loud": {"excitation": "square", "options": {"amplitude": 24.0}, "steps": 60},
}
TARGET = {"D_p": "1%", "J_p": "1%"}


# ---------------------------------------------------------------------------------- exchange


def best_of_all(loss, costs, most, rounds, budget):
    """The smallest loss of all allowed counts, one by one."""
    counts = itertools.product(*(range(m + 1) for m in most))
    allowed = [
        np.array(c) for c in counts
        if (rounds is None or sum(c) <= rounds) and (budget is None or np.dot(c, costs) <= budget)
    ]  # fmt: skip
    return min(map(loss, allowed))


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize(("rounds", "budget"), [(4, None), (None, 6.0), (3, 5.0)])
def test_exchange_comes_near_to_the_best_of_all_sets(seed, rounds, budget):
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(5, 2, 3)) * rng.lognormal(sigma=1.0, size=(5, 1, 1))
    gains, costs = np.einsum("eki,ekj->eij", roots, roots), rng.uniform(1, 3, 5)
    most = np.array([4, 4, 2, 1, 0])

    def loss(counts):
        total = 0.01 * np.eye(3) + np.einsum("e,eij->ij", counts, gains)
        return 0.5 * np.log(np.trace(np.linalg.inv(total)))

    counts = exchanged(loss, costs, most, rounds, budget)
    assert np.all((counts >= 0) & (counts <= most))
    assert rounds is None or counts.sum() <= rounds
    assert budget is None or counts @ costs <= budget
    assert loss(counts) <= best_of_all(loss, costs, most, rounds, budget) + 0.02


def test_nothing_is_chosen_where_nothing_is_allowed():
    found = exchanged(lambda n: -float(n.sum()), np.ones(2), np.zeros(2, int), 3)
    assert found.tolist() == [0, 0]


# --------------------------------------------------------------------------- several results


def test_independent_distributions_multiply():
    a = Prior.normal(["J_p", "D_p"], [0.0, 1.0], [[2.0, 0.3], [0.3, 1.0]], [True, True])
    b = Prior.normal(["D_p", "K_pu"], [0.5, 2.0], [[0.5, 0.1], [0.1, 1.0]], [True, True])
    made = Prior.product([a, b])
    assert made.names == ("J_p", "D_p", "K_pu")
    P, h = np.zeros((3, 3)), np.zeros(3)
    for prior, place in ((a, [0, 1]), (b, [1, 2])):
        own = np.asarray(prior.root).T @ np.asarray(prior.root)
        P[np.ix_(place, place)] += own
        h[place] += own @ np.asarray(prior.mean)
    np.testing.assert_allclose(np.asarray(made.root).T @ np.asarray(made.root), P, rtol=1e-9)
    np.testing.assert_allclose(made.mean, np.linalg.solve(P, h), rtol=1e-9)
    assert Prior.product([a]) is a
    linear = Prior.normal(["D_p"], [9.0], [[0.01]])
    with pytest.raises(ValueError, match="D_p has a normal and a lognormal distribution"):
        Prior.product([a, linear])
    far = Prior.normal(["D_p"], [9.0], [[0.01]], [True])
    with pytest.raises(ValueError, match="the results contradict each other"):
        Prior.product([a, far])


@pytest.fixture(scope="module")
def records():
    """Two records of one plant."""
    return [ex.simulate("aero2", seed=s, steps=80, options={"amplitude": 2.0}) for s in (1, 2)]


@pytest.mark.science
def test_results_of_several_runs_tell_as_much_as_their_records_together(records, tmp_path):
    results = [ex.identify(record) for record in records]
    results[1].save(tmp_path / "run")
    both = region_of(Aero2(), ex.identify(records), 0.3)
    for known in (results, [results[0], tmp_path / "run"], [results[0], records[1]]):
        found = known_from(known, None, None, 0.3).region
        error = np.sqrt(np.diag(np.linalg.inv(np.asarray(both.information))))
        np.testing.assert_array_less(np.abs(np.log(found.center / both.center)), 0.2 * error)
        own = np.sqrt(np.diag(np.linalg.inv(np.asarray(found.information))))
        np.testing.assert_allclose(own, error, rtol=0.2)


@pytest.mark.slow
def test_what_cannot_be_combined_is_one_sentence(records, tmp_path):
    result = ex.identify(records[0])
    other = ex.simulate("aero2", params={"D_p": 0.002}, seed=3, options={"amplitude": 2.0})
    lag = ex.identify(ex.simulate("aero2_lag", seed=1, options={"amplitude": 2.0}))
    for known, words in [
        ([result, other], "the records contradict the earlier results in D_p"),
        ([records[0], records[0]], "is given twice: give each record and each result once"),
        ([records[0], lag], "a result is of plant 'aero2_lag', and not of 'aero2'"),
    ]:
        with pytest.raises(ValueError, match=re.escape(words)):
            known_from(known, None, None, "factor:3")


@pytest.mark.slow
def test_a_plant_that_does_not_explain_the_records_is_told_and_the_given_one_stays():
    record = ex.simulate("aero2_lag", seed=1, options={"amplitude": 2.0})
    found = known_from(record, "aero2", None, "factor:3")
    assert found.plant.definition.name == "aero2"
    assert "times the declared noise: the plant may be wrong" in found.warnings[0]
    heavier = Aero2().changed(m=1.2)
    result = ex.identify(ex.simulate(heavier, seed=1), heavier)
    assert known_from(result, None, None, 0.3).plant.constants.m == 1.2
    assert known_from(result, Aero2(), None, 0.3).plant.constants.m == Aero2().constants.m


# --------------------------------------------------------------------------------- selection


@pytest.fixture(scope="module")
def chosen(records):
    """Three of the experiments."""
    return ex.choose_experiments("aero2", EXPERIMENTS, TARGET, known=records[0], rounds=3, coast=50)


def test_what_a_set_brings_is_the_sum_of_its_information(chosen, records):
    result = ex.identify(records[0])
    total = np.asarray(region_of(Aero2(), result, "factor:3").information)
    for i, name in enumerate(chosen.order):
        experiment = {**EXPERIMENTS[name]}
        experiment.pop("cost", None)
        own = ex.information("aero2", params=result.params, **experiment)
        total = total + own.information
        sd = np.sqrt(np.diag(np.linalg.inv(total))) * list(result.params.values())
        halves = [interval.ci95_half for interval in chosen.then[i].values()]
        np.testing.assert_allclose(halves, 1.959964 * sd, rtol=1e-3)
    assert sum(option.count for option in chosen.options) == len(chosen.order) == 3


def test_an_experiment_that_is_not_safe_is_never_chosen(chosen):
    by_name = {option.name: option for option in chosen.options}
    assert by_name["loud"].nearness > 1
    assert by_name["loud"].count == 0
    assert "not safe" in repr(chosen)
    assert {row[-1] for row in chosen.option_rows()} >= {"not safe", "3"}
    assert chosen.order == ("exact",) * 3
    assert chosen.cost == 60
    assert chosen.plot().axes


def test_costs_and_numbers_are_kept(records):
    given = {**EXPERIMENTS, "exact": {**EXPERIMENTS["exact"], "most": 1}}
    found = ex.choose_experiments("aero2", given, TARGET, known=records[0], budget=33, coast=50)
    counts = {option.name: option.count for option in found.options}
    assert counts["exact"] == 1
    assert found.cost <= 33
    assert sum(counts.values()) == 3  # one of 20 s, two of 6 s
    poor = ex.choose_experiments("aero2", given, TARGET, known=records[0], budget=1, coast=50)
    assert poor.decision == "no experiment is chosen: each costs too much, or tells nothing"
    assert poor.after == poor.known
    loud = {"loud": given["loud"]}
    none = ex.choose_experiments("aero2", loud, TARGET, known=records[0], coast=50)
    assert none.decision == "no experiment is safe"


def test_what_is_known_before_the_first_record_may_be_a_prior():
    prior = {"D_p": "lognormal:0.00104:1%"}
    found = ex.choose_experiments("aero2", EXPERIMENTS, TARGET, prior=prior, spread=0.1, coast=50)
    assert found.known["D_p"].ci95_half == pytest.approx(1.96 * 0.01 * 0.00104, rel=0.03)
    wide = ex.choose_experiments("aero2", EXPERIMENTS, TARGET, spread=0.1, coast=50)
    assert wide.known["D_p"].ci95_half > 4 * found.known["D_p"].ci95_half
    easy = ex.choose_experiments(
        "aero2", EXPERIMENTS, {"D_p": "5%"}, prior=prior, spread=0.1, coast=50
    )
    assert easy.decision == "every target is reached"


def test_an_output_that_is_not_measured_tells_nothing():
    experiment = {"excitation": "chirp", "options": {"amplitude": 0.2}, "steps": 40}
    given = {n: {**experiment, "outputs": o} for n, o in (("both", None), ("one", ["current"]))}
    found = ex.choose_experiments("dc_motor", given, {"R": "1%"}, spread=0.05, coast=10)
    alone = {option.name: option.after for option in found.options}
    assert found.order == ("both",)
    noise = {"noise": {"speed": 1e6}}  # as good as not measured
    given = {"one": {**experiment, **noise}}
    other = ex.choose_experiments("dc_motor", given, {"R": "1%"}, spread=0.05, coast=10)
    for name, interval in other.options[0].after.items():
        assert alone["one"][name].ci95_half == pytest.approx(interval.ci95_half, rel=1e-6)
        assert alone["both"][name].ci95_half < interval.ci95_half


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "no experiment is given"),
        ({"a": {"excitation": "chrp"}}, "experiment 'a': unknown excitation 'chrp'"),
        ({"a": {"step": 3}}, "experiments: a: unknown key 'step'; did you mean 'steps'"),
        ({"a": {"constants": {"M": 1.0}}}, "experiment 'a': unknown aero2 constant 'M'"),
        ({"a": {"outputs": ["yaw"]}}, "experiment 'a': unknown aero2 output 'yaw'"),
        ({"a": {"outputs": []}}, "experiment 'a': it measures no output"),
        ({"a": {"constants": {"m": -1.0}}}, "constant m must be finite, with the sign of 1.07"),
        ({"a": {"constants": {"m": math.inf}}}, "constant m must be finite"),
        ({"a": {"steps": 2_000_000}}, "experiment 'a': steps must be a whole number from 2"),
        ({"a": {"cost": "4"}}, "a: cost must be a number, got"),
        ({"a": {"cost": 0.0}}, "experiment 'a': cost must be a number above 0: got 0.0"),
        ({"a": {"most": -1}}, "experiment 'a': most must be a whole number from 0 to 1000"),
        ({"a": {"noise": {"pitch": 0.0}}}, "experiment 'a': a sensor without noise"),
    ],
)
def test_experiments_that_are_not_allowed_are_one_sentence(given, words):
    with pytest.raises((ValueError, TypeError), match=re.escape(words)):
        ex.choose_experiments("aero2", given, TARGET)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rounds": 0}, "rounds must be a whole number from 1 to 1000: got 0"),
        ({"budget": 0}, "budget must be a number above 0: got 0"),
        ({"coast": -1}, "coast must be a whole number"),
        ({"known": []}, "no record is given"),
        ({"spread": 2.0}, "such as factor:3: got 2.0"),
    ],
)
def test_an_option_that_is_not_allowed_is_one_sentence(options, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        ex.choose_experiments("aero2", EXPERIMENTS, TARGET, **options)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[experiment.a]", "unknown key 'experiment'; did you mean 'experiments'"),
        ("experiments = 3", "experiments must be tables, such as [experiments.first]"),
        ("[experiments", "not valid TOML"),
        ("[experiments.a]\nsteps = 'x'", "a: steps must be a whole number, got"),
    ],
)
def test_a_file_that_is_not_allowed_is_one_sentence(content, words, tmp_path):
    (tmp_path / "given.toml").write_text(content)
    run = excite("choose", "aero2", tmp_path / "given.toml", "--target", "D_p=1%")
    assert run.returncode == 2
    assert words in run.stderr
    assert len(run.stderr.strip().splitlines()) == 1


def test_the_command_reads_a_file_and_signals_beside_it(tmp_path, records):
    time = np.arange(61) * 0.1
    rows = [f"{t:.1f},{0.5 * np.sin(t):.6f}" for t in time]
    (tmp_path / "signal.csv").write_text("\n".join(["time,voltage", *rows]) + "\n")
    (tmp_path / "given.toml").write_text(
        "[experiments.own]\nexcitation = 'signal.csv'\n[experiments.slow]\nsteps = 40\n"
        "options = {amplitude = 0.3}\n"
    )
    asked = [tmp_path / "given.toml", "--target", "D_p=1%", "--spread", "0.3", "--rounds", "2"]
    run = excite("choose", "aero2", *asked, "--plot", tmp_path / "c.png", "--json")
    assert run.returncode == 0, run.stderr
    told = json.loads(run.stdout)
    assert [e["name"] for e in told["experiments"]] == ["own", "slow"]
    assert sum(e["count"] for e in told["experiments"]) == len(told["order"]) == 2
    assert told["after"]["D_p"]["ci95_half"] < told["known"]["D_p"]["ci95_half"]
    assert (tmp_path / "c.png").stat().st_size > 1000
    assert jnp.isfinite(told["cost"])
