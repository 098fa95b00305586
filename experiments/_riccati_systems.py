"""Riccati equations to test solvers with, and their stabilising solutions to more than fifty digits.

The reference is computed by doubling in mpmath, at a hundred digits and from nothing but the data. However it was
found, it is accepted only if Newton's next correction is below 1e-50 of it and its closed loop is stable, and there is
one stabilising solution. Every number in a system is an exact float64, and every Q and R exactly symmetric.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg

import cpjax
from cpjax import paper

Equation: TypeAlias = Literal["care", "dare"]
Matrix: TypeAlias = np.ndarray[Any, Any]

SHAPES = tuple((n, m) for n in range(2, 9) for m in range(1, 4))
"""Numbers of states and inputs of the random systems."""

UNIT = 2.0**-53
"""What rounding alone may cost a relative error."""

_DIGITS = 100  # carried, so that a condition number of 1e20 still leaves the reference more than enough
_ACCEPTED = 1e-50


class System(NamedTuple):
    """s' = A s + B u, or s+ = A s + B u, with the cost of s' Q s + u' R u."""

    name: str
    kind: str
    """Systems of one kind share a row of a table."""
    A: Matrix
    B: Matrix
    Q: Matrix
    R: Matrix

    def rounded(self) -> "System":
        """The nearest system of float32 numbers, still held in float64."""
        return self._replace(**{key: getattr(self, key).astype(np.float32).astype(np.float64) for key in "ABQR"})


def random_systems(
    equation: Equation, count: int, seed: int = 1, shapes: Sequence[tuple[int, int]] = SHAPES
) -> list[System]:
    """Stabilisable and detectable systems: stable and unstable, with Q of any rank.

    A third of them have a stable mode that is not controllable or not observable, and a sixth of the discrete ones a
    singular A. Their number does not change them: the few are the first of the many.
    """
    return [_random_system(equation, seed, index, *shapes[index % len(shapes)]) for index in range(count)]


def _random_system(equation: Equation, seed: int, index: int, n: int, m: int) -> System:
    rng = np.random.default_rng([seed, equation == "dare", index])
    while True:
        A = rng.standard_normal((n, n)) / math.sqrt(n)
        B = rng.standard_normal((n, m))
        # Multiples of 1/64, so that C' C is exact, its rank included, even in float32.
        C = np.round(64 * rng.standard_normal((rng.integers(1, n + 1), n))) / 64
        if equation == "care":
            A = 10 ** rng.uniform(-1, 1) * (A - rng.choice([0.0, 1.5]) * np.eye(n))
            stable = -np.abs(A).max() * rng.uniform(0.1, 1)
        else:
            radius = np.abs(np.linalg.eigvals(A)).max()
            A *= rng.choice([0.3, 0.9, 1.0, 1.1, 2.0, 5.0]) / radius
            stable = rng.uniform(-0.9, 0.9)
        flaw = rng.integers(6)
        if flaw == 0:
            A[-1], B[-1], A[-1, -1] = 0, 0, stable  # not controllable
        elif flaw == 1:
            A[:, 0], C[:, 0], A[0, 0] = 0, 0, stable  # not observable
        elif flaw == 2 and equation == "dare":
            A[:, : rng.integers(1, n)] = 0  # singular
        order = rng.permutation(n)
        A, B, C = A[np.ix_(order, order)], B[order], C[:, order]
        M = rng.standard_normal((m, m))
        R = 10 ** rng.uniform(-3, 3) * (M @ M.T + 0.1 * np.eye(m))
        matters = np.any(C @ B)  # else the best gain may be zero, and no error relative to it
        if matters and _stabilisable(equation, A, B) and _stabilisable(equation, A.T, C.T):
            return System(f"random {index}", f"random, n = {n}", A, B, C.T @ C, (R + R.T) / 2)


def _stabilisable(equation: Equation, A: Matrix, B: Matrix) -> bool:
    """Popov, Belevitch and Hautus: no unstable eigenvalue at which [A - lambda, B] loses rank, by a margin."""
    modes = np.linalg.eigvals(A)
    unstable = modes[modes.real > -1e-6] if equation == "care" else modes[np.abs(modes) > 1 - 1e-6]
    pencils = [np.hstack([A - mode * np.eye(len(A)), B]) for mode in unstable]
    return all(np.linalg.svd(pencil, compute_uv=False)[-1] > 1e-6 for pencil in pencils)


def special_systems(equation: Equation) -> list[System]:
    """The paper's problem on its two plants, and ten that are ill-conditioned, each for a reason of its own."""
    return _continuous_systems() if equation == "care" else _discrete_systems()


def _continuous_systems() -> list[System]:
    appendix, identified = _linear(paper.appendix_plant()), _linear(paper.identified_plant())
    weights = np.diag(paper.Q)
    binomials = [math.comb(6, i) * 4.0 ** (6 - i) for i in range(6)]
    units = np.diag([2.0**20, 2.0**-10, 2.0**10, 2.0**-20])
    return [
        _system("paper", *appendix, weights, paper.R),
        _system("identified", *identified, weights, paper.R),
        _system("paper, R = 1e-8", *appendix, weights, 1e-8),
        _system("paper, R = 1", *appendix, weights, 1.0),
        _system("paper, R = 1e4", *appendix, weights, 1e4),
        _system("identified, R = 1e-8", *identified, weights, 1e-8),
        _system("identified, R = 1e4", *identified, weights, 1e4),
        _system("stiff: winding of 10 uH", *_winding(), np.diag([*paper.Q, 0.0]), paper.R),
        _system("two poles, 0.70 and 0.71 m", *_two_poles(), np.diag([*paper.Q, *paper.Q[2:]]), paper.R),
        # p(s) p(-s) = (4 - s^2)^6 is what these weights make of six integrators in a chain.
        _system("closed-loop pole of order six", *_chain(np.zeros((6, 6))), np.diag(binomials), 1.0),
        _in_other_units(_system("units 2^40 apart", *appendix, weights, paper.R), units),
        _system("hardly damped, R = 1e4", *_oscillators(), 1e-4 * np.eye(6), 1e4),
    ]


def _discrete_systems() -> list[System]:
    appendix, identified = _linear(paper.appendix_plant()), _linear(paper.identified_plant())
    weights = np.diag(paper.Q)
    fast, slow = _held(*appendix, 0.002), _held(*appendix, 0.02)
    units = np.diag([2.0**20, 2.0**-10, 2.0**10, 2.0**-20])
    return [
        _system("paper, 2 ms", *fast, weights, paper.R),
        _system("paper, 20 ms", *slow, weights, paper.R),
        _system("identified, 2 ms", *_held(*identified, 0.002), weights, paper.R),
        _system("identified, 20 ms", *_held(*identified, 0.02), weights, paper.R),
        _system("paper, 2 ms, R = 1e-8", *fast, weights, 1e-8),
        _system("paper, 2 ms, R = 1e4", *fast, weights, 1e4),
        _system("paper, 20 ms, R = 1e-8", *slow, weights, 1e-8),
        _system("paper, 20 ms, R = 1e4", *slow, weights, 1e4),
        _system("stiff: winding of 10 uH, 2 ms", *_held(*_winding(), 0.002), np.diag([*paper.Q, 0.0]), paper.R),
        _system(
            "two poles, 0.70 and 0.71 m, 2 ms",
            *_held(*_two_poles(), 0.002),
            np.diag([*paper.Q, *paper.Q[2:]]),
            paper.R,
        ),
        _system("delay of four samples, 20 ms", *_delayed(*slow), np.diag([*paper.Q, 0.0, 0.0, 0.0, 0.0]), paper.R),
        _system("six sums in a chain, R = 1e4", *_chain(np.eye(6)), np.diag([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 1e4),
        _in_other_units(_system("units 2^40 apart, 20 ms", *slow, weights, paper.R), units),
        _system("hardly damped, 20 ms, R = 1e4", *_held(*_oscillators(), 0.02), 1e-4 * np.eye(6), 1e4),
    ]


def _system(name: str, A: Matrix, B: Matrix, Q: Matrix, R: float) -> System:
    return System(name, name, A, B, Q, np.array([[R]]))


def _linear(plant: cpjax.CartPole) -> tuple[Matrix, Matrix]:
    A, B = cpjax.linearize(plant)
    return np.array(A, dtype=np.float64), np.array(B, dtype=np.float64)


def _held(A: Matrix, B: Matrix, period: float) -> tuple[Matrix, Matrix]:
    """What a zero-order hold makes of a continuous plant."""
    n, m = B.shape
    whole = scipy.linalg.expm(period * np.block([[A, B], [np.zeros((m, n + m))]]))
    return whole[:n, :n], whole[:n, n:]


def _winding() -> tuple[Matrix, Matrix]:
    """The paper's plant with the current as a fifth state, in a winding of 10 uH: one pole at -1e5, others at -2."""
    plant = paper.appendix_plant()
    A, B = _linear(plant)
    back_emf, resistance, inductance = float(plant.motor.back_emf_constant), float(plant.motor.resistance), 1e-5
    A[:, 1] += B[:, 0] * back_emf
    row = np.array([[0.0, -back_emf, 0.0, 0.0, -resistance]]) / inductance
    return np.vstack([np.hstack([A, B * resistance]), row]), np.array([[0.0], [0.0], [0.0], [0.0], [1 / inductance]])


def _two_poles() -> tuple[Matrix, Matrix]:
    """The paper's cart under two poles of almost one length, which it can hardly tell apart."""
    plant = paper.appendix_plant()
    A, B = _linear(plant)
    first, second, g = 0.7, 0.71, float(plant.gravity)
    cart, push = np.array([0.0, A[1, 1], A[1, 2], 0.0, A[1, 2], 0.0]), B[1, 0]
    rows = np.zeros((6, 6))
    rows[[0, 2, 4], [1, 3, 5]] = 1
    rows[1], rows[3], rows[5] = cart, cart / first, cart / second
    rows[3, 2] += g / first
    rows[5, 4] += g / second
    return rows, np.array([[0.0], [push], [0.0], [push / first], [0.0], [push / second]])


def _chain(diagonal: Matrix) -> tuple[Matrix, Matrix]:
    """Each state drives the one before it, and the input the last."""
    n = len(diagonal)
    return diagonal + np.eye(n, k=1), np.eye(n)[:, -1:]


def _oscillators() -> tuple[Matrix, Matrix]:
    """Three undamped oscillators on one input, at 1, 1.1 and 10 rad/s."""
    A = scipy.linalg.block_diag(*([[0.0, w], [-w, 0.0]] for w in (1.0, 1.1, 10.0)))
    return A, np.array([[0.0], [1.0], [0.0], [1.0], [0.0], [1.0]])


def _delayed(A: Matrix, B: Matrix) -> tuple[Matrix, Matrix]:
    """A sampled plant of four states whose input comes four samples late: half of the poles are at 0, in one chain."""
    line, last = _chain(np.zeros((4, 4)))
    return np.block([[A, B, np.zeros((4, 3))], [np.zeros((4, 4)), line]]), np.vstack([np.zeros((4, 1)), last])


def _in_other_units(system: System, T: Matrix) -> System:
    """The system in the states T s; T holds powers of two, so that nothing is rounded."""
    back = np.linalg.inv(T)
    return system._replace(A=T @ system.A @ back, B=T @ system.B, Q=back @ system.Q @ back)


def reference(equation: Equation, system: System) -> Matrix:
    """The stabilising solution P (n, n) as an array of mpmath numbers, right to fifty digits of its norm.

    Raises:
      ArithmeticError: doubling has not led to a stabilising solution.
    """
    import mpmath

    with mpmath.workdps(_DIGITS):
        A, B, Q, R = (exact(matrix) for matrix in system[2:])
        G = _product(B, _solve(R, B.T))
        P = _doubled(*(_cayley(A, G, Q) if equation == "care" else (A, G, Q)))
        P = (P + P.T) / 2
        correction = newton_correction(equation, system, P)
        if not _norm(correction) <= _ACCEPTED * _norm(P):
            raise ArithmeticError(f"{system.name}: the next correction is {mpmath.nstr(_norm(correction) / _norm(P))}")
    return P


def newton_correction(equation: Equation, system: System, P: Matrix) -> Matrix:
    """What Newton's method adds to P, an array of mpmath numbers: the error of P with its sign changed, but for a term
    that is quadratic in it.

    Raises:
      ArithmeticError: the closed loop of P is not stable.
    """
    import mpmath

    with mpmath.workdps(_DIGITS):
        A, B, Q, _ = (exact(matrix) for matrix in system[2:])
        K = gain(equation, system, P)
        loop = A - _product(B, K)
        if equation == "care":
            half = _product(A.T, P) + Q / 2 - _product(P, B, K) / 2
            residual = half + half.T
        else:
            residual = _product(A.T, P, loop) + Q - P
    with mpmath.workdps(_DIGITS // 4):  # of the correction, unlike of the residual, a few digits are enough
        if equation == "dare":
            return _summed(loop, residual)
        shift = _middle(loop)
        inverse = _solve(loop - shift * _identity(loop), _identity(loop))
        return _summed(
            _product(inverse, loop + shift * _identity(loop)), 2 * shift * _product(inverse.T, residual, inverse)
        )


def exact(numbers: Matrix) -> Matrix:
    """Floating numbers as mpmath's, with nothing lost."""
    import mpmath

    return np.array([[mpmath.mpf(float(number)) for number in row] for row in numbers], dtype=object)


def gain(equation: Equation, system: System, P: Matrix) -> Matrix:
    """K (m, n) of u = -K s that follows from P, in the arithmetic of P: float64 or mpmath's."""
    import mpmath

    A, B, _, R = system[2:]
    if P.dtype != object:
        if equation == "care":
            return np.linalg.solve(R, B.T @ P)
        return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    with mpmath.workdps(_DIGITS):
        A, B, R = exact(A), exact(B), exact(R)
        if equation == "care":
            return _solve(R, _product(B.T, P))
        return _solve(R + _product(B.T, P, B), _product(B.T, P, A))


def relative_error(found: Matrix, right: Matrix) -> float:
    """Frobenius norm of the difference over that of `right`; infinite where `found` is not finite."""
    import mpmath

    if not np.all(np.isfinite(found)):
        return math.inf
    with mpmath.workdps(_DIGITS):
        error = float(_norm(exact(found) - right) / _norm(right))
    return error if error > _ACCEPTED else 0.0  # the reference itself is no better


def ratio(error: float, scipy_error: float) -> float:
    """An error over SciPy's on the same system, which counts as 2^-53 at least; infinite for a failure of one's own."""
    return error / max(scipy_error, UNIT) if math.isfinite(error) else math.inf


def scipy_solution(equation: Equation, system: System) -> Matrix:
    """SciPy's P, or NaNs where it gives up."""
    solve = scipy.linalg.solve_continuous_are if equation == "care" else scipy.linalg.solve_discrete_are
    try:
        return np.asarray(solve(*system[2:]))
    except np.linalg.LinAlgError:
        return np.full(system.A.shape, math.nan)


def _doubled(A: Matrix, G: Matrix, H: Matrix) -> Matrix:
    """X of X = A' X (I + G X)^-1 A + H: each pass doubles the horizon (Anderson, 1978)."""
    n = len(A)
    for _ in range(100):
        split = _solve(_identity(A) + _product(G, H), np.hstack([A, G]))
        step, spread = split[:, :n], split[:, n:]
        longer = _product(A.T, H, step)
        G = G + _product(A, spread, A.T)
        A, H = _product(A, step), H + longer
        if _norm(longer) <= 1e-60 * _norm(H):
            return H
    raise ArithmeticError("doubling did not converge")


def _cayley(A: Matrix, G: Matrix, Q: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """The discrete equation with the solution of A' X + X A - X G X + Q = 0 (Chu, Fan and Lin, 2005)."""
    shift = _middle(np.block([[A, -G], [-Q, -A.T]]))
    shifted = A - shift * _identity(A)
    inverse = _solve(shifted, _identity(A))
    W = _solve(shifted.T + _product(Q, inverse, G), _identity(A))
    return _identity(A) + 2 * shift * W.T, 2 * shift * _product(inverse, G, W), 2 * shift * _product(W, Q, inverse)


def _middle(M: Matrix) -> Any:
    """Of its eigenvalues' moduli, so that |(s + shift) / (s - shift)| is not too near 1 at either end."""
    import mpmath

    moduli = np.abs(np.linalg.eigvals(M.astype(np.float64)))
    return mpmath.sqrt(float(moduli.max()) * float(moduli.min()))


def _summed(F: Matrix, E: Matrix) -> Matrix:
    """X of F' X F - X + E = 0, summed as E + F' E F + ... by doubling (Smith, 1968).

    A power of F of norm below 1 proves F stable; what is missing from the sum then is of the order of its square.

    Raises:
      ArithmeticError: F is not stable.
    """
    for _ in range(100):
        E = E + _product(F.T, E, F)
        F = _product(F, F)
        if _norm(F) <= 1e-10:
            return E
    raise ArithmeticError("the closed loop is not stable")


def _product(first: Matrix, *others: Matrix) -> Matrix:
    """Matrix product; several times faster than @ on mpmath's numbers."""
    import mpmath

    for other in others:
        first = np.array([[mpmath.fdot(row, column) for column in other.T] for row in first], dtype=object)
    return first


def _solve(M: Matrix, N: Matrix) -> Matrix:
    """M^-1 N by elimination with row pivots, as dot products (Crout)."""
    import mpmath

    n = len(M)
    T = np.hstack([M, N])
    for k in range(n):
        for i in range(k, n):
            T[i, k] -= mpmath.fdot(T[i, :k], T[:k, k])
        pivot = k + int(np.argmax(np.abs(T[k:, k])))
        T[[k, pivot]] = T[[pivot, k]]
        for j in range(k + 1, T.shape[1]):
            T[k, j] = (T[k, j] - mpmath.fdot(T[k, :k], T[:k, j])) / T[k, k]
    for k in reversed(range(n - 1)):
        for j in range(n, T.shape[1]):
            T[k, j] -= mpmath.fdot(T[k, k + 1 : n], T[k + 1 :, j])
    return T[:, n:]


def _identity(M: Matrix) -> Matrix:
    return exact(np.eye(len(M)))


def _norm(M: Matrix) -> Any:
    import mpmath

    return mpmath.sqrt(mpmath.fdot(M.ravel(), M.ravel()))
