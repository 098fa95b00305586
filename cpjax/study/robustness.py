"""Robustness card: success rates of a controller on its rig, when the rig is not quite what it was designed for.

Six criteria, after those of the RealAIGym benchmark of double pendulums (Wiebe et al., 2022), with success rates and
their intervals in place of a majority vote: wrong parameters of the plant one at a time, noise of the sensors, noise of
the voltage, a lag of the drive, a delay, and pushes. The score of a criterion is the mean success rate over its grid.
Beside them: all parameters of the plant wrong at once.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from cpjax.controllers.protocol import Controller, Law, ModalController
from cpjax.errors import InputError
from cpjax.fields import config, count, number
from cpjax.numeric.statistics import wilson_interval
from cpjax.plant import CartPole, parameter, parameters_of, sample_starts, with_parameters
from cpjax.plant.state import State
from cpjax.pytree import Number
from cpjax.rig import Disturbance, Drive, Encoders, RandomPushes, Rig, StateSensors
from cpjax.sim.metrics import Metrics, ProtocolMetrics
from cpjax.sim.sweep import sweep

Progress = Callable[[str, int, int], None]
"""Function called with the name of a criterion, the number of runs done and their total."""

_KNOWN = ("gravity", "static_friction_ratio")
"""Parameters that are not varied: a constant, and a ratio that is 1 at least."""


@config
class RobustnessConfig:
    """Configuration of a robustness card."""

    values: int = count("values in each grid", default=21, at_least=2, at_most=1001)
    starts: int = count("initial states for each value", default=200, at_least=1, at_most=100_000)
    rigs: int = count("rigs with all parameters wrong at once", default=1000, at_least=1, at_most=1_000_000)
    seed: int = count("of initial states, noise and wrong parameters", default=1, at_most=2**32 - 1)
    dt: float = number("s", "integration step", default=0.002, above=0.0)
    control_period: float = number("s", "control period", default=0.002, above=0.0)
    spread: float = number("1", "largest share by which one parameter is wrong", default=0.25, above=0.0, below=1.0)
    spread_of_all: float = number("1", "the same, of all parameters at once", default=0.2, above=0.0, below=1.0)
    noise_steps: float = number("1", "largest noise of the encoders, in their steps", default=5.0, above=0.0)
    rate_noise: float = number("rad/s", "largest noise of a rate sensor", default=0.5, above=0.0)
    voltage_noise: float = number("1", "largest noise of the voltage, as a share of the supply", default=0.2, above=0.0)
    lag: float = number("s", "largest time constant of the drive", default=0.02, above=0.0)
    delay: float = number("s", "largest delay", default=0.04, above=0.0)
    push: float = number("1", "largest push, in the pole's weight, for 50 ms", default=2.0, above=0.0)


class Grid(NamedTuple):
    """Success rates along one grid."""

    name: str
    unit: str
    values: Float[np.ndarray, " values"]
    successes: Int[np.ndarray, " values"]
    trials: int
    """Runs for each value."""

    @property
    def rates(self) -> Float[np.ndarray, " values"]:
        """Success rates."""
        return self.successes / self.trials

    @property
    def intervals(self) -> Float[np.ndarray, "values 2"]:
        """95 % Wilson intervals of the success rates."""
        return np.array([wilson_interval(int(one), self.trials) for one in self.successes])


class Criterion(NamedTuple):
    """One criterion of a card: one grid, or one for each parameter of the plant."""

    name: str
    title: str
    grids: tuple[Grid, ...]

    @property
    def score(self) -> float:
        """Mean success rate over all grids."""
        return float(np.mean([np.mean(grid.rates) for grid in self.grids]))

    @property
    def runs(self) -> int:
        """Number of runs."""
        return sum(grid.trials * len(grid.values) for grid in self.grids)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the score."""
        return wilson_interval(sum(int(np.sum(grid.successes)) for grid in self.grids), self.runs)


class RobustnessCard(NamedTuple):
    """Result of `robustness_card`."""

    nominal: Grid
    """Success on the rig as it is."""
    criteria: tuple[Criterion, ...]
    together: Grid
    """Success with all parameters of the plant wrong at once."""


class _Variation(NamedTuple):
    """Grid to be run: a rig of arrays (values * starts,)."""

    criterion: str
    name: str
    unit: str
    values: Float[np.ndarray, " values"]
    rig: Rig


TITLES: Mapping[str, str] = {
    "plant": "one parameter of the plant wrong",
    "measurement": "noise of the sensors",
    "voltage": "noise of the voltage",
    "lag": "lag of the drive",
    "delay": "delay",
    "pushes": "pushes on cart and pole",
}
"""Criteria, and what they vary."""


def robustness_card(
    rig: Rig | CartPole,
    controller: Controller | ModalController | Law,
    settings: RobustnessConfig | None = None,
    *,
    progress: Progress | None = None,
) -> RobustnessCard:
    """Computes the robustness card of a controller on a rig.

    Runs follow the evaluation protocol for rigs: from `hanging` (the cart within a quarter of the half track, where
    that is less than 0.1 m), 20 s or 12 natural periods of the pendulum if that is longer, settled within
    `target_bands`; leaving the track is failure unless it has stops.

    Args:
      rig: the rig, with sensors, drive and track of its own; a bare plant is an ideal rig.
      controller: the firmware as it runs on this rig (with encoders, one that estimates rates).
      settings: the grids; by default those of the protocol.
      progress: called after each grid.

    Raises:
      InputError: a rig or controller that no sweep can run, or whose parameters are arrays.
    """
    settings = RobustnessConfig() if settings is None else settings
    rig = rig if isinstance(rig, Rig) else Rig(rig)
    if any(np.ndim(leaf) for leaf in jax.tree.leaves(rig.plant)):
        raise InputError("rig.plant", "of arrays", "one plant, of scalar parameters")
    n = settings.starts
    starts = initial_states(rig, n, settings.seed)
    variations = list(_variations(rig, settings))
    total = n + settings.rigs + sum(n * len(v.values) for v in variations)
    done = 0

    def run(variation: _Variation, starts: State, trials: int) -> Grid:
        nonlocal done
        metrics: Metrics = sweep(
            variation.rig,
            controller,
            starts,
            metrics=protocol_of(rig),
            duration=duration_of(rig, settings.dt),
            dt=settings.dt,
            control_period=settings.control_period,
            clock="sampled",
            seed=settings.seed,
        )
        successes = np.asarray(metrics.success).reshape(len(variation.values), trials).sum(axis=1)
        done += trials * len(variation.values)
        if progress is not None:
            progress(variation.name, done, total)
        return Grid(variation.name, variation.unit, variation.values, successes, trials)

    one = np.array([0.0])
    nominal = run(_Variation("", "as it is", "", one, rig), starts, n)
    grids = [(v.criterion, run(v, _tiled(starts, len(v.values)), n)) for v in variations]
    wrong = _all_wrong(rig.plant, settings)
    together = _Variation("", "all parameters", "", one, dataclasses.replace(rig, plant=wrong))
    criteria = tuple(
        Criterion(name, title, tuple(grid for of, grid in grids if of == name)) for name, title in TITLES.items()
    )
    all_at_once = run(together, initial_states(rig, settings.rigs, settings.seed), settings.rigs)
    return RobustnessCard(nominal, criteria, all_at_once)


def initial_states(rig: Rig, number_of_states: int, seed: int) -> State:
    """Returns `hanging` initial states (n,), the cart within a quarter of the half track if that is less than 0.1 m."""
    starts = sample_starts("hanging", number_of_states, seed=seed)
    if rig.track is None:
        return starts
    return dataclasses.replace(starts, x=starts.x * min(1.0, 0.25 * float(rig.track.half_length) / 0.1))


def natural_period(plant: CartPole) -> float:
    """Returns the period of small oscillations of the hanging pole, cart held [s]."""
    stiffness = float(plant.pole_mass) * float(plant.gravity) * float(plant.pole_length)
    return 2.0 * math.pi * math.sqrt(float(plant.pivot_inertia) / stiffness)


def duration_of(rig: Rig, dt: float) -> float:
    """Returns the length of a run: 20 s, or 12 natural periods if that is longer, in whole steps of `dt` [s]."""
    return dt * math.ceil(max(20.0, 12.0 * natural_period(rig.plant)) / dt - 1e-9)


def target_bands(rig: Rig) -> tuple[float, float]:
    """Returns the bands of angle [rad] and position [m] that count as settled: the protocol's 0.05 and 0.05.

    The band of the position is 5 % of the pole's length where that is smaller: of the whole length of a pole with an
    inertia, twice the distance to its centre of mass; of a point bob, that distance.
    """
    plant = rig.plant
    length = float(plant.pole_length) * (2.0 if float(plant.pole_inertia) > 0.0 else 1.0)
    return 0.05, min(0.05, 0.05 * length)


def protocol_of(rig: Rig) -> ProtocolMetrics:
    """Returns the metric of the protocol for a rig: its bands, and its track."""
    angle, position = target_bands(rig)
    ends = math.inf if rig.track is None or rig.track.ends == "stop" else float(rig.track.half_length)
    return ProtocolMetrics(angle_band=angle, position_band=position, track_limit=ends)


def _variations(rig: Rig, settings: RobustnessConfig) -> Iterator[_Variation]:
    n, plant = settings.starts, rig.plant
    shares = np.linspace(0.0, 1.0, settings.values)
    drive = Drive() if rig.drive is None else rig.drive

    def each(values: Float[np.ndarray, " values"]) -> Float[np.ndarray, " runs"]:
        return np.repeat(values, n)

    varied = _varied(plant)
    # All are arrays in each grid, and in that of all at once, so that one compilation serves them all.
    same = {name: np.full(n * settings.values, float(parameter(plant, name))) for name in varied}
    for name, rule in varied.items():
        factors = 1.0 + settings.spread * (2.0 * shares - 1.0)
        values = float(parameter(plant, name)) * factors
        changed = with_parameters(plant, {**same, name: _within(each(values), rule)})
        yield _Variation("plant", name, rule.unit, values, dataclasses.replace(rig, plant=changed))
    yield _noisy(rig, settings, shares, each)
    supply = float(plant.motor.voltage_limit)
    scale = supply if math.isfinite(supply) else 12.0
    values = settings.voltage_noise * shares * scale
    noisy = dataclasses.replace(drive, noise=each(values))
    yield _Variation("voltage", "noise", "V", values, dataclasses.replace(rig, drive=noisy))
    values = settings.lag * shares
    # A lag of 0 is one that is far below the step.
    lagging = dataclasses.replace(drive, lag=each(np.maximum(values, 1e-6 * settings.dt)))
    yield _Variation("lag", "time constant", "s", values, dataclasses.replace(rig, drive=lagging))
    values = settings.control_period * np.rint(settings.delay * shares / settings.control_period)
    values = values + float(drive.delay)
    late = dataclasses.replace(drive, delay=each(values))
    yield _Variation("delay", "delay", "s", values, dataclasses.replace(rig, drive=late))
    weight = float(plant.pole_mass) * float(plant.gravity)
    values = settings.push * shares * weight
    last = 0.75 * duration_of(rig, settings.dt)
    pushes = RandomPushes(every=last / 3.0, cart=each(values), pole=each(values), until=last)
    disturbance = Disturbance() if rig.disturbance is None else rig.disturbance
    pushed = dataclasses.replace(disturbance, pushes=pushes)
    yield _Variation("pushes", "force", "N", values, dataclasses.replace(rig, disturbance=pushed))


def _noisy(rig: Rig, settings: RobustnessConfig, shares: Any, each: Any) -> _Variation:
    """Returns the grid of the sensors' noise: in steps of the encoders or, with rates measured, of the rates' noise."""
    sensors = rig.sensors
    if isinstance(sensors, Encoders):
        values = settings.noise_steps * shares
        x, theta = (float(step) for step in (sensors.x_step, sensors.theta_step))
        more = {"x_noise": each(values) * x, "theta_noise": each(values) * theta}
        return _Variation(
            "measurement",
            "noise",
            "steps",
            values,
            dataclasses.replace(rig, sensors=dataclasses.replace(sensors, **more)),
        )
    values = settings.rate_noise * shares
    base = StateSensors() if sensors is None else sensors
    # The cart's rate is noisy by as much at the height of the pole's centre of mass.
    more = {"theta_dot_noise": each(values), "x_dot_noise": each(values) * float(rig.plant.pole_length)}
    return _Variation(
        "measurement", "noise", "rad/s", values, dataclasses.replace(rig, sensors=dataclasses.replace(base, **more))
    )


def _varied(plant: CartPole) -> dict[str, Number]:
    """Returns the declared numbers that are varied: those that are not zero, infinite or known."""
    numbers = {name: (rule, float(parameter(plant, name))) for name, rule in parameters_of(plant).items()}
    return {
        name: rule
        for name, (rule, value) in numbers.items()
        if name not in _KNOWN and value != 0.0 and math.isfinite(value)
    }


def _within(values: Float[np.ndarray, " n"], rule: Number) -> Float[np.ndarray, " n"]:
    return np.clip(values, rule.at_least, rule.at_most)


def _all_wrong(plant: CartPole, settings: RobustnessConfig) -> CartPole:
    """Returns plants (rigs,) whose parameters are all wrong, each uniformly within `spread_of_all`."""
    random = np.random.default_rng([settings.seed, 7])
    varied = _varied(plant)
    factors = random.uniform(1.0 - settings.spread_of_all, 1.0 + settings.spread_of_all, (len(varied), settings.rigs))
    values = {
        name: _within(float(parameter(plant, name)) * row, rule)
        for (name, rule), row in zip(varied.items(), factors, strict=True)
    }
    return with_parameters(plant, values)


def _tiled(starts: State, times: int) -> State:
    return jax.tree.map(lambda column: np.tile(column, times), starts)
