"""Compiles `roofline.c` with the system's compiler, in each of its forms, and calls the one that is fastest here."""

import ctypes
import hashlib
import itertools
import json
import math
import os
import shutil
import subprocess
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cpjax.backend.runtime import instruction_set
from cpjax.controllers import AngleRateGate, EnergySwingUp, Hybrid, StateFeedback
from cpjax.plant import CartPole
from cpjax.plant.state import State
from cpjax.sim.metrics import Metrics, ProtocolMetrics

SOURCE = Path(__file__).with_name("roofline.c")
FLAGS = ["-O3", "-march=native", "-ffp-contract=fast", "-fopenmp", "-shared", "-fPIC", "-Wno-psabi"]
TRIALS = 5
TRIAL_STEPS = 4_000_000
"""Steps of a trial, all starts together."""
BUILT = Path(__file__).parents[2] / "build" / "roofline"


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
        """Returns the compiler's flags."""
        return ["-DFUSED"] * self.fused + [f"-DBYTES={self.bytes}", f"-DVECTORS={self.vectors}"]

    @property
    def words(self) -> str:
        """Returns the form in words, for a table."""
        return f"{'one pass' if self.fused else 'two passes'}, {self.bytes}-byte vectors, {self.vectors} a block"


def compiler() -> str | None:
    """Returns the C compiler: $CC, or the system's; None if there is none."""
    return shutil.which(os.environ.get("CC", "cc"))


def build(dtype: str, plant: CartPole, controller: Hybrid, starts: State, threads: int) -> tuple[ctypes.CDLL, Form]:
    """Returns the fastest of all forms for "float32" or "float64" on this machine, and which it is.

    All are compiled and timed with these starts once; libraries and choice are kept in build/.
    """
    cc = compiler()
    if cc is None:
        raise FileNotFoundError("no C compiler")
    count = int(np.shape(starts.x)[0])
    forms = [
        Form(*form) for form in itertools.product((False, True), (16, 32, 64), (1,) if count == 1 else (2, 8, 16, 32))
    ]
    release = subprocess.run([cc, "--version"], capture_output=True, text=True, check=True).stdout
    key = (instruction_set(), release, *FLAGS, dtype, str(count), str(threads), repr(forms), str(TRIAL_STEPS))
    folder = BUILT / hashlib.sha256("\n".join((SOURCE.read_text(), *key)).encode()).hexdigest()[:16]
    if not folder.exists():
        BUILT.mkdir(parents=True, exist_ok=True)
        begun = Path(tempfile.mkdtemp(dir=BUILT))
        kind = ["-DSINGLE"] * (dtype == "float32")

        def made(form: Form) -> ctypes.CDLL:
            library = _library(begun, form)
            subprocess.run([cc, *FLAGS, *kind, *form.flags, str(SOURCE), "-o", str(library)], check=True)
            return ctypes.CDLL(str(library))

        with ThreadPoolExecutor() as pool:
            libraries = dict(zip(forms, pool.map(made, forms), strict=True))
        seconds = dict.fromkeys(forms, math.inf)
        for form in forms * TRIALS:
            begin = time.perf_counter()
            run(libraries[form], plant, controller, starts, TRIAL_STEPS // count, 2e-3, threads)
            seconds[form] = min(seconds[form], time.perf_counter() - begin)
        (begun / "chosen.json").write_text(json.dumps(min(forms, key=lambda form: seconds[form])))
        try:
            begun.rename(folder)
        except OSError:  # another process was first
            shutil.rmtree(begun)
    form = Form(*json.loads((folder / "chosen.json").read_text()))
    return ctypes.CDLL(str(_library(folder, form))), form


def _library(folder: Path, form: Form) -> Path:
    return (folder / f"{'fused' if form.fused else 'passes'}-{form.bytes}-{form.vectors}.so").resolve()


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
