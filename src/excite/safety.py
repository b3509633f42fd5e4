"""Warning and critical level of an output, as pure functions over arrays.

The functions use only what NumPy and JAX arrays share, so that a batch of thousands of
simulated episodes and a loop in real time are judged by the same lines. A level of
infinity is a level not watched. Axis 0 of one episode is time, axis 1 output; JAX maps
over episodes with `vmap`, NumPy by broadcasting.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from .description import PlantDescription

AnyArray: TypeAlias = Any
"""A NumPy or a JAX array."""


def critical_levels(description: PlantDescription) -> Float[np.ndarray, " output"]:
    """Critical level of each output's magnitude, in its unit; infinity for none."""
    levels = [
        math.inf if o.critical_level is None else o.critical_level for o in description.outputs
    ]
    return np.array(levels)


def watched_output(description: PlantDescription) -> int:
    """Index of the first output with a critical level, else of the first output."""
    levels = critical_levels(description)
    return next((i for i, level in enumerate(levels) if level < math.inf), 0)


def watched_levels(
    description: PlantDescription,
) -> tuple[tuple[int, ...], Float[np.ndarray, " watched"], Float[np.ndarray, " watched"]]:
    """Indices of the outputs with a critical level, their warning and critical levels.

    Where an output has no warning level, the critical one takes its place.
    """
    parts = [(i, o) for i, o in enumerate(description.outputs) if o.critical_level is not None]
    critical = np.array([o.critical_level for _, o in parts], float)
    warning = [o.warning_level for _, o in parts]
    warning = np.array([c if w is None else w for w, c in zip(warning, critical, strict=True)])
    return tuple(i for i, _ in parts), warning.astype(float), critical


def penalty(outputs: AnyArray, warning: AnyArray, critical: AnyArray) -> AnyArray:
    """Stepwise safety penalty, at most zero: Eq. 3 of Langschwert et al., summed over outputs.

    Args:
        outputs: true outputs that have a critical level, the last axis.
        warning, critical: their levels.
    """
    magnitude = abs(outputs)
    is_over = magnitude >= critical
    is_near = (magnitude >= warning) & ~is_over
    over = 1 + 2 * (magnitude - critical) / critical
    near = 0.1 * ((magnitude - warning) / (critical - warning + (critical == warning))) ** 2
    return -(is_over * over + is_near * near).sum(axis=-1)


def max_abs_output(outputs: AnyArray) -> AnyArray:
    """Largest magnitude of each output over time."""
    return abs(outputs).max(axis=-2)


def is_violation(outputs: AnyArray, levels: AnyArray) -> AnyArray:
    """Whether an episode reaches the critical level of any output at any sample.

    Args:
        outputs: true (noise-free) outputs, time and output the last two axes.
        levels: critical level of each output.

    A value that is not a number counts: a run that cannot be computed is not a safe run.
    """
    return ~(max_abs_output(outputs) < levels).all(axis=-1)
