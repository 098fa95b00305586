"""The figure of a tuning."""

import numpy as np
from matplotlib.figure import Figure

from cpjax.show.figures import design_colour
from cpjax.tune.outcome import Tuning

_OTHERS = "#999999"


def picture(tuning: Tuning) -> Figure:
    """Draws settling time and success rate of every restart over the steps; the best of each validation in colour."""
    colour = design_colour(tuning.controller)
    steps = np.array([record["step"] for record in tuning.history])
    times = np.array([record["settling_times"] for record in tuning.history])
    rates = 100.0 * np.array([record["success_rates"] for record in tuning.history])
    scores = np.array([record["scores"] for record in tuning.history], dtype=float)
    best = np.argmin(scores, axis=1)
    rows = np.arange(len(steps))
    figure = Figure(figsize=(9, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for axes, values in ((above, times), (below, rates)):
        axes.plot(steps, values, ".", color=_OTHERS, markersize=5)
        axes.plot(steps, values[rows, best], "o-", color=colour, markersize=5, label="best of this validation by score")
        axes.grid(alpha=0.3)
    above.set_ylabel("mean settling time [s]")
    below.set_ylabel("successful initial states [%]")
    below.set_xlabel("optimiser step")
    above.legend(frameon=False)
    chosen = f"chosen: {tuning.settling_time:.2f} s, {100 * tuning.success_rate:.2f} % (last comparison)"
    figure.suptitle(chosen)
    return figure
