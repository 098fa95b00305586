import json
import math
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import cpjax
import cpjax.cli.audit_gradients
from cpjax import AngleGate, CartPole, EnergySwingUp, Hybrid, InputError, Motor, State, StateFeedback, paper
from cpjax.show.gradients import cells, findings, header, picture
from cpjax.sim.flags import Flag
from cpjax.study.gradient_audit import GradientAudit, audit_gradients, document
from cpjax.study.named_parameters import parametrise

PLANT = paper.appendix_plant()
K = (-24.74, -25.36, 111.70, 28.58)
SHORT = {"duration": 1.6, "dt": 2e-3, "objective": cpjax.TimeOutside(1.5, 0.5)}
STARTS = State(
    *(jnp.asarray(column) for column in ([0.03, 0.0], [0.0, 0.0], [math.pi - 0.25, math.pi + 0.2], [0.2, 0.0]))
)


def build(p):
    law = EnergySwingUp(PLANT, energy_gain=p["energy_gain"], cart_stiffness=4.0, cart_damping=p["cart_damping"])
    gate = AngleGate(p["half_angle"])
    return CartPole(motor=Motor(voltage_limit=p["voltage_limit"])), Hybrid(law, StateFeedback(K), gate)


PARAMETERS = {"energy_gain": 5.0, "cart_damping": 2.0, "half_angle": 1.2, "voltage_limit": 12.0}


@pytest.fixture(scope="module")
def audit():
    calls = []
    found = audit_gradients(
        build, PARAMETERS, STARTS, **SHORT, temperatures=(0.03,), progress=lambda *call: calls.append(call)
    )
    assert [call[:2] for call in calls] == [(i, calls[-1][1]) for i in range(len(calls))]
    return found


@pytest.mark.slow
def test_the_located_derivatives_are_the_differences_and_the_others_are_not(audit):
    assert audit.names == tuple(PARAMETERS)
    assert audit.located.shape == (2, 4, 4)
    np.testing.assert_allclose(audit.horizons, [0.4, 0.8, 1.2, 1.6])
    assert np.all(audit.crossings[:, -1] >= 1)
    assert np.all(audit.trusted)
    assert np.all(audit.resolved[:, -1])
    assert np.max(audit.errors(audit.located)[:, -1]) <= 1e-6
    assert np.max(audit.errors(audit.plain)[:, -1]) >= 0.1
    assert np.all(audit.plain[:, :, 2] == 0.0)
    assert np.all(audit.wrong_signs(audit.plain)[:, -1, 2])
    assert not np.any(audit.wrong_signs(audit.located))
    assert 1e-3 <= np.median(audit.errors(audit.smooth[0])[:, -1]) <= 1.0


@pytest.mark.slow
def test_before_the_first_crossing_the_objective_knows_nothing_of_the_gate(audit):
    assert np.all(audit.crossings[:, 0] == 0)
    assert np.all(audit.located[:, 0, 2] == 0.0)
    assert np.all(audit.difference[:, 0, 2] == 0.0)
    assert np.all(np.isinf(audit.speed[:, 0]))
    assert np.all(np.diff(audit.value, axis=1) > 0.0)


@pytest.mark.slow
def test_derivatives_are_those_of_relative_changes_and_the_growth_that_of_the_flow(audit):
    def value(energy_gain, start):
        plant, law = build({name: jnp.asarray(v) for name, v in (PARAMETERS | {"energy_gain": energy_gain}).items()})
        return cpjax.rollout(plant, law, start, duration=1.6, dt=2e-3, switching="located", metrics=SHORT["objective"])

    one = State(*(float(column[0]) for column in STARTS.vector().T))
    run = value(5.0, one)
    assert float(run.metrics) == pytest.approx(audit.value[0, -1], rel=1e-12)
    slope = (value(5.0 + 5e-5, one).metrics - value(5.0 - 5e-5, one).metrics) / 2e-5
    assert audit.located[0, -1, 0] == pytest.approx(float(slope), rel=1e-5)
    moved = np.array(one.vector())
    columns = [
        (value(5.0, State.from_vector(jnp.asarray(moved + d))).state.vector()[-1] - run.state.vector()[-1]) / 1e-6
        for d in 1e-6 * np.eye(4)
    ]
    assert audit.growth[0, -1] == pytest.approx(np.linalg.norm(np.stack(columns, axis=1), ord=2), rel=1e-3)


@pytest.mark.slow
@pytest.mark.slow
def test_each_start_may_have_its_own_parameters(audit):
    each = {name: np.array([value, value * 1.01]) for name, value in PARAMETERS.items()}
    found = audit_gradients(build, each, STARTS, **SHORT, temperatures=(), each=True)
    np.testing.assert_allclose(found.located[0], audit.located[0], rtol=1e-9, atol=1e-14)
    assert np.max(np.abs(found.value[1] - audit.value[1])) > 1e-6


@pytest.mark.slow
def test_verdicts_name_what_is_wrong_with_a_start(audit):
    n = 5
    changed = {
        "flag": np.array([0, int(Flag.OVERFLOW), 0, 0, 0]),
        "speed": np.array([[np.inf, s] for s in (1.0, 1.0, 0.05, 1.0, np.inf)]),
        "growth": np.array([[g, 1.0] for g in (1.0, 1.0, 1.0, 1e5, 1.0)]),
        "crossings": np.array([[0, c] for c in (1, 1, 1, 1, 0)]),
    }
    empty = {name: np.zeros((n, 2, 1)) for name in ("located", "plain", "difference", "uncertainty")}
    made = GradientAudit(
        names=("p",),
        horizons=np.array([1.0, 2.0]),
        temperatures=(),
        value=np.zeros((n, 2)),
        smooth=(),
        **empty,
        **changed,
    )
    kinds, reasons = zip(*made.verdicts, strict=True)
    assert kinds == ("trustworthy", "stopped", "grazing", "chaotic", "trustworthy")
    for reason, word in zip(reasons, ("crossings", "overflow", "0.05 / s", "1e+05 times", "no crossing"), strict=True):
        assert word in reason
    assert made.trusted.tolist() == [True, False, False, False, True]


@pytest.mark.slow
def test_table_picture_sentences_and_document_have_what_was_found(audit):
    lines = cells(audit)
    assert [line[0] for line in lines] == list(audit.names)
    assert all(len(line) == len(header(audit)) for line in lines)
    assert lines[2][1] == "2"
    assert lines[2][3] == "1.0e+00 (2)"
    said = " ".join(findings(audit))
    assert "2 trustworthy" in said
    assert "Plain" in said
    assert len(picture([audit]).axes) == 3
    told = document(audit, STARTS, seed=7)
    assert told["seed"] == 7
    assert told["verdicts"][0]["verdict"] == "trustworthy"
    assert set(told) >= {"located", "plain", "smooth", "difference", "growth", "speed", "starts", "versions"}


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"parameters": {}}, "parameters"),
        ({"parameters": PARAMETERS | {"energy_gain": math.nan}}, "parameters[energy_gain]"),
        ({"parameters": PARAMETERS | {"half_angle": [[1.0]]}}, "parameters[half_angle]"),
        ({"parameters": PARAMETERS | {"cart_damping": 0.0}}, "scales[cart_damping]"),
        ({"scales": {"unknown": 1.0}}, "scales[unknown]"),
        ({"scales": {"energy_gain": 0.0}}, "scales[energy_gain]"),
        ({"horizons": []}, "horizons"),
        ({"horizons": [1.0, 9.0]}, "horizons"),
        ({"horizons": [1.2, 0.8]}, "horizons"),
        ({"horizons": [0.0013]}, "horizons"),
        ({"horizons": ["a"]}, "horizons"),
        ({"temperatures": (0.0,)}, "temperatures"),
        ({"temperatures": ("a",)}, "temperatures"),
        ({"parameters": PARAMETERS | {"energy_gain": "x"}}, "parameters[energy_gain]"),
        ({"scales": {"half_angle": "x"}}, "scales[half_angle]"),
        ({"starts": State(*(jnp.float32(column) for column in (0.0, 0.0, 3.0, 0.0)))}, "starts"),
        ({"duration": 1.0, "dt": 0.3}, "duration"),
        ({"starts": 3}, "starts"),
        ({"build": lambda p: (PLANT, StateFeedback(K))}, "build"),
    ],
)
def test_arguments_that_mean_nothing_are_refused_by_name(changes, field):
    arguments = {"build": build, "parameters": PARAMETERS, "starts": STARTS, **SHORT, **changes}
    with pytest.raises(InputError) as caught:
        audit_gradients(arguments.pop("build"), arguments.pop("parameters"), arguments.pop("starts"), **arguments)
    assert caught.value.field == field


@pytest.mark.slow
def test_a_loops_numbers_by_name_make_the_loop_again():
    state = State(0.1, 0.2, 0.4, -1.0)
    for design, gains, name in (
        ("placement", "printed", "K"),
        ("lqr", "computed", "Q"),
        ("placement", "computed", "polynomial"),
    ):
        controller = paper.controller("corrected-centred", design, PLANT, gains)
        chosen = parametrise(PLANT, controller)
        assert name in chosen.parameters
        plant, again = chosen.build({name: jnp.asarray(value) for name, value in chosen.parameters.items()})
        np.testing.assert_allclose(again.regulator.K, controller.regulator.K, rtol=1e-9)
        assert float(again.swing_up.voltage(state)) == pytest.approx(float(controller.swing_up.voltage(state)))
        assert float(plant.motor.voltage_limit) == 12.0
        assert set(chosen.scales) == {"cart_friction", "pivot_friction", "hysteresis"}
    with pytest.raises(InputError):
        parametrise(PLANT, controller.swing_up)


@pytest.mark.slow
def test_a_supply_without_limit_is_audited_too():
    plant = replace(PLANT, motor=replace(PLANT.motor, voltage_limit=math.inf))
    chosen = parametrise(plant, paper.controller("corrected-centred", "placement", plant))
    assert "voltage_limit" not in chosen.parameters
    found = audit_gradients(chosen.build, chosen.parameters, STARTS, scales=chosen.scales, **SHORT, temperatures=(0.1,))
    assert np.all(np.isfinite(found.smooth[0]))
    assert np.nanmax(np.where(found.resolved, found.errors(found.located), np.nan)[:, -1]) <= 1e-6


ARGUMENTS = ("--count", "2", "--duration", "1.2", "--dt", "0.004", "--seed", "3")


def check_command(done, folder):
    assert done.code == 0, done.err
    assert "half_angle" in done.out
    assert (folder / "audit_gradients.png").read_bytes().startswith(b"\x89PNG")
    told = json.loads((folder / "audit_gradients.json").read_text())
    assert told["seed"] == 3
    assert told["setting"] == {"starts": "hanging", "count": 2, "duration": 1.2, "dt": 0.004}
    assert len(told["verdicts"]) == 2
    assert len(told["names"]) == np.shape(told["located"])[2]


@pytest.mark.slow
def test_the_command_prints_its_table_and_writes_picture_and_json(command, tmp_path, monkeypatch, audit):
    calls = []

    def fake(build, parameters, starts, *, progress, **setting):
        calls.append((parameters, starts, setting))
        return audit

    monkeypatch.setattr(cpjax.cli.audit_gradients, "audit_gradients", fake)
    check_command(command("audit-gradients", *ARGUMENTS, "--energy-gain", "6", "--out", tmp_path), tmp_path)
    [(parameters, starts, setting)] = calls
    assert parameters["energy_gain"] == 6.0
    assert "K" in parameters
    assert setting["duration"] == 1.2
    assert setting["dt"] == 0.004
    np.testing.assert_array_equal(starts.theta, cpjax.sample_starts("hanging", 2, seed=3).theta)
    for options, name in (
        (("--q", "20", "1", "50", "1", "--r", "1"), "Q"),
        (("--poles", "-3", "-4", "-5", "-6"), "polynomial"),
    ):
        assert command("audit-gradients", *ARGUMENTS, *options, "--out", tmp_path).code == 0
        assert name in calls[-1][0]


@pytest.mark.slow
def test_the_command_runs_from_its_options_to_its_files(command, tmp_path):
    done = command("audit-gradients", *ARGUMENTS, "--out", tmp_path)
    check_command(done, tmp_path)
    assert "differences with steps" in done.err


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (("--count", "0"), "count"),
        (("--dt", "0"), "dt"),
        (("--duration", "-1"), "duration"),
        (("--half-angle", "9"), "half_angle"),
    ],
)
def test_bad_options_are_refused_in_one_line(command, tmp_path, arguments, field):
    done = command("audit-gradients", *arguments, "--out", tmp_path)
    assert done.code == 2
    assert field in done.err
    assert done.err.count("\n") == 1
