"""Argument checks of the bridges: numbers must be concrete, because JAX cannot trace through other packages."""

import dataclasses
from typing import Any

import jax
import numpy as np

from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.pytree import Number, check, is_traced, present

EXPRESSED = (
    *("cart_mass", "pole_mass", "pole_length", "gravity", "pole_inertia", "cart_friction", "pivot_friction"),
    *("torque_constant", "back_emf_constant", "resistance", "rotor_inertia", "viscous_friction"),
    *("wheel_radius", "gear_ratio", "voltage_limit"),
)
"""Parameters of plant and motor that the bridges' own formulas contain."""

UNTRACEABLE = "JAX cannot trace through another package"


def concrete_plant(plant: Any) -> CartPole:
    """Returns `plant` with Python floats as numbers; an array in a user's own motor stays an array.

    Raises:
      InputError: `plant` is not a CartPole, or JAX is tracing a number of it.
    """
    if not isinstance(plant, CartPole):
        raise InputError("plant", plant, "a cpjax.CartPole")
    require_concrete("plant", plant)
    return jax.tree.map(lambda leaf: leaf if np.ndim(leaf) else float(leaf), plant)


def unexpressed(part: Any) -> dict[str, Number]:
    """Returns the non-neutral numbers of a plant or motor beyond `EXPRESSED`: no formula of a bridge contains them."""
    declared = (present(part) if dataclasses.is_dataclass(part) else {}).items()
    return {name: rule for name, rule in declared if name not in EXPRESSED and getattr(part, name) != rule.neutral}


def require_concrete(name: str, tree: Any) -> None:
    """Raises InputError unless the fields of `tree` are in range and their numbers concrete."""
    check(name, tree)
    if any(is_traced(leaf) for leaf in jax.tree.leaves(tree)):
        raise InputError(name, tree, f"of known numbers; {UNTRACEABLE}")
