"""What the documentation says of the guard is in the committed results."""

import importlib.util
import json

import pytest
from experiments import ROOT

from excite.policy import read_policy, shipped_policies
from excite.rig.guard import Guard

RESULTS = ROOT / "results" / "guard"
POLICIES = sorted(path.stem for path in RESULTS.glob("*.json"))


def scenarios():
    """The script that made the results."""
    spec = importlib.util.spec_from_file_location("scenarios", RESULTS / "scenarios.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", POLICIES)
def test_the_tables_are_those_of_the_results(name):
    result = json.loads((RESULTS / f"{name}.json").read_text())
    page = (ROOT / "docs" / "reference" / "real-time.md").read_text()
    assert "\n".join(scenarios().table(result)) in page


@pytest.mark.parametrize("name", POLICIES)
def test_the_results_are_of_the_shipped_guard(name):
    result = json.loads((RESULTS / f"{name}.json").read_text())
    policy = read_policy(shipped_policies()[name])
    assert policy.guard is not None
    assert result["policy_hash"] == policy.hash
    assert result["thresholds"] == Guard.from_dict(policy.guard).rules.thresholds.tolist()


@pytest.mark.parametrize("name", POLICIES)
def test_declared_plants_do_not_trip_and_a_wrong_sign_is_found_in_time(name):
    rows = json.loads((RESULTS / f"{name}.json").read_text())["rows"]
    by_name = {row["scenario"]: row for row in rows}
    declared = by_name["as declared"]
    assert declared["runs"] >= 2000
    assert declared["detected"] + declared["by_supervisor"] <= 0.001 * declared["runs"]
    assert by_name["wrong sign"]["with"] == 0
    assert by_name["wrong sign"]["detected"] == by_name["wrong sign"]["runs"] >= 300
