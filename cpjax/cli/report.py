"""`cpjax report`: the main job, as one self-contained HTML page."""

import argparse
from typing import TYPE_CHECKING, Any, get_args

from cpjax import __version__, io, paper
from cpjax.cli import basin, pareto
from cpjax.cli.compare import compared
from cpjax.cli.options import EVALUATION_OPTIONS, Option, add_options, named_hybrid, resolve
from cpjax.cli.progress import progress
from cpjax.cli.reproduce import print_rows, rows_of
from cpjax.controllers import AngleGate
from cpjax.errors import InputError
from cpjax.study.design_check import check_design, document
from cpjax.study.forensics import audit_gains, write
from cpjax.study.front_plan import FrontPlan
from cpjax.study.printed_gains import printed_in_the_paper
from cpjax.study.reproduction import Setting

if TYPE_CHECKING:  # matplotlib takes a while; bad input should not wait for it
    from cpjax.show.page import Page


OPTIONS = [
    *EVALUATION_OPTIONS,
    Option("report", "cells", "of the basins, along each axis; 0 for none (default 256)", int),
    Option(
        "report", "fronts", "of the trade-offs (default quick; full takes minutes)", choices=("none", "quick", "full")
    ),
]
_QUICK: dict[str, Any] = {
    "bounds": 11,
    "candidates": 1024,
    "steps": 24,
    "judge_every": 6,
    "semifinal": 128,
    "final": 256,
}


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = "Runs the reproduction and the audit of the paper; writes report.html, JSON and pictures beside it."
    parser = commands.add_parser("report", help="the paper, run and audited, as one HTML page", description=text)
    add_options(parser, OPTIONS, out="out/report")
    parser.set_defaults(run=run, many_starts=True)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    chosen = sections["report"]
    if not 0 <= chosen.get("cells", 256) <= 4096 or chosen.get("cells") == 1:
        raise InputError("cells", chosen["cells"], "0, or a whole number from 2 to 4096")
    setting = Setting(seed=given.seed, **sections["evaluation"])
    rows = rows_of(given, setting)

    from cpjax.show.figures import png, save_figure, success_rates
    from cpjax.show.page import Page
    from cpjax.show.reproduction import HEADER, cells, findings, pictures

    page = Page(
        "Swing-up at 12 volts",
        "A student paper swings a pendulum up with an energy law and catches it with LQR or pole placement. "
        "Here are its controllers, as printed and as corrected, run from many starts.",
    )
    page.section("What was run")
    page.text(
        f"{setting.count} starts from the set `{setting.starts}` (seed {setting.seed}), {setting.duration:g} s each, "
        f"RK4 with a step of {1000 * setting.dt:g} ms, the control held over a step, the voltage clipped at 12 V. "
        "A run succeeds if from some moment, at least 1 s before its end, angle and cart stay within 0.05 rad and "
        "0.05 m of upright and centre."
    )
    page.section("What came out")
    for sentence in findings(rows):
        page.text(sentence)
    figure = success_rates(rows)
    save_figure(given.out / "success.png", figure)
    page.picture(png(figure), "Share of starts caught by each law, plant and regulator, with 95 % intervals.")
    page.table(HEADER, [cells(row) for row in rows], text_columns=4)
    page.note(
        "Settling, travel, effort and variation are over the successful runs, the peak voltage over all. "
        "Every number stands in `reproduction.json` beside this page."
    )
    page.section("The paper's Figures 3 to 6, from our runs")
    for name, figure, caption in pictures(setting):
        save_figure(given.out / f"{name}.png", figure)
        page.picture(png(figure), caption)
    _designs(page, given)
    _forensics(page, given)
    _comparison(page, given, setting)
    per_axis, fronts = chosen.get("cells", 256), chosen.get("fronts", "quick")
    if per_axis:
        _basins(page, given, per_axis)
    if fronts != "none":
        _fronts(page, given, fronts)
    page.section("How to get this page again")
    page.text(
        f"`cpjax report --starts {setting.starts} --count {setting.count} --seed {setting.seed} "
        f"--duration {_shortest(setting.duration)} --dt {_shortest(setting.dt)} --cells {per_axis} --fronts {fronts}` "
        f"with cpjax {__version__}."
    )
    path = given.out / "report.html"
    page.write(path)
    print_rows(rows)
    print(f"wrote {path}")
    return 0


def _designs(page: "Page", given: argparse.Namespace) -> None:
    """The paper's two regulators as linear designs."""
    from cpjax.show.design import COMPARISON, compared

    plant = paper.appendix_plant()
    gate = AngleGate(paper.SWITCH_ANGLE)
    checks = {
        (design, gains): check_design(plant, paper.regulator(design, gains, plant), gate)
        for design in get_args(paper.Design)
        for gains in get_args(paper.Gains)
    }
    io.write_json(given.out / "designs.json", {" ".join(key): document(check) for key, check in checks.items()})
    page.section("The two regulators as linear designs")
    page.text(
        "On the appendix's plant, linearised about upright, with the loop broken at the motor's voltage. Inside the "
        "certified level set the linear loop needs neither the 12 V clip nor the switch at 30 degrees; the last column "
        "has its widest angle."
    )
    page.table(COMPARISON, [compared(*key, check) for key, check in checks.items()], text_columns=2)
    page.note("Every number stands in `designs.json`; `cpjax design` checks any other regulator.")


def _forensics(page: "Page", given: argparse.Namespace) -> None:
    """Where the printed gains come from."""
    from cpjax.show.figures import png, save_figure
    from cpjax.show.forensics import (
        DIRECTION_HEADER,
        FIT_HEADER,
        direction_cells,
        findings,
        fit_cells,
        picture,
        shown_fits,
    )

    plant, prints = paper.appendix_plant(), printed_in_the_paper()
    with progress("audit-gains") as report:
        audit = audit_gains(prints, plant, starts=16, seed=given.seed, progress=report)
    write(given.out / "audit_gains.json", audit, prints, plant, seed=given.seed, starts=16)
    page.section("Where the printed gains come from")
    page.text(
        "The printed gains do not follow from the printed parameters. Which parameters would have to differ, and what "
        "do eight printed numbers say about a plant at all? Residuals are in units of the last printed digit."
    )
    for sentence in findings(audit):
        page.text(sentence)
    figure = picture(audit)
    save_figure(given.out / "audit_gains.png", figure)
    page.picture(
        png(figure),
        "Left: the worst residual when one or two parameters may change; a circle marks pairs that explain all eight "
        "gains. Right: how strongly the gains depend on each combination of parameters.",
    )
    page.table(FIT_HEADER, [fit_cells(fit, plant) for fit in shown_fits(audit)], text_columns=2)
    page.note("Every fit stands in `audit_gains.json`; `cpjax audit-gains` does the same for any printed gain.")
    known = [direction_cells(d) for d in audit.directions if d.sensitivity > 0.0]
    page.table(DIRECTION_HEADER, known, text_columns=1)


def _comparison(page: "Page", given: argparse.Namespace, setting: Setting) -> None:
    """The paper's controllers beside the tuned ones."""
    results = compared(given.out, paper.appendix_plant(), setting, {})

    from cpjax.show.comparison import HEADER, cells, findings

    page.section("Against tuned gains")
    page.text(
        "Energy gain, cart terms, gate and Q or poles, tuned together by gradients through whole swing-ups (`cpjax "
        "tune`), from the same starts as above, of which the tuning has seen none. Which of the two methods is better "
        "at 12 V?"
    )
    for sentence in findings(results):
        page.text(sentence)
    page.table(HEADER, [cells(one) for one in results], text_columns=3)
    page.note("Means over the successful runs. Every number stands in `compare.json` beside this page.")
    page.picture(
        (given.out / "responses.png").read_bytes(),
        "From one start: the best of the paper's controllers pumps for many swings; the tuned ones push and pull once.",
    )
    page.picture(
        (given.out / "by_start.png").read_bytes(),
        "Settling time by the angle and rate of the start, the paper's best above and tuned below; crosses fail.",
    )


def _basins(page: "Page", given: argparse.Namespace, cells: int) -> None:
    """Where the paper's and the tuned controllers work."""
    plant = paper.appendix_plant()
    controllers = {name: named_hybrid(name, plant) for name in basin.CONTROLLERS}
    chart = basin.chart_of({"cells": cells}, given.seed)
    _, header, rows = basin.table(basin.drawn(given.out, plant, controllers, chart, {"duration": 10.0, "dt": 0.002}))
    page.section("Where they work")
    page.text(
        "One run of 10 s from every cell of a map of angle and rate, the cart at rest in the middle. This is the whole "
        "hybrid loop with its clip, sampled, not certified: a start between two that succeed may fail."
    )
    page.picture(
        (given.out / "basin.png").read_bytes(),
        "The paper's controllers catch what comes along a narrow band; the tuned ones bring most of the plane to rest. "
        "The level set that the linear model certifies, in pink, is a speck of what works.",
    )
    page.table(header, rows, text_columns=1)
    page.note("Every number stands in `basin.json`, every run in the files that it names; `cpjax basin` draws others.")


def _fronts(page: "Page", given: argparse.Namespace, size: str) -> None:
    """What settling faster costs."""
    plan = FrontPlan(seed=given.seed, **(_QUICK if size == "quick" else {}))
    found = pareto.made(given.out, paper.appendix_plant(), plan, pareto.SUPPLIES)
    page.section("At what price")
    page.text(
        "LQR or pole placement, and what does settling faster cost? Each point is a controller that settles from "
        f"{100 * plan.success:g} % of unseen starts at least, and that no other found beats in both. Traced by "
        "gradients, many tunings side by side under one `vmap`, each with a bound on its cost; a random search of as "
        "many steps is drawn beside them. The hypervolumes reach up to 1.1 times the bland start."
    )
    page.picture(
        (given.out / "pareto.png").read_bytes(),
        "Down and left is better: tuned by gradients, both methods reach fronts that the same work of random search "
        "does not, and the two methods lie close together.",
    )
    page.picture(
        (given.out / "supplies.png").read_bytes(),
        "Settling time against effort at other supplies: with more voltage both methods settle faster, with less they "
        "need more swings, or find no catch.",
    )
    _, header, rows = pareto.table(found)
    page.table(header, rows, text_columns=2)
    for sentence in pareto.costs(found):
        page.note(sentence)
    page.note("Every point and its parameters stand in `pareto.json`; `cpjax pareto` traces them with more effort.")


def _shortest(seconds: float) -> str:
    """The number in as few digits as name it exactly."""
    return f"{seconds:g}" if float(f"{seconds:g}") == seconds else repr(seconds)
