"""What the process of the command line needs before the imports that take a second. In any other process: nothing.

The shell's `cpjax` and `python -m cpjax` import this package before a line of the command line's own code can run. So
its first import is this module.
"""

import os
import signal
import sys
import threading
from typing import Any


def is_command() -> bool:
    """Whether this process is the command line: `cpjax`, or `python -m cpjax`."""
    name = getattr(sys, "argv", [""])[0]  # while Python looks for the module of its -m, this is "-m"
    return os.path.splitext(os.path.basename(name))[0] == "cpjax" or (name == "-m" and "cpjax" in sys.orig_argv)


def prepare() -> None:
    """Ends an interrupted import without a traceback, opens closed standard streams, and quiets XLA's alarm."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    # The next file that is opened would get the number of a closed stream, and what libraries print would go into it.
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    # "Very slow compile?" is logged as an error, between the lines of a progress that says the same better. What fails
    # in XLA raises an exception besides. JAX reads this when it is imported; who has set it wants to see more.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def ready() -> None:
    """Hands interrupts back to Python, which raises KeyboardInterrupt for them: the imports are done."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = _again


def _again(unraisable: Any) -> None:
    """Interrupts once more where Python has dropped the interrupt, in a callback of the garbage collector for one."""
    if unraisable.exc_type is KeyboardInterrupt:
        # Later, from elsewhere: at once it would be dropped again.
        threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(unraisable)


def _end(*_: Any) -> None:
    os._exit(130)  # nothing has been written yet, and half of an import is not fit to clean up


if is_command():
    prepare()
