"""A critic that learns, with the policy, which parameters belong to which record."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm
from test_contrast import Line
from test_own_noise import Question, entropy

import excite as ex
from excite.environment import CriticGain, Env, InformationGain, WeightedSum
from excite.estimation.prior_knowledge import plants_of
from excite.plant.aero2 import Aero2
from excite.policy import Layout
from excite.study.agent import Agent, AgentSettings
from excite.training.checkpoint import Checkpoint
from excite.training.gradient import experiments, started, train, train_all, update_all
from excite.training.settings import GradientSettings

SMALL = GradientSettings(
    num_updates=4, num_plants=8, hidden=(4,), learning_rate=1e-2, watch_every=2, watch_episodes=8
)


def env_of(task, prior, steps, num_plants=63, **more):
    population = plants_of(task, prior)
    objective = CriticGain(population, steps, num_plants, **more)
    layout = Layout.of(task.description, 1, steps)
    return Env.of(task, objective=objective, layout=layout, prior=population)


def learnt(env, num_updates, rate=3e-3):
    """Worth on many new plants, after a training of policy and critic."""
    settings = dataclasses.replace(SMALL, num_updates=num_updates, num_plants=64, hidden=(8,),
                                   learning_rate=rate)  # fmt: skip
    course, keys = started(env, settings, [0])
    now = course.now
    for i in range(num_updates):
        now, _ = update_all(env, settings, now, keys(i), False, None)
    own = jax.tree.map(lambda x: x[0], now)
    batch = experiments(own.env(env), own.player, jax.random.split(jax.random.key(9), 4000), 0.9)
    return np.asarray(batch.worth)


@pytest.mark.slow
def test_it_learns_the_gain_of_a_line_but_never_more():
    found = learnt(env_of(Line(), {"slope": "normal:0:1"}, 2, 31), 400)
    exact = 0.5 * np.log1p(8)  # both places at an end
    assert 0.8 * exact < found.mean() < exact + 4 * found.std() / np.sqrt(len(found))


@pytest.mark.slow
def test_it_needs_no_likelihood():
    """A question with two answers, whose best place is the middle of the prior."""
    at, width = np.linspace(-6, 6, 2001, retstep=True)
    yes = norm.cdf(4 * at).clip(1e-12, 1 - 1e-12)
    density = norm.pdf(at) * width
    exact = entropy(density @ yes) - density @ entropy(yes)
    found = learnt(env_of(Question(), {"at": "normal:0:1"}, 1), 300)
    assert 0.85 * exact < found.mean() < exact + 4 * found.std() / np.sqrt(len(found))


def test_without_a_critic_nothing_is_rewarded_but_calm_inputs():
    task, population = Line(), plants_of(Line(), {"slope": "normal:0:1"})
    objective = CriticGain(population, 2, 7, change_price=2.0)
    layout = Layout.of(task.description, 1, 2)
    env = Env.of(task, objective=objective, layout=layout, penalty_weight=0.0, prior=population)
    state, _ = env.reset(jax.random.key(0))
    rewards = []
    for action in (0.5, -0.5):
        state, made = env.step(state, jnp.array([action]))
        rewards.append(float(made.reward))
    np.testing.assert_allclose(rewards, [-2 * 0.25, -2 * 1.0])
    assert np.isfinite(made.relative_errors).all()


def test_a_training_that_was_interrupted_goes_on_with_its_critic():
    env, kept = env_of(Line(), {"slope": "normal:1:1"}, 2, 7), []

    def keep(made, row):
        kept.append(made().to_bytes())

    whole = train(env, SMALL, 3, on_boundary=keep)
    resumed = train(env, SMALL, 3, resume=Checkpoint.from_bytes(kept[2], "kept"))
    for ours, theirs in zip(whole.weights, resumed.weights, strict=True):
        np.testing.assert_array_equal(ours[0], theirs[0])
    assert whole.curve == resumed.curve


def test_several_trainings_have_a_critic_each():
    env = env_of(Line(), {"slope": "normal:1:1"}, 2, 7)
    several, one = train_all(env, SMALL, [3, 4]), train(env, SMALL, 4)
    np.testing.assert_allclose(several[1].weights[0][0], one.weights[0][0], atol=1e-4)
    parts = started(env, SMALL, [3, 4])[0].now.trained
    assert not np.allclose(*parts.params[0][0])


def test_it_is_a_term_of_a_sum():
    """Its critic is trained there, too."""
    env = env_of(Line(), {"slope": "normal:1:1"}, 2, 7)
    information = InformationGain((True,), 1.0, dense=False)
    both = dataclasses.replace(env, objective=WeightedSum((information, env.objective)))
    course, keys = started(both, SMALL, [0])
    now, _ = update_all(both, SMALL, course.now, keys(0), False, None)
    before, after = course.now.trained, now.trained
    assert before[0] is after[0] is None
    assert not np.allclose(before[1].params[0][0], after[1].params[0][0])


def test_a_study_names_it_and_ppo_refuses_it():
    settings = AgentSettings(method="gradient", decision={"reward": "critic"})
    objective = Agent.of(settings, {}, {}, {}).env(Aero2(), 0.3, 20).objective
    assert (objective.num_plants, objective.num_steps, objective.critic) == (255, 20, None)
    by_ppo = Agent.of(settings.model_copy(update={"method": "ppo"}), {}, {}, {})
    with pytest.raises(ValueError, match="ppo does not train a critic: take the method gradient"):
        by_ppo.env(Aero2(), 0.3, 20)
    several = Agent.of(settings, {"window": 1}, {"starts": 4}, {})
    with pytest.raises(
        ValueError, match=r"InfoNCE .reward 'critic'. cannot compare several starts"
    ):
        several.env(Aero2(), 0.3, 20)


@pytest.mark.slow
def test_it_is_an_objective_of_training():
    policy = ex.train(
        Line(), objective="InfoNCE", contrast_plants=3, prior={"slope": "normal:1:1"}, steps=4,
        window=1, episodes=8, updates=2, training={"num_plants": 4, "hidden": [4]},
    )  # fmt: skip
    own = policy.provenance["decision"]
    assert (own["reward"], own["contrast_plants"]) == ("critic", 3)
    assert len(policy.weights) == 2
