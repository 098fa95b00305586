"""Seeded random initial states of the evaluation protocol.

Random numbers come from NumPy's PCG64, not from JAX, so that a seed gives the same initial states in float32 and
float64, on every backend and with every JAX release.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from cpjax.errors import InputError
from cpjax.plant.state import HANGING, NAMES, State

# Centre and half-width of the uniform distribution of each component.
_SETS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "hanging": {"x": (0.0, 0.1), "x_dot": (0.0, 0.0), "theta": (math.pi, 0.3), "theta_dot": (0.0, 0.3)},
    "anywhere": {"x": (0.0, 0.3), "x_dot": (0.0, 0.5), "theta": (0.0, math.pi), "theta_dot": (0.0, 4.0)},
    "wide": {"x": (0.0, 0.15), "x_dot": (0.0, 0.0), "theta": (math.pi, 0.4), "theta_dot": (0.0, 0.4)},
    "rest": {name: (getattr(HANGING, name), 0.0) for name in NAMES},
}

_MOST = 10**8  # 3 GB of float64

START_SETS = tuple(_SETS)
"""Names that `sample_starts` accepts."""


def sample_starts(name: str, count: int, *, seed: int, dtype: Any = np.float64) -> State:
    """Draws initial states from a named set.

    hanging: |x| <= 0.1 m, x_dot = 0, theta = pi +- 0.3 rad, |theta_dot| <= 0.3 rad/s.
    wide: |x| <= 0.15 m, x_dot = 0, theta = pi +- 0.4 rad, |theta_dot| <= 0.4 rad/s: just outside what tuning sees.
    anywhere: |x| <= 0.3 m, |x_dot| <= 0.5 m/s, theta anywhere on the circle, |theta_dot| <= 4 rad/s.
    rest: exactly hanging at rest, `count` times.

    A larger count with the same seed begins with the same initial states.

    Args:
      name: one of `START_SETS`.
      count: number of initial states.
      seed: of the random numbers.
      dtype: float32 or float64; the numbers are drawn in float64 and then cast.

    Returns:
      A State of NumPy arrays of shape (count,).

    Raises:
      InputError: an unknown set, a count outside 1 to 10^8, a negative seed, or another dtype.
    """
    check_starts(name, count, seed)
    if not any(dtype is kind or dtype == np.dtype(kind) for kind in (np.float32, np.float64)):
        raise InputError("dtype", dtype, "float32 or float64")
    unit = np.random.default_rng(seed).uniform(-1.0, 1.0, size=(count, len(NAMES)))
    columns = (centre + half * unit[:, i] for i, (centre, half) in enumerate(_SETS[name][n] for n in NAMES))
    return State(*(column.astype(dtype) for column in columns))


def check_starts(name: Any, count: Any, seed: Any) -> None:
    """Checks arguments of `sample_starts` without drawing.

    Raises:
      InputError: as `sample_starts` does.
    """
    if not isinstance(name, str) or name not in _SETS:
        raise InputError("starts", name, "one of " + ", ".join(_SETS))
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= _MOST:
        raise InputError("count", count, f"a whole number, at least 1 and at most {_MOST}")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise InputError("seed", seed, "a whole number, at least 0")
