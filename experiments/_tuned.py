"""Tunings that an experiment needs: made once, and kept in its folder."""

import json
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cpjax import files, io
from cpjax.controllers import Hybrid
from cpjax.plant import CartPole
from cpjax.plant.state import State
from cpjax.sim.metrics import Metric, Metrics
from cpjax.sim.sweep import sweep
from cpjax.tune.config import TuningConfig
from cpjax.tune.outcome import document, request
from cpjax.tune.parameters import FreeParameters
from cpjax.tune.tuner import tune

EVALUATION_SEED = 20_000
"""Of the starts that judge a tuning; no tuning sees them."""

QUICK: dict[str, Any] = {
    "candidates": 4,
    "restarts": 2,
    "steps": 2,
    "batch": 2,
    "screening": 2,
    "validation": 4,
    "final": 4,
}
"""For a `TuningConfig` that only shows that it works."""


def located_rate(
    plant: CartPole, controller: Hybrid, starts: State, duration: float, metrics: Metric | None = None
) -> tuple[float, float]:
    """Of the first fifth of `starts`, on the continuous clock with located switching: the share that succeeds, and the
    successes' mean settling time [s].
    """
    some = jax.tree.map(lambda column: column[: max(16, len(column) // 5)], starts)
    found: Metrics = sweep(plant, controller, some, duration=duration, dt=0.002, switching="located", metrics=metrics)
    good = np.asarray(found.success)
    return float(np.mean(good)), float(np.mean(np.asarray(found.settling_time)[good])) if good.any() else math.nan


def tuned(
    out: Path, case: str, plant: CartPole, free: FreeParameters, plan: TuningConfig
) -> tuple[Hybrid, dict[str, Any]]:
    """The controller of a tuning, and its document; read from `out` if the same tuning is there already."""
    path, record, checkpoint = out / f"{case}.json", out / f"{case}.tune.json", out / f"{case}.npz"
    asked = json.loads(files.dump_json(request(plant, free, plan)))
    made = files.read_table(record) if path.exists() and record.exists() else {}
    if any(made.get(key) != value for key, value in asked.items()):
        tuning = tune(plant, free, plan, checkpoint=checkpoint)
        files.write_json(record, document(tuning, plant, free, plan))
        io.save(path, tuning.controller)
        checkpoint.unlink()
    controller = io.load(path)
    assert isinstance(controller, Hybrid)
    return controller, files.read_table(record)
