"""A dead time of whole samples, around any controller. An `equinox.Module`, if that is what its author likes."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

import cpjax


class DeadTime(eqx.Module):
    controller: Any
    limit: Any
    samples: int = eqx.field(static=True)

    def init(self, measurement):
        return self.controller.init(measurement), jnp.zeros(self.samples)

    def update(self, memory, measurement):
        inner, waiting = memory
        inner, command = self.controller.update(inner, measurement)
        line = jnp.append(waiting, jnp.clip(command, -self.limit, self.limit).astype(waiting.dtype))
        return (inner, line[1:]), line[0]


def example(controller=None):
    controller = (
        cpjax.paper.controller("corrected-centred", "lqr", cpjax.CartPole()) if controller is None else controller
    )
    return DeadTime(controller, 12.0, 3), cpjax.State(0.0, 0.0, 3.0, 0.0)
