import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cpjax
from cpjax.backend.single_kernel import outline
from cpjax.sim.invariants import hoisted
from cpjax.sim.scan import scan

START = (jnp.asarray(0.3), jnp.asarray(2, jnp.int32))
PARAMETERS = {"gain": jnp.asarray(1.5), "bias": jnp.asarray(0.25), "weights": jnp.asarray([0.5, -0.3])}


@jax.custom_jvp
def doubled(x):
    return 2.0 * x


@doubled.defjvp
def _doubled_jvp(primals, tangents):
    return doubled(*primals), 3.0 * tangents[0]  # wrong by intention, so that it shows whether it is used


@jax.custom_vjp
def halved(x):
    return 0.5 * x


halved.defvjp(lambda x: (halved(x), None), lambda _, cotangent: (7.0 * cotangent,))  # wrong by intention as well


@jax.jit
def inner(p, x):
    return jnp.exp(p["gain"]) * x + jnp.sum(jnp.cos(p["weights"]))


def of_parameters(p, carry):
    x, n = carry
    return jnp.tanh(p["gain"] * x + jnp.sin(p["bias"])), n + 1


def with_functions(p, carry):
    x, n = carry
    return inner(p, inner(p, 0.1 * x) * 0.1) * 0.1, n + 1


def with_an_outline(p, carry):
    x, n = carry
    y, z = outline(lambda p, x: (jnp.exp(p["gain"]) * x, jnp.exp(p["gain"]) - x))(p, x)
    return 0.1 * (y + z), n


def with_own_derivatives(p, carry):
    x, n = carry
    return 0.1 * (doubled(p["gain"]) * x + doubled(x) + halved(p["bias"]) + halved(x)), n


def with_branches_and_loops(p, carry):
    x, n = carry
    chosen = jax.lax.cond(p["gain"] > 1.0, jnp.sin, lambda v: v, p["bias"])
    repeated = jax.lax.fori_loop(0, 3, lambda _, v: v * p["gain"], x)
    return jax.lax.cond(x > 0.2, lambda v: 0.1 * v * chosen, lambda v: v + p["bias"], repeated), n


def with_random_numbers(p, carry):
    x, n = carry
    key = jax.random.key(3)
    return 0.5 * x + 0.1 * jax.random.normal(jax.random.fold_in(key, n), x.shape, x.dtype) * p["gain"], n + 1


def with_results_of_parameters_alone(p, carry):
    return jnp.sin(p["gain"]), jnp.asarray(4, jnp.int32)


BODIES = [
    of_parameters,
    with_functions,
    with_an_outline,
    with_own_derivatives,
    with_branches_and_loops,
    with_random_numbers,
    with_results_of_parameters_alone,
]


@pytest.mark.parametrize("body", BODIES, ids=lambda body: body.__name__)
def test_a_loop_with_invariants_moved_out_has_the_same_values_and_derivatives(body):
    def moved(p, carry):
        (x, n), _ = scan(lambda c, _: (body(p, c), None), carry, jnp.arange(6), "segments")
        return x, n

    def plain(p, carry):
        (x, n), _ = jax.lax.scan(lambda c, _: (body(p, c), None), carry, jnp.arange(6))
        return x, n

    found, right = ((f(PARAMETERS, START), jax.grad(f, has_aux=True)(PARAMETERS, START)[0]) for f in (moved, plain))
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-13), found, right)
    many = (jnp.linspace(0.1, 0.9, 3), jnp.arange(3, dtype=jnp.int32))
    found, right = (jax.vmap(jax.value_and_grad(f, has_aux=True), (None, 0))(PARAMETERS, many) for f in (moved, plain))
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-13), found, right)
    each = jax.tree.map(lambda p: p * jnp.asarray([1.0, 1.1, 1.2]).reshape(3, *(1,) * jnp.ndim(p)), PARAMETERS)
    found, right = (jax.vmap(f)(each, many)[0] for f in (moved, plain))
    np.testing.assert_allclose(found, right, rtol=1e-13)
    if body is not with_own_derivatives:
        found, right = (jax.jacfwd(lambda p, f=f: f(p, START)[0])(PARAMETERS) for f in (moved, plain))
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-13), found, right)


def operations(function, *arguments):
    """The names of all operations of a function, those of functions that it calls included."""

    def names(jaxpr):
        for equation in jaxpr.eqns:
            inner_ones = list(jax.extend.core.jaxprs_in_params(equation.params))
            yield from [equation.primitive.name] if not inner_ones else []
            for one in inner_ones:
                yield from names(getattr(one, "jaxpr", one))

    return list(names(jax.make_jaxpr(function)(*arguments).jaxpr))


@pytest.mark.parametrize("body", [with_functions, with_an_outline], ids=lambda body: body.__name__)
def test_what_depends_on_parameters_alone_is_moved_out_of_functions_too(body):
    def rest_of(p):
        return operations(hoisted(lambda carry: body(p, carry), START), START)

    assert "exp" in operations(lambda carry: body(PARAMETERS, carry), START)
    assert not {"exp", "cos"} & set(rest_of(PARAMETERS))


def test_equal_operations_are_computed_once():
    def body(carry):
        return [jnp.sin(carry * carry) + jnp.sin(carry * carry), jnp.sin(carry * carry)]

    assert operations(hoisted(body, 1.0), 1.0).count("sin") == 1
    alike = (0.12345678901, 0.12345678902)  # which NumPy prints alike
    assert operations(hoisted(lambda x: [x * number for number in alike], 1.0), 1.0).count("mul") == 2
    assert operations(lambda x: [x + 0.0, x + (-0.0)], 1.0) == operations(
        hoisted(lambda x: [x + 0.0, x + (-0.0)], 1.0), 1.0
    )


def test_a_callback_stays_in_the_loop():
    seen = []

    def body(carry, _):
        jax.debug.callback(lambda gain: seen.append(float(gain)), PARAMETERS["gain"])
        return carry, None

    jax.jit(lambda carry: scan(body, carry, jnp.arange(4), "every_step"))(START)
    jax.effects_barrier()
    assert seen == [1.5] * 4


def operations_of_a_step():
    """The names of the operations in the loop of the tuned LQR."""

    def simulated(plant, law):
        return cpjax.measure(plant, law, cpjax.HANGING, duration=0.1, dt=0.01)

    jax.clear_caches()
    numbers = jax.tree.map(jnp.asarray, (cpjax.CartPole(), cpjax.preset("lqr")))
    jaxpr = jax.make_jaxpr(simulated)(*numbers).jaxpr
    loops = [equation for equation in _flat(jaxpr) if equation.primitive.name == "scan"]
    return [equation.primitive.name for equation in _flat(loops[-1].params["jaxpr"].jaxpr)]


def _flat(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for one in jax.extend.core.jaxprs_in_params(equation.params):
            yield from _flat(getattr(one, "jaxpr", one))


def test_about_half_of_the_operations_of_a_step_remain(monkeypatch):
    after = operations_of_a_step()
    monkeypatch.setattr("cpjax.sim.scan.hoisted", lambda function, *_: function)
    before = operations_of_a_step()
    assert 0.4 < len(after) / len(before) < 0.6
    assert after.count("div") == 4  # one in each stage of the Runge-Kutta step: by the determinant of the mass matrix
