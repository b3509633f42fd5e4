"""A round of a campaign while it runs: whether it can end, because enough is known."""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..description import Spread, SpreadLike, names_of, prior_sd_of
from ..environment.falsification import nearness
from ..estimation import NLS, Estimate
from ..estimation.prior_knowledge import PriorLike, with_prior
from ..information.identifiability import worst_seen
from ..plant import AbstractPlant, Params
from ..rig.contract import Interval, Sample
from ..rig.live_estimate import LiveEstimate
from ..safety import safe_input
from ..simulation import response
from ..training.redesign import JUDGES, SAFE, Region
from .quantities import estimates, propagated, slopes
from .targets import Target, others_of, shares_of

_FIRST = 8  # samples before the first running estimate of a round


class Monitor:
    """Judges a round while it runs: whether it can end, because enough is known.

    Call it with every sample, in a loop of your own or as `on_sample` of `ex.run`.

    Attributes:
        enough: largest share of the allowed intervals that ends the round.
    """

    def __init__(
        self,
        plant: AbstractPlant,
        before: PriorLike | Sequence[PriorLike] | None,
        targets: Sequence[Target],
        num_steps: int,
        coast: int,
        waits: bool,
        spread: SpreadLike,
        enough: float = 1.0,
        ends_at_once: bool = True,
    ) -> None:
        """Compiles the estimator; this takes seconds.

        Args:
            plant: as identification knows it.
            before: estimate from all earlier rounds, or what was known before the first one.
            targets: that end the round.
            num_steps: of the round.
            coast: samples of free motion after its end that must be safe.
            waits: whether a call waits for its estimate; otherwise it is computed beside the
                experiment, and the judgement follows some samples later.
            spread: of the parameters before the first round.
            enough: largest share of the allowed intervals that ends the round.
            ends_at_once: whether the input of the sample ends with the round; otherwise it is
                held until the next sample.
        """
        start, prior = plant.nominal, None
        if before is not None:
            _, prior, start = with_prior(plant, before, start, {}, {})
        self._plant, self._targets, self.enough = plant, targets, enough
        self._ends_at_once = ends_at_once
        self._others = others_of(plant, targets)
        self._is_later, self._num_outputs = before is not None, len(plant.definition.outputs)
        own = NLS(prior=prior)
        self._live = LiveEstimate(plant, num_steps, True, own, start, first=_FIRST, waits=waits)
        self._inputs = np.tile(safe_input(plant.definition), (num_steps + coast, 1))
        self._bounds, self._prior = _bounds(plant, spread), 1 / prior_sd_of(spread) ** 2
        self._after(start, np.zeros((len(start), len(start))))  # compiles, before the first sample
        if self._others:
            slopes(self._others, plant, start)

    def __call__(self, sample: Sample) -> bool:
        """Takes one more sample; whether every target is reached and ending now is safe."""
        self._live(sample)
        is_enough = False
        if not self._ends_at_once:
            self._inputs[sample.k] = sample.input
        if (estimate := self._live.estimate) is not None:
            known = self._known(estimate)
            is_enough = max(shares_of(self._targets, known).values()) <= self._enough(sample.k + 1)
            if is_enough:
                found = estimates(known, self._plant)
                is_enough = self._after(found, np.asarray(estimate.information)) < SAFE
        self._inputs[sample.k] = sample.input
        return is_enough

    def _enough(self, count: int) -> float:
        """Share of the allowed intervals that ends the round after so many samples.

        The size of the noise is that of this round's residual. With earlier records it may be
        larger, so that a later round leaves room for one standard error of it.
        """
        room = 1 / math.sqrt(2 * count * self._num_outputs) if self._is_later else 0.0
        return self.enough * (1 - room)

    def _known(self, estimate: Estimate) -> dict[str, Interval]:
        """What is known of every parameter and target.

        A parameter that the samples do not determine is not known, as `identify` says it.
        """
        known, names = dict(self._live.latest), names_of(self._plant.definition.parameters)
        information, free = np.asarray(estimate.information), np.ones(len(names), bool)
        while (unseen := worst_seen(names, information, free)) is not None:
            free[unseen[0]] = False
            name = names[unseen[0]]
            known[name] = known[name]._replace(ci95_half=np.inf)
        if self._others:
            halves = np.array([interval.ci95_half for interval in known.values()])
            params, covariance = estimates(known, self._plant), np.asarray(estimate.covariance)
            known |= propagated(self._others, self._plant, params, covariance, halves)
        return known

    def _after(self, params: Params, information: np.ndarray) -> float:
        """Largest output over its critical level on all possible plants if the round ended now."""
        whole = jnp.asarray(information + self._prior * np.eye(len(params)))
        region = Region(jnp.stack([jnp.asarray(value, float) for value in params]), whole)
        inputs = jnp.asarray(self._inputs)
        return float(_free_motion(self._plant, region, *self._bounds, inputs))

    def close(self) -> None:
        """Waits for the running estimate."""
        self._live.close()


def _bounds(
    plant: AbstractPlant, spread: SpreadLike
) -> tuple[Float[Array, " param"], Float[Array, " param"]]:
    """Lowest and highest value of each parameter."""
    given, usual = Spread.of(spread), zip(plant.definition.parameters, plant.nominal, strict=True)
    ends = [[given.value(p, float(nominal), unit) for unit in (-1.0, 1.0)] for p, nominal in usual]
    lower, upper = jnp.asarray(ends, float).T
    return lower, upper


@eqx.filter_jit
def _free_motion(
    plant: AbstractPlant,
    region: Region,
    lower: Float[Array, " param"],
    upper: Float[Array, " param"],
    inputs: Float[Array, "time input"],
) -> Float[Array, ""]:
    """Largest output over its critical level under these inputs, on the possible plants.

    These are within the bounds, or as far beyond them as the estimate is.
    """
    lower, upper = jnp.minimum(lower, region.center), jnp.maximum(upper, region.center)
    points = jnp.stack(list(region.plants(plant, JUDGES)), axis=1)
    points = jnp.clip(points, lower[None], upper[None])
    sizes = jax.vmap(lambda own: nearness(plant, response(plant, plant.Params(*own), inputs)))(
        points
    )
    return jnp.max(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))
