"""Robustness card: success rates of a controller on its rig, when the rig is not quite what it was designed for.

Six criteria, after those of the RealAIGym benchmark of double pendulums, with success rates and their intervals in
place of a majority vote: wrong parameters of the plant one at a time, noise of the sensors, noise of
the voltage, a lag of the drive, a delay, and pushes. The score of a criterion is the mean success rate over its grid.
Beside them: all parameters of the plant wrong at once.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
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
from cpjax.rig import Disturbance, Drive, RandomPushes, Rig, StateSensors
from cpjax.sim.metrics import Metrics, ProtocolMetrics
from cpjax.sim.sweep import sweep

Progress = Callable[[str, int, int], None]
"""Function called with what runs, the number of runs done and their total."""

_USUAL_STEPS = {"x": 1e-4, "theta": math.tau / 4096}
"""Steps of encoders [m, rad], in which the noise of sensors without steps is given."""

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

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.nominal.trials + self.together.trials + sum(criterion.runs for criterion in self.criteria)


class _Part(NamedTuple):
    """Grid to be run, and what differs from the rig as it is: arrays (values * trials,) by name."""

    criterion: str
    name: str
    unit: str
    values: Float[np.ndarray, " values"]
    trials: int
    changes: Mapping[str, Float[np.ndarray, " runs"]]

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.trials * len(self.values)


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
      progress: called after each part of the runs.

    Raises:
      InputError: a rig or controller that no sweep can run, or whose parameters are arrays.
    """
    settings = RobustnessConfig() if settings is None else settings
    rig = rig if isinstance(rig, Rig) else Rig(rig)
    if any(np.ndim(leaf) for leaf in jax.tree.leaves(rig.plant)):
        raise InputError("rig.plant", "of arrays", "one plant, of scalar parameters")
    # All grids of the plant are one sweep, and all others are another: two compilations in all.
    plants, benches = _plant_parts(rig, settings), _bench_parts(rig, settings)
    total = sum(part.runs for part in (*plants, *benches))

    def run(parts: Sequence[_Part], whole: Rig, before: int, name: str) -> list[Grid]:
        states = [_tiled(initial_states(rig, part.trials, settings.seed), len(part.values)) for part in parts]
        metrics: Metrics = sweep(
            whole,
            controller,
            jax.tree.map(lambda *columns: np.concatenate(columns), *states),
            metrics=protocol_of(rig),
            duration=duration_of(rig, settings.dt),
            dt=settings.dt,
            control_period=settings.control_period,
            clock="sampled",
            seed=settings.seed,
            progress=None if progress is None else lambda done, _: progress(name, before + done, total),
        )
        ends = np.cumsum([part.runs for part in parts])
        pieces = np.split(np.asarray(metrics.success), ends[:-1])
        return [
            Grid(part.name, part.unit, part.values, piece.reshape(-1, part.trials).sum(axis=1), part.trials)
            for part, piece in zip(parts, pieces, strict=True)
        ]

    nominal, *of_plant, together = run(plants, _with_plants(rig, plants), 0, "parameters of the plant")
    done = sum(part.runs for part in plants)
    of_bench = run(benches, _with_benches(rig, benches, settings), done, "noise, lag, delay and pushes")
    found = [*zip(plants[1:-1], of_plant, strict=True), *zip(benches, of_bench, strict=True)]
    criteria = tuple(
        Criterion(name, title, tuple(grid for part, grid in found if part.criterion == name))
        for name, title in TITLES.items()
    )
    return RobustnessCard(nominal, criteria, together)


def document(card: RobustnessCard) -> dict[str, Any]:
    """Returns a card as plain values, for JSON."""

    def grid(one: Grid) -> dict[str, Any]:
        return {
            "name": one.name,
            "unit": one.unit,
            "values": one.values.tolist(),
            "successes": one.successes.tolist(),
            "trials": one.trials,
            "intervals": one.intervals.tolist(),
        }

    return {
        "nominal": grid(card.nominal),
        "criteria": {
            one.name: {
                "title": one.title,
                "score": one.score,
                "interval": list(one.interval),
                "grids": [grid(each) for each in one.grids],
            }
            for one in card.criteria
        },
        "together": grid(card.together),
    }


def initial_states(rig: Rig, number_of_states: int, seed: int) -> State:
    """Returns `hanging` initial states (n,), the cart within a quarter of the half track if that is less than 0.1 m."""
    starts = sample_starts("hanging", number_of_states, seed=seed)
    if rig.track is None:
        return starts
    return dataclasses.replace(starts, x=starts.x * min(1.0, 0.25 * float(rig.track.half_length) / 0.1))


def duration_of(rig: Rig, dt: float) -> float:
    """Returns the length of a run: 20 s, or 12 natural periods if that is longer, in whole steps of `dt` [s]."""
    return dt * math.ceil(max(20.0, 24.0 * math.pi / float(rig.plant.natural_frequency)) / dt - 1e-9)


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


def _plant_parts(rig: Rig, settings: RobustnessConfig) -> list[_Part]:
    """Returns the rig as it is, one grid for each parameter of the plant, and all parameters at once."""
    n, plant, varied = settings.starts, rig.plant, _varied(rig.plant)
    factors = 1.0 + settings.spread * np.linspace(-1.0, 1.0, settings.values)
    one = np.array([0.0])
    parts = [_Part("", "as it is", "", one, n, {})]
    for name, rule in varied.items():
        values = float(parameter(plant, name)) * factors
        parts.append(_Part("plant", name, rule.unit, values, n, {name: _within(np.repeat(values, n), rule)}))
    random = np.random.default_rng([settings.seed, 7])
    spread = settings.spread_of_all
    shares = random.uniform(1.0 - spread, 1.0 + spread, (len(varied), settings.rigs))
    wrong = {
        name: _within(float(parameter(plant, name)) * row, rule)
        for (name, rule), row in zip(varied.items(), shares, strict=True)
    }
    return [*parts, _Part("", "all parameters", "", one, settings.rigs, wrong)]


def _bench_parts(rig: Rig, settings: RobustnessConfig) -> list[_Part]:
    """Returns the grids of what is beside the plant."""
    n, plant = settings.starts, rig.plant
    shares = np.linspace(0.0, 1.0, settings.values)
    rates = rig.sensors is None or isinstance(rig.sensors, StateSensors)
    noise = shares * (settings.rate_noise if rates else settings.noise_steps)
    supply = float(plant.motor.voltage_limit)
    late = settings.control_period * np.rint(settings.delay * shares / settings.control_period)
    base = 0.0 if rig.drive is None else float(rig.drive.delay)
    weight = float(plant.pole_mass) * float(plant.gravity)
    grids = [
        ("measurement", "noise", "rad/s" if rates else "steps", noise),
        ("voltage", "noise", "V", settings.voltage_noise * shares * (supply if math.isfinite(supply) else 12.0)),
        ("lag", "time constant", "s", settings.lag * shares),
        ("delay", "delay", "s", base + late),
        ("pushes", "force", "N", settings.push * shares * weight),
    ]
    return [_Part(key, name, unit, values, n, {key: np.repeat(values, n)}) for key, name, unit, values in grids]


def _columns(parts: Sequence[_Part], defaults: Mapping[str, float]) -> dict[str, Float[np.ndarray, " runs"]]:
    """Returns arrays over all runs of the parts: what a part changes, and else the defaults."""
    return {
        name: np.concatenate([part.changes.get(name, np.full(part.runs, value)) for part in parts])
        for name, value in defaults.items()
    }


def _with_plants(rig: Rig, parts: Sequence[_Part]) -> Rig:
    """Returns the rig with the plant of each run."""
    nominal = {name: float(parameter(rig.plant, name)) for name in _varied(rig.plant)}
    return dataclasses.replace(rig, plant=with_parameters(rig.plant, _columns(parts, nominal)))


def _with_benches(rig: Rig, parts: Sequence[_Part], settings: RobustnessConfig) -> Rig:
    """Returns the rig with the noise, the drive and the pushes of each run.

    A lag of 0 is one far below the step, which has the same effect.
    """
    drive = Drive() if rig.drive is None else rig.drive
    sensors = StateSensors() if rig.sensors is None else rig.sensors
    least = 1e-6 * settings.dt
    own = {"measurement": 0.0, "voltage": float(drive.noise), "delay": float(drive.delay), "pushes": 0.0}
    found = _columns(parts, {**own, "lag": least if drive.lag is None else float(drive.lag)})
    noise = found["measurement"]
    changes: dict[str, Any] = {}
    if not isinstance(sensors, StateSensors):
        for name, usual_step in _USUAL_STEPS.items():
            step = float(getattr(sensors, f"{name}_step", usual_step))
            changes[f"{name}_noise"] = np.hypot(noise * step, float(getattr(sensors, f"{name}_noise")))
    else:
        # The cart's rate is noisy by as much at the distance of the pole's centre of mass.
        length = float(rig.plant.pole_length)
        changes["theta_dot_noise"] = np.hypot(noise, float(sensors.theta_dot_noise))
        changes["x_dot_noise"] = np.hypot(noise * length, float(sensors.x_dot_noise))
    sensors = dataclasses.replace(sensors, **changes)
    last = 0.75 * duration_of(rig, settings.dt)
    force = found["pushes"]
    pushes = RandomPushes(every=last / 3.0, cart=force, pole=force, until=last)
    disturbance = dataclasses.replace(Disturbance() if rig.disturbance is None else rig.disturbance, pushes=pushes)
    lag = np.maximum(found["lag"], least)
    drive = dataclasses.replace(drive, noise=found["voltage"], lag=lag, delay=found["delay"])
    return dataclasses.replace(rig, sensors=sensors, drive=drive, disturbance=disturbance)


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


def _tiled(starts: State, times: int) -> State:
    return jax.tree.map(lambda column: np.tile(column, times), starts)
