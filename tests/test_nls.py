"""Nonlinear least squares: exact without noise, at the Cramér-Rao bound with it."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import FEW_AND_ALL, LONG, PLANTS, TwoMasses

import excite as ex
from excite.description import Input, Output, Parameter, PlantDescription, State, names_of
from excite.estimation import NLS, AbstractEstimator, Status, bound_reached, stack_experiments
from excite.estimation.contract import from_search, to_search
from excite.excitation import PRBS, Chirp, Multisine, Random
from excite.information import cramer_rao_bound, experiment_information, relative_size
from excite.plant import Aero2, Aero2Detailed, Sensor
from excite.simulation import response, run_episode

NUM_STEPS = 200
KEY = jax.random.key(23)


def all_free(plant):
    return jnp.ones(len(plant.definition.parameters), bool)


def true_params(plant):
    """Within 15 % of the nominal values, some above, some below."""
    count = len(plant.definition.parameters)
    factors = 1 + 0.15 * np.cos(2.0 * np.arange(count))
    return plant.Params(*(f * v for f, v in zip(factors, plant.nominal, strict=True)))


def noise_free(plant, inputs, start=None):
    return response(plant, true_params(plant), inputs, start)


def assert_recovered(plant, estimate, rtol: float = 1e-6) -> None:
    assert Status(int(estimate.status)) == Status.SUCCESSFUL
    np.testing.assert_allclose(estimate.params, true_params(plant), rtol=rtol)


# ------------------------------------------------------------------ without noise


@pytest.mark.parametrize("name", FEW_AND_ALL)
def test_noise_free_data_give_the_parameters(name):
    plant = PLANTS[name]
    inputs = Multisine().sequence(plant, NUM_STEPS, KEY)
    data = stack_experiments(plant, [inputs], [noise_free(plant, inputs)], True)
    estimate = NLS()(plant, data, plant.nominal, all_free(plant))
    assert_recovered(plant, estimate)
    np.testing.assert_array_equal(estimate.initial_state[0], plant.initial_state)
    assert estimate.params._fields == names_of(plant.definition.parameters)
    scale = np.array([o.scale for o in plant.definition.outputs])
    assert np.all(np.abs(estimate.residual) < 1e-7 * scale)


@pytest.mark.science
@pytest.mark.parametrize("name", PLANTS)
def test_noise_free_data_give_the_initial_state_too(name):
    plant = PLANTS[name]
    inputs = Chirp().sequence(plant, NUM_STEPS, KEY)
    scales = jnp.array([s.scale for s in plant.definition.states])
    start = plant.initial_state + 0.2 * scales * jnp.cos(1.0 + jnp.arange(len(scales)))
    data = stack_experiments(plant, [inputs], [noise_free(plant, inputs, start)], False)
    estimate = NLS()(plant, data, plant.nominal, all_free(plant))
    assert_recovered(plant, estimate)
    np.testing.assert_allclose(estimate.initial_state[0] / scales, start / scales, atol=1e-6)


def aero2_fit(estimator: AbstractEstimator | None = None, **changes):
    """One fit of 200 samples of the Aero 2, all of one compilation."""
    plant = changes.get("plant", Aero2())
    inputs = changes.get("inputs", Multisine().sequence(plant, NUM_STEPS, KEY))
    measured = changes.get("measured", noise_free(Aero2(), inputs))
    data = stack_experiments(plant, [inputs], [measured], True)
    free = changes.get("free", all_free(plant))
    return (estimator or NLS())(plant, data, changes.get("start", plant.nominal), free)


def test_a_held_parameter_stays_where_it_starts():
    true = true_params(Aero2())
    start = Aero2().nominal._replace(D_p=true.D_p)
    estimate = aero2_fit(start=start, free=jnp.array([True, True, False]))
    assert_recovered(Aero2(), estimate)
    assert float(estimate.params.D_p) == pytest.approx(float(true.D_p), rel=1e-14)
    for matrix in (estimate.covariance, estimate.information):
        np.testing.assert_array_equal(matrix[2], 0.0)
        np.testing.assert_array_equal(matrix[:, 2], 0.0)
        assert np.all(np.diag(matrix)[:2] > 0)


def test_a_parameter_held_at_a_wrong_value_is_not_moved_by_the_data():
    estimate = aero2_fit(free=jnp.array([False, True, True]))
    assert float(estimate.params.J_p) == pytest.approx(0.0232, rel=1e-14)
    assert abs(estimate.params.D_p / true_params(Aero2()).D_p - 1) > 0.01


def test_several_experiments_of_different_lengths_share_the_parameters():
    plant = Aero2()
    starts = [jnp.array(x) for x in ([0.3, 0.0], [-0.2, 0.4], [0.0, -0.3])]
    inputs = [
        Chirp().sequence(plant, 120, KEY),
        Random().sequence(plant, 40, KEY),
        jnp.zeros((75, 1)),  # a free decay, which alone would not show K_pu
    ]
    measured = [noise_free(plant, u, x) for u, x in zip(inputs, starts, strict=True)]
    estimate = NLS()(plant, stack_experiments(plant, inputs, measured, False))
    assert_recovered(plant, estimate)
    np.testing.assert_allclose(estimate.initial_state, jnp.stack(starts), atol=1e-7)
    assert estimate.residual.shape == (3, 121, 1)


def test_padding_of_an_experiment_changes_nothing():
    plant = Aero2()
    inputs = Multisine().sequence(plant, NUM_STEPS, KEY)
    measured = noise_free(plant, inputs) + 0.001 * jax.random.normal(KEY, (NUM_STEPS + 1, 1))
    data = stack_experiments(plant, [inputs, inputs[:50]], [measured, measured[:51]], True)
    other = jnp.where(data.valid, data.measured, 1e3)
    clean, dirty = (
        NLS()(plant, eqx.tree_at(lambda d: d.measured, data, m)) for m in (data.measured, other)
    )
    for ours, theirs in zip(jax.tree.leaves(dirty), jax.tree.leaves(clean), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.science
def test_every_start_within_thirty_percent_leads_to_the_same_estimate():
    plant = Aero2()
    factors = np.array(list(itertools.product((0.7, 1.3), repeat=3)))
    starts = plant.Params(*jnp.asarray(factors * np.stack(plant.nominal)).T)
    inputs = Chirp().sequence(plant, 300, KEY)
    data = stack_experiments(plant, [inputs], [noise_free(plant, inputs)], True)
    estimates = eqx.filter_vmap(lambda start: NLS()(plant, data, start))(starts)
    np.testing.assert_array_equal(estimates.status, Status.SUCCESSFUL)
    expected = np.repeat(np.stack(true_params(plant))[:, None], 8, axis=1)
    np.testing.assert_allclose(np.stack(estimates.params), expected, rtol=1e-6)


# -------------------------------------------------------------- failure is a value


def test_an_input_of_zero_is_ill_conditioned():
    still = jnp.zeros((NUM_STEPS, 1))
    noise = 0.001 * jax.random.normal(KEY, (NUM_STEPS + 1, 1))
    assert aero2_fit(inputs=still, measured=noise).status == Status.ILL_CONDITIONED


def test_data_that_are_not_a_number_are_not_finite():
    nothing = jnp.full((NUM_STEPS + 1, 1), jnp.nan)
    assert aero2_fit(measured=nothing).status == Status.NOT_FINITE


def test_a_search_cut_short_says_so():
    estimate = aero2_fit(NLS(max_steps=1))
    assert estimate.status == Status.ITERATIONS_EXHAUSTED


# --------------------------------------------------------------- search coordinates

MIXED = PlantDescription(
    name="mixed",
    states=(State("x", ""),),
    inputs=(Input("u", "", -1.0, 1.0),),
    outputs=(Output("y", "", 1.0),),
    parameters=(
        Parameter("positive", "", 3e-5),
        Parameter("free", "", -2.0, positive=False, scale=0.5),
        Parameter("between", "", 2.0, lower=1.0, upper=5.0),
        Parameter("above", "", 0.3, lower=0.01),
        Parameter("below", "", 0.3, upper=0.6),
        Parameter("free_between", "", 0.0, scale=0.1, lower=-1.0, upper=0.5, positive=False),
        Parameter("free_above", "", 0.0, scale=0.1, lower=-1.0, positive=False),
        Parameter("free_below", "", 0.0, scale=0.1, upper=0.5, positive=False),
    ),
    dt=1.0,
    band=(0.1, 0.5),
)
LOWER = np.array([0.0, -np.inf, 1.0, 0.01, 0.0, -1.0, -1.0, -np.inf])
UPPER = np.array([np.inf, np.inf, 5.0, np.inf, 0.6, 0.5, np.inf, 0.5])
VALUES = [
    [3e-5, -2.0, 2.0, 0.3, 0.3, 0.0, 0.0, 0.0],
    [1e-9, 70.0, 1.001, 0.011, 0.599, -0.99, -0.99, 0.49],
    [4e3, -900.0, 4.999, 200.0, 1e-4, 0.49, 50.0, -50.0],
]


@pytest.mark.parametrize("values", VALUES, ids=["nominal", "one end", "other end"])
def test_search_coordinates_there_and_back(values):
    z = to_search(MIXED, jnp.array(values))
    assert np.all(np.isfinite(z))
    np.testing.assert_allclose(from_search(MIXED, z), values, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(to_search(MIXED, from_search(MIXED, z)), z, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("size", [0.0, 1.0, -5.0, 30.0, -30.0])
def test_no_search_coordinate_leads_beyond_the_bounds(size):
    values = np.asarray(from_search(MIXED, jnp.full(8, size)))
    assert np.all((values >= LOWER) & (values <= UPPER))
    assert np.all(np.isfinite(values))


def test_without_bounds_the_coordinates_are_logarithms_and_multiples_of_the_scale():
    z = to_search(MIXED, jnp.array(VALUES[0]))
    np.testing.assert_allclose(z[:2], [np.log(3e-5), -4.0])


@pytest.mark.parametrize("i", range(8), ids=names_of(MIXED.parameters))
def test_one_unit_of_every_search_coordinate_is_a_relevant_change(i):
    # Steps and tolerances of the search mean the same for every parameter, bounded or not.
    parameter = MIXED.parameters[i]
    relevant = parameter.nominal if parameter.positive else parameter.scale
    slope = jax.jacfwd(from_search, argnums=1)(MIXED, to_search(MIXED, jnp.array(VALUES[0])))
    np.testing.assert_array_equal(slope, np.diag(np.diag(slope)))
    assert 1 / 3 < float(slope[i, i]) / relevant < 1 + 1e-9


@pytest.mark.parametrize(("i", "value", "bound"), [
    (2, 1.0005, 1.0), (2, 4.999, 5.0), (3, 0.010005, 0.01), (4, 0.5999, 0.6),
    (5, -0.999, -1.0), (7, 0.49999, 0.5), (0, 1e-30, None), (1, -1e9, None), (4, 1e-9, None),
])  # fmt: skip
def test_a_parameter_at_its_bound_is_found(i, value, bound):
    values = list(VALUES[0])
    values[i] = value
    assert bound_reached(MIXED, jnp.array(values)) == (None if bound is None else (i, bound))


class Bounded(Aero2):
    """An Aero 2 whose parameters have bounds; the true J_p is 0.02668."""

    J_p, K_pu, D_p = Aero2.definition.parameters
    definition = dataclasses.replace(
        Aero2.definition,
        parameters=(
            dataclasses.replace(J_p, lower=0.01, upper=0.05),
            dataclasses.replace(K_pu, lower=0.005),
            dataclasses.replace(D_p, upper=0.01),
        ),
    )


class Tight(Bounded):
    """A bound that keeps the true J_p out."""

    definition = dataclasses.replace(
        Bounded.definition,
        parameters=(
            dataclasses.replace(Bounded.J_p, upper=0.025),
            *Bounded.definition.parameters[1:],
        ),
    )


@pytest.mark.science
def test_bounds_with_room_change_nothing():
    assert_recovered(Aero2(), aero2_fit(plant=Bounded()))


def test_bounds_are_kept():
    estimate = aero2_fit(plant=Tight())
    assert 0.0249 < estimate.params.J_p <= 0.025
    assert bound_reached(Tight.definition, estimate.params) == (0, 0.025)
    assert all(np.isfinite(v) for v in estimate.params)


# ----------------------------------------------------------------------- with noise


@pytest.mark.parametrize("initial_state", ["known", "free"])
def test_the_covariance_is_that_of_the_bound(initial_state):
    plant = TwoMasses()
    known = initial_state == "known"
    episode = run_episode(plant, plant.nominal, Multisine(), NUM_STEPS, KEY)
    data = stack_experiments(plant, [episode.inputs], [episode.measured], known)
    estimate = NLS()(plant, data, plant.nominal, all_free(plant))
    at_start = plant.changed(initial_state=estimate.initial_state[0])
    information = experiment_information(
        at_start, estimate.params, episode.inputs, initial_state_known=known
    )
    bound = cramer_rao_bound(information) * relative_size(plant, estimate.params)
    # The noise is estimated from 201 samples of each output, to 5 %; three times that.
    np.testing.assert_allclose(np.sqrt(np.diag(estimate.covariance)), bound, rtol=0.15)
    size = np.stack(estimate.params)
    relative = estimate.covariance / np.outer(size, size)
    np.testing.assert_allclose(estimate.information @ relative, np.eye(4), atol=0.05)


@pytest.mark.parametrize("initial_state", ["known", LONG("free")])
def test_sensitivity_and_residual_of_a_fit_are_those_behind_its_information(initial_state):
    plant, known = TwoMasses(), initial_state == "known"
    estimator = NLS(noise="estimated")
    episode = run_episode(plant, plant.nominal, Multisine(), NUM_STEPS, KEY)
    data = stack_experiments(plant, [episode.inputs], [episode.measured], known)
    estimate = estimator(plant, data, plant.nominal, all_free(plant))
    S, residual = estimator.sensitivity(plant, data, estimate)
    M = np.einsum("etou,etov->uv", S, S)
    schur = M[:4, :4]
    if not known:
        schur = schur - M[:4, 4:] @ np.linalg.solve(M[4:, 4:], M[4:, :4])
    np.testing.assert_allclose(schur, estimate.information, rtol=1e-3, atol=1e-4 * schur.max())
    # Least squares: the residual is orthogonal to everything that could have moved it.
    slope = np.einsum("etou,eto->u", S, residual)
    assert np.all(np.abs(slope) < 0.01 * np.sqrt(np.diag(M)))
    spent = len(M) / 2
    np.testing.assert_allclose(np.sum(residual**2, axis=(0, 1)), NUM_STEPS + 1 - spent)


def test_outputs_can_be_weighted_by_the_noise_they_turn_out_to_have():
    plant = TwoMasses()
    misjudged = plant.changed(sensor=Sensor(jnp.array([0.02, 0.0004]), jnp.zeros(2)))
    episode = run_episode(plant, plant.nominal, Multisine(), NUM_STEPS, KEY)
    data = stack_experiments(plant, [episode.inputs], [episode.measured], True)
    nls = NLS(noise="estimated")
    right, wrong = (nls(p, data, p.nominal, all_free(p)) for p in (plant, misjudged))
    sd = np.sqrt(np.diag(right.covariance))
    assert np.all(np.abs(np.subtract(wrong.params, right.params)) < 0.05 * sd)
    np.testing.assert_allclose(wrong.covariance, right.covariance, rtol=0.05, atol=1e-9)


@pytest.mark.parametrize("initial_state", ["known", LONG("free")])
def test_the_covariance_allows_for_noise_that_was_declared_wrong(initial_state):
    known = initial_state == "known"
    declared = np.array([0.02, 0.0004])
    plant = TwoMasses().changed(sensor=Sensor(jnp.asarray(declared), jnp.zeros(2)))
    episode = run_episode(TwoMasses(), plant.nominal, Multisine(), NUM_STEPS, KEY)
    data = stack_experiments(plant, [episode.inputs], [episode.measured], known)
    estimate = NLS()(plant, data)
    S, residual = (np.asarray(part) for part in NLS().sensitivity(plant, data, estimate))
    S, residual = S[0], residual[0]
    count = len(residual) - S.shape[2] / 2
    variance = np.sum(residual**2, axis=0) / count  # of the weighted outputs
    H = np.einsum("tou,tov->uv", S, S)
    V = np.einsum("tou,o,tov->uv", S, variance, S)
    expected = np.linalg.solve(H, np.linalg.solve(H, V).T)[:4, :4]
    size = np.stack(estimate.params)
    relative = estimate.covariance / np.outer(size, size)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(relative / scale, expected / scale, atol=2e-3)
    right = NLS()(TwoMasses(), data)
    assert np.all(np.diag(estimate.covariance) > 0.95 * np.diag(right.covariance))


@pytest.mark.science
def test_known_noise_is_not_estimated():
    plant = Aero2()
    doubled = plant.changed(sensor=Sensor(2 * plant.sensor.noise_sd, plant.sensor.resolution))
    episode = run_episode(plant, plant.nominal, Multisine(), NUM_STEPS, KEY)
    data = stack_experiments(plant, [episode.inputs], [episode.measured], True)
    first, second = (NLS(noise="known")(p, data) for p in (plant, doubled))
    ratio = np.diag(second.covariance) / np.diag(first.covariance)
    np.testing.assert_allclose(
        ratio, float(doubled.sensor.sd[0] / plant.sensor.sd[0]) ** 2, rtol=1e-3
    )
    free = (NLS()(p, data) for p in (plant, doubled))
    one, other = (np.diag(e.covariance) for e in free)
    np.testing.assert_allclose(one, other, rtol=1e-3)


@pytest.mark.science
def test_many_fits_are_successful_at_the_bound_and_inside_their_intervals():
    plant = Aero2(sensor=Sensor(jnp.array([0.00063]), jnp.zeros(1)))
    draw_key, episode_key = jax.random.split(KEY)
    factors = jax.random.uniform(draw_key, (3, 60), float, 0.7, 1.3)
    params = plant.Params(*(f * v for f, v in zip(factors, plant.nominal, strict=True)))

    @jax.jit
    @jax.vmap
    def fit(params, inputs, measured):
        estimate = NLS()(plant, stack_experiments(plant, [inputs], [measured], True))
        error = jnp.stack(estimate.params) - jnp.stack(params)
        bound = cramer_rao_bound(experiment_information(plant, params, inputs))
        bound = bound * relative_size(plant, params)
        return estimate.status, error / bound, error / jnp.sqrt(jnp.diagonal(estimate.covariance))

    results = []
    for i, excitation in enumerate((Random(), PRBS(), Chirp())):
        keys = jax.random.split(jax.random.fold_in(episode_key, i), 60)
        many = jax.vmap(run_episode, in_axes=(None, 0, None, None, 0))
        episodes = many(plant, params, excitation, 500, keys)
        results.append(fit(params, episodes.inputs, episodes.measured))
    status, in_bounds, in_sd = (np.concatenate(parts) for parts in zip(*results, strict=True))

    np.testing.assert_array_equal(status, Status.SUCCESSFUL)
    assert np.abs(in_bounds).max() < 6  # a local minimum lies hundreds of bounds away
    assert 0.8 < np.sqrt(np.mean(in_bounds**2)) < 1.2
    # No bias, and 95 % intervals that hold 95 %: by their errors among 180 fits.
    assert np.all(np.abs(in_bounds.mean(axis=0)) < 5 / np.sqrt(180))
    assert abs(np.mean(np.abs(in_sd) < 1.96) - 0.95) < 3 * np.sqrt(0.95 * 0.05 / 180)


STUCK = [(0.0342, 0.00998, 0.000847), (0.0332, 0.00884, 0.001175), (0.0348, 0.00805, 0.001079)]
"""Of `aero2_detailed`: from the nominal values the search ends where the plant hardly moves."""


@pytest.mark.slow
@pytest.mark.parametrize("values", STUCK)
def test_a_search_that_ends_far_from_the_data_begins_elsewhere(values):
    plant = Aero2Detailed()
    true = plant.Params(*values)
    record = ex.simulate(plant, "aero2_detailed", params=true._asdict(), steps=300)
    found = NLS()(plant, stack_experiments(plant, [record.inputs[:-1]], [record.outputs], True))
    assert Status(int(found.status)) == Status.SUCCESSFUL
    np.testing.assert_allclose(found.params, true, rtol=0.01)
