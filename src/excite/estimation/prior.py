"""What is known of parameters before the records are seen.

A normal distribution of some parameters, or of their logarithms, adds a weighted sum of squares to
that of the residual; the estimate is then the most probable one (maximum a posteriori; L. Ljung,
System Identification, 2nd ed., section 7.4). A uniform distribution bounds the search.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Float, PRNGKeyArray

from ..description import RARE, Parameter, Spread, names_of
from ..information import relative_size
from ..plant import AbstractPlant, Params
from .diagnosis import chi2_tail

_CONTRADICTED = "the data contradict the prior of {}"
_LITTLE = 0.9  # of a prior's standard deviation; data that leave more of it tell little


class Prior(eqx.Module):
    """A normal distribution of some parameters, or of their logarithms.

        >>> prior = Prior.normal(["J_p", "D_p"], [0.022, 0.007], [[1e-6, 0.0], [0.0, 1e-6]])
        >>> prior.names
        ('J_p', 'D_p')

    Attributes:
        names: of the parameters.
        logarithmic: whether it is the logarithm that is normal.
        mean: of the parameters or of their logarithms.
        root: W with W' W the inverse of their covariance.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    mean: Float[Array, " part"]
    root: Float[Array, "row part"]

    @classmethod
    def normal(
        cls,
        names: Sequence[str],
        mean: Sequence[float] | Float[np.ndarray, " part"],
        covariance: Sequence[Sequence[float]] | Float[np.ndarray, "part part"],
        logarithmic: Sequence[bool] | None = None,
    ) -> Prior:
        """A joint distribution; ValueError where its covariance is not positive definite."""
        center, spread = np.asarray(mean, float), np.asarray(covariance, float)
        expected = f"{len(names)} numbers and {len(names)} x {len(names)} covariances"
        if center.shape != (len(names),) or spread.shape != (len(names), len(names)):
            raise ValueError(
                f"the prior of {', '.join(names)} needs {expected}: got shapes {center.shape} and "
                f"{spread.shape}"
            )
        size = np.sqrt(np.maximum(np.diag(spread), 0.0))
        is_sound = np.isfinite(center).all() and np.isfinite(spread).all() and np.all(size > 0)
        if not (is_sound and np.allclose(spread, spread.T, rtol=1e-6, atol=0)):
            raise ValueError(
                f"the prior of {', '.join(names)} must be finite, its covariance symmetric with "
                "variances above 0"
            )
        correlation = spread / np.outer(size, size)
        if np.linalg.eigvalsh(correlation)[0] < 1e-12:
            raise ValueError(
                f"the covariance of the prior of {', '.join(names)} is not positive definite"
            )
        root = np.linalg.cholesky(np.linalg.inv(correlation)).T / size
        kinds = tuple(map(bool, logarithmic or [False] * len(names)))
        return cls(tuple(names), kinds, jax.device_put(center), jax.device_put(root))

    @classmethod
    def joined(cls, priors: Sequence[Prior]) -> Prior:
        """Independent priors of different parameters as one."""
        return cls(
            tuple(name for prior in priors for name in prior.names),
            tuple(kind for prior in priors for kind in prior.logarithmic),
            jax.device_put(np.concatenate([prior.mean for prior in priors])),
            jax.scipy.linalg.block_diag(*[prior.root for prior in priors]),
        )

    @classmethod
    def product(cls, priors: Sequence[Prior]) -> Prior:
        """Distributions of independent records as one; of one of them, itself.

        Raises:
            ValueError: where they contradict each other.
        """
        if len(priors) == 1:
            return priors[0]
        names = tuple(dict.fromkeys(name for prior in priors for name in prior.names))
        kinds: dict[str, bool] = {}
        for prior in priors:
            for name, kind in zip(prior.names, prior.logarithmic, strict=True):
                if kinds.setdefault(name, kind) != kind:
                    raise ValueError(f"{name} has a normal and a lognormal distribution: give one")
        rows, means = [], []
        for prior in priors:
            root, place = np.asarray(prior.root), [names.index(name) for name in prior.names]
            row = np.zeros((len(root), len(names)))
            row[:, place] = root
            rows.append(row)
            means.append(root @ np.asarray(prior.mean))
        W, v = np.concatenate(rows), np.concatenate(means)
        size = np.linalg.norm(W, axis=0)
        mean = np.linalg.lstsq(W / size[None], v)[0] / size
        more = len(v) - len(names)
        if more and chi2_tail(more, float(np.sum((W @ mean - v) ** 2))) < RARE:
            raise ValueError(
                "the results contradict each other: their estimates differ by more than their "
                "errors; identify their records together"
            )
        root = np.linalg.qr(W, mode="r")
        return cls(
            names, tuple(kinds[n] for n in names), jax.device_put(mean), jax.device_put(root)
        )

    def residual(
        self, description_names: Sequence[str], values: Float[Array, " param"]
    ) -> Float[Array, " row"]:
        """Distance from the mean in standard deviations, uncorrelated."""
        own = values[np.array([description_names.index(name) for name in self.names])]
        is_log = np.array(self.logarithmic)
        logarithm = jnp.log(jnp.where(is_log, own, 1.0))
        return self.root @ (jnp.where(is_log, logarithm, own) - self.mean)

    def center(self) -> dict[str, float]:
        """The mean of each parameter, or the median where its logarithm is normal."""
        parts = zip(self.names, self.logarithmic, np.asarray(self.mean).tolist(), strict=True)
        return {name: math.exp(mean) if is_log else mean for name, is_log, mean in parts}

    def reach(self) -> dict[str, tuple[float, float]]:
        """By parameter, values beyond which it lies less often than once in 30,000 on each side."""
        sd = 4 * np.linalg.norm(np.linalg.inv(np.asarray(self.root)), axis=1)
        ends = np.stack([np.asarray(self.mean) - sd, np.asarray(self.mean) + sd], axis=1)
        with np.errstate(over="ignore"):
            ends = np.where(np.array(self.logarithmic)[:, None], np.exp(ends), ends)
        return {name: (own[0], own[1]) for name, own in zip(self.names, ends.tolist(), strict=True)}

    def chances(
        self, values: Mapping[str, float], sd: Mapping[str, float], includes_prior: bool = True
    ) -> dict[str, float]:
        """Of each parameter, how probable data are that move it as far, if the prior is right.

        Args:
            values: estimated parameters.
            sd: standard error, for white noise, of those that are not held.
            includes_prior: whether the estimate was made with this prior.
        """
        found, inverse = {}, np.linalg.inv(np.asarray(self.root))
        for name, is_log, mean, spread in zip(
            self.names, self.logarithmic, self.mean, np.linalg.norm(inverse, axis=1), strict=True
        ):
            if name not in sd:
                continue
            after = sd[name] / (values[name] if is_log else 1.0)
            moved = (math.log(values[name]) if is_log else values[name]) - float(mean)
            # The variance of what the data move is the prior's less the estimate's.
            variance = spread**2 + (-1 if includes_prior else 1) * after**2
            found[name] = chi2_tail(1, moved**2 / variance) if variance > 0 else 1.0
        return found

    def verdict(self, values: Mapping[str, float], sd: Mapping[str, float]) -> tuple[str, ...]:
        """Sentences where the data contradict the prior, or tell little beyond it.

        Args:
            values: estimated parameters.
            sd: standard error, for white noise, of those that are not held.
        """
        told, spread = [], np.linalg.norm(np.linalg.inv(np.asarray(self.root)), axis=1)
        for name, chance in self.chances(values, sd).items():
            index = self.names.index(name)
            after = sd[name] / (values[name] if self.logarithmic[index] else 1.0)
            if chance < RARE:
                told.append(_CONTRADICTED.format(name))
            elif after > _LITTLE * spread[index]:
                told.append(
                    f"the estimate of {name} is that of its prior; the data hardly change it"
                )
        return tuple(told)


class PriorPlants(eqx.Module):
    """Parameters as functions of independent standard normal coordinates z.

    Attributes:
        plant: has the parameters.
        normal: distribution of some parameters, or of their logarithms; None for none.
        spread: of the others, which are uniform in their box.
        ranges: name, lowest and highest value of parameters that are uniform between these.
    """

    plant: AbstractPlant
    normal: Prior | None
    spread: Spread = eqx.field(static=True)
    ranges: tuple[tuple[str, float, float], ...] = eqx.field(static=True, default=())

    def __str__(self) -> str:
        """The distributions in words."""
        given: dict[str, list[str]] = {}
        if (normal := self.normal) is not None:
            for name, is_log in zip(normal.names, normal.logarithmic, strict=True):
                given.setdefault("lognormal" if is_log else "normal", []).append(name)
        if self.ranges:
            given["uniform"] = [name for name, *_ in self.ranges]
        words = [f"{kind} in {', '.join(names)}" for kind, names in given.items()]
        count = sum(map(len, given.values()))
        others = "others " * bool(count) + str(self.spread)
        return ", ".join([*words, *([others] if count < len(self.plant.nominal) else [])])

    def draw(self, key: PRNGKeyArray) -> Params:
        """The parameters of a plant drawn from the prior."""
        return self.params(jax.random.normal(key, (len(self.plant.nominal),), float))

    def changes(self, params: Params) -> Float[Array, "param param"]:
        """Changes of the parameters, by row, by a standard deviation of each coordinate.

        That of a uniform distribution is its width over the root of twelve, everywhere. A parameter
        that is known does not change.
        """
        names = names_of(self.plant.definition.parameters)
        spread = jnp.eye(len(names)) * (self.spread.relative / math.sqrt(3))
        changes = spread * relative_size(self.plant, params)[:, None]
        for name, low, high in self.ranges:
            i = names.index(name)
            changes = changes.at[i, i].set((high - low) / math.sqrt(12))
        if (normal := self.normal) is not None:
            index = np.array([names.index(name) for name in normal.names])
            size = jnp.where(np.array(normal.logarithmic), jnp.stack(params)[index], 1.0)
            inverse = jnp.linalg.inv(normal.root) * size[:, None]
            changes = changes.at[np.ix_(index, index)].set(inverse)
        return changes

    def params(self, z: Float[Array, " param"]) -> Params:
        """The parameters at some coordinates, in their units."""
        d, values = self.plant.definition, {}
        names = () if self.normal is None else self.normal.names
        if self.normal is not None:
            index = np.array([names_of(d.parameters).index(name) for name in names])
            drawn = self.normal.mean + jnp.linalg.inv(self.normal.root) @ z[index]
            parts = zip(names, self.normal.logarithmic, drawn, strict=True)
            values = {n: jnp.exp(v) if is_log else v for n, is_log, v in parts}
        for name, low, high in self.ranges:
            values[name] = low + (high - low) * ndtr(z[names_of(d.parameters).index(name)])
        for i, parameter in enumerate(d.parameters):
            if parameter.name not in values:
                unit, nominal = 2 * ndtr(z[i]) - 1, self.plant.nominal[i]
                values[parameter.name] = self.spread.value(parameter, nominal, unit)
        return self.plant.Params(**values)

    def coordinates(self, params: Params) -> Float[Array, " param"]:
        """The coordinates of some parameters: the inverse of `params`; zero for a fixed one."""
        d, values = self.plant.definition, {}
        if self.normal is not None:
            own = self.normal.residual(names_of(d.parameters), jnp.stack(params))
            values = dict(zip(self.normal.names, own, strict=True))
        for name, low, high in self.ranges:
            values[name] = ndtri((getattr(params, name) - low) / (high - low))
        for parameter, nominal in zip(d.parameters, self.plant.nominal, strict=True):
            if parameter.name not in values:
                own = getattr(params, parameter.name)
                is_log = self.spread.is_factor and parameter.positive
                change = jnp.log(own / nominal) if is_log else (own - nominal) / parameter.scale
                unit = change / self.spread.relative if self.spread.relative else 0 * change
                values[parameter.name] = ndtri((1 + unit) / 2)
        return jnp.stack([values[name] for name in names_of(d.parameters)])


def bounded(
    plant: AbstractPlant, bounds: Sequence[tuple[str, float, float]], start: Params
) -> AbstractPlant:
    """The plant with bounds of parameters; ValueError where they exclude the start."""
    if not bounds:
        return plant
    for name, lower, upper in bounds:
        part, value = plant.definition.parameter(name), float(getattr(start, name))
        if not lower < value < upper:
            raise ValueError(
                f"the search begins at {name} = {value:g} {part.unit}, outside its uniform prior "
                f"{lower:g} to {upper:g}; give a start inside it ({name}={(lower + upper) / 2:g})"
            )
    begin = tuple(float(getattr(start, name)) for name, *_ in bounds)
    return plant.as_class(_narrowed(type(plant), tuple(bounds), begin))


@cache
def _narrowed(
    kind: type[AbstractPlant],
    limits: tuple[tuple[str, float, float], ...],
    begin: tuple[float, ...],
) -> type[AbstractPlant]:
    """The class of a plant with bounds inside its own, and nominal values inside the bounds."""
    d, by_name = kind.definition, {name: pair for name, *pair in limits}
    nominal = dict(zip(by_name, begin, strict=True))

    def within(part: Parameter) -> Parameter:
        if part.name not in by_name:
            return part
        (low, high), (least, most) = by_name[part.name], part.support
        lower = None if part.positive and max(low, least) == 0 else max(low, least)
        usual = part.nominal if low < part.nominal < high else nominal[part.name]
        return dataclasses.replace(part, lower=lower, upper=min(high, most), nominal=usual)

    narrow = dataclasses.replace(d, parameters=tuple(map(within, d.parameters)))
    own = {"definition": narrow, "uniform": tuple(by_name), "unbounded": kind}
    return type(kind.__name__, (kind,), {**own, "__module__": kind.__module__})


def unbounded(plant: AbstractPlant) -> AbstractPlant:
    """The plant without the bounds of uniform priors."""
    return plant.as_class(getattr(plant, "unbounded", type(plant)))


def within_support(
    plant: AbstractPlant, ends: Float[np.ndarray, "param end"]
) -> Float[np.ndarray, "param end"]:
    """Ends of intervals, not beyond the bounds of a parameter or its uniform prior."""
    allowed = np.array([p.support for p in plant.definition.parameters])
    return np.clip(ends, allowed[:, :1], allowed[:, 1:])


def uniform_names(plant: AbstractPlant) -> tuple[str, ...]:
    """Parameters that have a uniform prior."""
    return getattr(plant, "uniform", ())
