"""Training by gradient: the derivative of a whole experiment, safety, and failures."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import LONG
from jaxtyping import Array

from excite.description import Input, Output, Parameter, PlantDescription, State, prior_sd_of
from excite.environment import (
    AbstractObjective,
    Env,
    EstimationError,
    InformationGain,
    OutputError,
    StepData,
    WeightedSum,
)
from excite.environment.falsification import Cases, OnPlant
from excite.estimation import NLS, stack_experiments
from excite.excitation import Chirp
from excite.information import a_optimality, d_optimality, e_optimality, experiment_information
from excite.plant import AbstractPlant, Aero2
from excite.plant.uncertainty import Uncertainty
from excite.policy import Layout, Weights, forward, observe
from excite.simulation import response, step
from excite.training.checkpoint import Checkpoint
from excite.training.gradient import (
    GradientSettings,
    Network,
    Optimisation,
    experiments,
    rank,
    train,
    train_all,
    update,
)

ALL = (True, True, True)
KEYS = jax.random.split(jax.random.key(1), 3)
FEW = GradientSettings(num_updates=6, num_plants=4, watch_every=3, watch_episodes=4)


def env_of(objective: AbstractObjective, plant: AbstractPlant | None = None, num_steps: int = 60):
    plant = Aero2() if plant is None else plant
    layout = Layout.of(plant.description, window=10, num_steps=num_steps)
    scale = tuple(0.3 for _ in layout.output_scale)
    return Env.of(
        plant, objective=objective, layout=dataclasses.replace(layout, output_scale=scale)
    )


def weights_of(env: Env) -> Weights:
    """A policy that is neither silent nor saturated."""
    rng = np.random.default_rng(2)
    first = 0.3 * rng.standard_normal((8, env.layout.size))
    last = 0.3 * rng.standard_normal((1, 8))
    layers = ((first, np.full(8, 0.1)), (last, np.full(1, 0.05)))
    return tuple((jnp.asarray(m, jnp.float32), jnp.asarray(b, jnp.float32)) for m, b in layers)


def run(env: Env, weights: Weights, key: jax.Array) -> tuple[Any, jax.Array]:
    """The same experiment step by step: last state, and inputs."""
    state, _ = env.reset(key)
    inputs = []
    for _ in range(env.layout.num_steps):
        action = forward(jnp, weights, observe(jnp, env.layout, state.window, state.k))
        inputs.append(action * jnp.asarray(env.layout.input_half))
        state, _, _ = eqx.filter_jit(env.advance)(state, action)
    return state, jnp.stack(inputs).astype(float)


OBJECTIVES = {
    "relative": EstimationError(ALL),
    "log": EstimationError(ALL, [0.01, 0.004, 1.0], "log"),
    "D": InformationGain(ALL, prior_sd_of(0.3), dense=False),
    "D dense": InformationGain(ALL, prior_sd_of(0.3)),
    "A": InformationGain(ALL, prior_sd_of(0.3), criterion="A", dense=False),
    "E of two": InformationGain((True, True, False), prior_sd_of(0.3), criterion="E", dense=False),
}
OBJECTIVES["D and errors"] = WeightedSum(
    (OBJECTIVES["D dense"], EstimationError(ALL, [0.01, 0.004, 1.0], "log", 2.0))
)


def test_an_unknown_criterion_or_form_is_refused():
    with pytest.raises(ValueError, match="criterion must be D, A or E: got 'd'"):
        InformationGain(ALL, 0.1, criterion="d")
    with pytest.raises(ValueError, match="form must be relative, log or goals: got 'logs'"):
        EstimationError(ALL, form="logs")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_the_error_of_the_output_error_estimate_is_that_of_nls(seed):
    """To first order in the noise, here a hundredth of a degree."""
    plant = Aero2()
    objective, params = OutputError(ALL, prior_sd=prior_sd_of(0.3)), plant.nominal
    inputs = Chirp().sequence(plant, 300, KEYS[0])
    outputs = response(plant, params, inputs)
    noise = plant.sensor.sd[None] * jax.random.normal(jax.random.key(seed), outputs.shape)
    measured = outputs + noise
    memory = objective.init(plant, measured[0], KEYS[1])

    def advance(carry: tuple, now: tuple) -> tuple[tuple, None]:
        (memory, state), (k, input, seen) = carry, now
        memory, _ = objective.update(plant, memory, StepData(params, state, input, seen), k)
        return (memory, step(plant, state, input, params)), None

    samples = jnp.arange(len(inputs)), inputs, measured[1:]
    scan = eqx.filter_jit(jax.lax.scan)
    (memory, _), _ = scan(advance, (memory, plant.initial_state), samples)
    found = NLS()(plant, stack_experiments(plant, [inputs], [measured], True))
    theirs = np.abs(np.stack(found.params) / np.stack(params) - 1)
    ours = objective.relative_errors(plant, memory, params)
    np.testing.assert_allclose(ours, theirs, rtol=0.02, atol=1e-8)


def test_sensitivities_are_held_to_their_limit_and_below_it_left_alone():
    plant = Aero2()
    inputs = Chirp(20.0).sequence(plant, 60, KEYS[0])

    def largest(limit: float) -> float:
        objective = InformationGain(ALL, prior_sd_of(0.3), max_sensitivity=limit)

        def advance(carry: tuple, now: tuple) -> tuple[tuple, Array]:
            (memory, state), (k, input) = carry, now
            sample = StepData(plant.nominal, state, input, jnp.zeros(1))
            memory, _ = objective.update(plant, memory, sample, k)
            size = jnp.abs(memory.sensitivity[0]).max()
            return (memory, step(plant, state, input, plant.nominal)), size

        start = objective.init(plant, jnp.zeros(1), KEYS[1]), plant.initial_state
        samples = jnp.arange(len(inputs)), inputs
        sizes = eqx.filter_jit(jax.lax.scan)(advance, start, samples)[1]
        return float(jnp.max(sizes) / (plant.definition.outputs[0].critical_level or 0.0))

    free = largest(30.0)
    assert 0.05 < free < 30.0
    assert largest(free / 4) == pytest.approx(free / 4, rel=1e-6)
    assert largest(2 * free) == free


@pytest.mark.science
def test_a_sum_is_worth_the_sum_of_its_terms():
    goals = [0.01, 0.004, 1.0]
    terms = (
        InformationGain(ALL, prior_sd_of(0.3), weight=0.5),
        InformationGain(ALL, prior_sd_of(0.3), criterion="A", dense=False),
        OutputError(ALL, goals, "goals", 3.0),
    )

    def of(objective: AbstractObjective) -> tuple[Array, Array]:
        env = env_of(objective)
        batch = experiments(env, Network(weights_of(env), env.layout), KEYS, 0.9)
        return batch.worth, env.objective.of_batch(batch.outcome)

    alone, together = [of(term) for term in terms], of(WeightedSum(terms))
    for i in range(2):
        np.testing.assert_allclose(together[i], sum(own[i] for own in alone), rtol=1e-9)
    # Goals are of the mean over the plants, which the mean of their worths is not.
    assert abs(together[1] - jnp.mean(together[0])) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", [n if n == "D and errors" else LONG(n) for n in OBJECTIVES])
def test_the_gradient_is_that_of_the_whole_experiment(name):
    env = env_of(OBJECTIVES[name])
    weights = weights_of(env)

    def worth(last_bias: Array) -> Array:
        changed = (weights[0], (weights[1][0], last_bias))
        return jnp.mean(experiments(env, Network(changed, env.layout), KEYS, 0.9).worth)

    # In double precision from the last layer on: no rounding of its change.
    bias = jnp.full(1, 0.05)
    both = jax.jit(jax.value_and_grad(worth))  # one program: it is compiled for long
    gradient = both(bias)[1]
    h = 1e-4
    difference = (both(bias + h)[0] - both(bias - h)[0]) / (2 * h)
    assert abs(float(difference)) > 1e-3
    np.testing.assert_allclose(gradient[0], difference, rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("criterion", "expected"),
    [
        ("D", d_optimality),
        ("A", lambda m: -jnp.log(a_optimality(m))),
        ("E", lambda m: jnp.log(e_optimality(m))),
    ],
)
def test_the_worth_is_the_criterion_of_the_information(criterion, expected):
    sd = prior_sd_of(0.3)
    env = env_of(InformationGain(ALL, sd, criterion=criterion, dense=False))
    weights = weights_of(env)
    state, inputs = run(env, weights, KEYS[0])
    prior = jnp.eye(3) / sd**2
    information = experiment_information(env.plant, state.params, inputs) + prior
    worth = experiments(env, Network(weights, env.layout), KEYS[:1], 0.9).worth[0]
    np.testing.assert_allclose(worth, expected(information) - expected(prior), rtol=1e-6)


@pytest.mark.science
def test_dense_and_terminal_information_are_worth_the_same():
    dense, terminal = (env_of(OBJECTIVES[name]) for name in ("D dense", "D"))
    weights = weights_of(dense)
    player = Network(weights, dense.layout)
    both = [experiments(env, player, KEYS, 0.9).worth for env in (dense, terminal)]
    np.testing.assert_allclose(both[0], both[1], rtol=1e-9)


def test_excess_counts_from_the_margin_to_the_critical_level():
    env = env_of(OBJECTIVES["D"])
    weights = weights_of(env)
    state, inputs = run(env, weights, KEYS[0])
    outputs = np.abs(response(env.plant, state.params, inputs)[1:, 0])
    critical = env.plant.definition.outputs[0].critical_level or 0.0
    margin = 0.5 * float(outputs.max()) / critical  # so that some samples lie beyond
    over = np.maximum(outputs / critical - margin, 0) / (1 - margin)
    batch = experiments(env, Network(weights, env.layout), KEYS[:1], margin)
    assert over.max() > 0
    np.testing.assert_allclose(batch.excess[0], np.mean(over**2), rtol=1e-6)
    np.testing.assert_allclose(batch.nearness[0], outputs.max() / critical, rtol=1e-6)


@pytest.mark.slow
def test_the_coast_is_penalised_and_not_rewarded():
    env = env_of(OBJECTIVES["D"], num_steps=8)
    network = Network(weights_of(env), env.layout)
    longer = dataclasses.replace(env, coast=30)
    short, long = (experiments(e, network, KEYS, 1e-3) for e in (env, longer))
    np.testing.assert_array_equal(short.worth, long.worth)
    assert np.all(np.asarray(long.excess) > np.asarray(short.excess))
    critical = env.plant.definition.outputs[0].critical_level or 0.0
    for i, key in enumerate(KEYS):
        state, inputs = run(env, network.weights, key)
        whole = jnp.concatenate([inputs, jnp.zeros((30, 1))])
        outputs = np.abs(response(env.plant, state.params, whole)[1:, 0]) / critical
        np.testing.assert_allclose(long.nearness[i], outputs.max(), rtol=1e-6)
        over = np.maximum(outputs - 1e-3, 0) / (1 - 1e-3)
        np.testing.assert_allclose(long.excess[i], np.sum(over**2) / 8, rtol=1e-6)


@pytest.mark.science
def test_training_learns_and_one_seed_gives_one_policy():
    env = env_of(OBJECTIVES["D"])
    settings = dataclasses.replace(FEW, num_updates=30, watch_every=10, last_gain=0.1)
    first, again = train(env, settings, 0), train(env, settings, 0)
    for a, b in zip(jax.tree.leaves(first.weights), jax.tree.leaves(again.weights), strict=True):
        np.testing.assert_array_equal(a, b)
    assert [row["steps"] for row in first.curve] == [0, 2400, 4800, 7200]  # 4 plants, 60 steps
    assert first.curve[-1]["return"] > first.curve[0]["return"] + 5
    other = train(env, settings, 1)
    assert not np.array_equal(first.weights[0][0], other.weights[0][0])


@pytest.mark.science
def test_the_penalty_grows_while_plants_are_in_danger():
    definition = Aero2.definition
    pitch = dataclasses.replace(definition.outputs[0], warning_level=5e-5, critical_level=1e-4)
    narrow = type(
        "Narrow", (Aero2,), {"definition": dataclasses.replace(definition, outputs=(pitch,))}
    )
    rows = []
    for plant in (Aero2(), narrow()):
        env = env_of(OBJECTIVES["D"], plant)
        rows.append(train(env, dataclasses.replace(FEW, last_gain=0.1), 0).curve[-1])
    calm, dangerous = rows
    assert calm["penalty_weight"] == FEW.penalty_weight
    assert dangerous["penalty_weight"] == pytest.approx(FEW.penalty_weight * np.exp(0.02 * 6))


@pytest.mark.science
def test_a_training_that_was_interrupted_ends_with_the_same_policy():
    env, files = env_of(OBJECTIVES["D"]), []
    whole = train(env, FEW, 0, on_boundary=lambda make, _: files.append(make().to_bytes()))
    for at in (2, 3):  # between two looks, and at one
        saved = Checkpoint.from_bytes(files[at], "checkpoint")
        rest = train(env, FEW, 0, resume=saved)
        assert rest.curve == whole.curve
        for a, b in zip(jax.tree.leaves(whole.weights), jax.tree.leaves(rest.weights), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("num_updates", 0, "at least 1"),
        ("learning_rate", math.inf, "positive"),
        ("penalty_decay", -0.1, "not be negative"),
        ("margin", 1.0, r"\[0, 1\)"),
        ("hidden", (), "widths"),
    ],
)
def test_settings_that_are_not_allowed_are_refused(name, value, allowed):
    with pytest.raises(ValueError, match=f"{name}.*{allowed}"):
        GradientSettings(**{name: value})


class Runaway(AbstractPlant):
    """x' = a x + u, so fast that its state soon overflows."""

    definition = PlantDescription(
        name="runaway",
        states=(State("x", "m"),),
        inputs=(Input("u", "m/s", -1.0, 1.0),),
        outputs=(Output("x", "m", 1.0, noise_sd=0.1),),
        parameters=(Parameter("a", "1/s", 200.0),),
        dt=0.1,
        band=(0.1, 2.0),
    )

    def derivative(self, state, input, params):
        return params.a * state + input

    def output(self, state, params):
        return state


@pytest.mark.science
def test_a_plant_that_runs_away_ends_in_a_sentence():
    env = env_of(InformationGain((True,), prior_sd_of(0.3), dense=False), Runaway(), num_steps=200)
    with pytest.raises(ValueError, match="every simulation of this plant diverges"):
        train(env, FEW, 0)


class Steep(InformationGain):
    """Its derivative is infinite for plants with a moment of inertia above a limit."""

    limit: float = 0.0

    def final(self, plant, memory, params):
        value = memory.information[0, 0]
        is_flat = params.J_p < self.limit
        return jnp.sqrt(jnp.where(is_flat, 1.0, 0.0) + value - jax.lax.stop_gradient(value))


@pytest.mark.science
@pytest.mark.parametrize("limit", [0.0, 0.028])
def test_updates_that_are_not_finite_are_counted_and_never_reach_the_weights(limit):
    env = env_of(Steep(ALL, prior_sd_of(0.3), dense=False, limit=limit))
    settings = dataclasses.replace(FEW, num_updates=12, watch_every=12)
    if limit == 0:
        with pytest.raises(ValueError, match="gradient was not finite in the last 12 updates"):
            train(env, settings, 0)
    else:
        trained = train(env, settings, 0)
        assert 0 < trained.curve[-1]["not_finite"] < 12
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(trained.weights))


@pytest.mark.science
def test_several_seeds_side_by_side_are_those_trained_alone():
    env = env_of(OBJECTIVES["D"])
    together = train_all(env, FEW, [0, 1])
    for seed, trained in enumerate(together):
        alone = train(env, FEW, seed)
        for a, b in zip(
            jax.tree.leaves(trained.weights), jax.tree.leaves(alone.weights), strict=True
        ):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)
        assert [row["steps"] for row in trained.curve] == [row["steps"] for row in alone.curve]


# ----------------------------------------------------------------------- declared uncertainty


def uncertain_env(num_steps: int = 60) -> Env:
    """A decision process whose policy is also made safe in a declared uncertainty."""
    env = env_of(InformationGain(ALL, prior_sd_of(0.3), dense=False), num_steps=num_steps)
    ranges = {"delay_voltage": (0, 0.1), "initial_state": "2%"}
    box = Uncertainty.of(env.plant, 0.3, ranges)
    return dataclasses.replace(env, uncertainty=box)


AGAINST = dataclasses.replace(
    FEW, num_adversaries=6, adversary_steps=2, adversaries_from=0.3, watch_every=6
)


def adversaries_after(steps: int, settings=AGAINST):
    """Of one update; how near they come, each with its own noise."""
    env = uncertain_env()
    settings = dataclasses.replace(settings, adversary_steps=steps)
    now = Optimisation.start(Network(weights_of(env), env.layout), settings, env)
    after, _ = update(env, settings, now, KEYS, True)
    assert env.uncertainty is not None
    assert after.adversaries is not None
    play = OnPlant(env.uncertainty, now.player.excitation(env.layout), 60)
    return after.adversaries, np.asarray(jax.vmap(play)(after.adversaries))


@pytest.mark.science
def test_adversaries_climb_from_where_they_start_and_come_nearest_first():
    _, started = adversaries_after(1)  # one step looks at the start alone
    _, climbed = adversaries_after(4)
    assert np.mean(climbed) > 1.001 * np.mean(started)
    np.testing.assert_array_equal(np.argsort(-climbed), np.arange(6))


@pytest.mark.science
def test_noise_of_adversaries_is_searched_within_its_bound():
    half = dataclasses.replace(AGAINST, adversary_noise=0.5)
    within, _ = adversaries_after(4, half)
    assert within.noise is not None
    assert np.abs(within.noise).max() == 0.5
    without, _ = adversaries_after(4, dataclasses.replace(AGAINST, adversary_noise=0.0))
    assert without.noise is not None
    np.testing.assert_array_equal(without.noise, 0.0)


@pytest.mark.science
def test_without_their_time_adversaries_stay_where_they_began():
    env = uncertain_env()
    now = Optimisation.start(Network(weights_of(env), env.layout), AGAINST, env)
    same, _ = update(env, AGAINST, now, KEYS)
    assert same.adversaries is not None
    np.testing.assert_array_equal(same.adversaries.point, 0.0)


@pytest.mark.science
def test_the_penalty_of_adversaries_lowers_the_nearness_in_the_declared_uncertainty():
    env = uncertain_env()
    heavy = dataclasses.replace(AGAINST, penalty_weight=1e6, adversary_margin=0.05)
    now = Optimisation.start(Network(weights_of(env), env.layout), heavy, env)
    box = env.uncertainty
    assert box is not None
    cases = Cases(jnp.ones((1, len(box.names))), jnp.zeros(1, int))

    def nearest(player: Network) -> float:
        return float(jax.vmap(OnPlant(box, player.excitation(env.layout), 60))(cases)[0])

    before, step = nearest(now.player), eqx.filter_jit(update)
    for i in range(10):
        now, _ = step(env, heavy, now, jax.random.split(jax.random.key(i), 3), True)
    assert nearest(now.player) < 0.9 * before


@pytest.mark.science
def test_an_interrupted_training_against_an_uncertainty_ends_with_the_same_policy():
    env, kept = uncertain_env(20), []
    settings = dataclasses.replace(AGAINST, allowed_nearness=0.5)

    def keep(checkpoint, row):
        kept.append(checkpoint().to_bytes())

    whole = train(env, settings, 0, on_boundary=keep)
    resumed = train(env, settings, 0, resume=Checkpoint.from_bytes(kept[4], "kept"))
    for (a, b), (c, d) in zip(whole.weights, resumed.weights, strict=True):
        np.testing.assert_array_equal(a, c)
        np.testing.assert_array_equal(b, d)
    assert "worst_nearness" in whole.validation


def test_a_policy_that_a_search_finds_too_near_ranks_below_a_safe_one_of_less_worth():
    row = {"steps": 1.0, "violation_rate": 0.0, "worth": 9.0}
    settings = GradientSettings(allowed_nearness=0.975)
    near, far = {**row, "worst_nearness": 0.99}, {**row, "worth": 1.0, "worst_nearness": 0.9}
    assert rank(settings, far) > rank(settings, near)
    assert rank(settings, {**row, "worst_nearness": 0.9}) == rank(settings, row)


@pytest.mark.science
def test_adversaries_that_diverge_leave_the_weights_finite_and_moving():
    env = uncertain_env()
    fast = Uncertainty.of(env.plant, 0.3, {"J_p": (1e-7, 0.03)})
    env = dataclasses.replace(env, uncertainty=fast)
    many = dataclasses.replace(AGAINST, num_adversaries=24)
    now = Optimisation.start(Network(weights_of(env), env.layout), many, env)
    after, _ = eqx.filter_jit(update)(env, many, now, KEYS, True)
    moved = [
        float(jnp.abs(a - b).max())
        for (a, _), (b, _) in zip(after.player.weights, now.player.weights, strict=True)
    ]
    assert all(0 < m < 1 for m in moved)
