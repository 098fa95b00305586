"""Metric of the gradient audit: an objective at several horizons, and the crossings up to each."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from cpjax.numeric.selection import where
from cpjax.pytree import part, pytree
from cpjax.sim.closed_loop import GATE_CROSSING
from cpjax.sim.metrics import Metric, MetricState, Sample, finalize


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


class _State(NamedTuple):
    objective: MetricState
    crossings: Int[Array, ""]
    speed: Float[Array, ""]
    path: UInt32[Array, ""]
    probe: Probe


@pytree
class HorizonRecorder:
    """Metric that records an objective, the state and the crossings at several horizons."""

    objective: Metric = part("a metric", "init", "update")
    horizons: Float[Array, " horizons"]
    """Times of the records [s]."""
    dt: Float[Array, ""]
    """Step of the rollout [s]."""

    def init(self, sample: Sample) -> _State:
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
        return _State(self.objective.init(sample), none, far, none.astype(jnp.uint32), probe)

    def update(self, state: _State, sample: Sample) -> _State:
        objective = self.objective.update(state.objective, sample)
        at_gate = sample.crossing == GATE_CROSSING
        crossings = state.crossings + at_gate.astype(jnp.int32)
        speed = where(at_gate, jnp.minimum(state.speed, sample.crossing_speed), state.speed)
        step = jnp.floor(sample.time / self.dt).astype(jnp.uint32)
        mixed = (state.path + sample.crossing.astype(jnp.uint32)) * jnp.uint32(2654435761) + step
        path = where(sample.crossing > 0, mixed, state.path)
        now = Probe(finalize(self.objective, objective, sample), sample.state.vector(), crossings, speed, path)
        within = (sample.time <= self.horizons) & (sample.crossing == 0)  # horizons are grid points
        probe = jax.tree.map(
            lambda new, old: where(within.reshape((-1,) + (1,) * (old.ndim - 1)), new, old), now, state.probe
        )
        return _State(objective, crossings, speed, path, probe)

    def finalize(self, state: _State, last: Sample) -> tuple[Probe, Int[Array, ""]]:
        return state.probe, last.flag
