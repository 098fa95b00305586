"""Integral action and moving references: closed forms of the offset, catches, and steps without a fall."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cpjax
from cpjax import Disturbance, InputError, IntegralAction, MovingReference, ProtocolMetrics, Rig, State, VoltageSignal

PLANT = cpjax.CartPole()
LAW = cpjax.paper.controller("corrected-centred", "lqr", PLANT)
TILT = math.radians(2.0)
Q, R = np.diag([200.0, 10.0, 100.0, 10.0]), 0.1
HYBRID = dataclasses.replace(LAW, regulator=cpjax.StateFeedback(cpjax.lqr(*cpjax.linearize(PLANT), Q, R).K))
WITH = IntegralAction.designed(HYBRID, PLANT, Q, R, integral_weight=30.0)
UPRIGHT = State(0.0, 0.0, 0.05, 0.0)


def test_integral_action_takes_the_offset_of_a_tilted_rail_away():
    rig = Rig(PLANT, disturbance=Disturbance(tilt=TILT))
    settings = {"duration": 20.0, "dt": 2e-3, "save_every": 10_000}
    without, with_it = (cpjax.rollout(rig, c, UPRIGHT, **settings).state for c in (HYBRID, WITH))
    # At rest the pole is vertical, and the motor carries the weight along the rail.
    weight = (PLANT.cart_mass + PLANT.pole_mass) * PLANT.gravity * math.sin(TILT)
    K = np.asarray(HYBRID.regulator.K)[0]
    offset = (weight / PLANT.motor.force_per_voltage - K[2] * TILT) / K[0]
    assert abs(offset) > 0.01
    assert float(without.x[-1]) == pytest.approx(offset, abs=1e-6)
    assert abs(float(with_it.x[-1])) < 1e-3
    assert float(with_it.theta[-1]) == pytest.approx(TILT, abs=1e-4)


def test_integral_action_takes_no_catch_away():
    starts = cpjax.sample_starts("hanging", 512, seed=11)
    settings = {"duration": 15.0, "dt": 2e-3}
    none = dataclasses.replace(WITH, gain=0.0)
    without, with_it = (cpjax.sweep(PLANT, c, starts, **settings) for c in (none, WITH))
    assert np.mean(without.success) > 0.98
    assert np.mean(with_it.success) >= np.mean(without.success) - 0.002
    both = np.asarray(without.success & with_it.success)
    assert np.mean(with_it.settling_time[both]) < 1.02 * np.mean(without.settling_time[both])


def test_the_integral_grows_only_while_it_may():
    controller = dataclasses.replace(WITH, voltage_limit=5.0).at_period(0.01)
    caught, away = State(0.3, 0.0, 0.01, 0.0), State(0.3, 0.0, 3.1, 0.0)
    memory = controller.init(away)
    memory, _ = controller.update(memory._replace(integral=jnp.asarray(7.0)), away)
    assert float(memory.integral) == 0.0  # it swings up
    memory, _ = controller.update(memory, State(0.01, 0.0, 0.0, 0.0))
    assert float(memory.integral) == pytest.approx(1e-4)
    before = float(memory.integral)
    memory, command = controller.update(memory, caught)
    assert abs(float(command)) > 5.0
    grown = float(memory.integral) != before
    assert grown == (-float(WITH.gain) * 0.3 * np.sign(float(command)) <= 0.0)


def test_a_reference_of_zero_changes_nothing_and_a_file_is_its_steps(tmp_path):
    start, settings = State(0.0, 0.0, 2.9, 0.0), {"duration": 3.0, "dt": 2e-3, "save_every": 100}
    plain = cpjax.rollout(PLANT, HYBRID, start, **settings)
    still = cpjax.rollout(PLANT, MovingReference.steps(HYBRID, [0.0], [0.0]), start, **settings)
    np.testing.assert_array_equal(plain.state.vector(), still.state.vector())
    (tmp_path / "x.csv").write_text("time,x\n0.5,0.1\n1.0,-0.1\n1.5,0.1\n")
    read = MovingReference.from_file(HYBRID, tmp_path / "x.csv")
    wave = MovingReference.square_wave(HYBRID, amplitude=0.1, period=1.0, duration=1.5, begin=0.5)
    np.testing.assert_allclose(read.signal.times, wave.signal.times)
    np.testing.assert_allclose(read.signal.voltages, wave.signal.voltages)


def test_the_cart_follows_steps_without_a_fall():
    starts = cpjax.sample_starts("hanging", 512, seed=12)
    upright = dataclasses.replace(starts, theta=starts.theta - math.pi)
    reference = MovingReference.steps(HYBRID, [0.0, 3.0, 6.0], [0.2, 0.0, -0.2])
    run = cpjax.sweep(
        PLANT, reference, upright, duration=9.0, dt=2e-3, metrics=ProtocolMetrics(reference_x=-0.2), save_every=500
    )
    assert np.all(run.metrics.success)
    assert np.max(np.abs(np.asarray(run.state.theta))) < 0.6
    np.testing.assert_allclose(np.asarray(run.state.x)[:, [3, 6, 9]], [[0.2, 0.0, -0.2]] * 512, atol=0.05)


def test_derivatives_through_integral_and_reference_are_those_of_differences():
    def end(p):
        inner = dataclasses.replace(WITH, gain=p[0], controller=HYBRID.regulator)
        reference = MovingReference(inner, VoltageSignal(np.array([0.0, 0.3]), jnp.stack([p[1], -p[1]])))
        return cpjax.rollout(PLANT, reference, UPRIGHT, duration=0.6, dt=2e-3, save_every=300).state.x[-1]

    p = jnp.array([float(WITH.gain), 0.05])
    gradient, value = jax.jit(jax.grad(end))(p), jax.jit(end)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(p), gradient, rtol=1e-10)
    for i in range(2):
        step = jnp.zeros(2).at[i].set(1e-3 * p[i])
        found = (value(p - 2 * step) - 8 * value(p - step) + 8 * value(p + step) - value(p + 2 * step)) / 12e-3
        assert float(gradient[i] * p[i]) == pytest.approx(float(found), rel=1e-7)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: IntegralAction(HYBRID, math.nan), "gain"),
        (lambda: IntegralAction.designed(HYBRID, PLANT, Q, R, integral_weight=0.0), "integral_weight"),
        (lambda: IntegralAction.designed(HYBRID.regulator, PLANT, Q, R, integral_weight=1.0), "controller"),
        (lambda: MovingReference.steps(HYBRID, [1.0, 0.5], [0.0, 1.0]), "times"),
        (lambda: MovingReference.steps(HYBRID, ["a"], [0.0]), "times"),
        (lambda: MovingReference.square_wave(HYBRID, amplitude=0.1, period=1e-12, duration=1e6), "duration"),
        (lambda: MovingReference.square_wave(HYBRID, amplitude=0.1, period=0.0, duration=1.0), "period"),
        (lambda: MovingReference.from_file(HYBRID, "nothing.csv"), "path"),
    ],
)
def test_what_no_reference_can_be_is_refused_by_name(call, field):
    with pytest.raises(InputError) as caught:
        call()
    assert field in caught.value.field


def test_a_file_without_a_column_is_refused_by_its_line(tmp_path):
    (tmp_path / "x.csv").write_text("time,y\n0.5,0.1\n")
    with pytest.raises(InputError, match="line 2: x"):
        MovingReference.from_file(HYBRID, tmp_path / "x.csv")
