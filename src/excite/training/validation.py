"""Validation of the policy during training: episodes without exploration noise."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray

from ..description import names_of
from ..environment import Env, EnvState
from ..policy import Weights, act

VALIDATION_SEED = 0x7A11DA7E
"""Seed of the validation episodes: the same for all trainings, not used elsewhere."""


class Validation(eqx.Module):
    """Episodes of a policy without exploration noise; the leading axis is the episode.

    Attributes:
        total_reward: undiscounted return.
        relative_errors: of the parameters, as the objective knows them.
        is_violation: whether a critical level was reached.
        rms_action: root mean square action of each episode, 1 is the input limit.
    """

    total_reward: Float[Array, "*episode"]
    relative_errors: Float[Array, "*episode param"]
    is_violation: Bool[Array, "*episode"]
    rms_action: Float[Array, "*episode"]


@eqx.filter_jit
def validate(env: Env, weights: Weights, keys: Key[Array, " episode"]) -> Validation:
    """One episode of the deterministic policy for every key."""

    def episode(key: PRNGKeyArray) -> Validation:
        start, _ = env.reset(key)

        def advance(state: EnvState, _: None) -> tuple[EnvState, tuple]:
            window, action = act(jnp, env.layout, weights, state.window, state.k)
            state, t = env.step(dataclasses.replace(state, window=window), action)
            return state, (t.reward, t.relative_errors, t.is_violation, jnp.mean(action**2))

        _, kept = jax.lax.scan(advance, start, None, length=env.layout.num_steps)
        rewards, errors, violations, squares = kept
        rms = jnp.sqrt(jnp.mean(squares))
        return Validation(jnp.sum(rewards), errors[-1], violations[-1], rms)

    return jax.vmap(episode)(keys)


def validation_keys(num_episodes: int) -> Key[Array, " episode"]:
    """Keys of the validation episodes."""
    return jax.random.split(jax.random.key(VALIDATION_SEED), num_episodes)


def look(env: Env, weights: Weights, num_episodes: int) -> dict[str, float]:
    """A row of the learning curve: results of the deterministic policy in validation episodes."""
    seen = validate(env, weights, validation_keys(num_episodes))
    names = names_of(env.plant.definition.parameters)
    errors = np.asarray(seen.relative_errors).mean(axis=0)
    return {
        "return": float(np.mean(seen.total_reward)),
        "violation_rate": float(np.mean(np.asarray(seen.is_violation), dtype=float)),
        "rms_action": float(np.sqrt(np.mean(np.asarray(seen.rms_action) ** 2))),
        **{f"relative_error_{n}": float(e) for n, e in zip(names, errors, strict=True)},
    }
