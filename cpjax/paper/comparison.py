"""Comparison of tuned controllers with the paper's, by LQR and by pole placement."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from cpjax import files, io, paper
from cpjax.controllers import Hybrid
from cpjax.paper.reproduction import DESIGNS, GAINS, EvaluationConfig
from cpjax.plant import CartPole
from cpjax.plant.initial_states import sample_starts
from cpjax.plant.state import State
from cpjax.presets import preset
from cpjax.rig import Rig
from cpjax.sim.metrics import Metrics
from cpjax.sim.rollout import default_metrics
from cpjax.sim.sweep import sweep
from cpjax.study.summary import summarise

Report = Callable[[int, int, str], None]
LAWS = ("as-printed", "corrected")
"""The two readings of the paper's law that are compared, from `cpjax.paper.LAWS`."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """A controller in a comparison."""

    name: str
    """Name in tables, such as "paper, as printed"."""
    design: paper.Design
    gains: str
    """Origin of the gains: "printed", "computed" or "tuned"."""
    controller: Hybrid


@dataclasses.dataclass(frozen=True)
class Compared:
    """An entry, and its metrics over n initial states."""

    entry: Entry
    metrics: Metrics
    """Metrics as arrays (n,)."""
    summary: Mapping[str, Any]
    """Result of `summarise` for these metrics."""


def entries(plant: CartPole, tuned: Mapping[paper.Design, Hybrid] | None = None) -> list[Entry]:
    """Returns the paper's controllers for `plant`, of both laws and both gains, and a tuned one of each design.

    Args:
      plant: the laws' model, for which gains are computed.
      tuned: tuned controllers by design, in place of the package's presets.
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
    plant: CartPole | Rig,
    chosen: Sequence[Entry],
    setting: EvaluationConfig,
    *,
    track_limit: float = float("inf"),
    progress: Report | None = None,
    firmware: Callable[[Any], Any] | None = None,
    **simulation: Any,
) -> tuple[State, list[Compared]]:
    """Runs every entry from the same initial states, as the protocol's evaluation prescribes.

    Args:
      plant: the plant, or a rig with it.
      chosen: the entries.
      setting: initial states, duration and step of the evaluation.
      track_limit: largest |x| of a successful run [m]; a shorter track of the rig stays as it is.
      progress: called with the entries done, their number, and the next one in words.
      firmware: returns what runs around an entry's controller, such as a `cpjax.Digital`; by default itself.
      simulation: further arguments of `cpjax.sweep`, such as the control period.

    Returns:
      The initial states, arrays (count,), and the results in the order of the entries.
    """
    starts = sample_starts(setting.starts, setting.count, seed=setting.seed)
    usual: Any = default_metrics(plant)
    metric = dataclasses.replace(usual, track_limit=min(track_limit, float(usual.track_limit)))
    results = []
    for i, entry in enumerate(chosen):
        if progress is not None:
            progress(i, len(chosen), f"{entry.name}, {entry.design}, {entry.gains}")
        metrics: Metrics = sweep(
            plant,
            entry.controller if firmware is None else firmware(entry.controller),
            starts,
            duration=setting.duration,
            dt=setting.dt,
            clock="sampled",
            metrics=metric,
            **simulation,
        )
        results.append(Compared(entry, metrics, summarise(metrics)))
    if progress is not None:
        progress(len(chosen), len(chosen), "done")
    return starts, results


def document(
    plant: CartPole | Rig, results: Sequence[Compared], setting: EvaluationConfig, **others: Any
) -> dict[str, Any]:
    """Returns the comparison as plain values, for JSON, beside the entries of `others`."""
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
        "versions": files.versions(),
        "setting": dataclasses.asdict(setting),
        **io.encode_bench(plant),
        "rows": rows,
        **others,
    }


def best(results: Sequence[Compared], design: paper.Design, *, tuned: bool) -> Compared:
    """Returns the result of a design with the most successes, and among equals the least mean settling time.

    Args:
      results: the comparison.
      design: "lqr" or "placement".
      tuned: whether to choose among the tuned controllers or among the paper's.
    """
    pool = [one for one in results if one.entry.design == design and (one.entry.gains == "tuned") == tuned]

    def rank(one: Compared) -> tuple[float, float]:
        settling = float(one.summary["over_successes"]["settling_time"]["mean"])
        return -float(one.summary["success_rate"]), settling if np.isfinite(settling) else np.inf

    return min(pool, key=rank)
