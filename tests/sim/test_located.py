"""Rollouts with located switching: what they have in common with the others, their limits, and their derivatives."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import jacobian

import cpjax
from cpjax import (
    AngleGate,
    AngleRateGate,
    CartPole,
    EnergySwingUp,
    Flag,
    Hybrid,
    InputError,
    LyapunovGate,
    Motor,
    State,
    StateFeedback,
    linearize,
    lqr,
    paper,
)
from cpjax.pytree import pytree
from cpjax.sim.switching import CROSSING_COST

PLANT = paper.appendix_plant()
SOFT = paper.controller("corrected-centred", "placement", PLANT)
WEIGHTS = jnp.diag(jnp.asarray([20.0, 2.0, 50.0, 2.0]))
GATES = {
    "angle": lambda P: AngleGate(0.5),
    "angle with hysteresis": lambda P: AngleGate(0.4, hysteresis=0.2),
    "angle and rate": lambda P: AngleRateGate(0.5, 3.0),
    "level set": lambda P: LyapunovGate(P, 20.0),
}
NEAR = State(0.03, 0.0, math.pi - 0.25, 0.2)


def loop(gate="angle", plant=PLANT):
    A, B = linearize(plant)
    K, P = lqr(A, B, WEIGHTS, jnp.eye(1))
    law = EnergySwingUp(plant, energy_gain=5.0, cart_stiffness=4.0, cart_damping=2.0)
    return Hybrid(law, StateFeedback(K), GATES[gate](P))


def located(plant, controller, start, **settings):
    return cpjax.rollout(plant, controller, start, **{"duration": 2.4, "dt": 2e-3, "switching": "located", **settings})


# --- values -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_without_clip_and_crossing_it_is_the_rollout_that_reads_its_mode_per_step():
    plant = replace(PLANT, motor=replace(PLANT.motor, voltage_limit=math.inf))
    law = loop(plant=plant).swing_up
    start = State(0.0, 0.0, 3.0, 0.0)
    found, other = (
        cpjax.rollout(plant, law, start, duration=0.6, dt=2e-3, clock="continuous", switching=s)
        for s in ("located", "per_step")
    )
    assert np.max(np.abs(other.voltage)) > 12.0
    for name in ("time", "voltage", "mode", "cart_acceleration", "flag"):
        np.testing.assert_allclose(getattr(found, name), getattr(other, name), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(found.state.vector(), other.state.vector(), rtol=1e-13, atol=1e-13)
    for name in ("effort", "voltage_variation", "cart_travel", "peak_voltage"):
        assert float(getattr(found.metrics, name)) == pytest.approx(float(getattr(other.metrics, name)), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "gate",
    [
        "angle with hysteresis",
        *(pytest.param(g, marks=pytest.mark.slow) for g in ("level set", "angle", "angle and rate")),
    ],
)
def test_samples_are_on_the_grid_inside_the_supply_and_in_the_gates_mode(gate):
    controller = loop(gate)
    run = located(PLANT, controller, NEAR)
    np.testing.assert_allclose(run.time, 2e-3 * np.arange(1201), rtol=1e-12)
    assert run.flag == 0
    assert np.max(np.abs(run.voltage)) <= 12.0
    assert set(np.unique(run.mode)) == {0, 1}
    margin = jax.vmap(controller.gate.margin)(run.state, run.mode)
    assert np.all(np.where(run.mode == 1, margin >= -1e-12, margin <= 1e-12))
    demand = jax.vmap(controller.mode_voltage)(run.state, run.mode)
    np.testing.assert_allclose(run.voltage, np.clip(demand, -12.0, 12.0), atol=1e-9)


@pytest.mark.slow
def test_the_metrics_see_what_happens_inside_the_steps():
    coarse, fine = (located(PLANT, SOFT, NEAR, dt=dt).metrics for dt in (4e-3, 2.5e-4))
    for name, tolerance in (("effort", 1e-3), ("voltage_variation", 1e-3), ("cart_travel", 1e-4)):
        assert float(getattr(coarse, name)) == pytest.approx(float(getattr(fine, name)), rel=tolerance)
    assert coarse.switches == fine.switches == 1


@pytest.mark.slow
def test_what_is_kept_of_the_samples_changes_nothing_else():
    whole, some = (located(PLANT, SOFT, NEAR, save_every=n) for n in (1, 40))
    np.testing.assert_array_equal(some.state.vector(), whole.state.vector()[::40])
    np.testing.assert_array_equal(some.mode, whole.mode[::40])
    measured = cpjax.measure(PLANT, SOFT, NEAR, duration=2.4, dt=2e-3, switching="located")
    for name in ("effort", "settling_time", "switches"):
        np.testing.assert_allclose(getattr(measured, name), getattr(whole.metrics, name), rtol=1e-12)


def test_a_start_on_the_gate_and_one_inside_it_are_in_the_regulator():
    for theta in (0.5, 0.1, -0.5):
        run = located(PLANT, loop(), State(0.0, 0.0, theta, -2.0 * math.copysign(1.0, theta)), duration=0.02)
        assert run.mode[0] == 1


@pytest.mark.slow
def test_in_a_sweep_each_start_crosses_at_its_own_time_as_if_alone():
    starts = cpjax.sample_starts("hanging", 6, seed=3)
    together = cpjax.sweep(PLANT, SOFT, starts, duration=4.0, dt=2e-3, switching="located", chunk=4)
    for i in range(6):
        start = State(*(float(column[i]) for column in starts.vector().T))
        alone = cpjax.measure(PLANT, SOFT, start, duration=4.0, dt=2e-3, switching="located")
        assert float(together.effort[i]) == pytest.approx(float(alone.effort), rel=1e-10)
        assert together.switches[i] == alone.switches


# --- limits -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_with_too_few_spare_steps_is_stopped_flagged_and_no_success():
    runs = {n: located(PLANT, SOFT, NEAR, duration=8.0, spare_steps=n) for n in (8, 400)}
    assert runs[400].flag == 0
    assert runs[400].metrics.success
    assert runs[8].flag == Flag.OVERFLOW
    assert not runs[8].metrics.success
    assert np.all(np.isfinite(runs[8].state.vector()))
    np.testing.assert_allclose(runs[8].time, runs[400].time)
    stopped = int(np.argmin(np.any(np.diff(np.asarray(runs[8].state.vector()), axis=0) != 0.0, axis=1)))
    assert stopped > 1
    np.testing.assert_allclose(
        runs[8].state.vector()[:stopped], runs[400].state.vector()[:stopped], rtol=1e-9, atol=1e-12
    )


@pytest.mark.slow
def test_a_crossing_takes_as_many_spare_steps_as_it_says():
    inside = State(0.0, 0.0, 0.6, -3.0)  # into the gate, without the clip
    plant = replace(PLANT, motor=replace(PLANT.motor, voltage_limit=1e4))
    enough, short = (
        located(plant, loop(plant=plant), inside, duration=0.1, spare_steps=n)
        for n in (CROSSING_COST, CROSSING_COST - 1)
    )
    assert enough.metrics.switches == 1
    assert enough.flag == 0
    assert short.flag == Flag.OVERFLOW


@pytree
class Push:
    """A constant voltage towards or away from upright."""

    strength: float = 0.0

    def voltage(self, state):
        return self.strength * jnp.sin(state.theta)


@pytest.mark.slow
def test_two_laws_that_push_each_other_over_the_gate_are_flagged():
    # Beyond a rate the outer law brakes, within it the inner one accelerates: the rate can only stay where it is.
    chattering = Hybrid(Push(-400.0), Push(400.0), AngleRateGate(1.0, 1.0))
    run = located(PLANT, chattering, State(0.0, 0.0, 0.1, 1.1), duration=0.4)
    assert int(run.flag) & Flag.CHATTERING
    assert int(run.flag) & Flag.OVERFLOW
    assert not run.metrics.success
    wide = Hybrid(Push(-400.0), Push(400.0), AngleRateGate(1.0, 1.0, hysteresis=0.1))
    assert located(PLANT, wide, State(0.0, 0.0, 0.1, 1.1), duration=0.4, spare_steps=400).flag == 0


def test_a_runaway_is_held_and_flagged_as_on_the_other_path():
    fall = replace(loop(), regulator=StateFeedback([-1e6, -1e6, -1e6, -1e6]))
    plant = replace(PLANT, motor=replace(PLANT.motor, voltage_limit=1e9))
    run = located(plant, fall, State(0.0, 0.1, 0.1, 0.0), duration=0.4)
    assert int(run.flag) & Flag.RUNAWAY
    assert np.all(np.isfinite(run.state.vector()))


@pytree
class Elapsed:
    """The shortest time between samples, and what was located."""

    def init(self, sample):
        return jnp.full_like(sample.time, jnp.inf), 0 * sample.crossing

    def update(self, memory, sample):
        shortest, crossings = memory
        apart = jnp.where(sample.time > 0.0, sample.elapsed, jnp.inf)
        return jnp.minimum(shortest, apart), crossings + (sample.crossing > 0).astype(jnp.int32)

    def finalize(self, memory, last):
        return (*memory, last.flag)


@pytree
class Located:
    """For each value of `crossing`: how often it was seen, and the lowest and the highest voltage there."""

    def init(self, sample):
        none = jnp.zeros(4, sample.time.dtype)
        return none, none + jnp.inf, none - jnp.inf

    def update(self, memory, sample):
        here = sample.crossing == jnp.arange(4, dtype=jnp.int32)
        seen, lowest, highest = memory
        return (
            seen + here.astype(seen.dtype),
            jnp.where(here, jnp.minimum(lowest, sample.voltage), lowest),
            jnp.where(here, jnp.maximum(highest, sample.voltage), highest),
        )

    def finalize(self, memory, last):
        return memory


def test_a_crossing_is_numbered_by_its_limit_or_as_the_gates():
    settings = {"duration": 2.4, "dt": 2e-3, "switching": "located"}
    seen, lowest, highest = cpjax.measure(PLANT, loop(), NEAR, metrics=Located(), **settings)
    assert np.all(seen[1:] > 0)
    assert lowest[1] == pytest.approx(12.0)
    assert highest[2] == pytest.approx(-12.0)
    assert -12.0 < lowest[3] <= highest[3] < 12.0


@pytest.mark.slow
def test_with_coarse_steps_time_only_grows_and_the_supply_is_never_exceeded():
    draws = random_draws(1500, 3, jnp.float64)

    def seen(x):
        plant, controller, start = random_loop(x)
        settings = {"duration": 0.4, "dt": 1e-2, "switching": "located", "spare_steps": 400}
        shortest, _, flag = cpjax.measure(plant, controller, start, metrics=Elapsed(), **settings)
        peak = cpjax.measure(plant, controller, start, **settings).peak_voltage
        return shortest, flag, peak / plant.motor.voltage_limit

    shortest, flag, peak = jax.jit(jax.vmap(seen))(draws)
    clean = flag == 0
    assert np.mean(clean) > 0.8
    assert np.min(shortest[clean]) >= -1e-6 * 1e-2
    assert np.max(peak) <= 1.0 + 1e-6


def test_a_demand_that_jumps_from_one_limit_past_the_other_never_exceeds_the_supply():
    run = located(PLANT, StateFeedback(SOFT.regulator.K), State(0.0, 0.0, 3.0, 2.0), duration=1.0)
    assert np.max(np.abs(run.voltage)) <= 12.0
    assert 0.0 <= run.metrics.effort <= 144.0 * (1 + 1e-9)


@pytest.mark.slow
def test_a_run_that_is_held_just_after_a_crossing_counts_it_once():
    inside = State(0.0, 0.0, 0.6, -3.0)
    plant = replace(PLANT, motor=replace(PLANT.motor, voltage_limit=1e4))
    for spare in range(CROSSING_COST + 1):
        settings = {"duration": 0.1, "dt": 2e-3, "switching": "located", "spare_steps": spare}
        _, crossings, flag = cpjax.measure(plant, loop(plant=plant), inside, metrics=Elapsed(), **settings)
        assert crossings <= 1
        assert (flag == 0) == (spare == CROSSING_COST)


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"clock": "sampled"}, "switching"),
        ({"switching": "per_step", "spare_steps": 3}, "spare_steps"),
        ({"spare_steps": -1}, "spare_steps"),
        ({"spare_steps": 1.5}, "spare_steps"),
        ({"spare_steps": True}, "spare_steps"),
        ({"checkpoint": "sometimes"}, "checkpoint"),
        ({"checkpoint": None}, "checkpoint"),
    ],
)
def test_settings_that_do_not_fit_are_refused_by_name(settings, field):
    with pytest.raises(InputError) as caught:
        located(PLANT, SOFT, NEAR, **settings)
    assert caught.value.field == field


class Steps:
    """A controller that knows only its next mode."""

    def start_mode(self, state):
        return jnp.zeros((), dtype=jnp.int32)

    def next_mode(self, state, mode):
        return mode

    def mode_voltage(self, state, mode):
        return jnp.zeros_like(state.x)


def test_a_controller_whose_switch_cannot_be_located_is_refused_and_runs_per_step():
    controller = pytree(Steps)()
    with pytest.raises(InputError, match="margin and successor"):
        located(PLANT, controller, NEAR)
    assert cpjax.rollout(PLANT, controller, NEAR, clock="continuous", duration=0.1, dt=0.01).flag == 0


# --- derivatives ------------------------------------------------------------------------------------------------------

NAMES = ("energy_gain", "cart_damping", "half_angle", "rate", "K_x", "K_theta", "voltage_limit", "pole_length", "theta")
VALUES = np.array([5.0, 2.0, 0.5, 3.0, -24.7, 111.7, 12.0, 0.7, math.pi - 0.25])


def cost(x, switching="located", dt=1e-3, checkpoint="every_step", duration=2.0):
    """A smooth number from a swing-up and catch, of nine parameters of every kind."""
    p = dict(zip(NAMES, x, strict=True))
    plant = CartPole(pole_length=p["pole_length"], motor=Motor(voltage_limit=p["voltage_limit"]))
    rates = jnp.asarray([-25.4, 28.6], dtype=x.dtype)
    K = jnp.stack([p["K_x"], rates[0], p["K_theta"], rates[1]])[None]
    law = EnergySwingUp(plant, energy_gain=p["energy_gain"], cart_stiffness=4.0, cart_damping=p["cart_damping"])
    controller = Hybrid(law, StateFeedback(K), AngleRateGate(p["half_angle"], p["rate"]))
    zero = jnp.zeros_like(p["theta"])
    start = State(zero + 0.03, zero, p["theta"], zero + 0.2)
    return cpjax.measure(
        plant,
        controller,
        start,
        duration=duration,
        dt=dt,
        switching=switching,
        checkpoint=checkpoint,
        metrics=cpjax.TimeOutside(1.5, 0.5),
    )


@pytest.fixture(scope="module")
def derivatives():
    rng = np.random.default_rng(4)
    x = jnp.asarray(VALUES * np.exp(rng.uniform(-0.05, 0.05, (3, VALUES.size))))
    x = x.at[:, -1].set(math.pi - rng.uniform(0.2, 0.3, 3))
    return x, jax.jit(jax.vmap(jax.grad(cost)))(x)


def test_reverse_mode_is_the_finite_difference_for_parameters_of_every_kind(derivatives):
    x, reverse = derivatives
    batched = jax.jit(jax.vmap(cost))
    for one, gradient in zip(x, reverse, strict=True):
        differences = jacobian(batched, one, 1e-4 * np.abs(one))
        scaled, size = (np.asarray(g) * np.abs(one) for g in (gradient - differences, differences))
        assert np.all(np.abs(scaled) <= 1e-6 * np.maximum(np.abs(size), 1e-3 * np.max(np.abs(size))))


@pytest.mark.slow
def test_forward_mode_and_segments_and_one_start_alone_give_the_same(derivatives):
    x, reverse = derivatives
    forward = jax.jit(jax.vmap(jax.jacfwd(cost)))(x)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-10 * np.max(np.abs(reverse)))
    segments = jax.jit(jax.grad(lambda x: cost(x, checkpoint="segments")))(x[0])
    np.testing.assert_allclose(segments, reverse[0], rtol=1e-10, atol=1e-10 * np.max(np.abs(reverse)))


@pytest.mark.slow
def test_read_per_step_the_gate_has_no_derivative_and_the_others_are_off(derivatives):
    x, reverse = derivatives
    with pytest.warns(cpjax.DerivativeWarning, match="leaves out how its change of mode moves"):
        plain = jax.jit(jax.grad(lambda x: cost(x, switching="per_step")))(x[0])
    assert plain[2] == plain[3] == 0.0
    assert np.all(np.abs(reverse[0, 2:4]) > 1e-3)
    assert np.max(np.abs(plain / reverse[0] - 1.0)[[0, 1, 6, 7]]) > 1e-2


@pytest.mark.slow
def test_float32_gives_the_derivatives_to_three_digits(derivatives):
    x, reverse = derivatives
    narrow = jax.jit(jax.vmap(jax.grad(cost)))(x.astype(jnp.float32))
    assert narrow.dtype == jnp.float32
    size = np.abs(np.asarray(reverse) * np.abs(x))
    error = np.abs(narrow.astype(np.float64) - reverse) * np.abs(x)
    assert np.all(error <= 3e-3 * size.max(axis=1, keepdims=True))


def ugly_starts():
    gate, clip = 0.4, 12.0
    K = np.asarray(loop().regulator.K)[0]
    yield "hanging at rest", (0.0, 0.0, math.pi, 0.0)
    yield "hanging the other way", (0.0, 0.0, -math.pi, 0.0)
    yield "upright at rest", (0.0, 0.0, 0.0, 0.0)
    yield "on the gate at rest", (0.0, 0.0, gate, 0.0)
    yield "on the gate, leaving", (0.0, 0.0, gate, 1.0)
    yield "on the gate, entering", (0.0, 0.0, gate, -1.0)
    yield "along the gate", (0.0, 0.0, -gate, 1e-300)
    yield "on the clip", (0.0, 0.0, -clip / K[2], 0.0)
    yield "on the clip, leaving it", (0.0, 0.0, -clip / K[2], -0.1)
    yield "beyond the clip", (0.3, 0.0, -0.3, 0.0)
    yield "across the turn", (0.0, 0.0, math.pi, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "gate"),
    [pytest.param(jnp.float64, "angle with hysteresis", marks=pytest.mark.slow), (jnp.float32, "level set")],
)
def test_no_value_and_no_gradient_is_nan_at_the_ugly_points(dtype, gate):
    starts = jnp.asarray([start for _, start in ugly_starts()], dtype=dtype)
    controller = loop(gate)

    def end(controller, plant, start):
        run = cpjax.measure(plant, controller, State.from_vector(start), duration=0.3, dt=2e-3, switching="located")
        return run.effort + run.cart_travel

    everything = jax.vmap(jax.value_and_grad(end, argnums=(0, 1, 2)), (None, None, 0))(controller, PLANT, starts)
    for path, leaf in jax.tree_util.tree_leaves_with_path(everything):
        assert np.all(np.isfinite(leaf)), jax.tree_util.keystr(path)


@pytree
class OutsideAndFlag:
    """Time outside the target, and how the run ended."""

    outside: cpjax.TimeOutside = cpjax.TimeOutside(1.5, 0.5)

    def init(self, sample):
        return self.outside.init(sample)

    def update(self, memory, sample):
        return self.outside.update(memory, sample)

    def finalize(self, memory, last):
        return self.outside.finalize(memory, last), last.flag


LOWEST = (0.3, 0.3, 0.05, 0.3, 1.0, 1.0, 10.0, 1.0, 3.0, 0.3, -0.5, -2.0, -math.pi, -8.0)
HIGHEST = (30.0, 6.0, 1.5, 10.0, 300.0, 100.0, 1000.0, 100.0, 30.0, 1.5, 0.5, 2.0, math.pi, 8.0)


def random_draws(count, seed, dtype):
    """Parameters over more than a decade, gains of either sign, and states anywhere."""
    rng = np.random.default_rng(seed)
    low, high = np.array(LOWEST), np.array(HIGHEST)
    parameters = np.exp(rng.uniform(np.log(low[:10]), np.log(high[:10]), (count, 10)))
    parameters[:, 4:8] *= np.array([-1.0, -1.0, 1.0, 1.0])
    states = rng.uniform(low[10:], high[10:], (count, 4))
    return jnp.asarray(np.concatenate([parameters, states], axis=1), dtype=dtype)


def random_loop(x):
    energy_gain, damping, half_angle, rate, *rest = x[:10]
    K, limit, length = jnp.stack(rest[:4])[None], rest[4], rest[5]
    plant = CartPole(pole_length=length, motor=Motor(voltage_limit=limit))
    law = EnergySwingUp(plant, energy_gain=energy_gain, cart_stiffness=4.0, cart_damping=damping)
    controller = Hybrid(law, StateFeedback(K), AngleRateGate(half_angle, rate))
    return plant, controller, State.from_vector(x[10:])


def outcome(x):
    settings = {"duration": 1.0, "dt": 2e-3, "switching": "located"}
    return cpjax.measure(*random_loop(x), metrics=OutsideAndFlag(), **settings)


def check_random_draws(count, dtype, chunk):
    batched = jax.jit(jax.vmap(jax.value_and_grad(outcome, has_aux=True)))
    flags = []
    for begin in range(0, count, chunk):
        (value, flag), gradient = batched(random_draws(chunk, begin, dtype))
        assert np.all(np.isfinite(value))
        assert np.all(np.isfinite(gradient))
        flags.append(np.asarray(flag))
    lost = np.concatenate(flags) & (Flag.RUNAWAY | Flag.NON_FINITE)
    assert np.mean(lost != 0) <= 0.01


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_no_value_and_no_gradient_is_nan_at_random_points(dtype):
    check_random_draws(500, dtype, chunk=500)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_no_value_and_no_gradient_is_nan_at_a_hundred_thousand_random_points(dtype):
    check_random_draws(100_000, dtype, chunk=2000)
