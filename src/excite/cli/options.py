"""Shared by all commands: option types, preparation of JAX, progress, output."""

from __future__ import annotations

import contextlib
import functools
import gc
import json
import math
import os
import re
import shlex
import shutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, ParamSpec, Self, TypeVar

import click

from ..description import Spread
from ..progress import Course, Progress, seconds_between

Callback = TypeVar("Callback", bound=Callable[..., object])
P = ParamSpec("P")
Result = TypeVar("Result")
Value = TypeVar("Value")


class RunFailedError(Exception):
    """A run that failed although its options are valid: exit code 1."""


class RememberingGroup(click.Group):
    """A group that keeps its arguments for `command_line`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parses the arguments and keeps a copy."""
        ctx.meta[_WORDS] = list(args)
        return super().parse_args(ctx, args)


_WORDS = "excite.words"


def command_line() -> str:
    """The running command, as it was typed."""
    return shlex.join(["excite", *click.get_current_context().meta.get(_WORDS, [])])


class Assignments(click.ParamType, Generic[Value]):
    r"""NAME=VALUE,NAME=VALUE,... as a dictionary; a comma that belongs to a text is written \,."""

    name = "NAME=VALUE,..."

    def __init__(self, convert: Callable[[str], Value], kind: str) -> None:
        """`convert` reads the text of one value, or raises ValueError; `kind` is what it allows."""
        self.convert_value, self.kind = convert, kind

    def convert(
        self,
        value: str | dict[str, Value],
        param: click.Parameter | None,
        ctx: click.Context | None,
    ) -> dict[str, Value]:
        """Pairs in the order given."""
        if isinstance(value, dict):
            return value
        result: dict[str, Value] = {}
        for pair in re.split(r"(?<!\\),(?![^\[]*\])", value):  # not at the commas of a list
            parts = pair.replace("\\,", ",").partition("=")
            name, equals, text = (part.strip() for part in parts)
            if not (name and equals and text):
                self.fail(f"{pair!r} is not of the form NAME=VALUE", param, ctx)
            if name in result:
                self.fail(f"{name} is given twice", param, ctx)
            try:
                result[name] = self.convert_value(text)
            except ValueError:
                self.fail(f"{text!r} is not {self.kind} for {name!r}", param, ctx)
        return result


MOST = 10_000_000
"""Largest count: samples, episodes, updates, ..."""


class WholeNumber(click.IntRange):
    """A whole number in a range, with this word in its messages."""

    name = "whole number"

    def __init__(self, min: int, max: int = MOST) -> None:
        """The range, both ends included."""
        super().__init__(min, max)


SEED = WholeNumber(0, 2**63 - 1)


class Number(click.FloatRange):
    """A finite number in a range."""

    name = "number"

    def _describe_range(self) -> str:
        """The range for help; empty where there is none."""
        return super()._describe_range() if (self.min, self.max) != (None, None) else ""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The number; a comparison alone would let NaN pass."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return number


class _Spread(click.ParamType):
    """A fraction below one, or a factor."""

    name = "spread"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        """As it is given; a number as such."""
        try:
            spread = Spread.of(value if str(value).startswith("factor") else float(value))
        except ValueError as error:
            allowed = str(error).removeprefix("spread ").partition(": got")[0]
            self.fail(f"{value!r} is not allowed: it {allowed}", param, ctx)
        return spread.setting


SPREAD = _Spread()


def _option_value(text: str) -> bool | float | list[object]:
    """A number, true, false or a list of numbers, as TOML and JSON write them."""
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError(text) from None
    if not isinstance(value, bool | int | float | list):
        raise ValueError(text)
    return value


COAST = WholeNumber(0, 100_000)
CARRY = WholeNumber(1, 10_000)
coast_option = click.option(
    "--coast",
    type=COAST,
    default=0,
    show_default=True,
    metavar="N",
    help="Samples after the end, under the input that ends an experiment, that must be safe too.",
)
NUMBERS = Assignments(float, "a number")
NAMES = Assignments(str, "a name")
VALUES = Assignments(_option_value, "a number, true, false or a list of numbers")
OUT_FILE = click.Path(path_type=Path)


def merged(pairs: Iterable[dict[str, Value]]) -> dict[str, Value]:
    """One dictionary from an option that was given several times.

    Raises:
        ValueError: for a name with two values.
    """
    result: dict[str, Value] = {}
    for part in pairs:
        for name, value in part.items():
            if name in result:
                raise ValueError(f"{name} is given twice")
            result[name] = value
    return result


def uncertainty_option(help: str) -> Callable[[Callback], Callback]:
    """`--uncertainty NAME=RANGE,...`, with this help in front of the notation."""
    return click.option(
        "--uncertainty", type=NAMES, multiple=True, metavar="NAME=RANGE,...",
        help=f"{help} A range is LOW:HIGH, a percentage or factor:3, as in "
        "delay_voltage=0:0.1,d_S=10%,initial_state=2%.",
    )  # fmt: skip


prior_option = click.option(
    "--prior", type=NAMES, multiple=True, metavar="NAME=DISTRIBUTION,...",
    help="Plants are drawn from these distributions of parameters (normal:MEAN:SD, "
    "lognormal:MEDIAN:SD, uniform:LOWEST:HIGHEST), others within the spread; the table has the "
    "expected gain.",
)  # fmt: skip


def json_option(command: Callback) -> Callback:
    """`--json`: one JSON object on stdout and nothing else."""
    return click.option(
        "--json", "as_json", is_flag=True, help="Print one JSON object and nothing else."
    )(command)


def plot_option(command: Callback) -> Callback:
    """`--plot FILE`."""
    return click.option(
        "--plot", type=OUT_FILE, metavar="FILE", help="Write a figure (.png, .svg, .pdf)."
    )(command)


def computing(command: Callable[P, Result]) -> Callable[P, Result]:
    """Prepares JAX before a command: double precision, and a cache of compiled programs."""

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> Result:
        try:
            prepare_jax()
        except ImportError:
            raise ValueError(
                "this command needs JAX, which is not installed: pip install excite"
            ) from None
        for plot in (kwargs.get("plot"), kwargs.get("plot_diagnosis")):
            if isinstance(plot, Path):
                from ..record.figure import require_plot_path

                require_plot_path(plot)
        return command(*args, **kwargs)

    return wrapped


def prepare_jax() -> None:
    """Double precision, and a cache of compiled programs."""
    # Tracing makes many objects; searching all of them for cycles is a sixth of a first command.
    gc.set_threshold(100_000, 20, 20)
    # On a busy computer the threads of OpenBLAS wait for one another: a fit then takes five times
    # as long. NumPy reads this when it is imported.
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    # The user cannot act on the compiler's messages about its cache.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    jax.config.update("jax_enable_x64", True)
    _keep_compiled_programs()


def _keep_compiled_programs() -> None:
    import jax

    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # without a cache commands are slower, not wrong
        return
    if os.access(folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def cache_folder() -> Path:
    """Folder of compiled programs: EXCITE_CACHE, or the user's cache folder."""
    own = os.environ.get("EXCITE_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(own) if own else Path(base) / "excite"


class Lines(Course):
    """Progress of a command: a line on stderr every ten seconds, if stderr is no terminal."""

    def __init__(self, what: str) -> None:
        """`what` the command does."""
        super().__init__(what)
        self._seconds, self._end = seconds_between(), threading.Event()
        self._teller = threading.Thread(target=self._tell, daemon=True)

    def __enter__(self) -> Self:
        """Starts printing."""
        self._teller.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Stops printing."""
        self._end.set()
        self._teller.join()

    def _tell(self) -> None:
        while self._seconds > 0 and not self._end.wait(self._seconds):
            click.echo(self.line(), err=True)


def show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """A warning as a sentence on stderr."""
    click.echo(f"warning: {message}", err=True)


@contextlib.contextmanager
def warnings_shown() -> Iterator[None]:
    """Every warning as a sentence on stderr, also one that was shown before."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show_warning
        yield


@contextlib.contextmanager
def progress_bar(what: str) -> Iterator[Progress]:
    """Shows the progress of a command on stderr: a bar on a terminal, lines elsewhere.

    Yields a function that sets the current step, how much is done (NaN: it is not known), and the
    total.
    """
    with contextlib.ExitStack() as stack:
        if sys.stderr.isatty() or os.environ.get("FORCE_COLOR"):
            from rich import progress as shown
            from rich.console import Console

            console = Console(stderr=True)
            columns = (
                "{task.description}", shown.BarColumn(), shown.TaskProgressColumn(),
                shown.TimeRemainingColumn(),
            )  # fmt: skip
            bar = stack.enter_context(shown.Progress(*columns, console=console, transient=True))
            task = bar.add_task(what, total=None)

            def show(text: str, done: float, total: float) -> None:
                if math.isnan(done):
                    bar.tasks[0].total = None  # for `update` None is no change
                    bar.update(task, description=f"{what}: {text}")
                else:
                    bar.update(task, description=f"{what}: {text}", completed=done, total=total)
        else:
            show = stack.enter_context(Lines(what)).update
        came = stack.enter_context(_interrupts())

        def report(text: str, done: float, total: float) -> None:
            if came:
                raise KeyboardInterrupt
            show(text, done, total)

        yield report


@contextlib.contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Counts every Ctrl-C; one raised in a library's callback would be lost."""
    came, usual = list[int](), signal.getsignal(signal.SIGINT)

    def remember(number: int, frame: object) -> None:
        del frame
        came.append(number)
        raise KeyboardInterrupt

    if usual is not signal.default_int_handler:  # another handler, or ignored
        yield came
        return
    signal.signal(signal.SIGINT, remember)
    try:
        yield came
    finally:
        signal.signal(signal.SIGINT, usual)


def stdout_for(as_json: bool) -> contextlib.AbstractContextManager[object]:
    """Within it, what the driver of a rig prints goes to stderr where stdout is for JSON."""
    return contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext()


def show_json(value: object) -> None:
    """One JSON object on stdout."""
    from ..files import json_text

    click.echo(json_text(value))


def show_table(
    title: str, header: Sequence[str], rows: Iterable[Sequence[str]], labels: int = 1
) -> None:
    """A line and a table on stdout, as wide as the terminal, or 80 columns.

    Args:
        labels: how many columns begin every part of a table that is continued below.
    """
    from ..report.tables import text_table

    click.echo(text_table(title, header, list(rows), screen_width(), labels) + "\n")


def screen_width() -> int:
    """Columns of the terminal; 80 where there is none."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else 80
