"""`cpjax tune`: a controller tuned by gradients through swing-ups, as a file for `--controller` of other commands."""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from cpjax import files, io
from cpjax.cli.builders import PLANT_OPTIONS, build_plant, saved
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import Option, add_options, numbers_of, resolve
from cpjax.cli.output import say
from cpjax.cli.progress import compiling, progress
from cpjax.cli.tables import print_table
from cpjax.controllers import Hybrid
from cpjax.errors import InputError
from cpjax.paper.initial import initial_controller
from cpjax.plant import CartPole
from cpjax.plant.initial_states import START_SETS
from cpjax.tune.baseline import GateKind
from cpjax.tune.config import AGGREGATES, TuningConfig
from cpjax.tune.objective import Goal
from cpjax.tune.parameters import FreeParameters, free_parameters

if TYPE_CHECKING:  # imports optax, which is slow
    from cpjax.tune.outcome import Tuning

_DEFAULTS = {field.name: field.default for field in dataclasses.fields(TuningConfig)}
_PLANNED = {
    "candidates": "random controllers to choose restarts from",
    "restarts": "controllers that are tuned side by side",
    "batch": "starts of a step",
    "resample": "steps after which these are drawn anew; 0 to keep the first ones",
    "steps": "of the optimiser",
    "learning_rate": "Adam's, at first",
    "duration": "of the tuning's rollouts [s]",
    "dt": "their step [s]",
    "first_width": "of the target, at first [rad and m]",
    "last_width": "of the target, in the end [rad and m]",
    "spare_rate": "steps beyond those in each second, for crossings [1/s]",
    "temperature": "of a soft maximum or a success-weighted mean [s]",
    "threshold": "of a success-weighted mean [s]",
    "tail": "share of the worst starts that the mean is taken over",
    "explore": "noise when the worse half of the restarts goes on from the better",
    "clip": "a start's gradient is norm-clipped to this many times the batch's median norm",
    "screening": "starts by which all candidates are compared",
    "validation": "starts of a validation",
    "validate_every": "steps between validations",
    "horizon": "of screening and validation [s]",
    "horizon_dt": "their step and control period [s]",
    "finalists": "restarts that are compared once more in the end",
    "final": "starts of that comparison",
    "pole_limit": "bound on the fastest closed-loop pole [1/s]",
    "patience": "validations without progress after which to end; 0 for never",
    "plant_spread": "draw each start's plant within this share about the given one",
}
OPTIONS = [
    *PLANT_OPTIONS,
    Option("tune", "design", "of the regulator (default lqr)", choices=("lqr", "placement")),
    Option("tune", "start_from", "baseline, paper, or a file with a controller that has a design (default baseline)"),
    Option("tune", "gate", "of baseline and paper (default angle-rate)", choices=get_args(GateKind)),
    Option("tune", "frozen", "parameters to leave as they are, with commas between"),
    Option("tune", "free", "the only parameters to change, with commas between"),
    Option("tune", "full_q", "a full state weight (default diagonal)", choices=("full", "diagonal"), flag="q-shape"),
    Option("tune", "starts", "set of starts (default hanging)", choices=START_SETS),
    Option("tune", "aggregate", "of a batch's starts (default tail, a mean)", choices=AGGREGATES),
    *(
        Option("tune", name, f"{text} (default {_DEFAULTS[name]:g})", type(_DEFAULTS[name]))
        for name, text in _PLANNED.items()
    ),
    *numbers_of("goal", Goal),
]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "Tunes energy gain, cart terms, gate and Q or poles together, by gradients through whole swing-ups. Writes "
        "tuned.json (for --controller of other commands), tune.json and tune.png. An interrupted run goes on where it "
        "stopped, from checkpoint.npz in the same folder."
    )
    parser = commands.add_parser("tune", help="a controller tuned by gradients", description=text)
    add_options(parser, OPTIONS, out="out/tune")
    parser.set_defaults(run=run, many_starts=True)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    plant = build_plant(sections["plant"])
    setting = dict(sections["tune"])
    chosen: dict[str, Any] = {key: setting.pop(key) for key in ("design", "gate") if key in setting}
    controller = _begin(setting.pop("start_from", "baseline"), plant, chosen)
    notes = notes_on(sections["plant"], plant, {"the controller to start from": controller})
    announce("tune", notes)
    names = {key: _names(setting.pop(key)) for key in ("free", "frozen") if key in setting}
    free = free_parameters(controller, **names, full_q=setting.pop("full_q", "diagonal") == "full")
    plan = TuningConfig(seed=given.seed, goal=Goal(**sections["goal"]), **setting)
    tuning = tuned(given.out, plant, free, plan, given.out / "checkpoint.npz", notes)
    before = np.asarray(free.physical(free.start()))
    rows = [(label, f"{a:.4g}", f"{b:.4g}") for label, a, b in zip(tuning.labels, before, tuning.physical, strict=True)]
    print_table("Parameters, SI units", ("parameter", "start", "tuned"), rows, text_columns=1)
    after = f", after {tuning.settling_time:.3f} s on average" if tuning.success_rate > 0.0 else ""
    say(
        f"{100 * tuning.success_rate:.2f} % of {plan.final} starts settle{after}; {tuning.value_steps / 1e6:.1f} M "
        f"steps of values, {tuning.gradient_steps / 1e6:.2f} M of gradients, {tuning.seconds:.0f} s"
    )
    say(f"wrote {given.out / 'tuned.json'}, tune.json and tune.png")
    return 0 if tuning.success_rate > 0.0 else 1


def tuned(
    out: Path, plant: CartPole, free: FreeParameters, plan: TuningConfig, checkpoint: Path, notes: Sequence[str] = ()
) -> "Tuning":
    """Runs the tuning and writes tuned.json, tune.json and tune.png.

    Args:
      checkpoint: NPZ file from which an interrupted run goes on; removed at the end.
      notes: for the JSON.
    """
    from cpjax.tune.outcome import document
    from cpjax.tune.tuner import tune  # imports optax, which is slow; other commands need none

    with progress("tune") as report:
        tuning = tune(plant, free, plan, progress=compiling(report, "loss"), checkpoint=checkpoint)
    io.save(out / "tuned.json", tuning.controller)
    files.write_json(out / "tune.json", {**document(tuning, plant, free, plan), "notes": notes})

    from cpjax.show.figures import save_figure
    from cpjax.show.tuning import picture

    save_figure(out / "tune.png", picture(tuning))
    checkpoint.unlink(missing_ok=True)
    return tuning


def _begin(name: str, plant: Any, chosen: dict[str, Any]) -> Hybrid:
    if Path(name).suffix.lower() not in (".json", ".toml"):
        return initial_controller(name, chosen.pop("design", "lqr"), plant, **chosen)
    for field, value in chosen.items():
        raise InputError(field, value, "absent: the file's controller has one")
    loaded = saved(name, "start_from")
    if not isinstance(loaded, Hybrid):
        raise InputError("start_from", name, "a file that holds a Hybrid")
    return loaded


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]
