"""Four plants on which methods of adaptive experiment design are compared.

They are those of Inside-Out SMC² (S. Iqbal et al., Nesting particle filters for experimental design
in dynamical systems, ICML 2024), as in its source, github.com/Sahel13/InsideOutSMC.jl at ac40a4e:
the whole state is observed, and each step adds process noise. Noise of variance 1e-8 is added to
every state, in the simulation as in the likelihood.
"""

import jax.numpy as jnp

from excite.description import Constant, Input, Output, Parameter, PlantDescription, State
from excite.plant import AbstractPlant

DT = 0.05
SEEN = 1e-4
"""Standard deviation of a state without process noise of its own."""
NOISY = (0.1**2 * DT + SEEN**2) ** 0.5


class _Observed(AbstractPlant):
    def output(self, state, params):
        return state


def _description(name, states, inputs, parameters, constants=()):
    return PlantDescription(
        name=name,
        states=tuple(State(n, unit, noise_sd=sd) for n, unit, sd, _ in states),
        inputs=tuple(inputs),
        outputs=tuple(Output(n, unit, scale=scale) for n, unit, _, scale in states),
        parameters=tuple(parameters),
        constants=tuple(Constant(n, unit, value) for n, unit, value in constants),
        dt=DT,
        integrator="euler",
    )


class LinearPendulum(_Observed):
    """A pendulum whose acceleration is linear in its parameters."""

    definition = _description(
        "linear_pendulum",
        [("angle", "rad", SEEN, 1.0), ("speed", "rad/s", NOISY, 4.0)],
        [Input("torque", "N m", -1.0, 1.0)],
        [
            Parameter("a", "1/s²", 14.7, positive=False),
            Parameter("b", "1/s", 0.0, scale=1.0, positive=False),
            Parameter("c", "1/(kg m²)", 3.0, positive=False),
        ],
    )

    def derivative(self, state, input, params):
        q, w = state
        return jnp.stack([w, -params.a * jnp.sin(q) - params.b * w + params.c * input[0]])


class NonlinearPendulum(_Observed):
    """A pendulum of unknown mass and length."""

    definition = _description(
        "nonlinear_pendulum",
        [("angle", "rad", SEEN, 1.0), ("speed", "rad/s", NOISY, 4.0)],
        [Input("torque", "N m", -1.0, 1.0)],
        [Parameter("m", "kg", 1.0), Parameter("l", "m", 1.0)],
        [("g", "m/s²", 9.81), ("d", "N m s/rad", 0.1)],
    )

    def derivative(self, state, input, params):
        c, (q, w) = self.constants, state
        m, l = params.m, params.l  # noqa: E741
        return jnp.stack(
            [w, -3 * c.g / (2 * l) * jnp.sin(q) + 3 * (input[0] - c.d * w) / (m * l**2)]
        )


class CartPole(_Observed):
    """A cart with a pole that hangs down, of unknown length and masses."""

    definition = _description(
        "smc_cart_pole",
        [
            ("position", "m", SEEN, 1.0), ("angle", "rad", SEEN, 1.0),
            ("velocity", "m/s", NOISY, 3.0), ("angle_rate", "rad/s", SEEN, 5.0),
        ],
        [Input("force", "N", -5.0, 5.0)],
        [Parameter("l", "m", 1.0), Parameter("m_p", "kg", 1.0), Parameter("m_c", "kg", 1.0)],
        [
            ("g", "m/s²", 9.81), ("c", "N s/m", 0.01), ("k", "N/m", 0.01),
            ("d", "N m s/rad", 0.01), ("nu", "N m/rad", 0.01),
        ],
    )  # fmt: skip

    def derivative(self, state, input, params):
        o, (s, q, v, w), u = self.constants, state, input[0]
        l, m_p, m_c = params.l, params.m_p, params.m_c  # noqa: E741
        sin, cos = jnp.sin(q), jnp.cos(q)
        slide = o.c * v + o.k * s
        hinge = (o.d * w + o.nu * q) * cos / l
        size = m_c + m_p * sin**2
        cart = (u - slide - hinge + m_p * sin * (l * w**2 + o.g * cos)) / size
        # The sign of the sliding friction is that of the source.
        force = -u * cos - slide * cos
        gravity = -m_p * l * w**2 * cos * sin - (m_c + m_p) * o.g * sin
        return jnp.stack([v, w, cart, (force + gravity - hinge * cos) / (l * size)])


class DoublePendulum(_Observed):
    """Two pendulums, one on the other, of unknown masses and lengths."""

    definition = _description(
        "double_pendulum",
        [
            ("angle_1", "rad", SEEN, 1.0), ("angle_2", "rad", SEEN, 1.0),
            ("speed_1", "rad/s", NOISY, 4.0), ("speed_2", "rad/s", NOISY, 4.0),
        ],
        [Input("torque_1", "N m", -4.0, 4.0), Input("torque_2", "N m", -2.0, 2.0)],
        [
            Parameter("m_1", "kg", 1.0), Parameter("m_2", "kg", 1.0),
            Parameter("l_1", "m", 1.0), Parameter("l_2", "m", 1.0),
        ],
        [("g", "m/s²", 9.81), ("k_1", "N m s/rad", 0.1), ("k_2", "N m s/rad", 0.1)],
    )  # fmt: skip

    def derivative(self, state, input, params):
        o, (q1, q2, w1, w2) = self.constants, state
        m1, m2, l1, l2 = params.m_1, params.m_2, params.l_1, params.l_2
        off = m2 * l2**2 + m2 * l1 * l2 * jnp.cos(q2)
        first = (m1 + m2) * l1**2 + m2 * l2**2 + 2 * m2 * l1 * l2 * jnp.cos(q2)
        last = m2 * l2**2
        coupling = m2 * l1 * l2 * jnp.sin(q2)
        coriolis_1 = -coupling * (2 * w1 + w2) * w2
        coriolis_2 = coupling * ((2 * w1 + w2) * w1 - w1 * w2) / 2
        lower = m2 * l2 * jnp.sin(q1 + q2)
        r1 = -o.g * ((m1 + m2) * l1 * jnp.sin(q1) + lower) + input[0] - o.k_1 * w1 - coriolis_1
        r2 = -o.g * lower + input[1] - o.k_2 * w2 - coriolis_2
        size = first * last - off**2
        return jnp.stack([w1, w2, (last * r1 - off * r2) / size, (first * r2 - off * r1) / size])
