"""`cpjax basin`: basins of attraction of controllers, as maps, JSON and files of all runs."""

import argparse
import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cpjax import files, io
from cpjax.cli.builders import PLANT_OPTIONS, controller_title, named_hybrid
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import Option, add_options, resolve
from cpjax.cli.output import say
from cpjax.cli.progress import progress
from cpjax.cli.rigs import (
    BARE,
    FIRMWARE_OPTIONS,
    RIG_OPTIONS,
    TRACK_OPTION,
    Firmware,
    build_firmware,
    build_rig,
    split_period,
    with_usual_period,
)
from cpjax.cli.tables import print_table
from cpjax.controllers import Hybrid
from cpjax.controllers.protocol import Controller
from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.plant.state import NAMES, UNITS
from cpjax.rig import Rig, plant_of
from cpjax.sim.metrics import Metrics
from cpjax.study.basin import MOST_CELLS, Axis, StartGrid, area, document
from cpjax.study.design_check import DesignCheck, check_design
from cpjax.study.recording import read_sweep, record_sweep
from cpjax.workspace import Workspace

if TYPE_CHECKING:  # importing matplotlib is slow; bad input should fail before it
    from cpjax.show.basin import Panel

CONTROLLERS = ("corrected/lqr", "corrected/placement", "tuned_lqr", "tuned_place")
_RANGES = {"x": (-2.0, 2.0), "x_dot": (-3.0, 3.0), "theta": (-math.pi, math.pi), "theta_dot": (-12.0, 12.0)}

OPTIONS = [
    Option("map", "across", "coordinate of the horizontal axis (default theta)", choices=NAMES),
    Option("map", "up", "coordinate of the vertical axis (default theta_dot)", choices=NAMES),
    Option("map", "cells", "along each axis (default 512)", int),
    *(
        Option(
            "map",
            name,
            f"range of {name} [{unit}]: of its axis (default {low:.4g} {high:.4g}), or else what each initial state's "
            "is drawn from (default 0 0)",
            float,
            count=2,
        )
        for (name, (low, high)), unit in zip(_RANGES.items(), UNITS, strict=True)
    ),
    Option(
        "map",
        "controllers",
        "one map each: tuned_lqr, tuned_place, a file, or a law of the paper with its regulator, such as "
        "as-printed/placement or corrected/lqr/computed (default " + " ".join(CONTROLLERS) + ")",
        count="+",
    ),
    Option("run", "duration", "length of each run [s] (default 10)", float),
    Option("run", "dt", "integration step and control period [s] (default 0.002)", float),
    *PLANT_OPTIONS,
    *RIG_OPTIONS,
    TRACK_OPTION,
    *FIRMWARE_OPTIONS,
]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "Runs controllers from every cell of a map over two coordinates of the initial state. Writes basin.png, "
        "basin.json and the metrics of all runs. Sampled, not certified. An interrupted map goes on where it stopped."
    )
    parser = commands.add_parser("basin", help="where controllers work, as maps", description=text)
    add_options(parser, OPTIONS, out="out/basin")
    parser.set_defaults(run=run, many_starts=True)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    rig = build_rig(sections["plant"])
    plant = plant_of(rig)
    chosen = dict(sections["map"])
    names = chosen.pop("controllers", list(CONTROLLERS))
    if len({file_of(name) for name in names}) < len(names):
        raise InputError("controllers", names, "each one once, and with names that differ in more than their endings")
    controllers = {name: named_hybrid(name, plant) for name in names}
    stated, estimation = split_period(sections["run"], sections["firmware"])
    setting = with_usual_period({"duration": 10.0, "dt": 0.002, **stated}, stated, sections["plant"])
    firmware = build_firmware(estimation, rig, setting, given.seed)
    notes = [*notes_on(sections["plant"], plant, controllers), *firmware.notes]
    announce("basin", notes)
    begin = time.perf_counter()
    chart = chart_of(chosen, given.seed)
    rows, _ = run_basin(given.out, given.out / "basin.parts", rig, controllers, chart, setting, notes, firmware)
    seconds = time.perf_counter() - begin
    print_table(*table(rows), text_columns=1)
    steps = len(names) * chart.up.cells * chart.across.cells * round(setting["duration"] / setting["dt"])
    say(f"{steps / 1e6:,.0f} M steps in {seconds:.1f} s, compilation, files and picture included")
    say(f"wrote {given.out / 'basin.json'}, basin.png and the runs of each map")
    return 0


def run_basin(
    out: Path,
    parts: Path,
    rig: Rig | CartPole,
    controllers: Mapping[str, Hybrid],
    chart: StartGrid,
    setting: dict[str, Any],
    notes: Sequence[str] = (),
    firmware: Firmware = BARE,
) -> tuple[dict[str, dict[str, Any]], bytes]:
    """Maps all controllers and, when all are done, writes basin.json, basin.png and their runs.

    Until then all results are in the folder `parts`, from where an interrupted map goes on, and the files of an earlier
    map in `out` stay as they are.

    Args:
      controllers: by the names that `controller_title` puts into words.
      chart: the grid of initial states.
      setting: duration and dt [s], and perhaps control_period.
      notes: for the JSON.
      firmware: what runs around each controller.

    Returns:
      Each controller's map in a few numbers, by name, and the picture.
    """
    request = {
        "what": "share of a map from which controllers settle: sampled, not certified",
        "versions": files.versions(),
        "map": dataclasses.asdict(chart),
        "run": setting,
        **io.encode_bench(rig),
        "controllers": {name: io.encode(one) for name, one in controllers.items()},
        **firmware.entries(),
    }
    how = {**setting, **firmware.simulation}
    with Workspace(parts, request) as memory:
        metrics = {name: compute_map(memory, rig, chart, name, firmware(one), how) for name, one in controllers.items()}
        rows = {name: document(chart, found) for name, found in metrics.items()}

        from cpjax.show.basin import basins
        from cpjax.show.figures import png

        panels = [panel_of(plant_of(rig), chart, name, one, metrics[name]) for name, one in controllers.items()]
        picture = png(basins(chart, panels))
        recorded = {name: file_of(name) for name in controllers}
        for file in recorded.values():
            (parts / file).replace(out / file)
        files.write_bytes(out / "basin.png", picture)
        files.write_json(out / "basin.json", {**request, "basins": rows, "files": recorded, "notes": notes})
    return rows, picture


def chart_of(chosen: dict[str, Any], seed: int) -> StartGrid:
    """Builds the grid of initial states that the options describe.

    Args:
      chosen: the values of the section "map".
      seed: of the initial states.

    Raises:
      InputError: a number of cells or a range that is not allowed.
    """

    cells = chosen.get("cells", 512)
    if not 2 <= cells <= MOST_CELLS:
        raise InputError("cells", cells, f"a whole number from 2 to {MOST_CELLS}")

    def axis(name: str) -> Axis:
        low, high = chosen.get(name) or _RANGES[name]
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(name.replace("_", "-"), (low, high), "two finite numbers, the lower one first")
        return Axis(name, low, high, cells)

    across, up = axis(chosen.get("across", "theta")), axis(chosen.get("up", "theta_dot"))
    others = {name: tuple(chosen[name]) for name in NAMES if name in chosen and name not in (across.name, up.name)}
    return StartGrid(across, up, others, seed)


def file_of(name: str) -> str:
    """Returns the name of the file with a controller's runs."""
    return name.replace("/", "-").removesuffix(".json").removesuffix(".toml").lstrip(".-") + ".npz"


def compute_map(
    memory: Workspace, rig: Rig | CartPole, chart: StartGrid, name: str, controller: Controller, setting: dict[str, Any]
) -> Metrics:
    """Returns the metrics of a controller's map, recorded in `memory` or, if complete there, read from it."""
    path = memory.folder / file_of(name)
    known = memory.intact(path, read_sweep)
    if known is not None:
        columns: dict[str, Any] = known[1]
        return Metrics(**{field.name: columns[field.name] for field in dataclasses.fields(Metrics)})
    with progress(name) as report:
        metrics: Metrics = record_sweep(
            path,
            rig,
            controller,
            chart.starts(),
            **setting,
            clock="sampled",
            about={"across": chart.across.name, "up": chart.up.name, "cells": chart.across.cells, "seed": chart.seed},
            progress=lambda done, total: report(done, total, "starts"),
        )
    return metrics


def panel_of(plant: CartPole, chart: StartGrid, name: str, controller: Hybrid, metrics: Metrics) -> "Panel":
    """Returns one controller's panel of the picture."""
    from cpjax.show.basin import Panel

    found = area(chart, np.asarray(metrics.success))
    return Panel(
        controller_title(name),
        controller,
        float(plant.motor.voltage_limit),
        _checked(plant, controller),
        metrics,
        found,
    )


def _checked(plant: CartPole, controller: Hybrid) -> DesignCheck | None:
    regulator: Any = controller.regulator
    try:
        return check_design(plant, regulator, controller.gate)
    except InputError:
        return None


def table(rows: Mapping[str, dict[str, Any]]) -> tuple[str, tuple[str, ...], list[tuple[str, ...]]]:
    """Returns title, header and cells of the printed table, from the numbers of each map by controller."""

    def text(value: float | None) -> str:
        return "-" if value is None else f"{value:.3g}"

    unit = next(iter(rows.values()))["area_unit"]
    header = (
        "controller",
        "share [%]",
        f"area [{unit}]",
        "95 % +-",
        "settling [s]",
        "its maximum [s]",
        "switches",
        "at most",
    )
    cells = [
        (
            controller_title(name),
            f"{100 * row['share']:.2f}",
            f"{row['area']:.3f}",
            f"{row['area_half_width']:.3f}",
            *(text(row[k]) for k in ("settling_time_mean", "settling_time_max", "switches_mean", "switches_max")),
        )
        for name, row in rows.items()
    ]
    return "Basins of attraction, sampled", header, cells
