"""Finding two sources by the intensity that they cause where it is measured.

A benchmark of adaptive experiment design: A. Foster et al., Deep adaptive design, ICML 2021;
T. Blau et al., Optimizing sequential experimental design with deep reinforcement learning, ICML
2022, whose box of designs this is. Their figures are for 30 measurements.
"""

import jax.numpy as jnp

from excite.description import Input, Output, Parameter
from excite.plant import AbstractStaticTask, static_description

BACKGROUND, NEAREST = 0.1, 1e-4


class TwoSources(AbstractStaticTask):
    """Two sources in a plane, each coordinate normal with standard deviation one."""

    definition = static_description(
        "two_sources",
        designs=(Input("x", "", -4.0, 4.0), Input("y", "", -4.0, 4.0)),
        outcomes=(Output("log_intensity", "", scale=2.0, noise_sd=0.5),),
        parameters=tuple(
            Parameter(name, "", 0.0, scale=1.0, positive=False)
            for name in ("x_1", "y_1", "x_2", "y_2")
        ),
    )

    def outcome(self, design, params):
        x, y = design
        first = (params.x_1 - x) ** 2 + (params.y_1 - y) ** 2
        second = (params.x_2 - x) ** 2 + (params.y_2 - y) ** 2
        intensity = BACKGROUND + 1 / (NEAREST + first) + 1 / (NEAREST + second)
        return jnp.log(intensity)[None]
