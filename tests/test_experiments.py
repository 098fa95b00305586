"""Every experiment runs in its quick mode and leaves its files."""

import importlib.util
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import cpjax

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


def test_the_gradient_by_hand_in_c_is_that_of_jax(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER / "benchmark"))
    import problem
    import roofline

    if roofline.compiler() is None:
        pytest.skip("no C compiler")
    plant, law = problem.problem()
    hanging = cpjax.sample_starts("hanging", 8, seed=1)
    starts = jax.tree.map(lambda column: np.concatenate([column, 0.1 * column]), hanging)
    starts.theta[8:] += 0.1 * np.arange(8)
    starts.theta[0], starts.theta_dot[0] = np.pi - 1e-3, 0.0  # within the radius of the kick
    steps = 150
    monkeypatch.setattr(roofline, "TRIAL_STEPS", 1000)
    library, _ = roofline.build("float64", plant, law, starts, 1, roofline.GRADIENT)
    travel, effort, found = roofline.run_gradient(library, plant, law, starts, steps, problem.DT)

    def cost(law, start):
        options = problem.settings(steps) | {"derivative": "pathwise"}
        metrics = cpjax.measure(plant, law, start, **options)
        return metrics.effort, metrics.cart_travel

    (value, cart_travel), gradient = jax.jit(jax.vmap(jax.value_and_grad(cost, has_aux=True), (None, 0)))(law, starts)
    np.testing.assert_allclose(travel, cart_travel, rtol=1e-12)
    np.testing.assert_allclose(effort, value, rtol=1e-12)
    swing_up = gradient.swing_up
    K = np.moveaxis(gradient.regulator.K[:, 0], 1, 0)
    numbers = dict(zip(("K0", "K1", "K2", "K3"), K, strict=True))
    numbers |= {name: getattr(swing_up, name) for name in ("energy_gain", "cart_stiffness", "cart_damping", "kick")}
    model = swing_up.model
    numbers |= {"pivot_friction": model.pivot_friction, "cart_friction": model.cart_friction, "total": model.cart_mass}
    for name, expected in numbers.items():
        assert np.any(np.asarray(expected) != 0.0), name
        np.testing.assert_allclose(found[name], expected, rtol=1e-9, atol=1e-9 * np.max(np.abs(expected)), err_msg=name)
