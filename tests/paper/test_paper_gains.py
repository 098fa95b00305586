"""The paper's printed gains against its printed parameters, and the plant that they do follow from."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are
from scipy.signal import place_poles

import cpjax
from cpjax import paper

APPENDIX, IDENTIFIED = paper.appendix_plant(), paper.identified_plant()
M, m, l, g = APPENDIX.moving_mass, APPENDIX.pole_mass, APPENDIX.pole_length, APPENDIX.gravity
HALF_DIGIT = 0.005  # the gains are printed with two decimals


def test_the_identified_plant_differs_from_the_appendix_in_two_numbers():
    motor = APPENDIX.motor
    assert (APPENDIX.cart_mass, APPENDIX.pole_mass, APPENDIX.pole_length, APPENDIX.gravity) == (1.0, 0.5, 0.7, 9.81)
    assert (APPENDIX.pole_inertia, APPENDIX.cart_friction, APPENDIX.pivot_friction) == (0.0, 0.0, 0.0)
    assert (motor.torque_constant, motor.back_emf_constant, motor.resistance) == (1.25, 1.0, 1.25)
    assert (motor.rotor_inertia, motor.viscous_friction, motor.voltage_limit) == (7e-6, 1e-5, 12.0)
    assert (motor.wheel_radius, motor.gear_ratio) == (1.0, 1.0)

    assert IDENTIFIED.motor.force_per_voltage == pytest.approx(1.03846, rel=1e-12)
    assert IDENTIFIED.motor.damping == pytest.approx(1.93007, rel=1e-12)
    assert IDENTIFIED.motor.torque_constant == pytest.approx(1.29808, abs=5.1e-6)
    assert IDENTIFIED.motor.back_emf_constant == pytest.approx(1.8586, abs=5e-5)
    differing = {"torque_constant", "back_emf_constant"}
    for field in dataclasses.fields(motor):
        same = getattr(motor, field.name) == getattr(IDENTIFIED.motor, field.name)
        assert same == (field.name not in differing)
    for field in dataclasses.fields(APPENDIX):
        if field.name != "motor":
            assert getattr(APPENDIX, field.name) == getattr(IDENTIFIED, field.name)


@pytest.mark.slow
def test_the_gains_computed_from_the_appendix_are_not_the_printed_ones():
    computed = {"placement": (-25.688, -25.404, 115.997, 29.683), "lqr": (-1414.214, -1179.574, 4797.709, 967.239)}
    for design, values in computed.items():
        gain = np.asarray(paper.computed_gain(design, APPENDIX))[0]
        np.testing.assert_allclose(gain, values, rtol=0, atol=5e-4)
        off = np.abs(gain - paper.PRINTED_GAINS[design]) > HALF_DIGIT
        assert off.tolist() == [design != "lqr", True, True, True]


@pytest.mark.slow
def test_the_first_lqr_gain_says_nothing_about_the_plant():
    for plant in (APPENDIX, IDENTIFIED, dataclasses.replace(APPENDIX, pole_length=0.5, pole_mass=0.3)):
        first = paper.computed_gain("lqr", plant)[0, 0]
        assert first == pytest.approx(-math.sqrt(paper.Q[0] / paper.R), rel=1e-8)


def test_every_printed_gain_follows_from_the_identified_plant_to_its_last_digit():
    residuals = np.stack(
        [np.asarray(paper.computed_gain(d, IDENTIFIED))[0] - paper.PRINTED_GAINS[d] for d in paper.PRINTED_GAINS]
    )
    in_half_digits = np.abs(residuals) / HALF_DIGIT
    expected = [[0.63, 0.28, 0.28, 0.69], [0.71, 0.30, 0.41, 0.37]]
    np.testing.assert_allclose(in_half_digits, expected, rtol=0, atol=0.006)


def test_the_printed_gains_fix_force_per_volt_to_four_decimals_and_damping_to_two():
    def misfit(force_per_voltage, damping):
        """Largest residual of the eight gains, in half digits."""
        drag, push = -damping / M, force_per_voltage / M
        A = np.array([[0, 1, 0, 0], [0, drag, g * m / M, 0], [0, 0, 0, 1], [0, drag / l, g * (M + m) / (l * M), 0]])
        B = np.array([[0.0], [push], [0.0], [push / l]])
        P = solve_continuous_are(A, B, np.diag(paper.Q), np.array([[paper.R]]))
        gains = np.stack([place_poles(A, B, paper.POLES).gain_matrix[0], (B.T @ P)[0] / paper.R])
        return np.max(np.abs(gains - list(paper.PRINTED_GAINS.values()))) / HALF_DIGIT

    def best(damping):
        return min(misfit(b, damping) for b in np.arange(1.03836, 1.03857, 1e-5))

    def best_at_force(force_per_voltage):
        return min(misfit(force_per_voltage, d) for d in np.arange(1.915, 1.9451, 1e-3))

    assert misfit(1.03846, 1.93007) == pytest.approx(0.71, abs=0.006)
    assert max(best(1.926), best(1.934)) < 1.0 < min(best(1.925), best(1.935))
    assert best_at_force(1.03846) < 1.0 < min(best_at_force(1.03836), best_at_force(1.03856))


def test_the_printed_gains_leave_resistance_and_the_split_of_the_constants_open():
    force_per_voltage, friction = IDENTIFIED.motor.force_per_voltage, IDENTIFIED.motor.viscous_friction
    resistance = (IDENTIFIED.motor.damping - friction) / force_per_voltage**2
    assert resistance == pytest.approx(1.790, abs=5e-4)
    motor = dataclasses.replace(
        IDENTIFIED.motor,
        resistance=resistance,
        torque_constant=force_per_voltage * resistance,
        back_emf_constant=IDENTIFIED.motor.back_emf_constant,
    )
    assert motor.torque_constant == pytest.approx(motor.back_emf_constant, rel=1e-12)  # a motor that creates nothing
    for matrix, same in zip(
        cpjax.linearize(dataclasses.replace(IDENTIFIED, motor=motor)), cpjax.linearize(IDENTIFIED), strict=True
    ):
        np.testing.assert_allclose(matrix, same, rtol=1e-12)


def test_the_printed_placement_gain_places_other_poles_than_its_design():
    expected = {
        "appendix": (APPENDIX, [-5.262 - 3.942j, -5.262 + 3.942j, -3.875, -2.070]),
        "identified": (IDENTIFIED, [-5.693, -5.408, -3.872, -3.020]),  # rounding of the printed gain alone
    }
    for plant, poles in expected.values():
        A, B = (np.asarray(matrix) for matrix in cpjax.linearize(plant))
        found = np.sort_complex(np.linalg.eigvals(A - B @ np.array([paper.PRINTED_GAINS["placement"]])))
        np.testing.assert_allclose(found, np.sort_complex(poles), rtol=0, atol=6e-4)
