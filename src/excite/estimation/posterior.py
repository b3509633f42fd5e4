"""Posterior samples of the parameters of a least-squares estimate.

The likelihood is that of `NLS`: every output is the simulated one plus independent Gaussian noise.
Where `identify` was given no prior, it is flat in the logarithms of positive parameters, from
exp(-30) to exp(30) times the nominal value, flat in other parameters and in initial states, and
1/sd in the standard deviation of noise of unknown size. For a plant that is linear in its
parameters the posterior of a parameter of free sign is then Student's t, with the degrees of
freedom of its interval.

The standard deviations are integrated out and drawn afterwards (A. Gelman et al., Bayesian Data
Analysis, 3rd ed. 2013, section 14.2). The rest is drawn by the no-U-turn sampler (M. Hoffman and
A. Gelman, "The no-U-turn sampler", Journal of Machine Learning Research 15, 2014) in coordinates in
which the normal approximation at the estimate has unit covariance; only its step size is adapted.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray

try:
    import arviz_stats
    import blackjax
    import h5netcdf  # writes the samples
    import xarray
    from blackjax.adaptation.step_size import dual_averaging_adaptation
except ImportError:
    xarray: Any = None
    arviz_stats = blackjax = h5netcdf = dual_averaging_adaptation = xarray

from .. import __version__
from ..description import names_of
from ..information import relative_size
from .contract import Basis, residual_of, simulate_experiments
from .nls import FAR, NLS, Problem
from .prior import unbounded, uniform_names

if TYPE_CHECKING:
    from xarray import DataTree

_WARM_UP, _BLOCK, _BATCH = 200, 50, 50  # draws before those kept, in one call, simulated at once
_ACCEPTANCE = 0.8  # mean acceptance that the step size is adapted to
_SEEN = 1e-6  # of the best seen direction's size; initial states seen less are held
_MOST_VALUES = 10_000_000  # of the log likelihood that are kept
_CONVERGED, _ENOUGH = 1.01, 100  # largest rhat, least effective sample size for each chain


def require_extra() -> None:
    """Raises ValueError where the packages of the extra `bayes` are not installed."""
    if xarray is None:
        raise ValueError("posterior samples need the extra: pip install 'excite[bayes]'")


class Density(eqx.Module):
    """Logarithm of the posterior density, without the noise's standard deviations.

    The coordinates x are the search coordinates of the parameters, standard scores of the
    logarithms of uncertain constants, and the initial states that are estimated over their scale;
    x = centre + spread w.

    Attributes:
        problem: plant, experiments, and which parameters are free.
        known_sd: of the noise; None where it is unknown.
        uncertain: names of constants with a standard deviation.
        constants: value and standard deviation of each.
        centre: the estimate.
        spread: a root of the covariance; no column for what is held.
    """

    problem: Problem
    known_sd: Float[Array, " output"] | None
    uncertain: tuple[str, ...] = eqx.field(static=True)
    constants: Float[Array, "constant 2"]
    centre: Float[Array, " coordinate"]
    spread: Float[Array, "coordinate unknown"]

    @classmethod
    def of(cls, basis: Basis) -> Density:
        """The density around an estimate."""
        plant, estimate = basis.plant, jax.device_put(basis.estimate)
        own = basis.estimator if isinstance(basis.estimator, NLS) else NLS()
        free, is_known = jax.device_put(basis.free), own.noise == "known"
        problem = Problem(plant, basis.experiments, estimate.params, free, own.prior)
        sd = problem.assumed_sd if is_known else problem.noise_sd(estimate.residual)
        pairs = [
            (name, float(value), spread)
            for (name, value), spread in zip(
                plant.constants._asdict().items(), basis.uncertain.tolist(), strict=True
            )
            if spread
        ]
        known_state = basis.experiments.initial_state_known
        starts = estimate.initial_state / problem.state_scales[None]
        parts = [problem.start, jnp.zeros(len(pairs)), jnp.zeros(0) if known_state else starts]
        centre = jnp.concatenate([part.ravel() for part in parts])
        density = cls(
            problem,
            sd if is_known else None,
            tuple(name for name, *_ in pairs),
            jnp.asarray([pair[1:] for pair in pairs]).reshape(-1, 2),
            centre,
            jnp.eye(len(centre)),
        )
        rows = np.asarray(density.sensitivity(sd))
        return dataclasses.replace(density, spread=jax.device_put(_root(rows)))

    @eqx.filter_jit
    def sensitivity(self, sd: Float[Array, " output"]) -> Float[Array, "row coordinate"]:
        """Derivative of the residual over its sd, and of the prior's, at the estimate."""
        first, more = len(self.problem.start), len(self.uncertain)

        def weighted(x: Array) -> Array:
            common, starts = self.unpacked(x)
            misfit = self.residual(common, starts) / sd[None, None]
            return jnp.concatenate([misfit.ravel(), self.problem.prior_residual(common[:first])])

        constants = jnp.eye(more, len(self.centre), first)
        return jnp.concatenate([jax.jacfwd(weighted)(self.centre), constants])

    def unpacked(
        self, x: Float[Array, " coordinate"]
    ) -> tuple[Float[Array, " common"], Float[Array, "experiment state"]]:
        """Coordinates that all experiments share, and initial states over their scale."""
        count, own = len(self.problem.start) + len(self.uncertain), self.problem.experiments
        if own.initial_state_known:
            return x, own.initial_state / self.problem.state_scales[None]
        return x[:count], x[count:].reshape(own.initial_state.shape)

    def values_of_constants(self, common: Float[Array, " common"]) -> Float[Array, " constant"]:
        """Values of the uncertain constants."""
        value, sd = self.constants.T
        size, score = jnp.where(value == 0, 1.0, value), common[len(self.problem.start) :]
        return jnp.where(value == 0, sd * score, size * jnp.exp(sd / jnp.abs(size) * score))

    def residual(
        self, common: Float[Array, " common"], starts: Float[Array, "experiment state"]
    ) -> Float[Array, "experiment sample output"]:
        """Measured minus simulated outputs."""
        problem = self.problem
        params = problem.plant.Params(*problem.params(common[: len(problem.start)]))
        plant = problem.plant
        if self.uncertain:
            values = self.values_of_constants(common)
            plant = plant.changed(**dict(zip(self.uncertain, values, strict=True)))
        begin = starts * problem.state_scales[None]
        simulated = simulate_experiments(plant, params, problem.experiments, begin)
        return residual_of(problem.experiments, simulated)

    def squares(self, x: Float[Array, " coordinate"]) -> Float[Array, " output"]:
        """Sum of squares of each output; its gradient is computed in forward mode.

        For a few parameters that is quicker than in reverse. An experiment depends on its own
        initial state alone, so that one change serves the initial states of all.
        """
        common, starts = self.unpacked(x)
        count = len(common)
        is_known = self.problem.experiments.initial_state_known
        at = jax.lax.stop_gradient((common, starts))

        def squares(change: Array) -> tuple[Array, Array]:
            begin = at[1] if is_known else at[1] + change[None, count:]
            values = jnp.sum(self.residual(at[0] + change[:count], begin) ** 2, axis=1)
            return values, values

        more = 0 if is_known else starts.shape[1]
        slope, values = jax.jacfwd(squares, has_aux=True)(jnp.zeros(count + more))
        moved = jnp.tile((common - at[0])[None], (len(starts), 1))  # zero, with a derivative
        moved = moved if is_known else jnp.concatenate([moved, starts - at[1]], axis=1)
        return jnp.sum(values + jnp.einsum("eou,eu->eo", slope, moved), axis=0)

    def log_likelihood(self, squares: Float[Array, " output"]) -> Float[Array, ""]:
        """Of the measured outputs; an unknown sd of the noise is integrated out."""
        if self.known_sd is not None:
            return -jnp.sum(squares / self.known_sd**2) / 2
        return -jnp.sum(self.counts * jnp.log(squares)) / 2

    def log_prior(self, x: Float[Array, " coordinate"]) -> Float[Array, ""]:
        """Of the coordinates: of the prior, and normal in the scores of uncertain constants.

        Without a prior it is flat in relative changes, so that a coordinate has the density of its
        derivative; a normal or uniform distribution is one of the parameter's own changes.
        """
        problem, z = self.problem, self.unpacked(x)[0][: len(self.problem.start)]
        values, slope = jax.jvp(problem.params, (z,), (jnp.ones_like(z),))
        slope = slope / relative_size(problem.plant, problem.plant.Params(*values))
        slope = slope * jnp.where(self.is_normal, values, 1.0)
        flat = jnp.sum(jnp.log(jnp.where(problem.free, slope, 1.0)))
        d = problem.plant.definition
        searched = problem.free & jnp.asarray([p.positive for p in d.parameters])
        is_far = searched & (jnp.abs(z - problem.usual) > FAR)
        of_constants = self.unpacked(x)[0][len(z) :]
        scores = jnp.concatenate([of_constants, problem.prior_residual(z)])
        return jnp.where(jnp.any(is_far), -jnp.inf, flat) - jnp.sum(scores**2) / 2

    @property
    def is_normal(self) -> Bool[np.ndarray, " param"]:
        """Which positive parameters have a prior of their own, not one of their logarithm."""
        prior, parts = self.problem.prior, self.problem.plant.definition.parameters
        kinds = {} if prior is None else dict(zip(prior.names, prior.logarithmic, strict=True))
        kinds |= dict.fromkeys(uniform_names(self.problem.plant), False)
        return np.array([p.positive and not kinds.get(p.name, True) for p in parts])

    def __call__(self, w: Float[Array, " unknown"]) -> Float[Array, ""]:
        """The density; -inf where the simulation diverged."""
        x = self.centre + self.spread @ w
        value = self.log_likelihood(self.squares(x)) + self.log_prior(x)
        return jnp.where(jnp.isfinite(value), value, -jnp.inf)

    @property
    def counts(self) -> Float[Array, " output"]:
        """Measured values of each output."""
        return jnp.sum(self.problem.experiments.valid, axis=(0, 1)).astype(float)

    def sample(self, w: Float[Array, " unknown"], key: PRNGKeyArray) -> _Sample:
        """What a draw stands for; the noise's sd is drawn here."""
        common, starts = self.unpacked(self.centre + self.spread @ w)
        residual = self.residual(common, starts)
        sd = self.known_sd
        if sd is None:
            chi2 = jax.random.chisquare(key, self.counts)
            sd = jnp.sqrt(jnp.sum(residual**2, axis=(0, 1)) / chi2)
        score = residual / sd[None, None]
        return _Sample(
            self.problem.params(common[: len(self.problem.start)]),
            self.values_of_constants(common) if self.uncertain else None,
            starts * self.problem.state_scales[None],
            sd,
            -(score**2) / 2 - jnp.log(sd * jnp.sqrt(2 * jnp.pi))[None, None],
        )


class _Sample(eqx.Module):
    """Values of one draw, or of many."""

    params: Array
    constants: Array | None
    initial_state: Array
    noise_sd: Array
    log_likelihood: Array | None


def _root(rows: Float[np.ndarray, "row coordinate"]) -> Float[np.ndarray, "coordinate unknown"]:
    """A root of (rows' rows)^-1, without the directions that the rows do not determine."""
    length = np.linalg.norm(rows, axis=0)
    length[length == 0] = 1.0
    _, sizes, directions = np.linalg.svd(rows / length, full_matrices=False)
    seen = sizes > _SEEN * sizes[0]
    return (directions[seen] / sizes[seen, None]).T / length[:, None]


@eqx.filter_jit
def _begun(density: Density, keys: Key[Array, " chain"]) -> tuple:
    """Chains at draws from the normal approximation; at the estimate where it has no density."""
    init, _, _ = dual_averaging_adaptation(_ACCEPTANCE)

    def begun(key: PRNGKeyArray) -> tuple:
        w = jax.random.normal(key, density.spread.shape[1:], float)
        w = jnp.where(jnp.isfinite(density(w)), w, 0.0)
        return blackjax.nuts.init(w, density), init(1.0)

    # Not weakly typed, as the chains are when they went on: one program is compiled for both.
    return jax.tree.map(lambda a: jax.lax.convert_element_type(a, a.dtype), jax.vmap(begun)(keys))


@eqx.filter_jit
def _block(
    density: Density, chains: tuple, keys: Key[Array, "chain draw"], is_warm_up: Array
) -> tuple:
    """The chains some draws further, and the draws; the step size is adapted in the warm-up."""
    kernel = blackjax.nuts.build_kernel()
    _, adapt, final = dual_averaging_adaptation(_ACCEPTANCE)

    def draw(chain: tuple, key: PRNGKeyArray) -> tuple[tuple, dict[str, Array]]:
        state, adapted = chain
        step = jnp.where(is_warm_up, jnp.exp(adapted.log_step_size), final(adapted))
        state, info = kernel(key, state, density, step, jnp.ones_like(state.position))
        after = adapt(adapted, info.acceptance_rate)
        adapted = jax.tree.map(lambda a, b: jnp.where(is_warm_up, a, b), after, adapted)
        return (state, adapted), {
            "position": state.position,
            "lp": state.logdensity,
            "acceptance_rate": info.acceptance_rate,
            "diverging": info.is_divergent,
            "energy": info.energy,
            "n_steps": info.num_integration_steps,
            "tree_depth": info.num_trajectory_expansions,
            "step_size": step,
        }

    return jax.vmap(lambda chain, own: jax.lax.scan(draw, chain, own))(chains, keys)


@eqx.filter_jit
def _samples(
    density: Density,
    w: Float[Array, "draw unknown"],
    keys: Key[Array, " draw"],
    has_likelihood: bool,
) -> _Sample:
    """What draws stand for."""

    def sample(now: tuple) -> _Sample:
        found = density.sample(*now)
        return found if has_likelihood else eqx.tree_at(lambda s: s.log_likelihood, found, None)

    return jax.lax.map(sample, (w, keys), batch_size=_BATCH)


def sampled(
    basis: Basis,
    coloured: Sequence[str],
    num_samples: int,
    chains: int,
    seed: int,
    progress: Callable[[str, float, float], None],
) -> DataTree:
    """Samples of the posterior; see `Identification.posterior`.

    Args:
        coloured: names of outputs whose residual is not white.
    """
    require_extra()
    for word, value, least in (("num_samples", num_samples, 10), ("chains", chains, 1)):
        if value < least:
            raise ValueError(f"{word} must be at least {least}: got {value}")
    if not isinstance(basis.estimator, NLS):
        raise ValueError(f"posterior samples need the estimator nls: got {basis.estimator.name}")
    if basis.estimator.likelihood != "normal":
        raise ValueError(
            f"posterior samples need the normal likelihood: got {basis.estimator.likelihood}"
        )
    density = Density.of(basis)
    problem = density.problem
    if density.known_sd is None and np.any(
        problem.noise_sd(jax.device_put(basis.estimate.residual)) <= problem.rounding
    ):
        raise ValueError("a posterior needs noise: the simulated outputs are the measured ones")
    begin, *keys = jax.random.split(jax.random.key(seed), 3)
    blocks = -(-num_samples // _BLOCK)
    total = _WARM_UP + blocks * _BLOCK
    with jax.numpy_rank_promotion("allow"):
        running = _begun(density, jax.random.split(begin, chains))
        own = jax.random.split(keys[0], (total // _BLOCK, chains, _BLOCK))
        drawn: list[dict[str, np.ndarray]] = []
        for i, block_keys in enumerate(own):
            is_warm_up = i * _BLOCK < _WARM_UP
            progress("warm-up" if is_warm_up else "sampling", i * _BLOCK, total)
            running, found = _block(density, running, block_keys, jnp.asarray(is_warm_up))
            drawn += [] if is_warm_up else [jax.device_get(found)]
        statistics = {
            name: np.concatenate([part[name] for part in drawn], axis=1)[:, :num_samples]
            for name in drawn[0]
        }
        w = jnp.asarray(statistics.pop("position").reshape(chains * num_samples, -1))
        num_values = w.shape[0] * int(problem.experiments.valid.sum())
        found = jax.device_get(
            _samples(density, w, jax.random.split(keys[1], len(w)), num_values <= _MOST_VALUES)
        )
    found = jax.tree.map(lambda a: a.reshape(chains, num_samples, *a.shape[1:]), found)
    return _as_tree(basis, density, found, statistics, coloured)


def _as_tree(
    basis: Basis,
    density: Density,
    found: _Sample,
    statistics: Mapping[str, np.ndarray],
    coloured: Sequence[str],
) -> DataTree:
    """Samples and data in the groups and with the names of ArviZ."""
    d, outputs = basis.plant.definition, list(names_of(basis.plant.definition.outputs))
    draws, free = ("chain", "draw"), basis.free
    of_draws: dict[str, Any] = {
        name: np.arange(size) for name, size in zip(draws, found.params.shape[:2], strict=True)
    }
    posterior: dict[str, Any] = {
        p.name: (draws, found.params[..., i], {"unit": p.unit})
        for i, p in enumerate(d.parameters)
        if free[i]
    }
    units = {c.name: c.unit for c in d.constants}
    if found.constants is not None:
        for i, name in enumerate(density.uncertain):
            posterior[name] = (draws, found.constants[..., i], {"unit": units[name]})
    coordinates = of_draws | {"output": outputs, "unit": ("output", [o.unit for o in d.outputs])}
    if density.known_sd is None:
        posterior["noise_sd"] = ((*draws, "output"), found.noise_sd)
    if not basis.experiments.initial_state_known:
        posterior["initial_state"] = ((*draws, "experiment", "state"), found.initial_state)
        coordinates["state"] = list(names_of(d.states))
    parts = zip(d.parameters, basis.estimate.params, free, strict=True)
    valid, measured = map(np.asarray, (basis.experiments.valid, basis.experiments.measured))
    rows, seen = valid.any(axis=2), np.where(valid, measured, np.nan)
    times = {"experiment": ("sample", np.nonzero(rows)[0]), "time": ("sample", _times(basis)[rows])}
    observed = {name: ("sample", seen[rows][:, i]) for i, name in enumerate(outputs)}
    kept = {name: (draws, values) for name, values in statistics.items()}
    groups = {
        "posterior": xarray.Dataset(posterior, coordinates),
        "sample_stats": xarray.Dataset(kept, of_draws),
        "observed_data": xarray.Dataset(observed, times),
        "constant_data": xarray.Dataset(
            {p.name: float(v) for p, v, is_free in parts if not is_free}
        ),
    }
    if found.log_likelihood is not None:
        each = np.where(valid, found.log_likelihood, np.nan)[:, :, rows]
        values = {name: ((*draws, "sample"), each[..., i]) for i, name in enumerate(outputs)}
        groups["log_likelihood"] = xarray.Dataset(values, of_draws | times)
    tree = xarray.DataTree.from_dict(groups)
    tree.attrs = {
        "inference_library": "blackjax",
        "inference_library_version": blackjax.__version__,
        "creation_library": "excite",
        "creation_library_version": __version__,
        "plant": d.name,
        "plant_hash": unbounded(basis.plant).description.hash,
        "coloured": " and ".join(coloured),
    }
    return tree


def _times(basis: Basis) -> Float[np.ndarray, "experiment sample"]:
    """Time of each sample since the beginning of its experiment [s]."""
    count, num_samples = basis.experiments.valid.shape[:2]
    dt = basis.experiments.dt
    steps = np.full((count, num_samples - 1), float(basis.plant.dt)) if dt is None else dt
    return np.pad(np.cumsum(np.asarray(steps), axis=1), [(0, 0), (1, 0)])


def summary(samples: DataTree) -> dict[str, Any]:
    """Means, 95 % credible intervals and the chains' agreement, as JSON-ready data.

    Args:
        samples: of `Identification.posterior`; docs/reference/machine-readable.md lists the keys.
    """
    posterior, statistics = samples["posterior"].dataset, samples["sample_stats"].dataset
    chains, draws = posterior.sizes["chain"], posterior.sizes["draw"]
    rhat, ess = arviz_stats.rhat(posterior), arviz_stats.ess(posterior)
    worst = max(float(v.max()) for v in rhat.values()), min(float(v.min()) for v in ess.values())
    divergences, coloured = int(statistics["diverging"].sum()), samples.attrs["coloured"]
    verdict = []
    if divergences:
        verdict.append(
            f"{divergences} of {chains * draws} samples diverged: the sampler may miss a part of "
            "the posterior"
        )
    if not (worst[0] <= _CONVERGED and worst[1] >= _ENOUGH * chains):
        verdict.append(
            f"the chains have not converged (rhat {worst[0]:.3f}, effective sample size "
            f"{worst[1]:.0f}): take more samples (--samples)"
        )
    if coloured:
        verdict.append(
            f"the residual of {coloured} is not white: the posterior assumes white noise, and is "
            "too narrow"
        )

    def described(name: str, **of: str) -> dict[str, Any]:
        """One variable, or one element."""
        own = posterior[name].sel(of)
        return {
            "mean": float(own.mean()),
            "sd": float(own.std(ddof=1)),
            "ci95": own.quantile([0.025, 0.975]).values.tolist(),
            "unit": own.attrs["unit"] if "unit" in own.attrs else own["unit"].item(),
            "rhat": float(rhat[name].sel(of)),
            "ess": float(ess[name].sel(of)),
        }

    return {
        "chains": chains,
        "samples": draws,
        "divergences": divergences,
        "acceptance_rate": float(statistics["acceptance_rate"].mean()),
        "params": {str(n): described(str(n)) for n, v in posterior.items() if v.ndim == 2},
        "noise_sd": {
            name: described("noise_sd", output=name) for name in posterior["output"].values.tolist()
        }
        if "noise_sd" in posterior
        else None,
        "verdict": verdict,
    }
