"""Starting from rest: what the paper's law does there, what rounding does, and the kick that replaces both."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tables import rows

import cpjax
from cpjax import paper
from cpjax.pytree import Scalar, number, part, pytree

APPENDIX, IDENTIFIED = paper.appendix_plant(), paper.identified_plant()
PLANTS = {"appendix": APPENDIX, "identified": IDENTIFIED}
both_plants = pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
both_clocks = rows("clock", ["sampled", "continuous"])
SAMPLED = {"duration": 20.0, "dt": 0.002, "clock": "sampled"}


@pytree
class UnkickedSwingUp:
    """The corrected acceleration law, inverted to a voltage, with neither kick nor anything else at rest."""

    model: cpjax.CartPole = part("plant", "force_for_acceleration")
    energy_gain: Scalar = number("m/(J s)", "k")
    cart_stiffness: Scalar = number("1/s^2", "pull of the cart to x = 0", default=0.0)
    cart_damping: Scalar = number("1/s", "damping of the cart", default=0.0)

    def acceleration(self, state):
        pump = -self.energy_gain * self.model.pendulum_energy(state) * state.theta_dot * jnp.cos(state.theta)
        return pump - self.cart_stiffness * state.x - self.cart_damping * state.x_dot

    def voltage(self, state):
        force = self.model.force_for_acceleration(state, self.acceleration(state))
        return self.model.motor.voltage_for_force(force, state.x_dot)


def at(theta, dtype=np.float64):
    zero = jnp.zeros((), dtype)
    return cpjax.State(zero, zero, jnp.asarray(theta, dtype), zero)


def time_to_leave(trajectory):
    """When theta first is 0.3 rad from hanging [s]; inf if never."""
    gone = np.abs(np.asarray(trajectory.state.theta) - math.pi) > 0.3
    return float(trajectory.time[np.argmax(gone)]) if gone.any() else math.inf


@pytest.mark.slow
@both_plants
@both_clocks
def test_the_law_as_printed_never_starts_from_exact_rest(plant, clock):
    assert float(paper.PrintedSwingUp(plant).voltage(cpjax.HANGING)) == 0.0
    controller = paper.controller("as-printed", "placement", plant)
    trajectory = cpjax.rollout(plant, controller, cpjax.HANGING, **{**SAMPLED, "clock": clock})
    assert float(jnp.max(jnp.abs(trajectory.state.theta - math.pi))) < 1e-6
    assert float(jnp.max(jnp.abs(trajectory.voltage))) < 1e-6
    assert not trajectory.metrics.success


# (energy gain, stiffness, damping) and the time to leave, with room for the clocks and for other rounding.
UNKICKED = {
    (0.2, 0.0, 0.0): (32.0, 35.0),
    (1.0, 0.0, 0.0): (4.3, 4.7),
    (5.0, 0.0, 0.0): (0.9, 1.0),
    (1.0, 4.0, 2.0): (7.2, 7.6),
    (5.0, 4.0, 2.0): (0.95, 1.05),
    (0.2, 4.0, 2.0): (20.0, math.inf),
}


@pytest.mark.slow
@rows("numbers", UNKICKED, ids=str)
@both_clocks
def test_only_rounding_starts_the_energy_law_without_a_kick_and_it_takes_its_time(numbers, clock):
    law = UnkickedSwingUp(APPENDIX, *numbers)
    assert float(law.acceleration(cpjax.HANGING)) == 0.0
    assert abs(float(law.voltage(cpjax.HANGING))) < 1e-14  # the sine of the float nearest to pi is not zero
    trajectory = cpjax.rollout(APPENDIX, law, cpjax.HANGING, duration=40.0, dt=0.002, clock=clock, save_every=10)
    earliest, latest = UNKICKED[numbers]
    assert earliest < time_to_leave(trajectory) <= latest


def test_when_the_unkicked_law_starts_depends_on_the_precision_of_the_arithmetic():
    law = UnkickedSwingUp(APPENDIX, energy_gain=0.2)
    leave = [
        time_to_leave(cpjax.rollout(APPENDIX, law, at(math.pi, dtype=dtype), duration=40.0, dt=0.002, clock="sampled"))
        for dtype in (np.float32, np.float64)
    ]
    assert leave[0] < 0.5 * leave[1]


@rows(
    ("numbers", "seconds"),
    [
        ((0.2, 0.0, 0.0), 3.7),
        ((1.0, 0.0, 0.0), 0.5),
        ((5.0, 0.0, 0.0), 0.3),
        ((0.2, 4.0, 2.0), 3.4),
        ((1.0, 4.0, 2.0), 1.1),
        ((5.0, 4.0, 2.0), 0.3),
    ],
    ids=str,
)
@both_plants
def test_the_kick_starts_every_gain_within_four_seconds(plant, numbers, seconds):
    gain, stiffness, damping = numbers
    law = cpjax.EnergySwingUp(plant, energy_gain=gain, cart_stiffness=stiffness, cart_damping=damping)
    trajectory = cpjax.rollout(plant, law, cpjax.HANGING, duration=5.0, dt=0.002, clock="sampled")
    assert round(time_to_leave(trajectory), 1) == seconds


@pytest.mark.slow
@both_plants
def test_from_rest_the_kicked_law_settles_alike_in_either_precision_and_clock(plant):
    controller = paper.controller("corrected-centred", "placement", plant)
    times = [
        float(
            cpjax.measure(
                plant, controller, at(math.pi + off, dtype), duration=20.0, dt=0.002, clock=clock
            ).settling_time
        )
        for clock in ("sampled", "continuous")
        for dtype in (np.float32, np.float64)
        for off in (0.0, 1e-12, -1e-12)
    ]
    assert max(times) <= 1.01 * min(times)
    assert np.median(times) == pytest.approx(3.426 if plant is APPENDIX else 3.307, rel=0.005)


# The kick


def swung(law, amplitude, phase):
    """A state whose swing has the energy of `amplitude`, at `phase`: 0 is deflected at rest, pi/2 swings through."""
    frequency = math.sqrt(law.model.gravity / law.model.pole_length)
    deflection = 2.0 * math.asin(math.sin(0.5 * amplitude) * math.cos(phase))
    rate = 2.0 * frequency * math.sin(0.5 * amplitude) * math.sin(phase)
    return cpjax.State(*map(jnp.asarray, (0.1, 0.3, math.pi + deflection, rate)))


CENTRED = paper.LAWS["corrected-centred"](APPENDIX)
PHASES = (0.0, 0.7, math.pi / 2, 2.5, math.pi, 4.0, 5.5)


@rows("phase", PHASES)
def test_the_kick_is_exactly_zero_outside_its_radius(phase):
    plain = UnkickedSwingUp(APPENDIX, CENTRED.energy_gain, CENTRED.cart_stiffness, CENTRED.cart_damping)
    for factor in (1.0001, 1.1, 2.0, 50.0):
        s = swung(CENTRED, factor * CENTRED.kick_radius, phase)
        wild = dataclasses.replace(CENTRED, kick=1e6)
        assert float(wild.acceleration(s)) == float(CENTRED.acceleration(s))  # to the last bit
        assert float(CENTRED.acceleration(s)) == pytest.approx(float(plain.acceleration(s)), rel=1e-12)
    inside = swung(CENTRED, 0.9 * CENTRED.kick_radius, phase)
    assert float(wild.acceleration(inside)) - float(CENTRED.acceleration(inside)) > 1.0


def jacobian(law, s):
    return np.asarray(jax.grad(lambda vector: law.acceleration(cpjax.State.from_vector(vector)))(s.vector()))


@rows("phase", PHASES)
def test_the_kicked_law_is_continuously_differentiable_where_the_kick_ends(phase):
    def jump(step):
        before, after = (swung(CENTRED, (1.0 + side * step) * CENTRED.kick_radius, phase) for side in (-1, 1))
        return np.max(np.abs(jacobian(CENTRED, after) - jacobian(CENTRED, before)))

    assert jump(1e-1) > 1e-3  # the measure sees something
    assert jump(1e-3) < 0.02 * jump(1e-1)
    assert jump(1e-6) < 1e-3 * jump(1e-3)


@rows("phase", PHASES)
def test_the_kicked_law_is_continuously_differentiable_at_rest(phase):
    rest = jacobian(CENTRED, swung(CENTRED, 0.0, phase))
    for amplitude in (1e-4, 1e-6, 1e-8):
        near = jacobian(CENTRED, swung(CENTRED, amplitude, phase))
        # s = (1 - w)^3 bends by 6 / kick_radius^2, times the kick and the centring that it takes the place of
        assert np.max(np.abs(near - rest)) < 1.1 * 6.0 / 0.02**2 * (0.5 + 4.0 * 0.1 + 2.0 * 0.3) * amplitude


def finish(law, start, **settings):
    controller = cpjax.Hybrid(law, paper.regulator("placement", "printed", APPENDIX), cpjax.AngleGate(0.5))
    return cpjax.rollout(APPENDIX, controller, start, dt=0.002, **settings)


@both_clocks
def test_derivatives_from_hanging_rest_are_finite_and_those_of_central_differences(clock):
    leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, (CENTRED, cpjax.HANGING)))
    assert len(leaves) == len(jax.tree.leaves(CENTRED)) + 4

    @jax.jit
    def outcome_and_slope(leaves, direction):
        def outcome(leaves):
            settings = {"duration": 0.2, "clock": clock, "derivative": "pathwise"}  # it never reaches the gate
            end = finish(*jax.tree.unflatten(structure, leaves), **settings).state
            return end.theta[-1] + 0.3 * end.x[-1] + 0.1 * end.theta_dot[-1]

        return jax.jvp(outcome, (leaves,), (direction,))

    for moved in range(len(leaves)):
        direction = [jnp.asarray(float(i == moved)) for i in range(len(leaves))]
        step = 1e-6 * max(1.0, abs(float(leaves[moved])))
        above, below = (
            outcome_and_slope([v + side * step * d for v, d in zip(leaves, direction, strict=True)], direction)[0]
            for side in (1, -1)
        )
        _, slope = outcome_and_slope(leaves, direction)
        assert math.isfinite(slope)
        assert float(slope) == pytest.approx(float(above - below) / (2 * step), rel=1e-5, abs=1e-6)


@pytest.mark.slow
def test_gradients_of_a_whole_run_from_hanging_rest_are_finite():
    def effort(law, start):
        return finish(law, start, duration=6.0, clock="sampled", derivative="pathwise").metrics.effort

    slopes = jax.grad(effort, argnums=(0, 1))(*jax.tree.map(jnp.asarray, (CENTRED, cpjax.HANGING)))
    assert np.all(np.isfinite(jax.tree.leaves(slopes)))
    law, start = slopes
    assert min(abs(float(slope)) for slope in (law.kick, law.energy_gain, start.x, start.theta)) > 0.0
