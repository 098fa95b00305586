"""What a command does when it cannot print, and what it says of plants, controllers and failures beside its table."""

import errno
import io as buffers
import json
import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from tables import rows

import cpjax
import cpjax.show.figures
from cpjax import (
    AngleGate,
    CartPole,
    EnergySwingUp,
    Hybrid,
    InputError,
    Motor,
    StateFeedback,
    files,
    io,
    linearize,
    paper,
    preset,
)
from cpjax import startup as at_start
from cpjax.cli import animate, basin, compare, main, notes
from cpjax.cli.progress import compiling
from cpjax.presets import model_differences

SHORT = ("--duration", "0.1", "--dt", "0.01")


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch):
    monkeypatch.setattr(cpjax.show.figures, "response", lambda *_: None)
    monkeypatch.setattr(cpjax.show.figures, "save_figure", lambda path, _: files.write_bytes(path, b"") or b"")


def notes_of(result):
    return [line.split(": note: ")[1] for line in result.err.splitlines()]


# --- standard streams -------------------------------------------------------------------------------------------------


class Failing(buffers.StringIO):
    """A stream that fails at one method."""

    def __init__(self, method, problem):
        super().__init__()
        self._method, self._problem = method, problem

    def write(self, text):
        if self._method == "write":
            raise self._problem
        return super().write(text)

    def flush(self):
        if self._method == "flush":
            raise self._problem


@pytest.mark.parametrize("method", ["write", "flush"])
@pytest.mark.parametrize(("number", "code"), [(errno.EPIPE, 0), (errno.ENOSPC, 2), (errno.EIO, 2), (errno.EBADF, 2)])
def test_a_stream_that_fails_stops_no_command_and_only_a_reader_may_go_away(
    tmp_path, monkeypatch, method, number, code
):
    err = buffers.StringIO()
    monkeypatch.setattr(sys, "stdout", Failing(method, OSError(number, os.strerror(number))))
    monkeypatch.setattr(sys, "stderr", err)
    assert main(["design", "--out", str(tmp_path)]) == code
    assert {p.name for p in tmp_path.iterdir()} == {"design.json", "design.png"}
    if code:
        assert err.getvalue() == f"cpjax design: error: standard output cannot be written: [Errno {number}] " + (
            os.strerror(number) + "\n"
        )
    else:
        assert err.getvalue() == ""


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_a_stream_that_was_closed_from_the_start_changes_nothing_else(tmp_path, monkeypatch, name):
    other = buffers.StringIO()
    monkeypatch.setattr(sys, "stdout", other)
    monkeypatch.setattr(sys, "stderr", other)
    monkeypatch.setattr(sys, name, None)
    assert main(["design", "--gear-ratio", "3", "--out", str(tmp_path)]) == 0
    assert ("note: the motor" in other.getvalue()) == (name == "stdout")
    assert ("closed-loop poles" in other.getvalue()) == (name == "stderr")


def test_an_error_stays_one_where_standard_error_cannot_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stderr", Failing("write", OSError(errno.ENOSPC, "full")))
    assert main(["design", "--cart-mass", "0", "--out", str(tmp_path)]) == 2


def test_letters_that_the_terminal_lacks_are_printed_as_escapes(tmp_path, monkeypatch):
    out = buffers.TextIOWrapper(buffers.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.chdir(tmp_path)
    assert main(["design", "--out", "é/大"]) == 0
    assert b"wrote \\xe9/\\u5927/design.json" in out.buffer.getvalue()


@pytest.mark.skipif(os.name != "posix", reason="a shell's redirections")
@pytest.mark.parametrize(
    ("redirection", "code", "complaint"),
    [("| true", 0, ""), (">&-", 0, ""), ("> /dev/full", 2, "cpjax --help: error: standard output cannot be written")],
)
def test_a_process_whose_output_goes_away_ends_without_a_traceback(redirection, code, complaint):
    if "full" in redirection and not os.path.exists("/dev/full"):
        pytest.skip("no full device here")
    script = f"set -o pipefail; '{sys.executable}' -m cpjax --help {redirection}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == code
    assert done.stderr.startswith(complaint)
    assert done.stderr.count("\n") == (1 if complaint else 0)


def test_an_interrupt_during_the_imports_ends_with_130_and_without_a_word():
    script = """
import os, signal, sys
sys.argv = ["/usr/bin/cpjax"]
class Interrupt:
    def find_spec(self, name, *_):
        if name == "numpy":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
import cpjax
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.slow
def test_an_interrupt_that_python_drops_in_a_callback_comes_again():
    script = """
import gc, os, signal, sys, time
sys.argv = ["/usr/bin/cpjax"]
from cpjax import startup
startup.ready()
def interrupted(*_):
    gc.callbacks.clear()
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.001)
gc.callbacks.append(interrupted)
try:
    gc.collect()
    time.sleep(20)
except KeyboardInterrupt:
    print("interrupted")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


@pytest.mark.parametrize(
    ("name", "whole", "expected"),
    [
        ("/usr/bin/cpjax", ["python", "/usr/bin/cpjax"], True),
        ("cpjax.exe", ["cpjax.exe"], True),
        ("-m", ["python", "-X", "dev", "-m", "cpjax", "design"], True),
        ("-m", ["python", "-m", "pytest"], False),
        ("-c", ["python", "-c", "import cpjax"], False),
        ("tune.py", ["python", "tune.py"], False),
    ],
)
def test_only_the_command_lines_own_process_is_prepared(monkeypatch, name, whole, expected):
    monkeypatch.setattr(sys, "argv", [name])
    monkeypatch.setattr(sys, "orig_argv", whole)
    assert at_start.is_command() is expected


def test_a_prepared_process_hides_xlas_alarm_unless_asked_and_restores_interrupts(monkeypatch):
    before = signal.getsignal(signal.SIGINT)
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for given, expected in ((None, "3"), ("1", "1")):
            monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
            if given is not None:
                monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", given)
            at_start.prepare()
            assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == expected
        hook = sys.unraisablehook
        at_start.ready()
        monkeypatch.setattr(sys, "unraisablehook", hook)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("text", ["a\nb", "a\x1b[31mb", "a\r\nb", "a\x07", "a\u2028b"])
@pytest.mark.parametrize("option", ["--plant", "--controller", "--config", "--colour", "--law", "--cart-mass"])
def test_an_argument_with_control_characters_is_one_line_without_them(command, tmp_path, monkeypatch, option, text):
    monkeypatch.chdir(tmp_path)
    for argument in (text, f"{text}.json", f"{text}.toml"):
        result = command("design", option, argument)
        assert (result.code, result.out) == (2, "")
        assert result.err.endswith("\n")
        assert result.err[:-1].isprintable()


def test_a_folder_with_control_characters_is_shown_with_escapes(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = command("design", "--out", "a\x1b[31m")
    assert result.code == 0
    assert "wrote a\\x1b[31m/design.json" in result.out
    assert "\x1b" not in result.out


# --- gains for the plant that is given --------------------------------------------------------------------------------


def gain(folder):
    return np.asarray(files.read_table(folder / "design.json")["K"])


@rows("design", ["placement", "lqr"])
def test_a_plant_that_is_not_the_papers_gets_a_gain_computed_for_it(command, tmp_path, design):
    plant = CartPole(cart_mass=2.0, motor=Motor(voltage_limit=6.0))
    io.save(tmp_path / "mine.toml", plant)
    for given in (["--plant", tmp_path / "mine.toml"], ["--cart-mass", "2", "--voltage-limit", "6"]):
        assert command("design", "--design", design, *given, "--out", tmp_path).err == ""
        np.testing.assert_array_equal(gain(tmp_path), paper.computed_gain(design, plant))


@rows("given", [(), ("--plant", "identified"), ("--voltage-limit", "9"), ("--cart-mass", "1")])
def test_the_papers_plants_keep_its_printed_gain_whatever_their_supply(command, tmp_path, given):
    assert command("design", *given, "--out", tmp_path).err == ""
    np.testing.assert_array_equal(gain(tmp_path), [paper.PRINTED_GAINS["placement"]])


def test_a_plant_for_which_no_gain_can_be_computed_is_refused_with_the_ways_out(command, tmp_path):
    result = command("design", "--pole-length", "1e-300", "--out", tmp_path / "out")
    assert (result.code, result.err.count("\n")) == (2, 1)
    assert "give a gain of your own, or take the paper's with --gains printed" in result.err


def test_printed_gains_asked_for_on_another_plant_are_printed_and_said_to_be(command, tmp_path):
    result = command("design", "--cart-mass", "1.2", "--gains", "printed", "--out", tmp_path)
    assert result.code == 0
    np.testing.assert_array_equal(gain(tmp_path), [paper.PRINTED_GAINS["placement"]])
    assert notes_of(result) == files.read_table(tmp_path / "design.json")["notes"]
    assert notes_of(result)[0].startswith("the controller has the gain that the paper prints for its own plant")


def test_a_preset_on_another_plant_is_said_to_be_made_for_another(command, tmp_path):
    result = command("swingup", *SHORT, "--controller", "tuned_lqr", "--pole-length", "0.6", "--out", tmp_path)
    expected = "the controller was made for another plant: its model differs in pole_length (0.7 there, 0.6 here)"
    assert notes_of(result) == files.read_table(tmp_path / "swingup.json")["notes"] == [expected]
    result = command("swingup", *SHORT, "--controller", "tuned_lqr", "--out", tmp_path)
    assert result.err == ""


def test_a_controllers_file_is_held_against_the_plant_too(command, tmp_path):
    law = EnergySwingUp(CartPole(gravity=1.6), energy_gain=3.0)
    io.save(tmp_path / "moon.json", Hybrid(law, paper.regulator("lqr", "computed", CartPole()), AngleGate(0.5)))
    for arguments in (
        ("design", "--controller", tmp_path / "moon.json"),
        ("tune", "--start-from", tmp_path / "moon.json", "--steps", "-1"),
    ):
        result = command(*arguments, "--out", tmp_path / "out")
        assert "made for another plant: its model differs in gravity (1.6 there, 9.81 here)" in result.err


class StoppedError(InputError):
    """Ends a command where the work would begin."""


@pytest.mark.parametrize(
    ("module", "work", "name"),
    [(basin, "run_basin", "basin"), (animate, "run_animation", "animate"), (compare, "run_comparison", "compare")],
)
def test_commands_of_several_controllers_say_which_were_made_for_another_plant(
    command, tmp_path, monkeypatch, module, work, name
):
    def stopped(*arguments, **named):
        asked.extend(arguments)
        asked.extend(named.values())
        raise StoppedError("work", 0, "done")

    asked = []
    monkeypatch.setattr(module, work, stopped)
    result = command(name, "--cart-mass", "1.3", "--out", tmp_path)
    lines = notes_of(SimpleNamespace(err="".join(result.err.splitlines(keepends=True)[:-1])))
    assert lines in asked, "the notes for the JSON are those on standard error"
    assert any("tuned" in line and "cart_mass (1 there, 1.3 here)" in line for line in lines)
    assert any("printed" in line for line in lines) == (name == "compare")
    controllers = next((one for one in asked if isinstance(one, dict) and "corrected/lqr" in one), None)
    if controllers is not None:
        computed = paper.computed_gain("lqr", CartPole(cart_mass=1.3))
        np.testing.assert_array_equal(controllers["corrected/lqr"].regulator.K, computed)


def test_the_helper_names_every_parameter_in_which_a_controllers_model_differs():
    plant = paper.appendix_plant()
    for design in ("lqr", "placement"):
        assert model_differences(preset(design), plant) == []
    other = CartPole(pole_mass=0.25, motor=Motor(gear_ratio=2.0))
    found = model_differences(preset("lqr"), other)
    assert found == ["pole_mass (0.5 there, 0.25 here)", "gear_ratio (1 there, 2 here)"]
    assert model_differences(StateFeedback([1.0, 2.0, 3.0, 4.0]), other) == []


# --- a motor in parts -------------------------------------------------------------------------------------------------


def test_a_motor_given_in_part_is_said_to_have_the_papers_rotor_and_what_that_weighs(command, tmp_path):
    partly = '{"type": "CartPole", "motor": {"type": "Motor", "gear_ratio": 50, "wheel_radius": 0.02}}'
    (tmp_path / "rig.json").write_text(partly)
    (tmp_path / "run.toml").write_text("[plant]\ngear_ratio = 50\nwheel_radius = 0.02\n")
    for given in (
        ("--gear-ratio", "50", "--wheel-radius", "0.02"),
        ("--config", tmp_path / "run.toml"),
        ("--plant", tmp_path / "rig.json"),
    ):
        (note,) = notes_of(command("design", *given, "--out", tmp_path))
        assert "rotor_inertia = 7e-06 kg m^2, viscous_friction = 1e-05 N m s/rad" in note
        assert "the rotor weighs 43.8 kg at the cart" in note
        assert "damps the cart with 6.25e+06 N s/m" in note
        assert "gear_ratio =" not in note
        assert files.read_table(tmp_path / "design.json")["notes"] == [note]


def test_a_motor_given_in_full_or_not_at_all_or_another_supply_is_worth_no_note(command, tmp_path):
    io.save(tmp_path / "rig.json", CartPole(motor=Motor(gear_ratio=2.0)))
    for given in (("--plant", tmp_path / "rig.json"), ("--pole-mass", "0.4"), ("--voltage-limit", "9")):
        assert command("design", *given, "--out", tmp_path).err == ""


def test_a_plants_file_without_a_motor_is_said_to_have_the_papers(command, tmp_path):
    (tmp_path / "rig.toml").write_text('type = "CartPole"\ncart_mass = 0.5\n')
    (note,) = notes_of(command("design", "--plant", tmp_path / "rig.toml", "--out", tmp_path))
    assert "left at the paper's values: torque_constant = 1.25 N m/A" in note


# --- what files and flags may hold ------------------------------------------------------------------------------------

FULL = [[20.0, 1.0, 0.0, 0.0], [1.0, 2.0, 0.0, 0.0], [0.0, 0.0, 50.0, 3.0], [0.0, 0.0, 3.0, 2.5]]


def test_a_full_state_weight_is_taken_from_a_file_and_from_flags(command, tmp_path):
    (tmp_path / "run.toml").write_text(f"[controller]\nQ = {FULL}\nR = 0.5\n")
    flags = ["--q", *(str(q) for row in FULL for q in row), "--r", "0.5"]
    expected = cpjax.lqr(*linearize(CartPole()), np.array(FULL), np.array([[0.5]])).K
    for given in (["--config", tmp_path / "run.toml"], flags):
        result = command("design", *given, "--out", tmp_path)
        assert (result.code, result.err) == (0, "")
        np.testing.assert_array_equal(gain(tmp_path), expected)
        assert files.read_table(tmp_path / "design.json")["controller"]["regulator"]["design"]["Q"] == FULL


@rows(
    ("value", "words"),
    [
        ("[1, 2, 3]", "a list of 4 or 16 values"),
        ("[[1, 2], [2, 1]]", "4 rows of 4 values, or a list of 4 or 16 values"),
        ("[[1, 2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", "a symmetric matrix"),
        ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 'x']]", "a number"),
        ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], 1]", "4 rows of 4 values"),
    ],
)
def test_a_state_weight_of_another_shape_is_refused_by_name(command, tmp_path, value, words):
    (tmp_path / "run.toml").write_text(f"[controller]\nQ = {value}\n")
    result = command("design", "--config", tmp_path / "run.toml", "--out", tmp_path / "out")
    assert result.code == 2
    assert "Q = " in result.err
    assert words in result.err


@rows("flags", [["1", "2", "3"], ["1"] * 15])
def test_a_flag_of_another_number_of_weights_is_refused_by_name(command, tmp_path, flags):
    result = command("design", "--q", *flags, "--out", tmp_path / "out")
    assert (result.code, result.err.count("\n")) == (2, 1)
    assert "argument --q: expected 4 arguments, or 16" in result.err


def test_poles_may_be_numbers_texts_or_pairs_in_a_file(command, tmp_path):
    (tmp_path / "run.toml").write_text("[controller]\npoles = [[-3, 0], -4.5, '-5+2j', [-5, -2.0]]\n")
    result = command("design", "--config", tmp_path / "run.toml", "--out", tmp_path)
    assert result.err == ""
    expected = cpjax.place(*linearize(CartPole()), [-3, -4.5, -5 + 2j, -5 - 2j])
    np.testing.assert_array_equal(gain(tmp_path), expected)


@rows("pole", ["[-3]", "[-3, 0, 1]", "[-3, true]", "['-3', 0]", "true"])
def test_a_pole_of_another_shape_is_refused_with_what_is_allowed(command, tmp_path, pole):
    (tmp_path / "run.toml").write_text(f"[controller]\npoles = [{pole}, -4, -5, -6]\n")
    result = command("design", "--config", tmp_path / "run.toml", "--out", tmp_path / "out")
    assert result.code == 2
    assert "pairs of numbers [real, imaginary]" in result.err


def test_the_results_of_commands_are_plants_and_controllers_for_others(command, tmp_path):
    command("design", "--cart-mass", "1.5", "--design", "lqr", "--out", tmp_path / "a")
    result = tmp_path / "a" / "design.json"
    command("swingup", *SHORT, "--plant", result, "--controller", result, "--out", tmp_path / "b")
    again = tmp_path / "b" / "swingup.json"
    done = command("design", "--plant", again, "--controller", again, "--out", tmp_path / "c")
    assert (done.code, done.err) == (0, "")
    first, last = (files.read_table(path) for path in (result, tmp_path / "c" / "design.json"))
    assert first == last


@rows("option", ["--plant", "--controller"])
@rows(
    ("content", "holds"),
    [
        ({"type": "Motor"}, "a Motor"),
        ({"what": "a comparison"}, "a result (a comparison)"),
        ({"plan": {}, "fronts": 1}, "a table without a type (its keys: plan, fronts)"),
        ({"type": "Pendulum"}, "a Pendulum"),
        ({}, "a table without a type, which is empty"),
    ],
)
def test_a_file_of_another_kind_is_refused_with_what_it_holds(command, tmp_path, option, content, holds):
    (tmp_path / "thing.json").write_text(json.dumps(content))
    result = command("design", option, tmp_path / "thing.json", "--out", tmp_path / "out")
    assert result.code == 2
    assert f"must be a file that holds a C{'artPole' if option == '--plant' else ''}".lower() in result.err.lower()
    assert f"this one holds {holds}" in result.err
    assert "LyapunovGate" not in result.err


@rows(("gate", "key"), [("angle-rate", "rate"), ("lyapunov", "level")])
def test_what_has_to_be_given_is_named_without_a_value(command, tmp_path, gate, key):
    result = command("design", "--gate", gate, "--out", tmp_path / "out")
    assert result.err == f"cpjax design: error: {key}: must be given, because the gate {gate} needs it\n"


# --- extreme numbers, failures, progress ------------------------------------------------------------------------------


@rows(
    ("flags", "code"),
    [
        (["--voltage-limit", "5e-324"], 0),
        (["--voltage-limit", "1.7e308"], 0),
        (["--half-angle", "5e-324"], 0),
        (["--gate", "angle-rate", "--rate", "1e-300"], 0),
        (["--gain", *["5e-324"] * 4], 0),
        (["--gain", *["1.7e308"] * 4], 0),
        (["--cart-mass", "1e300"], 0),
        (["--resistance", "1e300"], 0),
        (["--r", "5e-324"], None),  # whether there is a gain is the Riccati equation's matter
        (["--q", *["1.7e308"] * 4], None),
    ],
    ids=lambda v: " ".join(v[:3]) if isinstance(v, list) else "",
)
def test_a_number_however_extreme_gives_a_design_or_one_line(command, tmp_path, flags, code):
    result = command("design", *flags, "--out", tmp_path)
    assert result.code in ((0, 2) if code is None else (code,))
    assert result.err == "" or all(line.startswith("cpjax design: ") for line in result.err.splitlines())
    assert (tmp_path / "design.png").exists() == (result.code == 0)


def test_a_design_that_is_not_stable_says_so_first_and_prints_no_nan(command, tmp_path):
    result = command("design", "--gain", "1", "2", "3", "4", "--out", tmp_path)
    assert result.code == 0
    assert result.out.startswith("not stable: a closed-loop pole at 2.814 1/s")
    assert "nan" not in result.out
    expected = ["the controller has an unstable regulator: upright it has a closed-loop pole at 2.81 1/s"]
    assert notes_of(result) == expected


@rows("gains", [[-24.74, -25.36, 111.7, 28.58], [0.0, -25.36, 111.7, 28.58], [1.0, 2.0, 3.0, 4.0]])
@rows("plant", [CartPole(), CartPole.rod(mass=0.2, length=0.6, cart_friction=0.1, pivot_friction=0.01)])
def test_the_unstable_pole_is_that_of_the_linear_model(gains, plant):
    A, B = (np.asarray(matrix) for matrix in linearize(plant))
    poles = np.linalg.eigvals(A - B @ np.array([gains]))
    found = notes.unstable_pole(plant, StateFeedback(gains))
    if max(poles.real) > 1e-9:
        assert found is not None
        assert found.real == pytest.approx(max(poles.real), rel=1e-9)
    else:
        assert found is None


WHY = [
    (SHORT, "the pendulum never reached the gate"),
    (
        ("--duration", "12", "--dt", "0.01", "--law", "as-printed", "--start", "hanging"),
        "the pendulum reached the gate ",
    ),
    (("--duration", "0.5", "--dt", "0.01", "--theta", "0.2"), "the regulator acts since 0 s, but "),
]


@rows(("flags", "reason"), WHY, ids=[reason for _, reason in WHY])
def test_a_swing_up_that_does_not_settle_says_why_in_one_line(command, tmp_path, flags, reason):
    result = command("swingup", *flags, "--out", tmp_path)
    assert result.code == 1
    (line,) = [line for line in result.out.splitlines() if line.startswith("why: ")]
    assert line.startswith(f"why: {reason}")


@pytest.mark.parametrize("first", ["screened", "loss"])  # of a new tuning, and of one that is resumed
def test_a_compilation_is_announced_once_and_before_the_step_that_waits_for_it(first):
    lines = []
    report = compiling(lambda done, total, text: lines.append(text), "screened", "loss")
    for text in ("screening 8 candidates", f"{first}: 3", "loss 2"):
        report(0, 2, text)
    assert lines == [
        "screening 8 candidates",
        f"{first}: 3; compiling the gradient (about a minute the first time)",
        "loss 2",
    ]
