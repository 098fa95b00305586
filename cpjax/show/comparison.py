"""A comparison of controllers as a table, sentences and figures."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from cpjax.controllers import REGULATE, SWING_UP, Hybrid
from cpjax.numeric.angles import wrap_angle
from cpjax.numeric.statistics import mcnemar_p_value
from cpjax.paper.comparison import Compared, best
from cpjax.paper.reproduction import DESIGNS
from cpjax.plant import CartPole
from cpjax.plant.state import State
from cpjax.show.figures import DESIGN_COLOURS, DESIGN_NAMES, GATE_COLOUR, SIDE_BY_SIDE
from cpjax.sim.rollout import Trajectory

HEADER = (
    "controller",
    "regulator",
    "gains",
    "success [%]",
    "95 % interval",
    "settling [s]",
    "its maximum [s]",
    "travel [m]",
    "effort [V^2 s]",
    "variation of u [V]",
    "peak x'' [m/s^2]",
)


def headline(results: Sequence[Compared]) -> list[tuple[str, str, str]]:
    """Returns the success rates of the paper's printed and of the tuned controllers: value, interval, what it is."""
    chosen = [one for one in results if one.entry.gains == "tuned" or one.entry.name == "paper, as printed"]
    numbers = []
    for one in chosen:
        if one.entry.gains != "computed":
            low, high = one.summary["success_interval"]
            value = f"{100 * one.summary['success_rate']:.1f} %"
            what = f"of initial states settle: {one.entry.name}, {DESIGN_NAMES[one.entry.design]}"
            numbers.append((value, f"({100 * low:.1f} to {100 * high:.1f})", what))
    return numbers


def cells(one: Compared) -> list[str]:
    """Returns a row of the table: means over the successful runs, and the longest settling time."""
    good: Mapping[str, Any] = one.summary["over_successes"]
    low, high = one.summary["success_interval"]

    def text(name: str, digits: int, what: str = "mean") -> str:
        value = good[name][what]
        return f"{value:.{digits}f}" if value == value else "-"

    return [
        one.entry.name,
        DESIGN_NAMES[one.entry.design],
        one.entry.gains,
        f"{100 * one.summary['success_rate']:.2f}",
        f"{100 * low:.2f}-{100 * high:.2f}",
        text("settling_time", 2),
        text("settling_time", 2, "max"),
        text("cart_travel", 2),
        text("effort", 0),
        text("voltage_variation", 0),
        text("peak_cart_acceleration", 1),
    ]


def findings(results: Sequence[Compared]) -> list[str]:
    """Returns a comparison of LQR and pole placement in words: first for the paper's gains, then for tuned ones."""
    return [_answer(results, tuned=False), _answer(results, tuned=True)]


def _answer(results: Sequence[Compared], *, tuned: bool) -> str:
    a, b = (best(results, design, tuned=tuned) for design in DESIGNS)
    kind = "Tuned" if tuned else "Of the paper's laws and gains, as printed or computed anew, the better of each"
    caught_by_a, caught_by_b = (np.asarray(one.metrics.success) for one in (a, b))
    p = mcnemar_p_value(int(np.sum(caught_by_a & ~caught_by_b)), int(np.sum(caught_by_b & ~caught_by_a)))
    verdict = "a difference" if p < 1e-3 else "no difference at 99.9 %"
    if mcnemar_p_value(len(caught_by_a), 0) >= 1e-3:
        verdict = "too few initial states to show a difference"

    def words(one: Compared) -> str:
        good = one.summary["over_successes"]
        if not one.summary["successes"]:
            return f"{DESIGN_NAMES[one.entry.design]} catches none of the initial states"
        return (
            f"{DESIGN_NAMES[one.entry.design]} catches {100 * one.summary['success_rate']:.2f} % of the initial "
            f"states, settles after {good['settling_time']['mean']:.2f} s, uses {good['cart_travel']['mean']:.2f} m "
            f"and {good['effort']['mean']:.0f} V^2 s, and moves the voltage by {good['voltage_variation']['mean']:.0f} "
            "V"
        )

    return f"{kind}: {words(a)}; {words(b)} ({verdict} in success by McNemar's test)."


Shown: TypeAlias = Mapping[tuple[str, str], tuple[Compared, Trajectory]]
"""A controller and its run from the one initial state shown, by "paper" or "tuned" and design."""


def responses(shown: Shown, until: float, limit: float, title: str) -> Figure:
    """Draws angle, cart position and voltage of the paper's and the tuned controllers, the designs side by side.

    Args:
      shown: all runs from one initial state.
      until: end of the time axis [s].
      limit: voltage limit [V], drawn as dotted lines.
    """
    figure = Figure(figsize=(12, 8), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(3, 2, sharex=True, sharey="row")
    for column, design in enumerate(SIDE_BY_SIDE):
        for kind, style in (("paper", "--"), ("tuned", "-")):
            one, run = shown[kind, design]
            time = np.asarray(run.time)
            colour = DESIGN_COLOURS[design] if kind == "tuned" else "#777777"
            series = (wrapped(run.state), np.asarray(run.state.x), np.asarray(run.voltage))
            for row, values in enumerate(series):
                axes[row, column].plot(time, values, style, color=colour, label=_label(one), linewidth=1.3)
        numbers = {"lqr": "3 and 5", "placement": "4 and 6"}[design]
        axes[0, column].set_title(f"{DESIGN_NAMES[design]} (the paper's Figures {numbers})")
        axes[2, column].set_xlabel("time [s]")
        axes[2, column].set_xlim(0, until)
        for sign in (-1, 1):
            axes[2, column].axhline(sign * limit, color="0.4", linewidth=0.8, linestyle=":")
        for row in range(3):
            axes[row, column].grid(alpha=0.3)
        axes[1, column].legend(frameon=False, loc="lower right")
    for row, label in enumerate((r"$\theta$, modulo a turn [rad]", "x [m]", "voltage [V]")):
        axes[row, 0].set_ylabel(label)
    low, high = axes[1, 0].get_ylim()
    if max(-low, high) > 3.0:
        axes[1, 0].set_ylim(max(low, -3.0), min(high, 3.0))
        axes[1, 0].set_ylabel("x [m] (cut at 3 m)")
    return figure


def phase_portraits(plant: CartPole, shown: Shown, title: str) -> Figure:
    """Draws angle and rate of the whole runs, over the pendulum's energy levels and each controller's gate."""
    figure = Figure(figsize=(12, 9), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    fastest = max(float(np.max(np.abs(np.asarray(run.state.theta_dot)))) for _, run in shown.values())
    per_lift = 4.0 * float(plant.pole_mass) * float(plant.gravity) * float(plant.pole_length)
    whole_turn = math.sqrt(per_lift / float(plant.pivot_inertia))  # rate when hanging, with the energy of upright
    high = min(1.1 * max(fastest, whole_turn), 2.5 * whole_turn)  # a pole that spins leaves the view
    for column, design in enumerate(SIDE_BY_SIDE):
        for row, kind in enumerate(("paper", "tuned")):
            panel, (one, run) = axes[row, column], shown[kind, design]
            _energy_and_gate(panel, plant, one.entry.controller, high)
            theta, rate = wrapped(run.state), np.asarray(run.state.theta_dot)
            regulating = np.asarray(run.mode) == REGULATE
            for part, width in ((~regulating, 0.9), (regulating, 2.4)):
                path = np.where(part, theta, np.nan), np.where(part, rate, np.nan)
                panel.plot(*path, color=DESIGN_COLOURS[design], linewidth=width)
            panel.plot(theta[:1], rate[:1], "o", color="black", markersize=5)
            panel.set_ylim(-high, high)
            panel.set_title(f"{DESIGN_NAMES[design]}: {_label(one)}", fontsize="medium")
        axes[1, column].set_xlabel(r"$\theta$ from upright [rad]")
    for row in range(2):
        axes[row, 0].set_ylabel(r"$\dot\theta$ [rad/s]")
    legend = {
        "swing-up acts": Line2D([], [], color="0.35", linewidth=0.9),
        "regulator acts": Line2D([], [], color="0.35", linewidth=2.4),
        "start": Line2D([], [], color="black", marker="o", linestyle="none", markersize=5),
        "energy of upright": Line2D([], [], color="black", linewidth=1.3, linestyle="--"),
        "other energies, 20 % of 2 m g l apart": Line2D([], [], color="0.75", linewidth=0.8),
        "gate": Patch(facecolor=GATE_COLOUR, alpha=0.25),
    }
    figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=6, frameon=False)
    return figure


def _label(one: Compared) -> str:
    return one.entry.name if one.entry.gains == "tuned" else f"{one.entry.name}, {one.entry.gains} gains"


def _energy_and_gate(axes: Axes, plant: CartPole, controller: Hybrid, high: float) -> None:
    """Draws energy levels and gate for the cart at rest at x = 0, for theta from -pi to pi."""
    theta, rate = np.linspace(-np.pi, np.pi, 401), np.linspace(-high, high, 401)
    grid = np.meshgrid(theta, rate)
    state = State(np.zeros_like(grid[0]), np.zeros_like(grid[0]), *grid)
    lift = 2.0 * plant.pole_mass * plant.gravity * plant.pole_length
    energy = np.asarray(plant.pendulum_energy(state)) / float(lift)
    levels = np.arange(-0.8, float(energy.max()), 0.2)
    axes.contour(
        theta, rate, energy, levels=levels[np.abs(levels) > 0.1], colors="0.75", linewidths=0.8, linestyles="-"
    )
    axes.contour(theta, rate, energy, levels=[0.0], colors="black", linewidths=1.3, linestyles="--")
    margin = np.asarray(controller.gate.margin(state, jnp.int32(SWING_UP)))
    if margin.max() > 0.0:
        axes.contourf(theta, rate, margin, levels=[0.0, float(margin.max())], colors=[GATE_COLOUR], alpha=0.25)


def wrapped(state: State) -> np.ndarray[Any, Any]:
    """Returns theta (n,), wrapped to [-pi, pi] [rad]; NaN where it jumps by a turn."""
    theta = np.asarray(wrap_angle(state.theta)).copy()
    theta[1:][np.abs(np.diff(theta)) > np.pi] = np.nan
    return theta


def by_start(starts: State, results: Sequence[Compared]) -> Figure:
    """Draws the settling time of every initial state over its angle and rate; failures as crosses.

    Args:
      starts: of arrays (n,).
      results: of all controllers compared; the best of each design is drawn, of the paper's and of the tuned ones.
    """
    figure = Figure(figsize=(12, 6.5), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    theta, rate = np.asarray(starts.theta), np.asarray(starts.theta_dot)
    shown = [[best(results, design, tuned=tuned) for design in SIDE_BY_SIDE] for tuned in (False, True)]
    metrics = [one.metrics for row in shown for one in row]
    times = np.concatenate([np.asarray(one.settling_time)[np.asarray(one.success)] for one in metrics])
    low, high = (float(np.min(times)), float(np.max(times))) if times.size else (1.0, 10.0)
    low = max(low, 0.1)  # a run that begins settled takes 0 s, which has no logarithm
    high = max(high, 1.01 * low)
    norm = LogNorm(low, high)
    drawn: Any = None
    for column, design in enumerate(SIDE_BY_SIDE):
        for row in range(2):
            one, panel = shown[row][column], axes[row, column]
            good = np.asarray(one.metrics.success)
            time = np.asarray(one.metrics.settling_time)
            drawn = panel.scatter(theta[good], rate[good], c=time[good], s=5, cmap="viridis", norm=norm)
            panel.plot(theta[~good], rate[~good], "x", color="0.55", markersize=3, alpha=0.6)
            panel.set_title(f"{DESIGN_NAMES[design]}: {_label(one)}", fontsize="medium")
        axes[1, column].set_xlabel(r"initial $\theta$ [rad]")
    for row in range(2):
        axes[row, 0].set_ylabel(r"initial $\dot\theta$ [rad/s]")
    ticks = [tick for tick in (0.1, 0.2, 0.5, 1, 2, 3, 5, 10, 20, 50, 100) if low <= tick <= high]
    bar = figure.colorbar(drawn, ax=axes, label="settling time [s] (x: fails)", ticks=ticks)
    bar.ax.set_yticklabels([f"{tick:g}" for tick in ticks])
    bar.minorticks_off()
    return figure
