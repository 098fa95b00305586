import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import columns, derivative, dop853, fitted_order, random_problem, rough_plant

import cpjax
from cpjax import CartPole, State, StateFeedback
from cpjax.sim.integrators import INTEGRATORS, euler, rk4, semi_implicit_euler

ORDERS = {"rk4": 4.0, "semi-implicit-euler": 1.0, "euler": 1.0}
METHODS = pytest.mark.parametrize("name", list(ORDERS))


def spring(q, v):
    return -q


def march(method, acceleration, q, v, dt, count):
    """All states of `count` steps, the start first: arrays of positions and velocities."""

    def step(carry, _):
        return method(acceleration, *carry, dt), carry

    carry = jax.tree.map(jnp.asarray, (q, v))
    last, before = jax.jit(lambda carry: jax.lax.scan(step, carry, length=count))(carry)
    return jax.tree.map(np.append, before, last)


def test_every_integrator_that_rollouts_know_has_its_order_tested():
    assert set(INTEGRATORS) == set(ORDERS)


@METHODS
def test_the_error_on_a_damped_oscillation_shrinks_with_the_methods_order(name):
    # q'' = -2 z q' - q: velocity-dependent, and known in closed form.
    z, duration = 0.15, 6.0
    w = math.sqrt(1.0 - z * z)

    def exact(t):
        sway, fade = math.sin(w * t) / w, math.exp(-z * t)
        q = fade * (math.cos(w * t) + (z + 0.5) * sway)
        return q, -z * q + fade * (-w * math.sin(w * t) + (z + 0.5) * math.cos(w * t))

    counts = np.array([60, 120, 240, 480, 960]) * (1 if name == "rk4" else 16)
    errors = []
    for count in counts:
        q, v = march(INTEGRATORS[name], lambda q, v: -2.0 * z * v - q, 1.0, 0.5, duration / count, int(count))
        errors.append(math.hypot(q[-1] - exact(duration)[0], v[-1] - exact(duration)[1]))
    assert fitted_order(duration / counts, errors) == pytest.approx(ORDERS[name], abs=0.1)


@pytest.mark.slow
@METHODS
def test_the_error_of_a_rollout_shrinks_with_its_integrators_order(name):
    # Smooth: the motor's terminals are shorted, so nothing clips or switches.
    plant, start, duration = rough_plant(), State(0.1, -0.5, 1.2, 2.0), 2.0
    exact = dop853(lambda s: derivative(plant, s, 0.0), columns(start), (0.0, duration)).y[:, -1]
    # RK4 reaches its order only at steps this fine: at longer ones terms of fifth order partly cancel the fourth's.
    counts = np.array([250, 500, 1000, 2000]) * (1 if name == "rk4" else 16)
    errors = []
    for count in counts:
        run = cpjax.rollout(
            plant,
            StateFeedback([0.0, 0.0, 0.0, 0.0]),
            start,
            clock="continuous",
            duration=duration,
            dt=duration / count,
            integrator=name,
            save_every=int(count),
        )
        errors.append(np.linalg.norm(columns(run.state)[-1] - exact))
    assert fitted_order(duration / counts, errors) == pytest.approx(ORDERS[name], abs=0.1)


def test_semi_implicit_euler_keeps_the_energy_of_an_oscillator_within_bounds():
    dt = 0.05
    q, v = march(semi_implicit_euler, spring, 1.0, 0.0, dt, 200_000)
    # The method conserves this quadratic form exactly, which pens the energy in for ever.
    conserved = q * q + v * v - dt * q * v
    energy = q * q + v * v
    np.testing.assert_allclose(conserved, 1.0, rtol=0, atol=1e-11)
    assert 1.0 / (1.0 + dt / 2) - 1e-11 <= energy.min() < energy.max() <= 1.0 / (1.0 - dt / 2) + 1e-11


def test_explicit_euler_feeds_an_oscillator_by_its_known_factor():
    dt, count = 0.05, 1000
    q, v = march(euler, spring, 1.0, 0.0, dt, count)
    np.testing.assert_allclose(q * q + v * v, (1.0 + dt * dt) ** np.arange(count + 1), rtol=1e-12)


def textbook_rk4(field, y, dt):
    k1 = field(y)
    k2 = field(y + dt / 2 * k1)
    k3 = field(y + dt / 2 * k2)
    k4 = field(y + dt * k3)
    return y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def test_rk4_without_position_rows_is_the_textbook_method_to_rounding():
    plants, states, voltages = random_problem(31)
    steps = jnp.asarray(np.random.default_rng(34).uniform(1e-3, 0.1, voltages.size))

    def clip_factors(plant, state, voltage, dt):
        def acceleration(q, v):
            rate = plant.vector_field(State(q["x"], v["x"], q["theta"], v["theta"]), voltage)
            return {"x": rate.x_dot, "theta": rate.theta_dot}

        q, v = {"x": state.x, "theta": state.theta}, {"x": state.x_dot, "theta": state.theta_dot}
        q, v = rk4(acceleration, q, v, dt)
        return State(q["x"], v["x"], q["theta"], v["theta"]).vector()

    def textbook(plant, state, voltage, dt):
        def field(y):
            return plant.vector_field(State.from_vector(y), voltage).vector()

        return textbook_rk4(field, state.vector(), dt)

    got = jax.vmap(clip_factors)(plants, states, voltages, steps)
    expected = jax.vmap(textbook)(plants, states, voltages, steps)
    rates = jax.vmap(CartPole.vector_field)(plants, states, voltages).vector()
    scale = np.linalg.norm(expected, axis=1) + steps * np.linalg.norm(rates, axis=1)
    assert np.max(np.abs(got - expected).max(axis=1) / scale) <= 1e-14
