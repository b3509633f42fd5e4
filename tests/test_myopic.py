"""Designs that are chosen one after the other: what is known, and where the next one lies."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import excite

import excite as ex
from excite.estimation.information_gain import gains
from excite.estimation.myopic import Myopic
from excite.excitation import Random
from excite.plant import AbstractPlant, AbstractStaticTask, static_description

SD = 0.5


class Line(AbstractStaticTask):
    """The outcome is a line over the design."""

    definition = static_description(
        "line",
        designs=(ex.Input("place", "m", -1.0, 2.0),),
        outcomes=(ex.Output("height", "m", scale=1.0, noise_sd=SD),),
        parameters=(
            ex.Parameter("offset", "", 0.0, scale=1.0, positive=False),
            ex.Parameter("slope", "", 0.0, scale=1.0, positive=False),
        ),
    )

    def outcome(self, design, params):
        return params.offset + design * params.slope


class Beacon(AbstractStaticTask):
    """A level that falls with the distance from where the beacon is."""

    definition = static_description(
        "beacon",
        designs=(ex.Input("place", "m", -4.0, 4.0),),
        outcomes=(ex.Output("level", "", scale=1.0, noise_sd=0.1),),
        parameters=(ex.Parameter("at", "m", 0.0, scale=1.0, positive=False),),
    )

    def outcome(self, design, params):
        return 1 / (1 + (design - params.at) ** 2)


class Climb(AbstractPlant):
    """A height to which each step adds what the line would measure."""

    definition = ex.PlantDescription(
        name="climb",
        states=(ex.State("height", "m", initial=0.7, noise_sd=SD),),
        inputs=Line.definition.inputs,
        outputs=(ex.Output("height", "m", scale=1.0),),
        parameters=Line.definition.parameters,
        dt=1.0,
        integrator="euler",
    )

    def derivative(self, state, input, params):
        del state
        return params.offset + input * params.slope

    def output(self, state, params):
        del params
        return state


PRIOR = {"offset": "normal:0:1", "slope": "normal:0:1"}
OUTCOMES = 1.3, -0.2, 2.1, 0.4


def played(chosen: Myopic, outcomes, count: int = 6):
    """The state after these outcomes, and the designs that had them and the next one."""
    state, designs = chosen.init(chosen.prior.plant, count, jax.random.key(3)), []
    for outcome in (0.0, *outcomes):
        state, design = chosen(state, jnp.array([outcome]))
        designs.append(np.asarray(design))
    return state, np.array(designs)


def test_what_is_known_of_a_linear_task_is_its_normal_posterior():
    chosen = dataclasses.replace(Myopic.of(Line, PRIOR), num_particles=4000, num_tried=16)
    state, designs = played(chosen, OUTCOMES)
    X = np.column_stack([np.ones(len(OUTCOMES)), designs[:-1, 0]]) / SD
    covariance = np.linalg.inv(X.T @ X + np.eye(2))
    mean = covariance @ X.T @ np.array(OUTCOMES) / SD
    found = np.asarray(state.particles)
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.mean(axis=0), mean, atol=0.15 * sd.min())
    np.testing.assert_allclose(np.cov(found.T), covariance, atol=0.15 * sd.max() ** 2)
    np.testing.assert_array_equal(state.outcomes[:4, 0], OUTCOMES)
    np.testing.assert_array_equal(state.designs[:5], designs)


def test_the_next_design_tells_most():
    # Of a line whose offset and slope are as uncertain, the outcome farthest from zero; then the
    # other end, where the first outcome says least.
    _, designs = played(Myopic.of(Line, PRIOR), [0.0])
    assert designs[0, 0] > 1.8
    X = np.array([1.0, designs[0, 0]]) / SD
    covariance = np.linalg.inv(np.outer(X, X) + np.eye(2))
    places = np.linspace(-1, 2, 301)
    rows = np.column_stack([np.ones(301), places])
    told = 0.5 * np.log1p(np.einsum("ij,jk,ik->i", rows, covariance, rows) / SD**2)
    own = np.interp(designs[1, 0], places, told)
    assert own > told.max() - 0.1 * np.ptp(told)


def test_of_a_plant_whose_state_is_observed_each_step_tells_what_a_design_does():
    """With the same random numbers, of its increments the same is learnt as of the line."""
    known, designs = played(Myopic.of(Line, PRIOR), OUTCOMES)
    chosen = Myopic.of(Climb, PRIOR)
    state, inputs = chosen.init(Climb(), 6, jax.random.key(3)), []
    for height in np.cumsum([0.7, *OUTCOMES]):
        state, input = chosen(state, jnp.array([height]))
        inputs.append(np.asarray(input))
    np.testing.assert_allclose(inputs, designs, atol=1e-9)
    np.testing.assert_allclose(state.particles, known.particles, atol=1e-9)
    np.testing.assert_allclose(chosen.posterior(state).slope, known.particles[:, 1], atol=1e-9)


def test_of_a_pool_only_its_designs_are_chosen():
    pool = np.array([[-0.5], [0.5], [1.5]])
    _, designs = played(Myopic.of(Line, PRIOR, pool=pool), OUTCOMES)
    assert set(designs.ravel()) <= set(pool.ravel())
    assert designs[0, 0] == 1.5


def test_another_design_than_the_proposed_one_is_learnt_from():
    chosen = Myopic.of(Line, PRIOR)
    state, _ = played(chosen, [])
    state, _ = chosen(chosen.applied(state, jnp.array([0.0])), jnp.array([3.0]))
    offset, slope = np.asarray(state.particles).mean(axis=0)  # at zero, of the offset alone
    assert offset == pytest.approx(3 / (1 + SD**2), abs=0.1)
    assert abs(slope) < 0.1


@pytest.mark.slow
def test_it_tells_more_than_designs_at_random():
    prior = {"at": "normal:0:1"}
    few = {"num_particles": 200, "num_moves": 2, "num_tried": 32, "num_rounds": 1}
    found = {
        name: ex.information_gain(
            Beacon, name, options=options, steps=4, prior=prior, plants=48, samples=100
        )
        for name, options in (("myopic", few), ("random", {"hold": 1}))
    }
    best, random = found["myopic"], found["random"]
    assert best.excitation == "Myopic"
    assert best.lower.value - random.lower.value > 4 * np.hypot(
        best.lower.std_error, random.lower.std_error
    )


def test_samples_of_the_prior_are_weighted_by_the_likelihood_alone():
    # With one sample, lower and upper bound of a record are functions of one ratio of likelihoods.
    population = Myopic.of(Line, PRIOR).prior
    found = gains(population, Random(hold=1), 4, jax.random.split(jax.random.key(0), 8), 1, True)
    np.testing.assert_allclose(found.lower, np.log(2 / (1 + np.exp(-found.upper))), atol=1e-9)


@pytest.mark.parametrize(
    ("pool", "sentence"),
    [
        (np.zeros(3), "a row of 1"),
        (np.zeros((0, 1)), "a row of 1"),
        (np.zeros((2, 2)), "a row of 1"),
        (np.array([[3.0]]), "the designs of a pool"),
        (np.array([[np.nan]]), "the designs of a pool"),
    ],
)
def test_a_pool_that_is_none_is_refused(pool, sentence):
    with pytest.raises(ValueError, match=sentence):
        Myopic.of(Line, PRIOR, pool=pool)


def test_what_is_no_outcome_or_comes_before_a_design_is_refused():
    chosen = Myopic.of(Line, PRIOR)
    nothing = chosen.init(Line(), 3, jax.random.key(0))
    for too_early in (chosen.learnt, chosen.applied):
        with pytest.raises(ValueError, match="no design is chosen yet"):
            too_early(nothing, jnp.array([0.4]))
    state, _ = chosen(nothing, jnp.zeros(1))
    for outcome in (jnp.array([jnp.nan]), jnp.ones(2)):
        with pytest.raises(ValueError, match="an outcome has one finite number for each of"):
            chosen.learnt(state, outcome)


def test_a_plant_whose_state_is_not_observed_is_refused():
    with pytest.raises(ValueError, match=r"tasks without memory.*plant 'aero2' are not its states"):
        Myopic.of("aero2")
    with pytest.raises(ValueError, match="tasks without memory"):
        ex.information_gain("aero2", "myopic")
    assert excite("gain", "aero2", "--excitation", "myopic").returncode == 2


def test_a_plant_that_delays_its_inputs_is_refused():
    late = Path(__file__).parent.parent / "examples" / "smc_pendulums.py"
    with pytest.raises(ValueError, match="delays its inputs"):
        Myopic.of(f"{late}:LinearPendulum+delay")


def test_another_task_is_refused():
    with pytest.raises(ValueError, match="for the plant 'line': got 'beacon'"):
        ex.information_gain(Beacon, Myopic.of(Line, PRIOR), steps=2)


@pytest.mark.parametrize(
    ("option", "allowed"),
    [
        ({"num_outcomes": 0}, "num_outcomes must be a whole number from 1 "),
        ({"num_particles": 63}, "num_particles must be a whole number from 64 "),
        ({"num_tried": 7}, "num_tried must be a whole number from 8 "),
        ({"num_rounds": -1}, "num_rounds must be a whole number from 0 "),
        ({"num_moves": 1.5}, "num_moves"),
        ({"moves": 5}, "moves"),
    ],
)
def test_an_option_that_is_not_allowed_is_refused(option, allowed):
    with pytest.raises(ValueError, match=allowed):
        ex.information_gain(Line, "myopic", options=option, prior=PRIOR)


def test_a_task_without_noise_is_refused():
    with pytest.raises(ValueError, match="noise"):
        ex.information_gain(Line, "myopic", prior=PRIOR, noise={"height": 0.0})


def test_more_designs_than_asked_for_are_refused():
    chosen = Myopic.of(Line, PRIOR)
    with pytest.raises(ValueError, match="all 3 designs are chosen: make a state for more"):
        played(chosen, OUTCOMES[:3], count=3)
