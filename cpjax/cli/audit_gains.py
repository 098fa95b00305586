"""`cpjax audit-gains`: which plant printed gains come from, as a table, a picture and JSON."""

import argparse
from collections.abc import Mapping
from typing import Any

from cpjax.cli.builders import PLANT_OPTIONS, build_plant, parse_poles
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import Option, Sections, add_options, resolve
from cpjax.cli.output import say
from cpjax.cli.progress import progress
from cpjax.cli.tables import print_table
from cpjax.errors import InputError, MissingError
from cpjax.paper.gain_identification import GainAudit, audit_gains, write
from cpjax.paper.plant_fit import PARAMETERS
from cpjax.paper.printed_gains import PrintedGain, printed_in_the_paper

OPTIONS = [
    *PLANT_OPTIONS,
    Option("gains", "lqr_gain", "an LQR gain as printed; its digits say how precise it is", count=4),
    Option("gains", "Q", "what it was designed for: diagonal of the state weight", float, count=4, flag="q"),
    Option("gains", "R", "and the weight of the voltage", float, flag="r"),
    Option("gains", "placement_gain", "a gain of pole placement as printed", count=4),
    Option("gains", "poles", "what it places, such as -3 -4 -5+2j -5-2j", count=4, numbers=True),
    Option("audit", "parameters", "those that may change, with commas between (default all of the plant's)"),
    Option("audit", "most", "how many may change at once (default 2)", int),
    Option("audit", "starts", "random initial states for each set of them (default 32)", int),
]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "Finds the changes of a plant that explain printed gains, and the combinations of parameters that the gains "
        "fix at all. Without a gain, audits the paper's. Writes audit_gains.json and audit_gains.png."
    )
    parser = commands.add_parser("audit-gains", help="which plant printed gains come from", description=text)
    add_options(parser, OPTIONS, out="out/audit-gains")
    parser.set_defaults(run=run, many_starts=True)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    plant = build_plant(sections["plant"])
    announce("audit-gains", notes_on(sections["plant"], plant))
    prints = _prints(sections["gains"])
    setting = _setting(sections)
    with progress("audit-gains") as report:
        audit = audit_gains(prints, plant, **setting, seed=given.seed, progress=report)
    path = given.out / "audit_gains.json"
    write(path, audit, prints, plant, seed=given.seed, **setting)

    from cpjax.show.figures import save_figure
    from cpjax.show.gain_identification import findings, picture

    save_figure(given.out / "audit_gains.png", picture(audit))
    print_audit(audit, plant)
    say(*findings(audit))
    say(f"wrote {path} and {given.out / 'audit_gains.png'}")
    return 0


def print_audit(audit: GainAudit, plant: Any) -> None:
    """Prints the tables of fits and of combinations of parameters."""
    from cpjax.show.gain_identification import DIRECTION_HEADER, FIT_HEADER, direction_cells, fit_cells, shown_fits

    title = "Residuals in units of the last printed digit"
    print_table(title, FIT_HEADER, [fit_cells(fit, plant) for fit in shown_fits(audit)], text_columns=2)
    title = "Combinations of parameters that the gains depend on, at the best of these plants"
    known = [direction_cells(d) for d in audit.directions if d.sensitivity > 0.0]
    print_table(title, DIRECTION_HEADER, known, text_columns=1)


def _setting(sections: Sections) -> dict[str, Any]:
    given = dict(sections["audit"])
    names = given.pop("parameters", None)
    chosen = PARAMETERS if names is None else tuple(name.strip() for name in names.split(","))
    return {"parameters": chosen, "most": min(2, len(chosen)), "starts": 32, **given}


def _prints(given: Mapping[str, Any]) -> list[PrintedGain]:
    prints = []
    if "placement_gain" in given:
        if "poles" not in given:
            raise MissingError("poles", "a placement gain is designed for poles")
        prints.append(PrintedGain.placement(given["placement_gain"], parse_poles(given["poles"])))
    if "lqr_gain" in given:
        for key in ("Q", "R"):
            if key not in given:
                raise MissingError(key, "an lqr gain is designed for weights")
        prints.append(PrintedGain.lqr(given["lqr_gain"], given["Q"], given["R"]))
    for key, gain in (("poles", "placement_gain"), ("Q", "lqr_gain"), ("R", "lqr_gain")):
        if key in given and gain not in given:
            raise InputError(key, given[key], f"absent where {gain} is")
    return prints or printed_in_the_paper()
