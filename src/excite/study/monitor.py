"""A round of a campaign while it runs: whether it can end, because enough is known."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..environment.falsification import nearness
from ..estimation import NLS
from ..estimation.prior_knowledge import with_prior
from ..estimation.result import Identification
from ..plant import AbstractPlant, Params
from ..plant.contract import with_nominal
from ..rig.contract import Interval, Sample
from ..rig.live_estimate import LiveEstimate
from ..safety import safe_input
from ..simulation import response
from ..training.redesign import SAFE

_FIRST = 8  # samples before the first running estimate of a round


class Monitor:
    """Judges a round while it runs: whether it can end, because enough is known.

    Call it with every sample, in a loop of your own or as `on_sample` of `ex.run`.
    """

    def __init__(
        self,
        plant: AbstractPlant,
        before: Identification | None,
        shares: Callable[[Mapping[str, Interval]], Mapping[str, float]],
        num_steps: int,
        coast: int,
        waits: bool,
    ) -> None:
        """Compiles the estimator; this takes seconds.

        Args:
            plant: as identification knows it.
            before: estimate from all earlier rounds.
            shares: of what is known, half of each interval over that allowed.
            num_steps: of the round.
            coast: samples of free motion after its end that must be safe.
            waits: whether a call waits for its estimate; otherwise it is computed beside the
                experiment, and the judgement follows some samples later.
        """
        own, estimator = plant, NLS()
        if before is not None:
            _, prior, _ = with_prior(plant, before, plant.nominal, {}, {})
            estimator = dataclasses.replace(estimator, prior=prior)
            own = with_nominal(plant, dict(before.params))
        self._plant, self._shares = plant, shares
        self._live = LiveEstimate(own, num_steps, True, estimator, first=_FIRST, waits=waits)
        self._inputs = np.tile(safe_input(plant.definition), (num_steps + coast, 1))
        self._after(own.nominal)  # compiles, before the first sample

    def __call__(self, sample: Sample) -> bool:
        """Takes one more sample; whether every target is reached and ending now is safe."""
        self._live(sample)
        known = self._live.latest
        shares = self._shares(known)
        is_enough = bool(shares) and max(shares.values()) <= 1
        if is_enough:
            values = jnp.asarray([known[name].estimate for name in self._plant.nominal._fields])
            # As plain numbers they would be compiled into the program.
            is_enough = self._after(self._plant.Params(*values)) < SAFE
        self._inputs[sample.k] = sample.input
        return is_enough

    def _after(self, params: Params) -> float:
        """Largest output over its critical level if the round ended now."""
        return float(_free_motion(self._plant, params, jnp.asarray(self._inputs)))

    def close(self) -> None:
        """Waits for the running estimate."""
        self._live.close()


@eqx.filter_jit
def _free_motion(
    plant: AbstractPlant, params: Params, inputs: Float[Array, "time input"]
) -> Float[Array, ""]:
    """Largest output over its critical level under these inputs."""
    return nearness(plant, response(plant, params, inputs))
