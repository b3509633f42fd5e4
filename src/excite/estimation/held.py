"""Parameters that are held because the data do not tell them: why, and what this costs."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool

from ..description import Parameter, listed
from ..information.identifiability import STRUCTURALLY_NOT, Structure, structure
from ..plant import AbstractPlant, Params
from .contract import AbstractEstimator, AnyArray, Estimate, Experiments, bound_reached
from .diagnosis import inverse_information
from .nls import NLS

_CHANGE = 0.1  # relative change of a held parameter of which the effect is told
_LEAST = 0.005  # relative change of another parameter that is told


def structure_of(
    plant: AbstractPlant,
    experiments: Experiments,
    params: Params,
    known: Bool[np.ndarray, " param"],
) -> Structure | None:
    """The structural test near some parameters, for random inputs and those of the experiments."""
    return structure(
        plant,
        params,
        initial_state_known=experiments.initial_state_known,
        inputs=np.asarray(experiments.inputs),
        known=known,
    )


def told_of_held(
    plant: AbstractPlant,
    experiments: Experiments,
    estimator: AbstractEstimator,
    estimate: Estimate,
    free: Bool[np.ndarray, " param"],
    known: Bool[np.ndarray, " param"],
    names: Sequence[str],
) -> tuple[str, ...]:
    """A sentence on each parameter of `names` that is not held at a bound, in their order.

    Whether it is structurally not identifiable or practically not, with those before it known,
    and how the other estimates move if its value is wrong: by the implicit function theorem,
    d theta = -(S' S)^-1 S' s for sensitivities S of what was estimated and s of the parameter.
    """
    parameters, params = plant.definition.parameters, estimate.params
    held = [params._fields.index(name) for name in names]
    at_bound = [
        bound_reached(plant.definition, _with(plant.nominal, i, params[i])) is not None
        for i in held
    ]
    if all(at_bound):
        return ()
    given = jax.device_put((plant, experiments, estimate))
    own = estimator if isinstance(estimator, NLS) else NLS()
    S = np.asarray(own.sensitivity(*given)[0])
    P = np.asarray(own.prior_information(plant, estimate, S.shape[-1]))
    estimated = np.append(free, np.ones(S.shape[-1] - len(free), bool))
    rows = np.einsum("etou,etoh->uh", S[..., estimated], S[..., held]) + P[estimated][:, held]
    inverse = inverse_information(S[..., estimated], P[np.ix_(estimated, estimated)])
    effects = -(inverse @ rows)[: free.sum()]
    others = [p for p, is_free in zip(parameters, free, strict=True) if is_free]
    told = []
    for i, is_at_bound, effect in zip(held, at_bound, effects.T, strict=True):
        if not is_at_bound:
            why = _why(parameters[i].name, structure_of(plant, experiments, params, known))
            told.append(f"{why}; {_cost(parameters[i], others, effect)}")
        known = known | (np.arange(len(known)) == i)
    return tuple(told)


def _with(params: Params, index: int, value: AnyArray) -> Params:
    return params._replace(**{params._fields[index]: value})


def _why(name: str, found: Structure | None) -> str:
    """Whether it is the plant or the data that do not tell a parameter."""
    if found is None:
        return f"{name} is practically not identifiable with these data"
    group = found.of(name)
    if group is not None:
        return f"{name} is {STRUCTURALLY_NOT}: {group.sentence}"
    return f"{name} is structurally identifiable, but practically not with these data"


def _cost(held: Parameter, others: list[Parameter], effects: np.ndarray) -> str:
    """How other estimates move with the held value."""
    moves = [
        f"{p.name} {_amount(p, abs(_CHANGE * effect))} {'larger' if effect > 0 else 'smaller'}"
        for p, effect in zip(others, effects, strict=True)
        if abs(_CHANGE * effect) >= _LEAST
    ]
    does = f"makes {listed(moves)}" if moves else "changes the other parameters by less than 0.5 %"
    return f"{_amount(held, _CHANGE)} more of it {does}"


def _amount(p: Parameter, relative: float) -> str:
    """A relative change in percent, of a parameter of free sign in its unit."""
    if p.positive:
        return f"{100 * relative:.2g} %"
    return f"{relative * p.scale:.2g} {p.unit}".rstrip()
