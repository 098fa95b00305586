"""Does the pole ever fall while the cart follows steps of 0.2 m? 10,000 runs with integral action.

    python experiments/reference_steps.py

Upright initial states with half the spread of the `hanging` set, so with up to 0.15 rad and 0.15 rad/s (with the whole
spread, some runs fall from where they start, without any reference); the reference steps from 0 to 0.2, 0, -0.2 and
0 m, one step every 4 s from the start on. A run counts as a fall if the pole leans beyond 90 degrees at any step. The
offset is that of the cart from the last position of the reference at the end.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import run

import cpjax
from cpjax import files, paper
from cpjax.cli.tables import print_table

AMPLITUDE, EVERY, DT = 0.2, 4.0, 2e-3


@cpjax.pytree.pytree
class Lean:
    """A metric: the largest lean of the pole [rad], and the cart's position at the end [m]."""

    def init(self, sample: Any) -> Any:
        """Returns the lean before the first sample."""
        return jnp.zeros_like(sample.time)

    def update(self, largest: Any, sample: Any) -> Any:
        """Returns the largest lean so far."""
        return jnp.maximum(largest, jnp.abs(sample.state.theta))

    def finalize(self, largest: Any, last: Any) -> Any:
        """Returns lean, position and flag."""
        return largest, last.state.x, last.flag


def main(out: Path, quick: bool = False, seed: int = 1, count: int = 10_000) -> dict[str, Any]:
    """Prints the table and writes reference_steps.json."""
    count = 64 if quick else count
    plant = cpjax.CartPole()
    hybrid = paper.controller("corrected-centred", "lqr", plant)
    weights = np.diag([200.0, 10.0, 100.0, 10.0]), 0.1
    integral = cpjax.IntegralAction.designed(hybrid, plant, *weights, integral_weight=30.0)
    plain = dataclasses.replace(integral, gain=0.0)
    places = AMPLITUDE * np.array([1.0, 0.0, -1.0, 0.0])
    starts = cpjax.sample_starts("hanging", count, seed=seed)
    starts = jax.tree.map(lambda column: 0.5 * column, dataclasses.replace(starts, theta=starts.theta - math.pi))
    found: dict[str, Any] = {"seed": seed, "count": count}
    rows = []
    for name, controller in (("feedback", plain), ("with integral action", integral)):
        reference = cpjax.MovingReference.steps(controller, EVERY * np.arange(len(places)), places)
        duration = EVERY * len(places)
        lean, x, flag = cpjax.sweep(plant, reference, starts, duration=duration, dt=DT, metrics=Lean())
        falls = int(np.sum((np.asarray(lean) > math.pi / 2) | (np.asarray(flag) != 0)))
        offset = float(np.max(np.abs(np.asarray(x) - places[-1])))
        found[name] = {"falls": falls, "largest_lean": float(np.max(lean)), "largest_offset": offset}
        rows.append((name, str(count), str(falls), f"{math.degrees(np.max(lean)):.1f}", f"{1e3 * offset:.2f}"))
    header = ("controller", "runs", "falls", "largest lean, degrees", "largest offset at the end, mm")
    print_table(f"Reference steps of {AMPLITUDE:g} m", header, rows, 1)
    files.write_json(out / "reference_steps.json", {"versions": files.versions(), **found})
    return found


if __name__ == "__main__":
    cpjax.configure_cpu()
    run(main, __doc__ or "")
