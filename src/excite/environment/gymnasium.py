"""The decision process as a Gymnasium environment: one plant, or hundreds as one batch.

    gymnasium.make("excite.environment.gymnasium:excite/Aero2-v0")
    gymnasium.make_vec("excite.environment.gymnasium:excite/Aero2-v0", num_envs=64)

Both run the same pure functions of `process`, compiled, and always in double precision.
Any choice of `Env.of` is a keyword argument (`objective`,
`layout`, `spread`, `penalty_weight`), and `plant` another plant of the class.

JAX does not support fork: processes of one environment each (`vectorization_mode="async"`)
must be spawned, `vector_kwargs={"context": "spawn"}`. The batch is much faster.
"""

from __future__ import annotations

import math
import multiprocessing
from typing import Any, TypedDict, Unpack

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Float, PyTree

from ..description import SpreadLike, names_of
from ..plant import EMPS, AbstractPlant, Aero2, CartPole, DCMotor
from ..policy import Layout
from .objective import AbstractObjective
from .process import Batch, Env, EnvState, Transition, reset_batch, step_batch

Observation = np.ndarray
Action = np.ndarray


class Choices(TypedDict, total=False):
    """Choices of `Env.of`."""

    objective: AbstractObjective
    layout: Layout
    spread: SpreadLike
    penalty_weight: float | Float[Array, ""]
    constants: tuple[PyTree, PyTree] | None


_reset = eqx.filter_jit(Env.reset)
_step = eqx.filter_jit(Env.step)


def _process(
    plant_class: type[AbstractPlant], plant: AbstractPlant | None, choices: Choices
) -> Env:
    """The process in double precision, whatever the precision of the given parts.

    Raises:
        ValueError: for a spread or a penalty weight that is not allowed.
        RuntimeError: in a forked process, where JAX would hang.
    """
    if type(multiprocessing.current_process()).__name__ == "ForkProcess":
        raise RuntimeError(
            "JAX does not support fork: spawn the processes, as with vector_kwargs="
            '{"context": "spawn"}, or step all environments as one batch, make_vec\'s default'
        )
    penalty_weight = choices.get("penalty_weight", 1.0)
    if not 0 <= penalty_weight < math.inf:
        raise ValueError(f"penalty_weight must lie in [0, inf): got {penalty_weight}")
    if getattr(choices.get("layout"), "memory", 0):
        raise ValueError("an environment's observation has no memory: leave that of the layout out")
    with jax.enable_x64(True):
        env = Env.of(plant_class() if plant is None else plant, **choices)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), env)


def _spaces(env: Env) -> tuple[spaces.Box, spaces.Box]:
    """Observation and action space of one plant."""
    layout, largest = env.layout, np.finfo(np.float32).max
    num_outputs = layout.window * len(layout.output_scale)
    high = np.ones(layout.size, np.float32)
    high[:num_outputs] = largest
    low = -high
    low[layout.size - 1 - 2 * len(layout.clocks)] = 0.0  # k / T
    observation = spaces.Box(low, high, dtype=np.float32)
    return observation, spaces.Box(-1.0, 1.0, (len(layout.input_half),), np.float32)


def _info(env: Env, transition: Transition) -> dict[str, np.ndarray]:
    """The `info` of a step; the errors are fractions."""
    names = names_of(env.plant.definition.parameters)
    errors = np.asarray(transition.relative_errors)
    return {
        "is_violation": np.asarray(transition.is_violation),
        **{f"relative_error_{name}": errors[..., i] for i, name in enumerate(names)},
    }


class ExperimentEnv(gymnasium.Env[Observation, Action]):
    """An experiment as a decision process (Langschwert et al., arXiv 2606.00059, for any plant).

    ## Description
    A plant with unknown parameters is drawn at the start of every episode. The agent
    chooses its input at every sample so that the parameters can be identified from the
    measurements, without an output reaching its critical level.

    ## Action Space
    `Box(-1, 1, (inputs,), float32)`. For `excite/Aero2-v0`:

    | Num | Action  | Min | Max | Stands for     | Unit |
    |-----|---------|-----|-----|----------------|------|
    | 0   | voltage | -1  | 1   | -24 V to 24 V  | V    |

    ## Observation Space
    `Box(low, high, (window (outputs + inputs) + 1,), float32)`, Eq. 2. For
    `excite/Aero2-v0` with its window of 80:

    | Num      | Observation                                              | Min      | Max     |
    |----------|----------------------------------------------------------|----------|---------|
    | 0 - 79   | last 80 measured pitch angles / 45 degrees, oldest first | -3.4e+38 | 3.4e+38 |
    | 80 - 159 | last 80 voltages / 24 V, oldest first                    | -1       | 1       |
    | 160      | k / T                                                    | 0        | 1       |

    Samples before the first are zero.

    ## Rewards
    At every step the safety penalty of Eq. 3 on the true outputs: down to -0.1 between
    warning and critical level, -1 and below beyond. At the last step minus the sum of the
    relative errors of the estimated parameters (Eq. 4). Plants without a mapping from ARX
    coefficients get the increment of log det of the Fisher information at every step.

    ## Starting State
    The plant's initial state (at rest); parameters uniform in nominal ± 30 %.

    ## Episode End
    `terminated` after T = 500 steps; `truncated` is never true, because T is part of the
    process and k / T is observed.

    ## Information
    `is_violation`, and `relative_error_NAME` of each parameter so far.

    ## Arguments
    `plant`, and all choices of `excite.environment.Env.of`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (as Gymnasium requires)

    def __init__(
        self,
        plant_class: type[AbstractPlant] = Aero2,
        plant: AbstractPlant | None = None,
        render_mode: None = None,
        **choices: Unpack[Choices],
    ) -> None:
        self.render_mode = render_mode
        self.process = _process(plant_class, plant, choices)
        self.observation_space, self.action_space = _spaces(self.process)
        self._state: EnvState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[Observation, dict[str, object]]:
        """A new plant; the same seed draws the same plants and the same noise."""
        super().reset(seed=seed)
        with jax.enable_x64(True):
            key = jax.random.key(self.np_random.integers(2**63))
            self._state, observation = _reset(self.process, key)
            return np.array(observation), {}

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, object]]:
        """One sampling time."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded(
                "no episode is running: call reset before the first step and after the last"
            )
        with jax.enable_x64(True):
            state, transition = _step(self.process, self._state, jnp.asarray(action))
            self._state = None if transition.terminated else state
            info = {k: v.item() for k, v in _info(self.process, transition).items()}
            observation = np.array(transition.observation)
            return observation, float(transition.reward), bool(transition.terminated), False, info


class ExperimentVectorEnv(VectorEnv[Observation, Action, np.ndarray]):
    """Many experiments stepped as one compiled batch; spaces and rewards of `ExperimentEnv`.

    Autoreset is SAME_STEP: where an episode ends, the observation returned is the first
    of the next one, and `final_obs` and `final_info` of the infos hold the last of the one
    that ended (rows where `_final_obs` is true).
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        plant_class: type[AbstractPlant] = Aero2,
        plant: AbstractPlant | None = None,
        render_mode: None = None,
        **choices: Unpack[Choices],
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1: got {num_envs}")
        self.num_envs, self.render_mode = num_envs, render_mode
        self.process = _process(plant_class, plant, choices)
        self.single_observation_space, self.single_action_space = _spaces(self.process)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.batch: Batch | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[Observation, dict[str, object]]:
        """New plants in all environments."""
        super().reset(seed=seed)
        with jax.enable_x64(True):
            key = jax.random.key(self.np_random.integers(2**63))
            self.batch, observations = reset_batch(self.process, key, self.num_envs)
            return np.array(observations), {}

    def step(
        self, actions: Action
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One sampling time in all environments."""
        if self.batch is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        with jax.enable_x64(True):
            self.batch, transition, observations = step_batch(
                self.process, self.batch, jnp.asarray(actions)
            )
            terminated = np.array(transition.terminated)
            infos: dict[str, object] = {}
            if terminated.any():
                infos = {
                    "final_obs": np.array(transition.observation),
                    "_final_obs": terminated,
                    "final_info": _info(self.process, transition),
                    "_final_info": terminated,
                }
            rewards, never = np.array(transition.reward), np.zeros(self.num_envs, bool)
            return np.array(observations), rewards, terminated, never, infos


for _class in (Aero2, CartPole, DCMotor, EMPS):
    gymnasium.register(
        id=f"excite/{_class.__name__}-v0",
        entry_point="excite.environment.gymnasium:ExperimentEnv",
        vector_entry_point="excite.environment.gymnasium:ExperimentVectorEnv",
        kwargs={"plant_class": _class},
    )
