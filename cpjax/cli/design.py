"""`cpjax design`: the checks of a regulator on a plant, as a table, a picture and JSON."""

import argparse
from typing import Any

from cpjax import files, io
from cpjax.cli.builders import CONTROLLER_OPTIONS, PLANT_OPTIONS, build_hybrid
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import add_options, resolve
from cpjax.cli.output import say
from cpjax.cli.rigs import RIG_OPTIONS, build_rig, parts_of
from cpjax.cli.tables import print_table
from cpjax.rig import plant_of
from cpjax.study.design_check import check_design, document

OPTIONS = [*PLANT_OPTIONS, *RIG_OPTIONS, *CONTROLLER_OPTIONS]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "Computes or takes a regulator's gain and checks it on the plant's linear model: poles, margins, the voltage "
        "that it asks for, and the region in which it needs neither clip nor gate. Writes design.json and design.png."
    )
    parser = commands.add_parser("design", help="a regulator's gain and its checks", description=text)
    add_options(parser, OPTIONS, out="out/design")
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    rig = build_rig(sections["plant"])
    plant = plant_of(rig)
    controller = build_hybrid(sections["controller"], plant)
    notes = notes_on(sections["plant"], plant, {"the controller": controller})
    if parts_of(rig):
        notes.append(f"these checks are of the plant alone: of the rig's {', '.join(parts_of(rig))} they know nothing")
    announce("design", notes)
    regulator: Any = controller.regulator
    check = check_design(plant, regulator, controller.gate)
    path = given.out / "design.json"
    setting = {"seed": given.seed, **io.encode_bench(rig), "controller": io.encode(controller), "notes": notes}
    files.write_json(path, document(check, **setting))

    from cpjax.show.design import instability, picture, rows
    from cpjax.show.figures import save_figure

    limit = float(plant.motor.voltage_limit)
    title = "u = -K s with K = " + ", ".join(f"{k:.5g}" for k in check.K[0])
    save_figure(given.out / "design.png", picture(check, controller.gate, limit, title))
    unstable = instability(check)
    if unstable is not None:
        say(unstable)
    print_table(title, ("check", "value", "unit"), rows(check, limit), text_columns=3)
    say(f"wrote {path} and {given.out / 'design.png'}")
    return 0
