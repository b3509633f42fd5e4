"""Expected information gain: exact where linear, bounds that hold, and what is refused."""

import json
import math
import re
from typing import Any

import numpy as np
import pytest
from commands import excite

import excite as ex

NARROW = {"J_p": "lognormal:0.0232:0.1%", "K_pu": "lognormal:0.0125:0.2%",
          "D_p": "lognormal:0.00104:2%"}  # fmt: skip
SHORT: Any = {"steps": 60, "plants": 96, "samples": 300}


@pytest.fixture(scope="module")
def narrow():
    """Of a prior so narrow that the response is nearly linear in the parameters."""
    return ex.information_gain("aero2", "chirp", prior=NARROW, **SHORT)


def linear(steps):
    """The gain of a linear response: half the log det of I + P M."""
    information = ex.information("aero2", "chirp", steps=steps).information
    prior = np.diag([0.001, 0.002, 0.02]) ** 2
    return 0.5 * np.linalg.slogdet(np.eye(3) + prior @ information)[1]


@pytest.mark.slow
def test_of_a_nearly_linear_response_the_gain_is_exact(narrow):
    expected = linear(60)
    for found in (narrow.lower, narrow.upper, narrow.laplace):
        assert found.std_error < 0.3
        assert found.value == pytest.approx(expected, abs=3.5 * found.std_error)
    assert narrow.lower.value <= narrow.upper.value
    assert narrow.upper.value - narrow.lower.value < 0.02
    assert narrow.few == 0


@pytest.mark.science
def test_samples_from_the_prior_give_wider_bounds_on_the_same_records(narrow):
    few = {**SHORT, "samples": 50}
    found = ex.information_gain("aero2", "chirp", prior=NARROW, from_prior=True, **few)
    assert found.lower.value < narrow.lower.value + 1e-6
    assert found.upper.value > narrow.upper.value - 0.05
    assert found.lower.value < math.log(51)
    assert found.laplace.value == pytest.approx(narrow.laplace.value)
    assert any("near its largest value, log(50 + 1) = 3.93" in told for told in found.warnings)


@pytest.mark.slow
def test_more_noise_tells_less_and_a_policy_may_react():
    options: Any = {"steps": 40, "plants": 32, "samples": 200, "spread": "factor:2"}
    quiet = ex.information_gain("aero2", "aero2", **options)
    loud = ex.information_gain("aero2", "aero2", noise={"pitch": 0.02}, **options)
    assert 0 < loud.upper.value < quiet.lower.value
    assert "aero2, aero2, 40 steps" in repr(quiet)
    assert "factor:3" not in quiet.prior
    assert quiet._repr_html_().startswith("<table")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"plants": 1}, "plants must be a whole number from 2"),
        ({"samples": 0}, "samples must be a whole number from 1"),
        ({"prior": {"J_p": "uniform:-1:0.03"}}, "'J_p' is -1 to 0.03, and it must lie between 0"),
        ({"prior": {"M": "normal:1:1%"}}, "unknown aero2 parameter 'M'"),
        ({"spread": 1.5}, "such as factor:3: got 1.5"),
        ({"noise": {"pitch": 0.0}}, "a sensor without noise"),
        ({"excitation": "chrp"}, "unknown excitation 'chrp'"),
        ({"seed": -1}, "seed must be a whole number"),
    ],
)
def test_what_is_not_allowed_is_one_sentence(options, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        ex.information_gain("aero2", **options)


@pytest.mark.slow
def test_the_command_prints_bounds():
    asked = ["gain", "aero2", "--steps", "40", "--plants", "8", "--samples", "50"]
    run = excite(*asked, "--prior", "J_p=lognormal:0.0232:10%", "--json")
    assert run.returncode == 0, run.stderr
    told = json.loads(run.stdout)
    assert told["lower"]["nats"] <= told["upper"]["nats"] + 1e-9
    assert told["prior"] == "lognormal in J_p, others 0.3"
    assert excite("gain", "aero2", "--params", "J_p=1").returncode == 2
