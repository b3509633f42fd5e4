"""Parameter estimates while an experiment runs: least squares on all samples so far.

A fit takes a fraction of a second. It runs in a thread beside the loop, on the samples
available when it starts; the next one starts when it is done. The estimator is the one that
`identify` uses, not a recursive approximation.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from ..description import names_of
from ..estimation import NLS, Estimate, Experiments, Status
from ..estimation.diagnosis import half_95
from ..plant import AbstractPlant, Params
from .contract import Interval, Sample

_FIRST = 40  # samples before the first estimate


class LiveEstimate:
    """Estimates during one experiment."""

    def __init__(
        self,
        plant: AbstractPlant,
        num_steps: int,
        starts_at_rest: bool,
        estimator: NLS | None = None,
        start: Params | None = None,
        first: int = _FIRST,
        waits: bool = False,
    ) -> None:
        """Compiles the estimator before the experiment; this takes seconds.

        Args:
            plant: whose parameters are estimated.
            num_steps: length of the experiment.
            starts_at_rest: whether the initial state is the plant's; otherwise it is
                estimated too.
            estimator: default nonlinear least squares without a prior.
            start: parameters where every search begins, default the nominal ones.
            first: samples before the first estimate.
            waits: whether a call waits for the estimate from its sample.
        """
        self._estimator, self._first, self._waits = estimator or NLS(), first, waits
        self._plant, self._start = plant, plant.nominal if start is None else start
        self._starts_at_rest, self._count = starts_at_rest, 0
        self._inputs = np.zeros((num_steps, len(plant.definition.inputs)))
        self._measured = np.zeros((num_steps + 1, len(plant.definition.outputs)))
        self._pool, self._fit = ThreadPoolExecutor(1), Future[Estimate]()
        self._fit.set_result(self._estimate(0))
        self._latest: dict[str, Interval] = {}
        self._kept: Estimate | None = None

    def __call__(self, sample: Sample) -> None:
        """Takes one more sample, and starts the next fit if none is running."""
        self._inputs[sample.k], self._measured[sample.k] = sample.input, sample.measured
        self._count = sample.k + 1
        if self._waits:
            if self._count >= self._first:
                self._keep(self._estimate(self._count))
        elif self._fit.done():
            self._keep(self._fit.result())
            if self._count >= self._first:
                self._fit = self._pool.submit(self._estimate, self._count)

    @property
    def latest(self) -> Mapping[str, Interval]:
        """Estimate and 95 % interval by parameter; empty before the first fit."""
        return self._latest

    @property
    def estimate(self) -> Estimate | None:
        """The latest successful fit; None before the first."""
        return self._kept

    def close(self) -> None:
        """Waits for the running fit, then estimates from all samples."""
        self._pool.shutdown()
        self._keep(self._fit.result())
        if self._count >= self._first:
            self._keep(self._estimate(self._count))

    def _keep(self, estimate: Estimate) -> None:
        if int(estimate.status) == Status.SUCCESSFUL:
            covariance, degrees = map(np.asarray, (estimate.covariance, estimate.degrees))
            half = half_95(covariance, degrees)
            self._kept = estimate
            names = names_of(self._plant.definition.parameters)
            values = zip(map(float, estimate.params), map(float, half), strict=True)
            self._latest = {n: Interval(*v) for n, v in zip(names, values, strict=True)}

    def _estimate(self, count: int) -> Estimate:
        """The estimate from the first `count` samples."""
        seen = np.arange(len(self._measured)) < count
        experiments = Experiments(
            inputs=jnp.asarray(self._inputs)[None],
            measured=jnp.asarray(self._measured)[None],
            valid=jnp.broadcast_to(seen[None, :, None], (1, *self._measured.shape)),
            initial_state=self._plant.initial_state[None],
            initial_state_known=self._starts_at_rest,
        )
        # Otherwise the loop would wait for the result when it reads it.
        return jax.block_until_ready(self._estimator(self._plant, experiments, self._start))
