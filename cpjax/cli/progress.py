"""Progress on standard error: a bar on a terminal, a line per step elsewhere."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import TypeAlias

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from cpjax.cli.output import complain
from cpjax.errors import printable

Report: TypeAlias = Callable[[int, int, str], None]
"""Takes the amount done, the total amount, and in words what comes next."""


@contextlib.contextmanager
def progress(what: str) -> Iterator[Report]:
    """Yields the function that reports progress; `what` names the work."""
    if not sys.stderr.isatty():
        yield lambda done, total, text: complain(f"{what}: {done}/{total} {text}")
        return
    what_it_is, what_comes = (
        TextColumn(f"{{task.{field}}}", markup=False) for field in ("fields[what]", "description")
    )
    columns = (what_it_is, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), what_comes)
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", what=printable(what))
        yield lambda done, total, text: bar.update(task, completed=done, total=total, description=printable(text))


def compiling(report: Report, *before: str) -> Report:
    """Returns `report` with a notice of a compilation in the first text that begins with one of `before`.

    The compilation reports no progress. That of a gradient takes a minute or more, unless an earlier process cached it.
    """
    told = False

    def tell(done: int, total: int, text: str) -> None:
        nonlocal told
        first = not told and text.startswith(before)
        told = told or first
        report(done, total, text + "; compiling the gradient (about a minute the first time)" * first)

    return tell
