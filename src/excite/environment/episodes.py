"""Evaluates an excitation: many experiments, each on another plant.

Signals and policies are evaluated by the same function. The plant and the noise of an
episode depend on its key alone.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PRNGKeyArray

from ..description import SpreadLike
from ..estimation.prior import PriorPlants
from ..excitation import AbstractExcitation, Coast
from ..information import cramer_rao_bound, experiment_information, relative_size
from ..plant import AbstractPlant, Params, draw_params
from ..plant.uncertainty import Uncertainty
from ..safety import critical_levels, is_violation, max_abs_output
from ..simulation import Trajectory, run_episode


class Episodes(eqx.Module):
    """A batch of evaluation episodes of one method; the leading axis is the episode.

    Attributes:
        params: true parameters.
        trajectory: inputs and outputs.
        is_violation: whether the critical level was reached.
        max_abs_output: largest magnitude of each output.
        information: relative Fisher information of each episode's inputs.
        bound: smallest relative standard deviation of each parameter (Cramér-Rao).
    """

    params: Params
    trajectory: Trajectory
    is_violation: Array
    max_abs_output: Float[Array, "*episode output"]
    information: Float[Array, "*episode param param"]
    bound: Float[Array, "*episode param"]


@eqx.filter_jit
def run_episodes(
    plant: AbstractPlant,
    excitation: AbstractExcitation,
    num_steps: int,
    spread: SpreadLike,
    keys: Key[Array, " episode"],
    uncertainty: Uncertainty | None = None,
    coast: int = 0,
    prior: PriorPlants | None = None,
) -> Episodes:
    """One episode per key. Plant and noise of a key are the same for any excitation.

    Args:
        plant: as identification knows it.
        excitation: proposes the inputs.
        num_steps: of an episode.
        spread: of the parameters around their nominal values.
        keys: of the episodes.
        uncertainty: in place of the spread, the box from which plants are drawn.
        coast: samples after the episode, under the input that ends it, whose outputs count as
            those of the episode; nothing is measured there.
        prior: in place of the spread, the distribution of the parameters.
    """
    whole, length = Coast.after(excitation, num_steps, coast)

    def episode(key: PRNGKeyArray) -> Episodes:
        params_key, episode_key = jax.random.split(key)
        if uncertainty is not None:
            true, own = uncertainty.at(uncertainty.draw(params_key))
        elif prior is not None:
            true, own = plant, prior.draw(params_key)
        else:
            true, own = plant, draw_params(plant, params_key, spread)
        run = run_episode(true, own, whole, length, episode_key)
        known = plant.Params(*(getattr(own, name) for name in plant.nominal._fields))
        return scored(plant, known, run, coast)

    return jax.vmap(episode)(keys)


def scored(plant: AbstractPlant, params: Params, run: Trajectory, coast: int = 0) -> Episodes:
    """One experiment with its information and its largest outputs.

    Args:
        coast: samples at the end of the run that are not part of the experiment.
    """
    end = len(run.inputs) - coast
    rows = run.time, run.measured, run.outputs
    time, measured, outputs = (x[: end + 1] for x in rows)
    trajectory = Trajectory(time, run.inputs[:end], measured, outputs)
    information = experiment_information(plant, params, trajectory.inputs, measured=measured)
    relative = relative_size(plant, params) / jnp.abs(jnp.stack(params))
    return Episodes(
        params=params,
        trajectory=trajectory,
        is_violation=is_violation(run.outputs, critical_levels(plant.definition)),
        max_abs_output=max_abs_output(run.outputs),
        information=information,
        bound=cramer_rao_bound(information) * relative,
    )
