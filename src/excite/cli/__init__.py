"""The command line: reads options, calls one function, shows what it returns.

Nothing is computed here. Commands import what they need when they run, so that `--help`
answers at once. A user's error is one sentence on stderr and exit code 2; a run that
failed exits with 1; a traceback comes only with `--debug`.
"""

from __future__ import annotations

import sys
import traceback

import click

from .. import __version__
from .benchmark import benchmark
from .design import design
from .doctor import doctor
from .export import export
from .identify import identify
from .information import information
from .options import RememberingGroup, RunFailedError
from .plants import plants
from .policies import evaluate, policies
from .report import report
from .run import run
from .serve import serve
from .simulate import simulate
from .study import study
from .train import train

_DEBUG = "--debug"


@click.group(cls=RememberingGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="excite")
@click.option(_DEBUG, is_flag=True, help="Show the traceback of an error.")
def cli(debug: bool) -> None:
    """Safe, informative experiments for mechatronic systems, and the parameters they identify."""
    del debug  # read from the arguments in `main`, where errors arrive


for command in (
    plants, policies, simulate, information, identify, design, train, evaluate, run, export,
    benchmark, study, report, serve, doctor,
):  # fmt: skip
    cli.add_command(command)


def main() -> None:
    """Runs the command line; the only place where errors become sentences."""
    debug = _DEBUG in sys.argv
    if debug:
        sys.argv.remove(_DEBUG)
    code: object = 0
    try:
        code = cli(standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        sys.exit(0)
    except click.ClickException as error:
        _fail(error.format_message(), 2, debug)
    except (click.Abort, KeyboardInterrupt):
        _fail("interrupted; nothing was written", 130, debug)
    except RunFailedError as error:
        _fail(str(error), 1, debug)
    except Exception as error:
        # Sentences for the user are plain ValueErrors; its subclasses come from libraries.
        if type(error) is ValueError or isinstance(error, OSError):
            _fail(str(error), 2, debug)
        _fail(f"failed: {type(error).__name__}: {error} (--debug shows where)", 1, debug)
    sys.exit(code if isinstance(code, int) else 0)


def _fail(sentence: str, code: int, debug: bool) -> None:
    if debug:
        traceback.print_exc()
    click.echo(f"excite: {' '.join(sentence.split())}", err=True)
    sys.exit(code)
