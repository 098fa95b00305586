"""Sampled basin of attraction: one closed-loop run from each cell of a grid over two coordinates of the initial state.

The basin is sampled, not certified: an initial state between two that succeed may fail.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from cpjax.errors import InputError
from cpjax.numeric.statistics import wilson_interval
from cpjax.plant.state import NAMES, UNITS, State
from cpjax.pytree import Number
from cpjax.sim.metrics import Metrics

MOST_CELLS = 4096
"""Largest number of cells along one axis."""
_SIGMAS = 1.959963984540054  # half width of the central 95 % of a normal distribution, in standard deviations
_FINITE = Number("SI unit", "")


def _finite(name: str, value: Any) -> float:
    if np.ndim(value):
        raise InputError(name, value, "one finite number")
    return float(_FINITE.normalise(name, value))


@dataclasses.dataclass(frozen=True)
class Axis:
    """One coordinate of the initial state, divided into `cells` equal cells from `low` to `high`."""

    name: str
    low: float
    high: float
    cells: int = 512

    def __post_init__(self) -> None:
        if self.name not in NAMES:
            raise InputError("Axis.name", self.name, "one of " + ", ".join(NAMES))
        for name in ("low", "high"):
            object.__setattr__(self, name, _finite(f"Axis.{name}", getattr(self, name)))
        if not self.low < self.high:
            raise InputError("Axis.high", self.high, f"above low, {self.low}")
        if isinstance(self.cells, bool) or not isinstance(self.cells, int) or not 2 <= self.cells <= MOST_CELLS:
            raise InputError("Axis.cells", self.cells, f"a whole number from 2 to {MOST_CELLS}")

    @property
    def unit(self) -> str:
        """Unit of the coordinate."""
        return UNITS[NAMES.index(self.name)]

    def edges(self) -> Float[np.ndarray, " edges"]:
        """Returns the edges of the cells, one more than cells, in `unit`."""
        return np.linspace(self.low, self.high, self.cells + 1)


@dataclasses.dataclass(frozen=True)
class StartGrid:
    """Grid of initial states for a sampled basin: one in each cell, at a random position within it.

    Attributes:
      across: the horizontal axis.
      up: the vertical axis.
      others: (low, high) of the other two coordinates, between which each initial state's value is drawn uniformly;
        (0, 0) where nothing is given.
      seed: of the random numbers.
    """

    across: Axis
    up: Axis
    others: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    seed: int = 1

    def __post_init__(self) -> None:
        if self.across.name == self.up.name:
            raise InputError("StartGrid.up", self.up.name, f"another coordinate than across, {self.across.name}")
        free = [name for name in NAMES if name not in (self.across.name, self.up.name)]
        for name, ends in self.others.items():
            if name not in free:
                raise InputError("StartGrid.others", name, "one of " + ", ".join(free))
            if not isinstance(ends, (tuple, list)) or len(ends) != 2:
                raise InputError(f"StartGrid.others[{name}]", ends, "two finite numbers, the lower one first")
            low, high = (_finite(f"StartGrid.others[{name}]", end) for end in ends)
            if low > high:
                raise InputError(f"StartGrid.others[{name}]", ends, "two finite numbers, the lower one first")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise InputError("StartGrid.seed", self.seed, "a whole number, at least 0")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (up) and columns (across)."""
        return self.up.cells, self.across.cells

    @property
    def middle(self) -> dict[str, float]:
        """Middle of the range of each coordinate that is not an axis, by name."""
        return {
            n: 0.5 * sum(self.others.get(n, (0.0, 0.0))) for n in NAMES if n not in (self.across.name, self.up.name)
        }

    def starts(self) -> State:
        """Returns one initial state of each cell, as arrays (rows * columns,), the lowest row first."""
        random = np.random.default_rng(self.seed)
        rows, columns = self.shape
        found = {}
        for name in NAMES:
            share = random.uniform(size=self.shape)
            if name == self.across.name:
                found[name] = self._within(self.across, np.arange(columns)[None, :] + share)
            elif name == self.up.name:
                found[name] = self._within(self.up, np.arange(rows)[:, None] + share)
            else:
                low, high = self.others.get(name, (0.0, 0.0))
                found[name] = low + (high - low) * share
        return State(**{name: column.ravel() for name, column in found.items()})

    @staticmethod
    def _within(axis: Axis, cell: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
        return axis.low + (axis.high - axis.low) / axis.cells * cell


@dataclasses.dataclass(frozen=True)
class Area:
    """Area of the part of a grid from which a controller succeeds.

    Attributes:
      value: area, in the product of the axes' units.
      half_width: half width of its 95 % interval, in the same unit.
      share: area relative to the whole grid [1].
    """

    value: float
    half_width: float
    share: float


def area(chart: StartGrid, success: Bool[ArrayLike, " starts"]) -> Area:
    """Estimates the basin's area and its uncertainty.

    One random initial state in each cell is a stratified sample. Its mean is unbiased, and its variance is that within
    the cells alone: estimated from the differences of neighbours, which on average can only overestimate it (Wolter,
    Introduction to Variance Estimation, 2007, ch. 8). If all succeed or none does, there are no differences: then the
    width of Wilson's interval bounds the part that may have been missed.

    Args:
      chart: the grid.
      success: whether the run from each of the grid's initial states succeeded, the lowest row first.
    """
    caught = np.asarray(success, float).reshape(chart.shape)
    differences = [np.mean(np.diff(caught, axis=axis) ** 2) for axis in (0, 1)]
    deviation = math.sqrt(0.5 * float(np.mean(differences)) / caught.size)
    whole = (chart.across.high - chart.across.low) * (chart.up.high - chart.up.low)
    share = float(np.mean(caught))
    half_width = _SIGMAS * deviation
    if share in (0.0, 1.0):
        low, high = wilson_interval(int(np.sum(caught)), caught.size)
        half_width = high - low
    return Area(share * whole, half_width * whole, share)


def document(chart: StartGrid, metrics: Metrics) -> dict[str, Any]:
    """Returns a summary of a basin as plain values, for JSON; `metrics` are arrays (rows * columns,)."""
    good = np.asarray(metrics.success)
    times, switches = np.asarray(metrics.settling_time)[good], np.asarray(metrics.switches)[good]
    found = area(chart, good)
    return {
        "area": found.value,
        "area_half_width": found.half_width,
        "area_unit": f"{chart.across.unit} {chart.up.unit}",
        "share": found.share,
        "settling_time_mean": float(np.mean(times)) if times.size else None,
        "settling_time_max": float(np.max(times)) if times.size else None,
        "switches_mean": float(np.mean(switches)) if times.size else None,
        "switches_max": int(np.max(switches)) if times.size else None,
    }


Map = StartGrid
"""The name until version 0.1."""
