"""Derivatives through the switch against SciPy: variational equations and saltation matrices (`variational.py`)."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from variational import LAW, PLANT, angle, angle_rate, flat, level_set, sensitivities

import cpjax
from cpjax import CartPole, EnergySwingUp, Hybrid, Motor, State, StateFeedback

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))
from _random_loops import GROUPS, draw

DURATION, DT = 2.4, 0.5e-3
GATES = {
    "half_angle": lambda p, P: (
        cpjax.AngleRateGate(p["half_angle"], p["rate"])
        if "rate" in p
        else cpjax.AngleGate(p["half_angle"], p["hysteresis"])
    ),
    "level": lambda p, P: cpjax.LyapunovGate(P, p["level"]),
}


def case(group, values):
    """Parameters with the gain itself among them, not what it is designed from; our loop of them, and SciPy's gate."""
    _, controller = group.build({name: jnp.asarray(value) for name, value in values.items()})
    p = {name: float(values[name]) for name in (*PLANT, *LAW, "voltage_limit", *group.gate_ranges)}
    p["K"] = np.asarray(controller.regulator.K)[0]
    P = np.asarray(controller.gate.P) if "level" in p else None
    ours = GATES["level" if "level" in p else "half_angle"]
    scipys = level_set(P) if "level" in p else (angle_rate if "rate" in p else angle)

    def final_state(p, start):
        motor = Motor(voltage_limit=p["voltage_limit"])
        plant = CartPole(**{name: p[name] for name in PLANT}, motor=motor)
        law = EnergySwingUp(plant, **{name: p[name] for name in LAW})
        loop = Hybrid(law, StateFeedback(p["K"][None]), ours(p, None if P is None else jnp.asarray(P)))
        run = cpjax.rollout(plant, loop, State.from_vector(start), duration=DURATION, dt=DT, switching="located")
        return run.state.vector()[-1], run.flag

    return p, final_state, scipys


def check(group, count, seed, at_least):
    parameters, starts, _ = draw(group, count, seed=seed, duration=DURATION, dt=DT)
    columns = np.asarray(starts.vector())
    jacobian, gates, kept = None, set(), 0
    for i in range(count):
        p, final_state, scipys = case(group, {name: value[i] for name, value in parameters.items()})
        if jacobian is None or "level" in p:  # its P is no parameter
            jacobian = jax.jit(jax.jacfwd(lambda p, s, f=final_state: f(p, s), has_aux=True))
            values = jax.jit(final_state)
        state, slopes, events = sensitivities(p, scipys, columns[i], DURATION)
        traced = {name: jnp.asarray(value) for name, value in p.items()}
        (ours, flag), (found, _) = values(traced, jnp.asarray(columns[i])), jacobian(traced, jnp.asarray(columns[i]))
        assert flag == 0
        assert np.max(np.abs(ours - state)) <= 1e-6 * max(1.0, np.linalg.norm(slopes))
        found = np.stack(
            [np.asarray(found[n]) if k is None else np.asarray(found[n])[:, k] for n, k in flat(p)], axis=1
        )
        size = np.linalg.norm(slopes, axis=0)
        assert np.max(np.linalg.norm(found - slopes, axis=0)[size > 0] / size[size > 0]) <= 1e-5, (group.name, i)
        gates |= {sum(number == 2 for _, number in events)}
        kept += 1
    assert kept >= at_least
    return gates


@pytest.mark.slow
def test_through_catch_and_clip_derivatives_are_those_of_the_variational_equation():
    check(GROUPS[3], 2, seed=11, at_least=2)


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group.name)
def test_derivatives_of_thirty_random_loops_are_those_of_the_variational_equation(group):
    numbers = check(group, 8, seed=12, at_least=8)
    assert len(numbers) >= (1 if "level" in group.name else 2)  # of crossings of the gate
