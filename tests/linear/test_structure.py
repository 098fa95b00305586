"""Controllability, observability and Gramians against python-control, quadrature, and what they promise."""

import math

import control
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_continuous_lyapunov
from tables import rows

import cpjax
from cpjax import InputError, State, paper
from cpjax.linear.structure import (
    POSITION_AND_ANGLE,
    controllability,
    controllability_gramian,
    controllability_matrix,
    observability,
    observability_gramian,
    observability_matrix,
)

SHAPES = [(1, 1, 1), (2, 1, 2), (4, 1, 2), (5, 2, 3), (8, 3, 1)]
FEW_SHAPES = [(4, 1, 2), (5, 2, 3)]  # because each is compiled
GRAMIANS = [controllability_gramian, observability_gramian]


def random_system(n, inputs, outputs):
    rng = np.random.default_rng([n, inputs, outputs])
    return rng.normal(size=(n, n)), rng.normal(size=(n, inputs)), rng.normal(size=(outputs, n))


def papers_model(plant="appendix", equilibrium="upright"):
    return tuple(np.asarray(m) for m in cpjax.linearize(paper.PLANTS[plant](), equilibrium))


def stable_system(n, inputs, outputs):
    A, B, C = random_system(n, inputs, outputs)
    return A - (0.2 + np.max(np.linalg.eigvals(A).real)) * np.eye(n), B, C


@rows("shape", SHAPES)
def test_the_matrices_are_python_controls(shape):
    A, B, C = random_system(*shape)
    expected = control.ctrb(A, B)
    np.testing.assert_allclose(
        controllability_matrix(A, B), expected, rtol=1e-12, atol=1e-12 * np.max(np.abs(expected))
    )
    expected = control.obsv(A, C)
    np.testing.assert_allclose(observability_matrix(A, C), expected, rtol=1e-12, atol=1e-12 * np.max(np.abs(expected)))


def test_a_plain_vector_is_one_input_or_one_output():
    A, B, C = random_system(4, 1, 1)
    np.testing.assert_array_equal(controllability_matrix(A, B[:, 0]), controllability_matrix(A, B))
    np.testing.assert_array_equal(observability_matrix(A, C[0]), observability_matrix(A, C))
    np.testing.assert_array_equal(controllability_gramian(A, B[:, 0], 1.0), controllability_gramian(A, B, 1.0))
    np.testing.assert_array_equal(observability_gramian(A, C[0], 1.0), observability_gramian(A, C, 1.0))


@rows("shape", SHAPES)
def test_rank_and_condition_are_numpys(shape):
    A, B, C = random_system(*shape)
    for found in (controllability(A, B), observability(A, C)):
        matrix = np.asarray(found.matrix)
        assert int(found.rank) == np.linalg.matrix_rank(matrix) == shape[0]
        assert found.rank.dtype == jnp.int32
        assert found.full
        assert float(found.condition) == pytest.approx(np.linalg.cond(matrix), rel=1e-9)
        np.testing.assert_allclose(found.singular_values, np.linalg.svd(matrix, compute_uv=False), rtol=1e-9)


@rows("plant", list(paper.PLANTS))
@rows("equilibrium", ["upright", "hanging"])
def test_the_papers_plants_are_controllable_and_observable_from_their_two_encoders(plant, equilibrium):
    A, B = papers_model(plant, equilibrium)
    assert controllability(A, B).full
    assert observability(A, POSITION_AND_ANGLE).full


def test_the_two_encoders_see_position_and_angle():
    state = State(*(jnp.asarray(v) for v in (1.0, 2.0, 3.0, 4.0)))
    np.testing.assert_array_equal(np.array(POSITION_AND_ANGLE) @ state.vector(), [state.x, state.theta])


def test_the_angle_alone_observes_no_cart_and_the_position_alone_everything():
    A, _ = papers_model()
    angle = observability(A, POSITION_AND_ANGLE[1])
    assert (int(angle.rank), bool(angle.full)) == (3, False)
    assert angle.condition > 1e15
    assert observability(A, POSITION_AND_ANGLE[0]).full


@rows(
    ("A", "B", "rank"),
    [
        (-np.eye(2), [1.0, 2.0], 1),  # two equal tanks
        (np.diag([-1.0, -2.0]), [1.0, 0.0], 1),  # a mode without an input
        ([[0.0, 1.0], [-2.0, -3.0]], [1.0, -1.0], 1),  # the input along an eigenvector: a pole is cancelled
        ([[0.0, 1.0], [-2.0, -3.0]], [0.0, 1.0], 2),  # companion form
        (np.diag([-1.0, -1.0, -2.0]), np.ones((3, 1)), 2),
        (np.diag([-1.0, -1.0, -2.0]), [[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]], 3),
        (np.diag([1.0, 2.0]), [0.0, 0.0], 0),
    ],
)
def test_textbook_pairs_have_their_textbook_rank_and_so_have_their_duals(A, B, rank):
    A, B = np.asarray(A), np.asarray(B)
    assert int(controllability(A, B).rank) == rank
    assert int(observability(A.T, B.T).rank) == rank
    if rank == 0:
        assert controllability(A, B).condition == math.inf


@rows("shape", FEW_SHAPES)
def test_infinite_gramians_of_a_stable_system_are_those_of_lyapunovs_equation(shape):
    A, B, C = stable_system(*shape)
    expected = solve_continuous_lyapunov(A, -B @ B.T), solve_continuous_lyapunov(A.T, -C.T @ C)
    for horizon in (None, math.inf):
        found = controllability_gramian(A, B, horizon), observability_gramian(A, C, horizon)
        for W, right in zip(found, expected, strict=True):
            np.testing.assert_allclose(W, right, rtol=1e-9, atol=1e-12 * np.max(np.abs(right)))


def by_quadrature(A, B, horizon):
    """The integral by Gauss's rule of 12 nodes on 40 pieces."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    times = horizon / 40 * (np.arange(40)[:, None] + 0.5 * (nodes + 1.0)).ravel()
    moved = expm(A * times[:, None, None]) @ B
    return np.einsum("t,tij,tkj->ik", np.tile(weights, 40) * horizon / 80, moved, moved)


def to_sixty_digits(A, B, horizon):
    """Van Loan's block exponential, with digits to spare for its cancellation."""
    with mpmath.workdps(60):
        block = np.block([[-A, B @ B.T], [np.zeros_like(A), A.T]]).astype(float)
        exponential = mpmath.expm(mpmath.matrix(block.tolist()) * horizon, method="taylor")
        n = len(A)
        W = exponential[n:, n:].T * exponential[:n, n:]
        return np.array(W.tolist(), dtype=float)


@rows("horizon", [1e-3, 0.3, 2.0, 8.0])
@rows("equilibrium", ["upright", "hanging"])
def test_the_gramians_of_the_papers_plant_over_a_horizon_are_their_integrals(equilibrium, horizon):
    A, B = papers_model(equilibrium=equilibrium)
    C = np.array(POSITION_AND_ANGLE)
    for found, right in (
        (controllability_gramian(A, B, horizon), by_quadrature(A, B, horizon)),
        (observability_gramian(A, C, horizon), by_quadrature(A.T, C.T, horizon)),
    ):
        sizes = np.sqrt(np.diag(right))
        assert np.max(np.abs(found - right) / np.outer(sizes, sizes)) <= 1e-11
        np.testing.assert_array_equal(found, found.T)


@rows("shape", FEW_SHAPES)
def test_the_gramians_of_random_systems_over_a_horizon_are_their_integrals(shape):
    A, B, C = random_system(*shape)
    for found, right in (
        (controllability_gramian(A, B, 3.0), by_quadrature(A, B, 3.0)),
        (observability_gramian(A, C, 3.0), by_quadrature(A.T, C.T, 3.0)),
    ):
        assert np.max(np.abs(found - right)) <= 1e-11 * np.max(np.abs(right))


@rows("rate", [-2.0, 0.0, 2.0, 3.0])
@rows("horizon", [1e-9, 1.0, 100.0])
def test_one_state_has_the_gramian_of_the_exponential_integral(rate, horizon):
    expected = math.expm1(2 * rate * horizon) / (2 * rate) if rate else horizon
    found = controllability_gramian([[rate]], [3.0], horizon)
    assert float(found[0, 0]) == pytest.approx(9.0 * expected, rel=1e-13)


@rows("horizon", [10.0, 1e3, 1e6])
def test_a_long_horizon_loses_nothing_of_a_stable_system(horizon):
    """The fast closed loop of the paper's LQR gain, up to 10^10 times its norm's inverse."""
    A, B = papers_model()
    A = A - B @ np.array([paper.PRINTED_GAINS["lqr"]])
    right = solve_continuous_lyapunov(A, -B @ B.T)
    sizes = np.sqrt(np.diag(right))
    found = controllability_gramian(A, B, horizon)
    assert np.max(np.abs(found - right) / np.outer(sizes, sizes)) <= 1e-9


def test_an_undamped_oscillator_keeps_its_digits_over_a_thousand_turns():
    """W = integral of (sin, cos)(sin, cos)'."""
    T = 1000 * math.tau + 1.0
    right = [[T / 2 - math.sin(2 * T) / 4, math.sin(T) ** 2 / 2], [math.sin(T) ** 2 / 2, T / 2 + math.sin(2 * T) / 4]]
    found = controllability_gramian([[0.0, 1.0], [-1.0, 0.0]], [0.0, 1.0], T)
    assert np.max(np.abs(found - np.array(right))) <= 1e-12 * T


def test_no_time_and_no_input_make_a_gramian_of_zeros():
    A, B = papers_model()
    np.testing.assert_array_equal(controllability_gramian(A, B, 0.0), np.zeros((4, 4)))
    np.testing.assert_array_equal(controllability_gramian(A, 0.0 * B, 1.0), np.zeros((4, 4)))


def test_the_gramian_gives_the_input_that_reaches_a_state_and_its_energy():
    A, B = papers_model()
    T, target = 1.5, np.array([0.3, -0.5, 0.1, 1.0])
    needed = np.linalg.solve(controllability_gramian(A, B, T), target)

    def field(t, s):
        u = B.T @ expm(A.T * (T - t)) @ needed
        return np.append(A @ s[:4] + B @ u, u @ u)

    reached = solve_ivp(field, (0.0, T), np.zeros(5), method="DOP853", rtol=1e-9, atol=1e-11).y[:, -1]
    np.testing.assert_allclose(reached[:4], target, rtol=1e-7, atol=1e-8)
    assert reached[4] == pytest.approx(target @ needed, rel=1e-8)


def test_the_observability_gramian_is_the_outputs_energy():
    A, _ = papers_model()
    C, start = np.array(POSITION_AND_ANGLE), np.array([0.3, -0.5, 0.1, 1.0])

    def field(t, s):
        return np.append(A @ s[:4], np.sum((C @ s[:4]) ** 2))

    energy = solve_ivp(field, (0.0, 1.5), [*start, 0.0], method="DOP853", rtol=1e-10, atol=1e-12).y[4, -1]
    assert float(start @ observability_gramian(A, C, 1.5) @ start) == pytest.approx(energy, rel=1e-8)


def difference_quotient(function, h):
    slopes = [(np.asarray(function(s)) - np.asarray(function(-s))) / (2 * s) for s in (h, h / 2)]
    return (4 * slopes[1] - slopes[0]) / 3


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [None, 1.5])
def test_a_gramians_derivative_agrees_forward_in_reverse_and_with_differences(horizon):
    A, B, _ = map(jnp.asarray, stable_system(4, 1, 1))
    rng = np.random.default_rng(8)
    direction = (jnp.asarray(rng.normal(size=(4, 4))), jnp.asarray(rng.normal(size=(4, 1))))
    weights = jnp.asarray(rng.normal(size=(4, 4)))

    @jax.jit
    def value(A, B):
        return jnp.sum(weights * controllability_gramian(A, B, horizon))

    gradient = jax.grad(value, argnums=(0, 1))
    ahead = jax.jvp(value, (A, B), direction)[1]
    back = sum(jnp.sum(g * d) for g, d in zip(gradient(A, B), direction, strict=True))
    assert float(back) == pytest.approx(float(ahead), rel=1e-11)
    differences = difference_quotient(lambda h: value(A + h * direction[0], B + h * direction[1]), 1e-3)
    assert float(differences) == pytest.approx(float(ahead), rel=1e-7)
    together = jax.vmap(gradient)(jnp.stack([A, A + 0.01]), jnp.stack([B, B - 0.01]))
    for found, alone in zip(together, gradient(A + 0.01, B - 0.01), strict=True):
        np.testing.assert_allclose(found[1], alone, rtol=1e-11, atol=1e-12)


@pytest.mark.slow
def test_the_gramian_grows_with_its_horizon_by_what_flows_in_at_the_end():
    A, B = papers_model()
    moved = expm(A * 0.7) @ B
    found = jax.jacfwd(lambda T: controllability_gramian(A, B, T))(0.7)
    np.testing.assert_allclose(found, moved @ moved.T, rtol=1e-11)
    np.testing.assert_allclose(jax.jacrev(lambda T: controllability_gramian(A, B, T))(0.7), found, rtol=1e-11)
    np.testing.assert_allclose(jax.jacfwd(lambda T: controllability_gramian(A, B, T))(0.0), B @ B.T, atol=1e-15)
    horizons = jnp.asarray([0.1, 0.7, 4.0])
    together = jax.vmap(lambda T: controllability_gramian(A, B, T))(horizons)
    for W, T in zip(together, horizons, strict=True):
        np.testing.assert_allclose(W, controllability_gramian(A, B, float(T)), rtol=1e-13)


def test_gradients_of_a_gramian_are_finite_where_a_further_doubling_would_overflow():
    gradient = jax.grad(lambda a: controllability_gramian(a, [1.0], 1.0)[0, 0])(jnp.asarray([[340.0]]))
    assert float(gradient[0, 0]) == pytest.approx(math.exp(680.0) / 340.0 * (1 - 1 / 680.0), rel=1e-11)


@pytest.mark.slow
def test_rank_conditioning_and_their_derivatives_survive_jit_and_vmap():
    A, B = papers_model()
    shifted = jnp.stack([A, A + 0.01])
    together = jax.jit(jax.vmap(lambda A: controllability(A, B)))(shifted)
    assert together.rank.tolist() == [4, 4]
    assert together.full.tolist() == [True, True]

    def condition(A):
        return controllability(A, B).condition

    gradient = jax.grad(condition)(shifted[1])
    np.testing.assert_allclose(jax.jacfwd(condition)(shifted[1]), gradient, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(jax.vmap(jax.grad(condition))(shifted)[1], gradient, rtol=1e-10, atol=1e-10)
    direction = np.random.default_rng(2).normal(size=(4, 4))
    differences = difference_quotient(lambda h: condition(shifted[1] + h * direction), 1e-3)
    assert float(differences) == pytest.approx(float(jnp.sum(gradient * direction)), rel=1e-6)


@rows("dtype", [jnp.float32, jnp.float64])
def test_a_gramians_error_is_a_few_roundings_per_norm_times_horizon_in_either_dtype(dtype):
    A, B = papers_model()
    for horizon in (0.5, 1.0, 2.0, 4.0):
        found = controllability_gramian(jnp.asarray(A, dtype=dtype), jnp.asarray(B, dtype=dtype), horizon)
        assert found.dtype == dtype
        right = to_sixty_digits(A, B, horizon)
        rounding = float(np.finfo(dtype).eps) * np.linalg.norm(A, 1) * horizon
        assert np.max(np.abs(np.asarray(found) - right)) <= 4 * rounding * np.max(right)


def test_in_float32_the_papers_plant_is_controllable_too():
    structure = controllability(*(jnp.asarray(m, dtype=jnp.float32) for m in papers_model()))
    assert structure.condition.dtype == jnp.float32
    assert structure.full


@rows("gramian", GRAMIANS)
def test_an_unstable_system_has_no_gramian_for_all_time(gramian):
    A, B = papers_model()
    matrix = B if gramian is controllability_gramian else B.T
    with pytest.raises(InputError, match="horizon"):
        gramian(A, matrix)
    assert np.all(np.isnan(jax.jit(gramian)(A, matrix)))


@rows("horizon", [-1.0, math.nan, "long", np.ones(2), True])
def test_a_horizon_that_is_none_is_refused_by_name(horizon):
    with pytest.raises(InputError) as refusal:
        controllability_gramian(*papers_model(), horizon)
    assert refusal.value.field == "horizon"


@rows("function", [controllability, controllability_matrix, controllability_gramian])
@rows(
    ("field", "A", "B"),
    [("A", np.ones((2, 3)), np.ones(2)), ("B", np.eye(2), np.ones(3)), ("B", np.eye(2), np.ones((2, 0)))],
)
def test_inputs_that_do_not_fit_are_refused_by_name(function, field, A, B):
    with pytest.raises(InputError) as refusal:
        function(A, B)
    assert refusal.value.field == field


@rows("function", [observability, observability_matrix, observability_gramian])
@rows(
    ("field", "A", "C"),
    [("A", np.ones((2, 3)), np.ones(2)), ("C", np.eye(2), np.ones((3, 1))), ("C", np.eye(2), np.ones((0, 2)))],
)
def test_outputs_that_do_not_fit_are_refused_by_name(function, field, A, C):
    with pytest.raises(InputError) as refusal:
        function(A, C)
    assert refusal.value.field == field
