"""Saved samples of a trajectory, in a form that XLA writes fast.

XLA writes a single array stacked by a loop in place, but merges several of the same shape and dtype and copies them
whole at every write; each sample is therefore packed into one row. Values computed only for the stacked array are not
vectorised, so the plant's outputs, which follow from the other fields, are computed after the loop.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Shaped

from cpjax.sim import plants
from cpjax.sim.metrics import Sample
from cpjax.sim.plants import Plant, PlantState, Tree


class SavedSamples(NamedTuple):
    """Saved samples except the final one."""

    packed: Float[Array, " rows *batch columns"]
    """Rows of `pack`."""
    outputs: dict[str, Float[Array, " rows *batch"]]
    """Outputs of the plant by name."""


def pack(sample: Sample, plant: Plant) -> Float[Array, " columns"]:
    """Returns a sample as a row."""
    return jnp.stack([field.astype(sample.time.dtype) for field in jax.tree.leaves(_packed_fields(sample, plant))])


def keep(packed: Float[Array, "rows columns"], plant: Plant, last: Sample) -> SavedSamples:
    """Returns packed rows with the plant's outputs added; `last` is a sample of the same run."""
    fields = _unpacked([packed[:, i] for i in range(packed.shape[1])], _packed_fields(last, plant))
    if plants.is_stepped(plant):  # the plant of each step is gone
        return SavedSamples(packed, fields.outputs)

    def row(fields: _PackedFields) -> dict[str, Float[Array, ""]]:
        q, v = plants.coordinates(plant, fields.state)
        acceleration = plants.accelerations(plant, plants.geometry(plant, q), v, fields.voltage, fields.plant_mode)
        return plants.outputs(plant, fields.state, acceleration, fields.voltage)

    return SavedSamples(packed, jax.vmap(row)(fields))


def fields(kept: SavedSamples, last: Sample) -> dict[str, Any]:
    """Returns the fields of a `Trajectory`, shape (..., rows + 1), from all rows (row axis first) and `last`."""

    def joined(many: Shaped[Array, " rows *batch"], one: Shaped[Array, "*batch"]) -> Shaped[Array, "*batch samples"]:
        return jnp.concatenate([jnp.moveaxis(many, 0, -1).astype(one.dtype), one[..., None]], axis=-1)

    columns = [kept.packed[..., i] for i in range(kept.packed.shape[-1])]
    short = _short(last)
    like = short if len(columns) == len(jax.tree.leaves(short)) else short._replace(outputs=last.outputs)
    rows = _unpacked(columns, like)
    found = jax.tree.map(joined, rows, like)._asdict()
    del found["plant_mode"]
    return {**found, "outputs": jax.tree.map(joined, kept.outputs, last.outputs)}


class _PackedFields(NamedTuple):
    time: Float[Array, "*shape"]
    state: PlantState
    voltage: Float[Array, "*shape"]
    mode: Int[Array, "*shape"]
    plant_mode: Tree
    outputs: dict[str, Float[Array, "*shape"]]
    """Empty where they follow from the other fields."""


def _short(sample: Sample) -> _PackedFields:
    """Returns the fields from which the others follow."""
    return _PackedFields(sample.time, sample.state, sample.voltage, sample.mode, sample.plant_mode, {})


def _packed_fields(sample: Sample, plant: Plant) -> _PackedFields:
    """Returns the fields that are saved: of a plant that differs from step to step its outputs as well."""
    short = _short(sample)
    return short._replace(outputs=sample.outputs) if plants.is_stepped(plant) else short


def _unpacked(columns: list[Float[Array, "..."]], like: _PackedFields) -> _PackedFields:
    ones, structure = jax.tree.flatten(like)
    typed = [column.astype(one.dtype) for column, one in zip(columns, ones, strict=True)]
    unpacked: _PackedFields = jax.tree.unflatten(structure, typed)
    return unpacked
