"""Falsification on the simulated rig: the experiments of a search as the rig runs them.

Latency and jitter, readings between the samples, the supervisor's trips and, where there is
one, the safety filter. Levels are judged by the true outputs at all readings, also after a trip.
"""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..environment.falsification import AbstractExperiments, Cases, nearness
from ..excitation import AbstractExcitation
from ..plant.uncertainty import Uncertainty
from ..safety import Supervision
from ..simulation import Trajectory
from .excitation import excitation_key
from .filter import AbstractFilter
from .simulated import (
    NO_FILTER,
    Hardware,
    Runs,
    at_interval,
    num_written,
    one_run,
    readings_per_sample,
    usual_numbers,
)


class OnRig(AbstractExperiments):
    """Experiments of an excitation on simulated rigs with the plants of a box.

    Attributes:
        uncertainty: the box, with the interval between two readings as its plant's dt.
        excitation: plays.
        safety_filter: between excitation and supervisor.
        numbers: `latency`, `jitter` and `dropout` of the rigs.
        rules: of the supervisor.
        num_steps: of an experiment.
        num_readings: in one sampling time.
        num_written: see `Hardware`.
    """

    uncertainty: Uncertainty
    excitation: AbstractExcitation
    safety_filter: AbstractFilter
    numbers: dict[str, Float[Array, ""]]
    rules: Supervision = eqx.field(static=True)
    num_steps: int = eqx.field(static=True)
    num_readings: int = eqx.field(static=True)
    num_written: int = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        uncertainty: Uncertainty,
        excitation: AbstractExcitation,
        num_steps: int,
        safety_filter: AbstractFilter = NO_FILTER,
        num_readings: int | None = None,
        **numbers: float,
    ) -> OnRig:
        """Experiments on the rigs of a box.

        Args:
            uncertainty: the box, of a plant sampled as experiments are.
            excitation: plays.
            num_steps: of an experiment.
            safety_filter: between excitation and supervisor.
            num_readings: in one sampling time; default those of the simulated rig.
            numbers: `latency`, `jitter`, `dropout`, see `Hardware.draw`.
        """
        plant, box = uncertainty.plant, uncertainty
        num_readings = num_readings or readings_per_sample(plant)

        def delay(point: Array) -> Array | None:
            there, params = box.at(point)
            return there.delay(params)

        return cls(
            uncertainty=dataclasses.replace(box, plant=at_interval(plant, num_readings)),
            excitation=excitation,
            safety_filter=safety_filter,
            numbers=usual_numbers(float(plant.dt), num_readings, numbers),
            rules=safety_filter.supervision(Supervision.of(plant.description)),
            num_steps=num_steps,
            num_readings=num_readings,
            num_written=num_written(delay, len(box.names), float(plant.dt)),
        )

    def __call__(self, case: Cases) -> Float[Array, ""]:
        """The nearness of one case."""
        return nearness(self.uncertainty.plant, self.run(case).max_abs_output[None])

    def run(self, case: Cases) -> Runs:
        """The experiment of one case."""
        return one_run(
            self.hardware(case),
            self.excitation,
            self.rules,
            self.num_steps,
            self.num_readings,
            self.safety_filter,
            case.noise,
            excitation_key(case.seed),
        )

    def replayed(self, case: Cases) -> tuple[Trajectory, float]:
        """The record of one case, what is read when inputs begin to act, and its nearness."""
        run = _run(self, case)
        time = jnp.arange(len(run.measured)) * self.rules.dt
        size = nearness(self.uncertainty.plant, run.max_abs_output[None])
        return Trajectory(time, run.inputs, run.measured, run.measured), float(size)

    def noise(self, case: Cases) -> Float[Array, "sample output"]:
        """The noise of a case's seed at all readings, in standard deviations."""
        length = self.num_steps + self.safety_filter.num_more
        count = (length + 1) * self.num_readings + 1
        return self.hardware(case).reading_noise(count)

    def hardware(self, case: Cases) -> Hardware:
        """The rig of one case; its key is that of `Hardware.draw` with the case's seed."""
        plant, params = self.uncertainty.at(case.point)
        key = jax.random.split(jax.random.key(case.seed))[1]
        n = self.numbers
        return Hardware(
            plant, params, n["latency"], n["jitter"], n["dropout"], key,
            num_written=self.num_written,
        )  # fmt: skip


_run = eqx.filter_jit(OnRig.run)
