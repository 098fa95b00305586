"""`cpjax audit-gains`, and the options of `cpjax swingup` that design a gain, called as functions."""

import json

import numpy as np
import pytest
from tables import rows

import cpjax.show.figures
from cpjax import AngleGate, LyapunovGate, files, io, linearize, lqr, paper, place
from cpjax.cli.builders import build_controller, parse_poles
from cpjax.paper import gain_identification
from cpjax.paper.gain_identification import Direction, GainAudit, audit_gains, document
from cpjax.paper.plant_fit import PARAMETERS, Fit
from cpjax.paper.printed_gains import PrintedGain, printed_in_the_paper

APPENDIX = paper.appendix_plant()
PAIR = ("--parameters", "torque_constant,back_emf_constant", "--starts", "8")
LQR = ("--lqr-gain", "-1414.21", "-1180.17", "4795.02", "966.35")
WEIGHTS = ("--q", "200", "1", "1000", "1", "--r", "1e-4")
PLACEMENT = ("--placement-gain", "-24.74", "-25.36", "111.70", "28.58")
POLES = ("--poles", "-3", "-4", "-5", "-6")
PNG = b"\x89PNG\r\n"


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr(cpjax.show.figures, "save_figure", lambda path, _: files.write_bytes(path, PNG))


@pytest.fixture
def asked(monkeypatch, no_pictures):
    """Whatever is asked for, an audit that costs nothing; what was asked for."""
    calls = []

    def fake(prints, plant, *, parameters, **setting):
        calls.append({"prints": prints, "plant": as_plain(io.encode(plant)), "parameters": parameters, **setting})
        fit = Fit(tuple(parameters[:1]), (1.0,), (0.25,) * 4, 1.0)
        return GainAudit((7.0,) * 4, (fit,), (Direction(0.0, {parameters[0]: 1.0}),), plant)

    monkeypatch.setattr("cpjax.cli.audit_gains.audit_gains", fake)
    return calls


def strict_json(path):
    def forbidden(token):
        raise AssertionError(f"{token} is no JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=forbidden)


def as_plain(value):
    return json.loads(files.dump_json(value))


# --- audit-gains ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_audit_of_the_paper_writes_json_and_a_picture_and_says_what_it_found(command, tmp_path):
    result = command("audit-gains", "--out", tmp_path, *PAIR)
    assert result.code == 0
    assert {p.name for p in tmp_path.iterdir()} == {"audit_gains.json", "audit_gains.png"}
    assert (tmp_path / "audit_gains.png").read_bytes().startswith(PNG)

    setting = {"parameters": ("torque_constant", "back_emf_constant"), "most": 2, "starts": 8}
    audit = audit_gains(printed_in_the_paper(), APPENDIX, **setting, seed=1)
    expected = document(audit, printed_in_the_paper(), APPENDIX, seed=1, **setting)
    assert strict_json(tmp_path / "audit_gains.json") == as_plain(expected)

    for words in ("torque_constant, back_emf_constant", "1.03846", "1.93006", "100 %", "none of 2 explain", "1 of 1"):
        assert words in result.out
    assert f"wrote {tmp_path / 'audit_gains.json'} and {tmp_path / 'audit_gains.png'}" in result.out
    assert [line.split()[1] for line in result.err.splitlines()] == ["0/3", "3/3"]


def test_gains_from_the_shell_are_audited_as_they_were_printed(command, tmp_path, asked):
    complex_poles = ("--poles", "-3+1j", "-3-1i", "-5", "-6")
    for flags in ((*PLACEMENT, *POLES, *LQR, *WEIGHTS), (*LQR, *WEIGHTS), (*PLACEMENT, *complex_poles)):
        assert command("audit-gains", "--out", tmp_path, *PAIR, *flags).code == 0
    whole, lqr_only, placement_only = (call["prints"] for call in asked)
    assert whole == printed_in_the_paper()
    assert lqr_only == whole[1:]
    assert placement_only == [PrintedGain.placement(PLACEMENT[1:], [-3 + 1j, -3 - 1j, -5.0, -6.0])]


def test_a_file_says_the_same_as_the_flags_and_flags_win(command, tmp_path, asked):
    gains = (
        '[gains]\nplacement_gain = ["-24.740", "\u221225.36", "1.1170e2", "28.58"]\n'
        'poles = ["-3+1j", "-3-1i", "-5", "-6"]\n'
        'lqr_gain = ["-1414.21", "-1180.17", "4795.02", "966.35"]\nQ = [200, 1, 1000.0, 1]\nR = 1e-4\n'
        '[plant]\nbase = "identified"\ncart_mass = 1.25\n[audit]\nparameters = "cart_mass, gravity"\nstarts = 3\n'
    )
    (tmp_path / "audit.toml").write_text(gains, encoding="utf-8")
    assert command("audit-gains", "--out", tmp_path, "--config", tmp_path / "audit.toml", "--starts", "8").code == 0
    flags = ("--plant", "identified", "--cart-mass", "1.25", "--parameters", "cart_mass,gravity", "--starts", "8")
    placement = ("--placement-gain", "-24.740", "-25.36", "1.1170e2", "28.58", "--poles", "-3+1j", "-3-1j", "-5", "-6")
    assert command("audit-gains", "--out", tmp_path, *flags, *placement, *LQR, *WEIGHTS).code == 0
    file, shell = ({key: value for key, value in call.items() if key != "progress"} for call in asked)
    assert file == shell
    assert (file["parameters"], file["most"], file["starts"], file["seed"]) == (("cart_mass", "gravity"), 2, 8, 1)
    assert file["prints"][0].unit == pytest.approx([0.001, 0.01, 0.01, 0.01])
    assert file["prints"][0].poles == (-3 + 1j, -3 - 1j, -5, -6)
    assert file["plant"]["cart_mass"] == 1.25
    assert strict_json(tmp_path / "audit_gains.json")["directions"][0]["known_to"] == "inf"


def test_without_parameters_all_of_the_plants_may_change_two_at_a_time(command, tmp_path, asked):
    assert command("audit-gains", "--out", tmp_path, "--seed", "7").code == 0
    assert command("audit-gains", "--out", tmp_path, "--parameters", "gravity").code == 0
    whole, single = asked
    assert (whole["parameters"], whole["most"], whole["starts"], whole["seed"]) == (PARAMETERS, 2, 32, 7)
    assert (single["parameters"], single["most"]) == (("gravity",), 1)


def test_a_place_that_cannot_be_written_is_one_line_on_standard_error(command, tmp_path, asked):
    (tmp_path / "taken").write_text("", encoding="utf-8")
    result = command("audit-gains", "--out", tmp_path / "taken")
    assert (result.code, result.out) == (2, "")
    assert result.err.startswith("cpjax audit-gains: error: path = ")
    assert "a place that can be written" in result.err


BAD_FLAGS = [
    (LQR, ["Q: must be given, because an lqr gain is designed for weights"]),
    ((*LQR, *WEIGHTS[5:]), ["Q: must be given, because an lqr gain is designed for weights"]),
    ((*LQR, *WEIGHTS[:5]), ["R: must be given, because an lqr gain is designed for weights"]),
    (PLACEMENT, ["poles: must be given, because a placement gain is designed for poles"]),
    (POLES, ["poles = ['-3', '-4', '-5', '-6']", "absent where placement_gain is"]),
    (WEIGHTS[:5], ["Q = [200.0, 1.0, 1000.0, 1.0]", "absent where lqr_gain is"]),
    (WEIGHTS[5:], ["R = 0.0001", "absent where lqr_gain is"]),
    ((*LQR, *WEIGHTS, *POLES), ["poles =", "absent where placement_gain is"]),
    ((*LQR[:4], *WEIGHTS), ["--lqr-gain", "expected 4 arguments"]),
    ((*LQR, "1", *WEIGHTS), ["unrecognized arguments: 1"]),
    ((*PLACEMENT, "--poles", "-3", "-4", "-5"), ["--poles", "expected 4 arguments"]),
    (("--lqr-gain", "1", "2", "three", "4", *WEIGHTS), ["lqr gain = 'three'", "a number as printed"]),
    (("--lqr-gain", "1", "2", "nan", "4", *WEIGHTS), ["lqr gain = 'nan'", "a number as printed"]),
    (("--placement-gain", "1", "2", "1e999", "4", *POLES), ["placement gain = '1e999'", "a number that fits a float"]),
    ((*LQR, "--q", "200", "1", "-1000", "1", "--r", "1"), ["Q = ", "four finite numbers, at least 0"]),
    ((*LQR, "--q", "200", "1", "inf", "1", "--r", "1"), ["Q = ", "four finite numbers, at least 0"]),
    ((*LQR, "--q", "200", "1", "x", "1", "--r", "1"), ["--q", "'x'"]),
    ((*LQR, *WEIGHTS[:5], "--r", "0"), ["R = 0.0", "a finite number above 0"]),
    ((*LQR, *WEIGHTS[:5], "--r", "nan"), ["R = nan", "a finite number above 0"]),
    ((*PLACEMENT, "--poles", "-3", "-4", "-5+2j", "-5"), ["poles = ", "closed under conjugation"]),
    ((*PLACEMENT, "--poles", "-3", "-4", "-5+2j", "-5-3j"), ["poles = ", "closed under conjugation"]),
    ((*PLACEMENT, "--poles", "-3", "-4", "-5+2k", "-5-2k"), ["--poles", "expected 4 arguments"]),
    ((*PLACEMENT, "--poles", "-3", "-4", "fast", "-5"), ["poles = 'fast'", "a number such as -3 or -5+2j"]),
    ((*PLACEMENT, "--poles", "-3", "-4", "nan", "-5"), ["poles = ", "finite"]),
    (("--parameters", "mass"), ["parameters = ['mass']", "different ones of cart_mass, pole_mass"]),
    (("--parameters", "voltage_limit"), ["parameters = ['voltage_limit']", "different ones of cart_mass"]),
    (("--parameters", "gravity,gravity"), ["parameters = ('gravity', 'gravity')", "different ones of cart_mass"]),
    (("--parameters", ""), ["parameters = ['']", "different ones of cart_mass"]),
    (("--parameters", "gravity,"), ["parameters = ['']", "different ones of cart_mass"]),
    (("--starts", "0"), ["starts = 0", "a whole number from 1 to 100000"]),
    (("--starts", "-1"), ["starts = -1", "a whole number from 1 to 100000"]),
    (("--starts", "1.5"), ["--starts", "'1.5'"]),
    (("--starts", "1" + 20 * "0"), ["starts = 1000", "a whole number from 1 to 100000"]),
    (("--most", "0"), ["most = 0", f"a whole number from 1 to {len(PARAMETERS)}"]),
    (
        ("--most", f"{len(PARAMETERS) + 1}"),
        [f"most = {len(PARAMETERS) + 1}", f"a whole number from 1 to {len(PARAMETERS)}"],
    ),
    (("--parameters", "gravity", "--most", "2"), ["most = 2", "a whole number from 1 to 1"]),
    (("--seed", "-1"), ["seed = -1", "a whole number, at least 0"]),
    (("--plant", "moon"), ["plant = 'moon'", "appendix, identified, or a file"]),
    (("--cart-mass", "0"), ["cart_mass = 0.0", "above 0 [kg]"]),
    (("--gain", "1", "2", "3", "4"), ["unrecognized arguments: --gain"]),
]


def assert_refused(result, folder, *words):
    """Exit code 2 and one line on standard error that holds the words; nothing printed, nothing written."""
    assert (result.code, result.out) == (2, "")
    assert result.err.count("\n") == 1, result.err
    assert result.err.startswith(("cpjax: error: ", "cpjax audit-gains: error: ", "cpjax swingup: error: "))
    assert "Traceback" not in result.err
    for word in words:
        assert word in result.err
    assert not (folder / "out").exists()


@rows(("flags", "words"), BAD_FLAGS, ids=lambda v: " ".join(v)[:40])
def test_a_bad_audit_is_one_line_on_standard_error(command, tmp_path, flags, words):
    assert_refused(command("audit-gains", "--out", tmp_path / "out", *flags), tmp_path, *words)


def test_weights_for_which_the_plant_has_no_gain_are_one_line_on_standard_error(command, tmp_path, monkeypatch):
    nothing = np.array([0.0] * 4 + [np.nan] * 4), None  # compiling what finds this out takes long
    monkeypatch.setattr(gain_identification, "linearised", lambda prints, plant: nothing)
    blind = ("--q", "0", "1", "1000", "1", "--r", "1e-4")
    result = command("audit-gains", "--out", tmp_path / "out", *PAIR, *LQR, *blind, *PLACEMENT, *POLES)
    assert_refused(result, tmp_path, "lqr gain = (-1414.21, ", "a design for which the plant, before any change, has a")


BAD_FILES = [
    ("[gains]\nlqr_gain = [1.0, 2.0, 3.0, 4.0]\n", ["lqr_gain = [1.0, 2.0, 3.0, 4.0]", "a text"]),
    ("[gains]\nlqr_gain = ['1', '2', '3']\n", ["lqr_gain = ['1', '2', '3']", "a list of 4 values"]),
    ("[gains]\nQ = '1 1 1 1'\n", ["Q = '1 1 1 1'", "a list of 4 values"]),
    ("[gains]\nR = '1'\n", ["R = '1'", "a number"]),
    ("[gains]\ngain = 1\n", ["key = 'gain'", "one of lqr_gain, Q, R, placement_gain, poles"]),
    ("[audit]\nparameters = ['gravity']\n", ["parameters = ['gravity']", "a text"]),
    ("[audit]\nstarts = 1.5\n", ["starts = 1.5", "a whole number"]),
    ("[audit]\nstarts = true\n", ["starts = True", "a whole number"]),
    ("[audit]\nseed = 1\n", ["key = 'seed'", "one of parameters, most, starts"]),
    ("[controller]\nlaw = 'corrected'\n", ["section = 'controller'", "one of plant, gains, audit"]),
]


@rows(("text", "words"), BAD_FILES, ids=lambda v: v[:30] if isinstance(v, str) else "")
def test_a_bad_file_of_an_audits_options_is_one_line_on_standard_error(command, tmp_path, text, words):
    (tmp_path / "audit.toml").write_text(text, encoding="utf-8")
    result = command("audit-gains", "--out", tmp_path / "out", "--config", tmp_path / "audit.toml")
    assert_refused(result, tmp_path, *words)


# --- swingup: --q, --r, --poles ---------------------------------------------------------------------------------------

PLANT = paper.identified_plant()
MODEL = linearize(PLANT)


def regulator(**given):
    return np.asarray(build_controller(given, PLANT).regulator.K)


def test_weights_not_given_are_the_papers():
    Q, R = [20.0, 1.0, 50.0, 2.5], 0.01
    for given, expected in (
        ({"Q": Q, "R": R}, lqr(*MODEL, np.diag(Q), [[R]]).K),
        ({"Q": Q}, lqr(*MODEL, np.diag(Q), [[paper.R]]).K),
        ({"R": R}, lqr(*MODEL, np.diag(paper.Q), [[R]]).K),
        ({"Q": [20, 1, 50, 2.5], "R": R}, lqr(*MODEL, np.diag(Q), [[R]]).K),  # as a file may have them
        ({"Q": Q, "R": R, "design": "lqr", "gains": "computed"}, lqr(*MODEL, np.diag(Q), [[R]]).K),
    ):
        np.testing.assert_array_equal(regulator(**given), expected)


def test_poles_give_their_placement_on_the_plant():
    for texts, poles in (
        (["-3", "-4", "-5+2j", "-5-2j"], [-3.0, -4.0, -5.0 + 2.0j, -5.0 - 2.0j]),
        (["-3", "-4", "-5+2i", "-5-2i"], [-3.0, -4.0, -5.0 + 2.0j, -5.0 - 2.0j]),
        (["-3", "-3", "-3.0", "-3e0"], [-3.0, -3.0, -3.0, -3.0]),
    ):
        expected = place(*MODEL, poles)
        np.testing.assert_array_equal(regulator(poles=texts), expected)
        np.testing.assert_array_equal(regulator(poles=texts, design="placement", gains="computed"), expected)


def test_a_lyapunov_gate_of_given_weights_has_their_riccati_solution():
    Q, R = [20.0, 1.0, 50.0, 2.5], 0.01
    controller = build_controller({"Q": Q, "R": R, "gate": "lyapunov", "level": 3.0}, PLANT)
    assert isinstance(controller.gate, LyapunovGate)
    np.testing.assert_array_equal(controller.gate.P, lqr(*MODEL, np.diag(Q), [[R]]).P)
    plain = build_controller({"poles": ["-3", "-4", "-5", "-6"]}, PLANT)
    assert isinstance(plain.gate, AngleGate)


@rows("gain", [{"poles": ["-3", "-4", "-5", "-6"]}, {"K": [1.0, 2.0, 3.0, 4.0]}], ids=["poles", "K"])
def test_weights_beside_another_gain_are_those_of_the_lyapunov_gate(gain):
    Q = [20.0, 1.0, 50.0, 2.5]
    controller = build_controller({**gain, "Q": Q, "R": 0.01, "gate": "lyapunov", "level": 3.0}, PLANT)
    np.testing.assert_array_equal(controller.gate.P, lqr(*MODEL, np.diag(Q), [[0.01]]).P)
    np.testing.assert_array_equal(controller.regulator.K, build_controller(gain, PLANT).regulator.K)


def test_without_any_of_them_the_gain_is_the_papers():
    np.testing.assert_array_equal(regulator(), [paper.PRINTED_GAINS["placement"]])
    np.testing.assert_array_equal(regulator(design="lqr"), [paper.PRINTED_GAINS["lqr"]])


def test_a_designed_gain_holds_the_cart_at_the_reference():
    law = build_controller({"poles": ["-3", "-4", "-5", "-6"], "reference_x": 0.5}, PLANT).regulator
    assert law.reference.x == 0.5


def test_poles_from_the_shell_end_in_the_controller_that_runs(command, tmp_path, no_pictures):
    flags = ("--duration", "0.1", "--dt", "0.01", "--plant", "identified", "--poles", "-3", "-4", "-5+2j", "-5-2j")
    result = command("swingup", "--out", tmp_path, *flags)
    assert result.err == ""
    found = strict_json(tmp_path / "swingup.json")["controller"]["regulator"]["K"]
    assert found == np.asarray(place(*MODEL, [-3.0, -4.0, -5 + 2j, -5 - 2j])).tolist()


@rows(
    ("text", "value"),
    [("-3", -3), ("-5+2j", -5 + 2j), ("-5-2i", -5 - 2j), (" -5 + 2j ", -5 + 2j), ("2e-1j", 0.2j), ("-1e1", -10)],
)
def test_a_pole_is_read_as_people_write_it(text, value):
    assert parse_poles([text]) == [value]


CONFLICTS = [
    ((*POLES, "--q", "1", "1", "1", "1"), ["Q = [1.0, 1.0, 1.0, 1.0]", "absent where poles is given"]),
    ((*POLES, "--r", "1"), ["R = 1.0", "absent where poles is given"]),
    ((*POLES, "--design", "lqr"), ["design = 'lqr'", "placement, where poles are given"]),
    ((*POLES, "--gains", "printed"), ["gains = 'printed'", "computed, where poles are given"]),
    (("--r", "1", "--design", "placement"), ["design = 'placement'", "lqr, where weights are given"]),
    (("--r", "1", "--gains", "printed"), ["gains = 'printed'", "computed, where weights are given"]),
    (("--gain", "1", "2", "3", "4", "--r", "1"), ["R = 1.0", "absent where gain is given"]),
    (("--gain", "1", "2", "3", "4", *POLES), ["poles = ['-3', '-4', '-5', '-6']", "absent where gain is given"]),
    (
        ("--gain", "1", "2", "3", "4", "--design", "lqr"),
        ["gain = [1.0, 2.0, 3.0, 4.0]", "absent where design or gains"],
    ),
    (("--q", "1", "1", "1"), ["--q", "expected 4 arguments"]),
    (("--q", "1", "1", "-1", "1"), ["Q", "positive semidefinite"]),
    (("--q", "0", "1", "1", "1"), ["Q = ", "detectable with A"]),
    (("--q", "nan", "1", "1", "1"), ["Q", "finite"]),
    (("--r", "0"), ["R", "positive definite"]),
    (("--r", "-1"), ["R", "positive definite"]),
    (("--r", "inf"), ["R", "finite"]),
    (("--poles", "-3", "-4", "-5+2j", "-5"), ["poles = ", "closed under conjugation"]),
    (("--poles", "-3", "-4", "slow", "-5"), ["poles = 'slow'", "a number such as -3 or -5+2j"]),
]


@rows(("flags", "words"), CONFLICTS, ids=lambda v: " ".join(v)[:40])
def test_a_gain_that_cannot_be_or_is_given_twice_is_one_line_on_standard_error(command, tmp_path, flags, words):
    result = command("swingup", "--out", tmp_path / "out", "--duration", "0.1", "--dt", "0.01", *flags)
    assert_refused(result, tmp_path, *words)
