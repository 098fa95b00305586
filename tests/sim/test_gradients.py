import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cpjax
from cpjax import InputError, gradients, paper
from cpjax.sim.scan import scan

PLANT = paper.appendix_plant()
LAW = paper.controller("corrected-centred", "placement", PLANT).swing_up
STARTS = cpjax.sample_starts("hanging", 7, seed=2)


def outside(p, start):
    law = cpjax.EnergySwingUp(
        PLANT, energy_gain=p["energy_gain"], cart_damping=p["cart"][0], cart_stiffness=p["cart"][1]
    )
    return cpjax.measure(
        PLANT, law, start, clock="continuous", duration=0.6, dt=0.01, metrics=cpjax.TimeOutside(1.5, 0.5)
    )


def parameters():
    return {"energy_gain": jnp.asarray(5.0), "cart": jnp.asarray([2.0, 4.0])}


@pytest.mark.slow
def test_forward_and_reverse_in_any_chunks_are_the_gradients_of_each_start():
    found = gradients(outside, parameters(), STARTS)
    assert found.value.shape == (7,)
    assert found.gradient["cart"].shape == (7, 2)
    for other in (
        gradients(outside, parameters(), STARTS, direction="forward"),
        gradients(outside, parameters(), STARTS, chunk=3),
    ):
        for one, two in zip(jax.tree.leaves(found), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-10, atol=1e-14)
    third = cpjax.State(*(jnp.asarray(column[2]) for column in STARTS.vector().T))
    value, gradient = jax.value_and_grad(outside)(parameters(), third)
    assert float(found.value[2]) == pytest.approx(float(value), rel=1e-12)
    np.testing.assert_allclose(found.gradient["cart"][2], gradient["cart"], rtol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"direction": "sideways"}, "direction"),
        ({"direction": None}, "direction"),
        ({"chunk": 0}, "chunk"),
        ({"chunk": 2.0}, "chunk"),
    ],
)
def test_arguments_that_mean_nothing_are_refused_by_name(arguments, field):
    with pytest.raises(InputError) as caught:
        gradients(outside, parameters(), STARTS, **arguments)
    assert caught.value.field == field


def test_initial_states_that_are_not_finite_are_refused():
    starts = dataclasses.replace(STARTS, theta=np.where(np.arange(STARTS.theta.size) == 1, np.inf, STARTS.theta))
    with pytest.raises(InputError, match=r"starts\.theta = .*: must be finite"):
        gradients(outside, parameters(), starts)


@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_an_objective_that_is_no_number_and_parameters_not_floats_are_refused(direction):
    with pytest.raises(InputError) as caught:
        gradients(lambda p, start: p["cart"], parameters(), STARTS, direction=direction)
    assert caught.value.field == "objective"
    with pytest.raises(InputError) as caught:
        gradients(outside, parameters() | {"energy_gain": 5}, STARTS, direction=direction)
    assert caught.value.field == "parameters['energy_gain']"


@pytest.mark.parametrize("n", [1, 2, 10, 16, 23])
def test_a_scan_in_segments_is_a_scan(n):
    def body(carry, x):
        carry = jnp.sin(carry) + 0.1 * x
        return carry, 2.0 * carry

    def total(c, checkpoint):
        last, kept = scan(body, c, jnp.arange(float(n)), checkpoint)
        return last + jnp.sum(kept)

    whole, segments = (jax.value_and_grad(total)(jnp.asarray(0.3), c) for c in ("every_step", "segments"))
    np.testing.assert_allclose(whole, segments, rtol=1e-14)


@pytest.mark.slow
def test_segments_keep_less():
    def cost(p, start, checkpoint):
        law = cpjax.EnergySwingUp(PLANT, energy_gain=p)
        return cpjax.measure(
            PLANT,
            law,
            start,
            clock="continuous",
            duration=90.0,
            dt=0.01,
            checkpoint=checkpoint,
            metrics=cpjax.TimeOutside(1.5, 0.5),
        )

    start = cpjax.State(*map(jnp.asarray, (0.0, 0.0, 3.0, 0.0)))
    memory = [
        jax.jit(jax.grad(cost), static_argnums=2).lower(5.0, start, c).compile().memory_analysis().temp_size_in_bytes
        for c in ("every_step", "segments")
    ]
    assert memory[1] < 0.3 * memory[0]


def test_a_gradient_that_overflows_is_told_for_each_start():
    def grown(p, start):
        return p * jnp.exp(start.x)

    starts = cpjax.State(jnp.array([1.0, 800.0, 2.0]), jnp.zeros(3), jnp.zeros(3), jnp.zeros(3))
    found = cpjax.gradients(grown, jnp.asarray(1.0), starts)
    assert found.finite.tolist() == [True, False, True]
