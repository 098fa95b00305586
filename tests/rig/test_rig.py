"""Rigs: encoders, estimator, delay and dead band against a loop written with NumPy, and what is refused."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.random import threefry_2x32
from oracles import derivative, oracle_of

import cpjax
from cpjax import Digital, Drive, Encoders, FilteredDerivative, InputError, Rig, State, Track, paper
from cpjax.numeric.noise import random_bits, standard_normals
from cpjax.rig import PRESETS

PLANT = paper.appendix_plant()
LAW = paper.controller("corrected-centred", "placement", PLANT)
START = State(0.02, 0.0, math.pi - 0.2, 0.1)
SENSORS = Encoders(x_step=2.275e-5, theta_step=2 * math.pi / 4096, theta_offset=0.002)
RUN = {"duration": 1.0, "dt": 1e-3}
FIRMWARE = Digital(LAW, FilteredDerivative(cutoff=300.0), dead_band=0.4)


def swung_by_numpy(dt, steps, every, delay, dead_band):
    """The loop of FIRMWARE on a rig, sample by sample: states (steps + 1, 4) and applied voltages (steps + 1,)."""
    oracle = oracle_of(PLANT, LAW)
    period = every * dt
    kept = math.exp(-300.0 * period)
    s = np.array([START.x, START.x_dot, START.theta, START.theta_dot])
    last, rates, commands, states, voltages = None, np.zeros(2), [], [], []
    for step in range(steps + 1):
        if step % every == 0:
            x = 2.275e-5 * np.round(s[0] / 2.275e-5)
            theta_step = 2 * math.pi / 4096
            theta = theta_step * np.round((s[2] + 0.002) / theta_step)
            y = np.array([x, theta])
            rates = kept * rates + (1 - kept) * ((y - last) / period if last is not None else np.zeros(2))
            last = y
            seen = np.array([y[0], rates[0], y[1], rates[1]])
            regulating = oracle.margin(seen) >= 0.0
            demand = oracle.regulate(seen) if regulating else oracle.swing_up(seen)
            if abs(demand) < 0.4 * (1 + 1e-6):
                demand = np.sign(demand) * 0.4 * (1 + 1e-6)
            clipped = min(max(demand, -12.0), 12.0)
        commands.append(0.0 if abs(clipped) <= dead_band else clipped)
        voltage = commands[step - delay] if step >= delay else 0.0
        states.append(s)
        voltages.append(voltage)
        k1 = derivative(PLANT, s, voltage)
        k2 = derivative(PLANT, s + 0.5 * dt * k1, voltage)
        k3 = derivative(PLANT, s + 0.5 * dt * k2, voltage)
        k4 = derivative(PLANT, s + dt * k3, voltage)
        s = s + dt / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.array(states), np.array(voltages)


@pytest.mark.parametrize(("every", "delay"), [(1, 0), (1, 3), (4, 4), (4, 3)])
def test_encoders_filter_dead_band_and_delay_are_those_of_a_numpy_loop(every, delay):
    dt, steps = 1e-3, 3000
    rig = Rig(PLANT, sensors=SENSORS, drive=Drive(delay=delay * dt, dead_band=0.4))
    run = cpjax.rollout(rig, FIRMWARE, START, duration=steps * dt, dt=dt, control_period=every * dt)
    states, voltages = swung_by_numpy(dt, steps, every, delay, 0.4)
    assert np.min(np.abs(states[:, 2])) < 0.1  # the pendulum swings up
    np.testing.assert_allclose(run.state.vector(), states, rtol=0, atol=1e-9)
    np.testing.assert_allclose(run.voltage, voltages, rtol=0, atol=1e-7)


def test_an_ideal_rig_is_its_plant():
    settings = {"duration": 0.5, "dt": 2e-3}
    for one, other in zip(
        jax.tree.leaves(cpjax.rollout(Rig(PLANT), LAW, START, **settings)),
        jax.tree.leaves(cpjax.rollout(PLANT, LAW, START, **settings)),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)


def test_a_sweep_with_noise_is_its_rollouts_and_no_chunk_changes_it():
    noisy = dataclasses.replace(SENSORS, x_noise=1e-4, theta_noise=1e-3)
    rig = Rig(PLANT, sensors=noisy, drive=Drive(delay=2e-3))
    starts = cpjax.sample_starts("hanging", 40, seed=1)
    settings = {"duration": 1.0, "dt": 2e-3, "seed": 5}
    whole = cpjax.sweep(rig, FIRMWARE, starts, **settings)
    pieces = cpjax.sweep(rig, FIRMWARE, starts, chunk=16, block=16, **settings)
    np.testing.assert_array_equal(whole.effort, pieces.effort)
    other = cpjax.sweep(rig, FIRMWARE, starts, **{**settings, "seed": 6})
    assert np.all(whole.effort != other.effort)
    first = cpjax.measure(rig, FIRMWARE, jax.tree.map(lambda column: column[0], starts), **settings)
    assert float(first.effort) == pytest.approx(float(whole.effort[0]), rel=1e-9)


def test_a_run_that_leaves_its_track_fails():
    rig = Rig(PLANT, track=Track(half_length=0.1))
    run = cpjax.rollout(rig, LAW, START, duration=4.0, dt=2e-3)
    assert not bool(run.metrics.success)
    assert float(np.max(np.abs(run.state.x))) <= 0.1
    assert int(run.metrics.flag) != 0


def test_the_noise_is_threefry_and_normal():
    key = (jnp.uint32(7), jnp.uint32(9))
    counter = (jnp.arange(1000, dtype=jnp.uint32), jnp.full(1000, 3, jnp.uint32))
    expected = threefry_2x32(jnp.stack(key), jnp.concatenate(counter)).reshape(2, -1)
    np.testing.assert_array_equal(jnp.stack(random_bits(key, counter)), expected)
    many = (jnp.arange(200_000, dtype=jnp.uint32), jnp.zeros(200_000, jnp.uint32))
    a, b = standard_normals(key, many, np.dtype(np.float64))
    for one in (a, b):
        assert abs(float(jnp.mean(one))) < 5.0 / math.sqrt(200_000)
        assert float(jnp.std(one)) == pytest.approx(1.0, abs=0.01)
        assert float(jnp.mean(one**4)) == pytest.approx(3.0, abs=0.1)
    assert abs(float(jnp.mean(a * b))) < 5.0 / math.sqrt(200_000)
    for one, other in zip(standard_normals(key, many, np.dtype(np.float32)), (a, b), strict=True):
        assert one.dtype == np.float32
        assert np.array_equal(one, other)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: Encoders(x_step=0.0, theta_step=1e-3), "x_step"),
        (lambda: Drive(delay=-1.0), "delay"),
        (lambda: Rig(PLANT, sensors=Drive()), "Rig.sensors"),
        (lambda: Track(half_length=0.0), "half_length"),
        (
            lambda: cpjax.measure(Rig(PLANT, drive=Drive(delay=0.0013)), LAW, START, **RUN),
            "Drive.delay",
        ),
        (
            lambda: cpjax.measure(Rig(PLANT, sensors=SENSORS), LAW, START, **RUN, clock="continuous"),
            "clock",
        ),
        (lambda: cpjax.measure(Rig(PLANT, sensors=SENSORS), LAW, START, **RUN), "controller"),
        (lambda: cpjax.measure(PLANT, LAW, START, **RUN, seed=-1), "seed"),
    ],
)
def test_what_no_rig_can_be_is_refused_by_name(call, field):
    with pytest.raises(InputError) as caught:
        call()
    assert field in caught.value.field


def test_a_lumped_motor_is_the_motor_with_its_lumps():
    motor = cpjax.Motor(torque_constant=0.03, back_emf_constant=0.02, resistance=2.0, wheel_radius=0.01, gear_ratio=3.0)
    lumped = cpjax.LumpedMotor(motor.force_per_voltage, motor.damping, motor.reflected_mass, motor.voltage_limit)
    for u, v in ((3.0, -0.4), (-11.0, 1.2)):
        assert float(lumped.force(u, v)) == pytest.approx(float(motor.force(u, v)), rel=1e-14)
        assert float(lumped.voltage_for_force(lumped.force(u, v), v)) == pytest.approx(u)
    plants = [dataclasses.replace(PLANT, motor=one) for one in (motor, lumped)]
    one, other = (np.asarray(cpjax.linearize(plant).A) for plant in plants)
    np.testing.assert_allclose(one, other, rtol=1e-12)


def test_published_gains_follow_from_the_public_rigs():
    # Control Tutorials for MATLAB and Simulink: Q = diag(5000, 0, 100, 0), R = 1.
    K = cpjax.lqr(*cpjax.linearize(cpjax.rig("ctms").plant), jnp.diag(jnp.array([5000.0, 0.0, 100.0, 0.0])), 1.0).K
    np.testing.assert_allclose(K[0], [-70.7107, -37.8345, 105.5298, 20.9238], atol=6e-5)
    # MathWorks File Exchange 97182: Q = diag(200, 0, 1000, 0), R = 0.035. Its printed numbers give it to 0.1 %.
    K = cpjax.lqr(
        *cpjax.linearize(cpjax.rig("fileexchange-97182").plant), jnp.diag(jnp.array([200.0, 0.0, 1000.0, 0.0])), 0.035
    ).K
    np.testing.assert_allclose(K[0], [-75.5929, -63.5585, 212.5131, 19.3977], rtol=2e-3)


@pytest.mark.parametrize("name", PRESETS)
def test_a_rig_by_name_comes_back_from_a_file(name, tmp_path):
    rig = cpjax.rig(name)
    for suffix in ("toml", "json"):
        cpjax.save(tmp_path / f"rig.{suffix}", rig)
        again = cpjax.load(tmp_path / f"rig.{suffix}")
        assert jax.tree.structure(again) == jax.tree.structure(rig)
        assert jax.tree.leaves(again) == jax.tree.leaves(rig)
    assert PRESETS[name].source


@pytest.mark.parametrize("period", [0.005, *(pytest.param(one, marks=pytest.mark.slow) for one in (0.001, 0.02))])
def test_an_observer_halves_the_filtered_derivatives_velocity_error(period):
    sensors = Encoders(x_step=2e-4, theta_step=2 * math.pi / 2000)
    observer = cpjax.kalman_observer(
        PLANT, period=period, x_deviation=2e-4 / 12**0.5, theta_deviation=2 * math.pi / 2000 / 12**0.5
    ).at_period(period)
    run = cpjax.rollout(PLANT, LAW, START, duration=3.0, dt=0.001, control_period=period)
    every = round(period / 0.001)
    states = np.asarray(run.state.vector())[::every]
    commands = np.asarray(run.voltage)[::every]
    zero = (jnp.uint32(0), jnp.uint32(0))

    @jax.jit
    def estimates(estimator):
        def step(carry, row):
            memory, before = carry
            state, command = row
            measured = sensors.measure(State.from_vector(state), zero, zero)
            memory, estimate = estimator.update(memory, measured, before)
            return (memory, command), estimate.vector() - state

        first = sensors.measure(State.from_vector(jnp.asarray(states[0])), zero, zero)
        carry = (estimator.init(first), jnp.zeros(()))
        return jax.lax.scan(step, carry, (jnp.asarray(states), jnp.asarray(commands)))[1]

    def errors(estimator):
        settled = np.asarray(estimates(estimator))[round(0.3 / period) :]
        return np.sqrt(np.mean(settled[:, [1, 3]] ** 2, axis=0))

    cutoffs = np.geomspace(10.0, 3.0 / period, 25)
    best = np.min([errors(FilteredDerivative(cutoff=c).at_period(period)) for c in cutoffs], axis=0)
    assert np.all(errors(observer) <= 0.5 * best)


def test_potentiometers_have_a_gap_and_sensors_of_the_state_the_stated_noise():
    gap = cpjax.Potentiometers(dead_angle=0.4, dead_centre=math.pi)
    key = (jnp.uint32(1), jnp.uint32(1))
    for theta, seen in ((3.0, math.pi - 0.2), (-3.2, -math.pi - 0.2), (2.0, 2.0), (math.pi + 0.3, math.pi + 0.3)):
        found = gap.measure(State(0.1, 0.0, theta, 0.0), key, (jnp.uint32(0), jnp.uint32(0)), noisy=False)
        assert float(found.theta) == pytest.approx(seen)
    noisy = cpjax.StateSensors(x_noise=0.1, x_dot_noise=0.2, theta_noise=0.3, theta_dot_noise=0.4)
    counters = (jnp.arange(20_000, dtype=jnp.uint32), jnp.zeros(20_000, jnp.uint32))
    found = jax.vmap(lambda *counter: noisy.measure(State(1.0, 2.0, 3.0, 4.0), key, counter).vector())(*counters)
    np.testing.assert_allclose(np.mean(found, axis=0), [1.0, 2.0, 3.0, 4.0], atol=0.02)
    np.testing.assert_allclose(np.cov(np.asarray(found).T), np.diag([0.01, 0.04, 0.09, 0.16]), atol=0.004)
