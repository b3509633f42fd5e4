"""The Gymnasium face: its checkers, one plant and many, in any program around it."""

import re
import subprocess
import sys
from typing import Any

import equinox as eqx
import gymnasium
import jax
import numpy as np
import pytest
from commands import PATIENCE
from gymnasium.envs.registration import registry
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from excite.environment import Env, InformationGain
from excite.environment.gymnasium import ExperimentEnv, ExperimentVectorEnv
from excite.plant import Aero2
from excite.policy import Layout

MODULE = "excite.environment.gymnasium:"
IDS = sorted(name for name in registry if name.startswith("excite/"))
AERO2 = "excite/Aero2-v0"
SHORT = Layout.of(Aero2.definition, window=4, num_steps=3)

ids = pytest.mark.parametrize("name", IDS)


def make(name: str = AERO2, **choices: Any) -> Any:
    return gymnasium.make(MODULE + name, **choices)


def make_vec(name: str = AERO2, **choices: Any) -> Any:
    return gymnasium.make_vec(MODULE + name, **choices)


def test_every_plant_is_registered():
    assert [f"excite/{name}-v0" for name in ("Aero2", "CartPole", "DCMotor", "EMPS")] == IDS


@ids
def test_the_checkers_are_content(name):
    env = make(name)
    check_env(env.unwrapped)
    stable_baselines3 = pytest.importorskip("stable_baselines3.common.env_checker")
    stable_baselines3.check_env(env.unwrapped)
    env.action_space.seed(0)
    env.reset(seed=1)
    info: dict[str, Any] = {}
    for _ in range(5):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert observation in env.observation_space
        assert not terminated
        assert not truncated
        assert np.isfinite(reward)
    plant = env.unwrapped.process.plant
    names = [f"relative_error_{p.name}" for p in plant.definition.parameters]
    assert sorted(info) == sorted(["is_violation", *names])
    assert all(type(info[name]) is float for name in names)
    assert type(info["is_violation"]) is bool


def test_the_docstring_names_the_right_sizes():
    env = make()
    rows = re.findall(r"^ *\| (\d+)(?: - (\d+))? +\|(.*)\|$", ExperimentEnv.__doc__ or "", re.M)
    actions, observations = rows[:1], rows[1:]
    assert len(observations) == 3
    for space, table in ((env.action_space, actions), (env.observation_space, observations)):
        expected = 0
        for first, last, columns in table:
            assert int(first) == expected
            expected = int(last or first) + 1
            low, high = (float(column) for column in columns.split("|")[1:3])
            part = slice(int(first), expected)
            np.testing.assert_allclose(space.low[part], low, rtol=1e-2)
            np.testing.assert_allclose(space.high[part], high, rtol=1e-2)
        assert space.shape == (expected,)
    assert env.observation_space.shape == (161,)
    assert f"T = {env.unwrapped.process.layout.num_steps} steps" in (ExperimentEnv.__doc__ or "")


def test_one_plant_is_the_process_step_by_step():
    env = make(layout=SHORT).unwrapped
    observation, info = env.reset(seed=3)
    assert info == {}
    state = env._state
    process = Env.of(Aero2(), layout=SHORT)
    step = eqx.filter_jit(Env.step)
    np.testing.assert_array_equal(np.flatnonzero(observation), [3])
    for k in range(3):
        action = np.array([(-1.0) ** k * 0.7], np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        state, transition = step(process, state, jax.numpy.asarray(action))
        np.testing.assert_allclose(observation, transition.observation, atol=1e-6)
        assert reward == pytest.approx(float(transition.reward), abs=1e-6)
        assert (terminated, truncated) == (k == 2, False)
        assert info["is_violation"] == transition.is_violation
        errors = [info[f"relative_error_{p}"] for p in ("J_p", "K_pu", "D_p")]
        np.testing.assert_allclose(errors, transition.relative_errors, atol=1e-6)


def test_a_seed_gives_the_same_plants_again():
    def run(env: Any, seed: int) -> tuple[np.ndarray, ...]:
        action = np.full(env.action_space.shape, 0.5, np.float32)
        seen = [env.reset(seed=seed)[0], env.step(action)[0]]
        seen += [env.reset()[0], env.step(action)[0]]
        return tuple(np.array(s) for s in seen)

    for env, again in ((make(), make()), (make_vec(num_envs=2), make_vec(num_envs=2))):
        ours, theirs, other = run(env, 4), run(again, 4), run(env, 5)
        np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(ours, run(env, 4))
        for a, b in zip(ours, other, strict=True):
            assert np.any(a != b)
        assert np.any(ours[0] != ours[2])  # without a seed another episode follows


def test_the_agent_may_keep_and_change_what_it_is_given():
    env = make_vec(num_envs=2)
    observation, _ = env.reset(seed=0)
    kept = observation.copy()
    after, *_ = env.step(np.ones((2, 1), np.float32))
    np.testing.assert_array_equal(observation, kept)
    after[:] = 0
    single = make()
    single.reset(seed=0)[0][:] = 0


@pytest.mark.parametrize("env", [make, lambda: make().unwrapped, lambda: make_vec(num_envs=2)])
def test_a_step_before_the_first_reset_is_refused(env):
    env = env()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(env.action_space.sample())


def test_a_step_after_the_last_is_refused_until_the_next_reset():
    env = make(layout=SHORT).unwrapped
    env.reset(seed=0)
    action = np.zeros(1, np.float32)
    assert [env.step(action)[2] for _ in range(3)] == [False, False, True]
    with pytest.raises(gymnasium.error.ResetNeeded, match="no episode is running"):
        env.step(action)
    env.reset()
    assert not env.step(action)[2]


# ---------------------------------------------------------------------------- vectors


@pytest.mark.slow
def test_many_plants_are_stepped_as_one():
    env = make_vec(num_envs=128, layout=SHORT)
    assert isinstance(env.unwrapped, ExperimentVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert env.num_envs == 128
    assert env.single_observation_space == make(layout=SHORT).observation_space
    assert env.single_action_space == make(layout=SHORT).action_space
    observations, infos = env.reset(seed=0)
    assert infos == {}
    assert observations in env.observation_space
    assert len(np.unique(observations[:, 3])) == 128
    env.action_space.seed(0)
    step = eqx.filter_jit(jax.vmap(Env.step, in_axes=(None, 0, 0)))
    for k in range(5):
        states, actions = env.batch.states, env.action_space.sample()
        observations, rewards, terminated, truncated, infos = env.step(actions)
        _, expected = step(env.process, states, jax.numpy.asarray(actions))
        assert observations in env.observation_space
        assert observations.dtype == np.float32
        assert rewards.shape == terminated.shape == truncated.shape == (128,)
        assert not truncated.any()
        np.testing.assert_allclose(rewards, expected.reward, atol=1e-6)
        assert np.all(terminated == (k == 2))
        if k != 2:
            assert infos == {}
            np.testing.assert_allclose(observations, expected.observation, atol=1e-6)
            continue
        # The next episodes have begun; the last observations of those that ended are told.
        np.testing.assert_array_equal(np.unique(np.nonzero(observations)[1]), [3])
        np.testing.assert_array_equal(infos["_final_obs"], True)
        np.testing.assert_array_equal(infos["_final_info"], True)
        np.testing.assert_allclose(infos["final_obs"], expected.observation, atol=1e-6)
        np.testing.assert_array_equal(infos["final_obs"][:, -1], 1.0)
        final = infos["final_info"]
        np.testing.assert_array_equal(final["is_violation"], expected.is_violation)
        for i, name in enumerate(("J_p", "K_pu", "D_p")):
            errors = final[f"relative_error_{name}"]
            np.testing.assert_allclose(errors, expected.relative_errors[:, i], atol=1e-6)


def test_a_row_is_what_the_same_plant_gives_alone():
    env, alone = make_vec(num_envs=3, layout=SHORT), make(layout=SHORT).unwrapped
    env.reset(seed=0)
    alone.reset(seed=0)
    alone._state = jax.tree.map(lambda leaf: leaf[1], env.batch.states)
    for value in (0.5, -1.0):
        observations, rewards, *_ = env.step(np.full((3, 1), value, np.float32))
        observation, reward, *_ = alone.step(np.full(1, value, np.float32))
        np.testing.assert_allclose(observations[1], observation, atol=1e-6)
        assert rewards[1] == pytest.approx(reward, abs=1e-6)


# ---------------------------------------------------------------------------- choices


@pytest.mark.parametrize("kind", [make, lambda **choices: make_vec(num_envs=1, **choices)])
def test_choices_reach_the_process(kind):
    objective = InformationGain((True, True, True), 0.1)
    plant = Aero2(g=3.7)
    env = kind(
        spread=0.05, penalty_weight=0.002, layout=SHORT, plant=plant, objective=objective
    ).unwrapped
    process = env.process
    assert float(process.spread.reach) == 0.05
    assert float(process.penalty_weight) == 0.002
    assert process.layout == SHORT
    assert float(process.plant.constants.g) == pytest.approx(3.7)
    assert isinstance(process.objective, InformationGain)
    assert float(process.objective.prior_sd) == pytest.approx(0.1)
    assert env.observation_space.shape[-1:] == (SHORT.size,)
    with pytest.raises(TypeError, match="spraed"):
        kind(spraed=0.05)


@pytest.mark.parametrize("kind", [make, make_vec])
@pytest.mark.parametrize(
    ("choices", "sentence"),
    [
        ({"spread": -1}, r"spread must lie in \[0, 1\), .*: got -1"),
        ({"spread": 2.0}, r"spread must lie in \[0, 1\), .*: got 2"),
        ({"spread": np.nan}, "spread must lie in"),
        ({"penalty_weight": -1}, r"penalty_weight must lie in \[0, inf\): got -1"),
        ({"penalty_weight": np.inf}, r"penalty_weight must lie in \[0, inf\): got inf"),
    ],
)
def test_a_choice_that_is_not_allowed_is_told_in_a_sentence(kind, choices, sentence):
    with pytest.raises(ValueError, match=sentence):
        kind(**choices)


@pytest.mark.parametrize("num_envs", [0, -1])
def test_a_batch_needs_an_environment(num_envs):
    with pytest.raises(ValueError, match=f"num_envs must be at least 1: got {num_envs}"):
        make_vec(num_envs=num_envs)


def test_a_smaller_spread_draws_closer_plants():
    env = make_vec(num_envs=64, spread=0.05)
    env.reset(seed=0)
    ratio = np.stack(env.batch.states.params) / np.stack(Aero2().nominal)[:, None] - 1
    assert 0.04 < np.abs(ratio).max() <= 0.05 + 1e-12


# ----------------------------------------------------------- the program around it

PROGRAM = """
import sys
import gymnasium, jax, jax.numpy as jnp, numpy as np
from excite.plant import Aero2

jax.config.update("jax_enable_x64", "double" in sys.argv)  # after the package switched it on
dtype = jnp.float64 if "double" in sys.argv else jnp.float32
seen = []
choices = [{}, {"plant": Aero2(initial_state=jnp.array([0.25, 0.0]))}]
for made in choices:
    env = gymnasium.make("excite.environment.gymnasium:excite/Aero2-v0", **made)
    many = gymnasium.make_vec("excite.environment.gymnasium:excite/Aero2-v0", num_envs=2, **made)
    seen += [env.reset(seed=1)[0], *many.reset(seed=1)[0]]
    for k in range(12):
        observation, reward, *_, info = env.step(np.array([(-1.0) ** (k // 3)], np.float32))
        assert jnp.zeros(1).dtype == dtype
    observations, *_ = many.step(np.ones((2, 1), np.float32))
    errors = [v for k, v in info.items() if k.startswith("relative_error")]
    seen += [observation, np.array([reward, *errors]), *observations]
    assert jnp.zeros(1).dtype == dtype
    state = env.unwrapped._state
    assert state.plant_state.dtype == np.float64
    # Constants, too, were never rounded to single precision.
    assert made or float(env.unwrapped.process.plant.constants.d_S) == 0.0019435
assert jax.config.jax_enable_x64 == ("double" in sys.argv)
np.savez(sys.argv[1], *seen)
"""


@pytest.mark.science
def test_a_program_in_single_precision_sees_the_same_and_stays_in_it(tmp_path):
    files = [tmp_path / "single.npz", tmp_path / "double.npz"]
    for path in files:
        command = [sys.executable, "-W", "error", "-c", PROGRAM, path, path.stem]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
        assert done.returncode == 0, done.stderr
    single, double = (np.load(path) for path in files)
    assert len(single.files) == len(double.files) == 14
    for i, name in enumerate(single.files):
        # The numbers of a plant made in single precision are rounded to it, no others are.
        if i not in (10, 11):
            rounding = 0.0 if i < 7 else 1e-6
            np.testing.assert_allclose(single[name], double[name], rtol=0, atol=rounding)
        assert np.any(single[name] != 0)


FORKED = """
import sys
import gymnasium
import numpy as np

if __name__ == "__main__":
    env = gymnasium.make_vec(
        "excite.environment.gymnasium:excite/Aero2-v0",
        num_envs=1, vectorization_mode="async", vector_kwargs={"context": sys.argv[1]},
    )
    env.reset(seed=0)
    print(env.step(np.zeros((1, 1), np.float32))[0].shape)
    env.close()
"""


@pytest.mark.slow
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_a_process_for_each_environment_is_spawned_or_refused(context, tmp_path):
    """A fork would hang in JAX."""
    program = tmp_path / "program.py"  # spawned processes import it
    program.write_text(FORKED)
    done = subprocess.run(
        [sys.executable, program, context], capture_output=True, text=True, timeout=PATIENCE
    )
    if context == "spawn":
        assert done.stdout == "(1, 161)\n", done.stderr
    else:
        assert done.returncode == 1
        assert "JAX does not support fork" in done.stderr
