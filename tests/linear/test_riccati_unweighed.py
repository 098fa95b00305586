"""Modes that Q does not see: mirrored where unstable, left alone where stable, refused on the boundary of stability."""

import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from oracles import relative_error
from scipy.linalg import expm, solve_continuous_are, solve_discrete_are

from cpjax import InputError, dlqr, linearize, lqr, paper
from cpjax.linear.riccati import solve_care, solve_dare

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
DESIGNS = {"continuous": lqr, "discrete": dlqr}
SOLVERS = {"continuous": solve_care, "discrete": solve_dare}
BATCHED = {time: jax.jit(jax.vmap(solve)) for time, solve in SOLVERS.items()}
EQUATIONS = {"continuous": "care", "discrete": "dare"}
both = pytest.mark.parametrize("time", DESIGNS)
ONE, NONE = np.eye(1), np.zeros((2, 2))
UP, LAST = np.array([[1.0], [1.0]]), np.array([[0.0], [1.0]])


def scipys(time, A, B, Q, R):
    """K and P."""
    if time == "continuous":
        P = solve_continuous_are(A, B, Q, R)
        return np.linalg.solve(R, B.T @ P), P
    P = solve_discrete_are(A, B, Q, R)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A), P


def mirrored(time, modes):
    if time == "continuous":
        return -np.abs(modes.real) + 1j * modes.imag
    return np.where(np.abs(modes) > 1.0, 1.0 / np.conj(np.where(modes == 0.0, 1.0, modes)), modes)


def partly_weighed(time, n, m, seed):
    """A system of which one to n modes are not weighed, with states in odd order and units."""
    rng = np.random.default_rng([seed, n, m])
    k = int(rng.integers(1, n + 1))

    def block(size):
        M = rng.normal(size=(size, size))
        if time == "continuous":
            return M * 10.0 ** rng.uniform(-1, 1)
        return M * rng.choice([0.0, 0.5, 0.9, 1.1, 1.5, 3.0]) / np.max(np.abs(np.linalg.eigvals(M)), initial=1e-300)

    A = np.zeros((n, n))
    A[:k, :k], A[k:, k:], A[:k, k:] = block(k), block(n - k), rng.normal(size=(k, n - k))
    C = np.zeros((n, n))
    C[k:, k:] = np.round(64.0 * rng.normal(size=(n - k, n - k))) / 64.0  # C' C is exact
    order, units = rng.permutation(n), 2.0 ** rng.integers(-6, 7, size=n)
    A, B, C = A[np.ix_(order, order)] * units[:, None] / units, rng.normal(size=(n, m)), C[:, order] / units
    return A, units[:, None] * B[order], C.T @ C, 10.0 ** rng.uniform(-2, 2) * np.eye(m)


def stacked(problems, dtype=np.float64):
    return [jnp.asarray(np.stack(matrices), dtype=dtype) for matrices in zip(*problems, strict=True)]


@pytest.fixture(scope="module")
def systems():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXPERIMENTS))
        yield importlib.import_module("_riccati_systems")


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_an_inverted_pendulum_without_weights_is_mirrored_at_the_least_input(dtype):
    for stiffness in (1e4, 9.81, 1e-3, 1e-8, 1e-16):
        A = np.array([[0.0, 1.0], [stiffness, 0.0]], dtype=dtype)
        K, P = lqr(A, [0, 1], np.zeros((2, 2), dtype=dtype), 1.0)
        a = float(A[1, 0])
        rate = np.sqrt(a)
        assert K.dtype == dtype
        np.testing.assert_allclose(K, [[2.0 * a, 2.0 * rate]], rtol=2.0 * np.finfo(dtype).eps)
        np.testing.assert_allclose(
            P, [[2.0 * a * rate, 2.0 * a], [2.0 * a, 2.0 * rate]], rtol=2.0 * np.finfo(dtype).eps
        )


def test_whole_numbers_in_lists_and_a_number_for_the_input_weight_give_the_same_gain():
    K, _ = lqr([[0, 1], [9.81, 0]], [0, 1], np.zeros((2, 2)), 1.0)
    np.testing.assert_allclose(K, [[19.62, 6.26418390534633]], rtol=1e-15)


def test_an_unweighed_discrete_pole_goes_to_its_inverse_or_stays_if_it_is_stable():
    K, P = dlqr(np.diag([1.5, 0.5]), UP, NONE, ONE)
    np.testing.assert_allclose(P, [[1.25, 0.0], [0.0, 0.0]], rtol=1e-15, atol=1e-30)
    np.testing.assert_allclose(K, [[1.5 - 1.0 / 1.5, 0.0]], rtol=1e-15, atol=1e-30)


def test_a_singular_unweighed_discrete_plant_has_its_unstable_pole_mirrored():
    K, P = dlqr([[0.0, 2.0], [0.0, 3.0]], UP, NONE, ONE)
    np.testing.assert_allclose(P, [[0.0, 0.0], [0.0, 8.0]], rtol=1e-15, atol=1e-30)
    np.testing.assert_allclose(K, [[0.0, 8.0 / 3.0]], rtol=1e-15, atol=1e-30)


@pytest.mark.slow
def test_a_repeated_pole_without_weight_is_mirrored_as_often_as_it_is_there():
    K, _ = lqr(np.array([[1.0, 1.0], [0.0, 1.0]]), LAST, NONE, ONE)  # (s - 1)^2 becomes (s + 1)^2
    np.testing.assert_allclose(K, [[4.0, 4.0]], rtol=1e-15)
    _, P = lqr(np.eye(2), np.eye(2), NONE, np.diag([1.0, 4.0]))
    np.testing.assert_allclose(P, np.diag([2.0, 8.0]), rtol=1e-15, atol=1e-30)
    _, P = dlqr(2.0 * np.eye(2), np.eye(2), NONE, np.diag([1.0, 4.0]))
    np.testing.assert_allclose(P, np.diag([3.0, 12.0]), rtol=1e-15, atol=1e-30)


# --- others' solutions ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@both
@pytest.mark.parametrize(("n", "m"), [(4, 1), pytest.param(6, 2, marks=pytest.mark.slow)])
def test_whatever_is_not_weighed_the_gain_is_scipys_to_rounding(time, n, m, systems):
    problems = [partly_weighed(time, n, m, seed) for seed in range(60)]
    P, K, found = (np.asarray(x) for x in BATCHED[time](*stacked(problems)))
    assert np.all(found)
    unstable = 0
    for problem, one, gain in zip(problems, P, K, strict=True):
        A, _, Q, _ = problem
        modes = np.linalg.eigvals(A)
        if not np.any(Q) and (np.max(modes.real) < 0 if time == "continuous" else np.max(np.abs(modes)) < 1):
            assert not np.any(one)
            assert not np.any(gain)
            continue
        unstable += 1
        system = systems.System("", "", *problem)
        with mpmath.workdps(100):  # where the closed loop is not stable, this is an error
            right = systems.exact(one) + systems.newton_correction(EQUATIONS[time], system, systems.exact(one))
        assert systems.relative_error(one, right) <= 2e-16
        np.testing.assert_allclose(gain, scipys(time, *problem)[0], rtol=1e-3, atol=1e-12)  # SciPy's errors
    assert unstable >= 40


@both
@pytest.mark.slow
def test_float32_finds_the_gains_of_all_but_few_and_these_are_right_to_rounding(time):
    problems = [tuple(x.astype(np.float32) for x in partly_weighed(time, 4, 1, seed)) for seed in range(60)]
    P, K, found = (np.asarray(x) for x in BATCHED[time](*stacked(problems, np.float32)))
    assert P.dtype == K.dtype == np.float32
    assert np.sum(~found) <= 2
    right_P, right_K, right_found = (
        np.asarray(x) for x in BATCHED[time](*stacked(problems))
    )  # of the rounded problems
    assert np.all(right_found)
    for index in np.flatnonzero(found):
        assert np.linalg.norm(P[index] - right_P[index]) <= 1.2e-7 * np.linalg.norm(right_P[index])
        assert np.linalg.norm(K[index] - right_K[index]) <= 1.2e-7 * np.linalg.norm(right_K[index])


@both
def test_without_any_weight_the_closed_loop_has_the_mirrored_modes(time):
    rng = np.random.default_rng(3)
    problems = [(rng.normal(size=(4, 4)), rng.normal(size=(4, 1)), np.zeros((4, 4)), ONE) for _ in range(60)]
    _, K, found = (np.asarray(x) for x in BATCHED[time](*stacked(problems)))
    assert np.all(found)
    for (A, B, _, _), gain in zip(problems, K, strict=True):
        right = np.poly(mirrored(time, np.linalg.eigvals(A))).real
        np.testing.assert_allclose(np.poly(A - B @ gain), right, rtol=1e-9, atol=1e-9 * np.max(np.abs(right)))


@both
def test_units_change_no_digit_where_an_unstable_mode_has_no_weight(time):
    A, B = np.array([[1.2, 0.3], [0.7, -0.4]]), UP
    plain = DESIGNS[time](A, B, NONE, ONE)
    for exponents in ([20, -20], [-20, 20], [100, 100]):
        units = 2.0 ** np.array(exponents, dtype=np.float64)
        K, P = DESIGNS[time](units[:, None] * A / units, units[:, None] * B, NONE, ONE)
        np.testing.assert_allclose(K * units, plain.K, rtol=1e-15)
        np.testing.assert_allclose(P * units * units[:, None], plain.P, rtol=1e-15)


@pytest.mark.slow
def test_weighing_position_alone_is_solved_and_angle_alone_names_the_mode_at_zero():
    A, B = (np.asarray(matrix) for matrix in linearize(paper.appendix_plant()))
    K, P = lqr(A, B, np.diag([1.0, 0.0, 0.0, 0.0]), 1e-4)
    right = scipys("continuous", A, B, np.diag([1.0, 0.0, 0.0, 0.0]), 1e-4 * ONE)
    assert relative_error(K, right[0]) <= 1e-9
    assert relative_error(P, right[1]) <= 1e-9
    with pytest.raises(InputError, match=r"imaginary axis: it must weigh the mode with eigenvalue 0$"):
        lqr(A, B, np.diag([0.0, 0.0, 1.0, 0.0]), 1e-4)
    held = expm(0.02 * np.block([[A, B], [np.zeros((1, 5))]]))
    with pytest.raises(InputError, match=r"unit circle: it must weigh the mode with eigenvalue 1$"):
        dlqr(held[:4, :4], held[:4, 4:], np.diag([0.0, 0.0, 1.0, 0.0]), 1e-4)


# --- the boundary -----------------------------------------------------------------------------------------------------

TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])
SKEW = np.array([[2.0, 1.0], [0.5, -1.0]])
ON_BOUNDARY = {
    "an integrator": ("continuous", np.diag([0.0, 2.0]), UP, "0"),
    "an oscillator": ("continuous", 2.0 * TURN, LAST, "0\\+2j"),
    "a double integrator": ("continuous", np.eye(2, k=1), LAST, "0"),
    "a double integrator in other coordinates": (
        "continuous",
        SKEW @ np.eye(2, k=1) @ np.linalg.inv(SKEW),
        SKEW @ LAST,
        "-?[0-9.e-]+",
    ),
    "a sum": ("discrete", np.diag([1.0, 2.0]), UP, "1"),
    "an alternating sum": ("discrete", np.diag([-1.0, 2.0]), UP, "-1"),
    "a turn by a quarter": ("discrete", TURN, LAST, "0\\+1j"),
    "a double sum": ("discrete", np.eye(2) + np.eye(2, k=1), LAST, "1"),
}


@pytest.mark.parametrize("name", ON_BOUNDARY)
def test_an_unweighed_mode_on_the_stability_boundary_is_refused_by_its_eigenvalue(name):
    time, A, B, mode = ON_BOUNDARY[name]
    with pytest.raises(InputError, match=f"^Q = .*: must be detectable .* with eigenvalue {mode}$"):
        DESIGNS[time](A, B, NONE, ONE)


@pytest.mark.slow
@both
def test_inside_jit_an_unweighed_boundary_mode_is_nan_in_its_own_elements_only(time):
    bad = [(A, B, NONE, ONE) for kind, A, B, _ in ON_BOUNDARY.values() if kind == time]
    good = (np.array([[1.5, 0.2], [0.1, 0.4]]), UP, NONE, ONE)
    P, K, found = (np.asarray(x) for x in BATCHED[time](*stacked([good, *bad, good, good])))
    right = np.array([True, *[False] * len(bad), True, True])
    np.testing.assert_array_equal(found, right)
    assert np.all(np.isnan(P[~right]))
    assert np.all(np.isnan(K[~right]))
    alone = DESIGNS[time](*good)
    for index in np.flatnonzero(right):
        np.testing.assert_allclose(P[index], alone.P, rtol=1e-15)
        np.testing.assert_allclose(K[index], alone.K, rtol=1e-15)


def test_an_unstable_mode_that_no_input_moves_is_refused_without_weights_too():
    for design, modes in ((lqr, [1.0, 2.0]), (dlqr, [1.5, 2.0])):
        with pytest.raises(InputError, match=f"^B = .* must move the mode with eigenvalue {modes[0]:.6g}, "):
            design(np.diag(modes), LAST, NONE, ONE)


def test_in_discrete_time_an_input_without_weight_is_refused():
    with pytest.raises(
        InputError, match=r"^R = .* positive definite: every input must cost something; that R \+ B' P B"
    ):
        dlqr([[1.5]], [[1.0]], [[1.0]], 0.0)


# --- derivatives ------------------------------------------------------------------------------------------------------

WEIGHT = np.array([[1.0, -0.3], [-0.3, 0.5]])


def family(time):
    """P and K in one number, of A, B, R and of q in Q = q W with W positive definite; and the point where Q is zero."""

    def value(x):
        A, B, R, q = x[:4].reshape(2, 2), x[4:6].reshape(2, 1), x[6].reshape(1, 1), x[7]
        K, P = DESIGNS[time](A, B, q * jnp.asarray([[2.0, 0.4], [0.4, 1.0]]), R)
        return jnp.sum(P * WEIGHT) + K[0, 0] - 2.0 * K[0, 1]

    unstable = [0.0, 1.0, 9.81, -0.1] if time == "continuous" else [1.1, 0.3, 0.4, 0.8]
    return value, np.array([*unstable, 0.2, 1.0, 0.7, 0.0])


def differences(function, x, step):
    """Of sixth order, central where there are two sides, and forward in the last coordinate."""
    points, rules = [], []
    for i in range(len(x)):
        if i < len(x) - 1:
            rule = {1: 3 / 4, -1: -3 / 4, 2: -3 / 20, -2: 3 / 20, 3: 1 / 60, -3: -1 / 60}
        else:
            rule = {0: -49 / 20, 1: 6.0, 2: -15 / 2, 3: 20 / 3, 4: -15 / 4, 5: 6 / 5, 6: -1 / 6}
        for k, factor in rule.items():
            points.append(x + k * step * np.eye(len(x))[i])
            rules.append(factor * np.eye(len(x))[i] / step)
    return np.stack(rules, axis=-1) @ np.asarray(function(jnp.asarray(np.stack(points))))


@both
@pytest.mark.slow
def test_where_q_is_zero_the_derivatives_agree_with_differences(time):
    value, x = family(time)
    first = differences(jax.jit(jax.vmap(value)), x, 1e-3)
    forward, reverse = jax.jit(lambda x: (jax.jacfwd(value)(x), jax.grad(value)(x)))(jnp.asarray(x))
    assert relative_error(forward, first) <= 1e-9
    assert relative_error(reverse, forward) <= 1e-12


@pytest.mark.slow
@both
def test_where_q_is_zero_the_second_derivatives_are_the_differences_of_the_first(time):
    value, x = family(time)
    gradients = jax.jit(jax.vmap(jax.grad(value)))
    second = jax.jit(jax.hessian(value))(jnp.asarray(x))
    assert relative_error(second, differences(gradients, x, 1e-3)) <= 1e-8
    assert relative_error(second, second.T) <= 1e-12
