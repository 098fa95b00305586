"""Maps of basins of attraction: settling time and mode changes over two coordinates of the initial state."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cpjax.controllers import Hybrid
from cpjax.controllers.protocol import SWING_UP
from cpjax.errors import InputError
from cpjax.plant.state import NAMES, State
from cpjax.show.figures import GATE_COLOUR, as_text
from cpjax.sim.metrics import Metrics
from cpjax.study.basin import Area, StartGrid
from cpjax.study.design_check import DesignCheck

LABELS = {
    "x": "x [m]",
    "x_dot": r"$\dot x$ [m/s]",
    "theta": r"$\theta$ from upright [rad]",
    "theta_dot": r"$\dot\theta$ [rad/s]",
}
_FAILED = "#c9c9c9"
_SATURATION, _CERTIFIED = "#111111", "#CC79A7"
_MOST_SWITCHES = 6
_FINE = 400  # grid points along an axis, for contour lines


class Panel(NamedTuple):
    """Map of one controller."""

    title: str
    controller: Hybrid
    voltage_limit: float
    check: DesignCheck | None
    """Check of its regulator and gate; None where `check_design` does not support them."""
    metrics: Metrics
    area: Area


def basins(chart: StartGrid, panels: Sequence[Panel]) -> Figure:
    """Draws settling time and number of mode changes of every cell, one column per controller; failures are grey.

    Orange: the gate. Black: beyond it, the regulator demands more than the voltage limit. Pink: the level set certified
    for the linear model. The lines hold in the plane in which the other coordinates have their middle values.

    Args:
      chart: the grid of initial states.
      panels: one per controller; their metrics are arrays (rows * columns,) in the order of `chart.starts()`.

    Raises:
      InputError: no panel.
    """
    if not panels:
        raise InputError("panels", panels, "one controller's map at least")
    figure = Figure(figsize=(1.2 + 4.3 * len(panels), 9.2), layout="constrained")
    axes = figure.subplots(2, len(panels), sharex=True, sharey=True, squeeze=False)
    longest = max(_longest(panel.metrics) for panel in panels) or 1.0
    times = Normalize(0.0, longest)
    counts = BoundaryNorm(np.arange(-0.5, _MOST_SWITCHES + 1), _MOST_SWITCHES + 1)
    few = ListedColormap(["#440154", "#3b528b", "#21918c", "#5ec962", "#fde725", "#f0a0c8", "#a0305a"])
    drawn: list[Any] = [None, None]
    for column, panel in enumerate(panels):
        good = np.asarray(panel.metrics.success).reshape(chart.shape)
        time = np.asarray(panel.metrics.settling_time, float).reshape(chart.shape)
        switches = np.minimum(np.asarray(panel.metrics.switches), _MOST_SWITCHES).reshape(chart.shape)
        for row, (values, style) in enumerate(
            ((time, {"cmap": "viridis", "norm": times}), (switches, {"cmap": few, "norm": counts}))
        ):
            panel_axes = axes[row, column]
            panel_axes.set_facecolor(_FAILED)
            edges = chart.across.edges(), chart.up.edges()
            drawn[row] = panel_axes.pcolormesh(*edges, np.ma.masked_where(~good, values), rasterized=True, **style)
            _lines(panel_axes, chart, panel)
        found = panel.area
        axes[0, column].set_title(
            f"{as_text(panel.title)}\n{100 * found.share:.1f} % of the map: {found.value:.2f} ± {found.half_width:.2f} "
            f"{chart.across.unit} {chart.up.unit}",
            fontsize="medium",
        )
        axes[1, column].set_xlabel(LABELS[chart.across.name])
    for row in range(2):
        axes[row, 0].set_ylabel(LABELS[chart.up.name])
    figure.colorbar(drawn[0], ax=axes[0], label="settling time [s] (grey: fails)", extend="max")
    bar = figure.colorbar(drawn[1], ax=axes[1], label="changes of mode", ticks=range(_MOST_SWITCHES + 1))
    bar.ax.set_yticklabels([*map(str, range(_MOST_SWITCHES)), f"{_MOST_SWITCHES}+"])
    names = ("gate", "regulator demands the voltage limit", "certified for the linear model")
    handles = [Line2D([], [], color=GATE_COLOUR), Line2D([], [], color=_SATURATION, linestyle="--")]
    handles.append(Line2D([], [], color=_CERTIFIED))
    figure.legend(handles, names, loc="outside lower center", ncols=3 if len(panels) > 1 else 1, frameon=False)
    others = ", ".join(f"{_range(chart, name)}" for name in chart.middle)
    figure.suptitle(f"Sampled, not certified: one run\u00a0from each of {good.size:,} cells; {others}", wrap=True)
    return figure


def _longest(metrics: Metrics) -> float:
    """Returns the time within which 99 % of the successful runs settle [s]; 1 s if there are none."""
    times = np.asarray(metrics.settling_time)[np.asarray(metrics.success)]
    return float(np.quantile(times, 0.99)) if times.size else 1.0


def _range(chart: StartGrid, name: str) -> str:
    low, high = chart.others.get(name, (0.0, 0.0))
    return f"{name} = {low:g}" if low == high else f"{name} from {low:g} to {high:g}"


def _lines(axes: Axes, chart: StartGrid, panel: Panel) -> None:
    across = np.linspace(chart.across.low, chart.across.high, _FINE)
    up = np.linspace(chart.up.low, chart.up.high, _FINE)
    grid = dict(zip((chart.across.name, chart.up.name), np.meshgrid(across, up), strict=True))
    columns = {name: np.asarray(grid.get(name, np.full((_FINE, _FINE), chart.middle.get(name)))) for name in NAMES}
    state = State(**columns)
    margin = np.asarray(panel.controller.gate.margin(state, jnp.int32(SWING_UP)))
    fields = [(margin, 0.0, GATE_COLOUR, "-")]
    if panel.check is not None:
        reference = getattr(panel.controller.regulator, "reference", None)
        s = np.stack([columns[n] - (0.0 if reference is None else float(getattr(reference, n))) for n in NAMES])
        s[2] = (s[2] + np.pi) % (2.0 * np.pi) - np.pi
        asked = np.abs(np.einsum("i,i...->...", panel.check.K[0], s))
        fields.append((asked, panel.voltage_limit, _SATURATION, "--"))
        if panel.check.P is not None and panel.check.level is not None:
            form = np.einsum("i...,ij,j...->...", s, panel.check.P, s)
            fields.append((form, panel.check.level, _CERTIFIED, "-"))
    for field, level, colour, style in fields:
        if np.isfinite(level) and field.min() < level < field.max():
            axes.contour(across, up, field, levels=[level], colors=[colour], linestyles=[style], linewidths=1.2)
