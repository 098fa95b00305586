"""The tuner: random candidates, gradients through whole swing-ups for the best of them, and a choice by values.

A gradient describes how a swing-up changes while its sequence of swings and switches stays the same. It does not show
that a little farther on the catch fails and the pendulum makes another turn. Values show that and cost less. So values
select the initial controllers and the result, and gradients improve the controllers in between.
"""

import functools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Shaped

from cpjax import files
from cpjax.controllers import Hybrid, StateFeedback
from cpjax.numeric.selection import where
from cpjax.plant import CartPole, linearize
from cpjax.plant.initial_states import sample_starts
from cpjax.plant.state import State
from cpjax.sim.flags import Flag
from cpjax.sim.metrics import Metrics, ProtocolMetrics
from cpjax.sim.rollout import measure
from cpjax.tune import descent
from cpjax.tune.checkpoint import TunerState, restore, store
from cpjax.tune.config import TuningConfig
from cpjax.tune.outcome import Tuning, request
from cpjax.tune.parameters import FreeParameters, Vector
from cpjax.tune.plants import sample_plants

Report = Callable[[int, int, str], None]

_FAILURE = 30.0  # settling time that a failed run counts as, in horizons: success comes before time
_SCREEN, _STEP, _VALIDATE, _COMPARISON, _FINAL, _CANDIDATES, _NOISE = range(7)  # purposes of random numbers
_BLOCK, _CONTROLLERS = 512, 64  # batch sizes: runs simulated, and controllers designed, at once


def tune(
    plant: CartPole,
    free: FreeParameters,
    plan: TuningConfig,
    *,
    progress: Report | None = None,
    checkpoint: Path | None = None,
) -> Tuning:
    """Tunes the free parameters on `plant`.

    Args:
      plant: the plant on which controllers are run.
      free: the free parameters, and the initial controller.
      plan: the configuration.
      progress: called with the steps done, their number, and what is done or was reached, in words.
      checkpoint: a file that is written after each validation. A tuning resumes from it if it exists, and its result
        is bitwise that of an uninterrupted one.

    Raises:
      InputError: a checkpoint of another tuning, or a controller that this plant cannot run.
    """
    began = time.perf_counter()
    tuner = _Tuner(plant, free, plan)
    say = progress if progress is not None else lambda done, total, text: None
    memory = restore(checkpoint, tuner.identity, tuner.optimiser)
    if memory is None:
        say(0, plan.steps, f"screening {plan.candidates + 1} candidates")
        memory = tuner.begin()
        store(checkpoint, tuner.identity, memory)
    while memory.step < plan.steps and not (plan.patience and memory.stale >= plan.patience):
        last = memory.history[-1]
        success = f"success {100 * max(last['success_rates']):.1f} %, best {min(memory.scores):.3f}"
        # Candidates are screened by their scores: there is no loss before the first gradient.
        say(memory.step, plan.steps, f"loss {last['loss']:.3f}, {success}" if memory.step else f"screened: {success}")
        memory = tuner.advance(memory)
        store(checkpoint, tuner.identity, memory)
    say(plan.steps, plan.steps, "last comparison")
    return tuner.finish(memory, began)


class _Tuner:
    """Compiled functions of one tuning, and the steps that use them."""

    def __init__(self, plant: CartPole, free: FreeParameters, plan: TuningConfig) -> None:
        self.plant, self.free, self.plan = plant, free, plan
        schedule = optax.cosine_decay_schedule(plan.learning_rate, max(1, plan.steps), 0.05)
        self.optimiser = optax.adam(schedule)
        self.metric = ProtocolMetrics(track_limit=plan.goal.track_limit)
        self.located: dict[str, Any] = {"duration": plan.duration, "dt": plan.dt, "switching": "located"}
        self.located |= {"spare_steps": plan.spare_steps, "checkpoint": "every_step"}  # few, long steps: little memory
        self.iterations = round(plan.duration / plan.dt) + plan.spare_steps
        self.gradient = jax.jit(jax.vmap(self._gradient, in_axes=(0, None, None, None)))
        self.controllers = jax.jit(jax.vmap(self._controller))
        self.validated = self._runs(duration=plan.horizon, dt=plan.horizon_dt, clock="sampled")
        self.evaluated = self._runs(duration=plan.final_horizon, dt=plan.final_dt, clock="sampled")
        self.located_runs = self._runs(**self.located)
        self.identity = files.dump_json(request(plant, free, plan))

    def _runs(self, **settings: Any) -> Any:
        """Returns a compiled map from controllers, initial states and plants (or None), each (n,), to metrics (n,)."""
        return jax.jit(jax.vmap(functools.partial(self._run, **settings)))

    def begin(self) -> TunerState:
        """Screens the candidates; the first restart is the given controller."""
        plan = self.plan
        given = np.asarray(self.free.start())[None]
        random = np.random.default_rng(descent.derive_seed(plan.seed, _CANDIDATES, 0))
        drawn = self.free.draw(random, plan.candidates, short_track=math.isfinite(plan.goal.track_limit))
        vectors = np.concatenate([given, drawn.astype(given.dtype)])
        starts, steps = plan.screening, 0
        while True:  # successive halving, by quarters (Jamieson and Talwalkar, 2016)
            scores, _, _ = self._score(vectors, starts, _SCREEN)
            steps += len(vectors) * self._value_steps(starts)
            order = [0, *(int(i) for i in np.argsort(scores, kind="stable") if i != 0)]
            if len(vectors) <= 16 * plan.restarts:
                break
            vectors, starts = vectors[order[: max(plan.restarts, len(vectors) // 4)]], 4 * starts
        chosen = vectors[order[: plan.restarts]]
        start = TunerState(
            0, chosen, self.optimiser.init(jnp.asarray(chosen)), chosen, np.full(len(chosen), np.inf), 0, [], steps, 0
        )
        return self._validate(start, np.nan)

    def advance(self, memory: TunerState) -> TunerState:
        """Runs the optimiser up to the next validation, validates, and selects restarts."""
        plan = self.plan
        vectors, state = jnp.asarray(memory.vectors), memory.optimiser
        end = min(memory.step + plan.validate_every, plan.steps)
        loss = jnp.full(vectors.shape[0], jnp.nan)
        for step in range(memory.step, end):
            starts, plants = self._draw(plan.batch, _STEP, step // plan.resample if plan.resample else 0)
            loss, slope = self.gradient(vectors, starts, plants, jnp.asarray(plan.width(step), vectors.dtype))
            vectors, state = descent.step(self.optimiser, vectors, state, slope)
        spent = (end - memory.step) * vectors.shape[0] * plan.batch * self.iterations
        memory = memory._replace(
            step=end, vectors=np.asarray(vectors), optimiser=state, gradient_steps=memory.gradient_steps + spent
        )
        memory = self._validate(memory, float(jnp.min(loss)))
        return self._select(memory) if memory.step < plan.steps else memory

    def _select(self, memory: TunerState) -> TunerState:
        """Replaces the worse half by the best of the better half plus noise (Jaderberg and others, 2017)."""
        plan = self.plan
        order = np.argsort(memory.scores, kind="stable")
        half = len(order) // 2
        if half == 0 or plan.explore == 0.0:
            return memory
        losers, winners = order[len(order) - half :], order[:half]
        random = np.random.default_rng(descent.derive_seed(plan.seed, _NOISE, memory.step))
        size = plan.explore * (1.0 - memory.step / plan.steps)
        noise = size * random.standard_normal((half, memory.best.shape[1]))
        vectors, best, scores = (np.array(x) for x in (memory.vectors, memory.best, memory.scores))
        vectors[losers] = memory.best[winners] + noise.astype(vectors.dtype)
        best[losers], scores[losers] = vectors[losers], np.inf

        def inherited(leaf: Shaped[Array, "*leaf"]) -> Shaped[Array, "*leaf"]:
            return leaf.at[losers].set(leaf[winners]) if leaf.ndim == 2 else leaf

        return memory._replace(
            vectors=vectors, best=best, scores=scores, optimiser=jax.tree.map(inherited, memory.optimiser)
        )

    def finish(self, memory: TunerState, began: float) -> Tuning:
        """Compares the best restarts on more initial states and returns the best of them."""
        plan = self.plan
        compared, _, _ = self._score(memory.best, plan.final, _COMPARISON)
        chosen = np.argsort(compared, kind="stable")[: plan.finalists]
        scores, rates, times = self._score(memory.best[chosen], plan.final, _FINAL)
        best = int(np.argmin(scores))
        vector = memory.best[chosen[best]]
        return Tuning(
            controller=jax.tree.map(np.asarray, self.free.build(jnp.asarray(vector))),
            vector=vector,
            labels=self.free.labels,
            physical=np.asarray(self.free.physical(jnp.asarray(vector))),
            score=float(scores[best]),
            success_rate=float(rates[best]),
            settling_time=float(times[best]),
            history=memory.history,
            value_steps=memory.value_steps
            + len(compared) * self._value_steps(plan.final)
            + len(chosen) * self._value_steps(plan.final, final=True),
            gradient_steps=memory.gradient_steps,
            seconds=time.perf_counter() - began,
        )

    def _validate(self, memory: TunerState, loss: float) -> TunerState:
        plan = self.plan
        scores, rates, times = self._score(memory.vectors, plan.validation, _VALIDATE)
        better = scores < memory.scores
        record = {
            "step": memory.step,
            "width": plan.width(memory.step),
            "loss": loss,
            "scores": scores.tolist(),
            "success_rates": rates.tolist(),
            "settling_times": times.tolist(),
        }
        improved = bool(np.min(scores) < np.min(memory.scores))
        return memory._replace(
            best=np.where(better[:, None], memory.vectors, memory.best),
            scores=np.where(better, scores, memory.scores),
            stale=0 if improved else memory.stale + 1,
            history=[*memory.history, record],
            value_steps=memory.value_steps + len(scores) * self._value_steps(plan.validation),
        )

    def _value_steps(self, starts: int, *, final: bool = False) -> int:
        """Returns the RK4 steps of one controller's score from so many initial states."""
        plan = self.plan
        horizon, dt = (plan.final_horizon, plan.final_dt) if final else (plan.horizon, plan.horizon_dt)
        return starts * round(horizon / dt) + _watched(starts) * self.iterations

    def _draw(self, count: int, purpose: int, step: int = 0) -> tuple[State, CartPole | None]:
        plan = self.plan
        dtype = np.dtype(jnp.result_type(float))
        starts = sample_starts(plan.starts, count, seed=descent.derive_seed(plan.seed, purpose, 2 * step), dtype=dtype)
        plants = None
        if plan.plant_spread > 0.0:
            seed = descent.derive_seed(plan.seed, purpose, 2 * step + 1)
            drawn = sample_plants(self.plant, count, spread=plan.plant_spread, seed=seed)
            plants = jax.tree.map(lambda column: jnp.asarray(column, dtype), drawn)
        return jax.tree.map(jnp.asarray, starts), plants

    def _gradient(
        self, vector: Vector, starts: State, plants: CartPole | None, width: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, " parameters"]]:
        """Returns loss and gradient of one restart; each state's gradient is norm-clipped before averaging."""
        plan = self.plan

        def objective(vector: Vector, start: State, plant: CartPole | None) -> Float[Array, ""]:
            plant = self.plant if plant is None else plant
            metric = plan.goal.metric(self.free.model, width, plan.duration)
            value: Float[Array, ""] = measure(plant, self.free.build(vector), start, **self.located, metrics=metric)
            return value

        values, slopes = jax.vmap(functools.partial(jax.value_and_grad(objective), vector))(starts, plants)
        sound = jnp.all(jnp.isfinite(slopes), axis=1) & jnp.isfinite(values)
        slopes = where(sound[:, None], slopes, 0.0)
        clip_factors = descent.clip_factors(slopes, sound, plan.clip)
        worst = jnp.max(where(sound, values, -jnp.inf))
        values = where(sound, values, worst)
        loss, shares = jax.value_and_grad(plan.aggregated)(values)
        slope = jnp.sum((shares * clip_factors)[:, None] * slopes, axis=0) + jax.grad(self._fast_pole_penalty)(vector)
        return loss, where(jnp.isfinite(slope), slope, 0.0)  # a NaN would stay in Adam's moments

    def _fast_pole_penalty(self, vector: Vector) -> Float[Array, ""]:
        """Returns a penalty on closed-loop poles faster than 90 % of `pole_limit`."""
        excess = jnp.log(fastest_pole_bound(self._closed_loop(vector)) / (0.9 * self.plan.pole_limit))
        return 10.0 * jnp.maximum(excess, 0.0) ** 2

    def _closed_loop(self, vector: Vector) -> Float[Array, "4 4"]:
        """Returns A - B K of the model used by the law."""
        A, B = linearize(self.free.model)
        regulator = self.free.build(vector).regulator
        assert isinstance(regulator, StateFeedback)
        return A - B @ jnp.asarray(regulator.K)

    def _score(
        self, vectors: Float[np.ndarray, "vectors parameters"], count: int, purpose: int
    ) -> tuple[Float[np.ndarray, " vectors"], Float[np.ndarray, " vectors"], Float[np.ndarray, " vectors"]]:
        """Returns score, success rate and mean settling time of each vector, from `count` initial states."""
        plan, goal = self.plan, self.plan.goal
        starts, plants = self._draw(count, purpose)
        final = purpose == _FINAL
        horizon = plan.final_horizon if final else plan.horizon
        block = min(_BLOCK, plan.restarts * plan.validation)
        controllers, poles = descent.in_blocks(self.controllers, min(block, _CONTROLLERS), jnp.asarray(vectors))

        def over(run: Any, starts_each: int) -> Any:
            """Returns `run` of every controller from the first `starts_each` states: arrays (n, starts_each)."""
            which, start = np.divmod(np.arange(len(vectors) * starts_each), starts_each)
            chosen = jax.tree.map(lambda column: column[which], controllers)
            drawn = jax.tree.map(lambda column: column[start], (starts, plants))
            found = descent.in_blocks(run, block, chosen, *drawn)
            return jax.tree.map(lambda column: column.reshape(len(vectors), starts_each), found)

        runs = over(self.evaluated if final else self.validated, count)
        failure = _FAILURE * horizon * max(1.0, float(goal.time))
        cost = np.where(runs.success, goal.time * runs.settling_time, failure)
        cost = cost + goal.effort * runs.effort + goal.voltage_variation * runs.voltage_variation
        score = np.mean(cost, axis=1)
        if watched := _watched(count):
            # More crossings than can be located: the run slides along the gate's boundary, and would chatter on a rig.
            sliding = (over(self.located_runs, watched).flag & Flag.OVERFLOW) != 0
            sliding = sliding & runs.success[:, :watched]  # the others have failed already
            score = score + failure * np.mean(sliding, axis=1)
        score = np.where(np.isnan(score) | ~(poles <= plan.pole_limit), np.inf, score)
        successes = np.sum(runs.success, axis=1)
        settled = np.sum(np.where(runs.success, runs.settling_time, 0.0), axis=1)
        settled = np.where(successes > 0, settled / np.maximum(successes, 1), np.nan)
        return score, successes / count, settled

    def _controller(self, vector: Vector) -> tuple[Hybrid, Float[Array, ""]]:
        """Returns the controller, and the magnitude of its fastest closed-loop pole [1/s]."""
        poles = jnp.linalg.eigvals(self._closed_loop(vector))
        return self.free.build(vector), jnp.max(jnp.abs(poles))

    def _run(self, controller: Hybrid, start: State, plant: CartPole | None, **settings: Any) -> Metrics:
        plant = self.plant if plant is None else plant
        found: Metrics = measure(plant, controller, start, metrics=self.metric, **settings)
        return found


def _watched(count: int) -> int:
    """Returns how many of so many initial states also run with located switching: an eighth, as each costs far more."""
    return count // 8


def fastest_pole_bound(A: Float[Array, "n n"]) -> Float[Array, ""]:
    """Returns a bound on the spectral radius of A: |A^64|^(1/64) in the Frobenius norm (Gelfand, 1941).

    Unlike the eigenvalues it is differentiable where some of them coincide. It exceeds the spectral radius by the 64th
    root of the condition number of A's eigenvectors, by about a tenth.
    """
    tiny = float(np.finfo(A.dtype).tiny)
    logarithm = jnp.zeros((), A.dtype)
    for doubling in range(7):
        size = jnp.sqrt(jnp.sum(A * A) + tiny)
        logarithm = logarithm + jnp.log(size) / 2**doubling
        A = (A / size) @ (A / size)
    return jnp.exp(logarithm)
