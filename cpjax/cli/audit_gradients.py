"""`cpjax audit-gradients`: which gradients through the loop can be trusted, as a table, a picture and JSON."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cpjax import files, io
from cpjax.cli.builders import CONTROLLER_OPTIONS, PLANT_OPTIONS, build_hybrid
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import Option, add_options, resolve
from cpjax.cli.output import say
from cpjax.cli.progress import compiling, progress
from cpjax.cli.rigs import RIG_OPTIONS, build_rig, refuse_parts
from cpjax.cli.tables import print_table
from cpjax.controllers import Hybrid
from cpjax.plant import CartPole
from cpjax.plant.initial_states import START_SETS, sample_starts
from cpjax.rig import Rig, plant_of
from cpjax.study.gradient_audit import GradientAudit, audit_gradients, document
from cpjax.study.named_parameters import parametrise

OPTIONS = [
    *PLANT_OPTIONS,
    *RIG_OPTIONS,
    *CONTROLLER_OPTIONS,
    Option("audit", "starts", "set of initial states (default hanging)", choices=START_SETS),
    Option("audit", "count", "number of initial states (default 16)", int),
    Option("audit", "duration", "length of each rollout [s] (default 4)", float),
    Option("audit", "dt", "integration step [s] (default 0.001)", float),
]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "Compares gradients through whole swing-ups, computed in three ways (switches located, switches read once per "
        "step, smooth surrogates), with finite differences, for each parameter of plant and controller; and says of "
        "each initial state whether its gradient can be trusted, and why not. Writes audit_gradients.json and .png."
    )
    parser = commands.add_parser("audit-gradients", help="which gradients can be trusted", description=text)
    add_options(parser, OPTIONS, out="out/audit-gradients")
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    rig = build_rig(sections["plant"])
    refuse_parts(rig, "audit-gradients")
    plant = plant_of(rig)
    controller = build_hybrid(sections["controller"], plant)
    notes = notes_on(sections["plant"], plant, {"the controller": controller})
    announce("audit-gradients", notes)
    audit, _ = run_audit(given.out, rig, controller, sections["audit"], given.seed, notes)

    from cpjax.show.gradients import TITLE, cells, findings, header

    print_table(TITLE, header(audit), cells(audit), text_columns=1)
    doubtful = [(str(i), kind, why) for i, (kind, why) in enumerate(audit.verdicts) if kind != "trustworthy"]
    if doubtful:
        print_table(
            "Starts whose gradients are not to be trusted", ("start", "verdict", "why"), doubtful, text_columns=3
        )
    say(*findings(audit))
    say(f"wrote {given.out / 'audit_gradients.json'} and {given.out / 'audit_gradients.png'}")
    return 0


def run_audit(
    out: Path,
    rig: Rig | CartPole,
    controller: Hybrid,
    setting: Mapping[str, Any],
    seed: int,
    notes: Sequence[str] = (),
) -> tuple[GradientAudit, bytes]:
    """Runs the audit, writes its JSON and picture, and returns the audit and the picture.

    Args:
      rig: the plant, or a rig of which only the plant counts.
      setting: starts, count, duration [s] and dt [s]; missing ones have the options' defaults.
      seed: of the initial states.
      notes: for the JSON.
    """
    setting = {"starts": "hanging", "count": 16, "duration": 4.0, "dt": 1e-3, **setting}
    starts = sample_starts(setting["starts"], setting["count"], seed=seed)
    chosen = parametrise(plant_of(rig), controller)
    with progress("audit-gradients") as report:
        audit = audit_gradients(
            chosen.build,
            chosen.parameters,
            starts,
            scales=chosen.scales,
            duration=setting["duration"],
            dt=setting["dt"],
            progress=compiling(report, "located"),
        )
    loop = {**io.encode_bench(rig), "controller": io.encode(controller), "notes": notes}
    described = document(audit, starts, seed=seed, setting=setting, parameters=chosen.parameters, **loop)
    files.write_json(out / "audit_gradients.json", described)

    from cpjax.show.figures import save_figure
    from cpjax.show.gradients import picture

    return audit, save_figure(out / "audit_gradients.png", picture([audit]))
