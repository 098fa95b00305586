"""Second derivatives through located switches: Hessian-vector products against differences of the gradient."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cpjax
from cpjax import paper
from cpjax.numeric.differences import central_differences

PLANT = paper.appendix_plant()
REGULATOR = paper.regulator("placement", "printed", PLANT)
STEPS = 4e-3 * 0.5 ** np.arange(9)


def hybrid(p):
    law = cpjax.EnergySwingUp(PLANT, energy_gain=p[0], cart_stiffness=p[1], cart_damping=2.0)
    return cpjax.Hybrid(law, REGULATOR, cpjax.AngleGate(p[2]))


# The gate once; the gate into the regulator and out of it, besides the clip's.
STARTS = {
    1: (cpjax.State(0.0, 0.0, 0.75, -3.0), 0.3),
    2: (cpjax.State(0.0, 0.0, 0.75, -7.5), 0.3),
}


@cpjax.pytree.pytree
class OutsideAndEffort:
    """The time outside the target, and the integral of u^2 by the trapezoidal rule."""

    outside: cpjax.TimeOutside = cpjax.TimeOutside()

    def init(self, sample):
        return self.outside.init(sample), jnp.zeros_like(sample.voltage)

    def update(self, memory, sample):
        step = 0.5 * sample.elapsed * (sample.voltage_since**2 + sample.voltage_before**2)
        return self.outside.update(memory[0], sample), memory[1] + step

    def finalize(self, memory, last):
        return self.outside.finalize(memory[0], last), memory[1]


@pytest.mark.slow  # a minute of compiling each
@pytest.mark.parametrize("changes", STARTS)
def test_hessian_products_through_located_switches_are_differences_of_gradients(changes):
    start, duration = STARTS[changes]
    run = {"duration": duration, "dt": 0.005, "switching": "located"}

    def outside(p):
        moved = cpjax.State(start.x, start.x_dot, start.theta + p[3], start.theta_dot)
        outside, effort = cpjax.measure(PLANT, hybrid(p), moved, metrics=OutsideAndEffort(), **run)
        return outside + 1e-3 * effort

    p = jnp.array([5.0, 4.0, math.pi / 6, 0.0])
    metrics = cpjax.measure(PLANT, hybrid(p), start, **run)
    assert int(metrics.switches) == changes
    assert int(metrics.flag) == 0
    gradient = jax.jit(jax.grad(outside))
    product = jax.jit(lambda p, v: jax.jvp(jax.grad(outside), (p,), (v,))[1])
    scale = np.array([1.0, 1.0, 0.1, 0.1])
    for direction in np.eye(4) * scale:
        found = np.asarray(product(p, jnp.asarray(direction)))
        expected = central_differences(
            lambda h, d=direction: (np.asarray(gradient(p + h * d)), np.asarray(gradient(p - h * d))), STEPS
        ).derivative
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.max(np.abs(expected)))
