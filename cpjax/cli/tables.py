"""Tables on standard output."""

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table

from cpjax.errors import printable


def print_table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]], text_columns: int) -> None:
    """Prints a table whose first `text_columns` columns are words and whose others are numbers."""
    table = Table(title=printable(title), title_justify="left")
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i < text_columns else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(printable, row))
    # Where the width is not known (a file, a pipe) a line may have up to 200 characters.
    width = None if Console().is_terminal else 200
    console = Console(width=width, markup=False)  # [s] is a unit, not a style
    console.print(table)
