"""Files: what is saved is what is loaded, to the bit; what is broken is refused; a write is all or nothing."""

import importlib.metadata
import json
import math
import os
import re
import stat
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tables import rows

import cpjax
from cpjax import (
    AngleGate,
    AngleRateGate,
    CartPole,
    EnergySwingUp,
    Hybrid,
    InputError,
    LqrWeights,
    LyapunovGate,
    Metrics,
    Motor,
    PoleFactors,
    ProtocolMetrics,
    State,
    StateFeedback,
    files,
    io,
    paper,
    rollout,
)
from cpjax.controllers import SingleLaw, SmoothClip, SmoothHybrid
from cpjax.sim.rollout import Trajectory

AWKWARD = (0.1 + 0.2, 1 / 3, -0.0, 5e-324)  # no short decimals; a signed zero; the smallest float
PLANT = CartPole(cart_mass=0.1 + 0.2, gravity=1e22, motor=Motor(resistance=1 / 3, voltage_limit=math.inf))
LAW = StateFeedback([*AWKWARD], reference=State(*AWKWARD))
WEIGHT = np.diag([1 / 3, 2.0, 3.0, 4e300]) + 0.1
METRICS = Metrics(
    success=jnp.asarray(True),
    settling_time=jnp.asarray(math.inf),
    cart_travel=jnp.asarray(1 / 3),
    effort=jnp.asarray(0.1 + 0.2),
    voltage_variation=jnp.asarray(math.nan),
    peak_voltage=jnp.asarray(12.0),
    peak_cart_acceleration=jnp.asarray(1e-300),
    switches=jnp.asarray(3, dtype=jnp.int32),
    flag=jnp.asarray(5, dtype=jnp.int32),
)
THINGS = {
    "State": State(*AWKWARD),
    "State of integers": State(0, 1, -2, 3),
    "State of float32 scalars": State(*np.float32(AWKWARD)),
    "State of float64 arrays": State(*np.array([AWKWARD] * 4)),
    "State of float32 arrays": State(*np.float32([AWKWARD] * 4)),
    "Motor": PLANT.motor,
    "Motor of float32": Motor(resistance=np.float32(0.1), voltage_limit=np.float32(math.inf)),
    "Motor of a batch": Motor(voltage_limit=np.array([math.inf, 12.0])),
    "Motor of a float32 batch": Motor(voltage_limit=np.float32([math.inf, 12.0])),
    "CartPole": PLANT,
    "CartPole of JAX arrays": jax.tree.map(jnp.float32, PLANT),
    "StateFeedback": LAW,
    "StateFeedback of LqrWeights": StateFeedback(LAW.K, design=LqrWeights(np.eye(4), 0.5)),
    "StateFeedback of PoleFactors": StateFeedback(LAW.K, design=PoleFactors([7.0, 11.0], [12.0, 30.0])),
    "LqrWeights": LqrWeights(np.eye(4), 0.5),
    "PoleFactors": PoleFactors([7.0, 11.0], [12.0, 30.0]),
    "StateFeedback of float32": StateFeedback(np.float32(LAW.K)),
    "EnergySwingUp": EnergySwingUp(PLANT, energy_gain=1 / 3, kick=-0.0),
    "PrintedSwingUp": paper.PrintedSwingUp(PLANT, energy_gain=-0.2),
    "CorrectedSwingUpAsVoltage": paper.CorrectedSwingUpAsVoltage(PLANT),
    "AngleGate": AngleGate(1 / 3, hysteresis=0.1),
    "AngleRateGate": AngleRateGate(1 / 3, rate=1 / 7),
    "LyapunovGate": LyapunovGate(WEIGHT, level=1 / 3),
    "Hybrid": Hybrid(EnergySwingUp(PLANT, energy_gain=5.0), LAW, LyapunovGate(WEIGHT, level=1 / 3)),
    "SingleLaw": SingleLaw(LAW),
    "SmoothHybrid": SmoothHybrid(LAW, StateFeedback([1.0, 2.0, 3.0, 4.0]), AngleGate(0.3), temperature=0.02),
    "SmoothClip": SmoothClip(LAW, voltage_limit=9.0, temperature=0.5),
    "ProtocolMetrics": ProtocolMetrics(hold=1 / 3),
    "Metrics": METRICS,
    "Metrics of a sweep": jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), METRICS),
    "Trajectory": Trajectory(
        time=np.linspace(0.0, 1.0, 4),
        state=State(*np.array([AWKWARD] * 4)),
        voltage=np.float32(AWKWARD),
        mode=np.array([0, 1, 1, 0], dtype=np.int32),
        outputs={"cart_acceleration": np.array([math.nan, math.inf, -math.inf, 0.0])},
        flag=np.array(2, dtype=np.int32),
        metrics=METRICS,
    ),
}
RIG = cpjax.Rig(
    PLANT,
    sensors=cpjax.Encoders(1e-4, 1e-3, theta_offset=0.1),
    drive=cpjax.Drive(delay=0.1),
    track=cpjax.Track(0.4),
    disturbance=cpjax.Disturbance(0.1, cpjax.Pushes([0.1], [1.0 / 3.0], [2.0]), cpjax.Wind(0.1)),
)
THINGS |= {
    "Rig": RIG,
    "Encoders": RIG.sensors,
    "Drive": RIG.drive,
    "Track": RIG.track,
    "Disturbance": RIG.disturbance,
    "Pushes": RIG.disturbance.pushes,
    "Wind": RIG.disturbance.wind,
    "RandomPushes": cpjax.RandomPushes(cart=1.0 / 3.0),
    "StateSensors": cpjax.StateSensors(theta_dot_noise=0.1),
    "Potentiometers": cpjax.Potentiometers(dead_angle=0.3),
    "IntegralAction": cpjax.IntegralAction(LAW, -10.0 / 3.0),
    "MovingReference": cpjax.MovingReference.steps(LAW, [0.0, 1.0], [0.1, -0.1]),
    "VoltageSignal": cpjax.VoltageSignal([0.0, 0.1], [1.0, -1.0]),
    "LumpedMotor": cpjax.LumpedMotor(2.0 / 3.0),
    "ForceActuator": cpjax.ForceActuator(math.inf),
    "AccelerationActuator": cpjax.AccelerationActuator(10.0 / 3.0),
    "FilteredDerivative": cpjax.FilteredDerivative(100.0 / 3.0),
    "Observer": cpjax.Observer(PLANT, np.ones((4, 2)) / 3.0),
    "Observer by poles": cpjax.Observer(PLANT, poles=[-20.0 + 3j, -20.0 - 3j, -30.0, -40.0], prediction="runge-kutta"),
    "KalmanFilter": cpjax.KalmanFilter(PLANT, 1e-4 / 3.0, 1e-3, kind="extended"),
    "Digital": cpjax.Digital(LAW, cpjax.Observer(PLANT, np.ones((4, 2)) / 3.0), dead_band=0.1, delay=2),
}
every_thing = rows("thing", THINGS.values(), ids=THINGS)
both_formats = rows("extension", ["json", "toml"])


def assert_bits(got, expected):
    """Same types, and every leaf with the same type, shape and bits."""
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())


def refused(field, allowed=""):
    return pytest.raises(InputError, match=rf"{re.escape(field)} = .*: must be .*{re.escape(allowed)}")


def written(folder, name, text):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def strict_json(text):
    def forbidden(token):
        raise AssertionError(f"{token} is no JSON")

    return json.loads(text, parse_constant=forbidden)


# --- round trips ------------------------------------------------------------------------------------------------------


@every_thing
@both_formats
def test_a_file_gives_back_every_bit(tmp_path, thing, extension):
    path = tmp_path / f"thing.{extension}"
    io.save(path, thing)
    loaded = io.load(path)
    assert type(loaded) is type(thing)
    assert_bits(loaded, thing)


@every_thing
def test_saving_what_was_loaded_writes_the_same_file(tmp_path, thing):
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    io.save(first, thing)
    io.save(second, io.load(first))
    assert first.read_bytes() == second.read_bytes()


@every_thing
def test_a_json_file_is_strict_and_tagged_with_schema_and_type(tmp_path, thing):
    io.save(tmp_path / "thing.json", thing)
    table = strict_json((tmp_path / "thing.json").read_text(encoding="utf-8"))
    assert table["schema"] == 1
    assert table["type"] == type(thing).__name__


@every_thing
def test_a_toml_file_is_read_by_the_standard_library(tmp_path, thing):
    io.save(tmp_path / "thing.toml", thing)
    table = tomllib.loads((tmp_path / "thing.toml").read_text(encoding="utf-8"))
    assert (table["schema"], table["type"]) == (1, type(thing).__name__)


def test_every_type_that_can_be_saved_is_in_the_round_trips():
    assert {type(thing) for thing in THINGS.values()} == set(io.TYPES.values())


@both_formats
def test_a_rollout_is_saved_with_its_metrics(tmp_path, extension):
    path = tmp_path / f"run.{extension}"
    run = rollout(PLANT, LAW, State(np.float32(0.1), 0.0, 3.0, 0.0), clock="continuous", duration=0.1, dt=0.05)
    io.save(path, run)
    loaded = io.load(path)
    assert isinstance(loaded.metrics, Metrics)
    assert_bits(loaded, run)


@both_formats
def test_metrics_of_a_users_own_kind_are_refused_when_saved(tmp_path, extension):
    trajectory = THINGS["Trajectory"]
    fields = {name: getattr(trajectory, name) for name in ("time", "state", "voltage", "mode", "outputs", "flag")}
    with pytest.raises(InputError, match="metrics"):
        io.save(tmp_path / f"run.{extension}", Trajectory(**fields, metrics={"final": jnp.ones(2)}))


@both_formats
def test_the_case_of_an_extension_does_not_matter(tmp_path, extension):
    path = tmp_path / f"THING.{extension.upper()}"
    io.save(path, PLANT)
    assert_bits(io.load(path), PLANT)


def test_paths_may_be_texts_with_any_letters_and_folders_are_made(tmp_path):
    path = str(tmp_path / "größe 大" / "deep" / "plant [1] {x}.json")
    io.save(path, PLANT)
    assert_bits(io.load(path), PLANT)


# --- files written by hand --------------------------------------------------------------------------------------------


def test_a_plant_written_by_hand_takes_defaults_for_what_it_leaves_out(tmp_path):
    text = """
        # a heavier cart on the paper's motor, on a stiff supply
        type = "CartPole"
        cart_mass = 2
        [motor]
        type = "Motor"
        resistance = 0.5
        voltage_limit = inf
    """
    plant = io.load(written(tmp_path, "plant.toml", text))
    assert_bits(plant, CartPole(cart_mass=2.0, motor=Motor(resistance=0.5, voltage_limit=math.inf)))


def test_a_controller_written_by_hand_takes_defaults_for_what_it_leaves_out(tmp_path):
    text = """
        schema = 1
        type = "Hybrid"
        [swing_up]
        type = "EnergySwingUp"
        energy_gain = 5
        model = { type = "CartPole" }
        [regulator]
        type = "StateFeedback"
        K = [-24, -25.5, 111, 28]
        [gate]
        type = "AngleGate"
        half_angle = 0.5
    """
    controller = io.load(written(tmp_path, "controller.toml", text))
    regulator = StateFeedback([-24.0, -25.5, 111.0, 28.0])
    assert_bits(controller, Hybrid(EnergySwingUp(CartPole(), energy_gain=5.0), regulator, AngleGate(0.5)))


def test_json_written_by_hand_may_say_inf_as_a_text(tmp_path):
    path = written(tmp_path, "motor.json", '{"type": "Motor", "voltage_limit": "inf"}')
    assert io.load(path).voltage_limit == math.inf


def test_a_smaller_array_type_written_by_hand_is_kept(tmp_path):
    text = '{"type": "StateFeedback", "K": {"dtype": "float32", "values": [[1, 2, 3, 4]]}}'
    assert io.load(written(tmp_path, "law.json", text)).K.dtype == np.float32


# --- what is refused when read ----------------------------------------------------------------------------------------


@rows(
    ("text", "field", "allowed"),
    [
        ('{"type": "CartPole", "mass": 1}', "key", "one of CartPole's fields: cart_mass, "),
        ('{"type": "CartPole", "motor": {"type": "Motor", "mass": 1}}', "motor: key", "one of Motor's fields: "),
        ('{"type": "AngleGate"}', "key", "present: AngleGate has no default for it"),
        ('{"type": "Hybrid", "gate": {"type": "AngleRateGate", "half_angle": 0.5}}', "key", "present: "),
        ('{"type": "Pendulum"}', "type", "one of State, Motor, CartPole"),
        ('{"type": "cartpole"}', "type", "one of State, Motor, CartPole"),
        ('{"type": null}', "type", "one of State"),
        ('{"type": ["CartPole"]}', "type", "one of State"),
        ('{"type": {"type": "CartPole"}}', "type", "one of State"),
        ('{"cart_mass": 1}', "type", "one of State"),
        ("{}", "type", "one of State"),
        ('{"type": "CartPole", "motor": {}}', "motor: type", "one of State"),
        ('{"type": "CartPole", "schema": 2}', "schema", "1, the layout that this version of cpjax reads"),
        ('{"type": "CartPole", "schema": "1"}', "schema", "1, the layout"),
        ('{"type": "CartPole", "cart_mass": -1}', "CartPole.cart_mass", "a finite number above 0 [kg]"),
        ('{"type": "CartPole", "cart_mass": NaN}', "CartPole.cart_mass", "a finite number above 0 [kg]"),
        ('{"type": "CartPole", "cart_mass": "nan"}', "CartPole.cart_mass", "a finite number above 0 [kg]"),
        ('{"type": "CartPole", "cart_mass": "1"}', "CartPole.cart_mass", "a finite number above 0 [kg]"),
        ('{"type": "CartPole", "cart_mass": true}', "CartPole.cart_mass", "a finite number above 0 [kg]"),
        ('{"type": "CartPole", "cart_mass": null}', "CartPole.cart_mass", "a finite number above 0 [kg]"),
        ('{"type": "CartPole", "cart_mass": 1' + 400 * "0" + "}", "CartPole.cart_mass", "a finite number above 0 [kg]"),
        ('{"type": "CartPole", "motor": 1}', "CartPole.motor", "a cpjax.Motor"),
        ('{"type": "CartPole", "motor": {"type": "AngleGate", "half_angle": 1}}', "CartPole.motor", "a cpjax.Motor"),
        (
            '{"type": "CartPole", "motor": {"type": "Motor", "resistance": 0}}',
            "motor: Motor.resistance",
            "above 0 [ohm]",
        ),
        ('{"type": "StateFeedback", "K": [1, 2, 3]}', "StateFeedback.K", "a finite array of shape (1, 4)"),
        ('{"type": "StateFeedback", "K": [1, 2, [3], 4]}', "K", "a list of numbers, nested evenly"),
        ('{"type": "StateFeedback", "K": ["1", "2", "3", "4"]}', "K", ""),
        ('{"type": "StateFeedback", "K": [true, true, true, true]}', "K", ""),
        (
            '{"type": "StateFeedback", "K": {"dtype": "f99", "values": [1]}}',
            "K",
            "dtype and values that fit each other",
        ),
        ('{"type": "StateFeedback", "K": {"dtype": "float32", "values": "x"}}', "K", "dtype and values that fit"),
        ('{"type": "StateFeedback", "K": {"dtype": "int32", "values": [[1, 2, 3, 4]]}}', "StateFeedback.K", "floating"),
    ],
)
def test_a_file_with_wrong_content_is_refused_with_its_path_and_key(tmp_path, text, field, allowed):
    path = written(tmp_path, "thing.json", text)
    with refused(field, allowed) as caught:
        io.load(path)
    assert str(caught.value).startswith(str(path))


@rows("text", ["", "{", '{"type": "CartPole",}', '{"type": "CartPole"} x', "\x00", "[" * 100_000])
def test_broken_json_is_refused(tmp_path, text):
    with refused("path", "a valid JSON file ("):
        io.load(written(tmp_path, "thing.json", text))


@rows("text", ["type", "[motor", 'type = "CartPole"\ntype = "Motor"', "x = 2026-13-40", "\x00"])
def test_broken_toml_is_refused(tmp_path, text):
    with refused("path", "a valid TOML file ("):
        io.load(written(tmp_path, "thing.toml", text))


@rows("text", ["1", "null", "[]", '"CartPole"', "true"])
def test_json_that_holds_no_table_is_refused(tmp_path, text):
    with refused("path", "a file that holds one table"):
        io.load(written(tmp_path, "thing.json", text))


def test_json_that_names_a_key_twice_is_refused(tmp_path):
    with pytest.raises(InputError, match="cart_mass"):
        io.load(written(tmp_path, "thing.json", '{"type": "CartPole", "cart_mass": 1, "cart_mass": 2}'))


@both_formats
def test_bytes_that_are_no_text_are_refused(tmp_path, extension):
    path = tmp_path / f"thing.{extension}"
    path.write_bytes(b"\xff\xfe\x00")
    with refused("path", "a readable text file ("):
        io.load(path)


@both_formats
def test_a_missing_file_is_refused(tmp_path, extension):
    with refused("path", "a readable text file ([Errno 2]"):
        io.load(tmp_path / f"thing.{extension}")


@both_formats
def test_a_folder_in_place_of_a_file_is_refused(tmp_path, extension):
    path = tmp_path / f"thing.{extension}"
    path.mkdir()
    with refused("path", "a readable text file ("):
        io.load(path)
    with refused("path", "a place that can be written ("):
        io.save(path, PLANT)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@rows("name", ["plant.yaml", "plant", "plant.json.txt", ".json"])
def test_another_extension_is_refused_for_reading_and_writing(tmp_path, name):
    for use in (lambda path: io.save(path, PLANT), io.load):
        with refused("path", "a file name that ends in .json or .toml"):
            use(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_path_with_a_null_in_it_is_refused(tmp_path):
    for use in (lambda path: io.save(path, PLANT), io.load):
        with refused("path"):
            use(str(tmp_path / "a\0b.json"))


def test_arrays_of_five_dtypes_are_read_and_no_other(tmp_path):
    for dtype in ("float32", "float64", "int32", "int64", "bool"):
        values = "true" if dtype == "bool" else "1"
        text = '{"type": "State", "x": {"dtype": "%s", "values": %s}, "x_dot": 0, "theta": 0, "theta_dot": 0}'
        assert io.load(written(tmp_path, "state.json", text % (dtype, values))).x.dtype == dtype
    for dtype in ("longdouble", "float16", "int8", "uint32", "complex64", "object", "<f4", "f4", "S3", "M8[s]"):
        with refused("x", "dtype one of bool, int32, int64, float32, float64"):
            io.load(written(tmp_path, "state.json", text % (dtype, "1")))


@rows(
    ("dtype", "values"),
    [
        ("int32", "1.5"),
        ("int32", "3000000000"),
        ("int64", "1" + 30 * "0"),
        ("bool", "2"),
        ("float32", "1e300"),
        ("float64", "true"),
        ("float64", '"1"'),
        ("float64", "null"),
        ("float32", "[[1], [1, 2]]"),
        ("float32", "{}"),
    ],
)
def test_values_that_are_no_numbers_of_their_dtype_are_refused(tmp_path, dtype, values):
    text = f'{{"type": "AngleGate", "half_angle": {{"dtype": "{dtype}", "values": {values}}}}}'
    with refused("half_angle", "dtype and values that fit each other"):
        io.load(written(tmp_path, "gate.json", text))


@rows("dtype", [np.longdouble, np.float16, np.int8, np.uint32], ids=lambda d: d.__name__)
@both_formats
def test_an_array_that_no_file_could_give_back_is_not_written(tmp_path, dtype, extension):
    with refused("State.x", "of dtype bool, int32, int64, float32, float64"):
        io.save(tmp_path / f"state.{extension}", State(dtype(1), 0.0, 0.0, 0.0))
    assert list(tmp_path.iterdir()) == []


REST = '"x_dot": 0, "theta": 0, "theta_dot": 0'


@rows(
    ("name", "text", "field"),
    [
        ("a.json", f'{{"type": "State", "x": "left", {REST}}}', "State.x"),
        ("a.json", f'{{"type": "State", "x": null, {REST}}}', "State.x"),
        ("a.json", f'{{"type": "State", "x": true, {REST}}}', "State.x"),
        ("a.json", f'{{"type": "State", "x": {{"type": "Motor"}}, {REST}}}', "State.x"),
        ("a.toml", 'type = "State"\nx = 2026-01-01\nx_dot = 0\ntheta = 0\ntheta_dot = 0', "State.x"),
        ("a.toml", 'type = "State"\nx = 0\nx_dot = 0\ntheta = 07:32:00\ntheta_dot = 0', "State.theta"),
    ],
)
def test_a_state_of_other_things_than_numbers_is_refused_by_name(tmp_path, name, text, field):
    with refused(field, "a number or an array of numbers"):
        io.load(written(tmp_path, name, text))


@rows("field", ["success", "effort", "flag"])
@rows("value", [None, "a text", {"type": "Motor"}], ids=str)
def test_metrics_of_other_things_than_numbers_are_refused_by_name(tmp_path, field, value):
    table = {**io.encode(METRICS), field: value}
    files.write_json(tmp_path / "metrics.json", table)
    with refused(f"Metrics.{field}", "a number or an array of numbers"):
        io.load(tmp_path / "metrics.json")


@rows(("field", "value"), [("state", 1.0), ("state", {"type": "Motor"}), ("metrics", "x"), ("time", {"type": "Motor"})])
def test_a_trajectory_of_other_parts_is_refused_by_name(tmp_path, field, value):
    files.write_json(tmp_path / "run.json", {**io.encode(THINGS["Trajectory"]), field: value})
    with refused(f"Trajectory.{field}"):
        io.load(tmp_path / "run.json")


def test_a_result_of_a_command_is_no_component_but_has_parts(tmp_path):
    path = tmp_path / "result.json"
    files.write_json(path, {"what": "one closed-loop rollout", "plant": io.encode(PLANT), "controller": io.encode(LAW)})
    with refused("path", "a file with one component; this one holds a result (one closed-loop rollout)"):
        io.load(path)
    assert_bits(io.load_part(path, "plant", "a CartPole"), PLANT)
    assert_bits(io.load_part(path, "controller", "a law"), LAW)


# --- what is refused when written -------------------------------------------------------------------------------------


@rows("thing", [None, 1.0, {"type": "CartPole"}, CartPole, jnp.ones(3), io.TYPES], ids=lambda v: "")
def test_what_is_no_component_is_refused(tmp_path, thing):
    with refused("thing", "one of State, Motor, CartPole"):
        io.save(tmp_path / "thing.json", thing)
    assert list(tmp_path.iterdir()) == []


def test_a_users_own_class_of_a_known_name_is_refused(tmp_path):
    other = type("Motor", (), {})
    with refused("thing", "one of State, Motor, CartPole"):
        io.save(tmp_path / "thing.json", other())


@both_formats
def test_a_component_with_a_part_of_the_users_own_is_refused(tmp_path, extension):
    class Law:
        def voltage(self, state):
            return 0.0

    with pytest.raises(InputError, match="must be"):
        io.save(tmp_path / f"thing.{extension}", SingleLaw(Law()))
    assert list(tmp_path.iterdir()) == []


@rows("transform", [jax.jit, jax.vmap, jax.grad], ids=["jit", "vmap", "grad"])
def test_a_component_that_jax_is_tracing_is_refused(tmp_path, transform):
    def use(mass):
        io.save(tmp_path / "thing.json", CartPole(cart_mass=mass))
        return mass

    with refused("CartPole.cart_mass", "a value outside jit, vmap and grad"):
        transform(use)(jnp.ones(2) if transform is jax.vmap else 1.0)
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_place_of_a_folder_is_refused(tmp_path):
    written(tmp_path, "taken", "")
    for path in (tmp_path / "taken" / "plant.json", tmp_path / "taken" / "deep" / "plant.json"):
        with refused("path", "a place that can be written ("):
            io.save(path, PLANT)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_folder_without_permission_is_refused(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        with refused("path", "a place that can be written ("):
            io.save(folder / "plant.json", PLANT)
    finally:
        folder.chmod(stat.S_IRWXU)


def test_a_folder_that_the_system_will_not_write_to_is_refused(tmp_path, monkeypatch):
    def denied(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", denied)
    with refused("path", "a place that can be written ([Errno 13]"):
        io.save(tmp_path / "plant.json", PLANT)


# --- atomic writes ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", ["fsync", "chmod", "replace"])
@pytest.mark.parametrize(
    ("failure", "seen"),
    [
        (OSError(28, "No space left on device"), InputError),
        (KeyboardInterrupt(), KeyboardInterrupt),
        (MemoryError(), MemoryError),
    ],
    ids=lambda v: type(v).__name__ if isinstance(v, BaseException) else "",
)
@pytest.mark.parametrize("before", [True, False], ids=["over an old file", "where there was none"])
def test_a_write_that_fails_on_its_way_leaves_the_old_content_and_nothing_else(
    tmp_path, monkeypatch, step, failure, seen, before
):
    path = tmp_path / "plant.json"
    if before:
        path.write_text("old", encoding="utf-8")

    def fail(*_, **__):
        raise failure

    if step == "chmod" and not before:
        return  # a new file's mode is the umask's business
    monkeypatch.setattr(os, step, fail)
    with pytest.raises(seen):
        io.save(path, PLANT)
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ([path.name] if before else [])
    assert not before or path.read_text(encoding="utf-8") == "old"
    io.save(path, PLANT)
    assert_bits(io.load(path), PLANT)


def test_an_overwritten_file_keeps_its_mode(tmp_path):
    path = tmp_path / "plant.json"
    io.save(path, PLANT)
    path.chmod(0o600)
    io.save(path, PLANT)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_component_that_cannot_be_saved_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / "plant.json"
    io.save(path, PLANT)
    with refused("thing"):
        io.save(path, object())
    assert_bits(io.load(path), PLANT)


def test_a_write_replaces_the_old_file_whole_and_leaves_no_other(tmp_path):
    path = tmp_path / "plant.json"
    io.save(path, Hybrid(LAW, LAW, AngleGate(0.5)))
    io.save(path, AngleGate(0.5))
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert_bits(io.load(path), AngleGate(0.5))


@pytest.mark.skipif(os.name != "posix", reason="permissions are the system's own elsewhere")
def test_a_written_file_has_the_permissions_of_an_ordinary_one(tmp_path):
    path, ordinary = tmp_path / "plant.json", written(tmp_path, "ordinary", "")
    io.save(path, PLANT)
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(ordinary.stat().st_mode)


# --- plain tables -----------------------------------------------------------------------------------------------------


def test_plain_tables_come_back_with_their_infinities_and_as_strict_json(tmp_path):
    path = tmp_path / "table.json"
    data = {
        "a": [1.5, math.inf, -math.inf],
        "b": {"c": np.arange(3), "d": jnp.float32(0.5)},
        "e": [],
        "f": "x [1,\n 2]",
    }
    files.write_json(path, data)
    strict_json(path.read_text(encoding="utf-8"))
    expected = {"a": [1.5, math.inf, -math.inf], "b": {"c": [0, 1, 2], "d": 0.5}, "e": [], "f": "x [1,\n 2]"}
    assert files.read_table(path) == expected


def test_lists_of_numbers_stand_on_one_line(tmp_path):
    assert files.dump_json({"a": [1, 2], "b": [[1.0, 2.0], [3.0, 4.0]]}).count("\n") < 12
    assert "[ 1, 2 ]" in files.dump_json({"a": [1, 2]})


def test_versions_name_what_a_result_depends_on():
    assert set(files.versions()) == {"cpjax", "jax", "jaxlib", "numpy", "scipy"}
    assert files.versions()["numpy"] == np.__version__


def test_versions_of_a_tree_that_was_never_installed_are_unknown(monkeypatch):
    def version(name):
        if name == "cpjax":
            raise importlib.metadata.PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert files.versions() == {"cpjax": "0+unknown", "jax": "1.0", "jaxlib": "1.0", "numpy": "1.0", "scipy": "1.0"}


def test_a_relative_path_without_a_folder_is_written_here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    io.save("plant.json", PLANT)
    assert [p.name for p in Path(tmp_path).iterdir()] == ["plant.json"]
