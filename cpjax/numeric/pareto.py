"""Pareto fronts of two costs: non-dominated points and the area that they dominate."""

from typing import Any

import numpy as np

Numbers = np.ndarray[Any, Any]


def nondominated(points: Numbers) -> Numbers:
    """Returns the indices of the non-dominated points, in ascending order of the first cost.

    A point is dominated if another one is at least as good in both costs and better in one. Of equal points only the
    first is returned; points with a non-finite number are never returned.

    Args:
      points: costs, shape (n, 2); smaller is better.
    """
    points = np.asarray(points, float)
    finite = np.flatnonzero(np.all(np.isfinite(points), axis=1))
    order = finite[np.lexsort((points[finite, 1], points[finite, 0]))]
    second = points[order, 1]
    best_before = np.concatenate([[np.inf], np.minimum.accumulate(second)[:-1]]) if len(order) else second
    return order[second < best_before]


def hypervolume(points: Numbers, reference: Numbers) -> float:
    """Computes the area that points (n, 2) dominate up to `reference` (2,) (Zitzler and Thiele, 1998)."""
    points, reference = np.asarray(points, float), np.asarray(reference, float)
    front = points[nondominated(points)]
    front = front[np.all(front < reference, axis=1)]
    upper = np.concatenate([[reference[1]], front[:-1, 1]]) if len(front) else np.zeros(0)
    return float(np.sum((reference[0] - front[:, 0]) * (upper - front[:, 1])))
