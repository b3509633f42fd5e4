"""The decision process: an experiment that is rewarded for its information and safety.

`Env` is two pure functions, `reset` and `step`, over one explicit state, for any plant.
An episode is one experiment of T steps on a newly drawn plant. Every step has the safety
penalty (Eq. 3 of Langschwert et al.). An objective adds the reward of the experiment: the
estimation error at its end (Eq. 4), or the information gained at every step. The defaults
are the paper's.

T is part of the process and k / T is observed, so the last step is `terminated`; nothing
is ever truncated. The memory of an objective does not grow with T, but for that of ACE, which
keeps the record.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, PyTree

from ..description import Spread, SpreadLike, prior_sd_of
from ..estimation.prior import PriorPlants
from ..plant import AbstractARXPlant, AbstractPlant, Params, draw_params
from ..plant.catalogue import require_inputs
from ..plant.fields import floats
from ..plant.uncertainty import Uncertainty
from ..policy import (
    Layout,
    Window,
    empty_window,
    observe,
    scaled_action,
    with_input,
    with_measurement,
)
from ..safety import critical_levels, penalty, safe_input, watched_levels
from ..simulation import disturbed, measure, step
from .errors import EstimationError
from .information_gain import InformationGain
from .objective import AbstractObjective, StepData, target_mask


def _spread(given: SpreadLike) -> Spread:
    """The spread, its numbers as arrays."""
    return jax.tree.map(floats, Spread.of(given))


class EnvState(eqx.Module):
    """State of one episode; of fixed size, whatever T is, but for the memory of ACE.

    Attributes:
        params: true parameters of this episode's plant.
        constants: its true constants.
        plant_state: true state.
        window: last measurements and inputs, for the policy.
        memory: of the objective.
        k: steps done.
        max_abs_output: largest magnitude of each true output so far.
        is_finite: False once the state could not be computed; it is then kept constant.
        key: of this episode.
    """

    params: Params
    constants: PyTree
    plant_state: Float[Array, " state"]
    window: Window
    memory: PyTree
    k: Int[Array, ""]
    max_abs_output: Float[Array, " output"]
    is_finite: Bool[Array, ""]
    key: PRNGKeyArray


class Transition(eqx.Module):
    """What a step returns beside the state.

    Attributes:
        observation: Eq. 2.
        reward: safety penalty and objective.
        terminated: whether this was step T.
        is_violation: whether a critical level was reached so far.
        relative_errors: of the parameters, so far.
    """

    observation: Float[Array, " observation"]
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    is_violation: Bool[Array, ""]
    relative_errors: Float[Array, " param"]


class Env(eqx.Module):
    """Decision process of one plant.

    Attributes:
        plant: its constants and sensor; its parameters are drawn for every episode.
        objective: what the experiment is rewarded for.
        layout: what is observed, and T.
        spread: of the parameters around their nominal values.
        penalty_weight: factor of the safety penalty; 1 / T normalises it by length.
        constants: lowest and highest constants of the plant; they are drawn for every
            episode, so that a policy is robust against errors of constants that
            identification takes as known. Default the plant's constants.
        uncertainty: box of the plants on which a policy is also made safe, without reward.
        coast: samples after the experiment, under the input that ends it, in which the plant must
            be safe too. Training by gradient penalises them; a step of the process has none.
        prior: of the parameters, in place of the spread.
    """

    plant: AbstractPlant
    objective: AbstractObjective
    layout: Layout = eqx.field(static=True)
    spread: Spread = eqx.field(converter=_spread, default=0.3)
    penalty_weight: Float[Array, ""] = eqx.field(converter=floats, default=1.0)
    constants: tuple[PyTree, PyTree] | None = None
    uncertainty: Uncertainty | None = None
    coast: int = eqx.field(static=True, default=0)
    prior: PriorPlants | None = None

    def __check_init__(self) -> None:
        """Raises ValueError for inputs that act late, and an objective of another length."""
        require_inputs(self.plant)
        self.objective.require_steps(self.layout.num_steps)

    @classmethod
    def of(
        cls,
        plant: AbstractPlant,
        *,
        objective: AbstractObjective | None = None,
        layout: Layout | None = None,
        spread: SpreadLike = 0.3,
        penalty_weight: float | Float[Array, ""] = 1.0,
        constants: tuple[PyTree, PyTree] | None = None,
        uncertainty: Uncertainty | None = None,
        coast: int = 0,
        prior: PriorPlants | None = None,
    ) -> Env:
        """The paper's process for a plant, except for the given choices."""
        return cls(
            plant,
            default_objective(plant, spread) if objective is None else objective,
            Layout.of(plant.description) if layout is None else layout,
            spread,
            penalty_weight,
            constants,
            uncertainty,
            coast,
            prior,
        )

    def reset(self, key: PRNGKeyArray) -> tuple[EnvState, Float[Array, " observation"]]:
        """A plant drawn at random, at its initial state, and its first observation."""
        params_key, key = jax.random.split(key)
        constants = self._draw_constants(params_key)
        plant = self.plant.changed(**constants._asdict())
        if self.prior is None:
            params = draw_params(plant, params_key, self.spread)
        else:
            params = self.prior.draw(params_key)
        output = plant.output(plant.initial_state, params)
        noise = jax.random.normal(jax.random.fold_in(key, 0), output.shape, float)
        measured = measure(plant, plant.initial_state, params, output, noise)
        window = with_measurement(jnp, self.layout, empty_window(jnp, self.layout), measured)
        state = EnvState(
            params=params,
            constants=constants,
            plant_state=plant.initial_state,
            window=window,
            memory=self.objective.init(plant, measured, jax.random.fold_in(params_key, 2)),
            k=jnp.asarray(0),
            max_abs_output=jnp.abs(plant.true_output(plant.initial_state, params)),
            is_finite=jnp.asarray(True),
            key=key,
        )
        return state, observe(jnp, self.layout, window, state.k)

    def step(self, state: EnvState, action: Float[Array, " input"]) -> tuple[EnvState, Transition]:
        """One sampling time with this action held, in [-1, 1] of the input limits."""
        state, output, gain = self.advance(state, action)
        return state, self._transition(state, output, gain)

    def advance(
        self, state: EnvState, action: Float[Array, " input"]
    ) -> tuple[EnvState, Float[Array, " output"], Float[Array, ""]]:
        """The experiment after one sampling time: state, true output, gain of the objective."""
        plant, k = self.plant.changed(**state.constants._asdict()), state.k + 1
        action = jnp.where(jnp.isfinite(action), jnp.clip(action, -1, 1), 0.0)
        input = scaled_action(jnp, self.layout, action.astype(float))
        noise_key = jax.random.fold_in(jax.random.fold_in(state.key, k), 1)
        after = step(plant, state.plant_state, input, state.params)
        after = disturbed(plant, after, noise_key)
        is_finite = jnp.all(jnp.isfinite(after)) & self._is_visible(after, state.params)
        is_finite = is_finite & state.is_finite
        after = jnp.where(is_finite, after, state.plant_state)
        output, shown = plant.true_and_shown(after, state.params)
        noise = jax.random.normal(jax.random.fold_in(state.key, k), shown.shape, float)
        measured = measure(plant, after, state.params, shown, noise)
        sample = StepData(state.params, state.plant_state, input, measured)
        memory, gain = self.objective.update(plant, state.memory, sample, state.k)
        window = with_input(jnp, self.layout, state.window, input)
        new = EnvState(
            params=state.params,
            constants=state.constants,
            plant_state=after,
            window=with_measurement(jnp, self.layout, window, measured),
            memory=memory,
            k=k,
            max_abs_output=jnp.maximum(state.max_abs_output, jnp.abs(output)),
            is_finite=is_finite,
            key=state.key,
        )
        return new, output, jnp.where(is_finite, gain, 0.0)

    def coasting(self, state: EnvState) -> Float[Array, "sample output"]:
        """True outputs after the experiment, under the input that ends it.

        They stay as they are from where the simulation diverges.
        """
        plant = self.plant.changed(**state.constants._asdict())
        rest = jnp.asarray(safe_input(plant.definition))

        def advance(own: Array, _: None) -> tuple[Array, Array]:
            after = step(plant, own, rest, state.params)
            own = jnp.where(jnp.all(jnp.isfinite(after)), after, own)
            return own, plant.true_output(own, state.params)

        return jax.lax.scan(advance, state.plant_state, None, length=self.coast)[1]

    def _draw_constants(self, key: PRNGKeyArray) -> PyTree:
        """Constants of one episode's plant, each uniform in its range."""
        if self.constants is None:
            return self.plant.constants
        low, high = self.constants
        keys = jax.random.split(jax.random.fold_in(key, 1), len(low))
        drawn = [
            jax.random.uniform(k, (), float, a, b) for a, b, k in zip(low, high, keys, strict=True)
        ]
        return type(low)(*drawn)

    def _is_visible(self, state: Float[Array, " state"], params: Params) -> Bool[Array, ""]:
        """Whether the outputs are numbers in the single precision of an observation."""
        shown = self.plant.output(state, params) / jnp.asarray(self.layout.output_scale)
        return jnp.all(jnp.isfinite(shown.astype(jnp.float32)))

    def _transition(
        self, state: EnvState, output: Float[Array, " output"], gain: Float[Array, ""]
    ) -> Transition:
        plant = self.plant
        watched, warning, critical = watched_levels(plant.definition)
        cost = penalty(output[np.array(watched, int)], warning, critical)
        terminated = state.k >= self.layout.num_steps
        final = self.objective.final(plant, state.memory, state.params)
        # A run that cannot be computed has the penalty of a violation at every step, and no gain.
        cost = jnp.where(state.is_finite, cost, -1.0)
        worth = gain + jnp.where(terminated, final, 0.0)
        is_over = jnp.any(state.max_abs_output >= critical_levels(plant.definition))
        return Transition(
            observation=observe(jnp, self.layout, state.window, state.k),
            reward=self.penalty_weight * cost + worth,
            terminated=terminated,
            is_violation=is_over | ~state.is_finite,
            relative_errors=self.objective.relative_errors(plant, state.memory, state.params),
        )


def default_objective(plant: AbstractPlant, spread: SpreadLike) -> AbstractObjective:
    """The paper's objective for a plant with a mapping from ARX, else the information gained."""
    targets = target_mask(plant.definition, None)
    if isinstance(plant, AbstractARXPlant):
        return EstimationError(targets)
    return InformationGain(targets, prior_sd_of(spread))


class Batch(eqx.Module):
    """Many parallel episodes, each followed at once by another.

    Attributes:
        states: of all episodes.
        keys: from which their next episodes will be drawn.
    """

    states: EnvState
    keys: Key[Array, " env"]


@eqx.filter_jit
def reset_batch(
    env: Env, key: PRNGKeyArray, num_envs: int
) -> tuple[Batch, Float[Array, "env observation"]]:
    """`num_envs` episodes at their beginning."""
    keys = jax.vmap(jax.random.split)(jax.random.split(key, num_envs))
    states, observations = jax.vmap(env.reset)(keys[:, 0])
    return Batch(states, keys[:, 1]), observations


@eqx.filter_jit
def step_batch(
    env: Env, batch: Batch, actions: Float[Array, "env input"]
) -> tuple[Batch, Transition, Float[Array, "env observation"]]:
    """One step of every episode; one that ends is followed by another in the same step.

    Returns:
        The batch; the transitions, their observations the last ones of episodes that
        ended; and the observations to act on next.
    """
    states, transitions = jax.vmap(env.step)(batch.states, actions)

    def renewed(_: None) -> tuple[Batch, Array]:
        keys = jax.vmap(jax.random.split)(batch.keys)
        fresh, observations = jax.vmap(env.reset)(keys[:, 0])

        def choose(new: Array, old: Array) -> Array:
            ended = transitions.terminated.reshape(-1, *(1,) * (old.ndim - 1))
            return jnp.where(ended, new, old)

        chosen = jax.tree.map(choose, Batch(fresh, keys[:, 1]), Batch(states, batch.keys))
        return chosen, choose(observations, transitions.observation)

    def same(_: None) -> tuple[Batch, Array]:
        return Batch(states, batch.keys), transitions.observation

    batch, observations = jax.lax.cond(jnp.any(transitions.terminated), renewed, same, None)
    return batch, transitions, observations
