"""Intervals of short records, of coloured noise and of uncertain constants."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from test_identification import Tank, tank_record

from excite.estimation import ARX, NLS
from excite.estimation.contract import Estimate, stack_experiments
from excite.estimation.diagnosis import half_95, input_dependence, ljung_box, student_95
from excite.estimation.identify import identify
from excite.plant import Aero2
from excite.record import Record
from excite.simulation import response, simulate

FLOW = np.array([[0.8], [0.8], [0.8], [0.0], [0.0], [0.5], [0.5]])


def share_inside(estimate: Estimate, truth: np.ndarray) -> np.ndarray:
    """Share of many estimates whose 95 % interval contains the truth, by parameter."""
    pairs = zip(estimate.covariance, np.asarray(estimate.degrees), strict=True)
    half = np.array([half_95(np.asarray(covariance), degrees) for covariance, degrees in pairs])
    return np.mean(np.abs(np.stack(estimate.params, axis=1) - truth[None]) < half, axis=0)


def short_tank_records(count: int, noise: float, seed: int = 0) -> np.ndarray:
    """Levels of a tank at eight instants."""
    plant = Tank()
    level = np.asarray(response(plant, plant.Params(jnp.array(1.8), jnp.array(0.4)), FLOW))
    return level + noise * np.random.default_rng(seed).normal(size=(count, *level.shape))


def first_rows(record: Record, count: int) -> Record:
    """The first rows of a record."""
    return dataclasses.replace(
        record,
        time=record.time[:count],
        inputs=record.inputs[:count],
        outputs=record.outputs[:count],
        source="short.csv",
    )


# Few samples


@pytest.mark.parametrize("degrees", [1, 1.5, 3, 5, 12, 100, 1e4])
def test_students_quantile_is_scipys(degrees):
    expected = scipy.stats.t.ppf(0.975, degrees)
    assert student_95(degrees) == pytest.approx(expected, rel=1e-9)


def test_students_quantile_of_a_known_noise_is_196():
    assert student_95(np.inf) == pytest.approx(scipy.stats.norm.ppf(0.975), rel=1e-6)
    assert student_95(1e7) == student_95(np.inf)


def test_degrees_of_freedom_are_values_less_unknowns():
    values = short_tank_records(1, 0.01)[0]
    known, free = (
        stack_experiments(Tank(), [FLOW], [values], is_known) for is_known in (True, False)
    )
    np.testing.assert_allclose(NLS()(Tank(), known).degrees, 8 - 2)
    np.testing.assert_allclose(NLS()(Tank(), free).degrees, 8 - 3)
    assert np.all(np.isinf(NLS(noise="known")(Tank(), known).degrees))


def test_six_samples_are_enough_for_two_unknowns():
    record = first_rows(tank_record(1.8), 6)
    result = identify(record, Tank())
    assert result.status == "successful"
    half = scipy.stats.t.ppf(0.975, 4) * result.std_error["leak"]
    low, high = result.ci95("leak")
    assert high - low == pytest.approx(2 * half, rel=1e-9)
    assert result.to_dict()["params"]["leak"]["ci95"] == (low, high)  # pyright: ignore
    assert f"{result.to_pandas().ci95_low['leak']:.12g}" == f"{low:.12g}"
    assert np.isnan(result.whiteness["level_m"])
    assert "too short to be tested" in str(result)
    result.plot()


def test_as_many_samples_as_unknowns_are_refused():
    record = dataclasses.replace(first_rows(tank_record(1.8), 3), metadata={})
    words = (
        r"short\.csv: 3 measured values for 3 unknowns \(2 parameters, 1 initial states\); more "
        "values than unknowns are needed"
    )
    with pytest.raises(ValueError, match=words):
        identify(record, Tank())
    assert identify(record, Tank(), hold={"area": 1.8}).is_usable
    hollow = dataclasses.replace(record, outputs=np.array([[1.0], [np.nan], [np.nan]]))
    with pytest.raises(ValueError, match=r"short\.csv: 1 measured values for 1 unknowns"):
        identify(tank_record(1.8), Tank(), validate=hollow)
    with pytest.raises(ValueError, match="at least two samples"):
        identify(first_rows(record, 1), Tank())


def test_other_estimators_say_that_a_short_record_failed():
    record = first_rows(simulate("aero2", "prbs", steps=20), 6)
    result = identify(record, Aero2(), ARX())
    assert result.is_usable or result.verdict


@pytest.mark.parametrize("count", [2, 5, 9, 11, 21])
def test_residuals_of_a_few_samples_are_no_alarm(count):
    rng = np.random.default_rng(count)
    residual, inputs = rng.normal(size=count), rng.normal(size=(count, 1))
    assert not ljung_box(residual) < 0.001
    assert not input_dependence([residual], [inputs]) < 0.001
    assert np.isnan(input_dependence([residual], [inputs[:, :0]]))


@pytest.mark.science
@pytest.mark.parametrize("is_known", [True, False], ids=["known", "free"])
def test_intervals_of_eight_samples_hold_in_95_percent(is_known):
    plant, values = Tank(), short_tank_records(1000, noise=0.02)

    def fit(level: jax.Array) -> Estimate:
        return NLS()(plant, stack_experiments(plant, [FLOW], [level], is_known))

    found = jax.device_get(jax.jit(jax.vmap(fit))(values))
    assert np.all(found.status == 0)
    inside = share_inside(found, np.array([1.8, 0.4]))
    assert np.all((inside > 0.93) & (inside < 0.97)), inside
    residual = found.residual[:, 0, :, 0]
    assert not any(ljung_box(r) < 0.01 for r in residual)
    assert not any(input_dependence([r], [FLOW]) < 0.01 for r in residual)
