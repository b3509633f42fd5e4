"""How programs are compiled in the tests."""

import contextlib
from collections.abc import Iterator

import jax


@contextlib.contextmanager
def optimised() -> Iterator[None]:
    """As for a user, where computing takes longer than compiling; also decorates a test."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)
