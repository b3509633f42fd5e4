"""A strict floor under all tests: double precision, no silent broadcasting, checked shapes.

The import hook stands here because it must be installed before anything imports `excite`.
"""

import os

# One thread a process: with more, the tests' processes wait for each other's.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook("excite", "strict.checked")


@pytest.fixture(scope="module", autouse=True)
def _compiled_programs_are_let_go():
    """A process that keeps all programs of the whole suite runs out of room for another.

    A command run in this process also switches the cache on disk on, for all that follows.
    """
    yield
    jax.clear_caches()
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
