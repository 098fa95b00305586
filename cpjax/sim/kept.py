"""What a trajectory keeps of the samples, in a form that XLA writes fast.

Of what a loop stacks, XLA writes a single array in place, but several of a kind it merges and then copies them whole at
every write. And what is computed for the array's sake alone is computed number by number, so the acceleration, which
follows from the rest, is left for afterwards.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from cpjax.numeric.trigonometry import sin_cos
from cpjax.plant import CartPole
from cpjax.sim.metrics import Sample
from cpjax.state import State


class Kept(NamedTuple):
    """Of every row but the last one."""

    packed: jax.Array
    """Shape (rows, 7), of `pack`."""
    cart_acceleration: jax.Array
    """Shape (rows,)."""


def pack(sample: Sample) -> jax.Array:
    """A sample's row, shape (7,)."""
    return jnp.stack([field.astype(sample.time.dtype) for field in jax.tree.leaves(_packed_fields(sample))])


def keep(packed: jax.Array, plant: CartPole) -> Kept:
    """Rows of shape (rows, 7), completed."""
    x_dot, theta, theta_dot, voltage = (packed[:, i] for i in (2, 3, 4, 5))
    sin, cos = sin_cos(theta)
    acceleration, _ = plant.acceleration(sin, cos, (x_dot, theta_dot), plant.motor.force(voltage, x_dot))
    return Kept(packed, jnp.asarray(acceleration))


def fields(kept: Kept, last: Sample) -> dict[str, State | jax.Array]:
    """Fields of a `Trajectory`, of shape (..., rows + 1), of all rows (row first) and the last sample."""

    def joined(many: jax.Array, one: jax.Array) -> jax.Array:
        return jnp.concatenate([jnp.moveaxis(many, 0, -1).astype(one.dtype), one[..., None]], axis=-1)

    ones, structure = jax.tree.flatten(_packed_fields(last))
    columns = [joined(kept.packed[..., i], one) for i, one in enumerate(ones)]
    acceleration = joined(kept.cart_acceleration, last.cart_acceleration)
    return {**jax.tree.unflatten(structure, columns)._asdict(), "cart_acceleration": acceleration}


class _PackedFields(NamedTuple):
    time: jax.Array
    state: State
    voltage: jax.Array
    mode: jax.Array


def _packed_fields(sample: Sample) -> _PackedFields:
    return _PackedFields(sample.time, sample.state, sample.voltage, sample.mode)
