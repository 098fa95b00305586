"""State of a tuning and its checkpoint file, from which a tuning interrupted at any moment resumes."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float

from cpjax import workspace
from cpjax.archive import read_archive, write_archive
from cpjax.errors import InputError
from cpjax.tune.descent import OptimiserState


class TunerState(NamedTuple):
    """State from which a tuning resumes: the content of its checkpoint file."""

    step: int
    vectors: Float[np.ndarray, "restarts parameters"]
    """Current free parameters."""
    optimiser: OptimiserState
    best: Float[np.ndarray, "restarts parameters"]
    """Free parameters with the best validation score of each restart."""
    scores: Float[np.ndarray, " restarts"]
    """Scores of `best`."""
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
    write_archive(path, arrays, {"identity": identity, "history": memory.history, **counts})


def restore(path: Path | None, identity: str, optimiser: optax.GradientTransformation) -> TunerState | None:
    """Returns the state that `store` wrote, or None without a path or a file, or if the file is damaged.

    A damaged file is renamed, with a `DamagedFileWarning`.

    Args:
      path: the checkpoint file, or None.
      identity: fingerprint of the tuning that resumes.
      optimiser: the tuning's optimiser, which gives the structure of its state.

    Raises:
      InputError: the file of another tuning.
    """

    def read(path: Path) -> tuple[str, TunerState]:
        arrays, note = read_archive(path)
        try:
            its_own = note.pop("identity")
            blank = optimiser.init(jnp.asarray(arrays["vectors"]))
            leaves = [jnp.asarray(arrays[f"optimiser_{i}"]) for i in range(len(jax.tree.leaves(blank)))]
            state = jax.tree.unflatten(jax.tree.structure(blank), leaves)
            vectors: dict[str, Any] = {name: arrays[name] for name in ("vectors", "best", "scores")}
            return its_own, TunerState(optimiser=state, **vectors, **note)
        except (KeyError, TypeError, AttributeError) as problem:
            raise InputError("checkpoint", str(path), f"a file written by a tuning ({problem})") from problem

    found = None if path is None else workspace.intact(path, read)
    if found is None:
        return None
    if found[0] != identity:
        allowed = "one of the same tuning (plan, plant, controller, versions); remove it, or choose another folder"
        raise InputError("checkpoint", str(path), allowed)
    return found[1]
