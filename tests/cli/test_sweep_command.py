"""`cpjax sweep`, called as a function."""

import json

import numpy as np
import pytest

import cpjax
from cpjax import io, presets
from cpjax.cli import main

SHORT = ("--count", "6", "--duration", "0.1", "--dt", "0.01", "--controller", "tuned_lqr", "--seed", "5")


def run(out, *arguments):
    return main(["sweep", *SHORT, "--out", str(out), *arguments])


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_it_writes_the_metrics_of_every_start_a_summary_and_a_picture(precision, tmp_path, capsys):
    assert run(tmp_path, "--precision", precision) == 0
    with np.load(tmp_path / "metrics.npz", allow_pickle=False) as found:
        travel = found["cart_travel"]
    starts = cpjax.sample_starts("hanging", 6, seed=5, dtype=np.dtype(precision))
    plant = cpjax.paper.appendix_plant()
    right = cpjax.sweep(plant, presets.preset("lqr"), starts, duration=0.1, dt=0.01, clock="sampled")
    assert travel.dtype == precision
    np.testing.assert_allclose(travel, right.cart_travel, rtol=1e-12 if precision == "float64" else 1e-5)
    document = json.loads((tmp_path / "sweep.json").read_text())
    assert (document["seed"], document["precision"], document["file"]) == (5, precision, "metrics.npz")
    assert document["plant"] == io.encode(plant)
    assert (tmp_path / "sweep.png").read_bytes().startswith(b"\x89PNG")
    text = capsys.readouterr().out
    assert "of 6 initial states settle" in text
    assert "M steps/s" not in text  # that is the progress bar's


@pytest.mark.parametrize("kind", ["json", "parquet"])
def test_the_format_is_asked_for(kind, tmp_path, capsys):
    if kind == "parquet":
        pytest.importorskip("pyarrow")
    assert run(tmp_path, "--format", kind) == 0
    assert (tmp_path / f"metrics.{kind}").exists()
    assert f"metrics.{kind}" in capsys.readouterr().out


def test_trajectories_go_to_a_folder(tmp_path, capsys):
    assert run(tmp_path, "--save-every", "2") == 0
    assert list((tmp_path / "trajectories").glob("*.npz"))
    assert "trajectories" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--precision", "float16"), "precision"),
        (("--format", "csv"), "format"),
        (("--count", "0"), "count"),
        (("--save-every", "3"), "save_every"),
        (("--dt", "-1"), "dt"),
        (("--dt", "nan"), "dt"),
    ],
)
def test_bad_options_are_refused_by_name(arguments, named, tmp_path, capsys):
    assert run(tmp_path, *arguments) == 2
    assert named in capsys.readouterr().err.replace("-", "_")
    assert not (tmp_path / "sweep.json").exists()
