"""Plants with process noise whose state is observed: simulation, likelihood, gain, training."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import excite as ex
from excite.description import Input, Output, Parameter, PlantDescription, Spread, State
from excite.environment import Env, InformationGain, run_episodes
from excite.estimation import NLS
from excite.estimation.prior import Prior, PriorPlants
from excite.excitation import PRBS, PolicyExcitation
from excite.files import module_at
from excite.plant import AbstractPlant, Aero2
from excite.plant.catalogue import plant_named
from excite.policy import Layout
from excite.simulation import predicted, run_episode
from excite.training.gradient import train
from excite.training.settings import GradientSettings

EXAMPLES = Path(__file__).parent.parent / "examples"
DT, SD = 0.1, (0.02, 0.3)
PRIOR = {"a": "normal:2:0.4", "c": "normal:1:0.3"}


class Pushed(AbstractPlant):
    """x' = v, v' = -a x - v + c u, linear in both parameters, with noise on both states."""

    definition = PlantDescription(
        name="pushed",
        states=(State("x", "m", noise_sd=SD[0]), State("v", "m/s", noise_sd=SD[1])),
        inputs=(Input("u", "N", -1.0, 1.0),),
        outputs=(Output("x", "m", scale=1.0), Output("v", "m/s", scale=2.0)),
        parameters=(
            Parameter("a", "1/s²", 2.0, positive=False),
            Parameter("c", "1/kg", 1.0, positive=False),
        ),
        dt=DT,
        integrator="euler",
    )

    def derivative(self, state, input, params):
        x, v = state
        return jnp.stack([v, -params.a * x - v + params.c * input[0]])

    def output(self, state, params):
        return state


def gain_of(states: np.ndarray, inputs: np.ndarray) -> float:
    """Of one record, for the prior above: half the log det of I + P M, without excite."""
    B = DT * np.column_stack([-states[:-1, 0], inputs[:, 0]])
    M = B.T @ B / SD[1] ** 2
    P = np.diag([0.4, 0.3]) ** 2
    return 0.5 * float(np.linalg.slogdet(np.eye(2) + P @ M)[1])


def test_a_disturbed_plant_moves_by_euler_and_maruyama():
    plant = Pushed()
    run = run_episode(plant, plant.nominal, PRBS(), 4000, jax.random.key(0))
    states, inputs = np.asarray(run.outputs), np.asarray(run.inputs)
    np.testing.assert_array_equal(run.measured, run.outputs)
    x, v = states[:-1].T
    steps = np.column_stack([x + DT * v, v + DT * (-2 * x - v + inputs[:, 0])])
    noise = (states[1:] - steps) / SD
    assert np.abs(noise.mean(axis=0)).max() < 4 / math.sqrt(4000)
    np.testing.assert_allclose(noise.std(axis=0), 1, atol=4 / math.sqrt(2 * 4000))
    for a, b in ((noise[:, 0], noise[:, 1]), (noise[1:, 1], noise[:-1, 1])):
        assert abs(np.mean(a * b)) < 4 / math.sqrt(4000)
    outputs, sd = predicted(plant, plant.nominal, run.inputs, run.measured)
    np.testing.assert_allclose(outputs[1:], steps, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(sd, SD)


def test_noise_grows_with_the_root_of_the_sampling_time_and_none_is_no_field():
    np.testing.assert_allclose(Pushed(dt=0.4).process_noise_sd, 2 * np.array(SD))
    told = Aero2.definition.to_dict()
    assert "integrator" not in told
    assert "noise_sd" not in told["states"][0]
    again = PlantDescription.from_dict(Pushed.definition.to_dict())
    assert again == Pushed.definition
    assert (again.is_disturbed, again.observes_state) == (True, True)


@pytest.mark.slow
def test_where_records_are_linear_in_the_parameters_all_figures_are_the_exact_gain():
    found = ex.information_gain(Pushed, "prbs", steps=40, prior=PRIOR, plants=300, samples=300)
    plant, rng = Pushed(), np.random.default_rng(0)
    values = []
    for i in range(300):
        params = plant.Params(*jnp.asarray(rng.normal([2, 1], [0.4, 0.3])))
        run = run_episode(plant, params, PRBS(), 40, jax.random.key(i))
        values.append(gain_of(np.asarray(run.outputs), np.asarray(run.inputs)))
    exact, error = np.mean(values), np.std(values) / math.sqrt(300)
    for mean in (found.lower, found.upper, found.laplace):
        assert abs(mean.value - exact) < 4 * math.hypot(mean.std_error, error)
    assert found.upper.value - found.lower.value < 0.02
    # An input of ±1 changes by two at half of the steps; the first from rest.
    assert found.changes.value == pytest.approx(1 + 4 * 0.5 * 39, rel=0.15)


def env_of(price: float = 0.0, num_steps: int = 30) -> Env:
    plant = Pushed()
    normal = Prior.normal(["a", "c"], [2.0, 1.0], np.diag([0.4, 0.3]) ** 2)
    prior = PriorPlants(plant, normal, Spread.of(0.3))
    objective = InformationGain(
        (True, True), 1.0, 0.5, dense=False, prior=prior, change_price=price
    )
    layout = Layout.of(plant.description, window=1, num_steps=num_steps)
    return Env.of(plant, objective=objective, layout=layout, prior=prior)


@pytest.mark.slow
@pytest.mark.parametrize("dense", [False, True])
def test_the_objective_is_the_exact_gain_less_the_price_of_changes(dense):
    env = env_of(price=0.1, num_steps=12)
    objective: Any = env.objective
    env = Env.of(
        env.plant, objective=InformationGain(
            (True, True), 1.0, 0.5, dense=dense, prior=objective.prior, change_price=0.1
        ), layout=env.layout, prior=env.prior,
    )  # fmt: skip
    state, _ = env.reset(jax.random.key(3))
    rng, states, inputs, total = np.random.default_rng(1), [state.plant_state], [], 0.0
    for _ in range(12):
        action = jnp.asarray(rng.uniform(-1, 1, 1))
        state, _, gain = env.advance(state, action)
        states.append(state.plant_state)
        inputs.append(np.asarray(action))
        total += float(gain)
    total += float(env.objective.final(env.plant, state.memory, state.params))
    changes = np.diff(np.concatenate([[0.0], np.ravel(inputs)]))
    expected = gain_of(np.stack(states), np.stack(inputs)) - 0.1 * np.sum(changes**2)
    assert total == pytest.approx(expected, rel=1e-9)


def test_coordinates_of_a_prior_are_its_standard_deviations():
    plant = Aero2()
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]])
    normal = Prior.normal(["J_p", "D_p"], [math.log(0.02), 0.001], covariance, [True, False])
    prior = PriorPlants(plant, normal, Spread.of(0.2))
    params = plant.Params(*map(jnp.asarray, (0.03, 0.0125, 0.002)))
    changes = np.asarray(prior.changes(params))
    expected = np.zeros((3, 3))
    expected[np.ix_([0, 2], [0, 2])] = covariance * np.outer([0.03, 1.0], [0.03, 1.0])
    expected[1, 1] = (0.2 * 0.0125) ** 2 / 3
    np.testing.assert_allclose(changes @ changes.T, expected, rtol=1e-9)
    z = jnp.asarray([0.3, 0.0, -0.5])
    slope = jax.jacfwd(lambda z: jnp.stack(prior.params(z)))(z)
    np.testing.assert_allclose(prior.changes(prior.params(z))[0], slope[0], rtol=1e-9)
    np.testing.assert_allclose(prior.changes(prior.params(z))[2], slope[2], rtol=1e-9)


@pytest.mark.science  # a training, 15 s
def test_the_best_of_many_linear_feedbacks_is_trained_to_more_than_it_began_with():
    env = env_of()
    settings = GradientSettings(
        starts=24, num_updates=30, num_plants=16, hidden=(8, 8), watch_every=15, watch_episodes=64
    )
    trained = train(env, settings, 0)
    worth = [row["worth"] for row in trained.curve]
    single = train(env, GradientSettings(**{**settings.__dict__, "starts": 1}), 0).curve[0]
    assert worth[0] > 1.5 * single["worth"]  # what begins small tells next to nothing
    assert worth[-1] >= worth[0] - 0.01
    policy = PolicyExcitation(jax.tree.map(jnp.asarray, trained.weights), env.layout)
    found = ex.information_gain(Pushed, policy, steps=30, prior=PRIOR, plants=256, samples=200)
    assert abs(found.laplace.value - worth[-1]) < 4 * math.hypot(found.laplace.std_error, 0.05)
    assert found.laplace.value > ex.information_gain(
        Pushed, "prbs", steps=30, prior=PRIOR, plants=256, samples=200
    ).laplace.value  # fmt: skip


def regression(record, sd=1.0):
    """Estimate and information (a, c) by linear least squares of all steps, without excite."""
    x, u = record.outputs, record.inputs[:-1]
    B = DT * np.column_stack([-x[:-1, 0], u[:, 0]])
    y = x[1:, 1] - (1 - DT) * x[:-1, 1]
    M = B.T @ B / sd**2
    return np.linalg.solve(M, B.T @ y / sd**2), M, y - B @ np.linalg.solve(M, B.T @ y / sd**2)


@pytest.mark.slow
def test_where_the_state_is_observed_nls_is_the_regression_of_its_steps():
    records = [ex.simulate(Pushed, "prbs", steps=n, seed=n) for n in (40, 70)]
    for record in records:
        found = ex.identify(record, Pushed)
        expected, M, rest = regression(record)
        np.testing.assert_allclose(list(found.params.values()), expected, rtol=1e-6)
        # Of both outputs, by whose declared noise they are weighed; two unknowns are shared.
        variance = rest @ rest / (len(rest) - 1)
        np.testing.assert_allclose(found.covariance, variance * np.linalg.inv(M), rtol=1e-4)
        computed = found.fitted[0].computed["predicted"][1:, 1]
        np.testing.assert_allclose(computed, record.outputs[1:, 1] - rest, atol=1e-5)
    both = ex.identify(records, Pushed, estimator=NLS(noise="known"))
    parts = [regression(record, SD[1]) for record in records]
    M = sum(part[1] for part in parts)
    expected = np.linalg.solve(M, sum(part[1] @ part[0] for part in parts))
    np.testing.assert_allclose(list(both.params.values()), expected, rtol=1e-6)
    np.testing.assert_allclose(both.covariance, np.linalg.inv(M), rtol=1e-6)


@pytest.mark.slow
def test_with_a_prior_it_is_the_most_probable_estimate():
    record = ex.simulate(Pushed, "prbs", steps=40, seed=3)
    found = ex.identify(record, Pushed, estimator=NLS(noise="known"), prior=PRIOR)
    expected, M, _ = regression(record, SD[1])
    W, mean = np.diag([1 / 0.4, 1 / 0.3]) ** 2, np.array([2.0, 1.0])
    posterior = np.linalg.solve(M + W, M @ expected + W @ mean)
    np.testing.assert_allclose(list(found.params.values()), posterior, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(M + W), rtol=1e-6)


@pytest.mark.slow
def test_a_sample_that_is_missing_costs_the_two_steps_beside_it():
    record = ex.simulate(Pushed, "prbs", steps=60, seed=4)
    outputs = record.outputs.copy()
    outputs[20, 1] = np.nan
    found = ex.identify(dataclasses.replace(record, outputs=outputs), Pushed)
    x, u, kept = record.outputs, record.inputs[:-1], np.setdiff1d(np.arange(60), [19, 20])
    B = DT * np.column_stack([-x[:-1, 0], u[:, 0]])[kept]
    y = (x[1:, 1] - (1 - DT) * x[:-1, 1])[kept]
    expected = np.linalg.lstsq(B, y)[0]
    np.testing.assert_allclose(list(found.params.values()), expected, rtol=1e-6)
    told = found.fitted[0].computed["predicted"]
    assert np.isnan(told[[0, 21]]).all()  # no step leads there
    assert np.isfinite(np.delete(told, [0, 20, 21], axis=0)).all()


@pytest.mark.slow
def test_the_step_across_a_gap_is_left_out():
    record = ex.simulate(Pushed, "prbs", steps=60, seed=4)
    time = record.time + np.where(np.arange(61) > 30, 5.0, 0.0)
    found = ex.identify(dataclasses.replace(record, time=time), Pushed)
    x, u, kept = record.outputs, record.inputs[:-1], np.setdiff1d(np.arange(60), [30])
    B = DT * np.column_stack([-x[:-1, 0], u[:, 0]])[kept]
    expected = np.linalg.lstsq(B, (x[1:, 1] - (1 - DT) * x[:-1, 1])[kept])[0]
    np.testing.assert_allclose(list(found.params.values()), expected, rtol=1e-6)


@pytest.mark.slow
def test_a_held_out_record_is_judged_by_the_noise_of_the_estimation():
    record, same = (ex.simulate(Pushed, "prbs", steps=200, seed=seed) for seed in (5, 6))
    loud = ex.simulate(Loud, "prbs", steps=200, seed=7)
    found = ex.identify(record, Pushed, validate=[same, loud])
    told = found.summary().validation
    inside, outside = ((held.inside_band_percent or {})["v"] for held in told)
    assert 90 < inside < 99
    assert outside < 50  # five times the noise


@pytest.mark.slow
def test_a_fit_by_steps_has_no_initial_state_among_its_unknowns():
    record = ex.simulate(Pushed, "prbs", steps=60, seed=4)
    counts = [
        ex.compare_plants(record, [Pushed, Loud], initial_state=state).plants[0].num_unknowns
        for state in ("known", "free")
    ]
    assert counts == [4, 4]  # two parameters, and the noise of two outputs


def test_the_bound_of_an_episode_is_that_of_its_steps():
    plant, keys = Pushed(), jax.random.split(jax.random.key(2), 3)
    found = run_episodes(plant, PRBS(), 30, 0.3, keys)
    for i in range(3):
        states, inputs = (
            np.asarray(rows[i]) for rows in (found.trajectory.measured, found.trajectory.inputs)
        )
        B = DT * np.column_stack([-states[:-1, 0], inputs[:, 0]])
        scale = np.diag([p.scale for p in plant.definition.parameters])
        expected = scale @ (B.T @ B / SD[1] ** 2) @ scale
        np.testing.assert_allclose(found.information[i], expected, rtol=1e-9)


class Loud(Pushed):
    """The same with five times the noise."""

    definition = dataclasses.replace(
        Pushed.definition,
        states=tuple(
            dataclasses.replace(state, noise_sd=5 * state.noise_sd)
            for state in Pushed.definition.states
        ),
    )


class Hidden(Pushed):
    """The same, with one output alone and noise of its sensor."""

    definition = PlantDescription(
        name="hidden",
        states=Pushed.definition.states,
        inputs=Pushed.definition.inputs,
        outputs=(Output("x", "m", scale=1.0, noise_sd=0.01),),
        parameters=Pushed.definition.parameters,
        dt=DT,
    )

    def output(self, state, params):
        return state[:1]


def uneven(record):
    """The same at times that jitter."""
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, len(record.time))
    return dataclasses.replace(record, time=record.time + DT * jitter)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: ex.information_gain(Hidden, "prbs"), "has process noise, and its state is not"),
        (lambda: ex.information(Pushed, "prbs"), "its information differs from record to record"),
        (lambda: ex.identify(ex.simulate(Hidden, "prbs"), Hidden), "use the estimator pem"),
        (
            lambda: ex.identify(ex.simulate(Pushed, "prbs"), Pushed, estimator="decrement"),
            "use the estimator pem",
        ),
        (
            lambda: ex.identify(uneven(ex.simulate(Pushed, "prbs")), Pushed),
            "times are uneven, and plant 'pushed' has process noise",
        ),
        (lambda: ex.Campaign(Pushed, {"a": "1%"}), "its information differs from record to record"),
        (lambda: State("x", "m", noise_sd=-1.0), "noise_sd of state 'x' must not be negative"),
        (
            lambda: PlantDescription(
                **{**Pushed.definition.__dict__, "integrator": "eular"}
            ),
            "unknown integrator 'eular'; did you mean 'euler'",
        ),
    ],
)  # fmt: skip
def test_what_is_not_possible_is_one_sentence(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize(
    ("name", "scale"),
    [("LinearPendulum", 1), ("NonlinearPendulum", 1), ("CartPole", 5), ("DoublePendulum", 4)],
)
def test_the_pendulums_of_the_comparison_are_those_of_its_source(name, scale):
    plant = plant_named(f"{EXAMPLES / 'smc_pendulums.py'}:{name}")
    d = plant.definition
    assert d.observes_state
    assert d.inputs[0].upper == scale
    # Every row of the mass matrix times the accelerations is the sum of the forces.
    state = jnp.asarray(np.random.default_rng(0).normal(size=len(d.states)))
    u = jnp.asarray(np.linspace(0.4, 0.9, len(d.inputs)))
    slope = np.asarray(plant.derivative(state, u, plant.nominal))
    np.testing.assert_allclose(slope, FORCES[name](np.asarray(state), np.asarray(u)), rtol=1e-9)


def _linear(x, u):
    return [x[1], -14.7 * math.sin(x[0]) + 3 * u[0]]


def _nonlinear(x, u):
    return [x[1], -1.5 * 9.81 * math.sin(x[0]) + 3 * (u[0] - 0.1 * x[1])]


def _cart_pole(x, u):
    s, q, v, w = x
    friction, hinge = 0.01 * v + 0.01 * s, 0.01 * w + 0.01 * q
    sin, cos, g = math.sin(q), math.cos(q), 9.81
    D = 1 + sin**2
    cart = (u[0] - friction - hinge * cos + sin * (w**2 + g * cos)) / D
    pole = (-u[0] * cos - friction * cos - w**2 * cos * sin - 2 * g * sin - hinge * cos**2) / D
    return [v, w, cart, pole]


def _double(x, u):
    q1, q2, w1, w2 = x
    M = np.array([[3 + 2 * math.cos(q2), 1 + math.cos(q2)], [1 + math.cos(q2), 1.0]])
    s = math.sin(q2)
    C = np.array([[0, -(2 * w1 + w2) * s], [0.5 * (2 * w1 + w2) * s, -0.5 * w1 * s]])
    tau = -9.81 * np.array([2 * math.sin(q1) + math.sin(q1 + q2), math.sin(q1 + q2)])
    force = tau + u - 0.1 * np.array([w1, w2]) - C @ [w1, w2]
    return [w1, w2, *np.linalg.solve(M, force)]


FORCES: Any = {
    "LinearPendulum": _linear, "NonlinearPendulum": _nonlinear, "CartPole": _cart_pole,
    "DoublePendulum": _double,
}  # fmt: skip


def test_a_published_policy_is_read_and_played(tmp_path):
    RecurrentPolicy = module_at(EXAMPLES / "smc_policies.py").RecurrentPolicy
    rng, sizes = np.random.default_rng(0), {"enc1": (2, 8), "enc2": (8, 8), "enc3": (8, 3)}
    sizes |= {"mean1": (3, 8), "mean2": (8, 8), "mean3": (8, 1)}
    weights = {}
    for name, shape in sizes.items():
        weights[f"{name}_weight"] = rng.normal(size=shape)
        weights[f"{name}_bias"] = rng.normal(size=shape[1])
    for name in ("gru4", "gru5"):
        weights |= {f"{name}_{part}": rng.normal(size=(3, 9)) for part in ("Wi", "Wh")}
        weights |= {f"{name}_b": rng.normal(size=9), f"{name}_state0": np.zeros((1, 3))}
    np.savez(tmp_path / "weights.npz", **weights)
    record = ex.simulate(Pushed, RecurrentPolicy.read(tmp_path / "weights.npz"), steps=20, seed=1)
    W, h1, h2 = weights, np.zeros(3), np.zeros(3)

    def unit(name, h, x):
        r_i, z_i, c_i = np.split(x @ W[f"{name}_Wi"], 3)
        r_h, z_h, c_h = np.split(h @ W[f"{name}_Wh"], 3)
        r_b, z_b, c_b = np.split(W[f"{name}_b"], 3)
        r, z = (1 / (1 + np.exp(-v)) for v in (r_i + r_h + r_b, z_i + z_h + z_b))
        return (1 - z) * np.tanh(c_i + r * c_h + c_b) + z * h

    for state, u in zip(record.outputs[:-1], record.inputs[:-1], strict=True):
        x = state
        for name in ("enc1", "enc2"):
            x = np.maximum(x @ W[f"{name}_weight"] + W[f"{name}_bias"], 0)
        h1 = unit("gru4", h1, x @ W["enc3_weight"] + W["enc3_bias"])
        h2 = x = unit("gru5", h2, h1)
        for name in ("mean1", "mean2"):
            x = np.maximum(x @ W[f"{name}_weight"] + W[f"{name}_bias"], 0)
        np.testing.assert_allclose(u, np.tanh(x @ W["mean3_weight"] + W["mean3_bias"]), rtol=1e-9)
