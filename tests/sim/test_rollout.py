"""Rollouts: samples, clocks, metrics, flags and dtypes, each against something worked out apart from them."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cpjax
from cpjax import REGULATE, SWING_UP, Flag, State, paper
from cpjax.plant.state import RUNAWAY_LIMIT
from cpjax.sim.flags import CHATTER_LENGTH, describe

PLANT = paper.appendix_plant()
CENTRED = paper.controller("corrected-centred", "placement", PLANT)
START = State(0.05, 0.0, math.pi - 0.2, 0.1)
EVALUATION = {"duration": 6.0, "dt": 0.002, "clock": "sampled"}


@pytest.fixture(scope="module")
def caught():
    return cpjax.rollout(PLANT, CENTRED, START, **EVALUATION)


def test_samples_have_one_length_and_span_the_duration(caught):
    assert caught.time.shape == caught.voltage.shape == caught.mode.shape == caught.state.theta.shape == (3001,)
    np.testing.assert_allclose(caught.time, np.arange(3001) * 0.002, rtol=0, atol=1e-15)
    assert [float(v[0]) for v in (caught.state.x, caught.state.theta)] == [0.05, math.pi - 0.2]


def test_the_voltage_is_the_clipped_law_of_the_mode_at_every_control_instant(caught):
    for i in (0, 100, 400, 900, 2000, 3000):
        state = jax.tree.map(lambda column, i=i: column[i], caught.state)
        demanded = CENTRED.mode_voltage(state, caught.mode[i])
        assert float(caught.voltage[i]) == pytest.approx(float(np.clip(demanded, -12, 12)), abs=1e-9)
    assert float(jnp.max(jnp.abs(caught.voltage))) == 12.0
    assert {SWING_UP, REGULATE} == set(np.asarray(caught.mode).tolist())


def test_saving_every_kth_sample_keeps_those_samples_and_all_metrics(caught):
    thinned = cpjax.rollout(PLANT, CENTRED, START, save_every=10, **EVALUATION)
    assert thinned.time.shape == (301,)
    for name in ("time", "voltage", "mode", "cart_acceleration"):
        np.testing.assert_allclose(getattr(thinned, name), getattr(caught, name)[::10], rtol=1e-9, atol=1e-9)
    for full, thin in zip(jax.tree.leaves(caught.metrics), jax.tree.leaves(thinned.metrics), strict=True):
        np.testing.assert_allclose(thin, full, rtol=1e-9)


def metrics_by_hand(trajectory, dt, hold=1.0):
    """The protocol's definitions, written down again over a stored trajectory of the sampled clock."""
    t, u = np.asarray(trajectory.time), np.asarray(trajectory.voltage)
    x, theta = np.asarray(trajectory.state.x), np.asarray(trajectory.state.theta)
    inside = (np.abs(np.remainder(theta + np.pi, 2 * np.pi) - np.pi) <= 0.05) & (np.abs(x) <= 0.05)
    outside = np.flatnonzero(~inside)
    settled = 0.0 if outside.size == 0 else (math.inf if outside[-1] == t.size - 1 else t[outside[-1] + 1])
    return {
        "success": settled <= t[-1] - hold + 1e-9,
        "settling_time": settled,
        "cart_travel": np.abs(x).max(),
        "effort": (u[:-1] ** 2).sum() * dt,
        "voltage_variation": np.abs(np.diff(u)).sum(),
        "peak_voltage": np.abs(u).max(),
        "peak_cart_acceleration": np.abs(np.asarray(trajectory.cart_acceleration)).max(),
        "switches": np.count_nonzero(np.diff(np.asarray(trajectory.mode))),
        "flag": 0,
    }


@pytest.mark.parametrize("law", ["as-printed", "corrected-centred"])
@pytest.mark.parametrize("design", ["placement", "lqr"])
def test_the_metrics_are_those_of_the_protocols_definitions(law, design):
    controller = paper.controller(law, design, PLANT)
    trajectory = cpjax.rollout(PLANT, controller, START, **EVALUATION)
    for name, expected in metrics_by_hand(trajectory, 0.002).items():
        assert float(getattr(trajectory.metrics, name)) == pytest.approx(float(expected), rel=1e-9), name


def test_the_settling_metrics_know_late_early_and_lost_bands():
    metric = cpjax.ProtocolMetrics()

    def judged(x):
        """The metric's verdict on a made-up path of the cart, one sample a second."""
        zero = jnp.asarray(0.0)
        samples = [
            cpjax.sim.metrics.Sample(
                time=jnp.asarray(float(i)),
                elapsed=jnp.asarray(float(i > 0)),
                state=State(jnp.asarray(v), zero, jnp.asarray(math.tau), zero),
                voltage=zero,
                voltage_since=zero,
                voltage_until=None,
                mode=jnp.asarray(1),
                mode_before=jnp.asarray(1),
                outputs={"cart_acceleration": zero},
                plant_mode=(),
                flag=jnp.asarray(0),
                crossing=jnp.asarray(0),
                crossing_speed=zero,
            )
            for i, v in enumerate(x)
        ]
        memory = metric.init(samples[0])
        for sample in samples:
            memory = metric.update(memory, sample)
        result = metric.finalize(memory, samples[-1])
        return float(result.settling_time), bool(result.success)

    assert judged([0.0] * 5) == (0.0, True)
    assert judged([1.0, 0.0, 0.0, 0.0, 0.0]) == (1.0, True)
    assert judged([0.0, 0.0, 1.0, 0.0, 0.0]) == (3.0, True)  # settles exactly `hold` before the end
    assert judged([0.0, 0.0, 0.0, 1.0, 0.0]) == (4.0, False)  # too late
    assert judged([0.0, 0.0, 0.0, 0.0, 1.0]) == (math.inf, False)
    assert judged([0.05, -0.05, 0.05, 0.0, 0.0]) == (0.0, True)  # the band is closed


def test_a_track_limit_turns_a_wide_success_into_a_failure(caught):
    travel = float(caught.metrics.cart_travel)
    for limit, success in ((travel + 1e-6, True), (travel - 1e-6, False)):
        metric = cpjax.ProtocolMetrics(track_limit=limit)
        assert bool(cpjax.measure(PLANT, CENTRED, START, metrics=metric, **EVALUATION).success) == success


def test_a_longer_control_period_holds_the_voltage_and_the_mode_between_instants():
    run = cpjax.rollout(PLANT, CENTRED, START, duration=4.0, dt=0.001, clock="sampled", control_period=0.02)
    for values in (run.voltage, run.mode):
        blocks = np.asarray(values)[:-1].reshape(-1, 20)
        assert (blocks == blocks[:, :1]).all()
    assert np.count_nonzero(np.diff(np.asarray(run.voltage))) > 20


def test_the_control_period_and_not_the_step_decides_what_the_plant_does():
    coarse = cpjax.rollout(PLANT, CENTRED, START, duration=2.0, dt=0.004, clock="sampled", control_period=0.02)
    fine = cpjax.rollout(PLANT, CENTRED, START, duration=2.0, dt=0.0005, clock="sampled", control_period=0.02)
    np.testing.assert_allclose(fine.state.theta[::8], coarse.state.theta, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_dense_sampled_clock_approaches_the_continuous_one():
    gentle = cpjax.EnergySwingUp(PLANT, energy_gain=0.5, kick=0.0)
    settings = {"duration": 1.0, "save_every": 1}
    continuous = cpjax.rollout(PLANT, gentle, START, dt=0.001, clock="continuous", **settings)
    errors = []
    for dt in (0.004, 0.002, 0.001):
        held = cpjax.rollout(PLANT, gentle, START, dt=dt, clock="sampled", **settings)
        errors.append(abs(float(held.state.theta[-1] - continuous.state.theta[-1])))
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.1)
    assert errors[1] / errors[2] == pytest.approx(2.0, abs=0.1)


def test_the_effort_of_the_continuous_clock_is_the_integral_of_the_squared_voltage():
    gentle = cpjax.EnergySwingUp(PLANT, energy_gain=0.5, kick=0.0)
    fine = cpjax.rollout(PLANT, gentle, START, clock="continuous", duration=1.0, dt=0.0005)
    from scipy.integrate import simpson

    expected = simpson(np.asarray(fine.voltage) ** 2, dx=0.0005)
    coarse = cpjax.measure(PLANT, gentle, START, clock="continuous", duration=1.0, dt=0.002)
    assert float(coarse.effort) == pytest.approx(expected, rel=1e-5)


def test_a_batch_is_the_same_as_one_start_at_a_time():
    starts = cpjax.sample_starts("hanging", 5, seed=11)
    batch = cpjax.sweep(PLANT, CENTRED, starts, **EVALUATION, chunk=2)
    for i in range(5):
        one = cpjax.measure(PLANT, CENTRED, jax.tree.map(lambda c, i=i: float(c[i]), starts), **EVALUATION)
        for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-7)


def test_sweep_reports_progress_block_by_block():
    seen = []
    starts = cpjax.sample_starts("hanging", 5, seed=11)
    settings = {"duration": 0.1, "dt": 0.002, "block": 2}
    cpjax.sweep(PLANT, CENTRED, starts, progress=lambda done, total: seen.append((done, total)), **settings)
    assert seen == [(2, 5), (4, 5), (5, 5)]


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["sampled", "continuous"])
def test_a_float32_start_makes_a_float32_rollout_close_to_the_float64_one(clock):
    start = jax.tree.map(jnp.float32, START)
    settings = {"duration": 1.5, "dt": 0.002, "clock": clock}
    single = cpjax.rollout(PLANT, CENTRED, start, **settings)
    double = cpjax.rollout(PLANT, CENTRED, START, **settings)
    floats = [single.time, single.state.x, single.voltage, single.cart_acceleration, single.metrics.effort]
    assert {leaf.dtype for leaf in floats} == {jnp.dtype("float32")}
    assert single.mode.dtype == jnp.int32
    np.testing.assert_allclose(single.state.theta, double.state.theta, rtol=0, atol=2e-3)


def test_a_rollout_that_runs_away_is_flagged_held_and_no_success():
    wild = cpjax.StateFeedback([0.0, -50.0, 0.0, 0.0])  # pushes the cart the way it goes
    unlimited = dataclasses.replace(PLANT, motor=dataclasses.replace(PLANT.motor, voltage_limit=math.inf))
    run = cpjax.rollout(unlimited, wild, State(0.0, 0.1, 0.3, 0.0), clock="continuous", duration=4.0, dt=0.002)
    assert int(run.flag) & Flag.RUNAWAY
    assert describe(int(run.flag)) == "runaway"
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(run.state))
    assert float(jnp.max(jnp.abs(run.state.x_dot))) <= RUNAWAY_LIMIT
    assert float(run.state.x[-1]) == float(run.state.x[-2])
    assert not bool(run.metrics.success)
    assert float(run.metrics.settling_time) == math.inf


def test_a_non_finite_parameter_under_jit_is_flagged_and_raises_nothing():
    @jax.jit
    def run(mass):
        return cpjax.rollout(
            dataclasses.replace(PLANT, cart_mass=mass), CENTRED, START, clock="continuous", duration=0.1, dt=0.002
        )

    result = run(jnp.nan)
    assert int(result.flag) & Flag.NON_FINITE
    assert not bool(result.metrics.success)
    assert int(run(1.0).flag) == 0


def test_chattering_across_a_gate_is_flagged_and_hysteresis_ends_it():
    # Inside the gate the regulator pushes out, outside the swing-up law pushes back in: sliding along the boundary.
    gate = cpjax.LyapunovGate(P=np.diag([0.0, 1.0, 0.0, 0.0]), level=0.25)

    def controller(gate):
        return cpjax.Hybrid(cpjax.StateFeedback([0, 60, 0, 0]), cpjax.StateFeedback([0, -60, 0, 0]), gate)

    settings = {"duration": 0.5, "dt": 0.002, "clock": "sampled"}
    start = State(0.0, 0.4, math.pi, 0.0)
    sliding = cpjax.rollout(PLANT, controller(gate), start, **settings)
    assert int(sliding.flag) & Flag.CHATTERING
    assert int(sliding.metrics.switches) > CHATTER_LENGTH
    calm = cpjax.rollout(PLANT, controller(dataclasses.replace(gate, hysteresis=1.0)), start, **settings)
    assert int(calm.flag) == 0
    assert 0 < int(calm.metrics.switches) < int(sliding.metrics.switches) / 3


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["sampled", "continuous"])
def test_a_smooth_rollouts_derivative_agrees_forward_in_reverse_and_with_differences(clock):
    """One second of swing-up before the gate, in each law parameter and each start component."""
    settings = {"duration": 0.6, "dt": 0.005, "clock": clock}

    def final_angle(p):
        law = cpjax.EnergySwingUp(PLANT, energy_gain=p[0], cart_stiffness=p[1], cart_damping=p[2])
        run = cpjax.rollout(PLANT, law, State(p[3], p[4], p[5], p[6]), **settings)
        return run.state.theta[-1]

    p = jnp.array([0.4, 1.0, 0.5, 0.05, 0.1, math.pi - 0.3, 0.2])
    forward, reverse = jax.jacfwd(final_angle)(p), jax.grad(final_angle)(p)
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-13)
    batch = jax.vmap(jax.grad(final_angle))(jnp.stack([p, p * 1.01]))
    np.testing.assert_allclose(batch[0], reverse, rtol=1e-10, atol=1e-12)
    value = jax.jit(final_angle)
    for i in range(7):
        e = jnp.zeros(7).at[i].set(1e-3)
        rough, fine = (value(p + e) - value(p - e)) / 2e-3, (value(p + e / 2) - value(p - e / 2)) / 1e-3
        assert float((4 * fine - rough) / 3) == pytest.approx(float(forward[i]), rel=1e-8, abs=1e-9)


@pytest.mark.parametrize("theta", [math.pi, -math.pi, 0.0, paper.SWITCH_ANGLE])
@pytest.mark.parametrize("dtype", [jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.slow)])
def test_gradients_are_finite_from_the_ugly_starts(theta, dtype):
    """Hanging at rest, at -pi, upright at rest, exactly on the gate."""

    def travel(start, plant):
        settings = {"duration": 0.4, "dt": 0.004, "clock": "continuous", "derivative": "pathwise"}
        run = cpjax.rollout(plant, CENTRED, start, **settings)
        return run.state.theta[-1] + run.metrics.effort + run.metrics.cart_travel + run.metrics.voltage_variation

    start = jax.tree.map(dtype, State(0.0, 0.0, theta, 0.0))
    gradients = jax.grad(travel, argnums=(0, 1))(start, jax.tree.map(dtype, PLANT))
    assert all(bool(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradients))


@pytest.mark.slow
def test_new_numbers_do_not_compile_again():
    cpjax.measure(PLANT, CENTRED, START, **EVALUATION)
    other = paper.controller("corrected-centred", "lqr", paper.identified_plant(), "computed")
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(lambda event, _, **__: compiled.append(event))
    try:
        cpjax.measure(paper.identified_plant(), other, cpjax.HANGING, duration=9.0, dt=0.003, clock="sampled")
    finally:
        jax.monitoring.clear_event_listeners()
    assert [event for event in compiled if "backend_compile" in event] == []


def test_a_run_that_settles_where_its_regulator_holds_it_is_a_success():
    law = cpjax.StateFeedback(paper.PRINTED_GAINS["placement"], reference=State(0.3, 0.0, 0.0, 0.0))
    settings = {"duration": 6.0, "dt": 0.002, "clock": "sampled"}
    for where, success in ((0.3, True), (0.0, False)):
        metric = cpjax.ProtocolMetrics(reference_x=where)
        result = cpjax.measure(PLANT, law, State(0.0, 0.0, 0.1, 0.0), metrics=metric, **settings)
        assert bool(result.success) == success


def test_a_stopped_run_adds_nothing_more_to_its_effort():
    wild = cpjax.StateFeedback([0.0, -50.0, 0.0, 0.0])
    unlimited = dataclasses.replace(PLANT, motor=dataclasses.replace(PLANT.motor, voltage_limit=math.inf))
    start = State(0.0, 0.1, 0.3, 0.0)
    short, long = (cpjax.measure(unlimited, wild, start, clock="continuous", duration=d, dt=0.002) for d in (1.0, 4.0))
    assert int(short.flag) & Flag.RUNAWAY
    assert float(long.effort) == float(short.effort)


class OpaqueLaw:
    def voltage(self, state):
        return 0.1 * state.x


@cpjax.pytree.pytree
class CubicLaw:
    """A law of a user's own, with a float64 constant that must not widen a float32 rollout."""

    gain: float = cpjax.pytree.number("V/m^3", "of the cube", above=0.0)

    def voltage(self, state):
        return -self.gain * state.x**3 + np.float64(0.25) * 0


def test_a_law_of_ones_own_runs_once_it_is_a_component():
    with jax.numpy_dtype_promotion("standard"):  # as users have it
        run = cpjax.rollout(
            PLANT, CubicLaw(2.0), jax.tree.map(jnp.float32, START), clock="continuous", duration=0.1, dt=0.002
        )
    assert run.voltage.dtype == jnp.float32
    assert float(run.voltage[0]) == pytest.approx(-2.0 * 0.05**3)
    with pytest.raises(cpjax.InputError, match=r"controller.* must be a number; a class of your own"):
        cpjax.rollout(PLANT, OpaqueLaw(), START, clock="continuous", duration=0.1, dt=0.002)


def test_a_component_that_an_optimiser_moved_out_of_its_range_is_refused():
    moved = jax.tree.map(lambda leaf: leaf - 2.0, PLANT)
    with pytest.raises(cpjax.InputError, match=r"plant\.cart_mass = -1\.0: must be a finite number above 0"):
        cpjax.rollout(moved, CENTRED, START, clock="continuous", duration=0.1, dt=0.002)


def test_a_metric_whose_method_is_called_finish_works_and_warns():
    @cpjax.pytree.pytree
    class Furthest:
        def init(self, sample):
            return jnp.abs(sample.state.x)

        def update(self, state, sample):
            return jnp.maximum(state, jnp.abs(sample.state.x))

        def finish(self, state, last):
            return state

    with pytest.warns(DeprecationWarning, match=r"Furthest\.finish is now called finalize"):
        found = cpjax.measure(PLANT, CENTRED, START, metrics=Furthest(), duration=0.1, dt=0.01)
    assert float(found) == float(cpjax.measure(PLANT, CENTRED, START, duration=0.1, dt=0.01).cart_travel)
