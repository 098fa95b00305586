"""Gates, their hysteresis, and the hybrid law that remembers its mode."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tables import rows

import cpjax
from cpjax import REGULATE, SWING_UP, AngleGate, AngleRateGate, LyapunovGate, State

P = np.diag([2.0, 0.5, 9.0, 1.0]) + 0.3


def at(theta, theta_dot=0.0, x=0.0, x_dot=0.0):
    return State(jnp.asarray(x), jnp.asarray(x_dot), jnp.asarray(theta), jnp.asarray(theta_dot))


def is_open(gate, state, mode=SWING_UP):
    return bool(gate.margin(state, jnp.asarray(mode)) >= 0)


@rows("turns", [-2, -1, 0, 1, 3])
def test_the_angle_gate_opens_within_its_half_angle_on_every_turn(turns):
    gate = AngleGate(half_angle=0.5)
    for theta in (-0.499, 0.0, 0.499):
        assert is_open(gate, at(theta + turns * math.tau))
    for theta in (-0.501, 0.501, math.pi, -math.pi):
        assert not is_open(gate, at(theta + turns * math.tau))


def test_hanging_is_no_boundary_of_an_angle_gate():
    gate = AngleGate(half_angle=0.5)
    margins = [float(gate.margin(at(math.pi + d), jnp.asarray(SWING_UP))) for d in (-1e-6, 0.0, 1e-6)]
    assert max(margins) < -1.8
    assert np.ptp(margins) < 1e-11


def test_the_angle_and_rate_gate_has_its_extents_on_the_axes_and_is_rounded_between():
    gate = AngleRateGate(half_angle=0.5, rate=2.0)
    assert is_open(gate, at(0.4999))
    assert not is_open(gate, at(0.5001))
    assert is_open(gate, at(0.0, 1.9999))
    assert not is_open(gate, at(0.0, 2.0001))
    assert not is_open(gate, at(0.49, 1.9))  # a box would be open here
    assert is_open(gate, at(0.49 + math.tau, 0.1))


def test_the_lyapunov_gate_is_the_level_set_of_its_form_with_the_angle_wrapped():
    rng = np.random.default_rng(3)
    gate = LyapunovGate(P=P, level=1.5)
    for s in rng.normal(size=(200, 4)) * 0.4:
        value = s @ P @ s
        assert is_open(gate, at(s[2], s[3], s[0], s[1])) == (value <= 1.5)
        assert is_open(gate, at(s[2] - math.tau, s[3], s[0], s[1])) == (value <= 1.5)


@rows(
    ("gate", "edge"),
    [
        (AngleGate(half_angle=0.4, hysteresis=0.25), lambda size: at(0.4 * size)),
        (AngleRateGate(half_angle=0.4, rate=2.0, hysteresis=0.25), lambda size: at(0.4 * size)),
        (AngleRateGate(half_angle=0.4, rate=2.0, hysteresis=0.25), lambda size: at(0.0, 2.0 * size)),
        (LyapunovGate(P=np.eye(4), level=0.16, hysteresis=0.25), lambda size: at(0.4 * math.sqrt(size))),
    ],
)
def test_hysteresis_widens_the_way_out_by_its_fraction_and_leaves_the_way_in(gate, edge):
    for size, on_the_way_in, on_the_way_out in ((0.999, True, True), (1.001, False, True), (1.251, False, False)):
        assert is_open(gate, edge(size), SWING_UP) == on_the_way_in
        assert is_open(gate, edge(size), REGULATE) == on_the_way_out


def hybrid(gate):
    model = cpjax.paper.appendix_plant()
    return cpjax.Hybrid(cpjax.EnergySwingUp(model, energy_gain=1.0), cpjax.StateFeedback([1.0, 2.0, 3.0, 4.0]), gate)


def test_inside_the_hysteresis_band_a_run_starts_in_the_swing_up_law():
    controller = hybrid(AngleGate(half_angle=0.4, hysteresis=0.25))
    mode = controller.start_mode(at(0.45))
    assert int(mode) == SWING_UP
    assert int(controller.next_mode(at(0.45), mode)) == SWING_UP
    inside = controller.next_mode(at(0.39), mode)
    assert int(inside) == REGULATE
    assert int(controller.next_mode(at(0.45), inside)) == REGULATE
    assert int(controller.next_mode(at(0.51), inside)) == SWING_UP


def test_a_start_exactly_on_the_boundary_is_inside():
    gate = AngleGate(half_angle=0.4)
    assert float(gate.margin(at(0.4), jnp.asarray(SWING_UP))) == 0.0
    assert int(hybrid(gate).start_mode(at(0.4))) == REGULATE


def test_each_mode_has_the_voltage_of_its_own_law():
    controller = hybrid(AngleGate(half_angle=0.4))
    state = at(0.3, 0.7, 0.1, -0.2)
    regulating = controller.mode_voltage(state, jnp.asarray(REGULATE))
    swinging = controller.mode_voltage(state, jnp.asarray(SWING_UP))
    assert float(regulating) == pytest.approx(-(0.1 - 0.4 + 0.9 + 2.8))
    assert float(swinging) == pytest.approx(float(controller.swing_up.voltage(state)))
    assert float(regulating) != pytest.approx(float(swinging))


def margin_of(gate, v):
    return gate.margin(State.from_vector(v), jnp.asarray(SWING_UP))


MARGIN = [jax.jit(f) for f in (margin_of, jax.jacfwd(margin_of, argnums=1), jax.grad(margin_of, argnums=1))]


@rows("gate", [AngleGate(0.4), AngleRateGate(0.4, 2.0), LyapunovGate(P, 0.3)])
@rows("theta", [0.0, 0.4, -0.4, math.pi, -math.pi, 3 * math.pi, 1.0])
def test_the_margins_derivative_agrees_forward_in_reverse_and_with_differences(gate, theta):
    margin, forward, reverse = (functools.partial(function, gate) for function in MARGIN)
    v = jnp.array([0.1, -0.2, theta, 0.3])
    forward, reverse = forward(v), reverse(v)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12, atol=1e-14)
    if isinstance(gate, LyapunovGate) and abs(math.remainder(theta, math.tau)) > 3.1:
        return  # the wrapped form jumps there, far outside its level set; its one-sided derivative is finite
    h = 1e-3
    for i in range(4):
        e = jnp.zeros(4).at[i].set(h)
        rough = (margin(v + e) - margin(v - e)) / (2 * h)
        fine = (margin(v + e / 2) - margin(v - e / 2)) / h
        assert float((4 * fine - rough) / 3) == pytest.approx(float(forward[i]), abs=1e-10)


def test_margins_and_their_derivatives_are_finite_everywhere():
    for gate in (AngleGate(0.4), AngleRateGate(0.4, 2.0, hysteresis=0.1), LyapunovGate(P, 0.3)):
        for theta in (0.0, 0.4, math.pi, -math.pi):
            for dtype in (jnp.float32, jnp.float64):
                state = jax.tree.map(lambda v, dtype=dtype: v.astype(dtype), at(theta))
                g = jax.tree.map(lambda v, dtype=dtype: jnp.asarray(v, dtype), gate)
                gradient = jax.grad(lambda s, g=g: g.margin(s, jnp.asarray(SWING_UP)))(state)
                assert all(np.isfinite(leaf) and leaf.dtype == dtype for leaf in jax.tree.leaves(gradient))


def test_state_feedback_holds_its_reference_and_takes_the_angle_modulo_a_turn():
    law = cpjax.StateFeedback([1.0, 2.0, 3.0, 4.0], reference=State(0.5, 0.0, 0.0, 0.0))
    assert float(law.voltage(at(0.0, x=0.5))) == 0.0
    assert float(law.voltage(at(math.tau + 0.1, x=0.5))) == pytest.approx(-0.3)
    assert float(law.voltage(at(0.0, x=1.0))) == pytest.approx(-0.5)
