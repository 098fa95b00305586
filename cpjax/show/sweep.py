"""The figure of a sweep."""

import numpy as np
from matplotlib.figure import Figure

from cpjax.numeric.angles import wrap_angle
from cpjax.plant.state import State
from cpjax.sim.metrics import Metrics

_MOST = 20_000  # dots of a scatter plot; thinning leaves up to twice as many
_FAILED = "#D55E00"


def picture(starts: State, metrics: Metrics) -> Figure:
    """Draws the settling time over the initial angle and rate, with failures in another colour, and its histogram.

    Args:
      starts: initial states, of arrays (n,).
      metrics: of arrays (n,).
    """
    some = slice(None, None, max(1, len(np.asarray(starts.x)) // _MOST))
    from_hanging = np.degrees(np.asarray(wrap_angle(np.asarray(starts.theta)[some] - np.pi)))
    rate = np.asarray(starts.theta_dot)[some]
    times, good = np.asarray(metrics.settling_time), np.asarray(metrics.success)
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    won = good[some]
    dots = left.scatter(from_hanging[won], rate[won], c=times[some][won], s=4, cmap="viridis", rasterized=True)
    left.plot(from_hanging[~won], rate[~won], ".", color=_FAILED, markersize=3, label="failed")
    left.set_xlabel("initial angle from hanging [deg]")
    left.set_ylabel("initial angular rate [rad/s]")
    if won.any():
        figure.colorbar(dots, ax=left, label="settling time [s]")
    if not won.all():
        left.legend(frameon=False)
    if good.any():
        right.hist(times[good], bins=80, color="#0072B2")
    right.set_xlabel("settling time [s]")
    right.set_ylabel("starts")
    right.grid(alpha=0.3)
    figure.suptitle(f"{good.sum()} of {good.size} initial states settle")
    return figure
