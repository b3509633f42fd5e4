"""Proximal policy optimisation of Stable-Baselines3 on a batch of plants.

The VecEnv passes on the batched Gymnasium environment: one compiled call per step, no loop
over environments. Training can be stopped at any rollout boundary and resumed bit by bit: a
checkpoint holds weights, Adam's moments, the running episodes and all random states, as
tensors and JSON, not as a pickle.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator
from typing import Any, NoReturn

import jax
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from ..environment import Env
from ..environment.gymnasium import ExperimentVectorEnv
from ..policy import Weights
from .checkpoint import Checkpoint, OnBoundary, Trained
from .settings import PPOSettings
from .validation import look


class BatchedVecEnv(VecEnv):
    """The batched environment as a VecEnv of Stable-Baselines3."""

    def __init__(self, env: ExperimentVectorEnv) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions = np.zeros(0)
        self.lengths = np.zeros(env.num_envs, int)
        self.totals = np.zeros(env.num_envs)
        self.last_returns = np.full(env.num_envs, np.nan)

    def reset(self) -> np.ndarray:
        """First observations."""
        self.totals[:], self.lengths[:] = 0, 0
        observations, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Stores the actions."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, object]]]:
        """One step of all; `info` of an ended episode has its last observation and its return."""
        observations, rewards, dones, _, final = self.env.step(self._actions)
        self.totals += rewards
        self.lengths += 1
        infos: list[dict[str, object]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(dones):
            infos[i] = {
                "terminal_observation": final["final_obs"][i],
                "episode": {"r": float(self.totals[i]), "l": int(self.lengths[i]), "t": 0.0},
                **{name: values[i] for name, values in final["final_info"].items()},
            }
        self.last_returns[dones] = self.totals[dones]
        self.totals[dones], self.lengths[dones] = 0, 0
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Nothing to release."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[object]:
        """An attribute of the batch, once for every index."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: object, indices: VecEnvIndices = None) -> NoReturn:
        """Not offered: the batch is one object."""
        raise NotImplementedError("the environments of a batch share all settings")

    def env_method(
        self, method_name: str, *args: object, indices: VecEnvIndices = None, **kwargs: object
    ) -> NoReturn:
        """Not offered: the batch is one object."""
        raise NotImplementedError("the environments of a batch have no methods")

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Always False: wrappers of single environments do not apply."""
        return [False] * len(list(self._get_indices(indices)))


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Limits torch to one thread: with small networks, more threads are slower."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@_one_thread()
def train(
    env: Env,
    settings: PPOSettings,
    seed: int,
    *,
    resume: Checkpoint | None = None,
    on_boundary: OnBoundary = lambda *_: None,
    log_folder: str | None = None,
) -> Trained:
    """Trains a policy; the same seed gives the same weights, interrupted or not.

    Args:
        resume: where to continue.
        on_boundary: called at every rollout boundary.
        log_folder: for TensorBoard.
    """
    choices = {field.name: getattr(env, field.name) for field in dataclasses.fields(env)}
    model = PPO(
        "MlpPolicy",
        BatchedVecEnv(ExperimentVectorEnv(settings.num_envs, **choices)),
        learning_rate=settings.learning_rate_at,
        n_steps=settings.n_steps,
        batch_size=settings.batch_size,
        n_epochs=settings.n_epochs,
        gamma=settings.gamma,
        gae_lambda=settings.gae_lambda,
        clip_range=settings.clip_range,
        ent_coef=settings.ent_coef,
        vf_coef=settings.vf_coef,
        max_grad_norm=settings.max_grad_norm,
        policy_kwargs={
            "net_arch": list(settings.hidden),
            "log_std_init": math.log(settings.noise_sd),
        },
        tensorboard_log=log_folder,
        seed=seed,
        device="cpu",
    )
    watcher = _Watcher(env, settings, on_boundary)
    watcher.model = model
    if resume is not None:
        _restore(model, watcher, resume)
    remaining = settings.total_steps - model.num_timesteps
    if remaining > 0:
        model.learn(remaining, watcher, reset_num_timesteps=resume is None)
    return Trained(watcher.weights, watcher.curve, watcher.curve[-1])


def policy_weights(model: PPO) -> Weights:
    """Matrices and biases of the deterministic policy."""
    policy: Any = model.policy
    layers = [m for m in policy.mlp_extractor.policy_net if hasattr(m, "weight")]
    return tuple(
        (m.weight.detach().numpy().copy(), m.bias.detach().numpy().copy())
        for m in (*layers, policy.action_net)
    )


class _Watcher(BaseCallback):
    """At every rollout boundary: anneals the noise, validates the policy, offers a checkpoint."""

    def __init__(self, env: Env, settings: PPOSettings, on_boundary: OnBoundary) -> None:
        super().__init__()
        self.env, self.settings, self.on_boundary = env, settings, on_boundary
        self.curve: list[dict[str, float]] = []
        self.num_averaged, self.averaged_at, self.average = 0, -1, ()

    def _on_rollout_start(self) -> None:
        model: Any = self.model
        num_rollouts = model.num_timesteps // (model.n_steps * model.n_envs)
        noise = self.settings.noise_at(model.num_timesteps / self.settings.total_steps)
        if noise is not None:
            model.policy.log_std.requires_grad_(False).fill_(math.log(noise))
        self._add_to_average()
        row = self._look() if num_rollouts % self.settings.watch_every == 0 else None
        self.on_boundary(lambda: _checkpoint(model, self), row)

    def _on_training_end(self) -> None:
        self._add_to_average()
        row = self._look()
        self.on_boundary(lambda: _checkpoint(self.model, self), row)

    def _on_step(self) -> bool:
        return True

    @property
    def weights(self) -> Weights:
        """Validation of the present policy."""
        model: Any = self.model
        return self.average if self.num_averaged else policy_weights(model)

    def _add_to_average(self) -> None:
        model: Any = self.model
        first = (1 - self.settings.average_last) * self.settings.total_steps
        is_early = model.num_timesteps < first or self.settings.average_last == 0
        if is_early or model.num_timesteps == self.averaged_at:  # or a checkpoint's boundary
            return
        n, newest = self.num_averaged, policy_weights(model)
        old = self.average if n else newest
        self.average = jax.tree.map(lambda a, b: (a * n + b) / np.float32(n + 1), old, newest)
        self.num_averaged, self.averaged_at = n + 1, model.num_timesteps

    def _look(self) -> dict[str, float] | None:
        model: Any = self.model
        if self.curve and self.curve[-1]["steps"] == model.num_timesteps:
            return None
        row = {
            "steps": float(model.num_timesteps),
            **look(self.env, self.weights, self.settings.watch_episodes),
            "sampled_return": float(np.mean(model.env.last_returns)),
            "noise_sd": float(model.policy.log_std.detach().exp().mean()),
        }
        self.curve.append(row)
        for name, value in row.items():
            if name != "steps":
                self.logger.record(f"deterministic/{name}", value)
        return row


def _checkpoint(model: Any, watcher: _Watcher) -> Checkpoint:
    tensors = {f"policy.{k}": v.numpy().copy() for k, v in model.policy.state_dict().items()}
    steps = {}
    for i, moments in model.policy.optimizer.state_dict()["state"].items():
        steps[str(i)] = float(moments["step"])
        tensors[f"adam.{i}.exp_avg"] = moments["exp_avg"].numpy().copy()
        tensors[f"adam.{i}.exp_avg_sq"] = moments["exp_avg_sq"].numpy().copy()
    for i, leaf in enumerate(_running_episodes(model)):
        tensors[f"episodes.{i}"] = leaf
    for i, leaf in enumerate(jax.tree.leaves(watcher.average)):
        tensors[f"average.{i}"] = leaf
    kind, words, position, has_gauss, gauss = np.random.get_state()
    tensors["random.numpy"] = np.asarray(words)
    tensors["random.torch"] = torch.get_rng_state().numpy()
    tensors["last_observations"] = model._last_obs
    tensors["last_starts"] = model._last_episode_starts
    tensors["totals"] = model.env.totals.copy()
    tensors["lengths"] = model.env.lengths.copy()
    tensors["last_returns"] = model.env.last_returns.copy()
    state = {
        "num_steps": model.num_timesteps,
        "num_updates": model._n_updates,
        "num_averaged": watcher.num_averaged,
        "adam_steps": steps,
        "numpy_random": [kind, position, has_gauss, gauss],
        "curve": watcher.curve,
    }
    return Checkpoint(tensors, state)


def _running_episodes(model: Any) -> list[np.ndarray]:
    leaves = jax.tree.leaves(model.env.env.batch)
    return [np.asarray(jax.random.key_data(x) if _is_key(x) else x) for x in leaves]


def _is_key(leaf: jax.Array) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _restore(model: Any, watcher: _Watcher, saved: Checkpoint) -> None:
    tensors, state = saved.tensors, saved.state
    prefix = "policy."
    model.policy.load_state_dict(
        {k[len(prefix) :]: torch.tensor(v) for k, v in tensors.items() if k.startswith(prefix)}
    )
    adam = model.policy.optimizer.state_dict()
    adam["state"] = {
        int(i): {
            "step": torch.tensor(step),
            "exp_avg": torch.tensor(tensors[f"adam.{i}.exp_avg"]),
            "exp_avg_sq": torch.tensor(tensors[f"adam.{i}.exp_avg_sq"]),
        }
        for i, step in state["adam_steps"].items()
    }
    model.policy.optimizer.load_state_dict(adam)
    vec_env = model.env
    vec_env.reset()
    old, structure = jax.tree.flatten(vec_env.env.batch)
    with jax.enable_x64(True):
        new = [_like(x, tensors[f"episodes.{i}"]) for i, x in enumerate(old)]
    vec_env.env.batch = jax.tree.unflatten(structure, new)
    vec_env.totals = np.array(tensors["totals"])
    vec_env.lengths = np.array(tensors["lengths"])
    vec_env.last_returns = np.array(tensors["last_returns"])
    model._last_obs = np.array(tensors["last_observations"])
    model._last_episode_starts = np.array(tensors["last_starts"])
    model.num_timesteps, model._n_updates = state["num_steps"], state["num_updates"]
    watcher.curve, watcher.num_averaged = list(state["curve"]), state["num_averaged"]
    structure = jax.tree.structure(policy_weights(model))
    if watcher.num_averaged:
        leaves = [tensors[f"average.{i}"] for i in range(structure.num_leaves)]
        watcher.average = jax.tree.unflatten(structure, leaves)
        watcher.averaged_at = model.num_timesteps
    kind, position, has_gauss, gauss = state["numpy_random"]
    np.random.set_state((kind, tensors["random.numpy"], position, has_gauss, gauss))
    torch.set_rng_state(torch.tensor(tensors["random.torch"]))


def _like(old: jax.Array, saved: np.ndarray) -> jax.Array:
    if _is_key(old):
        return jax.random.wrap_key_data(jax.numpy.asarray(saved))
    return jax.numpy.asarray(saved, old.dtype)
