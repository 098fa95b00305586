"""Differentiable design of gains for linear models, and analysis of the resulting loops.

`lqr` and `dlqr` are exported by `cpjax` itself: the module of `lqr` has its name.
"""

from cpjax.linear.discretization import SampledCost, SampledModel, discretize, discretize_cost
from cpjax.linear.estimation import KalmanGain, dlqe
from cpjax.linear.limits import (
    demanded_voltage,
    level_within_angle,
    level_within_angle_and_rate,
    level_within_form,
    level_within_voltage,
    lyapunov_function,
    saturation_angle,
)
from cpjax.linear.lqr import LinearQuadratic
from cpjax.linear.lyapunov import stein
from cpjax.linear.margins import (
    Margins,
    characteristic_polynomial,
    closed_loop_poles,
    loop_polynomials,
    stability_margins,
)
from cpjax.linear.placement import QuadraticFactors, place, place_polynomial, polynomial_from_poles
from cpjax.linear.riccati import RiccatiSolution, care, dare
from cpjax.linear.several_inputs import pole_directions
from cpjax.linear.structure import (
    POSITION_AND_ANGLE,
    Structure,
    controllability,
    controllability_gramian,
    controllability_matrix,
    observability,
    observability_gramian,
    observability_matrix,
)

__all__ = [
    "POSITION_AND_ANGLE",
    "KalmanGain",
    "LinearQuadratic",
    "Margins",
    "QuadraticFactors",
    "RiccatiSolution",
    "SampledCost",
    "SampledModel",
    "Structure",
    "care",
    "characteristic_polynomial",
    "closed_loop_poles",
    "controllability",
    "controllability_gramian",
    "controllability_matrix",
    "dare",
    "demanded_voltage",
    "discretize",
    "discretize_cost",
    "dlqe",
    "level_within_angle",
    "level_within_angle_and_rate",
    "level_within_form",
    "level_within_voltage",
    "loop_polynomials",
    "lyapunov_function",
    "observability",
    "observability_gramian",
    "observability_matrix",
    "place",
    "place_polynomial",
    "pole_directions",
    "polynomial_from_poles",
    "saturation_angle",
    "stability_margins",
    "stein",
]
