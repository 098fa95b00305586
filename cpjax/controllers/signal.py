"""Voltage commands over time, recorded in an experiment or planned for one."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int32

from cpjax.errors import InputError
from cpjax.numeric.selection import where
from cpjax.pytree import JaxOrNumpy, Scalar, is_traced, matrix, pytree


class SignalMemory(NamedTuple):
    """Playback position in a signal."""

    samples: Int32[Array, ""]
    """Number of control instants so far: unlike a sum of periods, free of rounding errors."""
    next: Int32[Array, ""]
    """Index of the next time of the signal."""


@pytree
class VoltageSignal:
    """Recorded or planned command, held between its times: an open-loop controller, independent of measurements.

    It is evaluated at the control instants of the sampled clock: at the instant t the command is the voltage of the
    last time that is not after t, and 0 V before the first time. The last voltage is held to the end. A time that
    equals a control instant up to rounding counts as that instant. To replay a log, choose dt or the control period so
    that the log's times are control instants.

    Differentiable in the voltages, not in the times: a command changes at a control instant.
    """

    times: Float[JaxOrNumpy, "*batch times"] = matrix((None,), "s", "rising: from when on each voltage is commanded")
    voltages: Float[JaxOrNumpy, "*batch times"] = matrix((None,), "V", "one for each time")
    period: Scalar | None = None
    """Control period of the loop [s], set by the rollout."""

    def __post_init__(self) -> None:
        times, voltages = np.shape(self.times), np.shape(self.voltages)
        if times[-1:] != voltages[-1:]:
            allowed = f"as many as there are times, {times[-1]}"
            raise InputError("VoltageSignal.voltages", f"array of shape {voltages}", allowed)
        if not is_traced(self.times) and not np.all(np.diff(np.asarray(self.times), axis=-1) > 0.0):
            raise InputError("VoltageSignal.times", self.times, "rising")

    def at_period(self, period: Scalar) -> "VoltageSignal":
        """Returns the signal with the control period [s] of its loop."""
        return dataclasses.replace(self, period=period)

    def init(self, measurement: object) -> SignalMemory:
        """Returns the memory at t = 0."""
        none = jnp.asarray(0, dtype=jnp.int32)
        return SignalMemory(none, jnp.sum(self._is_due(jnp.asarray(self.times), none)).astype(jnp.int32))

    def update(self, memory: SignalMemory, measurement: object) -> tuple[SignalMemory, Scalar]:
        """Returns the new memory and the voltage of this instant [V]."""
        times = jnp.asarray(self.times)  # only compared, so that nothing has a derivative in them
        voltages = jnp.asarray(self.voltages)
        count = times.shape[0]

        def is_due(index: jax.Array) -> jax.Array:
            time = lax.dynamic_index_in_dim(times, jnp.minimum(index, count - 1), keepdims=False)
            return (index < count) & self._is_due(time, memory.samples)

        # If the signal is finer than the control period, several of its times are due at once.
        following = lax.while_loop(is_due, lambda index: index + 1, memory.next)
        voltage = lax.dynamic_index_in_dim(voltages, jnp.maximum(following - 1, 0), keepdims=False)
        return SignalMemory(memory.samples + 1, following), where(following > 0, voltage, 0.0)

    def _is_due(self, time: jax.Array, samples: jax.Array) -> jax.Array:
        """Returns whether a time of the signal is not after this control instant, up to rounding."""
        if self.period is None:
            raise InputError("VoltageSignal.period", None, "known: use the signal in a rollout, or at_period(seconds)")
        period = jnp.asarray(self.period, dtype=time.dtype)
        now = samples.astype(time.dtype) * period
        rounding = 1e-3 * period + 4.0 * float(np.finfo(time.dtype).eps) * now
        return time <= now + rounding
