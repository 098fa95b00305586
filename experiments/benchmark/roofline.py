"""Compiles `roofline.c` with the system's compiler and calls it."""

import ctypes
import math
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from cpjax.controllers import AngleRateGate, EnergySwingUp, Hybrid, StateFeedback
from cpjax.plant import CartPole
from cpjax.plant.state import State
from cpjax.sim.metrics import Metrics, ProtocolMetrics

SOURCE = Path(__file__).with_name("roofline.c")
FLAGS = ["-O3", "-march=native", "-ffp-contract=fast", "-fopenmp", "-shared", "-fPIC"]


def compiler() -> str | None:
    """The C compiler: $CC, or the system's; None if there is none."""
    return shutil.which(os.environ.get("CC", "cc"))


def build(folder: Path, dtype: str, one: bool = False) -> ctypes.CDLL:
    """The compiled library for "float32" or "float64", made in `folder`; `one`: for a single start."""
    cc = compiler()
    if cc is None:
        raise FileNotFoundError("no C compiler")
    folder.mkdir(parents=True, exist_ok=True)
    library = folder / f"roofline-{dtype}{'-one' * one}.so"
    kind = ["-DSINGLE"] * (dtype == "float32") + ["-DONE"] * one
    subprocess.run([cc, *FLAGS, *kind, str(SOURCE), "-o", str(library)], check=True)
    return ctypes.CDLL(str(library.resolve()))


def run(
    library: ctypes.CDLL, plant: CartPole, controller: Hybrid, starts: State, steps: int, dt: float, threads: int
) -> Metrics:
    """The protocol's metrics of every start, on the sampled clock; see `cpjax.sweep`.

    Args:
      starts: of arrays (n,) in the library's dtype.
    """
    columns = np.ascontiguousarray(
        np.stack([np.asarray(getattr(starts, name)) for name in starts.__dataclass_fields__])
    )
    dtype, count = columns.dtype, columns.shape[1]
    results = np.empty((9, count), dtype)
    parameters = np.asarray(_parameters(plant, controller, dt), dtype)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (parameters, columns, results)]
    library.roofline(pointers[0], ctypes.c_long(count), ctypes.c_long(steps), *pointers[1:], ctypes.c_int(threads))
    rows: list[Any] = list(results)
    rows[0] = rows[0] != 0
    rows[7:] = [row.astype(np.int32) for row in rows[7:]]
    return Metrics(*rows)


def _parameters(plant: CartPole, controller: Hybrid, dt: float) -> list[float]:
    """In the order of the struct in `roofline.c`."""
    law, regulator, gate = controller.swing_up, controller.regulator, controller.gate
    # What the C code leaves out: a model other than the plant, a reference other than upright, hysteresis.
    assert isinstance(law, EnergySwingUp)
    assert isinstance(regulator, StateFeedback)
    assert isinstance(gate, AngleRateGate)
    assert gate.hysteresis == 0.0
    protocol, motor = ProtocolMetrics(), plant.motor
    ml = plant.pole_mass * plant.pole_length
    values = [
        dt,
        plant.moving_mass,
        plant.pole_mass,
        ml,
        ml * plant.gravity,
        plant.pivot_inertia,
        plant.pole_inertia,
        plant.pole_length,
        plant.cart_friction,
        plant.pivot_friction,
        motor.force_per_voltage,
        motor.damping,
        motor.voltage_limit,
        law.energy_gain,
        law.cart_stiffness,
        law.cart_damping,
        law.kick,
        2.0 * math.sin(0.5 * float(law.kick_radius)) ** 2,
        *np.asarray(regulator.K)[0],
        2.0 * math.sin(0.5 * float(gate.half_angle)) ** 2,
        gate.rate,
        protocol.angle_band,
        protocol.position_band,
        protocol.hold,
    ]
    return [float(value) for value in values]
