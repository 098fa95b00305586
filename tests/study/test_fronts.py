"""Trade-off fronts: what is minimised, what is chosen, and a small front from end to end."""

import dataclasses
import math

import numpy as np
import pytest

import cpjax
from cpjax import paper
from cpjax.errors import InputError
from cpjax.numeric.pareto import nondominated
from cpjax.show.front import Curve, findings
from cpjax.sim.metrics import TimeOutside
from cpjax.study.fronts.cache import Search, load_or_run
from cpjax.study.fronts.config import COSTS, FrontConfig
from cpjax.study.fronts.evaluator import Evaluated, nondominated_sort
from cpjax.study.fronts.reference_point import objectives, reference_points
from cpjax.study.fronts.trace import GRADIENT_STEP, METRICS, trace_fronts
from cpjax.tune.baseline import baseline
from cpjax.tune.objective import Lagrangian, RemainingTime, VoltageVariation
from cpjax.tune.parameters import free_parameters
from cpjax.workspace import Workspace

PLANT = paper.appendix_plant()
START = cpjax.State(0.05, 0.0, 3.0, 0.1)


@pytest.mark.slow
def test_the_time_that_is_minimised_has_every_cost_at_its_price():
    law = baseline("lqr", PLANT)
    run = {"duration": 2.0, "dt": 0.005, "clock": "sampled"}
    protocol = cpjax.measure(PLANT, law, START, **run)
    time = cpjax.measure(PLANT, law, START, metrics=TimeOutside(0.05, 0.05), **run)
    costs = [VoltageVariation(1e-9) if name == "voltage_variation" else METRICS[name] for name in COSTS]
    terms = (TimeOutside(0.05, 0.05), *costs, RemainingTime(2.0))
    total, spent = cpjax.measure(PLANT, law, START, metrics=Lagrangian(terms, (0.01, 2.0, 0.0), 10.0), **run)
    np.testing.assert_allclose(spent, [getattr(protocol, cost) for cost in COSTS], rtol=1e-5)
    assert float(total) == pytest.approx(float(time + 0.01 * protocol.effort + 2.0 * protocol.cart_travel))


def evaluated(rows):
    success, time, effort = np.array(rows).T
    costs = np.stack([effort, np.ones(len(rows)), np.ones(len(rows))], axis=1)
    return Evaluated(np.arange(len(rows), dtype=float)[:, None], success, time, costs)


def test_the_fastest_within_a_bound_never_fails_if_any_does_not():
    archive = evaluated([(1.0, 3.0, 10.0), (1.0, 2.0, 20.0), (0.9, 1.0, 5.0), (1.0, 4.0, 8.0)])
    assert archive.fastest("effort", 15.0, 0.99)[0] == 0.0
    assert archive.fastest("effort", 25.0, 0.99) == (1.0, 2.0)
    assert archive.fastest("effort", 25.0, 0.99, rank=1) == (0.0, 3.0)
    assert archive.fastest("effort", 25.0, 0.99, rank=9) == (3.0, 4.0)  # there are but three
    vector, time = archive.fastest("effort", 7.0, 0.99)
    assert (vector, time) == (3.0, math.inf)  # none keeps to it: the cheapest of those that never fail


def test_where_none_settles_enough_those_count_that_nearly_match_the_best():
    archive = evaluated([(0.6, 3.0, 10.0), (0.59, 2.0, 20.0), (0.3, 1.0, 5.0)])
    assert archive.fastest("effort", 100.0, 0.99) == (1.0, 2.0)
    assert archive.epsilon_grid("effort", FrontConfig(bounds=2)).tolist() == pytest.approx([8.5, 20.0, math.inf])


@pytest.mark.slow
def test_the_reference_is_the_same_for_both_designs_and_beyond_their_baselines():
    found = reference_points(PLANT, FrontConfig(final=64))
    for objective in objectives(PLANT):
        points = np.array([found.baseline[design][objective] for design in ("lqr", "placement")])
        np.testing.assert_allclose(found.reference[objective], 1.1 * points.max(axis=0))


@pytest.mark.slow
def test_a_supply_at_which_nothing_settles_is_named():
    weak = dataclasses.replace(PLANT, motor=dataclasses.replace(PLANT.motor, voltage_limit=1.0))
    with pytest.raises(InputError, match="voltage_limit"):
        reference_points(weak, FrontConfig(final=8, horizon=2.0))


def test_layers_begin_with_what_no_other_beats_and_end_with_what_is_finite():
    points = np.array([[9.0, 90.0], [1.0, 5.0], [2.0, 4.0], [3.0, 6.0], [np.inf, np.inf]])
    assert nondominated_sort(points, 2).tolist() == [1, 2]
    assert nondominated_sort(points, 3).tolist() == [1, 2, 3]
    assert sorted(nondominated_sort(points, 100)) == [0, 1, 2, 3]
    assert nondominated_sort(points[4:], 2).tolist() == [0]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"bounds": 0}, "bounds"),
        ({"dt": -1.0}, "dt"),
        ({"lowest": 1.0}, "lowest"),
        ({"success": 1.5}, "success"),
        ({"multiplier_range": 0.5}, "multiplier_range"),
        ({"lowest": 0.9995}, "lowest"),
        ({"restart_from": 0.0}, "restart_from"),
        ({"spare_rate": 0.0}, "spare_rate"),
        ({"clip": math.inf}, "clip"),
        ({"explore": -0.1}, "explore"),
    ],
)
def test_a_bad_plan_is_refused(change, field):
    with pytest.raises(InputError, match=field):
        FrontConfig(**change)


def test_the_sentences_say_of_each_design_what_either_search_found():
    def curve(traced, random, *volumes):
        return Curve(np.reshape(traced, (-1, 2)), np.reshape(random, (-1, 2)), *volumes)

    lqr, placement = curve([2.0, 9.0], [3.0, 9.0], 4.0, 5.0), curve([2.5, 9.0], [], 2.0, 0.0)
    (both,) = findings({(12.0, "effort"): {"lqr": lqr, "placement": placement}})
    assert "LQR settles after 2.00 s at the fastest, and random search dominates 25 % more than its front" in both
    assert "pole placement dominates 50 % less than LQR" in both
    lqr, placement = curve([], [3.0, 9.0], 0.0, 5.0), curve([9.0, 9.0], [], 0.0, 0.0)
    (one,) = findings({(9.0, "effort"): {"lqr": lqr, "placement": placement}})
    assert "LQR has no point by gradients, random search has some" in one
    assert "pole placement settles after 9.00 s at the fastest, beyond the reference" in one
    assert "less than" not in one


def test_a_search_that_is_done_is_read_again_to_the_last_bit(tmp_path):
    archive = evaluated([(1.0, 1 / 3, 10.0), (0.5, math.inf, 20.0)])
    found = Search(
        {12.0: archive, 0.1: archive._replace(time=archive.time + 1.0)},
        {12.0: 1, 0.1: 2},
        {12.0: 3, 0.1: 4},
        {12.0: 5, 0.1: 6},
        7.5,
    )
    memory = Workspace(tmp_path / "parts", {})
    assert load_or_run(memory, "search", lambda: found) is found
    again = load_or_run(memory, "search", lambda: pytest.fail("searched again"))
    assert again[1:] == found[1:]
    assert list(again.archive) == [12.0, 0.1]
    for supply, one in found.archive.items():
        for kept, column in zip(again.archive[supply], one, strict=True):
            np.testing.assert_array_equal(kept, column)
    assert load_or_run(None, "search", lambda: found) is found


@pytest.mark.slow
def test_a_small_front_is_made_of_controllers_that_do_what_its_points_say():
    plan = FrontConfig(bounds=6, candidates=1024, steps=6, evaluate_every=3, reevaluation=64, final=128, horizon=10.0)
    measure = reference_points(PLANT, plan, (24.0,))
    told = []
    found = trace_fronts(
        PLANT, "placement", plan, measure.reference, supplies=(24.0,), report=lambda *what: told.append(what)
    )
    for cost in COSTS:
        front = found.traced[12.0, cost]
        assert len(front.points) >= 2
        assert len(nondominated(front.points)) == len(front.points)
        assert np.all(front.success >= plan.success)
        assert np.all(front.points[0, 0] < measure.baseline["placement"][12.0, cost][0])
        assert front.volume > 0.0
        free = free_parameters(baseline("placement", PLANT))
        for point, vector in zip(front.points, front.vectors, strict=True):
            starts = cpjax.sample_starts("hanging", 512, seed=11)  # others than those that measured the point
            metrics = cpjax.sweep(PLANT, free.build(vector), starts, duration=10.0, dt=0.002, clock="sampled")
            good = np.asarray(metrics.success)
            assert np.mean(good) > 0.97
            for name, measured in zip(("settling_time", cost), point, strict=True):
                again = np.asarray(getattr(metrics, name))[good]
                assert abs(measured - np.mean(again)) < 5.0 * np.std(again) / math.sqrt(plan.final)
    assert found.steps[12.0]["gradients"] == 3 * found.steps[24.0]["gradients"]
    for steps in found.steps.values():
        assert 0.95 < steps["random"] / (steps["values"] + GRADIENT_STEP * steps["gradients"]) < 1.2
    assert [done for done, _, _ in told] == sorted(done for done, _, _ in told)
    assert told[-1][:2] == (16, 16)  # steps, supplies, and the fronts of both searches
