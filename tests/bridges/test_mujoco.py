import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import columns, rough_plant

from cpjax import CartPole, Motor, State
from cpjax.bridges.mujoco import LEAST_INERTIA, model_xml
from cpjax.errors import InputError
from cpjax.sim.integrators import rk4
from cpjax.sim.stepper import step_held

mujoco = pytest.importorskip("mujoco")

DT, PERIOD, DURATION = 1e-3, 20e-3, 3.0
HELD = round(PERIOD / DT)


def mujoco_run(plant, start, voltages):
    model = mujoco.MjModel.from_xml_string(model_xml(plant, DT))
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


# The inertia that a point bob gets there, in both.
POINT_BOB = CartPole(
    pole_inertia=LEAST_INERTIA,
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


def test_a_supply_without_a_limit_is_one_in_mujoco_too():
    plant = replace(ROD, motor=replace(ROD.motor, voltage_limit=math.inf))
    free = mujoco_run(plant, State(0.0, 0.0, 1.0, 0.0), [40.0, 40.0])
    clipped = mujoco_run(ROD, State(0.0, 0.0, 1.0, 0.0), [40.0, 40.0])
    assert free[-1, 0] > 1.5 * clipped[-1, 0] > 0.0


class OtherMotor(Motor):
    pass


@pytest.mark.parametrize(
    ("plant", "dt", "field"),
    [
        (replace(ROD, motor=OtherMotor()), DT, "plant.motor"),
        (ROD.motor, DT, "plant"),
        (ROD, 0.0, "dt"),
        (ROD, math.nan, "dt"),
    ],
)
def test_what_mujoco_cannot_be_told_is_refused(plant, dt, field):
    with pytest.raises(InputError, match=field):
        model_xml(plant, dt)
