"""What has no stabilising solution, in every way that it is asked for; and derivatives.

The accuracy of P is the matter of test_riccati_accuracy.py, that of K of test_lqr.py.
"""

import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from oracles import jacobian, lyapunov_operator, relative_error
from scipy.linalg import expm
from tables import rows

from cpjax import InputError, linearize, paper
from cpjax.linear.riccati import care, dare, solve_care, solve_dare

SOLVERS = {"continuous": solve_care, "discrete": solve_dare}
BATCHED = {time: jax.jit(jax.vmap(solve)) for time, solve in SOLVERS.items()}
LANES = 40
both = pytest.mark.parametrize("time", SOLVERS)
# What is done to the arguments is the same code for both.
continuous_discrete_slow = pytest.mark.parametrize(
    "time", ["continuous", pytest.param("discrete", marks=pytest.mark.slow)]
)

ONE = np.eye(1)


def held(A, B, period):
    """What a zero-order hold makes of a continuous plant."""
    n, m = B.shape
    whole = expm(period * np.block([[A, B], [np.zeros((m, n + m))]]))
    return whole[:n, :n], whole[:n, n:]


def paper_problem(time, R=paper.R, period=0.02):
    A, B = (np.asarray(matrix) for matrix in linearize(paper.appendix_plant()))
    if time == "discrete":
        A, B = held(A, B, period)
    return A, B, np.diag(paper.Q), np.array([[R]]), np.zeros((4, 1))


def slowest(time, A, B, K):
    """How far the closed loop's slowest mode is inside the region of stability; negative if it is outside."""
    modes = np.linalg.eigvals(A - B @ np.asarray(K, dtype=np.float64))
    return -np.max(modes.real) if time == "continuous" else 1.0 - np.max(np.abs(modes))


def solved_in_batches(time, problems):
    """P, K and found of a list of problems, under vmap in jit; in batches of one size, which are compiled once."""
    problems = [(*problem, np.zeros_like(problem[1]))[:5] for problem in problems]
    filled = problems + problems[:1] * (-len(problems) % LANES)
    answers = []
    for i in range(0, len(filled), LANES):
        batch = (jnp.asarray(np.stack(matrices)) for matrices in zip(*filled[i : i + LANES], strict=True))
        answers.append(BATCHED[time](*batch))
    return [np.concatenate(parts)[: len(problems)] for parts in zip(*answers, strict=True)]


def exact(x):
    """Floats as mpmath's numbers, with nothing lost."""
    return np.vectorize(mpmath.mpf, otypes=[object])(np.asarray(x, dtype=np.float64))


# --- what has a solution ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@both
def test_without_state_weights_a_stable_plant_is_left_alone_exactly(time):
    rng = np.random.default_rng(1)
    A = rng.normal(size=(4, 4))
    modes = np.linalg.eigvals(A)
    A = A - (np.max(modes.real) + 0.05) * np.eye(4) if time == "continuous" else 0.97 * A / np.max(np.abs(modes))
    P, K, found = SOLVERS[time](A, rng.normal(size=(4, 1)), np.zeros((4, 4)), ONE)
    assert found
    np.testing.assert_array_equal(P, np.zeros((4, 4)))
    np.testing.assert_array_equal(K, np.zeros((1, 4)))


@pytest.mark.slow
@both
def test_a_stable_mode_that_no_weight_sees_costs_nothing(time):
    modes = [-1e-3, 1.0] if time == "continuous" else [0.999, 1.5]
    A, B, Q = np.diag(modes), np.array([[1.0], [1.0]]), np.diag([0.0, 1.0])
    P, K, found = SOLVERS[time](A, B, Q, ONE)
    [[alone]], _, _ = SOLVERS[time](A[1:, 1:], B[1:], Q[1:, 1:], ONE)
    assert found
    np.testing.assert_allclose(P, [[0.0, 0.0], [0.0, alone]], rtol=1e-15, atol=1e-15)
    assert slowest(time, A, B, K) > 0


@pytest.mark.slow
@both
def test_a_stable_mode_that_no_input_moves_is_weighed_as_it_decays(time):
    mode = -0.5 if time == "continuous" else 0.5
    A, B = np.diag([mode, 2.0]), np.array([[0.0], [1.0]])
    P, K, found = SOLVERS[time](A, B, np.eye(2), ONE)
    assert found
    assert float(P[0, 0]) == pytest.approx(1.0 if time == "continuous" else 4.0 / 3.0, rel=1e-15)
    assert float(K[0, 0]) == 0.0


@both
def test_without_an_effective_input_the_solution_is_that_of_lyapunovs_equation(time):
    A = np.array([[-1.0, 3.0], [0.0, -2.0]]) * (1.0 if time == "continuous" else 0.3)
    P, K, found = SOLVERS[time](A, np.zeros((2, 1)), np.eye(2), ONE)
    left = lyapunov_operator(A, time) @ np.ravel(P) + np.eye(2).ravel()
    assert found
    assert np.max(np.abs(left)) <= 1e-14
    np.testing.assert_array_equal(K, np.zeros((1, 2)))


@pytest.mark.slow
@both
def test_the_closed_loop_is_stable_and_the_solution_symmetric_and_semidefinite(time):
    rng = np.random.default_rng(2)
    problems = []
    for _ in range(160):
        C = rng.normal(size=(rng.integers(1, 5), 4)) * 10.0 ** rng.uniform(-2, 2)
        A = rng.normal(size=(4, 4)) * (10.0 ** rng.uniform(-1, 1) if time == "continuous" else 1.0)
        problems.append((A, rng.normal(size=(4, 1)), C.T @ C, 10.0 ** rng.uniform(-4, 4, size=(1, 1))))
    P, K, found = solved_in_batches(time, problems)
    assert np.all(found)
    np.testing.assert_array_equal(P, np.swapaxes(P, 1, 2))
    for (A, B, _, _), one, gain in zip(problems, P, K, strict=True):
        assert slowest(time, A, B, gain) > 0
        size = np.sqrt(np.diag(one))
        assert np.min(np.linalg.eigvalsh(one / size / size[:, None])) >= -1e-12


@pytest.mark.slow
@continuous_discrete_slow
def test_only_the_symmetric_part_of_a_weight_counts(time):
    A, B, Q = np.array([[0.0, 1.0], [1.2, 0.3]]), np.array([[0.0], [1.0]]), np.array([[2.0, 1.0], [1.0, 3.0]])
    skew = np.array([[0.0, 1.0], [-1.0, 0.0]])
    P, K, found = solved_in_batches(time, [(A, B, Q, ONE), (A, B, Q + 0.1 * skew, ONE)])
    assert np.all(found)
    np.testing.assert_allclose(P[0], P[1], rtol=1e-15)
    np.testing.assert_allclose(K[0], K[1], rtol=1e-15)


# --- what has none ----------------------------------------------------------------------------------------------------

GROWING, STABLE = {"continuous": 1.0, "discrete": 1.5}, {"continuous": -1.0, "discrete": 0.5}
EDGE = {"continuous": 0.0, "discrete": 1.0}
TURNING = {"continuous": np.array([[0.0, 2.0], [-2.0, 0.0]]), "discrete": np.array([[0.0, 1.0], [-1.0, 0.0]])}
UP = np.array([[1.0], [1.0]])


def unsolvable(time):
    """Problems of two states and one input without a solution, and the argument that is to blame."""
    growing, stable, edge, turning = GROWING[time], STABLE[time], EDGE[time], TURNING[time]
    low, high = np.diag([0.0, 1.0]), np.array([[0.0], [1.0]])
    return {
        "an unstable mode that no input moves": ("B", (np.diag([growing, stable]), high, np.eye(2), ONE)),
        "a mode on the edge that no input moves": ("B", (np.diag([edge, stable]), high, np.eye(2), ONE)),
        "two equal modes on one input": ("B", (np.diag([growing, growing]), UP, np.eye(2), ONE)),
        "an oscillator that no input moves": ("B", (turning, np.zeros((2, 1)), np.eye(2), ONE)),
        "a mode on the edge that no weight sees": ("Q", (np.diag([edge, stable]), UP, low, ONE)),
        "an oscillator without weights": ("Q", (turning, high, np.zeros((2, 2)), ONE)),
        "a position without weight": ("Q", (edge * np.eye(2) + np.eye(2, k=1), high, low, ONE)),
        "an input that costs nothing": ("R", (np.diag([growing, stable]), UP, np.eye(2), 0.0 * ONE)),
        "an input that pays": ("R", (np.diag([growing, stable]), UP, np.eye(2), -ONE)),
        "a state that pays": ("Q", (np.diag([growing, stable]), UP, np.diag([1.0, -1.0]), ONE)),
        "weights with both signs": ("Q", (np.diag([growing, stable]), UP, np.array([[1.0, 2.0], [2.0, 1.0]]), ONE)),
        "a small state weight below zero": ("Q", (np.diag([growing, stable]), UP, np.diag([1e9, -1e-3]), ONE)),
        "a cross term that pays": ("N", (np.diag([growing, stable]), UP, np.eye(2), ONE, np.array([[0.0], [1.1]]))),
    }


@both
@rows("name", unsolvable("continuous"))
def test_a_problem_without_a_solution_is_refused_with_the_reason(time, name):
    field, problem = unsolvable(time)[name]
    with pytest.raises(InputError) as caught:
        SOLVERS[time](*problem)
    assert caught.value.field == field


@pytest.mark.slow
@both
def test_inside_jit_an_unsolvable_problem_is_nan_and_affects_no_other_element(time):
    good = (np.array([[0.0, 1.0], [1.3, -0.2]]), np.array([[0.0], [1.0]]), np.diag([1.0, 2.0]), 0.5 * ONE)
    bad = [problem for _, problem in unsolvable(time).values()]
    broken = [tuple(np.where(i == j, np.nan, matrix) for j, matrix in enumerate(good)) for i in range(4)]
    P, K, found = solved_in_batches(time, [good, *bad, good, *broken, good])
    right = np.zeros(found.shape, dtype=bool)
    right[[0, len(bad) + 1, -1]] = True
    np.testing.assert_array_equal(found, right)
    assert np.all(np.isnan(P[~right]))
    assert np.all(np.isnan(K[~right]))
    alone = SOLVERS[time](*good)
    for lane in np.flatnonzero(right):
        np.testing.assert_allclose(P[lane], alone.P, rtol=1e-15)
        np.testing.assert_allclose(K[lane], alone.K, rtol=1e-15)


def rotated(time, count, slow, Q, B, seed):
    """Three modes, the first of which has no weight or no input, in coordinates in which rounding hides that."""
    rng = np.random.default_rng(seed)
    modes = np.diag([slow, -1.0, -2.0] if time == "continuous" else [slow, 0.5, -0.2])
    for _ in range(count):
        T = rng.normal(size=(3, 3))
        back = np.linalg.inv(T)
        weight = back.T @ np.diag(Q) @ back
        yield T @ modes @ back, T @ np.array(B)[:, None], (weight + weight.T) / 2, ONE


HIDDEN = {
    "unstable, without input": (GROWING, [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]),
    "unstable, without weight": (GROWING, [0.0, 1.0, 1.0], [1.0, 1.0, 1.0]),
    "on the edge, without input": (EDGE, [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]),
    "on the edge, without weight": (EDGE, [0.0, 1.0, 1.0], [1.0, 1.0, 1.0]),
}


def is_stable(time, A, B, K):
    """Whether the closed loop of these very numbers is stable, in 60 digits."""
    with mpmath.workdps(60):
        closed = exact(A) - exact(B) @ exact(K)
        modes, _ = mpmath.eig(mpmath.matrix(closed.tolist()))
        return all(mode.real < 0 if time == "continuous" else abs(mode) < 1 for mode in modes)


@pytest.mark.slow
@both
def test_a_mode_that_rounding_hides_is_refused_or_the_rounded_problem_is_solved(time):
    # Rounding may give a mode a weight, and may move one on the edge inside; it never gives a mode an input.
    wrong = []
    for name, (slow, Q, B) in HIDDEN.items():
        problems = list(rotated(time, 400, slow[time], Q, B, seed=7))
        P, K, found = solved_in_batches(time, problems)
        assert np.all(np.isnan(P[~found]))
        answers = [(*problems[i][:2], K[i]) for i in np.flatnonzero(found)]
        for problem in problems[:10]:
            try:
                answers.append((*problem[:2], SOLVERS[time](*problem).K))
            except InputError:
                continue
        if name == "unstable, without input":
            assert not answers
        wrong += [(name, answer) for answer in answers if not is_stable(time, *answer)]
    assert not wrong


@both
def test_units_that_are_far_apart_hide_nothing(time):
    A, B, Q, R, _ = paper_problem(time)
    units = np.array([2.0**20, 2.0**-10, 2.0**10, 2.0**-20])
    scaled = (units[:, None] * A / units, units[:, None] * B, Q / units / units[:, None], R)
    found = SOLVERS[time](*scaled)
    np.testing.assert_allclose(found.K * units, SOLVERS[time](A, B, Q, R).K, rtol=1e-14)


@both
def test_a_weak_actuator_that_is_cheap_is_as_good_as_a_strong_one(time):
    A, B = np.array([[0.0, 1.0], [1.3, -0.2]]), np.array([[0.0], [1.0]])
    strong, weak = SOLVERS[time](A, B, np.eye(2), ONE), SOLVERS[time](A, 2.0**-50 * B, np.eye(2), 2.0**-100 * ONE)
    np.testing.assert_array_equal(weak.P, strong.P)
    np.testing.assert_array_equal(2.0**-50 * weak.K, strong.K)


@continuous_discrete_slow
def test_a_weight_semidefinite_but_for_rounding_is_accepted_or_named(time):
    rng = np.random.default_rng(8)
    A, B, c = rng.normal(size=(3, 3)), rng.normal(size=(3, 1)), rng.normal(size=(3, 1))
    exact = SOLVERS[time](A, B, c @ c.T, ONE).K
    for digits in (15, 12, 9, 7):
        Q = np.round(c @ c.T, digits)
        try:
            K = SOLVERS[time](A, B, Q, ONE).K
        except InputError as problem:
            assert "semidefinite" in str(problem), digits  # noqa: PT017
        else:
            assert relative_error(K, exact) <= 10.0 ** (4 - digits)


def test_a_plant_mode_at_the_cayley_transforms_pole_is_like_any_other():
    pole = -0.8284031576393032
    modes = [pole + offset for offset in (-1e-9, -1e-12, -1e-15, 0.0, 1e-15, 1e-12, 1e-9)]
    P, _, found = solved_in_batches("continuous", [(np.diag([1.0, mode]), UP, 1e-8 * np.eye(2), ONE) for mode in modes])
    assert found.tolist() == [True] * len(modes)
    for one in P:
        np.testing.assert_allclose(one, P[0], rtol=1e-8)


# --- arguments --------------------------------------------------------------------------------------------------------

A2, B2 = np.array([[0.0, 1.0], [1.3, -0.2]]), np.array([[0.0], [1.0]])
ODD = {
    "A of words": ("A", ("A", B2, np.eye(2), ONE)),
    "A of letters": ("A", ([["a", "b"], ["c", "d"]], B2, np.eye(2), ONE)),
    "no A": ("A", (None, B2, np.eye(2), ONE)),
    "complex A": ("A", (1j * A2, B2, np.eye(2), ONE)),
    "A of truth values": ("A", (A2 > 0, B2, np.eye(2), ONE)),
    "rectangular A": ("A", (np.ones((2, 3)), B2, np.eye(2), ONE)),
    "batched A": ("A", (A2[None], B2, np.eye(2), ONE)),
    "empty A": ("A", (np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((0, 0)), ONE)),
    "A with NaN": ("A", (A2 * np.nan, B2, np.eye(2), ONE)),
    "A of half precision": ("A", tuple(x.astype(np.float16) for x in (A2, B2, np.eye(2), ONE))),
    "uneven A": ("A", ([[0.0, 1.0], [1.0]], B2, np.eye(2), ONE)),
    "B as a row": ("B", (A2, B2.T, np.eye(2), ONE)),
    "B without columns": ("B", (A2, np.zeros((2, 0)), np.eye(2), np.zeros((0, 0)))),
    "B as a number": ("B", (A2, 1.0, np.eye(2), ONE)),
    "infinite B": ("B", (A2, np.array([[0.0], [np.inf]]), np.eye(2), ONE)),
    "Q of the wrong size": ("Q", (A2, B2, np.eye(3), ONE)),
    "Q as a vector": ("Q", (A2, B2, np.ones(2), ONE)),
    "Q with NaN": ("Q", (A2, B2, np.full((2, 2), np.nan), ONE)),
    "Q that is not symmetric": ("Q", (A2, B2, np.array([[1.0, 0.5], [0.0, 1.0]]), ONE)),
    "R as a number for two inputs": ("R", (A2, np.eye(2), np.eye(2), 1.0)),
    "R as a vector": ("R", (A2, np.eye(2), np.eye(2), np.ones(2))),
    "R of the wrong size": ("R", (A2, B2, np.eye(2), np.eye(2))),
    "R that is not symmetric": ("R", (A2, np.eye(2), np.eye(2), np.array([[1.0, 0.5], [0.0, 1.0]]))),
    "R that is singular": ("R", (A2, np.eye(2), np.eye(2), np.ones((2, 2)))),
    "R with both signs": ("R", (A2, np.eye(2), np.eye(2), np.diag([1.0, -1.0]))),
    "infinite R": ("R", (A2, B2, np.eye(2), np.array([[np.inf]]))),
    "N of the wrong shape": ("N", (A2, B2, np.eye(2), ONE, np.ones((1, 2)))),
    "N with NaN": ("N", (A2, B2, np.eye(2), ONE, np.full((2, 1), np.nan))),
}


@both
@rows("name", ODD)
def test_arguments_that_do_not_fit_are_refused_by_name(time, name):
    field, problem = ODD[name]
    with pytest.raises(InputError) as caught:
        SOLVERS[time](*problem)
    assert caught.value.field == field


@continuous_discrete_slow
def test_lists_integers_and_mixed_precision_are_taken_in_the_widest_dtype(time):
    right = SOLVERS[time]([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]], np.eye(2), ONE)
    whole = ([[0, 1], [2, -1]], [[0], [1]], [[1, 0], [0, 1]], [[1]])
    for problem in (whole, [np.array(x) for x in whole], [np.array(x, np.float32) for x in whole[:3]] + [ONE]):
        found = SOLVERS[time](*problem)
        assert found.P.dtype == found.K.dtype == jnp.float64
        np.testing.assert_array_equal(found.P, right.P)
    narrow = SOLVERS[time](*(np.array(x, np.float32) for x in whole))
    assert narrow.P.dtype == narrow.K.dtype == jnp.float32
    np.testing.assert_array_equal(SOLVERS[time](whole[0], [0, 1], whole[2], 1).P, right.P)
    np.testing.assert_array_equal((care if time == "continuous" else dare)(*whole), right.P)


# --- derivatives ------------------------------------------------------------------------------------------------------


def split(x, n, m):
    """A, B, Q, R and N of one vector."""
    shapes = [(n, n), (n, m), (n, n), (m, m), (n, m)]
    cuts = np.cumsum([rows * columns for rows, columns in shapes])[:-1]
    return [part.reshape(shape) for part, shape in zip(jnp.split(x, cuts), shapes, strict=True)]


def vector(problem):
    return np.concatenate([np.ravel(matrix) for matrix in problem])


@functools.cache
def functions(time, n, m):
    """P and K in one vector, their Jacobians forward and in reverse, each for a batch of problems."""

    def solution(x):
        P, K, _ = SOLVERS[time](*split(x, n, m))
        return jnp.concatenate([P.ravel(), K.ravel()])

    def jacobians(x):
        return jax.jacfwd(solution)(x), jax.jacrev(solution)(x)

    return jax.jit(jax.vmap(solution)), jax.jit(jax.vmap(jacobians))


def blocks(jacobians, n, m):
    """The ten parts: of P and of K, to A, B, Q, R and N."""
    sizes = np.cumsum([n * n, n * m, n * n, m * m])
    return [part for rows in (slice(n * n), slice(n * n, None)) for part in np.split(jacobians[rows], sizes, axis=1)]


def condition(time, problem, K):
    """Of the equation that the derivatives solve: the closed loop's Lyapunov operator."""
    return np.linalg.cond(lyapunov_operator(problem[0] - problem[1] @ np.asarray(K), time))


def random_problem(n, m, rng):
    M = rng.normal(size=(n + m, n + m))
    W = M @ M.T + 0.3 * np.eye(n + m)
    return rng.normal(size=(n, n)), rng.normal(size=(n, m)), W[:n, :n], W[n:, n:], W[:n, n:]


def steps(time, problem):
    """Of the differences: small where the weights would soon not be semidefinite, or where a sample is short."""
    A, B, Q, R, N = problem
    size = np.concatenate([np.sqrt(np.diag(Q)), np.sqrt(np.diag(R))])
    n = len(A)
    room = np.linalg.eigvalsh(np.block([[Q, N], [N.T, R]]) / size / size[:, None])[0]
    weights = 0.02 * min(room, 1.0) * np.outer(size, size)
    scale = 2e-3 if np.any(N) else {"continuous": 1e-3, "discrete": 2e-5}[time]
    return vector((np.full_like(A, scale), np.full_like(B, scale), weights[:n, :n], weights[n:, n:], weights[:n, n:]))


@pytest.mark.parametrize(
    ("time", "n", "m"),
    [
        pytest.param("continuous", 4, 1, marks=pytest.mark.slow),
        pytest.param("continuous", 5, 2, marks=pytest.mark.slow),
        pytest.param("discrete", 3, 2, marks=pytest.mark.slow),
        pytest.param("discrete", 4, 1, marks=pytest.mark.slow),
    ],
)
def test_derivatives_in_all_arguments_agree_with_differences(time, n, m):
    rng = np.random.default_rng(10 * n + m)
    problems = [random_problem(n, m, rng) for _ in range(3)] + ([paper_problem(time)] if (n, m) == (4, 1) else [])
    batched, jacobians = functions(time, n, m)
    x = jnp.asarray(np.stack([vector(problem) for problem in problems]))
    forward, reverse = jacobians(x)
    for i, problem in enumerate(problems):
        K = batched(x)[i, n * n :].reshape(m, n)
        assert condition(time, problem, K) < (1e6 if time == "continuous" else 4e6)
        differences = jacobian(batched, x[i], steps(time, problem))
        parts = (blocks(np.asarray(J), n, m) for J in (forward[i], reverse[i], differences))
        for one, other, difference in zip(*parts, strict=True):
            assert relative_error(one, difference) <= 1e-9
            assert relative_error(other, one) <= 1e-11
    if (n, m) == (4, 1):
        check_ill_conditioned_derivatives(time)


def solved(A, B):
    columns = [mpmath.lu_solve(mpmath.matrix(A.tolist()), mpmath.matrix(column.tolist())) for column in B.T]
    return np.array([list(column) for column in columns], dtype=object).T


def exact_solution(time, problem, P, corrections):
    """P and K by Newton's method, from a P close by."""
    A, B, Q, R, N = problem
    for _ in range(corrections):
        if time == "continuous":
            K = solved(R, B.T @ P + N.T)
            rest = A.T @ P + P @ A + Q - (P @ B + N) @ K
        else:
            K = solved(R + B.T @ P @ B, B.T @ P @ A + N.T)
            rest = A.T @ P @ A - P + Q - (A.T @ P @ B + N) @ K
        more = solved(lyapunov_operator(A - B @ K, time), -rest.reshape(-1, 1)).reshape(A.shape)
        P = P + (more + more.T) / 2
    return P, solved(R, B.T @ P + N.T) if time == "continuous" else solved(R + B.T @ P @ B, B.T @ P @ A + N.T)


def ill_conditioned(time):
    """By cheap control, by expensive control, and by a closed-loop pole of order four."""
    cheap = paper_problem(time, R=1e-8, period=0.002)
    slow = paper_problem(time, R=1e4, period=0.002)
    if time == "continuous":
        chain = (np.eye(4, k=1), np.eye(4)[:, 3:], np.diag([256.0, 256.0, 96.0, 16.0]), ONE, np.zeros((4, 1)))
    else:
        chain = (
            np.eye(4) + np.eye(4, k=1),
            np.eye(4)[:, 3:],
            np.diag([1.0, 0.0, 0.0, 0.0]),
            1e4 * ONE,
            np.zeros((4, 1)),
        )
    return cheap, slow, chain


def check_ill_conditioned_derivatives(time):
    """Beyond a condition of a million, digits are lost in proportion to it."""
    rng = np.random.default_rng(9)
    problems = ill_conditioned(time)
    batched, jacobians = functions(time, 4, 1)
    x = np.stack([vector(problem) for problem in problems])
    forward, _ = jacobians(jnp.asarray(x))
    conditions = []
    for problem, found, J in zip(problems, batched(jnp.asarray(x)), forward, strict=True):
        conditions.append(condition(time, problem, found[16:].reshape(1, 4)))
        allowed = 1e-8 * max(1.0, conditions[-1] / 1e6)
        with mpmath.workdps(60):
            step = mpmath.mpf(10) ** -22
            numbers = [exact(matrix) for matrix in problem]
            P, K = exact_solution(time, numbers, exact(found[:16].reshape(4, 4)), corrections=3)
            assert relative_error(found, np.concatenate([P.ravel(), K.ravel()])) <= 1e-15
            for k in range(5):
                direction = rng.normal(size=problem[k].shape) * np.maximum(np.abs(problem[k]), 1e-3)
                direction = direction + direction.T if k in (2, 3) else direction
                moved = [number + step * exact(direction) if i == k else number for i, number in enumerate(numbers)]
                near = exact_solution(time, moved, P, corrections=2)
                tangent = vector([direction if i == k else 0.0 * matrix for i, matrix in enumerate(problem)])
                pushed = np.asarray(J) @ tangent
                for part, after, before in zip((pushed[:16], pushed[16:]), near, (P, K), strict=True):
                    assert relative_error(part, ((after - before) / step).astype(np.float64).ravel()) <= allowed
    assert max(conditions) > 1e7


@pytest.mark.slow
@both
def test_second_derivatives_are_differences_and_no_batch_element_affects_another(time):
    problem = random_problem(2, 1, np.random.default_rng(11))
    x = vector(problem)

    def scalar(x):
        P, K, _ = SOLVERS[time](*split(x, 2, 1))
        return jnp.sum(P * jnp.asarray([[1.0, -0.3], [-0.3, 0.5]])) + K[0, 0] - 2.0 * K[0, 1]

    gradients = jax.jit(jax.vmap(jax.grad(scalar)))
    differences = jacobian(gradients, x, steps(time, problem))
    assert relative_error(differences, differences.T) <= 1e-9
    direction = np.random.default_rng(12).normal(size=x.shape)
    second = jax.jit(lambda x, v: jax.jvp(jax.grad(scalar), (x,), (v,)))
    alone, pushed = second(jnp.asarray(x), jnp.asarray(direction))
    assert relative_error(pushed, differences @ direction) <= 1e-9

    A, B, Q, R = unsolvable(time)["an unstable mode that no input moves"][1]
    batch = gradients(jnp.asarray(np.stack([x, vector((A, B, Q, R, 0.0 * B)), x])))
    np.testing.assert_allclose(batch[0], batch[2], rtol=1e-15)
    assert relative_error(batch[0], alone) <= 1e-14
