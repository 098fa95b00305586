"""Cart-poles from MJCF and URDF files: their motion against MuJoCo's, what is refused, and files written for MuJoCo."""

import math
import sys

import jax
import numpy as np
import pytest
from oracles import columns

import cpjax
from cpjax import InputError, State
from cpjax.bridges.models import load_model
from cpjax.bridges.mujoco import save_mjcf

mujoco = pytest.importorskip("mujoco")

# y is up, the slide's positive direction is -z, its motor pushes the other way, both joints start off zero, the pole
# starts at an angle and consists of two bodies, and so does the cart.
SKEWED = """
<mujoco>
  <option gravity="0 -9.7 0"/>
  <default><default class="light"><geom density="700"/></default></default>
  <worldbody>
    <geom type="plane" size="1 1 .1" pos="0 -3 0" zaxis="0 1 0"/>
    <body name="carriage" pos="0.3 0 0.2" euler="0 0 90">
      <joint name="rail" type="slide" axis="0 0 -2" range="-0.9 1.5" damping="0.3" armature="0.15" ref="0.1"/>
      <inertial pos="0 0.1 0" mass="0.8" diaginertia="0.01 0.02 0.015"/>
      <body name="lid" pos="0 0.1 0"><geom type="box" size="0.1 0.05 0.1" mass="0.25"/></body>
      <body name="rod" pos="0.1 0 0" euler="0 25 0" childclass="light">
        <joint name="pivot" type="hinge" axis="0 1 0" pos="0 0 0.02" damping="0.02" armature="0.003" ref="10"/>
        <geom type="cylinder" fromto="0 0 0 0.5 0 0" size="0.015"/>
        <geom type="sphere" pos="0.55 0.03 0.01" size="0.04"/>
        <body name="tip" pos="0.6 0 0" euler="10 20 30"><geom type="box" size="0.02 0.03 0.05"/></body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="rail" gear="-4" ctrllimited="true" ctrlrange="-2 2"/></actuator>
</mujoco>
"""

# The numbers of dm_control's suite/cartpole.xml and of Gymnasium's inverted_pendulum.xml.
DM_CONTROL = """
<mujoco>
  <worldbody>
    <body name="cart" pos="0 0 1">
      <joint name="slider" type="slide" axis="1 0 0" limited="true" range="-1.8 1.8" damping="0.0005"/>
      <geom type="box" size="0.2 0.15 0.1" mass="1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="0.000002"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size="0.045" mass="0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slider" gear="10" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
GYMNASIUM = """
<mujoco>
  <worldbody>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" limited="true" range="-1 1" damping="1"/>
      <geom type="capsule" size="0.1 0.1" quat="0.707 0 0.707 0"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0" limited="true" range="-90 90" damping="1"/>
        <geom type="capsule" fromto="0 0 0 0.001 0 0.6" size="0.049"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slider" gear="100" ctrllimited="true" ctrlrange="-3 3"/></actuator>
</mujoco>
"""

# Hangs at zero; slides along -y; a weight is fixed to the pole.
HANGING_ROBOT = """
<robot name="crane">
  <link name="base"><visual><geometry><box size="4 .1 .1"/></geometry></visual></link>
  <link name="trolley">
    <inertial>
      <origin xyz="0.1 0 0"/><mass value="1.3"/>
      <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.04"/>
    </inertial>
  </link>
  <link name="arm">
    <inertial>
      <origin xyz="0 0.02 -0.4" rpy="0.2 -0.4 1.1"/><mass value="0.4"/>
      <inertia ixx="0.012" ixy="0.001" ixz="-0.0005" iyy="0.011" iyz="0.0003" izz="0.003"/>
    </inertial>
    <visual><origin xyz="0 0 -0.4"/><geometry><cylinder radius="0.03" length="0.8"/></geometry></visual>
  </link>
  <link name="flange"/>
  <link name="weight">
    <inertial>
      <mass value="0.2"/><inertia ixx="0.0004" ixy="0" ixz="0" iyy="0.0005" iyz="0" izz="0.0006"/>
    </inertial>
    <collision><geometry><sphere radius="0.05"/></geometry></collision>
  </link>
  <joint name="rail" type="prismatic">
    <parent link="base"/><child link="trolley"/><origin xyz="0 0 1.2" rpy="0 0 -1.5707963267948966"/><axis xyz="3 0 0"/>
    <limit lower="-2" upper="2" effort="15" velocity="5"/><dynamics damping="0.4"/>
  </joint>
  <joint name="pivot" type="continuous">
    <parent link="trolley"/><child link="arm"/><origin xyz="0.1 0.05 0"/><axis xyz="0 -1 0"/><dynamics damping="0.01"/>
  </joint>
  <joint name="bolt" type="fixed"><parent link="arm"/><child link="flange"/><origin xyz="0 0 -0.5"/></joint>
  <joint name="screw" type="fixed">
    <parent link="flange"/><child link="weight"/><origin xyz="0 0.1 0" rpy="1 0 0"/>
  </joint>
</robot>
"""

DT, HELD, SAMPLES = 0.005, 4, 125  # 2.5 s


def written(folder, text, name="model.xml"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def moved_by_mujoco(text, found, start, commands):
    """States (samples + 1, 4) of MuJoCo's Runge-Kutta method, without contacts and limits of joints."""
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, DT
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = found.joints(start)
    states = [columns(start)]
    for command in commands:
        applied = data.ctrl if model.nu else data.qfrc_applied
        applied[0] = command
        for _ in range(HELD):
            mujoco.mj_step(model, data)
        states.append(columns(found.state(tuple(data.qpos), tuple(data.qvel))))
    return np.array(states)


@pytest.mark.parametrize(
    ("text", "start", "size", "share"),
    [
        (SKEWED, State(0.1, 0.0, 0.4, -0.3), 2.4, 0.7),  # share: how much of the commands' range is used at least
        (DM_CONTROL, State(0.1, 0.0, math.pi - 0.2, 0.5), 1.0, 0.7),
        (GYMNASIUM, State(0.0, 0.1, 0.2, 0.0), 0.3, 0.05),
        (HANGING_ROBOT, State(0.0, 0.0, math.pi - 0.5, 0.1), 15.0, 0.7),
    ],
    ids=["skewed", "dm_control", "gymnasium", "urdf"],
)
def test_an_imported_model_moves_as_in_mujoco(tmp_path, text, start, size, share):
    found = load_model(written(tmp_path, text))
    times = HELD * DT * np.arange(SAMPLES)
    commands = size * np.random.default_rng(5).uniform(-1.0, 1.0, SAMPLES)
    assert np.max(np.abs(commands)) > share * found.rig.plant.motor.voltage_limit
    run = cpjax.rollout(
        found.rig,
        cpjax.VoltageSignal(times, commands),
        start,
        duration=HELD * DT * SAMPLES,
        dt=DT,
        control_period=HELD * DT,
    )
    expected = moved_by_mujoco(text, found, start, commands)
    ours = columns(run.state)[::HELD]
    assert int(run.flag) == 0
    assert np.ptp(expected[:, 0]) > 0.01
    assert np.ptp(expected[:, 2]) > 0.2
    assert np.max(np.abs(ours - expected)) <= 1e-8


@pytest.mark.parametrize(("name", "text"), [("dm-control", DM_CONTROL), ("gymnasium", GYMNASIUM)])
def test_a_preset_has_the_numbers_that_mujoco_compiles(tmp_path, name, text):
    found, preset = load_model(written(tmp_path, text)), cpjax.rig(name)
    assert jax.tree.structure(found.rig) == jax.tree.structure(preset)
    np.testing.assert_allclose(jax.tree.leaves(found.rig.plant), jax.tree.leaves(preset.plant), rtol=1e-10)
    assert found.rig.track.half_length == preset.track.half_length


def test_the_files_zeros_and_signs_are_told(tmp_path):
    gym = load_model(written(tmp_path, GYMNASIUM))
    assert (gym.x_sign, gym.theta_sign, gym.x_origin) == (1.0, -1.0, 0.0)
    assert gym.upright == pytest.approx(-math.atan(0.001 / 0.6), rel=1e-9)  # there 0 leans towards positive x
    assert gym.left_out == ("range of joint hinge: -1.5708 to 1.5708 rad",)
    crane = load_model(written(tmp_path, HANGING_ROBOT, "crane.urdf"))
    hanging = crane.state((0.0, 0.0), (0.2, 0.3))
    assert hanging.x_dot == 0.2
    assert abs(hanging.theta) > 3.0
    assert repr(crane.rig.plant.motor) == repr(cpjax.ForceActuator(15.0))
    skewed = load_model(written(tmp_path, SKEWED))
    assert (skewed.x_sign, skewed.x_origin, skewed.rig.track.half_length) == (
        -1.0,
        pytest.approx(0.3),
        pytest.approx(1.2),
    )
    drive = cpjax.LumpedMotor(4.0, reflected_mass=0.15, voltage_limit=2.0)
    assert repr(skewed.rig.plant.motor) == repr(drive)
    for found in (gym, crane, skewed):
        state = State(0.1, -0.2, 0.3, 0.4)
        again = found.state(*found.joints(state))
        np.testing.assert_allclose(columns(again), columns(state), atol=1e-15)


def edited(text, old, new):
    assert text.count(old) >= 1, old
    return text.replace(old, new, 1)


MJCF_EDITS = {
    "another joint": ('<geom type="capsule"', '<joint type="ball"/><geom type="capsule"', "joints"),
    "no hinge": ('type="hinge"', 'type="slide"', "joints"),
    "hinge first": ('type="slide" axis="1 0 0" limited="true" range="-1.8 1.8"', 'type="hinge" axis="0 1 0"', "joints"),
    "spring": ('damping="0.000002"', 'stiffness="0.1"', "joint stiffness"),
    "oblique slide": ('axis="1 0 0"', 'axis="1 0 0.01"', "axis of joint slider"),
    "oblique hinge": ('axis="0 1 0"', 'axis="0.01 1 0"', "axis of joint hinge"),
    "upright hinge": ('axis="0 1 0"', 'axis="0 0 1"', "axis of joint hinge"),
    "no gravity": ("<worldbody>", '<option gravity="0 0 0"/><worldbody>', "gravity"),
    "gravity off": ("<worldbody>", '<option><flag gravity="disable"/></option><worldbody>', "flag gravity"),
    "water": ("<worldbody>", '<option density="1000"/><worldbody>', "option density"),
    "centred pole": ('fromto="0 0 0 0 0 1"', 'fromto="0 0 -1 0 0 1"', "centre of mass of the pole"),
    "wide inertia": (
        "</body>\n    </body>",
        '<inertial pos="0 0 .5" mass="1" diaginertia="1000 1000 1"/></body>\n    </body>',
        "inertia of the pole",
    ),
    "servo": ("<motor", "<position", "actuator"),
    "motor at the pivot": ('joint="slider"', 'joint="hinge"', "actuator"),
    "one-sided motor": ('ctrlrange="-1 1"', 'ctrlrange="-1 2"', "ctrlrange"),
    "tendon": (
        "<actuator>",
        '<tendon><fixed><joint joint="slider" coef="1"/></fixed></tendon><actuator>',
        "tendon",
    ),
    "unknown element": ("<worldbody>", "<nothing/><worldbody>", "path"),
    "missing include": ("<worldbody>", '<include file="nowhere.xml"/><worldbody>', "path"),
    "broken": ("</mujoco>", "", "path"),
    "another root": ("<mujoco>\n", "<sdf/><!--", "path"),
}
URDF_EDITS = {
    "another joint": ('type="fixed"', 'type="floating"', "joints"),
    "no slide": ('type="prismatic"', 'type="fixed"', "joints"),
    "mimic": ('<axis xyz="0 -1 0"/>', '<mimic joint="rail"/>', "mimic"),
    "oblique": ('<axis xyz="0 -1 0"/>', '<axis xyz="0 -1 0.1"/>', "axis of joint pivot"),
    "no axis": ('<axis xyz="0 -1 0"/>', '<axis xyz="0 0 0"/>', "pivot: axis"),
    "no number": ('mass value="0.4"', 'mass value="heavy"', "link arm: inertial: value"),
    "nan": ('mass value="0.4"', 'mass value="nan"', "link arm: inertial: value"),
    "negative mass": ('mass value="0.4"', 'mass value="-0.4"', "link arm: mass"),
    "massless cart": ('mass value="1.3"', 'mass value="0"', "link trolley: principal inertias"),
    "negative inertia": ('ixx="0.012"', 'ixx="-0.012"', "link arm: principal inertias"),
    "zero inertia": (
        'ixx="0.0004" ixy="0" ixz="0" iyy="0.0005" iyz="0" izz="0.0006"',
        'ixx="0" iyy="0" izz="0"',
        "link weight: principal",
    ),
    "triangle": ('izz="0.003"', 'izz="0.2"', "link arm: principal inertias"),
    "identity inertia": ('ixx="0.012" ixy="0.001" ixz="-0.0005" iyy="0.011"', 'ixx="1" iyy="1"', "inertia of the pole"),
    "wide inertia": (
        'ixx="0.0004" ixy="0" ixz="0" iyy="0.0005" iyz="0" izz="0.0006"',
        'ixx="1" iyy="1" izz="1"',
        "inertia of the pole",
    ),
    "missing inertia": ('<mass value="0.2"/>', "", "link weight: inertial"),
    "friction": ('<dynamics damping="0.01"/>', '<dynamics friction="-0.01"/>', "friction"),
    "no force": ('effort="15"', 'effort="0"', "effort"),
    "empty range": ('lower="-2"', 'lower="2"', "range of joint rail"),
    "unknown link": ('<child link="arm"/>', '<child link="leg"/>', "parent and child"),
    "loop": ('<parent link="flange"/>', '<parent link="weight"/>', "links"),
}
EDITS = [pytest.param(DM_CONTROL, *edit, id=f"mjcf: {name}") for name, edit in MJCF_EDITS.items()] + [
    pytest.param(HANGING_ROBOT, *edit, id=f"urdf: {name}") for name, edit in URDF_EDITS.items()
]


@pytest.mark.parametrize(("text", "old", "new", "field"), EDITS)
def test_what_no_cart_pole_is_is_refused_by_name(tmp_path, monkeypatch, text, old, new, field):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        load_model(written(tmp_path, edited(text, old, new)))
    assert field in caught.value.field
    assert [path.name for path in tmp_path.iterdir()] == ["model.xml"]  # no log of MuJoCo


def test_an_inertia_that_a_drawn_pole_cannot_have_is_refused(tmp_path):
    text = HANGING_ROBOT
    for moment in ("0.0004", "0.0005", "0.0006"):
        text = edited(text, f'"{moment}"', '"0.2"')
    with pytest.raises(InputError, match="inertia of the pole"):
        load_model(written(tmp_path, text))
    load_model(written(tmp_path, edited(text, 'radius="0.05"', 'radius="0.6"')))
    load_model(written(tmp_path, edited(text, '<sphere radius="0.05"/>', '<mesh filename="weight.stl"/>')))


@pytest.mark.parametrize("text", [DM_CONTROL, HANGING_ROBOT], ids=["mjcf", "urdf"])
def test_entities_are_not_expanded(tmp_path, text):
    bomb = '<!DOCTYPE m [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>\n' + text.lstrip()
    with pytest.raises(InputError, match="DOCTYPE"):
        load_model(written(tmp_path, bomb))


def test_mujoco_is_named_where_it_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    load_model(written(tmp_path, HANGING_ROBOT))  # needs no other package
    with pytest.raises(InputError, match=r"^mujoco = 'not installed'.*pip install"):
        load_model(written(tmp_path, DM_CONTROL))
    with pytest.raises(InputError, match="nowhere"):
        load_model(tmp_path / "nowhere.xml")


def test_dry_friction_is_taken_over(tmp_path):
    text = edited(DM_CONTROL, 'damping="0.0005"', 'damping="0.0005" frictionloss="0.2"')
    plant = load_model(written(tmp_path, text)).rig.plant
    assert (plant.coulomb_friction, plant.pivot_coulomb_friction) == (0.2, None)
    text = edited(HANGING_ROBOT, '<dynamics damping="0.01"/>', '<dynamics friction="0.01"/>')
    plant = load_model(written(tmp_path, text)).rig.plant
    assert (plant.coulomb_friction, plant.pivot_coulomb_friction) == (None, 0.01)


@pytest.mark.parametrize("name", ["quanser-ip02-long", "sensorsini", "dm-control", "fileexchange-97182"])
def test_a_rig_written_for_mujoco_comes_back_with_the_same_motion(tmp_path, name):
    rig = cpjax.rig(name)
    save_mjcf(tmp_path / "rig.xml", rig)
    found = load_model(tmp_path / "rig.xml")
    assert (found.x_sign, found.x_origin, found.theta_sign, found.upright) == (1.0, 0.0, 1.0, 0.0)
    assert (found.rig.track is None) == (rig.track is None)
    assert jax.tree.leaves(found.rig.track) == jax.tree.leaves(rig.track)
    assert found.rig.plant.motor.voltage_limit == rig.plant.motor.voltage_limit
    for ours, again in zip(*(cpjax.linearize(one.plant) for one in (rig, found.rig)), strict=True):
        np.testing.assert_allclose(again, ours, rtol=1e-12)


@pytest.mark.parametrize(
    ("path", "rig", "field"),
    [
        ("rig.toml", cpjax.rig("paper"), "path"),
        ("rig.xml", cpjax.rig("googol"), "plant.motor"),
        ("rig.xml", cpjax.Rig(cpjax.CartPole(), drive=cpjax.Drive(delay=0.01)), "rig.drive.delay"),
        ("rig.xml", cpjax.Rig(cpjax.CartPole(), drive=cpjax.Drive(lag=0.1)), "rig.drive.lag"),
        ("rig.xml", cpjax.Rig(cpjax.CartPole(), disturbance=cpjax.Disturbance(0.1)), "rig.disturbance"),
    ],
)
def test_what_mjcf_cannot_hold_is_not_written(tmp_path, path, rig, field):
    with pytest.raises(InputError) as caught:
        save_mjcf(tmp_path / path, rig)
    assert caught.value.field == field
    assert list(tmp_path.iterdir()) == []
