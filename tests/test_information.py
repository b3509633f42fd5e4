"""Sensitivities against differences, information against NumPy, and its laws."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import FEW_AND_ALL, PLANTS

import excite as ex
from excite.estimation import ARX, NLS, stack_experiments
from excite.excitation import Multisine
from excite.information import (
    a_optimality,
    cramer_rao_bound,
    d_optimality,
    e_optimality,
    experiment_information,
    fisher_information,
    marginal_information,
    relative_size,
    running_information,
    sensitivity,
)
from excite.plant import Aero2, Sensor
from excite.simulation import response

NUM_STEPS = 120
names = pytest.mark.parametrize("name", PLANTS)


@functools.cache
def inputs_of(name: str):
    return Multisine().sequence(PLANTS[name], NUM_STEPS, jax.random.key(0))


def response_of(name: str):
    """Outputs over relative changes of the parameters and the initial state."""
    plant = PLANTS[name]
    count = len(plant.definition.parameters)
    size = relative_size(plant, plant.nominal)

    def outputs(unknowns):
        values = jnp.stack(plant.nominal) + size * unknowns[:count]
        start = plant.initial_state + unknowns[count:]
        return response(plant, plant.Params(*values), inputs_of(name), start)

    return outputs, count + len(plant.definition.states)


@functools.cache
def sensitivity_of(name: str) -> np.ndarray:
    response, count = response_of(name)
    return np.asarray(sensitivity(response, jnp.zeros(count)))


def random_sensitivity(num_unknowns: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(30, 2, num_unknowns))


def random_information(size: int) -> np.ndarray:
    S = random_sensitivity(size).reshape(-1, size) * 10.0 ** np.arange(size)
    return S.T @ S


# -------------------------------------------------------------------- sensitivities


@pytest.mark.parametrize("name", FEW_AND_ALL)
def test_sensitivities_agree_with_central_differences(name):
    response, count = response_of(name)
    exact = sensitivity_of(name)
    # An initial velocity moves EMPS through its Coulomb friction within 1 mm/s.
    steps = np.full(count, 2e-5)
    steps[len(PLANTS[name].definition.parameters) :] *= 0.1 if name == "emps" else 1.0

    @jax.jit
    def difference(direction, h):
        """Richardson's extrapolation of central differences, of order 4."""
        at = jax.vmap(lambda step: response(step * direction))
        ahead, behind, near, back = at(h * jnp.array([1.0, -1.0, 0.5, -0.5]))
        return (8 * (near - back) - (ahead - behind)) / (6 * h)

    for i in range(count):
        numerical = difference(jnp.eye(count)[i], steps[i])
        for column, other in zip(exact[:, :, i].T, numerical.T, strict=True):
            error = np.linalg.norm(column - other)
            assert error <= 1e-6 * np.linalg.norm(column) + 1e-12, (i, error)


# -------------------------------------------------------------- Fisher information


@names
def test_fisher_information_is_the_sum_of_squares_over_the_noise(name):
    S, sd = sensitivity_of(name), np.asarray(PLANTS[name].sensor.sd)
    expected = sum(S[:, j].T @ S[:, j] / sd[j] ** 2 for j in range(S.shape[1]))
    ours = fisher_information(jnp.asarray(S), jnp.asarray(sd))
    np.testing.assert_allclose(ours, expected, rtol=1e-10, atol=1e-12 * np.abs(expected).max())


@names
@pytest.mark.parametrize("initial_state", ["known", "free"])
def test_information_of_an_experiment_is_that_of_its_sensitivities(name, initial_state):
    plant = PLANTS[name]
    count = len(plant.definition.parameters)
    weighted = (sensitivity_of(name) / np.asarray(plant.sensor.sd)[None, :, None]).reshape(
        -1, count + len(plant.definition.states)
    )
    if initial_state == "known":
        weighted = weighted[:, :count]
    # The bound on the parameters is the corner of the inverse of the whole information.
    R = np.linalg.qr(weighted, mode="r")
    bound = np.linalg.norm(np.linalg.inv(R)[:count], axis=1)
    ours = experiment_information(
        plant, plant.nominal, inputs_of(name), initial_state_known=initial_state == "known"
    )
    np.testing.assert_allclose(cramer_rao_bound(ours), bound, rtol=1e-5)
    np.testing.assert_allclose(ours, ours.T, rtol=1e-12)
    assert np.linalg.eigvalsh(ours)[0] > 0


@pytest.mark.parametrize("name", FEW_AND_ALL)
def test_running_information_grows_to_that_of_the_whole_experiment(name):
    plant, inputs = PLANTS[name], inputs_of(name)
    running = running_information(plant, plant.nominal, inputs)
    assert running.shape[0] == len(inputs)
    whole = experiment_information(plant, plant.nominal, inputs)
    np.testing.assert_allclose(running[-1], whole, rtol=1e-9, atol=1e-9 * np.abs(whole).max())
    half = len(inputs) // 2
    first = experiment_information(plant, plant.nominal, inputs[:half])
    np.testing.assert_allclose(running[half - 1], first, rtol=1e-9, atol=1e-9 * np.abs(first).max())


@names
def test_an_unknown_initial_state_never_adds_information(name):
    plant = PLANTS[name]
    known = experiment_information(plant, plant.nominal, inputs_of(name))
    free = experiment_information(plant, plant.nominal, inputs_of(name), initial_state_known=False)
    lost = np.linalg.eigvalsh(known - free)
    assert lost[0] >= -1e-9 * lost[-1]
    assert np.all(cramer_rao_bound(free) >= cramer_rao_bound(known) * (1 - 1e-9))


def test_half_the_noise_is_four_times_the_information():
    plant = PLANTS["aero2"]
    quiet = plant.changed(sensor=Sensor(plant.sensor.noise_sd / 2, plant.sensor.resolution))
    loud_, quiet_ = (
        experiment_information(p, p.nominal, inputs_of("aero2")) for p in (plant, quiet)
    )
    np.testing.assert_allclose(quiet_, 4 * loud_, rtol=1e-10)


def test_information_is_relative_and_so_the_same_in_any_unit_of_a_parameter():
    # Weight and damping of the Aero 2 in another unit of mass: J_p, D_p and m together.
    plant, heavy = Aero2(), Aero2(m=1070.0)
    scaled = plant.nominal._replace(J_p=1e3 * plant.nominal.J_p, D_p=1e3 * plant.nominal.D_p)
    ours = experiment_information(plant, plant.nominal, inputs_of("aero2"))
    theirs = experiment_information(heavy, scaled, inputs_of("aero2"))
    np.testing.assert_allclose(theirs, ours, rtol=1e-9)


def test_relative_size_is_the_value_of_a_positive_parameter_and_the_scale_of_a_free_one():
    plant = PLANTS["emps"]
    params = plant.Params(*jnp.array([50.0, 100.0, 10.0, 7.0]))
    np.testing.assert_array_equal(relative_size(plant, params), [50.0, 100.0, 10.0, 3.1648])


# --------------------------------------------------------------------- marginal


@pytest.mark.parametrize("num_others", [0, 1, 4])
def test_marginal_information_is_the_schur_complement(num_others):
    S, sd = random_sensitivity(3 + num_others), np.array([0.5, 2.0])
    W = (S / sd[None, :, None]).reshape(-1, 3 + num_others)
    M = W.T @ W
    A, B, C = M[:3, :3], M[:3, 3:], M[3:, 3:]
    schur = A - B @ np.linalg.solve(C, B.T)
    ours = marginal_information(jnp.asarray(S), jnp.asarray(sd), 3)
    np.testing.assert_allclose(ours, schur, rtol=1e-9, atol=1e-12)


def test_a_direction_of_the_others_that_is_not_seen_changes_nothing():
    S = random_sensitivity(3)
    unseen = np.concatenate([S, np.zeros((30, 2, 1))], axis=2)
    twice = np.concatenate([S, S[:, :, :1], S[:, :, :1]], axis=2)[:, :, 1:]
    sd = jnp.ones(2)
    full = marginal_information(jnp.asarray(S), sd, 3)
    np.testing.assert_allclose(marginal_information(jnp.asarray(unseen), sd, 3), full, rtol=1e-9)
    # Two others that move together count as one.
    once = marginal_information(jnp.asarray(twice[:, :, :3]), sd, 2)
    np.testing.assert_allclose(marginal_information(jnp.asarray(twice), sd, 2), once, rtol=1e-9)


# --------------------------------------------------------------------- criteria


def test_criteria_are_those_of_numpy():
    M = random_information(4)
    inverse = np.linalg.inv(M)
    assert d_optimality(jnp.asarray(M)) == pytest.approx(np.linalg.slogdet(M)[1])
    assert a_optimality(jnp.asarray(M)) == pytest.approx(np.trace(inverse), rel=1e-9)
    assert e_optimality(jnp.asarray(M)) == pytest.approx(np.linalg.eigvalsh(M)[0], rel=1e-6)
    np.testing.assert_allclose(
        cramer_rao_bound(jnp.asarray(M)), np.sqrt(np.diag(inverse)), rtol=1e-9
    )


def test_the_bound_survives_parameters_of_very_different_size():
    M = np.array([[2.0, 1.0], [1.0, 2.0]])
    unit = np.diag([1e-9, 1e9])
    np.testing.assert_allclose(
        cramer_rao_bound(jnp.asarray(unit @ M @ unit)), np.sqrt(2 / 3) / np.diag(unit), rtol=1e-9
    )


@pytest.mark.parametrize("matrix", [
    np.zeros((2, 2)), np.ones((2, 2)), np.diag([1.0, 0.0]),
    np.outer([1.0, 1e-8], [1.0, 1e-8]),
], ids=["nothing", "twins", "one unseen", "twins of different size"])  # fmt: skip
def test_a_singular_information_has_no_finite_bound_for_what_it_does_not_see(matrix):
    M = jnp.asarray(matrix)
    bound = cramer_rao_bound(M)
    assert not np.any(np.isnan(bound))
    assert bound[1] == np.inf
    assert d_optimality(M) == -np.inf
    assert a_optimality(M) == np.inf
    assert e_optimality(M) == pytest.approx(0.0, abs=1e-12)


def test_a_free_decay_bounds_the_damping_though_it_does_not_see_the_gain():
    plant = Aero2(initial_state=jnp.array([0.5, 0.0]))
    M = np.asarray(experiment_information(plant, plant.nominal, jnp.zeros((NUM_STEPS, 1))))
    np.testing.assert_array_equal(M[1], 0.0)
    seen = np.sqrt(np.diag(np.linalg.inv(M[::2, ::2])))
    np.testing.assert_allclose(cramer_rao_bound(jnp.asarray(M)), [seen[0], np.inf, seen[1]])


# -------------------------------------------------------------- double precision


def test_single_precision_is_refused_in_a_sentence():
    plant = PLANTS["aero2"]
    outputs = np.zeros((11, 1))
    with jax.enable_x64(False):
        single = Aero2()
        data = stack_experiments(single, [jnp.zeros((10, 1))], [jnp.asarray(outputs, "f4")], True)
        for call in (
            lambda: sensitivity(lambda x: x[:, None], jnp.zeros(2)),
            lambda: experiment_information(single, single.nominal, jnp.zeros((10, 1))),
            lambda: ARX()(single, data),
            lambda: NLS()(single, data),
        ):
            with pytest.raises(ValueError, match="need double precision: call jax"):
                call()
    assert experiment_information(plant, plant.nominal, inputs_of("aero2")).dtype == np.float64


def test_an_output_beyond_its_critical_level_is_told():
    safe = ex.information("aero2", "chirp", steps=100)
    assert safe.warnings == ()
    loud = ex.information("aero2", "square", options={"amplitude": 24.0}, steps=100)
    assert re.search(r"^pitch reaches \S+ times its critical level: on a rig", loud.warnings[0])
    unstable = {"J_p": 0.0232, "K_pu": 100.0}  # thousands of turns
    with pytest.raises(ValueError, match=r"pitch reaches .*: its information cannot be trusted"):
        ex.information("aero2", "square", options={"amplitude": 24.0}, params=unstable, steps=100)
