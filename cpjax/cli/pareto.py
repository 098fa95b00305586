"""`cpjax pareto`: what settling faster costs, by LQR and by pole placement, as fronts."""

import argparse
import dataclasses
import time
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from cpjax import io, paper
from cpjax.cli.options import PLANT_OPTIONS, Option, add_options, build_plant, resolve
from cpjax.cli.progress import progress
from cpjax.cli.tables import print_table
from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.study.comparison import Compared, compare, entries
from cpjax.study.front_plan import COSTS, FrontPlan
from cpjax.study.reproduction import DESIGNS, Setting

Found: TypeAlias = dict[paper.Design, dict[str, Any]]
"""The fronts of each design, as plain values."""

SUPPLIES = (6.0, 9.0, 24.0)
_PLANNED = {
    "bounds": "tunings for each cost and supply",
    "candidates": "random controllers to begin with",
    "steps": "of the optimiser",
    "batch": "starts of a step",
    "final": "starts that the points are measured from",
}

OPTIONS = [
    *(Option("front", key, f"{text} (default {getattr(FrontPlan, key)})", int) for key, text in _PLANNED.items()),
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
]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "Traces fronts of settling time against effort, cart travel and variation of the voltage, for LQR and for pole "
        "placement, by many tunings side by side; and what random search finds at the same cost. Writes pareto.json, "
        "pareto.png and supplies.png. An interrupted run keeps the design that it has finished."
    )
    parser = commands.add_parser("pareto", help="what settling faster costs, as fronts", description=text)
    add_options(parser, OPTIONS, out="out/pareto")
    parser.set_defaults(run=run, many_starts=True)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    plant = build_plant(sections["plant"])
    chosen = dict(sections["front"])
    supplies = tuple(chosen.pop("supplies", SUPPLIES))
    for supply in supplies:
        if not 0.0 < supply < float("inf"):
            raise InputError("supplies", supply, "finite numbers above 0 [V]")
    plan = FrontPlan(seed=given.seed, **chosen)
    found = made(given.out, plant, plan, supplies)
    print_table(*table(found), text_columns=2)
    print(*costs(found), sep="\n")
    print(f"wrote {given.out / 'pareto.json'}, pareto.png and supplies.png")
    return 0


def made(out: Path, plant: CartPole, plan: FrontPlan, supplies: tuple[float, ...]) -> Found:
    """The fronts of both designs, with pareto.json, pareto.png and supplies.png written."""
    found = {design: traced(out, plant, design, plan, supplies) for design in DESIGNS}
    known = compare(plant, entries(plant), Setting(count=plan.final, seed=plan.seed))[1]
    document = {
        "what": "mean settling time against mean cost, of controllers that no other found beats",
        "versions": io.versions(),
        "plan": dataclasses.asdict(plan),
        "plant": io.encode(plant),
        "fronts": found,
        "known": [{"name": _name(one), "design": one.entry.design, **one.summary} for one in known],
    }
    io.write_json(out / "pareto.json", document)
    draw(out, plant, found, known)
    for design in DESIGNS:
        _part(out, design).unlink(missing_ok=True)
    return found


def traced(
    out: Path, plant: CartPole, design: paper.Design, plan: FrontPlan, supplies: tuple[float, ...]
) -> dict[str, Any]:
    """A design's fronts as plain values, from the part that an interrupted run left if there is one."""
    from cpjax.study.front import trace_fronts  # optax takes a while; other commands should not wait for it

    request = io.dump_json(
        {"plan": dataclasses.asdict(plan), "plant": io.encode(plant), "supplies": supplies, "versions": io.versions()}
    )
    path = _part(out, design)
    if path.exists():
        part = io.read_table(path)
        if part["request"] == request:
            found: dict[str, Any] = part["found"]
            return found
    begin = time.perf_counter()
    with progress(f"pareto, {design}") as report:
        fronts = trace_fronts(plant, design, plan, supplies=supplies, report=report)
    rows = [
        {
            "supply": supply,
            "cost": cost,
            "bland": fronts.bland[supply, cost].tolist(),
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
    result = {"rows": rows, "steps": fronts.steps, "seconds": time.perf_counter() - begin}
    io.write_json(path, {"request": request, "found": result})
    return result


def draw(out: Path, plant: CartPole, found: Found, compared: list[Compared]) -> None:
    """The pictures."""
    from cpjax.show.figures import save_figure
    from cpjax.show.front import Curve, Known, by_supply, fronts

    own = float(plant.motor.voltage_limit)

    def row_of(design: paper.Design, supply: float, cost: str) -> dict[str, Any]:
        rows: list[dict[str, Any]] = found[design]["rows"]
        return next(row for row in rows if row["supply"] == supply and row["cost"] == cost)

    def curve(design: paper.Design, supply: float, cost: str) -> Curve:
        row = row_of(design, supply, cost)
        traced, random = (np.reshape(row[kind]["points"], (-1, 2)) for kind in ("traced", "random"))
        return Curve(traced, random, row["traced"]["volume"], row["random"]["volume"])

    known = {
        cost: [
            Known(_name(one), one.entry.design, time, one.summary["over_successes"][cost]["mean"], rate)
            for one in compared
            if one.entry.gains != "computed" and (rate := one.summary["success_rate"]) > 0.0
            for time in [one.summary["over_successes"]["settling_time"]["mean"]]
        ]
        for cost in COSTS
    }
    curves: dict[str, dict[str, Curve]] = {
        cost: {design: curve(design, own, cost) for design in DESIGNS} for cost in COSTS
    }
    bland: dict[str, dict[str, Any]] = {
        cost: {design: np.asarray(row_of(design, own, cost)["bland"]) for design in DESIGNS} for cost in COSTS
    }
    save_figure(out / "pareto.png", fronts(curves, bland, known))
    supplies = [row["supply"] for row in found[DESIGNS[0]]["rows"] if row["cost"] == "effort"]
    panels: dict[float, dict[str, Curve]] = {
        supply: {design: curve(design, supply, "effort") for design in DESIGNS} for supply in supplies
    }
    save_figure(out / "supplies.png", by_supply(panels))


def table(found: Found) -> tuple[str, tuple[str, ...], list[tuple[str, ...]]]:
    """Title, header and cells, for people."""
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
    """What each design's search took, in words."""
    sentences = []
    for design in DESIGNS:
        steps = {kind: f"{count / 1e6:.0f} M" for kind, count in found[design]["steps"].items()}
        sentences.append(
            f"{design}: {steps['values']} steps of values and {steps['gradients']} of gradients by the tracing, "
            f"{steps['random']} of values by the random search; {found[design]['seconds']:.0f} s"
        )
    return sentences


def _none(front: dict[str, Any]) -> str:
    """Instead of a number of points."""
    return f"none (at best {100 * front['best_success']:.0f} % settle)"


def _part(out: Path, design: str) -> Path:
    return out / f"pareto-{design}.part.json"


def _name(one: Compared) -> str:
    return "tuned" if one.entry.gains == "tuned" else one.entry.name
