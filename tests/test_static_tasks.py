"""Tasks without memory: simulation, likelihood, expected gain."""

import dataclasses
import math
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import excite as ex
from excite.excitation import Random, Replay
from excite.plant import AbstractStaticTask, static_description
from excite.plant.catalogue import plant_named
from excite.policy import Layout, Policy
from excite.record import Record
from excite.simulation import predicted, response, run_episode
from excite.study.table import finished_table

EXAMPLE = Path(__file__).parent.parent / "examples" / "location_finding.py"
SD = 0.5


class Slope(AbstractStaticTask):
    """The outcome is a multiple of the design."""

    definition = static_description(
        "slope",
        designs=(ex.Input("place", "m", -1.0, 1.0),),
        outcomes=(ex.Output("height", "m", scale=1.0, noise_sd=SD),),
        parameters=(ex.Parameter("slope", "", 0.0, scale=1.0, positive=False),),
    )

    def outcome(self, design, params):
        return design * params.slope


def intensity(places: np.ndarray, designs: np.ndarray) -> np.ndarray:
    """The logarithm of two sources' intensity, without excite."""
    squares = ((designs[:, None] - places.reshape(2, 2)[None]) ** 2).sum(axis=2)
    return np.log(0.1 + (1 / (1e-4 + squares)).sum(axis=1))


def test_the_outcome_is_that_of_the_last_design_alone():
    sources, places = plant_named(f"{EXAMPLE}:TwoSources"), np.array([0.5, -1.0, 1.5, 0.3])
    designs = np.random.default_rng(0).uniform(-4, 4, (30, 2))
    params = sources.Params(*places)
    outputs = response(sources, params, jnp.asarray(designs))
    np.testing.assert_allclose(outputs[1:, 0], intensity(places, designs), rtol=1e-12)
    assert float(outputs[0, 0]) == 0  # nothing is measured before the first design
    run = run_episode(sources, params, Replay(jnp.asarray(designs)), 30, jax.random.key(1))
    noise = np.asarray(run.measured - outputs)
    assert 0.3 < noise.std() < 0.7


def test_without_an_excitation_the_designs_are_random():
    own, random, chirp = (
        ex.simulate(Slope, excitation, steps=20).inputs for excitation in (None, "random", "chirp")
    )
    np.testing.assert_array_equal(own, random)
    assert not np.allclose(own, chirp)
    np.testing.assert_array_equal(
        ex.simulate("aero2", steps=20).inputs, ex.simulate("aero2", "chirp", steps=20).inputs
    )


@pytest.mark.slow
def test_a_trained_policy_is_compared_with_random_designs(tmp_path):
    ex.train(Slope, tmp_path / "run", steps=5, window=1, episodes=2, updates=1,
             training={"num_plants": 2, "hidden": [2]})  # fmt: skip
    assert {row.method for row in finished_table(tmp_path / "run").rows} == {
        "random",
        "gradient(D)",
    }


def test_a_design_outside_its_limits_is_refused_not_moved(tmp_path):
    file = tmp_path / "designs.csv"
    file.write_text("time,place\n0,0.5\n1,-1.5\n2,0.5\n")
    for designs, what in ((np.array([[0.5], [-1.5], [0.5]]), "inputs"), (file, str(file))):
        said = f"{what}: 'place' runs from -1.5 to 0.5 m; the plant's limits are -1 to 1 m"
        with pytest.raises(ValueError, match=re.escape(said)):
            ex.simulate(Slope, designs)
        with pytest.raises(ValueError, match=re.escape(said)):
            ex.information_gain(Slope, designs, steps=3, prior={"slope": "normal:0:1"})


class Root(Slope):
    """Without an outcome where the parameter is above two."""

    def outcome(self, design, params):
        return design * jnp.sqrt(2 - params.slope)


def test_a_prior_where_the_task_is_not_defined_is_refused():
    def gain(prior):
        return ex.information_gain(Root, steps=3, prior={"slope": prior}, plants=64, samples=20)

    assert gain("uniform:-1:1.9").lower.value > 0
    with pytest.raises(
        ValueError, match=r"\d of 64 experiments have outputs .* with slope = 2\.\d"
    ):
        gain("normal:1:1")


def test_a_prior_beyond_a_bound_is_refused():
    bounded = dataclasses.replace(
        Slope.definition, parameters=(ex.Parameter("slope", "", 0.5, scale=1.0, upper=1.0),)
    )
    task = type("Bounded", (Slope,), {"definition": bounded})
    for prior in ("lognormal:0.5:50%", "normal:0.9:0.05", "uniform:0.5:2"):
        with pytest.raises(ValueError, match=r"prior of 'slope' .* (above|and) 1"):
            ex.information_gain(task, steps=3, prior={"slope": prior}, plants=8, samples=20)


def test_what_the_likelihood_expects_is_the_response():
    sources = plant_named(f"{EXAMPLE}:TwoSources")
    designs = jnp.asarray(np.random.default_rng(1).uniform(-4, 4, (30, 2)))
    params = sources.Params(*jnp.array([0.5, -1.0, 1.5, 0.3]))
    expected, sd = predicted(sources, params, designs, jnp.zeros((31, 1)))
    np.testing.assert_allclose(expected, response(sources, params, designs), rtol=1e-12)
    np.testing.assert_array_equal(sd, [0.5])


class Singular(AbstractStaticTask):
    """The outcome of a design at zero is infinite."""

    definition = dataclasses.replace(
        Slope.definition, name="singular", inputs=(ex.Input("place", "m", 0.5, 2.0),)
    )

    def outcome(self, design, params):
        return jnp.log(design) * params.slope


def test_how_long_a_design_takes_changes_nothing():
    designs, params = jnp.array([[1.0], [-1.0], [0.5]]), Slope().Params(jnp.asarray(2.0))
    expected = [0.0, 2.0, -2.0, 1.0]
    for task in (Slope(), Slope(dt=2.0), Slope().integrated_in(4)):
        np.testing.assert_allclose(response(task, params, designs)[:, 0], expected)
    times = response(Slope(), params, designs, dt=jnp.array([0.1, 3.0, 1.0]))
    np.testing.assert_allclose(times[:, 0], expected)


@pytest.mark.parametrize("dt", [1.0, 2.0])
def test_identify_is_linear_regression(dt):
    rng = np.random.default_rng(0)
    designs, time = rng.uniform(-1, 1, 41), dt * np.arange(41)
    outcomes = np.append(0.0, 0.8 * designs[:-1]) + SD * rng.normal(size=41)
    record = ex.Record(time, designs[:, None], outcomes[:, None])
    found = ex.identify(record, Slope, initial_state="known")
    used = designs[:-1]
    assert found.params.slope == pytest.approx(used @ outcomes[1:] / (used @ used), rel=1e-6)
    assert not any("coarse" in sentence for sentence in found.verdict)


def test_a_prior_is_the_answer_where_the_record_tells_nothing():
    inputs, measured = np.full((6, 1), 1e-6), np.array([[0], [0.3], [-0.2], [0.4], [-0.5], [0.1]])
    time = np.arange(6.0)
    record = Record(time, inputs, measured, {})
    with pytest.raises(ValueError, match="no parameter is identifiable"):
        ex.identify(record, Slope)
    found = ex.identify(record, Slope, prior={"slope": "normal:0.7:0.1"})
    assert found.params["slope"] == pytest.approx(0.7, abs=1e-3)
    assert found.std_error["slope"] == pytest.approx(0.1, rel=1e-2)


def test_an_outcome_that_is_infinite_at_zero_has_a_gradient():
    designs = jnp.array([[0.5], [2.0]])

    def total(slope):
        return jnp.sum(response(Singular(), Singular().Params(slope), designs))

    assert float(jax.grad(total)(1.5)) == pytest.approx(0.0, abs=1e-12)
    assert float(total(1.5)) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.slow
def test_of_a_linear_task_all_figures_are_the_exact_gain():
    """Half the mean of log(1 + sum of squared designs over the variance), which bounds hold."""
    found = ex.information_gain(
        Slope, Random(hold=1), steps=8, prior={"slope": "normal:0:1"}, plants=256, samples=200
    )
    squares = (np.random.default_rng(0).uniform(-1, 1, (100_000, 8)) ** 2).sum(axis=1)
    exact = 0.5 * np.log1p(squares / SD**2).mean()
    for mean in (found.lower, found.upper, found.laplace):
        assert abs(mean.value - exact) < 4 * mean.std_error + 0.01


@pytest.mark.science
def test_random_designs_tell_of_two_sources_what_an_independent_computation_says():
    found = ex.information_gain(
        f"{EXAMPLE}:TwoSources", Random(hold=1), steps=30, from_prior=True, plants=128,
        samples=20_000, prior=dict.fromkeys(("x_1", "y_1", "x_2", "y_2"), "normal:0:1"),
    )  # fmt: skip
    rng, gains = np.random.default_rng(0), []
    others = rng.normal(size=(20_000, 4))
    for _ in range(256):
        places, designs = rng.normal(size=4), rng.uniform(-4, 4, (30, 2))
        outcomes = intensity(places, designs) + SD * rng.normal(size=30)
        logs = [-((outcomes - intensity(p, designs)) ** 2).sum() / (2 * SD**2)
                for p in (places, *others[:2000])]  # fmt: skip
        gains.append(logs[0] - np.logaddexp.reduce(logs) + np.log(len(logs)))
    error = np.std(gains) / 16
    # More samples only raise the lower bound, here by less than a third of a nat.
    difference = found.lower.value - np.mean(gains)
    assert -3 * np.hypot(error, found.lower.std_error) < difference < 0.35 + 3 * error


class Even(AbstractStaticTask):
    """The outcome does not tell the sign of the parameter: a posterior has two modes."""

    definition = static_description(
        "even",
        designs=(ex.Input("place", "m", -1.0, 1.0),),
        outcomes=(ex.Output("height", "m", scale=1.0, noise_sd=0.1),),
        parameters=(ex.Parameter("root", "", 0.5, scale=1.0, positive=False),),
    )

    def outcome(self, design, params):
        return design * params.root**2


@pytest.mark.slow
def test_of_a_posterior_with_two_modes_both_are_found():
    found = ex.information_gain(
        Even, "random", options={"hold": 1}, steps=8, prior={"root": "normal:0:1"}, plants=512,
        samples=300,
    )  # fmt: skip
    assert found.few == 0
    assert 0 <= found.upper.value - found.lower.value < 0.03
    rng, grid = np.random.default_rng(0), np.linspace(-6, 6, 2401)
    true, designs = rng.normal(size=500), rng.uniform(-1, 1, (500, 8))
    measured = designs * true[:, None] ** 2 + 0.1 * rng.normal(size=(500, 8))

    def log_likelihood(values: np.ndarray) -> np.ndarray:
        left = measured[:, None] - designs[:, None] * values[..., None] ** 2
        return -0.5 * (left**2).sum(axis=-1) / 0.1**2

    prior = np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi) * (grid[1] - grid[0])
    evidence = np.log(np.exp(log_likelihood(grid[None])) @ prior)
    gains = log_likelihood(true[:, None])[:, 0] - evidence
    error = math.hypot(gains.std() / math.sqrt(500), found.lower.std_error)
    assert abs(found.lower.value - gains.mean()) < 4 * error


def test_the_plant_of_a_policy_that_is_in_a_file_has_to_be_named():
    layout = Layout.of(Slope.definition, 1, 5)
    weights = ((np.zeros((1, layout.size)), np.zeros(1)),)
    policy = Policy(Slope().description, layout, weights)
    for verb in (ex.evaluate, ex.falsify):
        with pytest.raises(ValueError, match=r"plant 'slope' is in a file of yours: name it"):
            verb(policy)
    assert ex.evaluate(policy, plant=Slope, episodes=2) is not None
