"""The same work on this machine's accelerator and on its processor: ratio of wall times.

Simulation and fits of the Aero 2, a gradient update of its policy, and the evidence of records of
two sources from samples of the prior. Compilation is not counted. The processor is measured by
a process of its own, without the accelerator.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax

import excite as ex
from excite.environment import Env, InformationGain
from excite.estimation import NLS, stack_experiments
from excite.estimation.information_gain import gains
from excite.estimation.prior_knowledge import plants_of
from excite.excitation import PRBS, Random
from excite.plant import Aero2, draw_params
from excite.plant.catalogue import plant_named
from excite.policy import Layout
from excite.simulation import run_episode
from excite.training.gradient import train
from excite.training.settings import GradientSettings

STEPS = 500
TASK = Path(__file__).parent.parent / "examples" / "location_finding.py"


def experiments(count: int) -> Callable[[], object]:
    """Records of as many plants, 500 samples each."""
    plant, keys = Aero2(), jax.random.split(jax.random.key(0), count)

    @eqx.filter_jit
    def made(keys):
        return jax.vmap(
            lambda key: run_episode(plant, draw_params(plant, key, 0.3), PRBS(), STEPS, key)
        )(keys)

    return lambda: made(keys)


def fits(count: int) -> Callable[[], object]:
    """As many fits by nonlinear least squares, each of its own record."""
    plant, records = Aero2(), experiments(count)()

    @eqx.filter_jit
    def fitted(inputs, measured):
        return jax.vmap(lambda u, y: NLS()(plant, stack_experiments(plant, [u], [y], True)).params)(
            inputs, measured
        )

    return lambda: fitted(records.inputs, records.measured)


def updates(count: int) -> Callable[[], object]:
    """A training on 1,024 plants at once, for the information of 100 samples."""
    objective = InformationGain((True,) * 3, 0.3, dense=False)
    env = Env.of(Aero2(), objective=objective, layout=Layout.of(Aero2().description, 10, 100))
    settings = GradientSettings(num_updates=count, num_plants=1024, watch_every=count,
                                watch_episodes=64)  # fmt: skip
    return lambda: train(env, settings, 0).weights


def evidence(count: int) -> Callable[[], object]:
    """The bound of as many records of 30 designs, from 100,000 samples each."""
    task = plant_named(f"{TASK}:TwoSources")
    prior = plants_of(task, dict.fromkeys(("x_1", "y_1", "x_2", "y_2"), "normal:0:1"))
    keys = jax.random.split(jax.random.key(0), count)
    return lambda: gains(prior, Random(hold=1), 30, keys, 100_000, True)


WORK = {
    "10,000 experiments": (experiments, 10_000),
    "evidence of 256 records": (evidence, 256),
    "20 updates of a training": (updates, 20),
    "1,000 fits": (fits, 1000),
}


def seconds(work: Callable[[int], Callable[[], object]], count: int) -> float:
    """Wall time of the second call."""
    call = work(count)
    jax.block_until_ready(call())
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def main() -> None:
    if "processor" in sys.argv:
        print(json.dumps({name: seconds(*work) for name, work in WORK.items()}))
        return
    own = {**os.environ, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, __file__, "processor"]
    ran = subprocess.run(command, env=own, check=True, stdout=subprocess.PIPE, text=True)
    theirs = json.loads(ran.stdout)
    print(f"{jax.devices()[0].device_kind}; jax {jax.__version__}, excite {ex.__version__}")
    for name, work in WORK.items():
        ours = seconds(*work)
        ratio = f"{theirs[name] / ours:.1f}"
        print(f"{name}: {ours:.3f} s, on the processor {theirs[name]:.3f} s: {ratio}", flush=True)


if __name__ == "__main__":
    main()
