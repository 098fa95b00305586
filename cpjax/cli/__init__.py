"""The command line: one module per command, which declares options, calls the library, prints and writes."""

import argparse
import importlib
import os
import re
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any, NoReturn

from cpjax import startup
from cpjax.cli import output
from cpjax.cli.output import complain
from cpjax.errors import DamagedFileWarning, InputError

EXIT_CODES = """\
exit codes:
  0    done (swingup: and the pendulum settled; tune: from one start at least)
  1    swingup, tune: done, but the pendulum did not settle
  2    bad input, or an output that cannot be written (a full disk): one line on standard error says what is wrong
  130  interrupted

Files are written even where standard output fails. A reader of it that stops early (`cpjax design | head -1`), or a
standard output that is closed, changes no exit code.
"""

INTERRUPTED = 130

_COMMANDS = (
    "swingup",
    "sweep",
    "design",
    "reproduce",
    "audit_gains",
    "audit_gradients",
    "tune",
    "compare",
    "basin",
    "robustness",
    "pareto",
    "animate",
    "rig",
    "report",
)
"""Modules of this package, in the order in which the help lists them."""


class _Parser(argparse.ArgumentParser):
    """Parser that reports errors in one line, requires full option names, and reads `-5e-3` and `-5+2j` as numbers."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **{"allow_abbrev": False, **options})
        # argparse's own pattern matches neither exponents nor complex numbers, and no public name changes it.
        real = r"(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"
        self._negative_number_matcher = re.compile(rf"-{real}([-+]{real}[ij]|[ij])?$|-inf$|-nan$")

    def error(self, message: str) -> NoReturn:
        complain(f"{self.prog}: error: {message}")
        self.exit(2)


def make_parser() -> argparse.ArgumentParser:
    """Builds the parser of all commands."""
    parser = _Parser(
        prog="cpjax",
        description="A motor-driven cart-pole: swing-up, catch, and the numbers behind them.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)
    for name in _COMMANDS:
        importlib.import_module(f"cpjax.cli.{name}").add_command(commands)
    return parser


def command() -> int:
    """Runs `main` in a process of its own, whose JAX it sets up, and returns the exit code: the shell's entry point."""
    code = main(set_up=True)
    output.settle()
    if code == INTERRUPTED:
        os._exit(code)  # JAX, interrupted in the middle of a compilation, may crash while Python cleans up
    return code


def main(arguments: Sequence[str] | None = None, *, set_up: bool = False) -> int:
    """Runs one command and returns its exit code; see `EXIT_CODES`.

    Args:
      arguments: those of the command line, the command first; by default the process's.
      set_up: cache compilations for the next process, configure the CPU if the command simulates many initial states,
        and print no warnings of libraries. Only before JAX has started.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)
    with output.streams() as out:
        try:
            code = _run(given, set_up)
        except KeyboardInterrupt:
            if set_up:  # the rest is short, and a second interrupt would end it with a traceback
                signal.signal(signal.SIGINT, signal.SIG_IGN)
            complain(f"cpjax {given[0] if given else ''}: interrupted; what was saved so far is kept")
            code = INTERRUPTED
        out.flush()
        if out.problem is not None:
            complain(f"cpjax {given[0] if given else ''}: error: standard output cannot be written: {out.problem}")
            code = 2 if code in (0, 1) else code
    return code


def _run(arguments: list[str], set_up: bool) -> int:
    parser = make_parser()
    try:
        for text in arguments:
            if not text.isascii() and text != text.encode(errors="replace").decode():
                parser.error(f"argument {text!r}: allowed: text in UTF-8; other could be neither shown nor saved")
        options = parser.parse_args(arguments)
    except SystemExit as stop:  # argparse ends the process; main is a function and returns
        return int(stop.code or 0)

    import jax
    import numpy as np

    if set_up:
        from cpjax.backend import runtime

        runtime.keep_compilations()
        runtime.configure_cpu(None if getattr(options, "many_starts", False) else 1)
        startup.ready()  # until here an interrupt ends the process at once: nothing has been written
        if not sys.warnoptions:  # those that matter are in the results, as a flag, or in an error
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", DamagedFileWarning)
            warnings.showwarning = lambda message, *_, **__: complain(f"cpjax {options.command}: warning: {message}")
    # The protocol's figures are float64. Set here, in the application: the library never changes this setting.
    config: Any = jax.config  # whose methods JAX does not annotate
    config.update("jax_enable_x64", True)
    try:
        with np.errstate(all="ignore"):  # an overflow shows in the result, or in the one line of an error
            code: int = options.run(options)
        return code
    except InputError as problem:
        complain(f"cpjax {options.command}: error: {problem}")
        return 2
    except OSError as problem:  # such as a full disk or a name too long, which no InputError reports
        if problem.errno is None:
            raise
        allowed = f"a place that can be read and written ({problem.strerror})"
        complain(f"cpjax {options.command}: error: {InputError('path', problem.filename, allowed)}")
        return 2


def _version() -> str:
    from cpjax import __version__

    return f"cpjax {__version__}"
