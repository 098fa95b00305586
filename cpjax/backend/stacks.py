"""Keeps XLA's CPU compiler from copying what a loop stores at each step.

Reverse mode stores each number of a loop's carry in a stack of its own, one row per step. With multi-output fusion,
which `cpjax.configure_cpu` sets, XLA writes stacks of equal shape in one loop, and such a loop writes no row in place:
it copies all the stacks, at each step. XLA joins only arrays of equal shape. So each number gets a shape of its own, by
axes of length 1.
"""

from typing import Any

import jax

from cpjax.backend import runtime

LARGEST_RANK = 32
"""Rank from which on shapes are no longer made different."""


def apart(tree: Any) -> list[jax.Array]:
    """Returns the leaves of a tree, no two of one shape where the compiler fuses loops.

    Args:
      tree: of arrays.
    """
    leaves = jax.tree.leaves(tree)
    if not runtime.compiler_fuses_loops():
        return leaves
    taken: set[tuple[int, ...]] = set()
    for place, leaf in enumerate(leaves):
        shape = leaf.shape
        while shape in taken and len(shape) < LARGEST_RANK:
            shape = (1, *shape)
        taken.add(shape)
        leaves[place] = leaf.reshape(shape)
    return leaves


def together(leaves: list[jax.Array], like: Any) -> Any:
    """Returns the tree of which `apart` made these leaves.

    Args:
      leaves: what `apart` returned, or arrays of the same shapes.
      like: a tree of the structure and shapes.
    """
    shapes = [leaf.shape for leaf in jax.tree.leaves(like)]
    back = [leaf.reshape(shape) for leaf, shape in zip(leaves, shapes, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(like), back)
