import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import columns, rough_plant

from cpjax import CartPole, Motor, State
from cpjax.sim.integrators import rk4
from cpjax.sim.stepper import step_held

mujoco = pytest.importorskip("mujoco")

DT, PERIOD, DURATION = 1e-3, 20e-3, 3.0
HELD = round(PERIOD / DT)

# Positive theta leans towards negative x: a turn about -y. The wheels' force is an actuator on the cart's slide, what
# the back-EMF and the bearings take is damping of that slide, and the rotor is its armature.
MODEL = """
<mujoco>
  <option timestep="{dt}" integrator="RK4" gravity="0 0 -{gravity}"/>
  <compiler angle="radian" boundmass="0" boundinertia="0"/>
  <worldbody>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" damping="{slide_damping}" armature="{armature}"/>
      <inertial pos="0 0 0" mass="{cart_mass}" diaginertia="1 1 1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 -1 0" damping="{pivot_friction}"/>
        <inertial pos="0 0 {pole_length}" mass="{pole_mass}" diaginertia="{inertia} {inertia} {inertia}"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="slide" gear="{gear}" ctrllimited="true" ctrlrange="-{limit} {limit}"/>
  </actuator>
</mujoco>
"""


def mujoco_run(plant, start, voltages):
    motor = plant.motor
    turns = motor.gear_ratio / motor.wheel_radius  # rotor radians per metre
    model = mujoco.MjModel.from_xml_string(
        MODEL.format(
            dt=DT,
            gravity=plant.gravity,
            cart_mass=plant.cart_mass,
            pole_mass=plant.pole_mass,
            pole_length=plant.pole_length,
            inertia=plant.pole_inertia,
            pivot_friction=plant.pivot_friction,
            armature=motor.rotor_inertia * turns**2,
            slide_damping=plant.cart_friction
            + turns**2 * (motor.viscous_friction + motor.torque_constant * motor.back_emf_constant / motor.resistance),
            gear=turns * motor.torque_constant / motor.resistance,
            limit=motor.voltage_limit,
        )
    )
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (start.x, start.theta), (start.x_dot, start.theta_dot)
    states = [columns(start)]
    for voltage in voltages:
        data.ctrl[0] = voltage
        for _ in range(HELD):
            mujoco.mj_step(model, data)
        states.append(np.array([data.qpos[0], data.qvel[0], data.qpos[1], data.qvel[1]]))
    return np.array(states)


@jax.jit
def our_run(plant, start, voltages):
    def hold(state, voltage):
        applied = plant.motor.saturate(voltage)
        state = jax.lax.fori_loop(0, HELD, lambda _, s: step_held(plant, rk4, s, applied, DT), state)
        return state, state

    _, states = jax.lax.scan(hold, start, voltages)
    return states


# A point bob has no inertia of its own; MuJoCo asks for some. This much shifts the motion by less than 1e-7.
NEARLY_NONE = 1e-9
POINT_BOB = CartPole(
    pole_inertia=NEARLY_NONE,
    cart_friction=0.15,
    pivot_friction=0.004,
    motor=Motor(rotor_inertia=0.05, viscous_friction=0.01, wheel_radius=0.7, gear_ratio=1.3, voltage_limit=12.0),
)
ROD = CartPole.rod(
    mass=0.4, length=1.1, cart_mass=0.8, cart_friction=0.15, pivot_friction=0.004, motor=rough_plant().motor
)


def random_voltages():
    # Beyond the supply at times, so that both sides must clip.
    return np.random.default_rng(3).uniform(-15.0, 15.0, round(DURATION / PERIOD))


def sampled_sine():
    return 10.0 * np.sin(2.0 * math.pi * 1.1 * PERIOD * np.arange(round(DURATION / PERIOD)))


@pytest.mark.parametrize("voltages", [random_voltages(), sampled_sine()], ids=["random", "sine"])
@pytest.mark.parametrize(
    "start", [State(0.0, 0.0, math.pi - 0.3, 0.0), State(0.1, -0.4, 0.2, 1.0)], ids=["hanging", "falling"]
)
@pytest.mark.parametrize("plant", [POINT_BOB, ROD, rough_plant()], ids=["point-bob", "rod", "rough"])
def test_mujoco_moves_the_same_plant_the_same_way(plant, start, voltages):
    expected = mujoco_run(plant, start, voltages)
    ours = columns(our_run(plant, jax.tree.map(jnp.asarray, start), jnp.asarray(voltages)))
    assert np.ptp(expected[:, 0]) > 0.2  # the motor mattered
    assert np.ptp(expected[:, 2]) > 0.5  # and the pole moved
    # Method and step are MuJoCo's too, so that next to nothing but the equations of motion can tell the two apart.
    assert np.max(np.abs(ours - expected[1:])) <= 1e-9


def test_the_tiny_inertia_stands_for_a_point_bob():
    voltages = jnp.asarray(random_voltages())
    start = jax.tree.map(jnp.asarray, State(0.0, 0.0, math.pi - 0.3, 0.0))
    with_inertia = columns(our_run(POINT_BOB, start, voltages))
    without = columns(our_run(replace(POINT_BOB, pole_inertia=0.0), start, voltages))
    assert np.max(np.abs(with_inertia - without)) <= 1e-7
