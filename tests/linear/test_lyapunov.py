"""Lyapunov's and Stein's equations against Kronecker products in fifty digits, and against SciPy."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from oracles import jacobian, lyapunov_operator, relative_error
from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov
from tables import rows

from cpjax import InputError
from cpjax.linear.lyapunov import lyapunov, stein

SOLVERS = {"continuous": lyapunov, "discrete": stein}
COMPILED = {time: jax.jit(jax.vmap(solve)) for time, solve in SOLVERS.items()}
SCIPY = {
    "continuous": lambda A, Q: solve_continuous_lyapunov(A.T, -Q),
    "discrete": lambda A, Q: solve_discrete_lyapunov(A.T, Q, method="bilinear"),
}
both = rows("time", SOLVERS)


def stable(time, n, rng, margin):
    """A random matrix whose slowest mode is a relative `margin` away from the edge of stability."""
    A = rng.normal(size=(n, n))
    modes = np.linalg.eigvals(A)
    if time == "continuous":
        return A - (np.max(modes.real) + margin * np.max(np.abs(modes))) * np.eye(n)
    return A * (1.0 - margin) / np.max(np.abs(modes))


def exact_solution(time, A, Q):
    with mpmath.workdps(50):
        A, Q = (np.vectorize(mpmath.mpf, otypes=[object])(x) for x in (A, Q))
        X = mpmath.lu_solve(mpmath.matrix(lyapunov_operator(A, time).tolist()), mpmath.matrix((-Q.ravel()).tolist()))
        return np.array(X.tolist(), dtype=np.float64).reshape(A.shape)


@pytest.mark.slow
@both
@rows("n", [1, 2, 4])
def test_the_solution_is_the_exact_one_rounded_even_near_the_edge_of_stability(time, n):
    rng = np.random.default_rng(n)
    systems = [(stable(time, n, rng, margin), rng.normal(size=(n, n))) for margin in (0.5, 0.1, 1e-3, 1e-6)]
    found = COMPILED[time](*(jnp.asarray(np.stack(x)) for x in zip(*systems, strict=True)))
    for X, system in zip(found, systems, strict=True):
        assert relative_error(X, exact_solution(time, *system)) <= 2e-16


@both
@rows("n", [8, 16])
def test_large_systems_are_solved_as_scipy_solves_them(time, n):
    rng = np.random.default_rng(n)
    A, Q = stable(time, n, rng, 0.05), rng.normal(size=(n, n))
    X = SOLVERS[time](A, Q)
    assert relative_error(X, SCIPY[time](A, Q)) <= 1e-12
    left = lyapunov_operator(A, time) @ np.ravel(X) + Q.ravel()
    assert np.max(np.abs(left)) <= 1e-12 * np.max(np.abs(X)) * np.max(np.abs(A))


@both
def test_a_single_mode_of_multiplicity_four_is_no_harder_than_others(time):
    A = np.eye(4, k=1) + np.eye(4) * (-0.01 if time == "continuous" else 0.99)
    Q = np.diag([1.0, 0.0, 0.0, 2.0])
    assert relative_error(SOLVERS[time](A, Q), exact_solution(time, A, Q)) <= 2e-16


def test_a_system_that_forgets_everything_in_n_steps_sums_n_terms():
    np.testing.assert_array_equal(stein(np.eye(5, k=1), np.eye(5)), np.diag(np.arange(1.0, 6.0)))


def test_modes_ten_orders_of_magnitude_apart_are_solved_together():
    rates = np.array([1e-5, 1e-3, 1.0, 10.0, 1e3, 1e5])
    Q = np.random.default_rng(0).normal(size=(6, 6))
    np.testing.assert_allclose(lyapunov(np.diag(-rates), Q), Q / (rates[:, None] + rates), rtol=1e-15)


@both
def test_a_symmetric_right_side_has_a_symmetric_solution_and_zero_has_zero(time):
    rng = np.random.default_rng(3)
    A, C = stable(time, 4, rng, 0.1), rng.normal(size=(2, 4))
    X = np.asarray(SOLVERS[time](A, C.T @ C))
    np.testing.assert_allclose(X, X.T, rtol=1e-15)
    assert np.min(np.linalg.eigvalsh(X)) > 0
    np.testing.assert_array_equal(SOLVERS[time](A, np.zeros((4, 4))), np.zeros((4, 4)))


@both
def test_float32_arguments_give_float32_solutions_to_their_rounding(time):
    rng = np.random.default_rng(4)
    A, Q = (x.astype(np.float32) for x in (stable(time, 4, rng, 0.1), rng.normal(size=(4, 4))))
    X = SOLVERS[time](A, Q)
    assert X.dtype == jnp.float32
    assert relative_error(X, exact_solution(time, A.astype(np.float64), Q.astype(np.float64))) <= 2e-7


@both
def test_lists_and_whole_numbers_are_welcome(time):
    A, Q = ([[-1, 0], [0, -2]] if time == "continuous" else [[0, 1], [0, 0]]), [[1, 0], [0, 1]]
    assert SOLVERS[time](A, Q).dtype == jnp.float64
    np.testing.assert_array_equal(SOLVERS[time](A, Q), SOLVERS[time](np.array(A, float), jnp.eye(2)))


UNSTABLE = {
    "continuous": {
        "a growing mode": np.diag([-1.0, 1.0]),
        "an integrator": np.diag([-1.0, 0.0]),
        "an undamped oscillator": np.array([[0.0, 2.0], [-2.0, 0.0]]),
        "nothing but zeros": np.zeros((2, 2)),
        "a slowly growing mode": np.diag([-1.0, 1e-12]),
        "two integrators": np.eye(2, k=1),
    },
    "discrete": {
        "a growing mode": np.diag([0.5, -1.5]),
        "an integrator": np.diag([0.5, 1.0]),
        "an undamped oscillator": np.array([[0.6, 0.8], [-0.8, 0.6]]) * (1 + 1e-15),
        "an alternating mode": np.diag([0.0, -1.0]),
        "a slowly growing mode": np.diag([0.5, 1 + 1e-12]),
        "two integrators": np.eye(2) + np.eye(2, k=1),
    },
}


@both
def test_an_unstable_system_is_refused(time):
    for name, A in UNSTABLE[time].items():
        with pytest.raises(InputError, match="stable") as caught:
            SOLVERS[time](A, np.eye(2))
        assert caught.value.field == "A", name


@both
def test_an_unstable_system_gives_nan_inside_jit_and_spoils_no_other_lane(time):
    good = np.array([[-1.0, 3.0], [0.0, -2.0]]) * (1.0 if time == "continuous" else 0.3)
    A = np.stack([good, *UNSTABLE[time].values(), good])
    Q = np.broadcast_to(np.array([[2.0, 1.0], [0.0, 1.0]]), A.shape)
    X = COMPILED[time](jnp.asarray(A), jnp.asarray(Q))
    assert np.all(np.isnan(X[1:-1]))
    np.testing.assert_allclose(X[jnp.asarray([0, -1])], np.stack([exact_solution(time, good, Q[0])] * 2), rtol=1e-15)


@both
@rows(
    ("field", "arguments"),
    [
        ("A", (np.ones((2, 3)), np.eye(2))),
        ("A", (np.zeros((0, 0)), np.eye(2))),
        ("A", (np.zeros((5, 2, 2)), np.eye(2))),
        ("A", (np.full((2, 2), np.nan), np.eye(2))),
        ("A", ("A", np.eye(2))),
        ("A", (1j * np.eye(2), np.eye(2))),
        ("Q", (-0.5 * np.eye(2), np.eye(3))),
        ("Q", (-0.5 * np.eye(2), np.ones(2))),
        ("Q", (-0.5 * np.eye(2), np.full((2, 2), np.inf))),
        ("Q", (-0.5 * np.eye(2), None)),
        ("Q", (-0.5 * np.eye(2), [[1.0, 0.0], [1.0]])),
    ],
)
def test_arguments_that_do_not_fit_are_refused(time, field, arguments):
    with pytest.raises(InputError) as caught:
        SOLVERS[time](*arguments)
    assert caught.value.field == field


@pytest.mark.slow
@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_first_and_second_derivatives_agree_with_differences_and_under_vmap(time):
    n, rng = 3, np.random.default_rng(5)
    x = np.stack([np.concatenate([stable(time, n, rng, 0.3).ravel(), rng.normal(size=n * n)]) for _ in range(3)])

    def solution(x):
        return SOLVERS[time](x[: n * n].reshape(n, n), x[n * n :].reshape(n, n)).ravel()

    def scalar(x):
        return jnp.sum(solution(x) ** 2)

    batched, gradients = jax.jit(jax.vmap(solution)), jax.jit(jax.vmap(jax.grad(scalar)))
    forward, reverse = jax.jit(jax.vmap(lambda x: (jax.jacfwd(solution)(x), jax.jacrev(solution)(x))))(jnp.asarray(x))
    hessian, gradient = jax.jit(jax.hessian(scalar)), jax.jit(jax.grad(scalar))
    for i, point in enumerate(x):
        differences = jacobian(batched, point, 2e-3)
        for part in (slice(0, n * n), slice(n * n, None)):
            assert relative_error(forward[i][:, part], differences[:, part]) <= 1e-10
            assert relative_error(reverse[i][:, part], forward[i][:, part]) <= 1e-14
        assert relative_error(gradients(jnp.asarray(x))[i], gradient(jnp.asarray(point))) <= 1e-14
    assert relative_error(hessian(jnp.asarray(x[0])), jacobian(gradients, x[0], 2e-3)) <= 1e-10
