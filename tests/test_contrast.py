"""The contrast with other plants of a prior as the reward of an experiment."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm
from test_own_noise import Question, entropy

import excite as ex
from excite.environment import ContrastiveGain, Env, StepData
from excite.estimation.prior_knowledge import plants_of
from excite.excitation import Replay
from excite.plant import AbstractStaticTask, static_description
from excite.plant.aero2 import Aero2
from excite.plant.catalogue import with_sensor
from excite.policy import Layout
from excite.study.agent import Agent, AgentSettings
from excite.training.gradient import train
from excite.training.settings import GradientSettings


class Line(AbstractStaticTask):
    """A straight line through zero: the gain of designs is known exactly."""

    definition = static_description(
        "line",
        designs=(ex.Input("place", "m", -1.0, 1.0),),
        outcomes=(ex.Output("height", "m", scale=1.0, noise_sd=0.5),),
        parameters=(ex.Parameter("slope", "", 0.0, scale=1.0, positive=False),),
    )

    def outcome(self, design, params):
        return params.slope * design


def totals(task, prior, actions, dense=True, num_plants=255, episodes=2000):
    """Sum of the rewards of each episode under the same actions."""
    plant = task() if isinstance(task, type) else task
    objective = ContrastiveGain(plants_of(plant, prior), num_plants, dense=dense)
    layout = Layout.of(plant.description, 1, len(actions))
    env = Env.of(
        plant, objective=objective, layout=layout, penalty_weight=0.0, prior=plants_of(plant, prior)
    )

    def of(key):
        def advance(state, action):
            state, made = env.step(state, action)
            return state, made.reward

        return jnp.sum(jax.lax.scan(advance, env.reset(key)[0], jnp.asarray(actions))[1])

    return np.asarray(eqx.filter_jit(jax.vmap(of))(jax.random.split(jax.random.key(0), episodes)))


def test_the_reward_of_a_line_is_the_information_gained():
    places = np.array([[1.0], [0.5], [-1.0]])
    exact = 0.5 * np.log1p(np.sum(places**2) / 0.5**2)
    found = totals(Line, {"slope": "normal:0:1"}, places)
    assert found.mean() == pytest.approx(exact, abs=4 * found.std() / np.sqrt(len(found)))


def test_the_answer_to_a_question_tells_what_its_entropy_says():
    at, width = np.linspace(-6, 6, 2001, retstep=True)
    yes = norm.cdf(4 * (at - 0.5)).clip(1e-12, 1 - 1e-12)
    density = norm.pdf(at) * width
    exact = entropy(density @ yes) - density @ entropy(yes)
    found = totals(Question, {"at": "normal:0:1"}, [[0.5 / 3]])
    assert found.mean() == pytest.approx(exact, abs=4 * found.std() / np.sqrt(len(found)))


def test_the_last_reward_is_the_sum_of_those_at_every_step():
    actions = np.array([[1.0], [0.5], [-1.0]])
    both = [totals(Line, {"slope": "normal:0:1"}, actions, dense, 15, 8) for dense in (False, True)]
    np.testing.assert_allclose(*both, rtol=1e-9)
    assert np.all(both[0] <= np.log(16))


@pytest.mark.slow
def test_of_a_plant_with_a_state_it_is_the_bound_that_is_evaluated():
    """Two computations: with the experiment, and afterwards from its record."""
    plant = with_sensor(Aero2(), {"pitch": 0.02}, None)
    prior = {
        "J_p": "lognormal:0.022:50%",
        "K_pu": "lognormal:0.011:50%",
        "D_p": "lognormal:0.007:50%",
    }
    actions = np.where(np.arange(12) % 6 < 3, 0.5, -0.5)[:, None]
    found = totals(plant, prior, actions, num_plants=63, episodes=256)
    inputs = actions * np.asarray(plant.input_limits[1])
    theirs = ex.information_gain(
        plant, Replay(jnp.asarray(inputs)), steps=12, prior=prior, plants=256, samples=63,
        from_prior=True,
    )  # fmt: skip
    error = np.hypot(found.std() / 16, theirs.lower.std_error)
    assert found.mean() == pytest.approx(theirs.lower.value, abs=4 * error)
    assert theirs.lower.value > 0.5


def test_a_policy_trained_for_it_measures_at_the_ends():
    """A gradient through a likelihood; what is measured has none."""
    prior = plants_of(Line(), {"slope": "normal:0:1"})
    layout = Layout.of(Line().description, 1, 2)
    env = Env.of(
        Line(), objective=ContrastiveGain(prior, 63, dense=False), layout=layout, prior=prior
    )
    settings = GradientSettings(num_updates=200, num_plants=64, learning_rate=1e-2, hidden=(8,),
                                watch_every=50, watch_episodes=512)  # fmt: skip
    made = train(env, settings, 0)
    assert made.validation["worth"] > 0.9 * 0.5 * np.log1p(8)  # both places at an end


def test_a_study_names_it_and_its_plants():
    settings = AgentSettings(
        method="gradient", decision={"reward": "contrast", "contrast_plants": 31, "weight": 2.0}
    )
    agent = Agent.of(settings, {}, {}, {})
    objective = agent.env(Aero2(), 0.3, 20).objective
    assert (objective.num_plants, objective.weight, objective.dense) == (31, 2.0, False)
    assert (
        "contrast_plants" not in Agent.of(AgentSettings(), {}, {}, {}).settings(Aero2())["decision"]
    )
    with pytest.raises(ValueError, match=r"sPCE .reward 'contrast'. is of all parameters"):
        Agent.of(settings.model_copy(update={"targets": ["J_p"]}), {}, {}, {}).env(Aero2(), 0.3, 20)
    with pytest.raises(ValueError, match="the reward 'contrast' has no 'criterion'"):
        Agent.of(AgentSettings(decision={"reward": "contrast", "criterion": "A"}), {}, {}, {})


class Root(Line):
    """Not a number for half of the plants."""

    def outcome(self, design, params):
        return jnp.sqrt(params.slope + 0.1 * design)


def test_a_plant_that_cannot_be_computed_leaves_the_gradient_finite():
    task = Root()
    prior, true = plants_of(task, {"slope": "normal:1:1"}), task.Params(jnp.asarray(1.0))
    objective = ContrastiveGain(prior, 31)
    memory = objective.init(task, jnp.zeros(1), jax.random.key(0))

    def reward(design):
        sample = StepData(true, jnp.zeros(2), design, task.outcome(design, true))
        return objective.update(task, memory, sample, jnp.asarray(0))[1]

    assert jnp.any(memory.params.slope < -0.1)
    slope = jax.grad(lambda design: jnp.sum(reward(design)))(jnp.array([0.5]))
    step = 1e-5
    ends = [float(reward(jnp.array([0.5 + way * step]))) for way in (-1, 1)]
    assert float(slope[0]) == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-4)


@pytest.mark.slow
def test_it_is_an_objective_of_training():
    policy = ex.train(
        Line(), method="ppo", objective="sPCE", contrast_plants=15, prior={"slope": "normal:0:1"},
        steps=4, window=1, episodes=8,
        training={"total_steps": 256, "num_envs": 4, "n_steps": 16, "batch_size": 64},
    )  # fmt: skip
    assert policy.layout.num_steps == 4
    with pytest.raises(ValueError, match="are for the objectives sPCE, ACE and InfoNCE: got D"):
        ex.train(Line(), contrast_plants=15)
    with pytest.raises(ValueError, match="compares plants that differ: give a spread or a prior"):
        ex.train(Aero2(), objective="sPCE", spread=0.0)
