"""The paper that this project starts from: its plants, gains and laws, as printed and as corrected.

"Swing-up Control of an Inverted Pendulum Comparing LQR and Pole Placement", a student paper with a MATLAB simulation.
Its sections are cited below; docs/paper.md lists its errors with the test that shows each.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Array, Float

from cpjax.backend.trigonometry import sin_cos
from cpjax.controllers.energy import EnergySwingUp
from cpjax.controllers.feedback import DesignName, LqrWeights, PoleFactors, StateFeedback
from cpjax.controllers.gates import AngleGate
from cpjax.controllers.hybrid import Hybrid
from cpjax.controllers.protocol import Law
from cpjax.errors import InputError
from cpjax.io import register
from cpjax.linear.lqr import lqr
from cpjax.linear.placement import place
from cpjax.plant import CartPole, Motor, linearize
from cpjax.plant.state import State
from cpjax.pytree import Scalar, number, part, pytree

Design: TypeAlias = DesignName
Gains: TypeAlias = Literal["printed", "computed"]

POLES = (-3.0, -4.0, -5.0, -6.0)
"""Desired closed-loop poles, section IV-A [1/s]."""

Q = (200.0, 1.0, 1000.0, 1.0)
"""Diagonal of the state weight, section IV-B, in the order x, x_dot, theta, theta_dot."""

R = 1e-4
"""Weight of the voltage, section IV-B."""

PRINTED_GAINS: Mapping[Design, tuple[float, float, float, float]] = {
    "placement": (-24.74, -25.36, 111.70, 28.58),  # section IV-A
    "lqr": (-1414.21, -1180.17, 4795.02, 966.35),  # section IV-B
}
"""Gains K of u = -K s, V per SI unit of state. They do not follow from the appendix; see `identified_plant`."""

SWITCH_ANGLE = math.radians(30.0)
"""Angle from upright at which the linear law takes over, section IV-C [rad]."""

ENERGY_GAIN = 0.2
"""Gain k of the energy law, section IV-C."""


def appendix_plant() -> CartPole:
    """Returns the plant with the appendix's parameters, in SI units.

    The paper implies a wheel of r = 1 m and a gear of n = 1; its pole has no inertia about its centre of mass, and cart
    and pivot have no friction (section III-A). "Nmm" for the bearing friction is read as N m s/rad and "rad/(sV)" for
    k_V as V s/rad.
    """
    motor = Motor(
        torque_constant=1.25,
        back_emf_constant=1.0,
        resistance=1.25,
        rotor_inertia=7e-6,
        viscous_friction=1e-5,
        voltage_limit=12.0,
    )
    return CartPole(cart_mass=1.0, pole_mass=0.5, pole_length=0.7, gravity=9.81, motor=motor)


def identified_plant() -> CartPole:
    """Returns the plant that yields all eight printed gains, to within half a unit of their last printed digit.

    It differs from the appendix in two numbers, the force per volt k_T / (R r) = 1.03846 N/V and the total damping
    d = 1.93007 N s/m; the print determines them to about 1e-4 N/V and 5e-3 N s/m, the further digits are a choice. R is
    the appendix's, so k_T follows from the first and k_V from the second; the gains do not depend on R otherwise.
    """
    force_per_voltage, damping = 1.03846, 1.93007
    resistance, viscous_friction = 1.25, 1e-5
    motor = Motor(
        torque_constant=force_per_voltage * resistance,
        back_emf_constant=(damping - viscous_friction) / force_per_voltage,
        resistance=resistance,
        rotor_inertia=7e-6,
        viscous_friction=viscous_friction,
        voltage_limit=12.0,
    )
    return CartPole(cart_mass=1.0, pole_mass=0.5, pole_length=0.7, gravity=9.81, motor=motor)


PLANTS: Mapping[str, Callable[[], CartPole]] = {"appendix": appendix_plant, "identified": identified_plant}


@register
@pytree
class PrintedSwingUp:
    """The energy law as printed (section IV-C), with u the motor's voltage as in the paper's simulation.

        u = k dE theta' cos(theta),    dE = 2/3 m l^2 theta'^2 - m g l (cos(theta) - 1)

    dE is never negative, so the law never stops pumping; both of its signs are wrong, which cancels. Hanging at rest it
    demands 0 V, so it never leaves that equilibrium.
    """

    model: CartPole = part("plant model used by the law, a CartPole", "pole_mass", "pole_length", "gravity")
    energy_gain: Scalar = number("V/(J rad/s)", "k of the law as printed", default=ENERGY_GAIN)

    def voltage(self, state: State) -> Scalar:
        """Returns the demanded voltage [V]."""
        _, cos = sin_cos(state.theta)
        m, l, g = self.model.pole_mass, self.model.pole_length, self.model.gravity
        energy_error = 2.0 / 3.0 * m * l * l * state.theta_dot * state.theta_dot - m * g * l * (cos - 1.0)
        return self.energy_gain * energy_error * state.theta_dot * cos


@register
@pytree
class CorrectedSwingUpAsVoltage:
    """The energy law with its signs and its 2/3 corrected, but its output still read as the motor's voltage.

        u = -k E theta' cos(theta),    E = 1/2 m l^2 theta'^2 + m g l (cos(theta) - 1)

    Correct as a law for the pivot's acceleration; the paper's simulation applies it to the motor as a voltage. The
    cart's dynamics lie between voltage and acceleration, so the law does not swing the pendulum up.
    """

    model: CartPole = part("plant model used by the law, a CartPole", "pendulum_energy")
    energy_gain: Scalar = number("V/(J rad/s)", "k of the law", default=ENERGY_GAIN)

    def voltage(self, state: State) -> Scalar:
        """Returns the demanded voltage [V]."""
        _, cos = sin_cos(state.theta)
        return -self.energy_gain * self.model.pendulum_energy(state) * state.theta_dot * cos


LAWS: Mapping[str, Callable[[CartPole], Law]] = {
    "as-printed": PrintedSwingUp,
    "corrected": lambda model: EnergySwingUp(model, energy_gain=ENERGY_GAIN),
    "corrected-as-voltage": CorrectedSwingUpAsVoltage,
    "corrected-centred": lambda model: EnergySwingUp(model, energy_gain=5.0, cart_stiffness=4.0, cart_damping=2.0),
}
"""Swing-up laws by name, given their model of the plant. All but the last have the paper's k = 0.2; the last is no
longer the paper's: the corrected law with a larger gain and with cart-centring terms."""


def computed_gain(design: Design, plant: CartPole) -> Float[Array, "1 4"]:
    """Returns the gain that the paper's poles or weights give on `plant`; differentiable in its parameters.

    Raises:
      InputError: `design` is not one of the two, or the plant has no such gain.
    """
    _check_choice("design", design, get_args(Design))
    A, B = linearize(plant)
    try:
        return place(A, B, POLES) if design == "placement" else lqr(A, B, _state_weight(), R).K
    except InputError as problem:
        raise InputError("plant", plant, f"one for which a {design} gain can be computed ({problem})") from problem


def _state_weight() -> list[list[float]]:
    """Returns Q (4, 4) as a list, which takes the dtype of the plant's model."""
    return np.diag(Q).tolist()


def riccati_solution(plant: CartPole) -> Float[Array, "4 4"]:
    """Returns P of the paper's linear quadratic regulator on `plant` (section IV-B, "State Dependent" there).

    Raises:
      InputError: the plant has no such regulator.
    """
    A, B = linearize(plant)
    try:
        return lqr(A, B, _state_weight(), R).P
    except InputError as problem:
        raise InputError("plant", plant, f"one for which an lqr gain can be computed ({problem})") from problem


def regulator(design: Design, gains: Gains, plant: CartPole) -> StateFeedback:
    """Returns the linear law of section IV with its gain as printed, or computed from the printed poles or weights.

    Args:
      design: "lqr" or "placement".
      gains: "printed" or "computed".
      plant: the plant that a computed gain is for.

    Raises:
      InputError: an unknown `design` or `gains`, or a plant for which the gain cannot be computed.
    """
    _check_choice("design", design, get_args(Design))
    _check_choice("gains", gains, get_args(Gains))
    if gains == "printed":
        return StateFeedback(np.array([PRINTED_GAINS[design]]))
    return StateFeedback(computed_gain(design, plant), design=design_inputs(design))


def design_inputs(design: Design) -> LqrWeights | PoleFactors:
    """Returns the weights or the poles from which section IV designs the gain.

    Raises:
      InputError: an unknown design.
    """
    _check_choice("design", design, get_args(Design))
    return LqrWeights(np.diag(Q), R) if design == "lqr" else PoleFactors.from_poles(POLES)


def controller(law: str, design: Design, plant: CartPole, gains: Gains = "printed") -> Hybrid:
    """Returns the paper's hybrid controller: a law of `LAWS`, the regulator of `design`, and the switch at 30 degrees.

    Args:
      law: a key of `LAWS`.
      design: "lqr" or "placement".
      plant: the law's model, and the plant that a computed gain is for.
      gains: "printed" or "computed".

    Raises:
      InputError: an unknown name, or a plant for which the gain cannot be computed.
    """
    _check_choice("law", law, LAWS)
    return Hybrid(LAWS[law](plant), regulator(design, gains, plant), AngleGate(SWITCH_ANGLE))


def _check_choice(field: str, value: object, options: Iterable[str]) -> None:
    names = tuple(options)
    if value not in names:
        raise InputError(field, value, "one of " + ", ".join(names))
