"""Figure of robustness cards: success rate over each criterion's grid, one line per controller."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cpjax.errors import InputError
from cpjax.show.figures import as_text
from cpjax.study.robustness import Criterion, RobustnessCard

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#333333")
_SCALES: Mapping[str, float] = {"s": 1e3}
_UNITS: Mapping[str, str] = {"s": "ms"}


def robustness_figure(cards: Mapping[str, RobustnessCard]) -> Figure:
    """Draws success rate against what is wrong, one panel per criterion and one line per controller.

    A band is the 95 % interval. For the plant's parameters, a thick line is the mean over all of them and each thin
    line one of them. The legend has the rate on the rig as it is, and that with all parameters wrong at once.

    Args:
      cards: by the controllers' titles.

    Raises:
      InputError: no card.
    """
    if not cards:
        raise InputError("cards", cards, "one controller's card at least")
    figure = Figure(figsize=(12, 7.5 + 0.25 * len(cards)), layout="constrained")
    panels: Any = figure.subplots(2, 3, sharey=True)
    first = next(iter(cards.values()))
    for axes, criterion in zip(panels.flat, first.criteria, strict=True):
        for colour, card in zip(_cycled(len(cards)), cards.values(), strict=True):
            one = next(c for c in card.criteria if c.name == criterion.name)
            _draw(axes, one, colour)
        axes.set_title(criterion.title, loc="left", fontsize=11)
        axes.set_ylim(-3, 103)
        axes.grid(alpha=0.3)
    for axes in panels[:, 0]:
        axes.set_ylabel("success rate [%]")
    lines = [Line2D([], [], color=colour, linewidth=2) for colour in _cycled(len(cards))]
    labels = [
        as_text(
            f"{name}: {100 * card.nominal.rates[0]:.1f} % as it is, {100 * card.together.rates[0]:.1f} % with all "
            "parameters wrong"
        )
        for name, card in cards.items()
    ]
    figure.legend(lines, labels, loc="outside lower center", ncols=1, frameon=False, fontsize=10)
    return figure


def _cycled(count: int) -> list[str]:
    return [_COLOURS[i % len(_COLOURS)] for i in range(count)]


def _draw(axes: Axes, criterion: Criterion, colour: str) -> None:
    grid = criterion.grids[0]
    if len(criterion.grids) > 1:  # every parameter against its share of the nominal value
        share = 100.0 * (grid.values / grid.values[len(grid.values) // 2] - 1.0)
        for one in criterion.grids:
            axes.plot(share, 100.0 * one.rates, color=colour, linewidth=0.7, alpha=0.35)
        axes.plot(share, 100.0 * np.mean([one.rates for one in criterion.grids], axis=0), color=colour, linewidth=2)
        axes.set_xlabel("error of one parameter [%]")
        return
    values = grid.values * _SCALES.get(grid.unit, 1.0)
    low, high = 100.0 * grid.intervals.T
    axes.fill_between(values, low, high, color=colour, alpha=0.15, linewidth=0)
    axes.plot(values, 100.0 * grid.rates, color=colour, linewidth=2)
    axes.set_xlabel(f"{grid.name} [{_UNITS.get(grid.unit, grid.unit)}]")
