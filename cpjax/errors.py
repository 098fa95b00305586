"""The one exception for bad input: it names the field, the value and what would have been allowed."""

from typing import Any


class InputError(ValueError):
    """A value from outside (an argument, a file, an option) that the library cannot use.

    Attributes:
      field: where the value stood, as the user wrote it (``CartPole.cart_mass``, ``dt``, ``plant.toml: [motor] mass``).
      value: the value itself.
      allowed: what would have been accepted, with its unit.
    """

    def __init__(self, field: str, value: Any, allowed: str) -> None:
        self.field = field
        self.value = value
        self.allowed = allowed
        super().__init__(one_line(f"{field} = {_short(value)}: must be {allowed}"))


class MissingError(InputError):
    """A value that has to be given and was not."""

    def __init__(self, field: str, why: str) -> None:
        super().__init__(field, None, f"given, because {why}")
        self.args = (one_line(f"{field}: must be given, because {why}"),)


def one_line(text: str) -> str:
    """The text without line breaks, and with nothing in it that controls a terminal."""
    return printable(" ".join(text.splitlines()))


def printable(text: str) -> str:
    """The text with escapes for what is no printable character, such as those in the names of files."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 120 else text[:117] + "..."


class DerivativeWarning(UserWarning):
    """A derivative was asked for that leaves something out; the message says what, and how to ask for it."""


class PerformanceWarning(UserWarning):
    """Something runs much slower than it could; the message says why."""
