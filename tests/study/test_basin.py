"""Maps of where a controller works."""

import math

import jax
import numpy as np
import pytest
from tables import rows

import cpjax
from cpjax import paper
from cpjax.errors import InputError
from cpjax.study.basin import Axis, StartGrid, area, document

ANGLE, RATE = Axis("theta", -3.0, 3.0, 30), Axis("theta_dot", -2.0, 6.0, 40)


def test_every_cell_has_one_start_somewhere_inside_it():
    chart = StartGrid(ANGLE, RATE, {"x": (-0.1, 0.2)}, seed=3)
    starts = chart.starts()
    columns = np.floor((starts.theta + 3.0) / 0.2).astype(int)
    rows = np.floor((starts.theta_dot + 2.0) / 0.2).astype(int)
    np.testing.assert_array_equal(rows * 30 + columns, np.arange(1200))
    assert starts.x.min() >= -0.1
    assert starts.x.max() <= 0.2
    assert np.ptp(starts.x) > 0.29
    assert not starts.x_dot.any()
    assert chart.middle == {"x": pytest.approx(0.05), "x_dot": 0.0}


@rows("cells", [20, 60])
def test_the_area_of_a_disc_lies_in_its_interval_which_shrinks_with_the_cells(cells):
    """A disc of radius 1; its boundary passes through about 4 cells per cell of its diameter."""
    inside, widths = [], []
    for seed in range(100):
        chart = StartGrid(Axis("x", -1.5, 1.5, cells), Axis("x_dot", -1.5, 1.5, cells), seed=seed)
        starts = chart.starts()
        found = area(chart, starts.x**2 + starts.x_dot**2 <= 1.0)
        inside.append(abs(found.value - math.pi) <= found.half_width)
        widths.append(found.half_width)
    assert np.mean(inside) >= 0.95
    binomial = 1.96 * 9.0 * math.sqrt((math.pi / 9.0) * (1.0 - math.pi / 9.0)) / cells
    assert np.mean(widths) < binomial * {20: 0.6, 60: 0.35}[cells]


def test_of_a_map_without_a_boundary_the_interval_says_what_may_have_been_missed():
    chart = StartGrid(Axis("x", 0.0, 1.0, 10), Axis("x_dot", 0.0, 2.0, 10))
    for success in (True, False):
        found = area(chart, np.full(100, success))
        assert found.value == 2.0 * success
        assert found.half_width == pytest.approx(2.0 * 1.96**2 / (100 + 1.96**2), rel=1e-3)  # Wilson's, at 0 of 100


def test_a_cells_outcome_is_that_of_a_rollout_from_its_start():
    plant, controller = paper.appendix_plant(), cpjax.preset("placement")
    chart = StartGrid(Axis("theta", -1.0, 1.0, 3), Axis("theta_dot", -4.0, 4.0, 3))
    starts = chart.starts()
    metrics = cpjax.sweep(plant, controller, starts, duration=4.0, dt=0.002, clock="sampled")
    assert 0 < np.sum(metrics.success) <= 9
    for i in range(9):
        start = jax.tree.map(lambda column, i=i: float(column[i]), starts)
        alone = cpjax.measure(plant, controller, start, duration=4.0, dt=0.002, clock="sampled")
        assert bool(alone.success) == bool(metrics.success[i])
    found = document(chart, metrics)
    assert found["share"] == np.mean(metrics.success)
    assert found["area"] == pytest.approx(16.0 * found["share"])
    assert found["area_unit"] == "rad rad/s"


@rows(
    ("make", "field"),
    [
        (lambda: Axis("phi", 0.0, 1.0), "Axis.name"),
        (lambda: Axis("x", 1.0, 1.0), "Axis.high"),
        (lambda: Axis("x", math.nan, 1.0), "Axis.low"),
        (lambda: Axis("x", None, 1.0), "Axis.low"),
        (lambda: Axis("x", np.array([0.0, 0.5]), 1.0), "Axis.low"),
        (lambda: Axis("x", 0.0, 1.0, 1), "Axis.cells"),
        (lambda: StartGrid(ANGLE, RATE, {"x": 0.0}), r"StartGrid.others\[x\]"),
        (lambda: StartGrid(ANGLE, RATE, {"x": (0.0, "1")}), r"StartGrid.others\[x\]"),
        (lambda: StartGrid(ANGLE, ANGLE), "StartGrid.up"),
        (lambda: StartGrid(ANGLE, RATE, {"theta": (0.0, 0.0)}), "StartGrid.others"),
        (lambda: StartGrid(ANGLE, RATE, {"x": (1.0, 0.0)}), r"StartGrid.others\[x\]"),
        (lambda: StartGrid(ANGLE, RATE, seed=-1), "StartGrid.seed"),
    ],
)
def test_bad_maps_are_refused(make, field):
    with pytest.raises(InputError, match=field):
        make()
