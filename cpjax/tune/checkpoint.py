"""State of a tuning and its checkpoint file, from which a tuning interrupted at any moment resumes."""

import hashlib
import io as buffers
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from cpjax import files
from cpjax.errors import InputError

Numbers = np.ndarray[Any, Any]


class TunerState(NamedTuple):
    """State from which a tuning of r restarts with d free parameters resumes: the content of its checkpoint file."""

    step: int
    vectors: Numbers
    """Current free parameters (r, d)."""
    optimiser: Any
    best: Numbers
    """Free parameters with the best validation score of each restart (r, d)."""
    scores: Numbers
    """Scores of `best` (r,)."""
    stale: int
    """Validations since the last improvement."""
    history: list[dict[str, Any]]
    value_steps: int
    gradient_steps: int


def store(path: Path | None, identity: str, memory: TunerState) -> None:
    """Writes the state of a tuning to its checkpoint file, if there is a path.

    Args:
      path: the file, or None to write nothing.
      identity: fingerprint of the tuning that the state belongs to.
      memory: the state.
    """
    if path is None:
        return
    leaves = jax.tree.leaves(memory.optimiser)
    arrays = {f"optimiser_{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    arrays |= {name: getattr(memory, name) for name in ("vectors", "best", "scores")}
    counts = {name: getattr(memory, name) for name in ("step", "stale", "value_steps", "gradient_steps")}
    note = json.dumps({"identity": identity, "history": memory.history, **counts, "digest": _digest(arrays)})
    buffer = buffers.BytesIO()
    arrays["note"] = np.frombuffer(note.encode(), dtype=np.uint8)
    np.savez(buffer, allow_pickle=False, **arrays)
    files.write_bytes(path, buffer.getvalue())


def restore(path: Path | None, identity: str, optimiser: optax.GradientTransformation) -> TunerState | None:
    """Returns the state that `store` wrote, or None without a path or a file.

    Args:
      path: the checkpoint file, or None.
      identity: fingerprint of the tuning that resumes.
      optimiser: the tuning's optimiser, which gives the structure of its state.

    Raises:
      InputError: a file that `store` did not write, or one of another tuning.
    """
    if path is None or not path.exists():
        return None
    try:
        with path.open("rb") as file, np.load(file) as content:
            arrays = {name: content[name] for name in content.files}
        note = json.loads(arrays.pop("note").tobytes())
        if note.pop("digest") != _digest(arrays):
            raise ValueError("its content was changed")
        its_own = note.pop("identity")
        blank = optimiser.init(jnp.asarray(arrays["vectors"]))
        leaves = [jnp.asarray(arrays[f"optimiser_{i}"]) for i in range(len(jax.tree.leaves(blank)))]
        state = jax.tree.unflatten(jax.tree.structure(blank), leaves)
        found = TunerState(optimiser=state, **{name: arrays[name] for name in ("vectors", "best", "scores")}, **note)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as problem:
        raise InputError("checkpoint", str(path), f"a file written by a tuning, or none ({problem})") from problem
    if its_own != identity:
        allowed = "one of the same tuning (plan, plant, controller, versions); remove it, or choose another folder"
        raise InputError("checkpoint", str(path), allowed)
    return found


def _digest(arrays: Mapping[str, Any]) -> str:
    """Returns a checksum of arrays with their names, shapes and dtypes."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.shape} {array.dtype.str} ".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
