"""Gains against python-control, SciPy, closed forms and simulated costs."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import relative_error
from scipy.linalg import expm, solve_continuous_are, solve_discrete_are

from cpjax import InputError, linearize, paper
from cpjax.linear.lqr import dlqr, lqr
from cpjax.pytree import cast

DESIGNS = {"continuous": lqr, "discrete": dlqr}
PEERS = {"continuous": control.lqr, "discrete": control.dlqr}
BATCHED = {time: jax.jit(jax.vmap(design)) for time, design in DESIGNS.items()}  # twenty lanes, always
both = pytest.mark.parametrize("time", DESIGNS)
# What weights and dtypes do to a gain is the same code for both.
continuous_discrete_slow = pytest.mark.parametrize(
    "time", ["continuous", pytest.param("discrete", marks=pytest.mark.slow)]
)

A, B = (np.asarray(matrix) for matrix in linearize(paper.appendix_plant()))
Q, R = np.diag(paper.Q), np.array([[paper.R]])
HELD = expm(0.02 * np.block([[A, B], [np.zeros((1, 5))]]))
PAPER = {"continuous": (A, B, Q, R), "discrete": (HELD[:4, :4], HELD[:4, 4:], Q, R)}


def scipys(time, A, B, Q, R, N):
    """K and P."""
    if time == "continuous":
        P = solve_continuous_are(A, B, Q, R, s=N)
        return np.linalg.solve(R, B.T @ P + N.T), P
    P = solve_discrete_are(A, B, Q, R, s=N)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + N.T), P


def poles_are_stable(time, A, B, K):
    poles = np.linalg.eigvals(A - B @ np.asarray(K, dtype=np.float64))
    return np.max(poles.real) < 0 if time == "continuous" else np.max(np.abs(poles)) < 1


def random_problem(n, m, rng):
    """With a cross term, and weights over six orders of magnitude."""
    M = rng.normal(size=(n + m, n + m))
    W = 10.0 ** rng.uniform(-3, 3) * (M @ M.T)
    W = (W + W.T) / 2
    return rng.normal(size=(n, n)) / n**0.5, rng.normal(size=(n, m)), W[:n, :n], W[n:, n:], W[:n, n:]


@both
@pytest.mark.parametrize(
    ("n", "m"), [(2, 3), *(pytest.param(*one, marks=pytest.mark.slow) for one in ((4, 1), (16, 3)))]
)
def test_gains_are_scipys_and_python_controls_with_cross_terms_and_several_inputs(time, n, m):
    rng = np.random.default_rng(20 * n + m)
    problems = [random_problem(n, m, rng) for _ in range(20)]
    gains, solutions = BATCHED[time](*(jnp.asarray(np.stack(x)) for x in zip(*problems, strict=True)))
    for problem, K, P in zip(problems, gains, solutions, strict=True):
        right = scipys(time, *problem)
        assert relative_error(K, right[0]) <= 1e-9
        assert relative_error(P, right[1]) <= 1e-9
        assert poles_are_stable(time, *problem[:2], K)
    peer = PEERS[time](*problems[0])
    assert relative_error(gains[0], peer[0]) <= 1e-9
    assert relative_error(solutions[0], peer[1]) <= 1e-9


def test_the_paper_plant_has_the_gain_that_follows_from_its_weights():
    K, P = lqr(A, B, Q, R)
    assert (K.shape, P.shape) == ((1, 4), (4, 4))
    np.testing.assert_allclose(K[0], [-1414.214, -1179.574, 4797.709, 967.239], rtol=0, atol=5e-4)
    assert float(K[0, 0]) == pytest.approx(-np.sqrt(200.0 / 1e-4), rel=1e-15)
    assert relative_error(K, control.lqr(A, B, Q, R)[0]) <= 1e-10
    discrete = dlqr(*PAPER["discrete"])
    assert relative_error(discrete.K, control.dlqr(*PAPER["discrete"])[0]) <= 1e-10


@pytest.mark.slow
@continuous_discrete_slow
def test_only_the_ratio_of_the_weights_matters(time):
    A, B, Q, R = PAPER[time]
    N = np.array([[1.0], [0.5], [0.1], [0.2]]) * 1e-3
    factors = 10.0 ** np.linspace(-120, 120, 20)
    batch = [np.broadcast_to(A, (20, 4, 4)), np.broadcast_to(B, (20, 4, 1))]
    batch += [factors[:, None, None] * weight for weight in (Q, R, N)]
    K, P = BATCHED[time](*map(jnp.asarray, batch))
    plain = DESIGNS[time](A, B, Q, R, N)
    for factor, one, other in zip(factors, K, P, strict=True):
        np.testing.assert_allclose(one, plain.K, rtol=1e-13)
        np.testing.assert_allclose(other / factor, plain.P, rtol=1e-13)


@both
def test_a_factor_that_is_a_power_of_two_changes_no_bit_of_the_gain(time):
    A, B, Q, R = PAPER[time]
    plain, scaled = DESIGNS[time](A, B, Q, R), DESIGNS[time](A, B, 2.0**40 * Q, 2.0**40 * R)
    np.testing.assert_array_equal(scaled.K, plain.K)
    np.testing.assert_array_equal(scaled.P, 2.0**40 * plain.P)


@both
def test_the_units_of_states_and_inputs_do_not_matter(time):
    A, B, Q, R = PAPER[time]
    units, volt = np.array([2.0**5, 2.0**-3, 2.0, 2.0**-7]), 2.0**4
    K, P = DESIGNS[time](units[:, None] * A / units, units[:, None] * B / volt, Q / units / units[:, None], R / volt**2)
    plain = DESIGNS[time](A, B, Q, R)
    np.testing.assert_allclose(K * units / volt, plain.K, rtol=1e-14)
    np.testing.assert_allclose(P * units * units[:, None], plain.P, rtol=1e-14)


def test_faster_time_is_the_same_gain_and_a_cheaper_cost():
    K, P = lqr(2.0**6 * A, 2.0**6 * B, Q, R)
    np.testing.assert_allclose(K, lqr(A, B, Q, R).K, rtol=1e-14)
    np.testing.assert_allclose(2.0**6 * P, lqr(A, B, Q, R).P, rtol=1e-14)


@both
def test_a_cross_term_is_a_feedback_that_is_already_there(time):
    A, B, Q, R = PAPER[time]
    N = np.array([[1.0], [0.5], [0.1], [0.2]]) * 1e-3
    already = np.linalg.solve(R, N.T)
    without = DESIGNS[time](A - B @ already, B, Q - N @ already, R)
    found = DESIGNS[time](A, B, Q, R, N)
    assert relative_error(found.K, without.K + already) <= 1e-12
    assert relative_error(found.P, without.P) <= 1e-12
    np.testing.assert_array_equal(DESIGNS[time](A, B, Q, R, np.zeros((4, 1))).K, DESIGNS[time](A, B, Q, R).K)


@pytest.mark.slow
def test_the_solution_is_the_cost_of_coming_to_rest_and_no_gain_costs_less():
    rng = np.random.default_rng(5)
    A, B, Q, R, N = random_problem(4, 1, rng)
    K, P = dlqr(A, B, Q, R, N)
    s = rng.normal(size=4)

    def cost(K):
        total, state = 0.0, s
        for _ in range(2000):
            u = -K @ state
            total += state @ Q @ state + 2.0 * state @ N @ u + u @ R @ u
            state = A @ state + B @ u
        return total

    best = cost(np.asarray(K))
    assert best == pytest.approx(float(s @ P @ s), rel=1e-12)
    for _ in range(20):
        assert cost(K + 0.01 * rng.normal(size=K.shape)) > best


@pytest.mark.slow
@pytest.mark.parametrize(("a", "b", "q", "r"), [(1.3, -0.7, 2.1, 0.3), (-2.0, 1.0, 0.5, 4.0), (0.0, 3.0, 1.0, 1.0)])
def test_one_state_has_the_gain_of_a_quadratic_equation(a, b, q, r):
    problem = [np.array([[x]]) for x in (a, b, q, r)]
    assert float(lqr(*problem).K[0, 0]) == pytest.approx((a + np.sqrt(a * a + b * b * q / r)) / b, rel=1e-15)
    half = (r - a * a * r - b * b * q) / 2
    p = (-half + np.sqrt(half * half + b * b * q * r)) / (b * b)
    assert float(dlqr(*problem).K[0, 0]) == pytest.approx(a * b * p / (r + b * b * p), rel=1e-14)


@pytest.mark.slow
@continuous_discrete_slow
def test_float32_arguments_give_the_papers_gain_to_a_few_of_their_digits(time):
    narrow = [matrix.astype(np.float32) for matrix in PAPER[time]]
    K, P = DESIGNS[time](*narrow)
    assert K.dtype == P.dtype == jnp.float32
    np.testing.assert_allclose(K, DESIGNS[time](*PAPER[time]).K, rtol=1e-6)
    exact = DESIGNS[time](*(matrix.astype(np.float64) for matrix in narrow))  # of the rounded plant
    np.testing.assert_allclose(K, exact.K, rtol=1.2e-7)
    np.testing.assert_allclose(P, exact.P, rtol=1.2e-7)


def test_the_gain_of_a_float32_plant_is_float32_and_right_to_a_thousandth():
    model = linearize(cast(paper.appendix_plant(), jnp.float32))
    K, _ = lqr(*model, Q.astype(np.float32), R.astype(np.float32))
    assert K.dtype == jnp.float32
    np.testing.assert_allclose(K, lqr(A, B, Q, R).K, rtol=1e-3)


def one_weighed_output(m):
    """Twenty systems of sixteen states; C' C has rank one in float32 too."""
    rng = np.random.default_rng(16)
    C = np.round(8.0 * rng.normal(size=(20, 1, 16))) / 8.0
    A, B = rng.normal(size=(20, 16, 16)) / 4.0, rng.normal(size=(20, 16, m))
    problems = A, B, np.swapaxes(C, 1, 2) @ C, np.broadcast_to(np.eye(m), (20, m, m)), np.zeros((20, 16, m))
    return [x.astype(np.float32).astype(np.float64) for x in problems]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "m", "tolerance"), [(np.float64, 1, 1e-5), pytest.param(np.float32, 3, 1e-4, marks=pytest.mark.slow)]
)
def test_sixteen_states_with_one_output_weighed_have_scipys_gain(dtype, m, tolerance):
    problems = one_weighed_output(m)
    K, _ = BATCHED["continuous"](*(jnp.asarray(x, dtype=dtype) for x in problems))
    errors = [
        relative_error(one, scipys("continuous", *problem)[0]) for one, *problem in zip(K, *problems, strict=True)
    ]
    assert max(errors) <= tolerance, f"{np.sum(np.isinf(errors))} of 20 not found"


@pytest.mark.slow
@both
def test_whatever_batch_a_problem_is_solved_in_it_has_the_same_gain(time):
    A, B, Q, R = PAPER[time]
    weights = R * 10.0 ** np.random.default_rng(6).uniform(-4, 8, size=(20, 1, 1))
    batch = [*(np.stack([matrix] * 20) for matrix in (A, B, Q)), weights, np.zeros((20, 4, 1))]
    for weight, K, P in zip(weights, *BATCHED[time](*map(jnp.asarray, batch)), strict=True):
        alone = DESIGNS[time](A, B, Q, weight)
        np.testing.assert_allclose(K, alone.K, rtol=1e-14)
        np.testing.assert_allclose(P, alone.P, rtol=1e-14)


@pytest.mark.slow
@both
def test_what_a_gain_cannot_be_computed_for_is_refused_and_nan_inside_jit(time):
    A, B, Q, R = PAPER[time]
    with pytest.raises(InputError, match="stabilisable with A: it must move the mode with eigenvalue"):
        DESIGNS[time](A, 0.0 * B, Q, R)
    batch = [np.stack([matrix] * 20) for matrix in (A, B, Q, R, 0.0 * B)]
    batch[1][7] = 0.0
    for part in BATCHED[time](*map(jnp.asarray, batch)):
        assert np.all(np.isnan(part[7]))
        assert np.all(np.isfinite(np.delete(part, 7, axis=0)))
