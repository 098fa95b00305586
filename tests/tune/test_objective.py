import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cpjax
from cpjax import paper
from cpjax.errors import InputError
from cpjax.tune.baseline import baseline
from cpjax.tune.objective import (
    Effort,
    Goal,
    TerminalCost,
    TrackExcess,
    VoltageVariation,
    WeightedSum,
    soft_maximum,
    success_weighted,
    tail_mean,
)

PLANT = paper.appendix_plant()
LAW = baseline("lqr", PLANT)
START = cpjax.State(0.05, 0.0, 3.0, 0.1)
RUN = {"duration": 3.0, "dt": 0.005}


def test_terms_are_the_integrals_they_say():
    metric = WeightedSum(
        (Effort(), VoltageVariation(1e-9), TrackExcess(0.3, 0.1), TerminalCost()), (1.0, 0.0, 0.0, 0.0)
    )
    kept = cpjax.rollout(PLANT, LAW, START, clock="sampled", metrics=metric, **RUN)
    protocol = cpjax.measure(PLANT, LAW, START, clock="sampled", **RUN)
    assert float(kept.metrics) == pytest.approx(float(protocol.effort), rel=1e-12)
    jerk = cpjax.measure(PLANT, LAW, START, clock="sampled", metrics=VoltageVariation(1e-9), **RUN)
    assert float(jerk) == pytest.approx(float(protocol.voltage_variation), rel=1e-6)
    excess = cpjax.measure(PLANT, LAW, START, clock="sampled", metrics=TrackExcess(0.3, 0.1), **RUN)
    over = np.maximum(np.abs(np.asarray(kept.state.x)) - 0.2, 0.0) / 0.1
    rate = 1.0 - np.exp(-0.5 * over * over)
    assert float(excess) == pytest.approx(np.sum(0.5 * 0.005 * (rate[1:] + rate[:-1])), rel=1e-9)


@pytest.mark.slow
def test_every_terms_gradient_is_its_difference():
    goal = Goal(effort=0.01, track=1.0, track_limit=0.5, voltage_variation=0.01, energy=0.5, terminal=1.0)

    @jax.jit
    @jax.value_and_grad
    def value(gain):
        law = cpjax.Hybrid(cpjax.EnergySwingUp(PLANT, energy_gain=gain, cart_stiffness=2.0), LAW.regulator, LAW.gate)
        return cpjax.measure(
            PLANT, law, START, duration=1.5, dt=0.005, switching="located", metrics=goal.metric(PLANT, 0.3, 1.5)
        )

    at = jnp.asarray(3.0)
    differences = [float(value(at + h)[0] - value(at - h)[0]) / (2 * h) for h in (1e-4, 5e-5)]
    richardson = (4 * differences[1] - differences[0]) / 3
    assert float(value(at)[1]) == pytest.approx(richardson, rel=1e-5)


def test_aggregates():
    values = jnp.asarray([1.0, 2.0, 3.0, 10.0])
    assert float(tail_mean(0.5)(values)) == 6.5
    assert float(tail_mean(1.0)(values)) == 4.0
    np.testing.assert_allclose(jax.grad(tail_mean(0.25))(values), [0.0, 0.0, 0.0, 1.0])
    assert float(soft_maximum(1e-3)(values)) == pytest.approx(10.0, abs=2e-3)
    assert float(soft_maximum(1e4)(values)) == pytest.approx(4.0, abs=2e-3)
    assert float(success_weighted(5.0, 0.1)(values)) == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize(
    "make", [lambda: tail_mean(0.0), lambda: soft_maximum(-1.0), lambda: success_weighted(1.0, 0.0)]
)
def test_bad_aggregates_are_refused(make):
    with pytest.raises(InputError):
        make()


def test_a_track_weight_needs_a_limit_and_a_goal_a_weight():
    with pytest.raises(InputError, match="track"):
        Goal(track=1.0)
    with pytest.raises(InputError, match="weight"):
        Goal(time=0.0)


@pytest.mark.slow
def test_what_a_stopped_run_leaves_undone_counts_as_badly_spent():
    """Two spare steps are too few for the first swings: a run that is stopped early must not look the better one."""
    goal = Goal(effort=0.01)
    run = {"duration": 3.0, "dt": 0.02, "switching": "located", "metrics": goal.metric(PLANT, 0.3, 3.0)}
    stopped = cpjax.rollout(PLANT, LAW, START, spare_steps=2, **run)
    assert stopped.flag & cpjax.Flag.OVERFLOW
    whole = cpjax.rollout(PLANT, LAW, START, **run)
    assert whole.flag == 0
    reached = cpjax.rollout(PLANT, LAW, START, spare_steps=2, **(run | {"metrics": goal.metric(PLANT, 0.3, 1e-9)}))
    rest = float(stopped.metrics - reached.metrics) / (1.0 + 0.01 * 144.0)
    assert rest == pytest.approx(3.0, rel=1e-6)
    assert float(stopped.metrics) > float(whole.metrics)
