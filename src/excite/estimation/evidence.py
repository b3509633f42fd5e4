"""Evidence of rival plants: how probable each is after the same experiments.

A rival is a box of plants. Its evidence is the likelihood of the records, averaged over the box;
if all rivals were as probable before, their probabilities are in proportion to their evidences
(D. MacKay, Information Theory, Inference, and Learning Algorithms, 2003, chapter 28). A rival
with one more parameter is not preferred for a better fit alone: its box is larger.

The average is Laplace's approximation. Its coordinates z are standard normal where the box's own
are uniform, so that the best fit stays inside the box.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from ..plant.uncertainty import Uncertainty
from ..simulation import response
from .contract import Experiments, residual_of

_STEPS, _STARTS = 40, 16  # of the searches for the best fit
_DAMPING = 1e-2, 1e-9, 1e9  # first, smallest, largest; in diagonals of the information
_LOST = -1e30  # logarithm of the evidence where every simulation diverged
_LONGEST = 1.0  # step of a search, in each z


class Rival(eqx.Module):
    """One of several plants that may be the true one.

    Attributes:
        name: as it was given.
        box: of its parameters.
    """

    name: str = eqx.field(static=True)
    box: Uncertainty

    def values(self, z: Float[Array, " quantity"]) -> Float[Array, " quantity"]:
        """Of the box's quantities, in their units."""
        return self.box.values(2 * ndtr(z) - 1)

    def response(
        self, z: Float[Array, " quantity"], inputs: Float[Array, "time input"], *times: Array | None
    ) -> Float[Array, "sample output"]:
        """Noise-free outputs of one plant of the box; `times` as in `simulation.response`."""
        plant, params = self.box.at(2 * ndtr(z) - 1)
        return response(plant, params, inputs, None, *times)


class Fit(eqx.Module):
    """A rival after some experiments.

    Attributes:
        z: of the best fit.
        information: at the best fit, of records and box together.
        log_evidence: of the records, up to a constant that all rivals share.
        misfit: sum of squared residuals over the noise's variance.
    """

    z: Float[Array, " quantity"]
    information: Float[Array, "quantity quantity"]
    log_evidence: Float[Array, ""]
    misfit: Float[Array, ""]


def unplayed(rival: Rival) -> Fit:
    """A rival before the first experiment: its whole box is possible."""
    count, zero = len(rival.box.names), jnp.zeros(())
    return Fit(jnp.zeros(count), jnp.eye(count), zero, zero)


@eqx.filter_jit
def fitted(rival: Rival, experiments: Experiments) -> Fit:
    """The best fit of a rival to experiments from its initial state, of several starts."""
    e, sd, before = experiments, rival.box.plant.sensor.sd, unplayed(rival)

    def residual(z: Array) -> Array:
        simulated = jax.vmap(lambda *given: rival.response(z, *given))(
            e.inputs, e.dt, e.next_inputs
        )
        return (residual_of(e, simulated) / sd[None, None]).ravel()

    drawn = jax.random.normal(jax.random.key(0), (_STARTS - 1, len(before.z)))
    starts = jnp.concatenate([before.z[None], drawn])
    ends, costs = jax.vmap(lambda z: nearest(residual, before, z, _STEPS))(starts)
    z, S = ends[jnp.argmin(costs)], jax.jacfwd(residual)(ends[jnp.argmin(costs)])
    information = S.T @ S + before.information
    evidence = -0.5 * (jnp.min(costs) + jnp.linalg.slogdet(information)[1])
    fit = Fit(z, information, evidence, jnp.sum(residual(z) ** 2))
    lost = Fit(before.z, before.information, jnp.asarray(_LOST), jnp.asarray(jnp.inf))
    return jax.tree.map(lambda own, other: jnp.where(jnp.isfinite(evidence), own, other), fit, lost)


def nearest(
    residual: Callable[[Float[Array, " quantity"]], Float[Array, " value"]],
    known: Fit,
    start: Float[Array, " quantity"],
    num_steps: int,
) -> tuple[Float[Array, " quantity"], Float[Array, ""]]:
    """Where the sum of squares is smallest, and the sum there; infinite if it is never finite.

    By Levenberg's and Marquardt's method. What was known before is added as its quadratic.
    """
    first, smallest, largest = _DAMPING

    def total(z: Array, values: Array) -> Array:
        change = z - known.z
        found = jnp.sum(values**2) + change @ known.information @ change
        return jnp.where(jnp.isfinite(found), found, jnp.inf)

    def both(z: Array) -> tuple[Array, Array]:
        values = residual(z)
        return values, values

    with_slopes = jax.jacfwd(both, has_aux=True)

    def step(now: tuple, _: None) -> tuple[tuple, None]:
        z, least, damping = now
        S, values = with_slopes(z)
        A = S.T @ S + known.information
        b = S.T @ values + known.information @ (z - known.z)
        move = jnp.linalg.solve(A + damping * jnp.diag(jnp.diagonal(A)), -b)
        moved = z + jnp.clip(move, -_LONGEST, _LONGEST)
        reached = total(moved, residual(moved))
        better = reached < least
        damping = jnp.clip(jnp.where(better, damping / 8, 4 * damping), smallest, largest)
        return (jnp.where(better, moved, z), jnp.where(better, reached, least), damping), None

    begin = (start, total(start, residual(start)), jnp.asarray(first))
    (z, least, _), _ = jax.lax.scan(step, begin, length=num_steps)
    return z, least


def probabilities(fits: Sequence[Fit]) -> Float[Array, " rival"]:
    """Of each rival, if all were as probable before the first experiment."""
    return jax.nn.softmax(jnp.stack([fit.log_evidence for fit in fits]))
