"""Gains judged by the characteristic polynomial in fifty digits, by SciPy and by python-control; their derivatives."""

import control
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax import lax
from oracles import jacobian, relative_error
from scipy.linalg import expm
from scipy.signal import place_poles
from tables import rows

from cpjax import InputError, linearize, paper
from cpjax.linear.placement import QuadraticFactors, place, place_polynomial, polynomial_from_poles
from cpjax.linear.several_inputs import pole_directions

A, B = (np.asarray(matrix) for matrix in linearize(paper.appendix_plant()))
POLES = np.array(paper.POLES)
placed = jax.jit(jax.vmap(place_polynomial))


def exact(x):
    """Floats as mpmath's numbers, with nothing lost."""
    return np.vectorize(mpmath.mpf, otypes=[object])(np.asarray(x, dtype=np.float64))


def characteristic_polynomial(A, B, K):
    """Of A - B K, without its leading 1, as an array of mpmath numbers (Faddeev and LeVerrier)."""
    with mpmath.workdps(50):
        closed, adjugate, coefficients = exact(A) - exact(B) @ exact(K), exact(np.eye(len(A))), []
        for k in range(1, len(A) + 1):
            product = closed @ adjugate
            coefficients.append(-np.trace(product) / k)
            adjugate = product + coefficients[-1] * exact(np.eye(len(A)))
    return np.array(coefficients)


def polynomial(poles):
    """The coefficients of the poles' polynomial, as mpmath numbers."""
    with mpmath.workdps(50):
        whole = [mpmath.mpf(1)]
        for pole in poles:
            pole = mpmath.mpc(complex(pole))
            whole = [x - pole * y for x, y in zip([*whole, 0], [0, *whole], strict=True)]
        return np.array([mpmath.re(c) for c in whole[1:]])


def backward_error(A, B, K, poles):
    """The largest relative error of a coefficient."""
    right = polynomial(poles)
    return max(abs(float(x / y - 1)) for x, y in zip(characteristic_polynomial(A, B, K), right, strict=True))


def pole_sets(n, rng):
    """All equal, equal in pairs, clustered, distinct, and complex pairs on top of each other."""
    pair = rng.uniform(-4.0, -1.0) + 1j * rng.uniform(0.5, 3.0)
    return {
        "all equal": np.full(n, -2.0),
        "equal in pairs": -np.repeat(rng.uniform(1.0, 5.0, (n + 1) // 2), 2)[:n],
        "clustered": -3.0 - 1e-6 * rng.uniform(size=n),
        "distinct": -rng.uniform(0.5, 8.0, n),
        "double complex pairs": np.array([pair, pair.conjugate()] * (n // 2) + [-1.0] * (n % 2)),
    }


def test_the_appendix_plant_has_the_gain_that_follows_from_the_printed_poles():
    K = place(A, B, POLES)
    assert K.shape == (1, 4)
    np.testing.assert_allclose(K[0], [-25.688, -25.404, 115.997, 29.683], rtol=0, atol=5e-4)
    assert relative_error(K, place_poles(A, B, POLES).gain_matrix) <= 1e-8
    assert relative_error(K, control.place(A, B, POLES)) <= 1e-8
    assert relative_error(K, control.acker(A, B, POLES)) <= 1e-8


@pytest.mark.parametrize("n", [4, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3, 5, 6, 7, 8))])
def test_the_closed_loop_has_the_wanted_polynomial_however_the_poles_lie(n):
    rng = np.random.default_rng(n)
    cases = [
        (rng.normal(size=(n, n)), rng.normal(size=(n, 1)), poles)
        for _ in range(4)
        for poles in pole_sets(n, rng).values()
    ]
    given = [(a, b, polynomial(poles).astype(np.float64)) for a, b, poles in cases]
    gains = placed(*(jnp.asarray(np.stack(x)) for x in zip(*given, strict=True)))
    errors = [backward_error(a, b, K, poles) for (a, b, poles), K in zip(cases, gains, strict=True)]
    assert max(errors) <= 1e-10


@rows("name", pole_sets(4, np.random.default_rng(0)))
def test_poles_of_the_paper_plant_are_placed_wherever_they_lie(name):
    poles = pole_sets(4, np.random.default_rng(0))[name]
    K = place(A, B, poles)
    assert backward_error(A, B, K, poles) <= 1e-13
    # python-control takes no poles but those of a quotient that it can invert; its own digits are fewer.
    assert relative_error(K, control.acker(A, B, poles)) <= 1e-9


@rows("n", [2, 3, 4])
def test_distinct_poles_are_placed_as_scipy_places_them(n):
    rng = np.random.default_rng(20 + n)
    for _ in range(5):
        a, b, poles = (
            rng.normal(size=(n, n)),
            rng.normal(size=(n, 1)),
            -np.linspace(1.0, 4.0, n) - rng.uniform(size=n) / 4,
        )
        assert relative_error(place(a, b, poles), place_poles(a, b, poles).gain_matrix) <= 1e-8


SEVERAL = [(4, 2), (5, 3), (3, 3)]


@rows(("n", "m"), SEVERAL)
def test_poles_are_placed_by_several_inputs_as_python_control_places_them(n, m):
    rng = np.random.default_rng(10 * n + m)
    a, b = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    for poles in (np.array([-1.5 + 2j, -1.5 - 2j, -3.0, -3.0, -4.0][:n]), -np.linspace(1.0, 4.0, n)):
        K = place(a, b, poles)
        assert K.shape == (m, n)
        found = np.poly(a - b @ np.asarray(K))
        np.testing.assert_allclose(found, np.poly(poles).real, rtol=1e-9)
        assert relative_error(K, control.place(a, b, poles)) <= 1e-9
        # A pole that has come twice may be found as a pair, and its eigenvectors are any of a plane.
        again = place(a, b, poles, directions=pole_directions(a, b, poles))
        np.testing.assert_allclose(np.poly(a - b @ np.asarray(again)), found, rtol=1e-6)
    assert np.max(np.abs(np.sort(np.linalg.eigvals(a - b @ np.asarray(K)).real) - np.sort(poles))) <= 1e-9
    assert relative_error(again, K) <= 1e-9


def test_an_observer_of_two_outputs_is_the_transposed_problem():
    a, c = expm(0.01 * A), np.eye(4)[[0, 2]]
    poles = np.exp(-0.01 * np.array([20.0, 22.0, 25.0, 30.0]))
    L = np.asarray(place(a.T, c.T, poles)).T
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(a - L @ c)), np.sort(poles), rtol=1e-9)


def test_with_directions_the_gain_of_several_inputs_has_derivatives():
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    poles = jnp.array([-1.5 + 2j, -1.5 - 2j, -3.0, -4.0])
    G = pole_directions(a, b, poles)

    def gain(x):
        moved = lax.complex(x[jnp.array([0, 0, 2, 3])], jnp.stack([x[1], -x[1], 0.0 * x[2], 0.0 * x[3]]))
        return place(x[4:20].reshape(4, 4), x[20:].reshape(4, 2), moved, directions=G).ravel()

    x = jnp.concatenate([jnp.array([-1.5, 2.0, -3.0, -4.0]), a.ravel(), b.ravel()])
    expected = jacobian(jax.jit(jax.vmap(gain)), x, 1e-3)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(gain))(x), expected, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(jax.jit(jax.jacrev(gain))(x), expected, rtol=1e-7, atol=1e-7)


@rows(
    ("field", "arguments"),
    [
        ("poles", (A, np.eye(4)[:, :2], [-3.0, -3.0, -3.0, -4.0])),
        ("directions", (A, B, POLES, np.ones((1, 4)))),
        ("directions", (A, np.eye(4)[:, :2], POLES, np.ones((1, 4)))),
        ("B", (np.diag([1.0, 2.0, 3.0, 4.0]), np.eye(4)[:, :2], POLES)),
    ],
)
def test_what_several_inputs_cannot_place_is_refused(field, arguments):
    with pytest.raises(InputError) as caught:
        place(*arguments)
    assert caught.value.field == field


def test_the_search_for_a_robust_gain_is_refused_inside_jit():
    with pytest.raises(InputError, match="directions"):
        jax.jit(place)(A, np.eye(4)[:, :2], POLES)


def test_order_dtype_and_container_of_the_poles_do_not_matter():
    expected = place(A, B, POLES)
    for poles in (
        paper.POLES,
        [-3, -4, -5, -6],
        [-6.0, -3.0, -5.0, -4.0],
        POLES.astype(int),
        POLES.astype(np.float32),
        POLES.astype(np.complex64),
        POLES.astype(np.complex128),
        jnp.asarray(POLES),
        jnp.asarray(POLES, dtype=jnp.complex128),
    ):
        found = place(A, B, poles)
        assert found.dtype == jnp.float64
        np.testing.assert_allclose(found, expected, rtol=1e-14)
    np.testing.assert_array_equal(place(A, B[:, 0], POLES), expected)
    np.testing.assert_array_equal(place(A.tolist(), B.tolist(), POLES), expected)
    np.testing.assert_array_equal(place_polynomial(A, B, polynomial_from_poles(POLES)), expected)


@rows("poles", [POLES, np.full(4, -4.0), np.array([-3 + 2j, -3 - 2j, -3 + 2j, -3 - 2j])])
def test_float32_arguments_give_a_float32_gain_to_its_rounding(poles):
    narrow = [x.astype(np.float32) for x in (A, B)]
    K = place(*narrow, poles)
    assert K.dtype == jnp.float32
    assert relative_error(K, place(*(x.astype(np.float64) for x in narrow), poles)) <= 2e-7
    assert place(narrow[0], B, poles).dtype == jnp.float64


@pytest.mark.slow
def test_one_state_and_chains_of_integrators_have_the_gains_of_the_textbook():
    np.testing.assert_array_equal(place([[2.0]], [3.0], [-1.0]), [[1.0]])
    np.testing.assert_array_equal(place(np.eye(5, k=1), np.eye(5)[:, 4], [-1.0] * 5), [[1.0, 5.0, 10.0, 10.0, 5.0]])
    np.testing.assert_array_equal(place(np.eye(3, k=1), np.eye(3)[:, 2], [0.0] * 3), [[0.0, 0.0, 0.0]])


def test_the_states_units_do_not_matter():
    units = np.array([2.0**20, 2.0**-10, 2.0**10, 2.0**-20])
    K = place(units[:, None] * A / units, units[:, None] * B, POLES)
    np.testing.assert_allclose(K * units, place(A, B, POLES), rtol=1e-15)


# --- what is refused --------------------------------------------------------------------------------------------------


UNCONTROLLABLE = {
    "an unmoved mode": (np.diag([1.0, 2.0, 3.0]), np.array([0.0, 1.0, 1.0])),
    "no input": (np.diag([1.0, 2.0, 3.0]), np.zeros(3)),
    "two equal modes": (np.diag([1.0, 1.0, 3.0]), np.ones(3)),
    "two decoupled halves": (np.eye(3, k=1), np.array([0.0, 1.0, 0.0])),
}


def rotated(count, seed):
    """Uncontrollable pairs that rounding makes controllable by a hair."""
    rng = np.random.default_rng(seed)
    turns = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    modes = rng.uniform(-3.0, 3.0, size=(count, 3))
    return turns * modes[:, None] @ np.swapaxes(turns, 1, 2), turns @ np.array([[0.0], [1.0], [1.0]])


@rows("name", UNCONTROLLABLE)
def test_a_pair_that_is_not_controllable_is_refused(name):
    with pytest.raises(InputError, match="controllable") as caught:
        place(*UNCONTROLLABLE[name], [-1.0, -2.0, -3.0])
    assert caught.value.field == "B"


def test_a_pair_that_is_not_controllable_spoils_no_other_lane():
    good = (A[1:, 1:], B[1:, 0])
    pairs = [good, *UNCONTROLLABLE.values(), good]
    c = jnp.asarray(np.stack([np.poly([-1.0, -2.0, -3.0])[1:]] * len(pairs)))
    K = placed(*(jnp.asarray(np.stack(x)) for x in zip(*pairs, strict=True)), c)
    assert np.all(np.isnan(K[1:-1]))
    np.testing.assert_allclose(K[jnp.asarray([0, -1])], jnp.stack([place(*good, [-1.0, -2.0, -3.0])] * 2), rtol=1e-15)


def test_a_pair_whose_controllability_is_rounding_is_refused_in_any_coordinates():
    a, b = rotated(300, seed=4)
    c = jnp.asarray(np.broadcast_to(np.poly([-1.0, -2.0, -3.0])[1:], (300, 3)))
    assert np.all(np.isnan(placed(jnp.asarray(a), jnp.asarray(b), c)))


BAD_POLES = {
    "a pole without its conjugate": [-3.0 + 1j, -4.0, -5.0, -6.0],
    "one of a pair twice": [-3.0 + 1j, -3.0 + 1j, -4.0, -5.0],
    "pairs that do not match": [-3.0 + 1j, -3.0 - 2j, -4.0, -5.0],
    "three": [-1.0, -2.0, -3.0],
    "five": [-1.0] * 5,
    "none": [],
    "one number": -1.0,
    "rows": [[-1.0, -2.0], [-3.0, -4.0]],
    "not a number": [np.nan, -1.0, -2.0, -3.0],
    "infinite": [-np.inf, -1.0, -2.0, -3.0],
    "words": ["a", "b", "c", "d"],
    "a word": "abcd",
    "digits in words": ["1", "2", "3", "4"],
    "an array of words": np.array(["a", "b", "c", "d"]),
    "nothing": None,
    "four nothings": [None] * 4,
    "truth values": [True, False, True, True],
    "too large": [-1e200] * 4,
}


@rows("name", BAD_POLES)
def test_what_is_no_set_of_four_poles_is_refused(name):
    with pytest.raises(InputError) as caught:
        place(A, B, BAD_POLES[name])
    assert caught.value.field == "poles"


@rows(
    ("field", "arguments"),
    [
        ("A", (A[:3], B, POLES)),
        ("A", (A[None], B, POLES)),
        ("A", (A * np.nan, B, POLES)),
        ("A", ("A", B, POLES)),
        ("B", (A, np.ones((4, 2)), POLES)),
        ("B", (A, B.T, POLES)),
        ("B", (A, B[:3], POLES)),
        ("B", (A, 1j * B, POLES)),
    ],
)
def test_matrices_that_do_not_fit_are_refused(field, arguments):
    with pytest.raises(InputError) as caught:
        place(*arguments)
    assert caught.value.field == field


@rows("coefficients", [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0, np.nan], [1.0, 2.0, 3.0, 1j], ["a"] * 4, 1.0])
def test_coefficients_that_do_not_fit_are_refused(coefficients):
    with pytest.raises(InputError) as caught:
        place_polynomial(A, B, coefficients)
    assert caught.value.field == "coefficients"


def test_inside_jit_unpaired_poles_give_nan_and_paired_ones_a_gain():
    compiled = jax.jit(place)
    paired, unpaired = jnp.asarray([-3 + 1j, -3 - 1j, -4, -5]), jnp.asarray([-3 + 1j, -3 + 1j, -4, -5])
    np.testing.assert_allclose(compiled(A, B, paired), place(A, B, paired), rtol=1e-15)
    assert np.all(np.isnan(compiled(A, B, unpaired)))


# --- derivatives ------------------------------------------------------------------------------------------------------


def gain(x, n):
    """K of A, B and the coefficients in one vector."""
    return place_polynomial(*parts(x, n))[0]


def parts(x, n):
    return x[: n * n].reshape(n, n), x[n * n : n * n + n].reshape(n, 1), x[n * n + n :]


def vector(a, b, poles):
    return np.concatenate([a.ravel(), b.ravel(), np.poly(poles)[1:]])


def controllable_systems(n, count, seed):
    """Random ones whose controllability matrices are not far from regular: differences need some room."""
    rng = np.random.default_rng(seed)
    while count:
        a, b = rng.normal(size=(n, n)) / n**0.5, rng.normal(size=(n, 1))
        if np.linalg.cond(control.ctrb(a, b)) < 30 * n:
            count -= 1
            yield a, b


def points(n):
    """Three systems: with distinct, with double and with n-fold poles."""
    sets = (-np.arange(1.0, n + 1), -np.repeat(np.arange(1.0, n), 2)[:n], np.full(n, -1.5))
    return np.stack([vector(a, b, p) for (a, b), p in zip(controllable_systems(n, 3, seed=n), sets, strict=True)])


def functions(gain):
    """Of batches: the gain, and its Jacobians forward and in reverse."""
    jacobians = jax.jit(jax.vmap(lambda x: (jax.jacfwd(gain)(x), jax.jacrev(gain)(x))))
    return jax.jit(jax.vmap(gain)), jacobians


@pytest.mark.slow
def test_all_derivatives_agree_with_differences_at_multiple_poles_too():
    n, x = 3, points(3)
    batched, jacobians = functions(lambda x: gain(x, 3))
    forward, reverse = jacobians(jnp.asarray(x))
    for i, point in enumerate(x):
        differences = jacobian(batched, point, 1e-3, levels=4)
        for part in np.split(np.arange(point.size), [n * n, n * n + n]):
            assert relative_error(forward[i][:, part], differences[:, part]) <= 1e-10
            assert relative_error(reverse[i][:, part], forward[i][:, part]) <= 1e-12


def exact_gain(x, n):
    """Ackermann's formula on mpmath's numbers."""
    a, b, c = parts(x, n)
    columns = [b]
    for _ in range(n - 1):
        columns.append(a @ columns[-1])
    matrix = mpmath.matrix(np.hstack(columns).T.tolist())
    w = np.array(mpmath.lu_solve(matrix, mpmath.matrix([0] * (n - 1) + [1])).tolist()).T
    K = w
    for coefficient in c:
        K = K @ a + coefficient * w
    return K[0]


@pytest.mark.parametrize("n", [4, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3, 5, 6))])
def test_derivatives_have_eight_digits_where_the_condition_is_below_a_million(n):
    rng = np.random.default_rng(n)
    x = np.stack([vector(rng.normal(size=(n, n)), rng.normal(size=(n, 1)), -np.arange(1.0, n + 1)) for _ in range(12)])
    masks = np.stack([np.repeat(mask, [n * n, n, n]) for mask in np.eye(3)])
    directions = rng.normal(size=x.shape)[:, None] * masks * np.maximum(np.abs(x), 0.1)[:, None]

    def derivatives(x, directions):
        K, pushed = jax.vmap(lambda d: jax.jvp(lambda x: gain(x, n), (x,), (d,)), out_axes=(None, 0))(directions)
        return K, pushed

    K, pushed = jax.jit(jax.vmap(derivatives))(jnp.asarray(x), jnp.asarray(directions))
    errors, allowed = [], []
    with mpmath.workdps(70):
        step = mpmath.mpf(10) ** -25
        for i, point in enumerate(x):
            a, b, _ = parts(point, n)
            condition = np.linalg.cond(np.linalg.eig(a - b @ np.asarray(K[i])[None])[1])
            allowed.append(1e-8 * max(1.0, condition / 1e6))
            for direction, found in zip(directions[i], pushed[i], strict=True):
                ends = [exact_gain(exact(point) + side * step * exact(direction), n) for side in (1, -1)]
                errors.append(relative_error(found, ((ends[0] - ends[1]) / (2 * step)).astype(np.float64)))
    errors = np.max(np.reshape(errors, (-1, 3)), axis=1)
    assert np.all(errors <= allowed), np.max(errors / allowed)


@pytest.mark.slow
def test_the_papers_gain_has_the_derivatives_of_differences_under_vmap_too():
    sets = np.stack([POLES, np.full(4, -4.0), [-3.0, -3.0, -5.0, -5.0]])
    x = np.stack([vector(A, B, p) for p in sets])
    steps = np.concatenate([np.full(20, 2e-3), 1e-2 * np.poly(POLES)[1:]])
    single = jax.jit(jax.jacrev(lambda x: gain(x, 4)))
    batched, jacobians = functions(lambda x: gain(x, 4))
    forward, reverse = jacobians(jnp.asarray(x))
    for i, point in enumerate(x):
        differences = jacobian(batched, point, steps)
        for part in np.split(np.arange(24), [16, 20]):
            assert relative_error(forward[i][:, part], differences[:, part]) <= 1e-9
        assert relative_error(reverse[i], forward[i]) <= 1e-12
        assert relative_error(single(jnp.asarray(point)), reverse[i]) <= 1e-13


@pytest.mark.slow
def test_the_second_derivatives_are_the_differences_of_the_first():
    x = points(3)[2]

    def scalar(x):
        return gain(x, 3) @ jnp.asarray([1.0, -2.0, 0.5])

    hessian = jax.jit(jax.hessian(scalar))(jnp.asarray(x))
    differences = jacobian(jax.jit(jax.vmap(jax.grad(scalar))), x, 4e-3, levels=4)
    assert relative_error(hessian, differences) <= 1e-8
    assert relative_error(hessian, hessian.T) <= 1e-11
    assert np.max(np.abs(hessian[-3:, -3:])) <= 1e-10 * np.max(np.abs(hessian))  # K is linear in the coefficients


@pytest.mark.slow
def test_the_gain_moves_smoothly_with_poles_that_meet():
    derivative = jax.jit(jax.vmap(jax.jacfwd(lambda p: place(A, B, p)[0])))
    batched = jax.jit(jax.vmap(lambda p: place(A, B, p)[0]))
    p = np.array([-3.0, -3.0, -4.0, -4.0])
    found = derivative(jnp.asarray(p)[None])[0]
    assert relative_error(found, jacobian(batched, p, 0.05)) <= 1e-10
    np.testing.assert_allclose(found[:, 0], found[:, 1], rtol=1e-13)


def through_factors(x):
    return place_polynomial(A, B, QuadraticFactors.from_unconstrained(x).polynomial())[0]


@pytest.mark.slow
def test_the_gain_is_smooth_where_two_real_poles_become_a_complex_pair():
    meeting = QuadraticFactors(*(jnp.asarray(v) for v in ([4.0, 7.0], [4.0, 12.0], np.zeros(0)))).unconstrained()
    np.testing.assert_allclose(QuadraticFactors.from_unconstrained(meeting).poles(), [-2, -3, -2, -4], atol=1e-7)
    x = np.asarray(meeting)
    apart = x + 1e-3 * np.array([[0, 0, -1, 0], [0, 0, 1, 0]])  # b a little below, where poles are real, and above
    kinds = [np.sum(np.iscomplex(QuadraticFactors.from_unconstrained(jnp.asarray(v)).poles())) for v in apart]
    assert kinds == [0, 2]

    batched, jacobians = functions(through_factors)
    every = jnp.asarray(np.stack([x, *apart]))
    forward, reverse = jacobians(every)
    for i, point in enumerate(every):
        assert relative_error(forward[i], jacobian(batched, point, 0.05)) <= 1e-9
        assert relative_error(reverse[i], forward[i]) <= 1e-13
    # Across the point, value and derivative change by the same power series on either side.
    values = batched(every)
    for side in (1, 2):
        step = np.asarray(every[side] - every[0])
        predicted = values[0] + 0.5 * (forward[0] + forward[side]) @ step
        assert relative_error(values[side], predicted) <= 1e-9


# --- quadratic factors ------------------------------------------------------------------------------------------------


STABLE = {
    "one": [-2.0],
    "two real": [-1.0, -5.0],
    "a pair": [-1.0 + 2.0j, -1.0 - 2.0j],
    "two equal": [-3.0, -3.0],
    "odd": [-1.0 + 2.0j, -1.0 - 2.0j, -4.0],
    "odd and real": [-1.0, -2.0, -3.0, -4.0, -5.0],
    "double pairs": [-1.0 + 2.0j, -1.0 - 2.0j, -1.0 + 2.0j, -1.0 - 2.0j, -7.0],
    "slow and fast": [-1e-9, -1e9],
    "hardly damped": [-1e-6 + 10.0j, -1e-6 - 10.0j, -2.0],
}


@rows("name", STABLE)
def test_poles_become_factors_and_factors_the_poles(name):
    poles = np.array(STABLE[name])
    factors = QuadraticFactors.from_poles(poles)
    assert [part.shape[0] for part in factors] == [len(poles) // 2, len(poles) // 2, len(poles) % 2]
    assert all(np.all(np.asarray(part) > 0) for part in factors)
    np.testing.assert_allclose(factors.polynomial(), polynomial(poles).astype(np.float64), rtol=1e-14)
    np.testing.assert_allclose(factors.polynomial(), polynomial_from_poles(poles), rtol=1e-14)
    # A double pole is known to the root of what its polynomial is known to.
    slack = 1e-7 if len(set(STABLE[name])) < len(poles) else 1e-13
    np.testing.assert_allclose(np.sort_complex(factors.poles()), np.sort_complex(poles), rtol=slack)
    back = QuadraticFactors.from_unconstrained(factors.unconstrained())
    for part, other in zip(back, factors, strict=True):
        np.testing.assert_allclose(part, other, rtol=1e-14)


@rows("n", [1, 4, 5])
def test_any_vector_makes_a_stable_polynomial(n):
    x = jnp.asarray(np.random.default_rng(n).normal(size=(50, n)))
    coefficients, poles = jax.jit(
        jax.vmap(lambda x: (lambda f: (f.polynomial(), f.poles()))(QuadraticFactors.from_unconstrained(x)))
    )(x)
    assert coefficients.shape == poles.shape == (50, n)
    for c, p in zip(np.asarray(coefficients), np.asarray(poles), strict=True):
        assert np.all(p.real < 0)
        np.testing.assert_allclose(np.poly(p)[1:].real, c, rtol=1e-12)


def test_factors_keep_the_dtype_of_the_vector():
    factors = QuadraticFactors.from_unconstrained(jnp.asarray([0.1, 0.2, 0.3], dtype=jnp.float32))
    assert {part.dtype for part in factors} == {jnp.dtype(jnp.float32)}
    assert (factors.polynomial().dtype, factors.poles().dtype) == (jnp.float32, jnp.complex64)
    assert factors.unconstrained().dtype == jnp.float32


@rows(
    "poles",
    [
        [-1.0, 2.0],
        [0.0, -1.0],
        [1j, -1j],
        [-1.0 + 1j, -1.0 + 2j],
        [-1.0 + 1e-8j, -1.0],
        [],
        "ab",
        [np.nan],
    ],
)
def test_poles_that_are_not_stable_or_not_paired_have_no_factors(poles):
    with pytest.raises(InputError) as caught:
        QuadraticFactors.from_poles(poles)
    assert caught.value.field == "poles"
