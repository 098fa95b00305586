"""Estimators against loops written with NumPy, python-control and SciPy; what a delay and a dead band do to them."""

import dataclasses
import math

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import derivative
from scipy.stats import chi2

import cpjax
from cpjax import Digital, Drive, FilteredDerivative, InputError, KalmanFilter, Observer, Rig, State, paper
from cpjax.rig import Position

PLANT = paper.appendix_plant()
LAW = cpjax.StateFeedback(paper.PRINTED_GAINS["placement"])
NAMES = ("x", "x_dot", "theta", "theta_dot")
C = np.eye(4)[[0, 2]]


def midpoint(s, u, T):
    """The prediction over a period, with NumPy: both accelerations at the positions half a period on."""
    voltage = min(max(u, -12.0), 12.0)
    q, v = s[[0, 2]] + 0.5 * T * s[[1, 3]], s[[1, 3]]
    rates = v
    for share in (0.5, 1.0):
        rates = v + share * T * derivative(PLANT, np.array([q[0], rates[0], q[1], rates[1]]), voltage)[[1, 3]]
    q = q + 0.5 * T * rates
    return np.array([q[0], rates[0], q[1], rates[1]])


def slope(function, s, h):
    """Derivative along h, per its length, by differences of fourth order."""
    near, far = (function(s + k * h) - function(s - k * h) for k in (1, 2))
    return (8.0 * near - far) / (12.0 * np.linalg.norm(h))


def kalman_by_numpy(kind, measured, commands, T, Q, R, P):
    """Estimates, covariances and normalised squared innovations of the textbook's filter, with matrices."""
    A = control.c2d(control.ss(*cpjax.linearize(PLANT), np.eye(4), np.zeros((4, 1))), T).A
    s = np.array([measured[0, 0], 0.0, measured[0, 1], 0.0])
    states, covariances, squares = [s], [P], []
    for y, u in zip(measured[1:], commands, strict=True):
        if kind == "extended":
            A = np.stack([slope(lambda moved, u=u: midpoint(moved, u, T), s, h) for h in 1e-3 * np.eye(4)], axis=1)
        s, P = midpoint(s, u, T), A @ P @ A.T + Q
        S, error = C @ P @ C.T + R, y - C @ s
        squares.append(error @ np.linalg.solve(S, error))
        K = P @ C.T @ np.linalg.inv(S)
        s, P = s + K @ error, (np.eye(4) - K @ C) @ P
        states.append(s)
        covariances.append(P)
    return np.array(states), np.array(covariances), np.array(squares)


@pytest.mark.parametrize("kind", ["time-varying", "extended"])
def test_a_kalman_filter_is_the_textbooks_and_knows_its_own_errors(kind):
    T, steps, rng = 0.01, 400, np.random.default_rng(3)
    G = np.array([[0.5 * T * T, 0.0], [T, 0.0], [0.0, 0.5 * T * T], [0.0, T]])
    deviations, disturbances, rates = np.array([1e-3, 2e-3]), np.array([0.3, 1.0]), np.array([1.0, 3.0])
    commands = 10.0 * np.sin(np.cumsum(rng.uniform(0.0, 0.4, steps)))
    states = [np.array([0.0, rates[0] * rng.normal(), math.pi - 0.3, rates[1] * rng.normal()])]
    for u in commands:
        states.append(midpoint(states[-1], u, T) + G @ (disturbances * rng.normal(size=2)))
    measured = np.array(states) @ C.T + deviations * rng.normal(size=(steps + 1, 2))
    P = np.diag([deviations[0], rates[0], deviations[1], rates[1]]) ** 2
    expected = kalman_by_numpy(
        kind, measured, commands, T, G @ np.diag(disturbances**2) @ G.T, np.diag(deviations**2), P
    )

    filtering = KalmanFilter(PLANT, *deviations, *disturbances, *rates, kind=kind).at_period(T)

    def update(memory, row):
        memory, _ = filtering.update(memory, Position(row[0], row[1]), row[2])
        return memory, memory

    rows = jnp.asarray(np.column_stack([measured, [0.0, *commands]]))
    _, found = jax.lax.scan(update, filtering.init(Position(*rows[0, :2])), rows)
    upper = np.stack(found.covariance, axis=1)
    np.testing.assert_allclose(found.state.vector(), expected[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(upper, expected[1][:, *np.triu_indices(4)], rtol=0, atol=1e-9)
    if kind == "extended":
        low, high = chi2.interval(0.95, 2 * steps)
        assert low <= np.sum(expected[2]) <= high
    else:  # in the end the steady gain
        gain = upper[-1][[0, 1, 2, 3, 2, 5, 7, 8]].reshape(2, 4).T / deviations**2
        np.testing.assert_allclose(gain, filtering.steady_gain(T), rtol=1e-6)


def test_the_kalman_gain_is_python_controls():
    A, _ = cpjax.discretize(*cpjax.linearize(PLANT), 0.002)
    G = np.eye(4)[:, [1, 3]] * 0.002
    for QN, RN in ((np.diag([1.0, 100.0]), np.diag([1e-9, 1e-7])), (np.array([[2.0, 0.5], [0.5, 3.0]]), np.eye(2))):
        L, _, _ = control.dlqe(np.asarray(A), G, C, QN, RN)
        found = cpjax.dlqe(A, G, C, QN, RN)
        digits = {"rtol": 0, "atol": 1e-9 * np.max(np.abs(L))}
        np.testing.assert_allclose(found.L, L, **digits)
        np.testing.assert_allclose(np.asarray(A) @ found.filter, L, **digits)


def test_a_steady_filter_in_the_loop_is_the_observer_that_was_designed_before():
    deviations = {"x_deviation": 1e-4, "theta_deviation": 1e-3}
    designed = cpjax.kalman_observer(PLANT, period=0.01, **deviations)
    steady = jax.jit(lambda T: KalmanFilter(PLANT, **deviations).at_period(T))(0.01)
    assert isinstance(steady, Observer)
    np.testing.assert_allclose(steady.gain, designed.gain, rtol=1e-9)


@pytest.mark.parametrize("poles", [[-30.0, -30.0, -30.0, -30.0], [-20.0 + 15j, -20.0 - 15j, -40.0, -25.0]])
def test_an_observers_error_has_its_poles_with_a_pair_for_each_position(poles):
    T = 0.01
    A = np.asarray(cpjax.discretize(*cpjax.linearize(PLANT), T).A)
    observer = jax.jit(Observer(PLANT, poles=poles).at_period)(T)
    error = A - A @ np.asarray(observer.gain) @ C
    np.testing.assert_allclose(np.poly(error), np.real(np.poly(np.exp(np.array(poles) * T))), rtol=0, atol=1e-11)
    pairs = np.exp(np.array(poles) * T).reshape(2, 2)
    recursion = np.diag(np.sum(pairs, axis=1).real) @ C @ error - np.diag(np.prod(pairs, axis=1).real) @ C
    np.testing.assert_allclose(C @ error @ error, recursion, rtol=0, atol=1e-11)


def acting(prediction, delay, told, dead_band=0.4):
    """Largest difference, over a run, between the voltage that acts and the law's of the state at that instant."""
    T = 0.002
    observer = Observer(PLANT, poles=[-20.0, -20.0, -30.0, -30.0], prediction=prediction)
    rig = Rig(PLANT, drive=Drive(delay=delay * T, dead_band=dead_band))
    firmware = Digital(LAW, observer, dead_band=dead_band, delay=told)
    run = cpjax.rollout(rig, firmware, State(0.02, 0.0, 0.12, 0.0), duration=1.0, dt=T)
    wanted = np.asarray(jax.vmap(LAW.voltage)(run.state))
    wanted = np.clip(np.sign(wanted) * np.maximum(np.abs(wanted), dead_band), -12.0, 12.0)
    voltage = np.asarray(run.voltage)
    assert np.any(np.abs(wanted[delay:]) == 12.0)
    assert np.any(np.isclose(np.abs(wanted[delay:]), dead_band))
    return np.max(np.abs(voltage - wanted)[delay:])


def test_an_observer_by_poles_may_be_made_inside_a_function_that_is_traced():
    def gain(period):
        return Observer(PLANT, poles=[-20.0, -21.0, -30.0, -35.0]).at_period(period).gain

    np.testing.assert_allclose(jax.jit(gain)(0.002), gain(0.002), rtol=1e-12)
    with pytest.raises(InputError, match="every real part below 0"):
        jax.jit(lambda x: x * Observer(PLANT, poles=[1.0, -2.0, -3.0, -4.0]).poles.a)(1.0)


@pytest.mark.parametrize(
    ("prediction", "delay", "told", "error"),
    [
        ("runge-kutta", 4, 4, [0.0, 1e-5]),  # what the raise beyond the dead band's edge adds
        pytest.param("midpoint", 4, 4, [0.0, 0.02], marks=pytest.mark.slow),
        pytest.param("runge-kutta", 0, 0, [0.0, 1e-5], marks=pytest.mark.slow),
        ("runge-kutta", 4, 0, [1.0, 24.0]),
    ],
)
def test_with_a_known_delay_the_law_acts_on_the_state_that_its_command_meets(prediction, delay, told, error):
    least, most = error
    assert least <= acting(prediction, delay, told) <= most


@pytest.mark.slow
def test_derivatives_through_a_filtered_loop_are_those_of_finite_differences():
    sensors = cpjax.Encoders(x_step=1e-14, theta_step=1e-14, x_noise=1e-3, theta_noise=1e-3)
    filtering = KalmanFilter(PLANT, 1e-3, 2e-3, kind="extended")

    def effort(deviation, start):
        firmware = Digital(LAW, dataclasses.replace(filtering, x_deviation=deviation), delay=1)
        rig = Rig(PLANT, sensors=sensors, drive=Drive(delay=0.01))
        return cpjax.measure(rig, firmware, start, duration=0.5, dt=0.01).effort

    starts = State(*(jnp.asarray(column) for column in ([0.02, 0.0], [0.0, 0.0], [0.05, math.pi], [0.0, 0.0])))
    each = jax.jit(jax.vmap(effort, in_axes=(None, 0)))
    at, h = jnp.asarray(1e-3), 1e-6
    by_differences = (each(at + h, starts) - each(at - h, starts)) / (2 * h)
    _, forward = jax.jit(lambda d: jax.jvp(lambda d: each(d, starts), (d,), (jnp.ones_like(d),)))(at)
    reverse = jax.jit(jax.vmap(jax.grad(effort), in_axes=(None, 0)))(at, starts)
    assert abs(float(forward[0])) > 1.0
    np.testing.assert_allclose(forward, by_differences, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: Observer(PLANT), "Observer.gain"),
        (lambda: Observer(PLANT, np.ones((4, 2)), poles=[-1.0, -2.0, -3.0, -4.0]), "Observer.gain"),
        (lambda: Observer(PLANT, poles=[1.0, -2.0, -3.0, -4.0]), "poles"),
        (lambda: Observer(PLANT, np.ones((4, 2)), prediction="euler"), "Observer.prediction"),
        (lambda: KalmanFilter(PLANT, 1e-3, 0.0), "KalmanFilter.theta_deviation"),
        (lambda: KalmanFilter(PLANT, 1e-3, 1e-3, kind="unscented"), "KalmanFilter.kind"),
        (lambda: KalmanFilter(PLANT, 1e-3, 1e-3).update(None, None, 0.0), "KalmanFilter.period"),
        (lambda: Digital(LAW, FilteredDerivative(30.0), delay=1), "Digital.estimator"),
        (lambda: Digital(LAW, Observer(PLANT, np.ones((4, 2))), delay=0.002), "Digital.delay"),
    ],
)
def test_what_no_estimator_can_be_is_refused_by_name(call, field):
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.field == field
