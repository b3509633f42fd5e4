"""The body of `Aero2` as a unit of its own, which `test_fmu` exports with pythonfmu.

It imports nothing of excite, so that what the two agree on is physics. The parameter
`fails_at` ends it at that time as a unit that diverges does; `raises` says how badly.
"""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

SUBSTEPS = 20


class PitchUnit(Fmi2Slave):
    """Pitch by the classical Runge-Kutta method with many small steps."""

    def __init__(self, **kwargs) -> None:
        super().__init__(**kwargs)
        self.voltage, self.pitch, self.rate = 0.0, 0.0, 0.0
        self.J_p, self.K_pu, self.D_p, self.stiffness = 0.0232, 0.0125, 0.00104, 0.0204
        self.fails_at, self.raises = 1e9, 0.0
        fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        self.register_variable(Real("voltage", causality=Fmi2Causality.input))
        self.register_variable(Real("pitch", causality=Fmi2Causality.output))
        self.register_variable(Real("rate", causality=Fmi2Causality.local))
        for name in ("J_p", "K_pu", "D_p", "stiffness", "fails_at", "raises"):
            self.register_variable(Real(name, **fixed))

    def derivative(self, pitch: float, rate: float) -> tuple[float, float]:
        torque = -self.D_p * rate - self.stiffness * math.sin(pitch)
        return rate, 2 * self.K_pu * self.voltage + torque / self.J_p

    def do_step(self, current_time: float, step_size: float) -> bool:
        if current_time + step_size > self.fails_at:
            if self.raises:
                raise FloatingPointError("the pitch diverged")
            return False
        h = step_size / SUBSTEPS
        for _ in range(SUBSTEPS):
            x, v = self.pitch, self.rate
            a1, b1 = self.derivative(x, v)
            a2, b2 = self.derivative(x + h / 2 * a1, v + h / 2 * b1)
            a3, b3 = self.derivative(x + h / 2 * a2, v + h / 2 * b2)
            a4, b4 = self.derivative(x + h * a3, v + h * b3)
            self.pitch = x + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
            self.rate = v + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
        return True
