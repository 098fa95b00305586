"""`cpjax pareto`: trade-off fronts of settling time against cost, for LQR and for pole placement."""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from cpjax import files, io, paper
from cpjax.cli.builders import PLANT_OPTIONS
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import Option, add_options, options_of, resolve
from cpjax.cli.output import say
from cpjax.cli.progress import compiling, progress
from cpjax.cli.rigs import RIG_OPTIONS, build_rig, refuse_parts
from cpjax.cli.tables import print_table
from cpjax.errors import InputError
from cpjax.paper.comparison import Compared, compare, entries
from cpjax.paper.reproduction import DESIGNS, EvaluationConfig
from cpjax.plant import CartPole
from cpjax.rig import Rig, plant_of
from cpjax.study.fronts.config import COSTS, FrontConfig
from cpjax.workspace import Workspace

if TYPE_CHECKING:  # slow to import
    from cpjax.show.front import Curve
    from cpjax.study.fronts.reference_point import ReferencePoints

Found: TypeAlias = dict[paper.Design, dict[str, Any]]
"""The fronts of each design, as plain values."""

SUPPLIES = (6.0, 9.0, 24.0)
_LOWEST_SUPPLY, _HIGHEST_SUPPLY = 0.01, 10_000.0
OPTIONS = [
    *options_of("front", FrontConfig, ["bounds", "candidates", "steps", "batch", "final"], defaults=True),
    Option(
        "front",
        "supplies",
        "further voltage limits for settling time against effort (default "
        + " ".join(f"{v:g}" for v in SUPPLIES)
        + ")",
        float,
        count="+",
    ),
    *PLANT_OPTIONS,
    *RIG_OPTIONS,
]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "Traces fronts of settling time against effort, cart travel and variation of the voltage, for LQR and for pole "
        "placement, by many tunings side by side; and what random search finds at the same cost. Writes pareto.json, "
        "pareto.png and supplies.png. Takes ten minutes on 2 cores; an interrupted run goes on from the last "
        "search that it has finished."
    )
    parser = commands.add_parser("pareto", help="what settling faster costs, as fronts", description=text)
    add_options(parser, OPTIONS, out="out/pareto")
    parser.set_defaults(run=run, many_starts=True)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    rig = build_rig(sections["plant"])
    refuse_parts(rig, "pareto", honoured=("track",))
    plant = plant_of(rig)
    chosen = dict(sections["front"])
    supplies = tuple(chosen.pop("supplies", SUPPLIES))
    for supply in supplies:
        if not _LOWEST_SUPPLY <= supply <= _HIGHEST_SUPPLY:
            raise InputError("supplies", supply, f"from {_LOWEST_SUPPLY:g} to {_HIGHEST_SUPPLY:g} V")
    plan = FrontConfig(seed=given.seed, **chosen)
    notes = notes_on(sections["plant"], plant)
    announce("pareto", notes)
    found, _ = run_pareto(given.out, given.out / "pareto.parts", rig, plan, supplies, notes)
    print_table(*table(found), text_columns=2)
    from cpjax.show.front import findings

    say(*findings(curves_of(found)), *costs(found))
    say(f"wrote {given.out / 'pareto.json'}, pareto.png and supplies.png")
    return 0


def run_pareto(
    out: Path,
    parts: Path,
    rig: Rig | CartPole,
    plan: FrontConfig,
    supplies: tuple[float, ...],
    notes: Sequence[str] = (),
) -> tuple[Found, dict[str, bytes]]:
    """Traces the fronts of both designs and writes pareto.json, pareto.png and supplies.png.

    Args:
      parts: folder of finished searches, from which an interrupted run goes on; removed at the end.
      rig: the plant, or a rig, of which plant and track count.
      supplies: further voltage limits for settling time against effort [V].
      notes: for the JSON.

    Returns:
      The fronts, and the pictures by name.
    """
    from cpjax.study.fronts.reference_point import reference_points

    plant = plant_of(rig)
    request = {"plan": dataclasses.asdict(plan), **io.encode_bench(rig), "supplies": supplies}
    with Workspace(parts, {**request, "versions": files.versions()}) as memory:
        measure = reference_points(rig, plan, supplies)
        found = {design: trace_design(memory, rig, design, plan, supplies, measure) for design in DESIGNS}
        known = known_controllers(rig, plan)
        document = {
            "what": "mean settling time against mean cost, of controllers that no other found beats",
            "versions": files.versions(),
            "plan": dataclasses.asdict(plan),
            **io.encode_bench(rig),
            "fronts": found,
            "notes": notes,
            "known": [{"name": name, "design": one.entry.design, **one.summary} for name, one in known],
        }
        pictures = draw(plant, found, known)
        for name, picture in pictures.items():
            files.write_bytes(out / f"{name}.png", picture)
        files.write_json(out / "pareto.json", document)
    return found, pictures


def known_controllers(rig: Rig | CartPole, plan: FrontConfig) -> list[tuple[str, Compared]]:
    """Evaluates the paper's printed gains and cpjax's presets from the initial states that measure the points."""
    from cpjax.study.fronts.evaluator import FINAL
    from cpjax.tune.descent import derive_seed

    setting = EvaluationConfig(
        count=plan.final, seed=derive_seed(plan.seed, FINAL, 0), duration=plan.horizon, dt=plan.final_dt
    )
    plant = plant_of(rig)
    chosen = [one for one in entries(plant) if one.gains != "computed"]
    own = io.encode(plant) == io.encode(paper.appendix_plant())
    preset = "tuned, as shipped" if own else "as shipped for the appendix's plant"
    compared = compare(rig, chosen, setting)[1]
    return [(preset if one.entry.gains == "tuned" else one.entry.name, one) for one in compared]


def trace_design(
    memory: Workspace,
    rig: Rig | CartPole,
    design: paper.Design,
    plan: FrontConfig,
    supplies: tuple[float, ...],
    measure: "ReferencePoints",
) -> dict[str, Any]:
    """Traces a design's fronts, saved in `memory`, from where an interrupted run goes on; returns plain values."""
    known = memory.load(f"{design}-fronts")
    if known is not None:
        plain: dict[str, Any] = known[1]
        return plain

    from cpjax.study.fronts.trace import trace_fronts  # imports optax, which is slow; other commands need none

    with progress(f"pareto, {design}") as report:
        fronts = trace_fronts(
            rig,
            design,
            plan,
            measure.reference,
            supplies=supplies,
            report=compiling(report, "screening"),
            memory=memory,
        )
    rows = [
        {
            "supply": supply,
            "cost": cost,
            "baseline": measure.baseline[design][supply, cost].tolist(),
            "reference": measure.reference[supply, cost].tolist(),
            **{
                kind: {
                    "points": front.points.tolist(),
                    "success": front.success.tolist(),
                    "vectors": front.vectors.tolist(),
                    "volume": front.volume,
                    "best_success": front.best_success,
                }
                for kind, front in (("traced", fronts.traced[supply, cost]), ("random", fronts.random[supply, cost]))
            },
        }
        for supply, cost in fronts.traced
    ]
    steps = [{"supply": supply, **counted} for supply, counted in fronts.steps.items()]
    found = {"rows": rows, "steps": steps, "seconds": fronts.seconds}
    memory.save(f"{design}-fronts", {}, found)
    return found


def draw(plant: CartPole, found: Found, controllers: list[tuple[str, Compared]]) -> dict[str, bytes]:
    """Returns the pictures "pareto" and "supplies"."""
    from cpjax.show.figures import png
    from cpjax.show.front import Known, by_supply, fronts

    own = float(plant.motor.voltage_limit)
    curves = curves_of(found)
    known = {
        cost: [
            Known(name, one.entry.design, time, one.summary["over_successes"][cost]["mean"], rate)
            for name, one in controllers
            if (rate := one.summary["success_rate"]) > 0.0
            for time in [one.summary["over_successes"]["settling_time"]["mean"]]
        ]
        for cost in COSTS
    }
    baseline: dict[str, dict[str, Any]] = {cost: {} for cost in COSTS}
    for design in DESIGNS:
        for row in found[design]["rows"]:
            if row["supply"] == own:
                baseline[row["cost"]][design] = np.asarray(row["baseline"], float)
    supplies = {supply: designs for (supply, cost), designs in curves.items() if cost == "effort"}
    of_all_costs = fronts({cost: curves[own, cost] for cost in COSTS}, baseline, known)
    return {"supplies": png(by_supply(supplies)), "pareto": png(of_all_costs)}


def curves_of(found: Found) -> "dict[tuple[float, str], dict[str, Curve]]":
    """Returns the fronts by (supply [V], cost) and design."""
    from cpjax.show.front import Curve

    curves: dict[tuple[float, str], dict[str, Curve]] = {}
    for design in DESIGNS:
        for row in found[design]["rows"]:
            traced, random = (np.reshape(row[kind]["points"], (-1, 2)) for kind in ("traced", "random"))
            curve = Curve(traced, random, row["traced"]["volume"], row["random"]["volume"])
            curves.setdefault((row["supply"], row["cost"]), {})[design] = curve
    return curves


def table(found: Found) -> tuple[str, tuple[str, ...], list[tuple[str, ...]]]:
    """Returns title, header and cells of the printed table."""
    header = ("regulator", "cost", "supply [V]", "points", "fastest [s]", "cheapest", "hypervolume", "of random search")
    cells: list[tuple[str, ...]] = [
        (
            design,
            row["cost"],
            f"{row['supply']:g}",
            str(len(row["traced"]["points"])) if row["traced"]["points"] else _none(row["traced"]),
            f"{row['traced']['points'][0][0]:.3f}" if row["traced"]["points"] else "-",
            f"{row['traced']['points'][-1][1]:.4g}" if row["traced"]["points"] else "-",
            f"{row['traced']['volume']:.4g}",
            f"{row['random']['volume']:.4g}",
        )
        for design in DESIGNS
        for row in found[design]["rows"]
    ]
    return "Fronts of settling time against a cost", header, cells


def costs(found: Found) -> list[str]:
    """Returns one sentence per design with the steps and the time of its search."""
    sentences = []
    for design in DESIGNS:
        total = {kind: sum(one[kind] for one in found[design]["steps"]) for kind in ("values", "gradients", "random")}
        steps = {kind: f"{count / 1e6:.0f} M" for kind, count in total.items()}
        sentences.append(
            f"{design}: {steps['values']} steps of values and {steps['gradients']} of gradients by the tracing, "
            f"{steps['random']} of values by the random search; {found[design]['seconds']:.0f} s"
        )
    return sentences


def _none(front: dict[str, Any]) -> str:
    """Returns the text in place of the number of points of an empty front."""
    return f"none (the best settles from {100 * front['best_success']:.1f} %)"
