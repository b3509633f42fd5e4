"""Parts of long experiments, in which likely causes of a residual are looked for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..plant import AbstractPlant, Params
from ..simulation import acting, step
from .contract import AnyArray, Estimate, Experiments

_NUM_PARTS, _MOST_SAMPLES = 5, 5_000  # of one long experiment, and in all of them together


class Span(NamedTuple):
    """Samples of an experiment, from the first one to the one before `stop`."""

    experiment: int
    first: int
    stop: int


def spans_of(
    experiments: Experiments, residual: Float[np.ndarray, "experiment sample output"], values: int
) -> list[Span]:
    """Parts spread over all experiments, with at most so many values; where most is left.

    The experiments are cut into pieces of one length and these into as many groups as there are
    parts; of each group the piece with the largest residual is chosen.
    """
    valid = np.asarray(experiments.valid)
    num_samples, num_outputs = valid.shape[1:]
    most = max(min(values // num_outputs, _MOST_SAMPLES), 2 * _NUM_PARTS)
    length = min(num_samples, most // _NUM_PARTS)
    size = np.sqrt(np.mean(residual**2, axis=(0, 1)))
    power = np.sum((residual / np.where(size > 0, size, 1.0)) ** 2, axis=2)
    pieces = []
    for e in range(len(valid)):
        seen = valid[e].any(axis=1)
        stop = int(np.flatnonzero(seen)[-1]) + 1 if seen.any() else 0
        last = max(stop - length, 0)
        pieces += [Span(e, k, min(k + length, stop)) for k in range(0, last + 1, length) if stop]
    groups = np.array_split(np.arange(len(pieces)), min(most // length, len(pieces)))
    left = [float(power[p.experiment, p.first : p.stop].sum()) for p in pieces]
    return [pieces[max(group, key=left.__getitem__)] for group in groups]


class Excerpt(NamedTuple):
    """Parts as experiments of their own, whose initial states are unknown.

    Attributes:
        experiments: the parts; the search of their initial states starts at simulated ones.
        elapsed: time from the beginning of the experiment to that of the part [s].
    """

    experiments: Experiments
    elapsed: Float[np.ndarray, " experiment"]


def excerpt_of(
    plant: AbstractPlant, experiments: Experiments, estimate: Estimate, spans: Sequence[Span]
) -> Excerpt:
    """Parts of experiments; the estimate gives the states at their beginnings."""
    e, length = experiments, max(span.stop - span.first for span in spans)

    def cut(rows: AnyArray, num_rows: int) -> np.ndarray:
        rows = np.asarray(rows)
        parts = [rows[s.experiment, s.first : min(s.stop, s.first + num_rows)] for s in spans]
        return np.stack([np.resize(part, (num_rows, *part.shape[1:])) for part in parts])

    steps = np.full(e.inputs.shape[:2], float(plant.dt)) if e.dt is None else np.asarray(e.dt)
    given = jax.device_put((estimate.params, e, estimate.initial_state))
    states = np.asarray(_states(plant, *given))
    initial = np.stack([states[s.experiment, s.first] for s in spans])
    # The input of a part's last sample is cut off: with feedthrough that sample is left out.
    counts = np.array([[s.stop - s.first - int(plant.has_feedthrough)] for s in spans])
    is_part = np.arange(length)[None] < counts
    between = (None if rows is None else cut(rows, length - 1) for rows in (e.dt, e.next_inputs))
    dt, next_inputs = jax.device_put(tuple(between))
    inputs, measured, is_valid, start = jax.device_put(
        (
            cut(e.inputs, length - 1),
            cut(e.measured, length),
            cut(e.valid, length) & is_part[..., None],
            initial,
        )
    )
    parts = Experiments(inputs, measured, is_valid, start, False, dt, next_inputs)
    elapsed = np.array([steps[s.experiment, : s.first].sum() for s in spans])
    return Excerpt(parts, elapsed)


@eqx.filter_jit
def _states(
    plant: AbstractPlant,
    params: Params,
    experiments: Experiments,
    initial_state: Float[Array, "experiment state"],
) -> Float[Array, "experiment sample state"]:
    """Simulated states at all samples."""
    e = experiments

    def simulated(
        inputs: Array, start: Array, dt: Array | None, next_inputs: Array | None
    ) -> Array:
        def advance(state: Array, now: tuple) -> tuple[Array, Array]:
            input, dt, next_input = now
            after = step(plant, state, input, params, dt, next_input)
            return after, after

        steps = acting(plant, params, inputs, dt, next_inputs)
        _, states = jax.lax.scan(advance, start, steps)
        return jnp.concatenate([start[None], states])

    return jax.vmap(simulated)(e.inputs, initial_state, e.dt, e.next_inputs)
