"""`cpjax rig`: the public rigs, a rig's file, and what a rig can do."""

import argparse
import math
from pathlib import Path
from typing import Any

from cpjax import files
from cpjax.bridges.models import load_model
from cpjax.bridges.mujoco import save_mjcf
from cpjax.cli.options import Option, add_options, resolve
from cpjax.cli.output import complain, say
from cpjax.cli.rig_file import rig_text
from cpjax.cli.rigs import load_rig
from cpjax.cli.tables import print_table
from cpjax.rig import PRESETS
from cpjax.study.rig_check import Figure, RigCheck, check_rig, document

_READ = "Numbers are in SI units. --rig of cpjax's commands and cpjax.load read this file."
_PERIOD = 0.002  # control period of the other commands [s]

CHECK_OPTIONS = [
    Option("check", "period", f"control period [s] (default that of a rig given by name, and else {_PERIOD:g})", float)
]


def add_command(commands: Any) -> None:
    """Declares the command and its subcommands."""
    text = "Public rigs by name, the file of a rig, with comments, and what a rig can do. Other commands take --rig."
    parser = commands.add_parser("rig", help="public rigs, files of rigs, and checks", description=text)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)

    known = actions.add_parser("list", help="the public rigs", description="Lists the public rigs with their sources.")
    known.set_defaults(run=run_list)

    text = (
        "Prints a rig as a TOML file with comments, for `cpjax rig show NAME > mine.toml`; --rig mine.toml and "
        "cpjax.load read it."
    )
    shown = actions.add_parser("show", help="a rig as a file with comments", description=text)
    _add_name(shown)
    shown.set_defaults(run=run_show)

    text = (
        "Says what moves and how fast, how finely it is measured, what the linear model asks of the control period, "
        "whether track and supply allow a swing-up, and what its file leaves at ideal values. Writes rig.json."
    )
    checked = actions.add_parser(
        "check", help="what a rig can do, and what its file leaves at ideal values", description=text
    )
    _add_name(checked)
    add_options(checked, CHECK_OPTIONS, out="out/rig")
    checked.set_defaults(run=run_check, many_starts=True)

    text = (
        "Reads a cart-pole from a MuJoCo (MJCF) or URDF file and prints it as a TOML file with comments, for "
        "`cpjax rig import cartpole.xml > mine.toml`. MJCF needs the package mujoco. Notes say how the file's joints "
        "relate to x and theta."
    )
    imported = actions.add_parser("import", help="a cart-pole of another simulator as a file", description=text)
    imported.add_argument("file", metavar="FILE", help="an MJCF (.xml) or URDF file")
    imported.set_defaults(run=run_import)

    text = "Writes a rig's plant, drive and track as a MuJoCo (MJCF) file. Its sensors are left out."
    exported = actions.add_parser("export", help="a rig as a MuJoCo file", description=text)
    _add_name(exported)
    exported.add_argument("--out", type=Path, default=Path("out/rig"), help="folder for rig.xml (default out/rig)")
    exported.set_defaults(run=run_export)


def _add_name(parser: Any) -> None:
    parser.add_argument("name", metavar="NAME|FILE", help=f"{', '.join(PRESETS)}, or a file with a rig or a cart-pole")


def run_list(given: argparse.Namespace) -> int:
    """Runs `cpjax rig list`."""
    rows = [(name, f"{one.period:g}", one.source, one.note) for name, one in PRESETS.items()]
    print_table("Public rigs", ("name", "period [s]", "source", "note"), rows, text_columns=4)
    return 0


def run_show(given: argparse.Namespace) -> int:
    """Runs `cpjax rig show`."""
    rig = load_rig(given.name)
    say(*rig_text(rig, _heading(given.name)).splitlines())
    return 0


def run_import(given: argparse.Namespace) -> int:
    """Runs `cpjax rig import`."""
    model = load_model(given.file)
    for note in model.notes():
        complain(f"cpjax rig: note: {note}")
    heading = [f"The cart-pole of {given.file}.", *model.notes(), _READ]
    say(*rig_text(model.rig, heading).splitlines())
    return 0


def run_export(given: argparse.Namespace) -> int:
    """Runs `cpjax rig export`."""
    path = given.out / "rig.xml"
    save_mjcf(path, load_rig(given.name))
    say(f"wrote {path}")
    return 0


def _heading(name: str) -> list[str]:
    if name not in PRESETS:
        return [f"The rig of {name}.", _READ]
    one = PRESETS[name]
    usual = f"Usual control period: {one.period:g} s, which a file does not hold: --control-period {one.period:g}."
    return [f"{name}. Source: {one.source}.", f"Note: {one.note}.", usual, _READ]


def run_check(given: argparse.Namespace) -> int:
    """Runs `cpjax rig check`."""
    rig = load_rig(given.name)
    usual = PRESETS[given.name].period if given.name in PRESETS else _PERIOD
    period = resolve(given, CHECK_OPTIONS)["check"].get("period", usual)
    complain("cpjax rig: searching for a swing-up")
    check = check_rig(rig, period=period, seed=given.seed)
    path = given.out / "rig.json"
    files.write_json(path, document(check, rig, name=given.name, seed=given.seed))
    rows = [(figure.words, *_shown(figure)) for figure in check.figures]
    print_table(f"The rig {given.name}", ("figure", "value", "unit"), [*rows, *_search_rows(check)], text_columns=1)
    for warning in check.warnings:
        say(f"- {warning}")
    say(f"wrote {path}")
    return 0


def _shown(figure: Figure) -> tuple[str, str]:
    """Returns a figure's value and unit as text; angles in degrees."""
    if figure.value is None or isinstance(figure.value, bool):
        return {None: "-", True: "yes", False: "no"}[figure.value], figure.unit
    unit = figure.unit
    if figure.key == "hold_angle":
        return f"{math.degrees(figure.value):.3g}", "deg"
    return f"{figure.value:.4g}" + (f" ({figure.remark})" if figure.remark else ""), unit if unit != "1" else ""


def _search_rows(check: RigCheck) -> list[tuple[str, str, str]]:
    found = check.swing_up
    reached = [
        ("swing-up found", "yes" if found.found else "no", ""),
        ("energy reached, of that of upright", f"{100 * min(found.share, 1.0):.3g}", "%"),
    ]
    if not found.found:
        return reached
    return [*reached, ("after", f"{found.time:.3g}", "s"), ("with a cart travel of", f"{found.travel:.3g}", "m")]
