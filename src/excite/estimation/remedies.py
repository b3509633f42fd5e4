"""What the plant's equations may leave out, when a residual is not noise.

Each suspect is one effect with one parameter. The plant with all of them is simulated with one
at a time, at several values; those that could explain most of the residual are fitted. A suspect
is named where it explains more than chance; the best by the Bayesian information criterion
comes first.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..description import RARE, names_of
from ..plant import AbstractPlant, Params
from ..plant.extension import extended, extensions_of
from .contract import (
    Estimate,
    Experiments,
    from_search,
    quality,
    residual_of,
    simulate_experiments,
    to_search,
)
from .diagnosis import chi2_tail, innovations, log_likelihood
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
    "drift": (1.0,),
}
"""Values of a suspect's parameter: sampling times, parts of the largest input, usual sizes."""
HOLDS = "constant", "linear"  # an input between samples
_MOST_FITTED, _STEPS = 5, 30  # suspects that are fitted, and most steps of one fit
_STEP = 1e-6  # of a difference
_LANES = 16  # simulated side by side; a constant, so that one program is compiled
_HUGE = 1e30
_BOUND = 20.0  # the search coordinate of a parameter at its bound, which is infinite
_FREEDOMS = 2.0, 3.0, 4.0, 6.0, 10.0, 20.0  # of Student's t for outliers
_FAR = 4.0  # standard deviations of the bulk beyond which a sample is an outlier


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


def suspects(
    plant: AbstractPlant,
    experiments: Experiments,
    stacked: Callable[[Bool[np.ndarray, " input"]], Experiments],
    linear: Bool[np.ndarray, " input"],
    estimator: NLS,
    start: Params,
    estimate: Estimate,
    free: Bool[np.ndarray, " param"],
    plant_word: str,
    progress: Callable[[str, float, float], None] = lambda *_: None,
) -> tuple[Suspect, ...]:
    """The suspects that explain more than chance, the likeliest first.

    Args:
        experiments: the data.
        stacked: the same with other inputs linear between samples.
        linear: which inputs are so in the data.
        estimator: of the estimate.
        start: of its search.
        estimate: without suspects.
        free: which parameters were estimated.
        plant_word: the plant on the command line.
        progress: called with a text, how many suspects are fitted, and their number.
    """
    # A gain cannot be told from the plant's own.
    names = [name for name in extensions_of(plant) if not name.startswith(("bias_", "gain_"))]
    whole, valid = extended(plant, names), np.asarray(experiments.valid)
    before, tests = np.asarray(estimate.residual), len(names) + len(linear) + 1

    def suspect(name: str, after: Residual, remedy: str, freedoms: int = 1) -> Suspect:
        whitened = max(_gained(before, after, valid, whiten=True), 0.0)
        return Suspect(
            name=name,
            value=None,
            std_error=None,
            unit="",
            reduction=_reduction(before, after, valid),
            log_likelihood=_gained(before, after, valid, whiten=False),
            p_value=chi2_tail(freedoms, 2 * whitened),
            remedy=remedy,
        )

    found = [] if (tails := outliers(before, valid)) is None else [tails]
    total = len(linear) + _MOST_FITTED
    for i, channel in enumerate(names_of(plant.definition.inputs)):
        progress(f"likely causes: {channel} between samples", i, total)
        other = linear ^ (np.arange(len(linear)) == i)
        data, word = stacked(other), HOLDS[int(other[i])]
        ended = [
            jax.device_get(estimator(plant, data, *jax.device_put((begin, free))))
            for begin in (start, estimate.params)
        ]
        after = np.asarray(min(ended, key=quality).residual)
        found.append(suspect(f"{word}_{channel}", after, f"--hold-input {channel}={word}"))
    sd = np.asarray(estimator.weights(plant, experiments, jax.device_put(estimate)))
    search = _Search(plant, whole, experiments, start, estimate, free, sd)
    trials = [_Trial(n, v) for n in names for v in _tried(whole, n, experiments.inputs)]
    for i, trial in enumerate(search.promising(trials), len(linear)):
        progress(f"likely causes: {trial.name}", i, total)
        value, std_error, after = search.best(trial)
        remedy, freedoms = f"--plant {plant_word}+{trial.name}", 1 + trial.name.startswith("drift_")
        named = suspect(trial.name, after, remedy, freedoms)
        unit = whole.definition.parameter(trial.name).unit
        found.append(dataclasses.replace(named, value=value, std_error=std_error, unit=unit))
    likely = [s for s in found if s.log_likelihood > 0 and s.p_value * tests <= RARE]
    return tuple(sorted(likely, key=lambda s: -s.evidence(int(valid.sum()))))


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
    ) -> None:
        d, own = whole.definition, names_of(plant.definition.states)
        self.plant, self.whole, self.estimate, self.free, self.sd = plant, whole, estimate, free, sd
        self.valid = np.asarray(experiments.valid)
        self.states = np.array([names_of(d.states).index(name) for name in own])
        initial = np.tile(np.asarray(whole.initial_state), (len(self.valid), 1))
        initial[:, self.states] = np.asarray(estimate.initial_state)
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
            if name:
                scale = self.whole.definition.parameter(name).scale
                added[lane, fields.index(name)] = points[lane, -1] * scale
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

    def promising(self, trials: Sequence[_Trial]) -> list[_Trial]:
        """The few trials that explain most if everything were linear, one for each suspect."""
        before, S = self.slopes(np.append(self.begin, 0.0), "")
        basis, _ = np.linalg.qr(S[:, :-1])
        scale = [self.whole.definition.parameter(trial.name).scale for trial in trials]
        points = [np.append(self.begin, t.value / s) for t, s in zip(trials, scale, strict=True)]
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
        """
        ends = [self.fitted(trial, own) for own in (self.begin, self.start)]
        return min(ends, key=lambda end: float(np.sum((end[2] / self.sd) ** 2)))

    def fitted(self, trial: _Trial, own: np.ndarray) -> tuple[float, float, Residual]:
        """As `best`, from one point."""
        parameter = self.whole.definition.parameter(trial.name)
        begin = np.append(own, trial.value / parameter.scale)
        lower = np.full(len(begin), -np.inf)
        lower[-1] = -np.inf if parameter.lower is None else 0.0
        both = lru_cache(1)(lambda key: self.slopes(np.frombuffer(key), trial.name))
        found = _require_least_squares()(
            lambda point: both(point.tobytes())[0],
            begin,
            jac=lambda point: both(point.tobytes())[1],
            bounds=(lower, np.inf),
            ftol=1e-6,
            max_nfev=_STEPS,
        )
        residual = np.zeros(self.valid.shape)
        residual[self.valid] = found.fun
        sd = math.sqrt(2 * found.cost / max(len(found.fun) - len(begin), 1))
        row = np.linalg.pinv(np.linalg.qr(found.jac, mode="r"))[-1]
        size = parameter.scale
        return float(found.x[-1]) * size, sd * size * float(np.linalg.norm(row)), residual * self.sd


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
    pairs = zip(_parts(before, valid), _parts(after, valid), strict=True)
    left = [sum(float(r @ r) for r in n) / sum(float(r @ r) for r in o) for o, n in pairs]
    return 1 - float(np.mean(left))


def outliers(residual: Residual, valid: np.ndarray) -> Suspect | None:
    """The suspect that the noise has heavy tails, as Student's t has; None where it has not.

    What a residual follows from its own past is no outlier.
    """
    gained, count = 0.0, 0
    for parts in _parts(residual, valid):
        r = np.concatenate(innovations(parts))
        gauss = -0.5 * len(r) * (math.log(2 * math.pi * float(np.mean(r**2))) + 1)
        gained += max(0.0, max(_student(r, freedom) for freedom in _FREEDOMS) - gauss)
        bulk = 1.4826 * float(np.median(np.abs(r - np.median(r))))
        count += int(np.sum(np.abs(r - np.median(r)) > _FAR * bulk))
    p = chi2_tail(residual.shape[2], 2 * gained)
    if p > RARE or not count:
        return None
    remedy = f"{count} samples are more than {_FAR:g} standard deviations off: --likelihood student"
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
