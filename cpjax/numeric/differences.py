"""Derivatives by extrapolated central differences, with an estimate of their error (Ridders, 1982)."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class Differences(NamedTuple):
    """A derivative and its estimated error; NaN and infinite where no difference is valid."""

    derivative: Float[np.ndarray, "*functions"]
    uncertainty: Float[np.ndarray, "*functions"]


def central_differences(
    function: Callable[[float], tuple[Float[np.ndarray, "*functions"], Float[np.ndarray, "*functions"]]],
    steps: Float[np.ndarray, " steps"],
    valid: Callable[[float], Bool[np.ndarray, "*functions"]] | None = None,
) -> Differences:
    """Computes the derivative at 0 of a function of one variable, or of many such functions at once.

    Extrapolates the central differences of all consecutive steps to step 0, and returns the extrapolation that changes
    least with one step more or less: large steps have an error by curvature, small ones by rounding. Among many changes
    some are small by chance, so no change counts as smaller than the rounding error of the function's values.

    Args:
      function: takes a step h and returns the function at +h and at -h.
      steps: step sizes, at least two, falling by a constant factor.
      valid: takes a step and returns whether its difference counts; for functions that are smooth only near 0.

    Returns:
      The derivative of each function, and its estimated error.
    """
    factor = (steps[0] / steps[1]) ** 2
    rows: list[list[np.ndarray]] = []
    best = Differences(np.array(np.nan), np.array(np.inf))
    for step in steps:
        above, below = function(float(step))
        first = (above - below) / (2.0 * step)
        if valid is not None:
            first = np.where(valid(float(step)), first, np.nan)
        rounding = 16.0 * np.finfo(np.float64).eps * np.maximum(np.abs(above), np.abs(below)) / step
        row = [first]
        for order, coarse in enumerate(rows[-1] if rows else [], start=1):
            finer = row[-1] + (row[-1] - coarse) / (factor**order - 1.0)
            change = np.maximum(np.maximum(np.abs(finer - row[-1]), np.abs(finer - coarse)), rounding)
            row.append(finer)
            better = change < best.uncertainty
            best = Differences(np.where(better, finer, best.derivative), np.where(better, change, best.uncertainty))
        rows.append(row)
    return best
