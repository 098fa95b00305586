"""Tunings that an experiment needs: made once, and kept in its folder."""

import os
from pathlib import Path
from typing import Any

from cpjax import io
from cpjax.controllers import Hybrid
from cpjax.plant import CartPole
from cpjax.tune.parameters import FreeParameters
from cpjax.tune.plan import Plan
from cpjax.tune.tuner import document, tune

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
"""For a `Plan` that only shows that it works."""


def use_fast_gradients() -> None:
    """Sets an option of XLA's that about doubles the speed of the gradients. Before JAX computes anything."""
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true")


def tuned(out: Path, case: str, plant: CartPole, free: FreeParameters, plan: Plan) -> tuple[Hybrid, dict[str, Any]]:
    """The controller of a tuning, and its document; read from `out` if they are there already."""
    path = out / f"{case}.json"
    if not path.exists():
        tuning = tune(plant, free, plan, checkpoint=out / f"{case}.npz")
        io.write_json(out / f"{case}.tune.json", document(tuning, plant, plan))
        io.save(path, tuning.controller)
    controller = io.load(path)
    assert isinstance(controller, Hybrid)
    return controller, io.read_table(out / f"{case}.tune.json")
