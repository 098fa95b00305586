"""Summary statistics of the metrics of a sweep."""

from typing import Any

import numpy as np
from jaxtyping import Float

from cpjax.numeric.statistics import wilson_interval
from cpjax.sim.flags import Flag
from cpjax.sim.metrics import Metrics

COSTS = (
    "settling_time",
    "cart_travel",
    "effort",
    "voltage_variation",
    "peak_voltage",
    "peak_cart_acceleration",
    "switches",
)


def summarise(metrics: Metrics) -> dict[str, Any]:
    """Returns the success rate with its 95 % Wilson interval, and mean, median and maximum of every cost.

    Costs are given over the successful runs, where they are comparable, and over all runs; the settling time over the
    successful ones alone. With no success the values over successes are NaN.

    Args:
      metrics: of a sweep, each of shape (n,).
    """
    success = np.asarray(metrics.success)
    count, successes = success.size, int(success.sum())
    low, high = wilson_interval(successes, count)
    columns = {name: np.asarray(getattr(metrics, name), dtype=np.float64) for name in COSTS}
    flags = np.asarray(metrics.flag)
    return {
        "count": count,
        "successes": successes,
        "success_rate": successes / count,
        "success_interval": [low, high],
        "over_successes": {name: _spread(column[success]) for name, column in columns.items()},
        "over_all": {name: _spread(column) for name, column in columns.items() if name != "settling_time"},
        "flagged": {bit.name.lower(): int(((flags & bit) != 0).sum()) for bit in Flag if bit.name},
    }


def _spread(values: Float[np.ndarray, " starts"]) -> dict[str, float]:
    if values.size == 0:
        return dict.fromkeys(("mean", "median", "max"), float("nan"))
    return {"mean": float(values.mean()), "median": float(np.median(values)), "max": float(values.max())}
