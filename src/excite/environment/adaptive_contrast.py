"""A contrast with plants that the outcomes make probable, not with any of the prior."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..plant import AbstractPlant, Params
from ..safety import safe_input
from ..simulation import require_likelihood, step
from .contrast import IMPOSSIBLE, AbstractFinalContrast, with_finite_gradient
from .objective import StepData

_STEPS = 8  # of the fit
_FROM_PRIOR = 0.2  # of the compared plants
_WIDER = 1.2  # than the posterior by its normal approximation


class RecordMemory(eqx.Module):
    """The record so far.

    Attributes:
        count: of samples.
        states: true ones, before each step.
        inputs, measured: of each step.
        input: the last one.
        key: of the compared plants.
    """

    count: Int[Array, ""]
    states: Float[Array, "step state"]
    inputs: Float[Array, "step input"]
    measured: Float[Array, "step output"]
    input: Float[Array, " input"]
    key: PRNGKeyArray


class AdaptiveContrastiveGain(AbstractFinalContrast):
    """A lower bound of the expected information gain in nats that needs few plants: ACE.

    As `ContrastiveGain`, but the other plants are drawn from what the record tells, and weighted by
    the prior over this proposal (adaptive contrastive estimation; A. Foster et al., A unified
    stochastic gradient approach to designing Bayesian-optimal experiments, AISTATS 2020). The
    proposal is a normal distribution about the most probable parameters (Levenberg-Marquardt from
    the prior's center, by the record alone), a little wider than its approximation of the
    posterior, mixed with the prior. Where the posterior has one mode, the bound is close to the
    gain, however large that is; where it has several, it is a weak one.

    The reward is that of the last step: there the experiment is computed again for every compared
    plant. PPO computes it at every step, which takes long for long experiments. The gradient goes
    through the proposal by the last step of the fit.

    Attributes:
        prior: of the parameters.
        num_steps: of an experiment.
        num_plants: that are compared with the true one.
        weight: factor of the reward.
        change_price: of the squared change of the input, subtracted at every step.
    """

    num_plants: int = eqx.field(static=True, default=15)

    def init(
        self, plant: AbstractPlant, measured: Float[Array, " output"], key: PRNGKeyArray
    ) -> RecordMemory:
        """An empty record; the initial state is known."""
        rest = jnp.asarray(safe_input(plant.definition))

        def rows(sample: Array) -> Array:
            return jnp.zeros((self.num_steps, sample.size))

        parts = rows(plant.initial_state), rows(rest), rows(measured)
        return RecordMemory(jnp.asarray(0), *parts, rest, key)

    def update(
        self, plant: AbstractPlant, memory: RecordMemory, sample: StepData, k: Int[Array, ""]
    ) -> tuple[RecordMemory, Float[Array, ""]]:
        """The sample is kept."""
        del plant
        cost = self.change_price * jnp.sum((sample.input - memory.input) ** 2)
        new = RecordMemory(
            count=k + 1,
            states=memory.states.at[k].set(sample.state),
            inputs=memory.inputs.at[k].set(sample.input),
            measured=memory.measured.at[k].set(sample.measured),
            input=sample.input,
            key=memory.key,
        )
        return new, -cost

    def final(self, plant: AbstractPlant, memory: RecordMemory, params: Params) -> Float[Array, ""]:
        """The bound; zero before the last step."""
        is_whole = memory.count >= self.num_steps
        return jax.lax.cond(
            is_whole,
            lambda: self.weight * self._bound(plant, memory, params),
            lambda: jnp.zeros(()),
        )

    def relative_errors(
        self, plant: AbstractPlant, memory: RecordMemory, params: Params
    ) -> Float[Array, " param"]:
        """Relative standard deviations of the normal approximation; before the end, the prior's."""
        prior = jnp.zeros(len(params)), jnp.eye(len(params))
        is_whole = memory.count >= self.num_steps
        estimate, root = jax.lax.cond(is_whole, lambda: self._fit(plant, memory), lambda: prior)
        changes = jax.jacfwd(lambda z: jnp.stack(self.prior.params(z)))(estimate)
        deviations = solve_triangular(root.T, changes.T, lower=True)
        return jnp.linalg.norm(deviations, axis=0) / jnp.abs(jnp.stack(params))

    def _bound(
        self, plant: AbstractPlant, memory: RecordMemory, params: Params
    ) -> Float[Array, ""]:
        estimate, root = self._fit(plant, memory)
        count, size = self.num_plants, len(estimate)
        kind_key, value_key = jax.random.split(memory.key)
        drawn = jax.random.normal(value_key, (count, size), float)
        about = solve_triangular(root, _WIDER * drawn.T).T
        is_prior = jax.random.uniform(kind_key, (count, 1)) < _FROM_PRIOR
        others = jnp.where(is_prior, drawn, estimate[None] + about)
        z = jnp.concatenate([others, self.prior.coordinates(params)[None]])

        of_each = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(z), *x.shape)), _rows(memory))
        of_each = with_finite_gradient(of_each)
        residuals = jax.vmap(lambda z, rows: self._residuals(plant, rows, z))(z, of_each)
        found = -0.5 * jnp.sum(residuals**2, axis=1)
        found = jnp.where(found > IMPOSSIBLE, found, IMPOSSIBLE)  # also for NaN

        prior = -0.5 * jnp.sum(z**2, axis=1)
        change = (z - estimate[None]) @ root.T / _WIDER
        height = jnp.sum(jnp.log(jnp.abs(jnp.diagonal(root)))) - size * math.log(_WIDER)
        near = height - 0.5 * jnp.sum(change**2, axis=1)
        mixed = math.log(_FROM_PRIOR) + prior, math.log(1 - _FROM_PRIOR) + near
        evidence = jax.nn.logsumexp(found + prior - jnp.logaddexp(*mixed)) - math.log(count + 1)
        return found[-1] - evidence

    def _fit(
        self, plant: AbstractPlant, memory: RecordMemory
    ) -> tuple[Float[Array, " param"], Float[Array, "param param"]]:
        """The most probable coordinates of the prior, and a root R of the information R' R."""

        def residuals(z: Array, rows: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            own = jnp.append(self._residuals(plant, rows, z), z)
            return own, own

        slopes = jax.jacfwd(residuals, has_aux=True)

        def better(now: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
            z, damping = now
            J, r = slopes(z, rows)
            M = J.T @ J
            new = z - jnp.linalg.solve(M + damping * jnp.diag(jnp.diagonal(M)), J.T @ r)
            is_better = jnp.sum(residuals(new, rows)[0] ** 2) < jnp.sum(r**2)
            return (jnp.where(is_better, new, z), damping * jnp.where(is_better, 0.1, 10.0)), None

        rows = jax.lax.stop_gradient(_rows(memory))
        begin = jnp.zeros(len(plant.nominal)), jnp.asarray(1e-3)
        (z, _), _ = jax.lax.scan(better, begin, None, length=_STEPS)
        rows = with_finite_gradient(_rows(memory))
        J, r = slopes(z, rows)
        root = jnp.linalg.qr(J, mode="r")
        moved = z - solve_triangular(root, solve_triangular(root.T, J.T @ r, lower=True))
        is_sound = jnp.all(jnp.isfinite(root)) & jnp.all(jnp.isfinite(moved))
        return jnp.where(is_sound, moved, 0.0), jnp.where(is_sound, root, jnp.eye(len(z)))

    def _residuals(
        self, plant: AbstractPlant, rows: tuple[Array, Array, Array], z: Float[Array, " param"]
    ) -> Float[Array, " value"]:
        """Measured less expected, over the noise, of a plant at these coordinates."""
        params, is_seen = self.prior.params(z), require_likelihood(plant)
        sd = plant.process_noise_sd if is_seen else plant.sensor.sd

        @jax.checkpoint
        def advance(state: Array, made: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            true, input, measured = made
            after = step(plant, true if is_seen else state, input, params)
            expected = after if is_seen else plant.output(after, params)
            return after, (measured - expected) / sd

        return jax.lax.scan(advance, plant.initial_state, rows)[1].ravel()


def _rows(memory: RecordMemory) -> tuple[Array, Array, Array]:
    return memory.states, memory.inputs, memory.measured
