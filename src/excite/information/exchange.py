"""How often to make each of several experiments: the exchange algorithm.

Experiments are added one by one, then one is exchanged for another as long as this helps
(V. Fedorov, Theory of Optimal Experiments, 1972, chapter 3; A. Atkinson, A. Donev, R. Tobias,
Optimum Experimental Designs, with SAS, 2007, chapter 12). The end is a local optimum; the best
one from several beginnings counts.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

_LITTLE = 1e-9  # smallest gain of an exchange

Counts = Int[np.ndarray, " experiment"]


def exchanged(
    loss: Callable[[Counts], float],
    costs: Float[np.ndarray, " experiment"],
    most: Counts,
    rounds: int | None = None,
    budget: float | None = None,
) -> Counts:
    """How often to make each experiment, so that the loss is small.

        >>> exchanged(lambda n: 1 / (1 + n[0]) + 1 / (1 + n[1]), np.ones(2), np.full(2, 9), 4)
        array([2, 2])

    Args:
        loss: of the counts; no experiment makes it larger.
        costs: of each experiment.
        most: times that each experiment can be made; 0 for one that cannot.
        rounds: experiments together, at most.
        budget: costs together, at most.
    """

    def allowed(counts: Counts) -> bool:
        return bool(
            np.all((counts >= 0) & (counts <= most))
            and (rounds is None or counts.sum() <= rounds)
            and (budget is None or counts @ costs <= budget * (1 + 1e-12))
        )

    units = np.eye(len(costs), dtype=int)
    by = np.ones(len(costs)) if budget is None else costs  # a gain counts by what it costs

    def grown(counts: Counts) -> Counts:
        while True:
            before = loss(counts)
            gains = [
                (before - loss(counts + unit)) / cost if allowed(counts + unit) else -np.inf
                for unit, cost in zip(units, by, strict=True)
            ]
            if not max(gains) > _LITTLE:
                return counts
            counts = counts + units[int(np.argmax(gains))]

    def searched(counts: Counts) -> tuple[float, Counts]:
        counts = grown(counts)
        best = loss(counts)
        while True:
            swaps = [
                counts - units[i] + units[j]
                for i, j in itertools.permutations(range(len(costs)), 2)
                if allowed(counts - units[i] + units[j])
            ]
            losses = [loss(swap) for swap in swaps]
            if not losses or min(losses) >= best - _LITTLE:
                return best, counts
            counts = grown(swaps[int(np.argmin(losses))])
            best = loss(counts)

    nothing = np.zeros(len(costs), dtype=int)
    starts = [nothing, *(unit for unit in units if allowed(unit))]
    return min((searched(start) for start in starts), key=lambda found: found[0])[1]
