"""What a tuning remembers, and its file: a tuning that is stopped at any moment goes on from there."""

import io as buffers
import json
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from cpjax import io
from cpjax.errors import InputError

Numbers = np.ndarray[Any, Any]


class TunerState(NamedTuple):
    """All that a tuning needs to go on: the content of its file."""

    step: int
    vectors: Numbers
    """(r, d)."""
    optimiser: Any
    best: Numbers
    """(r, d)."""
    scores: Numbers
    """(r,), of `best`."""
    stale: int
    """Validations since the last improvement."""
    history: list[dict[str, Any]]
    value_steps: int
    gradient_steps: int


def store(path: Path | None, identity: str, memory: TunerState) -> None:
    """Writes a memory, if there is a path.

    Args:
      identity: of the tuning that it belongs to.
    """
    if path is None:
        return
    leaves = jax.tree.leaves(memory.optimiser)
    arrays = {f"optimiser_{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    arrays |= {name: getattr(memory, name) for name in ("vectors", "best", "scores")}
    counts = {name: getattr(memory, name) for name in ("step", "stale", "value_steps", "gradient_steps")}
    note = json.dumps({"identity": identity, "history": memory.history, **counts})
    buffer = buffers.BytesIO()
    arrays["note"] = np.frombuffer(note.encode(), dtype=np.uint8)
    np.savez(buffer, allow_pickle=False, **arrays)
    io.write_bytes(path, buffer.getvalue())


def restore(path: Path | None, identity: str, optimiser: optax.GradientTransformation) -> TunerState | None:
    """The memory that was stored, if any.

    Raises:
      InputError: a file that `store` did not write, or one of another tuning.
    """
    if path is None or not path.exists():
        return None
    try:
        with np.load(path) as content:
            arrays = {name: content[name] for name in content.files}
        note = json.loads(arrays.pop("note").tobytes())
        blank = optimiser.init(jnp.asarray(arrays["vectors"]))
        leaves = [jnp.asarray(arrays[f"optimiser_{i}"]) for i in range(len(jax.tree.leaves(blank)))]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as problem:
        raise InputError("checkpoint", str(path), f"a file written by a tuning, or none ({problem})") from problem
    if note.pop("identity") != identity:
        allowed = "one of the same tuning (plan, plant, controller, versions); remove it, or choose another folder"
        raise InputError("checkpoint", str(path), allowed)
    state = jax.tree.unflatten(jax.tree.structure(blank), leaves)
    parts = {name: arrays[name] for name in ("vectors", "best", "scores")}
    return TunerState(optimiser=state, **parts, **note)
