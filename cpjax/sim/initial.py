"""Validation of the initial states of a rollout."""

import functools
import math
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cpjax.errors import InputError
from cpjax.pytree import as_array, is_traced
from cpjax.sim.plants import Plant, PlantState

_LARGEST = sys.float_info.max


def checked_initial(
    plant: Plant, start: PlantState, field: str, *, batched: bool
) -> tuple[PlantState, np.dtype, int | None]:
    """Returns `start` as arrays of one dtype, that dtype, and the number of initial states (None if not `batched`).

    Args:
      plant: the plant, whose limits (`start_limits`, if it has them) the initial states must respect.
      start: one initial state of scalars or, if `batched`, many, of arrays (n,).
      field: name of the argument in error messages.
      batched: whether `start` holds many initial states.

    Raises:
      InputError: as `checked_tree` does.
    """
    units = getattr(plant, "units", {})
    limits = getattr(plant, "start_limits", plant.limits)
    return checked_tree(start, limits, units, field, batched=batched)


def checked_tree(
    start: PlantState, limits: PlantState, units: dict[str, str], field: str, *, batched: bool
) -> tuple[PlantState, np.dtype, int | None]:
    """Returns a state as arrays of one dtype, that dtype, and the batch length (None if not `batched`).

    Python numbers take the dtype of the arrays beside them, or JAX's default float if there are none.

    Args:
      start: the state.
      limits: the largest magnitude of each component, of the structure that `start` must have.
      units: of the components by name, for error messages.
      field: name of the argument in error messages.
      batched: whether the components are arrays of one shape (n,), else scalars.

    Raises:
      InputError: another structure; a component that is not real, not finite, beyond its limit, of another dtype than
        the rest, or not of shape () (`batched=False`) or one common (n,) (`batched=True`).
    """
    structure: Any = jax.tree.structure(limits)
    try:
        leaves = structure.flatten_up_to(start)
    except (ValueError, TypeError) as problem:
        kind = type(limits)
        components = ", ".join(component_names(structure))
        where = "cpjax." if kind.__module__.startswith("cpjax.") else ""
        raise InputError(field, start, f"a {where}{kind.__name__}({components})") from problem
    names = component_names(structure)
    dtypes = {}
    for name, value, limit in zip(names, leaves, jax.tree.leaves(limits), strict=True):
        path = f"{field}.{name}"
        if isinstance(value, bool) or not (isinstance(value, (int, float)) or hasattr(value, "dtype")):
            raise InputError(path, value, "a real number or an array of them")
        if isinstance(value, (int, float)):
            if not is_traced(limit) and not (abs(value) <= limit and abs(value) <= _LARGEST):
                raise InputError(path, value, _within(limit, units.get(name, "")))
        else:
            dtypes[name] = jnp.dtype(value.dtype) if is_traced(value) else jax.dtypes.canonicalize_dtype(value.dtype)
            if dtypes[name] not in (jnp.float32, jnp.float64):
                raise InputError(path, f"array of dtype {value.dtype}", "of dtype float32 or float64")
            known = not is_traced(value) and not is_traced(limit)
            if known and not np.all((np.abs(np.asarray(value)) <= np.asarray(limit)) & np.isfinite(value)):
                raise InputError(path, value, _within(limit, units.get(name, "")))
    name_of_type = type(start).__name__
    if len(set(dtypes.values())) > 1:
        mixture = ", ".join(f"{name}: {dtype}" for name, dtype in dtypes.items())
        raise InputError(field, f"{name_of_type} with dtypes {mixture}", "of one dtype, float32 or float64, throughout")
    dtype = next(iter(dtypes.values()), jnp.result_type(float))
    values = [as_array(value, dtype) for value in leaves]
    count = None
    if batched:
        shapes = f"{name_of_type} of shapes {[v.shape for v in values]}"
        if max(v.ndim for v in values) > 1 or min(v.size for v in values) == 0:
            raise InputError(field, shapes, "arrays of one shape (n,), n at least 1")
        try:
            values = list(jnp.broadcast_arrays(*[jnp.atleast_1d(v) for v in values]))
        except ValueError as problem:
            raise InputError(field, shapes, "arrays of one shape (n,), n at least 1") from problem
        count = values[0].shape[0]
    else:
        for name, value in zip(names, values, strict=True):
            if value.ndim:
                allowed = "one number; many initial states go through cpjax.sweep or jax.vmap"
                raise InputError(f"{field}.{name}", f"array of shape {value.shape}", allowed)
    return jax.tree.unflatten(structure, values), dtype, count


def _within(limit: Any, unit: str) -> str:
    largest = float(np.max(limit))
    return "finite" if largest == math.inf else f"finite, and within {largest:g} {unit}".rstrip()


@functools.cache
def component_names(structure: Any) -> tuple[str, ...]:
    """Returns the names of the components of a state of this structure, in order."""
    paths = jax.tree_util.tree_leaves_with_path(jax.tree.unflatten(structure, range(structure.num_leaves)))
    return tuple(jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in paths)
