"""Tunings for a track of limited length, judged by who settles within 10 s without ever leaving it.

    python experiments/tune_track.py

Both designs, tracks of +-0.8, +-0.6 and +-0.5 m, 10,000 `hanging` starts that no tuning has seen. A run is 10 s long
and has to be settled for its last second. The gate is a level set of the design's own s' P s. Of three seeds the tuning
that scored best by its own last comparison counts. The last track's tunings begin with the controller for the longer
one before it. A finished tuning is kept in the folder and not done again.
"""

import itertools
from pathlib import Path
from typing import Any, get_args

from _common import run
from _tuned import EVALUATION_SEED, QUICK, located_rate, tuned

from cpjax import files, paper
from cpjax.plant.initial_states import sample_starts
from cpjax.sim.metrics import ProtocolMetrics
from cpjax.sim.sweep import sweep
from cpjax.study.summary import summarise
from cpjax.tune.baseline import baseline
from cpjax.tune.config import TuningConfig
from cpjax.tune.objective import Goal
from cpjax.tune.parameters import free_parameters

LIMITS = (0.8, 0.6, 0.5)
FREELY: dict[str, Any] = {"duration": 6.0, "horizon": 10.0, "horizon_dt": 0.01}
FURTHER: dict[str, Any] = FREELY | {
    "candidates": 31,
    "duration": 7.0,
    "explore": 0.3,
    "steps": 160,
    "validation": 256,
}
"""Random controllers hardly ever succeed on the shortest track."""


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints a line for each tuning and writes tune_track.json."""
    plant = paper.appendix_plant()
    starts = sample_starts("hanging", 64 if quick else 10_000, seed=EVALUATION_SEED)
    rows = []
    cases = itertools.product(get_args(paper.Design), LIMITS)
    controller = baseline("placement", plant, "lyapunov")
    for design, limit in itertools.islice(cases, 1 if quick else None):
        further = limit == LIMITS[-1]
        if not further:
            controller = baseline(design, plant, "lyapunov")
        free = free_parameters(controller)
        goal = Goal(track=3.0, track_limit=limit)
        tunings = []
        for number in range(seed, seed + (1 if quick else 3)):
            plan = TuningConfig(seed=number, goal=goal, **((FURTHER if further else FREELY) | (QUICK if quick else {})))
            tunings.append((number, *tuned(out, f"{limit:g}m-{design}-{number}", plant, free, plan)))
        number, controller, made = min(tunings, key=lambda tuning: float(tuning[2]["score"]))
        metric = ProtocolMetrics(track_limit=limit)
        found = summarise(sweep(plant, controller, starts, duration=10.0, dt=0.002, clock="sampled", metrics=metric))
        located, _ = located_rate(plant, controller, starts, duration=10.0, metrics=metric)
        row = {"track_limit": limit, "design": design, "seed": number, "evaluation": found, "located_rate": located}
        row |= {key: made[key] for key in ("labels", "physical", "value_steps", "gradient_steps", "seconds")}
        rows.append(row | {"scores": [one["score"] for _, _, one in tunings]})
        low, high = found["success_interval"]
        costs = found["over_successes"]
        print(
            f"+-{limit:g} m  {design:9}  seed {number}  {100 * found['success_rate']:7.3f} % "
            f"({100 * low:.3f} to {100 * high:.3f})  "
            f"{costs['settling_time']['mean']:.3f} s  travel {costs['cart_travel']['mean']:.3f} m  "
            f"located {100 * located:.2f} %  "
            f"scores {', '.join(format(float(one['score']), '.2f') for _, _, one in tunings)}",
            flush=True,
        )
        files.write_json(out / "tune_track.json", {"versions": files.versions(), "rows": rows})
    return rows


if __name__ == "__main__":
    run(main, __doc__ or "")
