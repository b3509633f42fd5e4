"""What the plant's equations may leave out, when a residual is not noise.

Each suspect is one effect with one parameter. The plant with all of them is fitted once for each,
with the others switched off, all side by side. A suspect is named where it
explains more than chance; the best by the Bayesian information criterion comes first.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..description import RARE, names_of
from ..plant import AbstractPlant, Params, floats
from ..plant.extension import extended, extensions_of
from .contract import Estimate, Experiments
from .diagnosis import chi2_tail, innovations
from .nls import NLS

Residual = Float[np.ndarray, "experiment sample output"]

_STEPS = 30  # most steps of one fit
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
    stacked: Callable[[AbstractPlant, Bool[np.ndarray, " input"]], Experiments],
    linear: Bool[np.ndarray, " input"],
    estimator: NLS,
    params: Params,
    free: Bool[np.ndarray, " param"],
    plant_word: str,
) -> tuple[Suspect, ...]:
    """The suspects that explain more than chance, the likeliest first.

    Args:
        stacked: the experiments of a plant, with some inputs linear between samples.
        linear: which inputs are.
        params: estimate without suspects.
        free: which parameters were estimated.
        plant_word: the plant on the command line.
    """
    names = [name for name in extensions_of(plant) if not name.startswith("bias_")]
    whole, num_inputs = extended(plant, names), len(linear)
    neutral, all_names = _neutral(whole, params), names_of(whole.definition.parameters)
    own = [name for name, is_free in zip(params._fields, free, strict=True) if is_free]
    data = stacked(whole, np.ones(num_inputs, bool))
    trials = [_Trial("", neutral, linear)]
    for name in names:
        trials += [
            _Trial(name, neutral._replace(**{name: floats(b)}), linear)
            for b in _begins(whole, data, name)
        ]
    for i, channel in enumerate(names_of(plant.definition.inputs)):
        other = linear ^ (np.arange(num_inputs) == i)
        trials.append(_Trial(f"{'linear' if other[i] else 'constant'}_{channel}", neutral, other))
    is_free = np.array([[n in own or n == t.name for n in all_names] for t in trials])
    starts = np.array([[float(value) for value in t.start] for t in trials])
    ends = np.array([t.linear for t in trials])
    search = dataclasses.replace(estimator, num_starts=1, known=(), is_near=True, max_steps=_STEPS)
    found = jax.device_get(
        _all_fitted(search, whole, data, *jax.device_put((starts, is_free, ends)))
    )
    estimates = [jax.tree.map(lambda leaf, i=i: leaf[i], found) for i in range(len(trials))]
    valid, tests = np.asarray(data.valid), len(names) + num_inputs + 1
    before = np.asarray(estimates[0].residual)

    def suspect(
        name: str, estimate: Estimate, freedoms: int, remedy: str, index: int | None = None
    ) -> Suspect | None:
        after = np.asarray(estimate.residual)
        if not np.all(np.abs(after) < 1e100):  # the search diverged
            return None
        gained = _gained(before, after, valid, whiten=False)
        p = chi2_tail(freedoms, 2 * max(_gained(before, after, valid, whiten=True), 0.0))
        if not gained > 0 or p * tests > RARE:
            return None
        parameter = None if index is None else whole.definition.parameters[index]
        sd = math.nan if index is None else math.sqrt(max(estimate.covariance[index, index], 0.0))
        return Suspect(
            name=name,
            value=None if index is None else float(estimate.params[index]),
            std_error=None if index is None else sd,
            unit=parameter.unit if parameter else "",
            reduction=_reduction(before, after, valid),
            log_likelihood=gained,
            p_value=p,
            remedy=remedy,
        )

    best: dict[str, Estimate] = {}
    for trial, estimate in zip(trials[1:], estimates[1:], strict=True):
        best[trial.name] = min(best.get(trial.name, estimate), estimate, key=_cost)
    named = [outliers(before, valid, tests)]
    for name, estimate in best.items():
        if name in names:
            freedoms, remedy = 1 + name.startswith("drift_"), f"--plant {plant_word}+{name}"
            named.append(suspect(name, estimate, freedoms, remedy, all_names.index(name)))
        else:
            word, _, channel = name.partition("_")
            named.append(suspect(name, estimate, 1, f"--hold-input {channel}={word}"))
    likely = [s for s in named if s is not None]
    return tuple(sorted(likely, key=lambda s: -s.evidence(int(valid.sum()))))


class _Trial(NamedTuple):
    """A fit with one suspect: its name, where it starts, and which inputs are linear."""

    name: str
    start: Params
    linear: Bool[np.ndarray, " input"]


@eqx.filter_jit
def _all_fitted(
    search: NLS,
    plant: AbstractPlant,
    data: Experiments,
    starts: Float[Array, "trial param"],
    free: Bool[Array, "trial param"],
    linear: Bool[Array, "trial input"],
) -> Estimate:
    """All trials side by side; `data` has all inputs linear between samples."""

    def fitted(start: Array, free: Array, linear: Array) -> Estimate:
        ends = jnp.where(linear, data.next_inputs, data.inputs)
        own = dataclasses.replace(data, next_inputs=ends)
        return search(plant, own, plant.Params(*start), free)

    return jax.vmap(fitted)(starts, free, linear)


def _neutral(whole: AbstractPlant, params: Params) -> Params:
    """The estimate, and values of all suspects that have no effect."""
    values = {
        p.name: floats(1e6 * p.nominal if p.name.startswith("saturation_") else 0.0)
        for p in whole.definition.parameters
    }
    return whole.Params(**{**values, **params._asdict()})


def _begins(whole: AbstractPlant, experiments: Experiments, name: str) -> Sequence[float]:
    """Values of a suspect's parameter from which it is fitted."""
    parameter = next(p for p in whole.definition.parameters if p.name == name)
    kind = name.removesuffix(f"_{_channel(whole, name)}")
    if kind in ("delay", "lag"):
        dt = float(whole.dt)
        return 0.5 * dt, 3 * dt, 12 * dt
    if kind in ("saturation", "dead_zone"):
        index = names_of(whole.definition.inputs).index(_channel(whole, name))
        size = np.abs(np.asarray(experiments.inputs)[..., index])
        parts = (0.9, 0.6) if kind == "saturation" else (0.05, 0.3)
        return [part * float(size.max()) or parameter.nominal for part in parts]
    return (parameter.nominal,)


def _channel(whole: AbstractPlant, name: str) -> str:
    return next(e.channel for e in whole.extensions if e.name == name)  # pyright: ignore[reportAttributeAccessIssue]


def _cost(estimate: Estimate) -> float:
    """Sum of squares at the end of a search; infinite where it diverged."""
    cost = math.inf if estimate.costs is None else float(np.min(estimate.costs))
    return cost if math.isfinite(cost) else math.inf


def _parts(residual: Residual, valid: np.ndarray) -> list[list[np.ndarray]]:
    """Measured residuals by output and experiment."""
    return [
        [r[v, i] for r, v in zip(residual, valid[..., i], strict=True)]
        for i in range(residual.shape[2])
    ]


def _gained(before: Residual, after: Residual, valid: np.ndarray, whiten: bool) -> float:
    """Logarithm of the likelihood that a smaller residual gains; each output has its own noise.

    `whiten`: the residuals are taken as autoregressions, so that colour alone gains nothing.
    """
    gained = 0.0
    for old, new in zip(_parts(before, valid), _parts(after, valid), strict=True):
        if whiten:
            old, new = innovations(old), innovations(new)
        sums = [max(sum(float(r @ r) for r in part), 1e-300) for part in (old, new)]
        gained += 0.5 * sum(map(len, old)) * math.log(sums[0] / sums[1])
    return gained


def _reduction(before: Residual, after: Residual, valid: np.ndarray) -> float:
    """Part of the squared residuals, of each output over those before, that is gone."""
    pairs = zip(_parts(before, valid), _parts(after, valid), strict=True)
    left = [sum(float(r @ r) for r in n) / sum(float(r @ r) for r in o) for o, n in pairs]
    return 1 - float(np.mean(left))


def outliers(residual: Residual, valid: np.ndarray, tests: int = 1) -> Suspect | None:
    """The suspect that the noise has heavy tails, as Student's t has; None where it has not.

    Args:
        tests: number of suspects that are tested.
    """
    gained, count = 0.0, 0
    for parts in _parts(residual, valid):
        r = np.concatenate(parts)
        gauss = -0.5 * len(r) * (math.log(2 * math.pi * float(np.mean(r**2))) + 1)
        gained += max(0.0, max(_student(r, freedom) for freedom in _FREEDOMS) - gauss)
        bulk = 1.4826 * float(np.median(np.abs(r - np.median(r))))
        count += int(np.sum(np.abs(r - np.median(r)) > _FAR * bulk))
    p = chi2_tail(residual.shape[2], 2 * gained)
    if p * tests > RARE or not count:
        return None
    remedy = f"{count} samples are more than {_FAR:g} standard deviations off: leave them empty"
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
