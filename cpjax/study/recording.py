"""A sweep on disk: saved block by block, resumed after an interruption, and assembled into one file."""

import hashlib
import io as buffers
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack

import jax
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import Shaped

from cpjax import archive, files, io
from cpjax.controllers.protocol import Controller, Law, ModalController, as_controller
from cpjax.errors import InputError
from cpjax.rig import Rig
from cpjax.sim.metrics import Metric
from cpjax.sim.plants import Plant, PlantState
from cpjax.sim.rollout import default_metrics
from cpjax.sim.settings import Simulation, check_names
from cpjax.sim.sweep import Progress, SweepPlan, prepare
from cpjax.workspace import Workspace

SUFFIXES = (".parquet", ".npz", ".json")
"""Suffixes of the files that a sweep's metrics can be written to."""

_DOCUMENT = b"cpjax"  # key of the document in a Parquet file
_DIGEST, _LAYOUT = "digest", "layout"  # keys of the checksum, and of the layout that has one, in a document on disk


def record_sweep(
    path: str | Path,
    plant: Plant | Rig,
    controller: Controller | ModalController | Law,
    starts: PlantState,
    *,
    metrics: Metric | None = None,
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
        "what": "closed-loop trajectories of many initial states" if save_every else "metrics of many closed-loop runs",
        "versions": files.versions(),
        "about": dict(about or {}),
        "run": {key: value for key, value in run.items() if value is not None},
        "count": work.total,
        "dtype": str(work.leaves[0].dtype),
        **{key: _described(part) for key, part in _parts(plant).items()},
        "controller": _described(as_controller(controller)),
        "metrics": _described(default_metrics(plant) if metrics is None else metrics),
    }
    folder = path if save_every else path.with_name(path.name + ".parts")
    if jax.process_index():
        _record(None, work, progress)
        return None
    request = {**document, "starts": _fingerprint(work)}
    with Workspace(folder, request, record="sweep.json", keep=save_every is not None) as parts:
        blocks = _record(parts, work, progress, with_starts=save_every is not None)
        return None if save_every else _assemble(path, blocks, document, work)


def _record(
    parts: Workspace | None, work: SweepPlan, progress: Progress | None, *, with_starts: bool = False
) -> list[archive.Arrays]:
    """Runs the blocks that are not in `parts` yet and saves them there; returns all of them, without trajectories.

    All processes call this, the first with `parts`.
    """
    names = {begin: f"part-{begin:09d}-{min(begin + work.size, work.total):09d}" for begin in work.block_offsets()}
    blocks: dict[int, archive.Arrays] = {}
    there = np.zeros(len(names), bool)
    for number, (begin, name) in enumerate(names.items()):
        found = None if parts is None else parts.load(name)
        if found is not None:
            there[number] = True
            blocks[begin] = {} if with_starts else found[0]
    if jax.process_count() > 1:
        there = np.asarray(multihost_utils.broadcast_one_to_all(there))
    computed = work.blocks(begin for begin, known in zip(names, there, strict=True) if not known)
    for known, (begin, name) in zip(there, names.items(), strict=True):
        if not known:
            columns = _columns(next(computed))
            if parts is not None:
                own = _starts(work, begin, begin + work.size) if with_starts else {}
                parts.save(name, {**own, **columns})
                blocks[begin] = {} if with_starts else columns
        if progress is not None:
            progress(min(begin + work.size, work.total), work.total)
    return [blocks[begin] for begin in names] if parts is not None else []


def read_sweep(path: str | Path) -> tuple[dict[str, Any], dict[str, Shaped[np.ndarray, "starts ..."]]]:
    """Reads a file of metrics that `record_sweep` wrote.

    Returns:
      The document, and the columns by name: initial states ("start." and the component) and metrics.

    Raises:
      InputError: no such file, not one of `record_sweep`'s, or one whose content has changed since.
    """
    path = _checked_path(path, trajectories=False)
    if path.suffix == ".npz":
        columns, document = archive.read_archive(path)
        return document, columns
    try:
        if path.suffix == ".json":
            table = files.read_table(path)
            document = _unsealed(table["document"], files.dump_json(table["columns"]))
            columns = {name: np.asarray(values) for name, values in table["columns"].items()}
        else:
            table = _pyarrow().parquet.read_table(path, page_checksum_verification=True)
            columns = {name: _column(table[name]) for name in table.column_names}
            document = files.parse_json(table.schema.metadata[_DOCUMENT].decode())
            document = _unsealed(document, archive.digest(columns))
    except Exception as problem:  # pyarrow raises nearly anything for a damaged file
        if isinstance(problem, InputError):
            raise
        raise InputError("path", str(path), f"a file written by record_sweep ({problem})") from problem
    return document, columns


def _sealed(document: dict[str, Any], content: str) -> dict[str, Any]:
    """Returns a document with a checksum of itself and of `content`."""
    digest = hashlib.sha256(f"{files.dump_json(document)} {content}".encode()).hexdigest()
    return {**document, _LAYOUT: 2, _DIGEST: digest}


def _unsealed(sealed: dict[str, Any], content: str) -> dict[str, Any]:
    """Returns the document without its checksum.

    Raises:
      ValueError: document or content have changed.
    """
    document = {key: value for key, value in sealed.items() if key not in (_DIGEST, _LAYOUT)}
    # Files of cpjax 0.1 have neither key; one without the other is damaged.
    given, expected = ([seal.get(key) for key in (_DIGEST, _LAYOUT)] for seal in (sealed, _sealed(document, content)))
    if given not in ([None, None], expected):
        raise ValueError("its content was changed")
    return document


def _column(column: Any) -> Shaped[np.ndarray, "starts ..."]:
    """Returns a column of a Parquet table; of lists, with their axes."""
    values = column.combine_chunks().to_numpy(zero_copy_only=False)
    return np.stack([np.asarray(row.tolist()) for row in values]) if values.dtype == object else values


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


def _parts(plant: Any) -> dict[str, Any]:
    """Returns the plant by the name `plant` and, if it stands on a rig, the rig by the name `rig`."""
    return {"plant": plant.plant, "rig": plant} if isinstance(plant, Rig) else {"plant": plant}


def _described(component: Any) -> Any:
    try:
        return io.encode(component)
    except InputError:  # a component of the user's own, or one that holds such
        return type(component).__name__


def _fingerprint(work: SweepPlan) -> str:
    """Returns a fingerprint of all inputs of the sweep."""
    # With classes, choices and functions; without addresses, which differ between processes.
    structure = re.sub(r" at 0x[0-9a-f]+", "", str(work.kind.structure))
    leaves = archive.digest({f"{number:06d}": leaf for number, leaf in enumerate(work.leaves)})
    return hashlib.sha256(f"{structure} {leaves}".encode()).hexdigest()


def _starts(work: SweepPlan, begin: int, end: int) -> dict[str, Shaped[np.ndarray, "starts ..."]]:
    columns = zip(work.names, work.leaves, strict=False)  # the initial state's leaves come first
    return {f"start.{name}": np.asarray(column)[begin:end] for name, column in columns}


def _columns(result: Any) -> dict[str, Shaped[np.ndarray, "starts ..."]]:
    columns = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(result):
        name = jax.tree_util.keystr(path, simple=True, separator=".") or "result"
        columns[name.removeprefix("outputs.")] = leaf  # a trajectory's outputs, beside its other columns
    return columns


def _assemble(path: Path, blocks: list[archive.Arrays], document: dict[str, Any], work: SweepPlan) -> Any:
    """Writes one file of all blocks and returns the results."""
    results = {name: np.concatenate([one[name] for one in blocks]) for name in blocks[0]}
    columns = {**_starts(work, 0, work.total), **results}
    if path.suffix == ".json":
        document = files.parse_json(files.dump_json(document))
        files.write_json(path, {"document": _sealed(document, files.dump_json(columns)), "columns": columns})
    elif path.suffix == ".npz":
        archive.write_archive(path, columns, document)
    else:
        arrow = _pyarrow()
        table = arrow.table({name: column if column.ndim == 1 else column.tolist() for name, column in columns.items()})
        sealed = _sealed(document, archive.digest({name: _column(table[name]) for name in columns}))
        table = table.replace_schema_metadata({_DOCUMENT: files.dump_json(sealed)})
        buffer = buffers.BytesIO()
        arrow.parquet.write_table(table, buffer, write_page_checksum=True)
        files.write_bytes(path, buffer.getvalue())
    return jax.tree.unflatten(work.structure(), list(results.values()))
