"""What a step with a gradient costs a tuner, in steps of the fastest values: the weight of a tuning's cost.

    python experiments/tuner_cost.py

Values: the settling time of 192 starts, 5 s, a control held over 4 ms, as a search without gradients asks for them.
With a gradient: a step of `cpjax tune` with 8 controllers and 16 starts each, 3 s at 20 ms, located
switching, in the same nine parameters. And a step of `cpjax pareto`: time and all costs at once, as many controllers
as one core has, 8 starts each, 8 s, the supply a parameter of each. Each runs with nothing set and after
`configure_cpu(1)`, each combination in a process of its own, and all processes in turn; the best of each counts.
"""

import itertools
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from _common import run

from cpjax import files, paper
from cpjax.backend import configure_cpu
from cpjax.cli.tables import print_table
from cpjax.plant.initial_states import sample_starts
from cpjax.plant.state import State
from cpjax.sim.metrics import TimeOutside
from cpjax.sim.rollout import measure
from cpjax.study.fronts.config import FrontConfig
from cpjax.study.fronts.evaluator import BATCH, Evaluator
from cpjax.study.fronts.trace import Aim, Tracer
from cpjax.tune.baseline import baseline
from cpjax.tune.config import TuningConfig
from cpjax.tune.parameters import free_parameters

OPTIONS = ("nothing", "configure_cpu")
WORK = ("values", "gradients", "fronts")


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints the speeds and the weights and writes tuner_cost.json."""
    cases = list(itertools.product(get_args(paper.Design), WORK, OPTIONS))
    speeds: dict[Any, list[float]] = {case: [] for case in cases}
    for _ in range(1 if quick else 2):
        for case in cases[:1] if quick else cases:
            speeds[case].append(_in_a_process(*case, quick=quick))
    rows = [
        {"design": design, "work": work, "options": options, "million_steps_per_second": max(found) / 1e6}
        for (design, work, options), found in speeds.items()
        if found
    ]
    cells = [
        [*(str(row[key]) for key in ("design", "work", "options")), f"{row['million_steps_per_second']:.2f}"]
        for row in rows
    ]
    print_table("Speed", ("design", "work", "set before", "M steps/s"), cells, text_columns=3)
    weights = {}
    for design in () if quick else get_args(paper.Design):
        best = {
            w: max(r["million_steps_per_second"] for r in rows if (r["design"], r["work"]) == (design, w)) for w in WORK
        }
        weights[design] = {work: best["values"] / best[work] for work in WORK[1:]}
        print(f"{design}: a step with a gradient costs so many steps of the fastest values: {weights[design]}")
    files.write_json(out / "tuner_cost.json", {"versions": files.versions(), "rows": rows, "weights": weights})
    return rows


def _in_a_process(design: str, work: str, options: str, quick: bool) -> float:
    """Steps per second."""
    environment = os.environ | {"JAX_ENABLE_X64": "1"}
    command = [sys.executable, __file__, "--measure", design, work, options, "quick" if quick else "whole"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return float(json.loads(done.stdout))


def _measure(design: Any, work: str, quick: bool) -> float:
    plant = paper.appendix_plant()
    free = free_parameters(baseline(design, plant))
    plan = TuningConfig()
    if work == "fronts":
        return _measure_fronts(plant, design, quick)
    with_gradient = (plan.restarts, plan.batch, plan.duration, plan.dt)
    restarts, count, duration, dt = (1, 192, 5.0, 0.004) if work == "values" else with_gradient
    starts = jax.tree.map(jnp.asarray, sample_starts("hanging", 2 if quick else count, seed=1))
    duration = 10.0 * dt if quick else duration

    def value(vector: jax.Array, start: State) -> jax.Array:
        found = measure(plant, free.build(vector), start, duration=duration, dt=dt, clock="sampled")
        return jnp.where(found.success, found.settling_time, duration)

    def outside(vector: jax.Array, start: State) -> jax.Array:
        metric = TimeOutside(0.1, 0.1)
        settings: dict[str, Any] = {"switching": "located", "spare_steps": plan.spare_steps, "checkpoint": "every_step"}
        found: jax.Array = measure(
            plant, free.build(vector), start, duration=duration, dt=dt, metrics=metric, **settings
        )
        return found

    function: Any = value if work == "values" else jax.value_and_grad(outside)
    of_all = jax.jit(jax.vmap(jax.vmap(function, in_axes=(None, 0)), in_axes=(0, None)))
    random = np.random.default_rng(1)
    vectors = jnp.asarray(np.asarray(free.start()) + 0.1 * random.standard_normal((restarts, len(free.labels))))
    times = []
    for _ in range(2 if quick else 25):
        began = time.perf_counter()
        jax.block_until_ready(of_all(vectors, starts))  # type: ignore[no-untyped-call]  # untyped in JAX
        times.append(time.perf_counter() - began)
    steps = round(duration / dt) + (plan.spare_steps if work == "gradients" else 0)
    return restarts * jnp.shape(starts.x)[0] * steps / min(times[1:])


def _measure_fronts(plant: Any, design: Any, quick: bool) -> float:
    plan = FrontConfig()
    evaluator = Evaluator(plant, design, plan)
    tracer = Tracer(evaluator, plan)
    count = 2 if quick else 3 * (plan.bounds + 1)
    random = np.random.default_rng(1)
    start = np.asarray(evaluator.free.start())
    vectors = jnp.asarray(start + 0.1 * random.standard_normal((count, len(start))))
    aims = Aim(jnp.full((count, 3), 0.01), jnp.full((count,), 12.0))
    times = []
    for step in range(2 if quick else 8):
        began = time.perf_counter()
        jax.block_until_ready(tracer.gradient(vectors, aims, evaluator.starts(plan.batch, BATCH, step)))  # type: ignore[no-untyped-call]  # untyped in JAX
        times.append(time.perf_counter() - began)
    return count * plan.batch * tracer.steps_of_a_run / min(times[1:])


if __name__ == "__main__":
    if sys.argv[1:2] == ["--measure"]:
        if sys.argv[4] == "configure_cpu":
            configure_cpu(1)
        print(json.dumps(_measure(sys.argv[2], sys.argv[3], sys.argv[5] == "quick")))
    else:
        run(main, __doc__ or "")
