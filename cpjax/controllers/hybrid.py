"""Hybrid controller: a swing-up law outside a gate, a regulator inside it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from cpjax.checks import call, real
from cpjax.controllers.gates import AngleGate, AngleRateGate, Gate, LyapunovGate
from cpjax.controllers.protocol import REGULATE, SWING_UP, Law, ModeMemory, start_memory, update_mode
from cpjax.numeric.selection import where
from cpjax.plant.state import State
from cpjax.pytree import Scalar, part, pytree

_FINITE_GATES = (AngleGate, AngleRateGate, LyapunovGate)
"""Gates whose margin is finite for finite states and parameters."""


@pytree
class Hybrid:
    """Hybrid controller of a swing-up law, a regulator and the gate that switches between them.

    A rollout whose initial state lies between the entry and exit boundaries of a gate with hysteresis begins in the
    swing-up law: without an earlier mode, only the entry region counts.
    """

    swing_up: Law = part("a law", "voltage")
    regulator: Law = part("a law", "voltage")
    gate: Gate = part("a gate", "margin")

    def init(self, measurement: State) -> ModeMemory:
        """Returns the mode at the first measurement, the controller's only memory."""
        return start_memory(self, measurement)

    def update(self, memory: ModeMemory, measurement: State) -> tuple[ModeMemory, Scalar]:
        """Returns the next mode, and the voltage that its law demands [V]."""
        return update_mode(self, memory, measurement)

    def start_mode(self, state: State) -> Int[Array, ""]:
        """Returns REGULATE inside the gate's entry region, SWING_UP elsewhere."""
        return self.next_mode(state, jnp.asarray(SWING_UP, dtype=jnp.int32))

    def next_mode(self, state: State, mode: Int[Array, ""]) -> Int[Array, ""]:
        """Returns REGULATE where the gate's margin in the present mode is at least 0, else SWING_UP; no derivative."""
        return where(self._gate_margin(state, mode) >= 0.0, np.int32(REGULATE), np.int32(SWING_UP))

    def mode_voltage(self, state: State, mode: Int[Array, ""]) -> Scalar:
        """Returns the demanded voltage [V] of the law of `mode`.

        Both laws are evaluated; the one not selected, if finite, contributes neither value nor derivative.
        """
        regulate, swing_up = (
            real(f"controller.{name}.voltage", call(f"controller.{name}", getattr(self, name), "voltage", state))
            for name in ("regulator", "swing_up")
        )
        voltage = where(mode == REGULATE, regulate, swing_up)
        if isinstance(self.gate, _FINITE_GATES):
            return voltage
        # A margin that is NaN chooses no mode. So that it does not pass for "outside", the run is to fail.
        margin = self._gate_margin(state, mode)
        return where(jnp.isnan(margin), jnp.asarray(jnp.nan, voltage.dtype), voltage)

    def margin(self, state: State, mode: Int[Array, ""]) -> Scalar:
        """Returns the gate's margin, with the sign that makes it positive while `mode` lasts."""
        margin = self._gate_margin(state, mode)
        return where(mode == REGULATE, margin, -margin)

    def successor(self, mode: Int[Array, ""]) -> Int[Array, ""]:
        """Returns the other mode."""
        return (SWING_UP + REGULATE) - mode

    def _gate_margin(self, state: State, mode: Int[Array, ""]) -> jax.Array:
        return real("controller.gate.margin", call("controller.gate", self.gate, "margin", state, mode))
