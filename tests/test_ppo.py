"""Training with Stable-Baselines3: known answers, repeatability, checkpoints."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO

from excite.environment import AbstractObjective, Env
from excite.environment.gymnasium import ExperimentVectorEnv
from excite.plant import Aero2
from excite.policy import Layout, Policy
from excite.training.checkpoint import Checkpoint
from excite.training.ppo import BatchedVecEnv, policy_weights, train
from excite.training.settings import PPOSettings
from excite.training.validation import validate

TINY = PPOSettings(
    total_steps=4 * 8 * 30, num_envs=8, n_steps=30, batch_size=60, n_epochs=2,
    learning_rate=1e-3, learning_rate_end=1e-4, noise_sd=0.5, noise_sd_end=0.2,
    watch_every=2, watch_episodes=5, average_last=0.6,
)  # fmt: skip


def aero2(num_steps: int = 30) -> Env:
    plant = Aero2()
    return Env.of(plant, layout=Layout.of(plant.description, 5, num_steps))


def same(a: Any, b: Any) -> bool:
    return all(
        np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


# Probes: decision processes whose best policy is known


class Probe(AbstractObjective):
    """Minus the squared distance of the first voltage, over 24 V, from `first`, given at the end;
    and of every later one from `later`, given at once."""

    first: float = 0.5
    later: float = 0.5

    def init(self, plant, measured, key):
        return jnp.zeros(())

    def update(self, plant, memory, sample, k):
        action = sample.input[0] / 24
        now = jnp.where(k == 0, 0.0, -((action - self.later) ** 2))
        return jnp.where(k == 0, -((action - self.first) ** 2), memory), now

    def final(self, plant, memory, params):
        return memory

    def relative_errors(self, plant, memory, params):
        return jnp.zeros(3)


@pytest.mark.science
@pytest.mark.parametrize(
    ("num_steps", "first", "later"), [(1, 0.5, 0.0), (2, 0.4, -0.4), (4, -0.5, 0.25)]
)
def test_the_best_policy_of_a_probe_is_found(num_steps, first, later):
    plant = Aero2()
    layout = Layout.of(plant.description, 2, num_steps)
    env = Env.of(plant, layout=layout, objective=Probe(first, later))
    settings = PPOSettings(
        total_steps=64 * 8 * 25, num_envs=64, n_steps=8, batch_size=128, gamma=1.0,
        learning_rate=3e-3, learning_rate_end=1e-4, noise_sd=0.5, noise_sd_end=0.05,
        watch_every=100,
    )  # fmt: skip
    policy = Policy(plant.description, layout, train(env, settings, 0).weights)
    state, observation = env.reset(jax.random.key(3))
    for k in range(num_steps):
        action = policy(np.asarray(observation))
        assert action[0] == pytest.approx(first if k == 0 else later, abs=0.05)
        state, transition = env.step(state, jnp.asarray(action))
        observation = transition.observation


class Counting(ExperimentVectorEnv):
    """Two environments of three and five steps; the reward counts the steps."""

    def __init__(self):
        self.num_envs = 2

    single_observation_space = spaces.Box(0, 9, (1,), np.float32)
    single_action_space = spaces.Box(-1, 1, (1,), np.float32)
    lengths = np.array([3, 5])

    def reset(self, *, seed=None, options=None):
        self.seed, self.k = seed, np.zeros(2, int)
        return self.k[:, None].astype(np.float32), {}

    def step(self, actions):
        self.k += 1
        rewards, done = self.k.astype(float), self.k == self.lengths
        last = self.k[:, None].astype(np.float32)
        self.k = np.where(done, 0, self.k)
        final = {"final_obs": last, "_final_obs": done, "final_info": {"is_violation": done}}
        return self.k[:, None].astype(np.float32), rewards, done, done & False, final


def test_the_adapter_tells_returns_lengths_and_last_observations():
    env = BatchedVecEnv(Counting())  # pyright: ignore[reportArgumentType]
    env.seed(7)
    assert env.reset().tolist() == [[0], [0]]
    assert env.env.seed == 7  # pyright: ignore[reportAttributeAccessIssue]
    ended = []
    for k in range(1, 16):
        observations, _, dones, infos = env.step(np.zeros((2, 1)))
        assert np.asarray(observations).tolist() == [[k % 3], [k % 5]]  # pyright: ignore[reportArgumentType]
        for i in np.flatnonzero(dones):
            assert infos[i]["terminal_observation"] == env.env.lengths[i]  # pyright: ignore[reportAttributeAccessIssue]
            ended.append((int(i), infos[i]["episode"]["r"], infos[i]["episode"]["l"]))
            assert infos[i]["is_violation"]
        assert all(not infos[i] for i in np.flatnonzero(~dones))
    assert sorted(ended) == [(0, 6.0, 3)] * 5 + [(1, 15.0, 5)] * 3


# Repeatability and checkpoints


@pytest.fixture(scope="module")
def run() -> tuple[Any, dict[int, bytes]]:
    """A whole training, and a checkpoint of every rollout boundary as a file."""
    files: dict[int, bytes] = {}

    def keep(make, row):
        checkpoint = make()
        files[checkpoint.state["num_steps"]] = checkpoint.to_bytes()

    return train(aero2(), TINY, 3, on_boundary=keep), files


@pytest.mark.science
def test_training_twice_gives_the_same_weights(run):
    again = train(aero2(), TINY, 3)
    assert same(again.weights, run[0].weights)
    assert again.curve[1:] == run[0].curve[1:]


@pytest.mark.science
def test_another_seed_gives_other_weights(run):
    assert not same(train(aero2(), TINY, 4).weights, run[0].weights)


@pytest.mark.slow
@pytest.mark.parametrize("num_steps", [0, 240, 480, 720, 960])
def test_an_interrupted_training_goes_on_as_if_nothing_had_happened(run, num_steps):
    trained, files = run
    np.random.seed(1)  # (whatever the new process did before)
    torch.manual_seed(1)
    saved = Checkpoint.from_bytes(files[num_steps], "checkpoint")
    resumed = train(aero2(), TINY, 3, resume=saved)
    assert same(resumed.weights, trained.weights)
    assert resumed.curve[1:] == trained.curve[1:]


def test_an_episode_goes_on_across_rollouts_and_interruptions():
    settings = dataclasses.replace(
        TINY, n_steps=20, batch_size=80, total_steps=4 * 8 * 20
    )  # T is 30
    files = []
    whole = train(
        aero2(), settings, 0, on_boundary=lambda make, row: files.append(make().to_bytes())
    )
    half = Checkpoint.from_bytes(files[2], "checkpoint")
    assert same(train(aero2(), settings, 0, resume=half).weights, whole.weights)


def test_a_checkpoint_is_no_pickle_and_a_broken_one_is_refused(run):
    content = run[1][480]
    assert content[8:9] == b"{"
    for broken in (content[:100], content[: len(content) // 2], b"", b"\x80\x04K\x01."):
        with pytest.raises(ValueError, match="truncated"):
            Checkpoint.from_bytes(broken, "checkpoint")


def test_the_policy_is_the_network_that_was_trained(run):
    env = aero2()
    policy = Policy(env.plant.description, env.layout, run[0].weights)
    observations = np.random.default_rng(0).normal(size=(200, env.layout.size)).astype(np.float32)
    assert np.ptp([policy(o) for o in observations]) > 1e-3
    space = spaces.Box(-np.inf, np.inf, (env.layout.size,), np.float32)
    probe = Counting()
    probe.single_observation_space = space
    model = PPO(
        "MlpPolicy", BatchedVecEnv(probe), policy_kwargs={"net_arch": [64, 64]}, device="cpu"
    )  # pyright: ignore[reportArgumentType]
    mine = Policy(env.plant.description, env.layout, policy_weights(model))
    theirs, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose([mine(o) for o in observations], theirs, atol=1e-5)


# Watching


def test_the_noise_is_annealed_and_the_curve_says_so(run):
    noise = [row["noise_sd"] for row in run[0].curve]
    assert noise[0] == pytest.approx(0.5)
    assert np.all(np.diff(noise) < 0)
    assert [row["steps"] for row in run[0].curve] == [0, 480, 960]
    assert TINY.noise_at(1.0) == pytest.approx(0.2)
    assert TINY.learning_rate_at(0.0) == pytest.approx(1e-4)


def test_the_policy_is_the_average_of_the_last_ones():
    settings = dataclasses.replace(TINY, average_last=0.5)  # 4 rollouts: after 2, 3 and 4
    made = []

    def keep(make, row):
        tensors = make().tensors
        made.append([tensors[f"policy.mlp_extractor.policy_net.{i}.weight"] for i in (0, 2)])

    averaged = train(aero2(), settings, 3, on_boundary=keep)
    assert len(made) == 5
    for i in (0, 1):
        expected = np.mean([m[i] for m in made[2:]], axis=0)
        np.testing.assert_allclose(averaged.weights[i][0], expected, rtol=1e-5, atol=1e-7)
    last = train(aero2(), dataclasses.replace(settings, average_last=0.0), 3)
    np.testing.assert_array_equal(last.weights[0][0], made[-1][0])


def test_the_noise_is_learnt_where_none_is_given():
    settings = dataclasses.replace(TINY, noise_sd_end=None)
    noise = [row["noise_sd"] for row in train(aero2(), settings, 0).curve]
    assert noise[0] == pytest.approx(0.5)
    assert noise[-1] != pytest.approx(0.5, abs=1e-4)


@pytest.mark.slow
def test_watching_plays_the_deterministic_policy(run):
    env, keys = aero2(), jax.random.split(jax.random.key(5), 3)
    seen = validate(env, run[0].weights, keys)
    policy = Policy(env.plant.description, env.layout, run[0].weights)
    step = eqx.filter_jit(env.step)
    for i, key in enumerate(keys):
        state, observation = env.reset(key)
        total, squares = 0.0, []
        for _ in range(env.layout.num_steps):
            action = policy(np.asarray(observation))
            state, transition = step(state, jnp.asarray(action))
            observation = transition.observation
            total += float(transition.reward)
            squares.append(float(action[0]) ** 2)
        assert float(seen.total_reward[i]) == pytest.approx(total, rel=1e-3)
        assert float(seen.rms_action[i]) == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-4)


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"total_steps": 0}, "total_steps"), ({"num_envs": -1}, "num_envs"),
        ({"gamma": 1.5}, "gamma"), ({"gae_lambda": 0.0}, "gae_lambda"),
        ({"learning_rate": -1.0}, "learning_rate"), ({"noise_sd": 0.0}, "noise_sd"),
        ({"hidden": ()}, "hidden"), ({"average_last": 1.0}, "average_last"),
        ({"batch_size": 10_000}, "batch_size"), ({"batch_size": 7}, "batch_size"),
        ({"noise_sd_end": -0.1}, "noise_sd_end"),
        ({"watch_every": 0}, "watch_every"), ({"learning_rate_end": -1e-4}, "learning_rate_end"),
    ],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused(wrong, word):
    with pytest.raises(ValueError, match=word):
        dataclasses.replace(TINY, **wrong)


def test_torch_trains_in_one_thread_and_gets_its_threads_back():
    before, seen = torch.get_num_threads(), []
    torch.set_num_threads(2)
    try:
        train(aero2(), TINY, 0, on_boundary=lambda *_: seen.append(torch.get_num_threads()))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert set(seen) == {1}
