"""Figures as matplotlib `Figure` objects, without a window or global state.

The palette is Okabe and Ito's, which colour-blind readers can distinguish; a design has the same colour in all figures.
"""

import io as buffers
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cpjax import files
from cpjax.controllers import REGULATE, DesignName, Hybrid, PoleFactors
from cpjax.sim.rollout import Trajectory

DESIGN_COLOURS: Mapping[str, str] = {"lqr": "#D55E00", "placement": "#0072B2"}
GATE_COLOUR = "#E69F00"
DESIGN_NAMES: Mapping[str, str] = {"lqr": "LQR", "placement": "pole placement"}
SIDE_BY_SIDE: tuple[DesignName, ...] = ("lqr", "placement")
"""Columns from left to right, in the order of the paper's Figures 3 and 4."""
_X, _THETA, _VOLTAGE, _CATCH = "#009E73", "#CC79A7", "#333333", "#999999"


def design_colour(controller: Hybrid) -> str:
    """Returns the colour of the design of a controller's regulator; LQR's if the regulator has no design."""
    placed = isinstance(getattr(controller.regulator, "design", None), PoleFactors)
    return DESIGN_COLOURS["placement" if placed else "lqr"]


def as_text(words: str) -> str:
    """Returns the words with dollars escaped: matplotlib would typeset text between two dollars as a formula."""
    return words.replace("$", r"\$")


def png(figure: Figure) -> bytes:
    """Returns the figure as the content of a PNG file."""
    buffer = buffers.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    return buffer.getvalue()


def save_figure(path: Path, figure: Figure) -> bytes:
    """Writes a PNG file atomically and returns its content."""
    content = png(figure)
    files.write_bytes(path, content)
    return content


def response(trajectory: Trajectory, title: str, until: float, voltage_limit: float) -> Figure:
    """Draws positions, rates and voltage of one rollout; the time in the regulator is shaded.

    Args:
      until: end of the time axis [s].
      voltage_limit: [V], drawn as dashed lines; inf for none.
    """
    figure = Figure(figsize=(9, 7.5), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    _positions(axes[0], trajectory)
    _rates(axes[1], trajectory)
    _voltage(axes[2], trajectory, voltage_limit)
    axes[2].set_xlabel("time [s]")
    axes[2].set_xlim(0, until)
    figure.suptitle(title)
    return figure


def paper_figures(trajectories: Mapping[Any, Trajectory], title: str, until: float, voltage_limit: float) -> Figure:
    """Draws our runs in the layout of the paper's Figures 3 (LQR), 4 (pole placement), 5 and 6 (their voltages).

    Args:
      trajectories: by design.
      until: end of the time axis [s].
      voltage_limit: [V], drawn as dashed lines; inf for none.
    """
    figure = Figure(figsize=(12, 8.5), layout="constrained")
    axes = figure.subplots(3, 2, sharex=True, sharey="row")
    for column, (design, response_number, voltage_number) in enumerate(zip(SIDE_BY_SIDE, (3, 4), (5, 6), strict=True)):
        trajectory = trajectories[design]
        _positions(axes[0, column], trajectory)
        _rates(axes[1, column], trajectory)
        _voltage(axes[2, column], trajectory, voltage_limit)
        axes[0, column].set_title(f"Figure {response_number}: {DESIGN_NAMES[design]} response", loc="left", pad=20)
        axes[2, column].set_title(f"Figure {voltage_number}: {DESIGN_NAMES[design]} voltage", loc="left", pad=20)
        axes[2, column].set_xlabel("time [s]")
        axes[2, column].set_xlim(0, until)
    figure.suptitle(title)
    return figure


def success_rates(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draws the success rate with its 95 % interval for every law and plant; printed gains solid, computed hollow.

    Args:
      rows: of `cpjax.paper.reproduction.reproduce`.
    """
    laws = list(dict.fromkeys(row["law"] for row in rows))
    plants = list(dict.fromkeys(row["plant"] for row in rows))
    figure = Figure(figsize=(10, 1.2 + 1.05 * len(laws) * len(plants) / 2), layout="constrained")
    panels = figure.subplots(1, len(plants), sharey=True, squeeze=False)[0]
    for axes, plant in zip(panels, plants, strict=True):
        for row in rows:
            if row["plant"] != plant:
                continue
            design, gains = row["design"], row["gains"]
            offset = {"lqr": 0.1, "placement": -0.1}[design] * (3 if gains == "computed" else 1)
            y = laws.index(row["law"]) + offset
            rate, (low, high) = row["success_rate"], row["success_interval"]
            axes.errorbar(
                100 * rate,
                y,
                xerr=[[100 * (rate - low)], [100 * (high - rate)]],
                fmt="o" if design == "placement" else "s",
                color=DESIGN_COLOURS[design],
                markerfacecolor=DESIGN_COLOURS[design] if gains == "printed" else "white",
                markersize=6,
                capsize=3,
                label=f"{DESIGN_NAMES[design]}, {gains} gains" if row["law"] == laws[0] else None,
            )
        axes.set_title(f"{plant} plant")
        axes.set_xlim(-3, 103)
        axes.set_xlabel("successful initial states [%]")
        axes.grid(axis="x", alpha=0.3)
    panels[0].set_yticks(range(len(laws)), laws)
    panels[0].invert_yaxis()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _shade_regulation(axes: Axes, trajectory: Trajectory) -> None:
    regulating = np.asarray(trajectory.mode) == REGULATE
    axes.fill_between(
        np.asarray(trajectory.time),
        0,
        1,
        where=regulating.tolist(),
        transform=axes.get_xaxis_transform(),
        color=_CATCH,
        alpha=0.2,
        linewidth=0,
        label="regulator acts",
    )


def _positions(axes: Axes, trajectory: Trajectory) -> None:
    time, state = np.asarray(trajectory.time), trajectory.state
    _shade_regulation(axes, trajectory)
    axes.plot(time, np.asarray(state.x), color=_X, label="x [m]")
    axes.plot(time, np.asarray(state.theta), color=_THETA, label=r"$\theta$ [rad]")
    lowest, highest = axes.get_ylim()
    turns = range(math.ceil(lowest / math.tau), math.floor(highest / math.tau) + 1)
    for turn in turns if len(turns) <= 20 else ():  # more lines, of a spinning pole, would merge into an area
        axes.axhline(turn * math.tau, color=_THETA, linewidth=0.8, linestyle=":")  # upright
    axes.set_ylabel("position")
    _finish(axes)


def _rates(axes: Axes, trajectory: Trajectory) -> None:
    time, state = np.asarray(trajectory.time), trajectory.state
    _shade_regulation(axes, trajectory)
    axes.plot(time, np.asarray(state.x_dot), color=_X, label=r"$\dot x$ [m/s]")
    axes.plot(time, np.asarray(state.theta_dot), color=_THETA, label=r"$\dot\theta$ [rad/s]")
    axes.set_ylabel("rate")
    _finish(axes)


_DRAWABLE = 1e100
"""The largest voltage that an axis can hold [V]: matplotlib multiplies such numbers."""


def _voltage(axes: Axes, trajectory: Trajectory, limit: float) -> None:
    _shade_regulation(axes, trajectory)
    axes.step(
        np.asarray(trajectory.time),
        np.clip(np.asarray(trajectory.voltage), -_DRAWABLE, _DRAWABLE),
        where="post",
        color=_VOLTAGE,
        linewidth=1.0,
        label="u [V], applied",
    )
    if limit <= _DRAWABLE:
        for sign in (-1, 1):
            axes.axhline(sign * limit, color="0.4", linewidth=0.8, linestyle="--")
    axes.set_ylabel("voltage [V]")
    _finish(axes)


def _finish(axes: Axes) -> None:
    axes.grid(alpha=0.3)
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize="small", frameon=False, borderaxespad=0.2
    )
