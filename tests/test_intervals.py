"""Intervals of short records, of coloured noise and of uncertain constants."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from commands import excite
from experiments import autoregressive, record_of
from test_identification import Tank, tank_record

from excite.description import Constant, Input, Output, Parameter, PlantDescription, State
from excite.estimation import ARX, NLS
from excite.estimation.contract import Estimate, Experiments, stack_experiments
from excite.estimation.diagnosis import (
    effect_of_constants,
    half_95,
    input_dependence,
    ljung_box,
    robust_covariance,
    student_95,
    with_independent,
)
from excite.estimation.identify import identify
from excite.excitation import PRBS, Chirp
from excite.plant import AbstractPlant, Aero2, DCMotor
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
    plant, flow = Tank(), jnp.asarray(FLOW)
    level = np.asarray(response(plant, plant.Params(jnp.array(1.8), jnp.array(0.4)), flow))
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


@pytest.mark.science
def test_degrees_of_freedom_are_values_less_unknowns():
    values = short_tank_records(1, 0.01)[0]
    known, free = (
        stack_experiments(Tank(), [FLOW], [values], is_known) for is_known in (True, False)
    )
    for estimator, data, degrees in (
        (NLS(), known, 8 - 2), (NLS(), free, 8 - 3), (NLS(noise="known"), known, np.inf)
    ):  # fmt: skip
        np.testing.assert_allclose(np.asarray(estimator(Tank(), data).degrees), degrees)


@pytest.mark.slow
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


@pytest.mark.science
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


# Coloured noise

SLOW = Tank().changed(dt=0.05)


@pytest.mark.science
@pytest.mark.parametrize("rho", [0.5, 0.9])
@pytest.mark.parametrize("plant", [Aero2(), DCMotor(), SLOW], ids=["aero2", "dc_motor", "slow"])
def test_intervals_hold_in_noise_that_remembers(plant, rho):
    """Over 1000 records; the estimate is linear in such noise, so its sensitivities are enough."""
    excitation = PRBS(clock=20) if plant is SLOW else Chirp()
    record = record_of(plant, excitation, num_steps=500)
    experiments = stack_experiments(plant, [record.inputs[:-1]], [record.outputs], True)
    estimate = NLS()(plant, experiments)
    S = np.asarray(NLS().sensitivity(plant, experiments, estimate)[0])
    columns, valid = S.reshape(-1, S.shape[-1]), np.ones(S.shape[:3], bool)
    inverse, inside = np.linalg.pinv(columns), []
    shape = 1000, S.shape[2], S.shape[1]
    for noise in autoregressive(np.random.default_rng(1), shape, rho).swapaxes(1, 2):
        error = inverse @ noise.ravel()
        residual = (noise.ravel() - columns @ error).reshape(valid.shape)
        assert min(ljung_box(r) for r in residual[0].T) < 0.01
        covariance, degrees = robust_covariance(S, residual, valid)
        inside.append(np.abs(error) < half_95(covariance, degrees))
    share = np.mean(inside, axis=0)
    assert np.all((share > 0.93) & (share < 0.97)), share


@pytest.mark.science
@pytest.mark.parametrize("rho", [0.5, 0.9])
def test_intervals_of_refitted_records_hold_in_noise_that_remembers(rho):
    """As above, with the whole estimator on 300 records."""
    plant = SLOW
    record = record_of(plant, PRBS(clock=20), num_steps=500)
    clean = np.asarray(response(plant, plant.nominal, jnp.asarray(record.inputs[:-1])))
    noise = 0.01 * autoregressive(np.random.default_rng(2), (300, 501), rho)[..., None]
    free = jnp.ones(2, bool)

    def fit(outputs: jax.Array) -> tuple[Estimate, tuple[jax.Array, jax.Array]]:
        experiments = stack_experiments(plant, [record.inputs[:-1]], [outputs], True)
        estimate = NLS()(plant, experiments)
        return estimate, NLS().sensitivity(plant, experiments, estimate, free)

    found, (S, residual) = jax.device_get(jax.jit(jax.vmap(fit))(clean + noise))
    valid = np.ones(residual[0].shape, bool)
    half = np.array(
        [half_95(*robust_covariance(s, r, valid)) for s, r in zip(S, residual, strict=True)]
    )
    values, truth = np.stack(found.params, axis=1), np.array(plant.nominal)
    share = np.mean(np.abs(values - truth[None]) < half * values, axis=0)
    assert np.all((share > 0.91) & (share < 0.985)), share


@pytest.mark.science
def test_noise_that_remembers_has_fewer_degrees_of_freedom():
    record = record_of(SLOW, PRBS(clock=20), num_steps=500)
    usual = identify(record, SLOW)
    noise = 0.01 * autoregressive(np.random.default_rng(3), (1, 501), 0.9).T
    result = identify(dataclasses.replace(record, outputs=record.outputs + noise), SLOW)
    for name in ("area", "leak"):
        factors = [(r.ci95(name)[1] - r.params[name]) / r.std_error[name] for r in (usual, result)]
        assert factors[0] == pytest.approx(student_95(501 - 2), rel=1e-9)
        assert 2.0 < factors[1] < 2.6


# Uncertain constants


class Heater(AbstractPlant):
    """A mass that is heated; data tell only its heat capacity times its mass."""

    definition = PlantDescription(
        name="heater",
        states=(State("temperature", "K", scale=10.0),),
        inputs=(Input("power", "W", 0.0, 100.0),),
        outputs=(Output("temperature_k", "K", 20.0, noise_sd=0.05),),
        parameters=(Parameter("c", "J/(kg K)", 400.0), Parameter("loss", "W/K", 2.0)),
        constants=(Constant("mass", "kg", 0.5), Constant("gain", "", 1.0)),
        dt=5.0,
    )

    def derivative(self, state, input, params):
        k = self.constants
        return (k.gain * input - params.loss * state) / (params.c * k.mass)

    def output(self, state, params):
        return state


@pytest.mark.science
def test_the_effect_of_a_constant_is_that_of_another_fit():
    record = record_of(Heater(), num_steps=60)
    result = identify(record, Heater(), uncertain={"mass": "5%", "gain": 0.02})
    usual = identify(record, Heater())
    other = {
        "mass": identify(record, Heater(mass=0.501)), "gain": identify(record, Heater(gain=1.002))
    }  # fmt: skip
    for name in ("c", "loss"):
        per_sd = (
            (other["mass"].params[name] - usual.params[name]) / 0.001 * 0.025,
            (other["gain"].params[name] - usual.params[name]) / 0.002 * 0.02,
        )
        expected = np.sqrt(usual.std_error[name] ** 2 + np.sum(np.square(per_sd)))
        assert result.std_error[name] == pytest.approx(expected, rel=0.01)
        assert result.params[name] == usual.params[name]
    assert result.std_error["c"] > 10 * usual.std_error["c"]
    told = "the intervals include the standard deviation of mass (0.025 kg), gain (0.02)"
    assert told in result.verdict


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"mas": 0.1}, "unknown heater constant 'mas'; did you mean 'mass'"),
        ({"mass": -0.1}, "standard deviation of 'mass' must be above 0: got -0.1"),
        ({"mass": float("nan")}, "must be above 0: got nan"),
        ({"mass": "0%"}, "must be above 0: got 0%"),
        ({"mass": "much"}, "uncertain 'mass' must be a number or 5%: got 'much'"),
    ],
)
def test_an_uncertainty_that_makes_no_sense_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        identify(record_of(Heater(), num_steps=60), Heater(), uncertain=given)


def test_uncertain_constants_need_nls():
    with pytest.raises(ValueError, match="uncertain constants need the estimator nls"):
        identify(simulate("aero2", steps=60), estimator="arx-rls", uncertain={"m": "5%"})


@pytest.mark.science
def test_the_command_line_takes_uncertain_constants(tmp_path):
    simulate("aero2", steps=60).save(tmp_path / "r.csv")
    done = excite("identify", "r.csv", "--uncertain", "m=5%,g=0.01", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "include the standard deviation of m (0.0535 kg), g (0.01 m/s²)" in done.stdout
    refused = excite("identify", "r.csv", "--uncertain", "m=x", cwd=tmp_path)
    assert refused.returncode == 2


@pytest.mark.science
def test_intervals_hold_where_a_constant_is_uncertain():
    plant, sd = Heater(), np.array([0.025, 0.02])
    record = record_of(plant, num_steps=60)
    inputs, rng = jnp.asarray(record.inputs[:-1]), np.random.default_rng(4)
    constants = np.array([0.5, 1.0]) + sd * rng.normal(size=(1000, 2))
    noise = 0.05 * rng.normal(size=(1000, 61, 1))

    def fit(true: jax.Array, noise: jax.Array) -> tuple[Estimate, jax.Array, jax.Array]:
        real = plant.changed(mass=true[0], gain=true[1])
        outputs = response(real, plant.nominal, inputs) + noise
        experiments: Experiments = stack_experiments(plant, [inputs], [outputs], True)
        estimate = NLS()(plant, experiments)
        S, _ = NLS().sensitivity(plant, experiments, estimate, jnp.ones(2, bool))
        return estimate, S, NLS().constant_sensitivity(plant, experiments, estimate)

    found, S, to_constants = jax.device_get(jax.jit(jax.vmap(fit))(constants, noise))
    values, inside = np.stack(found.params, axis=1), []
    for i, value in enumerate(values):
        effect = value[:, None] * effect_of_constants(S[i], to_constants[i]) * sd
        total = with_independent(found.covariance[i], found.degrees[i], effect @ effect.T)
        inside.append(np.abs(value - np.array(plant.nominal)) < half_95(*total))
    share = np.mean(inside, axis=0)
    assert np.all((share > 0.93) & (share < 0.97)), share
