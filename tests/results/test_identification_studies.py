"""Committed counts of identification: far starts, intervals and likely causes."""

import json

import numpy as np
import pytest
from experiments import ROOT

import excite as ex
from excite.files import module_at
from excite.plant.catalogue import plant_named
from excite.record import Record

FOLDER = ROOT / "results" / "identification"
STARTS, COVERAGE, REMEDIES = (
    module_at(FOLDER / f"{name}.py") for name in ("starts", "coverage", "remedies")
)
FAR, HELD, NAMED = (
    json.loads((FOLDER / f"{name}.json").read_text()) for name in ("starts", "coverage", "remedies")
)

CURVED = "profile, turn", "radius"
MISSED = {"dc_motor, drag_speed", "dc_motor, drift_speed", "cart_pole, offset_force"}
"""What misses the promised figures; the scripts say why."""


# Far starts


@pytest.mark.parametrize("case", STARTS.CASES, ids=lambda case: case.name)
def test_plants_far_from_the_start_are_found(case):
    row = FAR[case.name]
    assert row["plants"] == case.plants
    # 3 of 3,000 within a factor of three, and 1 % of the others.
    assert len(row["failures"]) <= (1 if case.plant == "aero2" else 0.01 * case.plants)


def test_what_a_failure_says_is_found_again():
    (case,) = (c for c in STARTS.CASES if c.name == "dc_motor multisine")
    (failure,) = FAR[case.name]["failures"]
    found = STARTS.identified(case, STARTS.batch(case, failure["plant"]), 0)
    assert found["status"] == failure["status"]
    assert found["wrong"].keys() == failure["wrong"].keys()
    for name, own in failure["wrong"].items():
        assert found["wrong"][name] == pytest.approx(own, rel=1e-3)


def test_searches_in_a_batch_end_where_identify_ends():
    (case,) = (c for c in STARTS.CASES if c.name == "cart_pole loop-square")
    made, plant = STARTS.batch(case, 0), plant_named(case.plant)
    time = np.arange(STARTS.STEPS + 1) * float(plant.dt)
    for i in range(10):
        record = Record.of_episode(time, made.inputs[i], made.measured[i], {})
        found = ex.identify(record, plant, initial_state="known")
        assert found.status == "successful"
        assert made.is_clear[i]
        off = np.array(list(found.params.values())) - made.values[i]
        assert np.all(np.abs(off) < 0.01 * made.errors[i])


# Intervals


def shares():
    """Case, kind, parameter and its counts."""
    return [
        pytest.param(own, id=f"{case}, {kind}, {name}")
        for case, row in HELD.items()
        for kind, of_kind in row["intervals"].items()
        for name, own in of_kind.items()
        if (case, name) != CURVED
    ]


def test_every_case_has_its_records():
    assert HELD.keys() == COVERAGE.CASES.keys()
    for row in HELD.values():
        assert row["records"] == 1000
        assert sum(row["status"].get(word, 0) for word in COVERAGE.TOLD) == 1000


@pytest.mark.parametrize("own", shares())
def test_95_percent_intervals_hold_in_95_percent(own):
    assert own["percent"] == round(100 * own["inside"] / own["count"], 2)
    assert 93 <= own["percent"] <= 97


def test_profiles_hold_where_intervals_of_standard_errors_miss_by_five_points():
    kinds = HELD[CURVED[0]]["intervals"]
    assert kinds["linear"][CURVED[1]]["percent"] < 90
    own = kinds["profile"][CURVED[1]]
    # Those without an interval, of nearly straight runs, are mostly such that it would miss.
    assert 93 <= 100 * own["inside"] / 1000 <= 97


@pytest.mark.parametrize("case", ["white, aero2", "AR 0.9, aero2", "short, free state"])
def test_intervals_of_the_first_records_are_found_again(case):
    row = COVERAGE.nothing()
    for number in range(COVERAGE.FIRST):
        COVERAGE.counted(row, COVERAGE.CASES[case](number))
    assert row["inside_of_first"] == HELD[case]["inside_of_first"]


# Likely causes


def test_every_effect_has_its_records():
    cases = {f"{plant}, {e}" for plant in REMEDIES.PLAYED for e in REMEDIES.effects(plant)}
    assert NAMED.keys() == cases
    for row in NAMED.values():
        assert row["named"] + sum(row["others"].values()) == row["records"] >= 20


@pytest.mark.parametrize("case", [c for c in NAMED if c not in MISSED])
def test_what_a_plant_leaves_out_is_named_first(case):
    assert NAMED[case]["named"] >= 0.95 * NAMED[case]["records"]


def test_causes_of_the_first_records_are_found_again():
    case = "aero2, coulomb_pitch_rate"
    assert NAMED[case]["named"] == NAMED[case]["records"]
    for seed in range(REMEDIES.SEED, REMEDIES.SEED + 5):
        assert REMEDIES.named_first(*case.split(", "), seed) == "coulomb_pitch_rate"
