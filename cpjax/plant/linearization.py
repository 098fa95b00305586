"""Linear model of the plant about an equilibrium."""

import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cpjax.errors import InputError
from cpjax.plant.cartpole import CartPole
from cpjax.plant.state import HANGING, UPRIGHT, State
from cpjax.pytree import check, is_traced


class LinearModel(NamedTuple):
    """Linear model s' = A s + B u about an equilibrium, in the state order x, x_dot, theta, theta_dot."""

    A: Float[Array, "4 4"]
    B: Float[Array, "4 1"]
    """Per volt."""


def linearize(plant: CartPole, equilibrium: Literal["upright", "hanging"] | State = "upright") -> LinearModel:
    """Computes A and B of the plant about an equilibrium at zero voltage, by forward differentiation.

    Args:
      plant: the cart-pole.
      equilibrium: "upright", "hanging", or a State at rest with zero accelerations (at any cart position).

    Returns:
      The linear model.

    Raises:
      InputError: `plant` is no CartPole or has no finite linear model, or `equilibrium` is another word or a concrete
        State that is not an equilibrium.
    """
    if not isinstance(plant, CartPole):
        raise InputError("plant", plant, "a cpjax.CartPole")
    check("plant", plant)
    named = {"upright": UPRIGHT, "hanging": HANGING}
    if isinstance(equilibrium, str):
        if equilibrium not in named:
            raise InputError("equilibrium", equilibrium, "upright, hanging or a State")
        equilibrium = named[equilibrium]
    if not isinstance(equilibrium, State):
        raise InputError("equilibrium", equilibrium, "upright, hanging or a State")

    dtype = jnp.result_type(float, *(leaf for leaf in jax.tree.leaves(plant) if hasattr(leaf, "dtype")))
    vector = jnp.asarray(equilibrium.vector(), dtype=dtype)
    voltage = jnp.zeros((), dtype=dtype)
    A, B, drift = _derivatives(plant, vector, voltage)
    if not is_traced(A) and not is_traced(drift):
        if np.all(np.isfinite(vector)) and not (np.all(np.isfinite(A)) and np.all(np.isfinite(B))):
            raise InputError("plant", plant, "one with a finite linear model; no gain can be computed for this one")
        # Tolerance: the effect of a displacement by 1e-6, above the float32 error of pi, negligible in a linear model.
        if not np.max(np.abs(drift)) <= 1e-6 * np.max(np.abs(A)):  # refuses NaN too
            raise InputError("equilibrium", equilibrium, "a state at rest in which nothing accelerates")
    return LinearModel(A, B[:, None])


@functools.partial(jax.jit, inline=True)  # one program in place of a compilation for each operation
def _derivatives(
    plant: CartPole, vector: Float[Array, "4"], voltage: Float[Array, ""]
) -> tuple[Float[Array, "4 4"], Float[Array, "4"], Float[Array, "4"]]:
    """Returns the derivatives of the vector field with respect to state and voltage, and its value."""

    def field(vector: Float[Array, "4"], voltage: Float[Array, ""]) -> Float[Array, "4"]:
        return plant.vector_field(State.from_vector(vector), voltage).vector()

    A, B = jax.jacfwd(field, argnums=(0, 1))(vector, voltage)
    return A, B, field(vector, voltage)
