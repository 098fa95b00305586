"""A figure of one swing-up that is redrawn for each new controller, for the sliders of a notebook."""

import jax
import numpy as np
from matplotlib.figure import Figure

from cpjax.controllers import Hybrid
from cpjax.plant import CartPole
from cpjax.plant.state import HANGING, State
from cpjax.show.comparison import wrapped
from cpjax.show.figures import design_colour
from cpjax.sim.rollout import Trajectory, rollout


class Explorer:
    """Figure of angle, cart position and voltage under a controller, drawn once and then updated.

    The rollout is compiled once: a gain, weight, pole or gate parameter is an argument of the compiled program.

    Args:
      duration: length of the rollout [s].
      dt: integration step and control period [s].
      save_every: steps from one drawn sample to the next.

    Attributes:
      figure: the matplotlib figure.
    """

    def __init__(
        self, plant: CartPole, start: State = HANGING, *, duration: float = 6.0, dt: float = 0.002, save_every: int = 10
    ) -> None:
        def run(controller: Hybrid) -> Trajectory:
            return rollout(plant, controller, start, duration=duration, dt=dt, clock="sampled", save_every=save_every)

        self._run = jax.jit(run)
        self.figure = Figure(figsize=(8, 4.8), dpi=72)
        self.figure.subplots_adjust(left=0.1, right=0.98, top=0.92, bottom=0.11, hspace=0.12)
        axes = self.figure.subplots(3, 1, sharex=True)
        limit = float(plant.motor.voltage_limit)
        labels = ("angle from\nupright [rad]", "x [m]", "voltage [V]")
        ranges = ((-np.pi, np.pi), (-2.0, 2.0), (-1.1 * limit, 1.1 * limit) if np.isfinite(limit) else (-30.0, 30.0))
        self._lines = []
        for panel, label, ends in zip(axes, labels, ranges, strict=True):
            (line,) = panel.plot([], [], linewidth=1.3)
            self._lines.append(line)
            panel.set_ylabel(label)
            panel.set_ylim(*ends)
            panel.grid(alpha=0.3)
        axes[0].set_xlim(0.0, duration)
        axes[-1].set_xlabel("time [s]")
        self._title = axes[0].set_title("")

    def show(self, controller: Hybrid) -> Figure:
        """Simulates this controller, updates the figure and returns it."""
        run = jax.tree.map(np.asarray, self._run(controller))
        for line, values in zip(self._lines, (wrapped(run.state), run.state.x, run.voltage), strict=True):
            line.set_data(run.time, values)
            line.set_color(design_colour(controller))
        found = run.metrics
        if found.success:
            words = f"settles after {found.settling_time:.2f} s, travel {found.cart_travel:.2f} m, "
            self._title.set_text(words + f"effort {found.effort:.0f} V$^2$ s, {found.switches} changes of mode")
        else:
            self._title.set_text(f"does not settle in {run.time[-1]:.0f} s")
        return self.figure
