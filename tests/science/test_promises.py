"""What is said of the shipped policies, on fresh plants."""

from typing import Any

import pytest
from compiled import optimised

from excite.study.methods import method_rows
from excite.study.spec import study_from

POLICIES = ("aero2", "aero2-goals", "aero2-damping")


@pytest.fixture(scope="module")
@optimised()
def rows() -> dict[tuple[str, str], Any]:
    """By method and estimator, on 1000 plants that nothing was trained or chosen on."""
    study = study_from(
        {
            "name": "promises",
            "plant": "aero2",
            "episodes": 1000,
            "num_steps": 500,
            "seed": 2026,
            "spread": 0.3,
            "sensor": {"pitch": {"noise_sd": 0.0002}},
            "methods": {name: {"excitation": name} for name in ("chirp", *POLICIES)}
            | {"chirp": {"excitation": "chirp", "amplitude": 7.2}},
            "estimators": {kind: {"kind": kind} for kind in ("arx-rls", "nls")},
        },
        "promises",
    )
    return {(row.method, row.estimator): row.data() for row in method_rows(study)}


def mean_errors(row: dict[str, Any]) -> dict[str, float]:
    return {name: error["mean"] for name, error in row["relative_error_percent"].items()}


@pytest.mark.parametrize("name", POLICIES)
def test_no_policy_breaks_the_critical_level_or_an_estimator(name, rows):
    for estimator in ("arx-rls", "nls"):
        row = rows[name, estimator]
        assert (row["evaluations"], row["violations"], row["failed"]) == (1000, 0, 0)


def test_the_default_policy_informs_far_better_than_a_chirp(rows):
    gain = rows["aero2", "nls"]["log_det_information"] - rows["chirp", "nls"]["log_det_information"]
    assert gain >= 5.4
    assert max(mean_errors(rows["aero2", "nls"]).values()) <= 0.1


def test_one_policy_serves_the_estimator_of_the_paper_for_all_parameters(rows):
    errors = mean_errors(rows["aero2-goals", "arx-rls"])
    assert errors["J_p"] <= 0.5
    assert errors["K_pu"] <= 0.25
    assert errors["D_p"] <= 130
    assert mean_errors(rows["aero2-damping", "arx-rls"])["D_p"] <= 75
