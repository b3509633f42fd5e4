"""Campaigns: rounds that end when enough is known, resumed and judged alike."""

import dataclasses
import json
import math
import re
import signal
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import excite

import excite as ex
from excite.description import HALF_95
from excite.estimation import NLS
from excite.excitation import Replay
from excite.files import locked_folder, read_columns
from excite.information import experiment_information
from excite.plant import Aero2, draw_params
from excite.plant.catalogue import plant_named
from excite.policy import Layout
from excite.rig.contract import Interval, Sample
from excite.simulation import response, run_episode
from excite.study.campaign import REACHED, usual_policy
from excite.study.campaign_on_rig import _Folder, _paused
from excite.study.monitor import Monitor
from excite.study.quantities import known_of, propagated
from excite.study.targets import farthest, others_of, targets_from
from excite.training.design import Design

TRUE = {"J_p": 0.025, "K_pu": 0.0110, "D_p": 0.0011}
EASY = {"J_p": "5%", "K_pu": "10%"}


def steady(steps: int = 60, size: float = 0.05) -> ex.Policy:
    """A policy that reacts to what it sees, and stays far below the level."""
    layout = Layout.of(Aero2().description, 4, steps)
    rng = np.random.default_rng(0)
    weights = [
        (rng.normal(size=(8, layout.size)), rng.normal(size=8)),
        (size * rng.normal(size=(1, 8)), np.zeros(1)),
    ]
    return ex.Policy(Aero2().description, layout, tuple(weights), {"spread": "factor:3"})


# ---------------------------------------------------------------------------------- targets


@pytest.mark.parametrize(
    ("given", "half", "is_relative"),
    [("1%", 0.01, True), (" 0.5 %", 0.005, True), ("1e-4", 1e-4, False), (2e-4, 2e-4, False)],
)
def test_a_target_is_a_share_of_the_estimate_or_a_number(given, half, is_relative):
    (target,) = targets_from(Aero2(), {"D_p": given})
    assert (target.half, target.is_relative) == (pytest.approx(half), is_relative)
    allowed = half * 0.002 if is_relative else half
    assert target.share(-0.002, allowed) == pytest.approx(1)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "a target is needed, such as D_p=1%"),
        ({"D_q": "1%"}, "unknown parameter 'D_q'; did you mean 'D_p'"),
        ({"D_p": "0%"}, "target of D_p must be a number above 0, or a percentage such as 1%"),
        ({"D_p": "-1%"}, "target of D_p must be a number above 0"),
        ({"D_p": "much"}, "got 'much'"),
        ({"D_p": math.nan}, "got nan"),
        ({"D_p": math.inf}, "got inf"),
    ],
)
def test_a_target_that_is_not_allowed_is_one_sentence(given, words):
    with pytest.raises((ValueError, TypeError)) as error:
        targets_from(Aero2(), given)
    assert words in str(error.value)


def frequency(params):
    """Undamped, of the pitch; M_b, g and l_cm at their known values."""
    return jnp.sqrt(1.15 * 9.81 * 0.0038 / params.J_p)


def vector(params):
    """No number."""
    return jnp.stack([params.J_p, params.D_p])


def missing(params):
    """Of a parameter that the plant does not have."""
    return 1.0 / params.c


def leaving(params):
    """Ends the process."""
    raise SystemExit(3)


def constant(params):
    """Does not depend on the parameters."""
    return 3.0


def infinite(params):
    """No finite number."""
    return params.J_p / 0.0


def D_p(params):  # noqa: N802
    """A function with the name of a parameter."""
    return 3 * params.J_p


def damping_ratio(params):
    """Of both parameters."""
    return params.D_p / jnp.sqrt(params.J_p)


@pytest.mark.parametrize(
    ("given", "value", "name", "half"),
    [
        ("pitch@2:square", "0.1 deg", "pitch@2:square", math.radians(0.1)),
        ("pitch@2s:square", "2e-3rad", "pitch@2s:square", 2e-3),
        (frequency, "0.5%", "frequency", 0.005),
        (f"{__file__}:frequency", 0.01, "frequency", 0.01),
    ],
)
def test_a_target_may_be_a_function_or_a_prediction(given, value, name, half):
    (target,) = targets_from(Aero2(), {given: value})
    assert (target.name, target.half) == (name, pytest.approx(half))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"yaw@2:square": 1.0}, "unknown output 'yaw'"),
        (
            {"pitch@0:square": 1.0},
            "a number of seconds from 0.1 to 100000: got '0'",
        ),
        ({"pitch@soon:square": 1.0}, "to 100000: got 'soon'"),
        ({"pitch@2:aero2": 1.0}, "a prediction needs a signal that does not react: got 'aero2'"),
        ({"pitch@2:none.csv": 1.0}, "none.csv"),
        ({"pitch@2:square": "1 V"}, "cannot be in 'V': the unit is 'rad'"),
        ({"pitch@2": 1.0}, "'pitch@2' is no quantity: a prediction is OUTPUT@SECONDS:SIGNAL"),
        ({"own.py": 1.0}, "a function path/to/file.py:function"),
        ({"pitch@2:sqare": 1.0}, "pitch@2:sqare: unknown excitation 'sqare'"),
        ({vector: 1.0}, "ValueError: got an array of shape (2,)"),
        ({missing: 1.0}, "one number with jax.numpy from the parameters: AttributeError"),
        ({leaving: 1.0}, "one number with jax.numpy from the parameters: SystemExit"),
        ({constant: 1.0}, "has no slope at the nominal parameters"),
        ({infinite: 1.0}, "no finite number"),
        ({lambda params: params.J_p: 1.0}, "a function needs a name of its own: got '<lambda>'"),
        ({D_p: 1.0}, "a function needs a name of its own: got 'D_p'"),
        ({"nothing.py:frequency": 1.0}, "nothing.py: no such file"),
        ({f"{__file__}:frequenz": 1.0}, "has no function 'frequenz'; it has"),
        ({frequency: 1.0, f"{__file__}:frequency": 1.0}, "frequency has two targets"),
    ],
)
def test_a_quantity_that_is_not_allowed_is_one_sentence(given, words):
    with pytest.raises(ValueError, match=re.escape(words)) as error:
        targets_from(Aero2(), given)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_the_interval_of_a_quantity_is_that_of_many_draws():
    record = ex.simulate("aero2", "chirp", params=TRUE, seed=1)
    result, plant = ex.identify(record, "aero2"), Aero2()
    given = {damping_ratio: "1%", "pitch@3:square": 0.01, "D_p": "1%"}
    targets = targets_from(plant, given)
    known = known_of(plant, result, others_of(plant, targets))
    assert list(known) == ["J_p", "K_pu", "D_p", "damping_ratio", "pitch@3:square"]
    rng, center = np.random.default_rng(0), np.array(list(result.params.values()))
    drawn = rng.multivariate_normal(center, result.covariance, 4000)
    spread = [np.ptp(result.ci95(n)) / 2 / (HALF_95 * s) for n, s in
              zip(result.params, np.sqrt(np.diag(result.covariance)), strict=True)]  # fmt: skip
    for target in targets[:2]:
        values = jax.vmap(lambda p, t=target: t.quantity(plant, plant.Params(*p)))(drawn)
        expected = HALF_95 * np.std(np.asarray(values)) * spread[0]
        assert known[target.name].ci95_half == pytest.approx(expected, rel=0.05)
    size = dict(zip(result.params, center, strict=True))
    ratio = size["D_p"] / math.sqrt(size["J_p"])
    assert known["damping_ratio"].estimate == pytest.approx(ratio)


def test_a_quantity_of_a_parameter_that_is_not_known_is_not_known():
    covariance, halves = np.diag([1e-6, 1e-8, 0.0]), np.array([2e-3, 2e-4, np.inf])
    quantities = [t.quantity for t in targets_from(Aero2(), {damping_ratio: 1.0, frequency: 1.0})]
    found = propagated(quantities, Aero2(), Aero2().nominal, covariance, halves)
    assert found["damping_ratio"].ci95_half == math.inf
    assert 0 < found["frequency"].ci95_half < 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rounds": 0}, "rounds must be a whole number from 1 to 1000: got 0"),
        ({"coast": -1}, "coast must be a whole number"),
        ({"spread": 1.0}, "such as factor:3: got 1.0"),
        ({"policy": "aero3"}, "aero3"),
        ({"policy": "dc_motor"}, "the policy has 2 outputs; the plant has 1"),
        ({"plant": "aero3"}, "unknown plant 'aero3'"),
        ({"steps": 50}, "steps are for rounds without a policy: a policy has its own"),
        ({"policy": "none", "steps": 3}, "steps must be a whole number from 4 to 10000000: got 3"),
        (
            {"policy": steady(), "samples": 59},
            "a budget of 59 samples is shorter than a round of 60",
        ),
        ({"samples": 0}, "samples must be a whole number from 1 to 10000000: got 0"),
    ],
)
def test_a_campaign_that_cannot_be_played_is_one_sentence(options, words):
    given = {"plant": "aero2", "target": EASY, **options}
    with pytest.raises(ValueError, match=words.replace("(", r"\(")):
        ex.Campaign(**given)


def test_a_plant_without_a_shipped_policy_begins_with_a_robust_signal():
    campaign = ex.Campaign("aero2+offset_voltage", {"J_p": "1%"})
    assert (campaign.policy, campaign.steps, campaign.warnings) == (None, 50, ())
    assert campaign.to_dict()["policy_hash"] == ""


@pytest.fixture
def designed() -> ex.Campaign:
    """A campaign without a policy; its robust signal takes a minute, and is another one here."""
    campaign = ex.Campaign("aero2", {"D_p": "2%"}, policy="none", steps=60, coast=20, rounds=4)
    campaign.opening = Replay(jnp.asarray(3.0 * np.sign(np.sin(np.arange(30) + 0.5)))[:, None])
    return campaign


@pytest.mark.science  # compiles the redesign, 15 s
def test_without_a_policy_signals_are_redesigned_after_the_first(designed):
    expected = designed.expected
    for seed in range(4):
        if (asked := designed.ask()) is None:
            break
        told = designed.tell(ex.simulate("aero2", asked, params=TRUE, seed=seed))
        assert told.nearness < 1
    assert designed.reason == REACHED
    assert [(r.played, r.num_samples) for r in designed.rounds[:2]] == [
        ("robust", 30),
        ("redesigned", 60),
    ]
    assert abs(designed.known["D_p"].estimate - TRUE["D_p"]) < 0.02 * TRUE["D_p"]
    # What is predicted on plants around the nominal one, of which this is one.
    samples, halves = designed.knowledge()
    is_reached = halves[:, 2] <= 0.02 * designed.known["D_p"].estimate
    first = samples[is_reached.argmax()]
    assert expected.samples.min() / 1.5 < first < 1.5 * expected.samples.max()


@pytest.mark.slow
def test_a_first_signal_is_played_again_although_it_is_shorter_than_a_round(designed):
    designed.redesign = False
    designed.tell(ex.simulate("aero2", designed.ask(), params=TRUE, seed=0))
    assert designed.ask() is designed.opening


@pytest.mark.slow
def test_a_robust_signal_that_is_played_again_is_called_so(designed):
    record = ex.simulate("aero2", designed.ask(), params=TRUE, seed=0)
    designed.tell(record)
    assert designed.rounds[0].played == "robust"
    assert designed.tell(record, played="redesigned").played == "redesigned"


# ------------------------------------------------------------------------------ ask and tell


@pytest.fixture(scope="module")
def asked() -> ex.Campaign:
    """A campaign of two rounds, with what `identify` makes of both."""
    target = {"D_p": "0.001%", damping_ratio: "0.001%"}
    campaign = ex.Campaign("aero2", target, policy=steady(), rounds=2, redesign=False)
    for seed in (1, 2):
        policy = campaign.ask()
        campaign.tell(ex.simulate("aero2", policy, params=TRUE, seed=seed))
    return campaign


def test_all_rounds_are_identified_together(asked):
    records = [ex.simulate("aero2", steady(), params=TRUE, seed=seed) for seed in (1, 2)]
    result = ex.identify(records, "aero2", initial_state="known")
    known = dict(asked.rounds[-1].known)
    assert known.pop("damping_ratio") == asked.known["damping_ratio"]
    for name, (estimate, half) in known.items():
        low, high = result.ci95(name)
        assert estimate == pytest.approx(result.params[name], rel=1e-6)
        assert half == pytest.approx((high - low) / 2, rel=1e-4)
        assert low < TRUE[name] < high
    assert asked.num_samples == 120
    assert asked.ask() is None
    assert asked.reason == "all rounds are played"
    assert asked.rounds[0].decision.startswith("go on: damping_ratio is")
    with pytest.raises(ValueError, match="the campaign has ended: all rounds are played"):
        asked.tell(records[0])


def test_knowledge_after_every_sample_is_the_cramer_rao_bound(asked):
    samples, halves = asked.knowledge()
    assert samples[-1] == len(halves) == 120
    params = Aero2().Params(*asked.result.params.values())
    inputs = [jnp.asarray(record.inputs[:-1]) for record in asked.records]
    for count in (30, 60):
        information = experiment_information(Aero2(), params, inputs[0][:count])
        expected = HALF_95 * np.sqrt(np.diag(np.linalg.inv(information))) * np.array(params)
        np.testing.assert_allclose(halves[count - 1, :3], expected, rtol=1e-6)
    both = sum(experiment_information(Aero2(), params, u) for u in inputs)
    expected = HALF_95 * np.sqrt(np.diag(np.linalg.inv(both))) * np.array(params)
    np.testing.assert_allclose(halves[-1, :3], expected, rtol=1e-6)
    slope = np.array([-0.5, 0.0, 1.0])  # of the logarithm of D_p / sqrt(J_p)
    relative = HALF_95 * np.sqrt(slope @ np.linalg.inv(both) @ slope)
    assert halves[-1, 3] == pytest.approx(relative * float(damping_ratio(params)), rel=1e-6)


def test_the_table_says_what_was_asked_and_reached(asked):
    text = repr(asked)
    assert "aero2: all rounds are played (120 samples in 2 rounds)" in text
    assert max(map(len, text.splitlines())) <= 80
    (row,) = (row for row in asked.rows() if row[0] == "D_p")
    assert row[-2:] == ["0.001 %", "missed"]
    assert "<table" in asked._repr_html_()
    assert json.loads(json.dumps(asked.to_dict()))["num_samples"] == 120
    assert asked.plot().axes


def test_a_campaign_ends_where_a_level_is_reached():
    campaign = ex.Campaign("aero2", EASY, policy=steady())
    record = ex.simulate("aero2", steady(), params=TRUE, seed=1)
    beyond = dataclasses.replace(record, outputs=record.outputs + 1.0)
    campaign.tell(beyond)
    assert campaign.reason == "unsafe: a critical level was reached"
    tripped = ex.Campaign("aero2", EASY, policy=steady())
    tripped.tell(record, "warning level exceeded", unsafe=True)
    assert tripped.reason == "unsafe: warning level exceeded"


@pytest.mark.slow
def test_a_record_that_tells_nothing_is_a_round_without_an_estimate():
    campaign = ex.Campaign("aero2", EASY, policy=steady())
    record = ex.simulate("aero2", ex.read_policy("aero2"), params=TRUE, seed=1)
    short = dataclasses.replace(
        record, time=record.time[:3], inputs=record.inputs[:3], outputs=record.outputs[:3]
    )
    told = campaign.tell(short)
    assert told.known == {}
    assert told.decision.startswith("go on: there is no estimate yet (")
    assert campaign.ask() is not None
    with pytest.raises(ValueError, match="needs at least two samples: got one"):
        campaign.tell(
            dataclasses.replace(
                record, time=record.time[:1], inputs=record.inputs[:1], outputs=record.outputs[:1]
            )
        )
    assert campaign.tell(record).known  # the short one before spoils nothing


def test_a_round_that_was_interrupted_does_not_count_in_the_budget():
    campaign = ex.Campaign("aero2", {"D_p": "0.001%"}, policy=steady(), rounds=1, redesign=False)
    record = ex.simulate("aero2", steady(), params=TRUE, seed=1)
    campaign.tell(record, "interrupted by SIGINT")
    assert campaign.ask() is not None
    campaign.tell(record)
    assert campaign.reason == "all rounds are played"


def test_no_round_begins_that_could_pass_the_budget_of_samples():
    campaign = ex.Campaign("aero2", {"D_p": "0.001%"}, policy=steady(), samples=130, redesign=False)
    record = ex.simulate("aero2", steady(), params=TRUE, seed=1)
    assert campaign.tell(record).decision.startswith("go on")
    campaign.tell(record)
    assert campaign.reason == "the budget of 130 samples is used up"
    assert campaign.ask() is None
    assert campaign.to_dict()["most_samples"] == 130


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"metadata": {"starts_at_initial_state": False}}, "and this record says that it does not"),
        ({"time": 0.2 * np.arange(61)}, "a round is sampled every 0.1 s: got one of 0.2 s"),
    ],
)
def test_a_record_that_is_no_round_is_refused_and_spoils_nothing(changed, words):
    campaign = ex.Campaign("aero2", EASY, policy=steady())
    record = ex.simulate("aero2", steady(), params=TRUE, seed=1)
    with pytest.raises(ValueError, match=words):
        campaign.tell(dataclasses.replace(record, **changed))
    assert not campaign.records
    assert campaign.tell(record).known


@pytest.mark.slow
def test_a_round_that_tells_nothing_does_not_make_later_ones_longer():
    campaign = ex.Campaign("aero2", {"D_p": "1%"}, policy=steady(), redesign=False)
    still = ex.simulate("aero2", np.zeros((20, 1)), params=TRUE, seed=1)
    campaign.tell(still, REACHED)
    assert campaign.monitor(waits=True)._enough(100) == 1


def test_a_first_signal_that_is_not_safe_is_refused(monkeypatch):
    record = ex.simulate("aero2", "chirp", steps=10)
    made = Design(Aero2.definition, "robust", "D", 0, record.inputs, record, 1.0, 3, 1000)
    monkeypatch.setattr("excite.study.campaign.design", lambda *_, **__: made)
    campaign = ex.Campaign("aero2", {"D_p": "1%"}, policy="none")
    with pytest.raises(
        ValueError, match=r"a critical level on 3 of 1000 plants of the spread 0\.3"
    ):
        _ = campaign.ask()


@pytest.mark.slow
def test_a_round_that_ended_too_early_makes_later_ones_longer():
    campaign = ex.Campaign("aero2", {"D_p": "0.001%"}, policy=steady(), redesign=False)
    assert campaign.monitor(waits=True)._enough(100) == 1
    told = campaign.tell(ex.simulate("aero2", steady(), params=TRUE, seed=1), REACHED)
    estimate, half = told.known["D_p"]
    missing = half / (1e-5 * estimate)
    assert missing > 10
    assert told.decision.startswith("go on: D_p is")
    enough = campaign.monitor(waits=True)._enough(100)
    assert enough == pytest.approx((1 - 1 / math.sqrt(2 * 100)) / missing)


@pytest.mark.slow
def test_records_that_the_plant_does_not_explain_are_a_warning():
    campaign = ex.Campaign("aero2", {"D_p": "0.1%"}, policy=steady())
    record = ex.simulate("aero2", steady(), params=TRUE, seed=1)
    ripple = 0.01 * np.sin(0.8 * np.arange(len(record.time)))[:, None]
    campaign.tell(dataclasses.replace(record, outputs=record.outputs + ripple))
    (sentence,) = campaign.warnings
    assert "times the declared noise: the plant may be wrong" in sentence
    assert f"warning: {sentence}"[:60] in repr(campaign)
    assert campaign.ask() is campaign.policy  # a signal redesigned for this plant may be unsafe
    assert campaign.tell(record).played == "policy"


@pytest.mark.slow
def test_a_policy_that_is_played_although_no_candidate_is_safe_is_a_warning(monkeypatch):
    campaign = ex.Campaign("aero2", {"D_p": "0.1%"}, policy=steady())
    campaign.tell(ex.simulate("aero2", steady(), params=TRUE, seed=1))
    monkeypatch.setattr("excite.study.campaign.candidates", lambda *_, **__: [])
    assert campaign.warnings == ()
    assert campaign.ask() is campaign.policy
    (sentence,) = campaign.warnings
    assert sentence.endswith(
        "no candidate is safe on all plants that are possible; the policy is played all the same"
    )


@pytest.mark.slow
def test_a_spread_that_excludes_the_estimate_is_a_warning():
    campaign = ex.Campaign("aero2", {"D_p": "0.1%"}, policy=steady(), spread=0.3)
    record = ex.simulate("aero2", steady(), params={**TRUE, "J_p": 0.06}, seed=1)
    campaign.tell(record)
    (sentence,) = campaign.warnings
    assert sentence.startswith("the spread 0.3 excludes the estimate of J_p, 0.0")


def still() -> ex.Policy:
    """A policy that plays nothing."""
    return steady(size=0.0)


KNOWN = {"J_p": "lognormal:0.024:5%", "K_pu": "lognormal:0.0112:5%"}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"prior": {"c": "normal:1:2"}}, "'c'"),
        ({"prior": {"J_p": "normal:1:0.001"}}, "excludes the prior of J_p, 1 kg m²"),
        ({"prior": KNOWN, "target": {"J_p": "50%"}}, "every target is reached by the prior"),
        ({"prior": KNOWN, "rivals": ["aero2_lag"]}, "it does not go with rivals"),
        ({"prior": {"J_p": "uniform:0.02:0.03"}}, "and no uniform one: got J_p"),
    ],
)
def test_a_prior_that_cannot_be_used_is_one_sentence(options, words):
    given = {"plant": "aero2", "target": EASY, "policy": steady(), **options}
    with pytest.raises(ValueError, match=re.escape(words)):
        ex.Campaign(**given)


def test_what_was_known_before_counts_in_every_estimate_and_prediction():
    options: Any = {"policy": steady(), "redesign": False, "rounds": 2}
    campaign = ex.Campaign("aero2", {"D_p": "0.001%"}, prior=KNOWN, **options)
    half = campaign.known["J_p"].ci95_half / campaign.known["J_p"].estimate
    assert half == pytest.approx(HALF_95 * 0.05)
    assert campaign.known["D_p"].ci95_half == math.inf  # the spread is no prior
    assert not campaign.to_dict()["rounds"]
    record = ex.simulate("aero2", campaign.ask(), params=TRUE, seed=1)
    campaign.tell(record)
    result = ex.identify(record, "aero2", prior=KNOWN, initial_state="known")
    for name, interval in campaign.known.items():
        assert interval.estimate == pytest.approx(result.params[name], rel=1e-6)
        low, high = result.ci95(name)
        assert interval.ci95_half == pytest.approx((high - low) / 2, rel=1e-4)
    # After every sample, what was known before counts, too.
    assert campaign.knowledge()[1][10, 0] < half * campaign.known["J_p"].estimate


def test_what_is_expected_of_an_experiment_that_tells_nothing_is_the_prior():
    options: Any = {"policy": still(), "redesign": False}
    prior = {**KNOWN, "D_p": "lognormal:0.0011:10%"}
    expected = ex.Campaign("aero2", {"J_p": "1%"}, prior=prior, **options).expected
    assert expected.shares["J_p"] == pytest.approx(HALF_95 * 5)
    assert str(expected) == "no plant of the prior reaches every target"
    without = ex.Campaign("aero2", {"J_p": "1%"}, **options).expected
    assert without.shares["J_p"] > 1e6
    assert str(without) == "no plant of the spread reaches every target"


@pytest.mark.slow
@pytest.mark.parametrize("sd", ["2%", "0.01%"])  # the second outweighs the records
def test_records_that_contradict_the_prior_end_the_campaign(sd):
    prior = {"J_p": f"lognormal:0.05:{sd}"}
    campaign = ex.Campaign("aero2", EASY, policy=steady(), prior=prior, redesign=False)
    told = campaign.tell(ex.simulate("aero2", campaign.ask(), params=TRUE, seed=1))
    assert campaign.reason == "the records contradict the prior of J_p"
    estimate, half = told.known["J_p"]  # of the records alone
    assert abs(estimate - TRUE["J_p"]) < 2 * half < 0.1 * TRUE["J_p"]
    known = campaign.knowledge()[1]
    assert known[0, 0] > 1  # after one sample of the records alone


@pytest.mark.science  # compiles the redesign
def test_with_a_prior_and_without_a_policy_the_first_signal_is_designed_for_the_prior():
    prior = {**KNOWN, "D_p": "lognormal:0.0011:10%"}
    campaign = ex.Campaign("aero2", {"D_p": "1%"}, policy="none", prior=prior, steps=60, coast=20)
    told = campaign.tell(ex.simulate("aero2", campaign.ask(), params=TRUE, seed=1))
    assert (told.num_samples, told.played) == (60, "signal for the prior")
    assert told.nearness < 1


@pytest.mark.slow
def test_noise_that_is_not_white_contradicts_no_prior():
    rng, ended = np.random.default_rng(0), []
    for seed in range(20):
        prior = {n: f"lognormal:{v * math.exp(0.01 * rng.normal())}:1%" for n, v in TRUE.items()}
        campaign = ex.Campaign("aero2", {"D_p": "0.01%"}, policy=steady(), prior=prior)
        campaign.redesign = False
        record = ex.simulate("aero2", steady(), params=TRUE, seed=seed)
        noise = np.zeros(len(record.time))
        for k in range(1, len(noise)):
            noise[k] = 0.9 * noise[k - 1] + 1.5e-4 * rng.normal()
        outputs = record.outputs + noise[:, None]
        campaign.tell(dataclasses.replace(record, outputs=outputs))
        ended.append(campaign.reason)
    assert {*ended} == {""}


def test_a_prior_is_no_estimate():
    campaign = ex.Campaign("aero2", EASY, policy=steady(), prior=KNOWN, redesign=False)
    record = ex.simulate("aero2", still(), params=TRUE, seed=1)
    lost = dataclasses.replace(record, outputs=np.full_like(record.outputs, np.nan))
    lost.outputs[:3] = record.outputs[:3]
    told = campaign.tell(lost)
    assert campaign.result is None
    assert told.known == {}
    assert told.decision.startswith("go on: there is no estimate yet")


@pytest.mark.science
def test_a_campaign_with_a_prior_is_resumed_with_the_same_one_only(tmp_path):
    made = repeated(tmp_path / "a", {"D_p": "2%"}, rounds=1, prior=KNOWN)
    again = repeated(tmp_path / "a", {"D_p": "2%"}, rounds=1, prior=KNOWN)
    assert again.to_dict() == made.to_dict()
    with pytest.raises(ValueError, match="is another campaign, with prior"):
        repeated(tmp_path / "a", rounds=1, prior={"J_p": "lognormal:0.024:6%"})
    with pytest.raises(ValueError, match="is another campaign, with prior"):
        repeated(tmp_path / "a", rounds=1)


@pytest.mark.slow
def test_records_that_tell_nothing_contradict_no_prior():
    prior = {name: f"lognormal:{value}:5%" for name, value in TRUE.items()}
    campaign = ex.Campaign("aero2", EASY, policy=steady(), prior=prior, redesign=False)
    record = ex.simulate("aero2", still(), params=TRUE, noise={"pitch": 0.05}, seed=1)
    assert campaign.tell(record).decision.startswith("go on: ")


@pytest.mark.slow
def test_a_prior_that_is_right_ends_no_campaign():
    ended = []
    for seed in range(40):  # at a chance of one in a hundred, one of three parameters would
        rng = np.random.default_rng(seed)
        prior = {n: f"lognormal:{v * math.exp(0.05 * rng.normal())}:5%" for n, v in TRUE.items()}
        campaign = ex.Campaign("aero2", EASY, policy=steady(), prior=prior, redesign=False)
        campaign.tell(ex.simulate("aero2", steady(), params=TRUE, seed=seed))
        ended.append(campaign.reason)
    assert {*ended} <= {"", REACHED}


def test_a_campaign_ends_where_nothing_more_can_be_had():
    record = ex.simulate("aero2", steady(), params=TRUE, seed=1)
    for policy, goes_on in ((steady(), True), (still(), False)):  # what comes next counts
        campaign = ex.Campaign("aero2", {"D_p": "0.01%"}, policy=policy, redesign=False)
        campaign.tell(record)
        assert (campaign.ask() is not None) == goes_on
    half = 100 * campaign.known["D_p"].ci95_half / campaign.known["D_p"].estimate
    assert campaign.reason == (
        "nothing more can be had: 9 more rounds would hardly tell more of D_p, which is known to "
        f"{half:.2g} %"
    )


def test_later_rounds_compile_nothing():
    campaign = ex.Campaign("aero2", {"D_p": "0.001%"}, policy=steady(), redesign=False)
    records = [ex.simulate("aero2", steady(), params=TRUE, seed=seed) for seed in range(4)]
    short = dataclasses.replace(
        records[3], time=records[3].time[:-7], inputs=records[3].inputs[:-7],
        outputs=records[3].outputs[:-7],
    )  # fmt: skip
    compiled = []
    campaign.tell(records[0])
    campaign.ask()
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None
    )
    try:
        for record in (*records[1:3], short):
            campaign.tell(record)
            assert campaign.ask() is not None
    finally:
        jax.monitoring.clear_event_listeners()
    assert compiled == []


def test_a_share_of_nothing_is_infinite():
    assert targets_from(Aero2(), {"D_p": "1%"})[0].share(0.0, 1e-3) == math.inf


# ------------------------------------------------------------------------- what is expected


@pytest.mark.slow
def test_the_expected_samples_are_those_of_the_bound():
    campaign = ex.Campaign("aero2", {"D_p": "30%", "K_pu": "20%"}, policy=steady(), rounds=3)
    plant, found = Aero2(), campaign.expected
    keys = jax.random.split(jax.random.key(0), 32)
    for i in (0, 5):
        params_key, key = jax.random.split(keys[i])
        params = draw_params(plant, params_key, "factor:3")
        excitation = steady()
        from excite.excitation import PolicyExcitation

        run = run_episode(plant, params, PolicyExcitation.of(excitation), 60, key)
        count = int(found.samples[i]) if np.isfinite(found.samples[i]) else 180

        def share(samples: int, run=run, params=params) -> float:
            """Of the target that is farthest away, after so many samples."""
            rounds, rest = divmod(samples, 60)
            whole = experiment_information(plant, params, run.inputs)
            part = experiment_information(plant, params, run.inputs[:rest]) if rest else 0
            sd = np.sqrt(np.diag(np.linalg.inv(rounds * whole + part)))
            return max(HALF_95 * sd[1] / 0.2, HALF_95 * sd[2] / 0.3)

        if np.isfinite(found.samples[i]):
            assert share(count) <= 1 + 1e-9
        if count > 6:
            assert share(count - 1) > 1


@pytest.mark.slow  # compiles the redesign
def test_a_target_that_nothing_reaches_is_refused_before_the_first_round(tmp_path):
    with pytest.raises(ValueError, match=r"reaches D_p to 1e-07 %: at best .* %; ask for less"):
        ex.campaign("aero2", {"D_p": "0.0000001%"}, policy=steady(), out=tmp_path / "a", fast=True)
    assert not (tmp_path / "a").exists()


# ------------------------------------------------------------------------ the running round


@pytest.mark.slow
def test_a_round_ends_only_where_the_free_motion_after_it_is_safe(monkeypatch):
    campaign = ex.Campaign("aero2", EASY, policy=steady())
    traces, usual = 0, response

    def counted(*args):
        nonlocal traces
        traces += 1
        return usual(*args)

    monkeypatch.setattr("excite.study.monitor.response", counted)
    jax.clear_caches()
    monitor = campaign.monitor(waits=True)
    plant, fast = Aero2(), jnp.full((15, 1), 24.0)
    known = {name: Interval(value, 1e-9) for name, value in TRUE.items()}
    sure = dataclasses.replace(monitor._live._estimate(0), information=1e9 * jnp.eye(3))
    params = plant.Params(**TRUE)
    outputs = np.asarray(response(plant, params, jnp.concatenate([fast, jnp.zeros((100, 1))])))
    level = plant.definition.outputs[0].critical_level or 0.0
    verdicts = []
    for k in range(15):
        sample = Sample(plant.description, 60, k, 0.1 * k, np.array(outputs[k]), np.array([24.0]))
        monitor._live._latest, monitor._live._kept = known, sure
        monitor._live._first = 1000  # no estimate but this one
        verdicts.append(monitor(sample))
        surely, perhaps = (monitor._after(params, x * np.eye(3)) for x in (1e9, 0.0))
        assert perhaps >= surely - 1e-3  # also on the other plants of the spread
        rest = jnp.concatenate([fast[:k], jnp.zeros((160 - k, 1))])
        largest = float(np.abs(response(plant, params, rest)).max()) / level
        assert verdicts[-1] == (largest < 0.97)
    assert verdicts[0]
    assert not verdicts[-1]
    assert traces == 1  # nothing is compiled while a round runs
    assert np.abs(outputs[14]).max() < level  # what would happen, and has not
    monitor.close()


@pytest.mark.slow
def test_a_later_round_leaves_room_for_the_error_of_the_noise(monkeypatch):
    plant = Aero2()
    runs = [ex.simulate("aero2", steady(), params=TRUE, seed=seed) for seed in (1, 2)]
    one, two = (ex.identify(run, "aero2") for run in runs)
    targets = targets_from(plant, {"J_p": "1%"})
    traced, usual = [], NLS._search
    monkeypatch.setattr(NLS, "_search", lambda *args: traced.append(args) or usual(*args))
    jax.clear_caches()
    for earlier, share, is_enough in (
        (None, 0.99, True),
        (one, 0.99, False),
        (two, 0.8, True),
    ):
        monitor = Monitor(plant, earlier, targets, 60, 20, waits=True, spread="factor:3")
        half = 0.01 * share * TRUE["J_p"]
        known = {name: Interval(value, half) for name, value in TRUE.items()}
        sure = dataclasses.replace(monitor._live._estimate(0), information=1e9 * jnp.eye(3))
        monitor._live._latest, monitor._live._kept, monitor._live._first = known, sure, 1000
        sample = Sample(plant.description, 60, 19, 1.9, np.zeros(1), np.zeros(1))
        assert monitor(sample) == is_enough  # one standard error of 20 samples is 16 %
        monitor.close()
    assert len(traced) == 2  # compiled without, and once with what earlier rounds told


def test_one_process_at_a_time_works_in_a_folder(tmp_path):
    with (
        locked_folder(tmp_path / "a", "this campaign"),
        pytest.raises(ValueError, match="another process is working on this campaign"),
        locked_folder(tmp_path / "a", "this campaign"),
    ):
        pass
    with locked_folder(tmp_path / "a", "this campaign"):
        pass


def test_a_folder_in_which_a_file_was_being_written_is_that_of_a_campaign(tmp_path):
    campaign = ex.Campaign("aero2", EASY, policy=steady())
    for name in (".campaign.json.x1", ".run.json.x2", "run.json"):
        (tmp_path / name).write_text("{")
    assert not _Folder.checked(tmp_path, campaign, {}, "").has_rounds
    (tmp_path / ".thesis").write_text("mine")
    with pytest.raises(ValueError, match="exists and is no campaign"):
        _Folder.checked(tmp_path, campaign, {}, "")


def test_a_signal_ends_the_pause_between_rounds(monkeypatch):
    assert _paused(0.01) == ""
    slept = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(time, "sleep", sleep)
    assert _paused(3600.0) == "interrupted by SIGINT"
    assert len(slept) == 1


def test_a_spread_beyond_that_of_the_policy_is_a_warning():
    wide = ex.Campaign("aero2", EASY, policy=steady(), spread="factor:4")
    assert wide.warnings == (
        "the policy was trained for a spread of factor:3; outside it, it promises nothing",
    )
    assert wide.warnings[0] in " ".join(repr(wide).split())
    assert ex.Campaign("aero2", EASY, policy=steady(), spread="factor:2").warnings == ()


@pytest.mark.parametrize(("noise", "is_explained"), [(2e-4, True), (4e-4, False)])
def test_with_rivals_a_residual_larger_than_the_declared_noise_is_not_explained(
    noise, is_explained
):
    campaign: Any = ex.Campaign("aero2", EASY, policy=steady())
    record = ex.simulate("aero2", steady(), params=TRUE, noise={"pitch": noise}, seed=1)
    campaign.result = ex.identify(record, "aero2")
    assert campaign._is_explained()  # white, and the noise may be declared too small
    campaign.discrimination = "rivals"
    assert campaign._is_explained() == is_explained


@pytest.mark.slow
def test_a_record_that_was_followed_by_another_ends_nothing():
    campaign = ex.Campaign("aero2", EASY, policy=ex.read_policy("aero2"), redesign=False)
    record = ex.simulate("aero2", campaign.ask(), params=TRUE, seed=1)
    assert campaign.tell(record, goes_on=True).decision.startswith("go on: ")
    campaign.tell(record)
    assert campaign.reason == REACHED


def repeated(out: Path, target: Any = None, **options: Any) -> ex.Campaign:
    """The campaign of `played` in a folder, with what differs."""
    usual = {"rounds": 2, "fast": True, "seed": 3, "redesign": False}
    return ex.campaign("aero2", target or {"D_p": "0.3%"}, policy=steady(), out=out,
                       **(usual | options))  # fmt: skip


@pytest.fixture(scope="module")
def played(tmp_path_factory) -> tuple[Path, ex.Campaign]:
    """Two rounds on the simulated rig, and where they are."""
    folder = tmp_path_factory.mktemp("campaign") / "first"
    made = repeated(folder)
    return folder, made


@pytest.mark.science
def test_every_round_has_its_own_noise_and_the_same_plant(played):
    folder, made = played
    first, second = made.records
    assert (
        first.metadata["ended"]["rig"]["true_params"]
        == (second.metadata["ended"]["rig"]["true_params"])
    )
    assert not np.array_equal(first.outputs, second.outputs)
    assert made.reason == "all rounds are played"
    saved = json.loads((folder / "campaign.json").read_text())
    assert saved["num_samples"] == made.num_samples
    assert len(saved["rounds"]) == 2


@pytest.mark.science
def test_a_campaign_is_reported_and_its_estimate_is_a_run(played):
    folder, made = played
    after = [ex.next_experiment(folder / f"round-0{i}", spread="factor:3", steps=30, coast=20,
                                target=EASY).known for i in (1, 2)]  # fmt: skip
    for name, interval in made.rounds[0].known.items():
        assert after[0][name].estimate == pytest.approx(interval.estimate, rel=1e-6)
    assert after[1]["D_p"].ci95_half < after[0]["D_p"].ci95_half
    page = ex.report(folder)
    for words in ("aero2: all rounds are played", "0.3 %", "missed", "Round 2: inputs", "factor:3"):
        assert words in page
    assert page.count("<svg") == 3
    known = read_columns(folder / "knowledge.csv", ["sample", "J_p", "K_pu", "D_p"])
    np.testing.assert_allclose(known["D_p"], made.knowledge()[1][:, 2])
    found = ex.next_experiment(folder / "estimate", spread="factor:3", steps=30, coast=20)
    for name, interval in found.known.items():
        assert interval.estimate == pytest.approx(made.known[name].estimate, rel=1e-6)
    assert "every target" not in ex.report(folder / "estimate")
    (folder / "knowledge.csv").write_text("sample\n1\n")
    assert ex.report(folder).count("<svg") == 2  # without what was known
    (folder / "knowledge.csv").write_text("sample\nmany\n")
    with pytest.raises(ValueError, match=r"knowledge\.csv"):
        ex.report(folder)


@pytest.mark.science
def test_a_campaign_that_was_interrupted_is_resumed_and_nothing_is_played_twice(played, tmp_path):
    folder, made = played
    again = tmp_path / "again"
    again.mkdir()
    for name in ("campaign.json", "round-01.csv", "round-01.json"):
        (again / name).write_bytes((folder / name).read_bytes())
    before = (again / "round-01.csv").stat().st_mtime_ns
    told = []
    resumed = repeated(again, on_round=told.append)
    assert (again / "round-01.csv").stat().st_mtime_ns == before
    assert (again / "round-02.csv").read_text() == (folder / "round-02.csv").read_text()
    assert resumed.to_dict() == made.to_dict()
    assert len(told) == 2
    (again / "round-02.csv").write_text("time,voltage,pitch\n")  # hardly begun when it was killed
    once_more = repeated(again)
    assert once_more.to_dict() == made.to_dict()
    content = (again / "round-01.csv").read_bytes()
    eased = repeated(again, {"D_p": "50%"}, rounds=3)
    assert eased.reason == REACHED
    assert eased.prediction == ""  # that was about another target
    file = again / "round-02.json"  # as if the last round had ended at an easier target
    sidecar = json.loads(file.read_text())
    sidecar["ended"]["reason"] = REACHED
    file.write_text(json.dumps(sidecar))
    other = repeated(again, {"D_p": "0.001%"}, rounds=2)
    assert other.haste == 1.0
    assert len(eased.rounds) == 2  # all that was recorded is used
    assert (again / "round-01.csv").read_bytes() == content
    with pytest.raises(ValueError, match=r"is another campaign, with seed 3 and not 4"):
        repeated(again, seed=4)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("mine")
    with pytest.raises(ValueError, match="exists and is no campaign"):
        ex.campaign("aero2", EASY, policy=steady(), out=tmp_path / "other", fast=True)


@pytest.mark.science
def test_the_command_ends_a_round_as_soon_as_enough_is_known(tmp_path):
    asked = "--target", "D_p=2%,J_p=1%", "--policy", "aero2", "--fast"
    done = excite("campaign", "aero2", *asked, "--out", tmp_path / "a", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["reason"] == REACHED
    assert told["num_samples"] < 100
    record = ex.read_record(tmp_path / "a" / "round-01.csv")
    true = record.metadata["ended"]["rig"]["true_params"]
    for name, interval in told["rounds"][-1]["known"].items():
        assert abs(interval["estimate"] - true[name]) < 3 * interval["ci95_half"]
    missed = excite(
        "campaign", "aero2", "--target", "D_p=0.01%", "--policy", "aero2", "--fast",
        "--out", tmp_path / "b", "--rounds", "1", "--spread", "0.3",
        "--plot", tmp_path / "known.png",
    )  # fmt: skip
    assert missed.returncode in (1, 2)
    refused = excite("campaign", "aero2", "--target", "D_p=x", "--out", tmp_path / "c")
    assert refused.returncode == 2
    assert "target of D_p must be a number above 0" in refused.stderr


def test_a_budget_of_samples_that_is_too_short_names_its_option():
    few = r"at most 1 round of 500 samples .* more {}samples \(--samples\)$"
    for rounds, also in ((10, ""), (1, r"rounds \(--rounds\) and ")):
        target = {"D_p": "0.0001%"}
        asked = ex.Campaign("aero2", target, policy="aero2", rounds=rounds, samples=600)
        with pytest.raises(ValueError, match=few.format(also)):
            asked.require_reachable()


def test_a_plant_that_diverges_is_told_without_a_size():
    asked = ex.Campaign("aero2", {"D_p": "5%"})
    sizes = np.full(32, 0.9)
    sizes[:2] = np.inf, np.nan
    for name in ("nearness_after", "nearness"):
        asked.expected = dataclasses.replace(asked.expected, **{name: sizes})
        asked.require_reachable()
        assert asked.unsafe.endswith(
            "diverges or reaches a critical level on 2 of 32 plants of the spread: "
            "give another policy or none (--policy)"
        )


@pytest.mark.parametrize(
    ("plant", "usual", "with_guard"),
    [("aero2", "aero2-wide", "aero2"), ("dc_motor", "dc_motor-wide", "dc_motor"),
     ("emps", "emps-wide", "emps-wide"), ("aero2_detailed", "aero2_detailed", "aero2_detailed"),
     ("van_der_pol", "none", "none")],
)  # fmt: skip
def test_with_a_guard_the_usual_policy_is_one_that_has_it(plant, usual, with_guard):
    description = dataclasses.replace(plant_named("aero2").description, name=plant)
    assert usual_policy(description) == usual
    assert usual_policy(description, guarded=True) == with_guard


def test_a_campaign_with_guard_needs_no_name_of_a_policy(tmp_path):
    with pytest.raises(ValueError, match="no campaign of at most 1 round of 500 samples"):
        ex.campaign(
            "dc_motor", {"R": "0.000001%"}, guard=True, rounds=1, fast=True, out=tmp_path / "c"
        )


def test_a_policy_whose_experiment_ends_unsafely_is_told_before_the_first_round():
    """That of `dc_motor` ends at full speed: the safe input would drive the current."""
    told = ex.Campaign("dc_motor", {"K": "5%"}, policy="dc_motor")
    told.require_reachable()
    (warning,) = told.warnings
    assert re.match(
        r"the free motion after a whole round of the policy reaches .* on 32 of 32", warning
    )
    assert np.all(told.expected.nearness < 1)
    told.require_reachable(brakes=True)
    assert not told.warnings
    wide = ex.Campaign("dc_motor", {"K": "5%"}, policy="dc_motor", spread=0.6)
    wide.require_reachable(brakes=True)
    assert any(w.startswith("a whole round of the policy reaches") for w in wide.warnings)


@pytest.mark.parametrize(
    ("plant", "target"),
    [("aero2", {"D_p": "5%"}), ("dc_motor", {"R": "1%"}), ("cart_pole", {"l": "1%"}),
     ("emps", {"M": "1%"})],
)  # fmt: skip
def test_the_usual_policies_are_for_wide_spreads_and_end_safely(plant, target):
    asked = ex.Campaign(plant, target)
    assert asked.policy is not None
    assert asked.policy.hash == ex.read_policy(f"{plant}-wide").hash
    asked.require_reachable()
    assert not asked.warnings


@pytest.mark.parametrize(
    ("share", "told"),
    [(1.04, "slightly more uncertain"), (1.06, "1.1 times as"), (math.inf, "not identifiable yet")],
)
def test_a_target_that_is_nearly_reached_is_not_once_as_uncertain(share, told):
    assert told in farthest({"J_p": 0.5, "D_p": share})
