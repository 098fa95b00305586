"""`cpjax tune`: a controller tuned by gradients through swing-ups, as a file for `--controller` of other commands."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from cpjax import files, io
from cpjax.cli.builders import PLANT_OPTIONS, saved
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import Option, add_options, options_of, resolve
from cpjax.cli.output import say
from cpjax.cli.progress import compiling, progress
from cpjax.cli.rigs import RIG_OPTIONS, build_rig, refuse_parts
from cpjax.cli.tables import print_table
from cpjax.controllers import Hybrid
from cpjax.errors import InputError
from cpjax.paper.initial import initial_controller
from cpjax.plant import CartPole
from cpjax.rig import Rig, plant_of
from cpjax.tune.baseline import GateKind
from cpjax.tune.config import TuningConfig
from cpjax.tune.objective import Goal
from cpjax.tune.parameters import FreeParameters, free_parameters

if TYPE_CHECKING:  # imports optax, which is slow
    from cpjax.tune.outcome import Tuning

OPTIONS = [
    *PLANT_OPTIONS,
    *RIG_OPTIONS,
    Option("tune", "design", "of the regulator (default lqr)", choices=("lqr", "placement")),
    Option("tune", "start_from", "baseline, paper, or a file with a controller that has a design (default baseline)"),
    Option("tune", "gate", "of baseline and paper (default angle-rate)", choices=get_args(GateKind)),
    Option("tune", "frozen", "parameters to leave as they are, with commas between"),
    Option("tune", "free", "the only parameters to change, with commas between"),
    Option("tune", "full_q", "a full state weight (default diagonal)", choices=("full", "diagonal"), flag="q-shape"),
    *(option for option in options_of("tune", TuningConfig, defaults=True) if option.key != "seed"),
    *options_of("goal", Goal, defaults=True),
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
    rig = build_rig(sections["plant"])
    refuse_parts(rig, "tune", honoured=("track",))
    plant = plant_of(rig)
    setting = dict(sections["tune"])
    chosen: dict[str, Any] = {key: setting.pop(key) for key in ("design", "gate") if key in setting}
    controller = _begin(setting.pop("start_from", "baseline"), plant, chosen)
    notes = notes_on(sections["plant"], plant, {"the controller to start from": controller})
    goal = dict(sections["goal"])
    if isinstance(rig, Rig) and rig.track is not None:
        goal = _within(float(rig.track.half_length), goal)
        notes.append(
            f"the rig's track counts as the goal's: track_limit {goal['track_limit']:g} m, weight track "
            f"{goal['track']:g}"
        )
    announce("tune", notes)
    names = {key: _names(setting.pop(key)) for key in ("free", "frozen") if key in setting}
    free = free_parameters(controller, **names, full_q=setting.pop("full_q", "diagonal") == "full")
    plan = TuningConfig(seed=given.seed, goal=Goal(**goal), **setting)
    tuning, _ = run_tuning(given.out, rig, free, plan, given.out / "checkpoint.npz", notes)
    before = np.asarray(free.physical(free.start()))
    rows = [(label, f"{a:.4g}", f"{b:.4g}") for label, a, b in zip(tuning.labels, before, tuning.physical, strict=True)]
    print_table("Parameters, SI units", ("parameter", "start", "tuned"), rows, text_columns=1)
    after = f", after {tuning.settling_time:.3f} s on average" if tuning.success_rate > 0.0 else ""
    say(
        f"{100 * tuning.success_rate:.2f} % of {plan.final} initial states settle{after}; "
        f"{tuning.value_steps / 1e6:.1f} M steps of values, {tuning.gradient_steps / 1e6:.2f} M of gradients, "
        f"{tuning.seconds:.0f} s"
    )
    say(f"wrote {given.out / 'tuned.json'}, tune.json and tune.png")
    return 0 if tuning.success_rate > 0.0 else 1


def run_tuning(
    out: Path,
    rig: Rig | CartPole,
    free: FreeParameters,
    plan: TuningConfig,
    checkpoint: Path,
    notes: Sequence[str] = (),
) -> "tuple[Tuning, bytes]":
    """Runs the tuning, writes tuned.json, tune.json and tune.png, and returns the tuning and the picture.

    Args:
      rig: the plant, or a rig whose track, if any, is the goal's.
      checkpoint: NPZ file from which an interrupted run goes on; removed at the end.
      notes: for the JSON.
    """
    from cpjax.tune.outcome import document
    from cpjax.tune.tuner import tune  # imports optax, which is slow; other commands need none

    plant = plant_of(rig)
    with progress("tune") as report:
        tuning = tune(plant, free, plan, progress=compiling(report, "screened", "loss"), checkpoint=checkpoint)
    io.save(out / "tuned.json", tuning.controller)
    files.write_json(out / "tune.json", {**document(tuning, plant, free, plan), **io.encode_bench(rig), "notes": notes})

    from cpjax.show.figures import save_figure
    from cpjax.show.tuning import picture

    drawn = save_figure(out / "tune.png", picture(tuning))
    checkpoint.unlink(missing_ok=True)
    return tuning, drawn


def _begin(name: str, plant: Any, chosen: dict[str, Any]) -> Hybrid:
    if Path(name).suffix.lower() not in (".json", ".toml"):
        return initial_controller(name, chosen.pop("design", "lqr"), plant, **chosen)
    for field, value in chosen.items():
        raise InputError(field, value, "absent: the file's controller has one")
    loaded = saved(name, "start_from")
    if not isinstance(loaded, Hybrid):
        raise InputError("start_from", name, "a file that holds a Hybrid")
    return loaded


def _within(half_length: float, goal: dict[str, Any]) -> dict[str, Any]:
    """Returns the goal with a track's limit [m] and a weight of the time beyond it, unless they are given."""
    limit = goal.get("track_limit", half_length)
    if limit > half_length:
        raise InputError("track_limit", limit, f"at most that of the rig's track, {half_length:g} m")
    return {"track": 1.0, **goal, "track_limit": limit}


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]
