"""python-control simulates and linearises what cpjax does, and its gains are cpjax's."""

import functools
import itertools
import math
import subprocess
import sys
from dataclasses import replace

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import NAMES, columns, derivative, dop853, rough_plant
from scipy.linalg import solve_continuous_are
from scipy.signal import place_poles
from tables import rows

import cpjax
from cpjax import (
    HANGING,
    AngleGate,
    AngleRateGate,
    EnergySwingUp,
    Hybrid,
    InputError,
    LyapunovGate,
    Motor,
    State,
    StateFeedback,
    paper,
)
from cpjax.bridges import python_control as bridge

ROUGH = rough_plant()
TIGHT = {"solve_ivp_method": "DOP853", "solve_ivp_kwargs": {"rtol": 1e-13, "atol": 1e-13}}
LEANING = State(0.05, 0.1, math.pi - 0.2, 0.1)


@functools.cache
def optimal(plant):
    """python-control's LQR gain for some weights."""
    return control.lqr(bridge.state_space(plant), np.eye(4), [[0.1]])[0]


def hybrid(plant, half_angle=0.5, **gate):
    law = EnergySwingUp(plant, energy_gain=5.0, cart_stiffness=4.0, cart_damping=2.0)
    return Hybrid(law, StateFeedback(optimal(plant)), AngleGate(half_angle, **gate))


def simulate(system, times, start, voltage=None, **options):
    inputs = {} if voltage is None else {"inputs": voltage}
    run = control.input_output_response(system, times, initial_state=start, **inputs, **options)
    return np.asarray(run.states).T, {name: np.asarray(run.outputs)[i] for i, name in enumerate(system.output_labels)}


# The plant


@rows("plant", [paper.appendix_plant(), ROUGH], ids=["appendix", "rough"])
def test_the_plant_under_a_voltage_signal_is_scipys(plant):
    # python-control draws straight lines between the inputs' times: here a zigzag that goes beyond the clip.
    corners, zigzag = np.array([0.0, 0.5, 1.5, 2.5]), [0.0, 20.0, -20.0, 20.0]
    times = np.linspace(0.0, 2.5, 101)
    states, outputs = simulate(
        bridge.plant_system(plant), times, columns(LEANING), np.interp(times, corners, zigzag), **TIGHT
    )

    def applied(t):
        return min(max(np.interp(t, corners, zigzag), -12.0), 12.0)

    # The reference starts anew wherever the voltage has a corner; the time is its fifth state.
    kinks = [0.0, 0.3, 0.5, 0.7, 1.3, 1.5, 1.7, 2.3, 2.5]
    state, worst = np.append(columns(LEANING), 0.0), 0.0
    for begin, end in itertools.pairwise(kinks):
        inside = (times >= begin) & (times <= end)
        run = dop853(
            lambda s: np.append(derivative(plant, s[:4], applied(s[4])), 1.0), state, (begin, end), dense_output=True
        )
        worst = max(worst, np.max(np.abs(states[inside] - run.sol(times[inside]).T[:, :4])))
        state = run.y[:, -1]
    assert worst <= 1e-10
    np.testing.assert_array_equal(np.stack([outputs[name] for name in NAMES], axis=-1), states)


@cpjax.pytree.pytree
class Constant:
    """A law that holds 3 V."""

    def voltage(self, state):
        return 3.0


def test_the_plant_under_a_constant_voltage_is_a_rollout():
    times = np.linspace(0.0, 2.0, 101)
    states, _ = simulate(bridge.plant_system(ROUGH), times, columns(HANGING), np.full(101, 3.0), **TIGHT)
    run = cpjax.rollout(ROUGH, Constant(), HANGING, clock="continuous", duration=2.0, dt=2e-4, save_every=100)
    assert np.max(np.abs(states - columns(run.state))) <= 1e-11


def test_the_plants_derivative_is_that_of_cpjax_to_rounding():
    plant, rng = ROUGH, np.random.default_rng(1)
    system = bridge.plant_system(plant)
    field = jax.jit(lambda s, u: plant.vector_field(State.from_vector(s), plant.motor.saturate(u)).vector())
    for _ in range(200):
        state, voltage = rng.normal(size=4) * [1.0, 2.0, 4.0, 6.0], rng.uniform(-24.0, 24.0)
        ours = np.asarray(field(state, voltage))
        np.testing.assert_allclose(system.dynamics(0.0, state, [voltage]), ours, rtol=1e-13, atol=1e-13)


def test_the_clip_passes_on_what_is_not_a_number():
    system = bridge.plant_system(ROUGH)
    assert np.isnan(system.dynamics(0.0, np.zeros(4), [math.nan])[1])


@cpjax.pytree.pytree
class MotorWithDeadBand:
    """Somebody else's motor: it does not feel less than 1 V."""

    motor: Motor = cpjax.pytree.part("a cpjax.Motor", "force")

    def saturate(self, voltage):
        return jnp.where(jnp.abs(voltage) < 1.0, 0.0, voltage)

    def force(self, voltage, x_dot):
        return self.motor.force(voltage, x_dot)

    @property
    def reflected_mass(self):
        return self.motor.reflected_mass


def test_another_motor_saturates_in_its_own_way():
    plant = replace(ROUGH, motor=MotorWithDeadBand(ROUGH.motor))
    system = bridge.plant_system(plant)
    for asked, applied in ((0.9, 0.0), (1.5, 1.5), (20.0, 20.0)):
        expected = derivative(ROUGH, columns(LEANING), applied)
        np.testing.assert_allclose(system.dynamics(0.0, columns(LEANING), [asked]), expected, rtol=1e-12)


def test_an_unlimited_supply_clips_nothing():
    plant = replace(ROUGH, motor=replace(ROUGH.motor, voltage_limit=math.inf))
    np.testing.assert_allclose(
        bridge.plant_system(plant).dynamics(0.0, np.zeros(4), [500.0]),
        derivative(plant, np.zeros(4), 500.0),
        rtol=1e-13,
    )


# The linear model


@rows("equilibrium", ["upright", "hanging", State(1.5, 0.0, 0.0, 0.0)])
def test_the_state_space_is_cpjaxs_linear_model_with_names(equilibrium):
    system = bridge.state_space(ROUGH, equilibrium)
    model = cpjax.linearize(ROUGH, equilibrium)
    np.testing.assert_array_equal(system.A, model.A)
    np.testing.assert_array_equal(system.B, model.B)
    np.testing.assert_array_equal(system.C, np.eye(4))
    assert system.isctime()
    assert system.state_labels == system.output_labels == list(NAMES)
    assert system.input_labels == ["voltage"]


def test_the_outputs_are_the_named_states_in_the_order_asked_for():
    measured = bridge.state_space(ROUGH, outputs=bridge.MEASURED)
    np.testing.assert_array_equal(measured.C, [[1, 0, 0, 0], [0, 0, 1, 0]])
    assert measured.output_labels == ["x", "theta"]
    assert np.linalg.matrix_rank(control.obsv(measured.A, measured.C)) == 4
    np.testing.assert_array_equal(bridge.state_space(ROUGH, outputs=["theta", "x"]).C, measured.C[::-1])
    np.testing.assert_array_equal(bridge.state_space(ROUGH, outputs="theta").C, [[0, 0, 1, 0]])


@rows(("equilibrium", "theta"), [("upright", 0.0), ("hanging", math.pi)])
def test_python_controls_own_linearisation_of_the_plant_is_cpjaxs(equilibrium, theta):
    plant = ROUGH
    numeric = bridge.plant_system(plant).linearize([0.0, 0.0, theta, 0.0], [0.0])
    exact = bridge.state_space(plant, equilibrium)
    # One-sided differences with a step of 1e-6. The equations are odd about an equilibrium: they err by rounding only.
    assert np.max(np.abs(numeric.A - exact.A)) <= 5e-9
    assert np.max(np.abs(numeric.B - exact.B)) <= 5e-9
    np.testing.assert_allclose(numeric.C, exact.C, atol=1e-9)


# The closed loop in continuous time


def catch_time(system, start, until):
    """When the mode first becomes 1, by bisection on SciPy's own solution."""
    run = dop853(lambda s: system.dynamics(0.0, s, []), start, (0.0, until), dense_output=True)

    def caught(t):
        return system.output(0.0, run.sol(t), [])[5] == 1.0

    grid = np.linspace(0.0, until, 401)
    after = next(i for i, t in enumerate(grid) if caught(t))
    low, high = grid[after - 1], grid[after]
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if caught(middle) else (middle, high)
    return high


@rows("plant", [paper.appendix_plant(), ROUGH], ids=["appendix", "rough"])
def test_without_a_clip_the_continuous_loop_is_the_rollout_before_and_after_a_catch(plant):
    # A rollout switches at the end of a step, the system at the boundary: so let a step end just past the boundary.
    plant = replace(plant, motor=replace(plant.motor, voltage_limit=math.inf))
    controller = hybrid(plant)
    system = bridge.closed_loop_system(plant, controller)
    steps, every = 8192, 256
    dt = (catch_time(system, columns(LEANING), 2.0) + 1e-10) / steps
    run = cpjax.rollout(
        plant, controller, LEANING, clock="continuous", duration=2 * steps * dt, dt=dt, save_every=every
    )
    catch = int(np.argmax(run.mode))
    assert (catch, int(run.metrics.switches)) == (steps // every, 1)
    states, outputs = simulate(system, np.asarray(run.time), columns(LEANING), **TIGHT)
    error = np.max(np.abs(states - columns(run.state)), axis=1)
    assert np.max(error[:catch]) <= 1e-10
    assert (
        np.max(error) <= 1e-8
    )  # the 1e-10 s by which the rollout is late, times the switch's jump of the acceleration
    np.testing.assert_array_equal(outputs["mode"], run.mode)


@pytest.mark.slow
@rows("plant", [paper.appendix_plant(), ROUGH], ids=["appendix", "rough"])
@rows(("start", "mode"), [(LEANING, 0), (State(0.2, -0.3, 0.45, -0.2), 1)], ids=["swinging up", "catching"])
def test_with_the_clip_the_continuous_loop_is_the_rollout_in_either_mode(plant, start, mode):
    controller = hybrid(plant)
    run = cpjax.rollout(plant, controller, start, clock="continuous", duration=0.8, dt=1e-4, save_every=200)
    assert np.any(np.abs(run.voltage) == 12.0)
    assert np.any(np.abs(run.voltage) < 12.0)
    states, outputs = simulate(
        bridge.closed_loop_system(plant, controller), np.asarray(run.time), columns(start), **TIGHT
    )
    np.testing.assert_array_equal(run.mode, mode)
    np.testing.assert_array_equal(outputs["mode"], mode)
    # The clip's corners cost a rollout its fourth order: 1.3e-7 at most here, four times as much at twice the step.
    assert np.max(np.abs(states - columns(run.state))) <= 1e-6
    assert np.max(np.abs(outputs["voltage"] - run.voltage)) <= 1e-5


def test_a_law_on_its_own_closes_the_loop_in_mode_0():
    plant, start = ROUGH, State(0.1, 0.0, 0.1, 0.0)
    law = StateFeedback(optimal(plant))
    run = cpjax.rollout(plant, law, start, clock="continuous", duration=2.0, dt=1e-3, save_every=100)
    assert np.all(np.abs(run.voltage) < 12.0)
    states, outputs = simulate(bridge.closed_loop_system(plant, law), np.asarray(run.time), columns(start), **TIGHT)
    assert np.max(np.abs(states - columns(run.state))) <= 1e-10
    assert np.max(np.abs(outputs["voltage"] - run.voltage)) <= 1e-8
    np.testing.assert_array_equal(outputs["mode"], 0.0)


# The closed loop in discrete time


@pytest.mark.slow
@rows(
    ("controller", "start", "switches"),
    [
        pytest.param(hybrid(ROUGH), HANGING, 1, id="caught"),
        pytest.param(hybrid(ROUGH, half_angle=0.2), LEANING, 3, id="in and out"),
        pytest.param(hybrid(ROUGH, half_angle=0.2, hysteresis=0.2), LEANING, 2, id="hysteresis"),
        pytest.param(StateFeedback(optimal(ROUGH)), State(0.1, -0.2, 0.3, 0.1), 0, id="law"),
    ],
)
def test_the_sampled_loop_is_the_sampled_rollout_with_its_modes(controller, start, switches):
    period = 4e-3
    system = bridge.closed_loop_system(ROUGH, controller, period, dt=1e-3)
    run = cpjax.rollout(
        ROUGH, controller, start, duration=2.4, dt=1e-3, clock="sampled", control_period=period, save_every=4
    )
    states, outputs = simulate(system, np.asarray(run.time), [*columns(start), 0.0])
    assert int(run.metrics.switches) == switches
    assert system.dt == period
    assert np.max(np.abs(states[:, :4] - columns(run.state))) <= 1e-12
    assert np.max(np.abs(outputs["voltage"] - run.voltage)) <= 1e-12
    np.testing.assert_array_equal(outputs["mode"], run.mode)
    np.testing.assert_array_equal(states[1:, 4], run.mode[:-1])


def test_by_default_a_period_is_one_step():
    system = bridge.closed_loop_system(ROUGH, hybrid(ROUGH), 2e-3)
    run = cpjax.rollout(ROUGH, hybrid(ROUGH), LEANING, duration=0.1, dt=2e-3, clock="sampled")
    states, _ = simulate(system, np.asarray(run.time), [*columns(LEANING), 0.0])
    assert np.max(np.abs(states[:, :4] - columns(run.state))) <= 1e-12


def test_between_the_two_boundaries_the_mode_until_now_decides():
    system = bridge.closed_loop_system(ROUGH, hybrid(ROUGH, half_angle=0.2, hysteresis=0.5), 1e-3)
    between = [0.0, 0.0, 0.25, 0.0]
    for mode in (0.0, 1.0):
        assert system.output(0.0, [*between, mode], [])[5] == mode
        assert system.dynamics(0.0, [*between, mode], [])[4] == mode
    beyond = [0.0, 0.0, 0.31, 0.0]
    assert system.output(0.0, [*beyond, 1.0], [])[5] == 0.0


@rows("period", [None, 1e-3])
def test_whole_numbers_are_states_too(period):
    system, start = (
        bridge.closed_loop_system(ROUGH, hybrid(ROUGH), period),
        [0, 1, 3, 0, 0][: 4 if period is None else 5],
    )
    decimals = [float(v) for v in start]
    np.testing.assert_array_equal(system.dynamics(0.0, start, []), system.dynamics(0.0, decimals, []))
    np.testing.assert_array_equal(system.output(0.0, start, []), system.output(0.0, decimals, []))


@rows("period", [None, 2e-3])
def test_in_jaxs_default_dtype_the_loop_is_the_same_to_float32(period):
    times = np.linspace(0.0, 0.2, 101)
    start = [*columns(LEANING), 0.0][: 4 if period is None else 5]
    fine, _ = simulate(bridge.closed_loop_system(ROUGH, hybrid(ROUGH), period), times, start)
    with jax.enable_x64(False):
        system = bridge.closed_loop_system(ROUGH, hybrid(ROUGH), period)
        rough, outputs = simulate(system, times, start)
        plant_field = bridge.plant_system(ROUGH).dynamics(0.0, columns(LEANING), [1.0])
    assert np.max(np.abs(rough - fine)) <= 2e-5
    assert set(outputs["mode"]) == {0.0}
    np.testing.assert_allclose(plant_field, derivative(ROUGH, columns(LEANING), 1.0), rtol=1e-13)


# Gains


def test_python_controls_lqr_is_scipys_and_its_gain_catches_the_pole():
    A, B = map(np.asarray, cpjax.linearize(ROUGH))
    P = solve_continuous_are(A, B, np.eye(4), [[0.1]])
    law = bridge.state_feedback(optimal(ROUGH))
    np.testing.assert_allclose(law.K, B.T @ P / 0.1, rtol=1e-9)
    run = cpjax.rollout(ROUGH, law, State(0.1, 0.0, 0.2, 0.0), clock="continuous", duration=12.0, dt=1e-3)
    assert bool(run.metrics.success)


def test_a_placed_gain_has_the_papers_poles_in_either_package():
    system = bridge.state_space(paper.appendix_plant())
    K = control.place(system.A, system.B, list(paper.POLES))
    np.testing.assert_allclose(K, place_poles(system.A, system.B, paper.POLES).gain_matrix, rtol=1e-9)
    closed = control.feedback(system, bridge.feedback_system(bridge.state_feedback(K)), sign=1)
    np.testing.assert_allclose(np.sort(closed.poles().real), np.sort(paper.POLES), rtol=1e-6)


@rows("shape", [(1, 4), (4,)])
def test_a_gain_comes_back_as_it_went(shape):
    K = np.array([[-1.0, 2.0, -3.0, 4.0]])
    law = bridge.state_feedback(K.reshape(shape))
    np.testing.assert_array_equal(bridge.gain_array(law), K)
    np.testing.assert_array_equal(bridge.state_feedback(bridge.feedback_system(law)).K, K)
    assert float(law.voltage(State(1.0, 0.0, 0.0, 0.0))) == 1.0


def test_a_static_system_is_read_by_the_names_of_its_inputs():
    D = [[1.0, 2.0, 3.0, 4.0]]
    shuffled = control.StateSpace([], [], [], D, inputs=["theta", "x", "theta_dot", "x_dot"], outputs=["voltage"])
    np.testing.assert_array_equal(bridge.state_feedback(shuffled).K, [[-2.0, -4.0, -1.0, -3.0]])
    nameless = control.StateSpace([], [], [], D)
    np.testing.assert_array_equal(bridge.state_feedback(nameless).K, [[-1.0, -2.0, -3.0, -4.0]])


def test_plant_and_gain_connected_by_name_are_the_closed_loop():
    law, times = StateFeedback(optimal(ROUGH)), np.linspace(0.0, 1.0, 51)
    parts = [bridge.plant_system(ROUGH), bridge.feedback_system(law)]
    connected = control.interconnect(parts, inputs=[], outputs=list(NAMES))
    start = [0.1, 0.0, 0.2, -0.1]
    ours, _ = simulate(bridge.closed_loop_system(ROUGH, law), times, start, **TIGHT)
    theirs, _ = simulate(connected, times, start, **TIGHT)
    assert np.max(np.abs(ours - theirs)) <= 1e-11


# What is refused


@cpjax.pytree.pytree
class GateOfAStranger:
    """A gate of which nobody knows whether it remembers."""

    def margin(self, state, mode):
        return jnp.cos(state.theta) - 0.9


def traced(function, value):
    """Calls `function` with what JAX makes of `value` while it traces."""
    jax.eval_shape(function, value)


@rows(
    ("call", "field"),
    [
        (lambda: bridge.plant_system(paper), "plant"),
        (lambda: bridge.state_space(None), "plant"),
        (lambda: bridge.state_space(ROUGH, "sideways"), "equilibrium"),
        (lambda: bridge.state_space(ROUGH, outputs=["x", "phi"]), "outputs"),
        (lambda: bridge.state_space(ROUGH, outputs=["x", "x"]), "outputs"),
        (lambda: bridge.state_space(ROUGH, outputs=[]), "outputs"),
        (lambda: bridge.state_space(ROUGH, outputs=3), "outputs"),
        (lambda: bridge.state_space(ROUGH, outputs=[["x"]]), "outputs"),
        (lambda: bridge.closed_loop_system(paper, hybrid(ROUGH)), "plant"),
        (lambda: bridge.closed_loop_system(ROUGH, 3.0), "controller"),
        (lambda: bridge.closed_loop_system(ROUGH, hybrid(ROUGH, hysteresis=0.1)), "controller"),
        (lambda: bridge.closed_loop_system(ROUGH, replace(hybrid(ROUGH), gate=GateOfAStranger())), "controller"),
        (lambda: bridge.closed_loop_system(ROUGH, hybrid(ROUGH), dt=1e-3), "dt"),
        (lambda: bridge.closed_loop_system(ROUGH, hybrid(ROUGH), 1e-3, dt=0.3e-3), "control_period"),
        (lambda: bridge.closed_loop_system(ROUGH, hybrid(ROUGH), 1e-3, dt=2e-3), "control_period"),
        (lambda: bridge.closed_loop_system(ROUGH, hybrid(ROUGH), 1e-3, dt=-1e-3), "dt"),
        (lambda: bridge.closed_loop_system(ROUGH, hybrid(ROUGH), 0.0), "control_period"),
        (lambda: bridge.closed_loop_system(ROUGH, hybrid(ROUGH), math.inf), "control_period"),
        (lambda: bridge.closed_loop_system(ROUGH, hybrid(ROUGH), "fast"), "control_period"),
        (lambda: bridge.closed_loop_system(ROUGH, hybrid(ROUGH), [1e-3]), "control_period"),
        (lambda: bridge.closed_loop_system(ROUGH, hybrid(ROUGH), True), "control_period"),
        (lambda: bridge.gain_array([1.0, 2.0, 3.0, 4.0]), "law"),
        (lambda: bridge.gain_array(StateFeedback([1.0, 2.0, 3.0, 4.0], State(0.1, 0.0, 0.0, 0.0))), "law.reference"),
        (lambda: bridge.feedback_system(StateFeedback(np.ones((4,)), State(0.0, 0.0, 0.1, 0.0))), "law.reference"),
        (lambda: bridge.gain_array(jax.tree.map(lambda v: np.stack([v, v]), StateFeedback(np.ones(4)))), "law.K"),
        (lambda: bridge.state_feedback(np.ones((1, 3))), "gain"),
        (lambda: bridge.state_feedback(np.ones((4, 1))), "gain"),
        (lambda: bridge.state_feedback(np.ones((2, 1, 4))), "gain"),
        (lambda: bridge.state_feedback(np.ones((1, 4)) * 1j), "gain"),
        (lambda: bridge.state_feedback("wxyz"), "gain"),
        (lambda: bridge.state_feedback(control.lqr(bridge.state_space(ROUGH), np.eye(4), [[1.0]])), "gain"),
        (lambda: bridge.state_feedback(bridge.state_space(ROUGH)), "gain"),
        (lambda: bridge.state_feedback(control.StateSpace([], [], [], [[1.0, 2.0, 3.0]])), "gain"),
        (lambda: bridge.state_feedback([1.0, 2.0, math.nan, 4.0]), "StateFeedback.K"),
        (lambda: traced(lambda x: bridge.state_space(ROUGH, State(x, 0.0, 0.0, 0.0)), 1.0), "equilibrium"),
        (lambda: traced(lambda m: bridge.plant_system(replace(ROUGH, cart_mass=m)), 1.0), "plant"),
        (lambda: traced(lambda k: bridge.closed_loop_system(ROUGH, StateFeedback(k)), np.ones(4)), "controller"),
        (lambda: traced(lambda k: bridge.gain_array(StateFeedback(k)), np.ones(4)), "law"),
        (lambda: traced(bridge.state_feedback, np.ones(4)), "gain"),
        (lambda: traced(lambda t: bridge.closed_loop_system(ROUGH, Constant(), t), 1e-3), "control_period"),
    ],
)
def test_bad_input_is_refused_by_name(call, field):
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.field == field


def test_a_controller_that_remembers_is_told_to_give_a_control_period():
    with pytest.raises(InputError, match="control_period"):
        bridge.closed_loop_system(ROUGH, hybrid(ROUGH, hysteresis=0.1))
    bridge.closed_loop_system(ROUGH, hybrid(ROUGH, hysteresis=0.1), 1e-3)
    bridge.closed_loop_system(ROUGH, replace(hybrid(ROUGH), gate=GateOfAStranger()), 1e-3)


@rows("gate", [AngleGate(0.4), AngleRateGate(0.4, 2.0), LyapunovGate(np.eye(4), 0.3)])
def test_every_gate_without_hysteresis_closes_the_continuous_loop(gate):
    system = bridge.closed_loop_system(ROUGH, replace(hybrid(ROUGH), gate=gate))
    assert [system.output(0.0, [0.0, 0.0, theta, 0.0], [])[5] for theta in (0.0, math.pi)] == [1.0, 0.0]


def test_importing_cpjax_imports_no_bridge():
    script = "import sys, cpjax; sys.exit(any(m == 'control' or m.startswith('cpjax.bridges') for m in sys.modules))"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
