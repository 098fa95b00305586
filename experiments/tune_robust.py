"""A plant that is not the one the controller was made for: nominal tunings and tunings over random plants.

    python experiments/tune_robust.py

1,000 plants, parameters within 20 % of the appendix's, one at a time and all together; four `hanging` starts for each.
The appendix's frictions are zero: they are drawn between zero and a fifth of the units of `cpjax.tune.plants`.
The law's own model of the plant stays the nominal one, and so does its regulator. Beside the nominal tunings (the
controllers that ship) stand tunings over plants that are drawn anew for each start. A finished tuning is kept in the
folder and not done again.
"""

import functools
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from _common import run
from _tuned import EVALUATION_SEED, QUICK, tuned

from cpjax import files, paper
from cpjax.controllers import Hybrid
from cpjax.numeric.statistics import wilson_interval
from cpjax.plant import CartPole
from cpjax.plant.initial_states import sample_starts
from cpjax.plant.state import State
from cpjax.presets import preset
from cpjax.sim.metrics import Metrics
from cpjax.sim.rollout import measure
from cpjax.tune.baseline import baseline
from cpjax.tune.config import TuningConfig
from cpjax.tune.parameters import free_parameters
from cpjax.tune.plants import UNCERTAIN, sample_plants

SPREAD, PER_PLANT = 0.2, 4
# One plant in ten is hard for any controller, and a share of 128 starts says too little about the others.
PLAN: dict[str, Any] = {
    "plant_spread": SPREAD,
    "duration": 5.0,
    "horizon": 8.0,
    "horizon_dt": 0.01,
    "validation": 512,
}


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints a line for each set of plants and writes tune_robust.json."""
    nominal = paper.appendix_plant()
    count = 16 if quick else 1_000
    starts = sample_starts("hanging", PER_PLANT * count, seed=EVALUATION_SEED)
    controllers: dict[str, Hybrid] = {}
    for design in get_args(paper.Design)[: 1 if quick else None]:
        plan = TuningConfig(seed=seed, **(PLAN | (QUICK if quick else {})))
        free = free_parameters(baseline(design, nominal))
        controllers[f"{design}, nominal"] = preset(design)
        controllers[f"{design}, over plants"], _ = tuned(out, f"{design}-{seed}", nominal, free, plan)
    print(f"{'success [%]':20}" + "".join(f"{name:>24}" for name in controllers))
    rows = []
    for only in ("nothing", *UNCERTAIN, "everything")[: 2 if quick else None]:
        chosen = None if only in ("nothing", "everything") else only
        spread = 0.0 if only == "nothing" else SPREAD
        plants = sample_plants(nominal, count, spread=spread, seed=EVALUATION_SEED, only=chosen)
        plants = jax.tree.map(lambda column: np.repeat(column, PER_PLANT), plants)
        row: dict[str, Any] = {"varied": only}
        for name, controller in controllers.items():
            found = _sampled(controller, plants, starts)
            located = _located(controller, *jax.tree.map(lambda column: column[::PER_PLANT], (plants, starts)))
            good = np.asarray(found.success)
            row[name] = {
                "success_rate": float(np.mean(good)),
                "success_interval": wilson_interval(int(good.sum()), good.size),
                "located_rate": float(np.mean(located.success)),
                "plants_that_never_fail": float(np.mean(np.all(good.reshape(count, PER_PLANT), axis=1))),
                "settling_time": float(np.mean(np.asarray(found.settling_time)[good])) if good.any() else None,
            }
        rows.append(row)
        for label, key in ((only, "success_rate"), ("  located", "located_rate")):
            print(f"{label:20}" + "".join(f"{100 * row[name][key]:24.2f}" for name in controllers), flush=True)
        files.write_json(out / "tune_robust.json", {"versions": files.versions(), "seed": seed, "rows": rows})
    return rows


def _evaluated(controller: Hybrid, plants: CartPole, starts: State, **settings: Any) -> Metrics:
    def one(plant: CartPole, start: State) -> Metrics:
        found: Metrics = measure(plant, controller, start, duration=20.0, dt=0.002, **settings)
        return found

    found: Metrics = jax.vmap(one)(jax.tree.map(jnp.asarray, plants), jax.tree.map(jnp.asarray, starts))
    return found


_sampled = jax.jit(functools.partial(_evaluated, clock="sampled"))
_located = jax.jit(functools.partial(_evaluated, switching="located"))

if __name__ == "__main__":
    run(main, __doc__ or "")
