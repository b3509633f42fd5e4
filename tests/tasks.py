"""Functions that the workers of `test_engine` call by name; they import no excite."""

import os
import sys
import time
from pathlib import Path
from typing import Any

AT_IMPORT = os.environ.copy()


class NeedsTwoError(Exception):
    """Is pickled, but not back: its constructor takes two arguments, and it keeps one."""

    def __init__(self, what: str, why: str) -> None:
        super().__init__(f"{what} {why}")


def add(a: int, b: int, marker: str = "", seconds: float = 0.0) -> int:
    """A sum; a line is left in the file `marker`."""
    if marker:
        with open(marker, "a") as file:
            file.write("called\n")
    time.sleep(seconds)
    return a + b


def fail(marker: str, kind: str, times: int) -> str:
    """Raises the first so many times it is called."""
    with open(marker, "a") as file:
        file.write("called\n")
    if len(Path(marker).read_text().splitlines()) <= times:
        if kind == "value":
            raise ValueError("a user's mistake")
        if kind == "exit":
            sys.exit(3)
        if kind == "two":
            raise NeedsTwoError("does not", "travel")
        raise OSError("a disk is\nfull")
    return "mended"


def die(marker: str = "", a: int = 0, b: int = 0) -> int:
    """Kills its worker, once where there is a marker, always where there is none."""
    if not marker or not Path(marker).exists():
        if marker:
            Path(marker).touch()
        os._exit(9)
    return a + b


def any_of_them(function: str, **arguments: Any) -> Any:
    """One target for tasks of several kinds."""
    return globals()[function](**arguments)


def hang(marker: str) -> None:
    """Tells its process id and stays."""
    Path(marker).write_text(str(os.getpid()))
    time.sleep(300)


def process() -> int:
    """Its number."""
    return os.getpid()


def environment() -> dict[str, Any]:
    """What this process was told before anything was imported, and what is imported."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC")
    names += ("XLA_FLAGS", "JAX_ENABLE_X64", "TF_CPP_MIN_LOG_LEVEL")
    return {
        "environment": {name: os.environ.get(name) for name in names},
        "at the import of this file": dict(AT_IMPORT),
        "loaded": sorted({"jax", "torch"} & set(sys.modules)),
    }


def num_blas_threads() -> int:
    """How many threads the OpenBLAS has that comes with NumPy."""
    import ctypes

    import numpy as np

    [path] = Path(np.__file__).parent.parent.glob("numpy.libs/lib*openblas64_*")
    return ctypes.CDLL(str(path)).scipy_openblas_get_num_threads64_()
