"""Committed results are what README and documentation say of them; nothing is computed anew."""

import itertools
import json
import math
import re
import runpy
import tomllib
from typing import Any

import pytest
from experiments import ROOT

from excite.policy import read_policy, shipped_policies
from excite.study.table import finished_table

RESULTS = ROOT / "results"
PROMISED = ("aero2", "aero2-ideal", "aero2-goals", "aero2-damping")
"""Policies of which 10,000 experiments are promised."""


@pytest.mark.parametrize(
    "path", sorted(p.relative_to(ROOT).as_posix() for p in RESULTS.rglob("*.py"))
)
def test_a_command_that_makes_results_can_be_imported(path, monkeypatch):
    monkeypatch.syspath_prepend(str((ROOT / path).parent))
    runpy.run_path(str(ROOT / path), run_name="imported")


def test_the_committed_efficiency_is_near_the_best_that_could_be_had():
    table = json.loads((RESULTS / "frontier" / "table.json").read_text())
    row = next(r for r in table["rows"] if r["method"] == "gradient D")
    assert row["d_efficiency"] >= 0.74
    best = next(r for r in table["rows"] if r["method"] == "clairvoyant")
    assert best["evaluations"] >= 32
    assert best["violations"] == 0
    gap = row["log_det_of_clairvoyant_plants"] - best["log_det_information"]
    assert row["d_efficiency"] == pytest.approx(math.exp(gap / 3))


@pytest.mark.parametrize("name", shipped_policies())
def test_every_shipped_policy_was_evaluated_as_it_is(name):
    seen = json.loads((RESULTS / "policies" / f"{name}.json").read_text())
    assert seen["policy_hash"] == read_policy(shipped_policies()[name]).hash
    is_wide = name.endswith("-wide")
    factor = "factor:3" if name == "aero2-wide" else "factor:2"
    assert seen["study"]["spread"] == (factor if is_wide else 0.3)
    assert seen["study"].get("coast", 0) == (50 if is_wide else 0)
    for row in seen["rows"]:
        # Near chaos nonlinear least squares take about a second an experiment.
        least = {"cart_pole": 200, "cart_pole-wide": 200, **dict.fromkeys(PROMISED, 10_000)}
        assert row["evaluations"] >= least.get(name, 1000)
        assert row["violations"] == 0


@pytest.mark.parametrize("name", shipped_policies())
def test_the_page_on_safety_says_of_each_policy_what_its_certificate_says(name):
    page = (ROOT / "docs" / "how-to" / "check-safety.md").read_text().splitlines()
    (line,) = (line for line in page if line.startswith(f"| `{name}`"))
    shown = [cell.strip() for cell in line.split("|")[2:-1]]
    seen = json.loads((RESULTS / "policies" / f"{name}.json").read_text())["rows"][-1]
    assert seen["estimator"] == "nls"
    if seen["log_det_information"] is not None:
        assert is_rounded(shown[0], seen["log_det_information"])
    assert shown[1].replace(",", "") == f"{seen['violations']}/{seen['evaluations']}"
    certificate = read_policy(shipped_policies()[name]).certificate
    assert certificate is not None
    found = [certificate["nearness"], certificate["noise_nearness"]]
    assert all(map(is_rounded, shown[-2:], found))
    assert certificate["noise_bound"] == 3
    assert certificate["experiments"] >= 8000
    assert "initial_pitch" in certificate["uncertainty"] or "aero2" not in name
    if name == "aero2-ideal":  # the comparison: not for plants that differ
        assert certificate["violations"] > 0
    else:
        assert max(found) < 1
        assert certificate["violations"] == 0


def committed(study: str) -> dict[tuple[str, str], Any]:
    rows = json.loads((RESULTS / study / "table.json").read_text())["rows"]
    return {(row["method"], row["estimator"]): row for row in rows}


def test_no_policy_but_that_for_the_ideal_plant_violated_on_random_plants():
    text = (RESULTS / "policies" / "random_plants.txt").read_text()
    found = re.findall(r"^([\w-]+), [^:]*: (\d+) violations in 100,000 ", text, re.M)
    assert {name for name, _ in found} == {*shipped_policies()}
    assert [pair for pair in found if pair[1] != "0"] == [("aero2-ideal", "96")]


def test_half_the_samples_of_the_tuned_chirp_are_enough():
    half, frontier = committed("half"), committed("frontier")
    assert json.loads((RESULTS / "half" / "study.json").read_text())["num_steps"] == 250
    row, chirp = half["gradient D", "nls"], frontier["chirp tuned", "nls"]
    assert row["cramer_rao_percent"]["D_p"] <= chirp["cramer_rao_percent"]["D_p"]
    assert max(error["mean"] for error in row["relative_error_percent"].values()) <= 0.1
    assert row["violations"] == 0


@pytest.mark.parametrize(
    ("study", "more"),
    [("frontier", 1.0), ("cart_pole", 1.0), ("dc_motor", -0.05), ("emps", -0.05),
     ("aero2_lag", -0.05), ("sim_to_real", -0.05)],
)  # fmt: skip
def test_every_plant_has_a_policy_that_informs_better_than_tuned_signals(study, more):
    rows = [row for row in committed(study).values() if row["estimator"] == "nls"]
    policy = next(r for r in rows if r["method"] in ("gradient D", "gradient robust"))
    classical = [
        row["log_det_information"] for row in rows
        if row["method"].endswith("tuned") and row["violations"] <= policy["violations"]
    ]  # fmt: skip
    assert classical
    assert policy["log_det_information"] >= max(classical) + more
    assert policy["failed"] <= 0.01 * policy["evaluations"]


def test_the_rig_is_safe_without_a_filter_and_with_one():
    seen = json.loads((RESULTS / "policies" / "aero2_detailed_rig.json").read_text())
    assert seen["policy_hash"] == read_policy(shipped_policies()["aero2_detailed"]).hash
    row = seen["rows"][0]
    assert row["evaluations"] == 10_000
    assert row["violations"] <= 10
    assert row["on_rig"]["filtered_violations"] == 0


def test_the_table_of_the_results_page_holds_the_committed_results():
    rows = json.loads((ROOT / "results" / "table1" / "table.json").read_text())["rows"]
    found = {(row["method"], row["estimator"]): row for row in rows}
    published = tomllib.loads((ROOT / "studies" / "table1.toml").read_text())["reference"]
    header, cells = finished_table(ROOT / "results" / "table1").cells()
    place = header.index("violations (95 %)")
    lines = [
        line.split("|")[1:-1]
        for line in (ROOT / "docs" / "explanation" / "results.md").read_text().splitlines()
        if line.count(" / ") == 6
    ]
    assert len(lines) == len(published) == 7
    for method, *errors, violations in ([cell.strip() for cell in line] for line in lines):
        key = method.replace("PRBS", "prbs")
        for parameter, cell in zip(("J_p", "K_pu", "D_p"), errors, strict=True):
            ours = [
                found[key, kind]["relative_error_percent"][parameter]["mean"]
                for kind in ("arx-rls", "nls")
            ]
            paper = published[key]["relative_error_percent"][parameter][0]
            assert [float(x) for x in cell.split("/")] == pytest.approx([paper, *ours], rel=0.03)
        (cell,) = (row[place] for row in cells if row[:2] == [key, "arx-rls"])
        paper, _, ours = violations.partition(", ours ")
        assert paper == published[key]["violations"]
        assert ours
        assert cell.startswith(ours)


def is_rounded(shown: str, value: float) -> bool:
    half_a_digit = 0.5 * 10.0 ** -len(shown.partition(".")[2])
    return abs(float(shown) - value) <= half_a_digit * (1 + 1e-9)


def test_the_tutorial_on_table_1_holds_the_committed_results():
    page = (ROOT / "docs" / "tutorials" / "table-1.md").read_text()
    shown = [re.findall(r"([\d.]+) ± ([\d.]+) \|", line) for line in page.splitlines()]
    for study in ("baselines", "table1"):
        for (method, estimator), row in committed(study).items():
            errors = row["relative_error_percent"].values()
            numbers = [number for error in errors for number in (error["mean"], error["sd"])]
            assert estimator != "arx-rls" or any(
                all(map(is_rounded, itertools.chain(*line), numbers))
                for line in shown
                if len(line) == 3
            ), f"{method}: {numbers}"


def test_the_page_on_the_damping_error_holds_the_committed_results():
    page = (ROOT / "docs" / "explanation" / "damping-error.md").read_text().splitlines()
    header = next(line for line in page if line.startswith("| signal | sensor noise"))
    starts = [cell.split("=")[1].strip() for cell in header.split("|") if "P_0" in cell]
    noise = {
        "none": "damping_noise_free",
        "0.0002 rad": "damping",
        "0.00063 rad": "damping_encoder",
    }
    method, checked = "", 0
    for line in page:
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if len(cells) < 3 or cells[1] not in noise:
            continue
        method = cells[0].lower() or method
        rows = json.loads((ROOT / "results" / noise[cells[1]] / "table.json").read_text())["rows"]
        found = {row["estimator"]: row for row in rows if row["method"] == method}
        for start, shown in zip(starts, cells[2:], strict=False):
            mean = found[f"P0 = {start}"]["relative_error_percent"]["D_p"]["mean"]
            assert float(shown) == pytest.approx(mean, rel=6e-3)
            checked += 1
        bound = found[f"P0 = {starts[0]}"]["cramer_rao_percent"]["D_p"]
        assert float(cells[-1]) == pytest.approx(bound, rel=0.06, abs=1e-5)
    assert checked == 9 * len(starts)
