"""Pareto fronts of two costs: non-dominated points and the area that they dominate."""

import numpy as np
from jaxtyping import Float, Int


def nondominated(points: Float[np.ndarray, "points 2"]) -> Int[np.ndarray, " front"]:
    """Returns the indices of the non-dominated points, in ascending order of the first cost.

    A point is dominated if another one is at least as good in both costs and better in one. Of equal points only the
    first is returned; points with a non-finite number are never returned.

    Args:
      points: costs; smaller is better.

    Returns:
      The indices.
    """
    points = np.asarray(points, float)
    finite = np.flatnonzero(np.all(np.isfinite(points), axis=1))
    order = finite[np.lexsort((points[finite, 1], points[finite, 0]))]
    second = points[order, 1]
    best_before = np.concatenate([[np.inf], np.minimum.accumulate(second)[:-1]]) if len(order) else second
    return order[second < best_before]


def hypervolume(points: Float[np.ndarray, "points 2"], reference: Float[np.ndarray, "2"]) -> float:
    """Computes the area that points dominate up to a reference point (Zitzler and Thiele, 1998).

    Args:
      points: costs; smaller is better.
      reference: the costs beyond which a point dominates nothing.

    Returns:
      The area, in the product of the costs' units.
    """
    points, reference = np.asarray(points, float), np.asarray(reference, float)
    front = points[nondominated(points)]
    front = front[np.all(front < reference, axis=1)]
    upper = np.concatenate([[reference[1]], front[:-1, 1]]) if len(front) else np.zeros(0)
    return float(np.sum((reference[0] - front[:, 0]) * (upper - front[:, 1])))
