"""A sweep on disk: saved block by block, resumed after an interruption, and assembled into one file."""

import hashlib
import io as buffers
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack

import jax
import numpy as np
from jax.experimental import multihost_utils

from cpjax import files, io, workspace
from cpjax.controllers.protocol import Controller, Law, ModalController, as_controller
from cpjax.errors import InputError
from cpjax.sim.metrics import Fold
from cpjax.sim.plants import Plant
from cpjax.sim.rollout import default_metrics
from cpjax.sim.settings import Simulation, check_names
from cpjax.sim.sweep import Progress, SweepPlan, prepare

SUFFIXES = (".parquet", ".npz", ".json")
"""Suffixes of the files that a sweep's metrics can be written to."""

_DOCUMENT = "cpjax"  # key of the document in an NPZ or Parquet file


def record_sweep(
    path: str | Path,
    plant: Plant,
    controller: Controller | ModalController | Law,
    starts: Any,
    *,
    metrics: Fold | None = None,
    about: Mapping[str, Any] | None = None,
    chunk: int | None = None,
    block: int | None = None,
    progress: Progress | None = None,
    **simulation: Unpack[Simulation],
) -> Any:
    """Runs a `cpjax.sweep` and writes its results to `path`, with plant, controller, settings and versions.

    Each block is saved when it is done, in the folder `path` + ".parts". If the process is killed at any moment, a call
    with the same arguments resumes there and writes the identical file; the folder is deleted at the end. With several
    processes (`jax.distributed`) all call this, and the first writes.

    Args:
      path: ends in .parquet (needs pyarrow), .npz or .json. With `save_every`, the name of a folder without a suffix,
        in which the blocks of trajectories stay, each an NPZ file, beside sweep.json.
      starts: the initial states, as for `sweep`.
      about: plain values to store in the file, such as the seed of the initial states.
      simulation: see `cpjax.Simulation`; `sweep` describes the other arguments too.

    Returns:
      What `sweep` would return, as NumPy arrays; None for trajectories, and in all processes but the first.

    Raises:
      InputError: as for `sweep`; another suffix; or a folder of parts that belongs to another sweep.
    """
    check_names("record_sweep", simulation)
    save_every = simulation.get("save_every")
    path = _checked_path(path, trajectories=save_every is not None)
    work = prepare(plant, controller, starts, metrics=metrics, chunk=chunk, block=block, **simulation)
    if work.traced:
        raise InputError("record_sweep", "traced arguments", "outside jit, vmap and grad: it writes files")
    # Results of 0.1 name the clock; a result without one would be of the continuous clock, the default then.
    run = {**simulation, "clock": work.kind.settings.clock}
    document = {
        "what": "closed-loop trajectories of many starts" if save_every else "metrics of many closed-loop runs",
        "versions": files.versions(),
        "about": dict(about or {}),
        "run": {key: value for key, value in run.items() if value is not None},
        "count": work.total,
        "dtype": str(work.leaves[0].dtype),
        "plant": _described(plant),
        "controller": _described(as_controller(controller)),
        "metrics": _described(default_metrics(plant) if metrics is None else metrics),
    }
    folder = path if save_every else path.with_name(path.name + ".parts")
    first = jax.process_index() == 0
    parts = [
        folder / f"part-{begin:09d}-{min(begin + work.size, work.total):09d}.npz" for begin in work.block_offsets()
    ]
    if first:
        workspace.claim(folder / "sweep.json", {**document, "starts": _digest(work)})
    done = np.array([part.exists() for part in parts])
    if jax.process_count() > 1:
        done = np.asarray(multihost_utils.broadcast_one_to_all(done))
    computed = work.blocks(begin for begin, there in zip(work.block_offsets(), done, strict=True) if not there)
    for begin, part, there in zip(work.block_offsets(), parts, done, strict=True):
        if not there:
            columns = _columns(next(computed))
            if first:
                own = _starts(work, begin, begin + work.size) if save_every else {}
                files.write_bytes(part, _npz({**own, **columns}))
        if progress is not None:
            progress(min(begin + work.size, work.total), work.total)
    if save_every or not first:
        return None
    return _assemble(path, folder, parts, document, work)


def read_sweep(path: str | Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Reads a file of metrics that `record_sweep` wrote.

    Returns:
      The document, and the columns (n, ...) by name: initial states ("start." and the component) and metrics.

    Raises:
      InputError: no such file, or not one of `record_sweep`'s.
    """
    path = _checked_path(path, trajectories=False)
    try:
        if path.suffix == ".json":
            table = files.read_table(path)
            return table["document"], {name: np.asarray(values) for name, values in table["columns"].items()}
        if path.suffix == ".npz":
            with np.load(path) as archive:
                columns = dict(archive)
            return json.loads(str(columns.pop(_DOCUMENT))), columns
        table = _pyarrow().parquet.read_table(path)
        columns = {name: table[name].combine_chunks().to_numpy(zero_copy_only=False) for name in table.column_names}
        return json.loads(table.schema.metadata[_DOCUMENT.encode()]), columns
    except (OSError, ValueError, KeyError, TypeError, EOFError) as problem:
        if isinstance(problem, InputError):
            raise
        raise InputError("path", str(path), f"a file written by record_sweep ({problem})") from problem


def _checked_path(path: Any, *, trajectories: bool) -> Path:
    if not isinstance(path, (str, Path)):
        raise InputError("path", path, "a file name, as str or Path")
    path = Path(path)
    if trajectories and path.suffix:
        raise InputError("path", str(path), "the name of a folder, without a suffix: trajectories are written in parts")
    if not trajectories and path.suffix not in SUFFIXES:
        raise InputError("path", str(path), "a file name that ends in " + ", ".join(SUFFIXES))
    if path.suffix == ".parquet":
        _pyarrow()
    return path


def _pyarrow() -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as problem:
        raise InputError("path", ".parquet", "another suffix, or pyarrow installed: pip install pyarrow") from problem
    return pyarrow


def _described(component: Any) -> Any:
    try:
        return io.encode(component)
    except InputError:  # a component of the user's own, or one that holds such
        return type(component).__name__


def _digest(work: SweepPlan) -> str:
    """Returns a fingerprint of all inputs of the sweep."""
    digest = hashlib.sha256()
    # With classes, choices and functions; without addresses, which differ between processes.
    digest.update(re.sub(r" at 0x[0-9a-f]+", "", str(work.kind.structure)).encode())
    for leaf in work.leaves:
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.shape} {array.dtype}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _starts(work: SweepPlan, begin: int, end: int) -> dict[str, np.ndarray]:
    columns = zip(work.names, work.leaves, strict=False)  # the initial state's leaves come first
    return {f"start.{name}": np.asarray(column)[begin:end] for name, column in columns}


def _columns(result: Any) -> dict[str, np.ndarray]:
    columns = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(result):
        name = jax.tree_util.keystr(path, simple=True, separator=".") or "result"
        columns[name.removeprefix("outputs.")] = leaf  # a trajectory's outputs, beside its other columns
    return columns


def _npz(columns: Mapping[str, Any]) -> bytes:
    buffer = buffers.BytesIO()
    np.savez(buffer, **columns)
    return buffer.getvalue()


def _assemble(path: Path, folder: Path, parts: list[Path], document: dict[str, Any], work: SweepPlan) -> Any:
    """Writes one file of all parts, deletes them, and returns the results."""
    loaded = []
    for part in parts:
        with np.load(part) as archive:
            loaded.append(dict(archive))
    results = {name: np.concatenate([one[name] for one in loaded]) for name in loaded[0]}
    columns = {**_starts(work, 0, work.total), **results}
    if path.suffix == ".json":
        files.write_json(path, {"document": document, "columns": columns})
    elif path.suffix == ".npz":
        files.write_bytes(path, _npz({_DOCUMENT: np.asarray(files.dump_json(document)), **columns}))
    else:
        arrow = _pyarrow()
        table = arrow.table({name: column if column.ndim == 1 else column.tolist() for name, column in columns.items()})
        table = table.replace_schema_metadata({_DOCUMENT: files.dump_json(document)})
        buffer = buffers.BytesIO()
        arrow.parquet.write_table(table, buffer)
        files.write_bytes(path, buffer.getvalue())
    workspace.release(folder)
    return jax.tree.unflatten(work.structure(), list(results.values()))
