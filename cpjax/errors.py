"""The exception for bad input, which names field, value and allowed range, and the package's warnings."""

from typing import Any


class InputError(ValueError):
    """A value from outside (an argument, a file, an option) that the library cannot use.

    Attributes:
      field: where the value was, as the user wrote it (``CartPole.cart_mass``, ``dt``, ``plant.toml: [motor] mass``).
      value: the value itself.
      allowed: what is accepted, with its unit.
    """

    def __init__(self, field: str, value: Any, allowed: str) -> None:
        self.field = field
        self.value = value
        self.allowed = allowed
        super().__init__(one_line(f"{field} = {_short(value)}: must be {allowed}"))


class MissingError(InputError):
    """A required value that was not given."""

    def __init__(self, field: str, why: str) -> None:
        super().__init__(field, None, f"given, because {why}")
        self.args = (one_line(f"{field}: must be given, because {why}"),)


def one_line(text: str) -> str:
    """Returns the text on one line, with characters that could control a terminal escaped."""
    return printable(" ".join(text.splitlines()))


def printable(text: str) -> str:
    """Returns the text with non-printable characters, as they occur in the names of files, escaped."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 120 else text[:117] + "..."


class DerivativeWarning(UserWarning):
    """A requested derivative omits an effect; the message names the effect and how to include it."""


class PerformanceWarning(UserWarning):
    """A computation runs much slower than it could; the message gives the reason."""


class DamagedFileWarning(UserWarning):
    """A file of partial results cannot be read; the message says what it is called now, and that its work is redone."""
