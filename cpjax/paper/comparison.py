"""Tuned controllers beside the paper's: which of LQR and pole placement is better at 12 V, and at what price?"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from cpjax import io, paper
from cpjax.controllers import Hybrid
from cpjax.controllers.hybrid import without_design
from cpjax.paper.reproduction import DESIGNS, GAINS, EvaluationConfig
from cpjax.plant import CartPole
from cpjax.plant.initial_states import sample_starts
from cpjax.plant.state import State
from cpjax.presets import preset
from cpjax.sim.metrics import Metrics, ProtocolMetrics
from cpjax.sim.sweep import sweep
from cpjax.study.summary import summarise

Report = Callable[[int, int, str], None]
LAWS = ("as-printed", "corrected")
"""The paper's two readings, from `cpjax.paper.LAWS`."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """A controller in a comparison."""

    name: str
    """Such as "paper, as printed"."""
    design: paper.Design
    gains: str
    """printed, computed or tuned."""
    controller: Hybrid


@dataclasses.dataclass(frozen=True)
class Compared:
    """An entry, and what it does at every start."""

    entry: Entry
    metrics: Metrics
    """Of (n,) arrays."""
    summary: Mapping[str, Any]
    """See `summarise`."""


def entries(plant: CartPole, tuned: Mapping[paper.Design, Hybrid] | None = None) -> list[Entry]:
    """The paper's controllers for `plant`, both laws and both gains; and a tuned one of each design.

    Args:
      tuned: instead of the ones that come with the package.
    """
    found = [
        Entry(f"paper, {law.replace('-', ' ')}", design, gains, paper.controller(law, design, plant, gains))
        for law in LAWS
        for design in DESIGNS
        for gains in GAINS
    ]
    chosen = {design: (tuned or {}).get(design) or preset(design) for design in DESIGNS}
    return found + [Entry("tuned", design, "tuned", controller) for design, controller in chosen.items()]


def compare(
    plant: CartPole,
    chosen: Sequence[Entry],
    setting: EvaluationConfig,
    *,
    track_limit: float = float("inf"),
    progress: Report | None = None,
) -> tuple[State, list[Compared]]:
    """Every entry over the same starts, as the protocol's evaluation runs; and the starts."""
    starts = sample_starts(setting.starts, setting.count, seed=setting.seed)
    results = []
    for i, entry in enumerate(chosen):
        if progress is not None:
            progress(i, len(chosen), f"{entry.name}, {entry.design}, {entry.gains}")
        metrics: Metrics = sweep(
            plant,
            without_design(entry.controller),
            starts,
            duration=setting.duration,
            dt=setting.dt,
            clock="sampled",
            metrics=ProtocolMetrics(track_limit=track_limit),
        )
        results.append(Compared(entry, metrics, summarise(metrics)))
    if progress is not None:
        progress(len(chosen), len(chosen), "done")
    return starts, results


def document(plant: CartPole, results: Sequence[Compared], setting: EvaluationConfig, **others: Any) -> dict[str, Any]:
    """The comparison for programs."""
    rows = [
        {
            "name": one.entry.name,
            "design": one.entry.design,
            "gains": one.entry.gains,
            "controller": io.encode(one.entry.controller),
            **one.summary,
        }
        for one in results
    ]
    return {
        "versions": io.versions(),
        "setting": dataclasses.asdict(setting),
        "plant": io.encode(plant),
        "rows": rows,
        **others,
    }


def best(results: Sequence[Compared], design: paper.Design, *, tuned: bool) -> Compared:
    """The controller of a design with the most successes, and of those the fastest."""
    pool = [one for one in results if one.entry.design == design and (one.entry.gains == "tuned") == tuned]

    def rank(one: Compared) -> tuple[float, float]:
        settling = float(one.summary["over_successes"]["settling_time"]["mean"])
        return -float(one.summary["success_rate"]), settling if np.isfinite(settling) else np.inf

    return min(pool, key=rank)
