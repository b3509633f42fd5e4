"""Preferences of a customer, learnt from how far one of two baskets is preferred to the other.

A benchmark of adaptive experiment design with 10 questions: A. Foster et al., A unified stochastic
gradient approach to designing Bayesian-optimal experiments, AISTATS 2020; T. Blau et al.,
Optimizing sequential experimental design with deep reinforcement learning, ICML 2022, whose box of
designs this is. The utility has a constant elasticity of substitution.
"""

import math

import jax.numpy as jnp
from jax.scipy.special import log_ndtr

from excite.description import Input, Output, Parameter
from excite.plant import AbstractStaticTask, static_description

LIMIT = math.log(2**22 - 1)  # the answer is given as 1 / (1 + exp(-slider)), at least 2^-22
NOISE = 0.005


class Elasticity(AbstractStaticTask):
    """The answer is a slider from one limit to the other, more exact where baskets are alike.

    The shares of the three goods in the utility are uniform (a Dirichlet distribution with ones)
    where `v_1` and `v_2` are uniform between 0 and 1.
    """

    definition = static_description(
        "elasticity",
        designs=tuple(Input(f"{side}_{i}", "", 0.01, 100.0) for side in "ab" for i in (1, 2, 3)),
        outcomes=(Output("slider", "", scale=10.0),),
        parameters=(
            Parameter("rho", "", 0.5, upper=1.0),
            Parameter("v_1", "", 0.5, upper=1.0),
            Parameter("v_2", "", 0.5, upper=1.0),
            Parameter("u", "", math.e),
        ),
    )

    def outcome(self, design, params):
        first = 1 - jnp.sqrt(1 - params.v_1)
        second = (1 - first) * params.v_2
        shares = first, second, 1 - first - second
        logs = jnp.log(design)

        def utility(basket):
            terms = (a * jnp.exp(params.rho * log) for a, log in zip(shares, basket, strict=True))
            return jnp.exp(jnp.log(sum(terms)) / params.rho)

        return params.u * (utility(logs[:3]) - utility(logs[3:]))[None]

    def noise_sd(self, design, params):
        """Standard deviation of the slider before it comes to a limit."""
        distance = jnp.sqrt(jnp.sum((design[:3] - design[3:]) ** 2))
        return params.u * NOISE * (1 + distance)

    def measured(self, design, params, noise):
        slider = self.outcome(design, params) + self.noise_sd(design, params) * noise
        return jnp.clip(slider, -LIMIT, LIMIT)

    def log_likelihood(self, measured, design, params):
        mean, sd = self.outcome(design, params), self.noise_sd(design, params)
        side = jnp.where(measured > 0, 1.0, -1.0)
        beyond = log_ndtr((side * mean - LIMIT) / sd)
        # A density inside the limits, a probability at them.
        inside = -0.5 * ((measured - mean) / sd) ** 2 - jnp.log(sd) - 0.5 * math.log(2 * math.pi)
        return jnp.sum(jnp.where(jnp.abs(measured) >= LIMIT, beyond, inside))
