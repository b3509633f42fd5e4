"""Several objectives at once."""

from __future__ import annotations

import dataclasses
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from ..plant import AbstractPlant, Params
from .objective import AbstractObjective, StepData


class SumMemory(eqx.Module):
    """Memories of the terms, and the reward of each so far."""

    terms: tuple[PyTree, ...]
    gained: Float[Array, " term"]


class WeightedSum(AbstractObjective):
    """Weighted sum of objectives: information, errors, several criteria or estimators.

    Attributes:
        terms: objectives, each with its weight.
    """

    terms: tuple[AbstractObjective, ...] = eqx.field(converter=tuple)

    def __check_init__(self) -> None:
        """Raises ValueError without terms."""
        if not self.terms:
            raise ValueError("a sum of objectives needs at least one")

    def first_trained(self, plant: AbstractPlant, key: PRNGKeyArray) -> tuple[PyTree, ...]:
        """Those of the terms."""
        keys = jax.random.split(key, len(self.terms))
        return tuple(t.first_trained(plant, own) for t, own in zip(self.terms, keys, strict=True))

    def with_trained(self, trained: tuple[PyTree, ...] | None) -> Self:
        """With what was trained of each term."""
        if trained is None:
            return self
        pairs = zip(self.terms, trained, strict=True)
        terms = tuple(term.with_trained(own) for term, own in pairs)
        return dataclasses.replace(self, terms=terms)

    def require_steps(self, num_steps: int) -> None:
        """Raises ValueError where a term is for experiments of another length."""
        for term in self.terms:
            term.require_steps(num_steps)

    def init(
        self, plant: AbstractPlant, measured: Float[Array, " output"], key: PRNGKeyArray
    ) -> SumMemory:
        """Memory of every term."""
        keys = jax.random.split(key, len(self.terms))
        pairs = zip(self.terms, keys, strict=True)
        memories = tuple(term.init(plant, measured, own) for term, own in pairs)
        return SumMemory(memories, jnp.zeros(len(memories)))

    def update(
        self, plant: AbstractPlant, memory: SumMemory, sample: StepData, k: Int[Array, ""]
    ) -> tuple[SumMemory, Float[Array, ""]]:
        """Memory of every term after one step, and the sum of their gains."""
        pairs = zip(self.terms, memory.terms, strict=True)
        memories, gains = zip(*(t.update(plant, own, sample, k) for t, own in pairs), strict=True)
        return SumMemory(memories, memory.gained + jnp.stack(gains)), sum(gains, jnp.zeros(()))

    def final(self, plant: AbstractPlant, memory: SumMemory, params: Params) -> Float[Array, ""]:
        """The sum of the terms' rewards at the end."""
        return jnp.sum(self._finals(plant, memory, params))

    def relative_errors(
        self, plant: AbstractPlant, memory: SumMemory, params: Params
    ) -> Float[Array, " param"]:
        """Errors as the first term knows them."""
        return self.terms[0].relative_errors(plant, memory.terms[0], params)

    def outcome(
        self, plant: AbstractPlant, memory: SumMemory, params: Params, worth: Float[Array, ""]
    ) -> tuple[PyTree, ...]:
        """Outcome of every term from its part of the rewards."""
        del worth
        parts = memory.gained + self._finals(plant, memory, params)
        of_terms = zip(self.terms, memory.terms, parts, strict=True)
        return tuple(term.outcome(plant, own, params, part) for term, own, part in of_terms)

    def of_batch(self, outcomes: tuple[PyTree, ...]) -> Float[Array, ""]:
        """The sum of the terms' worth of the batch."""
        values = [term.of_batch(own) for term, own in zip(self.terms, outcomes, strict=True)]
        return sum(values, jnp.zeros(()))

    def _finals(
        self, plant: AbstractPlant, memory: SumMemory, params: Params
    ) -> Float[Array, " term"]:
        pairs = zip(self.terms, memory.terms, strict=True)
        return jnp.stack([term.final(plant, own, params) for term, own in pairs])
