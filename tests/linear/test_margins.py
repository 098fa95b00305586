"""Margins against python-control, SciPy, a dense grid, closed forms, and the poles of the loops they speak of."""

import itertools
import math

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are
from scipy.optimize import brentq, minimize_scalar
from scipy.signal import place_poles
from tables import rows

import cpjax
from cpjax import InputError, paper
from cpjax.linear.margins import (
    Margins,
    characteristic_polynomial,
    closed_loop_poles,
    loop_polynomials,
    stability_margins,
)

MARGINS = ("gain_lower", "gain_upper", "phase", "delay", "disk")
PAPERS_LOOPS = [(plant, design) for plant in paper.PLANTS for design in paper.PRINTED_GAINS]
the_papers_loops = rows(("plant", "design"), PAPERS_LOOPS)


def papers_loop(plant, design):
    A, B = (np.asarray(matrix) for matrix in cpjax.linearize(paper.PLANTS[plant]()))
    return A, B[:, 0], np.array(paper.PRINTED_GAINS[design])


def random_loops(n, count, seed=0):
    """Stable loops about plants that are stable or not."""
    rng = np.random.default_rng([seed, n])
    while count:
        A = rng.normal(size=(n, n)) - rng.uniform(-1.0, 2.0) * np.eye(n)
        B, K = rng.normal(size=n), rng.normal(size=n) * 10.0 ** rng.uniform(-1.0, 1.0)
        if is_stable(A, B, K):
            count -= 1
            yield A, B, K


def is_stable(A, B, K, factor=1.0):
    return np.max(np.linalg.eigvals(A - factor * np.outer(B, K)).real) < 0


def loop_gain(A, B, K, frequencies):
    resolvents = 1j * np.asarray(frequencies)[:, None, None] * np.eye(len(A)) - A
    return np.linalg.solve(resolvents, np.broadcast_to(B[:, None], (len(frequencies), len(B), 1)))[..., 0] @ K


def numbers(found):
    return {name: float(value) for name, value in found._asdict().items()}


def python_controls(A, B, K):
    """Gain, phase and delay margins of python-control, with its sign of the phase dropped."""
    system = control.ss(A, B[:, None], K[None, :], 0)
    gains, phases, _, _, crossovers, _ = control.stability_margins(system, returnall=True)
    delays = [math.radians(p % 360.0) / w for p, w in zip(phases, crossovers, strict=True)]
    return {
        "gain_lower": max([g for g in gains if 1e-7 < g < 1.0], default=0.0),
        "gain_upper": min([g for g in gains if 1.0 < g < 1e7], default=math.inf),
        "phase": min([math.radians(abs(p)) for p in phases], default=math.inf),
        "delay": min(delays, default=math.inf),
    }


def from_a_grid(A, B, K):
    """All margins from L on a dense grid, its crossings refined by bisection; poles near the axis get more of it."""
    closed = np.linalg.eigvals(A - np.outer(B, K))
    poles = np.concatenate([np.linalg.eigvals(A), closed])
    w = [np.geomspace(1e-3 * np.min(np.abs(closed)), 1e3 * (np.max(np.abs(poles)) + abs(K @ B)), 20000)]
    w += [abs(p.imag) + abs(p.real) * np.linspace(-30.0, 30.0, 2001) for p in poles]
    w = np.unique(np.concatenate(w))
    w = w[w > 0]
    L = loop_gain(A, B, K, w)

    def crossings(value):
        signs = np.sign(value(L))
        return np.array(
            [
                brentq(lambda x: value(loop_gain(A, B, K, [x]))[0], w[i], w[i + 1], xtol=1e-300, rtol=1e-14)
                for i in np.nonzero(signs[1:] * signs[:-1] < 0)[0]
            ]
        )

    def highest(L):
        """Of |S - T|, refined between the neighbours of the grid's highest."""
        i = min(max(np.argmax(np.abs((1 - L) / (1 + L))), 1), len(w) - 2)
        ends = math.log(w[i - 1]), math.log(w[i + 1])

        def depth(log_w):
            [L] = loop_gain(A, B, K, [math.exp(log_w)])
            return -abs((1 - L) / (1 + L))

        return -minimize_scalar(depth, bounds=ends, method="bounded", options={"xatol": 1e-9}).fun

    T_at_zero = -K @ np.linalg.solve(A - np.outer(B, K), B)  # where L may be infinite
    on_the_real_axis = crossings(lambda L: (L / (1 + L)).imag)
    factors = -1.0 / loop_gain(A, B, K, on_the_real_axis).real
    factors = np.append(factors, 1.0 - 1.0 / T_at_zero if T_at_zero else math.inf)
    factors = factors[(factors > 1e-7) & (factors < 1e7)]
    crossovers = crossings(lambda L: np.abs(L) - 1.0)
    lag = np.mod(np.angle(loop_gain(A, B, K, crossovers)) + math.pi, math.tau)
    return {
        "gain_lower": max(factors[factors < 1], default=0.0),
        "gain_upper": min(factors[factors > 1], default=math.inf),
        "phase": min(np.minimum(lag, math.tau - lag), default=math.inf),
        "delay": min(lag / crossovers, default=math.inf),
        "disk": 2.0 / max(1.0, abs(1 - 2 * T_at_zero), highest(L)),
    }


@the_papers_loops
def test_the_papers_loops_have_python_controls_margins(plant, design):
    loop = papers_loop(plant, design)
    found, expected = numbers(stability_margins(*loop)), python_controls(*loop)
    assert found["stable"]
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=1e-9), name
    crossovers = control.stability_margins(control.ss(loop[0], loop[1][:, None], loop[2][None, :], 0), returnall=True)
    assert found["gain_lower_frequency"] == pytest.approx(crossovers[3][0], rel=1e-8)
    assert found["phase_frequency"] == pytest.approx(crossovers[4][0], rel=1e-8)
    assert found["delay_frequency"] == found["phase_frequency"]
    assert math.isnan(found["gain_upper_frequency"])


@pytest.mark.parametrize("n", [4, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 6))])
def test_random_loops_have_python_controls_margins(n):
    for loop in random_loops(n, 40):
        found = numbers(stability_margins(*loop))
        for name, value in python_controls(*loop).items():
            assert found[name] == pytest.approx(value, rel=1e-6), (name, loop)


@the_papers_loops
def test_the_disk_margins_are_python_controls(plant, design):
    A, B, K = papers_loop(plant, design)
    found = numbers(stability_margins(A, B, K))
    system = control.ss(A, B[:, None], K[None, :], 0)
    grid = np.sort(np.append(np.geomspace(1e-2, 1e4, 500), found["disk_frequency"]))
    alpha, gain, phase = control.disk_margins(system, grid)
    assert found["disk"] == pytest.approx(alpha, rel=1e-10)
    assert found["disk_gain"] == pytest.approx(control.db2mag(gain), rel=1e-10)
    assert found["disk_phase"] == pytest.approx(math.radians(phase), rel=1e-10)


@pytest.mark.slow
@rows("n", [2, 4, 6])
def test_no_margin_of_a_random_loop_is_missed_that_a_dense_grid_finds(n):
    for loop in random_loops(n, 25, seed=1):
        found = numbers(stability_margins(*loop))
        for name, value in from_a_grid(*loop).items():
            assert found[name] == pytest.approx(value, rel=1e-9), (name, loop)


@rows("damping", [1e-2, 1e-4, 1e-6])
def test_a_resonance_is_found_however_narrow_it_is(damping):
    """Two oscillators, of which the faster one has |L| > 1 over a band of the width of its damping."""
    A = np.array([[0, 1, 0, 0], [-1, -0.5, 0, 0], [0, 0, 0, 1], [0, 0, -1e4, -200 * damping]])
    B, K = np.array([0, 1, 0, 1.0]), np.array([0, 0.1, 0, 300 * damping])
    found = numbers(stability_margins(A, B, K))
    for name, value in from_a_grid(A, B, K).items():
        assert found[name] == pytest.approx(value, rel=1e-7), name
    assert abs(found["phase_frequency"] - 100.0) < 1000 * damping + 1e-2


def test_an_lqr_loop_has_the_margins_that_every_lqr_loop_has():
    for n, seeds in ((2, 20), (4, 20)):
        for seed in range(seeds):
            rng = np.random.default_rng([seed, n])
            A, B, R = rng.normal(size=(n, n)), rng.normal(size=(n, 1)), 10.0 ** rng.uniform(-3.0, 2.0)
            K = (B.T @ solve_continuous_are(A, B, np.eye(n), [[R]]))[0] / R
            found = numbers(stability_margins(A, B, K))
            assert found["gain_lower"] < 0.5
            assert found["gain_upper"] == math.inf
            assert found["phase"] > math.pi / 3
            assert found["disk"] > 2 / 3  # |S| < 1 keeps L outside a disk about -1


LOOPS = {
    "placement": papers_loop("appendix", "placement"),
    "lqr": papers_loop("appendix", "lqr"),
    # L = 150 (s + 2) / ((s - 1) (s + 1) (s + 5) (s + 20))
    "between gains": (np.vstack([np.eye(4)[1:], [100, 25, -99, -25]]), np.eye(4)[3], np.array([300.0, 150, 0, 0])),
    # Positive feedback about two damped oscillators
    "below a gain": (
        np.array([[0, 1, 0, 0], [-4, -0.1, 0, 0], [0, 0, 0, 1], [0, 0, -25, -0.5]]),
        np.array([0.0, 1, 0, 1]),
        np.array([-1, 0, -2, 0.1]),
    ),
}
every_loop = rows("loop", LOOPS.values(), ids=LOOPS.keys())


def test_these_loops_have_between_them_every_kind_of_gain_margin():
    found = {name: numbers(stability_margins(*loop)) for name, loop in LOOPS.items()}
    assert all(found[name]["gain_upper"] == math.inf for name in ("placement", "lqr"))
    assert all(found[name]["gain_lower_frequency"] > 0 for name in ("placement", "lqr"))
    assert found["between gains"]["gain_lower_frequency"] == 0
    assert found["between gains"]["gain_upper_frequency"] > 0
    assert found["below a gain"]["gain_lower"] == 0
    assert found["below a gain"]["gain_upper_frequency"] == 0


@every_loop
def test_the_loop_is_stable_between_the_gain_margins_and_not_just_outside(loop):
    found = stability_margins(*loop)
    lower, upper = float(found.gain_lower), min(float(found.gain_upper), 1e3)
    inside = lower + (upper - lower) * np.linspace(1e-6, 1 - 1e-6, 500)
    assert all(is_stable(*loop, factor) for factor in inside)
    if lower > 0:
        assert not is_stable(*loop, lower * (1 - 1e-6))
    if found.gain_upper < math.inf:
        assert not is_stable(*loop, upper * (1 + 1e-6))


@every_loop
def test_the_loop_is_stable_for_every_phase_below_the_phase_margin_and_not_above(loop):
    phase = float(stability_margins(*loop).phase)
    assert all(is_stable(*loop, np.exp(1j * phi)) for phi in phase * np.linspace(-1 + 1e-6, 1 - 1e-6, 201))
    assert not all(is_stable(*loop, np.exp(1j * sign * phase * (1 + 1e-6))) for sign in (-1, 1))


@every_loop
def test_the_loop_is_stable_for_every_delay_below_the_delay_margin_and_not_above(loop):
    delay = float(stability_margins(*loop).delay)

    def delayed_is_stable(time):
        numerator, denominator = control.pade(time, 8)
        late = control.tf2ss(numerator, denominator)
        A, B, K = loop
        coupled = np.block(
            [[A - np.outer(B, late.D @ K[None, :]), -B[:, None] @ late.C], [late.B @ K[None, :], late.A]]
        )
        return np.max(np.linalg.eigvals(coupled).real) < 0

    assert all(delayed_is_stable(delay * part) for part in (0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 0.9999))
    assert not delayed_is_stable(delay * 1.0001)


@every_loop
def test_the_loop_is_stable_for_every_factor_in_the_disk_but_not_on_its_rim(loop):
    A, B, K = loop
    found = numbers(stability_margins(*loop))
    rng = np.random.default_rng(0)
    inside = found["disk"] * np.sqrt(rng.uniform(0, 1, 300)) * np.exp(1j * rng.uniform(0, math.tau, 300))
    rim = found["disk"] * (1 - 1e-6) * np.exp(1j * np.linspace(0, math.tau, 200))
    assert all(is_stable(*loop, (2 + d) / (2 - d)) for d in [*inside, *rim])
    L = loop_gain(A, B, K, [found["disk_frequency"]])[0]
    d = 2 * (1 + L) / (1 - L)  # the factor (2 + d) / (2 - d) is -1 / L
    assert abs(d) == pytest.approx(found["disk"], rel=1e-9)
    assert not is_stable(A, B, K, (2 + 1.00001 * d) / (2 - 1.00001 * d))
    assert found["disk_gain"] == pytest.approx((2 + found["disk"]) / (2 - found["disk"]), rel=1e-12)
    assert found["disk_phase"] == pytest.approx(2 * math.atan(found["disk"] / 2), rel=1e-12)


def expect(found, **expected):
    assert found.stable
    for name, value in expected.items():
        assert float(getattr(found, name)) == pytest.approx(value, rel=1e-12, abs=1e-300, nan_ok=True), name


NOTHING = math.nan


def test_an_unstable_lag_of_loop_gain_two_has_its_textbook_margins():
    """L = 2 / (s - 1)."""
    expect(
        stability_margins([[1.0]], [1.0], [2.0]),
        gain_lower=0.5,
        gain_lower_frequency=0.0,
        gain_upper=math.inf,
        gain_upper_frequency=NOTHING,
        phase=math.pi / 3,
        phase_frequency=math.sqrt(3),
        delay=math.pi / 3 / math.sqrt(3),
        disk=2 / 3,
        disk_frequency=0.0,
        disk_gain=2.0,
    )


def test_an_integrator_has_its_textbook_margins():
    """L = 2 / s lies in the right half plane and meets the disk of radius 1 nowhere."""
    expect(
        stability_margins([[0.0]], [1.0], [2.0]),
        gain_lower=0.0,
        gain_lower_frequency=NOTHING,
        gain_upper=math.inf,
        phase=math.pi / 2,
        phase_frequency=2.0,
        delay=math.pi / 4,
        disk=2.0,
        disk_frequency=math.inf,
        disk_gain=math.inf,
        disk_phase=math.pi / 2,
    )


def test_a_double_integrator_has_its_textbook_margins():
    """L = (s + 1) / s^2, with |L| = 1 where w^4 = w^2 + 1."""
    w = math.sqrt((1 + math.sqrt(5)) / 2)
    expect(
        stability_margins([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 1.0]),
        gain_lower=0.0,
        gain_upper=math.inf,
        phase=math.atan(w),
        phase_frequency=w,
        delay=math.atan(w) / w,
    )


def test_a_gain_that_acts_on_no_derivative_has_the_upper_margin_of_routh():
    """L = 1 / (s (s + 1) (s + 2)), whose K B is exactly 0."""
    A = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -2.0, -3.0]]
    found = stability_margins(A, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    expect(found, gain_lower=0.0, gain_upper=6.0, gain_upper_frequency=math.sqrt(2))


def test_four_equal_closed_loop_poles_are_no_obstacle():
    """Of L = (4 s^3 + 6 s^2 + 4 s + 1) / s^4 the factor 1/5 leaves (s^2 + 1)(5 s^2 + 4 s + 1) / 5."""
    found = stability_margins(np.diag(np.ones(3), 1), [0.0, 0.0, 0.0, 1.0], [1.0, 4.0, 6.0, 4.0])
    expect(found, gain_lower=0.2, gain_lower_frequency=1.0, gain_upper=math.inf)


def test_positive_feedback_on_a_stable_plant_is_limited_at_frequency_zero():
    """L = -1 / (s^2 + s / 10 + 4): at a factor of 4 a real pole reaches 0."""
    found = stability_margins([[0.0, 1.0], [-4.0, -0.1]], [0.0, 1.0], [-1.0, 0.0])
    expect(found, gain_lower=0.0, gain_upper=4.0, gain_upper_frequency=0.0)


def test_a_plant_with_poles_on_the_axis_has_finite_margins():
    """L = s / (s^2 + 4), infinite at 2 rad/s and always in the right half plane."""
    crossovers = [(math.sqrt(17) - 1) / 2, (math.sqrt(17) + 1) / 2]
    found = stability_margins([[0.0, 1.0], [-4.0, 0.0]], [0.0, 1.0], [0.0, 1.0])
    expect(found, gain_lower=0.0, gain_upper=math.inf, phase=math.pi / 2, disk=2.0)
    # Below the resonance L leads by a quarter turn, and only a lag of three quarters destabilises.
    expect(found, delay=math.pi / 2 / crossovers[1], delay_frequency=crossovers[1])
    assert float(found.phase_frequency) == pytest.approx(crossovers[0], rel=1e-9) or float(
        found.phase_frequency
    ) == pytest.approx(crossovers[1], rel=1e-9)


@rows(("B", "K"), [([1.0, 1.0], [0.0, 0.0]), ([0.0, 0.0], [1.0, 1.0])])
def test_without_feedback_nothing_limits_a_stable_plant(B, K):
    found = stability_margins([[-1.0, 0.0], [1.0, -2.0]], B, K)
    expect(found, gain_lower=0.0, gain_upper=math.inf, phase=math.inf, delay=math.inf, disk=2.0, disk_gain=math.inf)
    for name in ("gain_lower", "gain_upper", "phase", "delay"):
        assert math.isnan(getattr(found, f"{name}_frequency"))


@pytest.mark.slow
def test_of_an_unstable_loop_all_margins_are_nan_with_finite_derivatives():
    A, B, K = papers_loop("appendix", "placement")
    found = stability_margins(A, B, -K)
    assert not found.stable
    assert all(math.isnan(value) for value in found[1:])
    jacobian, _ = reverse(tuple(map(jnp.asarray, (A, B, -K))))
    assert all(np.all(part == 0.0) for part in jacobian)


@the_papers_loops
def test_the_margins_depend_neither_on_the_units_of_the_states_nor_on_that_of_time(plant, design):
    A, B, K = papers_loop(plant, design)
    plain = numbers(stability_margins(A, B, K))
    units = np.array([1e3, 1e-2, 57.3, 7.0])
    rescaled = numbers(stability_margins(A * units[:, None] / units, B * units, K / units))
    faster = numbers(stability_margins(50.0 * A, 50.0 * B, K))
    for name, value in plain.items():
        times = 50.0 if name.endswith("frequency") else 1 / 50.0 if name == "delay" else 1.0
        assert rescaled[name] == pytest.approx(value, rel=1e-9, nan_ok=True), name
        assert faster[name] == pytest.approx(times * value, rel=1e-9, nan_ok=True), name


def test_poles_four_decades_apart_and_gains_of_ten_millions_leave_eight_digits():
    A, B = (np.asarray(matrix) for matrix in cpjax.linearize(paper.appendix_plant()))
    for poles in ([-1.0, -40.0, -600.0, -1e4], [-2.0, -3.0, -5e3, -1e4]):
        K = place_poles(A, B, poles).gain_matrix[0]
        found = numbers(stability_margins(A, B[:, 0], K))
        for name, value in from_a_grid(A, B[:, 0], K).items():
            assert found[name] == pytest.approx(value, rel=1e-8), (name, poles)


@the_papers_loops
def test_float32_gives_the_papers_margins_to_four_digits_in_float32(plant, design):
    loop = papers_loop(plant, design)
    narrow = stability_margins(*(jnp.asarray(matrix, dtype=jnp.float32) for matrix in loop))
    for name, value in numbers(stability_margins(*loop)).items():
        found = getattr(narrow, name)
        assert found.dtype == (jnp.bool if name == "stable" else jnp.float32)
        assert float(found) == pytest.approx(value, rel=1e-4, nan_ok=True), name


def vector(found: Margins):
    return jnp.stack(found[1:])


@jax.jit
def forward(loop, direction):
    return jax.jvp(lambda loop: vector(stability_margins(*loop)), (loop,), (direction,))[1]


@jax.jit
def reverse(loop):
    """Jacobians in A, B and K, and the margins."""

    def twice(loop):
        values = vector(stability_margins(*loop))
        return values, values

    return jax.jacrev(twice, has_aux=True)(loop)


def directions(loop, count=3):
    """Random ones, in each of A, B and K alone and in all of them, in proportion to their entries."""
    rng = np.random.default_rng(5)
    for i in range(count + 1):
        yield tuple(
            jnp.asarray(rng.normal(size=m.shape) * (0.1 * np.max(np.abs(m)) + np.abs(m)) * (i in (j, count)))
            for j, m in enumerate(loop)
        )


def richardson(function, h):
    """Derivative at 0 from central differences at h, h/2 and h/4."""
    slopes = [(np.asarray(function(s)) - np.asarray(function(-s))) / (2 * s) for s in (h, h / 2, h / 4)]
    once = [(4 * fine - rough) / 3 for rough, fine in itertools.pairwise(slopes)]
    return (16 * once[1] - once[0]) / 15


@pytest.mark.slow
@every_loop
def test_every_finite_margins_derivative_agrees_with_differences(loop):
    loop = tuple(map(jnp.asarray, loop))
    jacobian, values = reverse(loop)
    finite = np.isfinite(values)
    assert all(np.all(np.isfinite(part)) for part in jacobian)
    for direction in directions(loop):
        ahead = forward(loop, direction)
        back = sum(jnp.tensordot(part, d, d.ndim) for part, d in zip(jacobian, direction, strict=True))

        def moved(h, direction=direction):
            return vector(stability_margins(*(m + h * d for m, d in zip(loop, direction, strict=True))))[finite]

        ahead, back, differences = ahead[finite], back[finite], richardson(moved, 1e-4)
        scale = np.maximum(np.abs(ahead), np.abs(values[finite]))
        assert np.all(np.abs(ahead - back) <= 1e-11 * scale)
        assert np.all(np.abs(ahead - differences) <= 1e-8 * scale)


@pytest.mark.slow
@rows(
    "loop",
    [
        ([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 2.0]),
        ([[0.0, 1.0], [-4.0, 0.0]], [0.0, 1.0], [0.0, 1.0]),
        ([[-1.0, 0.0], [1.0, -2.0]], [1.0, 1.0], [0.0, 0.0]),
        ([[-1.0, 0.0], [1.0, -2.0]], [0.0, 0.0], [0.0, 0.0]),
        (np.diag(np.ones(3), 1), [0.0, 0.0, 0.0, 1.0], [1.0, 4.0, 6.0, 4.0]),
    ],
    ids=["equal poles", "plant on the axis", "no gain", "no input", "four equal poles"],
)
def test_no_derivative_is_nan_where_a_loop_is_degenerate(loop):
    jacobian, _ = reverse(tuple(map(jnp.asarray, loop)))
    assert all(np.all(np.isfinite(part)) for part in jacobian)


@pytest.mark.slow
def test_the_margins_of_an_unstable_lag_have_their_textbook_derivatives_in_the_gain():
    """L = k / (s - 1) at k = 2, where the lower gain margin and the disk margin are met at frequency 0."""
    (_, _, in_K), _ = reverse((jnp.diag(jnp.asarray([1.0, -1.0])), jnp.asarray([1.0, 0.0]), jnp.asarray([2.0, 0.0])))
    slopes = Margins(0.0, *in_K[:, 0])
    assert slopes.gain_lower == pytest.approx(-1 / 4)  # of 1 / k
    assert slopes.phase == pytest.approx(1 / math.sqrt(12))  # of acos(1 / k)
    assert slopes.phase_frequency == pytest.approx(2 / math.sqrt(3))  # of sqrt(k^2 - 1)
    assert slopes.disk == pytest.approx(4 / 9)  # of 2 (k - 1) / (k + 1)
    assert slopes.disk_gain == pytest.approx(1.0)  # of k


@pytest.mark.slow
def test_second_derivatives_are_those_of_the_first():
    A, B, K = map(jnp.asarray, papers_loop("appendix", "placement"))
    direction = jnp.asarray([1.0, -2.0, 3.0, 1.0])

    def slopes(h):
        return jax.jacfwd(lambda h: vector(stability_margins(A, B, K + h * direction)))(h)

    curvature = jax.jit(jax.jacfwd(slopes))(0.0)
    expected = richardson(jax.jit(slopes), 1e-2)
    finite = np.isfinite(vector(stability_margins(A, B, K)))
    np.testing.assert_allclose(curvature[finite], expected[finite], rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_margins_and_their_derivatives_are_the_same_under_vmap():
    loops = [*LOOPS.values(), (LOOPS["placement"][0], LOOPS["placement"][1], -LOOPS["placement"][2])]
    batch = tuple(jnp.stack([jnp.asarray(m) for m in matrices]) for matrices in zip(*loops, strict=True))
    jacobians, values = jax.vmap(reverse)(batch)
    for i, loop in enumerate(loops):
        jacobian, alone = reverse(tuple(map(jnp.asarray, loop)))
        np.testing.assert_allclose(values[i], alone, rtol=1e-11)
        for found, right in zip(jacobians, jacobian, strict=True):
            np.testing.assert_allclose(found[i], right, rtol=1e-9, atol=1e-9)


def test_the_closed_loop_poles_are_sorted_and_python_controls():
    for plant, design in PAPERS_LOOPS:
        A, B, K = papers_loop(plant, design)
        poles = closed_loop_poles(A, B, K)
        expected = control.ss(A - np.outer(B, K), B[:, None], K[None, :], 0).poles()
        np.testing.assert_allclose(poles, np.sort_complex(expected), rtol=1e-9)
    rng = np.random.default_rng(1)
    A, B, K = rng.normal(size=(5, 5)), rng.normal(size=(5, 2)), rng.normal(size=(2, 5))
    np.testing.assert_allclose(
        closed_loop_poles(A, B, K), np.sort_complex(np.linalg.eigvals(A - B @ K)), rtol=1e-10, atol=1e-12
    )


def test_the_derivative_of_simple_poles_agrees_with_differences():
    A, B, K = map(jnp.asarray, papers_loop("appendix", "placement"))

    @jax.jit
    def poles(K):
        found = closed_loop_poles(A, B, K)
        return jnp.concatenate([found.real, found.imag])

    ahead, back = jax.jacfwd(poles)(K), jax.jacrev(poles)(K)
    np.testing.assert_allclose(ahead, back, rtol=1e-9, atol=1e-11)
    for i, unit in enumerate(np.eye(4)):
        differences = richardson(lambda h, unit=unit: poles(K + h * unit), 1e-3)
        np.testing.assert_allclose(ahead[:, i], differences, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(jax.vmap(jax.jacrev(poles))(jnp.stack([K, K]))[1], back, rtol=1e-12, atol=1e-13)


@rows("n", [1, 2, 3, 5, 8])
def test_the_characteristic_polynomial_is_numpys(n):
    A = np.random.default_rng(n).normal(size=(n, n))
    np.testing.assert_allclose(characteristic_polynomial(A), np.poly(A)[1:], rtol=1e-10, atol=1e-12)


def test_the_characteristic_polynomial_is_smooth_where_four_poles_coincide():
    """Of a chain of integrators its coefficients are the gain, backwards."""
    A, B = jnp.diag(jnp.ones(3), 1), jnp.zeros((4, 1)).at[3, 0].set(1.0)

    def polynomial(K):
        return characteristic_polynomial(A - B @ K)

    K = jnp.array([[1.0, 4.0, 6.0, 4.0]])
    np.testing.assert_allclose(polynomial(K), [4.0, 6.0, 4.0, 1.0], rtol=1e-14)
    np.testing.assert_allclose(jax.jacfwd(polynomial)(K)[:, 0], np.eye(4)[::-1], atol=1e-14)
    np.testing.assert_allclose(jax.jacrev(polynomial)(K)[:, 0], np.eye(4)[::-1], atol=1e-14)


@the_papers_loops
def test_the_loops_polynomials_are_python_controls_and_add_up_to_the_closed_loops(plant, design):
    A, B, K = papers_loop(plant, design)
    N, D = loop_polynomials(A, B, K)
    expected = control.ss2tf(control.ss(A, B[:, None], K[None, :], 0))
    [[numerator]], [[denominator]] = expected.num, expected.den
    size = np.max(np.abs(numerator))
    np.testing.assert_allclose(N, np.pad(numerator, (5 - len(numerator), 0))[1:], rtol=1e-9, atol=1e-11 * size)
    np.testing.assert_allclose(D, denominator[1:], rtol=1e-9, atol=1e-11)
    closed = A - np.outer(B, K)
    np.testing.assert_allclose(N + D, np.poly(closed)[1:], rtol=1e-9)
    bound = np.finfo(float).eps * np.linalg.norm(closed) ** np.arange(1, 5)
    assert np.all(np.abs(characteristic_polynomial(closed) - (N + D)) <= bound)


@rows(
    ("field", "loop"),
    [
        ("A", (np.zeros((2, 3)), [0.0, 1.0], [1.0, 1.0])),
        ("A", (np.full((2, 2), np.nan), [0.0, 1.0], [1.0, 1.0])),
        ("B", (np.eye(2), np.eye(2), [1.0, 1.0])),
        ("B", (np.eye(2), "motor", [1.0, 1.0])),
        ("K", (np.eye(2), [0.0, 1.0], [1.0, 1.0, 1.0])),
        ("K", (np.eye(2), [0.0, 1.0], np.ones((3, 1, 2)))),
    ],
)
def test_what_is_no_loop_is_refused_by_name(field, loop):
    for function in (stability_margins, loop_polynomials):
        with pytest.raises(InputError) as refusal:
            function(*loop)
        assert refusal.value.field == field


@rows(
    ("field", "loop"),
    [("B", (np.eye(2), np.ones((3, 1)), np.ones((1, 2)))), ("K", (np.eye(2), np.eye(2), [1.0, 1.0]))],
)
def test_poles_of_matrices_that_do_not_fit_are_refused_by_name(field, loop):
    with pytest.raises(InputError) as refusal:
        closed_loop_poles(*loop)
    assert refusal.value.field == field
