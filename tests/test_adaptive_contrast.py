"""The contrast with probable plants as the reward of an experiment."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_contrast import Line, Root

import excite as ex
from excite.environment import AdaptiveContrastiveGain, Env, StepData, WeightedSum
from excite.estimation.prior_knowledge import plants_of
from excite.excitation import Replay
from excite.plant.aero2 import Aero2
from excite.plant.catalogue import plant_named, with_sensor
from excite.policy import Layout
from excite.study.agent import Agent, AgentSettings

PENDULUM = "examples/smc_pendulums.py:NonlinearPendulum"


def totals(plant, prior, actions, num_plants=15, episodes=512):
    """Sum of the rewards of each episode under the same actions, and the errors at its end."""
    population = plants_of(plant, prior)
    objective = AdaptiveContrastiveGain(population, len(actions), num_plants)
    layout = Layout.of(plant.description, 1, len(actions))
    env = Env.of(plant, objective=objective, layout=layout, penalty_weight=0.0, prior=population)

    def of(key):
        def advance(state, action):
            state, made = env.step(state, action)
            return state, (made.reward, made.relative_errors)

        rewards, errors = jax.lax.scan(advance, env.reset(key)[0], jnp.asarray(actions))[1]
        return jnp.sum(rewards), errors[-1]

    found = eqx.filter_jit(jax.vmap(of))(jax.random.split(jax.random.key(0), episodes))
    return [np.asarray(part) for part in found]


@pytest.mark.parametrize("noise_sd", [0.5, 0.01])
def test_the_reward_of_a_line_is_the_information_gained(noise_sd):
    """However large it is: that of the small noise is more than the logarithm of the plants."""
    task = with_sensor(Line(), {"height": noise_sd}, None)
    places = np.array([[1.0], [0.5], [-1.0]])
    exact = 0.5 * np.log1p(np.sum(places**2) / noise_sd**2)
    found, errors = totals(task, {"slope": "normal:3:1"}, places, 15, 2000)
    assert found.mean() == pytest.approx(exact, abs=0.03 + 4 * found.std() / np.sqrt(len(found)))
    assert (exact > np.log(16)) == (noise_sd == 0.01)
    assert np.median(errors) == pytest.approx(np.exp(-exact) / 3, rel=0.05)


def test_a_proposal_with_one_other_plant_is_still_a_lower_bound():
    places = np.array([[1.0], [0.5], [-1.0]])
    exact = 0.5 * np.log1p(np.sum(places**2) / 0.25)
    few, many = (totals(Line(), {"slope": "normal:0:1"}, places, n, 4000)[0] for n in (1, 63))
    assert few.mean() < many.mean() < exact + 4 * many.std() / np.sqrt(len(many))


def test_coordinates_are_those_of_the_parameters():
    plant, z = Aero2(), jnp.array([0.3, -1.2, 0.7])
    for prior, spread in (
        ({"J_p": "normal:0.022:5%", "K_pu": "lognormal:0.011:50%"}, 0.3),
        ({"D_p": "uniform:0.001:0.02"}, "factor:3"),
        ({}, 0.2),
        ({"J_p": "normal:0.022:5%"}, 0.0),
        ({"J_p": "normal:0.022:5%"}, "factor:1"),
    ):
        population = plants_of(plant, prior, spread)
        is_fixed = jnp.arange(3) > 0 if spread in (0.0, "factor:1") else jnp.zeros(3, bool)
        found = population.coordinates(population.params(z))
        np.testing.assert_allclose(found, jnp.where(is_fixed, 0.0, z), rtol=1e-9)


def test_the_gradient_is_that_of_differences():
    """Also of the part that goes through the proposal; inside the limits of the design."""
    prior = plants_of(Line(), {"slope": "normal:1:1"})
    objective = AdaptiveContrastiveGain(prior, 2, 3)
    layout = Layout.of(Line().description, 1, 2)
    env = Env.of(Line(), objective=objective, layout=layout, penalty_weight=0.0, prior=prior)
    keys = jax.random.split(jax.random.key(1), 64)

    @jax.jit
    @jax.value_and_grad
    def worth(scale):
        def of(key):
            state, _ = env.reset(key)
            for action in (0.5, -0.3):
                state, made = env.step(state, scale * jnp.array([action]))
            return made.reward

        return jnp.mean(jax.vmap(of)(keys))

    (low, _), (_, slope), (high, _) = (worth(1 + change) for change in (-1e-4, 0.0, 1e-4))
    assert float(slope) == pytest.approx(float(high - low) / 2e-4, rel=1e-3)


def test_an_experiment_of_another_length_is_refused():
    prior = plants_of(Line(), {"slope": "normal:1:1"})
    layout, objective = Layout.of(Line().description, 1, 4), AdaptiveContrastiveGain(prior, 6)
    for own in (objective, WeightedSum((objective,))):
        with pytest.raises(ValueError, match="for 6 steps: got experiments of 4"):
            Env.of(Line(), objective=own, layout=layout, prior=prior)


@pytest.mark.slow
def test_of_a_plant_with_a_state_it_is_the_gain_that_is_evaluated():
    plant = with_sensor(Aero2(), {"pitch": 0.005}, None)
    names = {"J_p": 0.022, "K_pu": 0.011, "D_p": 0.007}
    prior = {name: f"lognormal:{value}:50%" for name, value in names.items()}
    actions = np.where(np.arange(16) % 6 < 3, 0.5, -0.5)[:, None]
    found = totals(plant, prior, actions)[0]
    replay = Replay(jnp.asarray(actions * np.asarray(plant.input_limits[1])))
    theirs = ex.information_gain(plant, replay, steps=16, prior=prior, plants=256, samples=500)
    error = np.hypot(found.std() / np.sqrt(512), theirs.upper.std_error)
    assert theirs.lower.value - 0.2 - 4 * error < found.mean() < theirs.upper.value + 4 * error
    assert theirs.lower.value > np.log(16)


@pytest.mark.slow
def test_of_an_observed_state_it_is_that_of_its_steps():
    plant, prior = plant_named(PENDULUM), {"m": "lognormal:1:10%", "l": "lognormal:1:10%"}
    actions = np.where(np.arange(50) % 20 < 10, 1.0, -1.0)[:, None]
    found = totals(plant, prior, actions, 31)[0]
    replay = Replay(jnp.asarray(actions * np.asarray(plant.input_limits[1])))
    theirs = ex.information_gain(plant, replay, steps=50, prior=prior, plants=512, samples=200)
    error = np.hypot(found.std() / np.sqrt(512), theirs.lower.std_error)
    assert found.mean() == pytest.approx(theirs.lower.value, abs=0.05 + 4 * error)
    assert theirs.lower.value > 2


def test_plants_that_cannot_be_computed_leave_the_gradient_finite():
    task = Root()
    true = task.Params(jnp.asarray(1.0))
    objective = AdaptiveContrastiveGain(plants_of(task, {"slope": "normal:0.3:1"}), 1, 31)
    memory = objective.init(task, jnp.zeros(1), jax.random.key(0))

    def reward(design):
        sample = StepData(true, jnp.zeros(2), design, task.outcome(design, true))
        after = objective.update(task, memory, sample, jnp.asarray(0))[0]
        return objective.final(task, after, true)

    assert np.isfinite(reward(jnp.array([0.5])))
    assert np.isfinite(jax.grad(reward)(jnp.array([0.5]))).all()


def test_a_study_names_it_and_its_plants():
    settings = AgentSettings(
        method="gradient", decision={"reward": "adaptive_contrast", "change_price": 0.1}
    )
    objective = Agent.of(settings, {}, {}, {}).env(Aero2(), 0.3, 20).objective
    assert (objective.num_plants, objective.num_steps, objective.change_price) == (15, 20, 0.1)
    with pytest.raises(ValueError, match=r"ACE .reward 'adaptive_contrast'. is of all parameters"):
        Agent.of(settings.model_copy(update={"targets": ["J_p"]}), {}, {}, {}).env(Aero2(), 0.3, 20)
    for own, words in (({"dense": True}, "has no 'dense'"), ({"goals": {}}, "has no 'goals'")):
        with pytest.raises(ValueError, match=f"the reward 'adaptive_contrast' {words}"):
            Agent.of(AgentSettings(decision={"reward": "adaptive_contrast", **own}), {}, {}, {})
    drawn = {"reward": "adaptive_contrast", "constants": {"m_b": [1.0, 1.2]}}
    with pytest.raises(ValueError, match="is of plants with the same constants"):
        Agent.of(AgentSettings(decision=drawn), {}, {}, {}).env(Aero2(), 0.3, 20)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["gradient", "ppo"])
def test_it_is_an_objective_of_training(method):
    small = {
        "gradient": {"num_updates": 2, "num_plants": 4, "watch_episodes": 4},
        "ppo": {"total_steps": 256, "num_envs": 4, "n_steps": 16, "batch_size": 64},
    }
    policy = ex.train(
        Line(), method=method, objective="ACE", contrast_plants=3, prior={"slope": "normal:1:1"},
        steps=4, window=1, episodes=8, training={**small[method], "hidden": [4]},
    )  # fmt: skip
    own = policy.provenance["decision"]
    assert (own["reward"], own["contrast_plants"]) == ("adaptive_contrast", 3)
    with pytest.raises(ValueError, match="compares plants that differ: give a spread or a prior"):
        ex.train(Aero2(), objective="ACE", spread=0.0)
