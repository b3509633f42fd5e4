"""Committed policies for the plants of Inside-Out SMC² tell what the page says."""

import json
import math

import pytest
from experiments import ROOT

import excite as ex
from excite.files import module_at

FOLDER = ROOT / "results" / "oed"
PAGE = (ROOT / "docs" / "explanation" / "expected-information.md").read_text()
COMPUTED = module_at(FOLDER / "compute.py")
ROWS = [
    row
    for task in COMPUTED.TASKS
    for row in json.loads(COMPUTED.path_of(task, ".json").read_text())["rows"]
]


def line_of(row):
    """The row on the page."""
    about = ""
    if row["method"] == "gradient":
        about = f", price {row['price']:g}, seed {row['seed']}"
    gain, error = row["lower"]["nats"], row["lower"]["std_error"]
    changes, less = row["input_changes"]["value"], row["gain_less_changes"]
    method = f"{row['method']}{about}"
    return f"| {row['task']} | {method} | {gain:.2f} ± {error:.2f} | {changes:.1f} | {less:.2f} |"


def test_every_row_is_on_the_page_and_its_bounds_are_tight():
    for row in ROWS:
        assert line_of(row) in PAGE
        assert 0 <= row["upper"]["nats"] - row["lower"]["nats"] < 0.01
        assert row["few_effective_samples"] == 0
    assert PAGE.count("| gradient, ") == sum(row["method"] == "gradient" for row in ROWS)
    assert {row["task"] for row in ROWS} == COMPUTED.TASKS.keys()


@pytest.mark.parametrize("task", COMPUTED.TASKS)
def test_a_policy_tells_again_what_its_row_says(task):
    row = next(r for r in ROWS if (r["task"], r["method"]) == (task, "gradient"))
    policy = COMPUTED.policy_path(task, row["price"], row["seed"])
    prior = COMPUTED.TASKS[task][1]
    found = ex.information_gain(
        COMPUTED.word_of(task), policy, prior=prior, plants=192, samples=100, seed=7
    )
    error = math.hypot(found.laplace.std_error, row["laplace"]["std_error"])
    assert abs(found.laplace.value - row["laplace"]["nats"]) < 4.5 * error


@pytest.mark.parametrize("task", COMPUTED.TASKS)
def test_trained_without_a_price_the_best_policy_tells_more_than_the_published_one(task):
    own = [r for r in ROWS if r["task"] == task]
    (published,) = (r for r in own if r["method"] == "published")
    best = max((r for r in own if r.get("price") == 0), key=lambda r: r["laplace"]["nats"])
    error = math.hypot(best["laplace"]["std_error"], published["laplace"]["std_error"])
    assert best["laplace"]["nats"] > published["laplace"]["nats"] + 3 * error
