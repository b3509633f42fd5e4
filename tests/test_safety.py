"""Warning and critical level: one judgement for NumPy and JAX."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import PLANTS, TwoMasses

from excite.description import Output, PlantDescription
from excite.plant import Aero2, DCMotor
from excite.safety import (
    critical_levels,
    is_violation,
    max_abs_output,
    penalty,
    watched_levels,
    watched_output,
)

LEVELS = np.array([1.0, np.inf])


def episode(largest: float, at: int, output: int = 0) -> np.ndarray:
    """Small outputs with one large value."""
    outputs = np.full((20, 2), 0.1)
    outputs[at, output] = largest
    return outputs


@pytest.mark.parametrize(("largest", "violated"), [
    (0.999, False), (-0.999, False), (1.0, True), (-1.0, True), (5.0, True),
    (np.nan, True), (np.inf, True), (-np.inf, True),
])  # fmt: skip
@pytest.mark.parametrize("at", [0, 7, 19])
def test_reaching_the_critical_level_at_any_sample_is_a_violation(largest, at, violated):
    assert is_violation(episode(largest, at), LEVELS) == violated
    assert bool(is_violation(jnp.asarray(episode(largest, at)), jnp.asarray(LEVELS))) == violated


def test_a_level_of_infinity_is_not_watched():
    assert not is_violation(episode(1e300, 3, output=1), LEVELS)


def test_a_value_that_is_not_a_number_counts_even_where_no_level_is_watched():
    assert is_violation(episode(np.nan, 3, output=1), LEVELS)
    assert bool(jax.jit(is_violation)(jnp.asarray(episode(np.nan, 3, output=1)), LEVELS))


def test_numpy_broadcasting_equals_jax_vmap():
    batch = np.random.default_rng(0).normal(size=(50, 20, 2))
    levels = np.array([2.0, 2.5])
    judged = is_violation(batch, levels)
    assert 0 < judged.sum() < 50
    mapped = jax.vmap(is_violation, in_axes=(0, None))(jnp.asarray(batch), jnp.asarray(levels))
    np.testing.assert_array_equal(mapped, judged)
    np.testing.assert_array_equal(max_abs_output(batch), np.abs(batch).max(axis=1))
    np.testing.assert_array_equal(
        jax.vmap(max_abs_output)(jnp.asarray(batch)), max_abs_output(batch)
    )


@pytest.mark.parametrize("name", PLANTS)
def test_levels_of_a_description_judge_both_kinds_of_array(name):
    definition = PLANTS[name].definition
    levels = critical_levels(definition)
    given = [o.critical_level for o in definition.outputs]
    assert list(levels) == [np.inf if level is None else level for level in given]
    outputs = np.zeros((3, len(given)))
    for judged in (is_violation(outputs, levels), is_violation(jnp.asarray(outputs), levels)):
        assert not judged
    outputs[1, watched_output(definition)] = 1.0001 * levels[watched_output(definition)]
    for judged in (is_violation(outputs, levels), is_violation(jnp.asarray(outputs), levels)):
        assert bool(judged) == bool(np.isfinite(levels).any())


def test_the_watched_output_is_the_first_with_a_critical_level():
    assert watched_output(DCMotor.definition) == 1
    assert watched_output(TwoMasses.definition) == 0


# ----------------------------------------------------------------------- the penalty


def equation_3(angle: float, warning: float, critical: float) -> float:
    """As the paper prints it."""
    if abs(angle) >= critical:
        return -1 - 2 * (abs(angle) - critical) / critical
    if abs(angle) >= warning:
        return -0.1 * ((abs(angle) - warning) / (critical - warning)) ** 2
    return 0.0


def angles_around(*levels: float) -> np.ndarray:
    """A grid that holds the levels themselves and their neighbours on both sides."""
    near = [np.nextafter(level, to) for level in levels for to in (0.0, np.inf)]
    positive = np.array([*np.linspace(0, 3 * max(levels), 100), *levels, *near])
    return np.concatenate([positive, -positive])


@pytest.mark.parametrize(("warning", "critical"), [
    (math.radians(30), math.radians(40)), (0.3, 0.4), (4.0, 5.0), (1e-3, 1e3),
])  # fmt: skip
def test_the_penalty_is_equation_3(warning, critical):
    angles = angles_around(warning, critical)
    expected = [equation_3(float(angle), warning, critical) for angle in angles]
    levels = np.array([warning]), np.array([critical])
    np.testing.assert_allclose(penalty(angles[:, None], *levels), expected, rtol=1e-12)
    of_jax = jax.jit(jax.vmap(lambda angle: penalty(angle, *levels)))(jnp.asarray(angles)[:, None])
    np.testing.assert_allclose(of_jax, expected, rtol=1e-12, atol=1e-15)
    # At the levels themselves: nothing at the first, one at the second.
    assert penalty(np.array([-warning]), *levels) == 0
    assert penalty(np.array([-critical]), *levels) == -1


def test_penalties_of_several_outputs_add_up():
    warning, critical = np.array([1.0, 0.2, 3.0]), np.array([2.0, 0.3, 3.5])
    outputs = np.random.default_rng(0).normal(size=(40, 7, 3)) * [2.0, 0.3, 3.0]
    expected = np.zeros((40, 7))
    for i, j, k in np.ndindex(outputs.shape):
        level = float(warning[k]), float(critical[k])
        expected[i, j] += equation_3(float(outputs[i, j, k]), *level)
    np.testing.assert_allclose(penalty(outputs, warning, critical), expected, rtol=1e-12)
    one = functools.partial(penalty, warning=warning, critical=critical)
    of_jax = jax.vmap(jax.vmap(one))(jnp.asarray(outputs))
    np.testing.assert_allclose(of_jax, expected, rtol=1e-12, atol=1e-15)


def with_outputs(*outputs: Output) -> PlantDescription:
    return dataclasses.replace(Aero2.definition, outputs=outputs)


def test_without_a_warning_level_the_penalty_begins_at_the_critical_one():
    watched, warning, critical = watched_levels(
        with_outputs(Output("y", "m", 1.0, 0, 0, None, 2.0))
    )
    assert (watched, list(warning), list(critical)) == ((0,), [2.0], [2.0])
    for angle in angles_around(2.0):
        expected = -1 - 2 * (abs(angle) - 2) / 2 if abs(angle) >= 2 else 0
        for array in (np.array([angle]), jnp.array([angle])):
            assert float(penalty(array, warning, critical)) == pytest.approx(expected, rel=1e-12)


def test_only_outputs_with_a_critical_level_are_watched():
    description = with_outputs(
        Output("a", "m", 1.0, warning_level=0.5),
        Output("b", "m", 1.0, warning_level=2.0, critical_level=3.0),
        Output("c", "m", 1.0),
        Output("d", "m", 1.0, critical_level=4.0),
    )
    watched, warning, critical = watched_levels(description)
    assert watched == (1, 3)
    np.testing.assert_array_equal(warning, [2.0, 4.0])
    np.testing.assert_array_equal(critical, [3.0, 4.0])


def test_where_no_output_is_watched_nothing_is_penalised():
    watched, warning, critical = watched_levels(with_outputs(Output("y", "m", 1.0)))
    assert watched == ()
    assert warning.shape == critical.shape == (0,)
    assert warning.dtype == critical.dtype == float
    for array in (np.zeros(0), jnp.zeros(0)):
        assert float(penalty(array, warning, critical)) == 0


@pytest.mark.parametrize("name", PLANTS)
def test_watched_levels_are_those_of_the_description(name):
    outputs = PLANTS[name].definition.outputs
    watched, warning, critical = watched_levels(PLANTS[name].definition)
    assert watched == tuple(i for i, o in enumerate(outputs) if o.critical_level)
    assert len(watched) > 0
    for i, low, high in zip(watched, warning, critical, strict=True):
        assert high == outputs[i].critical_level
        assert low == (outputs[i].warning_level or high)
