"""Many starts at once."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from cpjax.controllers.protocol import Controller, Law
from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.sim.metrics import Fold
from cpjax.sim.rollout import measure
from cpjax.sim.settings import Checkpoint, Clock, Switching
from cpjax.state import State, checked_start

Progress = Callable[[int, int], None]
"""Called with the number of starts done and their total."""


def sweep(
    plant: CartPole,
    controller: Controller | Law,
    starts: State,
    *,
    duration: float,
    dt: float,
    clock: Clock = "continuous",
    control_period: float | None = None,
    switching: Switching = "per_step",
    integrator: str = "rk4",
    spare_steps: int | None = None,
    checkpoint: Checkpoint = "every_step",
    metrics: Fold | None = None,
    chunk: int = 4096,
    progress: Progress | None = None,
) -> Any:
    """The metrics of every start; nothing of the trajectories is stored.

    Args:
      starts: a State of arrays of shape (n,), any n.
      chunk: starts simulated together, at most. All chunks have one size (the last is filled up with copies), so that
        one compilation serves all of them.
      progress: called after each chunk.

    Returns:
      What `metrics` returns for one start, with a leading axis n; `Metrics` by default.

    Raises:
      InputError: as for `rollout`, and for `chunk` below 1.
    """
    if isinstance(chunk, bool) or not isinstance(chunk, int) or chunk < 1:
        raise InputError("chunk", chunk, "a whole number of starts, at least 1")
    starts, _ = checked_start(starts, "starts", batched=True)
    total = jnp.shape(starts.x)[0]
    chunk = math.ceil(total / math.ceil(total / chunk))  # as even as can be, so that little is simulated twice

    def run(start: State) -> Any:
        return measure(
            plant,
            controller,
            start,
            duration=duration,
            dt=dt,
            clock=clock,
            control_period=control_period,
            switching=switching,
            integrator=integrator,
            spare_steps=spare_steps,
            checkpoint=checkpoint,
            metrics=metrics,
        )

    results = []
    for begin in range(0, total, chunk):
        members = jnp.minimum(jnp.arange(begin, begin + chunk), total - 1)
        part = jax.vmap(run)(jax.tree.map(lambda column, members=members: column[members], starts))
        if progress is not None:
            jax.block_until_ready(part)  # type: ignore[no-untyped-call]  # untyped in JAX
            progress(min(begin + chunk, total), total)
        results.append(part)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[:total], *results)
