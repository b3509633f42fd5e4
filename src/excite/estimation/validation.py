"""What the plant makes of records: those that were fitted, and held-out ones."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..description import HALF_95, PlantDescription, names_of
from ..plant import AbstractPlant, Params
from ..record import Record
from .contract import (
    AbstractEstimator,
    Estimate,
    Experiments,
    Prediction,
    of_transitions,
    residual_of,
    simulate_experiments,
    transitions,
)
from .diagnosis import fit_percent
from .fit import with_initial_state
from .from_records import by_record, experiments_of, parts_of, starts_at
from .nls import Problem
from .pem import PEM
from .result import Fitted, Predicted

_SHARE = 0.1  # of a held-out record, from which its initial state is estimated


def fitted_all(
    plant: AbstractPlant,
    records: Sequence[Record],
    experiments: Experiments,
    params: Params,
    residual: list[np.ndarray],
    prediction: Prediction | None,
) -> tuple[Fitted, ...]:
    """The records with what the plant makes of them."""
    predicted = _predicted(plant, records, prediction)
    if prediction is not None:
        residual = by_record(records, _simulation_error(plant, experiments, params))
    parts = zip(records, residual, predicted, strict=True)
    return tuple(_fitted(plant.definition, *part) for part in parts)


def predicted_in_steps(
    plant: AbstractPlant,
    whole: Experiments,
    steps: Experiments,
    params: Params,
    process_noise: Float[np.ndarray, " state"] | None = None,
) -> tuple[Float[np.ndarray, "experiment sample output"], Prediction]:
    """The residual of whole experiments, and their one-step prediction.

    Both are NaN where no step from a measured state leads.

    Args:
        plant: whose sensor has the noise of the process.
        whole: the experiments.
        steps: their `transitions`.
        params: estimated from these, or from other experiments.
        process_noise: diffusion of each state; default that of the residual.
    """
    own = jax.device_put(params)
    simulated = simulate_experiments(plant, own, steps, steps.initial_state)
    residual = residual_of(steps, simulated)
    if process_noise is None:
        sd = Problem(plant, steps, own, None).noise_sd(residual)
    else:
        sd = jnp.asarray(process_noise) * jnp.sqrt(plant.dt)
    error = of_transitions(whole, jnp.where(steps.valid, residual, jnp.nan))
    prediction = Prediction(
        outputs=whole.measured - error,
        sd=jnp.broadcast_to(sd, error.shape),
        process_noise=sd / jnp.sqrt(plant.dt),
        noise_sd=jnp.zeros_like(sd),
    )
    return jax.device_get((error, prediction))


def _fitted(
    description: PlantDescription,
    record: Record,
    residual: np.ndarray,
    predicted: Predicted | None = None,
) -> Fitted:
    """A record with its simulation, of which the residual is given."""
    simulated = record.outputs - residual
    return Fitted(record, simulated, _fits(description, record, simulated), predicted)


def _fits(description: PlantDescription, record: Record, outputs: np.ndarray) -> dict[str, float]:
    """Fit of each output in percent."""
    return {
        name: fit_percent(record.outputs[:, i], outputs[:, i])
        for i, name in enumerate(names_of(description.outputs))
    }


def _simulation_error(
    plant: AbstractPlant, experiments: Experiments, params: Params
) -> Float[np.ndarray, "experiment sample output"]:
    """Measured minus simulated outputs, from the initial states that fit best unless known."""
    if not experiments.initial_state_known:
        return np.asarray(with_initial_state(plant, experiments, params).residual)
    begin, given = jax.device_put((experiments.initial_state, params))
    return np.asarray(
        residual_of(experiments, simulate_experiments(plant, given, experiments, begin))
    )


def _predicted(
    plant: AbstractPlant, records: Sequence[Record], prediction: Prediction | None
) -> list[Predicted | None]:
    """The one-step predictions of each record, of estimators that have one."""
    if prediction is None:
        return [None] * len(records)
    outputs = by_record(records, np.asarray(prediction.outputs))
    sds = by_record(records, np.asarray(prediction.sd))
    return [
        Predicted(
            values,
            sd,
            _fits(plant.definition, _where_predicted(record, values), values),
            dict(zip(names_of(plant.definition.outputs), _inside(record, values, sd), strict=True)),
        )
        for record, values, sd in zip(records, outputs, sds, strict=True)
    ]


def _where_predicted(record: Record, predicted: np.ndarray) -> Record:
    """The record without the samples that have no prediction."""
    seen = np.where(np.isnan(predicted), np.nan, record.outputs)
    return dataclasses.replace(record, outputs=seen)


def _inside(record: Record, predicted: np.ndarray, sd: np.ndarray) -> list[float]:
    """Share of the measured values of each output inside the 95 % band [%]."""
    error = np.abs(record.outputs - predicted)
    return [
        100 * float(np.mean(e[s] <= HALF_95 * w[s]))
        for e, w in zip(error.T, sd.T, strict=True)
        for s in [np.isfinite(e)]
    ]


def state_from(record: Record, plant: AbstractPlant, way: str | float) -> float | None:
    """Share of a held-out record that gives its initial state, 0 its first sample; None: known.

    `way`: see `way_to_state`.
    """
    where, parts = record.source or "the record", parts_of(record)
    if way == "known" and len(parts) > 1:
        raise ValueError(f"{where} has gaps in time; the state after a gap is not known")
    if way == "known" or (way == "auto" and len(parts) == 1 and starts_at(record, plant)):
        return None
    is_measured = all(np.isfinite(record.outputs[part.start]).all() for part in parts)
    if way in ("first", "auto") and is_measured and _outputs_give_state(plant):
        return 0.0
    if way == "first":
        raise ValueError(
            f"the first outputs of {where} do not determine the state of plant "
            f"{plant.definition.name!r}; give the share of the record from which it is estimated, "
            "such as 10%"
        )
    return way if isinstance(way, float) else 1.0


def way_to_state(word: str | float) -> str | float:
    """How the initial state is found: a word, or a share given as a number or in percent."""
    if word in ("auto", "known", "first"):
        return word
    try:
        is_part = isinstance(word, str) and word.endswith("%")
        share = float(str(word).removesuffix("%")) * (0.01 if is_part else 1.0)
    except ValueError:
        share = math.nan
    if not 0 < share <= 1:
        raise ValueError(
            f"validate_state must be auto, known, first or a share such as 10%: got {word!r}"
        )
    return share


def _outputs_give_state(plant: AbstractPlant) -> bool:
    """Whether the outputs at one time determine the state, at the initial state."""
    scales = np.array([s.scale for s in plant.definition.states])
    slope = np.asarray(_slope(plant)) * scales
    slope = slope / np.array([o.scale for o in plant.definition.outputs])[:, None]
    return bool(np.linalg.matrix_rank(slope, 1e-6) == len(scales))


@eqx.filter_jit
def _slope(plant: AbstractPlant) -> Float[Array, "output state"]:
    """Derivative of the outputs with respect to the states, at the initial state."""
    rest = plant.feedthrough_input(jnp.zeros(len(plant.definition.inputs)))
    return jax.jacfwd(plant.output)(plant.initial_state, *rest, plant.nominal)


def validated(
    plant: AbstractPlant,
    record: Record,
    linear: np.ndarray,
    estimator: AbstractEstimator,
    estimate: Estimate,
    fitted: Prediction | None,
    share: float | None,
) -> Fitted:
    """A held-out record with its simulation and prediction.

    Args:
        fitted: prediction of the records of the estimation, whose noise this one has.
        share: see `state_from`.
    """
    experiments, prediction = experiments_of(plant, [record], False, linear), None
    if isinstance(estimator, PEM) and fitted is not None:
        own = jax.device_put((estimate.params, fitted))
        prediction = jax.device_get(estimator.predict(plant, experiments, *own))
    elif fitted is not None:
        seen, steps = transitions(plant, experiments)
        own = estimate.params, np.asarray(fitted.process_noise)
        prediction = predicted_in_steps(seen, experiments, steps, *own)[1]
    residual, fits = _begun(plant, record, experiments, estimator, estimate, share)
    if fits is None:
        raise ValueError(
            f"{record.source or 'the record'}: with {100 * (share or 0.0):.4g} % for the initial "
            "state too little is left to compare; give a smaller share"
        )
    words = _in_words(share)
    if share == 1:
        _, rest = _begun(plant, record, experiments, estimator, estimate, _SHARE)
        if rest is not None:
            percent = " and ".join(f"{fit:.4g} %" for fit in rest.values())
            words += f" (from its first {100 * _SHARE:.0f} %, the rest fits {percent})"
    found = _fitted(plant.definition, record, residual, *_predicted(plant, [record], prediction))
    return dataclasses.replace(found, fit_percent=fits, initial_state=words)


def _begun(
    plant: AbstractPlant,
    record: Record,
    experiments: Experiments,
    estimator: AbstractEstimator,
    estimate: Estimate,
    share: float | None,
) -> tuple[Float[np.ndarray, "sample output"], dict[str, float] | None]:
    """The residual of a held-out record, and its fits; None where too little is left to compare."""
    begun, used = experiments, np.zeros(experiments.valid.shape, bool)
    if share is not None:
        valid = np.asarray(experiments.valid)
        counts = valid.any(2).cumsum(1)
        used = valid & (counts <= np.ceil(counts[:, -1:] * share).clip(1))[..., None]
        begun = dataclasses.replace(experiments, valid=jax.device_put(used))
        initial = with_initial_state(plant, begun, estimate.params, estimator).initial_state
        begun = dataclasses.replace(experiments, initial_state=jax.device_put(initial))
    begun = dataclasses.replace(begun, initial_state_known=True)
    (residual,) = by_record([record], _simulation_error(plant, begun, estimate.params))
    (spent,) = by_record([record], used.astype(float))
    left = record.outputs if share == 1 else np.where(spent == 0, record.outputs, np.nan)
    if share != 1 and np.any(np.isfinite(left).sum(axis=0) < 2):
        return residual, None
    scored = dataclasses.replace(record, outputs=left)
    return residual, _fits(plant.definition, scored, record.outputs - residual)


def _in_words(share: float | None) -> str:
    """Where the initial state of a held-out record comes from."""
    if share is None:
        return "known initial state"
    if share == 0:
        return "initial state from the first measurements"
    if share == 1:
        return "initial state estimated from the whole record"
    return f"initial state estimated from the first {100 * share:.3g} %, which do not count"
