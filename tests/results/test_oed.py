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


def test_the_policy_that_finds_sources_tells_again_what_its_row_says():
    own = module_at(FOLDER / "location_finding.py")
    rows = json.loads(own.TABLE.read_text())["rows"]
    for row in rows:
        is_trained = row["method"] == "gradient"
        name = f"trained by gradient, seed {row['seed']}" if is_trained else row["method"]
        means = [row[kind] for kind in ("lower", "upper", "laplace")]
        cells = " | ".join(f"{m['nats']:.2f} ± {m['std_error']:.2f}" for m in means)
        assert f"| {name} | {cells} |" in PAGE
        assert (row["num_plants"], row["num_samples"]) == (256, 100_000)
    row = rows[-1]
    policy = FOLDER / f"location_finding-{row['seed']}.safetensors"
    found = ex.information_gain(
        own.WORD, policy, prior=own.PRIOR, plants=192, samples=10, from_prior=True, seed=7
    )
    error = math.hypot(found.laplace.std_error, row["laplace"]["std_error"])
    assert abs(found.laplace.value - row["laplace"]["nats"]) < 4.5 * error


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
