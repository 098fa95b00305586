"""A drive that prescribes the cart's acceleration: motion, linear model, published gain and swing-up."""

import dataclasses
import math

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import columns
from scipy.integrate import solve_ivp

import cpjax
from cpjax import CartPole, State
from cpjax.bridges.python_control import plant_system
from cpjax.cli.notes import unstable_pole
from cpjax.tune.parameters import free_parameters

SERVO = CartPole.rod(
    mass=0.3, length=0.8, cart_mass=2.0, cart_friction=7.0, pivot_friction=0.03, motor=cpjax.AccelerationActuator(4.0)
)


def test_the_cart_follows_the_command_and_the_pole_the_cart():
    commands = np.random.default_rng(2).uniform(-6.0, 6.0, 60)  # some beyond the limit
    start = State(0.1, -0.2, 2.5, 0.4)
    run = cpjax.rollout(
        SERVO,
        cpjax.VoltageSignal(0.02 * np.arange(60), commands),
        start,
        duration=1.2,
        dt=0.002,
        control_period=0.02,
    )
    m, l, J, b, g = 0.3, 0.4, 0.3 * 0.8**2 / 12, 0.03, 9.81
    s, states = columns(start), [columns(start)]
    for u in np.clip(commands, -4.0, 4.0):

        def field(t, s, u=u):
            torque = m * g * l * math.sin(s[2]) - b * s[3] + m * l * math.cos(s[2]) * u
            return [s[1], u, s[3], torque / (J + m * l * l)]

        s = solve_ivp(field, (0.0, 0.02), s, rtol=1e-12, atol=1e-12).y[:, -1]
        states.append(s)
    np.testing.assert_allclose(columns(run.state)[::10], states, atol=1e-9)
    held = np.repeat(np.clip(commands, -4.0, 4.0), 10)
    np.testing.assert_array_equal(np.asarray(run.outputs["cart_acceleration"])[:-1], held)


def test_the_published_gain_of_googols_rig_is_a_placement():
    model = cpjax.linearize(cpjax.rig("googol").plant)
    expected = np.zeros((4, 4))
    expected[0, 1] = expected[2, 3] = 1.0
    expected[3, 2] = 29.4
    np.testing.assert_allclose(model.A, expected, atol=1e-12)
    np.testing.assert_allclose(model.B[:, 0], [0.0, 1.0, 0.0, 3.0], atol=1e-12)
    side = 2.0 * math.sqrt(3.0)
    poles = [-10.0, -10.0, complex(-2.0, side), complex(-2.0, -side)]
    published = [-54.4218, -24.4898, 93.2739, 16.1633]
    np.testing.assert_allclose(cpjax.place(*model, poles)[0], published, atol=5e-5)
    np.testing.assert_allclose(
        np.ravel(control.acker(np.asarray(model.A), np.asarray(model.B), poles)), published, atol=5e-5
    )


def test_demanded_accelerations_are_the_command():
    law = cpjax.EnergySwingUp(SERVO, energy_gain=3.0, cart_stiffness=2.0, cart_damping=1.0)
    for state in (State(0.1, 0.3, 2.0, -1.5), State(-0.2, 0.1, 0.3, 4.0)):
        u = law.voltage(state)
        assert float(u) == float(law.acceleration(state))
        assert float(SERVO.vector_field(state, u).x_dot) == float(u)
        slope = jax.grad(lambda x, s=state: SERVO.vector_field(s, x).theta_dot)(jnp.asarray(u))
        assert float(slope) == pytest.approx(0.3 * 0.4 * math.cos(state.theta) / float(SERVO.pivot_inertia))


def test_the_carts_mass_and_friction_have_no_effect():
    other = dataclasses.replace(SERVO, cart_mass=0.1, cart_friction=0.0)
    for ours, theirs in zip(cpjax.linearize(SERVO), cpjax.linearize(other), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    regulator = cpjax.StateFeedback(np.ones((1, 4)), design=cpjax.LqrWeights(np.eye(4), 1.0))
    drawn = [
        free_parameters(
            cpjax.Hybrid(cpjax.EnergySwingUp(plant, 1.0), regulator, cpjax.AngleGate(0.3)), ["energy_gain"]
        ).draw(np.random.default_rng(1), 3)
        for plant in (SERVO, other)
    ]
    np.testing.assert_array_equal(*drawn)


def test_what_computes_without_jax_knows_the_drive_too():
    s = np.array([0.1, -0.2, 0.7, 0.4])
    found = plant_system(SERVO).updfcn(0.0, s, [9.0], {})
    expected = SERVO.vector_field(State(*s), SERVO.saturate(9.0))
    np.testing.assert_allclose(found, [float(leaf) for leaf in jax.tree.leaves(expected)], rtol=1e-14)
    googol = cpjax.rig("googol").plant
    assert unstable_pole(googol, cpjax.StateFeedback([-54.4218, -24.4898, 93.2739, 16.1633])) is None
    assert unstable_pole(googol, cpjax.StateFeedback([0.0, 0.0, 0.0, 0.0])) == pytest.approx(math.sqrt(29.4))


def test_stops_and_a_dry_pivot_act_and_the_carts_dry_friction_is_refused():
    half, u, dry = 0.3, 3.0, 0.02
    plant = dataclasses.replace(SERVO, pivot_coulomb_friction=dry)
    rig = cpjax.Rig(plant, track=cpjax.Track(half, ends="stop"))
    push = cpjax.VoltageSignal(np.array([0.0, 0.6]), np.array([u, -u]))
    start = State(0.0, 0.0, 0.5, 0.2)
    run = cpjax.rollout(rig, push, start, duration=0.7, dt=0.002, control_period=0.02)
    m, l, J, b, g = 0.3, 0.4, 0.3 * 0.8**2 / 12, 0.03, 9.81
    inertia, s, hit = J + m * l * l, np.array([0.5, 0.2]), math.sqrt(2.0 * half / u)

    def swung(s, duration, u):
        def field(t, s):
            torque = m * g * l * math.sin(s[0]) - b * s[1] - dry + m * l * math.cos(s[0]) * u
            return [s[1], torque / inertia]

        return solve_ivp(field, (0.0, duration), s, rtol=1e-11, atol=1e-11).y[:, -1]

    s = swung(s, hit, u)
    s[1] -= m * l * math.cos(s[0]) * u * hit / inertia  # the impact
    assert s[1] > 0.0
    s = swung(s, 0.6 - hit, 0.0)
    np.testing.assert_allclose(columns(run.state)[300], [half, 0.0, *s], atol=1e-6)
    s = swung(s, 0.1, -u)
    np.testing.assert_allclose(columns(run.state)[-1], [half - 0.5 * u * 0.1**2, -u * 0.1, *s], atol=1e-6)
    # On a tilted rail, and under a force on the cart, the cart still does as it is told; the pole feels the tilt.
    pushes = cpjax.Pushes(np.array([0.0]), np.array([5.0]), np.array([0.0]), duration=1.0)
    tilted = cpjax.Rig(SERVO, disturbance=cpjax.Disturbance(0.1, pushes)).moving(0, 0)
    (sin, cos), rates = (math.sin(0.5), math.cos(0.5)), (0.3, 0.2)
    x_ddot, theta_ddot = tilted.accelerations((sin, cos), rates, 1.0)
    torque = m * g * l * math.sin(0.5 - 0.1) - b * 0.2 + m * l * cos
    assert (float(x_ddot), float(theta_ddot)) == (1.0, pytest.approx(torque / inertia, rel=1e-12))
    with pytest.raises(cpjax.InputError, match="coulomb_friction"):
        dataclasses.replace(SERVO, coulomb_friction=0.5)
