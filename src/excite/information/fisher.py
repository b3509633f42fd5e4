"""Information of an experiment about its parameters, before anything is estimated.

With outputs y(theta) and independent Gaussian noise of standard deviation sigma, the
Fisher information is M = sum_k S_k' S_k / sigma^2, S = dy/dtheta, and no unbiased
estimator has a covariance below M^-1 (Cramér-Rao; L. Ljung, System Identification, 2nd
ed., ch. 7; G. Goodwin and R. Payne, Dynamic System Identification, 1977). In logarithms
of the parameters the information is relative and can be compared between parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..description import Named, PlantDescription, names_of
from ..excitation.catalogue import ExcitationLike
from ..plant import AbstractPlant, Params, require_double_precision
from ..plant.catalogue import PlantLike
from ..plant.static import require_sensor_noise
from ..record import Record
from ..record.table import data_frame
from ..report.results import information_html, information_text, wrapped
from ..safety import critical_levels
from ..simulation import Experiment, predicted, require_likelihood, response, run_episode, step
from .identifiability import Structure, practically, structure

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

Information = Float[Array, "param param"]

_DIVERGED = 100.0  # times its critical level: an output that a plant's equations do not describe


def require_noise(plant: AbstractPlant) -> None:
    """Raises ValueError for a sensor without noise, which has no Cramér-Rao bound."""
    require_sensor_noise(plant)
    if plant.definition.is_disturbed:
        raise ValueError(
            f"plant {plant.definition.name!r} has process noise, so that its information differs "
            "from record to record: see what is expected of it with excite gain "
            "(ex.information_gain)"
        )
    if not np.all(np.asarray(plant.sensor.sd) > 0):
        raise ValueError("a sensor without noise has no Cramér-Rao bound; give it a noise_sd")


def require_bound(plant: AbstractPlant) -> None:
    """Raises ValueError where the records of a plant have no likelihood, or no Cramér-Rao bound."""
    if not require_likelihood(plant):
        require_noise(plant)


def sensitivity(
    response: Callable[[Float[Array, " param"]], Float[Array, "time output"]],
    theta: Float[Array, " param"],
) -> Float[Array, "time output param"]:
    """Derivative of a response with respect to its parameters, in forward mode."""
    require_double_precision()
    return jax.jacfwd(response)(theta)


def fisher_information(
    sensitivity: Float[Array, "time output param"], noise_sd: Float[Array, " output"]
) -> Information:
    """S' S / sigma^2, summed over time and outputs."""
    weighted = sensitivity / noise_sd[None, :, None]
    return jnp.einsum("koi,koj->ij", weighted, weighted)


def marginal_information(
    sensitivity: Float[Array, "time output unknown"],
    noise_sd: Float[Array, " output"],
    num_params: int,
) -> Information:
    """Information on the first `num_params` parameters when the others are unknown too.

    The others (an initial state) are eliminated by an orthogonal factorisation, which
    keeps the digits that a Schur complement of the information loses.
    """
    weighted = (sensitivity / noise_sd[None, :, None]).reshape(-1, sensitivity.shape[-1])
    columns = jnp.roll(weighted, -num_params, axis=1)
    num_others = columns.shape[1] - num_params
    # An undetermined direction of the others must not make the rest singular.
    prior = jnp.concatenate(
        [1e-6 * jnp.eye(num_others), jnp.zeros((num_others, num_params))], axis=1
    )
    R = jnp.linalg.qr(jnp.concatenate([columns, prior]), mode="r")[num_others:, num_others:]
    return R.T @ R


class Start(eqx.Module):
    """Where an experiment begins.

    Attributes:
        state: of the plant.
        slope: its derivative with respect to relative changes of the parameters.
    """

    state: Float[Array, " state"]
    slope: Float[Array, "state param"]

    def after(self, change: Float[Array, " param"]) -> Float[Array, " state"]:
        """The state of a plant whose parameters are changed."""
        return self.state + self.slope @ change


class Past(eqx.Module):
    """What was played since rest, where an experiment begins without a rest.

    Attributes:
        inputs: from rest on; what follows the first `count` of them counts for nothing.
        count: samples that were played.
        pause: samples of the safe input with which the experiment begins, while it is decided.
    """

    inputs: Float[Array, "time input"]
    count: Int[Array, ""]
    pause: int = eqx.field(static=True)

    @classmethod
    def of(cls, played: Float[Array | np.ndarray, "time input"], pause: int, room: int = 0) -> Past:
        """After these inputs, in an array for at least `room` of them.

        One room for experiments of different lengths makes one compiled program serve all.
        """
        inputs, count = jnp.asarray(played), len(played)
        inputs = jnp.pad(inputs, ((0, max(room - count, 0)), (0, 0)))
        return cls(inputs, jnp.asarray(count), pause)


@eqx.filter_jit
def start_after(plant: AbstractPlant, params: Params, past: Past) -> Start:
    """The state of a plant without input delay before the pause."""
    changed = _changed(plant, params)

    def end(change: Array) -> Float[Array, " state"]:
        own = changed(change)

        def advance(state: Array, now: tuple) -> tuple[Array, None]:
            k, input = now
            return jnp.where(k < past.count, step(plant, state, input, own), state), None

        steps = jnp.arange(len(past.inputs)), past.inputs
        return jax.lax.scan(advance, plant.initial_state, steps)[0]

    at = jnp.zeros(len(params))
    return Start(end(at), jax.jacfwd(end)(at))


@eqx.filter_jit
def experiment_information(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[Array, "time input"],
    *,
    measured: Float[Array, "time+1 output"] | None = None,
    initial_state_known: bool = True,
    start: Start | None = None,
) -> Information:
    """Relative Fisher information of an experiment with these inputs and this plant's sensor.

    In logarithms of positive parameters, and of free ones over their scale.

    Args:
        measured: of a plant whose state is observed, which begins every step there.
        initial_state_known: False where the initial state must be estimated too; the
            experiment starts at the plant's initial state in either case.
        start: where it begins, if not at rest; its first measurement is of what was before.
    """
    require_double_precision()
    changed, num_params = _changed(plant, params), len(params)
    num_states = 0 if initial_state_known else len(plant.initial_state)

    if measured is not None and plant.definition.observes_state:
        S = sensitivity(
            lambda change: predicted(plant, changed(change), inputs, measured)[0],
            jnp.zeros(num_params),
        )
        return fisher_information(S, plant.process_noise_sd)

    def outputs(change: Array) -> Array:
        moved = change[num_params:] if num_states else 0.0
        begin = plant.initial_state if start is None else start.after(change[:num_params])
        return response(plant, changed(change[:num_params]), inputs, begin + moved)

    S = sensitivity(outputs, jnp.zeros(num_params + num_states))
    S = S if start is None else S[1:]
    if initial_state_known:
        return fisher_information(S, plant.sensor.sd)
    return marginal_information(S, plant.sensor.sd, num_params)


@eqx.filter_jit
def running_information(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[Array, "time input"],
    start: Start | None = None,
) -> Float[Array, "time param param"]:
    """`experiment_information` after each step, with a known initial state.

    The last is that of the whole experiment.
    """
    changed = _changed(plant, params)

    def outputs(change: Array) -> Array:
        begin = None if start is None else start.after(change)
        return response(plant, changed(change), inputs, begin)

    weighted = sensitivity(outputs, jnp.zeros(len(params))) / plant.sensor.sd[None, :, None]
    each = jnp.einsum("koi,koj->kij", weighted, weighted)
    if start is not None:
        return jnp.cumsum(each[1:], axis=0)
    return jnp.cumsum(each, axis=0)[1:]


def _changed(plant: AbstractPlant, params: Params) -> Callable[[Float[Array, " param"]], Params]:
    """Parameters after relative changes, which are a function's arguments."""
    theta, size = jnp.stack([jnp.asarray(p, float) for p in params]), relative_size(plant, params)
    return lambda change: plant.Params(*(theta + size * change))


def relative_size(plant: AbstractPlant, params: Params) -> Float[Array, " param"]:
    """Size of a relative change of one, for each parameter in its unit."""
    return jnp.stack(
        [
            jnp.asarray(value if p.positive else p.scale, float)
            for p, value in zip(plant.definition.parameters, params, strict=True)
        ]
    )


@jax.jit
def d_optimality(information: Information) -> Float[Array, ""]:
    """Log det M: minus twice the logarithm of the confidence ellipsoid's volume."""
    sign, value = jnp.linalg.slogdet(information)
    return jnp.where(sign > 0, value, -jnp.inf)


@jax.jit
def a_optimality(information: Information) -> Float[Array, ""]:
    """Trace M^-1: the sum of the parameters' smallest possible variances."""
    return jnp.sum(cramer_rao_bound(information) ** 2)


@jax.jit
def e_optimality(information: Information) -> Float[Array, ""]:
    """Smallest eigenvalue of M: the information in the least certain direction."""
    return jnp.linalg.eigvalsh(information)[0]


@jax.jit
def cramer_rao_bound(information: Information) -> Float[Array, " param"]:
    """Smallest possible standard deviation of each parameter; infinite where M is singular."""
    # Scaling to a unit diagonal first: parameters may differ by many orders of magnitude.
    size = jnp.sqrt(jnp.diagonal(information))
    safe = jnp.where(size > 0, size, 1.0)
    values, vectors = jnp.linalg.eigh(information / jnp.outer(safe, safe))
    unseen = values < 10 * len(size) * jnp.finfo(values.dtype).eps
    variance = jnp.sum(vectors**2 / jnp.where(unseen, 1.0, values)[None], axis=1) / safe**2
    lost = jnp.any(unseen[None] & (jnp.abs(vectors) > 1e-6), axis=1)
    return jnp.where(lost | (size == 0), jnp.inf, jnp.sqrt(variance))


@dataclass(frozen=True)
class Bound:
    """The smallest possible standard deviation of one parameter.

    Attributes:
        value: at which the bound holds.
        cramer_rao_bound: smallest standard deviation [unit]; None where there is none.
        cramer_rao_percent: the same in percent of the value.
    """

    value: float
    cramer_rao_bound: float | None
    cramer_rao_percent: float | None
    unit: str


@dataclass(frozen=True, repr=False)
class InformationResult:
    """How precisely an experiment can determine each parameter; the result of `information`.

        >>> import excite as ex
        >>> ex.information("aero2").params.J_p.cramer_rao_percent < 0.1
        True

    Attributes:
        plant: with the numbers of the experiment.
        initial_state: "known", or "free" where it must be estimated too.
        params: by parameter, in the order of the plant, as attribute or item.
        log_det_information, a_optimality, e_optimality: criteria of the relative information:
            log det M, trace M^-1, smallest eigenvalue of M.
        information: relative Fisher information, see `experiment_information`.
        identifiability: "structurally not identifiable", "practically not identifiable with this
            excitation" or "identifiable": the worst that holds for any parameter.
        structure: result of the structural test; None where it was not made.
        verdict: sentences: what cannot be identified, and how certain the rest is.
        inputs: of the experiment [input units].
        excitation: its name.
        warnings: sentences, where a policy was trained on another plant, and where an output
            reaches its critical level.
    """

    plant: PlantDescription
    initial_state: str
    params: Named[Bound]
    log_det_information: float
    a_optimality: float
    e_optimality: float
    information: Float[np.ndarray, "param param"]
    identifiability: str
    structure: Structure | None
    verdict: tuple[str, ...]
    inputs: Float[np.ndarray, "time input"]
    excitation: str = ""
    warnings: tuple[str, ...] = ()

    def __str__(self) -> str:
        return information_text(self.to_dict())

    def __repr__(self) -> str:
        return wrapped(str(self))

    def _repr_html_(self) -> str:
        return information_html(self.to_dict())

    def plot(self) -> Figure:
        """The input, and the smallest possible standard deviation of each parameter in percent."""
        from ..report.figures import information_figure

        time = np.arange(len(self.inputs) + 1) * self.plant.dt
        drawn = Record.of_episode(time, self.inputs, np.empty((len(time), 0)))
        percent = {name: bound.cramer_rao_percent for name, bound in self.params.items()}
        return information_figure(self.plant, drawn, percent)

    def to_pandas(self) -> DataFrame:
        """One row per parameter: value, smallest standard deviation, the same in percent, unit.

        Raises:
            ValueError: where pandas is not installed.
        """
        bounds = [asdict(bound) for bound in self.params.values()]
        return data_frame({key: [b[key] for b in bounds] for key in bounds[0]}, list(self.params))

    def to_dict(self) -> dict[str, object]:
        """The result as JSON-ready data; docs/reference/machine-readable.md lists its keys."""
        return {
            "plant": self.plant.name,
            "initial_state": self.initial_state,
            "params": {name: asdict(bound) for name, bound in self.params.items()},
            "log_det_information": self.log_det_information,
            "a_optimality": self.a_optimality,
            "e_optimality": self.e_optimality,
            "information": self.information,
            "identifiability": self.identifiability,
            "structure": None if self.structure is None else asdict(self.structure),
            "verdict": self.verdict,
            "excitation": self.excitation,
            "num_steps": len(self.inputs),
            "warnings": self.warnings,
        }


def information(
    plant: PlantLike,
    excitation: ExcitationLike | None = None,
    *,
    options: Mapping[str, object] | None = None,
    steps: int | None = None,
    params: Mapping[str, float] | Params | None = None,
    noise: Mapping[str, float] | None = None,
    resolution: Mapping[str, float] | None = None,
    seed: int | PRNGKeyArray = 0,
    initial_state: Literal["auto", "known", "free"] = "auto",
) -> InformationResult:
    """Smallest possible standard deviation of each parameter for an experiment (Cramér-Rao bound).

        >>> import excite as ex
        >>> result = ex.information("aero2", "multisine", steps=200)
        >>> result.params["D_p"].unit
        'N m s/rad'

    Args:
        plant: as for `simulate`, like all arguments except the last.
        initial_state: "known", or "free" where it must be estimated too; "auto" is known, for
            a record only where its sidecar says that it starts at the plant's initial state.

    Raises:
        ValueError: as `simulate`, for a sensor without noise, which sets no bound, and for a
            response that is not finite, or far beyond a critical level.
        TypeError: for an argument of another type.
    """
    if initial_state not in ("auto", "known", "free"):
        raise ValueError(f"initial state {initial_state!r} is not one of: auto, known, free")
    experiment = Experiment.of(
        plant, excitation, options=options, steps=steps, params=params, noise=noise,
        resolution=resolution, seed=seed,
    )  # fmt: skip
    elsewhere = isinstance(excitation, Record) and not excitation.starts_at_initial_state
    known = initial_state == "known" or (initial_state == "auto" and not elsewhere)
    e = experiment
    run = run_episode(e.plant, e.params, e.excitation, e.num_steps, e.key)
    inputs, levels = run.inputs, critical_levels(e.plant.description)
    near, beyond = np.max(np.abs(run.outputs), axis=0) / levels, []
    for output, size in zip(e.plant.definition.outputs, near, strict=True):
        told = f"{output.name} reaches {float(size):.3g} times its critical level"
        if _DIVERGED < size < np.inf:
            raise ValueError(
                f"{told}: its information cannot be trusted; a smaller amplitude may help"
            )
        if size >= 1:
            beyond.append(f"{told}: on a rig, the experiment would end there")
    result = best_possible(
        e.plant, e.params, inputs, initial_state_known=known,
        structure=structure(e.plant, e.params, initial_state_known=known),
    )  # fmt: skip
    return replace(result, excitation=e.name, warnings=(*e.warnings, *beyond))


def best_possible(
    plant: AbstractPlant,
    params: Params,
    inputs: Float[Array, "time input"],
    *,
    initial_state_known: bool,
    structure: Structure | None = None,
) -> InformationResult:
    """Smallest possible standard deviation of each parameter for these inputs.

    Args:
        structure: of the plant; what it cannot tell apart has no bound.

    Raises:
        ValueError: for a sensor without noise, which sets no bound, and for a response
            that is not finite.
    """
    require_noise(plant)
    information = experiment_information(
        plant, params, inputs, initial_state_known=initial_state_known
    )
    values = np.linalg.eigvalsh(np.nan_to_num(np.asarray(information)))
    if not np.all(np.isfinite(information)) or values[0] < -1e-6 * values[-1]:
        raise ValueError(
            "the response to this input is not finite, or chaotic: its information cannot be "
            "trusted; a smaller amplitude or other parameters may help"
        )
    parameters = plant.definition.parameters
    names = names_of(parameters)
    sd = np.asarray(cramer_rao_bound(information)) * np.asarray(relative_size(plant, params))
    if structure is not None:  # rounding may leave a bound
        sd = np.where([structure.of(name) is not None for name in names], np.inf, sd)
    identifiability, verdict = practically(names, np.asarray(information), structure)

    def bound(value: float, least: float, unit: str) -> Bound:
        is_finite = bool(np.isfinite(least))
        percent = 100 * least / abs(value) if is_finite and value else None
        return Bound(value, least if is_finite else None, percent, unit)

    return InformationResult(
        plant=plant.description,
        initial_state="known" if initial_state_known else "free",
        params=Named(
            (p.name, bound(float(value), float(s), p.unit))
            for p, value, s in zip(parameters, params, sd, strict=True)
        ),
        log_det_information=float(d_optimality(information)),
        a_optimality=float(a_optimality(information)),
        e_optimality=float(e_optimality(information)),
        information=np.asarray(information),
        identifiability=identifiability,
        structure=structure,
        verdict=verdict,
        inputs=np.asarray(inputs),
    )
