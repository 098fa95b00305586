"""Located switching on systems whose motion is known in closed form, jumps and all."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from cpjax.sim.integrators import rk4
from cpjax.sim.switching import CROSSING_COST, Observation, iterate, start_motion

DT = 1e-3


class Ball(NamedTuple):
    """Falls, and bounces at height 0."""

    gravity: jax.Array
    restitution: jax.Array

    def observe(self, q, v, mode):
        return Observation(-self.gravity * jnp.ones_like(q), (q,), ())

    def jump(self, q, v, mode, guard):
        return q, -self.restitution * v, mode


class Oscillator(NamedTuple):
    """A spring that is stiffer on one side of 0 than on the other. The mode is the sign of q."""

    right: jax.Array
    left: jax.Array

    def observe(self, q, v, mode):
        return Observation(-(jnp.where(mode > 0, self.right, self.left) ** 2) * q, (mode * q,), ())

    def jump(self, q, v, mode, guard):
        return q, v, -mode


def run(system, q, v, mode, steps, dt=DT, spare=64):
    """The clock after so many steps, and whether all of them were made."""
    dt = jnp.asarray(dt, dtype=q.dtype)

    def body(clock, _):
        after, _ = iterate(system, rk4, clock, dt)
        done = clock.grid_index >= steps
        return jax.tree.map(lambda old, new: jnp.where(done, old, new), clock, after), None

    clock, _ = lax.scan(body, start_motion(system, q, v, mode, dt), None, length=steps + spare)
    return clock


def ball(x):
    """Height and speed after 2 s, from height, speed, gravity and restitution."""
    clock = run(Ball(x[2], x[3]), x[0], x[1], jnp.ones(()), 2000)
    return jnp.stack([clock.q, clock.v]), clock.grid_index


def exact_ball(x, time=2.0):
    height, speed, gravity, restitution = x
    landing = (speed + jnp.sqrt(speed**2 + 2 * gravity * height)) / gravity
    while float(lax.stop_gradient(landing)) < time:
        impact = speed - gravity * landing
        time, height, speed = time - landing, 0.0, -restitution * impact
        landing = 2 * speed / gravity
    return jnp.stack([height + speed * time - 0.5 * gravity * time**2, speed - gravity * time])


def oscillator(x):
    """q and v after 3 s, from q, v = 0 and the two frequencies."""
    clock = run(Oscillator(x[1], x[2]), x[0], 0.0 * x[0], jnp.ones(()), 3000)
    return jnp.stack([clock.q, clock.v]), clock.grid_index


def exact_oscillator(x, time=3.0):
    amplitude, right, left = x
    time, sign, first = time - 0.5 * math.pi / right, -1.0, right * amplitude  # then it is at 0, with this speed
    frequencies = (left, right)
    for k in range(100):
        half = math.pi / frequencies[k % 2]
        if float(lax.stop_gradient(half)) > float(lax.stop_gradient(time)):
            w = frequencies[k % 2]
            return jnp.stack([sign * first / w * jnp.sin(w * time), sign * first * jnp.cos(w * time)])
        time, sign = time - half, -sign
    raise AssertionError


CASES = {
    "ball": (ball, exact_ball, [1.0, 0.3, 9.81, 0.8]),  # four bounces
    "ball that rises first": (ball, exact_ball, [0.01, 4.0, 9.81, 0.6]),
    "oscillator": (oscillator, exact_oscillator, [0.7, 5.0, 3.0]),  # four crossings
    "slow oscillator": (oscillator, exact_oscillator, [0.7, 0.6, 1.9]),  # one
}


@pytest.mark.parametrize(
    "case", ["ball", "oscillator", *(pytest.param(c, marks=pytest.mark.slow) for c in CASES if " " in c)]
)
def test_values_and_derivatives_through_events_are_those_of_the_closed_form(case):
    ours, exact, x = CASES[case]
    x = jnp.asarray(x)
    (value, passed), (expected, slopes) = jax.jit(ours)(x), (exact(x), jax.jacfwd(exact)(x))
    assert passed == (2000 if "ball" in case else 3000)
    np.testing.assert_allclose(value, expected, rtol=1e-10, atol=1e-11)
    for direction in (jax.jacfwd, jax.jacrev):
        found = jax.jit(direction(lambda x: ours(x)[0]))(x)
        np.testing.assert_allclose(found, slopes, rtol=1e-10, atol=1e-10)


def test_under_vmap_each_system_keeps_its_own_clock():
    rng = np.random.default_rng(3)
    x = jnp.asarray(np.array([1.0, 0.3, 9.81, 0.8]) * np.exp(rng.uniform(-0.3, 0.3, (16, 4))))
    x = x.at[:, 3].set(rng.uniform(0.75, 0.95, 16))  # it would come to rest, after bounces without number, later
    values, passed = jax.jit(jax.vmap(ball))(x)
    assert np.all(passed == 2000)
    for one, value in zip(x, values, strict=True):
        np.testing.assert_allclose(value, exact_ball(one), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("height", [0.5 * 9.81 * (100 * DT) ** 2, 0.5 * 9.81 * (100 * DT) ** 2 * (1 + 1e-15), 0.0])
def test_a_crossing_on_a_grid_point_or_at_the_start_happens_once(height):
    x = jnp.asarray([height, 0.0 if height else 3.0, 9.81, 0.8])
    clock = run(Ball(x[2], x[3]), x[0], x[1], jnp.ones(()), 150)
    expected = exact_ball(x, 0.15) if height else jnp.asarray([3.0 * 0.15 - 0.5 * 9.81 * 0.15**2, 3.0 - 9.81 * 0.15])
    np.testing.assert_allclose([clock.q, clock.v], expected, atol=1e-10)


def test_a_crossing_takes_so_many_iterations_more():
    x = jnp.asarray([1.0, 0.0, 9.81, 0.9])
    falls = math.sqrt(2 / 9.81)
    steps = int((falls + 0.1) / DT)  # one bounce
    enough, short = (
        run(Ball(x[2], x[3]), x[0], x[1], jnp.ones(()), steps, spare=n).grid_index for n in (CROSSING_COST, 3)
    )
    assert enough == steps
    assert short == steps - 1


class TwoWalls(NamedTuple):
    """A point that flies freely and counts, in its mode, which of two walls it has passed."""

    first: jax.Array
    second: jax.Array

    def observe(self, q, v, mode):
        return Observation(
            0.0 * q,
            (jnp.where(mode % 2 == 0, self.first - q, 1.0), jnp.where(mode < 2, self.second - q, 1.0)),
            (),
        )

    def jump(self, q, v, mode, guard):
        return q, v * jnp.where(guard == 0, 0.5, 3.0), mode + jnp.where(guard == 0, 1, 2)


@pytest.mark.parametrize(("first", "second"), [(0.2505, 0.2507), (0.2507, 0.2505), (0.2506, 0.2506)])
def test_of_two_crossings_in_one_step_the_earlier_is_first_and_both_happen(first, second):
    system = TwoWalls(jnp.asarray(first), jnp.asarray(second))

    def end(wall):
        clock = run(system._replace(first=wall), jnp.zeros(()), jnp.ones(()), jnp.zeros((), dtype=int), 400)
        return clock.q, clock.mode

    def exact(wall):
        (a, fa), (b, fb) = sorted([(float(wall), 0.5), (second, 3.0)])
        return b + fa * fb * (0.4 - a - (b - a) / fa)

    q, mode = end(system.first)
    assert mode == 3
    assert float(q) == pytest.approx(exact(first), rel=1e-12)
    if first != second:
        slope = jax.grad(lambda wall: end(wall)[0])(system.first)
        assert float(slope) == pytest.approx((exact(first + 1e-6) - exact(first - 1e-6)) / 2e-6, rel=1e-8)


class Twins(NamedTuple):
    """An oscillator with two guards that are the same."""

    wall: jax.Array

    def observe(self, q, v, mode):
        gap = self.wall - q
        return Observation(-9.0 * q - 1.0, (jnp.where(mode % 2 == 0, gap, 1.0), jnp.where(mode < 2, gap, 1.0)), ())

    def jump(self, q, v, mode, guard):
        return q, v, mode + jnp.where(guard == 0, 1, 2)


def test_two_guards_that_fall_at_one_instant_are_both_passed():
    walls = jnp.linspace(0.2, 0.8, 500)
    clock = jax.vmap(lambda w: run(Twins(w), 0.0 * w, 4.0 + 0.0 * w, jnp.zeros((), dtype=int), 30, dt=0.02, spare=32))(
        walls
    )
    assert np.all(clock.grid_index == 30)
    assert np.all(clock.mode == 3)


class Sharp(NamedTuple):
    """A guard that is nothing like a cubic on the scale of a step."""

    at: jax.Array

    def observe(self, q, v, mode):
        return Observation(0.0 * q, (jnp.where(mode == 0, jnp.tanh(200.0 * (self.at - q)), 1.0),), ())

    def jump(self, q, v, mode, guard):
        return q, 0.5 * v, mode + 1


def test_a_guard_unlike_a_cubic_is_located_and_time_never_runs_backwards():
    at = jnp.linspace(0.21, 0.39, 37)

    def end(at):
        clock = run(Sharp(at), 0.0 * at, 1.0 + 0.0 * at, jnp.zeros((), dtype=int), 8, dt=0.1)
        return clock.q, (clock.grid_index, clock.mode)

    (q, (passed, mode)), slope = jax.vmap(jax.value_and_grad(end, has_aux=True))(at)
    assert np.all(passed == 8)
    assert np.all(mode == 1)
    np.testing.assert_allclose(q, at + 0.5 * (0.8 - at), rtol=1e-6)
    np.testing.assert_allclose(slope, 0.5, rtol=1e-6)


def test_the_order_of_the_integrator_is_kept_across_events():
    errors, steps = [], (64, 128, 256, 512)
    x = jnp.asarray([0.7, 5.0, 3.0])
    for n in steps:
        clock = run(Oscillator(x[1], x[2]), x[0], 0.0 * x[0], jnp.ones(()), n, dt=3.0 / n)
        errors.append(float(jnp.max(jnp.abs(jnp.stack([clock.q, clock.v]) - exact_oscillator(x)))))
    assert -np.polyfit(np.log(steps), np.log(errors), 1)[0] >= 3.8
