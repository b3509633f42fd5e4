"""Finding sources by the intensity that they cause where it is measured.

Benchmarks of adaptive experiment design with 30 measurements. Two sources: A. Foster et al., Deep
adaptive design, ICML 2021; T. Blau et al., Optimizing sequential experimental design with deep
reinforcement learning, ICML 2022, whose box of designs this is. One source, uniform in the unit
square as are the designs: D. Huang et al., ALINE, NeurIPS 2025.
"""

import jax.numpy as jnp

from excite.description import Input, Output, Parameter
from excite.plant import AbstractStaticTask, static_description

BACKGROUND, NEAREST = 0.1, 1e-4


def intensity(design, x, y):
    """That a source causes at a design."""
    return 1 / (NEAREST + (design[0] - x) ** 2 + (design[1] - y) ** 2)


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
        first = intensity(design, params.x_1, params.y_1)
        second = intensity(design, params.x_2, params.y_2)
        return jnp.log(BACKGROUND + first + second)[None]


class OneSource(AbstractStaticTask):
    """One source, anywhere in the unit square."""

    definition = static_description(
        "one_source",
        designs=(Input("x", "", 0.0, 1.0), Input("y", "", 0.0, 1.0)),
        outcomes=(Output("log_intensity", "", scale=2.0, noise_sd=0.5),),
        parameters=tuple(
            Parameter(name, "", 0.5, scale=1.0, positive=False) for name in ("x_1", "y_1")
        ),
    )

    def outcome(self, design, params):
        return jnp.log(BACKGROUND + intensity(design, params.x_1, params.y_1))[None]
