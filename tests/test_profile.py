"""Profile likelihood intervals, against SciPy."""

import json
import math

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from commands import excite
from kinetics import TIME, TRUTH, Product, concentrations
from test_identification import Tank, tank_record
from test_plants_without_inputs import FILE

import excite as ex
from excite.description import Input, Output, Parameter, PlantDescription, State
from excite.estimation import NLS, stack_experiments
from excite.estimation.diagnosis import half_95, student_95
from excite.estimation.profile import profile_intervals
from excite.record import Record
from excite.simulation import response


def product(noise: float, time: np.ndarray = TIME, seed: int = 3) -> Record:
    """A record of B alone, made without the package."""
    values = concentrations(**TRUTH, time=time)[:, 1:]
    noisy = values + noise * np.random.default_rng(seed).normal(size=values.shape)
    return Record(time, np.zeros((len(time), 0)), noisy, source="product.csv")


def scipys_profile(record: Record) -> np.ndarray:
    """Both ends of the intervals of k1 and k2 by SciPy and matrix exponentials."""

    def residual(rates: np.ndarray) -> np.ndarray:
        return (concentrations(*rates, time=record.time)[:, 1:] - record.outputs).ravel()

    found = scipy.optimize.least_squares(residual, [0.4, 0.3], xtol=1e-13, ftol=1e-13)
    degrees = record.outputs.size - 2
    limit = student_95(degrees) ** 2 * 2 * found.cost / degrees

    def excess(value: float, index: int) -> float:
        def others(free: np.ndarray) -> np.ndarray:
            return residual(np.insert(free, index, value))

        start = [found.x[1 - index]]
        best = scipy.optimize.least_squares(others, start, xtol=1e-13, ftol=1e-13)
        return 2 * (best.cost - found.cost) - limit

    ends = [
        [
            scipy.optimize.brentq(excess, 0.3 * found.x[i], found.x[i], args=(i,)),
            scipy.optimize.brentq(excess, found.x[i], 4 * found.x[i], args=(i,)),
        ]
        for i in range(2)
    ]
    return np.array(ends)


@pytest.mark.science
def test_profile_intervals_of_a_reaction_are_scipys():
    record = product(0.03)
    result = ex.identify(record, Product, initial_state="known", intervals="profile")
    expected = scipys_profile(record)
    for (low, high), name in zip(expected, ("k1", "k2"), strict=True):
        np.testing.assert_allclose(result.ci95(name), (low, high), rtol=0.002)
        value = result.params[name]
        assert high - value > 1.05 * (value - low)  # not symmetric
        np.testing.assert_allclose(result.to_dict()["params"][name]["ci95"], result.ci95(name))  # pyright: ignore
    linear = ex.identify(record, Product, initial_state="known")
    assert linear.params == result.params
    result.plot()

    for name in ("k1", "k2"):  # the profile crosses its limit at both ends of the interval
        value, growth = result.profiles[name].T
        assert growth[value == result.params[name]] == 0
        for end in result.ci95(name):
            np.testing.assert_allclose(growth[np.isclose(value, end)], 1, atol=5e-3)
    titles = [axis.get_title() for axis in result.plot("diagnosis").axes]
    assert {"correlation of the estimates", "residual of b", "profile of k2"} <= {*titles}
    assert not any("profile" in axis.get_title() for axis in linear.plot("diagnosis").axes)


@pytest.mark.science
def test_profile_intervals_of_many_samples_are_those_of_standard_errors():
    record = tank_record(1.8)
    linear = ex.identify(record, Tank())
    for estimator in (NLS(), NLS(noise="estimated"), NLS(noise="known")):
        usual = ex.identify(record, Tank(), estimator)
        found = ex.identify(record, Tank(), estimator, intervals="profile")
        for name in ("area", "leak"):
            half = (usual.ci95(name)[1] - usual.ci95(name)[0]) / 2
            np.testing.assert_allclose(found.ci95(name), usual.ci95(name), atol=0.01 * half)
            assert usual.params[name] == pytest.approx(linear.params[name], rel=1e-6)


@pytest.mark.slow
def test_one_parameter_is_enough():
    record = tank_record(1.8)
    held = {"leak": 0.4}
    found = ex.identify(record, Tank(), hold=held, intervals="profile")
    usual = ex.identify(record, Tank(), hold=held)
    np.testing.assert_allclose(found.ci95("area"), usual.ci95("area"), rtol=1e-4)
    assert all(math.isnan(end) for end in found.ci95("leak"))


def open_below() -> Record:
    """Six early samples, from which the reaction may as well run in one direction only."""
    return product(0.025, np.array([0.0, 0.4, 0.8, 1.2, 1.6, 2.0]), seed=1)


@pytest.mark.science
def test_a_side_that_does_not_close_is_told():
    result = ex.identify(open_below(), Product, initial_state="known", intervals="profile")
    low, high = result.ci95("k2")
    assert result.status == "successful"
    assert low == 0
    assert result.params["k2"] < high < math.inf
    sentence = "k2 is practically not identifiable: its 95 % interval is open below"
    assert sentence in result.verdict
    result.plot()


class Enzyme(Product):
    """A substrate that an enzyme uses up, by L. Michaelis and M. Menten."""

    definition = PlantDescription(
        name="enzyme",
        states=(State("s", "mmol/l", initial=1.0),),
        inputs=(),
        outputs=(Output("substrate", "mmol/l", scale=1.0, noise_sd=0.05),),
        parameters=(Parameter("V", "mmol/l/s", 0.1), Parameter("K", "mmol/l", 0.6)),
        dt=1.0,
        substeps=10,
    )

    def derivative(self, state, input, params):
        return -params.V * state / (params.K + state)

    def output(self, state, params):
        return state


@pytest.mark.science
def test_an_end_is_found_after_a_value_far_outside():
    """Far below the estimate of V the best K is zero; from there no search finds back."""
    plant, none, rng = Enzyme(), jnp.zeros((14, 0)), np.random.default_rng(4)
    measured = np.asarray(response(plant, plant.nominal, none))
    measured = measured + 0.05 * rng.normal(size=measured.shape)
    data = stack_experiments(plant, [none], [measured], True)
    estimate, free = NLS()(plant, data), np.ones(2, bool)
    half = half_95(np.asarray(estimate.covariance), np.asarray(estimate.degrees))
    ends, profiles = profile_intervals(plant, data, NLS(), estimate, free, half)
    low, (value, growth) = ends[0, 0], profiles["V"].T
    assert low < 0.8 * float(estimate.params.V)
    np.testing.assert_allclose(growth[np.isclose(value, low)], 1, atol=5e-3)


class Turn(Product):
    """A car that turns; the heading is linear in the reciprocal of the radius."""

    definition = PlantDescription(
        name="turn",
        states=(State("distance", "m", scale=10.0), State("heading", "rad", scale=0.1)),
        inputs=(Input("wheel", "1/s", 0.0, 20.0),),
        outputs=(
            Output("distance", "m", 10.0, noise_sd=0.05),
            Output("heading", "rad", 0.1, noise_sd=0.07),
        ),
        parameters=(
            Parameter("circumference", "m", 1.0),
            Parameter("radius", "m", 100.0, positive=False, scale=100.0),
        ),
        dt=0.1,
        band=(0.1, 2.0),
    )

    def derivative(self, state, input, params):
        speed = params.circumference * input[0]
        return jnp.stack([speed, speed / params.radius])

    def output(self, state, params):
        return state


@pytest.mark.science
def test_segments_that_lead_astray_close_no_interval():
    """They turn the car to the other side, where a search does not find back."""
    plant, wheel = Turn(), np.full((20, 1), 3.0)
    clean = np.asarray(response(plant, plant.nominal, jnp.asarray(wheel)))
    for seed in range(12):
        noise = np.random.default_rng(seed).normal(size=clean.shape) * np.array([[0.05, 0.07]])
        record = Record.of_episode(0.1 * np.arange(21), wheel, clean + noise, {}, "r.csv")
        given = {"plant": plant, "initial_state": "known"}
        linear = ex.identify(record, **given)
        curved = ex.identify(record, intervals="profile", **given)
        # The distance tells the circumference, in which it is linear.
        half = np.diff(linear.ci95("circumference"))[0] / 2
        np.testing.assert_allclose(
            curved.ci95("circumference"), linear.ci95("circumference"), atol=0.02 * half
        )


def test_intervals_of_another_kind_are_refused():
    with pytest.raises(ValueError, match="profile intervals need the estimator nls: got arx-rls"):
        ex.identify(ex.simulate("aero2", steps=40), estimator="arx-rls", intervals="profile")


@pytest.mark.science
def test_the_command_line_has_profile_intervals(tmp_path):
    record = product(0.03)
    rows = np.column_stack([record.time, record.outputs])
    np.savetxt(tmp_path / "r.csv", rows, delimiter=",", header="time,b", comments="")
    words = ("identify", "r.csv", "--plant", FILE.replace("Conversion", "Product"))
    words = (*words, "--initial-state", "known", "--intervals", "profile", "--json")
    done = excite(*words, "--plot-diagnosis", "diagnosis.svg", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "profile of k1" in (tmp_path / "diagnosis.svg").read_text()
    assert len(json.loads(done.stdout)["starts"]) == 8
    refused = excite(*words, "--plot-diagnosis", "diagnosis.exe", cwd=tmp_path)
    assert refused.returncode == 2
    low, high = json.loads(done.stdout)["params"]["k1"]["ci95"]
    np.testing.assert_allclose((low, high), scipys_profile(record)[0], rtol=0.01)
