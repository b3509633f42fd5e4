"""The rows of the paper's baselines, and how near estimates come to the attainable bound."""

import math
from typing import Any

import pytest
from experiments import ROOT

from excite.study.methods import method_rows
from excite.study.spec import Study, read_study

PARAMETERS = ("J_p", "K_pu", "D_p")


@pytest.fixture(scope="module")
def baselines() -> tuple[Study, dict[tuple[str, str], dict[str, Any]]]:
    study = read_study(ROOT / "studies" / "baselines.toml")
    study = study.changed(estimators="arx-rls,nls", episodes=200)
    return study, {(r.method, r.estimator): r.data() for r in method_rows(study)}


@pytest.mark.parametrize("method", ["random", "prbs", "chirp"])
def test_the_papers_rows_are_reproduced(method, baselines):
    study, table = baselines
    row, published = table[method, "arx-rls"], study.reference[method]
    assert row["failed"] == 0
    for name in ("K_pu", "D_p"):
        mean, _ = published.relative_error_percent[name]
        assert row["relative_error_percent"][name]["mean"] == pytest.approx(mean, rel=0.25)
    factor = (
        row["relative_error_percent"]["J_p"]["mean"] / published.relative_error_percent["J_p"][0]
    )
    assert 0.5 < factor < 2
    assert row["max_abs_output"]["mean"] == pytest.approx(published.max_abs_output[0], abs=1.5)
    low, high = row["violation_rate"]["ci95"]
    violations, count = map(int, published.violations.split("/"))
    assert low <= violations / count <= high


@pytest.mark.parametrize("method", ["random", "prbs", "chirp"])
def test_nonlinear_least_squares_reaches_the_bound(method, baselines):
    row = baselines[1][method, "nls"]
    assert row["failed"] == 0
    assert row["beyond_6_std_errors"] == 0
    for name in PARAMETERS:
        assert 0.85 < row["rms_over_cramer_rao"][name] < 1.15
        assert 90 <= row["coverage95_percent"][name] <= 99
        # Of a normal error with the bound's standard deviation, the mean magnitude.
        attainable = math.sqrt(2 / math.pi) * row["cramer_rao_percent"][name]
        assert row["relative_error_percent"][name]["mean"] == pytest.approx(attainable, rel=0.2)


def test_a_signal_that_tells_more_has_the_smaller_bound(baselines):
    table = baselines[1]
    for name in PARAMETERS:
        bounds = [table[m, "nls"]["cramer_rao_percent"][name] for m in ("random", "prbs", "chirp")]
        assert bounds == sorted(bounds, reverse=True)
        assert bounds == [
            table[m, "arx-rls"]["cramer_rao_percent"][name] for m in ("random", "prbs", "chirp")
        ]
