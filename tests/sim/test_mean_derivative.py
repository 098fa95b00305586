"""The derivative of the mean on the sampled clock: against located derivatives, and against differences of the mean."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from extensions import dead_time, observer
from oracles import fitted_order

import cpjax
from cpjax import paper

PLANT = paper.appendix_plant()
SLOW = pytest.mark.slow  # half a minute of compiling each
CENTRED = paper.controller("corrected-centred", "placement", PLANT)


def changed(p):
    """The corrected law by energy gain, cart damping and gate angle."""
    swing_up = dataclasses.replace(CENTRED.swing_up, energy_gain=p[0], cart_damping=p[1])
    return cpjax.Hybrid(swing_up, CENTRED.regulator, cpjax.AngleGate(p[2]))


P = jnp.array([5.0, 2.0, math.pi / 6])


def derivatives(starts, wrap=lambda controller: controller, metrics=None, duration=1.6, **settings):
    """By initial state, (n, 3)."""
    metrics = cpjax.TimeOutside() if metrics is None else metrics

    def outside(p, start):
        return cpjax.measure(PLANT, wrap(changed(p)), start, metrics=metrics, duration=duration, **settings)

    return np.asarray(jax.jit(jax.vmap(jax.grad(outside), (None, 0)))(P, starts))


def catching(count, seed):
    """Initial states that all cross the gate once within 1.6 s, at all phases of a period."""
    unit = np.random.default_rng(seed).uniform(-0.05, 0.05, (4, count))
    middle = (0.0, 0.0, 1.2, -2.0)
    return cpjax.State(*(jnp.asarray(m + u) for m, u in zip(middle, unit, strict=True)))


def test_all_of_these_cross_once():
    swept = cpjax.sweep(PLANT, CENTRED, catching(500, 1), duration=1.6, dt=0.002)
    assert set(np.asarray(swept.switches).tolist()) == {1}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrapped", "steps"),
    [(False, 1), pytest.param(True, 1, marks=SLOW), pytest.param(False, 2, marks=SLOW)],
    ids=["hybrid", "held in another controller", "two steps per control period"],
)
def test_its_error_in_single_runs_falls_with_the_period(wrapped, steps):
    starts = catching(48, 2)
    exact = derivatives(starts, switching="located", dt=1e-3)
    periods = np.array([4e-3, 2e-3, 1e-3])
    wrap = Passing if wrapped else (lambda controller: controller)
    errors = [
        np.median(np.abs(derivatives(starts, wrap, derivative="mean", dt=t / steps, control_period=t) - exact), 0)
        for t in periods.tolist()
    ]
    for i in range(3):
        assert fitted_order(periods, np.array([row[i] for row in errors])) > 0.8
    plain = np.median(np.abs(derivatives(starts, derivative="pathwise", dt=2e-3) - exact), 0)
    assert plain[2] > 20.0 * errors[1][2]
    assert plain[2] == pytest.approx(np.median(np.abs(exact[:, 2])))  # blind to the gate


@cpjax.pytree.pytree
class Passing:
    """Holds another controller, and a float that remembers its command."""

    controller: cpjax.Hybrid

    def init(self, measurement):
        return self.controller.init(measurement), 0.0

    def update(self, memory, measurement):
        inner, command = self.controller.update(memory[0], measurement)
        return (inner, command), command


@cpjax.pytree.pytree
class Effort:
    """A metric that is not linear in the voltage: the integral of u^2 [V^2 s]."""

    def init(self, sample):
        return jnp.zeros_like(sample.voltage)

    def update(self, memory, sample):
        return memory + sample.elapsed * sample.voltage_since * sample.voltage_since

    def finalize(self, memory, last):
        return memory


def differences(i, wrap, metrics, count=40_000, move=4e-3):
    """The derivative of the mean by differences with common random numbers, and its standard error."""
    starts = catching(count, 3)
    step = np.zeros(3)
    step[i] = float(P[i]) * move
    up, down = (
        cpjax.sweep(PLANT, wrap(changed(P + sign * step)), starts, metrics=metrics, duration=1.6, dt=0.002)
        for sign in (1, -1)
    )
    each = np.asarray(up - down) / (2.0 * step[i])
    return each.mean(), each.std() / math.sqrt(count)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("delayed", "metrics"),
    [
        (False, cpjax.TimeOutside()),
        pytest.param(False, Effort(), marks=SLOW),
        pytest.param(True, cpjax.TimeOutside(), marks=SLOW),
    ],
    ids=["time outside", "effort", "time outside with a dead time"],
)
@pytest.mark.filterwarnings("ignore::cpjax.PerformanceWarning")  # sums over the waiting commands of 4,000 runs at once
def test_it_is_that_of_differences_of_the_mean_within_three_standard_errors(delayed, metrics):
    wrap = (lambda controller: dead_time.example(controller)[0]) if delayed else (lambda controller: controller)
    by_run = derivatives(catching(4_000, 4), wrap, metrics, derivative="mean", dt=0.002)
    plain = derivatives(catching(4_000, 4), wrap, metrics, derivative="pathwise", dt=0.002)
    for i in (0, 2):
        expected, error = differences(i, wrap, metrics)
        error = math.hypot(error, by_run[:, i].std() / math.sqrt(4_000))
        assert abs(by_run[:, i].mean() - expected) <= 3.0 * error
    assert abs(plain[:, 2].mean() - expected) > 5.0 * error  # the gate angle


@SLOW
def test_with_an_observer_it_differs_from_the_pathwise_one_and_forward_is_reverse():
    made, _ = observer.example()

    def outside(p, derivative):
        controller = dataclasses.replace(made, controller=changed(p))
        settings = {"duration": 0.4, "dt": 0.002, "derivative": derivative, "metrics": cpjax.TimeOutside()}
        return cpjax.measure(PLANT, controller, cpjax.State(0.0, 0.0, 0.6, -1.5), **settings)

    reverse = jax.grad(outside)(P, "mean")
    np.testing.assert_allclose(jax.jacfwd(lambda p: outside(p, "mean"))(P), reverse, rtol=1e-9)
    assert np.all(np.isfinite(reverse))
    assert float(jax.grad(outside)(P, "pathwise")[2]) == 0.0
    assert abs(float(reverse[2])) > 1e-6
    assert float(outside(P, "mean")) == float(outside(P, "pathwise"))


def test_values_are_those_of_the_plain_loop_and_float32_works():
    starts = jax.tree.map(lambda column: column.astype(jnp.float32), catching(8, 5))
    found = jax.vmap(lambda s: cpjax.measure(PLANT, CENTRED, s, duration=0.5, dt=0.002, derivative="mean"))(starts)
    plain = jax.vmap(lambda s: cpjax.measure(PLANT, CENTRED, s, duration=0.5, dt=0.002))(starts)
    np.testing.assert_allclose(found.effort, plain.effort, rtol=1e-5)
    slopes = derivatives(starts, derivative="mean", dt=0.002, duration=0.8)
    assert np.all(np.isfinite(slopes))


@pytest.mark.slow
def test_a_second_derivative_of_the_mean_is_refused():
    def outside(gain):
        p = jnp.stack([gain, P[1], P[2]])
        start = cpjax.State(0.0, 0.0, 1.2, -2.0)
        return cpjax.measure(
            PLANT, changed(p), start, metrics=cpjax.TimeOutside(), duration=0.1, dt=0.002, derivative="mean"
        )

    for second in (jax.jacfwd(jax.grad(outside)), jax.jacrev(jax.jacrev(outside))):
        with pytest.raises(cpjax.InputError, match=r"derivative = 'mean': must be first derivatives only\. .*located"):
            second(P[0])


def test_a_quantiser_has_the_derivative_that_its_name_says():
    for name, slope in (("zero", 0.0), ("straight_through", 1.0)):
        value, found = jax.value_and_grad(lambda x, n=name: cpjax.quantize(x, 0.1, derivative=n))(0.27)
        assert float(value) == pytest.approx(0.3)
        assert float(found) == slope
    mean = jax.vmap(lambda x: cpjax.quantize(x, 0.1, derivative="zero"))
    x = jnp.linspace(0.2, 0.3, 1001)
    assert float(jnp.mean(mean(x + 0.03) - mean(x))) == pytest.approx(0.03, rel=0.02)
    with pytest.raises(cpjax.InputError, match=r"derivative = 'one': must be zero or straight_through"):
        cpjax.quantize(0.1, 0.1, derivative="one")


@SLOW
def test_the_gradient_of_a_mean_is_the_mean_of_gradients_under_vmap_and_in_sweeps():
    starts = catching(6, 6)
    settings = {"duration": 0.8, "dt": 0.002, "derivative": "mean", "metrics": cpjax.TimeOutside()}
    each = derivatives(starts, duration=0.8, dt=0.002, derivative="mean")

    def mapped(p):
        return jnp.mean(jax.vmap(lambda start: cpjax.measure(PLANT, changed(p), start, **settings))(starts))

    def swept(p):
        return jnp.mean(cpjax.sweep(PLANT, changed(p), starts, **settings))

    for function in (mapped, swept):
        np.testing.assert_allclose(jax.grad(function)(P), each.mean(0), rtol=1e-9)
    np.testing.assert_allclose(jax.jacfwd(mapped)(P), each.mean(0), rtol=1e-9)


@cpjax.pytree.pytree
class Looking:
    """Holds a hybrid, looks into its gate, and keeps None in its memory."""

    controller: cpjax.Hybrid

    def init(self, measurement):
        return {"inner": self.controller.init(measurement), "spare": None, "margin": 0.0}

    def update(self, memory, measurement):
        inner, command = self.controller.update(memory["inner"], measurement)
        margin = self.controller.gate.margin(measurement, inner.mode)
        return {"inner": inner, "spare": None, "margin": margin}, command


@SLOW
def test_a_controller_that_looks_into_the_one_it_holds_has_the_same_derivative():
    starts = catching(4, 7)
    plain = derivatives(starts, derivative="mean", dt=0.002)
    np.testing.assert_allclose(derivatives(starts, Looking, derivative="mean", dt=0.002), plain, rtol=1e-9)


@cpjax.pytree.pytree
class TimeSwingingUp:
    """The time in mode 0 [s], which only the moment of the switch decides."""

    def init(self, sample):
        return jnp.zeros_like(sample.time)

    def update(self, memory, sample):
        return memory + jnp.where(sample.mode_before == 0, sample.elapsed, 0.0)

    def finalize(self, memory, last):
        return memory


@SLOW
def test_a_metric_of_the_mode_has_the_derivative_of_its_mean():
    found = derivatives(catching(4_000, 4), metrics=TimeSwingingUp(), derivative="mean", dt=0.002)
    expected, error = differences(2, lambda controller: controller, TimeSwingingUp())
    error = math.hypot(error, found[:, 2].std() / math.sqrt(4_000))
    assert abs(expected) > 20.0 * error
    assert abs(found[:, 2].mean() - expected) <= 3.0 * error
