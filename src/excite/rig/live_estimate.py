"""The estimate while an experiment runs: least squares on all samples so far, again and again.

A fit takes a part of a second, so it runs in a thread beside the loop, on the samples there
were when it began; the next begins when it is done. It is the estimator that `identify`
uses, not a recursive approximation of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from ..description import HALF_95, names_of
from ..estimation import NLS, Estimate, Experiments, Status
from ..plant import AbstractPlant
from .contract import Sample

_FIRST = 40  # samples before the first fit, the shortest horizon of the estimator


class Tracker:
    """Estimates of one experiment under way."""

    def __init__(self, plant: AbstractPlant, num_steps: int, starts_at_rest: bool) -> None:
        """Compiles the estimator, which takes seconds, before the experiment begins.

        Args:
            starts_at_rest: whether the initial state is the plant's, or to be estimated.
        """
        self._plant, self._starts_at_rest, self._count = plant, starts_at_rest, 0
        self._inputs = np.zeros((num_steps, len(plant.definition.inputs)))
        self._measured = np.zeros((num_steps + 1, len(plant.definition.outputs)))
        self._pool, self._fit = ThreadPoolExecutor(1), Future[Estimate]()
        self._fit.set_result(self._estimate(0))
        self._latest: dict[str, tuple[float, float]] = {}

    def __call__(self, sample: Sample) -> None:
        """One more sample."""
        self._inputs[sample.k], self._measured[sample.k] = sample.input, sample.measured
        self._count = sample.k + 1
        if self._fit.done():
            self._keep(self._fit.result())
            if self._count >= _FIRST:
                self._fit = self._pool.submit(self._estimate, self._count)

    @property
    def latest(self) -> Mapping[str, tuple[float, float]]:
        """Estimate and half of its 95 % interval by parameter; empty before there is one."""
        return self._latest

    def close(self) -> None:
        """Waits for the fit under way; the last estimate is that from all samples."""
        self._pool.shutdown()
        self._keep(self._fit.result())
        if self._count >= _FIRST:
            self._keep(self._estimate(self._count))

    def _keep(self, estimate: Estimate) -> None:
        if int(estimate.status) == Status.SUCCESSFUL:
            half = HALF_95 * np.sqrt(np.diag(np.asarray(estimate.covariance)))
            names = names_of(self._plant.definition.parameters)
            values = zip(map(float, estimate.params), map(float, half), strict=True)
            self._latest = dict(zip(names, values, strict=True))

    def _estimate(self, count: int) -> Estimate:
        """The estimate from the first `count` samples."""
        seen = np.arange(len(self._measured)) < count
        experiments = Experiments(
            inputs=jnp.asarray(self._inputs)[None],
            measured=jnp.asarray(self._measured)[None],
            valid=jnp.asarray(seen)[None],
            initial_state=self._plant.initial_state[None],
            initial_state_known=self._starts_at_rest,
        )
        # Otherwise whoever looks at it waits for it, and that is the loop.
        return jax.block_until_ready(NLS()(self._plant, experiments))
