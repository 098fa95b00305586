"""The fold by which gradients are audited: an objective at several horizons, and the crossings that led to it."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cpjax.pytree import part, pytree
from cpjax.sim.closed_loop import GATE_CROSSING
from cpjax.sim.metrics import Fold, Sample


class Probe(NamedTuple):
    """At each horizon: the first axis."""

    value: jax.Array
    state: jax.Array
    """(k, 4)."""
    crossings: jax.Array
    speed: jax.Array
    path: jax.Array
    """A number made of the sequence of crossings, of gate and supply, and of their steps: equal for equal sequences.
    Where a crossing passes a sample, the samples' states, and what is summed of them, have a (small) kink."""


class _Memory(NamedTuple):
    objective: Any
    crossings: jax.Array
    speed: jax.Array
    path: jax.Array
    probe: Probe


@pytree
class HorizonRecorder:
    """The fold that keeps an objective and what led to it at several horizons."""

    objective: Fold = part("a fold", "init", "update", "finish")
    horizons: Any = None
    """(k,) [s]."""
    dt: Any = None
    """[s]."""

    def init(self, sample: Sample) -> _Memory:
        k, dtype = self.horizons.shape[0], sample.time.dtype
        none = jnp.zeros_like(sample.mode)
        probe = Probe(
            jnp.zeros(k, dtype),
            jnp.zeros((k, 4), dtype),
            jnp.zeros(k, jnp.int32),
            jnp.full(k, jnp.inf, dtype),
            jnp.zeros(k, jnp.uint32),
        )
        far = jnp.full_like(sample.time, jnp.inf)
        return _Memory(self.objective.init(sample), none, far, none.astype(jnp.uint32), probe)

    def update(self, memory: _Memory, sample: Sample) -> _Memory:
        objective = self.objective.update(memory.objective, sample)
        at_gate = sample.crossing == GATE_CROSSING
        crossings = memory.crossings + at_gate.astype(jnp.int32)
        speed = jnp.where(at_gate, jnp.minimum(memory.speed, sample.crossing_speed), memory.speed)
        step = jnp.floor(sample.time / self.dt).astype(jnp.uint32)
        mixed = (memory.path + sample.crossing.astype(jnp.uint32)) * jnp.uint32(2654435761) + step
        path = jnp.where(sample.crossing > 0, mixed, memory.path)
        now = Probe(self.objective.finish(objective, sample), sample.state.vector(), crossings, speed, path)
        within = (sample.time <= self.horizons) & (sample.crossing == 0)  # horizons are grid points
        probe = jax.tree.map(
            lambda new, old: jnp.where(within.reshape((-1,) + (1,) * (old.ndim - 1)), new, old), now, memory.probe
        )
        return _Memory(objective, crossings, speed, path, probe)

    def finish(self, memory: _Memory, last: Sample) -> tuple[Probe, jax.Array]:
        return memory.probe, last.flag
