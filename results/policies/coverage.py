"""Coverage of the 95 % intervals for `aero2_detailed` where the rig's constants are not exact.

Rotor lag, dead zone, asymmetry and curvature of every plant differ from the values that the
estimator takes as known, with a standard deviation of 2 %. The intervals are computed with
these values as exact, and as `excite identify --uncertain tau=2%,dead_zone=2%,...` does.

    python results/policies/coverage.py
"""

from __future__ import annotations

import math
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from excite.description import HALF_95
from excite.environment import run_episodes
from excite.estimation import NLS, Estimate, stack_experiments
from excite.estimation.diagnosis import effect_of_constants
from excite.excitation.catalogue import excitation_named
from excite.plant import AbstractPlant
from excite.plant.catalogue import plant_named
from excite.plant.uncertainty import Uncertainty

NAME = "aero2_detailed"
SD, COUNT, CHUNK = 0.02, 500, 50
UNKNOWN = ("tau", "dead_zone", "asymmetry", "curvature")


@eqx.filter_jit
def estimate(plant: AbstractPlant, inputs: jax.Array, measured: jax.Array) -> Estimate:
    """The estimate from one experiment, its constants taken as exact."""
    return NLS()(plant, stack_experiments(plant, [inputs], [measured], True))


def main() -> None:
    """Prints the coverage and the mean standard error, by parameter, both ways."""
    plant = plant_named(NAME)
    half = 100 * SD * math.sqrt(3)  # of a uniform distribution with this standard deviation
    box = Uncertainty.of(plant, 0.3, dict.fromkeys(UNKNOWN, f"{half:.6g}%"))
    values = plant.constants._asdict()
    sd = np.array([SD * abs(float(v)) * (name in UNKNOWN) for name, v in values.items()])
    count, free = len(plant.definition.parameters), jnp.ones(len(plant.nominal), bool)
    keys, policy = jax.random.split(jax.random.key(7), COUNT), excitation_named(NAME, {}, plant)
    errors, exact, uncertain = [], [], []
    for first in range(0, COUNT, CHUNK):
        episodes = run_episodes(plant, policy, 500, 0.3, keys[first : first + CHUNK], box)
        true = np.stack(episodes.params, axis=1)
        for i, own in enumerate(true):
            run = episodes.trajectory
            found = estimate(plant, run.inputs[i], run.measured[i])
            if int(found.status):
                continue
            data = stack_experiments(plant, [run.inputs[i]], [run.measured[i]], True)
            slopes = np.asarray(NLS().sensitivity(plant, data, found, free)[0])
            more = np.asarray(NLS().constant_sensitivity(plant, data, found))
            params = np.array([float(value) for value in found.params])
            effect = effect_of_constants(slopes, more)[:count] * sd[None] * params[:, None]
            variance = np.diag(np.asarray(found.covariance))
            errors.append(np.abs(params / own - 1))
            exact.append(np.sqrt(variance) / own)
            uncertain.append(np.sqrt(variance + np.sum(effect**2, axis=1)) / own)
    lines = [f"{len(errors)} of {COUNT} estimates successful"]
    for title, errs in (("exact", exact), ("uncertain", uncertain)):
        inside = np.mean(np.array(errors) < HALF_95 * np.array(errs), axis=0)
        for name, share, error in zip(plant.nominal._fields, inside, np.mean(errs, 0), strict=True):
            lines.append(f"{title}: {name} {100 * share:.1f} %, standard error {100 * error:.3f} %")
    sys.stdout.write("\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
