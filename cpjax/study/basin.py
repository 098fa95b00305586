"""Where a controller works: one closed-loop run from every cell of a map over two coordinates of the start.

What a map shows is sampled, not certified: a start between two that succeed may fail.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from cpjax.errors import InputError
from cpjax.numeric.statistics import wilson_interval
from cpjax.plant.state import NAMES, UNITS, State
from cpjax.pytree import Number
from cpjax.sim.metrics import Metrics

MOST_CELLS = 4096
"""Along one axis."""
_SIGMAS = 1.959963984540054  # of a normal distribution, that hold 95 %
_FINITE = Number("SI unit", "")


def _finite(name: str, value: Any) -> float:
    if np.ndim(value):
        raise InputError(name, value, "one finite number")
    return float(_FINITE.normalise(name, value))


@dataclasses.dataclass(frozen=True)
class Axis:
    """One coordinate of the start, in `cells` equal cells from `low` to `high`."""

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
        """Of the coordinate."""
        return UNITS[NAMES.index(self.name)]

    def edges(self) -> np.ndarray[Any, Any]:
        """Of the cells (cells + 1,)."""
        return np.linspace(self.low, self.high, self.cells + 1)


@dataclasses.dataclass(frozen=True)
class StartGrid:
    """Which starts a basin is sampled from: one in each cell, anywhere in it.

    Attributes:
      across: the horizontal axis.
      up: the vertical one.
      others: (low, high) of the other two coordinates, between which each start's are drawn; (0, 0) where nothing is
        given.
      seed: of where in its cell a start lies.
    """

    across: Axis
    up: Axis
    others: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    seed: int = 1

    def __post_init__(self) -> None:
        if self.across.name == self.up.name:
            raise InputError("Map.up", self.up.name, f"another coordinate than across, {self.across.name}")
        free = [name for name in NAMES if name not in (self.across.name, self.up.name)]
        for name, ends in self.others.items():
            if name not in free:
                raise InputError("Map.others", name, "one of " + ", ".join(free))
            if not isinstance(ends, (tuple, list)) or len(ends) != 2:
                raise InputError(f"Map.others[{name}]", ends, "two finite numbers, the lower one first")
            low, high = (_finite(f"Map.others[{name}]", end) for end in ends)
            if low > high:
                raise InputError(f"Map.others[{name}]", ends, "two finite numbers, the lower one first")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise InputError("Map.seed", self.seed, "a whole number, at least 0")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (up) and columns (across)."""
        return self.up.cells, self.across.cells

    @property
    def middle(self) -> dict[str, float]:
        """Of the coordinates that are no axes."""
        return {
            n: 0.5 * sum(self.others.get(n, (0.0, 0.0))) for n in NAMES if n not in (self.across.name, self.up.name)
        }

    def starts(self) -> State:
        """One start of each cell, as arrays (rows * columns,), the lowest row first."""
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
    def _within(axis: Axis, cell: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return axis.low + (axis.high - axis.low) / axis.cells * cell


@dataclasses.dataclass(frozen=True)
class Area:
    """Of the part of a map that a controller brings to rest.

    Attributes:
      value: in the product of the axes' units.
      half_width: of its 95 % interval.
      share: of the map.
    """

    value: float
    half_width: float
    share: float


def area(chart: StartGrid, success: np.ndarray[Any, Any]) -> Area:
    """The basin's area, from the successes of the chart's starts (rows * columns,).

    One random start in each cell is a stratified sample. Its mean is unbiased, and its variance is that within the
    cells alone: estimated from the differences of neighbours, which can only make it too large on average (Wolter,
    Introduction to Variance Estimation, 2007, ch. 8). Where all succeed or none does, there are no differences: then
    the other end of Wilson's interval says how large a part may have been missed.
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
    """A basin in a few numbers, for JSON."""
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
