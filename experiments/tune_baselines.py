"""CMA-ES, Nelder-Mead and random search on the tuner's parameters and start, judged on the same unseen starts.

    python experiments/tune_baselines.py

Each minimises the mean settling time of 192 starts (5 s, a control held over 4 ms; a failure counts 5 s), with 2,240
evaluations, from the baseline, for both designs. CMA-ES comes from the package cma (the extra "baselines").
"""

import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias, get_args

import jax
import jax.numpy as jnp
import numpy as np
from _common import run
from _tuned import EVALUATION_SEED
from scipy.optimize import minimize

from cpjax import files, paper
from cpjax.plant.initial_states import sample_starts
from cpjax.sim.rollout import measure
from cpjax.sim.sweep import sweep
from cpjax.study.summary import summarise
from cpjax.tune.baseline import baseline
from cpjax.tune.parameters import FreeParameters, free_parameters

HORIZON, DT, STARTS, EVALUATIONS = 5.0, 0.004, 192, 2240
Numbers: TypeAlias = np.ndarray[Any, Any]
Score: TypeAlias = Callable[[Numbers], Numbers]


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints a line for each search and writes tune_baselines.json."""
    rows = []
    evaluations = 14 if quick else EVALUATIONS
    designs = get_args(paper.Design)[: 1 if quick else None]
    unseen = sample_starts("hanging", 64 if quick else 10_000, seed=EVALUATION_SEED)
    plant = paper.appendix_plant()
    for method, design, number in itertools.product(_SEARCHES, designs, range(seed, seed + (1 if quick else 5))):
        free = free_parameters(baseline(design, plant))
        began = time.perf_counter()
        score, asked = _score(free, number, 4 if quick else STARTS), 0

        def counted(vectors: Numbers, score: Score = score) -> Numbers:
            nonlocal asked
            asked += len(vectors)
            return score(vectors)

        found = _SEARCHES[method](counted, free, number, evaluations)
        if found is None:
            print(f"{method} needs the package cma: left out")
            continue
        seconds = time.perf_counter() - began
        law = free.build(jnp.asarray(found))
        judged = summarise(sweep(plant, law, unseen, duration=20.0, dt=0.002, clock="sampled"))
        cost = asked * STARTS * round(HORIZON / DT)  # Nelder-Mead may stop before it has to
        names = {"design": design, "method": method, "seed": number, "steps": cost, "seconds": seconds}
        rows.append({**names, "parameters": free.physical(jnp.asarray(found)), "evaluation": judged})
        print(
            f"{design:9} {method:11} {number}  {100 * judged['success_rate']:7.3f} %  "
            f"{judged['over_successes']['settling_time']['mean']:.3f} s  "
            f"{cost / 1e6:.0f} M steps  {seconds:.0f} s",
            flush=True,
        )
        files.write_json(out / "tune_baselines.json", {"versions": files.versions(), "rows": rows})
    return rows


def _score(free: FreeParameters, seed: int, count: int) -> Score:
    starts = jax.tree.map(jnp.asarray, sample_starts("hanging", count, seed=30_000 + seed))
    plant = paper.appendix_plant()

    @jax.jit
    def of_all(vectors: jax.Array) -> jax.Array:
        def one(vector: jax.Array) -> jax.Array:
            law = free.build(vector)
            runs = jax.vmap(lambda s: measure(plant, law, s, duration=HORIZON, dt=DT, clock="sampled"))(starts)
            return jnp.mean(jnp.where(runs.success, runs.settling_time, HORIZON))

        return jax.lax.map(one, vectors)

    def finite(vectors: Numbers) -> Numbers:
        return np.nan_to_num(np.asarray(of_all(jnp.asarray(vectors))), nan=2.0 * HORIZON)

    return finite


def _random(score: Score, free: FreeParameters, seed: int, evaluations: int) -> Numbers:
    vectors = free.draw(np.random.default_rng(seed), evaluations)
    vectors[0] = np.asarray(free.start())
    values = np.concatenate([score(part) for part in _parts(vectors)])
    best: Numbers = vectors[int(np.argmin(values))]
    return best


def _parts(vectors: Numbers) -> Iterator[Numbers]:
    for i in range(0, len(vectors), 14):
        yield vectors[i : i + 14]


def _nelder_mead(score: Score, free: FreeParameters, seed: int, evaluations: int) -> Numbers:
    start = np.asarray(free.start())
    simplex = start + np.concatenate([np.zeros((1, start.size)), 0.5 * np.eye(start.size)])
    simplex[1:] += 0.1 * np.random.default_rng(seed).standard_normal((start.size, start.size))
    options = {"maxfev": evaluations, "initial_simplex": simplex, "xatol": 1e-6, "fatol": 1e-6}
    found = minimize(lambda x: float(score(x[None])[0]), start, method="Nelder-Mead", options=options)
    best: Numbers = found.x
    return best


def _cma_es(score: Score, free: FreeParameters, seed: int, evaluations: int) -> Numbers | None:
    try:
        import cma
    except ImportError:
        return None
    options = {"seed": seed, "verbose": -9, "popsize": 14}
    search = cma.CMAEvolutionStrategy(np.asarray(free.start()), 0.5, options)
    for _ in range(evaluations // 14):
        vectors = search.ask()
        search.tell(vectors, list(score(np.array(vectors))))
    best: Numbers = search.best.x
    return best


_SEARCHES: dict[str, Callable[..., Any]] = {"cma-es": _cma_es, "random": _random, "nelder-mead": _nelder_mead}

if __name__ == "__main__":
    os.environ.setdefault(
        "XLA_FLAGS",
        "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true,"
        "xla_cpu_small_while_loop_byte_threshold=16777216",
    )
    run(main, __doc__ or "")
