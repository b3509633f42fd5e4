"""Training by gradient against PPO: wall time to the same information, at no more violations.

Both train a policy of two layers of 64 on the same decision process of the Aero 2 for the
log det of the Fisher information; PPO with its increments at every step as reward. The
gradient's clock stops at the first look whose mean log det is at least PPO's final one and
whose violation rate is at most PPO's, on 1000 held-out plants. Compilation is printed
apart, and what the looks take is not counted.
"""

from __future__ import annotations

import dataclasses
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from excite.description import prior_sd_of
from excite.environment import Env, InformationGain
from excite.plant import Aero2
from excite.policy import Layout
from excite.training import gradient, ppo
from excite.training.settings import PPOSettings

KEYS = jax.random.split(jax.random.key(2**40), 1000)
PPO = PPOSettings(
    total_steps=int(sys.argv[1]) if len(sys.argv) > 1 else 3_840_000, num_envs=64, n_steps=500,
    batch_size=2000, n_epochs=10, gamma=0.999, learning_rate=5e-4, learning_rate_end=1e-4,
    noise_sd=0.6, noise_sd_end=0.05, average_last=0.25, watch_every=10_000,
)  # fmt: skip


def process(is_dense: bool) -> Env:
    """The paper's observation of the Aero 2, rewarded for information."""
    plant = Aero2()
    layout = dataclasses.replace(Layout.of(plant.description), output_scale=(0.3,))
    objective = InformationGain((True, True, True), prior_sd_of(0.3), dense=is_dense)
    return Env.of(plant, objective=objective, layout=layout)


def judged(env: Env, player: gradient.Network) -> tuple[float, float]:
    """Mean log det gained over the prior, and violation rate."""
    batch = gradient.experiments(env, player, KEYS, 0.9)
    return float(jnp.mean(batch.worth)), float(np.mean(np.asarray(batch.nearness) >= 1))


def timed_ppo() -> tuple[float, float, float]:
    """Seconds of PPO after compilation, and what its policy reaches."""
    env = process(True)
    start = time.perf_counter()
    ppo.train(env, dataclasses.replace(PPO, total_steps=32_000), 0)
    print(f"PPO, compilation and first rollout: {time.perf_counter() - start:.1f} s")
    start = time.perf_counter()
    weights = ppo.train(env, PPO, 0).weights
    seconds = time.perf_counter() - start
    layers = tuple((jnp.asarray(m), jnp.asarray(b)) for m, b in weights)
    return seconds, *judged(process(False), gradient.Network(layers, env.layout))


def timed_gradient(goal: float, rate: float) -> tuple[float, float, float]:
    """Seconds of training by gradient until it reaches a goal."""
    env, settings = process(False), gradient.GradientSettings(num_updates=1000)
    course, keys = gradient.started(env, settings, [0])
    start = time.perf_counter()
    jax.block_until_ready(gradient.update_all(env, settings, course.now, keys(0), False, None))
    print(f"gradient, compilation and first update: {time.perf_counter() - start:.1f} s")
    now, seconds = course.now, 0.0
    for i in range(settings.num_updates):
        start = time.perf_counter()
        now, _ = jax.block_until_ready(
            gradient.update_all(env, settings, now, keys(i), False, None)
        )
        seconds += time.perf_counter() - start
        if (i + 1) % 10 == 0:
            worth, violations = judged(env, jax.tree.map(lambda leaf: leaf[0], now.player))
            if worth >= goal and violations <= rate:
                return seconds, worth, violations
    raise SystemExit("training by gradient did not reach PPO's information")


def main() -> None:
    """Prints both times and their ratio."""
    seconds, goal, rate = timed_ppo()
    print(
        f"PPO: {goal:.2f} in log det over the prior, {100 * rate:.1f} % violations, {seconds:.1f} s"
    )
    own, worth, violations = timed_gradient(goal, rate)
    print(f"gradient: {worth:.2f}, {100 * violations:.1f} % violations, {own:.1f} s")
    print(f"ratio: {seconds / own:.1f}")


if __name__ == "__main__":
    main()
