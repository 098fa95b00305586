"""One step of the closed loop: plant, input and integrator combined."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cpjax.backend.single_kernel import outline
from cpjax.controllers.protocol import ModalController, demand
from cpjax.pytree import Scalar
from cpjax.sim import plants
from cpjax.sim.integrators import Integrator
from cpjax.sim.plants import Plant, PlantState, Tree


def applied_voltage(
    plant: Plant, controller: ModalController, state: PlantState, mode: Int[Array, ""]
) -> Float[Array, ""]:
    """Returns the plant's input: the law's demand in `mode`, in the state's dtype, clipped by the drive."""
    return plants.saturate(plant, outline(demand)(controller, state, mode))


def dtype_of(tree: Tree) -> Any:
    """Returns the common dtype of the numbers of a state."""
    return jnp.asarray(jax.tree.leaves(tree)[0]).dtype


def step_held(
    plant: Plant,
    integrator: Integrator,
    state: PlantState,
    u: Scalar,
    dt: Scalar,
    first: Tree | None = None,
) -> PlantState:
    """Returns the state after `dt` [s] under a constant input `u` (zero-order hold).

    Args:
      plant: the plant.
      integrator: the method of one step.
      state: state at the beginning of the step.
      u: the input that the drive applies.
      dt: length of the step [s].
      first: the accelerations at `state`, if already known.
    """

    def acceleration(q: Tree, v: Tree) -> Tree:
        return outline(plants.accelerations)(plant, plants.geometry(plant, q), v, u)

    q, v = integrator(acceleration, *plants.coordinates(plant, state), dt, first)
    return plants.state_of(plant, q, v)


def step_held_incremental(
    plant: Plant,
    integrator: Integrator,
    state: PlantState,
    geometry: Tree,
    u: Scalar,
    dt: Scalar,
    first: Tree | None = None,
) -> tuple[PlantState, Bool[Array, ""]]:
    """Computes `step_held` with the geometry at the later stages derived from that at `state`.

    Args:
      plant: the plant.
      integrator: the method of one step.
      state: state at the beginning of the step.
      geometry: of the plant at `state`.
      u: the input that the drive applies.
      dt: length of the step [s].
      first: the accelerations at `state`, if already known.

    Returns:
      The state after `dt` [s], and whether all its geometries were accurate to rounding.
    """
    accurate = jnp.asarray(True)
    start, velocities = plants.coordinates(plant, state)

    def acceleration(q: Tree, v: Tree) -> Tree:
        nonlocal accurate
        change = jax.tree.map(jnp.subtract, q, start)
        there, near = plants.geometry_near(plant, geometry, q, change)
        accurate &= near
        return outline(plants.accelerations)(plant, there, v, u)

    q, v = integrator(acceleration, start, velocities, dt, first)
    return plants.state_of(plant, q, v), accurate


def step_continuous(
    plant: Plant,
    controller: ModalController,
    integrator: Integrator,
    state: PlantState,
    mode: Int[Array, ""],
    dt: Scalar,
    first: Tree | None = None,
) -> PlantState:
    """Returns the state after `dt` [s] with the law of `mode` evaluated, and its voltage clipped, in every stage.

    Args:
      plant: the plant.
      controller: laws by mode.
      integrator: the method of one step.
      state: state at the beginning of the step.
      mode: the controller's mode during the step.
      dt: length of the step [s].
      first: the accelerations at `state`, if already known.
    """

    def acceleration(q: Tree, v: Tree) -> Tree:
        u = applied_voltage(plant, controller, plants.state_of(plant, q, v), mode)
        return outline(plants.accelerations)(plant, plants.geometry(plant, q), v, u)

    q, v = integrator(acceleration, *plants.coordinates(plant, state), dt, first)
    return plants.state_of(plant, q, v)
