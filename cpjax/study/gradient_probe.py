"""Metric of the gradient audit: an objective at several horizons, and the crossings up to each."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from cpjax.pytree import part, pytree
from cpjax.sim.closed_loop import GATE_CROSSING
from cpjax.sim.metrics import Fold, MetricState, Sample


class Probe(NamedTuple):
    """Records at the horizons."""

    value: Float[Array, "*horizons"]
    """Objective."""
    state: Float[Array, "*horizons 4"]
    """State of the plant [SI]."""
    crossings: Int[Array, "*horizons"]
    """Number of gate crossings so far, int32."""
    speed: Float[Array, "*horizons"]
    """Slowest speed of the gate's margin at those [1/s]; infinite if there is none."""
    path: UInt32[Array, "*horizons"]
    """Hash of the sequence of crossings, of gate and supply, and of the steps in which they lie. Steps
    count because the samples' states, and sums over them, have a (small) kink where a crossing passes a sample."""


class _Memory(NamedTuple):
    objective: MetricState
    crossings: Int[Array, ""]
    speed: Float[Array, ""]
    path: UInt32[Array, ""]
    probe: Probe


@pytree
class HorizonRecorder:
    """Metric that records an objective, the state and the crossings at several horizons."""

    objective: Fold = part("a fold", "init", "update", "finish")
    horizons: Float[Array, " horizons"]
    """Times of the records [s]."""
    dt: Float[Array, ""]
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

    def finish(self, memory: _Memory, last: Sample) -> tuple[Probe, Int[Array, ""]]:
        return memory.probe, last.flag
