"""The paper's print against its own Lagrangian: each error in docs/paper.md, shown where it stands and put right.

Where the printed gains come from is in test_paper_gains.py, what laws and gains do when they run in test_paper_laws.py.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are
from scipy.signal import place_poles

import cpjax
from cpjax import paper

APPENDIX, IDENTIFIED = paper.appendix_plant(), paper.identified_plant()
M, m, l, g = APPENDIX.moving_mass, APPENDIX.pole_mass, APPENDIX.pole_length, APPENDIX.gravity
HALF_DIGIT = 0.005  # the gains are printed with two decimals

# Points (x, theta), rates and accelerations in general position; nothing below is special to them.
POINTS = np.random.default_rng(7).uniform(-2.0, 2.0, size=(20, 3, 2))


def printed_lagrangian(q, v):
    """Section III-A, K - V as printed, with the rotor's inertia beside the cart's mass as in the printed M(q)."""
    _, th = q
    x_dot, th_dot = v
    swing = (x_dot - l * th_dot * jnp.cos(th)) ** 2 + (l * th_dot * jnp.sin(th)) ** 2
    return 0.5 * M * x_dot**2 + 0.5 * m * swing - m * g * l * jnp.cos(th)


def generalised_forces(q, v, a):
    """d/dt dL/dv - dL/dq of the printed Lagrangian, differentiated by JAX: (force on x, torque on theta)."""
    q, v, a = (jnp.asarray(part) for part in (q, v, a))
    momentum = jax.grad(printed_lagrangian, argnums=1)
    _, rate = jax.jvp(momentum, (q, v), (v, a))
    return np.asarray(rate - jax.grad(printed_lagrangian, argnums=0)(q, v))


def matrix_form(q, v):
    """M(q), C(q, q') and G(q) of section III-A as printed, but for the third row of G."""
    th, th_dot = q[1], v[1]
    inertia = np.array([[M + m, -m * l * np.cos(th)], [-m * l * np.cos(th), m * l * l]])
    return inertia, np.array([m * l * th_dot**2 * np.sin(th), 0.0]), np.array([0.0, -m * g * l * np.sin(th)])


def state(q, v):
    return cpjax.State(q[0], v[0], q[1], v[1])


def energy(s):
    """E of section IV-C with J = m l^2."""
    return 0.5 * m * l * l * s.theta_dot**2 + m * g * l * (jnp.cos(s.theta) - 1.0)


def printed_energy_error(s):
    return 2.0 / 3.0 * m * l * l * s.theta_dot**2 - m * g * l * (jnp.cos(s.theta) - 1.0)


def rate_under_acceleration(function, s, x_ddot):
    """d/dt of a function of the state while the pivot accelerates with x_ddot and the bob swings freely."""
    theta_ddot = (jnp.cos(s.theta) * x_ddot + g * jnp.sin(s.theta)) / l
    s, flow = (jax.tree.map(jnp.asarray, z) for z in (s, cpjax.State(s.x_dot, x_ddot, s.theta_dot, theta_ddot)))
    return float(jax.jvp(function, (s,), (flow,))[1])


# Section III-A: the equations of motion


def test_the_second_printed_form_of_the_lagrangian_equals_the_first():
    for q, v, _ in POINTS:
        (_, th), (x_dot, th_dot) = q, v
        cross = m * l * x_dot * th_dot * np.cos(th)
        second = 0.5 * (M + m) * x_dot**2 - cross + 0.5 * m * l**2 * th_dot**2 - m * g * l * np.cos(th)
        assert second == pytest.approx(float(printed_lagrangian(jnp.asarray(q), jnp.asarray(v))), rel=1e-12)


@pytest.mark.slow
def test_the_printed_x_equation_has_two_signs_of_the_opposite_theta():
    for q, v, a in POINTS:
        th, th_dot = q[1], v[1]
        printed = (M + m) * a[0] + m * l * a[1] * np.cos(th) - m * l * th_dot**2 * np.sin(th)
        corrected = (M + m) * a[0] - m * l * a[1] * np.cos(th) + m * l * th_dot**2 * np.sin(th)
        mirrored = generalised_forces(q * [1, -1], v * [1, -1], a * [1, -1])
        assert generalised_forces(q, v, a)[0] == pytest.approx(corrected, rel=1e-11)
        assert mirrored[0] == pytest.approx(printed, rel=1e-11)  # right, were the bob at x + l sin(theta)
        assert abs(printed - corrected) > 1e-3


def test_the_printed_theta_equation_and_matrix_form_agree_with_the_lagrangian():
    for q, v, a in POINTS:
        theta_equation = m * l * a[0] * np.cos(q[1]) - m * l**2 * a[1] + m * g * l * np.sin(q[1])
        inertia, coriolis, gravity = matrix_form(q, v)
        expected = generalised_forces(q, v, a)
        assert -theta_equation == pytest.approx(expected[1], rel=1e-11, abs=1e-12)
        np.testing.assert_allclose(inertia @ a + coriolis + gravity, expected, rtol=1e-11, atol=1e-12)


def test_the_printed_gravity_vector_has_a_row_more_than_there_are_coordinates():
    for q, v, a in POINTS:
        inertia, coriolis, gravity = matrix_form(q, v)
        printed = np.append(gravity, 0.0)
        with pytest.raises(ValueError, match="could not be broadcast"):
            inertia @ a + coriolis + printed
        height = jax.grad(lambda q: m * g * l * jnp.cos(q[1]))(jnp.asarray(q))
        np.testing.assert_allclose(gravity, height, rtol=1e-12)


def test_the_solved_equation_yields_accelerations_and_not_the_printed_velocities():
    for q, v, (voltage, _) in POINTS:
        inertia, coriolis, gravity = matrix_form(q, v)
        pull = np.array([APPENDIX.motor.force_per_voltage * voltage - APPENDIX.motor.damping * v[0], 0.0])
        solved = np.linalg.solve(inertia, pull - coriolis - gravity)
        derivative = APPENDIX.vector_field(state(q, v), voltage)
        np.testing.assert_allclose(solved, [derivative.x_dot, derivative.theta_dot], rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose([derivative.x, derivative.theta], v)
        assert np.max(np.abs(solved - v)) > 1e-2


# Appendix: the linear model


def printed_linear_model():
    """A_lin and B_lin with m_p, m_c of its third row read as m_2, m_1, and the missing brackets closed."""
    motor = APPENDIX.motor
    drag = -(motor.torque_constant * motor.back_emf_constant + motor.viscous_friction * motor.resistance)
    drag /= motor.resistance * M
    push = motor.torque_constant / (motor.resistance * M)
    m_p, m_c = m, APPENDIX.cart_mass
    A = [[0, 1, 0, 0], [0, drag, g * m / M, 0], [0, m_p * g / m_c, 0, 1], [0, drag / l, g * (M + m) / (l * M), 0]]
    return np.array(A), np.array([[0.0], [push], [0.0], [push / l]])


def test_the_third_row_of_the_printed_linear_model_is_wrong_and_the_others_are_right():
    A, B = (np.asarray(matrix) for matrix in cpjax.linearize(APPENDIX))
    printed_A, printed_B = printed_linear_model()
    np.testing.assert_allclose(B, printed_B, rtol=1e-12)
    np.testing.assert_allclose(A[[0, 1, 3]], printed_A[[0, 1, 3]], rtol=1e-12)
    np.testing.assert_array_equal(A[2], [0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(printed_A[2] - A[2], [0.0, 4.905, 0.0, 0.0], rtol=1e-12)


def test_the_printed_gains_do_not_come_from_the_printed_linear_model_either():
    A, B = printed_linear_model()
    P = solve_continuous_are(A, B, np.diag(paper.Q), np.array([[paper.R]]))
    gains = {"placement": place_poles(A, B, paper.POLES).gain_matrix[0], "lqr": (B.T @ P)[0] / paper.R}
    for design, gain in gains.items():
        assert np.max(np.abs(gain - paper.PRINTED_GAINS[design])) > 80.0


# Section IV-B: the regulator


def test_the_printed_lqr_gain_solves_one_riccati_equation_with_constant_coefficients():
    A, B = (np.asarray(matrix) for matrix in cpjax.linearize(IDENTIFIED))
    Q, weight = np.diag(paper.Q), np.array([[paper.R]])
    P = paper.riccati_solution(IDENTIFIED)
    residual = A.T @ P + P @ A - P @ B @ B.T @ P / paper.R + Q
    assert np.max(np.abs(residual)) < 1e-6 * np.max(np.abs(A.T @ P + P @ A))
    np.testing.assert_allclose((B.T @ P / paper.R)[0], paper.PRINTED_GAINS["lqr"], atol=HALF_DIGIT)

    th = paper.SWITCH_ANGLE  # the same equation with sin(theta) / theta and cos(theta) left in: another gain
    sin, cos = math.sin(th), math.cos(th)
    moving = M + m * sin**2
    drag, push = -IDENTIFIED.motor.damping / moving, IDENTIFIED.motor.force_per_voltage / moving
    pull, tip = m * g * cos * sin / th / moving, (M + m) * g * sin / th / (l * moving)
    A = np.array([[0, 1, 0, 0], [0, drag, pull, 0], [0, 0, 0, 1], [0, drag * cos / l, tip, 0]])
    B = np.array([[0.0], [push], [0.0], [push * cos / l]])
    there = (B.T @ solve_continuous_are(A, B, Q, weight))[0] / paper.R
    assert there[2] - paper.PRINTED_GAINS["lqr"][2] > 200.0  # V/rad


def test_the_printed_weight_makes_voltage_cheap_and_not_small():
    A, B = (np.asarray(matrix) for matrix in cpjax.linearize(APPENDIX))
    largest = [
        np.max(np.abs(B.T @ solve_continuous_are(A, B, np.diag(paper.Q), np.array([[weight]])) / weight))
        for weight in (paper.R, 1.0)
    ]
    assert largest[0] > 15.0 * largest[1]
    assert round(largest[0] / max(map(abs, paper.PRINTED_GAINS["placement"]))) == 43


# Section IV-C: the energy law


def test_the_printed_energy_rate_has_the_wrong_sign_for_this_theta():
    for q, v, (x_ddot, _) in POINTS:
        s = state(q, v)
        holds = m * l * x_ddot * s.theta_dot * np.cos(s.theta)
        assert rate_under_acceleration(energy, s, x_ddot) == pytest.approx(holds, rel=1e-10, abs=1e-12)
        assert rate_under_acceleration(energy, s, x_ddot) != pytest.approx(-holds, rel=0.1)  # as printed


def test_the_printed_law_drives_the_energy_away_and_the_opposite_sign_drives_it_back():
    for q, v, _ in POINTS:
        s = state(q, v)
        command = paper.ENERGY_GAIN * energy(s) * s.theta_dot * jnp.cos(s.theta)
        assert rate_under_acceleration(lambda s: 0.5 * energy(s) ** 2, s, command) > 0.0
        assert rate_under_acceleration(lambda s: 0.5 * energy(s) ** 2, s, -command) < 0.0


def test_the_printed_energy_error_is_no_energy_and_never_negative():
    for q, v, _ in POINTS:
        s = state(q, v)
        assert rate_under_acceleration(energy, s, 0.0) == pytest.approx(0.0, abs=1e-12)  # swings freely: conserved
        assert abs(rate_under_acceleration(printed_energy_error, s, 0.0)) > 1e-2
        assert printed_energy_error(s) > 0.0
        assert float(energy(s)) == pytest.approx(float(APPENDIX.pendulum_energy(s)), rel=1e-12)
    hanging, upright = (jax.tree.map(jnp.asarray, s) for s in (cpjax.HANGING, cpjax.UPRIGHT))
    assert float(printed_energy_error(hanging)) == pytest.approx(2 * m * g * l)  # 6.867 J too much
    assert float(energy(hanging)) == pytest.approx(-2 * m * g * l)  # 6.867 J too little
    assert float(printed_energy_error(upright)) == float(energy(upright)) == 0.0


def test_two_thirds_belongs_to_a_uniform_rod_and_one_half_to_a_point_bob():
    turning = cpjax.State(0.0, 0.0, 0.0, 1.0)  # upright: no potential energy
    rod = cpjax.CartPole.rod(mass=m, length=2 * l)
    assert float(rod.pendulum_energy(turning)) == pytest.approx(2.0 / 3.0 * m * l * l, rel=1e-12)
    assert float(APPENDIX.pendulum_energy(turning)) == pytest.approx(1.0 / 2.0 * m * l * l, rel=1e-12)


@pytest.mark.parametrize("plant", [APPENDIX, IDENTIFIED], ids=["appendix", "identified"])
def test_the_laws_output_is_an_acceleration_and_needs_inversion_to_a_voltage(plant):
    law = paper.LAWS["corrected"](plant)
    for q, v, _ in POINTS:
        s = state(q, v)
        wanted = -paper.ENERGY_GAIN * float(energy(s)) * s.theta_dot * math.cos(s.theta)
        sin, cos = math.sin(s.theta), math.cos(s.theta)
        reaction = m * l * s.theta_dot**2 * sin - m * g * sin * cos
        voltage = (M + m * sin**2) * wanted + plant.motor.damping * s.x_dot + reaction
        voltage /= plant.motor.force_per_voltage
        assert float(law.voltage(s)) == pytest.approx(voltage, rel=1e-10, abs=1e-12)
        assert float(plant.vector_field(s, voltage).x_dot) == pytest.approx(wanted, rel=1e-9, abs=1e-12)
    # With the bob at rest it asks the pivot to keep still. Fed to the motor, that is 0 V: the bob pushes the cart away.
    s = cpjax.State(0.0, 0.0, 2.0, 0.0)
    assert float(law.acceleration(s)) == 0.0
    assert float(plant.vector_field(s, law.voltage(s)).x_dot) == pytest.approx(0.0, abs=1e-12)
    assert float(plant.vector_field(s, 0.0).x_dot) == pytest.approx(-1.313, abs=1e-3)


def test_the_printed_lyapunov_rate_holds_only_for_an_unsaturated_exact_acceleration():
    def lyapunov_rate(plant, law, s):
        applied = plant.motor.saturate(law.voltage(s))
        return float(jax.jvp(lambda s: 0.5 * energy(s) ** 2, (s,), (plant.vector_field(s, applied),))[1])

    def claimed(s):
        return -m * l * paper.ENERGY_GAIN * float(energy(s) * s.theta_dot * jnp.cos(s.theta)) ** 2

    exact, direct = paper.LAWS["corrected"](APPENDIX), paper.CorrectedSwingUpAsVoltage(APPENDIX)
    printed = paper.PrintedSwingUp(APPENDIX)
    for q, v, _ in POINTS:
        s = jax.tree.map(jnp.asarray, state(q, v))
        assert abs(float(exact.voltage(s))) < 12.0
        assert lyapunov_rate(APPENDIX, exact, s) == pytest.approx(claimed(s), rel=1e-9)
        for law in (direct, printed):
            assert lyapunov_rate(APPENDIX, law, s) != pytest.approx(claimed(s), rel=0.1)
    # On the way up with just less than the energy wanted, the bob pulls at the cart with more than 12 V can resist.
    s = cpjax.State(*map(jnp.asarray, (0.0, 0.0, math.radians(124.0), -6.5)))
    assert float(energy(s)) < 0.0
    assert abs(float(exact.voltage(s))) > 12.0
    assert claimed(s) < 0.0 < lyapunov_rate(APPENDIX, exact, s)


# Appendix: units


def test_units_in_print_do_not_fit_the_equations_they_stand_in():
    kilogram, metre, second, ampere = np.eye(4, dtype=int)  # exponents; a radian has none
    newton = kilogram + metre - 2 * second
    volt = newton + metre - second - ampere
    ohm = volt - ampere
    k_T = newton + metre - ampere  # as printed
    friction = newton + metre + second  # torque per rad/s: what B_m and k_V k_T / R have to be
    printed_k_V, holds_k_V = -second - volt, volt + second
    assert np.any(printed_k_V + k_T - ohm != friction)
    np.testing.assert_array_equal(holds_k_V + k_T - ohm, friction)
    np.testing.assert_array_equal(holds_k_V, k_T)  # in SI one constant: see the power balance below
    printed_B_m = newton + metre
    assert np.any(printed_B_m != friction)
    printed_g, holds_g = metre - second, metre - 2 * second
    assert np.any(kilogram + printed_g != newton)
    np.testing.assert_array_equal(kilogram + holds_g, newton)
    J_m, r = kilogram + 2 * metre, metre
    assert np.any(J_m != kilogram)  # printed beside m_1 in M(q)
    np.testing.assert_array_equal(J_m - 2 * r, kilogram)


def test_a_motor_with_unequal_constants_creates_power():
    def balance(plant, current, x_dot):
        """(electrical power in, mechanical power out at the wheel) [W]."""
        motor = plant.motor
        voltage = motor.resistance * current + motor.back_emf_constant * x_dot
        assert motor.current(voltage, x_dot) == pytest.approx(current, rel=1e-12)
        return voltage * current, motor.force(voltage, x_dot) * x_dot

    for plant, made in ((APPENDIX, 0.25), (IDENTIFIED, 1.298075 - 1.858579)):
        for current, x_dot in ((0.5, 5.0), (-0.5, 5.0), (3.0, -1.0)):
            electrical, mechanical = balance(plant, current, x_dot)
            heat = plant.motor.resistance * current**2 + plant.motor.viscous_friction * x_dot**2
            assert mechanical + heat - electrical == pytest.approx(made * current * x_dot, rel=1e-5)
    electrical, mechanical = balance(APPENDIX, 0.5, 5.0)  # driving: more comes out at the wheel than goes in
    assert mechanical > electrical > 0.0
    electrical, mechanical = balance(IDENTIFIED, -0.5, 5.0)  # braking: more comes back than the wheel gives
    assert electrical < mechanical < 0.0
