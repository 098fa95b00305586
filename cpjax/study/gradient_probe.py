"""Metric of the gradient audit: an objective at several horizons, and the crossings up to each."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cpjax.pytree import part, pytree
from cpjax.sim.closed_loop import GATE_CROSSING
from cpjax.sim.metrics import Fold, Sample


class Probe(NamedTuple):
    """Records at the k horizons, the first axis."""

    value: jax.Array
    """Objective (k,)."""
    state: jax.Array
    """State of the plant (k, 4) [SI]."""
    crossings: jax.Array
    """Number of gate crossings so far (k,), int32."""
    speed: jax.Array
    """Slowest speed of the gate's margin at those (k,) [1/s]; infinite if there is none."""
    path: jax.Array
    """Hash (k,), uint32, of the sequence of crossings, of gate and supply, and of the steps in which they lie. Steps
    count because the samples' states, and sums over them, have a (small) kink where a crossing passes a sample."""


class _Memory(NamedTuple):
    objective: Any
    crossings: jax.Array
    speed: jax.Array
    path: jax.Array
    probe: Probe


@pytree
class HorizonRecorder:
    """Metric that records an objective, the state and the crossings at several horizons."""

    objective: Fold = part("a fold", "init", "update", "finish")
    horizons: Any = None
    """Times of the records (k,) [s]."""
    dt: Any = None
    """Step of the rollout [s]."""

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
