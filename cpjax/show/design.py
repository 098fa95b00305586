"""The checks of a linear design as a table and a picture."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cpjax.controllers import SWING_UP
from cpjax.controllers.gates import Gate
from cpjax.linear.structure import Structure
from cpjax.plant.state import NAMES, UNITS, UPRIGHT, State
from cpjax.show.figures import DESIGN_NAMES, GATE_COLOUR
from cpjax.study.design_check import DesignCheck

_INK, _CLIP = "#333333", "#CC79A7"
_SMALLEST, _LARGEST = 1e-9, 1e9
"""Smallest and largest half width of the plane that can be drawn [rad and rad/s]."""

_BEYOND = 1e6
"""Upper clip of ratios to a limit: larger ratios draw the same."""

COMPARISON = (
    "regulator",
    "gains",
    "poles [1/s]",
    "gain may fall to",
    "phase margin [deg]",
    "delay margin [ms]",
    "voltage at the switch [V]",
    "saturates beyond [deg]",
    "certified up to [deg]",
)
"""Columns of `compared`."""


def compared(design: str, gains: str, check: DesignCheck) -> list[str]:
    """Returns one design as a row of the table `COMPARISON`."""
    m = check.margins
    return [
        DESIGN_NAMES[design],
        gains,
        ", ".join(_complex(p) for p in check.poles),
        f"{float(m.gain_lower):.2g}",
        f"{math.degrees(float(m.phase)):.0f}",
        f"{1000 * float(m.delay):.3g}",
        f"{check.gate_voltage:.0f}",
        f"{math.degrees(check.saturation_angle):.2f}",
        "-" if check.extent is None else f"{math.degrees(check.extent[2]):.2f}",
    ]


_MARGINS = {
    "gain may fall to": "times",
    "gain may rise to": "times",
    "phase margin": "deg",
    "delay margin": "ms",
    "disk margin": "of 2",
}


def instability(check: DesignCheck) -> str | None:
    """Says which pole makes the linear loop unstable; returns None if it is stable."""
    if bool(check.margins.stable):
        return None
    if not np.all(np.isfinite(check.poles)):
        return "not stable: a closed loop too fast to be computed; there are no margins and no certified region"
    worst = complex(check.poles[np.argmax(check.poles.real)])
    return f"not stable: a closed-loop pole at {_complex(worst)} 1/s; there are no margins and no certified region"


def rows(check: DesignCheck, voltage_limit: float) -> list[tuple[str, str, str]]:
    """Returns the checks as rows of name, value and unit.

    Args:
      voltage_limit: [V], which the row of the saturation angle names.
    """
    m = check.margins
    if not bool(m.stable):  # the margins of such a loop are NaN
        margins = [(name, "none", "the linear loop is not stable") for name in _MARGINS]
    else:
        values: tuple[Any, ...] = (
            m.gain_lower,
            m.gain_upper,
            math.degrees(float(m.phase)),
            1000 * float(m.delay),
            m.disk,
        )
        margins = [(name, f"{float(v):.3g}", unit) for (name, unit), v in zip(_MARGINS.items(), values, strict=True)]
    numbers = [
        ("gain K", " ".join(f"{k:.6g}" for k in check.K[0]), "V per unit"),
        ("closed-loop poles", "  ".join(_complex(p) for p in check.poles), "1/s"),
        ("controllability", _structure(check.controllability), ""),
        ("observability from x and theta", _structure(check.observability), ""),
        *margins,
        (f"voltage at the gate, {math.degrees(check.gate_angle):.3g} deg", f"{check.gate_voltage:.4g}", "V"),
        (f"asks for more than {voltage_limit:g} V beyond", f"{math.degrees(check.saturation_angle):.3g}", "deg"),
    ]
    if check.extent is not None:
        reach = ", ".join(f"{e:.3g} {u}" for e, u in zip(check.extent, UNITS, strict=True))
        numbers.append((f"certified level set, ended by the {check.limited_by}", reach, "largest " + ", ".join(NAMES)))
    else:
        numbers.append(("certified level set", "none", "the linear loop is not stable"))
    return numbers


def picture(check: DesignCheck, gate: Gate, voltage_limit: float, title: str) -> Figure:
    """Draws the closed-loop poles; and gate, voltage limit and certified level set in the plane of angle and rate.

    Args:
      voltage_limit: [V]; inf for none.
    """
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.axvline(0, color="#999999", linewidth=0.8)
    left.axhline(0, color="#999999", linewidth=0.8)
    left.plot(check.poles.real, check.poles.imag, "x", color=_INK, markersize=9, markeredgewidth=2)
    left.set_xlabel("real part [1/s]")
    left.set_ylabel("imaginary part [rad/s]")
    left.set_title("closed-loop poles", loc="left")
    left.margins(0.15)
    _plane(right, check, gate, voltage_limit)
    figure.suptitle(title)
    return figure


def _plane(axes: Axes, check: DesignCheck, gate: Gate, voltage_limit: float) -> None:
    K, widest = check.K[0], min(max(1.3 * check.gate_angle, _SMALLEST), math.pi)
    limited = math.isfinite(voltage_limit)
    with np.errstate(all="ignore"):  # extreme numbers may overflow; the results are clipped below
        upright = float(np.float64(1.3 * voltage_limit) / abs(K[3])) if K[3] and limited else 0.0
        tallest = min(max(upright, 3.0 * widest), _LARGEST)
        theta, rate = np.meshgrid(np.linspace(-widest, widest, 301), np.linspace(-tallest, tallest, 301))
        zero = np.zeros_like(theta)
        x = zero + float(getattr(gate, "reference", UPRIGHT).x)
        margin = np.asarray(gate.margin(State(x, zero, theta, rate), jnp.full(theta.shape, SWING_UP)))
        margin = np.clip(np.nan_to_num(margin, nan=-1.0), -_LARGEST, _LARGEST)
        demand = _share(np.abs(K[2] * theta + K[3] * rate), voltage_limit)
    degrees = np.degrees(theta)
    if margin.min() < 0.0 < margin.max():
        axes.contour(degrees, rate, margin, levels=[0.0], colors=GATE_COLOUR)
    if limited:
        axes.contourf(degrees, rate, demand, levels=[0.0, 1.0], colors=[_CLIP], alpha=0.25)
        axes.fill_between([], [], color=_CLIP, alpha=0.25, label=f"asks for at most {voltage_limit:g} V")
    if check.P is not None and check.level is not None:
        block = check.P[2:, 2:]
        with np.errstate(all="ignore"):
            form = block[0, 0] * theta**2 + 2 * block[0, 1] * theta * rate + block[1, 1] * rate**2
            form = _share(form, check.level)
        axes.contourf(degrees, rate, form, levels=[0.0, 1.0], colors=[_INK], alpha=0.7)
    axes.plot([], [], color=GATE_COLOUR, label="gate")
    axes.fill_between([], [], color=_INK, alpha=0.7, label="certified level set")
    axes.set_xlabel(r"$\theta$ [deg]")
    axes.set_ylabel(r"$\dot\theta$ [rad/s]")
    axes.set_title("cart at rest in the middle", loc="left")
    axes.legend(loc="upper right", fontsize=8)


def _share(values: np.ndarray[Any, Any], whole: float) -> np.ndarray[Any, Any]:
    """Returns values / whole, for whole > 0, clipped to [0, _BEYOND]; NaN becomes _BEYOND."""
    return np.clip(np.nan_to_num(values / np.float64(whole), nan=_BEYOND), 0.0, _BEYOND)


def _complex(pole: complex) -> str:
    return f"{pole.real:.4g}" if pole.imag == 0 else f"{pole.real:.4g}{pole.imag:+.3g}i"


def _structure(found: Structure) -> str:
    return f"rank {int(found.rank)}, condition {float(found.condition):.3g}"
