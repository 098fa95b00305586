"""Result of a search for trade-off fronts, and its partial result in a workspace."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from cpjax.study.fronts.evaluator import Evaluated
from cpjax.workspace import Workspace

_COUNTS = ("begun", "values", "gradients")


class Search(NamedTuple):
    """Result of a search, by supply [V]."""

    archive: Mapping[float, Evaluated]
    """Archive of every controller that was evaluated by more than the screening."""
    begun: Mapping[float, int]
    """Number of those that came from the candidates."""
    values: Mapping[float, int]
    """Runge-Kutta steps of values."""
    gradients: Mapping[float, int]
    """Runge-Kutta steps of gradients."""
    seconds: float
    """Wall time of the whole search, not by supply [s]."""


def load_or_run(memory: Workspace | None, name: str, search: Callable[[], Search]) -> Search:
    """Loads a search from a workspace, or runs it and saves it there.

    Args:
      memory: the workspace, or None to run the search without one.
      name: of the partial result.
      search: runs the search.
    """
    known = memory.load(name) if memory is not None else None
    if known is not None:
        columns, note = known
        supplies = note["supplies"]
        rows = [Evaluated(*(columns[f"{i}.{field}"] for field in Evaluated._fields)) for i in range(len(supplies))]
        archive = dict(zip(supplies, rows, strict=True))
        begun, values, gradients = (dict(zip(supplies, note[key], strict=True)) for key in _COUNTS)
        return Search(archive, begun, values, gradients, note["seconds"])
    found = search()
    if memory is not None:
        rows = list(found.archive.values())
        columns = {f"{i}.{key}": column for i, row in enumerate(rows) for key, column in row._asdict().items()}
        counts = {key: [getattr(found, key)[supply] for supply in found.archive] for key in _COUNTS}
        memory.save(name, columns, {"supplies": [*found.archive], "seconds": found.seconds, **counts})
    return found
