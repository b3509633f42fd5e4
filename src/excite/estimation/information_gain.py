"""Expected information gain: what an experiment is expected to tell of the parameters, in nats.

The gain is the mean, over plants drawn from a prior and over their records h, of

    log p(h | theta) - log p(h),

the mutual information of parameters and record (D. Lindley, On a measure of the information
provided by an experiment, 1956). The evidence p(h) is an average over the prior, and is found by
sampling. With samples from the prior, the true parameters among them or not, the estimate is a
lower or an upper bound (sequential prior-contrastive estimation, and nested Monte Carlo; A. Foster
et al., Deep adaptive design, 2021). These bounds are loose where the gain is near the logarithm of
the number of samples, which the lower one cannot exceed. Samples from a distribution near the
posterior, found from the record alone, bring both close together (A. Foster et al., A unified
stochastic gradient approach to designing Bayesian-optimal experiments, 2020).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from ..description import LARGEST_SEED, SpreadLike, require_whole, wrong_type
from ..excitation import AbstractExcitation
from ..excitation.catalogue import ExcitationLike
from ..information import require_bound
from ..plant.catalogue import PlantLike, plant_from, with_sensor
from ..plant.static import AbstractStaticTask, has_own_noise
from ..progress import SHOWN, Progress
from ..report.tables import html_table, text_table
from ..safety import safe_input
from ..simulation import DivergedError, Experiment, Trajectory, predicted, run_episode
from .evidence import Fit, nearest
from .myopic import MYOPIC, Myopic, posterior_particles
from .prior import PriorPlants
from .prior_knowledge import PriorLike, plants_of

_STEPS, _STARTS, _SIDE_BY_SIDE = 30, 16, 8  # of the searches for probable parameters
_WIDE, _SHARES = 2.0, (0.5, 0.375, 0.125)  # of the proposal: normal, a wider one, the prior
_PARTICLES, _MOVES = 1000, 5  # of the posterior of a task with its own noise
_ENDS, _PART = 200, 0.5  # of these in the proposal, and the deviation of each, in that of all
_AT_A_TIME = {True: (16, 1000), False: (256, 20_000)}  # records and samples, on a CPU or not
_NEAR_CAP = 1.0  # nats below the largest value of a lower bound, at which it says little
_FEW = 10.0  # effective samples


class Gains(eqx.Module):
    """The gain of each of some records.

    Attributes:
        laplace: Kullback-Leibler divergence of the posterior's normal approximation from the
            prior; an estimate, no bound.
        lower, upper: differences whose means bound the expected gain.
        effective: number of effective samples of the evidence.
        changes: sum of the squared changes of the input, the first from rest [input unit²].
        controls: functions of the true parameters whose mean is zero.
    """

    laplace: Float[Array, "*record"]
    lower: Float[Array, "*record"]
    upper: Float[Array, "*record"]
    effective: Float[Array, "*record"]
    changes: Float[Array, "*record"]
    controls: Float[Array, "*record control"]


class _Near(eqx.Module):
    """Normal distributions near a posterior, in coordinates in which the prior is standard normal.

    Attributes:
        ends: their centres.
        information: inverses of their covariances.
        log_dets: logarithms of the determinants of these.
        modes: logarithm of the share of each.
        laplace: see `Gains`.
    """

    ends: Float[Array, "end param"]
    information: Float[Array, "end param param"]
    log_dets: Float[Array, " end"]
    modes: Float[Array, " end"]
    laplace: Float[Array, ""]


def _divergence(center: Array, covariance: Array, log_det: Array) -> Array:
    """Of a normal distribution from the prior; `log_det` is that of its information."""
    return 0.5 * (jnp.trace(covariance) + center @ center - len(center) + log_det)


def _near_modes(
    residual: Callable[[Float[Array, " param"]], Float[Array, " value"]],
    log_likelihood: Callable[[Float[Array, " param"]], Float[Array, ""]],
    drawn: Float[Array, "draw param"],
) -> _Near:
    """At the most probable parameters, from several starts: the likeliest of the prior.

    A search that ended where the outputs are not finite is left out.
    """
    count = drawn.shape[1]
    unknown = Fit(jnp.zeros(count), jnp.eye(count), jnp.zeros(()), jnp.zeros(()))
    likely = jax.lax.top_k(jax.lax.map(log_likelihood, drawn, batch_size=64), _STARTS - 1)[1]
    starts = jnp.concatenate([unknown.z[None], drawn[likely]])
    search = partial(nearest, residual, unknown, num_steps=_STEPS)
    ends, costs = jax.lax.map(search, starts, batch_size=_SIDE_BY_SIDE)
    S = jax.vmap(jax.jacfwd(residual))(ends)
    is_sound = jnp.isfinite(costs) & jnp.all(jnp.isfinite(S), axis=(1, 2))
    ends = jnp.where(is_sound[:, None], ends, 0.0)
    S = jnp.where(is_sound[:, None, None], S, 0.0)
    costs = jnp.where(is_sound, costs, jnp.inf)
    best = jnp.argmin(costs)
    information = jnp.einsum("eoi,eoj->eij", S, S) + unknown.information[None]
    log_dets = jnp.linalg.slogdet(information)[1]
    laplace = _divergence(ends[best], jnp.linalg.inv(information[best]), log_dets[best])
    # Flatter than the posterior's shares: a small mode costs few samples, a missed one the sum.
    modes = jax.nn.log_softmax(-0.25 * (costs + log_dets))
    return _Near(ends, information, log_dets, modes, laplace)


def _near_particles(prior: PriorPlants, run: Trajectory, key: PRNGKeyArray) -> _Near:
    """At particles of the posterior of a static task, each with a part of their covariance."""
    z = posterior_particles(prior, run.inputs, run.measured[1:], _PARTICLES, _MOVES, key)
    covariance = jnp.cov(z.T).reshape(2 * z.shape[1:])
    information = jnp.linalg.inv(covariance)
    log_det = jnp.linalg.slogdet(information)[1]
    laplace = _divergence(jnp.mean(z, axis=0), covariance, log_det)
    ends = z[:: _PARTICLES // _ENDS]
    shape = (len(ends),)
    own = jnp.broadcast_to(information / _PART**2, shape + information.shape)
    log_dets = jnp.full(shape, log_det - 2 * z.shape[1] * math.log(_PART))
    return _Near(ends, own, log_dets, jnp.full(shape, -math.log(len(ends))), laplace)


@eqx.filter_jit
def gains(
    prior: PriorPlants,
    excitation: AbstractExcitation,
    num_steps: int,
    keys: Key[Array, " record"],
    num_samples: int,
    from_prior: bool,
) -> Gains:
    """The gain of one record for each key.

    Args:
        prior: from which the true plants are drawn, with the sensor of the experiment.
        excitation: proposes the inputs.
        num_steps: of the experiment.
        keys: of plants, noise and samples.
        num_samples: of the evidence of each record.
        from_prior: whether these are drawn from the prior, not near the posterior.
    """
    plant = prior.plant
    count = len(plant.nominal)
    chunk, block_size = _at_a_time()
    size = min(num_samples, block_size)

    def of(key: PRNGKeyArray) -> Gains:
        true_key, run_key, start_key, sample_key = jax.random.split(key, 4)
        true = jax.random.normal(true_key, (count,), float)
        run = run_episode(plant, prior.params(true), excitation, num_steps, run_key)

        def residual(z: Array) -> Array:
            outputs, sd = predicted(plant, prior.params(z), run.inputs, run.measured)
            return ((run.measured - outputs) / sd[None]).ravel()

        def log_likelihood(z: Array) -> Array:
            if isinstance(plant, AbstractStaticTask):
                params = prior.params(z)
                own = jax.vmap(lambda *made: plant.log_likelihood(*made, params))
                found = jnp.sum(own(run.measured[1:], run.inputs))
            else:
                found = -0.5 * jnp.sum(residual(z) ** 2)
            return jnp.where(jnp.isfinite(found), found, -jnp.inf)

        if has_own_noise(plant):
            near = _near_particles(prior, run, start_key)
        else:
            drawn = jax.random.normal(start_key, (max(size, _STARTS), count), float)
            near = _near_modes(residual, log_likelihood, drawn)
        ends, information, log_dets, modes = near.ends, near.information, near.log_dets, near.modes
        roots = jnp.linalg.cholesky(jnp.linalg.inv(information))

        def log_proposal(z: Array) -> Array:
            change = z[None] - ends
            forms, sizes = jnp.einsum("ei,eij,ej->e", change, information, change), 0.5 * log_dets
            parts = jnp.stack(
                [
                    jax.nn.logsumexp(modes + sizes - 0.5 * forms),
                    jax.nn.logsumexp(modes + sizes - 0.5 * forms / _WIDE**2)
                    - count * math.log(_WIDE),
                    -0.5 * z @ z,
                ]
            )
            return jax.nn.logsumexp(parts, b=jnp.array(_SHARES))

        def log_weight(z: Array) -> Array:
            if from_prior:
                return log_likelihood(z)
            return log_likelihood(z) - 0.5 * z @ z - log_proposal(z)

        def samples(key: PRNGKeyArray) -> Array:
            kind_key, value_key = jax.random.split(key)
            z = jax.random.normal(value_key, (size, count), float)
            if from_prior:
                return z
            kind = jax.random.choice(kind_key, 3, (size,), p=jnp.array(_SHARES))
            mode = jax.random.categorical(jax.random.fold_in(kind_key, 1), modes, shape=(size,))
            far = jnp.where(kind == 1, _WIDE, 1.0)[:, None]
            about = ends[mode] + far * jnp.einsum("sij,sj->si", roots[mode], z)
            return jnp.where((kind == 2)[:, None], z, about)

        def block(carry: tuple[Array, Array], key: PRNGKeyArray) -> tuple[tuple, None]:
            weights = jax.vmap(log_weight)(samples(key))
            total = jnp.logaddexp(carry[0], jax.nn.logsumexp(weights))
            squares = jnp.logaddexp(carry[1], jax.nn.logsumexp(2 * weights))
            return (total, squares), None

        blocks = jax.random.split(sample_key, -(-num_samples // size))
        nothing = jnp.asarray(-jnp.inf)
        (total, squares), _ = jax.lax.scan(block, (nothing, nothing), blocks)
        number, own = len(blocks) * size, log_likelihood(true)
        with_own = jnp.logaddexp(total, log_weight(true))
        lower = own - (with_own - math.log(number + 1))
        upper = own - (total - math.log(number))
        rest = jnp.asarray(safe_input(plant.definition))
        steps = jnp.diff(jnp.concatenate([rest[None], run.inputs]), axis=0)
        controls = jnp.concatenate([true, true**2 - 1])
        effective = jnp.exp(2 * total - squares)
        return Gains(near.laplace, lower, upper, effective, jnp.sum(steps**2), controls)

    return jax.lax.map(of, keys, batch_size=chunk)


def _at_a_time() -> tuple[int, int]:
    """Records, and samples of each, that are computed side by side."""
    return _AT_A_TIME[jax.default_backend() == "cpu"]


@dataclass(frozen=True)
class Mean:
    """A mean and its standard error."""

    value: float
    std_error: float

    @classmethod
    def of(
        cls, values: Float[np.ndarray, " record"], controls: Float[np.ndarray, "record control"]
    ) -> Mean:
        """Of some independent values.

        Args:
            controls: of mean zero; what of the values is linear in them is no error (control
                variates; R. Rubinstein, D. Kroese, Simulation and the Monte Carlo Method, 2017,
                section 5.2). Few values go without.
        """
        count, width = controls.shape
        X = np.ones((count, 1))
        if count > 10 * width:
            X = np.column_stack([X, controls])
        found, *_ = np.linalg.lstsq(X, values)
        rest = values - X @ found
        variance = rest @ rest / max(count - X.shape[1], 1)
        return cls(float(found[0]), math.sqrt(variance * np.linalg.inv(X.T @ X)[0, 0]))

    def __str__(self) -> str:
        return f"{self.value:.3f} ± {self.std_error:.3f}"


@dataclass(frozen=True, repr=False)
class InformationGain:
    """What an experiment is expected to tell of the parameters; the result of `information_gain`.

    Attributes:
        plant, excitation: their names.
        num_steps: of the experiment.
        prior: of the parameters, in words.
        lower, upper: bounds on the expected gain, each with its standard error [nats].
        laplace: the same by normal approximations of the posteriors: an estimate, no bound; exact
            where the records are linear in the parameters and their prior is normal.
        changes: mean sum of the squared changes of the input, the first from rest [input unit²].
        num_plants, num_samples: plants with a record each, and samples of each evidence.
        from_prior: whether the samples were drawn from the prior.
        few: records whose evidence has fewer than 10 effective samples.
        warnings: sentences on the bounds, and on the policy.
    """

    plant: str
    excitation: str
    num_steps: int
    prior: str
    lower: Mean
    upper: Mean
    laplace: Mean
    changes: Mean
    num_plants: int
    num_samples: int
    from_prior: bool
    few: int
    warnings: tuple[str, ...]

    header = ("", "nats", "standard error")

    def rows(self) -> list[list[str]]:
        """Rows of the table."""
        kind = "prior" if self.from_prior else "near the posterior"
        about = f"{self.num_samples} samples, {kind}"
        given = {f"lower bound, {about}": self.lower, f"upper bound, {about}": self.upper,
                 "by normal approximations": self.laplace}  # fmt: skip
        given["squared changes of the input, summed"] = self.changes
        return [[n, f"{m.value:.3f}", f"{m.std_error:.3f}"] for n, m in given.items()]

    @property
    def title(self) -> str:
        """Of the table."""
        return (
            f"{self.plant}, {self.excitation}, {self.num_steps} steps: expected information gain, "
            f"prior {self.prior}, {self.num_plants} plants"
        )

    def __repr__(self) -> str:
        """The table that `excite gain` prints."""
        return text_table(self.title, self.header, self.rows()).rstrip("\n")

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        return html_table(self.title, self.header, self.rows())

    def to_dict(self) -> dict[str, Any]:
        """The result as JSON-ready data."""
        means = {name: getattr(self, name) for name in ("lower", "upper", "laplace")}
        return {
            **{name: getattr(self, name) for name in ("plant", "excitation", "num_steps", "prior")},
            **{name: {"nats": m.value, "std_error": m.std_error} for name, m in means.items()},
            "input_changes": {"value": self.changes.value, "std_error": self.changes.std_error},
            **{name: getattr(self, name) for name in ("num_plants", "num_samples", "from_prior")},
            "few_effective_samples": self.few,
            "warnings": list(self.warnings),
        }


def information_gain(
    plant: PlantLike,
    excitation: ExcitationLike | None = None,
    *,
    options: Mapping[str, object] | None = None,
    steps: int | None = None,
    prior: PriorLike | Sequence[PriorLike] | None = None,
    spread: SpreadLike = 0.3,
    noise: Mapping[str, float] | None = None,
    resolution: Mapping[str, float] | None = None,
    plants: int = 256,
    samples: int = 1000,
    from_prior: bool = False,
    seed: int = 0,
    progress: Progress = SHOWN,
) -> InformationGain:
    """What an experiment is expected to tell of the parameters, in nats.

        >>> import excite as ex
        >>> found = ex.information_gain("aero2", steps=60, spread=0.3, plants=16, samples=200)
        >>> found.lower.value > 1
        True

    Args:
        plant: as for `simulate`, and so are `excitation`, `options`, `steps`, `noise` and
            `resolution`. An encoder's step counts as noise of its own standard deviation. For a
            static task, the excitation `myopic` is `Myopic` for the prior.
        prior: distributions of parameters, as for `identify`, or an earlier run.
        spread: of parameters without such a distribution: uniform, in the logarithm for a factor
            (`factor:3`).
        plants: that are drawn, each with a record.
        samples: of the evidence of each record; many are rounded up to whole blocks of 1,000, on
            an accelerator 20,000.
        from_prior: draws these samples from the prior: the usual figure of benchmarks, which
            can only be compared for the same number of samples.
        seed: of plants, noise and samples, which are other ones on an accelerator.
        progress: called with a text, how much is done, and the total.

    A plant with process noise is judged where its state is observed: its records then have the
    likelihood of their transitions.

    Raises:
        ValueError: as `simulate`, for a sensor without noise, for process noise of a state that is
            not observed, where a plant of the prior has outputs that are not finite.
        TypeError: for an argument of another type.
    """
    require_whole("plants", plants, 2, 1_000_000)
    require_whole("samples", samples, 1, 100_000_000)
    require_whole("seed", seed, 0, LARGEST_SEED)
    if not isinstance(from_prior, bool):
        raise wrong_type("from_prior", from_prior, "True or False")
    if isinstance(excitation, str) and excitation == MYOPIC:
        excitation = Myopic.of(with_sensor(plant_from(plant), noise, resolution), prior, spread)
    e = Experiment.of(
        plant, excitation, options=options, steps=steps, noise=noise, resolution=resolution,
        seed=seed,
    )  # fmt: skip
    if not has_own_noise(e.plant):
        require_bound(e.plant)
    population = plants_of(e.plant, prior, spread)
    keys = jax.random.split(jax.random.key(seed), plants)
    parts = []
    chunk, block = _at_a_time()
    for first in range(0, plants, 4 * chunk):
        progress(f"{first} of {plants} plants", first, plants)
        own = keys[first : first + 4 * chunk]
        parts.append(gains(population, e.excitation, e.num_steps, own, samples, from_prior))
    progress("done", plants, plants)
    found = jax.tree.map(lambda *rows: np.concatenate([np.asarray(r) for r in rows]), *parts)
    number = -(-samples // min(samples, block)) * min(samples, block)
    bad = np.flatnonzero(~np.isfinite(found.lower) | ~np.isfinite(found.laplace))
    if bad.size:
        true = population.params(jnp.asarray(found.controls[bad[0], : len(e.plant.nominal)]))
        first = ", ".join(f"{name} = {float(value):.4g}" for name, value in true._asdict().items())
        raise DivergedError(
            f"{bad.size} of {plants} experiments have outputs or a likelihood that are not finite, "
            f"the first with {first}: take a narrower prior, or a plant that is defined there"
        )
    lower, upper, laplace, changes = (
        Mean.of(v, found.controls) for v in (found.lower, found.upper, found.laplace, found.changes)
    )
    few = int(np.sum(~(found.effective >= _FEW)))  # NaN, too
    warnings = list(e.warnings)
    coarse = np.asarray(e.plant.sensor.resolution) > 2 * np.asarray(e.plant.sensor.noise_sd)
    if not has_own_noise(e.plant) and coarse.any():
        warnings.append(
            "an encoder's step is more than twice the noise: rounding counts as normal noise, so "
            "that neither bound holds strictly"
        )
    if from_prior and lower.value > math.log(number + 1) - _NEAR_CAP:
        warnings.append(
            f"the lower bound is near its largest value, log({number} + 1) = "
            f"{math.log(number + 1):.2f}: take more samples"
        )
    if few:
        warnings.append(
            f"the evidence of {few} of {plants} records has fewer than {_FEW:g} effective samples"
        )
    return InformationGain(
        plant=e.plant.definition.name,
        excitation=e.name,
        num_steps=e.num_steps,
        prior=str(population),
        lower=lower,
        upper=upper,
        laplace=laplace,
        changes=changes,
        num_plants=plants,
        num_samples=number,
        from_prior=from_prior,
        few=few,
        warnings=tuple(warnings),
    )
