"""Compiles `roofline.c` and `gradient.c` with the system's compiler, in each of their forms, and calls the fastest."""

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
from jaxtyping import Float

from cpjax.backend.runtime import instruction_set
from cpjax.controllers import AngleRateGate, EnergySwingUp, Hybrid, StateFeedback
from cpjax.plant import CartPole
from cpjax.plant.state import State
from cpjax.sim.metrics import Metrics, ProtocolMetrics

FOLDER = Path(__file__).parent
VALUES, GRADIENT = FOLDER / "roofline.c", FOLDER / "gradient.c"
FLAGS = ["-O3", "-march=native", "-ffp-contract=fast", "-fopenmp", "-shared", "-fPIC", "-Wno-psabi"]
FLAGS += os.environ.get("CFLAGS", "").split()
TRIALS = 5
TRIAL_STEPS = 4_000_000
"""Steps of a trial, all starts together."""
BUILT = Path(__file__).parents[2] / "build" / "roofline"


NUMBERS = (
    *("energy_gain", "cart_stiffness", "cart_damping", "kick", "K0", "K1", "K2", "K3"),
    *(
        "pivot_inertia",
        "weight",
        "ml",
        "pivot_friction",
        "total",
        "cart_friction",
        "motor_damping",
        "force_per_voltage",
    ),
)
"""Numbers of the law and its model in which `gradient.c` differentiates, in its order."""


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
    """Returns the C compiler: $CC, or the system's; None if there is none. ($CFLAGS are its further flags.)"""
    return shutil.which(os.environ.get("CC", "cc"))


def build(
    dtype: str, plant: CartPole, controller: Hybrid, starts: State, threads: int, source: Path = VALUES
) -> tuple[ctypes.CDLL, Form]:
    """Returns the fastest of all forms for "float32" or "float64" on this machine, and which it is.

    All are compiled and timed with these starts once; libraries and choice are kept in build/.

    Args:
      source: `VALUES` or `GRADIENT`, which has one form less: it does all vectors of a block in one pass.
    """
    cc = compiler()
    if cc is None:
        raise FileNotFoundError("no C compiler")
    count = int(np.shape(starts.x)[0])
    passes, counts = ((False, True), (2, 8, 16, 32)) if source == VALUES else ((True,), (1, 2, 4, 8))
    forms = [Form(*form) for form in itertools.product(passes, (16, 32, 64), (1,) if count == 1 else counts)]
    release = subprocess.run([cc, "--version"], capture_output=True, text=True, check=True).stdout
    key = (instruction_set(), release, *FLAGS, dtype, str(count), str(threads), repr(forms), str(TRIAL_STEPS))
    code = source.read_text() + VALUES.read_text()
    folder = BUILT / hashlib.sha256("\n".join((code, *key)).encode()).hexdigest()[:16]
    if not folder.exists():
        BUILT.mkdir(parents=True, exist_ok=True)
        begun = Path(tempfile.mkdtemp(dir=BUILT))
        kind = ["-DSINGLE"] * (dtype == "float32")

        def made(form: Form) -> ctypes.CDLL:
            library = _library(begun, form)
            subprocess.run([cc, *FLAGS, *kind, *form.flags, str(source), "-o", str(library)], check=True)
            return ctypes.CDLL(str(library))

        def timed(form: Form) -> float:
            begin = time.perf_counter()
            steps = TRIAL_STEPS // count
            if source == VALUES:
                run(libraries[form], plant, controller, starts, steps, 2e-3, threads)
            else:
                run_gradient(libraries[form], plant, controller, starts, min(steps, 5000), 2e-3)
            return time.perf_counter() - begin

        with ThreadPoolExecutor() as pool:
            libraries = dict(zip(forms, pool.map(made, forms), strict=True))
        seconds = dict.fromkeys(forms, math.inf)
        for form in forms * TRIALS:
            seconds[form] = min(seconds[form], timed(form))
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
    columns = _columns(starts)
    dtype, count = columns.dtype, columns.shape[1]
    results = np.empty((9, count), dtype)
    parameters = np.asarray(_parameters(plant, controller, dt), dtype)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (parameters, columns, results)]
    library.roofline(pointers[0], ctypes.c_long(count), ctypes.c_long(steps), *pointers[1:], ctypes.c_int(threads))
    rows: list[Any] = list(results)
    rows[0] = rows[0] != 0
    rows[7:] = [row.astype(np.int32) for row in rows[7:]]
    return Metrics(*rows)


def run_gradient(
    library: ctypes.CDLL, plant: CartPole, controller: Hybrid, starts: State, steps: int, dt: float
) -> tuple[Float[np.ndarray, " starts"], Float[np.ndarray, " starts"], dict[str, Float[np.ndarray, " starts"]]]:
    """Returns how far every cart goes on the sampled clock, the effort, and its derivatives by the number's name.

    Args:
      starts: of arrays (n,) in the library's dtype.
    """
    columns = _columns(starts)
    count = columns.shape[1]
    results = np.empty((2 + len(NUMBERS), count), columns.dtype)
    parameters = np.asarray(_parameters(plant, controller, dt), columns.dtype)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (parameters, columns, results)]
    if library.gradient(pointers[0], ctypes.c_long(count), ctypes.c_long(steps), *pointers[1:]):
        raise MemoryError("gradient.c: no memory for what it keeps of each step")
    return results[0], results[1], dict(zip(NUMBERS, results[2:], strict=True))


def _columns(starts: State) -> Float[np.ndarray, "components starts"]:
    return np.ascontiguousarray(np.stack([np.asarray(getattr(starts, name)) for name in starts.__dataclass_fields__]))


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
