"""`cpjax sweep`: runs from many initial states, as a table, a picture and a file of all results."""

import argparse
import dataclasses
import time
from typing import Any

import numpy as np

from cpjax import files, io
from cpjax.cli.builders import CONTROLLER_OPTIONS, EVALUATION_OPTIONS, PLANT_OPTIONS, build_controller
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import Option, add_options, resolve
from cpjax.cli.output import say
from cpjax.cli.progress import progress
from cpjax.cli.rigs import (
    FIRMWARE_OPTIONS,
    RIG_OPTIONS,
    TRACK_OPTION,
    build_firmware,
    build_rig,
    split_period,
    with_usual_period,
)
from cpjax.cli.tables import print_table
from cpjax.plant.initial_states import sample_starts
from cpjax.rig import plant_of
from cpjax.sim.rollout import default_metrics
from cpjax.study.recording import SUFFIXES, record_sweep
from cpjax.study.summary import COSTS, summarise

_FORMATS = tuple(suffix[1:] for suffix in SUFFIXES)

OPTIONS = [
    *EVALUATION_OPTIONS,
    Option("sweep", "precision", "of all numbers (default float64)", choices=("float32", "float64")),
    Option("sweep", "format", "of the results (default npz; parquet needs pyarrow)", choices=_FORMATS),
    Option("sweep", "save_every", "keep every so many steps of the trajectories, instead of metrics", int),
    *PLANT_OPTIONS,
    *RIG_OPTIONS,
    TRACK_OPTION,
    *CONTROLLER_OPTIONS,
    *FIRMWARE_OPTIONS,
]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "Simulates a controller from many initial states, on all cores. Writes the metrics of each to metrics.npz "
        "(.parquet, .json), sweep.json and sweep.png; or trajectories, in parts. An interrupted run goes on where it "
        "stopped."
    )
    parser = commands.add_parser("sweep", help="one controller from many initial states", description=text)
    add_options(parser, OPTIONS, out="out/sweep")
    parser.set_defaults(run=run, many_starts=True)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    rig = build_rig(sections["plant"])
    plant = plant_of(rig)
    controller = build_controller(sections["controller"], plant)
    stated, estimation = split_period(sections["evaluation"], sections["firmware"])
    setting = {"starts": "hanging", "count": 4096, "duration": 20.0, "dt": 0.002, **stated}
    setting = with_usual_period(setting, stated, sections["plant"])
    firmware = build_firmware(estimation, rig, setting, given.seed, controller)
    notes = [*notes_on(sections["plant"], plant, {"the controller": controller}), *firmware.notes]
    announce("sweep", notes)
    chosen = {"precision": "float64", "format": "npz", **sections["sweep"]}
    name, count = setting.pop("starts"), setting.pop("count")
    starts = sample_starts(name, count, seed=given.seed, dtype=np.dtype(chosen["precision"]))
    save_every = chosen.get("save_every")
    path = given.out / ("trajectories" if save_every is not None else f"metrics.{chosen['format']}")
    usual: Any = default_metrics(rig)
    metric = dataclasses.replace(usual, reference_x=sections["controller"].get("reference_x", 0.0))
    begin = time.perf_counter()
    with progress("sweep") as report:

        def tell(done: int, total: int) -> None:
            rate = done * round(setting["duration"] / setting["dt"]) / (time.perf_counter() - begin) / 1e6
            report(done, total, f"initial states, {rate:.0f} M steps/s")

        metrics = record_sweep(
            path,
            rig,
            firmware(controller),
            starts,
            **{**setting, **firmware.simulation},
            clock="sampled",
            metrics=metric,
            save_every=save_every,
            about={"starts": name, "seed": given.seed},
            progress=tell,
        )
    seconds = time.perf_counter() - begin
    steps = round(setting["duration"] / setting["dt"])
    speed = f"{count * steps / 1e6:.0f} M steps in {seconds:.1f} s, compilation and files included"
    if metrics is None:
        say(speed, f"wrote {path}")
        return 0

    from cpjax.show.figures import save_figure
    from cpjax.show.sweep import picture

    summary = summarise(metrics)
    document = {
        "what": "summary of a sweep",
        "versions": files.versions(),
        "seed": given.seed,
        "starts": name,
        "run": setting,
        "precision": chosen["precision"],
        **io.encode_bench(rig),
        "controller": io.encode(controller),
        **firmware.entries(),
        "notes": notes,
        "file": path.name,
        "seconds": seconds,
        **summary,
    }
    files.write_json(given.out / "sweep.json", document)
    save_figure(given.out / "sweep.png", picture(starts, metrics))
    spread = summary["over_successes"]
    rows = [(cost, *(f"{spread[cost][key]:.4g}" for key in ("mean", "median", "max"))) for cost in COSTS]
    print_table("Over the successful runs", ("metric", "mean", "median", "max"), rows, text_columns=1)
    low, high = (100 * bound for bound in summary["success_interval"])
    say(f"{100 * summary['success_rate']:.2f} % of {count} initial states settle ({low:.2f} to {high:.2f} %)")
    say(speed)
    say(f"wrote {path}, sweep.json and sweep.png")
    return 0
