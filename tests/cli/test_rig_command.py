"""`cpjax rig`, and --rig of the other commands."""

import dataclasses
import json
import math

import numpy as np
import pytest
from oracles import derivative
from tables import rows

import cpjax.show.figures
from cpjax import (
    CartPole,
    Digital,
    Disturbance,
    Drive,
    Encoders,
    FilteredDerivative,
    ForceActuator,
    InputError,
    LumpedMotor,
    Motor,
    Rig,
    State,
    Track,
    files,
    io,
    kalman_observer,
    load,
    paper,
    rollout,
)
from cpjax.cli import animate, basin, compare, robustness, sweep
from cpjax.cli.notes import papers_own
from cpjax.cli.rig_file import rig_text
from cpjax.cli.rigs import Firmware, build_firmware, build_rig, load_rig, with_usual_period
from cpjax.pytree import numbers
from cpjax.rig import PRESETS
from cpjax.rig import rig as named_rig
from cpjax.study import rig_check
from cpjax.study.fronts import evaluator
from cpjax.study.fronts.config import FrontConfig
from cpjax.study.fronts.evaluator import EVALUATION, Evaluator
from cpjax.study.rig_check import check_rig, document
from cpjax.study.swing_up_search import search_swing_up

QUANSER = "quanser-ip02-long"
FULL = Rig(
    CartPole(
        cart_mass=0.8,
        pole_mass=0.3,
        pole_length=0.4,
        pole_inertia=0.01,
        cart_friction=0.7,
        pivot_friction=0.002,
        motor=Motor(torque_constant=0.03, back_emf_constant=0.03, resistance=2.0, wheel_radius=0.02, gear_ratio=5.0),
    ),
    Encoders(x_step=1e-4, theta_step=2e-3, x_noise=1e-4),
    Drive(delay=0.01, dead_band=0.6),
    Track(0.5),
)
"""A rig with all parts."""


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr(cpjax.show.figures, "response", lambda *_: None)
    monkeypatch.setattr(cpjax.show.figures, "save_figure", lambda *_: None)


# --- the file ---------------------------------------------------------------------------------------------------------


@rows("name", list(PRESETS))
def test_the_printed_file_of_a_public_rig_is_that_rig_and_says_where_it_is_from(command, tmp_path, name):
    result = command("rig", "show", name)
    assert (result.code, result.err) == (0, "")
    (tmp_path / "mine.toml").write_text(result.out, encoding="utf-8")
    made = named_rig(name)
    assert io.encode(load(tmp_path / "mine.toml")) == io.encode(made)
    flat = " ".join(result.out.replace("# ", "").split())
    for words in (PRESETS[name].source, PRESETS[name].note, f"{PRESETS[name].period:g} s"):
        assert " ".join(words.split()) in flat
    for rule in numbers(CartPole, type(made.plant.motor), Encoders, Drive, Track).values():
        assert f"# {rule.help} [{rule.unit}]" in result.out


def test_parts_that_a_rig_lacks_are_there_to_be_uncommented(tmp_path):
    text = rig_text(Rig(FULL.plant))
    begin = text.index("# [sensors]")
    below = [line for line in text[begin:].splitlines() if " = " in line or "# [" in line]
    filled = "\n".join(line.removeprefix("# ").replace("?", "0.25") for line in below)
    (tmp_path / "rig.toml").write_text(text[:begin] + filled, encoding="utf-8")
    expected = Rig(FULL.plant, Encoders(x_step=0.25, theta_step=0.25), Drive(), Track(0.25), Disturbance())
    assert io.encode(load(tmp_path / "rig.toml")) == io.encode(expected)


def test_the_list_has_every_public_rig_with_its_source(command):
    result = command("rig", "list")
    flat = " ".join(result.out.replace("│", " ").split())
    assert result.code == 0
    assert all(name in flat and one.source[:30] in flat for name, one in PRESETS.items())


# --- the check --------------------------------------------------------------------------------------------------------


def test_the_figures_of_a_check_are_those_computed_by_hand(monkeypatch):
    monkeypatch.setattr(rig_check, "search_swing_up", search_result)
    check = check_rig(FULL, period=0.004)
    plant, turns = FULL.plant, 5.0 / 0.02
    rotor = turns**2 * 7e-6
    M, m, length, inertia = 0.8 + rotor, 0.3, 0.4, 0.01 + 0.3 * 0.4**2
    stall = 12.0 * turns * 0.03 / 2.0
    damping = turns**2 * (1e-5 + 0.03 * 0.03 / 2.0)
    mass = np.array([[M + m, -m * length], [-m * length, inertia]])
    stiff, loss = np.array([[0.0, 0.0], [0.0, m * 9.81 * length]]), np.diag([damping + 0.7, 0.002])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [np.linalg.solve(mass, stiff), -np.linalg.solve(mass, loss)]])
    poles = np.linalg.eigvals(A)
    expected = {
        "moving_mass": M,
        "reflected_mass": rotor,
        "supply": float(plant.motor.voltage_limit),
        "stall_force": stall,
        "no_load_speed": stall / damping,
        "top_speed": stall / (damping + 0.7),
        "hold_angle": math.atan(stall / ((M + m) * 9.81)),
        "dead_band_share": 0.6 / 12.0,
        "swing_period": 2 * math.pi * math.sqrt(inertia / (m * 9.81 * length)),
        "fall_time": 1.0 / np.max(poles.real),
        "fastest": 1.0 / np.max(np.abs(poles)),
        "needed_period": 0.1 / np.max(np.abs(poles)),
        "samples": 250.0 / np.max(np.abs(poles)),
        "dead_time_share": (0.01 + 0.002) * np.max(poles.real),
        "x_speed": 1e-4 / 0.004,
        "theta_speed": 2e-3 / 0.004,
        "delay_periods": 2.5,
    }
    for key, value in expected.items():
        assert check[key] == pytest.approx(value, rel=1e-9), key
    assert check["controllable"] is True
    assert any("samples of the fastest time constant" in text for text in check.warnings) == (check["samples"] < 10)
    assert not any(word in text for text in check.warnings for word in ("no sensors", "no drive", "no track", "rotor"))


def search_result(rig, seed):
    """The search's result, without a search."""
    from cpjax.study.swing_up_search import Pump, SwingUpSearch

    return SwingUpSearch(False, 0.4, math.inf, 0.1, Pump(1.0, 1.0, 0.0, 1.0, 1.0, 1.0), 512, 10.0)


def test_a_check_says_in_words_what_a_rig_leaves_out(command, tmp_path, monkeypatch):
    monkeypatch.setattr(rig_check, "search_swing_up", search_result)
    geared = Motor(rotor_inertia=0.0, gear_ratio=20.0, wheel_radius=0.02, voltage_limit=math.inf)
    io.save(tmp_path / "bare.toml", CartPole(motor=geared))
    result = command("rig", "check", tmp_path / "bare.toml", "--out", tmp_path)
    table = files.read_table(tmp_path / "rig.json")
    assert result.code == 0
    assert table["figures"]["period"] == 0.002
    assert table["figures"]["stall_force"] == math.inf
    for words in (
        "the rotor has no inertia",
        "efficiencies",
        "no limit",
        "no cart friction and no pivot friction",
        "no sensors",
        "no drive",
        "no track",
        "no swing-up was found in 512 runs: the pendulum gets 40 %",
    ):
        assert any(words in text for text in table["warnings"]), words
        assert words in result.out
    assert table["rig"]["plant"] == table["plant"]
    force = document(check_rig(Rig(CartPole(motor=ForceActuator())), seed=1), Rig(CartPole()))
    assert force["figures"]["no_load_speed"] == math.inf
    assert "the drive is a force" in force["warnings"][0]


@pytest.mark.slow
def test_a_swing_up_that_the_search_finds_is_one_by_another_integrator_too():
    possible, impossible = (dataclasses.replace(FULL, track=Track(length)) for length in (0.5, 0.003))
    found, none = search_swing_up(possible, seed=3), search_swing_up(impossible, seed=3)
    assert (found.found, none.found) == (True, False)
    assert 0.0 < none.share < 1.0
    assert none.travel <= 0.003
    law, plant, dt = found.law, FULL.plant, found.duration / 3000
    s, furthest, energies = np.array([0.0, 0.0, math.pi - 0.02, 0.0]), 0.0, []
    for _ in range(round(found.time / dt)):
        u = float(np.clip(float(law.voltage(State(*s))), -12.0, 12.0))
        u = 0.0 if abs(u) <= 0.6 else u
        k1 = derivative(plant, s, u)
        k2 = derivative(plant, s + 0.5 * dt * k1, u)
        k3 = derivative(plant, s + 0.5 * dt * k2, u)
        s = s + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + derivative(plant, s + dt * k3, u))
        furthest = max(furthest, abs(s[0]))
        energies.append(0.5 * 0.058 * s[3] ** 2 + 0.3 * 9.81 * 0.4 * (math.cos(s[2]) - 1.0))
    assert energies[-1] >= 0.0 > energies[-2]
    assert furthest == pytest.approx(found.travel, rel=1e-6)
    assert furthest < 0.5


# --- --rig ------------------------------------------------------------------------------------------------------------


def test_a_swing_up_on_a_rig_with_encoders_runs_behind_an_estimator_and_says_so(command, tmp_path, no_pictures):
    short = ("--rig", QUANSER, "--duration", "2.5")
    result = command("swingup", *short, "--theta", "0.1", "--cart-mass", "0.95", "--out", tmp_path / "near")
    assert result.code == 0
    assert "a Kalman filter designed for the plant and a control period of 0.002 s" in result.err
    table = files.read_table(tmp_path / "near" / "swingup.json")
    rig = named_rig(QUANSER)
    rig = dataclasses.replace(rig, plant=dataclasses.replace(rig.plant, cart_mass=0.95))
    assert (table["rig"], table["plant"]) == (io.encode(rig), io.encode(rig.plant))
    step = 1.0 / math.sqrt(12.0)
    observer = kalman_observer(
        rig.plant, period=0.002, x_deviation=2.275e-5 * step, theta_deviation=2 * math.pi / 4096 * step
    )
    gain = np.asarray(table["firmware"]["estimator"]["gain"])
    np.testing.assert_allclose(gain, observer.gain, rtol=1e-9)
    observer = dataclasses.replace(observer, gain=gain)
    law = Digital(paper.controller("corrected-centred", "placement", rig.plant, "computed"), observer)
    start = State(0.0, 0.0, 0.1, 0.0)
    run = rollout(rig, law, start, duration=2.5, dt=0.002, control_period=0.002, seed=1)
    assert table["trajectory"]["x"] == np.asarray(run.state.x).tolist()
    again = load_rig(str(tmp_path / "near" / "swingup.json"))
    assert io.encode(again) == io.encode(rig)
    result = command("swingup", *short, "--out", tmp_path / "rest")
    assert result.code == 1
    assert "why: the cart left the track, 0.4 m each way, at " in result.out


def test_the_estimator_is_chosen_and_an_unfit_one_is_refused():
    setting = {"dt": 0.002}
    raised = build_firmware({}, FULL, setting, 5)
    assert isinstance(raised, Firmware)
    assert (raised.dead_band, raised.delay, raised.simulation) == (0.6, 5, {"seed": 5})
    assert "predicts them over 5 periods, the drive's delay of 0.01 s" in raised.notes[0]
    deviations = {"x_deviation": math.sqrt(1e-8 / 12 + 1e-8), "theta_deviation": 2e-3 / math.sqrt(12.0)}
    designed = kalman_observer(FULL.plant, period=0.002, **deviations)
    np.testing.assert_allclose(raised.estimator.gain, designed.gain, rtol=1e-9)
    differences = build_firmware({"estimator": "derivative"}, FULL, setting, 1)
    assert (float(differences.estimator.cutoff), differences.delay) == (300.0, 0)
    assert "the drive's delay of 0.01 s is not predicted" in differences.notes[0]
    law = object()
    assert build_firmware({"estimator": "none"}, FULL, setting, 1)(law) is law
    assert "nothing raises them" in build_firmware({"estimator": "none"}, FULL, setting, 1).notes[0]
    firmware = Digital(paper.controller("corrected", "lqr", paper.appendix_plant()), FilteredDerivative(9.0))
    assert build_firmware({}, FULL, setting, 1, firmware)(firmware) is firmware
    assert build_firmware({}, FULL.plant, setting, 1).entries() == {}
    for given, rig, how, field in (
        ({"cutoff": 9.0}, FULL, setting, "cutoff"),
        ({"estimator": "kalman"}, FULL.plant, setting, "estimator"),
        ({"estimator": "kalman"}, FULL, {**setting, "clock": "continuous"}, "estimator"),
        ({}, FULL, {**setting, "clock": "continuous", "switching": "located"}, "switching"),
        ({}, FULL, {"dt": -1.0}, "dt"),
    ):
        with pytest.raises(InputError) as caught:
            build_firmware(given, rig, how, 1)
        assert caught.value.field == field
    with pytest.raises(InputError, match="estimator of its own"):
        build_firmware({"estimator": "kalman"}, FULL, setting, 1, firmware)


def test_a_robustness_card_is_that_of_firmware_from_a_file(command, tmp_path, monkeypatch):
    firmware = Digital(paper.controller("corrected", "lqr", paper.appendix_plant()), FilteredDerivative(90.0))
    io.save(tmp_path / "firmware.toml", firmware)
    io.save(tmp_path / "mine.toml", FULL)
    seen = []

    def card(rig, controller, *_, **__):
        seen.append((io.encode(rig), io.encode(controller)))
        raise InputError("rig", "seen", "no more")

    monkeypatch.setattr(robustness, "robustness_card", card)
    given = ("--rig", tmp_path / "mine.toml", "--controllers", tmp_path / "firmware.toml", "--out", tmp_path / "out")
    assert command("robustness", *given).code == 2
    assert seen == [(io.encode(FULL), io.encode(firmware))]
    assert "absent: the controller is a Digital" in command("robustness", *given, "--estimator", "kalman").err


def test_a_rig_by_name_has_its_usual_control_period_unless_another_is_given():
    named, by_file, dt = {"rig": "sensorsini"}, {"rig": "mine.toml"}, {"dt": 0.002}
    assert with_usual_period(dt, {}, named)["control_period"] == 0.02
    assert with_usual_period({"dt": 0.01}, {"dt": 0.01}, named) == {"dt": 0.01}
    assert with_usual_period(dt, {"control_period": 0.004}, named)["control_period"] == 0.004
    assert with_usual_period(dt, {}, by_file) == with_usual_period(dt, {}, {}) == dt


class StoppedError(InputError):
    """Ends a command where the work would begin."""


@pytest.mark.parametrize(
    ("module", "work", "name"),
    [
        (sweep, "record_sweep", "sweep"),
        (basin, "run_basin", "basin"),
        (animate, "run_animation", "animate"),
        (compare, "run_comparison", "compare"),
    ],
)
def test_commands_of_many_runs_take_the_whole_rig_and_its_firmware(command, tmp_path, monkeypatch, module, work, name):
    def stopped(*arguments, **named):
        asked.extend([*arguments, *named.values()])
        options.update(named)
        raise StoppedError("work", 0, "done")

    asked, options = [], {}
    monkeypatch.setattr(module, work, stopped)
    io.save(tmp_path / "rig.toml", FULL)
    given = ("--rig", tmp_path / "rig.toml", "--control-period", "0.01", "--seed", "7", "--out", tmp_path)
    assert "x and theta alone, every 0.01 s" in command(name, *given).err
    (rig,) = [one for one in asked if isinstance(one, Rig)]
    assert io.encode(rig) == io.encode(FULL)
    if name == "sweep":
        (digital,) = [one for one in asked if isinstance(one, Digital)]
        assert digital.dead_band == 0.6
        assert (options["control_period"], options["seed"]) == (0.01, 7)
        assert options["metrics"].track_limit == 0.5
    else:
        (firmware,) = [one for one in asked if isinstance(one, Firmware)]
        assert firmware.simulation == {"control_period": 0.01, "seed": 7}


@rows(
    "name, ignored",
    [("tune", "sensors,drive"), ("pareto", "sensors,drive"), ("audit-gradients", "sensors,drive,track")],
)
def test_a_command_that_would_ignore_parts_of_a_rig_refuses_it(command, tmp_path, name, ignored):
    io.save(tmp_path / "rig.json", FULL)
    result = command(name, "--rig", tmp_path / "rig.json", "--out", tmp_path / "out")
    assert (result.code, result.err.count("\n")) == (2, 1)
    assert f"--without {ignored}" in result.err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_front_counts_no_run_that_leaves_the_rigs_track(monkeypatch):
    monkeypatch.setattr(evaluator, "_RUNS", 4)
    monkeypatch.setattr(evaluator, "_CONTROLLERS", 1)
    plan, plant = FrontConfig(horizon=8.0, evaluation_dt=0.01), paper.appendix_plant()
    long, short = (Evaluator(Rig(plant, track=Track(length)), "lqr", plan) for length in (3.0, 0.12))
    start = np.asarray(long.free.start())[None]
    assert long.evaluate(start, 12.0, 4, EVALUATION).success[0] > 0.0
    assert short.evaluate(start, 12.0, 4, EVALUATION).success[0] == 0.0


def test_a_tuning_takes_the_rigs_track_for_its_goal(command, tmp_path):
    io.save(tmp_path / "rig.toml", FULL)
    given = ("--rig", tmp_path / "rig.toml", "--without", "sensors,drive", "--steps", "-1", "--out", tmp_path)
    assert "track_limit 0.5 m, weight track 1" in command("tune", *given).err
    result = command("tune", *given, "--track-limit", "0.6")
    assert "track_limit = 0.6: must be at most that of the rig's track, 0.5 m" in result.err


@rows(
    "arguments, words",
    [
        (("--rig", "quanser"), "rig = 'quanser': must be paper, quanser-ip02-long,"),
        (("--rig", "there-is-none.toml"), "there-is-none.toml"),
        (("--rig", "paper", "--plant", "appendix"), "plant = 'appendix': must be absent"),
        (("--rig", "paper", "--without", "wheels"), "without = 'wheels': must be one of sensors, drive, track"),
        (("--without", "track"), "must be absent where no rig is given"),
        (("--rig", "paper", "--limit", "3"), "limit = 3.0: must be the value of one of cart_mass"),
        (("--rig", "ctms", "--limit", "-3"), "ForceActuator.limit = -3.0: must be a number above 0 [N]"),
        (("--rig", QUANSER, "--clock", "continuous"), "clock = 'continuous': must be sampled: the rig's sensors"),
        (("--rig", QUANSER, "--x", "0.5"), "start x = 0.5: must be finite, and within 0.4 m"),
        (("--rig", QUANSER, "--estimator", "none", "--duration", "0.1"), "one that estimates rates"),
    ],
)
def test_a_rig_that_cannot_be_used_is_one_line_that_says_why(command, tmp_path, arguments, words):
    result = command("swingup", *arguments, "--out", tmp_path / "out")
    line = result.err.splitlines()[-1]
    assert result.code == 2
    assert line.startswith("cpjax swingup: error: ")
    assert words in line


@rows(
    "text, words",
    [
        ("x = [", "must be a valid TOML file"),
        ('type = "Track"\nhalf_length = 1.0\n', "this one holds a Track"),
        ('type = "Rig"\n[plant]\ntype = "CartPole"\ncart_mass = -1\n', "CartPole.cart_mass = -1.0: must be"),
        ('type = "Rig"\n[plant]\ntype = "CartPole"\n[brakes]\ntype = "Drive"\n', "brakes"),
        ('what = "nothing"\n', "this one holds a result (nothing)"),
    ],
)
def test_a_file_without_a_rig_is_one_line_that_says_what_it_holds(command, tmp_path, text, words):
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    for arguments in (("show", tmp_path / "rig.toml"), ("check", tmp_path / "rig.toml", "--out", tmp_path / "out")):
        result = command("rig", *arguments)
        assert (result.code, result.out, result.err.count("\n")) == (2, "", 1)
        assert words in result.err
    assert not (tmp_path / "out").exists()


def test_a_result_stands_for_its_rig_and_one_of_a_plant_alone_for_that_plant(tmp_path):
    for name, thing in (("rig", FULL), ("plant", FULL.plant)):
        (tmp_path / f"{name}.json").write_text(json.dumps({"what": "a result", **io.encode_bench(thing)}))
        found = build_rig({"rig": str(tmp_path / f"{name}.json"), "without": "drive"})
        expected = dataclasses.replace(FULL, drive=None) if name == "rig" else Rig(FULL.plant)
        assert io.encode(found) == io.encode(expected)


def test_a_drive_of_another_kind_that_moves_the_cart_alike_is_the_papers_plant():
    plant = paper.appendix_plant()
    motor = plant.motor
    lumped = LumpedMotor(float(motor.force_per_voltage), float(motor.damping), float(motor.reflected_mass))
    assert papers_own(dataclasses.replace(plant, motor=lumped)) == "appendix"
    assert papers_own(dataclasses.replace(plant, motor=ForceActuator(12.0))) is None


# --- other simulators' files ------------------------------------------------------------------------------------------


def test_a_rig_goes_to_mujocos_format_and_comes_back_as_a_file_with_comments(command, tmp_path):
    pytest.importorskip("mujoco")
    done = command("rig", "export", "dm-control", "--out", tmp_path)
    assert (done.code, done.err) == (0, "")
    result = command("rig", "import", tmp_path / "rig.xml")
    assert result.code == 0
    assert "theta = " in result.err
    (tmp_path / "mine.toml").write_text(result.out, encoding="utf-8")
    back, made = load(tmp_path / "mine.toml"), named_rig("dm-control")
    for name, rule in numbers(CartPole).items():
        one, other = getattr(back.plant, name), getattr(made.plant, name)
        assert (one == other is None) or float(one) == pytest.approx(float(other), rel=1e-9), (name, rule)
    assert float(back.track.half_length) == pytest.approx(float(made.track.half_length))
    (tmp_path / "no.xml").write_text("<sdf/>")
    refused = command("rig", "import", tmp_path / "no.xml")
    assert refused.code == 2
    assert "root element = 'sdf'" in refused.err


def test_a_track_limit_makes_a_run_that_leaves_it_fail(command, tmp_path, no_pictures):
    for limit, code in ((5.0, 0), (0.05, 1)):
        result = command(
            "swingup", "--controller", "tuned_lqr", "--track-limit", limit, "--dt", 0.01, "--out", tmp_path
        )
        assert result.code == code
    assert build_rig({"rig": "quanser-ip02-long", "track_limit": 0.3}).track.half_length == 0.3
    refused = command("swingup", "--track-limit", -1.0, "--out", tmp_path)
    assert "Track.half_length = -1.0" in refused.err
