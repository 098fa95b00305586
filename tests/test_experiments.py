"""Every experiment runs in its quick mode and leaves its files."""

import importlib.util
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent.parent / "experiments"
EXPERIMENTS = sorted(path for path in FOLDER.glob("*.py") if not path.name.startswith("_"))


SLOW = {  # a minute of compiling each, or what the package's own tests hold anyway
    "ablation",
    "accuracy",
    "benchmark",
    "benchmark_design",
    "compile_times",
    "cost_of_the_bench",
    "damages",
    "friction_derivatives",
    "gradient_accuracy",
    "gradient_cost",
    "kill_and_resume",
    "mean_derivative",
    "open_pages",
    "recover_parameters",
    "reference_steps",
    "reference_times",
    "riccati_accuracy",
    "sweep_against_measure",
    "sweep_on_a_rig",
    "speed_against",
    "start_up",
    "success_table",
    "tune_anywhere",
    "tune_baselines",
    "tune_robust",
    "tune_seeds",
    "tune_track",
    "tuner_cost",
}


@pytest.fixture(
    params=[pytest.param(p, marks=[pytest.mark.slow] * (p.stem in SLOW)) for p in EXPERIMENTS],
    ids=lambda path: path.stem,
)
def experiment(request, monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    spec = importlib.util.spec_from_file_location(request.param.stem, request.param)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, request.param.stem, module)
    spec.loader.exec_module(module)
    return module


def test_its_quick_mode_writes_its_json(experiment, tmp_path, capsys):
    if experiment.__name__ == "open_pages" and experiment.find_browser() is None:
        pytest.skip("no browser on the path")
    experiment.main(tmp_path, quick=True)
    written = {path.name for path in tmp_path.iterdir()}
    assert f"{experiment.__name__}.json" in written
    assert capsys.readouterr().out.strip()


def test_its_docstring_names_the_command_that_runs_it(experiment):
    assert f"python experiments/{experiment.__name__}.py" in experiment.__doc__
