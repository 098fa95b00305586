"""The command line, called as a function. One setting serves most tests, so that few rollouts are compiled."""

import dataclasses
import html.parser
import io as buffers
import json
import math
import re
import subprocess
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from tables import rows

import cpjax.show.figures
import cpjax.show.reproduction
from cpjax import (
    HANGING,
    AngleGate,
    CartPole,
    EnergySwingUp,
    ForceActuator,
    Hybrid,
    InputError,
    LumpedMotor,
    LyapunovGate,
    Metrics,
    Motor,
    State,
    StateFeedback,
    files,
    io,
    paper,
    rollout,
    sample_starts,
)
from cpjax.cli import main, report_sections
from cpjax.cli.basin import CONTROLLERS, file_of
from cpjax.cli.builders import controller_title
from cpjax.cli.reproduce import print_rows
from cpjax.cli.swingup import OPTIONS
from cpjax.paper import reproduction
from cpjax.paper.reproduction import EvaluationConfig, evaluate, reproduce, trajectory, variants
from cpjax.pytree import numbers
from cpjax.study.summary import summarise

SETTING = EvaluationConfig(count=8, duration=12.0, dt=0.01)
LONG = ("--duration", "12", "--dt", "0.01")
SHORT = ("--duration", "0.1", "--dt", "0.01")
PNG = b"\x89PNG\r\n"


@pytest.fixture
def no_pictures(monkeypatch):
    """Drawing is slow and is not what the test is about."""
    monkeypatch.setattr(cpjax.show.figures, "response", lambda *_: None)
    monkeypatch.setattr(cpjax.show.figures, "success_rates", lambda *_: None)
    monkeypatch.setattr(cpjax.show.figures, "save_figure", lambda path, _: files.write_bytes(path, PNG) or PNG)
    monkeypatch.setattr(cpjax.show.figures, "png", lambda _: PNG)
    monkeypatch.setattr(cpjax.show.reproduction, "pictures", lambda _: [("one", None, "A caption.")])


def strict_json(path):
    def forbidden(token):
        raise AssertionError(f"{token} is no JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=forbidden)


def document(folder, name="swingup.json"):
    """The result's JSON without what may differ between two equal runs."""
    strict_json(folder / name)
    return files.read_table(folder / name)


def as_plain(value):
    """A result as the JSON file holds it."""
    return files._numbers(json.loads(files.dump_json(value)))


def assert_notes(result, *beginnings):
    """Standard error has these notes, each on one line, and nothing else."""
    lines = result.err.splitlines()
    assert len(lines) == len(beginnings), result.err
    for line, beginning in zip(lines, beginnings, strict=True):
        assert re.match(rf"cpjax [a-z-]+: note: {re.escape(beginning)}", line), line


# --- swingup ----------------------------------------------------------------------------------------------------------


def test_a_swing_up_that_settles_exits_with_0_and_says_so(command, tmp_path):
    result = command("swingup", "--out", tmp_path, *LONG)
    assert (result.code, result.err) == (0, "")
    table = strict_json(tmp_path / "swingup.json")
    assert f"settled after {table['metrics']['settling_time']:.2f} s" in result.out
    for row in ("settling time", "cart travel", "effort", "total variation", "peak voltage", "mode changes", "flag"):
        assert row in result.out
    assert "clean" in result.out
    assert {p.name for p in tmp_path.iterdir()} == {"swingup.json", "swingup.png"}
    assert (tmp_path / "swingup.png").read_bytes().startswith(PNG)
    assert f"wrote {tmp_path / 'swingup.json'} and {tmp_path / 'swingup.png'}" in result.out


def test_a_swing_up_that_does_not_settle_exits_with_1_and_says_so(command, tmp_path, no_pictures):
    result = command("swingup", "--out", tmp_path, *LONG, "--law", "as-printed")
    assert (result.code, result.err) == (1, "")
    assert "did not settle" in result.out
    assert "never" in result.out
    table = strict_json(tmp_path / "swingup.json")
    assert table["metrics"]["success"] is False
    assert table["metrics"]["settling_time"] == "inf"


def test_a_run_that_blows_up_exits_with_1_and_names_its_flag(command, tmp_path, no_pictures):
    blow_up = ("--theta", "0.1", "--gain", "1e6", "1e6", "-1000000", "-1000000", "--voltage-limit", "inf")
    result = command("swingup", "--out", tmp_path, *SHORT, *blow_up)
    assert result.code == 1
    assert_notes(result, "the controller has an unstable regulator: upright it has a closed-loop pole at 4.29e+05 1/s")
    assert "did not settle (runaway)" in result.out
    assert re.search(r"why: the state left all bounds at .* s; .* try a smaller dt\n", result.out)
    assert strict_json(tmp_path / "swingup.json")["flag"] == "runaway"


@rows("number", ["-5e-3", "-1E2", "-.5", "-1.e0"])
def test_negative_numbers_may_be_written_with_an_exponent(command, tmp_path, no_pictures, number):
    result = command("swingup", "--out", tmp_path, *SHORT, "--kick", number, "--gain", number, "1", number, "2")
    assert result.code == 1
    assert_notes(result, "the controller has an unstable regulator: upright it has a closed-loop pole at ")
    controller = document(tmp_path)["controller"]
    assert controller["swing_up"]["kick"] == float(number)
    assert controller["regulator"]["K"] == [[float(number), 1.0, float(number), 2.0]]


def test_the_json_of_a_swing_up_is_the_rollout_of_the_library(command, tmp_path, no_pictures):
    command("swingup", "--out", tmp_path, *LONG, "--start", "hanging", "--seed", "4", "--x-dot", "0.25")
    table = document(tmp_path)
    plant = paper.appendix_plant()
    drawn = sample_starts("hanging", 1, seed=4)
    start = State(float(drawn.x[0]), 0.25, float(drawn.theta[0]), float(drawn.theta_dot[0]))
    controller = paper.controller("corrected-centred", "placement", plant)
    run = rollout(plant, controller, start, duration=12.0, dt=0.01, clock="sampled")
    assert table["seed"] == 4
    assert table["run"] == {"duration": 12.0, "dt": 0.01, "clock": "sampled"}
    assert table["versions"] == files.versions()
    assert table["start"] == as_plain(io.encode(start))
    assert table["plant"] == as_plain(io.encode(plant))
    assert table["controller"] == as_plain(io.encode(controller))
    assert table["metrics"] == as_plain({name: getattr(run.metrics, name) for name in table["metrics"]})
    assert set(table["metrics"]) == set(Metrics.__dataclass_fields__)
    states = {name: getattr(run.state, name) for name in ("x", "x_dot", "theta", "theta_dot")}
    expected = {"time": run.time, **states, "voltage": run.voltage, "mode": run.mode}
    assert table["trajectory"] == as_plain(expected)
    assert len(table["trajectory"]["time"]) == 1201


def test_plant_and_controller_saved_from_a_run_give_the_same_run_again(command, tmp_path, no_pictures):
    command("swingup", "--out", tmp_path / "a", *SHORT, "--cart-mass", "1.5", "--energy-gain", "3", "--design", "lqr")
    first = document(tmp_path / "a")
    for name in ("plant", "controller"):
        files.write_json(tmp_path / f"{name}.json", first[name])
    saved = ("--plant", tmp_path / "plant.json", "--controller", tmp_path / "controller.json")
    command("swingup", "--out", tmp_path / "b", *SHORT, *saved)
    assert document(tmp_path / "b") == first


def test_a_law_saved_by_the_library_is_a_controller_on_its_own(command, tmp_path, no_pictures):
    law = StateFeedback([-24.74, -25.36, 111.70, 28.58])
    io.save(tmp_path / "law.json", law)
    result = command("swingup", "--out", tmp_path, *SHORT, "--theta", "0.1", "--controller", tmp_path / "law.json")
    assert result.err == ""
    run = rollout(paper.appendix_plant(), law, State(0.0, 0.0, 0.1, 0.0), duration=0.1, dt=0.01, clock="sampled")
    assert document(tmp_path)["trajectory"]["x"] == as_plain(run.state.x)


RATE_GATE = {"controller.gate": "angle-rate", "controller.rate": 4.0}
LEVEL_GATE = {"controller.gate": "lyapunov", "controller.level": 30.0}
CASES = [
    {"start.set": "anywhere"},
    *({f"start.{name}": value} for name, value in (("x", 0.5), ("x_dot", -0.5), ("theta", 0.25), ("theta_dot", 1.5))),
    {"run.duration": 0.2},
    {"run.dt": 0.02},
    {"run.clock": "continuous"},
    {"run.control_period": 0.05},
    {"run.clock": "continuous", "run.switching": "located"},
    {"run.integrator": "semi-implicit-euler"},
    {"plant.base": "identified"},
    *({f"plant.{name}": 2.5} for name in ("cart_mass", "pole_mass", "pole_length", "gravity", "pole_inertia")),
    *({f"plant.{name}": 2.5} for name in ("cart_friction", "pivot_friction", "torque_constant", "back_emf_constant")),
    *({f"plant.{name}": 2.5} for name in ("resistance", "rotor_inertia", "viscous_friction", "wheel_radius")),
    *({f"plant.{name}": 2.5} for name in ("gear_ratio", "voltage_limit")),
    *({f"plant.{name}": 0.5} for name in ("coulomb_friction", "pivot_coulomb_friction", "inductance")),
    {"plant.static_friction_ratio": 1.5, "plant.coulomb_friction": 0.5},
    {"plant.voltage_limit": math.inf},
    *({"controller.law": law} for law in ("as-printed", "corrected", "corrected-as-voltage")),
    {"controller.design": "lqr"},
    {"controller.gains": "computed"},
    {"controller.K": [-1.0, 2.0, -3.5, 1e-3]},
    {"controller.Q": [20.0, 1.0, 50.0, 2.5]},
    {"controller.R": 0.01},
    {"controller.poles": ["-3", "-4", "-5+2j", "-5-2j"]},
    *(
        {f"controller.{name}": 0.25}
        for name in ("energy_gain", "cart_stiffness", "cart_damping", "kick", "kick_radius")
    ),
    {"controller.kick": -0.5},
    {"controller.law": "as-printed", "controller.energy_gain": 0.75},
    {"controller.half_angle": 0.25},
    {"controller.hysteresis": 0.5},
    {"controller.reference_x": -0.5},
    RATE_GATE,
    {**RATE_GATE, "controller.half_angle": 0.25, "controller.hysteresis": 0.25},
    LEVEL_GATE,
    {**LEVEL_GATE, "controller.hysteresis": 0.25},
]


PARTS_OF_A_MOTOR = (
    *("torque_constant", "back_emf_constant", "resistance", "rotor_inertia", "viscous_friction"),
    *("wheel_radius", "gear_ratio"),
)
NOTED = {
    **{f"plant.{name}": ("the motor was given in part; left at the appendix plant's",) for name in PARTS_OF_A_MOTOR},
    "controller.K": ("the controller has an unstable regulator: upright it has a closed-loop pole at 4.64 1/s",),
}
"""What is said on standard error, by the first option of a case."""


def flags_of(case):
    names = {f"{option.section}.{option.key}": option.name for option in OPTIONS}
    words = ((names[k], *map(str, v)) if isinstance(v, list) else (names[k], str(v)) for k, v in case.items())
    return [word for pair in words for word in pair]


def toml_of(case):
    sections = {}
    for path, value in case.items():
        section, key = path.split(".")
        text = "inf" if value == math.inf else json.dumps(value)
        sections.setdefault(section, []).append(f"{key} = {text}")
    return "".join(f"[{section}]\n" + "\n".join(lines) + "\n" for section, lines in sections.items())


OF_OTHER_DRIVES = {f"plant.{name}" for cls in (LumpedMotor, ForceActuator) for name in numbers(cls)}
OF_RIGS = {"plant.rig", "plant.without", "plant.track_limit", "firmware.estimator", "firmware.cutoff"}
"""Tested in test_rig_command.py."""


def test_the_cases_cover_every_option_that_is_no_file_and_of_no_rig():
    options = {f"{o.section}.{o.key}" for o in OPTIONS}
    cases = {path for case in CASES for path in case}
    assert cases == options - {"controller.file"} - OF_RIGS - (OF_OTHER_DRIVES - cases)


@pytest.fixture(scope="module")
def default_document(tmp_path_factory):
    folder = tmp_path_factory.mktemp("default")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cpjax.show.figures, "save_figure", lambda *_: None)
        main(["swingup", "--out", str(folder), *SHORT])
    return document(folder)


@pytest.mark.parametrize("case", CASES, ids=lambda case: ",".join(f"{k}={v}" for k, v in case.items()))
def test_an_option_does_the_same_from_the_shell_and_from_a_file_and_does_something(
    command, tmp_path, no_pictures, default_document, case
):
    (tmp_path / "run.toml").write_text(toml_of(case), encoding="utf-8")
    given = {"run.duration": 0.1, "run.dt": 0.01}
    base = flags_of({key: value for key, value in given.items() if key not in case})
    shell = command("swingup", "--out", tmp_path / "shell", *base, *flags_of(case))
    file = command("swingup", "--out", tmp_path / "file", *base, "--config", tmp_path / "run.toml")
    assert (shell.code, shell.err) == (file.code, file.err)
    assert shell.code == 1
    assert_notes(shell, *NOTED.get(next(iter(case)), ()))
    assert document(tmp_path / "shell") == document(tmp_path / "file")
    different = {k for k, v in document(tmp_path / "shell").items() if v != default_document[k]}
    expected = {key.split(".")[0] for key in case} | ({"notes"} if next(iter(case)) in NOTED else set())
    assert expected <= different
    assert different <= expected | {"metrics", "trajectory", "flag", "controller"}
    assert document(tmp_path / "shell")["notes"] == [line.split(": note: ")[1] for line in shell.err.splitlines()]
    assert "controller" not in different or expected & {"plant", "controller"}  # the law's model is the plant


@rows("extension", ["json", "toml"])
def test_a_plant_in_a_file_is_the_base_that_other_options_change(command, tmp_path, no_pictures, extension):
    path = tmp_path / f"plant.{extension}"
    io.save(path, CartPole(cart_mass=3.0, motor=Motor(resistance=2.0)))
    command("swingup", "--out", tmp_path / "a", *SHORT, "--plant", path, "--pole-mass", "0.25", "--gear-ratio", "2")
    expected = CartPole(cart_mass=3.0, pole_mass=0.25, motor=Motor(resistance=2.0, gear_ratio=2.0))
    assert document(tmp_path / "a")["plant"] == as_plain(io.encode(expected))


def test_the_defaults_are_the_papers_centred_law_on_the_appendix_plant_from_rest(default_document):
    plant = paper.appendix_plant()
    regulator = paper.regulator("placement", "printed", plant)
    law = EnergySwingUp(plant, energy_gain=5.0, cart_stiffness=4.0, cart_damping=2.0)
    expected = Hybrid(law, regulator, AngleGate(math.radians(30.0)))
    assert default_document["controller"] == as_plain(io.encode(expected))
    assert default_document["start"] == as_plain(io.encode(HANGING))
    assert default_document["seed"] == 1


def test_a_flag_wins_over_the_file_and_the_file_over_the_default(command, tmp_path, no_pictures):
    config = tmp_path / "run.toml"
    config.write_text("[run]\nduration = 0.2\ndt = 0.01\n[plant]\ncart_mass = 3\ngravity = 1.6\n", encoding="utf-8")
    result = command("swingup", "--out", tmp_path, "--config", config, "--duration", "0.1", "--cart-mass", "4")
    assert result.err == ""
    table = document(tmp_path)
    assert table["run"] == {"duration": 0.1, "dt": 0.01, "clock": "sampled"}
    assert (table["plant"]["cart_mass"], table["plant"]["gravity"], table["plant"]["pole_mass"]) == (4.0, 1.6, 0.5)


def test_a_lyapunov_gate_from_the_shell_has_the_papers_riccati_weight(command, tmp_path, no_pictures):
    command("swingup", "--out", tmp_path, *SHORT, "--gate", "lyapunov", "--level", "30")
    gate = LyapunovGate(paper.riccati_solution(paper.appendix_plant()), level=30.0)
    assert document(tmp_path)["controller"]["gate"] == as_plain(io.encode(gate))


def test_a_second_run_replaces_the_first_ones_files(command, tmp_path, no_pictures):
    for mass in ("2", "3"):
        command("swingup", "--out", tmp_path, *SHORT, "--cart-mass", mass)
    assert document(tmp_path)["plant"]["cart_mass"] == 3.0
    assert {p.name for p in tmp_path.iterdir()} == {"swingup.json", "swingup.png"}


# --- what the shell can get wrong -------------------------------------------------------------------------------------


def assert_refused(result, folder, *words, command_name="swingup"):
    """Exit code 2 and one line on standard error that holds the words; nothing printed, nothing written."""
    assert (result.code, result.out) == (2, "")
    assert result.err.count("\n") == 1, result.err
    assert result.err.startswith(("cpjax: error: ", f"cpjax {command_name}: error: "))
    assert "Traceback" not in result.err
    for word in words:
        assert word in result.err
    assert not (folder / "out").exists()


BAD_FLAGS = [
    (["--dt", "0"], ["dt = 0.0", "above 0 [s]"]),
    (["--dt", "-0.1"], ["dt = -0.1", "above 0 [s]"]),
    (["--dt", "nan"], ["dt = nan", "above 0 [s]"]),
    (["--dt", "x"], ["--dt", "'x'"]),
    (["--dt", "0.03"], ["duration = 0.1", "a whole multiple of dt = 0.03 s"]),
    (["--dt", "1"], ["dt = 1.0", "at most the duration, 0.1 s"]),
    (["--duration", "inf"], ["duration = inf", "a finite number"]),
    (["--duration", "nan"], ["duration = nan", "a finite number"]),
    (["--duration", "0"], ["duration = 0.0", "above 0 [s]"]),
    (["--duration", "1e300"], ["duration = 1e+300", "fewer than 2^31 steps"]),
    (["--duration", "1e300", "--dt", "1e-300"], ["duration = 1e+300", "fewer than 2^31 steps"]),
    (["--clock", "Sampled"], ["--clock", "'Sampled'", "continuous"]),
    (
        ["--clock", "continuous", "--control-period", "0.02"],
        ["control_period = 0.02", "absent unless clock is sampled"],
    ),
    (["--control-period", "0.005"], ["control_period = 0.005", "at least one step"]),
    (["--control-period", "0.015"], ["control_period = 0.015", "a whole multiple of dt"]),
    (["--integrator", "rk5"], ["--integrator", "'rk5'", "rk4"]),
    (["--theta", "nan"], ["theta = nan", "finite"]),
    (["--x-dot", "1e999"], ["x_dot = inf", "finite"]),
    (["--x", "left"], ["--x", "'left'"]),
    (["--start", "upside-down"], ["--start", "'upside-down'", "hanging", "anywhere", "rest"]),
    (["--seed", "-1"], ["seed = -1", "a whole number, at least 0"]),
    (["--seed", "1.5"], ["--seed", "'1.5'"]),
    (["--cart-mass", "0"], ["cart_mass = 0.0", "above 0 [kg]"]),
    (["--cart-mass", "nan"], ["cart_mass = nan", "above 0 [kg]"]),
    (["--cart-mass", "True"], ["--cart-mass", "'True'"]),
    (["--cart-mass"], ["--cart-mass"]),
    (["--pole-length", "-1"], ["pole_length = -1.0", "above 0 [m]"]),
    (["--cart-friction", "-1"], ["cart_friction = -1.0", "at least 0 [N s/m]"]),
    (["--resistance", "inf"], ["resistance = inf", "above 0 [ohm]"]),
    (["--voltage-limit", "0"], ["voltage_limit = 0.0", "above 0 [V]"]),
    (["--voltage-limit", "nan"], ["voltage_limit = nan", "above 0 [V]"]),
    (["--plant", "moon"], ["plant = 'moon'", "appendix, identified, or a file"]),
    (["--plant", ""], ["plant = ''", "appendix, identified, or a file"]),
    (["--plant", "missing.json"], ["missing.json", "No such file"]),
    (["--plant", "missing\0.json"], ["missing"]),
    (["--plant", "controller.json"], ["controller.json", "a file that holds a CartPole"]),
    (["--plant", "motor.toml"], ["motor.toml", "a file that holds a CartPole"]),
    (["--plant", "batch.json"], ["cart_mass", "shape (2,)"]),
    (["--plant", "list.json"], ["list.json", "a file that holds one table"]),
    (["--plant", "broken.toml"], ["broken.toml", "a valid TOML file"]),
    (["--plant", "folder.json"], ["folder.json", "a readable text file"]),
    (["--controller", "missing.toml"], ["missing.toml", "No such file"]),
    (["--controller", "plant.json"], ["plant.json", "a file that holds a controller"]),
    (["--controller", "gate.json"], ["gate.json", "a file that holds a controller"]),
    (["--controller", "plant"], ["'plant'", "ends in .json or .toml"]),
    (["--controller", "controller.json", "--law", "corrected"], ["controller.json", "alone, without law"]),
    (["--controller", "wanders.json"], ["reference", "x"]),
    (["--law", "best"], ["--law", "'best'", "as-printed"]),
    (["--design", "LQR"], ["--design", "'LQR'", "lqr"]),
    (["--gains", "all"], ["--gains", "'all'", "computed"]),
    (["--gain", "1", "2", "3"], ["--gain", "4 arguments"]),
    (["--gain", "1", "2", "3", "4", "5"], ["5"]),
    (["--gain", "1", "2", "3", "x"], ["--gain", "'x'"]),
    (["--gain", "1", "2", "3", "nan"], ["K = ", "nan", "finite"]),
    (["--gain", "1", "2", "3", "4", "--design", "lqr"], ["gain = [1.0, 2.0, 3.0, 4.0]", "absent"]),
    (["--energy-gain", "-1"], ["energy_gain = -1.0", "at least 0"]),
    (["--kick", "inf"], ["kick = inf", "a finite number"]),
    (["--kick-radius", "0"], ["kick_radius = 0.0", "at least 0.001"]),
    (["--law", "as-printed", "--kick", "1"], ["kick = 1.0", "the law as-printed has no such term"]),
    (["--gate", "box"], ["--gate", "'box'", "lyapunov"]),
    (["--half-angle", "4"], ["half_angle = 4.0", "at most 3.14159 [rad]"]),
    (["--half-angle", "2", "--hysteresis", "1"], ["hysteresis = 1.0", "at most pi"]),
    (["--hysteresis", "-0.1"], ["hysteresis = -0.1", "at least 0"]),
    (["--gate", "angle-rate"], ["rate", "the gate angle-rate needs it"]),
    (["--gate", "angle-rate", "--rate", "0"], ["rate = 0.0", "above 0 [rad/s]"]),
    (["--rate", "1"], ["rate = 1.0", "the gate angle has no such term"]),
    (["--gate", "lyapunov"], ["level", "the gate lyapunov needs it"]),
    (["--gate", "lyapunov", "--level", "-1"], ["level = -1.0", "above 0"]),
    (["--gate", "lyapunov", "--level", "1", "--half-angle", "1"], ["half_angle = 1.0", "has no such term"]),
    (["--level", "-1"], ["level = -1.0", "the gate angle has no such term"]),
    (["--reference-x", "nan"], ["reference", "nan", "finite"]),
    (["--reference-x", "inf"], ["reference", "inf", "finite"]),
    (["--gains", "computed", "--design", "lqr", "--torque-constant", "1e-160"], ["gain"]),
    (["--gains", "computed", "--pole-length", "1e-300"], ["gain"]),
    (["--gate", "lyapunov", "--level", "1", "--torque-constant", "1e-160"], ["lyapunov"]),
    (["--config", "missing.toml"], ["missing.toml", "No such file"]),
    (["--config", "plant.json"], ["--config", "plant.json", ".toml"]),
    (["--config", "folder.toml"], ["folder.toml"]),
    (["--colour", "red"], ["unrecognized arguments: --colour red"]),
    (["up"], ["unrecognized arguments: up"]),
]


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A folder with files of every kind, made the current one."""
    plant = CartPole()
    law = StateFeedback([1.0, 2.0, 3.0, 4.0])
    io.save(tmp_path / "plant.json", plant)
    io.save(tmp_path / "motor.toml", Motor())
    io.save(tmp_path / "gate.json", AngleGate(0.5))
    io.save(tmp_path / "controller.json", Hybrid(law, law, AngleGate(0.5)))
    wanders = io.encode(Hybrid(law, law, AngleGate(0.5)))
    wanders["regulator"]["reference"]["x"] = math.nan
    files.write_json(tmp_path / "wanders.json", wanders)
    io.save(tmp_path / "batch.json", jax.tree.map(lambda leaf: np.array([leaf, leaf]), plant))
    (tmp_path / "list.json").write_text("[1, 2]", encoding="utf-8")
    (tmp_path / "broken.toml").write_text("[motor", encoding="utf-8")
    for name in ("folder.json", "folder.toml"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("flags", "words"), BAD_FLAGS, ids=lambda v: " ".join(v) if isinstance(v, list) else "")
def test_a_bad_flag_is_one_line_on_standard_error(command, workplace, no_pictures, flags, words):
    assert_refused(command("swingup", "--out", "out", *SHORT, *flags), workplace, *words)


LARGE = "1" + "0" * 400
BAD_FILES = [
    ("[plants]\n", ["section = 'plants'", "one of start, run, plant, controller"]),
    ("cart_mass = 1\n", ["section = 'cart_mass'", "one of start"]),
    ("plant = 'identified'\n", ["plant = 'identified'", "a section, written [plant]"]),
    ("[[plant]]\ncart_mass = 1\n", ["a section, written [plant]"]),
    ("[evaluation]\ncount = 3\n", ["section = 'evaluation'"]),
    ("[plant]\nmass = 1\n", ["[plant] key = 'mass'", "one of base, cart_mass"]),
    ("[plant]\nplant = 'identified'\n", ["[plant] key = 'plant'", "one of base, "]),
    ("[plant]\n'größe' = 1\n", ["[plant] key = 'größe'"]),
    ("[run]\nseed = 3\n", ["[run] key = 'seed'", "one of duration"]),
    ("[run]\nsave_every = 3\n", ["[run] key = 'save_every'", "one of duration"]),
    ("[plant]\ncart_mass = '1'\n", ["[plant] cart_mass = '1'", "a number"]),
    ("[plant]\ncart_mass = true\n", ["[plant] cart_mass = True", "a number"]),
    ("[plant]\ncart_mass = [1.0]\n", ["[plant] cart_mass = [1.0]", "a number"]),
    ("[plant]\ncart_mass = {kg = 1}\n", ["[plant] cart_mass = {'kg': 1}", "a number"]),
    ("[plant]\ncart_mass = 1979-05-27\n", ["[plant] cart_mass", "a number"]),
    ("[plant]\ncart_mass = nan\n", ["cart_mass = nan", "above 0 [kg]"]),
    ("[plant]\ncart_mass = -1\n", ["cart_mass = -1.0", "above 0 [kg]"]),
    (f"[plant]\ncart_mass = {LARGE}\n", ["cart_mass"]),
    (f"[start]\ntheta = {LARGE}\n", ["theta"]),
    (f"[run]\ndt = {LARGE}\n", ["dt"]),
    ("[plant]\nbase = 1\n", ["[plant] base = 1", "a text"]),
    ("[start]\nset = 'nowhere'\n", ["[start] set = 'nowhere'", "one of hanging, anywhere, wide, rest"]),
    ("[start]\ntheta = inf\n", ["theta = inf", "finite"]),
    ("[run]\nclock = 'Sampled'\n", ["[run] clock = 'Sampled'", "one of sampled, continuous"]),
    ("[run]\nclock = 1\n", ["[run] clock = 1", "a text"]),
    ("[controller]\nlaw = 'best'\n", ["[controller] law = 'best'", "one of as-printed"]),
    ("[controller]\nK = [1, 2, 3]\n", ["[controller] K = [1, 2, 3]", "a list of 4 values"]),
    ("[controller]\nK = 1\n", ["[controller] K = 1", "a list of 4 values"]),
    ("[controller]\nK = [1, 2, 3, 'x']\n", ["[controller] K = [1, 2, 3, 'x']", "a number"]),
    ("[controller]\nK = [[1, 2, 3, 4]]\n", ["[controller] K = [[1, 2, 3, 4]]", "a list of 4 values"]),
    ("[controller]\nK = [1, 2, 3, true]\n", ["[controller] K = [1, 2, 3, True]", "a number"]),
    ("[controller]\nfile = 'controller.json'\nlaw = 'corrected'\n", ["controller.json", "alone, without law"]),
    ("[plant\n", ["run.toml", "a valid TOML file"]),
    ("[plant]\ncart_mass = 1\ncart_mass = 2\n", ["run.toml", "a valid TOML file"]),
    ("\ufeff[plant]\n", ["run.toml", "a valid TOML file"]),
]


@pytest.mark.parametrize(("text", "words"), BAD_FILES, ids=lambda v: repr(v)[:40] if isinstance(v, str) else "")
def test_a_bad_file_of_options_is_one_line_on_standard_error(command, workplace, no_pictures, text, words):
    (workplace / "run.toml").write_text(text, encoding="utf-8")
    rest = [flag for flag in SHORT if "dt" not in text] or ["--duration", "0.1"]
    assert_refused(command("swingup", "--out", "out", *rest, "--config", "run.toml"), workplace, *words)


def test_a_file_of_options_that_is_no_text_is_one_line_on_standard_error(command, workplace):
    (workplace / "run.toml").write_bytes(b"\xff\xfe\x00")
    assert_refused(
        command("swingup", "--out", "out", "--config", "run.toml"), workplace, "run.toml", "a readable text file"
    )


BAD_EVALUATIONS = [
    (["--count", "0"], ["count = 0", "a whole number, at least 1"]),
    (["--count", "-3"], ["count = -3", "a whole number, at least 1"]),
    (["--count", "1.5"], ["--count", "'1.5'"]),
    (["--count", "1000000000000000"], ["count = 1000000000000000"]),
    (["--count", "1" + 30 * "0"], ["count = 1000"]),
    (["--seed", "-1"], ["seed = -1", "a whole number, at least 0"]),
    (["--starts", "everywhere"], ["--starts", "'everywhere'", "hanging"]),
    (["--dt", "0"], ["dt = 0.0", "above 0 [s]"]),
    (["--duration", "inf"], ["duration = inf", "a finite number"]),
    (["--duration", "0.015", "--dt", "0.01"], ["duration = 0.015", "a whole multiple"]),
    (["--plant", "identified"], ["unrecognized arguments: --plant"]),
]


@pytest.mark.parametrize("name", ["reproduce", "report"])
@pytest.mark.parametrize(("flags", "words"), BAD_EVALUATIONS, ids=lambda v: " ".join(v)[:30])
def test_a_bad_evaluation_is_one_line_on_standard_error(command, workplace, no_pictures, name, flags, words):
    result = command(name, "--out", "out", "--count", "2", *flags)
    assert_refused(result, workplace, *words, command_name=name)


@pytest.mark.parametrize("name", ["swingup", "reproduce", "report"])
def test_a_place_that_cannot_be_written_is_one_line_on_standard_error(
    command, workplace, no_pictures, monkeypatch, name
):
    monkeypatch.setattr(reproduction, "evaluate", fake_evaluate)
    (workplace / "taken").write_text("", encoding="utf-8")
    result = command(name, "--out", "taken", *SHORT)
    assert result.code == 2
    assert result.err.splitlines()[-1].startswith(f"cpjax {name}: error: path = 'taken/")
    assert "a place that can be written" in result.err
    assert "Traceback" not in result.err
    assert (workplace / "taken").read_text(encoding="utf-8") == ""


def test_odd_names_of_folders_are_taken_as_they_are(command, workplace, no_pictures):
    for folder in ("größe 大", "[bold]x[/bold]", "a/b/../c", "-"):
        result = command("swingup", f"--out={folder}", *SHORT)
        assert (result.code, result.err) == (1, "")
        assert (workplace / folder / "swingup.json").exists()
        assert f"wrote {folder}/swingup.json" in result.out


# --- help, version, exit codes ----------------------------------------------------------------------------------------


@rows("name", ["swingup", "design", "reproduce", "audit-gains", "report"])
def test_the_help_of_a_command_exits_with_0_and_names_what_every_command_has(command, name):
    result = command(name, "--help")
    assert (result.code, result.err) == (0, "")
    for option in ("--seed", "--out", "--config"):
        assert option in result.out


def test_the_help_of_swingup_names_every_option_with_its_section(command):
    text = command("swingup", "--help").out
    for option in OPTIONS:
        assert option.name in text
        assert f"[{option.section}]" in text


def test_the_main_help_names_the_commands_and_the_exit_codes(command):
    result = command("--help")
    assert result.code == 0
    for word in ("swingup", "design", "reproduce", "audit-gains", "report", "exit codes", "130"):
        assert word in result.out


@rows("arguments", [[], ["upswing"], ["--verbose"]], ids=str)
def test_no_or_an_unknown_command_is_one_line_on_standard_error(command, tmp_path, arguments):
    assert_refused(command(*arguments), tmp_path)


def test_the_module_runs_as_a_program_and_knows_its_version():
    done = subprocess.run([sys.executable, "-m", "cpjax", "--version"], check=False, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"cpjax {cpjax.__version__}\n", "")


# --- reproduce and report ---------------------------------------------------------------------------------------------

EVALUATION = ("--count", "8", *LONG)
FIGURES = {"success.png", "figures-3-6-as-printed-appendix.png", "figures-3-6-corrected-centred-appendix.png"}


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):
    """One real run, with its pictures: folder, exit code and what it printed."""
    folder = tmp_path_factory.mktemp("reproduced")
    out, err = buffers.StringIO(), buffers.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", out)
        patch.setattr(sys, "stderr", err)
        code = main(["reproduce", "--out", str(folder), *EVALUATION])
    return SimpleNamespace(folder=folder, code=code, out=out.getvalue(), err=err.getvalue())


def same(a, b):
    """Equality of plain values in which NaN equals NaN."""
    return repr(a) == repr(b)


def fake_evaluate(variant, setting, starts=None):
    """Metrics that cost nothing and differ from variant to variant."""
    rng = np.random.default_rng(variants().index(variant))
    numbers = {name: rng.uniform(1.0, 5.0, setting.count) for name in Metrics.__dataclass_fields__}
    whole = {"switches": rng.integers(0, 9, setting.count), "flag": np.zeros(setting.count, np.int32)}
    return Metrics(**{**numbers, **whole, "success": rng.uniform(size=setting.count) < 0.5})


def test_a_reproduction_writes_its_rows_and_pictures_and_nothing_else(reproduced):
    assert reproduced.code == 0
    assert {p.name for p in reproduced.folder.iterdir()} == {"reproduction.json", *FIGURES}
    for name in FIGURES:
        assert (reproduced.folder / name).read_bytes().startswith(PNG)
    table = strict_json(reproduced.folder / "reproduction.json")
    assert table["complete"] is True
    assert table["versions"] == files.versions()
    assert table["setting"] == {"starts": "hanging", "count": 8, "seed": 1, "duration": 12.0, "dt": 0.01}


def test_a_reproduction_has_one_row_for_every_law_plant_regulator_and_gain(reproduced):
    rows = document(reproduced.folder, "reproduction.json")["rows"]
    names = [(row["law"], row["plant"], row["design"], row["gains"]) for row in rows]
    assert len(set(names)) == len(names) == 4 * 2 * 2 * 2
    for row in rows:
        low, high = row["success_interval"]
        assert row["count"] == 8
        assert row["success_rate"] == row["successes"] / 8
        assert low <= row["success_rate"] <= high


def test_a_row_is_what_the_library_says_of_that_variant(reproduced):
    rows = document(reproduced.folder, "reproduction.json")["rows"]
    for index in (5, 26):
        row = rows[index]
        expected = summarise(evaluate(variants()[index], SETTING))
        assert 0 < row["successes"] <= 8
        assert same({key: row[key] for key in expected}, as_plain(expected))


def test_a_reproduction_prints_one_line_for_each_row_and_its_progress_in_order(reproduced):
    lines = reproduced.err.splitlines()
    assert [line.split()[1] for line in lines] == [f"{i}/32" for i in range(33)]
    assert reproduced.out.count("pole placement │") == reproduced.out.count("LQR            │") == 16
    assert f"wrote {reproduced.folder / 'reproduction.json'}" in reproduced.out


def test_an_interrupted_reproduction_resumes_and_ends_with_identical_rows(
    command, tmp_path, no_pictures, monkeypatch, reproduced
):
    calls = []

    def interrupted(*arguments):
        if len(calls) == 29:
            raise KeyboardInterrupt
        calls.append(arguments)
        return evaluate(*arguments)

    monkeypatch.setattr(reproduction, "evaluate", interrupted)
    first = command("reproduce", "--out", tmp_path, *EVALUATION)
    assert first.code == 130
    assert first.err.splitlines()[-1] == "cpjax reproduce: interrupted; what was saved so far is kept"
    assert {p.name for p in tmp_path.iterdir()} == {"reproduction.parts"}
    assert len([*(tmp_path / "reproduction.parts").glob("row-*.npz")]) == 29

    resumed = []
    monkeypatch.setattr(reproduction, "evaluate", lambda *arguments: resumed.append(arguments) or evaluate(*arguments))
    second = command("reproduce", "--out", tmp_path, *EVALUATION)
    assert second.code == 0
    assert [arguments[0] for arguments in resumed] == variants()[29:]
    assert second.err.startswith("reproduce: 29/32 ")
    whole = (reproduced.folder / "reproduction.json").read_bytes()
    assert (tmp_path / "reproduction.json").read_bytes() == whole


@pytest.fixture
def partial(tmp_path, monkeypatch):
    """A run that was interrupted after three rows; how many are computed when it is started again."""
    path = tmp_path / "reproduction.json"
    setting = EvaluationConfig(count=3)

    def stop(*arguments):
        if arguments[0] == variants()[3]:
            raise KeyboardInterrupt
        return fake_evaluate(*arguments)

    monkeypatch.setattr(reproduction, "evaluate", stop)
    with pytest.raises(KeyboardInterrupt):
        reproduce(setting, path=path)

    def again(new_setting=setting):
        computed = []
        monkeypatch.setattr(reproduction, "evaluate", lambda v, *rest: computed.append(v) or fake_evaluate(v, *rest))
        rows = reproduce(new_setting, path=path)
        names = [(row["law"], row["plant"], row["design"], row["gains"]) for row in rows]
        assert names == [(v.law, v.plant, v.design, v.gains) for v in variants()]
        assert strict_json(path)["rows"] == json.loads(files.dump_json(rows))
        assert [p.name for p in tmp_path.iterdir()] == [path.name]
        return len(computed)

    return SimpleNamespace(path=path, again=again)


def test_an_unchanged_run_takes_over_the_rows_that_are_there(partial):
    assert partial.again() == 29
    assert partial.again() == 32  # a complete run is computed anew


@rows("change", [{"seed": 2}, {"count": 4}, {"duration": 19.0}, {"dt": 0.001}, {"starts": "rest"}])
def test_rows_of_another_setting_are_refused(change, partial):
    with pytest.raises(InputError, match="a place without the parts of other work"):
        partial.again(EvaluationConfig(**{"count": 3, **change}))


def test_rows_of_other_versions_are_refused(partial, monkeypatch):
    monkeypatch.setattr(files, "versions", lambda: {"jax": "0.0.1"})
    with pytest.raises(InputError, match="a place without the parts of other work"):
        partial.again()


def test_the_table_can_be_printed_where_only_ascii_is_known(monkeypatch, reproduced):
    rows = document(reproduced.folder, "reproduction.json")["rows"]
    monkeypatch.setattr(sys, "stdout", buffers.TextIOWrapper(buffers.BytesIO(), encoding="ascii"))
    print_rows(rows)
    sys.stdout.flush()


class Page(html.parser.HTMLParser):
    """What a report is made of: every tag, the cells of its table, and its text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.rows, self.words = [], [], []
        self._open = []
        self.feed(text)
        self.close()
        assert self._open == [], "unclosed tags"

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in ("meta", "img", "link", "br"):
            self._open.append(tag)
        if tag == "tr":
            self.rows.append([])

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)
        if self._open and self._open[-1] in ("td", "th"):
            self.rows[-1].append(data)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """One real report: folder, exit code, page and the text of its file."""
    folder = tmp_path_factory.mktemp("report")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", buffers.StringIO())
        patch.setattr(sys, "stderr", buffers.StringIO())
        patch.setattr(report_sections, "AUDIT_STARTS", 4)
        code = main(["report", "--out", str(folder), *EVALUATION, "--cells", "0", "--studies", "none"])
    text = (folder / "report.html").read_text(encoding="utf-8")
    return SimpleNamespace(folder=folder, code=code, text=text, page=Page(text))


def test_a_report_writes_its_page_beside_the_rows_and_pictures(report):
    assert report.code == 0
    data = {"reproduction.json", "designs.json", "audit_gains.json", "compare.json"}
    pictures = {"audit_gains.png", "responses.png", "phase.png", "by_start.png", *FIGURES}
    assert {p.name for p in report.folder.iterdir()} == {"report.html", *data, *pictures}


def test_a_reports_rows_are_those_of_the_reproduction(report, reproduced):
    assert document(report.folder, "reproduction.json") is not None
    ours, theirs = ((f / "reproduction.json").read_bytes() for f in (report.folder, reproduced.folder))
    assert ours == theirs


def test_a_report_is_one_valid_page_that_loads_nothing_from_elsewhere(report):
    assert report.text.startswith("<!doctype html>")
    tags = [tag for tag, _ in report.page.tags]
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(tags)
    for tag, attributes in report.page.tags:
        assert not [name for name in attributes if name.startswith("on")]
        for name in ("href", "src", "srcset", "data", "action"):
            own = {"img": "data:image/png;base64,", "a": "#part-"}.get(tag, "nothing")
            assert name not in attributes or attributes[name].startswith(own)
    assert "@import" not in report.text
    assert "url(" not in report.text
    assert "http" not in re.sub(r"data:image/png;base64,[^\"]*", "", report.text)


def test_a_report_begins_with_four_numbers_a_picture_and_links_to_its_parts(report):
    kinds = [(tag, attributes) for tag, attributes in report.page.tags if tag in ("b", "img", "a", "h2")]
    assert [tag for tag, _ in kinds[:5]] == ["b"] * 4 + ["img"]
    assert kinds[5][0] == "a"
    links = [attributes["href"] for tag, attributes in kinds if tag == "a"]
    assert links == [f"#{attributes['id']}" for tag, attributes in kinds if tag == "h2"]
    rows = document(report.folder, "compare.json")["rows"]
    rates = [f"{100 * row['success_rate']:.1f} %" for row in rows if row["gains"] == "tuned"]
    assert [word for word in report.page.words if word.endswith(" %")][2:4] == rates


def test_every_picture_of_a_report_is_inside_it_and_described(report):
    pictures = [attributes for tag, attributes in report.page.tags if tag == "img"]
    assert len(pictures) == len(FIGURES) + 4  # the audit's, and the comparison's three
    for picture in pictures:
        assert picture["src"].startswith("data:image/png;base64,iVBOR")
        assert len(picture["alt"]) > 20


def test_the_numbers_in_a_reports_table_are_those_of_its_json(report):
    rows = document(report.folder, "reproduction.json")["rows"]
    header, *body = report.page.rows[:33]
    assert len(body) == len(rows) == 32
    for cells, row in zip(body, rows, strict=True):
        shown = dict(zip(header, cells, strict=True))
        assert (shown["law"], shown["plant"], shown["gains"]) == (row["law"], row["plant"], row["gains"])
        assert shown["regulator"] == {"lqr": "LQR", "placement": "pole placement"}[row["design"]]
        assert shown["success [%]"] == f"{100 * row['successes'] / row['count']:.2f}"
        assert shown["95 % interval"] == "-".join(f"{100 * end:.2f}" for end in row["success_interval"])
        good = row["over_successes"]
        expected = {
            "settling mean [s]": f"{good['settling_time']['mean']:.2f}",
            "median [s]": f"{good['settling_time']['median']:.2f}",
            "travel mean [m]": f"{good['cart_travel']['mean']:.2f}",
            "variation mean [V]": f"{good['voltage_variation']['mean']:.0f}",
        }
        if row["successes"] == 0:
            assert {shown[name] for name in expected} == {"-"}
        else:
            assert {name: shown[name] for name in expected} == expected
        assert shown["peak [V]"] == f"{row['over_all']['peak_voltage']['max']:.1f}"


def test_the_designs_in_a_report_are_those_of_its_json(report):
    designs = document(report.folder, "designs.json")
    header, *body = report.page.rows[33:38]
    assert header[0] == "regulator"
    assert len(body) == len(designs) == 4
    for cells, check in zip(body, designs.values(), strict=True):
        shown = dict(zip(header, cells, strict=True))
        assert shown["voltage at the switch [V]"] == f"{check['gate_voltage']:.0f}"
        assert shown["saturates beyond [deg]"] == f"{math.degrees(check['saturation_angle']):.2f}"
        assert shown["phase margin [deg]"] == f"{math.degrees(check['margins']['phase']):.0f}"
    assert [round(check["gate_voltage"]) for check in designs.values()] == [58, 61, 2511, 2512]


def test_the_audit_in_a_report_is_that_of_its_json(report):
    audit = document(report.folder, "audit_gains.json")
    explaining = [row for row in report.page.rows if row and row[0] == "torque_constant, back_emf_constant"]
    assert len(explaining) == 1
    fit = next(f for f in audit["simplest"] if f["parameters"] == ["torque_constant", "back_emf_constant"])
    assert explaining[0][2] == f"{fit['worst']:.3g}"
    assert explaining[0][3:5] == ["1.03846", "1.93006"]
    assert f"{len(audit['simplest'])} of 91" in "".join(report.page.words)


def test_the_comparison_in_a_report_is_that_of_its_json(report):
    rows = document(report.folder, "compare.json")["rows"]
    tuned = [cells for cells in report.page.rows if cells and cells[0] == "tuned"]
    expected = [row for row in rows if row["gains"] == "tuned"]
    assert len(tuned) == len(expected) == 2
    for cells, row in zip(tuned, expected, strict=True):
        assert cells[3] == f"{100 * row['success_rate']:.2f}"
        assert cells[5] == f"{row['over_successes']['settling_time']['mean']:.2f}"


@pytest.mark.slow
def test_the_studies_in_a_report_are_those_of_its_json(command, tmp_path, monkeypatch):
    monkeypatch.setattr(report_sections, "gain_identification", lambda page, given: None)
    fronts = {"bounds": 2, "candidates": 64, "steps": 2, "reevaluation": 16, "final": 16}
    monkeypatch.setattr(report_sections, "QUICK_FRONTS", fronts)
    tuning = {"candidates": 15, "restarts": 2, "batch": 2, "steps": 2, "final": 64}
    monkeypatch.setattr(report_sections, "QUICK_TUNING", tuning)
    card = {"values": 2, "starts": 2, "rigs": 2}
    monkeypatch.setattr(report_sections, "QUICK_CARD", card)
    monkeypatch.setattr(report_sections, "QUICK_CARDS", ("tuned_place",))
    monkeypatch.setattr(report_sections, "QUICK_AUDIT", {"count": 2, "duration": 1.0, "dt": 0.005})
    assert command("report", "--out", tmp_path, *EVALUATION, "--cells", "8").code == 0
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    sources = [attributes["src"][:15] for tag, attributes in page.tags if tag == "img"]
    assert sources.count("data:image/gif;") == 1
    audit = document(tmp_path, "audit_gradients.json")
    assert [cells[0] for cells in page.rows if cells[0] in audit["names"]] == audit["names"]
    found = document(tmp_path / "tune-placement", "tune.json")
    expected = ["pole placement", f"{100 * found['success_rate']:.2f}", f"{found['settling_time']:.3f}"]
    assert expected in [cells[:3] for cells in page.rows]
    basins = document(tmp_path, "basin.json")["basins"]
    titles = [controller_title(name) for name in CONTROLLERS]
    shown = [cells[:2] for cells in page.rows]
    for name, title in zip(CONTROLLERS, titles, strict=True):
        assert [title, f"{100 * basins[name]['share']:.2f}"] in shown
    cards = document(tmp_path, "robustness.json")["cards"]
    assert list(cards) == ["tuned_place"]
    assert io.load(tmp_path / "bench.toml").drive.dead_band == 0.2
    assert all((tmp_path / file_of(name)).exists() for name in CONTROLLERS)
    fronts = document(tmp_path, "pareto.json")["fronts"]["lqr"]["rows"]
    rows = [cells for cells in page.rows if cells and cells[0] == "lqr" and cells[1] == "cart_travel"]
    expected = next(row for row in fronts if row["cost"] == "cart_travel")["traced"]["volume"]
    assert rows[0][6] == f"{expected:.4g}"


def test_a_report_names_its_setting_and_the_command_that_makes_it_again(report):
    text = "".join(report.page.words)
    assert "8 initial states from the set hanging (seed 1), 12 s each, RK4 with a step of 10 ms" in text
    assert "cpjax report --starts hanging --count 8 --seed 1 --duration 12 --dt 0.01 --cells 0 --studies none" in text


@pytest.mark.slow
def test_a_report_of_odd_numbers_gives_the_command_with_all_their_digits(command, tmp_path, no_pictures, monkeypatch):
    monkeypatch.setattr(reproduction, "evaluate", fake_evaluate)
    for section in ("designs", "gain_identification"):
        monkeypatch.setattr(report_sections, section, lambda page, given: None)
    few = ("--count", "3", "--cells", "0", "--studies", "none")
    command("report", "--out", tmp_path, *few, "--duration", "1.23456789", "--dt", "0.00123456789")
    text = "".join(Page((tmp_path / "report.html").read_text(encoding="utf-8")).words)
    assert "--duration 1.23456789 --dt 0.00123456789" in text


# --- pictures ---------------------------------------------------------------------------------------------------------


def test_a_pole_that_spins_hundreds_of_turns_does_not_fill_the_picture_with_lines():
    run = trajectory("corrected-centred", "placement", "appendix", HANGING, SETTING)
    spinning = dataclasses.replace(run, state=dataclasses.replace(run.state, theta=100.0 * math.tau * run.time))
    figure = cpjax.show.figures.response(spinning, "spinning", 12.0, 12.0)
    assert sum(len(axes.lines) for axes in figure.axes) < 100
