"""The command line: reads options, calls one function, shows what it returns.

Nothing is computed here. Commands import what they need when they run, so that `--help`
is fast. A user's error is one sentence on stderr and exit code 2; a run that failed
exits with 1; a traceback is printed only with `--debug`.
"""

from __future__ import annotations

import io
import sys
import traceback
import warnings

import click

from .. import __version__
from ..description import told
from .benchmark import benchmark
from .campaign import campaign
from .choose import choose
from .compare_plants import compare_plants
from .completion import complete_names
from .design import design
from .discriminate import discriminate
from .doctor import doctor
from .export import export
from .falsify import falsify
from .gain import gain
from .identify import identify
from .information import information
from .next import next_experiment
from .options import RememberingGroup, RunFailedError, show_warning
from .plants import plants
from .policies import evaluate, policies
from .report import report
from .run import run
from .serve import serve
from .simulate import simulate
from .study import study
from .train import train

_DEBUG = "--debug"
_LONGEST = 1000  # characters of a word in a message, such as a path

_SECTIONS: dict[str, dict[click.Command, str]] = {
    "Try a plant, identify it": {
        plants: "excite plants aero2",
        simulate: "excite simulate aero2 --excitation chirp --out record.csv --plot record.png",
        information: "excite information aero2 --excitation multisine",
        gain: "excite gain aero2 --excitation multisine --spread 0.3",
        identify: "excite identify record.csv --plant aero2 --plot fit.png",
        policies: "excite policies",
    },
    "Design and train": {
        next_experiment: "excite next record.csv --target D_p=1% --steps 200 --out next.csv",
        choose: "excite choose aero2 experiments.toml --target D_p=1% --rounds 3",
        discriminate: "excite discriminate aero2 aero2_lag,tau=0.05:0.25 --out next.csv",
        design: "excite design aero2 --out signal.csv",
        train: "excite train aero2 --out runs/first",
        evaluate: "excite evaluate aero2 --episodes 100",
        falsify: "excite falsify dc_motor --uncertainty initial_state=2% --out worst.json",
        export: "excite export aero2 --onnx aero2.onnx",
    },
    "Experiment on a rig": {
        run: "excite run --policy aero2 --fast --out experiment.csv",
        campaign: "excite campaign aero2 --target D_p=1%,J_p=0.5% --fast --out runs/known",
    },
    "Compare": {
        compare_plants: "excite compare-plants aero2 aero2+coulomb --record record.csv",
        study: "excite study run baselines --out runs/baselines",
        benchmark: "excite benchmark baselines --episodes 20",
        report: "excite report runs/baselines --out report.html",
    },
    "Page and system": {
        serve: "excite serve",
        doctor: "excite doctor",
    },
}
"""Every command with an example, in the order in which the help lists them."""

_STUDY_EXAMPLES = {
    "list": "excite study list",
    "run": "excite study run table1 --out runs/table1",
    "table": "excite study table runs/table1",
}


class _MainGroup(RememberingGroup):
    """The group of all commands: its help lists them by the kind of work."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """One section of the help for each kind of work."""
        for title, commands in _SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl(
                    [(c.name or "", c.get_short_help_str(200)) for c in commands if not c.hidden]
                )


@click.group(cls=_MainGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="excite")
@click.option(_DEBUG, is_flag=True, help="Show the traceback of an error.")
def cli(debug: bool) -> None:
    """Safe, informative experiments for mechatronic systems, and the parameters they identify."""
    del debug  # `main`, which handles errors, reads it from the arguments


def _document(command: click.Command, example: str) -> None:
    """An example at the end of a command's help, and completion of the names it takes."""
    command.epilog = f"\b\nExample:\n  {example}"
    complete_names(command)


for commands in _SECTIONS.values():
    for command, example in commands.items():
        cli.add_command(command)
        _document(command, example)
for name, example in _STUDY_EXAMPLES.items():
    _document(study.commands[name], example)


def main() -> None:
    """Runs the command line; only here errors become messages."""
    debug = _DEBUG in sys.argv
    if debug:
        sys.argv.remove(_DEBUG)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names of files may not be UTF-8
            stream.reconfigure(errors="backslashreplace")
    code: object = 0
    try:
        with warnings.catch_warnings():
            warnings.showwarning = show_warning
            code = cli(standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        sys.exit(0)
    except click.ClickException as error:
        _fail(error.format_message(), 2, debug)
    except (click.Abort, KeyboardInterrupt):
        _fail("interrupted; no file was left incomplete", 130, debug)
    except RunFailedError as error:
        _fail(str(error), 1, debug)
    except Exception as error:
        # Messages for the user are plain ValueErrors; its subclasses come from libraries.
        if type(error) is ValueError or isinstance(error, OSError):
            _fail(str(error), 2, debug)
        _fail(f"failed: {told(error)} (--debug shows where)", 1, debug)
    sys.exit(code if isinstance(code, int) else 0)


def _fail(sentence: str, code: int, debug: bool) -> None:
    if debug:
        traceback.print_exc()
    words = (word if len(word) <= _LONGEST else f"{word[:99]}..." for word in sentence.split())
    click.echo(f"excite: {' '.join(words)}", err=True)
    sys.exit(code)
