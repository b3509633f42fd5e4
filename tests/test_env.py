"""The decision process: against plain NumPy, against the information and laws of its own."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import plain_env
import pytest
import scipy.signal
from catalogue import FEW_AND_ALL, PLANTS, TwoMasses
from plain_env import PlainAero2Env

from excite import safety
from excite.description import Input, Output, Parameter, PlantDescription, State
from excite.environment import (
    Env,
    EnvState,
    EstimationError,
    InformationGain,
    StepData,
    Transition,
    default_objective,
    reset_batch,
    step_batch,
    target_mask,
)
from excite.information import experiment_information, relative_size
from excite.plant import AbstractPlant, Aero2
from excite.plant.contract import Sensor
from excite.policy import Layout
from excite.simulation import response, sensed

KEY = jax.random.key(5)
AERO2 = Aero2()
SILENT = AERO2.changed(sensor=Sensor(jnp.zeros(1), jnp.zeros(1)))
ALL = (True, True, True)

plants = pytest.mark.parametrize("plant", PLANTS)


@eqx.filter_jit
def episode(env: Env, key: jax.Array, actions: jax.Array) -> tuple[EnvState, EnvState, Transition]:
    """First state, states and transitions of an episode."""
    first, _ = env.reset(key)

    def advance(state: EnvState, action: jax.Array) -> tuple[EnvState, Any]:
        state, transition = env.step(state, action)
        return state, (state, transition)

    return first, *jax.lax.scan(advance, first, actions)[1]


def actions_of(env: Env, num_steps: int, amplitude: float = 0.4) -> jax.Array:
    rng = np.random.default_rng(0)
    shape = (num_steps, len(env.layout.input_half))
    return jnp.asarray(amplitude * rng.uniform(-1, 1, shape))


def short(plant: AbstractPlant, num_steps: int = 12, **choices: Any) -> Env:
    layout = Layout.of(plant.description, window=4, num_steps=num_steps)
    return Env.of(plant, layout=layout, **choices)


# ----------------------------------------------------- the paper's process in plain NumPy


def square_wave(amplitude: float, period: int) -> np.ndarray:
    return amplitude * np.where(np.arange(500) % period < period / 2, 1.0, -1.0)


ACTIONS = {
    "random": np.random.default_rng(1).uniform(-1.5, 1.5, 500),
    "gentle": 0.3 * np.random.default_rng(2).uniform(-1, 1, 500),
    "at resonance": square_wave(0.18, 67),
    "too much": square_wave(1.0, 40),
}


@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("name", ACTIONS)
def test_the_process_is_that_of_plain_numpy(name, noisy):
    plant = AERO2 if noisy else SILENT
    env, actions = Env.of(plant), ACTIONS[name][:, None]
    first, states, transitions = episode(env, KEY, jnp.asarray(actions))
    keys = [jax.random.fold_in(first.key, k) for k in range(501)]
    noise = [sensed(plant, jnp.zeros(1), jax.random.normal(key, (1,)))[0] for key in keys]
    assert (np.std(noise) > 1e-4) == noisy
    plain = PlainAero2Env()
    options = {"params": np.array(first.params), "noise": np.array(noise)}
    observation, _ = plain.reset(options=options)
    np.testing.assert_allclose(env.reset(KEY)[1], observation, atol=1e-6)
    assert observation.shape == (161,)
    steps = [plain.step(action) for action in actions]
    observations, rewards, terminated, _, infos = zip(*steps, strict=True)
    close = functools.partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-6)
    close(transitions.observation, np.stack(observations))
    close(transitions.reward, rewards)
    np.testing.assert_array_equal(transitions.terminated, terminated)
    violations = [info["is_violation"] for info in infos]
    np.testing.assert_array_equal(transitions.is_violation, violations)
    levels = np.array([plain_env.WARNING]), np.array([plain_env.CRITICAL])
    penalties = np.array([info["penalty"] for info in infos])
    angles = np.asarray(states.plant_state[:, :1])
    close(safety.penalty(angles, *levels), penalties)
    info = infos[-1]
    np.testing.assert_allclose(
        transitions.relative_errors[-1], info["relative_errors"], atol=1e-6, rtol=1e-6
    )
    signed = 1 - info["estimate"] / np.array(first.params)
    np.testing.assert_allclose(np.abs(signed), transitions.relative_errors[-1], atol=1e-6)
    if name == "at resonance":  # nothing, near and over: all three cases of Eq. 3
        cases = [np.sum(penalties == 0), np.sum(penalties <= -1)]
        assert min(*cases, 500 - sum(cases)) > 20
    if name == "gentle":
        assert max(info["relative_errors"][:2]) < 0.5


# ------------------------------------------------------------------ the grid, the state


@pytest.mark.parametrize("plant", FEW_AND_ALL)
def test_the_sum_of_rewards_is_the_information_gained(plant):
    plant = PLANTS[plant]
    targets = target_mask(plant.definition, None)
    objective = InformationGain((True,) * len(targets), 0.2)
    env = short(plant, 30, objective=objective, penalty_weight=0)
    actions = actions_of(env, 30)
    first, states, transitions = episode(env, KEY, actions)
    middle, half = np.array(env.layout.input_middle), np.array(env.layout.input_half)
    inputs = jnp.asarray(middle + half * np.asarray(actions))
    prior = np.eye(len(targets)) / 0.2**2
    gained = prior + np.asarray(experiment_information(plant, first.params, inputs))
    expected = np.linalg.slogdet(gained)[1] - np.linalg.slogdet(prior)[1]
    assert np.sum(transitions.reward) == pytest.approx(expected, rel=1e-8)
    assert np.all(transitions.reward >= -1e-9)
    # Information is relative to the scale of a parameter that may be zero, an error to its value.
    size = np.asarray(relative_size(plant, first.params)) / np.abs(np.stack(first.params))
    sd = np.sqrt(np.diag(np.linalg.inv(gained))) * size
    np.testing.assert_allclose(transitions.relative_errors[-1], sd, rtol=1e-6)
    # The trajectory is that of the simulation, the shapes are those of the layout.
    outputs = jax.vmap(lambda state: plant.output(state, first.params))(states.plant_state)
    np.testing.assert_allclose(outputs, response(plant, first.params, inputs)[1:], rtol=1e-9)
    assert transitions.observation.shape == (30, env.layout.size)
    assert transitions.observation.dtype == np.float32
    assert transitions.relative_errors.shape == (30, len(targets))
    assert transitions.reward.shape == transitions.terminated.shape == (30,)


@plants
def test_the_state_does_not_grow_with_the_number_of_steps(plant):
    def shapes(num_steps: int, objective: Any) -> Any:
        env = Env.of(
            PLANTS[plant], layout=Layout.of(PLANTS[plant].description, 4, num_steps), **objective
        )
        state, observation = eqx.filter_eval_shape(env.reset, KEY)
        action = jnp.zeros(len(env.layout.input_half))
        after, _ = eqx.filter_eval_shape(env.step, state, action)
        leaves = [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(state)]
        assert leaves == [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(after)]
        return leaves, observation.shape

    targets = target_mask(PLANTS[plant].definition, None)
    for objective in ({}, {"objective": InformationGain(targets, 0.2)}):
        assert shapes(10, objective) == shapes(1000, objective)


def test_an_episode_ends_at_its_last_step_and_not_before():
    env = short(AERO2, 12)
    _, states, transitions = episode(env, KEY, actions_of(env, 12))
    assert list(transitions.terminated) == [False] * 11 + [True]
    np.testing.assert_array_equal(states.k, np.arange(1, 13))
    np.testing.assert_allclose(transitions.observation[:, -1], np.arange(1, 13) / 12, rtol=1e-6)
    assert not hasattr(transitions, "truncated")


def test_a_key_gives_the_same_episode_again_and_another_key_another():
    env = short(AERO2, 12)
    actions = actions_of(env, 12)
    ours, again, other = (episode(env, key, actions) for key in (KEY, KEY, jax.random.key(6)))
    for a, b in zip(jax.tree.leaves(ours[1:]), jax.tree.leaves(again[1:]), strict=True):
        if not jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            np.testing.assert_array_equal(a, b)
    assert all(a != b for a, b in zip(ours[0].params, other[0].params, strict=True))
    noise = [
        e[2].observation[:, 3] - e[1].plant_state[:, 0] / np.radians(45) for e in (ours, other)
    ]
    assert np.all(np.diff(noise[0]) != 0)
    assert np.all(noise[0] != noise[1])


@plants
def test_parameters_are_drawn_within_the_spread(plant):
    plant = PLANTS[plant]
    parts = plant.definition.parameters

    @eqx.filter_jit
    def drawn(env: Env) -> jax.Array:
        keys = jax.random.split(KEY, 400)
        return jax.vmap(lambda key: jnp.stack(env.reset(key)[0].params))(keys)

    for spread in (0.2, 0.0):
        moved = np.asarray(drawn(short(plant, spread=spread)))
        moved = (moved - [p.nominal for p in parts]) / [p.scale for p in parts]
        assert np.abs(moved).max() <= spread + 1e-12
        # Of 400 uniform values the largest misses the end by one percent once in 50 times.
        assert np.all(moved.max(axis=0) >= 0.95 * spread)
        assert np.all(moved.min(axis=0) <= -0.95 * spread)


def test_a_violation_is_that_of_the_true_trajectory_so_far():
    env = Env.of(AERO2)
    levels = safety.critical_levels(AERO2.definition)
    for name, violated in (("gentle", False), ("at resonance", True)):
        first, states, transitions = episode(env, KEY, jnp.asarray(ACTIONS[name][:, None]))
        outputs = np.concatenate([first.plant_state[None, :1], states.plant_state[:, :1]])
        expected = [safety.is_violation(outputs[: k + 2], levels) for k in range(500)]
        np.testing.assert_array_equal(transitions.is_violation, expected)
        assert expected[-1] == violated
        np.testing.assert_array_equal(states.max_abs_output[-1], safety.max_abs_output(outputs))


def test_an_episode_that_begins_over_the_critical_level_is_a_violation():
    env = short(AERO2.changed(initial_state=jnp.array([0.75, -3.0])))
    _, states, transitions = episode(env, KEY, jnp.zeros((12, 1)))
    assert abs(states.plant_state[0, 0]) < plain_env.CRITICAL
    assert transitions.is_violation[0]


# ------------------------------------------------------------------------- objectives


def estimation(**settings: Any) -> Env:
    return short(AERO2, 12, objective=EstimationError(**settings), penalty_weight=0)


@pytest.mark.parametrize("targets", [ALL, (True, False, False), (False, True, True)])
@pytest.mark.parametrize("goals", [None, (0.5, 2.0, 10.0)])
@pytest.mark.parametrize("form", ["relative", "log"])
@pytest.mark.parametrize("weight", [1.0, 2.5])
def test_the_estimation_error_is_rewarded_at_the_end_only(targets, goals, form, weight):
    env = estimation(targets=targets, goals=goals, form=form, weight=weight)
    state, _ = env.reset(KEY)
    errors = np.array([0.3, 40.0, 2.0])
    # The memory of an estimate with these errors: the coefficients of such a plant.
    moved = AERO2.Params(*(p * (1 + e) for p, e in zip(state.params, errors, strict=True)))
    memory = eqx.tree_at(lambda m: m.rls.coefficients, state.memory, arx_coefficients(moved))
    reward = env.objective.final(AERO2, memory, state.params)
    expected = 0.0
    for error, goal, target in zip(errors, goals or (1, 1, 1), targets, strict=True):
        expected -= target * weight * (np.log(1 + error / goal) if form == "log" else error / goal)
    assert float(reward) == pytest.approx(expected, rel=1e-6)
    sample = StepData(state.params, state.plant_state, jnp.ones(1), jnp.ones(1))
    assert env.objective.update(AERO2, memory, sample, jnp.asarray(3))[1] == 0


def arx_coefficients(params: Any) -> jax.Array:
    """Of J_p y'' + D_p y' + (m g d_S) y = 2 J_p K_pu u behind a hold, by SciPy."""
    J_p, K_pu, D_p = (float(p) for p in params)
    denominator = [1.0, D_p / J_p, plain_env.STIFFNESS / J_p]
    sampled: Any = scipy.signal.cont2discrete(([2 * K_pu], denominator), 0.1)
    numerator, denominator, _ = sampled
    return jnp.asarray(np.concatenate([denominator[1:], numerator[0, 1:]]))


def test_rewards_before_the_end_are_the_penalty_alone():
    actions = jnp.asarray(square_wave(0.18, 67)[:, None])
    runs = [episode(Env.of(AERO2, penalty_weight=w), KEY, actions) for w in (0.0, 1.0, 3.0)]
    nothing, once, thrice = (np.asarray(transitions.reward) for _, _, transitions in runs)
    _, states, transitions = runs[0]
    np.testing.assert_array_equal(nothing[:-1], 0.0)
    assert nothing[-1] == pytest.approx(-np.sum(transitions.relative_errors[-1]))
    expected = [plain_env.safety_penalty(float(angle)) for angle in states.plant_state[:, 0]]
    np.testing.assert_allclose(once - nothing, expected, atol=1e-9)
    np.testing.assert_allclose(thrice - nothing, 3 * np.array(expected), atol=1e-9)
    assert min(expected) < -1


def test_an_experiment_that_shows_nothing_costs_the_largest_error():
    env = short(SILENT, 12)
    _, _, transitions = episode(env, KEY, jnp.zeros((12, 1)))
    np.testing.assert_array_equal(transitions.relative_errors, 100.0)
    assert transitions.reward[-1] == -300.0


@pytest.mark.parametrize("targets", [
    (True, False, False, True), (False, False, True, False), (True, True, True, False),
])  # fmt: skip
def test_parameters_that_are_no_targets_are_eliminated(targets):
    plant = PLANTS["two_masses"]
    env = short(plant, 20, objective=InformationGain(targets, 0.2, weight=2.0), penalty_weight=0)
    actions = actions_of(env, 20)
    first, _, transitions = episode(env, KEY, actions)
    inputs = jnp.array([[0.0, 3.0]]) + jnp.array([[5.0, 3.0]]) * actions
    prior = np.eye(4) / 0.2**2
    gained = prior + np.asarray(experiment_information(plant, first.params, inputs))
    kept = np.ix_(targets, targets)
    volumes = [np.linalg.det(np.linalg.inv(M)[kept]) for M in (prior, gained)]
    expected = 2.0 * np.log(volumes[0] / volumes[1])
    assert np.sum(transitions.reward) == pytest.approx(expected, rel=1e-8)


@plants
def test_the_default_objective_is_the_papers_where_the_plant_has_a_mapping(plant):
    plant = PLANTS[plant]
    objective = default_objective(plant, 0.3)
    assert isinstance(objective, EstimationError) == (plant.definition.name == "aero2")
    assert isinstance(objective, EstimationError | InformationGain)
    assert objective.targets == tuple(p.target for p in plant.definition.parameters)
    assert type(Env.of(plant).objective) is type(objective)
    if isinstance(objective, InformationGain):
        # A uniform distribution within ± 0.3, but never narrower than ± 0.01.
        for spread, width in ((0.3, 0.3), (0.0, 0.01)):
            sd = default_objective(plant, spread).prior_sd  # pyright: ignore
            assert float(sd) == pytest.approx(np.sqrt((2 * width) ** 2 / 12))


@pytest.mark.parametrize("name", ["cart_pole", "dc_motor", "emps", "two_masses"])
def test_the_estimation_error_needs_a_mapping(name):
    plant = PLANTS[name]
    targets = target_mask(plant.definition, None)
    env = short(plant, objective=EstimationError(targets))
    sentence = f"plant '{name}' has no mapping from ARX .* reward the information gained instead"
    with pytest.raises(ValueError, match=sentence):
        env.reset(KEY)


def test_targets_are_named():
    definition = Aero2.definition
    assert target_mask(definition, None) == ALL
    assert target_mask(definition, ["D_p"]) == (False, False, True)
    assert target_mask(definition, ["D_p", "J_p"]) == (True, False, True)
    partly = dataclasses.replace(definition.parameters[1], target=False)
    others = definition.parameters[0], partly, definition.parameters[2]
    partly_targeted = dataclasses.replace(definition, parameters=others)
    assert target_mask(partly_targeted, None) == (True, False, True)
    with pytest.raises(ValueError, match="'aero2' has no parameter 'K'; it has J_p, K_pu, D_p"):
        target_mask(definition, ["J_p", "K"])
    with pytest.raises(ValueError, match="needs at least one parameter"):
        target_mask(definition, [])


# ------------------------------------------------------------------------ divergence


class Explosive(AbstractPlant):
    """Its state, x' = k x^3 + u, is infinite after a finite time."""

    definition = PlantDescription(
        name="explosive",
        states=(State("x", "m"),),
        inputs=(Input("u", "m/s", -1.0, 1.0),),
        outputs=(Output("y", "m", 1e-3, noise_sd=0.01, warning_level=8.0, critical_level=9.0),),
        parameters=(Parameter("k", "1/s/m²", 1.0),),
        dt=0.1, band=(0.1, 5.0),
    )  # fmt: skip

    def derivative(self, state, input, params):
        return params.k * state**3 + input

    def output(self, state, params):
        return state


@pytest.mark.parametrize("start", [1.0, 3.0, 1e3, 1e8, 1e30])
def test_what_cannot_be_computed_is_a_violation_and_stays_a_number(start):
    env = short(Explosive(initial_state=jnp.array([start])), 25)
    _, states, transitions = episode(env, KEY, jnp.zeros((25, 1)))
    assert np.all(np.isfinite(transitions.observation))
    assert np.all(np.isfinite(transitions.reward))
    assert not states.is_finite[-1]
    lost = int(np.argmin(states.is_finite))
    assert not np.any(states.is_finite[lost:])
    assert np.all(transitions.is_violation[lost:])
    np.testing.assert_array_equal(transitions.reward[lost:], -1.0)
    assert list(transitions.terminated) == [False] * 24 + [True]
    if start == 1.0:
        assert lost > 0
        assert not transitions.is_violation[0]


# ---------------------------------------------------------------------------- batches


def row(tree: Any, i: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[i], tree)


@pytest.mark.science
def test_an_episode_that_ended_is_followed_by_another():
    env = short(AERO2, 3)
    batch, observations = reset_batch(env, KEY, 4)
    # Only the second episode is at its last step.
    batch = eqx.tree_at(lambda b: b.states.k, batch, jnp.array([0, 2, 1, 1]))
    actions = jnp.linspace(-1.5, 1.5, 4)[:, None]
    after, transitions, observations = step_batch(env, batch, actions)
    assert list(transitions.terminated) == [False, True, False, False]
    assert list(after.states.k) == [1, 0, 2, 2]
    for i in range(4):
        state, transition = eqx.filter_jit(env.step)(row(batch.states, i), actions[i])
        np.testing.assert_allclose(transitions.observation[i], transition.observation, rtol=1e-6)
        assert float(transitions.reward[i]) == pytest.approx(float(transition.reward), rel=1e-6)
        kept = row(after.states, i)
        if i != 1:
            np.testing.assert_array_equal(observations[i], transitions.observation[i])
            np.testing.assert_allclose(kept.plant_state, state.plant_state, rtol=1e-12)
            np.testing.assert_array_equal(kept.params, state.params)
            assert after.keys[i] == batch.keys[i]
            continue
        # The transition shows the end, the observation the beginning of the next.
        assert transitions.observation[i, -1] == 1.0
        np.testing.assert_array_equal(np.flatnonzero(observations[i]), [3])
        np.testing.assert_array_equal(kept.plant_state, 0.0)
        assert all(new != old for new, old in zip(kept.params, state.params, strict=True))
        assert after.keys[i] != batch.keys[i]


def test_episodes_follow_each_other_without_repeating():
    env = short(AERO2, 2)
    batch, observations = reset_batch(env, KEY, 3)
    seen = [np.stack(batch.states.params, axis=1)]
    first = observations
    for k in range(6):
        batch, transitions, observations = step_batch(env, batch, jnp.zeros((3, 1)))
        assert np.all(transitions.terminated == (k % 2 == 1))
        if k % 2 == 1:
            seen.append(np.stack(batch.states.params, axis=1))
            assert np.all(observations[:, 3] != first[:, 3])  # another noise, too
    drawn = np.concatenate(seen)
    assert len(np.unique(drawn, axis=0)) == len(drawn) == 12


def test_a_second_plant_of_a_class_is_not_compiled_again():
    traces = 0

    class Counted(TwoMasses):
        def derivative(self, state, input, params):
            nonlocal traces
            traces += 1
            return super().derivative(state, input, params)

    def run(plant: AbstractPlant, **choices: Any) -> float:
        env = short(plant, 3, **choices)
        batch, _ = reset_batch(env, KEY, 2)
        batch, _, _ = step_batch(env, batch, jnp.ones((2, 2)))
        _, transitions, _ = step_batch(env, batch, jnp.ones((2, 2)))
        return float(transitions.reward.sum())

    ours, compiled = run(Counted()), traces
    assert compiled > 0
    sensor = Sensor(jnp.array([1e-2, 1e-2]), jnp.zeros(2))
    others = [
        run(Counted(k_0=25.0)), run(Counted(sensor=sensor)),
        run(Counted(initial_state=jnp.array([0.1, 0.0, 0.0, 0.0]))), run(Counted(), spread=0.1),
    ]  # fmt: skip
    assert traces == compiled
    assert len({ours, *others}) == 5


class Growing(TwoMasses):
    """A plant whose simulation diverges."""

    def derivative(self, state, input, params):
        return 50 * state * jnp.sum(state**2)


def test_a_coast_that_diverges_keeps_its_last_numbers():
    env = Env.of(Growing(), coast=20)
    state, _ = env.reset(KEY)
    state = dataclasses.replace(state, plant_state=jnp.full_like(state.plant_state, 3.0))
    outputs = env.coasting(state)
    assert np.all(np.isfinite(outputs))
    np.testing.assert_array_equal(outputs[-1], outputs[-2])
    assert np.max(np.abs(outputs[-1])) > 1
