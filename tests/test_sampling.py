"""Records as they are sampled: uneven times, gaps, missing outputs, held or linear inputs."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from catalogue import LONG
from experiments import spread_params

import excite as ex
from excite.estimation import ARX, NLS
from excite.estimation.contract import stack_experiments
from excite.estimation.identify import identify
from excite.plant import Aero2, DCMotor
from excite.record import Record
from excite.simulation import response

PLANT = Aero2()
TRUE = spread_params(PLANT)
NUM_SAMPLES = 201
EVEN = 0.1 * np.arange(NUM_SAMPLES)
UNEVEN = np.cumsum(np.random.default_rng(1).uniform(0.02, 0.25, NUM_SAMPLES))


def solved(time: np.ndarray, linear: bool = False, noise: float = 0.0) -> Record:
    """The plant from rest by SciPy, with the input held or linear between samples."""
    voltage = 7.0 * np.sin(0.25 * (time - time[0]) ** 1.4)
    J_p, K_pu, D_p = map(float, TRUE)
    stiffness = 1.07 * 9.81 * 0.0019435

    def rate(t: float, x: np.ndarray, k: int) -> list[float]:
        part = (t - time[k]) / (time[k + 1] - time[k]) if linear else 0.0
        u = voltage[k] + part * (voltage[k + 1] - voltage[k])
        return [x[1], 2 * K_pu * u - (D_p * x[1] + stiffness * np.sin(x[0])) / J_p]

    state, pitch = np.zeros(2), [0.0]
    for k in range(len(time) - 1):
        end = scipy.integrate.solve_ivp(
            rate, time[k : k + 2], state, args=(k,), rtol=1e-9, atol=1e-12
        )
        state = end.y[:, -1]
        pitch.append(state[0])
    measured = np.array(pitch) + noise * np.random.default_rng(2).normal(size=len(time))
    return Record(time, voltage, measured, {"starts_at_initial_state": True}, "r.csv")


def rows(record: Record, chosen: slice | np.ndarray) -> Record:
    """Some rows of a record."""
    return Record(
        record.time[chosen], record.inputs[chosen], record.outputs[chosen], {}, record.source
    )


def without(record: Record, missing: np.ndarray) -> Record:
    """A record without some of its measurements."""
    outputs = np.where(missing, np.nan, record.outputs)
    return Record(record.time, record.inputs, outputs, record.metadata, record.source)


@pytest.mark.science
@pytest.mark.parametrize("linear", [False, True], ids=["held", "linear"])
@pytest.mark.parametrize("time", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_the_plant_is_found_from_what_scipy_solved(time, linear):
    hold = "linear" if linear else "constant"
    found = identify(solved(time, linear), PLANT, hold_input=hold)
    np.testing.assert_allclose(list(found.params.values()), TRUE, rtol=3e-4)


@pytest.mark.slow
@pytest.mark.parametrize("linear", [LONG(False, id="held"), pytest.param(True, id="linear")])
def test_the_other_hold_is_named_where_it_fits_better(linear):
    right, wrong = ("linear", "constant") if linear else ("constant", "linear")
    record = solved(EVEN, linear, noise=1e-3)
    told = f"with voltage {right} between samples the sum of squared residuals would be"
    assert any(told in s for s in identify(record, PLANT, hold_input=wrong).verdict)
    assert not any(
        "between samples" in s for s in identify(record, PLANT, hold_input=right).verdict
    )


@pytest.mark.science
def test_a_gap_begins_a_new_part_of_the_record():
    record = solved(EVEN, noise=1e-3)
    parts = [rows(record, slice(0, 80)), rows(record, slice(95, NUM_SAMPLES))]
    with_gap = rows(record, np.r_[0:80, 95:NUM_SAMPLES])
    one, two = identify(with_gap, PLANT), identify(parts, PLANT)
    np.testing.assert_allclose(list(one.params.values()), list(two.params.values()), rtol=1e-6)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-3)
    assert one.fitted[0].simulated.shape == with_gap.outputs.shape


@pytest.mark.science
def test_records_of_different_sampling_times_are_fitted_together():
    slow = rows(solved(np.linspace(0.0, 40.0, NUM_SAMPLES)), slice(None))
    found = identify([solved(EVEN), slow], PLANT, validate=[solved(UNEVEN)])
    np.testing.assert_allclose(list(found.params.values()), TRUE, rtol=3e-4)
    assert found.validation[0].fit_percent["pitch"] > 99.9


@pytest.mark.parametrize("missing", ["some", "another rate"])
def test_missing_outputs_are_left_out_of_the_likelihood(missing):
    record, rng = solved(EVEN, noise=1e-3), np.random.default_rng(3)
    chosen = rng.random((NUM_SAMPLES, 1)) < 0.4
    if missing == "another rate":
        chosen = np.arange(NUM_SAMPLES)[:, None] % 5 != 0
    found = identify(without(record, chosen), PLANT, initial_state="known")
    plant, inputs = PLANT, jax.device_put(record.inputs[:-1])

    @jax.jit
    def residual(ratio):
        simulated = response(plant, plant.Params(*(ratio * np.array(TRUE))), inputs)
        return (simulated - record.outputs)[~chosen]

    slope: Any = jax.jit(jax.jacfwd(residual))
    best = scipy.optimize.least_squares(residual, np.ones(3), slope)
    np.testing.assert_allclose(list(found.params.values()), best.x * np.array(TRUE), rtol=1e-6)
    S, count = best.jac, np.sum(~chosen)
    variance = np.sum(best.fun**2) / (count - 3)
    sd = np.array(TRUE) * np.sqrt(np.diag(variance * np.linalg.inv(S.T @ S)))
    assert not np.isfinite(found.fitted[0].simulated[chosen]).any()
    if found.whiteness["pitch"] > 0.01:
        np.testing.assert_allclose(list(found.std_error.values()), sd, rtol=1e-3)


@pytest.mark.science
def test_an_output_may_be_measured_at_another_rate_than_the_others():
    plant = DCMotor()
    u = 5.0 * np.sign(np.sin(0.3 * np.arange(400.0)))[:, None]
    measured = np.array(response(plant, plant.nominal, jax.device_put(u[:-1])))
    measured += np.asarray(plant.sensor.sd) * np.random.default_rng(4).normal(size=measured.shape)
    seldom = measured.copy()
    seldom[np.arange(400) % 4 != 0, 0] = np.nan
    inputs = [u[:-1]]
    all_seen = NLS()(plant, stack_experiments(plant, inputs, [measured], True))
    some_seen = NLS()(
        plant, stack_experiments(plant, inputs, [seldom], True, seen=[np.isfinite(seldom)])
    )
    wider = np.diag(some_seen.information) / np.diag(all_seen.information)
    assert np.all(wider < 1 + 1e-3)
    assert np.all(wider > 0.25)
    away = np.subtract(some_seen.params, all_seen.params) / np.sqrt(np.diag(some_seen.covariance))
    assert np.all(np.abs(away) < 3)


@pytest.mark.parametrize(
    ("record", "hold", "words"),
    [
        (solved(UNEVEN), "constant", r"r\.csv is sampled unevenly .* arx-rls needs one sampling"),
        (without(solved(EVEN), EVEN[:, None] < 1.0), "constant", r"without a measurement"),
        (solved(EVEN), "linear", r"takes inputs as constant between samples; nls also as linear"),
        (
            [solved(EVEN), rows(solved(EVEN), slice(None, None, 2))], "constant",
            r"r\.csv is sampled every 0\.2 s and r\.csv every 0\.1 s; arx-rls needs one",
        ),
    ],
    ids=["uneven", "missing", "linear", "rates"],
)  # fmt: skip
def test_an_estimator_in_discrete_time_says_what_it_cannot_use(record, hold, words):
    with pytest.raises(ValueError, match=words):
        identify(record, PLANT, ARX(), hold_input=hold)


def test_the_hold_of_an_input_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match=r"'aero2' has no input 'volt' to hold; it has voltage"):
        identify(solved(EVEN), PLANT, hold_input={"volt": "linear"})


def test_an_input_that_is_recorded_late_is_told():
    record = ex.simulate("dc_motor", "prbs", seed=1)
    late = np.concatenate([np.repeat(record.inputs[:1], 3, axis=0), record.inputs[:-3]])
    told = "the delay of voltage is negative (-0.00"
    result = ex.identify(dataclasses.replace(record, inputs=late), "dc_motor+delay")
    assert told in " ".join(result.verdict)
    assert told not in " ".join(ex.identify(record, "dc_motor+delay").verdict)
