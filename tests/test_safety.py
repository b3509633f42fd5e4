"""Warning and critical level: one judgement for NumPy and JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import PLANTS, TwoMasses

from excite.plant import DCMotor
from excite.safety import critical_levels, is_violation, max_abs_output, watched_output

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
