"""Checks of a linear regulator on a plant with a voltage limit: poles, margins, saturation, a certified region."""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from cpjax import files
from cpjax.controllers import AngleGate, AngleRateGate, LyapunovGate, StateFeedback
from cpjax.controllers.gates import Gate
from cpjax.errors import InputError
from cpjax.linear.limits import (
    demanded_voltage,
    level_within_angle,
    level_within_angle_and_rate,
    level_within_form,
    level_within_voltage,
    lyapunov_function,
    saturation_angle,
)
from cpjax.linear.margins import Margins, closed_loop_poles, stability_margins
from cpjax.linear.structure import POSITION_AND_ANGLE, Structure, controllability, observability
from cpjax.plant import CartPole, linearize
from cpjax.plant.state import NAMES


@dataclasses.dataclass(frozen=True)
class DesignCheck:
    """Result of `check_design`. `P`, `level`, `limited_by` and `extent` are None if the linear loop is not stable.

    Attributes:
      K: the gain.
      poles: of the linear closed loop [1/s].
      margins: of the loop broken at the voltage.
      controllability: of the linear model from the voltage.
      observability: of the linear model from x and theta.
      gate_angle: angle at which the gate opens, at rest with the cart at its reference [rad].
      gate_voltage: magnitude of the voltage demanded there [V].
      saturation_angle: angle beyond which, in the same state, the demand exceeds the voltage limit [rad].
      P: matrix of the linear closed loop's Lyapunov function s' P s, whose derivative is -s' s.
      level: the largest s' P s whose level set lies inside the voltage limit and the gate.
      limited_by: which of the two bounds the level, "voltage" or "gate".
      extent: largest value of each coordinate in that level set, in the order of the state [SI].
    """

    K: Float[np.ndarray, "1 4"]
    poles: Complex[np.ndarray, "4"]
    margins: Margins
    controllability: Structure
    observability: Structure
    gate_angle: float
    gate_voltage: float
    saturation_angle: float
    P: Float[np.ndarray, "4 4"] | None
    level: float | None
    limited_by: str | None
    extent: tuple[float, ...] | None


def check_design(plant: CartPole, regulator: StateFeedback, gate: Gate) -> DesignCheck:
    """Checks a regulator behind a gate, on the plant's linear model about upright.

    Args:
      plant: the plant.
      regulator: the linear law, of any cart reference.
      gate: an `AngleGate`, `AngleRateGate` or `LyapunovGate`.

    Raises:
      InputError: a regulator that is no StateFeedback, a gate that is not one of the library's, one of the two about
        another state than upright at rest, or a LyapunovGate about another x or whose P is not positive definite.
    """
    if not isinstance(regulator, StateFeedback):
        raise InputError("regulator", regulator, "a cpjax.StateFeedback")
    if not isinstance(gate, (AngleGate, AngleRateGate, LyapunovGate)):
        raise InputError("gate", gate, "an AngleGate, AngleRateGate or LyapunovGate")
    for name, part in (("regulator", regulator), ("gate", gate)):
        reference = getattr(part, "reference", None)
        if reference is not None and any(float(getattr(reference, n)) for n in NAMES if n != "x"):
            raise InputError(f"{name}.reference", reference, "upright at rest, wherever the cart is")
    if isinstance(gate, LyapunovGate) and float(gate.reference.x) != float(regulator.reference.x):
        raise InputError("gate.reference.x", gate.reference.x, f"the regulator's, {regulator.reference.x} m")
    if isinstance(gate, LyapunovGate) and not np.min(np.linalg.eigvalsh(np.asarray(gate.P))) > 0.0:
        raise InputError("gate.P", gate.P, "positive definite")
    A, B = linearize(plant)
    K = jnp.asarray(regulator.K, dtype=A.dtype)
    limit = plant.motor.voltage_limit
    found = stability_margins(A, B, K)
    angle = _opening_angle(gate)
    P = level = limited_by = extent = None
    if bool(found.stable):
        P = lyapunov_function(A, B, K, jnp.eye(4, dtype=A.dtype))
        inside_clip, inside_gate = float(level_within_voltage(P, K, limit)), float(_level_within(gate, P))
        level = min(inside_clip, inside_gate)
        limited_by = "voltage" if inside_clip < inside_gate else "gate"
        extent = tuple(float(e) for e in np.sqrt(level * np.diag(np.linalg.inv(np.asarray(P)))))
    return DesignCheck(
        K=np.asarray(K),
        poles=np.asarray(closed_loop_poles(A, B, K)),
        margins=found,
        controllability=controllability(A, B),
        observability=observability(A, jnp.asarray(POSITION_AND_ANGLE, dtype=A.dtype)),
        gate_angle=angle,
        gate_voltage=float(demanded_voltage(K, angle)),
        saturation_angle=float(saturation_angle(K, limit)),
        P=None if P is None else np.asarray(P),
        level=level,
        limited_by=limited_by,
        extent=extent,
    )


def document(check: DesignCheck, **setting: Any) -> dict[str, Any]:
    """Returns the check as plain values, for JSON, beside the entries of `setting`."""
    return {
        "what": "a linear regulator on the plant's linear model about upright, behind a gate and a voltage limit",
        "versions": files.versions(),
        **setting,
        "K": check.K,
        "poles": [[p.real, p.imag] for p in check.poles],
        "margins": check.margins._asdict(),
        "controllability": {"rank": check.controllability.rank, "condition": check.controllability.condition},
        "observability": {"rank": check.observability.rank, "condition": check.observability.condition},
        **{
            name: getattr(check, name)
            for name in ("gate_angle", "gate_voltage", "saturation_angle", "P", "level", "limited_by", "extent")
        },
    }


def _opening_angle(gate: Gate) -> float:
    if isinstance(gate, LyapunovGate):
        return math.sqrt(float(gate.level) / float(np.asarray(gate.P)[2, 2]))
    assert isinstance(gate, (AngleGate, AngleRateGate))
    return float(gate.half_angle)


def _level_within(gate: Gate, P: Float[Array, "4 4"]) -> Float[Array, ""]:
    if isinstance(gate, LyapunovGate):
        return level_within_form(P, jnp.asarray(gate.P, dtype=P.dtype), gate.level)
    if isinstance(gate, AngleRateGate):
        return level_within_angle_and_rate(P, gate.half_angle, gate.rate)
    assert isinstance(gate, AngleGate)
    return level_within_angle(P, gate.half_angle)
