"""Whether a rig can be swung up at all: a random search over short laws that do nothing but pump."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cpjax.backend.trigonometry import sin_cos
from cpjax.errors import InputError
from cpjax.numeric.selection import where
from cpjax.plant import CartPole, linearize
from cpjax.plant.state import State
from cpjax.pytree import Scalars, number, part, pytree
from cpjax.rig import Rig
from cpjax.sim.metrics import Sample
from cpjax.sim.sweep import sweep

RUNS, ROUNDS = 512, 4
"""Laws of a round, and rounds."""

_ELITE = 48  # laws of a round that the next one is drawn around
_PERIODS = 15.0  # length of a run, in periods of the pendulum
_START = 0.02  # angle from hanging at the start [rad]
_MOST_STEPS = 20_000
_LOW, _HIGH = np.array([-1.0, -0.5, 0.0, -2.0, -3.0]), np.array([0.0, 1.5, 1.0, 1.0, 1.0])
"""Ranges of a law's numbers: decimal logarithms relative to their scales; the lead in quarter turns."""


@pytree
class Pump:
    """Law that only pumps: u = amplitude tanh(sharpness p) - stiffness x - damping x'.

        p = theta' cos(theta) cos(lead) + (theta'^2 / frequency - frequency cos(theta)) sin(theta) sin(lead)

    An acceleration of the cart along theta' cos(theta) adds energy to the pendulum, and so does, integrated by parts, a
    velocity against the derivative of that, which for small friction is the second term. A cart that obeys as a mass
    wants no lead; one whose drive brakes it, so that its speed follows the voltage, a lead of a quarter turn.
    """

    amplitude: Scalars = number("V", "largest voltage that pumps", at_least=0.0)
    sharpness: Scalars = number("s/rad", "how soon it is reached", at_least=0.0)
    lead: Scalars = number("rad", "phase by which the voltage is ahead", at_least=0.0, at_most=math.pi / 2)
    stiffness: Scalars = number("V/m", "pull of the cart to x = 0", at_least=0.0)
    damping: Scalars = number("V s/m", "damping of the cart", at_least=0.0)
    frequency: Scalars = number("rad/s", "of small swings", above=0.0)

    def voltage(self, state: State) -> Scalars:
        """Returns the demanded voltage [V]."""
        sin, cos = sin_cos(state.theta)
        sin_lead, cos_lead = sin_cos(self.lead)
        rate = state.theta_dot
        ahead = (rate * rate / self.frequency - self.frequency * cos) * sin
        pump = self.amplitude * jnp.tanh(self.sharpness * (rate * cos * cos_lead + ahead * sin_lead))
        return pump - self.stiffness * state.x - self.damping * state.x_dot


class Climb(NamedTuple):
    """State and result of the metric `Energy`."""

    share: Float[Array, "*batch"]
    """Largest energy of the pendulum: 0 hanging at rest, 1 upright at rest."""
    time: Float[Array, "*batch"]
    """When it first was 1 [s]; inf if never."""
    travel: Float[Array, "*batch"]
    """Max |x| until then [m]."""


@pytree
class Energy:
    """Metric whose result is a `Climb`. A run that leaves the track is held, and gains nothing more."""

    plant: CartPole = part("plant whose pendulum energy counts, a CartPole", "pendulum_energy")

    def init(self, sample: Sample) -> Climb:
        nothing = jnp.zeros_like(sample.time)
        return Climb(nothing, jnp.full_like(nothing, math.inf), nothing)

    def update(self, state: Climb, sample: Sample) -> Climb:
        lift = 2.0 * self.plant.pole_mass * self.plant.gravity * self.plant.pole_length
        share = 1.0 + self.plant.pendulum_energy(sample.state) / lift
        before = state.time == math.inf
        travel = jnp.maximum(state.travel, jnp.abs(sample.state.x))
        return Climb(
            jnp.maximum(state.share, share),
            where(before & (share >= 1.0), sample.time, state.time),
            where(before, travel, state.travel),
        )

    def finalize(self, state: Climb, last: Sample) -> Climb:
        return state


@dataclasses.dataclass(frozen=True)
class SwingUpSearch:
    """Result of `search_swing_up`: the run that got highest, or, of several that reach upright, the fastest.

    Attributes:
      found: whether the pendulum got the energy of upright within the track.
      share: its largest energy: 0 hanging at rest, 1 upright at rest.
      time: when it had that of upright [s]; inf if never.
      travel: max |x| until then, or in the whole run [m].
      law: the law of that run.
      runs: runs simulated.
      duration: of each [s].
    """

    found: bool
    share: float
    time: float
    travel: float
    law: Pump
    runs: int
    duration: float


def search_swing_up(rig: Rig, *, seed: int = 1) -> SwingUpSearch:
    """Searches for a swing-up by the cross-entropy method over the numbers of a `Pump`.

    What is found is possible; what is not found may still be. The law measures the whole state and acts without delay,
    so that the plant, its supply, the drive's other imperfections and the track decide.

    Args:
      rig: the rig.
      seed: of the random numbers.

    Raises:
      InputError: a negative seed.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise InputError("seed", seed, "a whole number, at least 0")
    random, plant = np.random.default_rng(seed), rig.plant
    how = _timing(plant)
    bench = dataclasses.replace(rig, sensors=None)
    if rig.drive is not None:
        bench = dataclasses.replace(bench, drive=dataclasses.replace(rig.drive, delay=0.0))
    still = np.zeros(RUNS)
    starts = State(still, still, np.full(RUNS, math.pi - _START), still)
    drawn = random.uniform(_LOW, _HIGH, size=(RUNS, 5))
    best: SwingUpSearch | None = None
    runs = 0
    for _ in range(ROUNDS):
        runs += RUNS
        laws = _laws(drawn, rig)
        climbs: Climb = sweep(bench, laws, starts, metrics=Energy(plant), clock="sampled", **how)
        share, time = np.asarray(climbs.share), np.asarray(climbs.time)
        order = np.lexsort((time, -np.minimum(share, 1.0)))
        first = _result(int(order[0]), laws, climbs, how["duration"])
        if best is None or (first.found, first.share) > (best.found, best.share):
            best = first
        if best.found:
            break
        elite = drawn[order[:_ELITE]]
        spread = np.maximum(np.std(elite, axis=0), 0.05)
        drawn = np.clip(np.mean(elite, axis=0) + spread * random.standard_normal((RUNS, 5)), _LOW, _HIGH)
    assert best is not None
    return dataclasses.replace(best, runs=runs)


def _result(index: int, laws: Pump, climbs: Climb, duration: float) -> SwingUpSearch:
    """Returns the result if the run of this index is the best."""
    law: Pump = jax.tree.map(lambda column: float(column[index]), laws)
    share, time, travel = (float(np.asarray(column)[index]) for column in climbs)
    return SwingUpSearch(math.isfinite(time), share, time, travel, law, 0, duration)


def _laws(drawn: Float[np.ndarray, "laws numbers"], rig: Rig) -> Pump:
    """Returns the laws, of arrays (laws,), that points between `_LOW` and `_HIGH` stand for."""
    plant: Any = rig.plant
    supply = float(plant.motor.voltage_limit)
    if not math.isfinite(supply):  # as much as accelerates all of it with g
        weight = float(plant.moving_mass + plant.pole_mass) * float(plant.gravity)
        supply = float(plant.motor.voltage_for_force(weight, 0.0))
    length = float(plant.pole_length) if rig.track is None else float(rig.track.half_length)
    frequency = float(plant.natural_frequency)
    amplitude, sharpness, _, stiffness, damping = (10.0**drawn).T
    amplitude = supply * amplitude
    return Pump(
        amplitude=amplitude,
        sharpness=sharpness / frequency,
        lead=0.5 * math.pi * drawn[:, 2],
        stiffness=amplitude / length * stiffness,
        damping=amplitude / (length * frequency) * damping,
        frequency=np.full(len(drawn), frequency),
    )


def _timing(plant: CartPole) -> dict[str, Any]:
    """Returns duration and dt [s]: fine against the swings and against the fastest linear mode."""
    A, _ = linearize(plant)
    swing = 2.0 * math.pi / float(plant.natural_frequency)
    fastest = float(np.max(np.abs(np.linalg.eigvals(np.asarray(A, float)))))
    dt = min(swing / 200.0, 0.3 / fastest)
    steps = min(_MOST_STEPS, math.ceil(_PERIODS * swing / dt))
    return {"duration": steps * dt, "dt": dt}
