"""What many controllers are worth, and which of them to go on from: the judge of a search for trade-off fronts."""

import dataclasses
import math
import operator
from collections import Counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cpjax.controllers import DesignName, EnergySwingUp
from cpjax.controllers.hybrid import without_design
from cpjax.numeric.pareto import nondominated
from cpjax.plant import CartPole, with_parameters
from cpjax.plant.initial_states import sample_starts
from cpjax.plant.state import State
from cpjax.sim.metrics import Metrics
from cpjax.sim.sweep import sweep
from cpjax.study.fronts.config import COSTS, FrontConfig
from cpjax.tune.baseline import baseline
from cpjax.tune.descent import derive_seed, in_blocks
from cpjax.tune.parameters import FreeParameters, free_parameters

Numbers = np.ndarray[Any, Any]

SCREEN, BATCH, JUDGE, SEMIFINAL, FINAL, CANDIDATES, EXPLORE = range(7)
"""What random numbers are for."""

_RUNS, _CONTROLLERS = 2048, 64  # simulated, and designed, at a time


class Evaluated(NamedTuple):
    """Controllers and what they were found to be worth."""

    vectors: Numbers
    """Free parameters (n, d)."""
    success: Numbers
    """Share of the starts that they settle from (n,)."""
    time: Numbers
    """Mean settling time of those [s] (n,), infinite where there is none."""
    costs: Numbers
    """Likewise the mean `COSTS` (n, number of them)."""

    def points(self, cost: str, success: float) -> Numbers:
        """Settling time and cost (n, 2); infinite for those that settle from a smaller share of the starts."""
        found = np.stack([self.time, self.costs[:, COSTS.index(cost)]], axis=1)
        found[self.success < success] = np.inf
        return found

    def enough(self, wanted: float) -> float:
        """The share of starts to ask for: `wanted` if any settles from so many, or else nearly as many as the best."""
        best = float(np.max(self.success))
        return wanted if best >= wanted else 0.97 * best

    def fastest(self, cost: str, bound: float, success: float, rank: int = 0) -> tuple[Numbers, float]:
        """Of the controllers that settle from `success` of the starts, or nearly as many as the best, the fastest that
        keeps to the bound, and its time; if there is none, the cheapest, and infinity. Or the second such, the third,
        and so on, by `rank`, if there are so many.
        """
        time, spent = self.points(cost, self.enough(success)).T
        within = np.flatnonzero((spent <= bound) & np.isfinite(time))
        worth = time if len(within) else spent
        among = within if len(within) else np.arange(len(spent))
        found = int(among[np.argsort(worth[among], kind="stable")[min(rank, len(among) - 1)]])
        return self.vectors[found], float(time[found]) if len(within) else math.inf

    def epsilon_grid(self, cost: str, plan: FrontConfig) -> Numbers:
        """Bounds of a cost (bounds + 1,)."""
        points = self.points(cost, self.enough(plan.success))
        points = points[np.isfinite(points[:, 0])]
        if not len(points):
            return np.full(plan.bounds + 1, np.inf)
        fastest = points[np.argmin(points[:, 0]), 1]
        return np.append(np.geomspace(plan.lowest * np.min(points[:, 1]), fastest, plan.bounds), np.inf)


class Evaluator:
    """Builds one design's controllers of their free parameters, at any supply, and counts what it costs to judge them.

    Attributes:
      free: what may change, about the bland start.
      steps: Runge-Kutta steps simulated so far, by supply [V].
    """

    def __init__(self, plant: CartPole, design: DesignName, plan: FrontConfig) -> None:
        self._plant, self._design, self._plan = plant, design, plan
        self.free = free_parameters(baseline(design, plant))
        self.steps: Counter[float] = Counter()
        self._built = jax.jit(jax.vmap(lambda vector, supply: without_design(self.free_at(supply).build(vector))))

    def plant_at(self, supply: Any) -> CartPole:
        """The plant at a supply [V]."""
        return with_parameters(self._plant, {"voltage_limit": supply})

    def free_at(self, supply: Any) -> FreeParameters:
        """The free parameters of controllers whose law knows this supply [V]."""
        controller = self.free.controller
        law = controller.swing_up
        assert isinstance(law, EnergySwingUp)
        law = dataclasses.replace(law, model=self.plant_at(supply))
        return dataclasses.replace(self.free, controller=dataclasses.replace(controller, swing_up=law))

    def starts(self, count: int, purpose: int, number: int = 0) -> State:
        """Starts that no person's seed names."""
        seed = derive_seed(self._plan.seed, purpose, number)
        return sample_starts("hanging", count, seed=seed, dtype=np.dtype(jnp.result_type(float)))

    def evaluate(self, vectors: Numbers, supply: float, count: int, purpose: int) -> Evaluated:
        """Controllers (n, d) by the protocol's metrics from so many starts, all the same."""
        plan, plant, starts = self._plan, self.plant_at(supply), self.starts(count, purpose)
        dt = plan.final_dt if purpose in (SEMIFINAL, FINAL) else plan.judging_dt
        controllers = in_blocks(self._built, _CONTROLLERS, vectors, np.full(len(vectors), supply, vectors.dtype))

        def run(which: Numbers, start: Numbers) -> Metrics:
            found: Metrics = sweep(
                plant,
                jax.tree.map(operator.itemgetter(which), controllers),
                jax.tree.map(operator.itemgetter(start), starts),
                duration=plan.horizon,
                dt=dt,
                clock="sampled",
            )
            return found

        metrics = in_blocks(run, _RUNS, *np.divmod(np.arange(len(vectors) * count), count))
        self.steps[supply] += len(vectors) * count * round(plan.horizon / dt)
        table = jax.tree.map(lambda column: column.astype(float).reshape(-1, count), metrics)
        good = table.success > 0.0
        total = np.sum(good, axis=1)

        def mean(column: Numbers) -> Numbers:
            summed = np.sum(np.where(good, column, 0.0), axis=1)
            return np.where(total > 0, summed / np.maximum(total, 1), np.inf)

        costs = np.stack([mean(getattr(table, cost)) for cost in COSTS], axis=1)
        return Evaluated(vectors, total / count, mean(table.settling_time), costs)

    def begin(self, supply: float, count: int, number: int) -> Evaluated:
        """The bland start and `count` random candidates from ranges that suit the supply; the better ones of each cost
        judged on more starts."""
        plan = self._plan
        random = np.random.default_rng([plan.seed, CANDIDATES, number])
        free = free_parameters(baseline(self._design, self.plant_at(supply)))
        bland = np.asarray(self.free.start())[None]
        gentle = count // 2  # who pumps gently, in more swings, needs less room
        draws = free.draw(random, count - gentle), free.draw(random, gentle, short_track=True)
        drawn = np.concatenate([bland, *draws]).astype(bland.dtype)
        screened = self.evaluate(drawn, supply, plan.screening, SCREEN)
        better: set[int] = {0}
        for cost in COSTS:
            better.update(
                map(int, nondominated_sort(screened.points(cost, screened.enough(plan.success)), 4 * plan.bounds))
            )
        return self.evaluate(screened.vectors[sorted(better)], supply, plan.judging, JUDGE)


def nondominated_sort(points: Numbers, least: int) -> Numbers:
    """Indices of the points (n, 2) that no other beats, then of those that only they beat, and so on, until there are
    `least` or no more that are finite; the first point if none is.
    """
    left, chosen = np.array(points), np.zeros(0, int)
    while len(chosen) < least and len(layer := nondominated(left)):
        chosen = np.concatenate([chosen, layer])
        left[layer] = np.inf
    return chosen if len(chosen) else np.zeros(1, int)


def concatenate(parts: list[Evaluated]) -> Evaluated:
    """All controllers of several lists."""
    return Evaluated(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
