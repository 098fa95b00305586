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
        super().__init__(f"{field} = {_short(value)}: must be {allowed}")


class MissingError(InputError):
    """A value that has to be given and was not."""

    def __init__(self, field: str, why: str) -> None:
        super().__init__(field, None, f"given, because {why}")
        self.args = (f"{field}: must be given, because {why}",)


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 120 else text[:117] + "..."
