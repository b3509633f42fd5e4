"""Every module can be imported where POSIX is missing, as on Windows (simulated)."""

import subprocess
import sys
from pathlib import Path

import pytest

import excite

WINDOWS = """
import importlib, os, signal, sys
import numpy, jax, matplotlib, multiprocessing.reduction  # what comes from elsewhere knows Windows
for name in ("fcntl", "resource", "termios", "pwd", "grp", "pty", "tty"):
    sys.modules[name] = None
for module, names in (
    (os, "nice sysconf sched_getaffinity getuid fork killpg setsid"),
    (signal, "SIGHUP SIGKILL pthread_sigmask SIG_BLOCK SIG_SETMASK"),
):
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)
for name in sys.argv[1:]:
    importlib.import_module(name)
"""
OPTIONAL = {"excite.__main__", "excite.training.ppo"}  # a program; torch, which is slow to load


@pytest.mark.slow
def test_every_module_is_imported_without_posix():
    root = Path(excite.__file__).parent
    paths = [p.relative_to(root.parent).with_suffix("") for p in sorted(root.rglob("*.py"))]
    names = {".".join(p.parts).removesuffix(".__init__") for p in paths} - OPTIONAL
    command = [sys.executable, "-c", WINDOWS, *sorted(names)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
