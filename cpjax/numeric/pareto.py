"""Trade-offs between two costs: which points no other beats, and how much they dominate together."""

from typing import Any

import numpy as np

Numbers = np.ndarray[Any, Any]


def nondominated(points: Numbers) -> Numbers:
    """Indices of the points (n, 2) that no other is at least as good as in both costs and better in one, by rising
    first cost. Of equal points the first; points with a number that is not finite are never among them.
    """
    points = np.asarray(points, float)
    finite = np.flatnonzero(np.all(np.isfinite(points), axis=1))
    order = finite[np.lexsort((points[finite, 1], points[finite, 0]))]
    second = points[order, 1]
    best_before = np.concatenate([[np.inf], np.minimum.accumulate(second)[:-1]]) if len(order) else second
    return order[second < best_before]


def hypervolume(points: Numbers, reference: Numbers) -> float:
    """The area that points (n, 2) dominate up to `reference` (2,): the larger the better (Zitzler and Thiele, 1998)."""
    points, reference = np.asarray(points, float), np.asarray(reference, float)
    front = points[nondominated(points)]
    front = front[np.all(front < reference, axis=1)]
    upper = np.concatenate([[reference[1]], front[:-1, 1]]) if len(front) else np.zeros(0)
    return float(np.sum((reference[0] - front[:, 0]) * (upper - front[:, 1])))
