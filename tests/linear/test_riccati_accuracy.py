"""Against fifty digits, cpjax's Riccati solvers are nowhere ten times less accurate than SciPy's."""

import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from cpjax.linear.riccati import care, dare

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
SOLVERS = {"care": jax.jit(care), "dare": jax.jit(dare)}
FEW_SHAPES = ((2, 1), (4, 1), (6, 3))  # because each is compiled

both = pytest.mark.parametrize("equation", ["care", "dare"])


@pytest.fixture(scope="module")
def systems():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXPERIMENTS))
        yield importlib.import_module("_riccati_systems")


def beyond_ten_times_scipys(systems, equation, chosen):
    """Names, errors and SciPy's errors of the systems on which cpjax fails or loses."""
    lost = []
    for system in chosen:
        right = systems.reference(equation, system)
        found = SOLVERS[equation](*(jnp.asarray(matrix) for matrix in system[2:]))
        solutions = np.asarray(found), systems.scipy_solution(equation, system)
        errors = [systems.relative_error(P, right) for P in solutions]
        if not systems.ratio(*errors) <= 10.0:
            lost.append((system.name, *errors))
    return lost


@pytest.mark.slow
@both
def test_on_few_systems_the_error_is_at_most_ten_times_scipys(systems, equation):
    special = [system for system in systems.special_systems(equation) if system.B.shape == (4, 1)]
    chosen = systems.random_systems(equation, 20, shapes=FEW_SHAPES) + special
    assert len(chosen) >= 28
    assert beyond_ten_times_scipys(systems, equation, chosen) == []


@pytest.mark.slow
@both
def test_on_a_thousand_systems_the_error_is_at_most_ten_times_scipys(systems, equation):
    chosen = systems.random_systems(equation, 1000) + systems.special_systems(equation)
    assert beyond_ten_times_scipys(systems, equation, chosen) == []


def test_the_reference_has_the_gain_of_six_integrators_with_poles_at_minus_two(systems):
    [chain] = [s for s in systems.special_systems("care") if s.name == "closed-loop pole of order six"]
    found = systems.gain("care", chain, systems.reference("care", chain))
    expected = np.array([[64.0, 192.0, 240.0, 160.0, 60.0, 12.0]])  # (s + 2)^6
    assert systems.relative_error(expected, found) <= 1e-50


@both
def test_the_reference_of_a_scalar_equation_is_the_positive_root_of_its_quadratic(systems, equation):
    a, b, q, r = 1.3, -0.7, 2.1, 0.3
    system = systems.System("", "", *(np.array([[number]]) for number in (a, b, q, r)))
    with mpmath.workdps(60):
        a, b, q, r = (mpmath.mpf(number) for number in (a, b, q, r))
        # b^2 p^2 - 2 a r p - q r = 0,   b^2 p^2 + (r - a^2 r - b^2 q) p - q r = 0
        half = -a * r if equation == "care" else (r - a * a * r - b * b * q) / 2
        p = (-half + mpmath.sqrt(half * half + b * b * q * r)) / (b * b)
        assert abs(systems.reference(equation, system)[0, 0] / p - 1) <= 1e-50


@both
def test_every_reference_solution_is_symmetric_and_stabilising(systems, equation):
    for system in systems.random_systems(equation, 6, seed=2):
        P = systems.reference(equation, system)
        assert (P == P.T).all()
        loop = system.A - system.B @ systems.gain(equation, system, P).astype(np.float64)
        poles = np.linalg.eigvals(loop)
        assert np.max(poles.real) < 0 if equation == "care" else np.max(np.abs(poles)) < 1


@both
def test_newtons_correction_takes_back_an_error_in_the_fortieth_digit(systems, equation):
    [system] = systems.random_systems(equation, 1, shapes=[(4, 2)])
    P = systems.reference(equation, system)
    with mpmath.workdps(100):
        error = systems.exact(np.diag([1.0, 2.0, 3.0, 4.0])) * mpmath.mpf(10) ** -40
        found = systems.newton_correction(equation, system, P + error)
    assert systems.relative_error((found * mpmath.mpf(10) ** 40).astype(np.float64), -error * 10**40) <= 1e-15


@both
def test_a_solution_that_does_not_stabilise_is_no_reference(systems, equation):
    system = systems.System("", "", np.diag([2.0, -0.5]), np.eye(2), np.zeros((2, 2)), np.eye(2))
    with pytest.raises(ArithmeticError, match="not stable"):
        systems.newton_correction(equation, system, systems.exact(np.zeros((2, 2))))


@both
def test_few_random_systems_are_the_first_of_many(systems, equation):
    few, many = systems.random_systems(equation, 3), systems.random_systems(equation, 30)
    for one, other in zip(few, many, strict=False):
        assert one[:2] == other[:2]
        assert all(np.array_equal(*pair) for pair in zip(one[2:], other[2:], strict=True))


@both
def test_every_system_is_of_exact_numbers_with_symmetric_weights(systems, equation):
    for system in systems.random_systems(equation, 42) + systems.special_systems(equation):
        n, m = system.B.shape
        assert [matrix.shape for matrix in system[2:]] == [(n, n), (n, m), (n, n), (m, m)]
        assert {matrix.dtype for matrix in system[2:]} == {np.dtype(np.float64)}
        assert np.array_equal(system.Q, system.Q.T)
        assert np.array_equal(system.R, system.R.T)
        assert all(np.array_equal(matrix, matrix.astype(np.float32)) for matrix in system.rounded()[2:])
