"""Posterior samples, against Student's t and integrals over a grid."""

import dataclasses
import json

import arviz_stats
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
import xarray
from commands import excite
from kinetics import TIME, TRUTH, Product, concentrations
from test_plants_without_inputs import FILE

import excite as ex
from excite.description import Constant, Input, Output, Parameter, PlantDescription, State
from excite.estimation import NLS
from excite.estimation import posterior as module
from excite.estimation.posterior import summary
from excite.plant import AbstractPlant
from excite.record import Record

LEVELS = np.array([0.025, 0.25, 0.5, 0.75, 0.975])


class Line(AbstractPlant):
    """An output that is linear in both parameters."""

    definition = PlantDescription(
        name="line",
        states=(State("x", "m"),),
        inputs=(Input("u", "V", -1.0, 1.0),),
        outputs=(Output("y", "m", 1.0, noise_sd=0.05),),
        parameters=(
            Parameter("a", "m", 0.0, positive=False, scale=1.0),
            Parameter("b", "m/s/V", 1.0, positive=False, scale=1.0),
        ),
        dt=0.5,
    )

    def derivative(self, state, input, params):
        return params.b * input

    def output(self, state, params):
        return state + params.a


class Bounded(Line):
    """The same with a bound on the slope, which is positive."""

    definition = dataclasses.replace(
        Line.definition,
        name="bounded",
        parameters=(Line.definition.parameters[0], Parameter("b", "m/s/V", 1.0, upper=1.35)),
    )


class Loud(Bounded):
    """The same with much noise."""

    definition = dataclasses.replace(
        Bounded.definition, outputs=(Output("y", "m", 1.0, noise_sd=0.5),)
    )


class Wall(Line):
    """The slope is a parameter times a constant, and cannot be simulated above 2.1."""

    definition = dataclasses.replace(
        Line.definition,
        name="wall",
        parameters=(Parameter("b", "m/s/V", 1.0),),
        constants=(Constant("c", "1", 2.0),),
    )

    def derivative(self, state, input, params):
        slope = params.b * self.constants.c
        return slope * input + 0 * jnp.sqrt(2.1 - slope)

    def output(self, state, params):
        return state


def line(gain: float, offset: float = 0.0, noise: float = 0.05, seed: int = 1) -> Record:
    """Nine samples of a line, made without the package."""
    random = np.random.default_rng(seed)
    time, inputs = 0.5 * np.arange(9.0), random.choice([-1.0, 1.0], size=(9, 1))
    reached = np.concatenate([[0.0], np.cumsum(0.5 * inputs[:-1, 0])])
    outputs = offset + gain * reached + noise * random.normal(size=9)
    return Record(time, inputs, outputs[:, None], source="line.csv")


def reached(record: Record) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(np.diff(record.time) * record.inputs[:-1, 0])])


def require_quantiles(drawn: xarray.DataArray, expected: np.ndarray) -> None:
    """As many samples lie below each quantile as the independent ones of their effective size."""
    below = [float((drawn <= quantile).mean()) for quantile in expected]
    count = min(float(arviz_stats.ess(drawn.values)), drawn.size)
    error = np.sqrt(LEVELS * (1 - LEVELS) / count)
    assert count > 300
    np.testing.assert_array_less(np.abs(below - LEVELS), 4 * error)


def quantiles(values: np.ndarray, log_density: np.ndarray) -> np.ndarray:
    """Of a density on an even grid."""
    density = np.exp(log_density - log_density.max())
    return np.interp(LEVELS, np.cumsum(density) / density.sum(), values)


# ---------------------------------------------------------------------- linear plants


@pytest.mark.science
def test_a_linear_plant_has_students_t():
    record = line(1.3, 0.4)
    result = ex.identify(record, Line, initial_state="known")
    samples = result.posterior()
    posterior = samples["posterior"].dataset
    for name in ("a", "b"):
        of_t = scipy.stats.t(7, result.params[name], result.std_error[name])
        require_quantiles(posterior[name], of_t.ppf(LEVELS))
    regressors = np.stack([np.ones(9), reached(record)], axis=1)
    _, squares, *_ = np.linalg.lstsq(regressors, record.outputs[:, 0])
    of_sd = np.sqrt(squares / scipy.stats.chi2(7).ppf(1 - LEVELS))
    require_quantiles(posterior["noise_sd"].sel(output="y"), of_sd)
    assert samples["sample_stats"]["diverging"].sum() == 0
    assert list(posterior.data_vars) == ["a", "b", "noise_sd"]
    np.testing.assert_array_equal(samples["observed_data"]["y"], record.outputs[:, 0])

    likelihood = scipy.stats.norm.logpdf(
        record.outputs[:, 0],
        posterior["a"].values[..., None] + posterior["b"].values[..., None] * reached(record),
        posterior["noise_sd"].values,
    )
    np.testing.assert_allclose(samples["log_likelihood"]["y"], likelihood, rtol=1e-6)

    again = result.posterior(seed=0)
    assert again["posterior"].dataset.equals(posterior)
    assert not result.posterior(seed=1)["posterior"].dataset.equals(posterior)


def require_density_of_slope(plant, record: Record, prior: str, slope: np.ndarray, log_prior):
    """The samples of a slope with a prior have the density on an even grid of slopes."""
    options = {"hold": {"a": 0.0}, "prior": {"b": prior}, "initial_state": "known"}
    result = ex.identify(record, plant, NLS(noise="known"), **options)
    samples = result.posterior(num_samples=600)
    assert samples.attrs["plant_hash"] == result.plant.hash
    sd = plant.definition.outputs[0].noise_sd
    misfit = (record.outputs[:, 0] - slope[:, None] * reached(record)) / sd
    drawn = samples["posterior"].dataset["b"]
    require_quantiles(drawn, quantiles(slope, log_prior - np.sum(misfit**2, axis=1) / 2))


@pytest.mark.science
def test_a_normal_prior_counts_in_the_unit_of_the_parameter():
    """Of a positive parameter, too, which is searched by its logarithm."""
    slope = np.linspace(1.0, 1.35, 4001)
    log_prior = -(((slope - 1.2) / 0.05) ** 2) / 2
    require_density_of_slope(Bounded, line(1.3), "normal:1.2:0.05", slope, log_prior)


@pytest.mark.science
def test_a_uniform_prior_is_one_of_the_parameter():
    slope = np.linspace(0.2, 1.2, 4001)
    require_density_of_slope(Loud, line(0.7), "uniform:0.2:1.2", slope, 0.0)


@pytest.mark.science
def test_initial_states_are_drawn_too():
    """Two records with times of their own, of which one lacks a measurement."""
    first, second = line(1.3, 0.4, seed=1), line(1.3, -0.2, seed=2)
    first.outputs[4] = np.nan
    uneven = np.cumsum([0.0, 0.5, 0.2, 0.9, 0.5, 0.5, 0.1, 0.7, 0.5])
    second = Record(uneven, second.inputs, second.outputs, source="second.csv")
    result = ex.identify([first, second], Line, hold={"a": 0.0}, initial_state="free")
    samples = result.posterior()
    seen = np.isfinite(np.concatenate([first.outputs, second.outputs])[:, 0])
    design = np.zeros((18, 3))
    design[:9, 0], design[9:, 1] = 1.0, 1.0
    design[:, 2] = np.concatenate([reached(first), reached(second)])
    design, measured = design[seen], np.concatenate([first.outputs, second.outputs])[seen, 0]
    best, squares, *_ = np.linalg.lstsq(design, measured)
    sd = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * squares / 14)
    posterior = samples["posterior"].dataset
    drawn = [posterior["initial_state"].sel(experiment=i, state="x") for i in range(2)]
    for own, centre, error in zip([*drawn, posterior["b"]], best, sd, strict=True):
        require_quantiles(own, scipy.stats.t(14, centre, error).ppf(LEVELS))
    observed = samples["observed_data"].dataset
    np.testing.assert_array_equal(observed["y"], measured)
    times = np.concatenate([first.time, second.time])[seen]
    np.testing.assert_allclose(observed["time"], times)
    assert observed["experiment"].values.tolist() == [0] * 8 + [1] * 9


# ---------------------------------------------------------------------- curved likelihoods


def squares(record: Record, log_slope: np.ndarray, offset: float = 0.0) -> np.ndarray:
    """Sum of squares for each logarithm of the slope."""
    error = record.outputs[:, 0] - offset - np.exp(log_slope)[:, None] * reached(record)
    return np.sum(error**2, axis=1)


@pytest.mark.science
def test_bounds_cut_the_posterior_noise_may_be_known_and_a_held_parameter_stays_held():
    record = line(1.3, 0.4)
    options = {"hold": {"a": 0.38}, "initial_state": "known"}
    result = ex.identify(record, Bounded, NLS(noise="known"), **options)
    assert result.held == ("a",)
    samples = result.posterior()
    assert list(samples["posterior"].data_vars) == ["b"]
    assert samples["constant_data"]["a"] == 0.38
    assert summary(samples)["noise_sd"] is None
    grid = np.linspace(0, np.log(1.35), 10_001)
    expected = quantiles(grid, -squares(record, grid, 0.38) / 2 / 0.05**2)
    assert expected[-1] > np.log(1.34)  # the bound matters
    require_quantiles(samples["posterior"].dataset["b"], np.exp(expected))


@pytest.mark.science
def test_what_cannot_be_simulated_has_no_density_and_constants_may_be_uncertain():
    record = line(2.0)
    result = ex.identify(record, Wall, uncertain={"c": "5%"}, initial_state="known")
    samples = result.posterior()
    posterior = samples["posterior"].dataset
    slope = posterior["b"] * posterior["c"]
    assert slope.max() <= 2.1
    grid = np.linspace(np.log(1), np.log(2.1), 10_001)
    require_quantiles(slope, np.exp(quantiles(grid, -9 / 2 * np.log(squares(record, grid)))))
    of_c = 2 * np.exp(0.05 * scipy.stats.norm.ppf(LEVELS))
    require_quantiles(posterior["c"], of_c)


def product() -> Record:
    values = concentrations(TRUTH["k1"], TRUTH["k2"])[:, 1:]
    noisy = values + 0.015 * np.random.default_rng(3).normal(size=values.shape)
    return Record(TIME, np.zeros((len(TIME), 0)), noisy, source="product.csv")


@pytest.mark.science
def test_a_curved_posterior_is_that_of_a_grid():
    record = product()
    known = {"plant": Product, "initial_state": "known"}
    result = ex.identify(record, **known)
    posterior = result.posterior()["posterior"].dataset
    k1, k2 = (
        np.linspace(np.log(low), np.log(high), 121) for low, high in ((0.35, 0.95), (0.1, 0.5))
    )
    total = np.array([
        [np.sum((concentrations(*np.exp([a, b]))[:, 1:] - record.outputs) ** 2) for b in k2]
        for a in k1
    ])  # fmt: skip
    log_density = -len(TIME) / 2 * np.log(total)
    ends = []
    for axis, (name, grid) in enumerate({"k1": k1, "k2": k2}.items()):
        marginal = np.log(np.exp(log_density - log_density.max()).sum(axis=1 - axis))
        fine = np.linspace(grid[0], grid[-1], 10_001)
        expected = np.exp(quantiles(fine, np.interp(fine, grid, marginal)))
        require_quantiles(posterior[name], expected)
        ends.append(expected[[0, -1]])
    profile = ex.identify(record, **known, intervals="profile")
    symmetric, of_profile = (np.array(list(r.intervals.values())) for r in (result, profile))
    width = np.diff(ends)
    assert np.abs((of_profile - ends) / width).max() < 0.02
    assert np.abs((symmetric - ends) / width).max() > 0.04


# ---------------------------------------------------------------------- doors


@pytest.mark.science
def test_the_command_line_writes_samples_and_shows_them(tmp_path):
    record = product()
    rows = np.column_stack([record.time, record.outputs])
    np.savetxt(tmp_path / "r.csv", rows, delimiter=",", header="time,b", comments="")
    words = ("identify", "r.csv", "--plant", FILE.replace("Conversion", "Product"))
    words = (*words, "--initial-state", "known", "--posterior", "p.nc")
    done = excite(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "95 % credible interval" in done.stdout
    assert "4 chains of 1000 samples, no divergences" in done.stdout
    with xarray.open_datatree(tmp_path / "p.nc") as samples:
        found = summary(samples.load())
    k1 = samples["posterior"].dataset["k1"].values
    np.testing.assert_allclose(found["params"]["k1"]["ci95"], np.quantile(k1, [0.025, 0.975]))
    assert found["params"]["k1"]["rhat"] < 1.01
    assert found["params"]["k1"]["unit"] == "1/s"
    assert found["noise_sd"]["b"]["unit"] == "mol/l"

    refused = excite(*words, cwd=tmp_path)
    assert refused.returncode == 2
    assert "p.nc exists; choose another name or add --overwrite" in refused.stderr

    done = excite(*words, "--overwrite", "--samples", "20", "--json", cwd=tmp_path)
    told = json.loads(done.stdout)["posterior"]
    assert told["samples"] == 20
    assert "take more samples (--samples)" in told["verdict"][0]
    with xarray.open_datatree(tmp_path / "p.nc") as samples:
        assert summary(samples.load()) == told


@pytest.mark.slow
def test_what_has_no_posterior_says_so(monkeypatch):
    record = line(1.3, 0.4)
    result = ex.identify(record, Line, initial_state="known")
    with pytest.raises(ValueError, match="num_samples must be at least 10: got 3"):
        result.posterior(3)
    with pytest.raises(ValueError, match="chains must be at least 1: got 0"):
        result.posterior(chains=0)
    noise_free = ex.identify(line(1.3, noise=0.0), Line, initial_state="known")
    with pytest.raises(ValueError, match="a posterior needs noise"):
        noise_free.posterior()
    other = ex.identify(ex.simulate("aero2", steps=200), estimator="arx-rls")
    with pytest.raises(ValueError, match="need the estimator nls: got arx-rls"):
        other.posterior()
    failed = dataclasses.replace(result, status="not finite")
    with pytest.raises(ValueError, match="a failed estimate has no posterior"):
        failed.posterior()
    monkeypatch.setattr(module, "xarray", None)
    with pytest.raises(ValueError, match=r"need the extra: pip install 'excite\[bayes\]'"):
        result.posterior()
