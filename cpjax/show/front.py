"""Trade-off fronts as figures and sentences."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import AutoLocator, NullLocator, StrMethodFormatter

from cpjax.errors import InputError
from cpjax.show.figures import DESIGN_COLOURS, DESIGN_NAMES

COST_LABELS = {
    "effort": "effort [V$^2$ s]",
    "cart_travel": "cart travel [m]",
    "voltage_variation": "variation of the voltage [V]",
}
_MARKERS = {"paper, as printed": "^", "paper, corrected": "v"}  # all others: a diamond


class Curve(NamedTuple):
    """Front of one design and one cost, traced by gradients, and that of random search."""

    traced: np.ndarray[Any, Any]
    """Mean settling times [s] and mean costs (n, 2)."""
    random: np.ndarray[Any, Any]
    """The same for random search (m, 2)."""
    traced_volume: float
    random_volume: float


class Known(NamedTuple):
    """Controller shown as a point."""

    label: str
    design: str
    time: float
    """Mean settling time [s]."""
    cost: float
    success: float
    """Fraction of the initial states from which it settles."""


def fronts(
    curves: Mapping[str, Mapping[str, Curve]],
    baseline: Mapping[str, Mapping[str, np.ndarray[Any, Any]]],
    known: Mapping[str, Sequence[Known]],
) -> Figure:
    """Draws one panel per cost: the fronts, the baselines as stars, and known controllers as hollow points.

    Args:
      curves: by cost and design.
      baseline: by cost and design, the baseline's mean settling time [s] and mean cost (2,); not drawn if not finite.
      known: by cost.
    """
    figure = Figure(figsize=(5.2 * len(curves), 5.6), layout="constrained")
    panels = figure.subplots(1, len(curves), squeeze=False)[0]
    for axes, (cost, designs) in zip(panels, curves.items(), strict=True):
        for design, curve in designs.items():
            _draw(axes, design, curve)
        for design, point in baseline[cost].items():
            if np.all(np.isfinite(point)):
                axes.plot(
                    *point, "*", color=DESIGN_COLOURS[design], markersize=11, label=f"{DESIGN_NAMES[design]}, baseline"
                )
        # The view holds fronts, baselines and controllers that nearly always settle; others are drawn at its edge.
        good = [(one.time, one.cost) for one in known[cost] if one.success > 0.9]
        found = [np.concatenate([curve.traced, curve.random]) for curve in designs.values()]
        shown = np.concatenate([*found, np.reshape([*baseline[cost].values(), *good], (-1, 2))])
        low, high = _view(shown)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        for one in known[cost]:
            label = (
                f"{DESIGN_NAMES[one.design]}, {one.label} ({100 * one.success:.0f} % settle, after {one.time:.1f} s)"
            )
            at = np.clip([one.time, one.cost], low, high)
            style = {"color": DESIGN_COLOURS[one.design], "fillstyle": "none", "markersize": 9, "clip_on": False}
            axes.plot(*at, _MARKERS.get(one.label, "D"), label=label, **style)
        _time_axis(axes)
        axes.set_ylabel("mean " + COST_LABELS[cost])
        axes.grid(alpha=0.3)
        axes.set_title(_verdict(designs), fontsize="medium")
    handles = {
        label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize="small"
    )
    return figure


def _view(shown: np.ndarray[Any, Any]) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Returns the lower left and upper right corner of the view: the finite points of `shown` (n, 2) and a margin."""
    finite = shown[np.all(np.isfinite(shown), axis=1)]
    if not len(finite):
        return np.array([1.0, 0.0]), np.array([10.0, 1.0])
    scaled = np.stack([np.log(finite[:, 0]), finite[:, 1]], axis=1)  # logarithmic time, as on `_time_axis`
    low, high = np.min(scaled, axis=0), np.max(scaled, axis=0)
    room = np.where(high > low, 0.12 * (high - low), 0.12 * np.maximum(np.abs(high), 1e-9))
    low, high = low - room, high + room
    return np.array([np.exp(low[0]), low[1]]), np.array([np.exp(high[0]), high[1]])


class _Times(AutoLocator):
    """Tick locator of a logarithmic time axis [s]."""

    def tick_values(self, vmin: float, vmax: float) -> Sequence[float]:
        """Returns round values; those of a linear axis where fewer than three round ones are in range."""
        steps = np.outer(10.0 ** np.arange(-2, 4), [1, 1.5, 2, 2.5, 3, 4, 5, 6, 8]).ravel()
        inside = steps[(steps >= vmin) & (steps <= vmax)]
        return inside.tolist() if len(inside) > 2 else super().tick_values(vmin, vmax)


def _time_axis(axes: Axes) -> None:
    """Makes the time axis logarithmic: the bend of a front is at its fast end."""
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(_Times())
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("mean settling time [s]")


def by_supply(curves: Mapping[float, Mapping[str, Curve]]) -> Figure:
    """Draws settling time against effort, one panel per supply.

    Args:
      curves: by supply [V] and design.

    Raises:
      InputError: no supply.
    """
    if not curves:
        raise InputError("curves", curves, "the fronts of one supply at least")
    figure = Figure(figsize=(4.2 * len(curves), 4.6), layout="constrained")
    panels = figure.subplots(1, len(curves), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (supply, designs) in zip(panels, sorted(curves.items()), strict=True):
        for design, curve in designs.items():
            _draw(axes, design, curve)
        if not any(len(curve.traced) + len(curve.random) for curve in designs.values()):
            axes.text(
                0.5,
                0.5,
                "no controller found\nthat settles from enough initial states",
                ha="center",
                transform=axes.transAxes,
            )
        axes.set_title(f"{supply:g} V\n{_verdict(designs)}", fontsize="medium")
        _time_axis(axes)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("mean " + COST_LABELS["effort"])
    panels[0].legend(frameon=False, fontsize="small")
    return figure


def findings(curves: Mapping[tuple[float, str], Mapping[str, Curve]]) -> list[str]:
    """Returns one sentence per supply and cost that compares the designs, and gradients with random search.

    Args:
      curves: by (supply [V], cost) and design.
    """
    sentences = []
    for (supply, cost), designs in curves.items():
        said = [f"{DESIGN_NAMES[design]} {_found(curve)}" for design, curve in designs.items()]
        ordered = sorted(designs, key=lambda design: -designs[design].traced_volume)
        most, least = (designs[design].traced_volume for design in (ordered[0], ordered[-1]))
        if least > 0.0:
            lead = 100.0 * (1.0 - least / most)
            said.append(f"{DESIGN_NAMES[ordered[-1]]} dominates {lead:.0f} % less than {DESIGN_NAMES[ordered[0]]}")
        sentences.append(f"Settling time against {cost.replace('_', ' ')} at {supply:g} V: {'; '.join(said)}.")
    return sentences


def _found(curve: Curve) -> str:
    """Says what tracing by gradients and random search find for one design."""
    if not len(curve.traced):
        other = "random search has some" if len(curve.random) else "neither does random search"
        return f"has no point by gradients, {other}"
    words = f"settles after {curve.traced[0, 0]:.2f} s at the fastest"
    if not curve.traced_volume:
        return f"{words}, beyond the reference of the hypervolume"
    share = 100.0 * (1.0 - curve.random_volume / curve.traced_volume)
    return f"{words}, and random search dominates {abs(share):.0f} % {'less' if share >= 0 else 'more'} than its front"


def _draw(axes: Axes, design: str, curve: Curve) -> None:
    colour, name = DESIGN_COLOURS[design], DESIGN_NAMES[design]
    marker = "s" if design == "lqr" else "o"
    axes.step(*curve.traced.T, where="post", color=colour, linewidth=1.2)
    axes.plot(*curve.traced.T, marker, color=colour, markersize=4, label=f"{name}, by gradients")
    axes.step(*curve.random.T, where="post", color=colour, linewidth=0.9, linestyle="--", alpha=0.7)
    axes.plot(*curve.random.T, "x", color=colour, markersize=4, alpha=0.7, label=f"{name}, random search")


def _verdict(designs: Mapping[str, Curve]) -> str:
    """Says by how much the hypervolume of random search differs from that of the traced front."""
    parts = []
    for design, curve in designs.items():
        if curve.traced_volume:
            share = f"{100 * (curve.random_volume / curve.traced_volume - 1.0):+.0f} %"
        else:
            none = "beyond the reference" if len(curve.traced) else "none"
            share = f"some, by gradients {none}" if len(curve.random) else none
        parts.append(f"{DESIGN_NAMES[design]} {share}")
    return "hypervolume of random search:\n" + ", ".join(parts)
