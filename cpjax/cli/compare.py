"""`cpjax compare`: the paper's gains against tuned ones, as a table, pictures and JSON."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cpjax import files, io, paper
from cpjax.cli.builders import EVALUATION_OPTIONS, PLANT_OPTIONS, saved
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import Option, add_options, resolve
from cpjax.cli.output import say
from cpjax.cli.progress import progress
from cpjax.cli.rigs import (
    BARE,
    FIRMWARE_OPTIONS,
    RIG_OPTIONS,
    Firmware,
    build_firmware,
    build_rig,
    split_period,
    with_usual_period,
)
from cpjax.cli.tables import print_table
from cpjax.controllers import Hybrid, LqrWeights, PoleFactors
from cpjax.errors import InputError
from cpjax.paper.comparison import Compared, Entry, best, compare, document, entries
from cpjax.paper.reproduction import DESIGNS, EvaluationConfig
from cpjax.plant import CartPole
from cpjax.plant.state import NAMES, State
from cpjax.rig import Rig, plant_of
from cpjax.sim.rollout import rollout

OPTIONS = [
    *PLANT_OPTIONS,
    *RIG_OPTIONS,
    *FIRMWARE_OPTIONS,
    *EVALUATION_OPTIONS,
    Option("tuned", "lqr", "a file of `cpjax tune`, instead of the one that comes with cpjax", flag="tuned-lqr"),
    Option("tuned", "placement", "the same for pole placement", flag="tuned-placement"),
    Option("tuned", "track_limit", "leaving |x| within it is failure (default none) [m]", float),
]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "The paper's gains, as printed and as computed, with its law as printed and as corrected, against tuned "
        "controllers, over the same initial states. Writes compare.json, responses.png, phase.png and by_start.png."
    )
    parser = commands.add_parser("compare", help="the paper's gains against tuned ones", description=text)
    add_options(parser, OPTIONS, out="out/compare")
    parser.set_defaults(run=run, many_starts=True)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    rig = build_rig(sections["plant"])
    plant = plant_of(rig)
    setting = EvaluationConfig(seed=given.seed, **sections["evaluation"])
    stated, estimation = split_period(sections["evaluation"], sections["firmware"])
    timing = with_usual_period({**stated, "dt": setting.dt}, stated, sections["plant"])
    firmware = build_firmware(estimation, rig, timing, given.seed)
    files = dict(sections["tuned"])
    limit = files.pop("track_limit", float("inf"))
    tuned = {design: _loaded(design, files[design]) for design in DESIGNS if design in files}
    notes = notes_on(sections["plant"], plant, {_name(one): one.controller for one in entries(plant, tuned)})
    notes += firmware.notes
    announce("compare", notes)
    results, shown_start, _ = run_comparison(given.out, rig, setting, tuned, limit, notes, firmware)

    from cpjax.show.comparison import findings

    print_results(results)
    say(*findings(results), f"responses.png and phase.png show start {shown_start}.")
    say(f"wrote {given.out / 'compare.json'} and the pictures beside it")
    return 0


def run_comparison(
    out: Path,
    rig: Rig | CartPole,
    setting: EvaluationConfig,
    tuned: Mapping[paper.Design, Hybrid],
    track_limit: float = float("inf"),
    notes: Sequence[str] = (),
    firmware: Firmware = BARE,
) -> tuple[list[Compared], str, dict[str, bytes]]:
    """Runs the comparison and writes its JSON and pictures.

    Args:
      tuned: by design; the presets where it has none.
      track_limit: a run that leaves |x| <= track_limit [m] fails.
      notes: for the JSON.
      firmware: what runs around each controller.

    Returns:
      The results, in words which initial state the pictures of one run show, and the pictures by name.
    """
    plant = plant_of(rig)
    chosen = entries(plant, tuned)
    how: dict[str, Any] = dict(firmware.simulation)
    with progress("compare") as report:
        starts, results = compare(
            rig, chosen, setting, track_limit=track_limit, progress=report, firmware=firmware, **how
        )
    best_ones: dict[tuple[str, str], Compared] = {
        (kind, design): best(results, design, tuned=kind == "tuned")
        for kind in ("paper", "tuned")
        for design in DESIGNS
    }
    start, chosen_because = representative_start(starts, list(best_ones.values()))
    shown_start = {"state": io.encode(start), "is": chosen_because}
    more = {"track_limit": track_limit, "shown_start": shown_start, "notes": notes, **firmware.entries()}
    described = document(rig, results, setting, **more)
    files.write_json(out / "compare.json", described)

    from cpjax.show.comparison import by_start, phase_portraits, responses
    from cpjax.show.figures import save_figure

    how |= {"duration": setting.duration, "dt": setting.dt, "clock": "sampled"}
    shown = {key: (one, rollout(rig, firmware(one.entry.controller), start, **how)) for key, one in best_ones.items()}
    times = [float(run.metrics.settling_time) for _, run in shown.values() if bool(run.metrics.success)]
    until = min(setting.duration, 1.1 * max(times, default=setting.duration)) or setting.duration
    title = f"start {chosen_because}"
    figures = {
        "responses": responses(shown, until, float(plant.motor.voltage_limit), title),
        "phase": phase_portraits(plant, shown, title),
        "by_start": by_start(starts, results),
    }
    return results, chosen_because, {name: save_figure(out / f"{name}.png", one) for name, one in figures.items()}


def representative_start(starts: State, shown: Sequence[Compared]) -> tuple[State, str]:
    """Returns the first initial state that all shown controllers catch, or else the first one; and in words which.

    Args:
      starts: of arrays (n,).
      shown: with metrics of arrays (n,).
    """
    caught = np.all([np.asarray(one.metrics.success) for one in shown], axis=0)
    index = int(np.argmax(caught))
    start = State(*(float(np.asarray(getattr(starts, name))[index]) for name in NAMES))
    if not caught[index]:
        return start, f"the first of {len(caught)}: no initial state is caught by all shown controllers"
    return start, f"number {index + 1} of {len(caught)}, the first that all shown controllers catch"


def print_results(results: list[Compared]) -> None:
    """Prints the table."""
    from cpjax.show.comparison import HEADER, cells

    print_table("Means over the successful runs", HEADER, map(cells, results), text_columns=3)


def _name(entry: Entry) -> str:
    return f"{entry.name}, {entry.design}" + ("" if entry.gains == "tuned" else f", {entry.gains}")


def _loaded(design: str, path: str) -> Hybrid:
    loaded = saved(path, f"tuned-{design}")
    if not isinstance(loaded, Hybrid):
        raise InputError(f"tuned-{design}", path, "a file that holds a Hybrid")
    wanted = LqrWeights if design == "lqr" else PoleFactors
    found = getattr(loaded.regulator, "design", None)
    if found is not None and not isinstance(found, wanted):
        raise InputError(f"tuned-{design}", path, f"a file whose regulator has the design {wanted.__name__}, or none")
    return loaded
