import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import jacobian

import cpjax
from cpjax import InputError, SmoothClip, SmoothHybrid, State, paper
from cpjax.pytree import pytree

PLANT = paper.appendix_plant()
HARD = paper.controller("corrected-centred", "placement", PLANT)


@pytree
class Ask:
    """Asks for the cart's position, in volts."""

    def voltage(self, state):
        return state.x


def at(x):
    return State(x, 0.0 * x, 0.0 * x, 0.0 * x)


@pytest.mark.parametrize("temperature", [1e-6, 1e-2, 1.0, 100.0])
def test_the_clipped_demand_rises_smoothly_from_limit_to_limit_and_never_beyond(temperature):
    clip = SmoothClip(Ask(), 12.0, temperature)
    x = jnp.linspace(-1000.0, 1000.0, 4001)
    u, slope = jax.vmap(jax.value_and_grad(lambda x: clip.voltage(at(x))))(x)
    assert np.all(np.abs(u) <= 12.0 * (1 + 1e-12))
    assert np.all((slope >= 0.0) & (slope <= 1.0 + 1e-12))
    assert np.all(np.diff(u) >= -1e-9)
    np.testing.assert_allclose(u, -u[::-1], atol=1e-9)


def test_the_colder_the_closer_to_the_clip():
    x = jnp.linspace(-30.0, 30.0, 601)
    far = [
        float(jnp.max(jnp.abs(SmoothClip(Ask(), 12.0, t).voltage(at(x)) - jnp.clip(x, -12.0, 12.0))))
        for t in (1.0, 0.1, 0.01)
    ]
    np.testing.assert_allclose(far, math.log(2.0) * np.array([1.0, 0.1, 0.01]), rtol=1e-6)  # at the corner


def test_the_regulators_share_is_a_half_on_the_boundary_and_whole_far_inside():
    smooth = SmoothHybrid(HARD.swing_up, HARD.regulator, HARD.gate, 0.01)
    edge = float(HARD.gate.half_angle)
    inside, outside, on = (State(0.0, 0.0, theta, -1.0) for theta in (0.5 * edge, 1.5 * edge, edge))
    assert float(smooth.voltage(inside)) == pytest.approx(float(HARD.regulator.voltage(inside)), rel=1e-3)
    assert float(smooth.voltage(outside)) == pytest.approx(float(HARD.swing_up.voltage(outside)), rel=1e-3)
    half = 0.5 * (HARD.regulator.voltage(on) + HARD.swing_up.voltage(on))
    assert float(smooth.voltage(on)) == pytest.approx(float(half), rel=1e-9)


@pytest.mark.slow
def test_a_smooth_loop_has_right_derivatives_and_converges_to_the_hard_one():
    start = State(0.03, 0.0, math.pi - 0.25, 0.2)

    def end(x):
        law = SmoothClip(SmoothHybrid(HARD.swing_up, HARD.regulator, HARD.gate, x[0]), 12.0, 12.0 * x[0])
        return cpjax.rollout(PLANT, law, start, clock="continuous", duration=2.4, dt=2e-3).state.vector()[-1]

    hard = cpjax.rollout(PLANT, HARD, start, duration=2.4, dt=2e-3, switching="located").state.vector()[-1]
    batched = jax.jit(jax.vmap(end))
    ends = np.asarray(batched(jnp.asarray([[0.1], [0.01], [0.001]])))
    distances = np.linalg.norm(ends - hard, axis=1)
    assert distances[2] < 0.1 * distances[1] < 0.1 * distances[0]
    slopes = jax.jit(jax.jacfwd(end))(jnp.asarray([0.1]))
    np.testing.assert_allclose(slopes, jacobian(batched, [0.1], 1e-4), rtol=1e-7)


@pytest.mark.parametrize("temperature", [0.0, -1.0, math.inf, math.nan])
def test_temperatures_that_mean_nothing_are_refused(temperature):
    with pytest.raises(InputError, match="temperature"):
        SmoothClip(Ask(), 12.0, temperature)
    with pytest.raises(InputError, match="temperature"):
        SmoothHybrid(HARD.swing_up, HARD.regulator, HARD.gate, temperature)


def test_they_can_be_saved_and_loaded(tmp_path):
    law = SmoothClip(SmoothHybrid(HARD.swing_up, HARD.regulator, HARD.gate, 0.1), 12.0, 1.0)
    cpjax.save(tmp_path / "law.json", law)
    state = State(0.1, 0.2, 0.4, -1.0)
    assert float(cpjax.load(tmp_path / "law.json").voltage(state)) == float(law.voltage(state))
