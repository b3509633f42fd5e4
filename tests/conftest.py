"""A strict floor under all tests: double precision, no silent broadcasting, checked shapes.

The import hook stands here because it must be installed before anything imports `excite`.
Compiled programs are kept on disk, in one folder for all processes of a test run and for
the runs that follow: what one test compiles, no other compiles again. Thousands of small ones
are compiled as fast as they are written, and are not kept.
"""

import ctypes
import gc
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

# One thread a process: with more, the tests' processes wait for each other's.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
os.environ["EXCITE_PROGRESS"] = "0"  # how long a command takes is no matter of its output
CACHE = os.environ.setdefault(
    "EXCITE_CACHE", str(Path(tempfile.gettempdir()) / f"excite-tests-{os.getuid()}")
)
# In the environment, so that every process that a test starts does the same.
os.environ["JAX_COMPILATION_CACHE_DIR"] = CACHE
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "0"

import jax  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook("excite", "strict.checked")
assert "excite.plant" not in sys.modules
# Tracing makes so many objects that looking through them for cycles, again and again, takes a
# fifth of all time.
gc.set_threshold(100_000, 20, 20)
# A program that a shell starts in the background ignores Ctrl-C, and so would all that it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)


class Memory:
    """What this process uses; compiled programs are given up where it is too much.

    They stay as long as the process, and there are thousands of them.
    """

    limit = 1.4e9
    step = 0.2e9

    def used(self) -> int:
        """Bytes in memory; 0 where that is not told."""
        try:
            return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except OSError:
            return 0

    def bound(self) -> None:
        if self.used() > self.limit:
            jax.clear_caches()
            gc.collect()
            ctypes.CDLL(None).malloc_trim(0)
            self.limit = max(self.limit, self.used() + self.step)


MEMORY = Memory()


@pytest.fixture(autouse=True)
def bounded_memory() -> Iterator[None]:
    yield
    MEMORY.bound()


HANDLERS = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}


@pytest.fixture(autouse=True)
def _handlers_of_signals() -> Iterator[None]:
    """`excite run` in this process leaves signals ignored, as a program does that ends."""
    yield
    for number, handler in HANDLERS.items():
        signal.signal(number, handler)
