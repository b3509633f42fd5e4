"""The command line, called in this process: most of a short program's time is what it imports."""

import contextlib
import io
import subprocess
import sys
from pathlib import Path

import pytest

from excite.cli import main

PATIENCE = 1800
"""Seconds after which a program hangs, and is not only slow on a busy computer."""
REPEATS = 20
"""How often an experiment in real time is tried; a busy computer loses deadlines."""


def excite(*words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """What `excite WORDS` prints, and its exit code."""
    out, err = io.StringIO(), io.StringIO()
    arguments = ["excite", *map(str, words)]
    with pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as stack:
        patch.setattr(sys, "argv", arguments)
        if cwd is not None:
            patch.chdir(cwd)
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
        ending = stack.enter_context(pytest.raises(SystemExit))
        main()
    code = ending.value.code
    code = code if isinstance(code, int) else int(code is not None)
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())
