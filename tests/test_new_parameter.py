"""A parameter is one declaration: what follows from it for parameters of today, and for one that is added."""

import dataclasses
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import columns, derivative, rough_plant

import cpjax
from cpjax import CartPole, EnergySwingUp, InputError, Motor, State, paper
from cpjax.bridges.known import EXPRESSED
from cpjax.bridges.mujoco import model_xml
from cpjax.bridges.python_control import plant_system
from cpjax.paper.plant_fit import PARAMETERS, scale_of
from cpjax.plant import parameter, parameters_of, with_parameters
from cpjax.pytree import Number, Scalar, number, numbers, pytree
from cpjax.study.named_parameters import parametrise
from cpjax.tune.plants import UNCERTAIN, sample_plants

APPENDIX, ROUGH = paper.appendix_plant(), rough_plant()
DRAWN = (
    *("cart_mass", "pole_mass", "pole_length", "cart_friction", "pivot_friction"),
    *("torque_constant", "back_emf_constant", "resistance"),
)
"""In the order in which their random numbers are drawn."""


@pytree
class CartPoleWithDrag(CartPole):
    """Its cart is also held back by k x'|x'|."""

    drag: Scalar = number(
        "N s^2/m^2",
        "drag of the cart",
        default=0.0,
        at_least=0.0,
        typical=lambda plant: 2.0 * plant.cart_mass,
        linear=False,
        uncertain=True,
    )

    def acceleration(self, sin, cos, rates, force):
        return CartPole.acceleration(self, sin, cos, rates, force - self.drag * rates[0] * jnp.abs(rates[0]))


@pytree
class MotorWithDryBearings(Motor):
    """Its bearings also take a constant force. No word says more of it than unit, range and help."""

    dry_friction: Scalar = number("N", "dry friction", default=0.0, at_least=0.0)

    def force(self, voltage, x_dot):
        return Motor.force(self, voltage, x_dot) - self.dry_friction * jnp.tanh(x_dot / 0.01)


def as_class(cls, part, **more):
    return cls(**{field.name: getattr(part, field.name) for field in dataclasses.fields(part)}, **more)


def test_no_two_parameters_of_a_plant_its_motor_and_the_swing_up_law_share_a_name():
    names = [name for cls in (CartPole, Motor, EnergySwingUp) for name in numbers(cls)]
    assert len(names) == len(set(names))


def test_each_word_of_a_declaration_reaches_the_list_that_is_made_of_it():
    assert {*EXPRESSED} - {*PARAMETERS} == {"voltage_limit"}
    assert {*UNCERTAIN} >= {*DRAWN}
    assert "gravity" not in UNCERTAIN
    chosen = parametrise(APPENDIX, paper.controller("corrected-centred", "placement", APPENDIX))
    assert [name for name in chosen.parameters if name in EXPRESSED] == [*DRAWN[:5], "voltage_limit"]
    assert chosen.scales.items() >= {"cart_friction": 0.1, "pivot_friction": 0.01, "hysteresis": 0.1}.items()


def test_a_seed_draws_the_plants_that_it_always_drew():
    plants = sample_plants(APPENDIX, 20, spread=0.3, seed=5)
    unit = np.random.default_rng(5).uniform(-1.0, 1.0, size=(20, len(DRAWN)))
    sizes = {"cart_friction": APPENDIX.motor.damping, "pivot_friction": 0.4 * np.sqrt(0.5 * 9.81 * 0.7 * 0.5 * 0.7**2)}
    for name, share in zip(DRAWN, 0.3 * unit.T, strict=True):
        expected = np.abs(share) * sizes[name] if name in sizes else parameter(APPENDIX, name) * (1.0 + share)
        np.testing.assert_allclose(parameter(plants, name), expected, rtol=1e-15)


def test_a_zero_parameter_counts_as_large_as_declared_or_as_one():
    plant = as_class(CartPoleWithDrag, APPENDIX)
    assert scale_of(plant, "drag") == 2.0
    assert scale_of(with_parameters(plant, {"drag": 0.3}), "drag") == 0.3
    dry = dataclasses.replace(APPENDIX, motor=as_class(MotorWithDryBearings, APPENDIX.motor))
    assert scale_of(dry, "dry_friction") == 1.0
    assert Number("1", "", typical=3.0, change=0.2).size(None, "change") == 0.2
    assert Number("1", "", typical=3.0, change=0.2).size(None, "drawn") == 3.0


@pytest.mark.parametrize(
    ("ends", "scales"),
    [({}, True), ({"above": 0.0}, True), ({"at_least": 0.1}, False), ({"at_least": 0.0, "at_most": 1.0}, False)],
)
def test_a_fit_may_multiply_by_any_factor_only_what_has_no_end_above_zero(ends, scales):
    assert Number("1", "", **ends).scales == scales


def test_a_new_uncertain_parameter_is_drawn_and_changes_no_draw_of_the_others():
    plain = sample_plants(ROUGH, 50, spread=0.2, seed=3)
    drawn = sample_plants(as_class(CartPoleWithDrag, ROUGH), 50, spread=0.2, seed=3)
    for name in parameters_of(ROUGH):
        np.testing.assert_array_equal(parameter(drawn, name), parameter(plain, name))
    assert 0.0 <= np.min(drawn.drag) < np.max(drawn.drag) <= 0.2 * 2.0 * ROUGH.cart_mass
    assert len(set(np.abs(drawn.drag / ROUGH.cart_mass))) == 50
    alone = sample_plants(as_class(CartPoleWithDrag, ROUGH, drag=0.5), 50, spread=0.2, seed=3, only="drag")
    assert np.all(alone.cart_mass == ROUGH.cart_mass)
    assert 0.4 <= np.min(alone.drag) < 0.5 < np.max(alone.drag) <= 0.6


def test_a_share_that_would_leave_the_range_ends_at_its_end():
    @pytree
    class CartPoleWithGrip(CartPole):
        """Its wheels pass on a share of the force."""

        grip: Scalar = number("1", "share of the force", default=0.95, at_least=0.0, at_most=1.0, uncertain=True)

    grip = sample_plants(CartPoleWithGrip(), 100, spread=0.2, seed=1).grip
    assert 0.76 <= np.min(grip) < 0.95 < np.max(grip) == 1.0


def test_parameters_are_replaced_wherever_they_stand_and_no_other_name_is_taken():
    changed = with_parameters(ROUGH, {"resistance": 2.0, "pole_mass": 0.3})
    assert (changed.motor.resistance, changed.pole_mass) == (2.0, 0.3)
    others = [name for name in parameters_of(ROUGH) if name not in ("resistance", "pole_mass")]
    assert all(parameter(changed, name) == parameter(ROUGH, name) for name in others)
    assert jax.jit(lambda v: with_parameters(ROUGH, {"voltage_limit": v}).motor.voltage_limit)(9.0) == 9.0
    with pytest.raises(InputError, match="motor_mass = 1"):
        with_parameters(ROUGH, {"motor_mass": 1.0})
    with pytest.raises(InputError, match=r"Motor.resistance = -1"):
        with_parameters(ROUGH, {"resistance": -1.0})


@pytest.mark.parametrize("name", EXPRESSED)
def test_mujocos_model_depends_on_every_parameter_that_it_is_said_to_hold(name):
    other = with_parameters(ROUGH, {name: 1.5 * parameter(ROUGH, name)})
    assert model_xml(other, 1e-3) != model_xml(ROUGH, 1e-3)


def test_mujocos_model_refuses_a_plant_or_motor_of_another_class_by_its_name():
    with pytest.raises(InputError, match=r"^plant = CartPoleWithDrag\(.*MuJoCo model cannot express"):
        model_xml(as_class(CartPoleWithDrag, ROUGH), 1e-3)
    plant = dataclasses.replace(ROUGH, motor=as_class(MotorWithDryBearings, ROUGH.motor))
    with pytest.raises(InputError, match=r"^plant.motor = MotorWithDryBearings\(.*MuJoCo model cannot express"):
        model_xml(plant, 1e-3)


@pytest.mark.parametrize("float64", [True, False])
def test_a_plant_of_jax_functions_moves_in_python_control_in_floats(float64):
    motor = as_class(MotorWithDryBearings, ROUGH.motor, dry_friction=0.4)
    plant = as_class(CartPoleWithDrag, dataclasses.replace(ROUGH, motor=motor), drag=0.7)
    state, voltage = State(0.1, 1.5, 0.4, -2.0), 5.0
    with jax.enable_x64(float64):
        found = plant_system(plant).updfcn(0.0, columns(state), [voltage], {})
    assert [type(number) for number in found] == [float] * 4
    # Both frictions act where the wheels push: as if the voltage were smaller.
    less = (0.4 * np.tanh(150.0) + 0.7 * 1.5**2) / float(ROUGH.motor.force_per_voltage)
    np.testing.assert_allclose(found, derivative(ROUGH, columns(state), voltage - less), rtol=1e-12)


BEFORE = "    motor: Any = part("
ADDED = """    smooth_friction: Scalar = number("N", "dry friction", default=0.0, at_least=0.0, uncertain=True)
"""
TERM = (
    "        push = force - self.cart_friction * x_dot",
    "        push = force - self.smooth_friction * jnp.tanh(x_dot / 0.01) - self.cart_friction * x_dot",
)

USES_OF_THE_COPY = """
import json
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)
import cpjax
from cpjax import cli, paper
from cpjax.bridges.mujoco import model_xml
from cpjax.bridges.python_control import plant_system
from cpjax.plant import with_parameters
from cpjax.paper.gain_identification import audit_gains
from cpjax.study.named_parameters import parametrise
from cpjax.paper.plant_fit import PARAMETERS, scale_of
from cpjax.paper.printed_gains import printed_in_the_paper
from cpjax.tune.plants import UNCERTAIN, sample_plants

here, name = Path(__file__).parent, "smooth_friction"
assert Path(cpjax.__file__).parent.parent == here, cpjax.__file__
plain = paper.appendix_plant()
rubbing = with_parameters(plain, {name: 0.3})
assert plain.smooth_friction == 0.0 and rubbing.smooth_friction == 0.3

# Fits of gains
assert name in PARAMETERS
assert scale_of(plain, name) == 1.0
audit = audit_gains(printed_in_the_paper()[:1], plain, parameters=(name, "torque_constant"), most=1, starts=2)
assert [fit.parameters for fit in audit.fits] == [(name,), ("torque_constant",)]
assert np.all(np.isfinite([fit.worst for fit in audit.fits]))

# Random plants
assert name in UNCERTAIN
plants = sample_plants(plain, 5, spread=0.2, seed=1)
assert 0.0 <= np.min(plants.smooth_friction) < np.max(plants.smooth_friction) <= 0.2
np.testing.assert_array_equal(plants.cart_mass, np.load(here / "cart_mass.npy"))
np.testing.assert_array_equal(plants.motor.resistance, np.load(here / "resistance.npy"))

# Audits of gradients
controller = paper.controller("corrected-centred", "placement", plain)
chosen = parametrise(plain, controller)
assert chosen.scales[name] == 1.0
assert chosen.build(chosen.parameters | {name: 0.2})[0].smooth_friction == 0.2

# Files and the command line
cpjax.save(here / "rig.toml", rubbing)
assert cpjax.load(here / "rig.toml").smooth_friction == 0.3
(here / "options.toml").write_text("[plant]\\nsmooth_friction = 0.1\\n")
for option, text, value in (
    ("--smooth-friction", "0.1", 0.1),
    ("--config", "options.toml", 0.1),
    ("--plant", "rig.toml", 0.3),
):
    assert cli.main(["swingup", "--duration", "0.1", "--out", "out", option, text]) == 1  # it does not settle so soon
    assert json.loads((here / "out" / "swingup.json").read_text())["plant"][name] == value
assert cli.main(["swingup", "--smooth-friction", "-0.1", "--out", "out"]) == 2

# Bridges
model_xml(plain, 1e-3)
try:
    model_xml(rubbing, 1e-3)
except cpjax.InputError as problem:
    assert str(problem).startswith("plant.smooth_friction = 0.3: ") and "cannot express" in str(problem), problem
else:
    raise AssertionError("MuJoCo's model drops the friction")
state = np.array([0.0, 0.02, 0.3, 0.1])
found = plant_system(rubbing).updfcn(0.0, state, [2.0], {})
assert [type(number) for number in found] == [float] * 4
field = rubbing.vector_field(cpjax.State(*state), 2.0)
np.testing.assert_allclose(found, field.vector(), rtol=1e-12)
less = 0.3 * np.tanh(2.0) / plain.motor.force_per_voltage
np.testing.assert_allclose(found, plain.vector_field(cpjax.State(*state), 2.0 - less).vector(), rtol=1e-12)

# Rollouts
start = cpjax.State(0.0, 1.0, 3.0, 0.0)
run = dict(duration=0.1, dt=0.002, clock="sampled")  # as the command above: compiled already
metric = cpjax.ProtocolMetrics(reference_x=0.0)
slowed, free = (cpjax.rollout(plant, controller, start, metrics=metric, **run).state for plant in (rubbing, plain))
assert slowed.x[-1] < free.x[-1] - 5e-4
starts = jax.tree.map(lambda v: np.array([v, v]), start)
swept = cpjax.sweep(rubbing, controller, starts, **run)
np.testing.assert_allclose(swept.cart_travel, np.max(np.abs(slowed.x)), rtol=1e-9)
"""


@pytest.mark.slow
def test_a_parameter_added_by_one_declaration_and_one_term_works_everywhere(tmp_path):
    source = Path(cpjax.__file__).parent
    shutil.copytree(source, tmp_path / "cpjax", ignore=shutil.ignore_patterns("__pycache__"))
    plant = tmp_path / "cpjax" / "plant" / "cartpole.py"
    text = plant.read_text()
    assert text.count(BEFORE) == text.count(TERM[0]) == 1
    plant.write_text(text.replace(BEFORE, ADDED + BEFORE).replace(*TERM))
    drawn = sample_plants(APPENDIX, 5, spread=0.2, seed=1)
    np.save(tmp_path / "cart_mass.npy", drawn.cart_mass)
    np.save(tmp_path / "resistance.npy", drawn.motor.resistance)
    script = tmp_path / "uses.py"
    script.write_text(USES_OF_THE_COPY)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-W", "error", script],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
