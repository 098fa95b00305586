"""What the tests compare cpjax with, written from the physics in NumPy; of cpjax it reads parameters only."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from cpjax import CartPole, Motor, State

NAMES = ("x", "x_dot", "theta", "theta_dot")


def random_plants(count, seed):
    """A batch of plants in which every parameter named here differs from its default and from every other plant's."""
    rng = np.random.default_rng(seed)

    def between(low, high):
        return jnp.asarray(np.exp(rng.uniform(math.log(low), math.log(high), count)))

    motor = Motor(
        torque_constant=between(0.3, 3.0),
        back_emf_constant=between(0.3, 3.0),
        resistance=between(0.5, 4.0),
        rotor_inertia=between(1e-3, 0.3),
        viscous_friction=between(1e-3, 0.3),
        wheel_radius=between(0.3, 2.0),
        gear_ratio=between(0.3, 3.0),
        voltage_limit=between(6.0, 24.0),
    )
    plants = CartPole(
        cart_mass=between(0.3, 3.0),
        pole_mass=between(0.1, 1.5),
        pole_length=between(0.2, 1.5),
        gravity=between(1.6, 25.0),
        pole_inertia=between(1e-3, 0.3),
        cart_friction=between(0.01, 1.0),
        pivot_friction=between(1e-3, 0.1),
        motor=motor,
    )
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count,)), plants)


def random_states(count, seed):
    rng = np.random.default_rng(seed)
    return State(*(jnp.asarray(rng.uniform(-size, size, count)) for size in (2.0, 3.0, 4.0 * math.pi, 8.0)))


def random_problem(seed, count=1000):
    """Plants, states and voltages, each a batch."""
    voltages = jnp.asarray(np.random.default_rng(seed + 2).uniform(-24.0, 24.0, count))
    return random_plants(count, seed), random_states(count, seed + 1), voltages


def rough_plant():
    """One plant in which nothing vanishes and no two parameters could be mistaken for each other."""
    motor = Motor(
        torque_constant=0.9,
        back_emf_constant=0.7,
        resistance=1.4,
        rotor_inertia=0.02,
        viscous_friction=0.03,
        wheel_radius=0.8,
        gear_ratio=1.7,
    )
    return CartPole(
        cart_mass=1.1,
        pole_mass=0.4,
        pole_length=0.6,
        gravity=9.7,
        pole_inertia=0.05,
        cart_friction=0.21,
        pivot_friction=0.013,
        motor=motor,
    )


def columns(state):
    """A State of (n,) arrays as a NumPy array (n, 4)."""
    return np.stack([np.asarray(getattr(state, name)) for name in NAMES], axis=-1)


def wheel_force(plant, x_dot, voltage):
    motor = plant.motor
    rotor_speed = motor.gear_ratio * x_dot / motor.wheel_radius
    current = (voltage - motor.back_emf_constant * rotor_speed) / motor.resistance
    rotor_torque = motor.torque_constant * current - motor.viscous_friction * rotor_speed
    return motor.gear_ratio * rotor_torque / motor.wheel_radius


def equations_of_motion(plant, s):
    """Mass matrix, and everything but the wheels' force on the other side, for the coordinates (x, theta)."""
    _, x_dot, theta, theta_dot = s
    motor = plant.motor
    sin, cos = math.sin(theta), math.cos(theta)
    rotor = motor.rotor_inertia * (motor.gear_ratio / motor.wheel_radius) ** 2
    ml = plant.pole_mass * plant.pole_length
    total = plant.cart_mass + plant.pole_mass + rotor
    mass = np.array([[total, -ml * cos], [-ml * cos, plant.pole_inertia + ml * plant.pole_length]])
    loads = np.array(
        [
            -plant.cart_friction * x_dot - ml * sin * theta_dot**2,
            ml * plant.gravity * sin - plant.pivot_friction * theta_dot,
        ]
    )
    return mass, loads


def derivative(plant, s, voltage):
    mass, loads = equations_of_motion(plant, s)
    loads[0] += wheel_force(plant, s[1], voltage)
    x_ddot, theta_ddot = np.linalg.solve(mass, loads)
    return np.array([s[1], x_ddot, s[3], theta_ddot])


def oracle_of(plant, law):
    """The NumPy form of a Hybrid with a corrected, centred law, a gain and an angle gate, with this plant as model."""
    names = ("energy_gain", "cart_stiffness", "cart_damping", "kick", "kick_radius")
    terms = {name: getattr(law.swing_up, name) for name in names}
    return HybridOracle(plant, law.regulator.K, law.gate.half_angle, **terms)


class HybridOracle:
    """The corrected swing-up law, a linear law and an angle gate without hysteresis, on the law's own plant."""

    def __init__(self, plant, gain, half_angle, *, energy_gain, cart_stiffness, cart_damping, kick, kick_radius):
        self.plant, self.gain, self.half_angle = plant, np.ravel(gain), half_angle
        self.energy_gain, self.stiffness, self.damping = energy_gain, cart_stiffness, cart_damping
        self.kick, self.kick_radius = kick, kick_radius

    def margin(self, s):
        return math.cos(s[2]) - math.cos(self.half_angle)

    def voltage(self, s, regulating):
        """Demanded voltage clipped to the supply."""
        demand = self.regulate(s) if regulating else self.swing_up(s)
        return min(max(demand, -self.plant.motor.voltage_limit), self.plant.motor.voltage_limit)

    def regulate(self, s):
        x, x_dot, theta, theta_dot = s
        return -float(self.gain @ [x, x_dot, math.remainder(theta, 2.0 * math.pi), theta_dot])

    def swing_up(self, s):
        plant = self.plant
        x, x_dot, theta, theta_dot = s
        weight = plant.pole_mass * plant.gravity * plant.pole_length
        swing = 0.5 * (plant.pole_inertia + plant.pole_mass * plant.pole_length**2) * theta_dot**2
        energy = swing + weight * (math.cos(theta) - 1.0)
        share = (energy + 2.0 * weight) / (weight * (1.0 - math.cos(self.kick_radius)))
        near = max(0.0, 1.0 - share) ** 3
        wanted = -self.energy_gain * energy * theta_dot * math.cos(theta)
        wanted += near * self.kick - (1.0 - near) * (self.stiffness * x + self.damping * x_dot)
        # The pole's row gives theta'' under the wanted x''; the cart's row then gives the force.
        mass, loads = equations_of_motion(plant, s)
        theta_ddot = (loads[1] - mass[1, 0] * wanted) / mass[1, 1]
        force = mass[0, 0] * wanted + mass[0, 1] * theta_ddot - loads[0]
        # The force is affine in the voltage.
        without = wheel_force(plant, x_dot, 0.0)
        return (force - without) / (wheel_force(plant, x_dot, 1.0) - without)


def dop853(field, start, span, **options):
    """SciPy's eighth-order method, close to the tightest tolerance that it takes."""
    solution = solve_ivp(lambda _, s: field(s), span, start, method="DOP853", rtol=1e-13, atol=1e-13, **options)
    assert solution.success, solution.message
    return solution


def fitted_order(steps, errors):
    """Slope of log(error) over log(step)."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


def jacobian(function, x, steps, levels=3):
    """(..., k) at a vector x (k,), by central differences with the steps, half of them, ..., extrapolated (Richardson).

    `function` takes many vectors at once, (b, k), as a JAX function under `vmap` does.
    """
    x = np.asarray(x, dtype=np.float64)
    halvings = [np.diag(np.broadcast_to(steps, x.shape)) / 2**level for level in range(levels)]
    points = np.stack([[x + moves, x - moves] for moves in halvings])
    values = np.asarray(function(jnp.asarray(points.reshape(-1, x.size))), dtype=np.float64)
    values = values.reshape(levels, 2, x.size, *values.shape[1:])
    columns = [
        (above - below) / (2 * np.diag(moves)).reshape(-1, *[1] * (values.ndim - 3))
        for (above, below), moves in zip(values, halvings, strict=True)
    ]
    for order in range(1, levels):
        columns = [(4**order * fine - coarse) / (4**order - 1) for coarse, fine in itertools.pairwise(columns)]
    return np.moveaxis(columns[0], 0, -1)


def relative_error(found, right):
    """Frobenius norm of the difference over that of `right`; infinite where `found` is not finite."""
    found, right = np.asarray(found, dtype=np.float64), np.asarray(right, dtype=np.float64)
    if not np.all(np.isfinite(found)):
        return math.inf
    return float(np.linalg.norm(found - right) / np.linalg.norm(right))


def lyapunov_operator(A, time):
    """The matrix (n n, n n) that takes X, row by row, to A' X + X A, or in discrete time to A' X A - X."""
    identity = np.eye(len(A), dtype=A.dtype)
    if time == "continuous":
        return np.kron(A.T, identity) + np.kron(identity, A.T)
    return np.kron(A.T, A.T) - np.kron(identity, identity)
