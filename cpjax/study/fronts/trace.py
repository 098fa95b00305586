"""Trade-off fronts between settling time and a cost: traced by gradients, and by random search for comparison.

Every point is a hybrid controller. The search begins with random candidates, evaluated by values. Then many tunings run
in parallel under one `vmap`: each minimises the time outside the target while the mean of one cost stays below a bound,
for a grid of bounds, every cost, and every supply (epsilon constraints, Haimes and others, 1971). A multiplier rises
while the cost exceeds its bound and falls while it does not (Arrow, Hurwicz and Uzawa, 1958). At intervals all are
evaluated by the protocol's metrics, and each continues from the fastest controller of the archive within its bound. The
non-dominated controllers of the archive are the front. The random search draws candidates until it has simulated as
many Runge-Kutta steps at each supply, where a gradient's step counts as the measured multiple of a value's.

The multiplier and the evaluation use different means: a multiplier follows the mean cost of a few initial states over a
short run, on the continuous clock and failures included; a bound applies to the protocol's mean over the successes.
"""

import dataclasses
import functools
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Shaped

from cpjax.controllers import DesignName
from cpjax.numeric.pareto import hypervolume, nondominated
from cpjax.numeric.selection import where
from cpjax.plant import CartPole
from cpjax.plant.state import State
from cpjax.rig import Rig, plant_of
from cpjax.sim.metrics import TimeOutside
from cpjax.sim.rollout import measure
from cpjax.study.fronts.cache import Search, load_or_run
from cpjax.study.fronts.config import COSTS, FrontConfig, Objective
from cpjax.study.fronts.evaluator import (
    BATCH,
    EVALUATION,
    EXPLORE,
    FINAL,
    REEVALUATION,
    Evaluated,
    Evaluator,
    concatenate,
    nondominated_sort,
)
from cpjax.study.fronts.reference_point import Point, objectives
from cpjax.tune import descent
from cpjax.tune.objective import Effort, Lagrangian, RemainingTime, Travel, VoltageVariation
from cpjax.tune.parameters import Vector
from cpjax.workspace import Workspace

Report = Callable[[int, int, str], None]
GRADIENT_STEP = 60.0
"""Steps of values on the fastest path that take as long as one gradient step here (`experiments/tuner_cost.py`)."""

METRICS: Mapping[str, Any] = {"effort": Effort(), "cart_travel": Travel(), "voltage_variation": VoltageVariation()}
"""Differentiable metric for each of `COSTS`."""


@dataclasses.dataclass(frozen=True)
class Front:
    """Front of one cost and one supply, from one kind of search.

    Attributes:
      points: mean settling time [s] and mean cost over the successes of the final evaluation; by rising time.
      success: share of the final evaluation's initial states that each settles from.
      vectors: the controllers' free parameters, unconstrained.
      volume: hypervolume up to the reference point.
      best_success: the largest share of the re-evaluation's initial states that any controller settles from.
    """

    points: Float[np.ndarray, "points 2"]
    success: Float[np.ndarray, " points"]
    vectors: Float[np.ndarray, "points parameters"]
    volume: float
    best_success: float


@dataclasses.dataclass(frozen=True)
class Fronts:
    """Fronts of one design.

    Attributes:
      traced: fronts found by gradients, by (supply [V], cost).
      random: fronts found by random search, likewise.
      steps: for each supply [V] the Runge-Kutta steps of values ("values") and of gradients ("gradients") of the search
        by gradients, and those of the random search ("random").
      seconds: wall time, with that of cached searches [s].
    """

    traced: dict[Objective, Front]
    random: dict[Objective, Front]
    steps: dict[float, dict[str, int]]
    seconds: float


def trace_fronts(
    rig: CartPole | Rig,
    design: DesignName,
    plan: FrontConfig,
    reference: Mapping[Objective, Point],
    *,
    supplies: tuple[float, ...] = (),
    report: Report,
    memory: Workspace | None = None,
) -> Fronts:
    """Traces the fronts of settling time against every cost at the plant's own supply, and against effort at others.

    Args:
      rig: the plant, or a rig, of which plant and track count.
      design: "lqr" or "placement".
      plan: the configuration.
      reference: reference points of the hypervolumes by (supply, cost); see `reference_points`.
      supplies: further voltage limits [V].
      report: called with the parts done, their number, and the current part in words.
      memory: a workspace in which each of the two searches is saved when it is done. A call that finds one there does
        not repeat it.

    Raises:
      InputError: a plant without a voltage limit.
    """
    wanted = objectives(plant_of(rig), supplies)
    everywhere = list(dict.fromkeys(supply for supply, _ in wanted))
    parts = plan.steps + len(everywhere) + 2 * len(wanted)
    evaluator = Evaluator(rig, design, plan)

    def trace() -> Search:
        begin = time.perf_counter()
        evaluator.steps = Counter()
        report(0, parts, "screening candidates")
        begun = {supply: evaluator.begin(supply, plan.candidates, 0) for supply in everywhere}
        tracer = Tracer(evaluator, plan)
        archive = tracer.trace(begun, wanted, lambda done, text: report(done, parts, text))
        counts = {supply: len(one.vectors) for supply, one in begun.items()}
        return Search(archive, counts, evaluator.steps, tracer.steps, time.perf_counter() - begin)

    def draw() -> Search:
        # As much work for each supply as tracing; as many candidates are evaluated further, the rest is screening.
        begin = time.perf_counter()
        evaluator.steps = Counter()
        drawn = {}
        run = round(plan.horizon / plan.evaluation_dt)
        for number, supply in enumerate(everywhere):
            report(plan.steps + number, parts, f"random search of the same cost, {supply:g} V")
            budget = traced.values[supply] + GRADIENT_STEP * traced.gradients[supply]
            budget -= run * plan.evaluation * traced.begun[supply]
            drawn[supply] = evaluator.begin(supply, max(1, int(budget / (run * plan.screening))), 1)
        counts = {supply: len(one.vectors) for supply, one in drawn.items()}
        return Search(drawn, counts, evaluator.steps, dict.fromkeys(everywhere, 0), time.perf_counter() - begin)

    traced = load_or_run(memory, f"{design}-traced", trace)
    random = load_or_run(memory, f"{design}-random", draw)
    steps = {
        supply: {
            "values": traced.values[supply],
            "gradients": traced.gradients[supply],
            "random": random.values[supply],
        }
        for supply in everywhere
    }

    begin = time.perf_counter()
    fronts: list[dict[Objective, Front]] = []
    for which, found in enumerate((traced.archive, random.archive)):
        fronts.append({})
        for number, objective in enumerate(wanted):
            report(parts - (2 - which) * len(wanted) + number, parts, "measuring the points")
            fronts[-1][objective] = _front(evaluator, plan, found[objective[0]], *objective, reference[objective])
    report(parts, parts, "done")
    return Fronts(fronts[0], fronts[1], steps, traced.seconds + random.seconds + time.perf_counter() - begin)


def _front(
    evaluator: Evaluator, plan: FrontConfig, archive: Evaluated, supply: float, cost: str, reference: Point
) -> Front:
    """Returns the front of an archive, measured once more from unseen initial states."""
    # Few initial states do not resolve a failure rate of 1 %: those with a few failures are re-evaluated too.
    lenient = archive.threshold(1.0 - 3.0 * (1.0 - plan.success))
    chosen = np.unique(
        np.concatenate([nondominated_sort(archive.points(cost, share), 3 * plan.bounds) for share in (1.0, lenient)])
    )
    reevaluation = evaluator.evaluate(archive.vectors[chosen], supply, plan.reevaluation, REEVALUATION)
    chosen = chosen[nondominated_sort(reevaluation.points(cost, plan.success), plan.bounds)]
    final = evaluator.evaluate(archive.vectors[chosen], supply, plan.final, FINAL)
    points = final.points(cost, plan.success)
    kept = nondominated(points)
    return Front(
        points[kept],
        final.success[kept],
        final.vectors[kept],
        hypervolume(points[kept], reference),
        float(np.max(reevaluation.success)),
    )


class Aim(NamedTuple):
    """Objective of one tuning: multipliers and supply."""

    multipliers: Float[Array, "*tunings costs"]
    """Multiplier of each of `COSTS` [s per unit of the cost]; zero but for the one that has a finite bound."""
    supply: Float[Array, "*tunings"]
    """Voltage limit [V]."""


class Tracer:
    """Runs one design's tunings in parallel.

    Attributes:
      steps: Runge-Kutta steps of all gradients, by supply [V].
      steps_of_a_run: Runge-Kutta steps of one run.
      gradient: compiled map from free parameters (n, d), aims (n,) and initial states (m,) to gradients (n, d) and mean
        costs (n, number of `COSTS`).
    """

    def __init__(self, evaluator: Evaluator, plan: FrontConfig) -> None:
        self._evaluator, self._plan = evaluator, plan
        self.steps: Counter[float] = Counter()
        self._optimiser = optax.adam(optax.cosine_decay_schedule(plan.learning_rate, max(1, plan.steps), 0.1))
        self._spare = math.ceil(plan.spare_rate * plan.duration)
        self.steps_of_a_run = round(plan.duration / plan.dt) + self._spare
        mesh = Mesh(np.array(jax.devices()), ("tunings",))
        shared_out: Any = PartitionSpec("tunings")  # type: ignore[no-untyped-call]  # untyped in JAX
        self._placed = functools.partial(jax.device_put, device=NamedSharding(mesh, shared_out))
        same: Any = PartitionSpec()  # type: ignore[no-untyped-call]  # untyped in JAX
        each = jax.vmap(self._slope, in_axes=(0, 0, None))
        specs = {"in_specs": (shared_out, shared_out, same), "out_specs": shared_out}
        self.gradient = jax.jit(jax.shard_map(each, mesh=mesh, check_vma=False, **specs))

    def trace(
        self, begun: dict[float, Evaluated], fronts: list[Objective], report: Callable[[int, str], None]
    ) -> dict[float, Evaluated]:
        """Runs all tunings and returns the archive: the controllers of `begun` and all evaluated on the way, by supply.

        Args:
          begun: evaluated candidates, by supply [V].
          fronts: the pairs of supply [V] and cost that are traced.
          report: called with the steps done and the current work in words.
        """
        plan = self._plan
        jobs = [(supply, cost, bound) for supply, cost in fronts for bound in begun[supply].epsilon_grid(cost, plan)]
        # Every device runs the same number of tunings: the last one is repeated if necessary.
        jobs += [jobs[-1]] * (-len(jobs) % len(jax.devices()))
        bounds = np.full((len(jobs), len(COSTS)), np.inf)
        for row, (_, cost, bound) in enumerate(jobs):
            bounds[row, COSTS.index(cost)] = bound
        supplies = np.array([supply for supply, _, _ in jobs])
        ranks = [row % plan.initial_controllers for row in range(len(jobs))]
        first = [begun[job[0]].fastest(*job[1:], plan.success, rank)[0] for job, rank in zip(jobs, ranks, strict=True)]
        vectors = self._placed(np.stack(first))  # sharded as after a step, else the gradient is compiled twice
        multipliers = np.where(np.isfinite(bounds), plan.multiplier, 0.0)  # of costs in units of their bounds
        least, most = plan.multiplier / plan.multiplier_range, plan.multiplier * plan.multiplier_range
        state = self._optimiser.init(vectors)
        archive = dict(begun)
        random = np.random.default_rng([plan.seed, EXPLORE])
        for step in range(plan.steps):
            aims = Aim(jnp.asarray(multipliers / bounds, vectors.dtype), jnp.asarray(supplies, vectors.dtype))
            slope, spent = self.gradient(vectors, aims, self._evaluator.starts(plan.batch, BATCH, step))
            grown = multipliers * np.exp(plan.multiplier_rate * (np.asarray(spent) / bounds - 1.0))
            multipliers = np.where(multipliers > 0.0, np.clip(grown, least, most), 0.0)
            vectors, state = descent.step(self._optimiser, vectors, state, slope)
            each = plan.batch * self.steps_of_a_run
            self.steps.update({supply: each * int(np.sum(supplies == supply)) for supply in archive})
            if (step + 1) % plan.evaluate_every == 0 or step + 1 == plan.steps:
                times = np.full(len(jobs), np.inf)
                for supply in archive:
                    rows = np.flatnonzero(supplies == supply)
                    evaluated = self._evaluator.evaluate(np.asarray(vectors)[rows], supply, plan.evaluation, EVALUATION)
                    archive[supply] = concatenate([archive[supply], evaluated])
                    well = evaluated.success >= archive[supply].threshold(plan.success)
                    kept = well & np.all(evaluated.costs <= bounds[rows], axis=1)
                    times[rows] = np.where(kept, evaluated.time, np.inf)
                if step + 1 >= plan.restart_from * plan.steps:
                    better = [archive[supply].fastest(cost, bound, plan.success) for supply, cost, bound in jobs]
                    jump = np.array([time < 0.98 * now for (_, time), now in zip(better, times, strict=True)])
                    noise = plan.explore * (1.0 - (step + 1) / plan.steps) * random.standard_normal(vectors.shape)
                    taken = np.stack([vector for vector, _ in better]) + noise
                    vectors = where(jump[:, None], taken.astype(vectors.dtype), vectors)
                    state = jax.tree.map(functools.partial(_forgotten, rows=jump), state)
            report(step + 1, f"{len(jobs)} tunings side by side")
        return archive

    def _slope(self, vector: Vector, aim: Aim, starts: State) -> tuple[Vector, Float[Array, " costs"]]:
        """Returns the gradient, norm-clipped per initial state and then averaged; and the mean costs."""
        plan, rig, free = self._plan, self._evaluator.rig_at(aim.supply), self._evaluator.free_at(aim.supply)
        costs = (METRICS[cost] for cost in COSTS)
        terms = (TimeOutside(plan.width, plan.width), *costs, RemainingTime(plan.duration))
        metric = Lagrangian(terms, tuple(aim.multipliers), plan.stop_penalty)

        def objective(vector: Vector, start: State) -> tuple[Float[Array, ""], tuple[Float[Array, ""], ...]]:
            found: tuple[Float[Array, ""], tuple[Float[Array, ""], ...]] = measure(
                rig,
                free.build(vector),
                start,
                duration=plan.duration,
                dt=plan.dt,
                switching="located",
                spare_steps=self._spare,
                checkpoint="every_step",
                metrics=metric,
            )
            return found

        slopes, spent = jax.vmap(jax.grad(objective, has_aux=True), in_axes=(None, 0))(vector, starts)
        sound = jnp.all(jnp.isfinite(slopes), axis=1)
        slopes = where(sound[:, None], slopes, 0.0)
        slope = jnp.mean(descent.clip_factors(slopes, sound, plan.clip)[:, None] * slopes, axis=0)
        return slope, jnp.mean(jnp.nan_to_num(jnp.stack(spent, axis=1)), axis=0)


def _forgotten(leaf: Shaped[Array, "*leaf"], rows: Bool[np.ndarray, " rows"]) -> Shaped[Array, "*leaf"]:
    """Returns a leaf of the optimiser's state with some rows of its moments reset to zero."""
    return where(rows[:, None], 0.0, leaf).astype(leaf.dtype) if leaf.ndim == 2 else leaf
