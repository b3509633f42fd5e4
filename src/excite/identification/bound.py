"""How well an experiment can determine each parameter, before it is run."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Float

from ..description import names_of
from ..estimation.diagnosis import identifiability, worst_seen
from ..information import (
    a_optimality,
    cramer_rao_bound,
    d_optimality,
    e_optimality,
    experiment_information,
    relative_size,
)
from ..plant import AbstractPlant, Params


def best_possible(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[Array, "time input"],
    *,
    initial_state_known: bool,
) -> dict[str, Any]:
    """Least standard deviation of each parameter for an input, as JSON-ready data.

    Raises:
        ValueError: for a sensor without noise, which sets no bound, and for a response
            that is not finite.
    """
    if not np.all(np.asarray(plant.sensor.sd) > 0):
        raise ValueError("a sensor without noise sets no bound; give every output a noise")
    information = experiment_information(
        plant, params, inputs, initial_state_known=initial_state_known
    )
    values = np.linalg.eigvalsh(np.nan_to_num(np.asarray(information)))
    if not np.all(np.isfinite(information)) or values[0] < -1e-6 * values[-1]:
        raise ValueError(
            "the response to this input is not finite, or chaotic: it has no information that "
            "could be trusted; a smaller amplitude or other parameters may help"
        )
    size = np.asarray(relative_size(plant, params))
    sd = np.asarray(cramer_rao_bound(information)) * size
    return {
        "plant": plant.definition.name,
        "initial_state": "known" if initial_state_known else "free",
        "params": {
            p.name: {
                "value": float(value),
                "cramer_rao_bound": float(s) if np.isfinite(s) else None,
                "cramer_rao_percent": float(100 * s / abs(value))
                if np.isfinite(s) and value
                else None,
                "unit": p.unit,
            }
            for p, value, s in zip(plant.definition.parameters, params, sd, strict=True)
        },
        "log_det_information": float(d_optimality(information)),
        "a_optimality": float(a_optimality(information)),
        "e_optimality": float(e_optimality(information)),
        "information": np.asarray(information),
        "verdict": _verdict(names_of(plant.definition.parameters), np.asarray(information)),
    }


def _verdict(names: tuple[str, ...], information: np.ndarray) -> list[str]:
    """What cannot be seen, one sentence each, and how well the rest is."""
    free, sentences = np.ones(len(names), bool), []
    while (unseen := worst_seen(names, information, free)) is not None:
        free[unseen[0]] = False
        sentences.append(unseen[1])
    if free.any():
        block = np.where(np.outer(free, free), information, np.eye(len(names)))
        sentences.append(identifiability(names, np.linalg.inv(block), free))
    return sentences
