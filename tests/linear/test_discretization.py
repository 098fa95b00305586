"""Sampled models and costs against 60 digits, closed forms, quadrature and simulations."""

import math

import control
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax import lax
from oracles import dop853, rough_plant
from scipy.integrate import quad_vec
from scipy.linalg import expm, solve_discrete_are
from scipy.signal import cont2discrete
from tables import rows

from cpjax import InputError, State, linearize, paper
from cpjax.linear.discretization import discretize, discretize_cost
from cpjax.sim.integrators import rk4
from cpjax.sim.stepper import step_held

RNG = np.random.default_rng(4)
UPRIGHT = tuple(map(np.asarray, linearize(rough_plant())))
HANGING = tuple(map(np.asarray, linearize(paper.appendix_plant(), "hanging")))
MODELS = {
    "upright": (*UPRIGHT, np.diag(paper.Q), np.array([[paper.R]])),
    "hanging": (*HANGING, np.diag([1000.0, 0.0, 0.0, 0.0]), np.eye(1)),
    "large input": (UPRIGHT[0], 1e6 * UPRIGHT[1], np.eye(4), np.eye(1)),
    "two inputs": (RNG.normal(size=(3, 3)), RNG.normal(size=(3, 2)), np.eye(3) + 0.3, np.diag([1.0, 2.0])),
    "oscillator": (np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1)),
    "double integrator": (np.eye(2, k=1), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1)),
    "nothing": (np.zeros((2, 2)), np.zeros((2, 1)), np.zeros((2, 2)), np.zeros((1, 1))),
}
PERIODS = (1e-6, 1e-3, 0.02, 0.5, 3.0)


def norm(A):
    return np.max(np.sum(np.abs(A), axis=0))


def exact(A, B, Q, R, period):
    """Ad, Bd, Qd, Rd, Nd by Van Loan's formula in so many digits that nothing in it matters."""
    n, m = B.shape
    F = np.block([[A, B], [np.zeros((m, n + m))]])
    C = np.block([[Q, np.zeros((n, m))], [np.zeros((m, n)), R]])
    with mpmath.workdps(80 + int(norm(A) * period)):
        X = mpmath.expm(mpmath.matrix(np.block([[-F.T, C], [np.zeros_like(F), F]]).tolist()) * mpmath.mpf(period))
        E, G = X[n + m :, n + m :], X[: n + m, n + m :]
        E, W = (np.array(M.tolist(), dtype=float) for M in (E, E.T * G))
    return E[:n, :n], E[:n, n:], W[:n, :n], W[n:, n:], W[:n, n:]


def error(ours, reference):
    """Relative to the largest entry."""
    scale = np.max(np.abs(reference))
    return float(np.max(np.abs(np.asarray(ours, dtype=float) - reference)) / (scale if scale > 0 else 1.0))


@rows("dtype", [np.float64, np.float32])
@rows("period", PERIODS)
@rows("model", MODELS)
@pytest.mark.slow
def test_model_and_cost_are_exact_to_a_few_roundings_of_the_largest_entry(model, period, dtype):
    A, B, Q, R = (M.astype(dtype) for M in MODELS[model])
    period = dtype(period)
    ours = (*discretize(A, B, period), *discretize_cost(A, B, Q, R, period))
    reference = exact(*(M.astype(np.float64) for M in (A, B, Q, R)), float(period))
    allowed = 8 * np.finfo(dtype).eps * max(1.0, norm(A) * period)
    assert {M.dtype for M in ours} == {np.dtype(dtype)}
    assert [M.shape for M in ours] == [M.shape for M in reference]
    assert max(map(error, ours, reference)) <= allowed


@rows("model", ["upright", "hanging", "two inputs"])
@rows("period", [1e-3, 0.02, 0.5])
def test_the_model_is_scipys_and_python_controls(model, period):
    A, B, _, _ = MODELS[model]
    ours = discretize(A, B, period)
    theirs = cont2discrete((A, B, np.eye(len(A)), np.zeros_like(B)), period)
    peers = control.c2d(control.ss(A, B, np.eye(len(A)), np.zeros_like(B)), period, "zoh")
    assert max(map(error, ours, theirs[:2])) <= 1e-13
    assert max(map(error, ours, (peers.A, peers.B))) <= 1e-13


def test_the_sampled_model_is_the_derivative_of_a_held_step_of_the_plant():
    def held(vector, voltage):
        def step(_, state):
            return step_held(rough_plant(), rk4, state, voltage, 2e-4)

        return lax.fori_loop(0, 100, step, State.from_vector(vector)).vector()

    A, B = jax.jit(jax.jacfwd(held, argnums=(0, 1)))(jnp.zeros(4), jnp.zeros(()))
    assert max(map(error, discretize(*UPRIGHT, 0.02), (A, B[:, None]))) <= 1e-12


@rows("turns", [0.5, 1.0, 1.7, 3.0, 50.0])
def test_a_rotation_stays_one_at_every_angle(turns):
    # JAX's exponential of this matrix is wrong by 2e-8 at 1.7 turns.
    angle = 2.0 * math.pi * turns
    A, B = discretize([[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]], angle)
    cos, sin = math.cos(angle), math.sin(angle)
    assert np.max(np.abs(A - np.array([[cos, sin], [-sin, cos]]))) <= 8 * np.finfo(float).eps * angle
    assert np.max(np.abs(B[:, 0] - np.array([1.0 - cos, sin]))) <= 8 * np.finfo(float).eps * angle


@rows("dtype", [np.float64, np.float32])
@rows("period", [1e2, 1e4, 1e6, 1e9])
def test_a_stable_model_forgets_its_start_over_a_long_period(period, dtype):
    # s' = -s + u twice: what is left is the input's share, and a cost that still remembers how it began.
    eye, ones = np.eye(2, dtype=dtype), np.ones((2, 1), dtype=dtype)
    A, B = discretize(-eye, ones, dtype(period))
    cost = discretize_cost(-eye, ones, eye, np.zeros((1, 1), dtype=dtype), dtype(period))
    allowed = 8 * float(np.finfo(dtype).eps) * period
    assert np.max(np.abs(A)) <= 1e-37
    np.testing.assert_allclose(B, ones, rtol=allowed)
    np.testing.assert_allclose(np.diag(cost.Q), [0.5, 0.5], rtol=allowed)
    np.testing.assert_allclose(cost.R, [[2.0 * period - 3.0]], rtol=allowed)


def test_two_periods_are_the_period_twice():
    A, B, Q, R = MODELS["upright"]
    once, twice = discretize(A, B, 0.01), discretize(A, B, 0.02)
    cost, both = discretize_cost(A, B, Q, R, 0.01), discretize_cost(A, B, Q, R, 0.02)
    assert error(twice.A, once.A @ once.A) <= 1e-14
    assert error(twice.B, once.A @ once.B + once.B) <= 1e-14
    assert error(both.Q, cost.Q + once.A.T @ cost.Q @ once.A) <= 1e-14
    assert error(both.N, cost.N + once.A.T @ (cost.Q @ once.B + cost.N)) <= 1e-14


# The cost


@rows("model", ["upright", "hanging", "two inputs"])
@rows("period", [1e-3, 0.1, 1.0])
def test_the_cost_is_the_integral_by_quadrature(model, period):
    A, B, Q, R = MODELS[model]
    n, m = B.shape
    F = np.block([[A, B], [np.zeros((m, n + m))]])
    C = np.block([[Q, np.zeros((n, m))], [np.zeros((m, n)), R]])
    W, _ = quad_vec(lambda t: expm(F.T * t) @ C @ expm(F * t), 0.0, period, epsrel=1e-13, epsabs=0.0)
    ours = discretize_cost(A, B, Q, R, period)
    assert max(map(error, ours, (W[:n, :n], W[n:, n:], W[:n, n:]))) <= 1e-12


def test_the_cost_is_that_of_a_simulated_period():
    A, B, Q, R = MODELS["upright"]
    s, u, period = np.array([0.1, -0.2, 0.3, 0.4]), np.array([2.0]), 0.2
    run = dop853(
        lambda z: np.append(A @ z[:4] + B @ u, z[:4] @ Q @ z[:4] + u @ R @ u), np.append(s, 0.0), (0.0, period)
    )
    model, cost = discretize(A, B, period), discretize_cost(A, B, Q, R, period)
    np.testing.assert_allclose(model.A @ s + model.B @ u, run.y[:4, -1], rtol=1e-11)
    assert float(s @ cost.Q @ s + 2.0 * s @ cost.N @ u + u @ cost.R @ u) == pytest.approx(run.y[4, -1], rel=1e-11)


def test_a_sampled_regulator_with_this_cost_minimises_the_continuous_integral():
    A, B, Q, R = UPRIGHT[0], UPRIGHT[1], np.diag([1.0, 0.1, 1.0, 0.1]), np.array([[0.01]])
    period, start = 0.1, np.array([0.2, 0.0, 0.1, 0.0])
    model, cost = (tuple(map(np.asarray, M)) for M in (discretize(A, B, period), discretize_cost(A, B, Q, R, period)))
    (Ad, Bd), (Qd, Rd, Nd) = model, cost
    P = solve_discrete_are(Ad, Bd, Qd, Rd, s=Nd)
    K = np.linalg.solve(Rd + Bd.T @ P @ Bd, Bd.T @ P @ Ad + Nd.T)

    # The integral again, from nothing but the matrix exponential at Gauss's nodes within a period.
    nodes, weights = np.polynomial.legendre.leggauss(12)
    F = np.block([[A, B], [np.zeros((1, 5))]])
    flows = [expm(F * period * 0.5 * (node + 1.0))[:4] for node in nodes]
    whole = expm(F * period)[:4]

    def integral(K):
        s, total = start, 0.0
        for _ in range(400):
            z = np.append(s, -K @ s)
            inside = [flow @ z for flow in flows]
            total += (
                0.5 * period * sum(w * (x @ Q @ x + R[0, 0] * z[4] ** 2) for w, x in zip(weights, inside, strict=True))
            )
            s = whole @ z
        assert np.max(np.abs(s)) < 1e-9
        return total

    least = integral(K)
    assert least == pytest.approx(start @ P @ start, rel=1e-11)
    for i in range(4):
        step = 1e-3 * np.abs(K[0, i]) * np.eye(4)[i]
        more, less = integral(K + step), integral(K - step)
        assert min(more, less) > least
        assert abs(more - less) <= 1e-2 * (more + less - 2.0 * least)  # level, to the third order of the step


def test_only_symmetric_parts_of_the_weights_count():
    A, B, Q, R = MODELS["two inputs"]
    skew = lambda n: np.triu(np.ones((n, n)), 1) - np.tril(np.ones((n, n)), -1)  # noqa: E731
    ours = discretize_cost(A, B, Q + skew(3), R + skew(2), 0.3)
    for lopsided, straight in zip(ours, discretize_cost(A, B, Q, R, 0.3), strict=True):
        np.testing.assert_allclose(lopsided, straight, rtol=1e-14)
    np.testing.assert_array_equal(ours.Q, ours.Q.T)
    np.testing.assert_array_equal(ours.R, ours.R.T)


# Derivatives


def everything(A, B, Q, R, period):
    """One number that depends on every entry of model and cost."""
    results = (*discretize(A, B, period), *discretize_cost(A, B, Q, R, period))
    weights = [jnp.asarray(np.cos(np.arange(M.size) + k).reshape(M.shape)) for k, M in enumerate(results)]
    return sum(jnp.sum(w * M) for w, M in zip(weights, results, strict=True))


def richardson(function, h):
    """The derivative at 0 by central differences, extrapolated twice."""
    rough, fine, finest = ((function(h / k) - function(-h / k)) / (2 * h / k) for k in (1, 2, 4))
    first, second = (4 * fine - rough) / 3, (4 * finest - fine) / 3
    return (16 * second - first) / 15


ALL = (0, 1, 2, 3, 4)
gradient = jax.jit(jax.grad(everything, argnums=ALL))
gradients = jax.jit(jax.vmap(gradient))
slope = jax.jit(lambda values, direction: jax.jvp(everything, values, direction)[1])
slopes = jax.jit(jax.vmap(slope))
along = jax.jit(lambda values, direction, h: everything(*(v + h * d for v, d in zip(values, direction, strict=True))))

POINTS = {
    "one input": [
        (*MODELS["upright"], 0.01),
        (*MODELS["hanging"], 1.5),
        # Nothing moves and nothing costs; and the norm is a power of two, where the number of halvings changes.
        (np.zeros((4, 4)), np.zeros((4, 1)), np.zeros((4, 4)), np.zeros((1, 1)), 0.5),
        (-2.0 * np.eye(4), np.ones((4, 1)) / 4, 2.0 * np.eye(4), np.eye(1), 2.0),
    ],
    "two inputs": [(*MODELS["two inputs"], 0.7), (*MODELS["two inputs"], 0.01)],
}


@pytest.mark.slow
@pytest.mark.parametrize("points", ["one input", pytest.param("two inputs", marks=pytest.mark.slow)])
def test_derivatives_agree_forward_in_reverse_with_differences_and_under_vmap(points):
    rng = np.random.default_rng(7)
    values = [tuple(map(jnp.asarray, point)) for point in POINTS[points]]
    directions = [tuple(rng.normal(size=v.shape) * (0.3 + jnp.max(jnp.abs(v))) for v in point) for point in values]
    stacked = [jax.tree.map(lambda *v: jnp.stack(v), *each) for each in (values, directions)]
    # Under vmap all points are halved side by side, each as often as it needs.
    for point, direction, in_reverse, batched in zip(
        values, directions, zip(*gradients(*stacked[0]), strict=True), slopes(*stacked), strict=True
    ):
        forward, reverse = float(slope(point, direction)), gradient(*point)
        numeric = float(richardson(lambda h, p=point, d=direction: along(p, d, h), 1e-3))
        assert float(batched) == pytest.approx(forward, rel=1e-12)
        assert numeric == pytest.approx(forward, rel=1e-8)
        assert float(sum(jnp.sum(g * d) for g, d in zip(reverse, direction, strict=True))) == pytest.approx(
            forward, rel=1e-12
        )
        for one, other in zip(reverse, in_reverse, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12 * np.max(np.abs(one)))


@rows("what", ["A", "B", "period"])
def test_the_models_own_derivatives_are_those_of_their_definition(what):
    # d exp(A T) / dT = A exp(A T); Bd is linear in B; and along a direction that commutes with A, exp' is exp.
    A, B = UPRIGHT
    if what == "period":
        Ad, Bd = jax.jacfwd(lambda T: discretize(A, B, T))(0.3)
        model = discretize(A, B, 0.3)
        np.testing.assert_allclose(Ad, A @ model.A, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(Bd, model.A @ B, rtol=1e-11, atol=1e-12)
    elif what == "B":
        _, (Ad, Bd) = jax.jvp(lambda B: discretize(A, B, 0.3), (jnp.asarray(B),), (jnp.ones_like(B),))
        assert np.max(np.abs(Ad)) == 0.0
        np.testing.assert_allclose(Bd, discretize(A, np.ones_like(B), 0.3).B, rtol=1e-12)
    else:
        _, (Ad, _) = jax.jvp(lambda A: discretize(A, B, 0.3), (jnp.asarray(A),), (jnp.asarray(A @ A),))
        np.testing.assert_allclose(Ad, 0.3 * A @ A @ discretize(A, B, 0.3).A, rtol=1e-11, atol=1e-11)


# Edges


def test_lists_and_whole_numbers_are_taken():
    model = discretize([[0, 1], [0, 0]], [[0], [1]], 2)
    np.testing.assert_array_equal(model.A, [[1, 2], [0, 1]])
    np.testing.assert_array_equal(model.B, [[2], [2]])
    assert model.A.dtype == jnp.float64


def test_a_vector_is_taken_as_input_matrix_and_a_number_as_weight_of_one_input():
    A, B = UPRIGHT
    plain, right = discretize(A, B[:, 0], 0.1), discretize(A, B, 0.1)
    cost, right_cost = discretize_cost(A, B[:, 0], np.eye(4), 2, 0.1), discretize_cost(A, B, np.eye(4), [[2.0]], 0.1)
    for one, other in zip((*plain, *cost), (*right, *right_cost), strict=True):
        np.testing.assert_array_equal(one, other)


A2, B2 = np.eye(2, k=1), np.ones((2, 1))


@rows(
    ("call", "field"),
    [
        (lambda: discretize(np.ones((2, 3)), B2, 0.1), "A"),
        (lambda: discretize(np.ones((2, 2, 2)), B2, 0.1), "A"),
        (lambda: discretize(A2 * math.nan, B2, 0.1), "A"),
        (lambda: discretize(A2, np.ones((3, 1)), 0.1), "B"),
        (lambda: discretize(A2, np.ones(3), 0.1), "B"),
        (lambda: discretize(A2, 1.0, 0.1), "B"),
        (lambda: discretize(A2, np.ones((2, 0)), 0.1), "B"),
        (lambda: discretize(A2, "b", 0.1), "B"),
        (lambda: discretize(A2, B2, 0.0), "period"),
        (lambda: discretize(A2, B2, -1e-3), "period"),
        (lambda: discretize(A2, B2, math.inf), "period"),
        (lambda: discretize(A2, B2, math.nan), "period"),
        (lambda: discretize(A2, B2, [0.1, 0.2]), "period"),
        (lambda: discretize(A2, B2, True), "period"),
        (lambda: discretize(np.eye(2), B2, 1e3), "period"),
        (lambda: discretize(A2, B2, 1e12), "period"),
        (lambda: discretize_cost(A2, B2, np.eye(3), np.eye(1), 0.1), "Q"),
        (lambda: discretize_cost(A2, B2, np.eye(2), np.eye(2), 0.1), "R"),
        (lambda: discretize_cost(A2, np.eye(2), np.eye(2), 1.0, 0.1), "R"),
        (lambda: discretize_cost(A2, B2, np.eye(2), np.ones(1), 0.1), "R"),
        (lambda: discretize_cost(A2, B2, np.eye(2), np.eye(1), 0.0), "period"),
        (lambda: discretize_cost(np.eye(2), B2, np.eye(2), np.eye(1), 400.0), "period"),
    ],
)
def test_bad_input_is_refused_by_name(call, field):
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.field == field


@rows("period", [0.0, -1.0, math.nan, math.inf, 1e12])
def test_inside_jit_a_bad_period_gives_nan(period):
    model = jax.jit(discretize)(A2, B2, period)
    cost = jax.jit(discretize_cost)(A2, B2, np.eye(2), np.eye(1), period)
    assert all(np.any(np.isnan(M)) for M in (model.A, model.B, cost.Q, cost.R, cost.N))
