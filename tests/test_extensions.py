"""What a user may add as one new file: controllers with memory, inputs over time, another plant.

Nothing in the package knows the files of `tests/extensions`; each runs everywhere a controller or a plant of cpjax
does.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from extensions import dead_time, furuta, observer, pid, square_wave, walled
from oracles import columns, derivative
from scipy.integrate import solve_ivp

import cpjax
from cpjax import paper
from cpjax.numeric.angles import wrap_angle
from cpjax.numeric.differences import central_differences

PLANT = cpjax.CartPole()


def recorded():
    times = 0.002 * np.arange(50) * 10
    return cpjax.VoltageSignal(times, 6.0 * np.sin(9.0 * times)), cpjax.State(0.1, 0.0, 2.9, 0.2)


EXAMPLES = {
    "pid": (pid.example, "proportional"),
    "observer": (observer.example, "gain"),
    "dead time": (dead_time.example, "controller"),
    "square wave": (square_wave.example, "law"),
    "recorded voltage": (recorded, "voltages"),
}
"""What makes each, and the field whose numbers its derivative is taken in."""
MARKED = ["dead time"]
MARKED += [pytest.param(name, marks=pytest.mark.slow, id=name) for name in EXAMPLES if name not in MARKED]
"""The slow ones take a minute of compiling each, and are like the others."""
RUN = {"duration": 0.5, "dt": 0.002}


@pytest.fixture(params=MARKED)
def example(request):
    return EXAMPLES[request.param][0]()


def many(start, count=5):
    """Initial states about one."""
    spread = np.linspace(-0.01, 0.01, count)
    return jax.tree.map(lambda value: value + spread, start)


def assert_close(found, expected, tolerance):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(
            np.asarray(a, dtype=float), np.asarray(b, dtype=float), rtol=tolerance, atol=tolerance
        )


def test_a_controller_of_ones_own_runs_alone_under_jit_under_vmap_and_in_a_sweep(example):
    controller, start = example
    starts = many(start)

    def one(start):
        return cpjax.measure(PLANT, controller, start, **RUN)

    mapped = jax.jit(jax.vmap(one))(starts)
    assert np.all(np.asarray(mapped.flag) == 0)
    assert np.all(np.asarray(mapped.effort) > 0.0)
    assert_close(cpjax.sweep(PLANT, controller, starts, **RUN), mapped, 1e-8)
    assert_close(jax.jit(lambda s: cpjax.sweep(PLANT, controller, s, **RUN))(starts), mapped, 1e-12)
    alone = cpjax.rollout(PLANT, controller, jax.tree.map(lambda column: column[1], starts), **RUN)
    assert_close(alone.metrics, jax.tree.map(lambda column: column[1], mapped), 1e-12)
    saved = cpjax.sweep(PLANT, controller, starts, save_every=50, **RUN)
    assert_close(jax.tree.map(lambda x: x[1], saved.state), jax.tree.map(lambda x: x[::50], alone.state), 1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", MARKED)
def test_its_derivative_is_that_of_differences_forward_in_reverse_and_under_vmap(name):
    make, field = EXAMPLES[name]
    controller, start = make()

    def outside(scale, x):
        part = jax.tree.map(lambda leaf: leaf * scale, getattr(controller, field))
        changed = dataclasses.replace(controller, **{field: part})
        moved = dataclasses.replace(start, x=start.x + x)
        settings = {**RUN, "derivative": "pathwise", "metrics": cpjax.TimeOutside()}
        return cpjax.measure(PLANT, changed, moved, **settings)

    at = (jnp.asarray(1.0), jnp.asarray(0.01))
    forward, reverse = jax.jacfwd(outside, (0, 1))(*at), jax.grad(outside, (0, 1))(*at)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-13)
    batch = jax.vmap(jax.grad(outside, (0, 1)))(*(jnp.stack([value, value]) for value in at))
    np.testing.assert_allclose(np.asarray(batch)[:, 1], reverse, rtol=1e-9, atol=1e-13)
    value = jax.jit(outside)
    for i in range(2):

        def along(step, i=i):
            return float(value(*(a + step * (j == i) for j, a in enumerate(at))))

        rough, fine = ((along(h) - along(-h)) / (2 * h) for h in (2e-4, 1e-4))
        assert float(reverse[i]) == pytest.approx((4 * fine - rough) / 3, rel=1e-6, abs=1e-9)


@pytest.mark.slow
def test_it_runs_in_float32(example):
    controller, start = example
    with jax.numpy_dtype_promotion("standard"):  # as users have it
        runs = {
            dtype: cpjax.rollout(PLANT, controller, jax.tree.map(dtype, start), **RUN)
            for dtype in (jnp.float32, jnp.float64)
        }
        swept = cpjax.sweep(PLANT, controller, jax.tree.map(jnp.float32, many(start)), **RUN)
    assert runs[jnp.float32].state.theta.dtype == runs[jnp.float32].voltage.dtype == jnp.float32
    assert swept.effort.dtype == jnp.float32
    assert_close(runs[jnp.float32].state, runs[jnp.float64].state, 2e-3)


def sampled_by_scipy(command, start, duration, period, plant=PLANT):
    """States at the control instants, and the voltages applied from them on: SciPy between instants."""
    s, states, voltages = columns(start), [], []
    for k in range(round(duration / period) + 1):
        voltage = float(np.clip(command(k, s), -plant.motor.voltage_limit, plant.motor.voltage_limit))
        states.append(s)
        voltages.append(voltage)
        field = lambda t, s, u=voltage: derivative(plant, s, u)  # noqa: E731
        s = solve_ivp(field, (0.0, period), s, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return np.array(states), np.array(voltages)


def test_a_pid_is_that_of_an_independent_loop_within_1e_9_over_2_s():
    law, start = pid.example()
    integral, before = 0.0, float(start.theta)

    def command(k, s):
        nonlocal integral, before
        error = s[2]
        wanted = law.proportional * error + law.integral * integral + law.derivative * (error - before) / law.period
        clipped = min(max(wanted, -law.limit), law.limit)
        integral += law.period * (error + (clipped - wanted) / law.tracking)
        before = error
        return clipped

    states, voltages = sampled_by_scipy(command, start, 2.0, 0.002)
    run = cpjax.rollout(PLANT, law, start, duration=2.0, dt=0.0005, control_period=0.002, save_every=4)
    assert np.max(np.abs(columns(run.state) - states)) <= 1e-9
    assert np.max(np.abs(np.asarray(run.voltage) - voltages)) <= 1e-7  # 1e-9 of the angle, through the D term
    assert np.max(np.abs(voltages)) == 12.0  # so that the anti-windup acts


def test_the_integral_of_a_pid_does_not_wind_up_while_its_command_is_clipped():
    law, _ = pid.example()
    far = cpjax.State(0.0, 0.0, 0.6, 0.0)
    free = dataclasses.replace(law, tracking=1e9)
    plant = cpjax.CartPole(motor=cpjax.Motor(voltage_limit=12.0))

    def integrals(law):
        memory, found = law.init(far), []
        for _ in range(2000):
            memory, _ = law.update(memory, far)
            found.append(float(memory.integral))
        return found[999], found[1999]

    assert integrals(law)[1] == pytest.approx(integrals(law)[0], rel=1e-3)
    assert integrals(free)[1] == pytest.approx(2.0 * integrals(free)[0], rel=1e-3)
    assert int(cpjax.measure(plant, law, far, **RUN).flag) == 0


def test_a_replay_is_that_of_an_independent_loop_within_1e_9_over_2_s():
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.integers(1, 9, 150)) * 0.002  # some later than the end
    voltages = rng.uniform(-14.0, 14.0, 150)
    start = cpjax.State(0.0, 0.1, 2.5, 0.0)

    def command(k, s):
        due = np.flatnonzero(times <= k * 0.002 + 1e-9)
        return voltages[due[-1]] if due.size else 0.0

    states, applied = sampled_by_scipy(command, start, 2.0, 0.002)
    signal = cpjax.VoltageSignal(times, voltages)
    run = cpjax.rollout(PLANT, signal, start, duration=2.0, dt=0.0005, control_period=0.002, save_every=4)
    np.testing.assert_array_equal(run.voltage, applied)
    assert np.max(np.abs(columns(run.state) - states)) <= 1e-9


@pytest.mark.slow
def test_the_derivative_of_a_replay_in_plant_and_voltages_is_that_of_differences():
    signal, start = recorded()
    target = jnp.asarray([0.3, -0.2, 1.0, 0.5])

    def misfit(p):
        motor = cpjax.Motor(resistance=p[1], viscous_friction=p[2])
        plant = cpjax.CartPole(pole_length=p[0], cart_friction=p[3], motor=motor)
        played = dataclasses.replace(signal, voltages=signal.voltages * p[4])
        run = cpjax.rollout(plant, played, start, duration=1.0, dt=0.002)
        return jnp.sum((run.state.vector()[::25] - target) ** 2)

    p = jnp.array([0.6, 1.3, 0.01, 0.2, 1.1])
    gradient = jax.grad(misfit)(p)
    np.testing.assert_allclose(jax.jacfwd(misfit)(p), gradient, rtol=1e-10)
    value = jax.jit(misfit)
    for i in range(5):
        e = jnp.zeros(5).at[i].set(1e-3)
        rough, fine = (value(p + e) - value(p - e)) / 2e-3, (value(p + e / 2) - value(p - e / 2)) / 1e-3
        assert float(gradient[i]) == pytest.approx(float((4 * fine - rough) / 3), rel=1e-7)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_log_on_the_control_instants_is_replayed_sample_by_sample(dtype):
    """Times come as 0.002 k, or as sums, or from text; none of it may shift a voltage by a sample."""
    voltages = np.where(np.arange(10_001) % 2 == 0, 1.0, -1.0)
    for times in (0.002 * np.arange(10_001), np.cumsum(np.full(10_001, 0.002)) - 0.002, np.linspace(0.0, 20.0, 10_001)):
        start = jax.tree.map(dtype, cpjax.HANGING)
        run = cpjax.rollout(PLANT, cpjax.VoltageSignal(times, voltages), start, duration=20.0, dt=0.002)
        np.testing.assert_array_equal(run.voltage, voltages.astype(dtype))


def test_a_signal_of_two_lengths_or_of_times_that_fall_is_refused():
    with pytest.raises(
        cpjax.InputError, match=r"VoltageSignal\.voltages = .*shape \(3,\).* as many as there are times, 2"
    ):
        cpjax.VoltageSignal([0.0, 1.0], [1.0, 2.0, 3.0])
    with pytest.raises(cpjax.InputError, match=r"VoltageSignal\.times = .*: must be rising"):
        cpjax.VoltageSignal([0.0, 0.0], [1.0, 2.0])
    with pytest.raises(cpjax.InputError, match=r"VoltageSignal\.voltages"):
        cpjax.VoltageSignal([0.0, 1.0], [1.0, math.nan])


def test_one_signal_for_each_initial_state():
    signal, start = recorded()
    gains = np.array([0.5, 1.0, 2.0])
    each = cpjax.VoltageSignal(np.tile(signal.times, (3, 1)), gains[:, None] * np.asarray(signal.voltages))
    swept = cpjax.sweep(PLANT, each, jax.tree.map(lambda value: np.full(3, value), start), **RUN)
    for i, gain in enumerate(gains):
        one = cpjax.VoltageSignal(signal.times, gain * np.asarray(signal.voltages))
        alone = cpjax.measure(PLANT, one, start, **RUN)
        assert_close(jax.tree.map(lambda column, i=i: column[i], swept), alone, 1e-9)


# --- another plant ----------------------------------------------------------------------------------------------------

FURUTA = furuta.Furuta()
CAUGHT = {"duration": 2.5, "dt": 0.002}
STEPS = 1e-3 * 0.5 ** np.arange(8)


def test_the_furuta_pendulum_follows_from_its_lagrangian():
    def lagrangian(q, v):
        (_, theta), (phi_dot, theta_dot) = q, v
        m, l, r = FURUTA.pole_mass, FURUTA.pole_length, FURUTA.arm_length
        sin, cos = jnp.sin(theta), jnp.cos(theta)
        arm = FURUTA.arm_inertia + m * r**2 + m * l**2 * sin**2
        kinetic = 0.5 * arm * phi_dot**2 + m * r * l * cos * phi_dot * theta_dot
        return kinetic + 0.5 * (FURUTA.pole_inertia + m * l**2) * theta_dot**2 - m * FURUTA.gravity * l * cos

    rng = np.random.default_rng(2)
    for q, v, u in zip(rng.uniform(-3, 3, (20, 2)), rng.uniform(-5, 5, (20, 2)), rng.uniform(-12, 12, 20), strict=True):
        q, v = jnp.asarray(q), jnp.asarray(v)
        mass = jax.hessian(lagrangian, 1)(q, v)
        drift = jax.grad(lagrangian, 0)(q, v) - jax.jacfwd(jax.grad(lagrangian, 1), 0)(q, v) @ v
        load = jnp.array([FURUTA.torque_per_voltage * u - FURUTA.damping * v[0], 0.0])
        expected = jnp.linalg.solve(mass, drift + load)
        np.testing.assert_allclose(FURUTA.accelerations(tuple(q), tuple(v), u), expected, rtol=1e-9)


@pytest.mark.slow
def test_a_furuta_pendulum_is_caught_and_its_located_gradient_is_that_of_differences():
    def outside(p):
        plant = dataclasses.replace(FURUTA, pole_length=p[2], torque_per_voltage=p[3])
        settings = {**CAUGHT, "switching": "located", "metrics": furuta.FurutaTimeOutside()}
        return cpjax.measure(plant, furuta.controller(FURUTA, p[0], 2.0, p[1]), furuta.START, **settings)

    run = cpjax.rollout(FURUTA, furuta.controller(FURUTA), furuta.START, switching="located", **CAUGHT)
    assert int(run.flag) == 0
    assert int(run.mode[-1]) == 1
    assert int(run.mode[0]) == 0
    assert abs(float(wrap_angle(run.state.theta[-1]))) < 0.25  # still on its way
    p = jnp.array([500.0, 0.4, 0.15, 0.03])
    forward = jax.jacfwd(outside)(p)
    np.testing.assert_allclose(jax.grad(outside)(p), forward, rtol=1e-8)
    value = jax.jit(outside)
    for i in range(4):
        whole = jnp.zeros(4).at[i].set(p[i])
        found = central_differences(lambda h, e=whole: (value(p + h * e), value(p - h * e)), STEPS).derivative
        assert float(forward[i] * p[i]) == pytest.approx(float(found), rel=1e-6)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-8), (np.float32, 5e-3)])
def test_4096_furuta_pendulums_are_those_of_rollouts(dtype, tolerance):
    rng = np.random.default_rng(3)
    spread = [rng.uniform(-size, size, 4096).astype(dtype) for size in (0.1, 0.0, 0.3, 0.3)]
    starts = furuta.FurutaState(*(value + middle for value, middle in zip(spread, (0, 0, math.pi, 0), strict=True)))
    starts = jax.tree.map(lambda column: column.astype(dtype), starts)
    controller, settings = furuta.controller(FURUTA), {"duration": 0.5, "dt": 0.002}
    swept = cpjax.sweep(FURUTA, controller, starts, metrics=furuta.FurutaTimeOutside(), **settings)
    assert swept.shape == (4096,)
    assert swept.dtype == dtype
    few = jax.tree.map(lambda column: column[:20], starts)
    one = jax.vmap(lambda s: cpjax.measure(FURUTA, controller, s, metrics=furuta.FurutaTimeOutside(), **settings))
    np.testing.assert_allclose(swept[:20], one(few), rtol=tolerance)


def test_another_plants_initial_state_is_checked_by_its_own_names():
    with pytest.raises(
        cpjax.InputError, match=r"start = State.*: must be a FurutaState\(phi, phi_dot, theta, theta_dot\)"
    ):
        cpjax.rollout(FURUTA, furuta.controller(FURUTA), cpjax.HANGING, **CAUGHT)
    with pytest.raises(cpjax.InputError, match=r"start\.phi_dot = 2000\.0: must be finite, and within 1000"):
        cpjax.rollout(FURUTA, furuta.controller(FURUTA), furuta.FurutaState(0.0, 2e3, 0.0, 0.0), **CAUGHT)
    with pytest.raises(cpjax.InputError, match=r"metrics = None: must be given"):
        cpjax.measure(FURUTA, furuta.controller(FURUTA), furuta.START, **CAUGHT)


# --- a plant with events ----------------------------------------------------------------------------------------------

WALLED = walled.Walled(PLANT, 0.2, 0.6)
PUSHED = cpjax.State(0.0, 0.3, 2.6, 0.0)


class Pushing:
    """A voltage signal that drives the cart from wall to wall."""

    times = np.array([0.0, 0.3, 0.7, 1.1])
    voltages = np.array([6.0, -6.0, 8.0, -8.0])


def bounced_by_scipy(duration):
    """The end of the run, with SciPy's events for the walls, and how often it bounces."""
    s, t, bounces = columns(PUSHED), 0.0, 0
    while t < duration - 1e-12:
        voltage = Pushing.voltages[np.flatnonzero(Pushing.times <= t + 1e-9)[-1]]
        later = Pushing.times[Pushing.times > t + 1e-9]
        end = min(duration, later[0]) if later.size else duration
        wall = lambda t, s: 0.2 - abs(s[0])  # noqa: E731
        wall.terminal, wall.direction = True, -1
        field = lambda t, s, u=voltage: derivative(PLANT, s, u)  # noqa: E731
        piece = solve_ivp(field, (t, end), s, method="DOP853", rtol=1e-12, atol=1e-13, events=wall)
        s, t = piece.y[:, -1].copy(), piece.t[-1]
        if piece.status == 1:
            bounces += 1
            change = -1.6 * s[1]
            s[3] += PLANT.pole_mass * PLANT.pole_length * math.cos(s[2]) * change / PLANT.pivot_inertia
            s[1] += change
            s[0] = math.copysign(0.2 - 1e-15, s[0])
    return s, bounces


@pytest.mark.slow
def test_the_events_of_a_plant_are_located_on_the_sampled_clock():
    end, bounces = bounced_by_scipy(1.4)
    assert bounces == 3
    signal = cpjax.VoltageSignal(Pushing.times, Pushing.voltages)
    run = cpjax.rollout(WALLED, signal, PUSHED, duration=1.4, dt=0.001, control_period=0.02)
    assert int(run.flag) == 0
    assert np.max(np.abs(columns(run.state)[-1] - end)) <= 1e-8
    assert np.max(np.abs(np.asarray(run.state.x))) <= 0.2 + 1e-12
    starts = many(PUSHED, 4)
    mapped = jax.vmap(lambda s: cpjax.measure(WALLED, signal, s, duration=1.4, dt=0.001, metrics=cpjax.TimeOutside()))
    swept = cpjax.sweep(WALLED, signal, starts, duration=1.4, dt=0.001, metrics=cpjax.TimeOutside())
    assert_close(swept, mapped(starts), 1e-9)


@pytest.mark.slow
def test_the_derivative_through_a_plants_events_is_that_of_differences():
    def end(p):
        plant = dataclasses.replace(WALLED, restitution=p[0], half_length=p[1])
        signal = cpjax.VoltageSignal(Pushing.times, Pushing.voltages * p[2])
        run = cpjax.rollout(plant, signal, PUSHED, duration=1.0, dt=0.002, save_every=500)
        return run.state.theta[-1] + run.state.x[-1]

    p = jnp.array([0.6, 0.2, 1.0])
    gradient, value = jax.grad(end)(p), jax.jit(end)
    np.testing.assert_allclose(jax.jacfwd(end)(p), gradient, rtol=1e-8)
    for i in range(3):
        whole = jnp.zeros(3).at[i].set(p[i])
        found = central_differences(lambda h, e=whole: (value(p + h * e), value(p - h * e)), STEPS).derivative
        assert float(gradient[i] * p[i]) == pytest.approx(float(found), rel=1e-6)


@pytest.mark.slow
def test_on_the_continuous_clock_the_walls_stand_beside_clip_and_gate():
    controller = cpjax.paper.controller("corrected-centred", "placement", PLANT)
    walls = dataclasses.replace(WALLED, half_length=0.35)
    fine, coarse = (
        cpjax.rollout(
            walls, controller, cpjax.HANGING, duration=1.5, dt=dt, clock="continuous", save_every=round(0.5 / dt)
        )
        for dt in (0.001, 0.002)
    )
    assert int(fine.flag) == 0
    assert np.max(np.abs(np.asarray(fine.state.x))) <= 0.35 + 1e-12
    assert np.max(np.abs(columns(fine.state) - columns(coarse.state))) <= 1e-6
    with pytest.raises(cpjax.InputError, match=r"must be located, or absent, for a plant with"):
        cpjax.rollout(
            walls, controller, cpjax.HANGING, duration=0.1, dt=0.002, clock="continuous", switching="per_step"
        )


# --- random keys ------------------------------------------------------------------------------------------------------


@cpjax.pytree.pytree
class Dithering:
    """Adds noise to a command, from a random key in its memory."""

    law: cpjax.StateFeedback
    key: jax.Array

    def init(self, measurement):
        return self.key

    def update(self, key, measurement):
        key, now = jax.random.split(key)
        voltage = self.law.voltage(measurement)
        return key, voltage + 0.1 * jax.random.normal(now, dtype=voltage.dtype)


@pytest.mark.slow
@pytest.mark.parametrize("make", [jax.random.key, jax.random.PRNGKey])
def test_a_random_key_may_be_part_of_a_controller_and_of_its_memory(make):
    law = paper.regulator("lqr", "printed", PLANT)
    starts = many(cpjax.State(0.0, 0.0, 0.1, 0.0), 3)
    swept = cpjax.sweep(PLANT, Dithering(law, make(1)), starts, **RUN)
    mapped = jax.vmap(lambda start: cpjax.measure(PLANT, Dithering(law, make(1)), start, **RUN))(starts)
    assert_close(swept, mapped, 1e-9)
    assert np.all(
        np.asarray(swept.effort) != np.asarray(cpjax.sweep(PLANT, Dithering(law, make(2)), starts, **RUN).effort)
    )


def test_each_initial_state_may_have_a_random_key_of_its_own_through_vmap():
    law, keys = paper.regulator("lqr", "printed", PLANT), jax.random.split(jax.random.key(1), 3)
    start = cpjax.State(0.0, 0.0, 0.1, 0.0)
    mapped = jax.vmap(lambda key: cpjax.measure(PLANT, Dithering(law, key), start, **RUN).effort)(keys)
    alone = [float(cpjax.measure(PLANT, Dithering(law, key), start, **RUN).effort) for key in keys]
    np.testing.assert_allclose(mapped, alone, rtol=1e-9)
    assert len(set(alone)) == 3


@cpjax.pytree.pytree
class ThreeKeys:
    """Holds three random keys, and uses the first."""

    keys: jax.Array

    def init(self, measurement):
        return ()

    def update(self, memory, measurement):
        return memory, jax.random.normal(self.keys[0], dtype=measurement.x.dtype)


def test_as_many_keys_as_initial_states_are_still_one_field():
    controller = ThreeKeys(jax.random.split(jax.random.key(1), 3))
    efforts = [cpjax.sweep(PLANT, controller, many(cpjax.HANGING, count), **RUN).effort for count in (2, 3)]
    np.testing.assert_allclose(efforts[1], np.full(3, efforts[0][0]), rtol=1e-9)
