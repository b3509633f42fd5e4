"""Committed results of campaigns are of the shipped policy, and the pages say what they are."""

import json
import re

import pytest
from experiments import ROOT

from excite.policy import read_policy

FOLDER = ROOT / "results" / "campaign"
PAGE = (ROOT / "docs" / "explanation" / "results.md").read_text()


@pytest.mark.parametrize("name", ["aero2", "aero2_noisy", "coverage"])
def test_the_results_are_of_the_shipped_policy(name):
    found = json.loads((FOLDER / f"{name}.json").read_text())
    assert found["policy_hash"] == read_policy("aero2-wide").hash
    assert found["plants"] >= 1000


def test_the_page_says_how_many_samples_are_needed_and_that_no_level_was_reached():
    found = json.loads((FOLDER / "aero2.json").read_text())
    assert found["violations_of_whole_rounds"] == found["violations_after_whole_rounds"] == 0
    for target, words in {"0.005": "0.5 %", "0.001": "0.1 %"}.items():
        own, known = found["targets"][target], found["targets"][target]["samples_until_known"]
        assert own["violations"] == 0
        (line,) = (line for line in PAGE.splitlines() if line.startswith(f"| {words} |"))
        cells = [cell.strip() for cell in line.split("|")[2:-1]]
        shown = [f"{known[key]:.0f}" if known[key] else "–" for key in ("median", "90 %", "all")]
        assert cells == [*shown, f"{own['missed']}/{found['plants']}"]


def test_the_page_says_what_a_policy_does_whose_plants_also_have_delay_lag_and_another_stiffness():
    found = json.loads((FOLDER / "aero2_uncertain.json").read_text())
    policy = read_policy(ROOT / found["policy"])
    assert found["policy_hash"] == policy.hash
    assert found["uncertainty"] == policy.provenance["uncertainty"]
    assert {"d_S", "delay_voltage", "lag_voltage"} < set(found["uncertainty"])
    assert found["violations_of_whole_rounds"] == found["violations_after_whole_rounds"] == 0
    assert [target["violations"] for target in found["targets"].values()] == [0, 0]
    row = found["targets"]["0.005"]
    largest = max(target["largest"] for target in found["targets"].values())
    told = PAGE[PAGE.index("**With delay, lag and another stiffness.**") :].partition("\n\n")[0]
    told, median = told.replace("\n", " "), row["samples_until_known"]["median"]
    assert f"the largest output is {found['largest']:.3f} of it" in told
    assert f"and {largest:.3f} after" in told
    assert f"a median of {median:.0f} samples, and {row['missed']} of the 1000" in told


def test_whole_campaigns_on_plants_with_delay_and_lag_play_the_policy_and_are_safe():
    found = json.loads((FOLDER / "uncertain.json").read_text())
    policy = read_policy(FOLDER / "policies" / "aero2-wide-robust.safetensors")
    assert found["policy_hash"] == policy.hash
    assert found["uncertainty"] == policy.provenance["uncertainty"]
    assert (found["violations"], found["redesigned"]) == (0, 0)
    count = found["campaigns"]
    assert found["warned"] == count
    assert found["rounds"] == 3 * count
    told = PAGE[PAGE.index("Whole campaigns know nothing") :].partition("\n\n")[0]
    told = told.replace("\n", " ")
    assert f"In {count} campaigns" in told
    assert f"(largest {found['largest']:.3f})" in told
    assert f"All {count} were warned" in told


def test_the_page_says_what_campaigns_with_guard_on_the_detailed_rig_did():
    found = json.loads((FOLDER / "detailed_rig.json").read_text())
    count, rows = found["campaigns"], found["rows"]
    assert found["policy_hash"] == read_policy("aero2_detailed").hash
    assert found["violations"] == 0
    inside = sum(abs(r["errors"][n]) <= r["ci95_half"][n] for r in rows for n in r["errors"])
    told = PAGE[PAGE.index("**On the simulated rig, with the guard.**") :].partition("\n\n")[0]
    for words in (
        f"--campaigns {count} ", f"chosen in {found['right_plant']}, ",
        f"reached in {found['reached']}, ", f"of {found['samples']['median']:.0f} samples",
        f"{inside} of {3 * count} intervals", f"(largest {found['largest']:.3f})",
    ):  # fmt: skip
        assert words in told.replace("\n", " ")
    assert f"records of {found['told_again']} of" in told.replace("\n", " ")
    assert found["same_decisions"] == found["told_again"] > 0


def test_campaigns_that_were_killed_went_on_where_they_were():
    found = json.loads((FOLDER / "killed.json").read_text())
    count, ended = len(found["kills"]), found["campaigns"]
    told = PAGE[PAGE.index("**Killed.**") :].partition("\n\n")[0].replace("\n", " ")
    hit = {kill["campaign"] for kill in found["kills"]}
    assert f"{len(hit)} of {len(ended)} campaigns were killed {count} times" in told
    assert {c["reason"] for c in ended} == {"every target is reached"}
    for kill in found["kills"]:  # what was recorded before it is at the end as it was
        rounds = ended[kill["campaign"]]["rounds"]
        assert list(kill["samples"].values()) == rounds[: len(kill["samples"])]


def test_the_page_says_how_often_the_true_rival_is_found_with_much_noise():
    found = json.loads((FOLDER / "structure_noisy.json").read_text())
    designed = found["designed"].values()
    table = PAGE[PAGE.index("| designed after every round") :].partition("\n\n")[0]
    lines = {line.split("|")[1].strip(): line for line in table.splitlines()}
    wrong, undecided = (sum(row[of] for row in designed) for of in ("decided_wrong", "undecided"))
    assert (wrong, undecided) == (2, 8)
    assert found["designed"]["aero2"]["decided_wrong"] == 0
    told = PAGE[PAGE.index("Of 800 designed campaigns") :].partition("\n\n")[0].replace("\n", " ")
    assert f"{wrong} chose a wrong rival" in told
    assert f"{undecided} had chosen none. In {found['designed']['aero2']['undecided']} of" in told
    for count in ("20", "40", "60", "80"):
        least = min(row["right_after"][count] for row in designed)
        assert f"| {least:.3g} |" in lines["designed after every round"]
    for name, rows in found["fixed"].items():
        shown = [float(cell) for cell in lines[name].split("|")[2:-1]]
        lengths = ("20", "40", "60", "80", "120", "160", "200")
        assert shown == [min(row[n] for row in rows.values()) for n in lengths]
    assert max(row["largest_nearness"] for row in designed) < 1


@pytest.mark.parametrize(
    "name",
    ["compare", "compare_emps", "compare_dc_motor", "compare_cart_pole", "compare_cart_pole_2"],
)
def test_the_page_compares_campaigns_with_other_methods(name):
    found = json.loads((FOLDER / f"{name}.json").read_text())
    plant = name.partition("_")[2].removesuffix("_2")
    is_named = plant in ("dc_motor", "cart_pole")
    for method, row in found["rows"].items():
        cells = []
        for target in (key for key in row if key.startswith("0.")):
            own = row[target]
            shown = [f"{own[q]:.0f}" if own[q] else "–" for q in ("median", "90 %", "all")]
            cells.append(", ".join([*shown, str(own["missed"])]))
        if plant:
            cells.append(f"{row['violations']}, {row['largest']:.3f}")
        whole = f"| {method}{f', {plant}' * is_named} | {' | '.join(cells)} |"
        assert whole in PAGE.splitlines()
    assert found["policy_hash"] == read_policy(f"{plant or 'aero2'}-wide").hash
    assert name == "compare_emps" or not any(row["violations"] for row in found["rows"].values())


def test_intervals_hold_where_a_round_ends_by_its_own_estimate():
    found = json.loads((FOLDER / "coverage.json").read_text())
    shown = [f"{value:.1f}" for value in found["coverage_percent"].values()]
    assert re.search(rf"{shown[0]}, {shown[1]} and {shown[2]} %", PAGE)
    assert all(93 <= value <= 97 for value in found["coverage_percent"].values())
