"""Tunings for a track of limited length, judged by who settles within 10 s without ever leaving it.

    python experiments/tune_track.py

Both designs, tracks of +-0.8, +-0.6 and +-0.5 m, 10,000 `hanging` starts that no tuning has seen. A run is 10 s long
and has to be settled for its last second. A finished tuning is kept in the folder and not done again.
"""

import itertools
from pathlib import Path
from typing import Any, get_args

from _common import run
from _tuned import QUICK, tuned, use_fast_gradients

from cpjax import io, paper
from cpjax.sim.metrics import ProtocolMetrics
from cpjax.sim.sweep import sweep
from cpjax.starts import sample_starts
from cpjax.study.summary import summarise
from cpjax.tune.objective import Goal
from cpjax.tune.parameters import free_parameters
from cpjax.tune.plan import Plan
from cpjax.tune.starting import beginning

EVALUATION_SEED = 20_000
LIMITS = (0.8, 0.6, 0.5)
PLAN: dict[str, Any] = {"duration": 6.0, "horizon": 10.0, "horizon_dt": 0.01}


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints a line for each tuning and writes tune_track.json."""
    plant = paper.appendix_plant()
    starts = sample_starts("hanging", 64 if quick else 10_000, seed=EVALUATION_SEED)
    rows = []
    for limit, design in itertools.islice(itertools.product(LIMITS, get_args(paper.Design)), 1 if quick else None):
        goal = Goal(track=3.0, track_limit=limit)
        plan = Plan(seed=seed, goal=goal, **PLAN, **(QUICK if quick else {}))
        free = free_parameters(beginning("bland", design, plant, "lyapunov"))
        controller, made = tuned(out, f"{limit:g}m-{design}-{seed}", plant, free, plan)
        fold = ProtocolMetrics(track_limit=limit)
        found = summarise(sweep(plant, controller, starts, duration=10.0, dt=0.002, clock="sampled", metrics=fold))
        row = {"track_limit": limit, "design": design, "seed": seed, "evaluation": found, "physical": made["physical"]}
        rows.append(row | {key: made[key] for key in ("labels", "value_steps", "gradient_steps", "seconds")})
        low, high = found["success_interval"]
        costs = found["over_successes"]
        print(
            f"+-{limit:g} m  {design:9}  {100 * found['success_rate']:7.3f} % ({100 * low:.3f} to {100 * high:.3f})  "
            f"{costs['settling_time']['mean']:.3f} s  travel {costs['cart_travel']['mean']:.3f} m  "
            f"{made['seconds']:.0f} s",
            flush=True,
        )
        io.write_json(out / "tune_track.json", {"versions": io.versions(), "rows": rows})
    return rows


if __name__ == "__main__":
    use_fast_gradients()
    run(main, __doc__ or "")
