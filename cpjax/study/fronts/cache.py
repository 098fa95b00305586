"""Result of a search for trade-off fronts and its file, so that a finished search is not repeated."""

import io as buffers
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cpjax import files
from cpjax.study.fronts.evaluator import Evaluated

_COUNTS = ("begun", "values", "gradients")


class Search(NamedTuple):
    """Result of a search, by supply [V]."""

    met: Mapping[float, Evaluated]
    """Archive of every controller that was evaluated by more than the screening."""
    begun: Mapping[float, int]
    """Number of those that came from the candidates."""
    values: Mapping[float, int]
    """Runge-Kutta steps of values."""
    gradients: Mapping[float, int]
    """Runge-Kutta steps of gradients."""
    seconds: float
    """Wall time of the whole search, not by supply [s]."""


def load_or_run(path: Path | None, search: Callable[[], Search]) -> Search:
    """Loads the cached result, or runs `search` and caches it.

    Args:
      path: the NPZ file, or None to run `search` without a file.
      search: runs the search.
    """
    if path is not None and path.exists():
        with np.load(path) as archive:
            columns = dict(archive)
        supplies = columns["supplies"].tolist()
        met = {
            supply: Evaluated(*(columns[f"{i}.{n}"] for n in Evaluated._fields)) for i, supply in enumerate(supplies)
        }
        begun, values, gradients = (dict(zip(supplies, columns[name].tolist(), strict=True)) for name in _COUNTS)
        return Search(met, begun, values, gradients, float(columns["seconds"]))
    found = search()
    if path is not None:
        columns = {
            f"{i}.{name}": of[name] for i, one in enumerate(found.met.values()) for of in [one._asdict()] for name in of
        }
        counts = {name: np.array([getattr(found, name)[supply] for supply in found.met]) for name in _COUNTS}
        content: dict[str, Any] = {"supplies": np.array([*found.met]), "seconds": found.seconds, **counts, **columns}
        buffer = buffers.BytesIO()
        np.savez(buffer, **content)
        files.write_bytes(path, buffer.getvalue())
    return found
