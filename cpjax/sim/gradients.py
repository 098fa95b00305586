"""Gradients of an objective at many initial states, in chunks, in forward or reverse mode."""

import functools
import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cpjax.errors import InputError
from cpjax.plant.state import State
from cpjax.sim.initial import checked_tree

Direction: TypeAlias = Literal["reverse", "forward"]
Objective: TypeAlias = Callable[[Any, State], Float[Array, ""]]
"""Function of parameters and one initial state that returns a scalar, such as an entry of `cpjax.measure`'s result."""


class Gradients(NamedTuple):
    """Value and gradient of an objective at each of n initial states."""

    value: Float[Array, "*batch"]
    gradient: Any
    """Tree of the parameters' structure, each leaf with the leading axis of `value`."""

    @property
    def finite(self) -> Bool[Array, " starts"]:
        """Returns whether the value and all numbers of the gradient are finite.

        A derivative can overflow where the run itself is clean: exactly upright at rest, a perturbation grows by
        powers of ten every second, in float32 soon beyond the largest number. No flag of the run reports this.
        """
        count = self.value.shape[0]
        leaves = (self.value, *jax.tree.leaves(self.gradient))
        good = [jnp.all(jnp.isfinite(leaf).reshape(count, -1), axis=1) for leaf in leaves]
        return jnp.all(jnp.stack(good), axis=0)


def gradients(
    objective: Objective, parameters: Any, starts: State, *, direction: Direction = "reverse", chunk: int = 64
) -> Gradients:
    """Computes value and gradient of `objective(parameters, start)` at every initial state.

    Compiled once per function object: pass the same objective again, not a new equivalent one. The memory per step is
    set by `checkpoint` where the objective calls `cpjax.measure`; docs/gradients.md has measurements.

    Args:
      objective: a function of the parameters and one initial state (scalars) that returns a scalar.
      parameters: a tree of floats or floating-point arrays.
      starts: the initial states: a State of arrays of shape (n,), any n.
      direction: "reverse" costs a few rollouts whatever the number of parameters, and memory for each step; "forward"
        costs about one rollout for each parameter, and hardly any memory.
      chunk: number of initial states computed together, at most.

    Raises:
      InputError: another direction, a chunk below 1, parameters that are not floating-point, initial states that hold
        NaN or are not of one dtype and shape (n,), or an objective that returns no scalar.
    """
    if not isinstance(direction, str) or direction not in get_args(Direction):
        raise InputError("direction", direction, "reverse or forward")
    if isinstance(chunk, bool) or not isinstance(chunk, int) or chunk < 1:
        raise InputError("chunk", chunk, "a whole number of initial states, at least 1")
    for path, leaf in jax.tree_util.tree_leaves_with_path(parameters):
        if not (isinstance(leaf, float) or jnp.issubdtype(getattr(leaf, "dtype", int), jnp.floating)):
            name = f"parameters{jax.tree_util.keystr(path)}"
            raise InputError(name, leaf, "a float or a floating-point array")
    limits = jax.tree.map(lambda _: math.inf, starts)
    starts, _, _ = checked_tree(starts, limits, {}, "starts", batched=True)
    shape = jax.eval_shape(objective, parameters, jax.tree.map(lambda column: column[0], starts))
    if getattr(shape, "shape", None) != ():
        raise InputError("objective", objective, f"a function that returns one number, not {shape}")
    found: Gradients = _gradients(parameters, starts, objective=objective, direction=direction, chunk=chunk)
    return found


@functools.partial(jax.jit, static_argnames=("objective", "direction", "chunk"))
def _gradients(parameters: Any, starts: State, *, objective: Objective, direction: Direction, chunk: int) -> Gradients:
    def at(start: State) -> Gradients:
        if direction == "reverse":
            return Gradients(*jax.value_and_grad(objective)(parameters, start))
        value, gradient = jax.jacfwd(lambda p: (objective(p, start),) * 2, has_aux=True)(parameters)[::-1]
        return Gradients(value, gradient)

    total = jax.tree.leaves(starts)[0].shape[0]
    count = math.ceil(total / chunk)
    size = math.ceil(total / count)  # chunks of nearly equal size
    members = jnp.minimum(jnp.arange(count * size), total - 1).reshape(count, size)
    found = lax.map(lambda rows: jax.vmap(at)(jax.tree.map(lambda column: column[rows], starts)), members)
    return jax.tree.map(lambda x: x.reshape(count * size, *x.shape[2:])[:total], found)
