"""The student paper that this project starts from: its plants, gains and laws, their reproduction and their audit.

An application of the general packages, none of which imports it.
"""

from cpjax.paper.printed import (
    ENERGY_GAIN,
    LAWS,
    PLANTS,
    POLES,
    PRINTED_GAINS,
    SWITCH_ANGLE,
    CorrectedSwingUpAsVoltage,
    Design,
    Gains,
    PrintedSwingUp,
    Q,
    R,
    appendix_plant,
    computed_gain,
    controller,
    design_inputs,
    identified_plant,
    regulator,
    riccati_solution,
)

__all__ = [
    "ENERGY_GAIN",
    "LAWS",
    "PLANTS",
    "POLES",
    "PRINTED_GAINS",
    "SWITCH_ANGLE",
    "CorrectedSwingUpAsVoltage",
    "Design",
    "Gains",
    "PrintedSwingUp",
    "Q",
    "R",
    "appendix_plant",
    "computed_gain",
    "controller",
    "design_inputs",
    "identified_plant",
    "regulator",
    "riccati_solution",
]
