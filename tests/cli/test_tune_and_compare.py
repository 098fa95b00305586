"""`cpjax tune` and `cpjax compare`, called as functions, and the tuned controllers that ship."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from tables import rows

import cpjax
from cpjax import files, io, paper
from cpjax.cli.compare import representative_start
from cpjax.controllers import LqrWeights, PoleFactors
from cpjax.errors import InputError
from cpjax.paper.comparison import DESIGNS, Compared, Entry, best, compare, entries
from cpjax.paper.reproduction import EvaluationConfig
from cpjax.presets import preset
from cpjax.show.comparison import findings, phase_portraits
from cpjax.tune import tuner
from cpjax.tune.outcome import Tuning

PLANT = paper.appendix_plant()
SMALL = ("--candidates", "3", "--restarts", "2", "--batch", "2", "--steps", "2", "--duration", "1")


@pytest.mark.slow
def test_tune_writes_a_controller_that_other_commands_take(tmp_path, command):
    done = command("tune", "--out", tmp_path, *SMALL)
    assert done.code == 0
    assert "settle" in done.out
    tuned = cpjax.load(tmp_path / "tuned.json")
    assert isinstance(tuned.regulator.design, LqrWeights)
    result = json.loads((tmp_path / "tune.json").read_text())
    assert result["gradient_steps"] == 2 * 2 * 2 * (50 + 20)
    assert io.encode(tuned) == result["controller"]
    assert (tmp_path / "tune.png").read_bytes().startswith(b"\x89PNG")


def test_tune_asks_for_what_its_options_say_and_writes_what_it_gets(tmp_path, command, monkeypatch):
    """The loop itself is tested elsewhere, and takes a minute to compile."""
    asked = {}

    def pretended(plant, free, plan, *, progress, checkpoint):
        asked.update(plant=plant, free=free, plan=plan, checkpoint=checkpoint)
        vector = np.asarray(free.start())
        record = {"step": 0, "scores": [2.5], "success_rates": [1.0], "settling_times": [2.5], "loss": float("nan")}
        return Tuning(free.controller, vector, free.labels, vector, 2.5, 1.0, 2.5, [record], 7, 8, 9.0)

    monkeypatch.setattr(tuner, "tune", pretended)
    options = ["--design", "placement", "--start-from", "paper", "--frozen", "kick_radius, energy_gain", "--seed", "5"]
    done = command("tune", *options, "--out", tmp_path, "--steps", "3", "--effort", "0.01", "--pole-mass", "0.4")
    assert done.code == 0, done.err
    assert "100.00 %" in done.out
    assert asked["plan"].steps == 3
    assert asked["plan"].seed == 5
    assert asked["plan"].goal.effort == 0.01
    assert asked["plant"].pole_mass == asked["free"].model.pole_mass == 0.4
    assert "energy_gain" not in asked["free"].labels
    assert asked["free"].controller.gate.half_angle == paper.SWITCH_ANGLE
    assert asked["checkpoint"] == tmp_path / "checkpoint.npz"
    assert isinstance(cpjax.load(tmp_path / "tuned.json").regulator.design, PoleFactors)
    assert json.loads((tmp_path / "tune.json").read_text())["gradient_steps"] == 8
    assert (tmp_path / "tune.png").read_bytes().startswith(b"\x89PNG")


def test_a_tuning_that_settles_from_no_start_says_so_in_its_exit_code(tmp_path, command, monkeypatch):
    def pretended(plant, free, plan, *, progress, checkpoint):
        vector = np.asarray(free.start())
        record = {"step": 0, "scores": [30.0], "success_rates": [0.0], "settling_times": [float("nan")], "loss": 1.0}
        return Tuning(free.controller, vector, free.labels, vector, 30.0, 0.0, float("nan"), [record], 7, 8, 9.0)

    monkeypatch.setattr(tuner, "tune", pretended)
    done = command("tune", "--out", tmp_path)
    assert done.code == 1, done.err
    assert "0.00 %" in done.out
    assert "nan" not in done.out
    assert files.read_table(tmp_path / "tune.json")["success_rate"] == 0.0


@rows(("option", "value"), [("--design", "lqr"), ("--gate", "lyapunov")])
def test_a_file_to_start_from_has_its_design_and_gate_already(option, value, tmp_path, command):
    io.save(tmp_path / "law.json", preset("placement"))
    done = command("tune", "--start-from", tmp_path / "law.json", option, value, "--out", tmp_path)
    assert done.code == 2
    assert option.removeprefix("--") in done.err


@rows(
    ("arguments", "words"),
    [
        (("--steps", "-1"), "steps = -1"),
        (("--start-from", "nowhere"), "start_from = 'nowhere'"),
        (("--frozen", "nonsense"), "frozen = 'nonsense'"),
        (("--track", "1"), "track"),
    ],
)
def test_tune_names_what_is_wrong(arguments, words, tmp_path, command):
    done = command("tune", "--out", tmp_path, *arguments)
    assert done.code == 2
    assert words in done.err
    assert done.err.count("\n") == 1


def test_the_command_line_knows_the_shipped_controllers_by_name(tmp_path, command):
    done = command("swingup", "--controller", "tuned_place", "--duration", "6", "--dt", "0.01", "--out", tmp_path)
    assert done.code == 0, done.err
    assert json.loads((tmp_path / "swingup.json").read_text())["controller"] == io.encode(preset("placement"))


def test_a_preset_that_does_not_exist_is_refused():
    with pytest.raises(InputError, match="one of lqr, placement"):
        preset("h-infinity")


@rows("design", DESIGNS)
def test_a_shipped_controller_is_what_its_design_gives_and_swings_up_every_start(design):
    law = preset(design)
    assert isinstance(law.regulator.design, LqrWeights if design == "lqr" else PoleFactors)
    found = law.regulator.design.solve(*cpjax.linearize(PLANT))
    np.testing.assert_allclose(law.regulator.K, found.K, rtol=1e-9)
    starts = cpjax.sample_starts("hanging", 256, seed=77)
    metrics = cpjax.sweep(PLANT, law, starts, duration=10.0, dt=0.002, clock="sampled")
    assert np.all(metrics.success)
    assert np.mean(metrics.settling_time) < 2.55


@pytest.mark.slow
def test_a_comparison_has_the_papers_eight_and_two_tuned_and_ranks_the_tuned_first():
    setting = EvaluationConfig(count=16, duration=8.0, dt=0.004)
    _, results = compare(PLANT, entries(PLANT), setting)
    assert [one.entry.gains for one in results].count("tuned") == 2
    assert len(results) == 10
    for design in DESIGNS:
        tuned, papers = best(results, design, tuned=True), best(results, design, tuned=False)
        assert tuned.summary["success_rate"] > papers.summary["success_rate"]


@pytest.mark.slow
def test_compare_writes_its_table_and_pictures(tmp_path, command):
    done = command("compare", "--count", "4", "--duration", "4", "--dt", "0.004", "--out", tmp_path)
    assert done.code == 0
    assert "Tuned:" in done.out
    assert len(json.loads((tmp_path / "compare.json").read_text())["rows"]) == 10
    pictures = {"responses.png", "phase.png", "by_start.png"}
    assert {path.name for path in tmp_path.iterdir()} == {"compare.json", *pictures}


@pytest.mark.slow
def test_a_comparison_in_which_nothing_settles_says_so_without_figures():
    results = compare(PLANT, entries(PLANT), EvaluationConfig(count=2, duration=1.5, dt=0.005))[1]
    for sentence in findings(results):
        assert "catches none of the initial states" in sentence
        assert "nan" not in sentence


def test_the_start_that_is_shown_is_the_first_that_all_catch_and_says_so():
    starts = cpjax.sample_starts("hanging", 3, seed=1)

    def one(*success):
        return SimpleNamespace(metrics=SimpleNamespace(success=np.array(success)))

    start, words = representative_start(starts, [one(True, True, True), one(False, False, True)])
    assert start.theta == float(starts.theta[2])
    assert words.startswith("number 3 of 3")
    start, words = representative_start(starts, [one(True, False, False), one(False, True, True)])
    assert start.theta == float(starts.theta[0])
    assert "no initial state is caught by all" in words


def test_the_phase_portrait_shows_the_run_and_the_gate_where_the_controller_has_it():
    controller = preset("lqr")
    run = cpjax.rollout(PLANT, controller, cpjax.HANGING, duration=4.0, dt=0.005, clock="sampled")
    one = Compared(Entry("tuned", "lqr", "tuned", controller), run.metrics, {})
    figure = phase_portraits(
        PLANT, {(kind, design): (one, run) for kind in ("paper", "tuned") for design in DESIGNS}, ""
    )
    swing_up, regulating, start = figure.axes[0].lines
    theta, rate = np.concatenate([np.stack(line.get_data()) for line in (swing_up, regulating)], axis=1)
    drawn = np.isfinite(theta) & np.isfinite(rate)
    assert np.abs(theta[drawn]).max() <= np.pi
    assert np.isclose(rate[drawn].max(), np.asarray(run.state.theta_dot).max())
    assert start.get_data()[0][0] == pytest.approx(np.pi)
    half_angle = float(controller.gate.half_angle)
    edge = max(path.vertices[:, 0].max() for path in figure.axes[0].collections[-1].get_paths())
    assert edge == pytest.approx(half_angle, abs=0.02)  # at rest


def test_compare_refuses_a_file_without_a_hybrid(tmp_path, command):
    cpjax.save(tmp_path / "plant.json", PLANT)
    done = command("compare", "--tuned-lqr", tmp_path / "plant.json", "--out", tmp_path)
    assert done.code == 2
    assert "tuned-lqr" in done.err


def test_compare_refuses_a_controller_of_the_other_design(tmp_path, command):
    io.save(tmp_path / "law.json", preset("placement"))
    done = command("compare", "--tuned-lqr", tmp_path / "law.json", "--out", tmp_path)
    assert done.code == 2
    assert "tuned-lqr" in done.err
