"""What a bridge takes: numbers that are known, as other packages cannot be traced by JAX."""

from typing import Any

import jax

from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.pytree import check, is_traced

UNTRACEABLE = "JAX cannot trace through another package"


def known_plant(plant: Any) -> CartPole:
    """`plant` with Python's floats for numbers.

    Raises:
      InputError: it is no CartPole, or JAX is tracing a number of it.
    """
    if not isinstance(plant, CartPole):
        raise InputError("plant", plant, "a cpjax.CartPole")
    refuse_unknown("plant", plant)
    return jax.tree.map(float, plant)


def refuse_unknown(name: str, tree: Any) -> None:
    """Raises InputError unless the fields of `tree` are in range and their numbers known."""
    check(name, tree)
    if any(is_traced(leaf) for leaf in jax.tree.leaves(tree)):
        raise InputError(name, tree, f"of known numbers; {UNTRACEABLE}")
