"""Compiles `roofline.c` with the system's compiler, in each of its forms, and calls the one that is fastest here."""

import ctypes
import hashlib
import itertools
import json
import math
import os
import platform
import shutil
import subprocess
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cpjax.controllers import AngleRateGate, EnergySwingUp, Hybrid, StateFeedback
from cpjax.plant import CartPole
from cpjax.plant.state import State
from cpjax.sim.metrics import Metrics, ProtocolMetrics

SOURCE = Path(__file__).with_name("roofline.c")
FLAGS = ["-O3", "-march=native", "-ffp-contract=fast", "-fopenmp", "-shared", "-fPIC", "-Wno-psabi"]
TRIAL_STEPS, TRIALS = 200, 5


class Form(NamedTuple):
    """One way to compile the file."""

    fused: bool
    """Whether each vector is observed and advanced at once; else all vectors of a block in two passes."""
    bytes: int
    """Of a vector."""
    vectors: int
    """In a block."""

    @property
    def flags(self) -> list[str]:
        """The compiler's flags."""
        return ["-DFUSED"] * self.fused + [f"-DBYTES={self.bytes}", f"-DVECTORS={self.vectors}"]

    @property
    def words(self) -> str:
        """What a table says."""
        return f"{'one pass' if self.fused else 'two passes'}, {self.bytes}-byte vectors, {self.vectors} a block"


def compiler() -> str | None:
    """The C compiler: $CC, or the system's; None if there is none."""
    return shutil.which(os.environ.get("CC", "cc"))


def build(dtype: str, plant: CartPole, controller: Hybrid, starts: State, threads: int) -> tuple[ctypes.CDLL, Form]:
    """The fastest of all forms for "float32" or "float64" on this machine, and which it is.

    All are compiled and timed with these starts once; the choice is kept in the system's folder for temporary files.
    """
    cc = compiler()
    if cc is None:
        raise FileNotFoundError("no C compiler")
    one = int(np.shape(starts.x)[0]) == 1
    forms = [Form(*form) for form in itertools.product((False, True), (16, 32, 64), (1,) if one else (2, 8, 32))]
    machine = (platform.processor(), _processor(), cc, *FLAGS, dtype, str(one), str(threads))
    name = hashlib.sha256("\n".join((SOURCE.read_text(), *machine)).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"cpjax-roofline-{name}"
    chosen = folder / "chosen.json"
    if not chosen.exists():
        folder.mkdir(parents=True, exist_ok=True)
        kind = ["-DSINGLE"] * (dtype == "float32")

        def made(form: Form) -> ctypes.CDLL:
            library = _library(folder, form)
            subprocess.run([cc, *FLAGS, *kind, *form.flags, str(SOURCE), "-o", str(library)], check=True)
            return ctypes.CDLL(str(library))

        with ThreadPoolExecutor() as pool:
            libraries = dict(zip(forms, pool.map(made, forms), strict=True))
        seconds = dict.fromkeys(forms, math.inf)
        for form in forms * TRIALS:
            begin = time.perf_counter()
            run(libraries[form], plant, controller, starts, TRIAL_STEPS, 2e-3, threads)
            seconds[form] = min(seconds[form], time.perf_counter() - begin)
        fastest = min(forms, key=lambda form: seconds[form])
        (folder / "chosen.tmp").write_text(json.dumps(fastest))
        (folder / "chosen.tmp").replace(chosen)
    form = Form(*json.loads(chosen.read_text()))
    return ctypes.CDLL(str(_library(folder, form))), form


def _library(folder: Path, form: Form) -> Path:
    return (folder / f"{'fused' if form.fused else 'passes'}-{form.bytes}-{form.vectors}.so").resolve()


def _processor() -> str:
    """The processor's features, as Linux names them; "" elsewhere."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")


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
