"""Level sets inside clip and gate: against points of their boundaries, closed forms, the paper, and the plant."""

import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from oracles import jacobian
from scipy.linalg import eigh, expm, solve_continuous_lyapunov
from tables import rows

from cpjax import AngleGate, AngleRateGate, InputError, LyapunovGate, State, StateFeedback, linearize, paper, sweep
from cpjax.linear.limits import (
    demanded_voltage,
    level_within_angle,
    level_within_angle_and_rate,
    level_within_form,
    level_within_voltage,
    lyapunov_function,
    saturation_angle,
)
from cpjax.sim.flags import Flag

PLANT = paper.identified_plant()
A, B = linearize(PLANT)
K = paper.computed_gain("placement", PLANT)
GATES = [(0.5, 2.0), (0.5, 200.0), (0.02, 1.0), (2.5, 3.0), (3.0, 0.1), (3.14, 2000.0), (math.pi, 20.0)]
the_gates = rows(("half_angle", "rate"), GATES)


def random_form(rng, n=4):
    """Symmetric, positive definite, with eigenvalues over four decades."""
    vectors = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return vectors @ np.diag(10.0 ** rng.uniform(-2.0, 2.0, n)) @ vectors.T


def boundary(P, level, count, rng):
    """Random points (count, n) at which s' P s = level."""
    z = rng.normal(size=(count, len(P)))
    z *= math.sqrt(level) / np.linalg.norm(z, axis=1, keepdims=True)
    return np.linalg.solve(np.linalg.cholesky(P).T, z.T).T


def shadow(P, level, count):
    """Points (count, 2) of the outline of {s' P s <= level} on angle and rate, all the way around."""
    turn = np.linspace(0.0, math.tau, count)
    root = np.linalg.cholesky(np.linalg.inv(P)[2:, 2:])
    return math.sqrt(level) * np.stack([np.cos(turn), np.sin(turn)], axis=1) @ root.T


def used(half_angle, rate, angle, angle_rate):
    """What an AngleRateGate lets through: up to 1."""
    return (np.sin(angle / 2) / math.sin(half_angle / 2)) ** 2 + (angle_rate / rate) ** 2


# --- no point beyond, and one that gets there -------------------------------------------------------------------------


@rows("seed", range(5))
def test_the_level_set_demands_at_most_the_voltage_limit_and_reaches_it(seed):
    rng = np.random.default_rng(seed)
    P, gain, limit = random_form(rng), rng.normal(size=(1, 4)) * 30.0, rng.uniform(5.0, 30.0)
    level = float(level_within_voltage(P, gain, limit))
    asked = np.abs(boundary(P, level, 100_000, rng) @ gain[0])
    assert 0.99 * limit < np.max(asked) <= limit * (1 + 1e-12)
    extreme = np.linalg.solve(P, gain[0])
    extreme *= math.sqrt(level / (extreme @ P @ extreme))
    assert abs(extreme @ gain[0]) == pytest.approx(limit, rel=1e-10)


@rows("seed", range(5))
def test_no_state_of_the_level_set_leaves_the_angle_gate_and_one_stands_on_its_edge(seed):
    rng = np.random.default_rng(seed)
    P, half_angle = random_form(rng), rng.uniform(0.1, 3.0)
    level = float(level_within_angle(P, half_angle))
    angles = np.abs(boundary(P, level, 100_000, rng)[:, 2])
    assert 0.99 * half_angle < np.max(angles) <= half_angle * (1 + 1e-12)
    assert np.max(np.abs(shadow(P, level, 10_001)[:, 0])) == pytest.approx(half_angle, rel=1e-6)


@the_gates
@rows("seed", range(3))
def test_the_level_set_lies_in_the_angle_rate_gate_and_touches_its_edge(half_angle, rate, seed):
    rng = np.random.default_rng(seed)
    P = random_form(rng)
    level = float(level_within_angle_and_rate(P, half_angle, rate))
    angle, angle_rate = shadow(P, level, 200_001).T
    inside = np.abs(angle) < math.pi  # a level set that passes hanging is one that touches it, too
    assert np.max(np.abs(angle)) <= math.pi * (1 + 1e-6)
    assert np.max(used(half_angle, rate, angle[inside], angle_rate[inside])) == pytest.approx(1.0, abs=1e-6)
    far = boundary(P, level, 10_000, rng)
    assert np.max(used(half_angle, rate, far[:, 2], far[:, 3])) <= 1.0 + 1e-9


@rows("seed", range(5))
def test_no_state_of_the_level_set_leaves_another_level_set_and_one_touches_it(seed):
    rng = np.random.default_rng(seed)
    P, other, bound = random_form(rng), random_form(rng), rng.uniform(0.5, 40.0)
    level = float(level_within_form(P, other, bound))
    points = boundary(P, level, 100_000, rng)
    reached = np.sum(points * (points @ other), axis=1)
    assert 0.99 * bound < np.max(reached) <= bound * (1 + 1e-12)
    assert level == pytest.approx(bound / eigh(other, P, eigvals_only=True)[-1], rel=1e-10)


@rows(
    ("gate", "level_of"),
    [
        (AngleGate(0.5), lambda P: level_within_angle(P, 0.5)),
        (AngleRateGate(0.5, 2.0), lambda P: level_within_angle_and_rate(P, 0.5, 2.0)),
        (LyapunovGate(np.eye(4), 0.3), lambda P: level_within_form(P, jnp.eye(4), 0.3)),
    ],
    ids=["angle", "angle-rate", "lyapunov"],
)
def test_gates_are_open_all_over_the_level_set_and_shut_somewhere_outside(gate, level_of):
    rng = np.random.default_rng(4)
    P = random_form(rng)
    margin = jax.vmap(lambda s: gate.margin(State.from_vector(s), jnp.asarray(0)))
    level = float(level_of(P))
    points = jnp.asarray(boundary(P, level, 200_000, rng))
    assert np.min(margin(points * (1 - 1e-9))) > 0.0
    assert np.min(margin(points * 1.01)) < 0.0


# --- closed forms -----------------------------------------------------------------------------------------------------


def test_of_a_diagonal_form_every_level_is_written_down():
    P = np.diag([3.0, 0.2, 7.0, 0.5])
    gain = np.array([[1.0, -2.0, 30.0, 4.0]])
    expected = 12.0**2 / (1 / 3 + 4 / 0.2 + 900 / 7 + 16 / 0.5)
    assert float(level_within_voltage(P, gain, 12.0)) == pytest.approx(expected, rel=1e-14)
    assert float(level_within_angle(P, 0.5)) == pytest.approx(7 * 0.5**2, rel=1e-14)
    for half_angle, rate in ((0.5, 0.01), (0.5, 100.0), (2.0, 1.0), (2.0, 1000.0), (1e-3, 1e3), (1e-3, 1e-5)):
        ends = 7 * half_angle**2, 0.5 * rate**2  # the smaller one, as they are far apart
        level = float(level_within_angle_and_rate(P, half_angle, rate))
        assert level == pytest.approx(min(ends), rel=1e-13)
    other = np.diag([1.0, 1.0, 2.0, 0.0])
    assert float(level_within_form(P, other, 4.0)) == pytest.approx(4.0 * 0.2, rel=1e-14)


def test_a_gate_hardly_limited_in_rate_is_an_angle_gate():
    rng = np.random.default_rng(0)
    for _ in range(5):
        P = random_form(rng)
        level = float(level_within_angle_and_rate(P, 0.7, 1e6))
        assert level == pytest.approx(float(level_within_angle(P, 0.7)), rel=1e-9)


def test_a_level_set_inside_its_own_level_set_is_that_level_set():
    P = random_form(np.random.default_rng(1))
    assert float(level_within_form(P, P, 3.0)) == pytest.approx(3.0, rel=1e-12)
    assert float(level_within_form(P, 5.0 * P, 3.0)) == pytest.approx(0.6, rel=1e-12)


def test_where_nothing_limits_the_level_is_infinite():
    P = random_form(np.random.default_rng(2))
    assert float(level_within_voltage(P, np.ones((1, 4)), math.inf)) == math.inf
    assert float(level_within_voltage(P, np.zeros((1, 4)), 12.0)) == math.inf
    assert float(level_within_form(P, -np.eye(4), 1.0)) == math.inf
    assert float(level_within_form(P, np.zeros((4, 4)), 1.0)) == math.inf
    assert float(saturation_angle(K, math.inf)) == math.inf
    assert float(saturation_angle([[1.0, 2.0, 0.0, 3.0]], 12.0)) == math.inf


def test_a_level_scales_with_the_form_and_with_the_square_of_the_limits():
    P = random_form(np.random.default_rng(3))
    levels = [
        lambda P, size: level_within_voltage(P, K, 12.0 * size),
        lambda P, size: level_within_angle(P, 0.5 * size),
        lambda P, size: level_within_angle_and_rate(P, 1e-4 * size, 1e-3 * size),  # small, where cos is a parabola
    ]
    for level in levels:
        assert float(level(9.0 * P, 2.0)) == pytest.approx(36.0 * float(level(P, 1.0)), rel=1e-8)


def test_only_the_symmetric_part_of_a_form_counts():
    rng = np.random.default_rng(5)
    P, skew = random_form(rng), rng.normal(size=(4, 4))
    skew -= skew.T
    for level in (
        lambda P: level_within_voltage(P, K, 12.0),
        lambda P: level_within_angle(P, 0.5),
        lambda P: level_within_angle_and_rate(P, 0.5, 2.0),
        lambda P: level_within_form(P, np.eye(4), 1.0),
        lambda P: level_within_form(np.eye(4), P, 1.0),
    ):
        assert float(level(P + skew)) == pytest.approx(float(level(P)), rel=1e-10)


# --- the paper --------------------------------------------------------------------------------------------------------


def test_at_the_papers_switch_lqr_asks_for_2500_volts_and_placement_for_58():
    for design, voltage, degrees in (("lqr", 2510.67, 0.14339), ("placement", 58.486, 6.1553)):
        gain = [paper.PRINTED_GAINS[design]]
        assert float(demanded_voltage(gain, paper.SWITCH_ANGLE)) == pytest.approx(voltage, rel=2e-5)
        assert float(demanded_voltage(gain, -paper.SWITCH_ANGLE)) == pytest.approx(voltage, rel=2e-5)
        angle = saturation_angle(gain, 12.0)
        assert math.degrees(angle) == pytest.approx(degrees, rel=5e-5)
        assert float(demanded_voltage(gain, angle)) == pytest.approx(12.0, rel=1e-14)


# --- the Lyapunov function --------------------------------------------------------------------------------------------


@rows("design", ["placement", "lqr"])
def test_the_lyapunov_function_is_scipys_and_falls_as_asked(design):
    gain = np.array([paper.PRINTED_GAINS[design]])
    Q = random_form(np.random.default_rng(6))
    P = np.asarray(lyapunov_function(A, B, gain, Q))
    closed = np.asarray(A) - np.asarray(B) @ gain
    np.testing.assert_allclose(P, solve_continuous_lyapunov(closed.T, -Q), rtol=1e-8)
    assert np.min(np.linalg.eigvalsh(P)) > 0.0

    time = np.linspace(0.0, 3.0, 3001)
    step, s = expm(closed * (time[1] - time[0])), np.array([0.3, -0.2, 0.1, 0.5])
    states = [s]
    for _ in time[1:]:
        states.append(step @ states[-1])
    states = np.array(states)
    values = np.sum(states * (states @ P), axis=1)
    assert np.all(np.diff(values) < 0.0)
    lost = np.trapezoid(np.sum(states * (states @ Q), axis=1), time)
    assert values[0] - values[-1] == pytest.approx(lost, rel=1e-3 if design == "lqr" else 1e-5)


def certified(gain, half_angle, limit=12.0, weight=None):
    P = lyapunov_function(A, B, gain, np.eye(4) if weight is None else weight)
    return np.asarray(P), float(min(level_within_voltage(P, gain, limit), level_within_angle(P, half_angle)))


@pytest.fixture(scope="module")
def metrics_from():
    def run(points):
        starts = State(*(jnp.asarray(column) for column in points.T))
        return sweep(PLANT, StateFeedback(K), starts, clock="continuous", duration=8.0, dt=0.005)

    return run


def test_from_placements_certified_boundary_the_plant_settles_unsaturated(metrics_from):
    P, level = certified(K, paper.SWITCH_ANGLE)
    points = boundary(P, 0.99 * level, 63, np.random.default_rng(7))
    extreme = np.linalg.solve(P, np.asarray(K)[0])
    extreme *= math.sqrt(0.99 * level / (extreme @ P @ extreme))
    metrics = metrics_from(np.concatenate([points, extreme[None]]))
    assert np.all(metrics.flag == Flag(0))
    assert np.all(metrics.success)
    assert np.all(metrics.peak_voltage < 12.0)
    assert np.max(metrics.peak_voltage) == pytest.approx(12.0 * math.sqrt(0.99), rel=1e-9)  # at the extreme start


def test_beyond_the_certified_boundary_the_plant_saturates(metrics_from):
    P, level = certified(K, paper.SWITCH_ANGLE)
    extreme = np.linalg.solve(P, np.asarray(K)[0])
    extreme *= math.sqrt(1.01 * level / (extreme @ P @ extreme))
    assert np.all(metrics_from(np.tile(extreme, (64, 1))).peak_voltage == 12.0)


# --- derivatives ------------------------------------------------------------------------------------------------------

FORM = random_form(np.random.default_rng(8))
OTHER = random_form(np.random.default_rng(9))
FUNCTIONS = {
    "demanded_voltage": (demanded_voltage, (K, 0.4)),
    "saturation_angle": (saturation_angle, (K, 12.0)),
    "level_within_voltage": (level_within_voltage, (FORM, K, 12.0)),
    "level_within_angle": (level_within_angle, (FORM, 0.5)),
    "level_within_angle_and_rate": (level_within_angle_and_rate, (FORM, 0.5, 2.0)),
    "level_within_form": (level_within_form, (FORM, OTHER, 3.0)),
    "certified level": (
        lambda A, K, Q, limit: level_within_voltage(lyapunov_function(A, B, K, Q), K, limit),
        (A, K, FORM, 12.0),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_agree_forward_in_reverse_with_differences_and_under_vmap(name):
    function, arguments = FUNCTIONS[name]
    point, unravel = ravel_pytree(tuple(jnp.asarray(x) for x in arguments))

    def flat(x):
        return function(*unravel(x))

    def both(x, direction):
        return jax.jvp(flat, (x,), (direction,))[1], jax.grad(flat)(x)

    directions = jnp.asarray(np.random.default_rng(10).normal(size=(3, *point.shape)) * np.abs(point))
    points = point + 0.01 * jnp.roll(directions, 1, axis=0)
    forward, reverse = (np.asarray(a) for a in jax.jit(jax.vmap(both))(points, directions))
    alone = jax.jit(jax.grad(flat))
    values = jax.jit(jax.vmap(flat))
    for x, direction, ahead, back in zip(points, directions, forward, reverse, strict=True):
        size = np.linalg.norm(back * x)
        assert abs(back @ direction - ahead) <= 1e-10 * size
        assert np.linalg.norm((alone(x) - back) * x) <= 1e-10 * size
        differences = jacobian(values, x, 1e-3 * np.maximum(np.abs(x), 0.1 * np.median(np.abs(x))))
        assert np.linalg.norm((differences - back) * x) <= 1e-8 * size


slopes = jax.jit(jax.grad(level_within_angle_and_rate, argnums=(0, 1, 2)))


@pytest.mark.slow
def test_second_derivatives_of_the_level_inside_are_those_of_the_first():
    def gradient(limits):
        return jnp.stack(slopes(FORM, limits[0], limits[1])[1:])

    hessian = jax.jit(jax.jacfwd(gradient))
    for limits in (jnp.asarray([0.5, 2.0]), jnp.asarray([2.5, 3.0])):
        expected = jacobian(lambda points: np.stack([gradient(point) for point in points]), limits, 1e-2)
        np.testing.assert_allclose(hessian(limits), expected, rtol=1e-8, atol=1e-8 * np.max(np.abs(expected)))


@pytest.mark.slow
@rows("half_angle", [1e-6, 0.5, 3.1, math.pi])
@rows("rate", [1e-6, 2.0, 1e4])
def test_no_derivative_of_the_level_inside_angle_and_rate_is_nan(half_angle, rate):
    for P in (np.eye(4), FORM):
        assert all(np.all(np.isfinite(slope)) for slope in slopes(jnp.asarray(P), half_angle, rate))


def test_the_level_inside_a_multiple_of_the_same_form_has_that_derivative():
    P = jnp.asarray(FORM)

    def level(factor):
        return level_within_form(P, factor * P, 3.0)

    assert float(jax.grad(level)(2.0)) == pytest.approx(-3.0 / 4.0, rel=1e-10)
    assert float(jax.jvp(level, (2.0,), (1.0,))[1]) == pytest.approx(-3.0 / 4.0, rel=1e-10)


# --- float32, and what is refused -------------------------------------------------------------------------------------


def test_every_function_stays_in_float32_and_agrees_with_float64_to_its_digits():
    narrow = jnp.float32
    for function, point in FUNCTIONS.values():
        if function.__name__ == "<lambda>":
            continue
        given = [jnp.asarray(x, narrow) if np.ndim(x) else x for x in point]
        found = function(*given)
        assert found.dtype == narrow
        assert float(found) == pytest.approx(float(function(*point)), rel=2e-3)
        mixed = [jnp.asarray(x, narrow) if np.ndim(x) else jnp.asarray(x) for x in point]
        assert float(function(*mixed)) == float(found)
    P = lyapunov_function(*(jnp.asarray(x, narrow) for x in (A, B, K, np.eye(4))))
    assert P.dtype == narrow
    np.testing.assert_allclose(P, lyapunov_function(A, B, K, np.eye(4)), rtol=1e-4)


def test_a_plain_vector_is_taken_as_the_gain_and_the_input_matrix_of_one_input():
    k, b = np.asarray(K)[0], np.asarray(B)[:, 0]
    P = lyapunov_function(A, B, K, np.eye(4))
    np.testing.assert_array_equal(lyapunov_function(A, b, k, np.eye(4)), P)
    assert float(demanded_voltage(k, 0.1)) == float(demanded_voltage(K, 0.1))
    assert float(saturation_angle(k, 12.0)) == float(saturation_angle(K, 12.0))
    assert float(level_within_voltage(P, k, 12.0)) == float(level_within_voltage(P, K, 12.0))


INDEFINITE = np.diag([1.0, 1.0, -1.0, 1.0])
SINGULAR = np.diag([1.0, 1.0, 0.0, 1.0])
REFUSED = [
    (demanded_voltage, ([1.0, 2.0, 3.0], 0.1), "K", "of shape (1, 4)"),
    (demanded_voltage, ([[1.0, 2.0, math.nan, 4.0]], 0.1), "K", "an array of finite real numbers"),
    (saturation_angle, (K, 0.0), "voltage_limit", "a number above 0 [V]"),
    (saturation_angle, (K, -12.0), "voltage_limit", "a number above 0 [V]"),
    (saturation_angle, (K, math.nan), "voltage_limit", "a number above 0 [V]"),
    (saturation_angle, (K, np.array([12.0, 24.0])), "voltage_limit", "of shape ()"),
    (level_within_voltage, (np.eye(4), K, "12"), "voltage_limit", "a number above 0 [V]"),
    (level_within_voltage, (np.eye(4), K[0, :3], 12.0), "K", "of shape (1, 4)"),
    (level_within_voltage, (np.eye(3), K, 12.0), "K", "of shape (1, 3)"),
    (level_within_voltage, (np.ones((4, 3)), K, 12.0), "P", "a square matrix"),
    (level_within_voltage, (INDEFINITE, K, 12.0), "P", "positive definite"),
    (level_within_voltage, (SINGULAR, K, 12.0), "P", "positive definite"),
    (level_within_voltage, (-np.eye(4), K, 12.0), "P", "positive definite"),
    (level_within_angle, (INDEFINITE, 0.5), "P", "positive definite"),
    (level_within_angle, (np.eye(2), 0.5), "P", "of shape (4, 4)"),
    (level_within_angle, (np.eye(4), 3.2), "half_angle", "a finite number above 0 and at most 3.14159 [rad]"),
    (level_within_angle, (np.eye(4), 0.0), "half_angle", "a finite number above 0 and at most 3.14159 [rad]"),
    (level_within_angle_and_rate, (SINGULAR, 0.5, 1.0), "P", "positive definite"),
    (level_within_angle_and_rate, (np.eye(4), 0.5, 0.0), "rate", "a finite number above 0 [rad/s]"),
    (level_within_angle_and_rate, (np.eye(4), 0.5, math.inf), "rate", "a finite number above 0 [rad/s]"),
    (level_within_angle_and_rate, (np.eye(4), 4.0, 1.0), "half_angle", "a finite number above 0 and at most 3.14159"),
    (level_within_form, (INDEFINITE, np.eye(4), 1.0), "P", "positive definite"),
    (level_within_form, (np.eye(4), np.eye(3), 1.0), "other", "of shape (4, 4)"),
    (level_within_form, (np.eye(4), np.eye(4), 0.0), "level", "a finite number above 0 [1]"),
    (lyapunov_function, (A, B, -K, np.eye(4)), "A", "stable"),
    (lyapunov_function, (A, B, K[0, :3], np.eye(4)), "K", "of shape (1, 4)"),
    (lyapunov_function, (A, B[:3, 0], K, np.eye(4)), "B", "of shape (4, m)"),
    (lyapunov_function, (A, B, K, np.eye(3)), "Q", "of shape (4, 4)"),
]


@rows(("function", "given", "field", "allowed"), REFUSED)
def test_what_makes_no_sense_is_refused_by_name(function, given, field, allowed):
    with pytest.raises(InputError, match=rf"^{field} = .*: must be .*{re.escape(allowed)}"):
        function(*given)


def test_under_jit_an_indefinite_form_and_an_unstable_loop_give_nan():
    @jax.jit
    def levels(P):
        return jnp.stack(
            [
                level_within_voltage(P, K, 12.0),
                level_within_angle(P, 0.5),
                level_within_angle_and_rate(P, 0.5, 2.0),
                level_within_form(P, np.eye(4), 1.0),
            ]
        )

    assert np.all(np.isfinite(levels(np.eye(4))))
    for P in (INDEFINITE, SINGULAR, -np.eye(4)):
        assert np.all(np.isnan(levels(P)))
    assert np.all(np.isnan(jax.jit(lyapunov_function)(A, B, -K, np.eye(4))))
