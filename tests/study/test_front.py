"""Trade-off fronts: what is minimised, what is chosen, and a small front from end to end."""

import math

import numpy as np
import pytest

import cpjax
from cpjax import paper
from cpjax.errors import InputError
from cpjax.numeric.pareto import nondominated
from cpjax.sim.metrics import TimeOutside
from cpjax.study.front import trace_fronts
from cpjax.study.front_judge import Judged, layers
from cpjax.study.front_plan import COSTS, FrontPlan
from cpjax.tune.objective import Effort, Jerkiness, PricedTime, Travel, Unfinished
from cpjax.tune.starting import beginning

PLANT = paper.appendix_plant()
START = cpjax.State(0.05, 0.0, 3.0, 0.1)


def test_the_time_that_is_minimised_has_every_cost_at_its_price():
    law = beginning("bland", "lqr", PLANT)
    run = {"duration": 2.0, "dt": 0.005, "clock": "sampled"}
    protocol = cpjax.measure(PLANT, law, START, **run)
    time = cpjax.measure(PLANT, law, START, metrics=TimeOutside(0.05, 0.05), **run)
    terms = (TimeOutside(0.05, 0.05), Effort(), Travel(), Jerkiness(1e-9), Unfinished(2.0))
    total, costs = cpjax.measure(PLANT, law, START, metrics=PricedTime(terms, (0.01, 2.0, 0.0), 10.0), **run)
    expected = [getattr(protocol, cost) for cost in COSTS]
    np.testing.assert_allclose(costs, expected, rtol=1e-5)
    assert float(total) == pytest.approx(float(time + 0.01 * protocol.effort + 2.0 * protocol.cart_travel))


def judged(rows):
    success, time, effort = np.array(rows).T
    costs = np.stack([effort, np.ones(len(rows)), np.ones(len(rows))], axis=1)
    return Judged(np.arange(len(rows), dtype=float)[:, None], success, time, costs)


def test_the_fastest_within_a_bound_never_fails_if_any_does_not():
    met = judged([(1.0, 3.0, 10.0), (1.0, 2.0, 20.0), (0.9, 1.0, 5.0), (1.0, 4.0, 8.0)])
    assert met.fastest("effort", 15.0)[0] == 0.0
    assert met.fastest("effort", 25.0) == (1.0, 2.0)
    assert met.fastest("effort", 25.0, rank=1) == (0.0, 3.0)
    assert met.fastest("effort", 25.0, rank=9) == (3.0, 4.0)  # there are but three
    vector, time = met.fastest("effort", 7.0)
    assert (vector, time) == (3.0, math.inf)  # none keeps to it: the cheapest of those that never fail


def test_layers_begin_with_what_no_other_beats_and_end_with_what_is_finite():
    points = np.array([[9.0, 90.0], [1.0, 5.0], [2.0, 4.0], [3.0, 6.0], [np.inf, np.inf]])
    assert layers(points, 2).tolist() == [1, 2]
    assert layers(points, 3).tolist() == [1, 2, 3]
    assert sorted(layers(points, 100)) == [0, 1, 2, 3]
    assert layers(points[4:], 2).tolist() == [0]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"bounds": 0}, "bounds"),
        ({"dt": -1.0}, "dt"),
        ({"lowest": 1.0}, "lowest"),
        ({"success": 1.5}, "success"),
        ({"dearest": 0.5}, "dearest"),
    ],
)
def test_a_bad_plan_is_refused(change, field):
    with pytest.raises(InputError, match=field):
        FrontPlan(**change)


@pytest.mark.slow
def test_a_small_front_is_made_of_controllers_that_do_what_its_points_say():
    plan = FrontPlan(bounds=4, candidates=256, steps=6, judge_every=3, semifinal=64, final=64, horizon=10.0)
    found = trace_fronts(PLANT, "placement", plan, report=lambda *_: None)
    for cost in COSTS:
        front = found.traced[12.0, cost]
        assert len(front.points) >= 2
        assert len(nondominated(front.points)) == len(front.points)
        assert np.all(front.success >= plan.success)
        assert np.all(front.points[0, 0] < found.bland[12.0, cost][0])
        assert front.volume > 0.0
    assert found.steps["random"] == pytest.approx(found.steps["values"] + 36.0 * found.steps["gradients"], rel=0.1)
