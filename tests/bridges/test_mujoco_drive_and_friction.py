"""MuJoCo's own DC motor with inductance, and its dry friction while it slides, against cpjax's."""

import dataclasses
import math

import numpy as np
import pytest
from oracles import columns

import cpjax
from cpjax import CartPole, Motor, State, VoltageSignal
from cpjax.bridges.mujoco import model_xml

mujoco = pytest.importorskip("mujoco")

PERIOD, INSTANTS = 0.02, 40
VOLTAGES = 9.0 * np.sin(1.0 + np.arange(float(INSTANTS)) ** 2)
MOTOR = Motor(0.05, 0.05, 0.8, rotor_inertia=1e-5, viscous_friction=1e-5, wheel_radius=0.02, gear_ratio=2.0)
PLANT = CartPole(0.6, 0.2, 0.3, pole_inertia=0.006, cart_friction=0.3, pivot_friction=0.001, motor=MOTOR)
START = State(0.0, 0.0, 2.5, 0.3)


def in_mujoco(xml, start, voltages, dt):
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (start.x, start.theta), (start.x_dot, start.theta_dot)
    states = [columns(start)]
    for voltage in voltages:
        data.ctrl[0] = voltage
        for _ in range(round(PERIOD / dt)):
            mujoco.mj_step(model, data)
        states.append(np.array([data.qpos[0], data.qvel[0], data.qpos[1], data.qvel[1]]))
    return np.array(states)


def ours(plant, start, voltages, dt):
    signal = VoltageSignal(np.arange(len(voltages)) * PERIOD, np.asarray(voltages))
    settings = {"duration": len(voltages) * PERIOD, "dt": dt, "control_period": PERIOD}
    run = cpjax.rollout(plant, signal, start, save_every=round(PERIOD / dt), **settings)
    assert int(run.flag) == 0
    return columns(run.state)


def with_inductance(dt):
    """The plant with MuJoCo's `dcmotor` in the place of the bridge's motor and its damping by back-EMF."""
    motor = MOTOR
    turns = motor.gear_ratio / motor.wheel_radius
    damping = PLANT.cart_friction + turns**2 * motor.viscous_friction
    xml = model_xml(PLANT, dt)
    begin, end = xml.index("<motor "), xml.index("/>", xml.index("<motor ")) + 2
    constant = f"{motor.torque_constant} {motor.back_emf_constant}"
    electrical = f'resistance="{motor.resistance}" motorconst="{constant}" inductance="4e-3 0"'
    dc = f'<dcmotor joint="x" gear="{turns}" {electrical}/>'
    xml = xml[:begin] + dc + xml[end:]
    whole = f'damping="{PLANT.cart_friction + motor.damping}"'
    assert whole in xml
    return xml.replace(whole, f'damping="{damping}"')


def extrapolated(coarse, middle, fine, order):
    """The limit of results at steps that halve, whose errors have this order and the next."""
    first = [b + (b - a) / (2**order - 1) for a, b in ((coarse, middle), (middle, fine))]
    return first[1] + (first[1] - first[0]) / (2 ** (order + 1) - 1)


def test_the_motor_with_inductance_is_mujocos_dcmotor():
    # MuJoCo holds the current during a step, so that its error is of first order; ours is of second order. Both are
    # extrapolated to a step of zero.
    plant = dataclasses.replace(PLANT, motor=dataclasses.replace(MOTOR, inductance=4e-3))
    theirs = [in_mujoco(with_inductance(dt), START, VOLTAGES, dt) for dt in (1e-4, 5e-5, 2.5e-5)]
    found = [ours(plant, START, VOLTAGES, dt) for dt in (1e-3, 5e-4, 2.5e-4)]
    limit = extrapolated(*theirs, order=1)
    np.testing.assert_allclose(extrapolated(*found, order=2), limit, rtol=0, atol=1e-6)
    errors = [[np.max(np.abs(run - limit)) for run in runs] for runs in (found, theirs)]
    for (_, middle, fine), order in zip(errors, (2, 1), strict=True):
        assert math.log2(middle / fine) == pytest.approx(order, abs=0.1)
    assert errors[0][0] < 1e-3 < 0.1 < np.max(np.abs(ours(PLANT, START, VOLTAGES, 1e-3) - limit))  # it matters


def test_dry_friction_that_slides_is_mujocos_frictionloss():
    plant = dataclasses.replace(PLANT, coulomb_friction=0.8)
    start = dataclasses.replace(START, x_dot=1.2)
    voltages = 6.0 + VOLTAGES / 9.0
    xml = model_xml(PLANT, 1e-3).replace('name="x" type="slide"', 'name="x" type="slide" frictionloss="0.8"')
    expected = in_mujoco(xml, start, voltages, 1e-3)
    assert np.min(expected[:, 1]) > 0.05  # it slides all the time
    np.testing.assert_allclose(ours(plant, start, voltages, 1e-3), expected, rtol=0, atol=1e-10)


def test_a_cart_that_friction_holds_creeps_in_mujoco_only():
    plant = dataclasses.replace(PLANT, coulomb_friction=0.8)
    xml = model_xml(PLANT, 1e-3).replace('name="x" type="slide"', 'name="x" type="slide" frictionloss="0.8"')
    start, voltages = dataclasses.replace(START, theta=math.pi, theta_dot=0.0), np.full(INSTANTS, 0.1)
    assert np.max(np.abs(ours(plant, start, voltages, 1e-3)[:, 0])) == 0.0
    assert 1e-9 < in_mujoco(xml, start, voltages, 1e-3)[-1, 0] < 1e-2
