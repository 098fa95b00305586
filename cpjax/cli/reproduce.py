"""`cpjax reproduce`: the paper's controllers over a seeded set of initial states, as a table, pictures and JSON."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cpjax.cli.builders import EVALUATION_OPTIONS
from cpjax.cli.options import add_options, resolve
from cpjax.cli.output import say
from cpjax.cli.progress import progress
from cpjax.cli.tables import print_table
from cpjax.paper.reproduction import EvaluationConfig, reproduce


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "Every swing-up law, plant, regulator and gain of the paper over one seeded set of initial states. Writes "
        "reproduction.json, success.png and our figures in the places of the paper's Figures 3 to 6. An interrupted "
        "run goes on where it stopped."
    )
    parser = commands.add_parser("reproduce", help="the paper's controllers over many initial states", description=text)
    add_options(parser, EVALUATION_OPTIONS, out="out/reproduce")
    parser.set_defaults(run=run, many_starts=True)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    setting = setting_of(given)
    rows = rows_of(given.out, given.out / "reproduction.parts", setting)

    from cpjax.show.figures import save_figure, success_rates
    from cpjax.show.reproduction import findings, pictures

    save_figure(given.out / "success.png", success_rates(rows))
    for name, figure, caption in pictures(setting):
        save_figure(given.out / f"{name}.png", figure)
        say(caption)
    print_rows(rows)
    say(*findings(rows))
    say(f"wrote {given.out / 'reproduction.json'} and the pictures beside it")
    return 0


def setting_of(given: argparse.Namespace) -> EvaluationConfig:
    """Returns the evaluation's configuration from the options."""
    return EvaluationConfig(seed=given.seed, **resolve(given, EVALUATION_OPTIONS)["evaluation"])


def rows_of(out: Path, parts: Path, setting: EvaluationConfig) -> list[dict[str, Any]]:
    """Runs the reproduction, shows its progress, writes reproduction.json and returns its rows.

    Args:
      out: folder of the file.
      parts: folder of finished rows, from which an interrupted run goes on; removed at the end.
      setting: configuration of the evaluation.
    """
    with progress("reproduce") as report:
        return reproduce(setting, progress=report, path=out / "reproduction.json", parts=parts)


def print_rows(rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints the table."""
    from cpjax.show.reproduction import HEADER, cells

    title = "Settling, travel, effort and variation over successes; peak over all runs"
    print_table(title, HEADER, map(cells, rows), text_columns=4)
