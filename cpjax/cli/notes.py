"""Notes on inputs with consequences that are easy to miss: one line each, on standard error and in the JSON."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cpjax import files, paper
from cpjax.cli.output import complain
from cpjax.controllers import StateFeedback
from cpjax.plant import CartPole
from cpjax.presets import differences, model_differences
from cpjax.pytree import present
from cpjax.rig import PRESETS as RIGS

_SUPPLY = "voltage_limit"
"""The number of a drive that is no property of the motor itself; linear models do not depend on it."""


def announce(command: str, notes: Sequence[str]) -> None:
    """Prints the notes on standard error."""
    for note in notes:
        complain(f"cpjax {command}: note: {note}")


def notes_on(given: Mapping[str, Any], plant: CartPole, controllers: Mapping[str, Any] | None = None) -> list[str]:
    """Returns all notes on a plant that was built from the options `given`, and on its controllers by name."""
    found = plant_notes(given, plant)
    for name, controller in (controllers or {}).items():
        found += controller_notes(name, controller, plant)
    return found


def plant_notes(given: Mapping[str, Any], plant: CartPole) -> list[str]:
    """Returns a note with the fields that were left at their defaults, if a motor was given in part."""
    declared = present(plant.motor)
    stated = {key for key in declared if key in given}
    base = given.get("rig", given.get("base", "appendix"))
    whose = f"the {base} plant's"
    if base not in paper.PLANTS and base not in RIGS:
        table = files.read_table(Path(base))
        for part in ("rig", "plant") if "type" not in table else ():
            table = table.get(part, table) if "type" not in table else table
        motor = table.get("plant", table).get("motor", {})
        stated |= set(motor) & set(declared)
        whose = "the paper's"
        if not stated:
            stated = {""}  # a plant without a motor: the note lists all of its fields
    left = [key for key in declared if key not in stated]
    of_the_motor = {key for key in left if declared[key].linear}
    if not {key for key in stated if key not in declared or declared[key].linear} or not of_the_motor:
        return []
    values = ", ".join(f"{key} = {float(getattr(plant.motor, key)):g} {declared[key].unit}" for key in left)
    mass, damping = float(plant.motor.reflected_mass), float(plant.motor.damping)
    return [
        f"the motor was given in part; left at {whose} values: {values}. Behind its gear and wheel the rotor weighs "
        f"{mass:.3g} kg at the cart, and the motor damps the cart with {damping:.3g} N s/m"
    ]


def controller_notes(name: str, controller: Any, plant: CartPole) -> list[str]:
    """Returns notes on a controller made for another plant, or with a regulator that does not stabilise this one."""
    found = []
    others = model_differences(controller, plant)
    if others:
        more = f", and {len(others) - 3} more" if len(others) > 3 else ""
        found.append(f"{name} was made for another plant: its model differs in {', '.join(others[:3])}{more}")
    regulator = getattr(controller, "regulator", None) or getattr(controller, "law", None)
    if isinstance(regulator, StateFeedback) and np.shape(regulator.K) == (1, 4):
        printed = [design for design, K in paper.PRINTED_GAINS.items() if np.allclose(regulator.K, [K], rtol=1e-6)]
        if printed and papers_own(plant) is None:
            found.append(
                f"{name} has the gain that the paper prints for its own plant ({printed[0]}), which this is not"
            )
        pole = unstable_pole(plant, regulator)
        if pole is not None:
            found.append(f"{name} has an unstable regulator: upright it has a closed-loop pole at {shown_pole(pole)}")
    return found


def papers_own(plant: CartPole) -> str | None:
    """Returns the name of the paper's plant that this is, with any supply; None if it is another plant."""
    for name, make in paper.PLANTS.items():
        if set(differences(make(), plant)) <= {_SUPPLY}:
            return name
    return None


def unstable_pole(plant: CartPole, regulator: StateFeedback) -> complex | None:
    """Returns the unstable pole of the linear closed loop about upright that grows fastest [1/s]; None if it is stable.

    It is computed without JAX, whose compilations would take a second.
    """
    A, B = np.zeros((4, 4)), np.zeros((4, 1))
    A[0, 1] = A[2, 3] = 1.0

    motor: Any = plant.motor
    body: Any = plant  # called with complex numbers, which its annotations exclude

    def slope(sin: Any = 0.0, x_dot: Any = 0.0, theta_dot: Any = 0.0, voltage: Any = 0.0) -> tuple[float, float]:
        """Returns the derivatives of the accelerations by one argument: by a complex step, without cancellation."""
        force = motor.force(voltage, x_dot)
        x_ddot, theta_ddot = body.acceleration(sin, 1.0, (x_dot, theta_dot), force)
        return float(np.imag(x_ddot)) / _STEP, float(np.imag(theta_ddot)) / _STEP

    step: Any = complex(0.0, _STEP)
    with np.errstate(all="ignore"):
        try:
            A[[1, 3], 1], A[[1, 3], 2] = slope(x_dot=step), slope(sin=step)
            A[[1, 3], 3], B[[1, 3], 0] = slope(theta_dot=step), slope(voltage=step)
            loop = A - B @ np.asarray(regulator.K, dtype=float)
            poles = np.linalg.eigvals(loop)
        except (ValueError, TypeError, ArithmeticError, np.linalg.LinAlgError):  # batches and overflows get no note
            return None
    worst = complex(poles[np.argmax(poles.real)])
    # A pole at zero, of a cart without feedback of x, is computed as rounding noise of the matrix.
    return worst if worst.real > 1e-9 * max(1.0, float(np.max(np.abs(loop)))) and math.isfinite(worst.real) else None


_STEP = 1e-20


def shown_pole(pole: complex) -> str:
    """Returns a pole as text with its unit."""
    return f"{pole.real:.3g}{pole.imag:+.3g}i 1/s" if pole.imag else f"{pole.real:.3g} 1/s"
