"""Several plants for the same records."""

import re

import numpy as np
import pytest
import scipy.stats

import excite as ex
from excite.estimation.comparison import Comparison
from excite.estimation.diagnosis import log_likelihood
from excite.record import Record


def test_the_likelihood_is_that_of_normal_noise():
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 50)), 3 * rng.normal(size=(2, 50))
    expected = sum(
        np.sum(scipy.stats.norm.logpdf(r, scale=np.sqrt(np.mean(r**2)))) for r in (first, second)
    )
    assert log_likelihood([list(first), list(second)]) == pytest.approx(expected)


@pytest.fixture(scope="module")
def compared() -> Comparison:
    records = [ex.simulate("aero2+coulomb", "multisine", seed=seed) for seed in (0, 1)]
    plants = ["aero2", "aero2+coulomb", "aero2+delay"]
    return ex.compare_plants(records[0], plants, validate=records[1])


@pytest.mark.science
def test_the_plant_that_made_a_record_comes_first(compared):
    best, *others = compared.plants
    assert best.name == "aero2+coulomb_pitch_rate"
    assert best.p_value < 1e-6
    assert {p.name: p.p_value is None for p in others} == {
        "aero2": True,
        "aero2+delay_voltage": False,
    }
    assert [p.bic for p in compared.plants] == sorted(p.bic for p in compared.plants)


@pytest.mark.science
def test_the_criterion_counts_parameters_states_and_noise(compared):
    best = compared.plants[0]
    assert best.num_unknowns == 4 + 1  # J_p, K_pu, D_p, the friction; and one output's noise
    residual = np.ravel(best.result.fitted[0].record.outputs - best.result.fitted[0].simulated)
    count, variance = residual.size, float(np.mean(residual**2))
    likelihood = -count * (np.log(2 * np.pi * variance) + 1) / 2
    assert best.bic == pytest.approx(5 * np.log(count) - 2 * likelihood)
    free = ex.compare_plants(
        best.result.fitted[0].record, ["aero2", "aero2+delay"], initial_state="free"
    )
    states = len(best.result.plant.states)
    assert {p.num_unknowns for p in free.plants} == {4 + states, 5 + states}


@pytest.mark.science
def test_an_effect_that_is_not_there_gains_by_chance_only():
    record = ex.simulate("aero2", "multisine", seed=3)
    first, second = ex.compare_plants(record, ["aero2", "aero2+delay"]).plants
    assert first.name == "aero2"
    assert second.p_value is not None
    assert second.p_value > 0.01


@pytest.mark.science
def test_the_table_shows_fits_tests_and_the_held_out_record(compared):
    lines = str(compared).splitlines()
    assert lines[1].split()[:2] == ["plant", "unknowns"]
    assert lines[3].startswith("aero2+coulomb_pitch_rate")
    assert "held-out fit [%]" in str(compared)
    assert re.search(r"aero2: successful; pitch: residual \S+ deg RMS, not white", str(compared))
    assert "<table" in compared._repr_html_()
    found = compared.to_dict()["plants"][0]
    assert found["identification"]["plant"] == found["plant"] == "aero2+coulomb_pitch_rate"


@pytest.mark.parametrize(
    ("plants", "words"),
    [
        (["aero2"], "at least two plants"),
        (["aero2", "dc_motor"], "'dc_motor' has speed, current; 'aero2' has pitch"),
        (["aero2", "aero"], "unknown plant 'aero'"),
    ],
)
def test_what_cannot_be_compared_is_refused(plants, words):
    record = Record(np.arange(3.0), np.zeros((3, 1)), np.zeros((3, 1)), {}, "log.csv")
    with pytest.raises(ValueError, match=words):
        ex.compare_plants(record, plants)


@pytest.mark.slow
def test_the_initial_state_is_known_for_all_plants_or_for_none():
    record = ex.simulate("aero2", "multisine", steps=200, seed=1)  # from rest: aero2 knows it
    found = ex.compare_plants(record, ["aero2", "aero2_lag"])
    assert {p.result.initial_state_known for p in found.plants} == {False}
    assert [p.name for p in found.plants] == ["aero2", "aero2_lag"]
    assert str(found).startswith("plants, likeliest first; initial state free\n")
    unknowns = {p.name: p.num_unknowns for p in found.plants}
    assert unknowns["aero2"] == 3 + 2 + 1  # parameters, states, noise


def test_plants_are_compared_without_priors_and_other_likelihoods():
    with pytest.raises(ValueError, match="compared by a normal likelihood, without priors"):
        ex.compare_plants("record.csv", ["aero2", "aero2_lag"], likelihood="student")
