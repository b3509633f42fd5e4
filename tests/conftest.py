"""A strict floor under all tests: double precision, no silent broadcasting, checked shapes.

The import hook stands here because it must be installed before anything imports `excite`.
Compiled programs are kept on disk, in one folder for all processes of a test run and for
the runs that follow: what one test compiles, no other compiles again.
"""

import os
import sys
import tempfile
from pathlib import Path

# One thread a process: with more, the tests' processes wait for each other's.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
os.environ["EXCITE_PROGRESS"] = "0"  # how long a command takes is no matter of its output
CACHE = os.environ.setdefault(
    "EXCITE_CACHE", str(Path(tempfile.gettempdir()) / f"excite-tests-{os.getuid()}")
)

import jax  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_compilation_cache_dir", CACHE)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
install_import_hook("excite", "strict.checked")
assert "excite.plant" not in sys.modules
