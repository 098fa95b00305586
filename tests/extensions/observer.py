"""A Luenberger observer from cart position and angle, around any controller that wants the whole state.

Registered with JAX by hand, as a dataclass that is not made by the package's decorator.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import place_poles

import cpjax


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Observer:
    controller: Any
    transition: Any
    """(4, 4), of the linear model over one period, upright."""
    input: Any
    """(4,), likewise."""
    gain: Any
    """(4, 2)."""

    def init(self, measurement):
        estimate = cpjax.State(measurement.x, 0.0, measurement.theta, 0.0)
        return estimate.vector(), self.controller.init(estimate)

    def update(self, memory, measurement):
        estimate, inner = memory
        state = cpjax.State.from_vector(estimate)
        inner, command = self.controller.update(inner, state)
        error = jnp.stack([measurement.x - state.x, measurement.theta - state.theta])
        following = [
            sum(self.transition[i, j] * estimate[j] for j in range(4))
            + self.input[i] * command
            + sum(self.gain[i, j] * error[j] for j in range(2))
            for i in range(4)
        ]
        return (jnp.stack(following), inner), command


def example():
    plant, period = cpjax.CartPole(), 0.002
    model = cpjax.linearize(plant)
    A, B = (np.asarray(M) for M in cpjax.discretize(*model, period))
    C = np.eye(4)[[0, 2]]
    poles = np.exp(-period * np.array([20.0, 21.0, 22.0, 23.0]))
    gain = place_poles(A.T, C.T, poles).gain_matrix.T
    K = cpjax.lqr(*model, jnp.diag(jnp.array([10.0, 1.0, 100.0, 1.0])), 1.0).K
    law = cpjax.as_sampled(cpjax.StateFeedback(K))
    return Observer(law, A, B[:, 0], gain), cpjax.State(0.0, 0.0, 0.03, 0.0)
