"""`cpjax swingup`: one rollout, as a table, a picture and JSON."""

import argparse
import dataclasses
import math
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cpjax import files, io
from cpjax.cli.builders import (
    CONTROLLER_OPTIONS,
    PLANT_OPTIONS,
    RUN_OPTIONS,
    START_OPTIONS,
    build_controller,
    build_start,
)
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import add_options, resolve
from cpjax.cli.output import say
from cpjax.cli.rigs import ESTIMATOR_OPTIONS, RIG_OPTIONS, TRACK_OPTION, build_firmware, build_rig, with_usual_period
from cpjax.controllers import REGULATE, Hybrid
from cpjax.errors import InputError
from cpjax.rig import plant_of
from cpjax.sim.flags import STOPPED, Flag, describe
from cpjax.sim.metrics import Metrics, ProtocolMetrics
from cpjax.sim.rollout import Trajectory, default_metrics, rollout

OPTIONS = [
    *START_OPTIONS,
    *RUN_OPTIONS,
    *PLANT_OPTIONS,
    *RIG_OPTIONS,
    TRACK_OPTION,
    *CONTROLLER_OPTIONS,
    *ESTIMATOR_OPTIONS,
]

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
    text = "Swing up from one initial state: prints the metrics, writes swingup.png and swingup.json."
    parser = commands.add_parser("swingup", help="one initial state: table, time plots, JSON", description=text)
    add_options(parser, OPTIONS, out="out/swingup")
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    rig = build_rig(sections["plant"])
    plant = plant_of(rig)
    controller = build_controller(sections["controller"], plant)
    settings: dict[str, Any] = {"duration": 20.0, "dt": 0.002, "clock": "sampled", **sections["run"]}
    settings = with_usual_period(settings, sections["run"], sections["plant"])
    firmware = build_firmware(sections["firmware"], rig, settings, given.seed, controller)
    notes = [*notes_on(sections["plant"], plant, {"the controller": controller}), *firmware.notes]
    announce("swingup", notes)
    start = build_start(sections["start"], given.seed)
    try:
        metric: Any = default_metrics(rig)
        metric = dataclasses.replace(metric, reference_x=sections["controller"].get("reference_x", 0.0))
        trajectory = rollout(rig, firmware(controller), start, metrics=metric, **{**settings, **firmware.simulation})
    except InputError as problem:
        raise InputError(problem.field.replace("start.", "start "), problem.value, problem.allowed) from problem
    metrics = trajectory.metrics
    path = given.out / "swingup.json"
    document = {
        "what": "one closed-loop rollout",
        "versions": files.versions(),
        "seed": given.seed,
        "run": settings,
        "start": io.encode(start),
        **io.encode_bench(rig),
        "controller": io.encode(controller),
        **firmware.entries(),
        "notes": notes,
        "flag": describe(metrics.flag),
        "metrics": {name: getattr(metrics, name) for name in metrics.__dataclass_fields__},
        "trajectory": {
            "time": trajectory.time,
            **{name: getattr(trajectory.state, name) for name in trajectory.state.__dataclass_fields__},
            "voltage": trajectory.voltage,
            "mode": trajectory.mode,
        },
    }
    files.write_json(path, document)

    from cpjax.show.figures import response, save_figure  # matplotlib is slow; bad input should fail before

    picture = given.out / "swingup.png"
    end = float(trajectory.time[-1])
    until = min(end, float(metrics.settling_time) + 3.0) if bool(metrics.success) else end  # settled, plus 3 s
    save_figure(picture, response(trajectory, _title(metrics), until, float(plant.motor.voltage_limit)))
    _print(metrics)
    if not bool(metrics.success):
        say("why: " + reason(trajectory, metric, hybrid=isinstance(controller, Hybrid)))
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
        table.add_row(name, "never" if field == "settling_time" and text == "inf" else text, unit)
    table.add_row("flag", describe(int(metrics.flag)), "")
    Console().print(table)


def reason(run: Trajectory, metric: ProtocolMetrics, *, hybrid: bool) -> str:
    """Says why a run does not count as settled, as far as its trajectory shows.

    Args:
      run: with every step saved.
      metric: the metric that did not count it as settled.
      hybrid: whether the controller has a gate.
    """
    flag, end = int(run.flag), float(run.time[-1])
    states = np.asarray(run.state.vector())
    x, theta = float(states[-1, 0]), float(states[-1, 2])
    if flag & STOPPED:
        held = np.all(states == states[-1], axis=1)
        since = float(run.time[_first_of_the_last(held)])
        what = "left all bounds" if flag & int(Flag.RUNAWAY) else "could not be computed any further"
        step, track = float(run.time[-1] - run.time[-2]), float(metric.track_limit)
        if flag & int(Flag.RUNAWAY) and abs(x) + 2.0 * step * abs(states[-1, 1]) >= track:
            return f"the cart left the track, {track:g} m each way, at {since:.3g} s"
        more = "; an integrator that is unstable for too long a step looks the same: try a smaller dt"
        return f"the state {what} at {since:.3g} s" + ("" if flag & int(Flag.OVERFLOW) else more)
    acting = np.asarray(run.mode) == REGULATE
    entries = int(acting[0]) + int(np.sum(acting[1:] & ~acting[:-1]))
    if hybrid and not acting.any():
        return "the pendulum never reached the gate, where the regulator takes over"
    if hybrid and not acting[-1]:
        times = "once" if entries == 1 else f"{entries} times"
        return f"the pendulum reached the gate {times}, and each time left it again"
    acts = f"the regulator acts since {float(run.time[_first_of_the_last(acting)]):.3g} s, but " if hybrid else ""
    angle, away = abs(math.remainder(theta, math.tau)), abs(x - float(metric.reference_x))
    if math.isfinite(float(run.metrics.settling_time)):
        since = end - float(run.metrics.settling_time)
        return f"{acts}the run ended {since:.2g} s after it had settled, and {float(metric.hold):g} s are asked for"
    return (
        f"{acts}at the end, after {end:g} s, the angle is {angle:.3g} rad and the cart {away:.3g} m away; settled is "
        f"within {float(metric.angle_band):g} rad and {float(metric.position_band):g} m"
    )


def _first_of_the_last(holds: np.ndarray[Any, Any]) -> int:
    """Returns the index from which `holds` (n,) is true to the end; n if it ends false."""
    return len(holds) - int(np.argmin(np.append(holds[::-1], False)))
