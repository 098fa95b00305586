import math

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import rough_plant, wheel_force

from cpjax import InputError, State, linearize, paper
from cpjax.pytree import cast


def corrected_appendix(plant):
    """A_lin and B_lin of the paper's appendix with its sign errors corrected: point bob, r = n = 1, no friction."""
    k_t, k_v, b_m = plant.motor.torque_constant, plant.motor.back_emf_constant, plant.motor.viscous_friction
    r, l, g, m = plant.motor.resistance, plant.pole_length, plant.gravity, plant.pole_mass
    m_c = plant.motor.rotor_inertia + plant.cart_mass
    drag = (k_t * k_v + b_m * r) / (r * m_c)
    A = [[0, 1, 0, 0], [0, -drag, g * m / m_c, 0], [0, 0, 0, 1], [0, -drag / l, g * (m_c + m) / (l * m_c), 0]]
    return np.array(A), np.array([[0], [k_t / (r * m_c)], [0], [k_t / (r * l * m_c)]])


@pytest.mark.parametrize("plant", [paper.appendix_plant(), paper.identified_plant()], ids=["appendix", "identified"])
def test_the_upright_linearisation_is_the_corrected_appendix(plant):
    model = linearize(plant)
    A, B = corrected_appendix(plant)
    assert (model.A.shape, model.B.shape) == ((4, 4), (4, 1))
    assert np.max(np.abs(model.A - A)) <= 1e-12
    assert np.max(np.abs(model.B - B)) <= 1e-12


def equations_about(plant, side):
    """A and B of any plant about cos(theta) = side, from the mass matrix and the loads' first-order terms."""
    ml = plant.pole_mass * plant.pole_length
    total = plant.cart_mass + plant.pole_mass + plant.motor.reflected_mass
    mass = np.array([[total, -ml * side], [-ml * side, plant.pole_inertia + ml * plant.pole_length]])
    drag = plant.cart_friction - wheel_force(plant, 1.0, 0.0)
    loads = np.array([[0, -drag, 0, 0], [0, 0, ml * plant.gravity * side, -plant.pivot_friction]])
    push = np.array([[wheel_force(plant, 0.0, 1.0)], [0.0]])
    rows, column = np.linalg.solve(mass, loads), np.linalg.solve(mass, push)
    A = np.array([[0, 1, 0, 0], rows[0], [0, 0, 0, 1], rows[1]])
    return A, np.array([[0.0], column[0], [0.0], column[1]])


@pytest.mark.parametrize(
    ("equilibrium", "side"),
    [("upright", 1.0), ("hanging", -1.0), (State(2.0, 0.0, -math.pi, 0.0), -1.0), (State(-1.0, 0.0, 0.0, 0.0), 1.0)],
)
def test_the_linearisation_is_that_of_the_equations_of_motion_at_either_equilibrium(equilibrium, side):
    model = linearize(rough_plant(), equilibrium)
    A, B = equations_about(rough_plant(), side)
    assert np.max(np.abs(model.A - A)) <= 1e-12
    assert np.max(np.abs(model.B - B)) <= 1e-12


def test_the_hanging_linearisation_is_stable_and_the_upright_one_is_not():
    assert np.max(np.linalg.eigvals(linearize(rough_plant(), "upright").A).real) > 1.0
    assert np.max(np.linalg.eigvals(linearize(rough_plant(), "hanging").A).real) < 1e-12


@pytest.mark.parametrize(
    "state", [State(0.0, 0.0, 0.1, 0.0), State(0.0, 0.5, 0.0, 0.0), State(0.0, 0.0, math.pi, 0.1), "sideways"]
)
def test_where_something_moves_there_is_nothing_to_linearise_about(state):
    with pytest.raises(InputError, match="equilibrium"):
        linearize(paper.appendix_plant(), state)


@pytest.mark.parametrize("equilibrium", ["upright", "hanging"])
def test_a_float32_plant_is_linearised_in_float32(equilibrium):
    model = linearize(cast(paper.appendix_plant(), jnp.float32), equilibrium)
    assert (model.A.dtype, model.B.dtype) == (jnp.float32, jnp.float32)
    wide = linearize(paper.appendix_plant(), equilibrium)
    assert wide.A.dtype == jnp.float64
    np.testing.assert_allclose(model.A, wide.A, rtol=1e-5, atol=1e-5)
