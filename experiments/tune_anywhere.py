"""Tunings for starts anywhere: any angle, up to 4 rad/s, a moving cart, judged on 10,000 of them over 20 s.

    python experiments/tune_anywhere.py

Beside them the tunings for `hanging` starts (the controllers that ship) on the same starts. A finished tuning is kept
in the folder and not done again.
"""

from pathlib import Path
from typing import Any, get_args

from _common import run
from _tuned import EVALUATION_SEED, QUICK, located_rate, tuned

from cpjax import files, paper
from cpjax.plant.initial_states import sample_starts
from cpjax.presets import preset
from cpjax.sim.sweep import sweep
from cpjax.study.summary import summarise
from cpjax.tune.baseline import baseline
from cpjax.tune.config import TuningConfig
from cpjax.tune.parameters import free_parameters

PLAN: dict[str, Any] = {"starts": "anywhere", "duration": 5.0, "horizon": 8.0, "horizon_dt": 0.01}


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints a line for each controller and writes tune_anywhere.json."""
    plant = paper.appendix_plant()
    starts = sample_starts("anywhere", 64 if quick else 10_000, seed=EVALUATION_SEED)
    rows = []
    for design in get_args(paper.Design)[: 1 if quick else None]:
        plan = TuningConfig(seed=seed, **(PLAN | (QUICK if quick else {})))
        free = free_parameters(baseline(design, plant))
        aimed, made = tuned(out, f"{design}-{seed}", plant, free, plan)
        for name, controller in (("hanging", preset(design)), ("anywhere", aimed)):
            found = summarise(sweep(plant, controller, starts, duration=20.0, dt=0.002, clock="sampled"))
            located, _ = located_rate(plant, controller, starts, duration=20.0)
            row: dict[str, Any] = {"design": design, "tuned_for": name, "evaluation": found, "located_rate": located}
            if name == "anywhere":
                row |= {key: made[key] for key in ("labels", "physical", "value_steps", "gradient_steps", "seconds")}
            rows.append(row)
            low, high = found["success_interval"]
            print(
                f"{design:9}  tuned for {name:8}  {100 * found['success_rate']:7.3f} % "
                f"({100 * low:.3f} to {100 * high:.3f})  {found['over_successes']['settling_time']['mean']:.3f} s  "
                f"located {100 * located:.2f} %",
                flush=True,
            )
            files.write_json(out / "tune_anywhere.json", {"versions": files.versions(), "seed": seed, "rows": rows})
    return rows


if __name__ == "__main__":
    run(main, __doc__ or "")
