"""What settling faster costs: trade-off fronts of a design, traced by gradients, and by random search for comparison.

Every point is a hybrid controller. Random candidates, judged by values, are where the search begins. Then many tunings
go side by side under one `vmap`: each minimises the time outside the target plus a weight times one cost, for a ladder
of weights, every cost, and every supply. All controllers met on the way are judged by the protocol's metrics; those
that no other beats are the front. The random search draws candidates until it has simulated as many Runge-Kutta steps,
a gradient's counted as the measured multiple of a value's.
"""

import dataclasses
import math
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, PartitionSpec

from cpjax import paper
from cpjax.controllers import EnergySwingUp, Hybrid
from cpjax.errors import InputError
from cpjax.numeric.extremes import larger
from cpjax.numeric.pareto import hypervolume, nondominated
from cpjax.plant import CartPole
from cpjax.pytree import pytree
from cpjax.sim.metrics import Metrics, Sample, TimeOutside
from cpjax.sim.rollout import measure
from cpjax.sim.sweep import sweep
from cpjax.starts import sample_starts
from cpjax.state import State
from cpjax.tune.objective import Effort, Jerkiness, Unfinished, WeightedSum
from cpjax.tune.parameters import FreeParameters, free_parameters
from cpjax.tune.starting import beginning

Numbers = np.ndarray[Any, Any]
Report = Callable[[int, int, str], None]

COSTS = ("effort", "cart_travel", "voltage_variation")
"""Of `Metrics`, against the settling time."""

GRADIENT_STEP = 36.0
"""Steps of the fastest values that take as long as one of a gradient with located switching
(`experiments/tuner_cost.py`)."""

_PIECE, _CONTROLLERS = 2048, 64
"""Runs, and controllers that are designed, at a time: always as many, so that both are compiled once."""

_SCREEN, _BATCH, _JUDGE, _FINAL, _CANDIDATES = range(5)  # what random numbers are for


@dataclasses.dataclass(frozen=True)
class FrontPlan:
    """How fronts are traced.

    Attributes:
      seed: of everything random. Starts are never those that a seed names for `cpjax.sample_starts`.
      weights: of the ladder, for each cost and supply.
      lowest: the ladder's first weight, in settling times per cost of the bland start; they rise geometrically.
      highest: its last.
      candidates: random controllers to begin with.
      screening: starts by which they are judged.
      steps: of the optimiser.
      batch: starts of a step.
      learning_rate: Adam's.
      duration: of the tunings' rollouts [s].
      dt: their step [s].
      spare_rate: steps beyond those in each second, for crossings [1/s].
      width: of the target [rad and m].
      judge_every: steps after which all controllers are judged.
      judging: starts by which they are.
      final: starts that the points of a front are measured from.
      horizon: of judging and of the last measurement [s].
      horizon_dt: step and control period there [s].
      success: share of the last starts that a point must settle from.
    """

    seed: int = 1
    weights: int = 24
    lowest: float = 0.02
    highest: float = 20.0
    candidates: int = 2048
    screening: int = 16
    steps: int = 80
    batch: int = 8
    learning_rate: float = 0.04
    duration: float = 5.0
    dt: float = 0.02
    spare_rate: float = 20.0
    width: float = 0.05
    judge_every: int = 8
    judging: int = 64
    final: int = 1024
    horizon: float = 10.0
    horizon_dt: float = 0.002
    success: float = 0.99

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.type in (int, "int"):
                least = 0 if field.name in ("seed", "steps") else 1
                if isinstance(value, bool) or not isinstance(value, int) or value < least:
                    raise InputError(field.name, value, f"a whole number, at least {least}")
            elif isinstance(value, (bool, str)) or not 0.0 < value < math.inf:
                raise InputError(field.name, value, "a finite number above 0")
        if not self.lowest < self.highest:
            raise InputError("highest", self.highest, f"above lowest, {self.lowest}")
        if self.success > 1.0:
            raise InputError("success", self.success, "above 0 and at most 1")

    def ladder(self) -> Numbers:
        """The weights (weights,), in settling times per cost of the bland start."""
        return np.geomspace(self.lowest, self.highest, self.weights)


@dataclasses.dataclass(frozen=True)
class Front:
    """Of one cost, one supply and one way to search.

    Attributes:
      points: mean settling time [s] and mean cost (n, 2), over the successes among the last starts; by rising time.
      success: share of those starts (n,).
      vectors: the controllers' free parameters (n, d).
      volume: the hypervolume up to the reference.
    """

    points: Numbers
    success: Numbers
    vectors: Numbers
    volume: float


@dataclasses.dataclass(frozen=True)
class Fronts:
    """Of one design.

    Attributes:
      traced: by gradients: (supply [V], cost) to front.
      random: by random search, likewise.
      bland: (supply, cost) to the bland start's settling time and cost (2,).
      steps: Runge-Kutta steps of values and of gradients that the tracing took, and the values of the random search.
    """

    traced: dict[tuple[float, str], Front]
    random: dict[tuple[float, str], Front]
    bland: dict[tuple[float, str], Numbers]
    steps: dict[str, int]


@pytree
class Travel:
    """max |x| [m]."""

    def init(self, sample: Sample) -> jax.Array:
        return jnp.zeros_like(sample.time)

    def update(self, memory: jax.Array, sample: Sample) -> jax.Array:
        return larger(memory, jnp.abs(sample.state.x))

    def finish(self, memory: jax.Array, last: Sample) -> jax.Array:
        return memory


class _Lanes(NamedTuple):
    """What one tuning of many minimises, and on what."""

    weights: jax.Array
    """Of each of `COSTS` [s per unit]."""
    supply: jax.Array
    """[V]."""


class _Judged(NamedTuple):
    """Controllers and what they were found to be worth: arrays with a leading axis of their number."""

    vectors: Numbers
    success: Numbers
    time: Numbers
    costs: Numbers
    """(n, number of `COSTS`)."""


class _Tracer:
    """One design's search."""

    def __init__(self, plant: CartPole, design: paper.Design, plan: FrontPlan) -> None:
        self.plant, self.plan = plant, plan
        self.free = free_parameters(beginning("bland", design, plant))
        self.optimiser = optax.adam(optax.cosine_decay_schedule(plan.learning_rate, max(1, plan.steps), 0.1))
        self.spare = math.ceil(plan.spare_rate * plan.duration)
        mesh = Mesh(np.array(jax.devices()), ("lanes",))
        lanes: Any = PartitionSpec("lanes")  # type: ignore[no-untyped-call]  # untyped in JAX
        same: Any = PartitionSpec()  # type: ignore[no-untyped-call]
        each = jax.vmap(self._gradient, in_axes=(0, 0, None))
        self.gradient = jax.jit(
            jax.shard_map(each, mesh=mesh, check_vma=False, in_specs=(lanes, lanes, same), out_specs=lanes)
        )
        self.built = jax.jit(jax.vmap(self._build))
        self.value_steps = 0

    def supplied(self, supply: Any) -> CartPole:
        """The plant at a supply [V]."""
        return dataclasses.replace(self.plant, motor=dataclasses.replace(self.plant.motor, voltage_limit=supply))

    def draw(self, count: int, purpose: int) -> Numbers:
        """Random candidates (count, d)."""
        random = np.random.default_rng([self.plan.seed, _CANDIDATES, purpose])
        return self.free.draw(random, count).astype(self.free.start().dtype)

    def judge(self, vectors: Numbers, supply: float, count: int, purpose: int) -> _Judged:
        """Controllers (n, d) by the protocol's metrics from so many starts, all the same."""
        plan = self.plan
        starts = _starts(plan, count, purpose)
        controllers, plant = self._controllers(vectors, supply), self.supplied(supply)
        runs = len(vectors) * count
        parts = []
        for begin in range(0, runs, _PIECE):
            which, start = np.divmod(np.minimum(np.arange(begin, begin + _PIECE), runs - 1), count)
            metrics: Metrics = sweep(
                plant,
                jax.tree.map(operator.itemgetter(which), controllers),
                jax.tree.map(operator.itemgetter(start), starts),
                duration=plan.horizon,
                dt=plan.horizon_dt,
                clock="sampled",
            )
            parts.append(jax.tree.map(np.asarray, metrics))
        self.value_steps += runs * round(plan.horizon / plan.horizon_dt)
        table = jax.tree.map(lambda *c: np.concatenate(c)[:runs].astype(float).reshape(-1, count), *parts)
        good = table.success > 0.0
        total = np.sum(good, axis=1)

        def mean(column: Numbers) -> Numbers:
            summed = np.sum(np.where(good, column, 0.0), axis=1)
            return np.where(total > 0, summed / np.maximum(total, 1), np.inf)

        costs = np.stack([mean(getattr(table, cost)) for cost in COSTS], axis=1)
        return _Judged(vectors, total / count, mean(table.settling_time), costs)

    def bland(self, supply: float) -> _Judged:
        """The bland start."""
        return self.judge(np.asarray(self.free.start())[None], supply, self.plan.final, _FINAL)

    def front(self, met: _Judged, supply: float, cost: str, reference: Numbers) -> Front:
        """Of all controllers met, those that no other beats, measured once more from unseen starts."""
        column = COSTS.index(cost)
        points = np.stack([met.time, met.costs[:, column]], axis=1)
        points[met.success < 1.0] = np.inf
        chosen = nondominated(points)
        final = self.judge(met.vectors[chosen], supply, self.plan.final, _FINAL) if len(chosen) else None
        if final is None:
            nothing = np.zeros((0, 2)), np.zeros(0), met.vectors[:0]
            return Front(*nothing, volume=0.0)
        points = np.stack([final.time, final.costs[:, column]], axis=1)
        points[final.success < self.plan.success] = np.inf
        kept = nondominated(points)
        return Front(points[kept], final.success[kept], final.vectors[kept], hypervolume(points, reference))

    def trace(self, begun: dict[float, _Judged], lanes: list[tuple[float, str]], scales: Any, report: Report) -> Any:
        """All controllers met, by supply: what `begun` has, and all that were judged on the way."""
        plan = self.plan
        ladder = plan.ladder()
        jobs = [(supply, cost, weight * scales[supply, cost]) for supply, cost in lanes for weight in ladder]
        # Every device has as many tunings: the last is done more than once if need be.
        jobs += [jobs[-1]] * (-len(jobs) % len(jax.devices()))
        weights = np.zeros((len(jobs), len(COSTS)))
        for row, (_, cost, weight) in enumerate(jobs):
            weights[row, COSTS.index(cost)] = weight
        supplies = np.array([supply for supply, _, _ in jobs])
        vectors = jnp.asarray(np.stack([_best(begun[supply], cost, weight) for supply, cost, weight in jobs]))
        arguments = _Lanes(jnp.asarray(weights, vectors.dtype), jnp.asarray(supplies, vectors.dtype))
        state = self.optimiser.init(vectors)
        met = {supply: [judged] for supply, judged in begun.items()}
        for step in range(plan.steps):
            starts = _starts(plan, plan.batch, _BATCH, step)
            slope = self.gradient(vectors, arguments, starts)
            with jax.numpy_dtype_promotion("standard"):  # optax's own arithmetic mixes dtypes
                change, state = self.optimiser.update(slope, state)
                moved = optax.apply_updates(vectors, change)
            vectors = jnp.where(jnp.isfinite(moved), moved, vectors)
            if (step + 1) % plan.judge_every == 0 or step + 1 == plan.steps:
                for supply in met:
                    met[supply].append(
                        self.judge(np.asarray(vectors)[supplies == supply], supply, plan.judging, _JUDGE)
                    )
            report(step + 1, plan.steps, f"{len(jobs)} tunings side by side")
        return {supply: _together(found) for supply, found in met.items()}

    def gradient_steps(self, lanes: int) -> int:
        """Runge-Kutta steps of all gradients."""
        plan = self.plan
        return plan.steps * lanes * plan.weights * plan.batch * (round(plan.duration / plan.dt) + self.spare)

    def begin(self, supply: float, count: int, purpose: int) -> _Judged:
        """The bland start and random candidates; the better ones of each front judged on more starts."""
        drawn = np.concatenate([np.asarray(self.free.start())[None], self.draw(count, purpose)])
        screened = self.judge(drawn, supply, self.plan.screening, _SCREEN)
        better = _layers(screened, 4 * self.plan.weights)
        return self.judge(screened.vectors[better], supply, self.plan.judging, _JUDGE)

    def _build(self, vector: jax.Array, supply: jax.Array) -> Hybrid:
        return self._supplied(supply).build(vector)

    def _supplied(self, supply: jax.Array) -> FreeParameters:
        controller = self.free.controller
        law = controller.swing_up
        assert isinstance(law, EnergySwingUp)
        law = dataclasses.replace(law, model=self.supplied(supply))
        return dataclasses.replace(self.free, controller=dataclasses.replace(controller, swing_up=law))

    def _controllers(self, vectors: Numbers, supply: float) -> Hybrid:
        parts = []
        for begin in range(0, len(vectors), _CONTROLLERS):
            members = np.minimum(np.arange(begin, begin + _CONTROLLERS), len(vectors) - 1)
            built = self.built(jnp.asarray(vectors[members]), jnp.full(_CONTROLLERS, supply, vectors.dtype))
            parts.append(jax.tree.map(np.asarray, built))
        joined: Hybrid = jax.tree.map(lambda *columns: np.concatenate(columns)[: len(vectors)], *parts)
        return joined

    def _gradient(self, vector: jax.Array, lane: _Lanes, starts: State) -> jax.Array:
        """Of the mean over the starts, no start's sensitivity drowning the others'."""
        plan, plant = self.plan, self.supplied(lane.supply)
        free = self._supplied(lane.supply)
        terms = (TimeOutside(plan.width, plan.width), Effort(), Travel(), Jerkiness(), Unfinished(plan.duration))
        worst = 1.0 + lane.weights[0] * lane.supply * lane.supply
        fold = WeightedSum(terms, (1.0, lane.weights[0], lane.weights[1], lane.weights[2], worst))

        def objective(vector: jax.Array, start: State) -> jax.Array:
            value: jax.Array = measure(
                plant,
                free.build(vector),
                start,
                duration=plan.duration,
                dt=plan.dt,
                switching="located",
                spare_steps=self.spare,
                metrics=fold,
            )
            return value

        slopes = jax.vmap(jax.grad(objective), in_axes=(None, 0))(vector, starts)
        slopes = jnp.where(jnp.all(jnp.isfinite(slopes), axis=1)[:, None], slopes, 0.0)
        norms = jnp.sqrt(jnp.sum(slopes * slopes, axis=1))
        most = 2.0 * jnp.median(norms)
        shortened = jnp.minimum(1.0, most / jnp.maximum(norms, float(np.finfo(norms.dtype).tiny)))
        return jnp.mean(shortened[:, None] * slopes, axis=0)


def trace_fronts(
    plant: CartPole, design: paper.Design, plan: FrontPlan, *, supplies: tuple[float, ...] = (), report: Report
) -> Fronts:
    """The fronts of settling time against every cost at the plant's own supply, and against effort at others.

    Args:
      supplies: further voltage limits [V].
      report: called with the steps done, their number, and what they are.
    """
    own = float(plant.motor.voltage_limit)
    if not math.isfinite(own):
        raise InputError("plant.motor.voltage_limit", own, "a finite number: effort is measured by it")
    tracer = _Tracer(plant, design, plan)
    others = [supply for supply in dict.fromkeys(map(float, supplies)) if supply != own]
    lanes = [(own, cost) for cost in COSTS] + [(supply, "effort") for supply in others]
    bland, scales = {}, {}
    for supply in (own, *others):
        judged = tracer.bland(supply)
        for cost in (cost for at, cost in lanes if at == supply):
            point = np.array([judged.time[0], judged.costs[0, COSTS.index(cost)]])
            bland[supply, cost] = point
            scales[supply, cost] = point[0] / point[1] if np.all(np.isfinite(point)) else 1.0
    report(0, plan.steps, "screening candidates")
    tracer.value_steps = 0
    begun = {supply: tracer.begin(supply, plan.candidates, 0) for supply in (own, *others)}
    met = tracer.trace(begun, lanes, scales, report)
    values, gradients = tracer.value_steps, tracer.gradient_steps(len(lanes))
    report(plan.steps, plan.steps, "random search of the same cost")
    share = (values + GRADIENT_STEP * gradients) / (1 + len(others))
    each = plan.screening * round(plan.horizon / plan.horizon_dt)
    tracer.value_steps = 0
    drawn = {supply: tracer.begin(supply, int(share / each), 1) for supply in (own, *others)}
    searched = tracer.value_steps

    def fronts(found: dict[float, _Judged]) -> dict[tuple[float, str], Front]:
        return {lane: tracer.front(found[lane[0]], *lane, 1.1 * bland[lane]) for lane in lanes}

    steps = {"values": values, "gradients": gradients, "random": searched}
    return Fronts(fronts(met), fronts(drawn), bland, steps)


def _starts(plan: FrontPlan, count: int, purpose: int, step: int = 0) -> State:
    """Starts that no person's seed names."""
    seed = 2**33 + int(np.random.SeedSequence([plan.seed, purpose, step]).generate_state(1)[0])
    return sample_starts("hanging", count, seed=seed, dtype=np.dtype(jnp.result_type(float)))


def _best(judged: _Judged, cost: str, weight: float) -> Numbers:
    """The controller with the least weighted sum, of those that never fail if there are any."""
    score = judged.time + weight * judged.costs[:, COSTS.index(cost)]
    score = np.where(judged.success >= np.max(judged.success), score, np.inf)
    found: Numbers = judged.vectors[int(np.argmin(score))]
    return found


def _layers(judged: _Judged, least: int) -> Numbers:
    """Indices of the controllers that no other beats in some cost, then of those that only they beat, and so on, until
    there are `least` for each cost or no more that never fail; and the first controller in any case.
    """
    chosen = {0}
    for column in range(len(COSTS)):
        points = np.stack([judged.time, judged.costs[:, column]], axis=1)
        points[judged.success < np.max(judged.success)] = np.inf
        taken = 0
        while taken < least and len(layer := nondominated(points)):
            chosen.update(map(int, layer))
            taken += len(layer)
            points[layer] = np.inf
    return np.array(sorted(chosen), int)


def _together(parts: list[_Judged]) -> _Judged:
    return _Judged(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
