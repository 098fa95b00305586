import math

import jax
import numpy as np
import pytest
from oracles import random_problem, wheel_force

from cpjax import Motor


def test_the_wheels_push_with_the_torque_of_the_rotor():
    plants, states, voltages = random_problem(17)
    expected = wheel_force(plants, states.x_dot, voltages)
    scale = wheel_force(plants, 0.0, np.abs(voltages)) - wheel_force(plants, np.abs(states.x_dot), 0.0)
    got = jax.vmap(Motor.force)(plants.motor, voltages, states.x_dot)
    assert np.max(np.abs(got - expected) / scale) <= 1e-15


def test_the_current_obeys_kirchhoff():
    plants, states, voltages = random_problem(20)
    motor = plants.motor
    rotor_speed = motor.gear_ratio * states.x_dot / motor.wheel_radius
    current = jax.vmap(Motor.current)(motor, voltages, states.x_dot)
    loop = motor.resistance * current + motor.back_emf_constant * rotor_speed - voltages
    assert np.max(np.abs(loop / (np.abs(voltages) + np.abs(motor.back_emf_constant * rotor_speed)))) <= 1e-15
    torque = motor.torque_constant * current - motor.viscous_friction * rotor_speed
    force = jax.vmap(Motor.force)(motor, voltages, states.x_dot)
    np.testing.assert_allclose(force, motor.gear_ratio * torque / motor.wheel_radius, rtol=1e-12, atol=1e-13)


def test_the_voltage_for_a_force_yields_that_force():
    plants, states, voltages = random_problem(23)
    forces = jax.vmap(Motor.force)(plants.motor, voltages, states.x_dot)
    back = jax.vmap(Motor.voltage_for_force)(plants.motor, forces, states.x_dot)
    np.testing.assert_allclose(back, voltages, rtol=0, atol=1e-12)
    again = jax.vmap(Motor.force)(plants.motor, back, states.x_dot)
    np.testing.assert_allclose(again, forces, rtol=0, atol=1e-12)


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
@pytest.mark.parametrize(
    ("voltage", "applied", "by_voltage", "by_limit"),
    [
        (3.0, 3.0, 1.0, 0.0),
        (-11.9, -11.9, 1.0, 0.0),
        (12.5, 12.0, 0.0, 1.0),
        (-300.0, -12.0, 0.0, -1.0),
        (12.0, 12.0, 0.5, 0.5),
        (-12.0, -12.0, 0.5, -0.5),
    ],
)
def test_the_supply_clips_the_voltage_and_its_derivative(derivative, voltage, applied, by_voltage, by_limit):
    def clipped(voltage, limit):
        return Motor(voltage_limit=limit).saturate(voltage)

    assert float(clipped(voltage, 12.0)) == applied
    assert [float(d) for d in derivative(clipped, argnums=(0, 1))(voltage, 12.0)] == [by_voltage, by_limit]


def test_without_a_limit_nothing_is_clipped():
    motor = Motor(voltage_limit=math.inf)
    assert float(motor.saturate(1e9)) == 1e9
    assert float(jax.grad(motor.saturate)(1e9)) == 1.0
