"""Interface of a plant in the loop, and checked calls of its methods. Independent of any particular plant.

A plant is a second-order system q'' = a(q, v, u) with one input u; positions q and velocities v are two pytrees of the
same structure. Its state may be any pytree of scalars.
"""

from typing import Any, Protocol, TypeAlias, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cpjax.checks import call, like, pair, real
from cpjax.errors import InputError
from cpjax.pytree import Scalar, is_number, is_traced

Tree: TypeAlias = Any
"""A pytree of scalars, such as a plant's positions."""

PlantState: TypeAlias = Any
"""A state of a plant: of a `CartPole` a `State`, of another plant any pytree of scalars."""


@runtime_checkable
class Plant(Protocol):
    """A second-order system with one input. A pytree: its numbers may be traced.

    Positions, velocities and accelerations at zero state and zero input must be finite: a failed run is continued from
    there, and its result discarded.
    """

    @property
    def limits(self) -> PlantState:
        """Largest allowed magnitude of each component, as a state; a run that exceeds one is stopped."""
        ...

    def coordinates(self, state: PlantState) -> tuple[Tree, Tree]:
        """Returns positions and velocities (q, v) of a state."""
        ...

    def state(self, q: Tree, v: Tree) -> PlantState:
        """Returns the state of these positions and velocities."""
        ...

    def saturate(self, command: Scalar) -> Scalar:
        """Returns the input that the drive applies for a command."""
        ...

    def accelerations(self, geometry: Tree, v: Tree, u: Scalar) -> Tree:
        """Returns q'', of the structure of v, under the input u.

        Args:
          geometry: what `geometry(q)` returns, for a plant that has it (see `Geometric`); else q.
          v: velocities.
          u: the input that the drive applies.
        """
        ...


@runtime_checkable
class Geometric(Protocol):
    """A plant whose accelerations depend on its positions only through functions that are worth sharing, such as sine
    and cosine."""

    def geometry(self, q: Tree) -> Tree:
        """Returns the functions of the positions that `accelerations` uses."""
        ...

    def geometry_near(self, geometry: Tree, change: Tree) -> tuple[Tree, Bool[Array, ""]]:
        """Returns the geometry at q + `change`, given that at q, and whether it is accurate to rounding.

        It must cost less than `geometry`, and may be inaccurate for large changes. `sweep` uses it for values only.
        """
        ...


@runtime_checkable
class Eventful(Protocol):
    """A plant with modes of its own, such as stick and slip, or the ends of a track.

    Its `accelerations` take the mode as a fourth argument. A mode ends where a guard, smooth near zero, falls below
    zero; that instant is located inside the integrator's step.
    """

    def start_mode(self, q: Tree, v: Tree) -> Tree:
        """Returns the mode at the start: a pytree of int32 scalars."""
        ...

    def guards(self, q: Tree, v: Tree, u: Scalar, mode: Tree) -> tuple[Scalar, ...]:
        """Returns scalars that are at least 0 while the mode lasts; a fixed number of them, smooth near zero."""
        ...

    def jump(self, q: Tree, v: Tree, mode: Tree, guard: Int[Array, ""]) -> tuple[Tree, Tree, Tree]:
        """Returns positions, velocities and mode after the guard of this number (int32) has fallen."""
        ...


@runtime_checkable
class Stepped(Protocol):
    """A plant that differs from step to step, by forces that depend on time, or by a drive with a memory of its own.

    It runs on the sampled clock with switching per step.
    """

    def start_drive(self, state: PlantState) -> Tree:
        """Returns the memory before the first step: any pytree of arrays."""
        ...

    def during(
        self, memory: Tree, index: Int[Array, ""], dt: Scalar, state: PlantState, u: Scalar
    ) -> tuple["Plant", Tree]:
        """Returns the plant as it is during the step of this number (int32), and the memory after it."""
        ...


def is_stepped(plant: Any) -> bool:
    """Returns whether a plant is `Stepped`."""
    return hasattr(plant, "start_drive")


def start_drive(plant: Any, state: PlantState) -> Tree:
    """Returns the memory of a `Stepped` plant before the first step; () for another plant."""
    return jax.tree.map(jnp.asarray, call("plant", plant, "start_drive", state)) if is_stepped(plant) else ()


def during(plant: Any, memory: Tree, index: Int[Array, ""], dt: Scalar, state: PlantState, u: Scalar) -> Any:
    """Returns the plant as it is during a step, and its memory after it; unchanged if it is not `Stepped`.

    Raises:
      InputError: the plant's `during` returns no pair, or a memory of another structure.
    """
    if not is_stepped(plant):
        return plant, memory
    returned = call("plant", plant, "during", memory, index, dt, state, u)
    now, after = pair("plant.during", returned, "the plant in this step and the memory after it")
    return now, like("plant.during: memory", after, memory)


@runtime_checkable
class Releasing(Protocol):
    """An `Eventful` plant whose mode may end at once because its input changes at once, as a cart that is held until
    the voltage steps. Without this, a mode ends only where a guard falls."""

    def release(self, q: Tree, v: Tree, u: Scalar, mode: Tree) -> Tree:
        """Returns the mode under the input u: called at the start, where the input steps, and after each jump."""
        ...


def has_events(plant: Any) -> bool:
    """Returns whether a plant is `Eventful`. (`isinstance` with a protocol would take longer than a whole check.)"""
    return all(hasattr(plant, name) for name in ("start_mode", "guards", "jump"))


def check_plant(plant: Any) -> None:
    """Checks that a plant has all attributes that the loop uses.

    Raises:
      InputError: a required attribute is missing, or only some of the methods that belong together are present.
    """
    needed = ("limits", "coordinates", "state", "saturate", "accelerations")
    missing = [name for name in needed if not hasattr(plant, name)]
    if missing or isinstance(plant, type):
        raise InputError("plant", plant, f"a cpjax.CartPole, or a plant of your own with {', '.join(needed)}")
    leaves = jax.tree_util.tree_leaves_with_path(plant.limits)
    for path, limit in leaves:
        if not is_number(limit) or (not is_traced(limit) and np.any(np.isnan(limit))):
            where = f"plant.limits{jax.tree_util.keystr(path)}"
            raise InputError(where, limit, "a number: the largest magnitude of this component of the state")
    if not leaves:
        raise InputError("plant.limits", plant.limits, "a state: the largest magnitude of each component")
    for together in (("geometry", "geometry_near"), ("start_mode", "guards", "jump")):
        if 0 < sum(hasattr(plant, name) for name in together) < len(together):
            raise InputError("plant", plant, f"one with all of {', '.join(together)}, or none of them")


def coordinates(plant: Plant, state: PlantState) -> tuple[Tree, Tree]:
    """Returns (q, v) of a state.

    Raises:
      InputError: the plant's `coordinates` returns no pair, or positions and velocities of two structures.
    """
    q, v = pair("plant.coordinates", call("plant", plant, "coordinates", state), "positions and velocities")
    here, there = str(jax.tree.structure(q)), str(jax.tree.structure(v))
    if here != there:
        raise InputError("plant.coordinates", f"{here} and {there}", "positions and velocities of one structure")
    return q, v


def state_of(plant: Plant, q: Tree, v: Tree) -> PlantState:
    """Returns the state of (q, v).

    Raises:
      InputError: the state's structure is not that of `plant.limits`.
    """
    state = call("plant", plant, "state", q, v)
    found: Any = jax.tree.structure(state)
    if found != jax.tree.structure(plant.limits):
        raise InputError("plant.state", str(found), "a state of the structure of plant.limits")
    return state


def geometry(plant: Plant, q: Tree) -> Tree:
    """Returns the functions of the positions that `accelerations` uses."""
    return call("plant", plant, "geometry", q) if isinstance(plant, Geometric) else q


def geometry_near(plant: Plant, at: Tree, q: Tree, change: Tree) -> tuple[Tree, Bool[Array, ""]]:
    """Returns the geometry at q, given the geometry `at` the positions q - `change`, and whether it is accurate.

    Raises:
      InputError: the plant's `geometry_near` returns no pair of a geometry like the given one and a bool.
    """
    if not isinstance(plant, Geometric):
        return q, jnp.asarray(True)
    returned = call("plant", plant, "geometry_near", at, change)
    near, accurate = pair("plant.geometry_near", returned, "the geometry and whether it is accurate")
    if jax.typeof(jnp.asarray(accurate)).dtype != jnp.bool_:
        raise InputError("plant.geometry_near", accurate, "a pair, the geometry and a bool: whether it is accurate")
    return like("plant.geometry_near", near, at), accurate


def accelerations(plant: Plant, geometry: Tree, v: Tree, u: Scalar, mode: Tree = ()) -> Tree:
    """Returns q'' under the input u, in the plant's own mode if it has modes."""
    arguments = (geometry, v, u, mode) if has_events(plant) else (geometry, v, u)
    return like("plant.accelerations", call("plant", plant, "accelerations", *arguments), v)


def saturate(plant: Plant, command: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the input that the drive applies for a command, in the command's dtype."""
    return real("plant.saturate", call("plant", plant, "saturate", command), command.dtype)


def start_mode(plant: Plant, q: Tree, v: Tree) -> Tree:
    """Returns the plant's own mode at the start; () for a plant without modes."""
    return jax.tree.map(jnp.asarray, call("plant", plant, "start_mode", q, v)) if has_events(plant) else ()


def release(plant: Any, q: Tree, v: Tree, u: Scalar, mode: Tree) -> Tree:
    """Returns the plant's own mode under an input that has changed at once; unchanged without a `release`."""
    if not hasattr(plant, "release"):
        return mode
    return like("plant.release", call("plant", plant, "release", q, v, u, mode), mode)


def guards(plant: Plant, q: Tree, v: Tree, u: Float[Array, ""], mode: Tree) -> tuple[Scalar, ...]:
    """Returns the plant's own guards, () for a plant without events.

    Raises:
      InputError: the plant's `guards` returns no tuple of scalars.
    """
    if not has_events(plant):
        return ()
    found = call("plant", plant, "guards", q, v, u, mode)
    if not isinstance(found, tuple):
        raise InputError("plant.guards", f"a {type(found).__name__}", "a tuple of scalars")
    return tuple(real(f"plant.guards[{i}]", guard, jnp.asarray(u).dtype) for i, guard in enumerate(found))


def jump(plant: Any, q: Tree, v: Tree, mode: Tree, guard: Int[Array, ""]) -> tuple[Tree, Tree, Tree]:
    """Returns positions, velocities and the plant's mode after its own guard of this number (int32) has fallen, before
    its `release`.

    Raises:
      InputError: the plant's `jump` returns another tree structure.
    """
    after = call("plant", plant, "jump", q, v, mode, guard)
    found: Any = jax.tree.structure(after)
    if found != jax.tree.structure((q, v, mode)):
        raise InputError("plant.jump", str(found), "positions, velocities and mode, as given")
    q, v, mode = jax.tree.map(lambda new, old: jnp.asarray(new, dtype=jnp.asarray(old).dtype), after, (q, v, mode))
    return q, v, mode


def outputs(plant: Plant, state: PlantState, acceleration: Tree, u: Scalar) -> dict[str, Float[Array, ""]]:
    """Returns the scalars that the plant saves beside state and input, by name; none by default.

    Raises:
      InputError: the plant's `outputs` returns no dict, or a name of a trajectory's own columns.
    """
    if not hasattr(plant, "outputs"):
        return {}
    found = call("plant", plant, "outputs", state, acceleration, u)
    if not isinstance(found, dict) or not _TAKEN.isdisjoint(found):
        allowed = f"a dict of scalars by name, other names than {', '.join(sorted(_TAKEN))}"
        raise InputError("plant.outputs", found, allowed)
    dtype = jnp.asarray(jax.tree.leaves(state)[0]).dtype
    return {name: real(f"plant.outputs: {name}", value, dtype) for name, value in found.items()}


_TAKEN = frozenset({"time", "state", "voltage", "mode", "flag", "metrics", "outputs"})
"""Names of a trajectory's own columns, which outputs must not have."""


def within(tree: Tree, limits: Tree) -> Bool[Array, ""]:
    """Returns whether every number of the tree is at most its limit in magnitude; False for NaN."""
    inside = jax.tree.map(lambda value, limit: jnp.abs(value) <= limit, tree, limits)
    return jax.tree.reduce(jnp.logical_and, inside)
