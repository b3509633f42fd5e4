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
from test_myopic import Beacon

import excite as ex
from excite.cli import main
from excite.environment import Env, InformationGain
from excite.estimation.prior_knowledge import plants_of
from excite.excitation import PolicyExcitation
from excite.files import tensors_from_bytes, tensors_to_bytes
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
from excite.policy.contract import FORMAT, added, attended, gated
from excite.rig.player import PolicyPlayer
from excite.simulation import run_episode
from excite.study.agent import Agent, AgentSettings
from excite.training.gradient import (
    Network,
    Optimisation,
    experiments,
    started,
    train,
    update_all,
)
from excite.training.settings import GradientSettings

MEMORY, STEPS = 5, 12
LAYOUT = Layout.of(Aero2.definition, window=1, num_steps=STEPS, memory=MEMORY)
SUM = dataclasses.replace(LAYOUT, window=2, clocks=(0.1,), memory_kind="sum")
ATTENTION = dataclasses.replace(LAYOUT, window=8, clocks=(0.1,), memory_kind="attention")
EACH = pytest.mark.parametrize("layout", [LAYOUT, SUM, ATTENTION], ids=["gru", "sum", "attention"])
SMALL: dict[str, Any] = {"num_plants": 2, "hidden": [4], "watch_episodes": 2}


def weights(seed: int = 0, layout: Layout = LAYOUT) -> Any:
    rng, size = np.random.default_rng(seed), layout.size
    unit = [(3 * MEMORY, size), (3 * MEMORY, MEMORY)]
    if layout.memory_kind != "gru":
        unit = [(7, 2), (MEMORY, 7)]
    if layout.memory_kind == "attention":
        unit, size = [*unit, (3 * MEMORY, MEMORY)], 2 + 1 + 2 * len(layout.clocks)
    return tuple(
        (rng.normal(size=s).astype(np.float32), rng.normal(size=s[0]).astype(np.float32))
        for s in [*unit, (4, MEMORY + size), (1, 4)]
    )


def policy(seed: int = 0, layout: Layout = LAYOUT) -> Policy:
    return Policy(Aero2().description, layout, weights(seed, layout))


def env(layout: Layout = LAYOUT, **options: Any) -> Env:
    objective = InformationGain((True,) * 3, 1.0)
    return Env.of(Aero2(), objective=objective, layout=layout, **options)


def after(layout: Layout, samples: np.ndarray) -> tuple[np.ndarray, float]:
    """Memory and action after these inputs, each with the measurement that follows it."""
    window, action = empty_window(np, layout), np.zeros(1)
    for k, (input, measured) in enumerate([(0.0, 0.7), *samples]):
        if k:
            window = with_input(np, layout, window, np.array([input]))
        window = with_measurement(np, layout, window, np.array([measured]))
        window, action = act(np, layout, weights(0, layout), window, k)
    return window.memory, float(action[0])


SAMPLES = np.random.default_rng(5).normal(size=(6, 2)) * [10, 0.3]


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
            ours = gated(np, LAYOUT, weights()[:2], ours, seen)
            theirs = cell(torch.from_numpy(seen)[None], theirs)
            np.testing.assert_allclose(ours, theirs[0].numpy(), atol=1e-6)


def test_a_sum_is_that_of_the_encoded_samples():
    """Of every sample once; the measurement before the first input is none."""
    (inner, inner_bias), (outer, bias), *_ = weights(0, SUM)
    total = np.zeros(MEMORY)
    for input, measured in SAMPLES:
        seen = np.array([measured / SUM.output_scale[0], input / SUM.input_half[0]])
        total += outer @ np.tanh(inner @ seen + inner_bias) + bias
    np.testing.assert_allclose(after(SUM, SAMPLES)[0], total / np.sqrt(STEPS), atol=1e-5)
    np.testing.assert_array_equal(after(SUM, SAMPLES[:0])[0], 0)


@pytest.mark.parametrize("count", [0, 1, 3, 6])
def test_attention_is_that_of_torch(count):
    """Over the samples there are; beside what is read, the encoded samples themselves."""
    (inner, inner_bias), (outer, bias), (read, read_bias), *_ = weights(0, ATTENTION)
    scaled = SAMPLES[:count, ::-1] / [ATTENTION.output_scale[0], ATTENTION.input_half[0]]
    encoded = np.tanh(scaled @ inner.T + inner_bias) @ outer.T + bias
    unit = torch.nn.MultiheadAttention(MEMORY, 1, batch_first=True)
    with torch.no_grad():
        unit.in_proj_weight.copy_(torch.from_numpy(read))
        unit.in_proj_bias.copy_(torch.from_numpy(read_bias))
        unit.out_proj.weight.copy_(torch.eye(MEMORY))
        unit.out_proj.bias.zero_()
        given = torch.from_numpy(encoded.astype(np.float32))
        found = unit(given[None], given[None], given[None])[0][0].numpy() if count else 0 * encoded
    expected = (encoded + found).sum(axis=0) / np.sqrt(STEPS)
    np.testing.assert_allclose(after(ATTENTION, SAMPLES[:count])[0], expected, atol=1e-5)


def test_attention_reads_the_samples_of_the_window_alone():
    """With more samples than the window, the oldest are left out."""
    rng = np.random.default_rng(6)
    samples = rng.normal(size=(11, 2)) * [10, 0.3]
    forgotten = np.concatenate([rng.normal(size=(3, 2)), samples[3:]])
    kept, changed = (after(ATTENTION, own)[0] for own in (samples, forgotten))
    np.testing.assert_array_equal(kept, changed)
    shorter = dataclasses.replace(ATTENTION, window=9)
    assert abs(after(shorter, samples)[0] - after(shorter, forgotten)[0]).max() > 1e-3


@pytest.mark.parametrize("steps", [7, 49, 500, 10_007])
def test_attention_counts_the_samples_at_every_step(steps):
    """In single precision too, where k / T times T is not k."""
    layout = dataclasses.replace(ATTENTION, num_steps=steps, window=steps, clocks=())
    if steps > 500:
        layout = dataclasses.replace(layout, window=500)
    zero = np.zeros((MEMORY, 7), np.float32)
    nothing = np.zeros((3 * MEMORY, MEMORY), np.float32), np.zeros(3 * MEMORY, np.float32)
    unit = weights(0, ATTENTION)[0], (zero, np.ones(MEMORY, np.float32)), nothing
    window = empty_window(np, layout)
    for k in {0, 1, 2, steps // 3, layout.window - 1, steps - 1}:
        seen = attended(np, layout, unit, None, observe(np, layout, window, k))
        assert seen[0] * np.sqrt(steps) == pytest.approx(min(k, layout.window), rel=1e-5)


@pytest.mark.parametrize("layout", [SUM, ATTENTION], ids=["sum", "attention"])
def test_the_gradient_is_that_of_differences(layout):
    """With respect to all weights of the unit, along one direction."""
    own, changes, first = weights(0, layout), weights(1, layout), len(layout.unit)
    whole, changes = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), (own, changes))

    @jax.jit
    @jax.value_and_grad
    def actions(step: jax.Array) -> jax.Array:
        moved = jax.tree.map(lambda leaf, by: leaf + step * by, whole[:first], changes[:first])
        window, total = empty_window(jnp, layout), jnp.zeros(())
        for k, (input, measured) in enumerate(SAMPLES):
            window = with_input(jnp, layout, window, input[None])
            window = with_measurement(jnp, layout, window, measured[None])
            window, action = act(jnp, layout, (*moved, *whole[first:]), window, jnp.asarray(k))
            total += action[0]
        return total

    with jax.enable_x64():
        (low, _), (_, slope), (high, _) = (actions(x) for x in (-1e-3, 0.0, 1e-3))
    assert abs(slope) > 1e-2
    np.testing.assert_allclose(slope, (high - low) / 2e-3, rtol=1e-2)


@EACH
def test_what_stands_beside_a_memory_is_counted(layout):
    assert layout.size_beside_memory == len(layout.beside_memory)


def test_a_sum_does_not_depend_on_the_order_of_the_samples_and_a_unit_does():
    """The action depends on the window, too: here of the newest two samples; of attention, one."""
    orders = [[3, 0, 2, 1, 4, 5], [2, 3, 1, 0, 4, 5]]
    kept, read, changed = (
        [after(layout, SAMPLES[order]) for order in orders] for layout in (SUM, ATTENTION, LAYOUT)
    )
    for own in (kept, read):
        np.testing.assert_allclose(own[0][0], own[1][0], atol=1e-5)
        assert own[0][1] == pytest.approx(own[1][1], abs=1e-5)
    assert abs(changed[0][0] - changed[1][0]).max() > 1e-3
    assert abs(changed[0][1] - changed[1][1]) > 1e-4
    np.testing.assert_allclose(after(SUM, SAMPLES[::-1])[0], kept[0][0], atol=1e-5)


@EACH
def test_numpy_on_a_rig_and_jax_in_a_simulation_give_the_same_inputs(layout):
    rng, player = np.random.default_rng(2), PolicyPlayer(policy(0, layout))
    excitation = PolicyExcitation.of(policy(0, layout))
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


@EACH
def test_it_travels_in_its_file_and_others_keep_theirs(tmp_path, layout):
    policy(0, layout).save(tmp_path / "p.safetensors")
    read = ex.read_policy(tmp_path / "p.safetensors")
    assert read.layout == layout
    assert read.hash == policy(0, layout).hash
    assert "5-4-1" in repr(read)
    run = run_episode(Aero2(), Aero2().nominal, PolicyExcitation.of(read), STEPS, jax.random.key(0))
    assert np.isfinite(run.inputs).all()
    assert b"memory" not in ex.read_policy("aero2").to_bytes()
    assert (b"memory_kind" in read.to_bytes()) == (layout is not LAYOUT)


def test_a_policy_with_a_unit_has_the_hash_it_had_before_there_were_sums():
    assert policy().hash == "9848a71004145e5a38037aa1f013aaee99b96cb2bcd0f729208d11a39ccb5a94"


def test_a_new_memory_keeps_most_of_what_it_holds():
    """The gate that keeps begins above one half, and so do the others not."""
    weights: Any = started(env(), GradientSettings(), [0])[0].best.weights
    (_, into_bias), (_, bias), *_ = weights
    np.testing.assert_array_equal(into_bias[0], 0)
    np.testing.assert_array_equal(bias[0], np.repeat([0, 1, 0], MEMORY))
    unit = tuple((np.zeros((3 * MEMORY, n)), np.asarray(b)) for n, b in
                 ((LAYOUT.size, into_bias[0]), (MEMORY, bias[0])))  # fmt: skip
    after = gated(np, LAYOUT, unit, np.ones(MEMORY), np.zeros(LAYOUT.size))
    np.testing.assert_allclose(after, 1 / (1 + np.exp(-1)))


def test_a_new_sum_is_of_the_size_of_its_terms_however_many_there_are():
    for steps in (12, 1200):
        layout = dataclasses.replace(SUM, num_steps=steps)
        first: Any = started(env(layout), GradientSettings(hidden=(9,)), [0])[0].best.weights
        (inner, _), (outer, _), (matrix, _), _ = unit = tuple(
            tuple(p[0] for p in layer) for layer in first
        )
        assert (inner.shape, outer.shape, matrix.shape) == ((9, 2), (MEMORY, 9), (9, 5 + SUM.size))
        memory, seen = np.zeros(MEMORY), np.ones(layout.size)
        rng = np.random.default_rng(0)
        for _ in range(steps):
            seen[list(layout.newest)] = rng.normal(size=2)
            memory = added(np, layout, unit[:2], memory, seen)
        assert 0.1 < np.sqrt((memory**2).mean()) < 2


def test_trainers_refuse_what_they_cannot_train():
    with pytest.raises(ValueError, match="several starts are for policies without a memory"):
        train(env(), GradientSettings(starts=2), 0)
    with pytest.raises(ValueError, match="an environment's observation has no memory"):
        gymnasium.make("excite.environment.gymnasium:excite/Aero2-v0", layout=LAYOUT)


@EACH
@pytest.mark.parametrize("part", range(4))
def test_a_unit_that_does_not_fit_is_refused(part, layout):
    wrong = [list(layer) for layer in weights(0, layout)]
    wrong[part // 2][part % 2] = wrong[part // 2][part % 2][:-1]
    for layers in (tuple(map(tuple, wrong)), ()):
        with pytest.raises(ValueError, match="the unit of a memory of 5 numbers has other weights"):
            Policy(Aero2().description, layout, layers)  # pyright: ignore[reportArgumentType]


def test_a_unit_whose_weights_are_not_finite_and_a_negative_memory_are_refused():
    wrong = [list(layer) for layer in weights()]
    wrong[1][1] = wrong[1][1] * np.nan
    with pytest.raises(ValueError, match="the unit of the memory has weights that are not finite"):
        Policy(Aero2().description, LAYOUT, tuple(map(tuple, wrong)))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="memory must not be negative: got -1"):
        Layout.of(Aero2.definition, memory=-1)


def test_a_kind_of_memory_that_does_not_exist_or_is_of_none_is_refused():
    with pytest.raises(
        ValueError, match="memory_kind must be one of gru, sum, attention: got 'lstm'"
    ):
        Layout.of(Aero2.definition, memory=3, memory_kind="lstm")
    with pytest.raises(ValueError, match="memory_kind needs a memory: set memory, or"):
        Layout.of(Aero2.definition, memory_kind="sum")
    tensors, contract = tensors_from_bytes(policy(0, SUM).to_bytes(), FORMAT, "policy")
    contract["layout"]["memory_kind"] = "lstm"
    with pytest.raises(ValueError, match="policy: memory_kind must be one of gru, sum, attention"):
        Policy.from_bytes(tensors_to_bytes(tensors, FORMAT, contract))


def test_one_observation_is_not_enough_for_an_action():
    with pytest.raises(ValueError, match="this policy has a memory of 5 numbers"):
        policy()(np.zeros(LAYOUT.size, np.float32))


@EACH
def test_other_runtimes_play_it_with_its_memory(tmp_path, monkeypatch, capsys, layout):
    policy(0, layout).save(tmp_path / "p.safetensors")
    words = "export", str(tmp_path / "p.safetensors"), "--onnx", str(tmp_path / "p.onnx")
    monkeypatch.setattr(sys, "argv", ["excite", *words])
    with pytest.raises(SystemExit, match="0"):
        main()
    shown = "] and memory [batch, 5] to action [batch, 1] and next_memory [batch, 5], "
    assert shown in capsys.readouterr().out
    path: Any = tmp_path / "p.onnx"
    session: Any = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    own, newest = weights(0, layout), layout.newest[0]
    rng, window = np.random.default_rng(4), empty_window(np, layout)
    seen, memory = np.zeros((2, layout.size), np.float32), np.zeros((2, MEMORY))
    for k in range(STEPS):
        window = with_input(np, layout, window, 10 * rng.normal(size=1))
        window = with_measurement(np, layout, window, rng.normal(size=1))
        seen = np.repeat(observe(np, layout, window, k)[None], 2, axis=0)
        action, memory = session.run(None, {"observation": seen, "memory": np.float32(memory)})
        window, ours = act(np, layout, own, window, k)
        np.testing.assert_allclose(action, [ours, ours], atol=1e-5)
        np.testing.assert_allclose(memory, [window.memory] * 2, atol=1e-5)
    for bad in (np.nan, np.inf):
        seen[1, newest] = bad
        action, kept = session.run(None, {"observation": seen, "memory": np.float32(memory)})
        before = window._replace(outputs=np.roll(window.outputs, 1, axis=0))
        spoilt = with_measurement(np, layout, before, np.array([bad]))
        with np.errstate(invalid="ignore"):
            after, ours = act(np, layout, own, spoilt, STEPS - 1)
        np.testing.assert_allclose(action[1], ours, atol=1e-5)
        assert (float(ours[0]) == 0) == np.isnan(bad)
        np.testing.assert_array_equal(kept[1], np.asarray(memory, np.float32)[1])
        np.testing.assert_array_equal(after.memory, window.memory)
        if layout is not ATTENTION:  # which reads the window again
            assert not np.allclose(kept[0], memory[0])


@pytest.mark.slow
def test_it_is_trained_by_its_arguments():
    made = ex.train(
        "dc_motor", steps=20, window=1, memory=3, memory_kind="sum", episodes=2, updates=2,
        training={**SMALL, "through_measurements": False},
    )  # fmt: skip
    assert (made.layout.memory, made.layout.window, made.layout.memory_kind) == (3, 1, "sum")
    own = made.provenance["decision"]
    assert (own["memory"], own["memory_kind"]) == (3, "sum")
    assert [matrix.shape for matrix, _ in made.weights[:2]] == [(4, 3), (3, 4)]
    assert np.isfinite(ex.simulate("dc_motor", made).outputs).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "ppo"}, "ppo trains policies without a memory"),
        ({"training": {"starts": 4}}, "several starts are for policies without a memory"),
        ({"memory_kind": "lstm"}, "memory_kind must be 'gru', 'sum' or 'attention', got \"lstm\""),
        ({"memory": None, "memory_kind": "sum"}, "memory_kind needs a memory: set memory, or"),
        ({"memory": 0, "memory_kind": "gru"}, "memory_kind needs a memory: set memory, or"),
    ],
)
def test_trainings_that_cannot_be_are_one_sentence(options, message):
    with pytest.raises(ValueError, match=message):
        ex.train("dc_motor", **{"steps": 20, "memory": 3, **options})


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--memory", "3", "--memory-kind", "lstm"],
            "is not one of 'gru', 'sum', 'attention'",
        ),
        (["--memory-kind", "sum"], "memory_kind needs a memory: set memory, or"),
    ],
)
def test_kinds_that_cannot_be_are_refused_by_the_command(
    words, message, tmp_path, monkeypatch, capsys
):
    own = ["excite", "train", "dc_motor", "--out", str(tmp_path / "run"), *words]
    monkeypatch.setattr(sys, "argv", own)
    with pytest.raises(SystemExit, match="2"):
        main()
    assert message in capsys.readouterr().err


def test_an_agent_without_a_memory_has_no_kind_of_it_from_the_study():
    shared, nothing = {"memory": 3, "memory_kind": "sum"}, {"window": 1}
    own = {memory: AgentSettings(method="gradient", decision={"memory": memory, **nothing})
           for memory in (0, 5)}  # fmt: skip
    kinds = {m: Agent.of(a, shared, {}, {}).decision.memory_kind for m, a in own.items()}
    assert kinds == {0: "gru", 5: "sum"}
    marks = [
        Agent.of(own[5], kind, {}, {}).settings(Aero2())
        for kind in ({}, {"memory_kind": "gru"}, {"memory_kind": "sum"})
    ]
    assert marks[0] == marks[1] != marks[2]


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


@pytest.mark.slow
def test_a_sum_learns_what_helps_to_choose_the_next_design():
    """In nats, more than at first, and more than with an encoder of nothing."""
    prior = plants_of(Beacon(), {"at": "normal:0:1.5"})
    objective = InformationGain((True,), 1.0, 0.5, dense=False, prior=prior)
    layout = Layout.of(Beacon.definition, 1, 8, memory=8, memory_kind="sum")
    process = Env.of(Beacon(), objective=objective, layout=layout, prior=prior)
    settings = GradientSettings(
        num_updates=100, num_plants=64, learning_rate=1e-2, hidden=(16,), last_gain=0.3,
        through_measurements=False,
    )  # fmt: skip
    course, keys = started(process, settings, [0])

    def worth(now: Optimisation) -> float:
        batches = [update_all(process, settings, now, keys(i), False, None)[1] for i in range(8)]
        return float(np.mean([batch.worth for batch in batches]))

    now = course.now
    for i in range(settings.num_updates):
        now, _ = update_all(process, settings, now, keys(i), False, None)
    (first, last, *rest), zeros = now.player.weights, jnp.zeros_like
    deaf = dataclasses.replace(now.player, weights=(first, jax.tree.map(zeros, last), *rest))
    without = dataclasses.replace(now, player=deaf)
    assert worth(now) > max(worth(course.now), worth(without)) + 0.2


@pytest.mark.science
def test_a_memory_finds_a_source_that_a_window_of_one_sample_does_not():
    from test_static_tasks import EXAMPLE

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
