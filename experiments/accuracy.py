"""How the error falls with the step: order 4, but order 1 across a switch that is read per step.

    python experiments/accuracy.py

Four runs of the corrected, centred law with the computed placement gain on the appendix plant:
  smooth      continuous clock, supply without limit, swing-up only
  sampled     sampled clock with a control period of 16 ms whatever the step, through the catch
  continuous  continuous clock, mode read per step, through the catch; mean over starts, since where the crossing
              falls inside a step is different for each
  located     the same with located switching
The reference is the same run with a much smaller step.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import run
from matplotlib.figure import Figure

import cpjax
from cpjax import files, paper
from cpjax.show.figures import save_figure

STEPS = (0.016, 0.008, 0.004, 0.002, 0.001)
COLOURS = ("#0072B2", "#009E73", "#D55E00", "#CC79A7")


def main(out: Path, quick: bool = False, seed: int = 1) -> dict[str, Any]:
    """Prints errors and fitted orders and writes accuracy.json and accuracy.png."""
    plant = paper.appendix_plant()
    unlimited = dataclasses.replace(plant, motor=dataclasses.replace(plant.motor, voltage_limit=math.inf))
    hybrid = paper.controller("corrected-centred", "placement", plant, "computed")
    starts = cpjax.sample_starts("hanging", 4 if quick else 64, seed=seed)
    divide = 4 if quick else 64
    step_sizes = STEPS[:2] if quick else STEPS

    cases: dict[str, dict[str, Any]] = {
        "smooth": {"plant": unlimited, "controller": hybrid.swing_up, "duration": 0.8, "clock": "continuous"},
        "sampled": {"plant": plant, "controller": hybrid, "duration": 2.4, "clock": "sampled", "control_period": 0.016},
        "continuous": {"plant": plant, "controller": hybrid, "duration": 2.4, "clock": "continuous"},
    }
    cases["located"] = cases["continuous"] | {"switching": "located"}

    def final_states(case: dict[str, Any], dt: float) -> np.ndarray[Any, Any]:
        settings = {k: v for k, v in case.items() if k not in ("plant", "controller")}

        def final(start: cpjax.State) -> jax.Array:
            steps = round(case["duration"] / dt)
            run = cpjax.rollout(case["plant"], case["controller"], start, dt=dt, save_every=steps, **settings)
            return run.state.vector()[-1]

        return np.asarray(jax.vmap(final)(jax.tree.map(jnp.asarray, starts)))

    results: dict[str, Any] = {}
    for name, case in cases.items():
        reference = final_states(case, step_sizes[-1] / divide)
        errors = [float(np.abs(final_states(case, dt) - reference).max(axis=1).mean()) for dt in step_sizes]
        order = float(np.polyfit(np.log(step_sizes), np.log(errors), 1)[0])
        results[name] = {"errors": errors, "order": order}
        print(f"{name:11} order {order:5.2f}   " + "  ".join(f"{e:.1e}" for e in errors), flush=True)

    files.write_json(
        out / "accuracy.json",
        {
            "versions": files.versions(),
            "seed": seed,
            "starts": int(np.size(starts.x)),
            "steps": step_sizes,
            "cases": results,
        },
    )
    figure = Figure(figsize=(7, 5), layout="constrained")
    axes = figure.subplots()
    for (name, result), marker, colour in zip(results.items(), "osDv", COLOURS, strict=True):
        label = f"{name}: fitted order {result['order']:.2f}"
        axes.loglog(step_sizes, result["errors"], marker=marker, color=colour, label=label)
    axes.set_xlabel("step [s]")
    axes.set_ylabel("mean over starts of the final state's largest error")
    axes.grid(which="both", alpha=0.3)
    axes.legend()
    save_figure(out / "accuracy.png", figure)
    return results


if __name__ == "__main__":
    run(main, __doc__ or "")
