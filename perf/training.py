"""PPO on a batch of plants against Stable-Baselines3's defaults on a plain NumPy environment.

Both train the paper's agent on its decision process with two layers of 64, on all cores of
this machine: ours on 64 plants as one batch, the peer as a user would who writes a
Gymnasium environment and calls `PPO("MlpPolicy", env).learn(...)`. The ratio is that of
environment steps per second, rollouts and updates included.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path

from stable_baselines3 import PPO

from excite.environment import Env
from excite.plant import Aero2
from excite.training.ppo import train
from excite.training.settings import PPOSettings

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from plain_env import PlainAero2Env  # noqa: E402 - it stands beside the tests

PEER_ROLLOUTS, OUR_ROLLOUTS = 8, 8
NUM_ENVS, NUM_STEPS, BATCH_SIZE = 64, 500, 2000


def main() -> None:
    model = PPO("MlpPolicy", PlainAero2Env(), device="cpu", seed=0)
    model.learn(model.n_steps)  # what is done once is not counted
    start = time.process_time()
    model.learn(PEER_ROLLOUTS * model.n_steps)
    theirs = PEER_ROLLOUTS * model.n_steps / (time.process_time() - start)
    print(f"Stable-Baselines3, its defaults, NumPy environment: {theirs:,.0f} steps/s")

    env, rollout = Env.of(Aero2()), NUM_ENVS * NUM_STEPS
    short = PPOSettings(
        total_steps=rollout, num_envs=NUM_ENVS, n_steps=NUM_STEPS, batch_size=BATCH_SIZE,
        watch_every=10_000,
    )  # fmt: skip
    train(env, short, 0)  # compiles
    start = time.process_time()
    train(env, dataclasses.replace(short, total_steps=OUR_ROLLOUTS * rollout), 0)
    ours = OUR_ROLLOUTS * rollout / (time.process_time() - start)
    print(f"ours, {NUM_ENVS} plants as one batch: {ours:,.0f} steps/s")
    print(f"ratio: {ours / theirs:.1f}")


if __name__ == "__main__":
    main()
