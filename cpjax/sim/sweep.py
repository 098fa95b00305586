"""Sweeps: many initial states at once, on all cores or accelerators.

Initial states are simulated in blocks, which bound the memory and allow progress reports. A block is distributed over
the devices (`jax.sharding`: the cores of a CPU that `cpjax.configure_cpu` made into devices, the GPUs of a machine,
those of several hosts), and each device computes its share in chunks, on a CPU so small that a chunk stays in the
first-level cache. The result for an initial state does not depend on this division.
"""

import functools
import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, TypeAlias, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, Shaped

from cpjax.backend import runtime
from cpjax.controllers.protocol import Controller, Law, ModalController
from cpjax.errors import InputError
from cpjax.pytree import is_traced
from cpjax.rig import Rig
from cpjax.sim.flags import NEEDS_RECOMPUTE
from cpjax.sim.initial import component_names
from cpjax.sim.metrics import Metric, Sample
from cpjax.sim.plants import Plant, PlantState
from cpjax.sim.rollout import prepared, results, simulate
from cpjax.sim.saved import SavedSamples
from cpjax.sim.settings import Settings, Simulation, check_names

Progress = Callable[[int, int], None]
"""Function called with the number of initial states done and their total."""

_CHUNK = 1024
"""Bytes per number of a chunk on a CPU, 128 initial states in float64: their state stays in the first-level cache."""

_VECTOR = 16
"""Number of float32 elements in the longest vectors of a CPU."""

_STEPS_PER_BLOCK = 1 << 28
"""Integrator steps per block on a CPU: about one second of computation."""

_LARGEST_BLOCK = 1 << 30
"""Bytes of results per block."""

_LARGEST_BLOCK_OF_A_CPU = 1 << 25
"""Bytes of results per block on a CPU, small enough for the memory of one block to be reused for the next (glibc
retains freed memory up to this size): obtaining fresh memory is slower than a simulation."""

_AXIS = "starts"
_SHARED_OUT: Any = PartitionSpec(_AXIS)  # type: ignore[no-untyped-call]  # untyped in JAX
_EVERYWHERE: Any = PartitionSpec()  # type: ignore[no-untyped-call]


def sweep(
    plant: Plant | Rig,
    controller: Controller | ModalController | Law,
    starts: PlantState,
    *,
    metrics: Metric | None = None,
    chunk: int | None = None,
    block: int | None = None,
    progress: Progress | None = None,
    **simulation: Unpack[Simulation],
) -> Any:
    """Simulates many initial states; returns their metrics or trajectories.

    Results equal those of `rollout` up to rounding. With several processes (`jax.distributed`), each calls this with
    the same arguments and receives the whole result.

    Args:
      plant: one for all initial states, or one for each: any of its declared numbers may be an array of shape (n,).
      controller: likewise; a gain may have shape (n, 1, 4).
      starts: the initial states: a `State` of arrays of shape (n,), any n, or the state of a plant of your own.
      metrics: as in `rollout`; its numbers may have shape (n,).
      chunk: largest number of initial states that one device simulates together; None chooses by the machine.
      block: largest number of initial states between two calls of `progress`; None for about one second on a CPU.
      progress: called after each block.
      simulation: see `cpjax.Simulation`. `save_every` None stores no trajectories; k saves every k-th step of all n
        initial states in memory (`cpjax.record_sweep` writes them to disk block by block).

    Returns:
      What `metrics` returns for one initial state, with a leading axis n; `Metrics` by default. With `save_every`, a
      `Trajectory` of such arrays. Under `jit` or differentiation, the same by plain `vmap` of `measure` or `rollout`.

    Raises:
      InputError: as for `rollout`, and for `chunk` or `block` below 1.
    """
    check_names("sweep", simulation)
    work = prepare(plant, controller, starts, metrics=metrics, chunk=chunk, block=block, **simulation)
    if work.traced:
        columns, shared = _split(work.leaves, work.kind.batched)
        kind = work.kind._replace(settings=work.kind.settings._replace(fast_path=False))
        return jax.vmap(lambda column: results(*_one(column, shared, kind)))(columns)
    whole: Any = None
    for begin, part in zip(work.block_offsets(), work.blocks(work.block_offsets()), strict=True):
        if whole is None:
            whole = jax.tree.map(lambda array: _unwritten((work.total, *array.shape[1:]), array.dtype), part)
        for array, rows in zip(jax.tree.leaves(whole), jax.tree.leaves(part), strict=True):
            array[begin : begin + len(rows)] = rows
        if progress is not None:
            progress(min(begin + work.size, work.total), work.total)
    return jax.tree.map(lambda array: jax.device_put(array, may_alias=True), whole)  # no other reference to it


class _CompileKey(NamedTuple):
    """Static arguments of a compilation, beside shapes and dtypes."""

    structure: Any
    """Tree structure of (start, (plant, controller, metric, dt))."""
    batched: tuple[bool, ...]
    """Whether each leaf of that structure has one entry per initial state."""
    settings: Settings
    chunk: int
    mesh: Mesh


class SweepPlan(NamedTuple):
    """Prepared sweep, computed one block at a time."""

    kind: _CompileKey
    leaves: list[Any]
    total: int
    size: int
    """Initial states per block; the last block is padded with copies of the last initial state."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the initial state's components, whose leaves come first."""
        starts, _ = jax.tree.unflatten(self.kind.structure, self.leaves)
        return component_names(jax.tree.structure(starts))

    @property
    def traced(self) -> bool:
        """Returns whether JAX is tracing any of the input numbers."""
        return any(is_traced(leaf) for leaf in self.leaves)

    def block_offsets(self) -> range:
        """Returns the index of the first initial state of each block."""
        return range(0, self.total, self.size)

    def blocks(self, block_offsets: Iterable[int]) -> Iterator[Any]:
        """Yields the results of up to `size` initial states from each of `block_offsets` on, as NumPy arrays.

        While the caller processes one block, the devices compute the next.
        """
        waiting: tuple[int, Any] | None = None
        for begin in block_offsets:
            members = np.minimum(np.arange(begin, begin + self.size), self.total - 1)
            ahead = (begin, self._compute(members, self.kind))
            if waiting is not None:
                yield self._collect(*waiting)
            waiting = ahead
        if waiting is not None:
            yield self._collect(*waiting)

    def structure(self) -> Any:
        """Returns the tree structure of a block's results."""
        columns, shared = _split(self.leaves, self.kind.batched)
        first = [column[0] for column in columns]
        return jax.tree.structure(jax.eval_shape(lambda: results(*_one(first, shared, self.kind))))

    def _compute(self, members: Int[np.ndarray, " members"], kind: _CompileKey) -> Any:
        """Returns results and flags of these initial states, dispatched asynchronously."""
        columns, shared = _split(self.leaves, kind.batched)
        placed = [_place(np.asarray(column)[members], NamedSharding(kind.mesh, _SHARED_OUT)) for column in columns]
        # Packed into one array per dtype: transferring dozens of arrays takes longer than a small sweep.
        numbers = [np.asarray(leaf) for leaf in shared]
        forms = tuple((leaf.shape, leaf.dtype.str) for leaf in numbers)
        packed = {
            dtype: np.concatenate([leaf.ravel() for leaf in numbers if leaf.dtype.str == dtype])
            for dtype in dict.fromkeys(dtype for _, dtype in forms)
        }
        replicated = {dtype: _place(one, NamedSharding(kind.mesh, _EVERYWHERE)) for dtype, one in packed.items()}
        return _compiled(kind.mesh.devices.flat[0].platform)(placed, replicated, kind, forms)

    def _collect(self, begin: int, results: Any) -> Any:
        result, flag = jax.tree.map(lambda array: _gather(array)[: self.total - begin], results)
        doubtful = np.flatnonzero(flag & NEEDS_RECOMPUTE)
        if doubtful.size:
            result = jax.tree.map(np.array, result)  # writable copies
            kind = self.kind._replace(settings=self.kind.settings._replace(fast_path=False))
            together = kind.chunk * kind.mesh.size
            for first in range(0, doubtful.size, together):
                rows = doubtful[first : first + together]
                members = np.resize(begin + rows, together)  # constant size, for a single compilation
                in_full, _ = jax.tree.map(_gather, self._compute(members, kind))
                for array, again in zip(jax.tree.leaves(result), jax.tree.leaves(in_full), strict=True):
                    array[rows] = again[: rows.size]
        return result


def prepare(
    plant: Plant | Rig,
    controller: Controller | ModalController | Law,
    starts: PlantState,
    *,
    metrics: Metric | None,
    chunk: int | None,
    block: int | None,
    **simulation: Any,
) -> SweepPlan:
    """Checks a sweep's arguments and divides its initial states into blocks; arguments and errors as for `sweep`."""
    for name, value in (("chunk", chunk), ("block", block)):
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
            raise InputError(name, value, "a whole number of initial states, at least 1")
    starts, arguments, settings, batched = prepared(plant, controller, starts, metrics, batched=True, **simulation)
    settings = settings._replace(fast_path=settings.clock == "sampled" and settings.switching == "per_step")
    leaves, structure = jax.tree.flatten((starts, arguments))
    columns = jax.tree.leaves(starts)
    total, dtype = columns[0].shape[0], columns[0].dtype
    devices = jax.devices()
    chunk_length, size = _sizes(total, devices, settings, np.dtype(dtype).itemsize, chunk, block)
    mesh = Mesh(np.array(devices), (_AXIS,))
    kind = _CompileKey(structure, (True,) * len(columns) + tuple(batched), settings, chunk_length, mesh)
    return SweepPlan(kind, leaves, total, size)


def _sizes(
    total: int, devices: list[Any], settings: Settings, itemsize: int, chunk: int | None, block: int | None
) -> tuple[int, int]:
    """Returns the initial states per chunk and per block, with equally many chunks for each device."""
    on_cpu = devices[0].platform == "cpu"
    saved = 0 if settings.save_every is None else settings.steps // settings.save_every + 1
    most = (_LARGEST_BLOCK_OF_A_CPU if on_cpu else _LARGEST_BLOCK) // (itemsize * 8 * (saved + 2))
    if on_cpu:
        most = min(most, _STEPS_PER_BLOCK // (settings.steps + settings.spare_steps))
    most = max(1, (most if block is None else block) // len(devices))
    share = math.ceil(total / len(devices))
    if chunk is None:
        best = _CHUNK // itemsize if on_cpu else most
        chunk = min(best, _VECTOR * math.ceil(share / _VECTOR))  # whole vectors; few initial states need no full chunk
    chunk = min(chunk, most)
    chunks = math.ceil(share / chunk)
    blocks = math.ceil(chunks / (most // chunk))
    return chunk, math.ceil(chunks / blocks) * chunk * len(devices)


def _split(leaves: list[Any], batched: tuple[bool, ...]) -> tuple[list[Any], list[Any]]:
    columns = [leaf for leaf, many in zip(leaves, batched, strict=True) if many]
    return columns, [leaf for leaf, many in zip(leaves, batched, strict=True) if not many]


def _one(column: list[Any], shared: list[Any], kind: _CompileKey) -> tuple[SavedSamples | None, Sample, Any]:
    """Returns the result of `simulate` for one initial state."""
    columns, others = iter(column), iter(shared)
    leaves = [next(columns) if many else next(others) for many in kind.batched]
    start, (plant, controller, metric, dt) = jax.tree.unflatten(kind.structure, leaves)
    return simulate(start, plant, controller, metric, dt, kind.settings)


_Forms: TypeAlias = tuple[tuple[tuple[int, ...], str], ...]
"""Shape and dtype of each leaf that all initial states share."""


def _block(
    columns: list[Shaped[Array, "starts ..."]],
    packed: dict[str, Shaped[Array, " _"]],
    kind: _CompileKey,
    forms: _Forms,
) -> Any:
    def share(columns: list[Shaped[Array, "starts ..."]], packed: dict[str, Shaped[Array, " _"]]) -> Any:
        shared = _unpacked(packed, forms)

        def chunk(column: list[Shaped[Array, "lanes ..."]]) -> Any:
            return jax.vmap(lambda lane: _one(lane, shared, kind), out_axes=(1, 0, 0))(column)

        like: Any = None  # shapes and dtypes of a chunk's results, which its one trace notes

        def packed_chunk(column: list[Shaped[Array, "lanes ..."]]) -> Any:
            nonlocal like
            kept, *others = chunk(column)
            like = jax.tree.map(jax.typeof, others)
            return kept, _stacked(others)

        chunks = [column.reshape(-1, kind.chunk, *column.shape[1:]) for column in columns]
        kept, others = jax.lax.map(packed_chunk, chunks)
        last, result = _unstacked(others, like)
        kept = jax.tree.map(lambda part: jnp.moveaxis(part, 1, 0), kept)  # rows first
        trees = results(kept, last, result), last.flag
        return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), trees)

    specs = {"in_specs": (_SHARED_OUT, _EVERYWHERE), "out_specs": _SHARED_OUT}
    return jax.shard_map(share, mesh=kind.mesh, check_vma=False, **specs)(columns, packed)


def _stacked(tree: Any) -> list[Shaped[Array, "..."]]:
    """Stacks leaves of equal shape and dtype: for several arrays, XLA copies all that is written at every write."""
    kinds: dict[Any, list[Array]] = {}
    for leaf in jax.tree.leaves(tree):
        kinds.setdefault((leaf.shape, leaf.dtype), []).append(leaf)
    return [jnp.stack(leaves) for leaves in kinds.values()]


def _unstacked(stacks: list[Shaped[Array, "..."]], like: Any) -> Any:
    """Inverts `_stacked` for a tree of the shapes `like`, with one additional leading axis on all arrays."""
    leaves, structure = jax.tree.flatten(like)
    kinds = list(dict.fromkeys((leaf.shape, leaf.dtype) for leaf in leaves))
    taken = dict.fromkeys(kinds, -1)
    found = []
    for leaf in leaves:
        kind = (leaf.shape, leaf.dtype)
        taken[kind] += 1
        found.append(stacks[kinds.index(kind)][:, taken[kind]])
    return jax.tree.unflatten(structure, found)


def _unpacked(packed: dict[str, Shaped[Array, " _"]], forms: _Forms) -> list[Shaped[Array, "..."]]:
    taken, leaves = dict.fromkeys(packed, 0), []
    for shape, dtype in forms:
        begin, taken[dtype] = taken[dtype], taken[dtype] + math.prod(shape)
        leaves.append(packed[dtype][begin : taken[dtype]].reshape(shape))
    return leaves


@functools.cache
def _compiled(platform: str) -> Any:
    return jax.jit(_block, static_argnames=("kind", "forms"), compiler_options=runtime.compiler_options(platform))


def _unwritten(shape: tuple[int, ...], dtype: Any) -> Shaped[np.ndarray, "..."]:
    """Returns an uninitialised NumPy array aligned to 64 bytes, which JAX can use without a copy."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = np.empty(size + 64, np.uint8)
    begin = -memory.ctypes.data % 64
    return memory[begin : begin + size].view(dtype).reshape(shape)


def _place(array: Shaped[np.ndarray, "*shape"], sharding: NamedSharding) -> Shaped[Array, "*shape"]:
    return jax.make_array_from_callback(array.shape, sharding, lambda index: array[index])


def _gather(array: Shaped[Array, "*shape"]) -> Shaped[np.ndarray, "*shape"]:
    whole = array if array.is_fully_addressable else multihost_utils.process_allgather(array, tiled=True)
    return np.asarray(whole)
