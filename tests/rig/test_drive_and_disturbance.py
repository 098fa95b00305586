"""Drive, inductance and disturbances: against equations of motion written here and solved by SciPy."""

import dataclasses
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import columns, rough_plant
from scipy.integrate import solve_ivp

import cpjax
from cpjax import Disturbance, Drive, InputError, Pushes, RandomPushes, Rig, State, VoltageSignal, Wind, paper
from cpjax.rig.drive import line_of_decay

PLANT = rough_plant()
LAW = paper.controller("corrected-centred", "lqr", PLANT, "computed")
START = State(0.02, 0.3, 2.6, 0.4)
SIGNAL = VoltageSignal(np.arange(20) * 0.05, 10.0 * np.sin(1.0 + np.arange(20.0) ** 2))


def moving(plant, s, force, cart=0.0, pole=0.0, tilt=0.0):
    """Accelerations under the motor's force, forces along the rail and a tilted rail."""
    x_dot, theta, theta_dot = s[1:4]
    m, l, g = plant.pole_mass, plant.pole_length, plant.gravity
    along, across = g * math.sin(tilt), g * math.cos(tilt)
    coupling = -m * l * math.cos(theta)
    a, b, d = plant.moving_mass + m, coupling, plant.pivot_inertia
    push, torque = (
        force
        - plant.cart_friction * x_dot
        - m * l * math.sin(theta) * theta_dot**2
        + (plant.cart_mass + m) * along
        + cart
        + pole,
        m * l * (across * math.sin(theta) - along * math.cos(theta))
        - plant.pivot_friction * theta_dot
        - l * math.cos(theta) * pole,
    )
    return (d * push - b * torque) / (a * d - b * b), (a * torque - b * push) / (a * d - b * b)


def solved(field, s, times, **options):
    """States at the times, solved from each to the next, between which the field is smooth."""
    found = [s]
    for begin, end in itertools.pairwise(times):
        piece = solve_ivp(
            lambda t, s, b=begin: field(b, t, s), (begin, end), found[-1], rtol=1e-11, atol=1e-12, **options
        )
        found.append(piece.y[:, -1])
    return np.array(found)


def commanded(begin):
    return float(np.clip(SIGNAL.voltages[min(19, int(begin / 0.05 + 1e-9))], -12.0, 12.0))


def test_tilt_and_pushes_are_those_of_the_equations_of_motion():
    pushes = Pushes(times=[0.1, 0.3, 0.31], cart=[5.0, 0.0, -2.0], pole=[0.0, 3.0, 1.0], duration=0.05)
    rig = Rig(PLANT, disturbance=Disturbance(tilt=0.05, pushes=pushes))
    run = cpjax.rollout(rig, SIGNAL, START, duration=0.6, dt=1e-3, control_period=0.05, save_every=10)

    def field(begin, t, s):
        acts = (begin >= pushes.times - 1e-9) & (begin < pushes.times + 0.05 - 1e-9)
        force = PLANT.motor.force(commanded(begin), s[1])
        a = moving(PLANT, s, force, np.sum(acts * pushes.cart), np.sum(acts * pushes.pole), 0.05)
        return [s[1], a[0], s[3], a[1]]

    expected = solved(field, columns(START), np.arange(61) * 0.01, method="DOP853")
    np.testing.assert_allclose(columns(run.state), expected, rtol=0, atol=1e-8)
    a = moving(PLANT, expected[35], PLANT.motor.force(commanded(0.35), expected[35][1]), -2.0, 1.0, 0.05)
    assert float(run.cart_acceleration[35]) == pytest.approx(a[0], abs=1e-6)


@pytest.mark.parametrize("lag", [1e-3, *(pytest.param(one, marks=pytest.mark.slow) for one in (0.02, 1e-5))])
def test_a_lag_of_any_length_needs_no_shorter_step(lag):
    rig = Rig(PLANT, drive=Drive(lag=lag))
    run = cpjax.rollout(rig, SIGNAL, START, duration=0.6, dt=2e-3, control_period=0.05 - 0.0, save_every=25)

    def field(begin, t, s):
        a = moving(PLANT, s, PLANT.motor.force(s[4], s[1]))
        return [s[1], a[0], s[3], a[1], (commanded(begin) - s[4]) / lag]

    expected = solved(
        field, np.array([*columns(START), 0.0]), np.arange(13) * 0.05, method="DOP853" if lag > 1e-4 else "Radau"
    )
    np.testing.assert_allclose(columns(run.state), expected[:, :4], rtol=0, atol=1e-6)


def test_inductance_needs_no_shorter_step():
    motor = dataclasses.replace(PLANT.motor, inductance=0.2e-3 * PLANT.motor.resistance)
    plant = dataclasses.replace(PLANT, motor=motor)
    k = motor.back_emf_constant * motor.gear_ratio / motor.wheel_radius

    def field(begin, t, s):
        force = (
            motor.force_per_voltage * s[4]
            - motor.viscous_friction * (motor.gear_ratio / motor.wheel_radius) ** 2 * s[1]
        )
        a = moving(PLANT, s, force)
        return [s[1], a[0], s[3], a[1], (commanded(begin) - k * s[1] - s[4]) / 0.2e-3]

    start = np.array([*columns(START), -k * START.x_dot])
    expected = solved(field, start, np.arange(13) * 0.05, method="DOP853")[:, :4]
    errors = {}
    for dt in (2e-3, 1e-3):
        run = cpjax.rollout(plant, SIGNAL, START, duration=0.6, dt=dt, control_period=0.05, save_every=round(0.05 / dt))
        errors[dt] = np.max(np.abs(columns(run.state) - expected))
    assert errors[2e-3] < 5e-6
    assert errors[1e-3] < 0.4 * errors[2e-3]
    without = cpjax.rollout(PLANT, SIGNAL, START, duration=0.6, dt=1e-3, control_period=0.05, save_every=50)
    assert np.max(np.abs(columns(without.state) - expected)) > 1e-4  # it matters


def test_the_supply_sags_and_pulse_widths_have_steps():
    motor = PLANT.motor
    drive = Drive(source_resistance=0.3, voltage_step=0.5)
    rig = Rig(PLANT, drive=drive)
    run = cpjax.rollout(rig, SIGNAL, START, duration=0.6, dt=1e-3, control_period=0.05, save_every=50)
    k = motor.back_emf_constant * motor.gear_ratio / motor.wheel_radius

    def field(begin, t, s):
        duty = 0.5 * np.round(commanded(begin) / 0.5) / motor.voltage_limit
        # Terminal voltage v and current i of a bridge: v = duty (V - r duty i), i = (v - k x') / R.
        v, _ = np.linalg.solve(
            [[1.0, duty**2 * 0.3], [-1.0, motor.resistance]], [duty * motor.voltage_limit, -k * s[1]]
        )
        a = moving(PLANT, s, motor.force(v, s[1]))
        return [s[1], a[0], s[3], a[1]]

    expected = solved(field, columns(START), np.arange(13) * 0.05, method="DOP853")
    np.testing.assert_allclose(columns(run.state), expected, rtol=0, atol=1e-8)


def test_random_pushes_wind_and_noise_depend_on_seed_and_place_alone():
    pushes = RandomPushes(every=0.5, cart=4.0, pole=1.0)
    disturbance = Disturbance(pushes=pushes, wind=Wind(force=0.3, correlation_time=0.2))
    rig = Rig(PLANT, drive=Drive(noise=0.4, delay=2e-3), disturbance=disturbance)
    starts = cpjax.sample_starts("hanging", 20, seed=1)
    settings = {"duration": 0.3, "dt": 2e-3, "seed": 5}
    whole = cpjax.sweep(rig, LAW, starts, **settings)
    pieces = cpjax.sweep(rig, LAW, starts, chunk=16, block=16, **settings)
    np.testing.assert_array_equal(whole.effort, pieces.effort)
    other = cpjax.sweep(rig, LAW, starts, **{**settings, "seed": 6})
    assert np.all(whole.effort != other.effort)
    first = cpjax.measure(rig, LAW, jax.tree.map(lambda column: column[0], starts), **settings)
    assert float(first.effort) == pytest.approx(float(whole.effort[0]), rel=1e-9)
    # One push in each interval, for its duration; wind of the stated size.
    times, key = jnp.arange(0.0, 4000.0, 0.01), jnp.uint32(3)
    found = jax.jit(jax.vmap(lambda t: pushes.forces(t, 0.01, key, jnp.uint32(0))))(times)
    share = np.asarray(found.cart).reshape(-1, 50)
    assert np.all(np.abs(np.sum(np.abs(share), axis=1) - 4.0 * 5) <= 4.0)
    assert abs(np.mean(found.cart)) < 0.02
    wind = np.asarray(jax.jit(jax.vmap(lambda t: disturbance.wind.at(t, 0.01, key, jnp.uint32(0)).pole))(times))
    assert np.std(wind) == pytest.approx(0.3, rel=0.03)
    assert np.mean(wind[:-40] * wind[40:]) == pytest.approx(0.0, abs=0.003)


def test_a_push_shorter_than_a_step_has_its_impulse():
    pushes, key = Pushes(times=[0.1013], cart=[100.0], pole=[3.0], duration=1e-4), jnp.uint32(3)
    times = jnp.arange(0.0, 0.5, 0.002)
    found = jax.jit(jax.vmap(lambda t: pushes.forces(t, 0.002, key, jnp.uint32(0))))(times)
    assert float(jnp.sum(found.cart) * 0.002) == pytest.approx(100.0 * 1e-4, rel=1e-9)
    fast = Wind(force=0.3, correlation_time=1e-12)
    wind = jax.jit(jax.vmap(lambda t: fast.at(t, 0.002, key, jnp.uint32(0)).pole))(times)
    assert len(np.unique(wind)) == len(times)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_line_of_decay_has_mean_and_first_moment_of_the_exponential(dtype):
    for ratio in (1e-9, 1e-4, 0.0299, 0.0301, 1.0, 40.0, 1e9):
        value, slope = (np.float64(number) for number in line_of_decay(dtype(ratio)))
        s, weights = np.polynomial.legendre.leggauss(200)
        s, weights = 0.5 + 0.5 * s, 0.5 * weights
        mean, moment = (
            (1 / ratio, 1 / ratio**2) if ratio > 1e3 else (np.exp(-ratio * s) @ (weights * p) for p in (1, s))
        )
        tolerance = 100.0 * float(np.finfo(dtype).eps)
        assert value + slope / 2 == pytest.approx(mean, abs=tolerance)
        assert value / 2 + slope / 3 == pytest.approx(moment, abs=tolerance)


@pytest.mark.slow
def test_derivatives_through_drive_and_disturbance_are_those_of_differences():
    start = State(0.02, 0.1, 2.6, 0.4)

    def end(p):
        motor = dataclasses.replace(PLANT.motor, inductance=p[2])
        plant = dataclasses.replace(PLANT, motor=motor, coulomb_friction=p[4])
        pushes = Pushes(times=[0.1], cart=p[3][None], pole=p[3][None])
        rig = Rig(plant, drive=Drive(lag=p[0]), disturbance=Disturbance(tilt=p[1], pushes=pushes))
        run = cpjax.rollout(rig, SIGNAL, start, duration=0.5, dt=2e-3, control_period=0.05 - 0.0, save_every=250)
        return run.state.theta[-1] + run.state.x[-1]

    p = jnp.array([0.01, 0.03, 1e-3, 2.0, 0.7])
    gradient, value = jax.jit(jax.grad(end))(p), jax.jit(end)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(p), gradient, rtol=1e-9)
    for i in range(5):
        step = jnp.zeros(5).at[i].set(1e-4 * p[i])
        found = (value(p - 2 * step) - 8 * value(p - step) + 8 * value(p + step) - value(p + 2 * step)) / 12e-4
        assert float(gradient[i] * p[i]) == pytest.approx(float(found), rel=1e-6)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: Drive(lag=0.0), "lag"),
        (
            lambda: cpjax.measure(
                Rig(PLANT, drive=Drive(dead_band=1.0)), LAW, START, duration=0.1, dt=0.01, switching="located"
            ),
            "switching",
        ),
        (lambda: Drive(noise=-1.0), "noise"),
        (lambda: Pushes(times=[0.1], cart=[1.0, 2.0], pole=[0.0]), "Pushes.cart"),
        (lambda: RandomPushes(every=0.1, duration=0.2), "duration"),
        (lambda: Disturbance(tilt=2.0), "tilt"),
        (lambda: Disturbance(wind=1.0), "Disturbance.wind"),
        (lambda: Rig(PLANT, disturbance=0.1), "Rig.disturbance"),
        (lambda: Rig(cpjax.rig("quanser-ip02-long").plant, drive=Drive(source_resistance=0.1)), "source_resistance"),
        (
            lambda: cpjax.measure(
                Rig(PLANT, drive=Drive(lag=0.1)), LAW, START, duration=0.1, dt=0.01, clock="continuous"
            ),
            "clock",
        ),
        (
            lambda: cpjax.measure(
                Rig(PLANT, drive=Drive(noise=1.0)), LAW, START, duration=0.1, dt=0.01, clock="continuous"
            ),
            "clock",
        ),
    ],
)
def test_what_no_drive_or_disturbance_can_be_is_refused_by_name(call, field):
    with pytest.raises(InputError) as caught:
        call()
    assert field in caught.value.field
