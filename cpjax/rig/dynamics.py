"""A cart-pole as it moves on the bench: with its drive, its track and what disturbs it, for the loop.

Within a step of the integrator forces of pushes and wind are constant, and a voltage that is still changing, because
the drive lags or because of the motor's inductance, is a straight line in time with the mean and the first moment of
the exact exponential. So a time constant far below the step needs no shorter step. For that, time since the beginning
of the step is a third coordinate, whose velocity is 1.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cpjax.plant import CartPole, State
from cpjax.pytree import Scalar, part, pytree
from cpjax.rig.disturbance import Disturbance, Forces, added_loads
from cpjax.rig.drive import Drive, line_of_decay
from cpjax.rig.track import Track

Coordinates = tuple[Scalar, ...]
"""Cart and pole and, where the voltage changes within a step, time since its beginning."""


class DriveMemory(NamedTuple):
    """Memory of the drive between steps."""

    voltage: Float[Array, ""]
    """Terminal voltage [V]; it follows the command with the drive's lag."""
    current: Float[Array, ""]
    """Current times resistance [V]; it follows with the motor's electrical time constant."""


class Line(NamedTuple):
    """Voltage over a step: `value` + `slope` t [V, V/s]."""

    value: Float[Array, ""]
    slope: Float[Array, ""]


@pytree
class OnTheBench:
    """A cart-pole with its drive, track and disturbance, for the loop."""

    plant: CartPole = part("a cpjax.CartPole", "loads", "saturate", "solved")
    drive: Drive = part("a cpjax.Drive", "apply")
    track: Track | None = None
    disturbance: Disturbance | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "plant"), name)

    @property
    def limits(self) -> State:
        """Largest allowed magnitude of each component of the state."""
        limits = self.plant.limits
        return limits if self.track is None else dataclasses.replace(limits, x=self.track.half_length)

    def coordinates(self, state: State) -> tuple[Coordinates, Coordinates]:
        return self.plant.coordinates(state)

    def state(self, q: Coordinates, v: Coordinates) -> State:
        return self.plant.state((q[0], q[1]), (v[0], v[1]))

    def geometry(self, q: Coordinates) -> Coordinates:
        return self.plant.geometry((q[0], q[1]))

    def geometry_near(self, geometry: Coordinates, change: Coordinates) -> tuple[Coordinates, Bool[Array, ""]]:
        return self.plant.geometry_near((geometry[0], geometry[1]), (change[0], change[1]))

    def saturate(self, command: Scalar) -> Scalar:
        return self.drive.apply(self.plant.saturate(command))

    def accelerations(self, geometry: Coordinates, v: Coordinates, u: Scalar) -> Coordinates:
        """Returns x'' and theta'' [m/s^2, rad/s^2] under an applied voltage [V]."""
        return self.plant.solved(geometry[0], geometry[1], *self.loads(geometry, v, u))

    def loads(self, geometry: Coordinates, v: Coordinates, u: Scalar) -> Coordinates:
        """Returns the right-hand sides of the equations of motion under an applied voltage [V], as `CartPole.loads`."""
        return self._under(u, geometry, v, None)

    def _under(self, voltage: Scalar, geometry: Coordinates, v: Coordinates, forces: Forces | None) -> Coordinates:
        """Returns the loads under a voltage that the supply does not hold, and forces [N, N m]."""
        angle, rates = (geometry[0], geometry[1]), (v[0], v[1])
        if self.drive.source_resistance is not None:
            voltage = self._sagged(voltage, rates[0])
        push, torque = self.plant.loads(angle, rates, voltage)
        if self.disturbance is None:
            return push, torque
        zero = jnp.zeros_like(jnp.asarray(rates[0]))
        forces = Forces(zero, zero) if forces is None else forces
        more = added_loads(self.plant, self.disturbance.tilt, angle, forces)
        return push + more[0], torque + more[1]

    def outputs(self, state: State, acceleration: Coordinates, u: Scalar) -> dict[str, Scalar]:
        return self.plant.outputs(state, (acceleration[0], acceleration[1]), u)

    def _back_emf(self, x_dot: Scalar) -> Scalar:
        """Returns the voltage that the motor generates at a speed of the cart [V]."""
        motor = self.plant.motor
        return motor.back_emf_constant * motor.gear_ratio / motor.wheel_radius * x_dot

    def _sagged(self, voltage: Scalar, x_dot: Scalar) -> Scalar:
        """Returns the terminal voltage of a bridge that is on for the share `voltage` / supply of the time [V]."""
        supply, resistance = self.plant.motor.voltage_limit, self.drive.source_resistance
        duty = voltage / supply
        load = resistance * duty / self.plant.motor.resistance
        return (voltage + duty * load * self._back_emf(x_dot)) / (1.0 + duty * load)


@pytree
class ChangingBench(OnTheBench):
    """A rig whose forces or voltage differ from step to step: a `cpjax.sim.plants.Stepped` plant."""

    seed: Scalar = 0
    """Seed of what is random, uint32."""
    run: Scalar = 0
    """Number of the run, uint32."""
    forces: Forces | None = None
    """Forces of pushes and wind in the present step."""
    line: Line | None = None
    """Voltage in the present step, if it changes there: terminal voltage or, with inductance, current times resistance.
    """

    @property
    def inductance(self) -> Scalar | None:
        """Inductance of the motor's winding [H]; None for none."""
        return getattr(self.plant.motor, "inductance", None)

    @property
    def voltage_changes(self) -> bool:
        """Whether the voltage changes within a step."""
        return self.drive.lag is not None or self.inductance is not None

    def coordinates(self, state: State) -> tuple[Coordinates, Coordinates]:
        q, v = self.plant.coordinates(state)
        if not self.voltage_changes:
            return q, v
        begin = jnp.zeros_like(jnp.asarray(q[0]))
        return (*q, begin), (*v, begin + 1.0)

    def state(self, q: Coordinates, v: Coordinates) -> State:
        return self.plant.state((q[0], q[1]), (v[0], v[1]))

    def geometry(self, q: Coordinates) -> Coordinates:
        return (*self.plant.geometry((q[0], q[1])), *q[2:])

    def geometry_near(self, geometry: Coordinates, change: Coordinates) -> tuple[Coordinates, Bool[Array, ""]]:
        (sin, cos), accurate = self.plant.geometry_near((geometry[0], geometry[1]), (change[0], change[1]))
        later = tuple(g + c for g, c in zip(geometry[2:], change[2:], strict=True))
        return (sin, cos, *later), accurate

    def accelerations(self, geometry: Coordinates, v: Coordinates, u: Scalar) -> Coordinates:
        """Returns x'' and theta'' [m/s^2, rad/s^2], and 0 for time, if that is a coordinate."""
        return (*super().accelerations(geometry, v, u), *jax.tree.map(jnp.zeros_like, v[2:]))

    def loads(self, geometry: Coordinates, v: Coordinates, u: Scalar) -> Coordinates:
        """Returns the right-hand sides of the equations of motion in the present step, as `CartPole.loads`."""
        voltage = u if self.line is None else self.line.value + self.line.slope * geometry[2]
        if self.inductance is not None:  # the motor's force at this voltage is that of the current
            voltage = voltage + self._back_emf(v[0])
        return self._under(voltage, geometry, v, self.forces)

    def start_drive(self, state: State) -> DriveMemory:
        """Returns the drive's memory before the first step: no voltage, and no torque of a current that rises."""
        nothing = jnp.zeros_like(jnp.asarray(state.x))
        emf = nothing if self.inductance is None else self._back_emf(state.x_dot)
        return DriveMemory(nothing, nothing - emf)

    def during(
        self, memory: DriveMemory, index: Int[Array, ""], dt: Scalar, state: State, u: Scalar
    ) -> tuple["ChangingBench", DriveMemory]:
        """Returns the plant as it is during a step, and the drive's memory after it.

        Args:
          memory: of the drive before the step.
          index: number of the step.
          dt: its length [s].
          state: at its beginning.
          u: voltage that the drive is to apply [V].
        """
        now = self
        if self.disturbance is not None and self.disturbance.changes:
            time = index.astype(jnp.asarray(state.x).dtype) * dt
            key, run = (jnp.asarray(word, dtype=jnp.uint32) for word in (self.seed, self.run))
            now = dataclasses.replace(now, forces=self.disturbance.forces(time, dt, key, run))
        if not self.voltage_changes:
            return now, memory
        value: Any = jnp.asarray(u)
        slope: Any = jnp.zeros_like(value)
        voltage: Any = memory.voltage
        if self.drive.lag is not None:
            ratio = dt / self.drive.lag
            at_begin, along = line_of_decay(ratio)
            gap = voltage - u
            value, slope, voltage = u + gap * at_begin, gap * along, u + gap * jnp.exp(-ratio)
        if self.inductance is None:
            return dataclasses.replace(now, line=Line(value, slope / dt)), DriveMemory(voltage, memory.current)
        emf = self._back_emf(state.x_dot)
        line, _ = self._current(memory.current, value - emf, slope, dt)
        (q, v) = now.plant.coordinates(state)
        mean = line.value + 0.5 * dt * line.slope
        trial = dataclasses.replace(now, line=Line(mean, jnp.zeros_like(mean)))
        geometry = (*now.plant.geometry(q), jnp.zeros_like(mean))
        rise = self._back_emf(dt * trial.accelerations(geometry, (*v, jnp.ones_like(mean)), u)[0])
        line, current = self._current(memory.current, value - emf, slope - rise, dt)
        return dataclasses.replace(now, line=line), DriveMemory(voltage, current)

    def _current(self, before: Scalar, target: Scalar, slope: Scalar, dt: Scalar) -> tuple[Line, Float[Array, ""]]:
        """Returns current times resistance over a step, and at its end, while its target moves along a straight line.

        Args:
          before: current times resistance at the beginning [V].
          target: what it would settle at there, the voltage less the back-EMF [V].
          slope: by how much the target moves in the step [V].
          dt: length of the step [s].
        """
        ratio = dt * self.plant.motor.resistance / self.inductance
        at_begin, along = line_of_decay(ratio)
        gap = before - target
        line = Line(
            target + gap * at_begin - slope * (1.0 - at_begin) / ratio,
            (gap * along + slope * (1.0 + along / ratio)) / dt,
        )
        mean = at_begin + 0.5 * along
        return line, jnp.asarray(target + gap * jnp.exp(-ratio) + slope * (1.0 - mean))
