"""Standard output and standard error of a command: a failure to print never stops the computation."""

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from typing import Any

from cpjax.errors import one_line, printable


class Stream(io.TextIOBase):
    """Stream that prints to another one and discards all text after the first failure.

    Characters that the other's encoding lacks are printed as escapes. A reader that stopped early (`cpjax design |
    head -1`) and a closed stream are no errors; any other failure is stored in `problem`.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._open = stream is not None
        self.problem: OSError | None = None

    @property
    def encoding(self) -> str:  # type: ignore[override]  # typeshed has a plain attribute; here it is the other stream's
        """The encoding of the other stream."""
        return getattr(self._stream, "encoding", None) or "utf-8"

    def write(self, text: str) -> int:
        """Prints the text unless the stream has failed; returns its length."""
        shown = text.encode(self.encoding, errors="backslashreplace").decode(self.encoding)
        self._try("write", shown)
        return len(text)

    def flush(self) -> None:
        """Flushes the other stream unless it has failed."""
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
        except ValueError:  # the stream is closed
            self._open = False


@contextlib.contextmanager
def streams() -> Iterator[Stream]:
    """Replaces both standard streams by a `Stream` within the context; yields that of standard output."""
    out, err = Stream(sys.stdout), Stream(sys.stderr)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            yield out
        finally:
            out.flush()
            err.flush()


def settle() -> None:
    """Flushes both standard streams and redirects one that fails to the null device.

    For a process that ends: Python flushes both once more at its exit, and would fail on text that cannot be printed.
    """
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None:
                stream.flush()
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)
        except ValueError:  # it is closed, and Python will not flush it
            pass


def say(*lines: str) -> None:
    """Prints lines on standard output, with characters that control a terminal escaped."""
    for line in lines:
        print(printable(line))


def complain(text: str) -> None:
    """Prints one line on standard error."""
    print(one_line(text), file=sys.stderr, flush=True)
