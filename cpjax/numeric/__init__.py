"""Mathematics, independent of the plant."""

from cpjax.numeric.angles import wrap_angle
from cpjax.numeric.differences import Differences, central_differences
from cpjax.numeric.pareto import hypervolume, nondominated
from cpjax.numeric.quantisation import quantize
from cpjax.numeric.roots import crossing_fraction, newton_correction
from cpjax.numeric.statistics import mcnemar_p_value, two_proportion_p_value, wilson_interval
from cpjax.numeric.transforms import from_positive, from_semidefinite, positive, semidefinite

__all__ = [
    "Differences",
    "central_differences",
    "crossing_fraction",
    "from_positive",
    "from_semidefinite",
    "hypervolume",
    "mcnemar_p_value",
    "newton_correction",
    "nondominated",
    "positive",
    "quantize",
    "semidefinite",
    "two_proportion_p_value",
    "wilson_interval",
    "wrap_angle",
]
