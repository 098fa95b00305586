"""The checks of a regulator, in one place and on the command line."""

import dataclasses
import json
import math

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

import cpjax
from cpjax import paper
from cpjax.cli import main
from cpjax.show.design import picture, rows
from cpjax.study.design_check import check_design, document

PLANT = paper.appendix_plant()
GATE = cpjax.AngleGate(paper.SWITCH_ANGLE)


def checked(design="placement", gains="printed", plant=PLANT, gate=GATE):
    return check_design(plant, paper.regulator(design, gains, plant), gate)


@pytest.mark.parametrize(
    ("design", "voltage", "saturates"), [("placement", 58.49, 6.155), ("lqr", 2510.7, 0.14339)], ids=str
)
def test_the_printed_gains_ask_for_what_the_paper_page_says(design, voltage, saturates):
    check = checked(design)
    assert check.gate_voltage == pytest.approx(voltage, rel=1e-3)
    assert math.degrees(check.saturation_angle) == pytest.approx(saturates, rel=1e-3)
    assert check.limited_by == "voltage"
    assert (int(check.controllability.rank), int(check.observability.rank)) == (4, 4)


def test_the_lyapunov_function_and_the_level_are_those_of_an_independent_computation():
    check = checked()
    A, B = (np.asarray(x) for x in cpjax.linearize(PLANT))
    closed = A - B @ check.K
    P = solve_continuous_lyapunov(closed.T, -np.eye(4))
    np.testing.assert_allclose(check.P, P, rtol=1e-9)
    inverse = np.linalg.inv(P)
    level = 12.0**2 / (check.K @ inverse @ check.K.T)[0, 0]
    assert check.level == pytest.approx(level, rel=1e-9)
    np.testing.assert_allclose(check.extent, np.sqrt(level * np.diag(inverse)), rtol=1e-9)
    np.testing.assert_allclose(np.sort_complex(check.poles), np.sort_complex(np.linalg.eigvals(closed)), rtol=1e-9)


def test_without_a_voltage_limit_the_gate_ends_the_level_set():
    motor = dataclasses.replace(PLANT.motor, voltage_limit=math.inf)
    check = checked(plant=dataclasses.replace(PLANT, motor=motor))
    assert check.limited_by == "gate"
    assert check.extent[2] == pytest.approx(paper.SWITCH_ANGLE, rel=1e-9)
    assert math.isinf(check.saturation_angle)


@pytest.mark.parametrize(
    "gate",
    [
        cpjax.AngleGate(0.01),
        cpjax.AngleRateGate(0.01, 0.05),
        cpjax.LyapunovGate(paper.riccati_solution(PLANT), level=1e-3),
    ],
    ids=lambda gate: type(gate).__name__,
)
def test_nothing_of_the_level_set_is_outside_a_narrow_gate_and_something_touches_it(gate):
    check = checked(gate=gate)
    assert check.limited_by == "gate"
    points = np.random.default_rng(0).normal(size=(200_000, 4))
    points *= np.sqrt(check.level / np.sum((points @ check.P) * points, axis=1))[:, None]
    margins = np.asarray(gate.margin(cpjax.State(*points.T), np.zeros(len(points), dtype=np.int32)))
    scale = np.max(np.abs(margins))
    assert -1e-9 * scale <= np.min(margins) < 0.05 * scale


def test_an_unstable_loop_has_poles_but_no_level_set():
    check = check_design(PLANT, cpjax.StateFeedback([0.0, 0.0, 0.0, 0.0]), GATE)
    assert (check.P, check.level, check.limited_by, check.extent) == (None, None, None, None)
    assert not bool(check.margins.stable)
    assert np.max(check.poles.real) > 1.0
    assert ("certified level set", "none", "the linear loop is not stable") in rows(check, 12.0)
    picture(check, GATE, 12.0, "unstable")


def test_what_is_no_regulator_or_gate_about_upright_is_refused():
    law = paper.regulator("placement", "printed", PLANT)
    with pytest.raises(cpjax.InputError, match=r"regulator = .*StateFeedback"):
        check_design(PLANT, cpjax.EnergySwingUp(PLANT, energy_gain=1.0), GATE)
    with pytest.raises(cpjax.InputError, match=r"gate = "):
        check_design(PLANT, law, None)
    leaning = dataclasses.replace(law, reference=cpjax.State(0.0, 0.0, 0.3, 0.0))
    with pytest.raises(cpjax.InputError, match=r"regulator\.reference"):
        check_design(PLANT, leaning, GATE)
    elsewhere = dataclasses.replace(law, reference=cpjax.State(0.5, 0.0, 0.0, 0.0))
    assert check_design(PLANT, elsewhere, GATE).level == pytest.approx(checked().level)


def test_the_command_prints_and_writes_what_the_check_found(tmp_path, capsys):
    assert main(["design", "--out", str(tmp_path), "--poles", "-3", "-3", "-5+2j", "-5-2j", "--half-angle", "0.3"]) == 0
    printed = capsys.readouterr().out
    table = json.loads((tmp_path / "design.json").read_text())
    A, B = cpjax.linearize(PLANT)
    K = cpjax.place(A, B, [-3, -3, -5 + 2j, -5 - 2j])
    np.testing.assert_allclose(table["K"], K, rtol=1e-12)
    assert f"{table['gate_voltage']:.4g}" in printed
    assert table["limited_by"] in printed
    assert (tmp_path / "design.png").read_bytes().startswith(b"\x89PNG")
    check = check_design(PLANT, cpjax.StateFeedback(K), cpjax.AngleGate(0.3))
    assert document(check)["level"] == pytest.approx(table["level"])


def test_the_command_refuses_a_controller_without_a_gate(tmp_path, capsys):
    cpjax.save(tmp_path / "law.json", paper.regulator("placement", "printed", PLANT))
    assert main(["design", "--out", str(tmp_path / "out"), "--controller", str(tmp_path / "law.json")]) == 2
    assert "a regulator behind a gate" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
