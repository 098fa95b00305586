import math
from dataclasses import replace

import numpy as np
import pytest
from oracles import HybridOracle, columns, derivative, dop853, fitted_order

import cpjax
from cpjax import HANGING, AngleGate, CartPole, EnergySwingUp, Hybrid, Motor, State, StateFeedback

SETTLING = 0.5  # how long after the catch the runs are compared [s]
HALF_ANGLE = math.radians(30.0)
SOFT, STIFF = (-24.74, -25.36, 111.70, 28.58), (-1414.21, -1180.17, 4795.02, 966.35)
LAW = {"energy_gain": 5.0, "cart_stiffness": 4.0, "cart_damping": 2.0, "kick": 0.5, "kick_radius": 0.02}

POINT_BOB = CartPole(motor=Motor(rotor_inertia=7e-6, viscous_friction=1e-5))
RUBBING_ROD = CartPole(
    cart_mass=0.9,
    pole_mass=0.45,
    pole_length=0.75,
    pole_inertia=0.02,
    cart_friction=0.1,
    pivot_friction=0.003,
    motor=Motor(back_emf_constant=0.9, rotor_inertia=0.03, viscous_friction=0.02, wheel_radius=0.8, gear_ratio=0.9),
)
LEANING = State(0.05, 0.0, math.pi - 0.2, 0.1)


def hybrid(model, gain):
    """One controller twice: cpjax's, and the test's own."""
    ours = Hybrid(EnergySwingUp(model, **LAW), StateFeedback(gain), AngleGate(HALF_ANGLE))
    return ours, HybridOracle(model, gain, HALF_ANGLE, **LAW)


def held_reference(plant, oracle, start, period, duration):
    """States at the control instants, and mode and voltage from each on. The integration restarts at each."""
    states, modes, voltages = [columns(start)], [], []
    for _ in range(round(duration / period)):
        modes.append(oracle.margin(states[-1]) >= 0.0)
        voltage = oracle.voltage(states[-1], modes[-1])
        voltages.append(voltage)
        run = dop853(lambda s, voltage=voltage: derivative(plant, s, voltage), states[-1], (0.0, period))
        states.append(run.y[:, -1])
    return np.array(states), np.array(modes), np.array(voltages)


# 1e-8 sets the steps: at 2 ms RK4 is off by 7e-9 with the soft gain; the stiff one multiplies that, the more so the
# longer its period (2e-8 and 2e-7 at a step of 2 ms).
@pytest.mark.parametrize(
    ("plant", "model", "gain", "start", "period", "dt"),
    [
        pytest.param(POINT_BOB, POINT_BOB, SOFT, HANGING, 2e-3, 2e-3, id="every-step"),
        pytest.param(POINT_BOB, POINT_BOB, SOFT, HANGING, 4e-3, 1e-3, id="every-fourth-step"),
        pytest.param(POINT_BOB, POINT_BOB, STIFF, LEANING, 2e-3, 1e-3, id="stiff-gain"),
        pytest.param(POINT_BOB, POINT_BOB, STIFF, LEANING, 4e-3, 0.5e-3, id="stiff-gain-slow-clock"),
        pytest.param(RUBBING_ROD, RUBBING_ROD, SOFT, HANGING, 2e-3, 1e-3, id="rubbing-rod"),
        pytest.param(RUBBING_ROD, POINT_BOB, SOFT, LEANING, 4e-3, 1e-3, id="wrong-model"),
    ],
)
def test_the_sampled_loop_is_scipys_through_the_first_catch(plant, model, gain, start, period, dt):
    ours, oracle = hybrid(model, gain)
    duration = 2.4
    states, modes, voltages = held_reference(plant, oracle, start, period, duration)
    catch = int(np.argmax(modes))
    until = catch + round(SETTLING / period) + 1
    assert 0 < catch < until < len(modes)
    assert np.any(np.abs(voltages[:catch]) == 12.0)
    assert np.any(np.abs(voltages[:catch]) < 12.0)

    run = cpjax.rollout(plant, ours, start, duration=duration, dt=dt, clock="sampled", control_period=period)
    held = round(period / dt)
    # In between control instants, mode and voltage stay: one row per period.
    np.testing.assert_array_equal(run.mode[:-1].reshape(-1, held)[:until], np.repeat(modes[:until, None], held, axis=1))
    assert np.all(np.ptp(run.voltage[:-1].reshape(-1, held), axis=1) == 0.0)
    assert np.max(np.abs(columns(run.state)[::held] - states)[:until]) <= 1e-8
    # The voltage amplifies the state's error by the gain.
    assert np.max(np.abs(run.voltage[::held][:until] - voltages[:until])) <= 1e-8 * np.linalg.norm(gain)


def swing_until_the_switch(plant, oracle, start, duration):
    """The continuous loop up to its first catch, as SciPy's solution with dense output."""

    def margin(_, s):
        return oracle.margin(s)

    margin.terminal = True

    def field(s):
        return derivative(plant, s, oracle.voltage(s, False))

    swing = dop853(field, start, (0.0, duration), events=margin, dense_output=True)
    assert swing.status == 1
    return swing


def error_before_the_switch(run, swing, dt):
    """The largest error at any step before the catch, and whether the supply clipped at each of them."""
    before = np.arange(int(swing.t[-1] / dt) + 1)
    error = np.max(np.abs(columns(run.state)[before] - swing.sol(before * dt).T))
    return error, np.abs(np.asarray(run.voltage)[before]) == POINT_BOB.motor.voltage_limit


def test_before_the_switch_the_clipped_continuous_loop_from_rest_is_scipys():
    ours, oracle = hybrid(POINT_BOB, SOFT)
    swing = swing_until_the_switch(POINT_BOB, oracle, columns(HANGING), 1.8)
    run = cpjax.rollout(POINT_BOB, ours, HANGING, clock="continuous", duration=1.8, dt=1e-3)
    error, clipped = error_before_the_switch(run, swing, 1e-3)
    assert 0.4 < np.mean(clipped) < 0.9
    assert np.sum(clipped[1:] != clipped[:-1]) >= 4
    assert error <= 1e-5


def test_it_is_the_clip_that_costs_accuracy_before_the_switch():
    plant = replace(POINT_BOB, motor=replace(POINT_BOB.motor, voltage_limit=math.inf))
    ours, oracle = hybrid(plant, SOFT)
    swing = swing_until_the_switch(plant, oracle, columns(HANGING), 1.0)
    run = cpjax.rollout(plant, ours, HANGING, clock="continuous", duration=1.0, dt=1e-3)
    error, _ = error_before_the_switch(run, swing, 1e-3)
    assert error <= 1e-6


class ContinuousReference:
    """The continuous loop of many starts with the switch located in time, not at the end of a step."""

    duration = 2.0
    count = 24

    def __init__(self):
        self.ours, oracle = hybrid(POINT_BOB, SOFT)
        rng = np.random.default_rng(5)
        spread = np.array([0.1, 0.0, 0.1, 0.1])
        starts = columns(HANGING) + rng.uniform(-spread, spread, (self.count, 4))
        self.starts = [State(*map(float, start)) for start in starts]
        self.swings, ends = [], []
        for start in starts:
            swing = swing_until_the_switch(POINT_BOB, oracle, start, self.duration)
            catch = dop853(
                lambda s: derivative(POINT_BOB, s, oracle.voltage(s, True)),
                swing.y[:, -1],
                (swing.t[-1], self.duration),
            )
            assert min(oracle.margin(s) for s in catch.y.T) > -1e-9  # it switches once
            self.swings.append(swing)
            ends.append(catch.y[:, -1])
        self.ends = np.array(ends)
        self.switch_times = np.array([swing.t[-1] for swing in self.swings])

    def errors(self, dt, switching="per_step"):
        """By start: the largest error before the switch, and the error at the end."""
        before, after = [], []
        for start, swing, end in zip(self.starts, self.swings, self.ends, strict=True):
            settings = {"duration": self.duration, "dt": dt, "clock": "continuous", "switching": switching}
            run = cpjax.rollout(POINT_BOB, self.ours, start, **settings)
            error, _ = error_before_the_switch(run, swing, dt)
            before.append(error)
            after.append(np.max(np.abs(columns(run.state)[-1] - end)))
        return np.array(before), np.array(after)


@pytest.fixture(scope="module")
def continuous():
    return ContinuousReference()


@pytest.fixture(scope="module")
def errors_by_step(continuous):
    steps = np.array([2e-3, 1e-3, 0.5e-3, 0.25e-3])
    before, after = zip(*(continuous.errors(float(dt)) for dt in steps), strict=True)
    return steps, np.array(before), np.array(after)


# A switch falls anywhere within a step, so the error of one start jumps about as the step shrinks; the mean does less.
@pytest.mark.slow
def test_switching_per_step_is_of_first_order(errors_by_step):
    steps, before, after = errors_by_step
    assert fitted_order(steps, after.mean(axis=1)) == pytest.approx(1.0, abs=0.1)
    assert np.all(after.mean(axis=1) > 10.0 * before.mean(axis=1))  # it is the switch that errs


@pytest.mark.slow
def test_the_error_after_the_switch_is_in_proportion_to_its_delay_to_the_next_step(continuous, errors_by_step):
    steps, _, after = errors_by_step
    delays = -continuous.switch_times % steps[:, None]
    # Summed over starts, so that those whose switch happens to fall on a step count for little.
    per_delay = after.sum(axis=1) / delays.sum(axis=1)
    np.testing.assert_allclose(per_delay, per_delay[-1], rtol=0.05)


@pytest.mark.slow
def test_the_clip_before_the_switch_is_of_second_order(errors_by_step):
    steps, before, _ = errors_by_step
    assert fitted_order(steps, before.mean(axis=1)) == pytest.approx(2.0, abs=0.2)
    assert before[-1].max() <= 1e-5


@pytest.fixture(scope="module")
def located_errors_by_step(continuous):
    steps = np.array([8e-3, 4e-3, 2e-3, 0.5e-3])
    before, after = zip(*(continuous.errors(float(dt), "located") for dt in steps), strict=True)
    return steps, np.array(before), np.array(after)


@pytest.mark.slow
def test_located_switching_is_of_fourth_order_across_clip_and_switch(located_errors_by_step):
    steps, before, after = located_errors_by_step
    assert fitted_order(steps[:3], before.mean(axis=1)[:3]) >= 3.7
    assert fitted_order(steps[:3], after.mean(axis=1)[:3]) >= 3.7


@pytest.mark.slow
def test_located_the_loop_is_scipys_through_the_first_catch(located_errors_by_step):
    _, before, after = located_errors_by_step
    assert before[-1].max() <= 1e-8
    assert after[-1].max() <= 1e-8
