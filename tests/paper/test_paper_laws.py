"""What the paper's laws and gains do when they run: swing-up, and the catch under 12 V."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cpjax
from cpjax import paper
from cpjax.pytree import Scalar, number, part, pytree

APPENDIX, IDENTIFIED = paper.appendix_plant(), paper.identified_plant()
PLANTS = {"appendix": APPENDIX, "identified": IDENTIFIED}
both_plants = pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
both_clocks = pytest.mark.parametrize("clock", ["sampled", "continuous"])
HANGING_ENERGY = -2 * 0.5 * 9.81 * 0.7  # J, upright at rest is 0
SAMPLED = {"duration": 20.0, "dt": 0.002, "clock": "sampled"}


@pytree
class SignedSwingUp:
    """u = +-k E theta' cos(theta) as a voltage, with E or its printed form: the paper's law, corrected sign by sign."""

    model: cpjax.CartPole = part("plant", "pendulum_energy")
    outer_sign: Scalar = number("1", "sign of the law")
    potential_sign: Scalar = number("1", "sign of m g l (cos(theta) - 1)")
    kinetic: Scalar = number("1", "factor of m l^2 theta'^2", default=2.0 / 3.0)

    def voltage(self, state):
        m, l, g = self.model.pole_mass, self.model.pole_length, self.model.gravity
        kinetic = self.kinetic * m * l * l * state.theta_dot * state.theta_dot
        energy = kinetic + self.potential_sign * m * g * l * (jnp.cos(state.theta) - 1.0)
        return self.outer_sign * paper.ENERGY_GAIN * energy * state.theta_dot * jnp.cos(state.theta)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Reach:
    """Metric: (highest cos(theta), pendulum energy at the end, and its extremes after `since` seconds)."""

    plant: cpjax.CartPole
    since: float = 0.0

    def init(self, sample):
        far = jnp.full_like(sample.state.theta, jnp.inf)
        return -far, far, -far

    def update(self, memory, sample):
        highest, low, high = memory
        energy = self.plant.pendulum_energy(sample.state)
        late = sample.time >= self.since
        return (
            jnp.maximum(highest, jnp.cos(sample.state.theta)),
            jnp.where(late, jnp.minimum(low, energy), low),
            jnp.where(late, jnp.maximum(high, energy), high),
        )

    def finalize(self, memory, last):
        highest, low, high = memory
        return jnp.degrees(jnp.arccos(highest)), self.plant.pendulum_energy(last.state), low, high


def at(theta, theta_dot=0.0, dtype=np.float64):
    zero = jnp.zeros(np.broadcast_shapes(np.shape(theta), np.shape(theta_dot)), dtype)
    return cpjax.State(zero, zero, zero + jnp.asarray(theta, dtype), zero + jnp.asarray(theta_dot, dtype))


def hanging_starts():
    return cpjax.sample_starts("hanging", 64, seed=1)


# The law as printed, and what mending only a part of it does


@pytest.mark.slow
@both_plants
def test_the_printed_law_swings_up_from_a_small_offset_and_never_stops_pumping(plant):
    offsets = at(math.pi - np.array([1e-3, 1e-2, 1e-1]))
    starts = jax.tree.map(lambda *parts: jnp.concatenate(parts), offsets, hanging_starts())
    closest, _, low, _ = cpjax.sweep(plant, paper.PrintedSwingUp(plant), starts, metrics=Reach(plant, 19.0), **SAMPLED)
    assert np.all(closest < 1.0)
    assert np.all(low > 10.0 * -HANGING_ENERGY)  # spinning, with far more than the energy of upright
    s = at(np.linspace(-7.0, 7.0, 57), np.linspace(5.0, -9.0, 57))
    pump = jax.vmap(paper.PrintedSwingUp(plant).voltage)(s) * s.theta_dot * jnp.cos(s.theta)
    assert np.all(pump >= 0.0)  # pushes so as to add energy, however much there is


@both_plants
def test_the_two_printed_signs_cancel_below_the_energy_of_upright_and_not_above_it(plant):
    printed, corrected = paper.PrintedSwingUp(plant), paper.CorrectedSwingUpAsVoltage(plant)
    formula = SignedSwingUp(plant, outer_sign=1.0, potential_sign=-1.0)
    for theta, theta_dot in np.random.default_rng(3).uniform(-7.0, 7.0, size=(50, 2)):
        s = at(theta, theta_dot)
        assert float(printed.voltage(s)) == pytest.approx(float(formula.voltage(s)), rel=1e-11)
        agree = float(printed.voltage(s)) * float(corrected.voltage(s)) > 0.0
        assert agree == (float(plant.pendulum_energy(s)) < 0.0)


@both_plants
@pytest.mark.parametrize("signs", [(-1.0, -1.0), (1.0, 1.0)], ids=["law corrected", "energy corrected"])
def test_with_only_one_of_its_signs_corrected_the_law_brakes_and_never_gets_there(plant, signs):
    law = SignedSwingUp(plant, *signs)
    closest, end, _, _ = cpjax.sweep(plant, law, hanging_starts(), metrics=Reach(plant), **SAMPLED)
    assert np.min(closest) > 160.0  # no start swings higher than 162.8 degrees
    np.testing.assert_allclose(end, HANGING_ENERGY, rtol=0, atol=1e-5)  # it comes to rest where it hangs


@pytest.mark.slow
@both_plants
@both_clocks
def test_the_corrected_law_read_as_a_voltage_never_gets_there(plant, clock):
    law = paper.CorrectedSwingUpAsVoltage(plant)
    closest, _, _, high = cpjax.sweep(plant, law, hanging_starts(), metrics=Reach(plant), **{**SAMPLED, "clock": clock})
    level = 76 if plant is APPENDIX else 89
    assert np.all(np.round(closest) == level)  # degrees from upright
    assert np.max(high) < -0.5


@both_plants
def test_with_both_signs_corrected_but_two_thirds_kept_the_law_swings_lower_still(plant):
    law = SignedSwingUp(plant, outer_sign=-1.0, potential_sign=1.0)
    closest, _, _, _ = cpjax.sweep(plant, law, hanging_starts(), metrics=Reach(plant), **SAMPLED)
    assert np.all(np.round(closest) == (93 if plant is APPENDIX else 102))


@both_plants
def test_the_corrected_law_inverted_to_a_voltage_gets_to_the_switch_from_every_start(plant):
    law = paper.LAWS["corrected"](plant)
    closest, _, _, _ = cpjax.sweep(plant, law, hanging_starts(), metrics=Reach(plant), **SAMPLED)
    assert np.max(closest) < 24.0


def test_the_corrected_law_reaches_the_upright_energy_only_without_a_voltage_limit():
    def late_energy(limit):
        plant = dataclasses.replace(APPENDIX, motor=dataclasses.replace(APPENDIX.motor, voltage_limit=limit))
        metric = Reach(plant, 50.0)
        law = paper.LAWS["corrected"](plant)
        run = cpjax.measure(plant, law, at(math.pi - 0.1), clock="continuous", duration=60.0, dt=0.002, metrics=metric)
        return float(run[2]), float(run[3])

    low, high = late_energy(math.inf)
    assert -1e-5 < low <= high < 0.0
    low, high = late_energy(12.0)
    assert (low, high) == pytest.approx((-0.211, 0.019), abs=1e-3)  # J


@pytest.mark.parametrize(("plant", "volts"), [(APPENDIX, 14.95), (IDENTIFIED, 14.40)], ids=PLANTS)
def test_holding_the_pivot_still_at_upright_takes_more_than_12_volts(plant, volts):
    theta = jnp.linspace(0.0, math.pi, 20001)
    swing = at(theta, jnp.sqrt(2 * plant.gravity / plant.pole_length * (1.0 - jnp.cos(theta))))
    np.testing.assert_allclose(plant.pendulum_energy(swing), 0.0, atol=1e-12)
    still = jnp.zeros_like(theta)
    needed = plant.motor.voltage_for_force(plant.force_for_acceleration(swing, still), still)
    assert float(jnp.max(jnp.abs(needed))) == pytest.approx(volts, abs=5e-3)


# The catch under 12 V


@pytest.mark.parametrize(("design", "volts", "degrees"), [("placement", 58.49, 6.155), ("lqr", 2510.7, 0.1434)])
def test_what_the_printed_gains_ask_for_at_30_degrees_and_where_they_saturate(design, volts, degrees):
    law = paper.regulator(design, "printed", APPENDIX)
    assert abs(float(law.voltage(at(paper.SWITCH_ANGLE)))) == pytest.approx(volts, rel=1e-4)
    assert abs(float(law.voltage(at(math.radians(degrees))))) == pytest.approx(12.0, rel=5e-4)
    trajectory = cpjax.rollout(APPENDIX, law, at(paper.SWITCH_ANGLE), duration=0.1, dt=0.002, clock="sampled")
    assert float(jnp.max(jnp.abs(trajectory.voltage))) == 12.0  # "below 12 V" is the clip


CATCH = [
    ("appendix", "placement", 22.6, (-3.3, -0.6)),
    ("appendix", "lqr", 11.2, (-2.7, -1.5)),
    ("identified", "placement", 24.2, (-3.5, -0.5)),
    ("identified", "lqr", 13.5, (-2.8, -1.3)),
]


@pytest.mark.parametrize(("name", "design", "largest", "window"), CATCH)
def test_from_rest_the_regulator_alone_catches_up_to_this_angle(name, design, largest, window):
    degrees = np.round(np.arange(0.1, 45.05, 0.1), 1)
    plant = PLANTS[name]
    law = paper.regulator(design, "printed", plant)
    caught = np.asarray(cpjax.sweep(plant, law, at(np.radians(degrees)), **SAMPLED).success)
    np.testing.assert_array_equal(caught, degrees <= largest)


@pytest.mark.parametrize(("name", "design", "largest", "window"), CATCH)
def test_at_30_degrees_the_regulator_alone_catches_within_this_window_of_rates(name, design, largest, window):
    rates = np.round(np.arange(-6.0, 2.05, 0.1), 1)
    plant = PLANTS[name]
    law = paper.regulator(design, "printed", plant)
    for side in (1.0, -1.0):
        starts = at(np.full_like(rates, side * paper.SWITCH_ANGLE), side * rates)
        caught = np.asarray(cpjax.sweep(plant, law, starts, **SAMPLED).success)
        np.testing.assert_array_equal(caught, (rates >= window[0]) & (rates <= window[1]))
