"""Evaluation of many controllers, and selection among them, for the search for trade-off fronts."""

import dataclasses
import math
import operator
from collections import Counter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from cpjax.controllers import DesignName, EnergySwingUp
from cpjax.controllers.feedback import without_design
from cpjax.numeric.pareto import nondominated
from cpjax.plant import CartPole, with_parameters
from cpjax.plant.initial_states import sample_starts
from cpjax.plant.state import State
from cpjax.pytree import Scalar
from cpjax.rig import Rig, plant_of
from cpjax.sim.metrics import Metrics
from cpjax.sim.sweep import sweep
from cpjax.study.fronts.config import COSTS, FrontConfig
from cpjax.tune.baseline import baseline
from cpjax.tune.descent import derive_seed, in_blocks
from cpjax.tune.parameters import FreeParameters, free_parameters

SCREEN, BATCH, EVALUATION, REEVALUATION, FINAL, CANDIDATES, EXPLORE = range(7)
"""Purposes of random numbers."""

_RUNS, _CONTROLLERS = 2048, 64  # batch sizes: runs simulated, and controllers designed, at once


class Evaluated(NamedTuple):
    """Controllers and their metrics."""

    vectors: Float[np.ndarray, "controllers parameters"]
    """Free parameters, unconstrained."""
    success: Float[np.ndarray, " controllers"]
    """Share of the initial states that each settles from."""
    time: Float[np.ndarray, " controllers"]
    """Mean settling time over those [s]; infinite if there is none."""
    costs: Float[np.ndarray, "controllers costs"]
    """Mean of each of `COSTS` over those; infinite if there is none."""

    def points(self, cost: str, success: float) -> Float[np.ndarray, "controllers 2"]:
        """Returns settling time and cost; infinite for those that settle from a smaller share than `success`."""
        found = np.stack([self.time, self.costs[:, COSTS.index(cost)]], axis=1)
        found[self.success < success] = np.inf
        return found

    def threshold(self, wanted: float) -> float:
        """Returns the success threshold: `wanted` if any controller reaches it, else 97 % of the largest share."""
        best = float(np.max(self.success))
        return wanted if best >= wanted else 0.97 * best

    def fastest(
        self, cost: str, bound: float, success: float, rank: int = 0
    ) -> tuple[Float[np.ndarray, " parameters"], float]:
        """Returns the fastest controller within a bound on a cost, and its settling time.

        If none is within the bound, returns the one with the least cost, and infinity.

        Args:
          cost: one of `COSTS`.
          bound: largest mean cost.
          success: wanted share of the initial states; see `threshold`.
          rank: 0 for the best, 1 for the second, and so on; at most the last.

        Returns:
          Free parameters and mean settling time [s].
        """
        time, spent = self.points(cost, self.threshold(success)).T
        within = np.flatnonzero((spent <= bound) & np.isfinite(time))
        worth = time if len(within) else spent
        among = within if len(within) else np.arange(len(spent))
        found = int(among[np.argsort(worth[among], kind="stable")[min(rank, len(among) - 1)]])
        return self.vectors[found], float(time[found]) if len(within) else math.inf

    def epsilon_grid(self, cost: str, plan: FrontConfig) -> Float[np.ndarray, " bounds"]:
        """Returns bounds on a cost, one more than `FrontConfig.bounds`; the last one is infinite."""
        points = self.points(cost, self.threshold(plan.success))
        points = points[np.isfinite(points[:, 0])]
        if not len(points):
            return np.full(plan.bounds + 1, np.inf)
        fastest = points[np.argmin(points[:, 0]), 1]
        return np.append(np.geomspace(plan.lowest * np.min(points[:, 1]), fastest, plan.bounds), np.inf)


class Evaluator:
    """Builds and evaluates one design's controllers at any supply, and counts the steps simulated.

    Of a rig, plant and track count.

    Attributes:
      free: the free parameters of the baseline controller.
      steps: Runge-Kutta steps simulated so far, by supply [V].
    """

    def __init__(self, rig: Rig | CartPole, design: DesignName, plan: FrontConfig) -> None:
        self._plant, self._design, self._plan = plant_of(rig), design, plan
        self._track = rig.track if isinstance(rig, Rig) else None
        self.free = free_parameters(baseline(design, self._plant))
        self.steps: Counter[float] = Counter()
        self._built = jax.jit(jax.vmap(lambda vector, supply: without_design(self.free_at(supply).build(vector))))

    def plant_at(self, supply: Scalar) -> CartPole:
        """Returns the plant with another voltage limit [V]."""
        return with_parameters(self._plant, {"voltage_limit": supply})

    def rig_at(self, supply: Scalar) -> Rig | CartPole:
        """Returns the plant with another voltage limit [V], on its track if there is one."""
        plant = self.plant_at(supply)
        return plant if self._track is None else Rig(plant, track=self._track)

    def free_at(self, supply: Scalar) -> FreeParameters:
        """Returns the free parameters of controllers whose law's model has this voltage limit [V]."""
        controller = self.free.controller
        law = controller.swing_up
        assert isinstance(law, EnergySwingUp)
        law = dataclasses.replace(law, model=self.plant_at(supply))
        return dataclasses.replace(self.free, controller=dataclasses.replace(controller, swing_up=law))

    def starts(self, count: int, purpose: int, number: int = 0) -> State:
        """Draws initial states (count,) of the set "hanging", with a seed derived from purpose and number."""
        seed = derive_seed(self._plan.seed, purpose, number)
        return sample_starts("hanging", count, seed=seed, dtype=np.dtype(jnp.result_type(float)))

    def evaluate(
        self, vectors: Float[np.ndarray, "controllers parameters"], supply: float, count: int, purpose: int
    ) -> Evaluated:
        """Evaluates controllers by the protocol's metrics, all from the same initial states.

        Args:
          vectors: free parameters.
          supply: voltage limit [V].
          count: number of initial states.
          purpose: `REEVALUATION` and `FINAL` use `final_dt`, others `evaluation_dt`; each has its own initial states.
        """
        plan, rig, starts = self._plan, self.rig_at(supply), self.starts(count, purpose)
        dt = plan.final_dt if purpose in (REEVALUATION, FINAL) else plan.evaluation_dt
        controllers = in_blocks(self._built, _CONTROLLERS, vectors, np.full(len(vectors), supply, vectors.dtype))

        def run(which: Int[np.ndarray, " runs"], start: Int[np.ndarray, " runs"]) -> Metrics:
            found: Metrics = sweep(
                rig,
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

        def mean(column: Float[np.ndarray, "controllers starts"]) -> Float[np.ndarray, " controllers"]:
            summed = np.sum(np.where(good, column, 0.0), axis=1)
            return np.where(total > 0, summed / np.maximum(total, 1), np.inf)

        costs = np.stack([mean(getattr(table, cost)) for cost in COSTS], axis=1)
        return Evaluated(vectors, total / count, mean(table.settling_time), costs)

    def begin(self, supply: float, count: int, number: int) -> Evaluated:
        """Screens the baseline controller and random candidates, and evaluates the better ones for each cost.

        Args:
          supply: voltage limit [V], which the candidates' ranges suit.
          count: number of random candidates.
          number: distinguishes independent draws.
        """
        plan = self._plan
        random = np.random.default_rng([plan.seed, CANDIDATES, number])
        free = free_parameters(baseline(self._design, self.plant_at(supply)))
        given = np.asarray(self.free.start())[None]
        gentle = count // 2  # lower energy gains: more swings, less cart travel
        draws = free.draw(random, count - gentle), free.draw(random, gentle, short_track=True)
        drawn = np.concatenate([given, *draws]).astype(given.dtype)
        screened = self.evaluate(drawn, supply, plan.screening, SCREEN)
        better: set[int] = {0}
        for cost in COSTS:
            better.update(
                map(int, nondominated_sort(screened.points(cost, screened.threshold(plan.success)), 4 * plan.bounds))
            )
        return self.evaluate(screened.vectors[sorted(better)], supply, plan.evaluation, EVALUATION)


def nondominated_sort(points: Float[np.ndarray, "points 2"], least: int) -> Int[np.ndarray, " chosen"]:
    """Returns indices of points by non-dominated sorting: the first fronts that together hold at least `least` points.

    Args:
      points: two costs of each point; points that are not finite are left out.
      least: wanted number of points; fewer if there are not so many. The first point alone if none is finite.
    """
    left, chosen = np.array(points), np.zeros(0, int)
    while len(chosen) < least and len(layer := nondominated(left)):
        chosen = np.concatenate([chosen, layer])
        left[layer] = np.inf
    return chosen if len(chosen) else np.zeros(1, int)


def concatenate(parts: list[Evaluated]) -> Evaluated:
    """Returns all controllers of several lists as one."""
    return Evaluated(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
