"""Failure handling, common to all loops: a failed run is held at its last valid state.

A run that would leave the plant's limits, or become non-finite, is held at its last valid state and flagged.

Reverse-mode differentiation passes through both branches of a `where`, and 0 times an infinity of the branch not taken
is NaN. A step that would fail, as predicted by an Euler step of the velocities, is therefore computed from the zero
state, where everything is finite, and its result is discarded. (A law that is itself not finite at a state at which it
is evaluated still gives NaN derivatives; the laws of this library are finite.)
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from cpjax.backend.single_kernel import outline
from cpjax.numeric.selection import where
from cpjax.pytree import Scalar
from cpjax.sim import plants
from cpjax.sim.flags import STOPPED, Flag
from cpjax.sim.plants import Plant, PlantState, Tree


class Outlook(NamedTuple):
    """Prediction about a step before it is taken."""

    possible: Bool[Array, ""]
    """Whether an Euler step keeps the velocities within the plant's limits."""
    ahead: Tree
    """Velocities after an Euler step."""


def look_ahead(plant: Plant, v: Tree, acceleration: Tree, dt: Scalar) -> Outlook:
    """Predicts a step of `dt` [s] by an Euler step of the velocities."""
    ahead = jax.tree.map(lambda velocity, change: velocity + dt * change, v, acceleration)
    return Outlook(plants.within(ahead, plants.coordinates(plant, plant.limits)[1]), ahead)


def is_stopped(flag: Int[Array, ""]) -> Bool[Array, ""]:
    """Returns whether a flag has stopped the run."""
    return (flag & STOPPED) != 0


def safe(going: Bool[Array, ""], tree: Any) -> Any:
    """Returns the tree where the run continues, and zeros where it does not."""
    return jax.tree.map(lambda value: where(going, value, jnp.zeros((), jnp.asarray(value).dtype)), tree)


def verdict(plant: Plant, after: PlantState, outlook: Outlook) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Returns whether the state after a step is within the limits, and the flag for a step that is not."""
    within, finite = outline(_judged)(after, outlook.ahead, plant.limits)
    return within, where(finite, np.int32(Flag.RUNAWAY), np.int32(Flag.NON_FINITE))


def _judged(after: PlantState, ahead: Tree, limits: PlantState) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    total = sum(jax.tree.leaves(ahead)) + sum(jax.tree.leaves(after))
    return plants.within(after, limits), jnp.isfinite(total)
