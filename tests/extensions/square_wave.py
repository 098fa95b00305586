"""State feedback to a reference that jumps to and fro, as every course on control has it."""

import dataclasses
from typing import Any

import jax.numpy as jnp

import cpjax
from cpjax.pytree import Scalar, number, part, pytree


@pytree
class SquareWave:
    law: cpjax.StateFeedback = part("a StateFeedback", "K")
    amplitude: Scalar = number("m", "of the cart's reference")
    half_period: Scalar = number("s", "for which the reference stays on a side", above=0.0)
    period: Any = None

    def at_period(self, period):
        return dataclasses.replace(self, period=period)

    def init(self, measurement):
        return jnp.asarray(0, dtype=jnp.int32)

    def update(self, samples, measurement):
        time = samples.astype(measurement.x.dtype) * self.period
        side = jnp.where(jnp.floor(time / self.half_period + 1e-6) % 2 == 0, 1.0, -1.0)
        state = dataclasses.replace(measurement, x=measurement.x - side * self.amplitude)
        return samples + 1, self.law.voltage(state)


def example():
    K = cpjax.lqr(*cpjax.linearize(cpjax.CartPole()), jnp.diag(jnp.array([100.0, 1.0, 100.0, 1.0])), 1.0).K
    return SquareWave(cpjax.StateFeedback(K), 0.05, 0.25), cpjax.State(0.0, 0.0, 0.02, 0.0)
