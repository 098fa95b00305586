"""Setup of the command line's process before the imports that take a second; without effect in any other process.

The shell's `cpjax` and `python -m cpjax` import this package before any line of the command line's own code can run.
Therefore the package's first import is this module.
"""

import gc
import os
import signal
import sys
import threading
from typing import Any


def is_command() -> bool:
    """Returns whether this process is the command line: `cpjax`, or `python -m cpjax`."""
    name = getattr(sys, "argv", [""])[0]  # while Python looks for the module of its -m, this is "-m"
    return os.path.splitext(os.path.basename(name))[0] == "cpjax" or (name == "-m" and "cpjax" in sys.orig_argv)


def prepare() -> None:
    """Makes an interrupted import end without a traceback, opens closed standard streams, silences XLA's log, and lets
    Python look for unreachable objects less often."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    # The next file that is opened would get the descriptor of a closed stream, and libraries would print into it.
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    # JAX makes many objects while it traces and drops hardly any: with Python's thresholds much of that time goes to
    # looking for unreachable ones.
    gc.set_threshold(200_000, 20, 20)
    # XLA logs "Very slow compile?" as an error, in the middle of the progress display, which shows the same more
    # clearly; real failures also raise an exception. JAX reads this when it is imported; a value set by the user stays.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def ready() -> None:
    """Restores Python's interrupt handling, which raises KeyboardInterrupt, once the imports are done."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = _again


def _again(unraisable: Any) -> None:
    """Repeats an interrupt that Python has dropped, for example in a callback of the garbage collector."""
    if unraisable.exc_type is KeyboardInterrupt:
        # After a delay and from another thread: raised at once, it would be dropped again.
        threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(unraisable)


def _end(*_: Any) -> None:
    os._exit(130)  # nothing has been written yet, and a half-imported package cannot clean up


if is_command():
    prepare()
