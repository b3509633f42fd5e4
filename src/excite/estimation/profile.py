"""Profile likelihood intervals of a least-squares estimate.

A parameter is held at a value and all others are estimated again; its interval holds the values
at which the sum of squares stays below a limit. Unlike an interval of standard errors it follows a
curved likelihood, and a side that never reaches the limit stays open: the data do not bound the
parameter there (A. Raue et al., "Structural and practical identifiability analysis of partially
observed dynamical models by exploiting the profile likelihood", Bioinformatics 25, 2009).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..description import Parameter, names_of
from ..information import relative_size
from ..plant import AbstractPlant, Params, Sensor, floats
from .contract import Estimate, Experiments, Status
from .diagnosis import inverse_information
from .nls import NLS

_STEPS, _CLOSE = 40, 1e-3  # most values of one side, and how near its end is found
_FACTOR, _SCALES = 1e4, 1e4  # from the estimate, as far as a positive or another one is tried
_GROWTH = 3.0  # of the distance from the estimate in one step


def profile_intervals(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: NLS,
    estimate: Estimate,
    free: Bool[np.ndarray, " param"],
    half: Float[np.ndarray, " param"],
    progress: Callable[[str, float, float], None] = lambda *_: None,
) -> tuple[Float[np.ndarray, "param end"], dict[str, Float[np.ndarray, "point 2"]]]:
    """Both ends of each free parameter's interval, and the profiles.

    An end is infinite where the interval stays open, NaN for a held parameter; a positive
    parameter whose interval stays open below begins at zero. A profile has the values that were
    tried, and the growth of the sum of squares over the limit.

    Args:
        half: of the intervals by standard errors. They set the limits, so that both kinds agree
            for a plant that is linear in its parameters.
        progress: called with a text, how many parameters are done, and their number.
    """
    if estimator.finds_noise:  # the weights of the estimate are kept
        sd = np.asarray(estimator.weights(plant, experiments, estimate))
        plant = plant.changed(sensor=Sensor(floats(sd), floats(0 * sd)))
        estimator = dataclasses.replace(estimator, noise="known")
    S, _ = map(
        np.asarray, estimator.sensitivity(plant, experiments, estimate, jax.device_put(free))
    )
    given = plant, estimate, S.shape[-1], jax.device_put(free)
    prior = np.asarray(estimator.prior_information(*given))
    unit = np.sqrt(np.diag(inverse_information(S, prior)))[: len(free)]
    size = np.abs(np.asarray(relative_size(plant, estimate.params)))
    whole = dataclasses.replace(estimator, segment_length=experiments.valid.shape[1])
    least = float(estimator.sum_of_squares(plant, experiments, estimate))
    ends = np.full((len(free), 2), np.nan)
    profiles: dict[str, Float[np.ndarray, "point 2"]] = {}

    def excess_of(
        index: int, limit: float, tried: list[tuple[float, float]]
    ) -> Callable[[float], float]:
        """Growth of the sum of squares, with the parameter at a value and the others best.

        The others are searched from the last value inside the interval: from one far outside a
        search may not find back. Where the sum is above the limit they are searched by one
        simulation, too: the segments of a noisy record may have led astray.
        """
        name = names_of(plant.definition.parameters)[index]
        others = jax.device_put(free & (np.arange(len(free)) != index))
        inside = {"params": estimate.params}

        def search(by: NLS, begin: Params) -> tuple[float, Params]:
            found = jax.device_get(by(plant, experiments, jax.device_put(begin), others))
            is_found = int(found.status) == Status.SUCCESSFUL
            return float(found.cost) - least if is_found else math.inf, found.params

        def excess(value: float) -> float:
            begin = inside["params"]._replace(**{name: floats(value)})
            growth, params = search(estimator, begin)
            if not growth <= limit:
                ends = (growth, params), search(whole, begin)
                growth, params = min(ends, key=lambda end: end[0])
            inside["params"] = params if growth <= limit else inside["params"]
            tried.append((value, growth))
            return growth

        return excess

    for index in np.flatnonzero(free):
        part, value = plant.definition.parameters[index], float(estimate.params[index])
        progress(f"profile of {part.name}", int(index), len(free))
        limit = (half[index] / (unit[index] * size[index])) ** 2
        tried = [(value, 0.0)]
        for side, sign in enumerate((-1, 1)):
            excess = excess_of(int(index), limit, tried)
            ends[index, side] = _end(part, value, sign, half[index], limit, excess)
        profiles[part.name] = np.array(sorted(tried)) / np.array([1.0, limit])
    return ends, profiles


def _end(
    part: Parameter,
    value: float,
    sign: int,
    half: float,
    limit: float,
    excess: Callable[[float], float],
) -> float:
    """Where the sum of squares has grown by the limit; open or at a bound where it never does."""
    bound, last = (part.lower, 0.0) if sign < 0 else (part.upper, math.inf)
    last = last if part.positive or sign > 0 else -math.inf

    def at(distance: float) -> float:
        return value * math.exp(sign * distance) if part.positive else value + sign * distance

    farthest = math.log(_FACTOR) if part.positive else _SCALES * max(part.scale, abs(value))
    if bound is not None:  # the search coordinates end there
        to_bound = abs(math.log(bound / value)) if part.positive else abs(bound - value)
        farthest, last = min(farthest, (1 - 1e-6) * to_bound), bound
    inside, outside = 0.0, math.inf
    distance = min(half / value if part.positive else half, farthest)
    for _ in range(_STEPS):
        # The root of the excess is nearly linear in the distance.
        grown = math.sqrt(max(excess(at(distance)), 0.0) / limit)
        if abs(grown - 1) < _CLOSE:
            return at(distance)
        if grown < 1 and distance >= farthest:
            return last
        inside, outside = (distance, outside) if grown < 1 else (inside, distance)
        hoped = distance / max(grown, 1 / _GROWTH)
        if not inside < hoped < outside:
            hoped = (inside + outside) / 2
        distance = min(hoped, farthest)
    return at(distance)
