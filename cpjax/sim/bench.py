"""A controller on a rig: it sees what the sensors measure, and its commands take effect after the drive's delay."""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int32

from cpjax.checks import call, pair
from cpjax.controllers.protocol import as_sampled
from cpjax.errors import InputError
from cpjax.numeric.noise import standard_normals
from cpjax.numeric.selection import where
from cpjax.plant.state import State
from cpjax.pytree import Scalar, is_traced
from cpjax.rig import Position, Rig
from cpjax.rig.sensors import Sensors
from cpjax.sim.settings import Settings
from cpjax.sim.switching import pick

_SENSORS, _DRIVE = np.uint32(1), np.uint32(4)
"""Second words of the noise's keys; each source of noise has its own (`cpjax.rig.disturbance` has 2 and 3)."""


class BenchMemory(NamedTuple):
    """Memory of a `Bench`."""

    inner: Any
    """The controller's."""
    step: Int32[Array, ""]
    """Number of updates so far."""
    line: tuple[Scalar, ...]
    """Commands that do not act yet [V], the newest first."""
    held: Scalar | None
    """The controller's last command [V], where it runs less often than the bench."""


@dataclasses.dataclass(frozen=True)
class Bench:
    """A controller that measures through a rig's sensors and acts through its delay.

    Attributes:
      controller: the firmware, a `Controller`.
      sensors: what it measures by; None for the whole state.
      seed: of the sensors' noise.
      behind: updates until a command acts, int32, at most `delay`; None for `delay` itself.
      delay: most updates until a command acts.
      divider: updates per control period.
      run: number of the run, which selects its noise.
      noisy: whether the sensors have noise.
      drive_noise: standard deviation of the noise on the command [V]; None for none.
    """

    controller: Any
    sensors: Sensors | None
    drive_noise: Any
    behind: Any
    seed: Any
    run: Any
    delay: int
    divider: int
    noisy: bool

    def init(self, state: State) -> BenchMemory:
        step = jnp.asarray(0, dtype=jnp.int32)
        with _needs_rates(self.sensors):
            inner = call("controller", as_sampled(self.controller), "init", self._measured(state, step))
        # Zero, of one initial state each: of a constant, `vmap` learns only element by element that the line differs
        # between initial states, and it traces the whole loop again for each.
        x = jnp.asarray(state.x)
        nothing = lax.select(x == x, jnp.zeros_like(x), jnp.zeros_like(x))
        return BenchMemory(inner, step, (nothing,) * self.delay, nothing if self.divider > 1 else None)

    def update(self, memory: BenchMemory, state: State) -> tuple[BenchMemory, Scalar]:
        measured = self._measured(state, memory.step)
        with _needs_rates(self.sensors):
            returned = call("controller", as_sampled(self.controller), "update", memory.inner, measured)
        inner, command = pair("controller.update", returned, "the new memory and the command")
        if memory.held is not None:
            due = memory.step % self.divider == 0
            inner, command = jax.tree.map(
                lambda new, old: where(due, new, old), (inner, command), (memory.inner, memory.held)
            )
        held = None if memory.held is None else command
        if self.drive_noise is not None:
            key = (jnp.asarray(self.seed, dtype=jnp.uint32), jnp.asarray(_DRIVE))
            period = (memory.step // self.divider).astype(jnp.uint32)
            normal, _ = standard_normals(key, (jnp.asarray(self.run), period), jnp.asarray(state.x).dtype)
            command = command + self.drive_noise * normal
        line = (command, *memory.line)
        acting = line[-1] if self.behind is None else pick(line, self.behind)
        return BenchMemory(inner, memory.step + 1, line[:-1], held), acting

    def _measured(self, state: State, step: Int32[Array, ""]) -> Any:
        if self.sensors is None:
            return state
        key = (jnp.asarray(self.seed, dtype=jnp.uint32), jnp.asarray(_SENSORS))
        return self.sensors.measure(state, key, (jnp.asarray(self.run), step.astype(jnp.uint32)), noisy=self.noisy)


@contextlib.contextmanager
def _needs_rates(sensors: Sensors | None) -> Iterator[None]:
    """Raises an `InputError` where a controller asks for a rate that the sensors do not measure."""
    try:
        yield
    except AttributeError as problem:
        if sensors is None or not isinstance(problem.obj, Position):
            raise
        allowed = "one that estimates rates, as cpjax.Digital(controller, estimator): encoders measure x and theta"
        raise InputError("controller", f"one that reads {problem.name}", allowed) from problem


jax.tree_util.register_dataclass(
    Bench,
    data_fields=["controller", "sensors", "drive_noise", "behind", "seed", "run"],
    meta_fields=["delay", "divider", "noisy"],
)


def on_bench(rig: Rig, controller: Any, settings: Settings, dt: float, seed: int, runs: Any) -> tuple[Any, Settings]:
    """Returns the controller as the loop runs it on a rig, and the settings of that loop.

    Args:
      rig: the rig.
      controller: the firmware.
      settings: of the rollout as asked for.
      dt: the integrator's step [s].
      seed: of the sensors' noise.
      runs: number of each run, uint32.

    Raises:
      InputError: the continuous clock with sensors or a delay, or a delay that is no whole number of steps.
    """
    delays = _steps_of_delay(rig, dt)
    steps = int(np.max(delays))
    noise = None if rig.drive is None else rig.drive.noise
    noise = noise if noise is not None and (is_traced(noise) or bool(np.any(np.asarray(noise)))) else None
    if settings.clock == "continuous":
        if rig.sensors is not None or steps or noise is not None:
            name = "sensors" if rig.sensors is not None else "drive.delay" if steps else "drive.noise"
            raise InputError("clock", settings.clock, f"sampled: the rig's {name} act at control instants")
        shaped = rig.drive is not None and (
            rig.drive.voltage_step is not None
            or is_traced(rig.drive.dead_band)
            or np.any(np.asarray(rig.drive.dead_band))
        )
        if shaped and settings.switching == "located":
            allowed = "per_step, or the sampled clock: a dead band and steps of the voltage are not located"
            raise InputError("switching", settings.switching, allowed)
        return controller, settings
    if rig.sensors is None and not steps and noise is None:
        return controller, settings
    every, noisy = settings.steps_per_control, rig.sensors is not None and rig.sensors.noisy
    # A delay that ends between two control instants: the bench runs at every step.
    divider = 1 if np.all(delays % every == 0) else every
    per_update = every if divider == 1 else 1
    behind = (delays // per_update).astype(np.int32) if np.ndim(delays) else None
    parts = (controller, rig.sensors, noise, behind, np.uint32(seed), runs)
    bench = Bench(*parts, steps // per_update, divider, noisy)
    return bench, settings if divider == 1 else settings._replace(steps_per_control=1)


def _steps_of_delay(rig: Rig, dt: float) -> Any:
    """Returns the drive's delay in steps: a whole number, or one for each run.

    Raises:
      InputError: a delay that is traced, or no whole number of steps.
    """
    delay = 0.0 if rig.drive is None else rig.drive.delay
    if is_traced(delay):
        raise InputError("Drive.delay", delay, "known when the rollout is compiled")
    shares = np.asarray(delay, dtype=np.float64) / dt
    steps = np.rint(shares).astype(np.int64)
    if np.any(np.abs(shares - steps) > 1e-6 * np.maximum(1, steps)):
        raise InputError("Drive.delay", delay, f"a whole number of steps of dt = {dt:g} s")
    return steps
