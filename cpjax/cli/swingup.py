"""`cpjax swingup`: one rollout, as a table, a picture and JSON."""

import argparse
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cpjax import io
from cpjax.cli.options import (
    CONTROLLER_OPTIONS,
    PLANT_OPTIONS,
    RUN_OPTIONS,
    START_OPTIONS,
    add_options,
    build_controller,
    build_plant,
    build_start,
    resolve,
)
from cpjax.cli.output import say
from cpjax.errors import InputError
from cpjax.sim.flags import describe
from cpjax.sim.metrics import Metrics, ProtocolMetrics
from cpjax.sim.rollout import rollout

OPTIONS = [*START_OPTIONS, *RUN_OPTIONS, *PLANT_OPTIONS, *CONTROLLER_OPTIONS]

_ROWS = (
    ("settling time", "settling_time", "s"),
    ("cart travel, max |x|", "cart_travel", "m"),
    ("effort, integral of u^2", "effort", "V^2 s"),
    ("total variation of u", "voltage_variation", "V"),
    ("peak voltage", "peak_voltage", "V"),
    ("peak cart acceleration", "peak_cart_acceleration", "m/s^2"),
    ("mode changes", "switches", ""),
)


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = "Swing up from one start: prints the metrics, writes swingup.png and swingup.json."
    parser = commands.add_parser("swingup", help="one start: table, time plots, JSON", description=text)
    add_options(parser, OPTIONS, out="out/swingup")
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    plant = build_plant(sections["plant"])
    controller = build_controller(sections["controller"], plant)
    start = build_start(sections["start"], given.seed)
    settings = {"duration": 20.0, "dt": 0.002, "clock": "sampled", **sections["run"]}
    try:
        fold = ProtocolMetrics(reference_x=sections["controller"].get("reference_x", 0.0))
        trajectory = rollout(plant, controller, start, metrics=fold, **settings)
    except InputError as problem:
        raise InputError(problem.field.replace("start.", "start "), problem.value, problem.allowed) from problem
    metrics = trajectory.metrics
    path = given.out / "swingup.json"
    document = {
        "what": "one closed-loop rollout",
        "versions": io.versions(),
        "seed": given.seed,
        "run": settings,
        "start": io.encode(start),
        "plant": io.encode(plant),
        "controller": io.encode(controller),
        "flag": describe(metrics.flag),
        "metrics": {name: getattr(metrics, name) for name in metrics.__dataclass_fields__},
        "trajectory": {
            "time": trajectory.time,
            **{name: getattr(trajectory.state, name) for name in trajectory.state.__dataclass_fields__},
            "voltage": trajectory.voltage,
            "mode": trajectory.mode,
        },
    }
    io.write_json(path, document)

    from cpjax.show.figures import response, save_figure  # matplotlib takes a while; bad input should not wait for it

    picture = given.out / "swingup.png"
    end = float(trajectory.time[-1])
    until = min(end, float(metrics.settling_time) + 3.0) if bool(metrics.success) else end  # at rest there is no news
    save_figure(picture, response(trajectory, _title(metrics), until, float(plant.motor.voltage_limit)))
    _print(metrics)
    say(f"wrote {path} and {picture}")
    return 0 if bool(metrics.success) else 1


def _title(metrics: Metrics) -> str:
    if bool(metrics.success):
        return f"settled after {float(metrics.settling_time):.2f} s"
    flag = describe(int(metrics.flag))
    return "did not settle" + ("" if flag == "clean" else f" ({flag})")


def _print(metrics: Metrics) -> None:
    table = Table(title=_title(metrics), title_justify="left")
    table.add_column("metric")
    table.add_column("value", justify="right")
    table.add_column("unit")
    for name, field, unit in _ROWS:
        value = np.asarray(getattr(metrics, field))
        text = str(int(value)) if np.issubdtype(value.dtype, np.integer) else f"{float(value):.4g}"
        table.add_row(name, "never" if text == "inf" else text, unit)
    table.add_row("flag", describe(int(metrics.flag)), "")
    Console().print(table)
