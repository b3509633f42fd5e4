"""Policies that carry a memory from step to step."""

import dataclasses
import sys
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest
import torch

import excite as ex
from excite.cli import main
from excite.environment import Env, InformationGain
from excite.excitation import PolicyExcitation
from excite.plant import Aero2
from excite.policy import (
    Layout,
    Policy,
    act,
    empty_window,
    observe,
    respond,
    with_input,
    with_measurement,
)
from excite.policy.contract import remembered
from excite.rig.player import PolicyPlayer
from excite.simulation import run_episode
from excite.training.gradient import Network, experiments, started, train
from excite.training.settings import GradientSettings

MEMORY, STEPS = 5, 12
LAYOUT = Layout.of(Aero2.definition, window=1, num_steps=STEPS, memory=MEMORY)
SMALL: dict[str, Any] = {"num_plants": 2, "hidden": [4], "watch_episodes": 2}


def weights(seed: int = 0, memory: int = MEMORY) -> Any:
    rng = np.random.default_rng(seed)
    shapes = [(3 * memory, LAYOUT.size), (3 * memory, memory), (4, memory + LAYOUT.size), (1, 4)]
    return tuple(
        (rng.normal(size=s).astype(np.float32), rng.normal(size=s[0]).astype(np.float32))
        for s in shapes
    )


def policy(seed: int = 0) -> Policy:
    return Policy(Aero2().description, LAYOUT, weights(seed))


def env(**options: Any) -> Env:
    objective = InformationGain((True,) * 3, 1.0)
    return Env.of(Aero2(), objective=objective, layout=LAYOUT, **options)


def test_the_unit_is_that_of_torch():
    (into, into_bias), (back, back_bias), *_ = weights()
    cell = torch.nn.GRUCell(LAYOUT.size, MEMORY)
    with torch.no_grad():
        for name, value in (
            ("weight_ih", into), ("bias_ih", into_bias), ("weight_hh", back), ("bias_hh", back_bias)
        ):  # fmt: skip
            getattr(cell, name).copy_(torch.from_numpy(value))
        rng = np.random.default_rng(1)
        ours = np.zeros(MEMORY, np.float32)
        theirs = torch.zeros(1, MEMORY)
        for _ in range(20):
            seen = rng.normal(size=LAYOUT.size).astype(np.float32)
            ours = remembered(np, weights()[:2], ours, seen)
            theirs = cell(torch.from_numpy(seen)[None], theirs)
            np.testing.assert_allclose(ours, theirs[0].numpy(), atol=1e-6)


def test_numpy_on_a_rig_and_jax_in_a_simulation_give_the_same_inputs():
    rng, player = np.random.default_rng(2), PolicyPlayer(policy())
    excitation = PolicyExcitation.of(policy())
    state = excitation.init(Aero2(), STEPS, jax.random.key(0))
    for k in range(STEPS):
        measured = rng.normal(size=1) * 0.3
        ours = player(k, measured)
        player.applied(ours)
        state, theirs = excitation(state, jnp.asarray(measured))
        np.testing.assert_allclose(ours, theirs, atol=2e-3)  # of 24 V
        assert abs(ours[0]) < 24


def test_a_memory_tells_apart_what_the_window_no_longer_shows():
    def last(first: float) -> float:
        window, input = empty_window(np, LAYOUT), np.zeros(1)
        for k in range(STEPS):
            measured = np.array([first if k == 0 else 0.1])
            window, input = respond(np, LAYOUT, policy().weights, window, k, measured)
            window = with_input(np, LAYOUT, window, np.ones(1))
        return float(input[0])

    assert last(0.0) != last(0.5)


@pytest.mark.slow
def test_the_training_plays_what_the_simulation_plays():
    """The memory goes on from step to step in the gradient's experiments, too."""
    network = Network(PolicyExcitation.of(policy()).weights, LAYOUT)
    process = env(spread=0.0)
    keys = jax.random.split(jax.random.key(3), 2)
    batch = experiments(process, network, keys, 0.9)

    def largest(key: jax.Array) -> jax.Array:
        state, _ = process.reset(key)
        for _ in range(STEPS):
            state, action = network(state)
            state, _ = process.step(state, action)
        return jnp.max(state.max_abs_output)

    level = Aero2.definition.outputs[0].critical_level or 0.0
    sizes = [float(largest(key)) / level for key in keys]
    np.testing.assert_allclose(batch.nearness, sizes, rtol=1e-5)
    without = dataclasses.replace(network, weights=PolicyExcitation.of(policy(1)).weights)
    assert not np.allclose(experiments(process, without, keys, 0.9).nearness, sizes, rtol=1e-3)


def test_it_travels_in_its_file_and_others_keep_theirs(tmp_path):
    policy().save(tmp_path / "p.safetensors")
    read = ex.read_policy(tmp_path / "p.safetensors")
    assert read.layout.memory == MEMORY
    assert read.hash == policy().hash
    assert "5-4-1" in repr(read)
    run = run_episode(Aero2(), Aero2().nominal, PolicyExcitation.of(read), STEPS, jax.random.key(0))
    assert np.isfinite(run.inputs).all()
    assert b'"memory' not in ex.read_policy("aero2").to_bytes()


def test_a_new_memory_keeps_most_of_what_it_holds():
    """The gate that keeps begins above one half, and so do the others not."""
    weights: Any = started(env(), GradientSettings(), [0])[0].best.weights
    (_, into_bias), (_, bias), *_ = weights
    np.testing.assert_array_equal(into_bias[0], 0)
    np.testing.assert_array_equal(bias[0], np.repeat([0, 1, 0], MEMORY))
    unit = tuple((np.zeros((3 * MEMORY, n)), np.asarray(b)) for n, b in
                 ((LAYOUT.size, into_bias[0]), (MEMORY, bias[0])))  # fmt: skip
    after = remembered(np, unit, np.ones(MEMORY), np.zeros(LAYOUT.size))
    np.testing.assert_allclose(after, 1 / (1 + np.exp(-1)))


def test_trainers_refuse_what_they_cannot_train():
    with pytest.raises(ValueError, match="several starts are for policies without a memory"):
        train(env(), GradientSettings(starts=2), 0)
    with pytest.raises(ValueError, match="an environment's observation has no memory"):
        gymnasium.make("excite.environment.gymnasium:excite/Aero2-v0", layout=LAYOUT)


@pytest.mark.parametrize("part", range(4))
def test_a_unit_that_does_not_fit_is_refused(part):
    wrong = [list(layer) for layer in weights()]
    wrong[part // 2][part % 2] = wrong[part // 2][part % 2][:-1]
    with pytest.raises(ValueError, match="the unit of a memory of 5 numbers has other weights"):
        Policy(Aero2().description, LAYOUT, tuple(map(tuple, wrong)))  # pyright: ignore[reportArgumentType]


def test_a_unit_whose_weights_are_not_finite_and_a_negative_memory_are_refused():
    wrong = [list(layer) for layer in weights()]
    wrong[1][1] = wrong[1][1] * np.nan
    with pytest.raises(ValueError, match="the unit of the memory has weights that are not finite"):
        Policy(Aero2().description, LAYOUT, tuple(map(tuple, wrong)))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="memory must not be negative: got -1"):
        Layout.of(Aero2.definition, memory=-1)


def test_one_observation_is_not_enough_for_an_action():
    with pytest.raises(ValueError, match="this policy has a memory of 5 numbers"):
        policy()(np.zeros(LAYOUT.size, np.float32))


def test_other_runtimes_play_it_with_its_memory(tmp_path, monkeypatch, capsys):
    policy().save(tmp_path / "p.safetensors")
    words = "export", str(tmp_path / "p.safetensors"), "--onnx", str(tmp_path / "p.onnx")
    monkeypatch.setattr(sys, "argv", ["excite", *words])
    with pytest.raises(SystemExit, match="0"):
        main()
    shown = "] and memory [batch, 5] to action [batch, 1] and next_memory [batch, 5], "
    assert shown in capsys.readouterr().out
    path: Any = tmp_path / "p.onnx"
    session: Any = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    rng, window = np.random.default_rng(4), empty_window(np, LAYOUT)
    seen, memory = np.zeros((2, LAYOUT.size), np.float32), np.zeros((2, MEMORY))
    for k in range(STEPS):
        window = with_measurement(np, LAYOUT, window, rng.normal(size=1))
        seen = np.repeat(observe(np, LAYOUT, window, k)[None], 2, axis=0)
        action, memory = session.run(None, {"observation": seen, "memory": np.float32(memory)})
        window, ours = act(np, LAYOUT, policy().weights, window, k)
        np.testing.assert_allclose(action, [ours, ours], atol=1e-5)
        np.testing.assert_allclose(memory, [window.memory] * 2, atol=1e-5)
    for bad in (np.nan, np.inf):
        seen[1, 0] = bad
        action, kept = session.run(None, {"observation": seen, "memory": np.float32(memory)})
        spoilt = with_measurement(np, LAYOUT, window, np.array([bad]))
        with np.errstate(invalid="ignore"):
            after, ours = act(np, LAYOUT, policy().weights, spoilt, STEPS - 1)
        np.testing.assert_allclose(action[1], ours, atol=1e-5)
        assert (float(ours[0]) == 0) == np.isnan(bad)
        np.testing.assert_array_equal(kept[1], np.asarray(memory, np.float32)[1])
        np.testing.assert_array_equal(after.memory, window.memory)
        assert not np.allclose(kept[0], memory[0])


@pytest.mark.slow
def test_it_is_trained_by_one_argument():
    made = ex.train(
        "dc_motor", steps=20, window=1, memory=3, episodes=2, updates=2,
        training={**SMALL, "through_measurements": False},
    )  # fmt: skip
    assert (made.layout.memory, made.layout.window) == (3, 1)
    assert made.provenance["decision"]["memory"] == 3
    assert np.isfinite(ex.simulate("dc_motor", made).outputs).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "ppo"}, "ppo trains policies without a memory"),
        ({"training": {"starts": 4}}, "several starts are for policies without a memory"),
    ],
)
def test_trainings_that_cannot_be_are_one_sentence(options, message):
    with pytest.raises(ValueError, match=message):
        ex.train("dc_motor", steps=20, memory=3, **options)


@pytest.mark.slow
def test_without_the_part_through_measurements_the_gradient_is_that_of_fixed_ones():
    """Of a policy that sees no measurement it is the whole gradient; of others another one."""
    process, keys = env(), jax.random.split(jax.random.key(0), 2)
    unit, back, (matrix, bias), last = PolicyExcitation.of(policy()).weights
    deaf = (unit[0].at[:, 0].set(0.0), unit[1]), back, (matrix.at[:, MEMORY].set(0.0), bias), last

    def gradient(weights: Any, whole: bool) -> np.ndarray:
        def worth(bias: jax.Array) -> jax.Array:
            player = Network((*weights[:-1], (weights[-1][0], bias)), LAYOUT, whole)
            return jnp.mean(experiments(process, player, keys, 0.9).worth)

        return np.asarray(jax.grad(worth)(weights[-1][1]))

    np.testing.assert_allclose(gradient(deaf, True), gradient(deaf, False), rtol=1e-4)
    seeing = PolicyExcitation.of(policy()).weights
    assert not np.allclose(gradient(seeing, True), gradient(seeing, False), rtol=1e-3)


@pytest.mark.science
def test_a_memory_finds_a_source_that_a_window_of_one_sample_does_not():
    from test_static_tasks import EXAMPLE

    from excite.estimation.prior_knowledge import plants_of
    from excite.plant.catalogue import plant_named

    plant = plant_named(f"{EXAMPLE}:TwoSources")
    given: dict[str, str] = dict.fromkeys(("x_1", "y_1", "x_2", "y_2"), "normal:0:1")
    prior = plants_of(plant, given)
    objective = InformationGain((True,) * 4, 1.0, 0.5, dense=False, prior=prior)
    settings = GradientSettings(
        num_updates=400, learning_rate=3e-3, hidden=(64,), last_gain=0.3, watch_every=200,
        watch_episodes=256, through_measurements=False,
    )  # fmt: skip
    worth = {}
    for memory in (0, 32):
        layout = Layout.of(plant.description, window=1, num_steps=30, memory=memory)
        process = Env.of(plant, objective=objective, layout=layout, prior=prior)
        worth[memory] = train(process, settings, 0).validation["worth"]
    assert worth[32] > worth[0] + 0.3
    assert worth[32] > 9


@pytest.mark.slow
def test_a_policy_with_a_memory_is_falsified():
    """The experiment that is found has the inputs of the policy, memory included."""
    found, player = ex.falsify(policy(), budget=200), PolicyPlayer(policy())
    for k in range(STEPS):
        input = player(k, found.record.outputs[k])
        np.testing.assert_allclose(input, found.record.inputs[k], atol=2e-3)
        player.applied(input)
    assert found.certified().hash == policy().hash
