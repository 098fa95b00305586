"""Standard output and standard error, as a command needs them: what cannot be printed never stops what it computes."""

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from typing import Any

from cpjax.errors import one_line, printable


class Stream(io.TextIOBase):
    """Prints to another stream as long as that works; from the first failure on, to nowhere.

    Characters that its encoding lacks are printed as escapes. A reader that went away (`cpjax design | head -1`) has
    what it wanted, and a stream that was closed from the start was not wanted; anything else is a `problem`.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._open = stream is not None
        self.problem: OSError | None = None

    @property
    def encoding(self) -> str:  # type: ignore[override]  # a plain attribute there
        """The other stream's."""
        return getattr(self._stream, "encoding", None) or "utf-8"

    def write(self, text: str) -> int:
        """Prints, if it can."""
        shown = text.encode(self.encoding, errors="backslashreplace").decode(self.encoding)
        self._try("write", shown)
        return len(text)

    def flush(self) -> None:
        """Prints what waits to be, if it can."""
        self._try("flush")

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        return self._open and bool(self._stream.isatty())

    def fileno(self) -> int:
        if self._stream is None:
            raise io.UnsupportedOperation("fileno")
        return int(self._stream.fileno())

    def _try(self, method: str, *arguments: str) -> None:
        if not self._open:
            return
        try:
            getattr(self._stream, method)(*arguments)
        except BrokenPipeError:
            self._open = False
        except OSError as problem:
            self.problem = problem
            self._open = False
        except ValueError:  # closed by somebody else
            self._open = False


@contextlib.contextmanager
def streams() -> Iterator[Stream]:
    """Both standard streams as a `Stream` meanwhile; yields that of standard output."""
    out, err = Stream(sys.stdout), Stream(sys.stderr)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            yield out
        finally:
            out.flush()
            err.flush()


def settle() -> None:
    """Sees that Python, which flushes both streams once more at its exit, does not fail at what could not be printed.

    For a process that ends: what waits to be printed to a broken stream goes nowhere.
    """
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None:
                stream.flush()
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)
        except ValueError:  # it is closed, and will not be flushed
            pass


def say(*lines: str) -> None:
    """Lines on standard output, with nothing in them that controls a terminal."""
    for line in lines:
        print(printable(line))


def complain(text: str) -> None:
    """One line on standard error."""
    print(one_line(text), file=sys.stderr, flush=True)
