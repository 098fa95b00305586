"""Loops that the compiler makes one function of: which ones, and that nothing but speed depends on it."""

import contextlib
import dataclasses
import importlib
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cpjax
from cpjax import paper
from cpjax.backend import runtime, single_kernel
from cpjax.numeric.differences import central_differences
from cpjax.pytree import number, pytree

PLANT = paper.appendix_plant()
CENTRED = paper.controller("corrected-centred", "placement", PLANT)
WHOLE = 'xla_cpu_small_call = "true"'


@pytree
class Law:
    """`function` of the state and of two numbers, of which the second may not matter."""

    gain: float = number("V", "a gain", default=3.0)
    other: float = number("V", "another", default=0.5)
    function = staticmethod(lambda law, state: law.gain * state.theta_dot)

    def voltage(self, state):
        return type(self).function(self, state)


def law(function):
    return pytree(
        type("Made", (Law,), {"__doc__": "A law.", "__annotations__": {}, "function": staticmethod(function)})
    )


def effort(start, controller, **options):
    options = {"clock": "sampled", "duration": 0.1, "dt": 0.002} | options
    if options.get("switching") != "located":
        options["derivative"] = "pathwise"
    return cpjax.measure(PLANT, controller, start, **options).effort


def near(theta):
    return cpjax.State(x=0.1, x_dot=0.0, theta=theta, theta_dot=0.1)


def slope(function, x):
    return central_differences(
        lambda h: (np.asarray(function(x + h)), np.asarray(function(x - h))), 0.1 / 2.0 ** np.arange(8)
    ).derivative


def lowered(function, *arguments):
    return jax.jit(function).lower(*arguments).as_text()


def unmarked(monkeypatch):
    monkeypatch.setattr(runtime, "TESTED", ())
    runtime.jaxlib_is_tested.cache_clear()
    with pytest.warns(cpjax.PerformanceWarning, match="was not tested with"):
        runtime.jaxlib_is_tested()
    jax.clear_caches()


@pytest.fixture(autouse=True)
def fresh():
    yield
    runtime.jaxlib_is_tested.cache_clear()


@pytest.mark.parametrize(
    "options",
    [{}, pytest.param({"clock": "continuous", "switching": "located"}, marks=pytest.mark.slow)],
    ids=["per_step", "located"],
)
def test_a_rollout_is_one_function_and_so_are_the_passes_of_its_derivative(options):
    def cost(theta):
        return effort(near(theta), CENTRED, **options)

    assert WHOLE in lowered(cost, 3.0)
    assert lowered(jax.vmap(jax.value_and_grad(cost)), jnp.linspace(2.0, 3.0, 5)).count(WHOLE) == 2


@pytest.mark.parametrize(
    "options",
    [
        {"derivative": "pathwise"},
        *(
            pytest.param(one, marks=pytest.mark.slow)
            for one in (
                {"derivative": "mean"},
                {"clock": "continuous", "derivative": "pathwise"},
                {"clock": "continuous", "switching": "located"},
            )
        ),
    ],
    ids=["sampled", "mean", "per_step", "located"],
)
def test_each_pass_of_a_derivative_in_all_numbers_is_one_function(options):
    def cost(plant, law, theta):
        return cpjax.measure(plant, law, near(theta), metrics=cpjax.TimeOutside(), duration=0.4, dt=0.01, **options)

    numbers = jax.tree.map(jnp.asarray, (PLANT, CENTRED))
    gradients = jax.vmap(jax.value_and_grad(cost, argnums=(0, 1)), (None, None, 0))
    assert lowered(gradients, *numbers, jnp.linspace(2.0, 3.0, 5)).count(WHOLE) == 2


def test_a_batch_too_large_for_one_core_stays_shared_out():
    starts = jnp.linspace(2.0, 3.0, single_kernel.LARGEST + 1)
    assert WHOLE not in lowered(jax.vmap(lambda theta: effort(near(theta), CENTRED)), starts)


@pytest.mark.parametrize(("count", "fits"), [(1023, True), (1024, False)])
def test_a_sum_that_xla_hands_to_another_library_is_not_part_of_a_kernel(count, fits):
    """Such a loop failed to compile."""
    controller = law(lambda law, state: jnp.sum(law.gain * state.vector()))()
    function = jax.vmap(lambda theta: effort(near(theta), controller))
    starts = jnp.linspace(2.0, 3.0, count)
    with contextlib.nullcontext() if fits else pytest.warns(cpjax.PerformanceWarning, match="a sum over 4096 numbers"):
        assert (WHOLE in lowered(function, starts)) == fits
    with warnings.catch_warnings(action="ignore"):
        assert np.all(np.isfinite(jax.jit(function)(starts)))


@pytest.mark.slow
def test_a_jaxlib_that_was_not_tested_is_told_nothing_and_gives_the_same(monkeypatch):
    def cost(theta):
        return effort(near(theta), CENTRED, clock="continuous")

    marked = jax.jit(jax.value_and_grad(cost))(2.9)
    unmarked(monkeypatch)
    assert WHOLE not in lowered(jax.value_and_grad(cost), 2.9)
    np.testing.assert_allclose(marked, jax.jit(jax.value_and_grad(cost))(2.9), rtol=1e-10)


@pytest.mark.parametrize(
    "options",
    [
        {"checkpoint": "every_step"},
        pytest.param({"clock": "continuous"}, marks=pytest.mark.slow),
        pytest.param({"clock": "continuous", "switching": "located"}, marks=pytest.mark.slow),
    ],
)
def test_finite_difference_forward_and_reverse_agree_also_under_vmap(options):
    def cost(gain):
        controller = cpjax.EnergySwingUp(PLANT, energy_gain=gain, cart_stiffness=4.0, cart_damping=2.0)
        return effort(near(2.8), controller, **options)

    gains = jnp.array([5.0, 8.0])
    forward = jax.jit(jax.vmap(jax.jacfwd(cost)))(gains)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(cost)))(gains), forward, rtol=1e-10)
    np.testing.assert_allclose(jax.jit(jax.grad(cost))(gains[0]), forward[0], rtol=1e-10)
    np.testing.assert_allclose(forward[0], slope(cost, gains[0]), rtol=1e-6)


UNUSED = {
    "always the first": lambda law, state: jnp.where(True, law.gain, law.other) * state.theta_dot,
    "a branch never taken": lambda law, state: jax.lax.cond(
        jnp.bool_(False), lambda: law.other * state.x, lambda: law.gain * state.theta_dot
    ),
    "neither number": lambda law, state: 3.0 * state.theta_dot,
    "a constant": lambda law, state: 1.0,
}


@pytest.mark.slow
@pytest.mark.parametrize("function", UNUSED.values(), ids=UNUSED)
def test_numbers_that_the_compiler_finds_unused_do_no_harm(function):
    kind = law(function)

    def cost(gain, other):
        return effort(near(2.8), kind(gain, other), clock="continuous")

    assert np.all(np.isfinite(jax.jit(jax.grad(cost, argnums=(0, 1)))(3.0, 0.5)))
    assert np.all(np.isfinite(jax.grad(cost, argnums=(0, 1))(3.0, 0.5)))
    assert np.isfinite(jax.jit(lambda: cost(3.0, 0.5))())  # all is constant


def zoo(law, state):
    x, v, theta, omega = state.x, state.x_dot, state.theta, state.theta_dot
    smooth = [jnp.sin(theta), jnp.cos(x), jnp.tan(0.3 * x), jnp.tanh(v), jnp.exp(-x * x), jnp.expm1(0.1 * v)]
    smooth += [jnp.log1p(x * x), jnp.log(2.0 + jnp.cos(x)), jnp.sqrt(1.0 + v * v), jax.lax.rsqrt(2.0 + x * x)]
    smooth += [jnp.cbrt(2.0 + jnp.sin(x)), jax.nn.sigmoid(v), jnp.arctan2(x, 1.0 + v * v), (2.0 + jnp.sin(x)) ** 1.7]
    steps = [jnp.floor(3.0 * x), jnp.ceil(v), jnp.round(theta), jnp.sign(omega), jnp.mod(theta, 2.0), jnp.abs(v)]
    steps += [jnp.clip(omega, -1.0, 1.0), jnp.where(jnp.isfinite(x), 1.0, 0.0), jnp.maximum(x, v) - jnp.minimum(x, v)]
    table = jnp.concatenate([jnp.stack([x, v]), jnp.stack([0.0 * x, theta, omega, 0.0 * x])])[::-1]
    taken = jax.lax.dynamic_slice(table, (jnp.int32(law.gain > 0) + 1,), (2,)).sum() + table.reshape(2, 3).T[1, 0]
    looped = jax.lax.fori_loop(0, 3, lambda _, y: 0.5 * y + x, v) + jax.lax.while_loop(
        lambda y: y > 1.0, lambda y: 0.5 * y, jnp.abs(theta)
    )
    branched = jax.lax.switch(jnp.int32(theta > 0), [lambda: x, lambda: v * law.other])
    counted = jax.lax.population_count(jnp.int32(4.0 + x) ^ 5) << 1
    return law.gain * (
        sum(smooth) + 0.1 * sum(steps) + 0.1 * taken + looped + branched + 0.01 * counted.astype(x.dtype)
    )


def test_each_operation_that_is_allowed_gives_what_it_gives_elsewhere(monkeypatch):
    controller = law(zoo)()

    def efforts(theta):
        return effort(near(theta), controller)

    assert WHOLE in lowered(efforts, 2.8)
    marked = jax.jit(efforts)(2.8)
    unmarked(monkeypatch)
    np.testing.assert_allclose(jax.jit(efforts)(2.8), marked, rtol=1e-9)


def heavy(law, state):
    value = law.gain * state.theta_dot
    for i in range(40):
        value = jnp.tanh(value + 0.01 * i) * (2.0 + jnp.cos(state.x))
    return value


@pytest.mark.slow
def test_a_heavy_law_for_many_starts_is_not_shared_out_within_the_function():
    """XLA marks what is worth several cores, and there are none to share it out to inside one function."""
    controller, starts = law(heavy)(), jnp.linspace(2.0, 3.0, 512)

    def cost(theta):
        return effort(near(theta), controller, duration=0.02)

    assert WHOLE in lowered(jax.vmap(cost), starts)
    np.testing.assert_allclose(jax.jit(jax.vmap(cost))(starts)[7], cost(starts[7]), rtol=1e-10)
    assert np.all(np.isfinite(jax.jit(jax.vmap(jax.grad(cost)))(starts)))


CALLS = {
    "a solver": lambda law, state: jnp.linalg.solve(jnp.eye(2) * law.gain, jnp.stack([state.theta_dot, state.x]))[0],
    "a sort": lambda law, state: jnp.sort(jnp.stack([state.x, law.gain * state.theta_dot]))[1],
    "a callback": lambda law, state: jax.pure_callback(
        lambda x: np.asarray(2.0 * x, x.dtype), jax.ShapeDtypeStruct((), state.x.dtype), state.theta_dot
    ),
    "a product of matrices": lambda law, state: (jnp.ones((1, 2)) * law.gain @ jnp.stack([state.x, state.x_dot]))[0],
}


@pytest.mark.slow
@pytest.mark.parametrize("function", CALLS.values(), ids=CALLS)
def test_a_law_that_calls_another_library_works_as_ever(function):
    controller = law(function)()
    with pytest.warns(cpjax.PerformanceWarning, match="keeps XLA from compiling it as one function"):
        assert WHOLE not in lowered(lambda theta: effort(near(theta), controller), 2.8)
    with warnings.catch_warnings(action="ignore"):
        assert np.isfinite(effort(near(2.8), controller))


def test_reverse_mode_through_the_elements_of_a_vector_in_the_memory_is_forward_mode(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    controller, start = importlib.import_module("extensions.observer").example()

    def outside(scale):
        law = dataclasses.replace(controller, gain=scale * controller.gain)
        settings = {"duration": 0.5, "dt": 0.002, "derivative": "pathwise", "metrics": cpjax.TimeOutside()}
        return cpjax.measure(PLANT, law, dataclasses.replace(start, x=start.x + 0.01), **settings)

    with jax.enable_x64(True):
        np.testing.assert_allclose(jax.grad(outside)(1.0), jax.jacfwd(outside)(1.0), rtol=1e-9)
