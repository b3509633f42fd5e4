"""Prediction error: the filter against a Kalman filter in NumPy, the estimates by Monte Carlo."""

import json
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from compiled import optimised
from experiments import record_of, spread_params

from excite.description import Input, Output, Parameter, PlantDescription, State
from excite.estimation import NLS, PEM, Estimate, Experiments, Status
from excite.estimation.identify import identify
from excite.estimation.kalman import innovations
from excite.estimation.result import Identification
from excite.excitation import PRBS
from excite.files import json_ready
from excite.plant import AbstractPlant, Aero2, DCMotor
from excite.record import Record
from excite.report.html import report_html
from excite.simulation import response, step


class Tank(AbstractPlant):
    """One tank: a linear plant of the first order."""

    definition = PlantDescription(
        name="tank",
        states=(State("level", "m", initial=1.0),),
        inputs=(Input("inflow", "m³/s", 0.0, 2.0),),
        outputs=(Output("level", "m", 1.0, noise_sd=0.02),),
        parameters=(Parameter("area", "m²", 2.0), Parameter("loss", "m²/s", 0.4)),
        dt=1.0,
        band=(0.01, 0.2),
    )

    def derivative(self, state, input, params):
        return (input - params.loss * state) / params.area

    def output(self, state, params):
        return state


class TwoTanks(AbstractPlant):
    """Two tanks in a row: linear, of two states and two outputs."""

    definition = PlantDescription(
        name="two_tanks",
        states=(State("upper", "m", initial=0.5), State("lower", "m", initial=0.2)),
        inputs=(Input("inflow", "m³/s", 0.0, 2.0),),
        outputs=(Output("sum", "m", 1.0, noise_sd=0.02), Output("lower", "m", 1.0, noise_sd=0.02)),
        parameters=(Parameter("a", "1/s", 0.3), Parameter("b", "1/s", 0.2)),
        dt=0.5,
        substeps=20,
        band=(0.01, 0.2),
    )

    def derivative(self, state, input, params):
        return jnp.stack(
            [input[0] - params.a * state[0], params.a * state[0] - params.b * state[1]]
        )

    def output(self, state, params):
        return jnp.stack([state[0] + state[1], state[1]])


# The filter


def discretised(F: np.ndarray, sigma: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """State transition and covariance of the process noise over h (Van Loan)."""
    n = len(F)
    block = np.block([[-F, np.diag(sigma**2)], [np.zeros((n, n)), F.T]])
    e = scipy.linalg.expm(block * h)
    return e[n:, n:].T, e[n:, n:].T @ e[:n, n:]


def log_likelihood(
    F: np.ndarray, B: np.ndarray, C: np.ndarray, sigma: np.ndarray, noise: np.ndarray,
    first: np.ndarray, u: np.ndarray, dt: np.ndarray, y: np.ndarray, linear: bool,
) -> float:  # fmt: skip
    """Log-likelihood by a Kalman filter in matrix form; NaN in y was not measured."""
    n, x, P, total = len(F), first, np.zeros_like(F), 0.0
    for k in range(len(y)):
        seen = np.isfinite(y[k])
        c, e = C[seen], (y[k] - C @ x)[seen]
        S = c @ P @ c.T + np.diag(noise[seen] ** 2)
        if seen.any():
            total -= 0.5 * (np.linalg.slogdet(2 * np.pi * S)[1] + e @ np.linalg.solve(S, e))
            K = P @ c.T @ np.linalg.inv(S)
            x, P = x + K @ e, P - K @ S @ K.T
        if k < len(y) - 1:
            A, Q = discretised(F, sigma, dt[k])
            slope = (u[k + 1] - u[k]) / dt[k] if linear else np.zeros_like(u[k])
            # State, input and its slope together have a linear homogeneous equation.
            m = B.shape[1]
            whole = np.zeros((n + 2 * m, n + 2 * m))
            whole[:n, :n], whole[:n, n : n + m] = F, B
            whole[n : n + m, n + m :] = np.eye(m)
            x = (scipy.linalg.expm(whole * dt[k]) @ np.concatenate([x, u[k], slope]))[:n]
            P = A @ P @ A.T + Q
    return total


@pytest.mark.parametrize("linear", [False, True], ids=["held", "linear"])
def test_the_likelihood_is_that_of_a_kalman_filter(linear):
    rng, plant, length = np.random.default_rng(0), TwoTanks(), 60
    dt = rng.uniform(0.1, 0.5, length)
    u, y = rng.uniform(0, 1, (length + 1, 1)), rng.normal(1, 0.3, (length + 1, 2))
    seen = rng.uniform(size=y.shape) < 0.7
    y[~seen] = np.nan
    sigma, noise, (a, b) = np.array([0.1, 0.03]), np.array([0.05, 0.02]), (0.3, 0.2)
    F, B, C = np.array([[-a, 0], [a, -b]]), np.array([[1.0], [0.0]]), np.array([[1.0, 1], [0, 1]])
    first = np.array([0.4, 0.3])
    expected = log_likelihood(F, B, C, sigma, noise, first, u, dt, y, linear)
    found = eqx.filter_jit(innovations)(
        plant, plant.nominal, jnp.asarray(sigma), jnp.asarray(noise), jnp.asarray(first),
        (jnp.asarray(u[:-1]), jnp.asarray(dt), jnp.asarray(u[1:]) if linear else None),
        jnp.asarray(np.where(seen, y, 1e6)), jnp.asarray(seen),
    )  # fmt: skip
    own = -float(found.cost) - 0.5 * np.log(2 * np.pi) * seen.sum()
    assert own == pytest.approx(expected, rel=1e-8)


# Estimates

TANK, MOTOR, AERO2 = Tank(), DCMotor(), Aero2()
FINE = 20
"""Steps of the simulated disturbance in one sampling time."""


def levels(plant: AbstractPlant, length: int, hold: int = 10, seed: int = 0) -> np.ndarray:
    """Inputs that jump between random levels."""
    lower, upper = map(np.asarray, plant.input_limits)
    amplitudes = [i.amplitude for i in plant.definition.inputs]
    unit = np.random.default_rng(seed).uniform(-1, 1, (-(-length // hold), len(lower)))
    return (lower + upper) / 2 + amplitudes * np.repeat(unit, hold, axis=0)[:length]


@eqx.filter_jit
def disturbed(
    plant: AbstractPlant,
    params: Any,
    sigma: jax.Array,
    inputs: jax.Array,
    keys: jax.Array,
) -> jax.Array:
    """Measured outputs of many records with process noise, by small steps (Euler-Maruyama)."""
    h = plant.dt / FINE

    def one(key: jax.Array) -> jax.Array:
        own, sensor = jax.random.split(key)
        noise = jax.random.normal(own, (len(inputs), FINE, len(sigma)), float)

        def advance(state: jax.Array, now: tuple) -> tuple[jax.Array, jax.Array]:
            input, kicks = now

            def small(x: jax.Array, kick: jax.Array) -> tuple[jax.Array, None]:
                return step(plant, x, input, params, h) + sigma * jnp.sqrt(h) * kick, None

            state, _ = jax.lax.scan(small, state, kicks)
            return state, plant.output(state, params)

        _, later = jax.lax.scan(advance, plant.initial_state, (inputs, noise))
        outputs = jnp.concatenate([plant.output(plant.initial_state, params)[None], later])
        noise_sd = plant.sensor.noise_sd[None]
        return outputs + noise_sd * jax.random.normal(sensor, outputs.shape, float)

    return jax.vmap(one)(keys)


def experiments_of(
    plant: AbstractPlant, inputs: jax.Array, measured: jax.Array, known: bool
) -> Experiments:
    """One record as experiments, also with traced measurements."""
    return Experiments(
        inputs=inputs[None],
        measured=measured[None],
        valid=jnp.ones_like(measured[None], bool),
        initial_state=plant.initial_state[None],
        initial_state_known=known,
    )


def fitted_to_many(
    plant: AbstractPlant, true: Any, sigma: list[float], count: int, known: bool, length: int = 300
) -> Estimate:
    """Estimates from many records with other noise."""
    inputs = jnp.asarray(levels(plant, length))
    keys = jax.random.split(jax.random.key(1), count)
    measured = disturbed(plant, true, jnp.asarray(sigma), inputs, keys)
    pem = PEM()

    @eqx.filter_jit
    def fit(plant: AbstractPlant, inputs: jax.Array, measured: jax.Array) -> Estimate:
        return jax.vmap(lambda y: pem(plant, experiments_of(plant, inputs, y, known)))(measured)

    return jax.device_get(fit(plant, inputs, measured))


def coverage(true: Any, found: Estimate) -> np.ndarray:
    """Percent of the 95 % intervals that contain the true value, by parameter."""
    values = np.stack(found.params, axis=1)
    sd = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    return 100 * np.mean(np.abs(values - np.array(true)) <= 1.96 * sd, axis=0)


DISTURBED = {
    "tank": (TANK, spread_params(TANK, 0.1), [0.05], False),
    # With more friction than usual; else a disturbance hides it.
    "dc_motor": (MOTOR, spread_params(MOTOR, 0.1)._replace(b=4e-4), [20.0, 1.0], True),
}
"""Plant, true parameters, process noise, and whether the initial state is known."""


@pytest.mark.science
@pytest.mark.parametrize("name", DISTURBED)
@optimised()
def test_the_intervals_of_disturbed_plants_hold_what_they_promise(name):
    plant, true, sigma, known = DISTURBED[name]
    found = fitted_to_many(plant, true, sigma, 300, known)
    assert np.all(found.status == Status.SUCCESSFUL)
    share = coverage(true, found)
    assert np.all(np.abs(share - 95) < 3.5), share
    assert found.prediction is not None
    noise = np.median(found.prediction.process_noise, axis=0)
    np.testing.assert_allclose(noise, sigma, rtol=0.15)


@pytest.mark.science
def test_without_disturbance_it_is_least_squares():
    record = record_of(AERO2, PRBS(), params=spread_params(AERO2))
    u, y = jnp.asarray(record.inputs[:-1]), jnp.asarray(record.outputs)
    e = experiments_of(AERO2, u, y, True)
    by_pem, by_nls = PEM()(AERO2, e), NLS()(AERO2, e)
    sd = np.sqrt(np.diagonal(by_nls.covariance))
    away = np.abs(np.array(by_pem.params) - np.array(by_nls.params)) / sd
    assert by_pem.status == Status.SUCCESSFUL
    assert np.all(away < 0.1), away
    np.testing.assert_allclose(np.sqrt(np.diagonal(by_pem.covariance)), sd, rtol=0.1)


@pytest.mark.slow
def test_data_without_any_noise_give_the_true_parameters():
    true = spread_params(TANK)
    u = jnp.asarray(levels(TANK, 200))
    found = PEM()(TANK, experiments_of(TANK, u, response(TANK, true, u), True))
    assert found.status == Status.SUCCESSFUL
    np.testing.assert_allclose(found.params, true, rtol=1e-6)


# Identification

TRUE = spread_params(TANK, 0.1)


def tank_record(seed: int, length: int = 300, name: str = "r.csv") -> Record:
    """A disturbed record from elsewhere: nothing tells how it began."""
    inputs = levels(TANK, length, seed=seed)
    keys = jax.random.key(seed)[None]
    measured = disturbed(TANK, TRUE, jnp.array([0.05]), jnp.asarray(inputs), keys)[0]
    return Record.of_episode(np.arange(length + 1.0), inputs, np.array(measured), {}, name)


@cache
def identified() -> Identification:
    """A disturbed tank with a held-out record."""
    return identify(tank_record(1), TANK, PEM(), validate=tank_record(2, name="v.csv"))


@pytest.mark.science
def test_the_errors_of_the_prediction_are_white_and_those_of_the_simulation_larger():
    result = identified()
    assert result.status == "successful"
    (fitted,) = result.fitted
    assert fitted.predicted is not None
    assert result.whiteness["level"] > 0.01
    assert fitted.predicted.fit_percent["level"] > fitted.fit_percent["level"]
    np.testing.assert_array_equal(fitted.model, fitted.predicted.outputs)
    assert result.noise is not None
    assert result.noise.process["level"] == pytest.approx(0.05, rel=0.3)
    assert result.noise.measurement["level"] == pytest.approx(0.02, rel=0.5)
    for name, true in zip(result.params, TRUE, strict=True):
        assert abs(result.params[name] - float(true)) < 4 * result.std_error[name]


@pytest.mark.science
def test_held_out_samples_lie_inside_the_band():
    (validated,) = identified().validation
    assert validated.predicted is not None
    assert validated.predicted.inside_percent["level"] == pytest.approx(95, abs=4)
    assert validated.predicted.fit_percent["level"] > validated.fit_percent["level"]


@pytest.mark.science
def test_prediction_and_simulation_are_told_apart():
    result = identified()
    text, data = str(result), json.loads(json.dumps(json_ready(result.to_dict())))
    assert "level: fit of the one-step prediction" in text
    assert "v.csv: held-out level fit of the one-step prediction" in text
    assert "of the samples inside the 95 % band" in text
    assert "process noise [state unit / sqrt(s)]: level 0.0" in text
    (held_out,) = data["validation"]
    assert held_out["inside_band_percent"]["level"] > 90
    assert data["prediction_fit_percent"]["level"] > data["fit_percent"]["level"]
    assert data["process_noise"].keys() == data["measurement_noise"].keys() == {"level"}


@pytest.mark.science
def test_the_run_folder_has_the_prediction(tmp_path):
    identified().save(tmp_path / "run")
    names = ("record", "simulated", "predicted", "predicted_sd", "residual")
    tables = {n: np.loadtxt(tmp_path / f"run/{n}.csv", delimiter=",", skiprows=1) for n in names}
    measured = identified().fitted[0].record.outputs[:, 0]
    np.testing.assert_allclose(
        tables["residual"][:, 1], measured - tables["predicted"][:, 1], atol=1e-6
    )
    assert "predicted one step ahead" in report_html([tmp_path / "run"])


@pytest.mark.science
def test_uneven_records_with_missing_samples_and_a_known_parameter():
    record, rng = tank_record(1), np.random.default_rng(0)
    is_jump = np.arange(len(record.time)) % 10 == 0  # of the input
    kept = is_jump | (rng.uniform(size=len(record.time)) < 0.8)
    missing = rng.uniform(size=(kept.sum(), 1)) < 0.1
    outputs = np.where(missing, np.nan, record.outputs[kept])
    spoiled = Record(record.time[kept], record.inputs[kept], outputs, {}, "r.csv")
    other = tank_record(2, 200)
    result = identify(
        [spoiled, other],
        TANK,
        PEM(),
        hold={"loss": float(TRUE.loss)},
        start={"area": 3.0},
    )
    assert result.status == "successful"
    assert result.params["loss"] == float(TRUE.loss)
    assert result.held == ("loss",)
    assert abs(result.params["area"] - float(TRUE.area)) < 4 * result.std_error["area"]
