import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from jax.flatten_util import ravel_pytree
from oracles import random_plants, random_problem, rough_plant

import cpjax
from cpjax import HANGING, UPRIGHT, CartPole, Motor, State, StateFeedback, paper
from cpjax.plant import parameters_of
from cpjax.sim.integrators import rk4

UGLY_STATES = [
    HANGING,
    UPRIGHT,
    State(0.0, 0.0, -math.pi, 0.0),
    State(1.0, 0.0, 2.0 * math.pi, 0.0),
    State(0.0, 0.0, math.pi / 2, 0.0),
    State(0.0, -3.0, math.pi, 0.0),
    State(0.0, 0.0, -math.pi, 8.0),
]


def relative_error(got, expected):
    """The largest distance of two batches of vectors, relative to each vector's norm."""
    got, expected = np.asarray(got), np.asarray(expected)
    return np.max(np.linalg.norm(got - expected, axis=-1) / np.linalg.norm(expected, axis=-1))


def energies(plant, q, v):
    """Kinetic and potential energy from where the masses are: q = (x, theta), v = q'."""
    motor = plant.motor

    def bob(q):
        return jnp.stack([q[0] - plant.pole_length * jnp.sin(q[1]), plant.pole_length * jnp.cos(q[1])])

    place, velocity = jax.jvp(bob, (q,), (v,))
    rotor_speed = motor.gear_ratio * v[0] / motor.wheel_radius
    turning = 0.5 * plant.pole_inertia * v[1] ** 2 + 0.5 * motor.rotor_inertia * rotor_speed**2
    kinetic = 0.5 * plant.cart_mass * v[0] ** 2 + 0.5 * plant.pole_mass * jnp.sum(velocity**2) + turning
    return kinetic, plant.pole_mass * plant.gravity * place[1]


def coordinates(state):
    return jnp.stack([state.x, state.theta]), jnp.stack([state.x_dot, state.theta_dot])


def euler_lagrange(plant, state, voltage):
    """State's derivative from d/dt dL/dv - dL/dq = Q, with the derivatives of L taken by JAX."""
    q, v = coordinates(state)

    def lagrangian(q, v):
        kinetic, potential = energies(plant, q, v)
        return kinetic - potential

    wheels = oracles.wheel_force(plant, state.x_dot, voltage)
    loads = jnp.stack([wheels - plant.cart_friction * v[0], -plant.pivot_friction * v[1]])
    mass = jax.hessian(lagrangian, argnums=1)(q, v)
    momentum_by_q = jax.jacfwd(jax.grad(lagrangian, argnums=1), argnums=0)(q, v)
    acceleration = jnp.linalg.solve(mass, jax.grad(lagrangian)(q, v) + loads - momentum_by_q @ v)
    return jnp.stack([v[0], acceleration[0], v[1], acceleration[1]])


def test_the_vector_field_equals_the_euler_lagrange_equations():
    problem = random_problem(1)
    got = jax.jit(jax.vmap(CartPole.vector_field))(*problem).vector()
    assert got.shape == (1000, 4)
    error = relative_error(got, jax.jit(jax.vmap(euler_lagrange))(*problem))
    assert error <= 1e-12


def test_the_accelerations_alone_equal_the_euler_lagrange_equations():
    # The norm above includes the velocities, which are equal by construction.
    problem = random_problem(4)
    got = jax.vmap(CartPole.vector_field)(*problem).vector()
    error = relative_error(got[:, 1::2], jax.vmap(euler_lagrange)(*problem)[:, 1::2])
    assert error <= 1e-12


def test_energies_are_those_of_the_masses_positions_and_velocities():
    plants, states, _ = random_problem(7)
    kinetic, potential = jax.vmap(lambda plant, state: energies(plant, *coordinates(state)))(plants, states)
    weight = plants.pole_mass * plants.gravity * plants.pole_length
    scale = np.asarray(kinetic + weight)
    for got, expected in (
        (jax.vmap(CartPole.kinetic_energy)(plants, states), kinetic),
        (jax.vmap(CartPole.potential_energy)(plants, states), potential),
        (jax.vmap(CartPole.total_energy)(plants, states), kinetic + potential),
    ):
        assert np.max(np.abs(got - expected) / scale) <= 1e-14


def test_the_pendulum_energy_is_zero_upright_and_minus_two_weights_hanging():
    plants = random_plants(1000, 10)
    weight = np.asarray(plants.pole_mass * plants.gravity * plants.pole_length)
    pendulum = jax.vmap(CartPole.pendulum_energy, in_axes=(0, None))
    np.testing.assert_allclose(pendulum(plants, UPRIGHT), 0.0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(pendulum(plants, HANGING), -2.0 * weight, rtol=1e-15)


def test_the_pendulum_energy_is_the_total_energy_above_upright_of_a_cart_at_rest():
    plants, states, _ = random_problem(11)
    states = replace(states, x_dot=jnp.zeros(1000))
    weight = plants.pole_mass * plants.gravity * plants.pole_length
    got = jax.vmap(CartPole.pendulum_energy)(plants, states)
    expected = jax.vmap(CartPole.total_energy)(plants, states) - weight
    assert np.max(np.abs(got - expected) / (jax.vmap(CartPole.kinetic_energy)(plants, states) + weight)) <= 1e-14


def forceless(plant):
    """`plant` with nothing that takes energy out or puts it in."""
    motor = replace(plant.motor, back_emf_constant=0.0, viscous_friction=0.0)
    return replace(plant, cart_friction=0.0, pivot_friction=0.0, motor=motor)


@pytest.mark.parametrize("plant", [paper.appendix_plant(), rough_plant()], ids=["appendix", "rough"])
def test_without_drive_and_friction_the_total_energy_is_conserved(plant):
    plant = forceless(plant)
    weight = plant.pole_mass * plant.gravity * plant.pole_length
    starts = State(
        x=jnp.zeros(4),
        x_dot=jnp.asarray([0.0, 0.5, -1.0, 0.3]),
        theta=jnp.asarray([3.0, 2.0, 0.2, 0.0]),
        theta_dot=jnp.asarray([0.5, -1.0, 0.0, 3.0]),
    )
    rest = StateFeedback([0.0, 0.0, 0.0, 0.0])
    run = jax.vmap(lambda start: cpjax.rollout(plant, rest, start, clock="continuous", duration=10.0, dt=1e-3).state)(
        starts
    )
    assert np.all(np.ptp(run.theta, axis=1) > 0.3)  # it did swing
    energy = jax.vmap(jax.vmap(lambda state: sum(energies(plant, *coordinates(state)))))(run)
    assert np.max(np.abs(energy - energy[:, :1])) <= 1e-9 * weight
    np.testing.assert_allclose(plant.total_energy(run), energy, rtol=0, atol=1e-13 * weight)


def test_the_work_of_the_wheels_is_what_is_stored_and_what_friction_takes():
    plant = rough_plant()
    weight = plant.pole_mass * plant.gravity * plant.pole_length

    # Work and loss ride along as velocities, and so does the clock, so that all are integrated by one method.
    def acceleration(q, v):
        x, theta, _, _, time = q
        x_dot, theta_dot, _, _, _ = v
        state = State(x, x_dot, theta, theta_dot)
        voltage = 10.0 * jnp.sin(5.0 * time) + 4.0 * jnp.cos(1.3 * time)
        rate = plant.vector_field(state, voltage)
        power = oracles.wheel_force(plant, x_dot, voltage) * x_dot
        return rate.x_dot, rate.theta_dot, power, plant.dissipated_power(state), 0.0 * time

    def step(carry, _):
        q, v = carry
        energy = sum(energies(plant, jnp.stack(q[:2]), jnp.stack(v[:2])))
        return rk4(acceleration, q, v, 1e-3), jnp.stack([energy, v[2], v[3]])

    start = jax.tree.map(jnp.asarray, ((0.0, math.pi, 0.0, 0.0, 0.0), (0.0, 0.1, 0.0, 0.0, 1.0)))
    _, history = jax.lax.scan(step, start, length=10_001)
    energy, work, loss = np.asarray(history).T
    assert min(np.ptp(energy), np.ptp(work), loss[-1]) > 1.0 * weight  # all three matter
    assert np.max(np.abs(work - (energy - energy[0]) - loss)) <= 1e-6 * weight


def test_friction_takes_power_in_proportion_to_the_squared_rates():
    plants, states, _ = random_problem(14)
    expected = plants.cart_friction * states.x_dot**2 + plants.pivot_friction * states.theta_dot**2
    np.testing.assert_allclose(jax.vmap(CartPole.dissipated_power)(plants, states), expected, rtol=1e-15)


def test_the_force_for_an_acceleration_is_the_force_that_yields_it():
    plants, states, voltages = random_problem(26)
    forces = jax.vmap(Motor.force)(plants.motor, voltages, states.x_dot)
    x_ddot = jax.vmap(CartPole.vector_field)(plants, states, voltages).x_dot
    back = jax.vmap(CartPole.force_for_acceleration)(plants, states, x_ddot)
    inertial = (plants.cart_mass + plants.pole_mass) * np.abs(x_ddot)
    centrifugal = plants.pole_mass * plants.pole_length * states.theta_dot**2
    assert np.max(np.abs(back - forces) / (np.abs(forces) + inertial + centrifugal)) <= 1e-13


def test_a_rod_has_the_energy_of_its_parts():
    plant = CartPole.rod(mass=0.8, length=1.4, cart_mass=0.9, gravity=3.7, pivot_friction=0.02)
    assert (plant.cart_mass, plant.gravity, plant.pivot_friction) == (0.9, 3.7, 0.02)
    state = State(0.3, -1.1, 2.2, 3.3)
    # Two Gauss points along the rod integrate its squared velocity exactly.
    parts = [0.7 * (1.0 + side / math.sqrt(3.0)) for side in (-1.0, 1.0)]
    speeds = [
        (state.x_dot - s * state.theta_dot * math.cos(state.theta)) ** 2
        + (s * state.theta_dot * math.sin(state.theta)) ** 2
        for s in parts
    ]
    kinetic = 0.5 * (0.9 + plant.motor.reflected_mass) * state.x_dot**2 + 0.5 * sum(0.4 * v for v in speeds)
    potential = sum(0.4 * 3.7 * s * math.cos(state.theta) for s in parts)
    assert float(plant.kinetic_energy(state)) == pytest.approx(kinetic, rel=1e-14)
    assert float(plant.potential_energy(state)) == pytest.approx(potential, rel=1e-14)
    assert plant.pivot_inertia == pytest.approx(0.8 * 1.4**2 / 3, rel=1e-15)


def check_derivatives(problems):
    """Forward, reverse and finite differences agree for a batch of (plant, state, voltage), in every argument."""
    _, unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], problems))
    points = jax.vmap(lambda problem: ravel_pytree(problem)[0])(problems)

    def field(point):
        plant, state, voltage = unravel(point)
        return plant.vector_field(state, voltage).vector()

    # Parameters are varied in proportion to themselves, for some are small; all else by an absolute amount.
    def unit_of(problem):
        plant, *others = problem
        relative = jax.tree.map(lambda value: jnp.where(value == 0.0, 1.0, value), plant)
        return ravel_pytree((relative, *jax.tree.map(jnp.ones_like, others)))[0]

    units = jax.vmap(unit_of)(problems)

    def central(point, unit, h):
        steps = h * jnp.diag(unit)
        return jax.vmap(lambda step: (field(point + step) - field(point - step)) / (2.0 * h), out_axes=1)(steps)

    def richardson(point, unit):
        return (4.0 * central(point, unit, 0.5e-3) - central(point, unit, 1e-3)) / 3.0

    forward, reverse = (jax.jit(jax.vmap(mode(field)))(points) for mode in (jax.jacfwd, jax.jacrev))
    assert forward.shape == (len(points), 4, 4 + 1 + len(parameters_of(paper.appendix_plant())))
    scaled, differences = forward * units[:, None, :], jax.jit(jax.vmap(richardson))(points, units)
    norm = np.linalg.norm(scaled, axis=(1, 2), keepdims=True)
    assert np.max(np.abs(forward - reverse) * units[:, None, :] / norm) <= 1e-14
    assert np.max(np.abs(scaled - differences) / norm) <= 1e-8
    alone = jax.jit(jax.jacfwd(field))
    for point, batched in zip(points[:5], forward[:5], strict=True):
        assert np.max(np.abs(alone(point) - batched)) <= 1e-13 * np.max(np.abs(batched))


def test_forward_reverse_and_finite_difference_derivatives_agree():
    check_derivatives(random_problem(29))


@pytest.mark.parametrize("plant", [paper.appendix_plant(), rough_plant()], ids=["appendix", "rough"])
def test_derivatives_agree_at_rest_and_on_whole_half_turns(plant):
    many = [(plant, state, voltage) for state in UGLY_STATES for voltage in (0.0, -7.0)]
    check_derivatives(jax.tree.map(lambda *leaves: jnp.asarray(leaves), *many))
