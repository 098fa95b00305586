"""What used to be wrong without a word: traced sweeps, what a user's own parts return, blind derivatives."""

import dataclasses
import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from extensions import dead_time

import cpjax
from cpjax import paper
from cpjax.pytree import pytree

PLANT = paper.appendix_plant()
CENTRED = paper.controller("corrected-centred", "placement", PLANT)
RUN = {"duration": 0.1, "dt": 0.002}


# --- traced sweeps ----------------------------------------------------------------------------------------------------

UNLIMITED = cpjax.CartPole(motor=cpjax.Motor(voltage_limit=math.inf))
WILD = cpjax.StateFeedback([0.0, -50.0, 0.0, 0.0])
RUNAWAYS = cpjax.State(np.zeros(2), np.array([0.1, 0.2]), np.full(2, 0.3), np.zeros(2))


def assert_equal(found, expected, rtol=1e-12):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol)


@pytest.mark.slow
def test_a_traced_sweep_of_runaways_has_their_flags_metrics_and_gradients():
    settings = {"duration": 4.0, "dt": 2e-3}
    mapped = jax.vmap(lambda start: cpjax.measure(UNLIMITED, WILD, start, **settings))(RUNAWAYS)
    traced = jax.jit(lambda starts: cpjax.sweep(UNLIMITED, WILD, starts, **settings))(RUNAWAYS)
    eager = cpjax.sweep(UNLIMITED, WILD, RUNAWAYS, **settings)
    assert np.asarray(mapped.flag).tolist() == [1, 1]
    np.testing.assert_allclose(mapped.cart_travel, [31.1, 30.5], atol=0.05)
    assert_equal(traced, mapped)
    assert_equal(eager, mapped, 1e-6)

    def effort(scale, one):
        law = cpjax.StateFeedback(jnp.asarray(WILD.K) * scale)
        return jnp.sum(one(law).effort)

    by_sweep = jax.grad(lambda s: effort(s, lambda law: cpjax.sweep(UNLIMITED, law, RUNAWAYS, **settings)))(1.0)
    mapped_one = lambda law: jax.vmap(lambda s: cpjax.measure(UNLIMITED, law, s, **settings))(RUNAWAYS)  # noqa: E731
    by_vmap = jax.grad(lambda s: effort(s, mapped_one))(1.0)
    assert np.isfinite(by_vmap)
    assert float(by_sweep) == pytest.approx(float(by_vmap), rel=1e-9)


def test_a_traced_parameter_that_is_nan_is_flagged_by_a_sweep_as_by_a_rollout():
    def flags(mass, starts):
        return cpjax.sweep(cpjax.CartPole(cart_mass=mass), CENTRED, starts, **RUN).flag

    starts = cpjax.sample_starts("anywhere", 3, seed=1)
    assert jax.jit(flags)(math.nan, starts).tolist() == [2, 2, 2]
    assert jax.jit(flags)(1.0, starts).tolist() == [0, 0, 0]


# --- controllers drawn at random --------------------------------------------------------------------------------------


@pytree
class RandomMemory:
    """A controller with a vector, a count and a boolean for memory, of random numbers."""

    gains: jax.Array
    mixing: jax.Array
    modes: cpjax.Hybrid

    def init(self, measurement):
        return {"x": jnp.zeros(3), "count": jnp.asarray(0), "late": jnp.asarray(False)}, self.modes.init(measurement)

    def update(self, memory, measurement):
        own, inner = memory
        inner, command = self.modes.update(inner, measurement)
        x = jnp.tanh(self.mixing @ own["x"] + self.gains[:, :4] @ measurement.vector())
        command = command + self.gains[0, 4] * x[0] + jnp.where(own["late"], self.gains[1, 4], 0.0)
        own = {"x": x, "count": own["count"] + 1, "late": own["count"] > 20}
        return (own, inner), command


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
@pytest.mark.filterwarnings("ignore::cpjax.PerformanceWarning")  # it has matrix products
def test_a_random_controller_is_the_same_in_rollout_measure_and_sweep_traced_or_not(seed):
    rng = np.random.default_rng(seed)
    gate = cpjax.AngleGate(rng.uniform(0.2, 2.0), hysteresis=rng.uniform(0.0, 0.3))
    law = cpjax.EnergySwingUp(PLANT, energy_gain=rng.uniform(1.0, 20.0), cart_stiffness=2.0)
    hybrid = cpjax.Hybrid(law, cpjax.StateFeedback(rng.normal(0.0, 40.0, 4)), gate)
    controller = RandomMemory(rng.normal(size=(3, 5)), rng.normal(size=(3, 3)), hybrid)
    starts = cpjax.sample_starts("anywhere", 6, seed=seed)
    settings = {"duration": 0.3, "dt": 0.003, "control_period": 0.003 * int(rng.integers(1, 6))}
    mapped = jax.vmap(lambda start: cpjax.measure(PLANT, controller, start, **settings))(starts)
    assert_equal(jax.jit(lambda s: cpjax.sweep(PLANT, controller, s, **settings))(starts), mapped)
    eager = cpjax.sweep(PLANT, controller, starts, chunk=4, **settings)
    assert_equal(eager, mapped, 1e-8)
    np.testing.assert_array_equal(eager.switches, mapped.switches)
    for i in (0, 5):
        start = jax.tree.map(lambda column, i=i: column[i], starts)
        run = cpjax.rollout(PLANT, controller, start, **settings)
        assert_equal(run.metrics, jax.tree.map(lambda column, i=i: column[i], mapped))
        changed = np.flatnonzero(np.diff(np.asarray(run.voltage))) + 1
        assert np.all(changed % round(settings["control_period"] / 0.003) == 0)
        assert np.count_nonzero(np.diff(np.asarray(run.mode))) == int(run.metrics.switches)


# --- what a user's own parts return -----------------------------------------------------------------------------------


@pytree
class Returns:
    """A law that returns what it is told to."""

    kind: str

    def voltage(self, state):
        return {
            "vector": -state.x[None] if hasattr(state.x, "shape") else np.zeros(1),
            "complex": 1j,
            "text": "12 V",
            "none": None,
            "boolean": True,
            "integer": 2,
        }[self.kind]


@pytree
class TimeLaw:
    """A law that asks for the time."""

    gain: float = 1.0

    def voltage(self, state, time):
        return self.gain * time


@pytree
class FloatMode:
    """Says its mode in floats."""

    law: cpjax.StateFeedback

    def start_mode(self, state):
        return jnp.asarray(0.0)

    def next_mode(self, state, mode):
        return mode

    def mode_voltage(self, state, mode):
        return self.law.voltage(state)


@pytree
class Growing:
    """A memory that changes its shape."""

    gain: float = 1.0

    def init(self, measurement):
        return jnp.zeros(1)

    def update(self, memory, measurement):
        return jnp.append(memory, 0.0), 0.0


@pytree
class Alone:
    """Forgets to return its memory."""

    gain: float = 1.0

    def init(self, measurement):
        return ()

    def update(self, memory, measurement):
        return 0.0


@pytree
class WideGate:
    """A gate whose margin is a vector."""

    half_angle: float = 0.3

    def margin(self, state, mode):
        return jnp.cos(state.theta)[None] - 0.9


class WideMotor(cpjax.Motor):
    """A motor whose force is a vector."""

    def force(self, voltage, x_dot):
        return jnp.atleast_1d(super().force(voltage, x_dot))


jax.tree_util.register_pytree_node(
    WideMotor,
    lambda m: ([getattr(m, f.name) for f in dataclasses.fields(m)], None),
    lambda _, leaves: _unflattened(leaves),
)


def _unflattened(leaves):
    motor = object.__new__(WideMotor)
    for field, value in zip(dataclasses.fields(cpjax.Motor), leaves, strict=True):
        object.__setattr__(motor, field.name, value)
    return motor


@pytree
class GrowingMetric:
    """A metric whose memory changes its dtype."""

    def init(self, sample):
        return jnp.asarray(0, dtype=jnp.int32)

    def update(self, memory, sample):
        return sample.time

    def finalize(self, memory, last):
        return memory


HYBRID = {"swing_up": CENTRED.swing_up, "regulator": CENTRED.regulator, "gate": CENTRED.gate}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"controller": Returns("vector")}, r"controller\.voltage = 'array of shape \(1,\).*: must be a scalar"),
        ({"controller": Returns("complex")}, r"controller\.voltage = .*complex.*: must be a scalar"),
        ({"controller": Returns("text")}, r"controller\.voltage = 'a str': must be a scalar"),
        ({"controller": Returns("none")}, r"controller\.voltage = 'a NoneType': must be a scalar"),
        ({"controller": Returns("boolean")}, r"controller\.voltage = .*bool.*: must be a scalar"),
        ({"controller": TimeLaw()}, r"controller\.voltage = .*time.*: must be a method that can be called with 1 arg"),
        ({"controller": FloatMode(CENTRED.regulator)}, r"controller\.start_mode = .*float64.*: must be a mode, an int"),
        ({"controller": Growing()}, r"controller\.update: memory = .*\(2,\).*: must be of shape \(1,\)"),
        ({"controller": Alone()}, r"controller\.update = 'a float': must be a pair"),
        (
            {"controller": cpjax.Hybrid(**HYBRID | {"regulator": Returns("vector")})},
            r"controller\.regulator\.voltage = 'array of shape \(1,\)",
        ),
        ({"controller": cpjax.Hybrid(**HYBRID | {"gate": WideGate()})}, r"controller\.gate\.margin = .*\(1,\)"),
        ({"plant": cpjax.CartPole(motor=WideMotor())}, r"plant\.motor\.force = .*\(1,\)"),
        ({"metrics": GrowingMetric()}, r"metrics\.update = .*float64.*: must be .*int32, as before"),
        ({"plant": 1.0}, r"plant = 1\.0: must be a cpjax\.CartPole, or a plant of your own"),
    ],
    ids=lambda value: "" if isinstance(value, str) else next(iter(value)),
)
@pytest.mark.parametrize("function", [cpjax.rollout, cpjax.sweep], ids=lambda f: f.__name__)
def test_what_a_part_of_ones_own_returns_is_checked_and_named(function, arguments, message):
    start = cpjax.State(0.0, 0.0, 0.3, 0.0)
    if function is cpjax.sweep:
        start = jax.tree.map(lambda value: np.full(2, value), start)
    given = {"plant": PLANT, "controller": CENTRED} | arguments
    settings = RUN | {key: given.pop(key) for key in list(given) if key == "metrics"}
    with pytest.raises(cpjax.InputError, match=message):
        function(given["plant"], given["controller"], start, **settings)


def test_an_integer_voltage_is_a_voltage():
    assert np.all(np.asarray(cpjax.rollout(PLANT, Returns("integer"), cpjax.HANGING, **RUN).voltage) == 2.0)


def test_a_net_of_plain_arrays_and_a_function_is_a_law():
    @pytree
    class Net:
        """Two layers."""

        weights: tuple
        activation: object

        def voltage(self, state):
            hidden = [
                self.activation(sum(w * s for w, s in zip(row, state.vector(), strict=True))) for row in self.weights[0]
            ]
            return sum(w * h for w, h in zip(self.weights[1], hidden, strict=True))

    net = Net((np.full((3, 4), 0.1), np.ones(3)), jnp.tanh)
    starts = cpjax.sample_starts("hanging", 3, seed=1)  # as many as the net has rows
    swept = cpjax.sweep(PLANT, net, starts, **RUN)
    alone = cpjax.measure(PLANT, net, jax.tree.map(lambda column: column[2], starts), **RUN)
    assert float(swept.effort[2]) == pytest.approx(float(alone.effort), rel=1e-9)


# --- derivatives ------------------------------------------------------------------------------------------------------


def outside(gain, controller=CENTRED, **settings):
    swing_up = dataclasses.replace(controller.swing_up, energy_gain=gain)
    changed = dataclasses.replace(controller, swing_up=swing_up)
    return cpjax.measure(PLANT, changed, cpjax.HANGING, metrics=cpjax.TimeOutside(), **{**RUN, **settings})


def trace(function):
    """Traces the derivative, which is when it warns; computing it would take a compilation."""
    jax.make_jaxpr(jax.grad(function))(5.0)


@pytest.mark.parametrize("clock", ["sampled", "continuous"])
def test_a_derivative_that_misses_the_switch_warns_unless_it_is_asked_for_by_name(clock):
    with pytest.warns(cpjax.DerivativeWarning, match="leaves out how its change of mode moves"):
        trace(lambda gain: outside(gain, clock=clock, duration=0.104))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        trace(lambda gain: outside(gain, clock=clock, derivative="pathwise"))
        outside(5.0, clock=clock)


def test_a_derivative_that_has_its_switch_does_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        trace(lambda gain: outside(gain, switching="located"))
        trace(lambda gain: outside(gain, derivative="mean"))
        law = cpjax.StateFeedback([1.0, 2.0, 3.0, 4.0])
        trace(lambda k: cpjax.measure(PLANT, cpjax.StateFeedback(law.K * k), cpjax.HANGING, **RUN).effort)


def test_the_derivative_of_the_mean_is_refused_where_it_has_no_meaning():
    with pytest.raises(cpjax.InputError, match=r"derivative = 'mean': must be pathwise, or absent, on the continuous"):
        outside(5.0, derivative="mean", clock="continuous")
    with pytest.raises(cpjax.InputError, match=r"clock = 'continuous': must be sampled"):
        cpjax.measure(PLANT, cpjax.VoltageSignal([0.0], [1.0]), cpjax.HANGING, clock="continuous", **RUN)


@pytree
class HiddenModes:
    """Holds a mode that JAX can see, and a controller that it cannot."""

    gain: float = 1.0

    def init(self, measurement):
        return CENTRED.init(measurement)

    def update(self, memory, measurement):
        return CENTRED.update(memory, measurement)


def test_a_mode_whose_margin_cannot_be_seen_is_refused_by_the_derivative_of_the_mean():
    with pytest.raises(cpjax.InputError, match=r"derivative = 'mean': must be pathwise: a part of this controller"):
        cpjax.measure(PLANT, HiddenModes(), cpjax.HANGING, derivative="mean", **RUN)


@pytree
class Filter:
    """Remembers the period that it was told."""

    inner: object = None
    period: object = 1.0

    def at_period(self, period):
        return dataclasses.replace(self, period=period)

    def init(self, measurement):
        return ()

    def update(self, memory, measurement):
        return (), jnp.asarray(self.period) + (0.0 if self.inner is None else self.inner.update((), measurement)[1])


def test_every_part_of_a_controller_is_told_the_period():
    run = cpjax.rollout(PLANT, Filter(Filter()), cpjax.HANGING, duration=0.1, dt=0.002, control_period=0.01)
    np.testing.assert_allclose(run.voltage, 0.02)
    with pytest.raises(cpjax.InputError, match="clock = 'continuous'"):
        cpjax.rollout(PLANT, Filter(), cpjax.HANGING, duration=0.1, dt=0.002, clock="continuous")


class HalfEventful(cpjax.CartPole):
    """Has guards, and nothing that a guard leads to."""

    def guards(self, q, v, u, mode):
        return (1.0 - q[0],)


def test_a_plant_with_half_of_a_protocol_is_refused():
    with pytest.raises(cpjax.InputError, match="one with all of start_mode, guards, jump, or none of them"):
        cpjax.rollout(HalfEventful(), CENTRED, cpjax.HANGING, **RUN)


@pytree
class Bang:
    """A controller with modes and no margin."""

    edge: float = 1.0

    def start_mode(self, state):
        return self.next_mode(state, 0)

    def next_mode(self, state, mode):
        return (state.x > self.edge).astype(jnp.int32)

    def mode_voltage(self, state, mode):
        return jnp.where(mode == 1, -1.0, 1.0)


def test_a_mode_without_a_margin_warns_too():
    with pytest.warns(cpjax.DerivativeWarning):
        jax.grad(lambda edge: cpjax.measure(PLANT, Bang(edge), cpjax.HANGING, **RUN).effort)(0.1)


# --- what is not a number ---------------------------------------------------------------------------------------------


@pytree
class LateNaN:
    """Commands 1 V, and NaN at the last control instant."""

    def init(self, measurement):
        return jnp.asarray(0)

    def update(self, count, measurement):
        return count + 1, jnp.where(count == 10, jnp.nan, 1.0).astype(measurement.x.dtype)


def test_a_command_that_is_nan_at_the_last_instant_is_flagged():
    settings = {"duration": 0.05, "dt": 0.005}
    start = cpjax.State(0.0, 0.0, 3.0, 0.0)
    assert int(cpjax.rollout(PLANT, LateNaN(), start, **settings).flag) == cpjax.Flag.NON_FINITE
    starts = jax.tree.map(lambda value: np.full(2, value), start)
    assert cpjax.sweep(PLANT, LateNaN(), starts, **settings).flag.tolist() == [cpjax.Flag.NON_FINITE] * 2


@pytree
class BrokenGate:
    """A gate whose margin is NaN beyond an angle."""

    def margin(self, state, mode):
        return jnp.where(state.theta > 2.9, jnp.nan, -1.0)


@pytest.mark.parametrize("settings", [{}, {"switching": "located"}, {"derivative": "mean"}], ids=str)
def test_a_gate_whose_margin_is_nan_is_flagged(settings):
    controller = cpjax.Hybrid(CENTRED.swing_up, CENTRED.regulator, BrokenGate())
    run = cpjax.rollout(PLANT, controller, cpjax.State(0.0, 0.0, 3.0, 0.0), **RUN, **settings)
    assert int(run.flag) == cpjax.Flag.NON_FINITE
    assert not bool(run.metrics.success)


@pytree
class TextMemory:
    """A controller whose memory is a text."""

    def init(self, measurement):
        return {"phase": "idle"}

    def update(self, memory, measurement):
        return memory, 1.0


@pytree
class Results:
    """A metric that returns things of its own."""

    begin: object = 0.0
    end: object = 0.0

    def init(self, sample):
        return self.begin

    def update(self, memory, sample):
        return memory

    def finalize(self, memory, last):
        return jax.random.key(0) if self.end == "key" else self.end


@pytree
class Huge:
    """A law that returns an integer which no array can hold."""

    def voltage(self, state):
        return 10**400


@pytest.mark.parametrize("function", [cpjax.rollout, cpjax.sweep], ids=lambda f: f.__name__)
def test_what_jax_takes_for_no_array_is_named(function):
    start = cpjax.HANGING if function is cpjax.rollout else cpjax.sample_starts("hanging", 2, seed=1)
    for controller, metrics, message in (
        (TextMemory(), None, r"controller\.init: memory\['phase'\] = 'a str': must be a number or an array"),
        (CENTRED, Results(begin="text"), r"metrics\.init = 'a str': must be a number or an array"),
        (CENTRED, Results(end="text"), r"metrics\.finalize = 'a str': must be a number or an array"),
        (CENTRED, Results(end="key"), r"metrics\.finalize = 'a random key': must be a number or an array"),
        (Huge(), None, r"controller\.voltage = 'a int': must be a scalar"),
    ):
        with pytest.raises(cpjax.InputError, match=message):
            function(PLANT, controller, start, metrics=metrics, **RUN)


def test_what_a_plant_of_ones_own_returns_is_checked_and_named():
    def plant(**changes):
        return pytree(type("Changed", (cpjax.CartPole,), {"__doc__": "A plant.", **changes}))()

    for changes, message in (
        ({"coordinates": lambda self, s: (1.0, (1.0, 2.0))}, r"plant\.coordinates = .*: must be positions and veloc"),
        ({"limits": property(lambda self: None)}, r"plant\.limits = None: must be a state"),
        ({"limits": cpjax.State(math.nan, 1.0, 1.0, 1.0)}, r"plant\.limits\.x = nan: must be a number"),
        ({"limits": cpjax.State("a", 1.0, 1.0, 1.0)}, r"plant\.limits\.x = 'a': must be a number"),
        ({"outputs": lambda self, s, a, u: {}}, r"plant\.outputs = 'none': must be with cart_acceleration"),
    ):
        with pytest.raises(cpjax.InputError, match=message):
            cpjax.rollout(plant(**changes), CENTRED, cpjax.HANGING, **RUN)
    odd = plant(geometry_near=lambda self, geometry, change: geometry)
    with pytest.raises(cpjax.InputError, match=r"plant\.geometry_near = .*: must be a pair"):
        cpjax.sweep(odd, CENTRED, cpjax.sample_starts("hanging", 2, seed=1), **RUN)


def test_the_derivative_of_the_mean_warns_of_voltage_metrics_with_a_memory():
    controller = dead_time.example()[0]
    settings = {**RUN, "derivative": "mean"}
    with pytest.warns(cpjax.DerivativeWarning, match="total variation is wrong"):
        cpjax.measure(PLANT, controller, cpjax.HANGING, **settings)
    cpjax.measure(PLANT, controller, cpjax.HANGING, metrics=cpjax.TimeOutside(), **settings)
