"""What settling faster costs: trade-off fronts of a design, traced by gradients, and by random search for comparison.

Every point is a hybrid controller. Random candidates, judged by values, are where the search begins. Then many tunings
go side by side under one `vmap`: each minimises the time outside the target while one cost stays below a bound, for a
ladder of bounds, every cost, and every supply (epsilon constraints, Haimes and others, 1971). Now and then all are
judged by the protocol's metrics, and each goes on from the fastest controller met so far that keeps to its bound. Of
all that were judged, those that no other beats are the front. The random search draws candidates until it has simulated
as many Runge-Kutta steps, a gradient's counted as the measured multiple of a value's.
"""

import dataclasses
import functools
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
from cpjax.tune.objective import Effort, Jerkiness, Unfinished
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

_SCREEN, _BATCH, _JUDGE, _SEMIFINAL, _FINAL, _CANDIDATES = range(6)  # what random numbers are for


@dataclasses.dataclass(frozen=True)
class FrontPlan:
    """How fronts are traced.

    Attributes:
      seed: of everything random. Starts are never those that a seed names for `cpjax.sample_starts`.
      bounds: of the ladder, for each cost and supply; from `lowest` times the least cost among the candidates
        geometrically to the cost of the fastest; and one more tuning without a bound.
      lowest: see there.
      penalty: what a cost of twice its bound counts [s].
      candidates: random controllers to begin with.
      screening: starts by which they are judged.
      steps: of the optimiser.
      batch: starts of a step.
      learning_rate: Adam's.
      duration: of the tunings' rollouts [s].
      dt: their step [s].
      spare_rate: steps beyond those in each second, for crossings [1/s].
      width: of the target [rad and m].
      judge_every: steps after which all controllers are judged, and exchanged.
      judging: starts by which they are.
      semifinal: starts by which the best of a front are compared once more: who was lucky with few is not with many.
      final: unseen starts that the points of a front are measured from.
      horizon: of all runs that judge [s].
      judging_dt: step and control period of screening and judging [s].
      final_dt: of semifinal and final [s].
      success: share of the starts that a point must settle from in both.
    """

    seed: int = 1
    bounds: int = 31
    lowest: float = 0.85
    penalty: float = 10.0
    candidates: int = 4096
    screening: int = 16
    steps: int = 100
    batch: int = 8
    learning_rate: float = 0.04
    duration: float = 8.0
    dt: float = 0.02
    spare_rate: float = 20.0
    width: float = 0.05
    judge_every: int = 10
    judging: int = 96
    semifinal: int = 256
    final: int = 1024
    horizon: float = 20.0
    judging_dt: float = 0.004
    final_dt: float = 0.002
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
        if self.lowest >= 1.0:
            raise InputError("lowest", self.lowest, "above 0 and below 1")
        if self.success > 1.0:
            raise InputError("success", self.success, "above 0 and at most 1")


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
      bland: (supply, cost) to the bland start's settling time and cost (2,), at the plant's own supply where it settles
        from no start; 1.1 times as much is the hypervolumes' reference.
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


@pytree
class BoundedTime:
    """The time outside the target [s], and `penalty` times what each cost exceeds its bound by, relative to it."""

    terms: tuple[Any, ...]
    """The time, the costs, and the time that a stopped run left undone."""
    bounds: tuple[Any, ...]
    penalty: Any

    def init(self, sample: Sample) -> tuple[Any, ...]:
        return tuple(term.init(sample) for term in self.terms)

    def update(self, memory: tuple[Any, ...], sample: Sample) -> tuple[Any, ...]:
        return tuple(term.update(m, sample) for term, m in zip(self.terms, memory, strict=True))

    def finish(self, memory: tuple[Any, ...], last: Sample) -> jax.Array:
        time, *costs, undone = (term.finish(m, last) for term, m in zip(self.terms, memory, strict=True))
        excess = sum(jnp.maximum(cost / bound - 1.0, 0.0) for cost, bound in zip(costs, self.bounds, strict=True))
        return time + undone * (1.0 + self.penalty) + self.penalty * excess


class _Lanes(NamedTuple):
    """What one tuning of many minimises, and on what."""

    bounds: jax.Array
    """Of each of `COSTS`; infinite for all but one."""
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
        self.plant, self.design, self.plan = plant, design, plan
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

    def draw(self, supply: float, count: int, purpose: int) -> Numbers:
        """Random candidates (count, d), from ranges that suit the supply."""
        random = np.random.default_rng([self.plan.seed, _CANDIDATES, purpose])
        free = free_parameters(beginning("bland", self.design, self.supplied(supply)))
        return free.draw(random, count).astype(self.free.start().dtype)

    def judge(self, vectors: Numbers, supply: float, count: int, purpose: int) -> _Judged:
        """Controllers (n, d) by the protocol's metrics from so many starts, all the same."""
        plan = self.plan
        starts = _starts(plan, count, purpose)
        controllers, plant = self._controllers(vectors, supply), self.supplied(supply)
        dt = plan.final_dt if purpose in (_SEMIFINAL, _FINAL) else plan.judging_dt
        runs = len(vectors) * count
        parts = []
        for begin in range(0, runs, _PIECE):
            which, start = np.divmod(np.minimum(np.arange(begin, begin + _PIECE), runs - 1), count)
            metrics: Metrics = sweep(
                plant,
                jax.tree.map(operator.itemgetter(which), controllers),
                jax.tree.map(operator.itemgetter(start), starts),
                duration=plan.horizon,
                dt=dt,
                clock="sampled",
            )
            parts.append(jax.tree.map(np.asarray, metrics))
        self.value_steps += runs * round(plan.horizon / dt)
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

        def points(judged: _Judged, success: float) -> Numbers:
            found = np.stack([judged.time, judged.costs[:, column]], axis=1)
            found[judged.success < success] = np.inf
            return found

        chosen = met.vectors[_layers(points(met, 1.0), 3 * self.plan.bounds)]
        for count, purpose in ((self.plan.semifinal, _SEMIFINAL), (self.plan.final, _FINAL)):
            judged = self.judge(chosen, supply, count, purpose)
            found = points(judged, self.plan.success)
            kept = nondominated(found)
            chosen = chosen[kept]
            if not len(kept):
                break
        return Front(found[kept], judged.success[kept], chosen, hypervolume(found[kept], reference))

    def trace(self, begun: dict[float, _Judged], fronts: list[tuple[float, str]], report: Report) -> Any:
        """All controllers met, by supply: what `begun` has, and all that were judged on the way."""
        plan = self.plan
        jobs = [(supply, cost, bound) for supply, cost in fronts for bound in _ladder(begun[supply], cost, plan)]
        # Every device has as many tunings: the last is done more than once if need be.
        jobs += [jobs[-1]] * (-len(jobs) % len(jax.devices()))
        bounds = np.full((len(jobs), len(COSTS)), np.inf)
        for row, (_, cost, bound) in enumerate(jobs):
            bounds[row, COSTS.index(cost)] = bound
        supplies = np.array([supply for supply, _, _ in jobs])
        vectors = jnp.asarray(np.stack([_fastest(begun[supply], cost, bound)[0] for supply, cost, bound in jobs]))
        lanes = _Lanes(jnp.asarray(bounds, vectors.dtype), jnp.asarray(supplies, vectors.dtype))
        state = self.optimiser.init(vectors)
        met = dict(begun)
        for step in range(plan.steps):
            slope = self.gradient(vectors, lanes, _starts(plan, plan.batch, _BATCH, step))
            with jax.numpy_dtype_promotion("standard"):  # optax's own arithmetic mixes dtypes
                change, state = self.optimiser.update(slope, state)
                moved = optax.apply_updates(vectors, change)
            vectors = jnp.where(jnp.isfinite(moved), moved, vectors)
            if (step + 1) % plan.judge_every == 0 or step + 1 == plan.steps:
                times = np.full(len(jobs), np.inf)
                for supply in met:
                    rows = np.flatnonzero(supplies == supply)
                    judged = self.judge(np.asarray(vectors)[rows], supply, plan.judging, _JUDGE)
                    met[supply] = _together([met[supply], judged])
                    kept = (judged.success == 1.0) & np.all(judged.costs <= bounds[rows], axis=1)
                    times[rows] = np.where(kept, judged.time, np.inf)
                better = [_fastest(met[supply], cost, bound) for supply, cost, bound in jobs]
                jump = np.array([time < 0.98 * now for (_, time), now in zip(better, times, strict=True)])
                vectors = jnp.where(jump[:, None], np.stack([vector for vector, _ in better]), vectors)
                state = jax.tree.map(functools.partial(_forgotten, rows=jump), state)
            report(step + 1, plan.steps, f"{len(jobs)} tunings side by side")
        return met

    def gradient_steps(self, lanes: int) -> int:
        """Runge-Kutta steps of all gradients."""
        plan = self.plan
        return plan.steps * lanes * (plan.bounds + 1) * plan.batch * (round(plan.duration / plan.dt) + self.spare)

    def begin(self, supply: float, count: int, purpose: int) -> _Judged:
        """The bland start and random candidates; the better ones of each front judged on more starts."""
        drawn = np.concatenate([np.asarray(self.free.start())[None], self.draw(supply, count, purpose)])
        screened = self.judge(drawn, supply, self.plan.screening, _SCREEN)
        least_failing = screened.success >= np.max(screened.success)
        better: set[int] = {0}
        for column in range(len(COSTS)):
            points = np.stack([screened.time, screened.costs[:, column]], axis=1)
            points[~least_failing] = np.inf
            better.update(map(int, _layers(points, 4 * self.plan.bounds)))
        return self.judge(screened.vectors[sorted(better)], supply, self.plan.judging, _JUDGE)

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
        fold = BoundedTime(terms, tuple(lane.bounds), plan.penalty)

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
    wanted = [(own, cost) for cost in COSTS] + [(supply, "effort") for supply in others]
    bland: dict[tuple[float, str], Numbers] = {}
    for supply, cost in wanted:
        judged = tracer.bland(supply)
        point = np.array([judged.time[0], judged.costs[0, COSTS.index(cost)]])
        bland[supply, cost] = point if np.all(np.isfinite(point)) else bland[own, cost]  # it never settles
    report(0, plan.steps, "screening candidates")
    tracer.value_steps = 0
    begun = {supply: tracer.begin(supply, plan.candidates, 0) for supply in (own, *others)}
    met = tracer.trace(begun, wanted, report)
    values, gradients = tracer.value_steps, tracer.gradient_steps(len(wanted))
    report(plan.steps, plan.steps, "random search of the same cost")
    share = (values + GRADIENT_STEP * gradients) / (1 + len(others))
    each = plan.screening * round(plan.horizon / plan.judging_dt)
    tracer.value_steps = 0
    drawn = {supply: tracer.begin(supply, int(share / each), 1) for supply in (own, *others)}
    searched = tracer.value_steps

    def fronts(found: dict[float, _Judged]) -> dict[tuple[float, str], Front]:
        return {lane: tracer.front(found[lane[0]], *lane, 1.1 * bland[lane]) for lane in wanted}

    steps = {"values": values, "gradients": gradients, "random": searched}
    return Fronts(fronts(met), fronts(drawn), bland, steps)


def _starts(plan: FrontPlan, count: int, purpose: int, step: int = 0) -> State:
    """Starts that no person's seed names."""
    seed = 2**33 + int(np.random.SeedSequence([plan.seed, purpose, step]).generate_state(1)[0])
    return sample_starts("hanging", count, seed=seed, dtype=np.dtype(jnp.result_type(float)))


def _ladder(judged: _Judged, cost: str, plan: FrontPlan) -> Numbers:
    """Bounds of a cost (bounds + 1,)."""
    column = judged.costs[:, COSTS.index(cost)]
    good = (judged.success == np.max(judged.success)) & np.isfinite(judged.time)
    if not np.any(good):
        return np.full(plan.bounds + 1, np.inf)
    fastest = column[good][np.argmin(judged.time[good])]
    return np.append(np.geomspace(plan.lowest * np.min(column[good]), fastest, plan.bounds), np.inf)


def _fastest(judged: _Judged, cost: str, bound: float) -> tuple[Numbers, float]:
    """The fastest controller that keeps to the bound, and its time; if there is none, the cheapest, and infinity. Of
    those that never fail, or fail least.
    """
    column = judged.costs[:, COSTS.index(cost)]
    good = judged.success == np.max(judged.success)
    kept = good & (column <= bound) & np.isfinite(judged.time)
    if np.any(kept):
        best = int(np.argmin(np.where(kept, judged.time, np.inf)))
        return judged.vectors[best], float(judged.time[best])
    return judged.vectors[int(np.argmin(np.where(good, column, np.inf)))], math.inf


def _forgotten(leaf: jax.Array, rows: Numbers) -> jax.Array:
    """An optimiser's memory without that of some rows."""
    return jnp.where(rows[:, None], 0.0, leaf).astype(leaf.dtype) if leaf.ndim == 2 else leaf


def _layers(points: Numbers, least: int) -> Numbers:
    """Indices of the points (n, 2) that no other beats, then of those that only they beat, and so on, until there are
    `least` or no more that are finite; the first point if none is.
    """
    left, chosen = np.array(points), np.zeros(0, int)
    while len(chosen) < least and len(layer := nondominated(left)):
        chosen = np.concatenate([chosen, layer])
        left[layer] = np.inf
    return chosen if len(chosen) else np.zeros(1, int)


def _together(parts: list[_Judged]) -> _Judged:
    return _Judged(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
