"""Dry friction that sticks, of cart and pivot, and stops at the ends of the track: a cart-pole with modes.

Cart and pole each slide in one direction, or are at rest and held. In each mode the equations of motion are smooth:

    sliding   dry friction is -F_c sign(x'), until x' reaches 0
    held      x'' = 0, while the force that holds the cart, the opposite of the other forces, is at most the static
              friction F_s = `static_friction_ratio` F_c
    stopped   the cart stands against a stop, which only pushes

and likewise for the pole with the pivot's friction torque. A step of the integrator stays in one mode (see
`cpjax.sim.plants.Eventful`), so friction is neither smoothed nor creeps: a held cart has x' = 0 exactly.

A stop acts on the cart alone, within no time: x' becomes -`restitution` x', and the pole's row of the equations of
motion gives (J + m l^2) d(theta') = m l cos(theta) d(x'). Likewise where dry friction stops cart or pole late, because
two events fell into one step: so neither adds energy.
"""

import dataclasses
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cpjax.numeric.selection import where
from cpjax.plant.cartpole import Pair
from cpjax.plant.motor import AccelerationActuator
from cpjax.plant.state import State
from cpjax.pytree import Scalar, number, part, pytree

HELD, AT_STOP = 0, 2
"""Modes: -1 and 1 slide in that direction, `HELD` is at rest, -`AT_STOP` and `AT_STOP` is the cart at that stop."""

_SLOWEST_REBOUND = 1e-3
"""Rebounds of the cart below this speed [m/s] end at rest: with restitution, infinitely many follow one another."""

_LOOSE = 3
"""Mode, between `jump` and `release`, of an axis that is no longer held: `release`, which knows the input, finds the
direction."""

_NO_END = 1.0
"""Guard of a mode that ends otherwise."""


_Loads: TypeAlias = tuple[Float[Array, ""], Float[Array, ""]]
"""Force on the cart [N], torque on the pole [N m]."""


class ContactMode(NamedTuple):
    """Mode of a cart-pole in contact, int32 each."""

    cart: Int[Array, ""]
    pole: Int[Array, ""]


@pytree
class InContact:
    """A `CartPole` with dry friction, stops or both, as the loop integrates it: a `cpjax.sim.plants.Eventful` plant."""

    free: Any = part("a cpjax.CartPole, bare or on the bench", "loads", "solved")
    half_length: Scalar | None = number(
        "m", "stops at this distance from the middle; None for no stops", default=None, above=0.0, optional=True
    )
    restitution: Scalar = 0.0
    """Speed of the cart after a stop to that before [1]."""

    @property
    def limits(self) -> State:
        """Largest allowed magnitude of each component of the state."""
        return self.free.limits

    @property
    def start_limits(self) -> State:
        """Largest allowed magnitude of each component of an initial state: the cart starts between the stops."""
        if self.half_length is None:
            return self.limits
        # A stop stays allowed after rounding to float32.
        return dataclasses.replace(self.limits, x=(1.0 + 1e-6) * self.half_length)

    @property
    def input_limit(self) -> Scalar:
        """Voltage at which the drive clips [V]."""
        return self.free.input_limit

    @property
    def units(self) -> dict[str, str]:
        """Units of the state's components by name, for error messages."""
        return self.free.units

    def __getattr__(self, name: str) -> Any:
        # What a plant on the bench has beside, such as a drive with a memory.
        return getattr(object.__getattribute__(self, "free"), name)

    def coordinates(self, state: State) -> tuple[Pair, Pair]:
        return self.free.coordinates(state)

    def state(self, q: Pair, v: Pair) -> State:
        return self.free.state(q, v)

    def saturate(self, command: Scalar) -> Scalar:
        return self.free.saturate(command)

    def geometry(self, q: Pair) -> Pair:
        return self.free.geometry(q)

    def geometry_near(self, geometry: Pair, change: Pair) -> tuple[Pair, Bool[Array, ""]]:
        return self.free.geometry_near(geometry, change)

    def outputs(self, state: State, acceleration: Pair, u: Scalar) -> dict[str, Scalar]:
        return self.free.outputs(state, acceleration, u)

    def accelerations(self, geometry: Pair, v: Pair, u: Scalar, mode: ContactMode) -> Pair:
        """Returns (x'', theta'') [m/s^2, rad/s^2] in the mode; exactly 0 for what is held."""
        push, torque = self._with_friction(self.free.loads(geometry, v, u), mode)
        x_ddot, theta_ddot = self.free.solved(geometry[0], geometry[1], push, torque)
        resting, held = self._resting(mode)
        alone_x, alone_theta = self._one_at_rest(push, torque)
        x_ddot = where(resting, 0.0, where(held, alone_x, x_ddot))
        theta_ddot = where(held, 0.0, where(resting, alone_theta, theta_ddot))
        others: Any = jax.tree.map(jnp.zeros_like, v[2:])  # of time, on the bench
        return (x_ddot, theta_ddot, *others)

    def start_mode(self, q: Pair, v: Pair) -> ContactMode:
        """Returns the mode at the start: what moves slides, what rests is held until the input is known."""
        dry = self.free.coulomb_friction is not None, self.free.pivot_coulomb_friction is not None
        cart, pole = (
            jnp.sign(rate).astype(jnp.int32) if sticks else jnp.ones_like(rate, dtype=jnp.int32)
            for rate, sticks in zip(v[:2], dry, strict=True)
        )
        if self.half_length is not None:
            cart = where((q[0] >= self.half_length) & (v[0] >= 0.0), AT_STOP, cart)
            cart = where((q[0] <= -self.half_length) & (v[0] <= 0.0), -AT_STOP, cart)
        return ContactMode(cart, pole)

    def guards(self, q: Pair, v: Pair, u: Scalar, mode: ContactMode) -> tuple[Scalar, ...]:
        """Returns what ends a mode below zero: of the cart, of the pole, then the distance to the nearer stop.

        Guard 0 is the cart's, the next the pole's if the pivot has dry friction, the last the stops' if there are any.
        Each is smooth near zero, and may have a kink elsewhere: one guard serves two directions.
        """
        geometry = self.geometry(q)
        cart, pole = self._holding(geometry, self.free.loads(geometry, v, u), mode)
        static_x, static_theta = self._static()
        speed = None if self.free.coulomb_friction is None else v[0]
        return (
            _end(mode.cart, speed, cart, static_x),
            *(() if self.free.pivot_coulomb_friction is None else (_end(mode.pole, v[1], pole, static_theta),)),
            *self._stop(q, mode),
        )

    def jump(self, q: Pair, v: Pair, mode: ContactMode, guard: Int[Array, ""]) -> tuple[Pair, Pair, ContactMode]:
        """Returns positions, velocities and mode after a guard has fallen; an axis no longer held is `_LOOSE`."""
        cart, pole = mode
        x, x_dot = q[0], v[0]
        theta_dot = v[1]
        sliding = jnp.abs(cart) == 1
        coupling = self._coupling(self.geometry(q))
        of_cart = guard == 0
        x_dot = where(of_cart & sliding, 0.0, x_dot)
        leaving = where(cart == HELD, _LOOSE, -jnp.sign(cart))  # a stop has one way out
        after = where(of_cart, where(sliding, HELD, leaving), cart)
        number = 1
        if self.free.pivot_coulomb_friction is not None:
            of_pole = guard == 1
            turning = jnp.abs(pole) == 1
            if not self._follows:
                moved = -coupling * theta_dot / (self.free.moving_mass + self.free.pole_mass)
                x_dot = x_dot + where(of_pole & turning & sliding, moved, 0.0)
            theta_dot = where(of_pole & turning, 0.0, theta_dot)
            pole = where(of_pole, where(turning, HELD, _LOOSE), pole)
            number = 2
        hits = guard == number
        if self.half_length is not None:
            side = where(x > 0.0, 1, -1)
            # Another event in the same step may have turned the cart already.
            back = where(side * x_dot > 0.0, -self.restitution * x_dot, x_dot)
            rebounds = jnp.abs(back) >= _SLOWEST_REBOUND
            x = where(hits, side * self.half_length, x)
            x_dot = where(hits, where(rebounds, back, 0.0), x_dot)
            after = where(hits, where(rebounds, -side, AT_STOP * side), after)
        # What stops the cart acts on the pole too. Dry friction stops what is at rest already, to rounding, unless its
        # event took effect late.
        turn = coupling * (x_dot - v[0]) / self.free.pivot_inertia
        theta_dot = theta_dot + where(hits | (of_cart & sliding & (pole != HELD)), turn, 0.0)
        if self.free.pivot_coulomb_friction is not None:
            # The impact may turn a held pole, or one that slides the other way.
            pole = where(hits, jnp.sign(theta_dot).astype(pole.dtype), pole)
        return (x, *q[1:]), (x_dot, theta_dot, *v[2:]), ContactMode(after.astype(cart.dtype), pole.astype(cart.dtype))

    def release(self, q: Pair, v: Pair, u: Scalar, mode: ContactMode) -> ContactMode:
        """Returns the mode that the input imposes at once: what is held slides where the static friction is exceeded,
        and what is loose slides as it is pushed.

        Each is released in turn, with the other's state known: first a loose pole, then the cart, the pole and the cart
        again.
        """
        geometry = self.geometry(q)
        smooth = self.free.loads(geometry, v, u)  # the same in every mode
        static_x, static_theta = self._static()
        if self.free.pivot_coulomb_friction is not None:  # else the pole is never held
            loose = mode.pole == _LOOSE
            _, pole = self._holding(geometry, smooth, mode._replace(pole=where(loose, HELD, mode.pole)))
            mode = mode._replace(pole=where(loose, _direction(pole), mode.pole))
        for axis in ("cart", "pole", "cart"):
            cart, pole = self._holding(geometry, smooth, mode)
            if axis == "pole":
                loose = (mode.pole == HELD) & (jnp.abs(pole) > static_theta)
                mode = mode._replace(pole=where(loose, _direction(pole), mode.pole))
                continue
            loose = (mode.cart == _LOOSE) | (mode.cart == HELD) & (jnp.abs(cart) > static_x)
            loose |= (mode.cart == AT_STOP) & (cart < -static_x) | (mode.cart == -AT_STOP) & (cart > static_x)
            mode = mode._replace(cart=where(loose, _direction(cart), mode.cart))
        return mode

    def during(
        self, memory: Any, index: Int[Array, ""], dt: Scalar, state: State, u: Scalar
    ) -> tuple["InContact", Any]:
        """Returns the plant as it is during a step; see `cpjax.sim.plants.Stepped`."""
        free, memory = self.free.during(memory, index, dt, state, u)
        return dataclasses.replace(self, free=free), memory

    def _static(self) -> tuple[Scalar, Scalar]:
        """Returns the largest holding force [N] and torque [N m]."""
        ratio = self.free.static_friction_ratio
        x, theta = self.free.coulomb_friction, self.free.pivot_coulomb_friction
        return (0.0 if x is None else ratio * x), (0.0 if theta is None else ratio * theta)

    def _resting(self, mode: ContactMode) -> tuple[Array, Array]:
        """Returns whether the cart and whether the pole is at rest."""
        return (mode.cart == HELD) | (jnp.abs(mode.cart) == AT_STOP), mode.pole == HELD

    def _with_friction(self, smooth: Pair, mode: ContactMode) -> _Loads:
        """Returns force [N] and torque [N m] with the friction of what slides."""
        push, torque = (jnp.asarray(load) for load in smooth)
        if self.free.coulomb_friction is not None:
            direction = where(jnp.abs(mode.cart) == 1, mode.cart, 0).astype(push.dtype)
            push = push - direction * self.free.coulomb_friction
        if self.free.pivot_coulomb_friction is not None:
            torque = torque - mode.pole.astype(torque.dtype) * self.free.pivot_coulomb_friction
        return push, torque

    @property
    def _follows(self) -> bool:
        """Whether the cart follows a given acceleration, which then stands in the place of the force on it."""
        return isinstance(self.free.motor, AccelerationActuator)

    def _coupling(self, geometry: Pair) -> Scalar:
        """Returns m l cos(theta) [kg m]."""
        return self.free.pole_mass * self.free.pole_length * geometry[1]

    def _one_at_rest(self, push: Scalar, torque: Scalar) -> Pair:
        """Returns x'' with the pole at rest, and theta'' with the cart at rest."""
        free = self.free
        # Products with inverses that stay the same for a whole run: a division takes as long as six multiplications.
        alone = push if self._follows else push * (1.0 / (free.moving_mass + free.pole_mass))
        return alone, torque * (1.0 / free.pivot_inertia)

    def _holding(self, geometry: Pair, smooth: Pair, mode: ContactMode) -> Pair:
        """Returns the force [N] and the torque [N m] that would move cart and pole from rest, their friction apart."""
        push, torque = self._with_friction(smooth, mode)
        coupling = self._coupling(geometry)
        resting, held = self._resting(mode)
        alone_x, alone_theta = self._one_at_rest(push, torque)
        return (
            push if self._follows else push + coupling * where(held, 0.0, alone_theta),
            torque + coupling * where(resting, 0.0, alone_x),
        )

    def _stop(self, q: Pair, mode: ContactMode) -> tuple[Scalar, ...]:
        """Returns the distance to the nearer stop."""
        if self.half_length is None:
            return ()
        return (where(jnp.abs(mode.cart) == AT_STOP, _NO_END, self.half_length - jnp.abs(q[0])),)


def in_contact(plant: Any, half_length: Scalar | None = None, restitution: Scalar = 0.0) -> Any:
    """Returns a plant as the loop integrates it: unchanged if it has neither dry friction nor stops.

    Args:
      plant: the cart-pole, bare or on the bench.
      half_length: of a track with stops at its ends [m]; None for no stops.
      restitution: speed of the cart after a stop to that before [1].
    """
    if half_length is None and plant.coulomb_friction is None and plant.pivot_coulomb_friction is None:
        return plant
    return InContact(plant, half_length, restitution)


def _end(mode: Int[Array, ""], rate: Scalar | None, force: Scalar, static: Scalar) -> Scalar:
    """Returns the guard of one axis.

    Sliding: the speed, or `_NO_END` without dry friction. Held: what is left of the static friction.
    At a stop: what is left of the force that presses the cart against it, static friction included.
    """
    side = jnp.sign(mode).astype(jnp.asarray(force).dtype)
    speed = _NO_END if rate is None else side * rate
    press = where(mode == HELD, -jnp.abs(force), side * force)
    return where(jnp.abs(mode) == 1, speed, static + press)


def _direction(force: Scalar) -> Int[Array, ""]:
    """Returns the sliding mode, 1 or -1, in the direction of a force."""
    return where(force > 0.0, np.int32(1), np.int32(-1))
