"""`cpjax tune` and `cpjax compare`, called as functions, and the tuned controllers that ship."""

import json

import numpy as np
import pytest

import cpjax
from cpjax import io, paper
from cpjax.controllers import LqrWeights, PoleFactors
from cpjax.study.comparison import DESIGNS, best, compare, entries, preset
from cpjax.study.reproduction import Setting

PLANT = paper.appendix_plant()
SMALL = ("--candidates", "3", "--restarts", "2", "--batch", "2", "--steps", "2", "--duration", "1")


def test_tune_writes_a_controller_that_other_commands_take(tmp_path, command):
    done = command("tune", "--out", tmp_path, *SMALL)
    assert done.code == 0
    assert "settle" in done.out
    tuned = cpjax.load(tmp_path / "tuned.json")
    assert isinstance(tuned.regulator.design, LqrWeights)
    result = json.loads((tmp_path / "tune.json").read_text())
    assert result["gradient_steps"] == 2 * 2 * 2 * (50 + 32)
    assert io.encode(tuned) == result["controller"]
    assert (tmp_path / "tune.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--steps", "-1"), "steps = -1"),
        (("--start-from", "nowhere"), "beginning = 'nowhere'"),
        (("--frozen", "nonsense"), "frozen = 'nonsense'"),
        (("--track", "1"), "track"),
    ],
)
def test_tune_names_what_is_wrong(arguments, words, tmp_path, command):
    done = command("tune", "--out", tmp_path, *arguments)
    assert done.code == 2
    assert words in done.err
    assert done.err.count("\n") == 1


@pytest.mark.parametrize("design", DESIGNS)
def test_a_shipped_controller_is_what_its_design_gives_and_swings_up_every_start(design):
    law = preset(design)
    assert isinstance(law.regulator.design, LqrWeights if design == "lqr" else PoleFactors)
    found = law.regulator.design.solve(*cpjax.linearize(PLANT))
    np.testing.assert_allclose(law.regulator.K, found.K, rtol=1e-9)
    starts = cpjax.sample_starts("hanging", 256, seed=77)
    metrics = cpjax.sweep(PLANT, law, starts, duration=10.0, dt=0.002, clock="sampled")
    assert np.all(metrics.success)
    assert np.mean(metrics.settling_time) < 2.55


def test_a_comparison_has_the_papers_eight_and_two_tuned_and_ranks_the_tuned_first():
    setting = Setting(count=16, duration=8.0, dt=0.004)
    _, results = compare(PLANT, entries(PLANT), setting)
    assert [one.entry.gains for one in results].count("tuned") == 2
    assert len(results) == 10
    for design in DESIGNS:
        tuned, papers = best(results, design, tuned=True), best(results, design, tuned=False)
        assert tuned.summary["success_rate"] > papers.summary["success_rate"]


def test_compare_writes_its_table_and_pictures(tmp_path, command):
    done = command("compare", "--count", "4", "--duration", "4", "--dt", "0.004", "--out", tmp_path)
    assert done.code == 0
    assert "Tuned:" in done.out
    assert len(json.loads((tmp_path / "compare.json").read_text())["rows"]) == 10
    assert {path.name for path in tmp_path.iterdir()} == {"compare.json", "responses.png", "by_start.png"}


def test_compare_refuses_a_file_without_a_hybrid(tmp_path, command):
    cpjax.save(tmp_path / "plant.json", PLANT)
    done = command("compare", "--tuned-lqr", tmp_path / "plant.json", "--out", tmp_path)
    assert done.code == 2
    assert "tuned-lqr" in done.err
