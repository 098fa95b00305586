"""Gains of other conventions."""

import control
import numpy as np
import pytest

import cpjax
from cpjax import InputError, State, StateFeedback

OTHERS = ("x", "theta", "x_dot", "theta_dot")
STATE = State(0.2, -0.3, 0.1, 0.7)


def test_a_gain_of_another_order_and_lean_gives_the_same_command():
    K = np.array([-44.7, 109.4, -42.1, 13.6])
    same_lean = StateFeedback.from_convention(K, OTHERS)
    assert float(same_lean.voltage(STATE)) == pytest.approx(-K @ [0.2, 0.1, -0.3, 0.7], rel=1e-12)
    opposite = StateFeedback.from_convention([K * [1, -1, 1, -1]], OTHERS, theta_sign=-1)
    np.testing.assert_array_equal(opposite.K, same_lean.K)
    # A mirror image: everything has the other sign there, the command too, unless it is said to be ours.
    mirrored = StateFeedback.from_convention(K, list(OTHERS), theta_sign=-1, x_sign=-1)
    np.testing.assert_array_equal(mirrored.K, same_lean.K)
    ours = StateFeedback.from_convention(K, OTHERS, theta_sign=-1, x_sign=-1, command_sign=1)
    np.testing.assert_array_equal(ours.K, -same_lean.K)


def test_a_design_in_another_convention_stabilises_the_plant_here():
    A, B = (np.asarray(matrix) for matrix in cpjax.linearize(cpjax.CartPole()))
    there = np.diag([1.0, -1.0, 1.0, -1.0]) @ np.eye(4)[[0, 2, 1, 3]]  # their state is this times ours
    K = control.lqr(there @ A @ there.T, there @ B, np.eye(4), 1.0)[0]
    law = StateFeedback.from_convention(K, OTHERS, theta_sign=-1)
    np.testing.assert_allclose(law.K, control.lqr(A, B, np.eye(4), 1.0)[0], rtol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "options", "field"),
    [
        (([1.0, 2.0, 3.0], OTHERS), {}, "K"),
        (([1.0, 2.0, 3.0, 4.0], ("x", "theta", "v", "w")), {}, "order"),
        (([1.0, 2.0, 3.0, 4.0], ("x", "x", "theta", "theta_dot")), {}, "order"),
        (([1.0, 2.0, 3.0, 4.0], "x"), {}, "order"),
        (([1.0, 2.0, 3.0, 4.0],), {"theta_sign": 0}, "theta_sign"),
        (([1.0, 2.0, 3.0, 4.0],), {"command_sign": "-"}, "command_sign"),
    ],
)
def test_no_other_convention_is_taken(arguments, options, field):
    with pytest.raises(InputError) as caught:
        StateFeedback.from_convention(*arguments, **options)
    assert caught.value.field == field
