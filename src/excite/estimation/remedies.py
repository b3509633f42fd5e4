"""What the plant's equations may leave out, when a residual is not noise.

Each suspect is one effect with one parameter. The plant with all of them is simulated with one
at a time, at several values; those that could explain most of the residual are fitted. A suspect
is named where it explains more than chance; the best by the Bayesian information criterion
comes first. Of a long record some parts are searched, and the likeliest suspects are then fitted
to all of it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..description import RARE, names_of
from ..plant import AbstractPlant, Params
from ..plant.extension import HOLDS, extended, extensions_of
from .contract import (
    Estimate,
    Experiments,
    from_search,
    quality,
    residual_of,
    simulate_experiments,
    to_search,
)
from .diagnosis import chi2_tail, innovations, log_likelihood, whiteness_of
from .excerpt import Excerpt, Span, excerpt_of
from .nls import NLS

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

Residual = Float[np.ndarray, "experiment sample output"]

_TRIED = {
    "delay": (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0, 4.0, 12.0),
    "lag": (0.5, 1.0, 2.0, 4.0, 12.0),
    "saturation": (0.95, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4),
    "dead_zone": (0.02, 0.05, 0.1, 0.2, 0.4),
    "offset": (1.0,),
    "coulomb": (1.0,),
    "drag": (1.0,),
    "bias": (1.0,),
    "drift": (1.0,),
}
"""Values of a suspect's parameter: sampling times, parts of the largest input, usual sizes."""
_MOST_FITTED, _STEPS = 7, 30  # suspects that are fitted, and most steps of one fit
_MOST_CONFIRMED = 2  # suspects found in parts of a record that are fitted to all of it
_STEP = 1e-6  # of a difference
_LANES = 16  # simulated side by side; a constant, so that one program is compiled
_HUGE = 1e30
_BOUND = 20.0  # the search coordinate of a parameter at its bound, which is infinite
_FREEDOMS = 2.0, 3.0, 4.0, 6.0, 10.0, 20.0  # of Student's t for outliers
_FAR = 4.0  # standard deviations, told by the median, beyond which a sample is an outlier
_SIMPLER = 1.05  # advantage of the other hold over a delay
_MUCH = 0.1  # part of a coloured residual that a likely cause explains


@dataclasses.dataclass(frozen=True)
class Suspect:
    """An effect that explains more of the residual than chance.

    Attributes:
        name: of the plant's extension, `linear_voltage` for an input that is linear between
            samples (or `constant_voltage`), or `outliers`.
        value, std_error, unit: of its parameter; None where it has none.
        reduction: part of the sum of squared residuals that it explains.
        log_likelihood: gained by it.
        p_value: of a likelihood-ratio test; it allows for a coloured residual.
        remedy: what to change.
    """

    name: str
    value: float | None
    std_error: float | None
    unit: str
    reduction: float
    log_likelihood: float
    p_value: float
    remedy: str

    def evidence(self, num_values: int) -> float:
        """Half the gain by the Bayesian information criterion: a parameter has its price."""
        return self.log_likelihood - (self.value is not None) * math.log(num_values) / 2

    @property
    def sentence(self) -> str:
        """The suspect in words."""
        if self.name == "outliers":
            return (
                "the residual has heavier tails than a normal distribution, as outliers make them "
                f"({self.remedy})"
            )
        if self.value is None:
            word, _, channel = self.name.partition("_")
            what = f"{channel} {word} between samples"
        else:
            what = f"{self.name} = {self.value:.4g} ± {self.std_error:.2g} {self.unit}"
        return (
            f"with {what} the sum of squared residuals would be {100 * self.reduction:.3g} % "
            f"smaller ({self.remedy})"
        )


@dataclasses.dataclass(frozen=True)
class Question:
    """A fit that leaves more than noise, and what else could be fitted.

    Attributes:
        plant, experiments, estimator: of the fit.
        stacked: experiments of a plant with other inputs linear between samples.
        linear: which inputs are so in the data.
        start: of the search.
        estimate: without suspects.
        is_best: whether no other values of the free parameters fit better.
        free: which parameters were estimated.
        plant_word: the plant on the command line.
    """

    plant: AbstractPlant
    experiments: Experiments
    estimator: NLS
    stacked: Callable[[AbstractPlant, Bool[np.ndarray, " input"]], Experiments]
    linear: Bool[np.ndarray, " input"]
    start: Params
    estimate: Estimate
    is_best: bool
    free: Bool[np.ndarray, " param"]
    plant_word: str

    @property
    def names(self) -> list[str]:
        """Extensions that are suspects; a gain cannot be told from the plant's own."""
        return [name for name in extensions_of(self.plant) if not name.startswith("gain_")]

    @cached_property
    def whole(self) -> AbstractPlant:
        """The plant with all of them."""
        return extended(self.plant, self.names)

    @property
    def num_tests(self) -> int:
        """Number of suspects."""
        return len(self.names) + len(self.linear) + 1

    def other_hold(self, index: int) -> tuple[Bool[np.ndarray, " input"], str]:
        """Inputs of which one has the other hold, and the suspect's name."""
        other = self.linear ^ (np.arange(len(self.linear)) == index)
        return other, f"{HOLDS[int(other[index])]}_{names_of(self.plant.definition.inputs)[index]}"

    def search(self, part: Excerpt | None = None) -> _Search:
        """For suspects that are extensions, from the estimate; in a part of the record."""
        sd = self.estimator.weights(self.plant, self.experiments, jax.device_put(self.estimate))
        experiments, elapsed = part or (self.experiments, None)
        return _Search(
            self.plant,
            self.whole,
            experiments,
            self.start,
            self.estimate,
            self.free,
            np.asarray(sd),
            elapsed,
        )

    def suspect(
        self,
        name: str,
        before: Residual,
        after: Residual,
        valid: Bool[np.ndarray, "..."],
        value: float | None = None,
        std_error: float | None = None,
    ) -> Suspect:
        """A suspect by the residuals without and with it, and the value of its parameter."""
        whitened = max(_gained(before, after, valid, whiten=True), 0.0)
        word, _, channel = name.partition("_")
        remedy, unit = f"--hold-input {channel}={word}", ""
        if value is not None:
            unit = self.whole.definition.parameter(name).unit
            remedy = f"--plant {self.plant_word}+{name} --start {name}={value:.4g}"
        return Suspect(
            name=name,
            value=value,
            std_error=std_error,
            unit=unit,
            reduction=_reduction(before, after, valid),
            log_likelihood=_gained(before, after, valid, whiten=False),
            p_value=chi2_tail(1 + (word == "drift"), 2 * whitened),
            remedy=remedy,
        )

    def likely(
        self, found: Sequence[Suspect], before: Residual, valid: Bool[np.ndarray, "..."]
    ) -> tuple[Suspect, ...]:
        """Those that explain more than chance, the likeliest first.

        What a plant leaves out has heavy tails, too: of a coloured residual outliers are a cause
        only where no effect explains much. A delay of half a sample is as good as the other hold,
        which needs no parameter and is named first where the two are alike.
        """
        likely = [s for s in found if s.log_likelihood > 0 and s.p_value * self.num_tests <= RARE]
        parts, outputs = _parts(before, valid), self.plant.definition.outputs
        is_coloured = any(
            whiteness_of(r, o.scale) < RARE for r, o in zip(parts, outputs, strict=True)
        )

        def evidence(s: Suspect) -> float:
            return s.evidence(int(valid.sum()))

        ranked = sorted(
            likely, key=lambda s: (is_coloured and not s.reduction > _MUCH, -evidence(s))
        )
        hold = next((s for s in ranked if s.name.startswith(HOLDS)), None)
        is_delay = bool(ranked) and ranked[0].name.startswith("delay_")
        if hold and is_delay and _SIMPLER * evidence(hold) > evidence(ranked[0]):
            ranked = [hold, *(s for s in ranked if s is not hold)]
        return tuple(ranked)


Told = Callable[[str, float, float], None]


def suspects(question: Question, progress: Told = lambda *_: None) -> tuple[Suspect, ...]:
    """The suspects that explain more than chance, the likeliest first.

    Args:
        question: what was fitted.
        progress: called with a text, how many suspects are fitted, and their number.
    """
    q, valid = question, np.asarray(question.experiments.valid)
    search, total = q.search(), len(q.linear) + _MOST_FITTED
    before = np.asarray(q.estimate.residual)
    if not q.is_best:
        before = search.refitted(search.begin, search.start)
    found = [] if (tails := outliers(before, valid)) is None else [tails]
    for i, channel in enumerate(names_of(q.plant.definition.inputs)):
        progress(f"likely causes: {channel} between samples", i, total)
        other, name = q.other_hold(i)
        data = q.stacked(q.plant, other)
        ended = [
            jax.device_get(q.estimator(q.plant, data, *jax.device_put((begin, q.free))))
            for begin in (q.start, q.estimate.params)
        ]
        after = np.asarray(min(ended, key=quality).residual)
        found.append(q.suspect(name, before, after, valid))
    found += _effects(q, search, before, progress)
    return q.likely(found, before, valid)


def suspects_in(
    question: Question, spans: Sequence[Span], progress: Told = lambda *_: None
) -> tuple[Suspect, ...]:
    """The suspects of a long record, looked for in some parts of it.

    The likeliest are fitted to the whole record: their figures are of that fit.

    Args:
        question: what was fitted.
        spans: the parts.
        progress: see `suspects`.
    """
    q, total = question, len(question.linear) + _MOST_FITTED + 1
    search = q.search(excerpt_of(q.plant, q.experiments, q.estimate, spans))
    before, valid = search.refitted(search.begin), search.valid
    found = [] if (tails := outliers(before, valid)) is None else [tails]
    for i, channel in enumerate(names_of(q.plant.definition.inputs)):
        progress(f"likely causes: {channel} between samples", i, total)
        other, name = q.other_hold(i)
        part = excerpt_of(q.plant, q.stacked(q.plant, other), q.estimate, spans)
        other_search = q.search(part)
        after = other_search.refitted(other_search.begin)
        found.append(q.suspect(name, before, after, valid))
    found += _effects(q, search, before, progress)
    likely, confirmed = q.likely(found, before, valid), []
    for first in likely[:_MOST_CONFIRMED]:
        progress(f"likely causes: {first.name} in the whole record", total - 1, total)
        confirmed.append(_in_all(q, first))
    whole = np.asarray(q.estimate.residual), np.asarray(q.experiments.valid)
    best = q.likely(confirmed, *whole)
    return (*best, *likely[_MOST_CONFIRMED:]) if best else ()


def _in_all(q: Question, found: Suspect) -> Suspect:
    """A suspect by its fit to the whole record."""
    before, valid = np.asarray(q.estimate.residual), np.asarray(q.experiments.valid)
    if found.name == "outliers":
        return outliers(before, valid) or dataclasses.replace(found, p_value=1.0)
    if found.value is None:
        index = names_of(q.plant.definition.inputs).index(found.name.partition("_")[2])
        data, plant = q.stacked(q.plant, q.other_hold(index)[0]), q.plant
        begin, free = q.estimate.params, q.free
    else:
        plant = extended(q.plant, [found.name])
        data = q.stacked(plant, q.linear)
        values = {**q.estimate.params._asdict(), found.name: jnp.asarray(found.value)}
        begin = plant.Params(**values)
        free = np.array([n not in q.plant.Params._fields for n in begin._fields])
        free[[begin._fields.index(n) for n in q.plant.Params._fields]] = q.free
    end = jax.device_get(q.estimator(plant, data, *jax.device_put((begin, free))))
    value = std_error = None
    if found.value is not None:
        at = plant.Params._fields.index(found.name)
        value, std_error = float(end.params[at]), math.sqrt(end.covariance[at, at])
    return q.suspect(found.name, before, np.asarray(end.residual), valid, value, std_error)


def _effects(q: Question, search: _Search, before: Residual, progress: Told) -> list[Suspect]:
    """The extensions that could explain most, fitted."""
    inputs, found, first = search.data.inputs, [], len(q.linear)
    trials = [_Trial(n, v) for n in q.names for v in _tried(search.whole, n, inputs)]
    where = search.begin if q.is_best else search.start  # an estimate may be far off
    for i, trial in enumerate(search.promising(trials, where), first):
        progress(f"likely causes: {trial.name}", i, first + _MOST_FITTED)
        value, std_error, after = search.best(trial)
        found.append(q.suspect(trial.name, before, after, search.valid, value, std_error))
    return found


class _Trial(NamedTuple):
    """A suspect, and a value of its parameter."""

    name: str
    value: float


class _Search:
    """Fits of a plant with one suspect at a time, from the estimate without it.

    The unknowns are search coordinates of the plant's own free parameters, then initial states
    over their scales, and at last the suspect's parameter over its scale. Slopes are differences:
    a simulation is compiled many times faster than its derivatives, and no more digits are needed.
    """

    def __init__(
        self,
        plant: AbstractPlant,
        whole: AbstractPlant,
        experiments: Experiments,
        start: Params,
        estimate: Estimate,
        free: Bool[np.ndarray, " param"],
        sd: Float[np.ndarray, " output"],
        elapsed: Float[np.ndarray, " experiment"] | None = None,
    ) -> None:
        d, own = whole.definition, names_of(plant.definition.states)
        self.plant, self.whole, self.estimate, self.free, self.sd = plant, whole, estimate, free, sd
        self.valid = np.asarray(experiments.valid)
        self.states = np.array([names_of(d.states).index(name) for name in own])
        initial = np.tile(np.asarray(whole.initial_state), (len(self.valid), 1))
        begun = estimate if elapsed is None else experiments
        initial[:, self.states] = np.asarray(begun.initial_state)
        names = names_of(d.states)
        if elapsed is not None:  # lags have settled, and drifts have gone on since the beginning
            for i, channel in enumerate(names_of(d.inputs)):
                if (lag := f"lag_{channel}") in names and lag not in own:
                    initial[:, names.index(lag)] = np.asarray(experiments.inputs)[:, 0, i]
        self.elapsed = elapsed
        self.data = dataclasses.replace(experiments, initial_state=jax.device_put(initial))
        estimated, begun = (
            np.nan_to_num(to_search(plant.definition, params), posinf=_BOUND, neginf=-_BOUND)
            for params in (estimate.params, start)
        )
        self.z = np.where(free, estimated, 0.0)
        self.neutral = np.array(
            [1e6 * p.nominal if p.name.startswith("saturation_") else 0.0 for p in d.parameters]
        )
        num_free, (count, num_states) = int(free.sum()), (len(self.valid), len(own))
        num_initial = 0 if experiments.initial_state_known else count * num_states
        self.begin, self.start = (
            np.append(z[free], np.zeros(num_initial)) for z in (estimated, begun)
        )
        # What is changed together for a slope: a state in all experiments at once.
        self.kind = np.append(
            np.concatenate([
                np.arange(num_free), num_free + np.arange(num_initial) % num_states
            ]),
            -1,
        )  # fmt: skip
        experiment = np.arange(num_initial) // num_states
        self.of_state = np.nonzero(self.valid)[0][:, None] == experiment[None]

    def misfits(
        self, points: Float[np.ndarray, "lane unknown"], names: Sequence[str]
    ) -> Float[np.ndarray, "lane value"]:
        """Weighted residuals, huge where a simulation diverges; each lane with its suspect."""
        count, num_free, fields = len(points), int(self.free.sum()), self.whole.Params._fields
        own, added = np.tile(self.z, (count, 1)), np.tile(self.neutral, (count, 1))
        own[:, self.free] = points[:, :num_free]
        moved = np.zeros((count, *self.data.initial_state.shape))
        if not self.data.initial_state_known:
            moved[..., self.states] = points[:, num_free:-1].reshape(count, len(self.valid), -1)
        for lane, name in enumerate(names):
            if not name:
                continue
            value = points[lane, -1] * self.whole.definition.parameter(name).scale
            added[lane, fields.index(name)] = value
            if name.startswith("drift_") and self.elapsed is not None:
                state = next(s for s in self.whole.definition.states if s.name == name)
                at = self.whole.definition.states.index(state)
                moved[lane, :, at] = value * self.elapsed / state.scale
        found = []
        for first in range(0, count, _LANES):
            few = [rows[first : first + _LANES] for rows in (own, added, moved)]
            padded = [np.resize(rows, (_LANES, *rows.shape[1:])) for rows in few]
            residual = _residuals(
                self.plant,
                self.whole,
                self.data,
                self.estimate.params,
                *jax.device_put((self.free, *padded)),
            )
            with np.errstate(over="ignore"):
                weighted = (np.asarray(residual) / self.sd)[: len(few[0]), self.valid]
            found.append(np.clip(np.nan_to_num(weighted, nan=_HUGE), -_HUGE, _HUGE))
        return np.concatenate(found)

    def slopes(self, point: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Weighted residual, and its derivative with respect to the unknowns."""
        kinds, of_kind = np.unique(self.kind, return_inverse=True)
        changes = _STEP * (self.kind[None] == kinds[:, None])
        points = point + np.concatenate([np.zeros((1, len(point))), changes])
        found = self.misfits(points, [name] * len(points))
        columns = ((found[1:] - found[0]) / _STEP)[of_kind].T
        columns[:, -1 - self.of_state.shape[1] : -1] *= self.of_state
        return found[0], columns

    def promising(self, trials: Sequence[_Trial], where: np.ndarray) -> list[_Trial]:
        """The few trials that explain most if all were linear at a point, one for each suspect."""
        before, S = self.slopes(np.append(where, 0.0), "")
        basis, _ = np.linalg.qr(S[:, :-1])
        scale = [self.whole.definition.parameter(trial.name).scale for trial in trials]
        points = [np.append(where, t.value / s) for t, s in zip(trials, scale, strict=True)]
        changed = self.misfits(np.stack(points), [trial.name for trial in trials])
        best: dict[str, tuple[float, _Trial]] = {}
        for trial, change in zip(trials, changed - before, strict=True):
            change = change - basis @ (basis.T @ change)
            parameter = self.whole.definition.parameter(trial.name)
            factor = -float(change @ before) / max(float(change @ change), 1e-300)
            factor = factor if parameter.lower is None else max(factor, 0.0)
            explained = factor**2 * float(change @ change)
            if sum(t.name == trial.name for t in trials) == 1:  # the effect is linear in the value
                trial = trial._replace(value=factor * trial.value)
            if explained > best.get(trial.name, (0.0,))[0]:
                best[trial.name] = explained, trial
        ranked = sorted(best.values(), key=lambda pair: -pair[0])
        return [trial for _, trial in ranked[:_MOST_FITTED]]

    def best(self, trial: _Trial) -> tuple[float, float, Residual]:
        """Value of the suspect's parameter, its standard error, and the residual.

        The search begins at the estimate, and at its start: a strong effect distorts an estimate.
        In parts of a long record it begins at the estimate only.
        """
        begins = (self.begin, self.start) if self.elapsed is None else (self.begin,)
        ends = [self.fitted(trial, own) for own in begins]
        return min(ends, key=lambda end: float(np.sum((end[2] / self.sd) ** 2)))

    def fitted(self, trial: _Trial, own: np.ndarray) -> tuple[float, float, Residual]:
        """As `best`, from one point."""
        parameter = self.whole.definition.parameter(trial.name)
        begin = np.append(own, trial.value / parameter.scale)
        lower = np.full(len(begin), -np.inf)
        lower[-1] = -np.inf if parameter.lower is None else 0.0
        found = self._searched(lambda point: self.slopes(point, trial.name), begin, lower)
        sd = math.sqrt(2 * found.cost / max(len(found.fun) - len(begin), 1))
        row = np.linalg.pinv(np.linalg.qr(found.jac, mode="r"))[-1]
        size = parameter.scale
        std_error = sd * size * float(np.linalg.norm(row))
        return float(found.x[-1]) * size, std_error, self._residual(found)

    def refitted(self, *begins: np.ndarray) -> Residual:
        """The residual of the best fit without suspects, at which all others begin."""

        def slopes(point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            misfit, columns = self.slopes(np.append(point, 0.0), "")
            return misfit, columns[:, :-1]

        ends = [self._searched(slopes, begin, -np.inf) for begin in begins]
        found = min(ends, key=lambda end: end.cost)
        self.begin = found.x
        return self._residual(found)

    def _searched(
        self,
        slopes: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
        begin: np.ndarray,
        lower: np.ndarray | float,
    ) -> OptimizeResult:
        both = lru_cache(1)(lambda key: slopes(np.frombuffer(key)))
        return _require_least_squares()(
            lambda point: both(point.tobytes())[0],
            begin,
            jac=lambda point: both(point.tobytes())[1],
            bounds=(lower, np.inf),
            ftol=1e-6,
            max_nfev=_STEPS,
        )

    def _residual(self, found: OptimizeResult) -> Residual:
        residual = np.zeros(self.valid.shape)
        residual[self.valid] = found.fun
        return residual * self.sd


@eqx.filter_jit
def _residuals(
    plant: AbstractPlant,
    whole: AbstractPlant,
    data: Experiments,
    params: Params,
    free: Bool[Array, " param"],
    own: Float[Array, "lane param"],
    added: Float[Array, "lane whole_param"],
    moved: Float[Array, "lane experiment state"],
) -> Float[Array, "lane experiment sample output"]:
    """Measured minus simulated outputs of several plants and initial states."""
    names, scales = whole.Params._fields, jnp.asarray([s.scale for s in whole.definition.states])
    at = np.array([names.index(name) for name in plant.Params._fields])

    def residual(z: Array, added: Array, moved: Array) -> Array:
        known = jnp.where(free, from_search(plant.definition, z), jnp.stack(params))
        whole_params = whole.Params(*added.at[at].set(known))
        initial = data.initial_state + moved * scales[None]
        return residual_of(data, simulate_experiments(whole, whole_params, data, initial))

    return jax.vmap(residual)(own, added, moved)


def _require_least_squares() -> Callable[..., OptimizeResult]:
    """SciPy's search, which only those wait for whose residual is not noise."""
    from scipy.optimize import least_squares

    return least_squares


def _tried(whole: AbstractPlant, name: str, inputs: Array) -> list[float]:
    """Values of a suspect's parameter that are tried."""
    kind = next(k for k in _TRIED if name.startswith(f"{k}_"))
    parameter, names = whole.definition.parameter(name), names_of(whole.definition.inputs)
    size = parameter.nominal or 0.1 * parameter.scale
    if kind in ("delay", "lag"):
        size = float(whole.dt)
    elif kind in ("saturation", "dead_zone"):
        index = names.index(name.removeprefix(f"{kind}_"))
        size = float(np.abs(np.asarray(inputs)[..., index]).max()) or size
    return [part * size for part in _TRIED[kind]]


def _parts(residual: Residual, valid: np.ndarray) -> list[list[np.ndarray]]:
    """Measured residuals by output and experiment."""
    return [
        [r[v, i] for r, v in zip(residual, valid[..., i], strict=True)]
        for i in range(residual.shape[2])
    ]


def _gained(before: Residual, after: Residual, valid: np.ndarray, whiten: bool) -> float:
    """Logarithm of the likelihood that a smaller residual gains; each output has its own noise."""
    old, new = (log_likelihood(_parts(residual, valid), whiten) for residual in (before, after))
    return new - old


def _reduction(before: Residual, after: Residual, valid: np.ndarray) -> float:
    """Part of the squared residuals, of each output over those before, that is gone."""
    old, new = (
        np.array([sum(float(r @ r) for r in parts) for parts in _parts(residual, valid)])
        for residual in (before, after)
    )
    return 1 - float(np.mean(new[old > 0] / old[old > 0])) if old.any() else 0.0


def outliers(residual: Residual, valid: np.ndarray) -> Suspect | None:
    """The suspect that the noise has heavy tails, as Student's t has; None where it has not.

    What a residual follows from its own past is no outlier.
    """
    gained, count = 0.0, 0
    for parts in _parts(residual, valid):
        r = np.concatenate(innovations(parts))
        if not r.any():
            continue
        gauss = -0.5 * len(r) * (math.log(2 * math.pi * float(np.mean(r**2))) + 1)
        gained += max(0.0, max(_student(r, freedom) for freedom in _FREEDOMS) - gauss)
        bulk = 1.4826 * float(np.median(np.abs(r - np.median(r))))
        count += int(np.sum(np.abs(r - np.median(r)) > _FAR * bulk))
    p = chi2_tail(residual.shape[2], 2 * gained)
    if p > RARE or not count:
        return None
    far = f"{count} of {int(valid.sum())} values are more than {_FAR:g} robust standard deviations"
    remedy = f"{far} off: --likelihood student"
    return Suspect("outliers", None, None, "", math.nan, gained, p, remedy)


def _student(residual: np.ndarray, freedom: float) -> float:
    """Largest log-likelihood of Student's t with a scale, found by its fixed point."""
    scale = float(np.median(residual**2)) or 1e-300
    for _ in range(50):
        weight = (freedom + 1) / (freedom + residual**2 / scale)
        scale = max(float(np.mean(weight * residual**2)), 1e-300)
    constant = math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)
    constant -= 0.5 * math.log(freedom * math.pi * scale)
    tails = np.log1p(residual**2 / (freedom * scale))
    return len(residual) * constant - (freedom + 1) / 2 * float(np.sum(tails))
