"""Reproduction of the paper: every law on every plant with every gain, over one seeded set of initial states."""

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cpjax import files, paper
from cpjax.plant.initial_states import check_starts, sample_starts
from cpjax.plant.state import HANGING, State
from cpjax.sim.metrics import Metrics
from cpjax.sim.rollout import Trajectory, rollout
from cpjax.sim.settings import check_settings
from cpjax.sim.sweep import sweep
from cpjax.study.summary import summarise
from cpjax.workspace import Workspace

DESIGNS: tuple[paper.Design, ...] = ("placement", "lqr")
GAINS: tuple[paper.Gains, ...] = ("printed", "computed")


@dataclasses.dataclass(frozen=True)
class Variant:
    """One of the paper's controllers on one of its plants."""

    law: str
    plant: str
    design: paper.Design
    gains: paper.Gains


@dataclasses.dataclass(frozen=True)
class EvaluationConfig:
    """Configuration of the protocol's evaluation: RK4, and the sampled clock with one control instant per step.

    Attributes:
      starts: name of the set of initial states.
      count: number of initial states.
      seed: of the initial states.
      duration: of the runs [s].
      dt: step and control period [s].

    Raises:
      InputError: a value outside its range.
    """

    starts: str = "hanging"
    count: int = 4096
    seed: int = 1
    duration: float = 20.0
    dt: float = 0.002

    def __post_init__(self) -> None:
        check_settings(duration=self.duration, dt=self.dt)
        check_starts(self.starts, self.count, self.seed)


def variants() -> list[Variant]:
    """Returns all variants, in the order of the tables."""
    return [Variant(*choice) for choice in itertools.product(paper.LAWS, paper.PLANTS, DESIGNS, GAINS)]


def evaluate(variant: Variant, setting: EvaluationConfig, starts: State | None = None) -> Metrics:
    """Returns the metrics of one variant, arrays (n,).

    Args:
      variant: the controller and the plant.
      setting: configuration of the evaluation.
      starts: initial states, arrays (n,); by default the setting's.
    """
    plant = paper.PLANTS[variant.plant]()
    controller = paper.controller(variant.law, variant.design, plant, variant.gains)
    if starts is None:
        starts = sample_starts(setting.starts, setting.count, seed=setting.seed)
    metrics: Metrics = sweep(plant, controller, starts, duration=setting.duration, dt=setting.dt, clock="sampled")
    return metrics


def reproduce(
    setting: EvaluationConfig,
    *,
    progress: Callable[[int, int, str], None] | None = None,
    path: Path | None = None,
    parts: Path | None = None,
) -> list[dict[str, Any]]:
    """Returns one row per variant: its names, and the result of `summarise` for its metrics.

    Args:
      setting: configuration of the evaluation.
      progress: called with the rows done, their number, and the next row in words.
      path: JSON file to write the rows to, if any.
      parts: with `path`, the folder in which each row is saved when it is done, by default `path` with ".parts" at its
        end. A run with the same setting and versions that was interrupted resumes there; the folder is removed at the
        end.

    Raises:
      InputError: a `path` that cannot be written, or `parts` of another computation.
    """
    if path is None:
        return _rows(setting, progress, None)
    what = {
        "what": "the paper's controllers over a seeded set of initial states",
        "versions": files.versions(),
        "setting": dataclasses.asdict(setting),
    }
    with Workspace(parts or path.with_name(path.name + ".parts"), what) as memory:
        rows = _rows(setting, progress, memory)
        files.write_json(path, {**what, "complete": True, "rows": rows})
    return rows


def _rows(
    setting: EvaluationConfig, progress: Callable[[int, int, str], None] | None, memory: Workspace | None
) -> list[dict[str, Any]]:
    starts = sample_starts(setting.starts, setting.count, seed=setting.seed)
    todo = variants()
    rows = []
    for number, variant in enumerate(todo):
        known = None if memory is None else memory.load(f"row-{number:02d}")
        if known is None:
            if progress is not None:
                progress(number, len(todo), f"{variant.law}, {variant.plant}, {variant.design}, {variant.gains}")
            known = {}, {**dataclasses.asdict(variant), **summarise(evaluate(variant, setting, starts))}
            if memory is not None:
                memory.save(f"row-{number:02d}", *known)
        rows.append(known[1])
    if progress is not None:
        progress(len(todo), len(todo), "done")
    return rows


def representative(law: str, plant: str, setting: EvaluationConfig) -> tuple[str, State]:
    """Returns description and initial state of a run that represents a law with both regulators.

    Hanging exactly at rest, for a law that leaves that equilibrium. For other laws, of the initial states from which
    both regulators settle with the printed gains, the one whose longer settling time is the median; the set's first if
    there is none.

    Args:
      law: a key of `cpjax.paper.LAWS`.
      plant: a key of `cpjax.paper.PLANTS`.
      setting: configuration of the evaluation.
    """
    if law.startswith("corrected") and law != "corrected-as-voltage":
        return "exactly hanging at rest", HANGING
    starts = sample_starts(setting.starts, setting.count, seed=setting.seed)
    both = [evaluate(Variant(law, plant, design, "printed"), setting, starts) for design in DESIGNS]
    times = np.max([np.where(one.success, np.asarray(one.settling_time), np.inf) for one in both], axis=0)
    successes = int(np.isfinite(times).sum())
    index = int(np.argsort(times)[(successes - 1) // 2]) if successes else 0
    words = "the median of those that both catch," if successes else "the first, for none is caught by both,"
    start: State = jax.tree.map(lambda column: float(column[index]), starts)
    return f"{words} of {setting.count} {setting.starts} initial states (number {index + 1})", start


def trajectory(law: str, design: paper.Design, plant: str, start: State, setting: EvaluationConfig) -> Trajectory:
    """Simulates one run with the printed gains, under the protocol.

    Args:
      law: a key of `cpjax.paper.LAWS`.
      design: "lqr" or "placement".
      plant: a key of `cpjax.paper.PLANTS`.
      start: the initial state.
      setting: configuration of the evaluation.
    """
    model = paper.PLANTS[plant]()
    controller = paper.controller(law, design, model)
    return rollout(model, controller, start, duration=setting.duration, dt=setting.dt, clock="sampled")


Setting = EvaluationConfig
"""The name until version 0.1."""
