"""`cpjax report`: the reproduction, the audits and the studies as one self-contained HTML page."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from cpjax import files, paper
from cpjax.cli.builders import EVALUATION_OPTIONS
from cpjax.cli.options import Option, add_options, resolve
from cpjax.cli.output import say
from cpjax.cli.reproduce import print_rows, rows_of
from cpjax.errors import InputError
from cpjax.paper.reproduction import EvaluationConfig
from cpjax.study.basin import MOST_CELLS
from cpjax.workspace import Workspace

OPTIONS = [
    *EVALUATION_OPTIONS,
    Option("report", "cells", "of the basins, along each axis; 0 for none (default 192)", int),
    Option(
        "report",
        "studies",
        "gradient audit, tuning, animation and trade-offs (default quick; full takes minutes)",
        choices=("none", "quick", "full"),
    ),
]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "Runs the reproduction and the audits of the paper, gradients, tuning, comparison, basins and fronts; writes "
        "report.html, and JSON and pictures beside it."
    )
    parser = commands.add_parser("report", help="the paper, run and audited, as one HTML page", description=text)
    add_options(parser, OPTIONS, out="out/report")
    parser.set_defaults(run=run, many_starts=True)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    chosen = sections["report"]
    if not 0 <= chosen.get("cells", 192) <= MOST_CELLS or chosen.get("cells") == 1:
        raise InputError("cells", chosen["cells"], f"0, or a whole number from 2 to {MOST_CELLS}")
    setting = EvaluationConfig(seed=given.seed, **sections["evaluation"])
    per_axis, studies = chosen.get("cells", 192), chosen.get("studies", "quick")
    asked = {"setting": dataclasses.asdict(setting), "cells": per_axis, "studies": studies}
    asked["versions"] = files.versions()
    with Workspace(given.out / "report.parts", asked) as memory:
        rows = write_report(given, memory.folder, setting, per_axis, studies)
    print_rows(rows)
    say(f"wrote {given.out / 'report.html'}")
    return 0


def write_report(
    given: argparse.Namespace, parts: Path, setting: EvaluationConfig, per_axis: int, studies: str
) -> list[dict[str, Any]]:
    """Runs the reproduction and all studies, writes the page and its files, and returns the reproduction's rows.

    Args:
      given: the options; `out` and `seed` are read.
      parts: folder in which long studies save what is done.
      per_axis: cells of the basins along each axis; 0 for none.
      studies: none, quick or full.
    """
    rows = rows_of(given.out, parts / "reproduction", setting)

    from cpjax.cli import report_sections as sections_of  # matplotlib is slow; bad input should fail before
    from cpjax.cli.compare import run_comparison
    from cpjax.show import comparison
    from cpjax.show.figures import save_figure, success_rates
    from cpjax.show.page import Page

    results, shown_start, drawn = run_comparison(given.out, paper.appendix_plant(), setting, {})
    page = Page(
        "Swing-up at 12 volts",
        "A student paper swings a pendulum up with an energy law and catches it with LQR or pole placement: here are "
        "its controllers, as printed, as corrected and as tuned by gradients, run from many initial states.",
    )
    page.numbers(comparison.headline(results))
    picture = save_figure(given.out / "success.png", success_rates(rows))
    page.picture(picture, "Share of initial states caught by each law, plant and regulator, with 95 % intervals.")
    sections_of.setup(page, setting)
    sections_of.results(page, rows, results)
    sections_of.paper_figures(page, given, setting)
    sections_of.designs(page, given)
    sections_of.gain_identification(page, given)
    if studies != "none":
        sections_of.gradients(page, given, studies)
        sections_of.tuning(page, given, parts, studies)
    sections_of.comparison(page, results, shown_start, drawn)
    if studies != "none":
        sections_of.animation(page, given)
    if studies != "none":
        sections_of.bench(page, given, studies)
    if per_axis:
        sections_of.basins(page, given, parts, per_axis)
    if studies != "none":
        sections_of.fronts(page, given, parts, studies)
    sections_of.how_to_reproduce(page, setting, per_axis, studies)
    page.write(given.out / "report.html")
    return rows
