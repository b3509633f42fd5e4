"""Plants with direct feedthrough: an input acts on an output at once, as on an accelerometer."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.signal
from commands import excite

import excite as ex
from excite.description import Input, Output, Parameter, PlantDescription, State
from excite.estimation import NLS
from excite.files import json_ready
from excite.plant import AbstractARXPlant, AbstractPlant
from excite.record import Record
from excite.simulation import response

FILE = f"{Path(__file__)}:Shaker"
DT, TRUTH = 0.01, {"m": 0.6, "k": 110.0, "d": 0.9}


class Shaker(AbstractPlant):
    """A mass on a spring, driven by a force, with an accelerometer."""

    definition = PlantDescription(
        name="shaker",
        states=(State("x", "m", scale=0.05), State("v", "m/s")),
        inputs=(Input("force", "N", -5.0, 5.0),),
        outputs=(Output("acceleration", "m/s²", scale=5.0, noise_sd=0.05),),
        parameters=(
            Parameter("m", "kg", 0.5),
            Parameter("k", "N/m", 100.0),
            Parameter("d", "kg/s", 1.0),
        ),
        dt=DT,
        substeps=4,
        band=(0.5, 10.0),
    )

    def derivative(self, state, input, params):
        acceleration = (input[0] - params.k * state[0] - params.d * state[1]) / params.m
        return jnp.stack([state[1], acceleration])

    def output(self, state, input, params):
        return self.derivative(state, input, params)[1:]


def matrices(m: float, k: float, d: float) -> tuple[np.ndarray, ...]:
    A, B = np.array([[0.0, 1.0], [-k / m, -d / m]]), np.array([[0.0], [1 / m]])
    return A, B, A[1:], B[1:]


def accelerations(params: dict[str, float], force: np.ndarray, is_linear: bool) -> np.ndarray:
    """Sample k of C x_k + D u_k by SciPy: input held (zoh) or linear (foh) between samples."""
    A, B, C, D = matrices(**params)
    if is_linear:
        time = DT * np.arange(len(force))
        return scipy.signal.lsim((A, B, C, D), force, time, interp=True)[1].reshape(-1, 1)
    system = scipy.signal.cont2discrete((A, B, C, D), DT, "zoh")
    return scipy.signal.dlsim(system, force)[1]


def recorded(is_linear: bool = False, seed: int = 1, num_samples: int = 400) -> Record:
    """A record that was made without the package; its last force is not the one before."""
    force = np.random.default_rng(seed).uniform(-5, 5, num_samples)
    return answered(force, accelerations(TRUTH, force, is_linear))


def answered(force: np.ndarray, values: np.ndarray) -> Record:
    """A record of forces and of accelerations with noise."""
    noisy = values + 0.05 * np.random.default_rng(5).normal(size=values.shape)
    about = {"plant": json_ready(Shaker().description.to_dict()), "starts_at_initial_state": True}
    return Record(DT * np.arange(len(force)), force[:, None], noisy, about, "shaker.csv")


def swept(num_samples: int = 400) -> np.ndarray:
    """Forces that change little from sample to sample."""
    return 4 * scipy.signal.chirp(DT * np.arange(num_samples), 0.5, DT * num_samples, 5.0)


def scipys(record: Record, is_linear: bool) -> tuple[np.ndarray, np.ndarray]:
    """Parameters and standard errors by SciPy's least squares."""

    def residual(z: np.ndarray) -> np.ndarray:
        params = dict(zip(TRUTH, np.exp(z), strict=True))
        return (accelerations(params, record.inputs[:, 0], is_linear) - record.outputs).ravel()

    begin = np.log([0.5, 100.0, 1.0])
    found = scipy.optimize.least_squares(residual, begin, xtol=1e-12, ftol=1e-12)
    variance = 2 * found.cost / (record.outputs.size - 3)
    covariance = variance * np.linalg.inv(found.jac.T @ found.jac)
    return np.exp(found.x), np.exp(found.x) * np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("is_linear", [False, True], ids=["held", "linear"])
def test_samples_are_of_the_state_and_of_the_input_of_the_sample(is_linear):
    plant, force = Shaker(), recorded().inputs
    next_inputs = jnp.asarray(force[1:]) if is_linear else None
    found = response(plant, plant.Params(**TRUTH), jnp.asarray(force[:-1]), next_inputs=next_inputs)
    wanted = accelerations(TRUTH, force[:, 0], is_linear)
    known = slice(None) if is_linear else slice(-1)  # a held input ends with the last step
    np.testing.assert_allclose(found[known], wanted[known], atol=1e-5)


def test_a_signal_is_simulated_as_the_response_to_it():
    exact = {"acceleration": 0.0}
    record = ex.simulate(Shaker, "prbs", params=TRUTH, noise=exact, steps=100)
    force = record.inputs[:, 0]
    np.testing.assert_allclose(record.outputs, accelerations(TRUTH, force, False), atol=1e-5)
    again = ex.simulate(Shaker, record, params=TRUTH, noise=exact)
    np.testing.assert_allclose(again.outputs, record.outputs, atol=1e-12)


@pytest.mark.parametrize("is_linear", [False, True], ids=["held", "linear"])
def test_estimates_are_those_of_scipy(is_linear):
    record = recorded(is_linear)
    result = ex.identify(record, Shaker, hold_input="linear" if is_linear else "constant")
    values, errors = scipys(record, is_linear)
    np.testing.assert_allclose([result.params[name] for name in TRUTH], values, rtol=1e-4)
    np.testing.assert_allclose([result.std_error[name] for name in TRUTH], errors, rtol=0.01)
    assert result.is_usable
    assert not result.suspects


def test_the_input_of_a_sample_is_not_the_one_before():
    """Where the output was measured before its input changed, the fit is poor, and it is said."""
    force = swept()
    values = accelerations(TRUTH, force, False)
    good = ex.identify(answered(force, values), Shaker)
    change = np.diff(force, prepend=force[0])[:, None] / TRUTH["m"]
    early = ex.identify(answered(force, values - change), Shaker)
    assert not good.suspects
    assert "follows the input" in " ".join(early.verdict)
    assert early.misfit_factor > 1.5


def test_the_filter_sees_the_input_of_the_sample():
    record = recorded()
    values, errors = scipys(record, False)
    result = ex.identify(record, Shaker, "pem")
    found = np.array([result.params[name] for name in TRUTH])
    assert np.all(np.abs(found - values) < 0.5 * errors)
    predicted = result.fitted[0].predicted
    assert predicted is not None
    assert 93 <= predicted.inside_percent["acceleration"] <= 97


def test_the_information_is_that_of_the_covariance():
    record = recorded()
    result = ex.identify(record, Shaker, NLS(noise="known"))
    plant = Shaker()
    change, size = 1e-5, np.array([result.params[name] for name in TRUTH])

    def outputs(params: np.ndarray) -> np.ndarray:
        own = dict(zip(TRUTH, params, strict=True))
        return accelerations(own, record.inputs[:, 0], False)[:, 0]

    steps = change * np.diag(size)
    slope = np.stack([(outputs(size + s) - outputs(size - s)) / (2 * change) for s in steps])
    np.testing.assert_allclose(
        np.array(result.information), slope @ slope.T / float(plant.sensor.sd[0]) ** 2, rtol=1e-3
    )


@pytest.mark.parametrize(
    ("extension", "value", "force"),
    [
        ("gain", 1.3, lambda u: 1.3 * u),
        ("offset", 0.7, lambda u: u + 0.7),
        ("saturation", 3.0, lambda u: np.clip(u, -3, 3)),
        ("dead_zone", 0.5, lambda u: u - np.clip(u, -0.5, 0.5)),
        ("bias_acceleration", 0.4, None),
    ],
)
def test_an_effect_of_the_input_acts_on_the_output_too(extension, value, force):
    name = extension if "_" in extension.removeprefix("dead_") else f"{extension}_force"
    played, bias = recorded().inputs[:, 0], 0.0 if force else value
    outputs = accelerations(TRUTH, force(played) if force else played, False) + bias
    hold = ("m",) if extension == "gain" else ()  # the mass and the gain are not told apart
    result = ex.identify(
        answered(played, outputs),
        f"{FILE}+{extension}",
        NLS(known=hold),
        start={**TRUTH, name: value},
    )
    assert abs(result.params[name] - value) < 4 * result.std_error[name]
    assert result.fitted[0].fit_percent["acceleration"] > 97


def test_an_effect_that_was_left_out_is_named():
    force = recorded().inputs[:, 0]
    outputs = accelerations(TRUTH, np.clip(force, -3, 3), False)
    assert ex.identify(answered(force, outputs), Shaker).suspects[0].name == "saturation_force"


class LateShaker(Shaker):
    def delay(self, params):
        return jnp.array([0.02])


@pytest.mark.parametrize("plant", [LateShaker, f"{FILE}+delay", f"{FILE}+delay_force"])
def test_a_delay_and_feedthrough_are_refused(plant):
    """A held input that is late changes between samples: no derivative by the delay is left."""
    with pytest.raises(ValueError, match="cannot be delayed, too: shift the rows of the input"):
        ex.identify(recorded(), plant)


def test_records_of_two_lengths_and_a_gap_are_fitted_together():
    long, short = recorded(seed=2), recorded(seed=3, num_samples=150)
    gap = dataclasses.replace(short, time=short.time + np.where(np.arange(150) < 80, 0.0, 5.0))
    result = ex.identify([long, gap], Shaker)
    for name, value in TRUTH.items():
        assert abs(result.params[name] - value) < 4 * result.std_error[name]
    assert len(result.fitted[1].simulated) == 150
    assert np.isfinite(result.fitted[1].simulated).all()


class Told(AbstractARXPlant):
    definition = Shaker.definition
    derivative, output = Shaker.derivative, Shaker.output

    def from_transfer_function(self, c_0, c_1, d_0):
        return self.Params(1 / d_0, c_0 / d_0, c_1 / d_0)


def test_what_measures_before_it_chooses_is_refused():
    message = "acts on an output directly"
    goal = {"m": "1 %"}
    for refused in (
        lambda: ex.train(Shaker),
        lambda: ex.design(Shaker),
        lambda: ex.falsify("prbs", Shaker),
        lambda: ex.Campaign(Shaker, goal),
    ):
        with pytest.raises(ValueError, match=message):
            refused()
    with pytest.raises(ValueError, match="algebraic loop"):
        ex.simulate(Shaker, "loop-chirp")
    with pytest.raises(ValueError, match="is an ARX plant"):
        ex.simulate(Told)


def test_commands_take_such_a_plant(tmp_path):
    path = tmp_path / "shaker.csv"
    done = excite("simulate", FILE, "--steps", "300", "--out", str(path))
    assert done.returncode == 0
    done = excite("identify", str(path), "--plant", FILE, "--out", str(tmp_path / "run"))
    assert done.returncode == 0
    done = excite("information", FILE, "--excitation", "multisine")
    assert done.returncode == 0
    done = excite("run", "--plant", FILE, "--out", str(tmp_path / "rig.csv"))
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "acts on an output directly" in done.stderr
