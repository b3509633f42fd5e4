"""Identifiability of parameters: structural, of a plant, and practical, of an experiment.

A parameter is structurally identifiable (locally) if no other value near its own gives the same
outputs for every input. It is a property of equations, inputs, outputs and known initial states.
It is tested by the rank of the sensitivities of the outputs at random parameter values, for
inputs of random levels: a direction of the parameters in which the sensitivities vanish at every
value cannot be determined by any experiment (J. Stigter, J. Molenaar, "A fast algorithm to assess
local structural identifiability", Automatica 58, 2015; A. Raue et al., Bioinformatics 25, 2009).
What is left is practically identifiable if the experiment tells it from the noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..description import Parameter, listed, names_of
from ..plant import AbstractPlant, Params, require_double_precision
from ..simulation import response

UNSEEN_SD = 0.5
"""A direction of relative changes with a larger standard deviation is not identifiable: its
95 % interval reaches from zero to twice the value."""

UNDETERMINED = 1e-10
"""Singular values of the scaled sensitivities below this part of the largest count as zero."""

_HOLDS = 1, 2, 5, 10, 20  # samples for which the levels of each random input are held
_NUM_DRAWS, NUM_STEPS = len(_HOLDS), 500
_NO_EFFECT = 1e-12  # sensitivity relative to the outputs that is nothing but rounding
_INVOLVED = 1e-6  # component of a direction that is not rounding
_ALIKE = 0.9  # part of the largest component, or certainty, that counts as much

IDENTIFIABLE, PRACTICALLY_NOT, STRUCTURALLY_NOT = (
    "identifiable",
    "practically not identifiable with this excitation",
    "structurally not identifiable",
)


@dataclass(frozen=True)
class Inseparable:
    """Unknowns that no experiment tells apart, or one that acts on no output.

    Attributes:
        parameters, initial_states: their names.
        num_combinations: of them that the outputs do determine.
        held: parameters whose values, once known, make the others identifiable.
        sentence: the same in words.
    """

    parameters: tuple[str, ...]
    initial_states: tuple[str, ...]
    num_combinations: int
    held: tuple[str, ...]
    sentence: str


@dataclass(frozen=True)
class Structure:
    """Result of the structural test.

    Attributes:
        rank: of the sensitivities to all unknowns: parameters, and initial states where they
            are unknown.
        num_unknowns: the rank where all of them are identifiable.
        singular_values: of the scaled sensitivities over the largest one, at the random value
            where the smallest that is not zero is largest.
        not_identifiable: groups of unknowns.
        tried: parameter values and inputs, in words.
    """

    rank: int
    num_unknowns: int
    singular_values: tuple[float, ...]
    not_identifiable: tuple[Inseparable, ...]
    tried: str

    def of(self, name: str) -> Inseparable | None:
        """The group that a parameter belongs to; None for an identifiable one."""
        return next((g for g in self.not_identifiable if name in g.parameters), None)


def structure(
    plant: AbstractPlant,
    params: Params,
    *,
    initial_state_known: bool,
    inputs: Float[np.ndarray, "experiment time input"] | None = None,
    known: Bool[np.ndarray, " param"] | None = None,
) -> Structure | None:
    """Which parameters no experiment can tell apart; None where the responses are not finite.

    The random parameter values lie within a factor of two of `params`, those of free sign within
    a scale. Levels of the inputs are random, with amplitudes from the plant's own to the limits.

    Args:
        initial_state_known: False where it is unknown too; it is then random as well.
        inputs: of experiments that are tried besides, up to the length of the random ones.
        known: which parameters are no unknowns; default none.
    """
    require_double_precision()
    d = plant.definition
    values, random_inputs, states = _drawn(plant, params, initial_state_known)
    if inputs is not None:
        values, states = (np.concatenate([rows, rows]) for rows in (values, states))
        own = inputs[np.arange(_NUM_DRAWS) % len(inputs), :NUM_STEPS]
        missing = NUM_STEPS - own.shape[1]
        own = np.pad(own, [(0, 0), (0, missing), (0, 0)], mode="edge")
        random_inputs = np.concatenate([random_inputs, own])
    size = np.where([p.positive for p in d.parameters], values, [p.scale for p in d.parameters])
    numbers = jax.device_put((values, size, random_inputs, states))
    outputs, slopes = jax.device_get(_sensitivities(plant, numbers, initial_state_known))
    is_unknown = np.ones(len(params), bool) if known is None else ~known
    slopes = slopes[..., np.append(is_unknown, np.ones(slopes.shape[-1] - len(params), bool))]
    parameters = [p for p, is_free in zip(d.parameters, is_unknown, strict=True) if is_free]
    found = [_Null.of(*rows) for rows in zip(outputs, slopes, size[:, is_unknown], strict=True)]
    num_unknowns, rank = slopes.shape[-1], max(null.rank for null in found)
    if rank < num_unknowns and not any(null.is_complete for null in found):
        return None
    generic = [null for null in found if null.rank == rank]
    best = max(generic, key=lambda null: null.singular_values[max(rank - 1, 0)])
    return Structure(
        rank=rank,
        num_unknowns=num_unknowns,
        singular_values=tuple(best.singular_values.tolist()),
        not_identifiable=_groups(parameters, names_of(d.states), generic),
        tried=f"{_NUM_DRAWS} random parameter values, "
        f"{'inputs of random levels, ' * bool(d.inputs)}"
        f"{'and the given inputs, ' * (inputs is not None)}{NUM_STEPS} samples",
    )


def _drawn(
    plant: AbstractPlant, params: Params, initial_state_known: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random parameter values, inputs and initial states, always the same."""
    d = plant.definition
    counts = np.cumsum([len(d.parameters), len(d.states)])
    shape = (_NUM_DRAWS, counts[-1] + NUM_STEPS * len(d.inputs))
    unit = np.asarray(jax.random.uniform(jax.random.key(0), shape, float, -1.0, 1.0))
    for_params, for_states, for_inputs = np.split(unit, counts, axis=1)
    centre = np.array([float(value) for value in params])
    drawn = np.where(
        [p.positive for p in d.parameters],
        centre * 2**for_params,
        centre + for_params * [p.scale for p in d.parameters],
    )
    lower = np.array([-np.inf if p.lower is None else p.lower for p in d.parameters])
    upper = np.array([np.inf if p.upper is None else p.upper for p in d.parameters])
    values = np.clip(drawn, centre + 0.9 * (lower - centre), centre + 0.9 * (upper - centre))
    low, high = map(np.asarray, plant.input_limits)
    usual, part = np.array([i.amplitude for i in d.inputs]), np.linspace(0.0, 1.0, _NUM_DRAWS)
    amplitude = usual + part[:, None] * ((high - low) / 2 - usual)
    levels = for_inputs.reshape(_NUM_DRAWS, NUM_STEPS, len(d.inputs))
    held = [rows[np.arange(NUM_STEPS) // hold] for rows, hold in zip(levels, _HOLDS, strict=True)]
    inputs = (low + high) / 2 + amplitude[:, None] * np.stack(held)
    # Upwards only: many states are never negative.
    moved = 0.0 if initial_state_known else np.abs(for_states) / 2 * [s.scale for s in d.states]
    return values, inputs, np.asarray(plant.initial_state) + np.zeros_like(for_states) + moved


@eqx.filter_jit
def _sensitivities(
    plant: AbstractPlant, numbers: tuple[Array, ...], initial_state_known: bool
) -> tuple[Float[Array, "draw sample output"], Float[Array, "draw sample output unknown"]]:
    """Outputs over their scales, and their derivatives by relative changes of the unknowns.

    Args:
        plant: is simulated.
        numbers: by draw: parameter values, sizes of their relative changes, inputs, initial states.
        initial_state_known: False where the initial states are unknowns, too.
    """
    scales = jnp.asarray([o.scale for o in plant.definition.outputs])
    state_scales = jnp.asarray([s.scale for s in plant.definition.states])
    num_params = len(plant.definition.parameters)

    def one(own: Array, size: Array, inputs: Array, start: Array) -> tuple[Array, Array]:
        def outputs(change: Array) -> tuple[Array, Array]:
            moved = 0.0 if initial_state_known else state_scales * change[num_params:]
            params = plant.Params(*(own + size * change[:num_params]))
            y = response(plant, params, inputs, start + moved) / scales[None]
            return y, y

        unknowns = num_params + (0 if initial_state_known else len(start))
        slopes, y = jax.jacfwd(outputs, has_aux=True)(jnp.zeros(unknowns))
        return y, slopes

    return jax.vmap(one)(*numbers)


@dataclass(frozen=True)
class _Null:
    """Rank of the sensitivities at one random value, and the directions in which they vanish.

    Attributes:
        directions: orthonormal, in the scaled unknowns.
        lengths: of the scaled unknowns, in relative changes.
        size: of a relative change of each parameter, in its unit.
        is_complete: whether the response was finite to its end.
    """

    rank: int
    singular_values: np.ndarray
    directions: Float[np.ndarray, "unknown direction"]
    lengths: Float[np.ndarray, " unknown"]
    size: Float[np.ndarray, " param"]
    is_complete: bool

    @classmethod
    def of(
        cls,
        outputs: Float[np.ndarray, "sample output"],
        slopes: Float[np.ndarray, "sample output unknown"],
        size: Float[np.ndarray, " param"],
    ) -> _Null:
        """From a response and its sensitivities.

        Rows are divided by the largest value up to their time, so that what grows without
        limit does not hide what came before it; columns by their lengths, so that a parameter
        of little effect counts as much as any other. Neither changes the rank.
        """
        rows = np.concatenate([outputs[..., None], slopes], axis=-1)
        largest = np.abs(rows).max(axis=(1, 2))
        finite = np.logical_and.accumulate(np.isfinite(largest))
        largest = np.maximum.accumulate(largest[finite])
        rows = slopes[finite] / np.where(largest > 0, largest, 1.0)[:, None, None]
        columns = rows.reshape(-1, slopes.shape[-1])
        lengths = np.linalg.norm(columns, axis=0)
        acts = lengths > _NO_EFFECT * np.sqrt(len(columns))
        lengths = np.where(acts, lengths, 1.0)
        triangle = np.linalg.qr(columns * acts / lengths, mode="r")
        square = np.zeros((len(lengths),) * 2)  # there may be fewer rows than unknowns
        square[: len(triangle)] = triangle
        _, values, directions = np.linalg.svd(square)
        values = values / max(values[0], 1e-300)
        rank = int(np.sum(values > UNDETERMINED))
        return cls(rank, values, directions[rank:].T, 1 / lengths, size, bool(finite.all()))

    @property
    def projector(self) -> Float[np.ndarray, "unknown unknown"]:
        """On the directions; they may be turned among themselves, it may not."""
        return self.directions @ self.directions.T

    def within(self, members: list[int], count: int) -> Float[np.ndarray, "member direction"]:
        """The directions of a group, in relative changes."""
        _, vectors = np.linalg.eigh(self.projector[np.ix_(members, members)])
        return vectors[:, len(members) - count :] * self.lengths[members, None]


def _groups(
    parameters: Sequence[Parameter], states: Sequence[str], found: Sequence[_Null]
) -> tuple[Inseparable, ...]:
    """Unknowns that are part of an undetermined direction at every value, by what they share."""
    projectors = np.stack([null.projector for null in found])
    diagonals = np.einsum("vii->vi", projectors)
    lost = np.all(diagonals > _INVOLVED**2, axis=0)
    linked = np.any(np.abs(projectors) > _INVOLVED, axis=0) & np.outer(lost, lost)
    for _ in lost:  # what is linked by others is linked
        linked = linked @ linked
    groups = []
    for i in range(len(parameters)):
        members = np.flatnonzero(linked[i]).tolist()
        if members[:1] == [i]:
            count = round(float(np.trace(projectors[0][np.ix_(members, members)])))
            names = names_of(parameters[m] for m in members if m < len(parameters))
            starts = tuple(states[m - len(parameters)] for m in members if m >= len(parameters))
            rows = projectors[0][members[: len(names)]]
            groups.append(
                Inseparable(
                    parameters=names,
                    initial_states=starts,
                    num_combinations=len(members) - count,
                    held=tuple(names[m] for m in _pivots(rows, count)),
                    sentence=_told(names, starts, parameters, members, count, found),
                )
            )
    return tuple(groups)


def _pivots(rows: np.ndarray, count: int) -> list[int]:
    """Rows of an undetermined space that determine it, the longest first."""
    rows, chosen = rows.copy(), []
    for _ in range(min(count, len(rows))):
        lengths = np.linalg.norm(rows, axis=1)
        longest = int(np.argmax(lengths.round(6)))  # the first one of equals
        if lengths[longest] < _INVOLVED:
            break
        chosen.append(longest)
        unit = rows[longest] / lengths[longest]
        rows -= np.outer(rows @ unit, unit)
    return sorted(chosen)


def _told(
    names: tuple[str, ...],
    starts: tuple[str, ...],
    parameters: Sequence[Parameter],
    members: list[int],
    count: int,
    found: Sequence[_Null],
) -> str:
    """What cannot be told apart, and what can be told: a product of powers or a sum, if it is."""
    if len(members) == 1:
        return f"{names[0]} acts on no output"
    values = f"the initial value{'s' if len(starts) > 1 else ''} of {listed(starts)}"
    apart = f"{listed([*names, *[values] * bool(starts)])} cannot be told apart"
    own = members[: len(names)]
    relative = [null.within(members, count)[: len(names)] for null in found]
    absolute = [rows * null.size[own, None] for rows, null in zip(relative, found, strict=True)]
    positive = all(parameters[m].positive for m in own)
    left = len(names) - len(_pivots(found[0].projector[own], count))
    only = f"{apart}{', of the parameters' if starts else ','} only"
    if left == 1 and positive and (powers := _same(map(_across, relative))) is not None:
        return f"{only} {_product(names, powers)}"
    if left == 1 and (weights := _same(map(_across, absolute))) is not None:
        return f"{only} {_sum(names, weights)}"
    if count == 1 and positive and (powers := _same(rows[:, 0] for rows in relative)) is not None:
        if np.allclose(powers, powers[0]) and len(names) > 1:
            return f"{only} their ratios"
        if not starts:
            scaled = [f"{name} s{_power(p)}" for name, p in zip(names, powers, strict=True)]
            return f"{apart}: {listed(scaled)} give the same outputs for every s"
    left = len(members) - count
    return f"{apart}, only {left} combination{'s' if left > 1 else ''} of them"


def _across(directions: Float[np.ndarray, "member direction"]) -> np.ndarray:
    """The one direction across all the others."""
    return np.linalg.svd(directions / np.abs(directions).max())[0][:, -1]


def _same(directions: Iterable[np.ndarray]) -> np.ndarray | None:
    """The direction if it is the same at every value, its smallest part 1 or -1; None if not."""
    unit = [v / np.abs(v).max() * np.sign(v[0]) for v in directions]
    least = min(np.abs(v).min() for v in unit)
    alike = all(np.allclose(v, unit[0], rtol=0, atol=_INVOLVED) for v in unit)
    return unit[0] / np.abs(unit[0]).min() if alike and len(unit) > 1 and least > 1e-3 else None


def _power(power: float) -> str:
    return "" if abs(power - 1) < 1e-4 else f"^{power:.3g}"


def _product(names: Sequence[str], powers: np.ndarray) -> str:
    """In words and symbols: the ratio J/c, the product a b, a b^2/c."""
    pairs = list(zip(names, powers, strict=True))
    over = [name + _power(p) for name, p in pairs if p > 0]
    under = [name + _power(-p) for name, p in pairs if p < 0]
    below = f"/({' '.join(under)})" if len(under) > 1 else "".join(f"/{u}" for u in under)
    word = ""
    if np.allclose(np.abs(powers), 1):
        word = "the product " if not under else "the ratio " if len(names) == 2 else ""
    return f"{word}{' '.join(over)}{below}"


def _sum(names: Sequence[str], weights: np.ndarray) -> str:
    """A weighted sum: the sum a + b, the difference a - b, a - 2 b."""
    terms = [
        f"{'-' if w < 0 else '+'} {'' if abs(abs(w) - 1) < 1e-4 else f'{abs(w):.3g} '}{name}"
        for name, w in zip(names, weights, strict=True)
    ]
    word = ""
    if np.allclose(np.abs(weights), 1):
        word = "the sum " if np.all(weights > 0) else "the difference " if len(names) == 2 else ""
    return f"{word}{' '.join(terms).removeprefix('+ ')}"


def practically(
    names: tuple[str, ...],
    information: Float[np.ndarray, "param param"],
    structure: Structure | None,
) -> tuple[str, tuple[str, ...]]:
    """The verdict on an experiment, and its sentences.

    What is structurally not identifiable, what the experiment does not tell from the noise,
    and how certain the rest is.
    """
    groups = structure.not_identifiable if structure else ()
    sentences = [f"{STRUCTURALLY_NOT}: {group.sentence}" for group in groups]
    held = [name for group in groups for name in group.held]
    free, verdict = np.array([name not in held for name in names]), IDENTIFIABLE
    while (unseen := worst_seen(names, information, free, is_planned=True)) is not None:
        free[unseen[0]], verdict = False, PRACTICALLY_NOT
        sentences.append(unseen[1])
    if free.any():
        block = np.where(np.outer(free, free), information, np.eye(len(names)))
        given = [name for g in groups for name in g.held if len(g.parameters) > 1]
        known = f"with {listed(given)} known: " if given else ""
        sentences.append(known + identifiability(names, np.linalg.inv(block), free))
    return STRUCTURALLY_NOT if groups else verdict, tuple(sentences)


def worst_seen(
    names: tuple[str, ...],
    information: Float[np.ndarray, "param param"],
    free: np.ndarray,
    *,
    is_planned: bool = False,
) -> tuple[int, str] | None:
    """The free parameter to hold because the data do not determine it, and the reason.

    None when every direction of the free parameters is known better than `UNSEEN_SD`.
    The direction is the eigenvector of the information with the smallest eigenvalue.

    Args:
        is_planned: the information is that of an experiment, not of data.
    """
    index = np.flatnonzero(free)
    if index.size == 0:
        return None
    block = information[np.ix_(index, index)]
    if np.all(np.isfinite(block)):
        values, vectors = np.linalg.eigh(block)
        value, direction = max(values[0], 0.0), vectors[:, 0]
    else:
        value, direction = 0.0, np.ones(index.size)
    if value * UNSEEN_SD**2 >= 1:
        return None
    involved = [names[i] for i, v in zip(index, direction, strict=True) if abs(v) > 0.3]
    chosen = int(index[_best_to_hold(block, direction)])
    if len(involved) == 1:
        kind = PRACTICALLY_NOT if is_planned else "not identifiable from the data"
        return chosen, f"{names[chosen]} is {kind}"
    if not is_planned:
        return chosen, f"{' and '.join(involved)} are not identifiable separately"
    combination = " ".join(
        f"{names[i]}^{v:+.2g}"
        for i, v in zip(index, direction / direction[np.argmax(np.abs(direction))], strict=True)
        if names[i] in involved
    )
    kind = f"{PRACTICALLY_NOT}, separately"
    return chosen, f"{' and '.join(involved)} are {kind}: {combination} is undetermined"


def _best_to_hold(
    information: Float[np.ndarray, "param param"], direction: Float[np.ndarray, " param"]
) -> int:
    """Which parameter of an undetermined direction, once held, makes the others most certain."""
    size = np.abs(direction)
    alike = np.flatnonzero(size > _ALIKE * size.max())
    if len(alike) == 1 or not np.all(np.isfinite(information)):
        return int(np.argmax(size))
    rest = [np.delete(np.delete(information, i, 0), i, 1) for i in alike]
    rounding = UNDETERMINED * float(np.abs(information).max())
    least = [max(np.linalg.eigvalsh(block)[0], rounding) for block in rest]
    equal = [i for i, value in zip(alike, least, strict=True) if value >= _ALIKE * max(least)]
    return int(max(equal, key=lambda i: size[i]))


def identifiability(
    names: tuple[str, ...], covariance: Float[np.ndarray, "param param"], free: np.ndarray
) -> str:
    """A sentence on the standard deviation of the least certain direction of free parameters.

    Args:
        covariance: of relative changes.
    """
    index = np.flatnonzero(free)
    values, vectors = np.linalg.eigh(covariance[np.ix_(index, index)])
    sd, direction = np.sqrt(max(values[-1], 0.0)), vectors[:, -1]
    involved = [names[i] for i, v in zip(index, direction, strict=True) if abs(v) > 0.3]
    seen = "all parameters" if len(index) == len(names) else ", ".join(names[i] for i in index)
    what = involved[0] if len(involved) == 1 else f"a combination of {' and '.join(involved)}"
    return f"{seen} identifiable; least certain direction: {what}, {100 * sd:.2g} % (1 SD)"
