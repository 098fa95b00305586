"""Progress for people, on standard error: a bar on a terminal, a line per step elsewhere."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import TypeAlias

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from cpjax.cli.output import complain, shown

Report: TypeAlias = Callable[[int, int, str], None]
"""Takes how much is done, of how much, and what comes next."""


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
        task = bar.add_task("", what=shown(what))
        yield lambda done, total, text: bar.update(task, completed=done, total=total, description=shown(text))
