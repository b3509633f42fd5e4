"""Committed policies for the plants of Inside-Out SMC² tell what the page says."""

import json
import math

import pytest
from experiments import ROOT

import excite as ex

FOLDER = ROOT / "results" / "oed"
PAGE = (ROOT / "docs" / "explanation" / "expected-information.md").read_text()
ROWS = [
    row for path in sorted(FOLDER.glob("*.json")) for row in json.loads(path.read_text())["rows"]
]
PLANTS = {
    "linear pendulum": ("LinearPendulum", {"a": "normal:14.7:0.316228", "b": "normal:0:0.1",
                                           "c": "normal:3:0.316228"}),
    "nonlinear pendulum": ("NonlinearPendulum", {"m": "lognormal:1:0.1", "l": "lognormal:1:0.1"}),
    "cart-pole": ("CartPole", dict.fromkeys(("l", "m_p", "m_c"), "lognormal:1:0.1")),
    "double pendulum": (
        "DoublePendulum", dict.fromkeys(("m_1", "m_2", "l_1", "l_2"), "lognormal:1:0.1"),
    ),
}  # fmt: skip


def policy_of(row):
    """The policy's file of a row."""
    word = row["task"].replace(" ", "_")
    return FOLDER / f"{word}-{row['price']:g}-{row['seed']}.safetensors"


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
    assert {row["task"] for row in ROWS} == PLANTS.keys()


@pytest.mark.parametrize("task", PLANTS)
def test_a_policy_tells_again_what_its_row_says(task):
    row = next(r for r in ROWS if (r["task"], r["method"]) == (task, "gradient"))
    name, prior = PLANTS[task]
    found = ex.information_gain(
        f"{ROOT}/examples/smc_pendulums.py:{name}", policy_of(row), prior=prior, plants=192,
        samples=100, seed=7,
    )  # fmt: skip
    error = math.hypot(found.laplace.std_error, row["laplace"]["std_error"])
    assert abs(found.laplace.value - row["laplace"]["nats"]) < 4.5 * error


@pytest.mark.parametrize("task", PLANTS)
def test_trained_without_a_price_the_best_policy_tells_more_than_the_published_one(task):
    own = [r for r in ROWS if r["task"] == task]
    (published,) = (r for r in own if r["method"] == "published")
    best = max((r for r in own if r.get("price") == 0), key=lambda r: r["laplace"]["nats"])
    error = math.hypot(best["laplace"]["std_error"], published["laplace"]["std_error"])
    assert best["laplace"]["nats"] > published["laplace"]["nats"] + 3 * error
