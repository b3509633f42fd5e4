"""PPO on a batch of plants against Stable-Baselines3's defaults on a plain NumPy environment.

Both train the paper's agent on its decision process with two layers of 64, on all cores of
this machine: ours as `studies/table1.toml` does, the peer as a user would who writes a
Gymnasium environment and calls `PPO("MlpPolicy", env).learn(...)`. The ratio is that of
environment steps per second, rollouts and updates included.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import dataclasses  # noqa: E402

from plain_env import PlainAero2Env  # noqa: E402
from stable_baselines3 import PPO  # noqa: E402

from excite.study import read_study  # noqa: E402
from excite.training.ppo import train  # noqa: E402

PEER_ROLLOUTS, OUR_ROLLOUTS = 8, 8


def main() -> None:
    model = PPO("MlpPolicy", PlainAero2Env(), device="cpu", seed=0)
    model.learn(model.n_steps)  # what is done once is not counted
    start = time.perf_counter()
    model.learn(PEER_ROLLOUTS * model.n_steps)
    theirs = PEER_ROLLOUTS * model.n_steps / (time.perf_counter() - start)
    print(f"Stable-Baselines3, its defaults, NumPy environment: {theirs:,.0f} steps/s")

    study = read_study(ROOT / "studies" / "table1.toml")
    env, settings = study.build_env(study.build_plant(), "RL(all)"), study.build_training("RL(all)")
    rollout = settings.num_envs * settings.n_steps
    short = dataclasses.replace(settings, total_steps=rollout, watch_every=10_000)
    train(env, short, 0)  # compiles
    start = time.perf_counter()
    train(env, dataclasses.replace(short, total_steps=OUR_ROLLOUTS * rollout), 0)
    ours = OUR_ROLLOUTS * rollout / (time.perf_counter() - start)
    print(f"ours, {settings.num_envs} plants as one batch: {ours:,.0f} steps/s")
    print(f"ratio: {ours / theirs:.1f}")


if __name__ == "__main__":
    main()
