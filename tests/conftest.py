"""A strict floor under all tests: double precision, no silent broadcasting, checked shapes.

The import hook stands here because it must be installed before anything imports `excite`.
"""

import os

# One thread a process: with more, the tests' processes wait for each other's.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook("excite", "strict.checked")
